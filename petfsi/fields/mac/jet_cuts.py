"""Jets through faces that walls cut, too: which part of a jet each piece of fluid behind the face gets (2D).

On the line of a side the walls' crossings bound intervals of fluid, each of a piece that the walls themselves know.
With clip the nearest point of an interval, a piece has of it

    sum over crossings above it of clip(y) - sum over those below it of clip(y),

where the ends of the face count as crossings of the pieces that reach them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from petfsi.fields.mac.cut import Links
from petfsi.fields.mac.sides import Jet
from petfsi.geometry.clipping import CutCells, Lattice

#: What is open of a face by its crossings must be what it is by the divergence theorem; where bodies overlap it is not.
AGREES = 1e-9


def jet_openings(
    cut: CutCells, facets: np.ndarray, lattice: Lattice, links: Links, jets: list[Jet],
    number: Callable[[Jet], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Return how open links through sides are to jets; set how much of its open part each jet gets of a face.

    Elsewhere, and in 3D, a jet is spread evenly over what is open of a face. Not collective.

    Parameters
    ----------
    cut : CutCells
        Of a box of cells.
    facets : ndarray of int, shape (m, 2)
        As ``cut`` numbers them.
    lattice : Lattice
    links : Links
        Those through sides with a given velocity.
    jets : list of Jet
    number : callable
        Returns the flat index of a jet's faces among the box's faces of its axis; -1 beyond the box.

    Returns
    -------
    ndarray, shape (n_links,)
        The part of the face's flow, times the openness of the face.
    """
    opening = links.openness.copy()
    for jet in jets:
        jet.mean[:] = jet.part
        if lattice.dx.size != 2 or not jet.divides:
            continue
        faces = number(jet)
        some = np.flatnonzero((links.axis == jet.axis) & ((links.above < 0) if jet.upper else (links.below < 0)))
        order = np.argsort(faces)
        at = order[np.minimum(np.searchsorted(faces[order], links.face[some]), len(order) - 1)]
        use = (faces[at] == links.face[some]) & (jet.part[at] < 1.0)
        some, at = some[use], at[use]
        if len(some):
            _share(cut, facets, lattice, links, jet, some, at, opening)
    return opening


def _share(
    cut: CutCells, facets: np.ndarray, lattice: Lattice, links: Links, jet: Jet, some: np.ndarray, at: np.ndarray,
    opening: np.ndarray,
) -> None:  # fmt: skip
    """Give links their parts of a jet, of which they are on the faces ``at``."""
    b, shape = 1 - jet.axis, lattice.shape
    slot = np.maximum(links.below[some], links.above[some])
    n_box = int(np.prod(shape))
    further = slot >= n_box
    cell, piece = slot.copy(), np.zeros(len(slot), dtype=np.int64)
    cell[further] = cut.extra_cell[slot[further] - n_box]
    piece[further] = cut.extra_piece[slot[further] - n_box]
    # where the jet lies on the faces, which reach from 0 to 1
    along = np.array(np.unravel_index(cell, shape))[b] + lattice.lo[b]
    middle = (jet.points[at, b] - lattice.origin[b]) / lattice.dx[b] - along % lattice.cells[b]
    low, high = middle - 0.5 * jet.part[at], middle + 0.5 * jet.part[at]
    crossing = _crossings(cut, facets, lattice, jet)
    key = cell * (1 << 20) + piece
    whole = _within(*crossing, key, np.zeros(len(key)), np.ones(len(key)))
    of_jet = _within(*crossing, key, low, high)
    face, which = np.unique(at, return_inverse=True)
    opened = np.bincount(which, links.openness[some])
    wrong = np.bincount(which, np.abs(whole - links.openness[some])) > AGREES
    gets = np.bincount(which, of_jet)
    good = ~wrong & (opened > 0.0)
    jet.mean[face[good]] = np.maximum(gets[good], 0.0) / opened[good]
    shared = good[which]
    total = np.where(gets > 0.0, gets, 1.0)
    opening[some[shared]] = (of_jet * opened[which] / total[which])[shared]


def _crossings(
    cut: CutCells, facets: np.ndarray, lattice: Lattice, jet: Jet
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return keys of cells and pieces, places from 0 to 1, and 1 or -1 where fluid lies below or above them."""
    a, b = jet.axis, 1 - jet.axis
    index = np.array(np.unravel_index(cut.cell, lattice.shape)) + np.asarray(lattice.lo)[:, None]
    near = np.flatnonzero(index[a] == (lattice.cells[a] - 1 if jet.upper else 0))
    _, first = np.unique(cut.cell[near] * (1 + int(cut.facet.max(initial=0))) + cut.facet[near], return_index=True)
    near = near[first]
    ends = (cut.points[facets[cut.facet[near]]] - lattice.origin) / lattice.dx
    away = ends[:, :, a] - (lattice.cells[a] if jet.upper else 0)
    through = away[:, 0] * away[:, 1] < 0.0
    near, ends, away = near[through], ends[through], away[through]
    share = away[:, 0] / (away[:, 0] - away[:, 1])
    place = ends[:, 0, b] + share * (ends[:, 1, b] - ends[:, 0, b]) - index[b, near]
    if lattice.periodic[b]:
        place -= lattice.cells[b] * np.floor(place / lattice.cells[b])
    here = (place >= 0.0) & (place <= 1.0)
    near, place = near[here], place[here]
    sign = np.where(cut.normals[cut.facet[near], b] > 0.0, -1.0, 1.0)
    cell, key = cut.cell[near], cut.cell[near] * (1 << 20) + cut.piece[near]
    order = np.lexsort((place, cell))
    cell, key, place, sign = cell[order], key[order], place[order], sign[order]
    if not len(cell):
        return key, place, sign
    # pieces that reach the ends of a face
    begins = np.append(True, np.diff(cell) != 0)
    stops = np.append(np.diff(cell) != 0, True)
    lower, upper = np.flatnonzero(begins & (sign > 0.0)), np.flatnonzero(stops & (sign < 0.0))
    key = np.concatenate((key, key[lower], key[upper]))
    place = np.concatenate((place, np.full(len(lower), -np.inf), np.full(len(upper), np.inf)))
    return key, place, np.concatenate((sign, np.full(len(lower), -1.0), np.full(len(upper), 1.0)))


def _within(
    key: np.ndarray, place: np.ndarray, sign: np.ndarray, wanted: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return the length of the fluid of some pieces from low to high, by all crossings."""
    order = np.argsort(wanted)
    at = order[np.minimum(np.searchsorted(wanted[order], key), len(order) - 1)]
    use = wanted[at] == key
    at = at[use]
    return np.bincount(at, sign[use] * np.clip(place[use], low[at], high[at]), len(wanted))
