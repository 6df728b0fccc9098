"""Jets through faces that walls cut, too: which part of a jet each piece of fluid behind a face gets.

A plane side cuts facets in segments (in 2D in points, which stand for segments along a dummy axis). Within a face they
bound the fluid of a piece, with it on their left, and Green's formula gives the area that the piece has in common with
the jet's region K: with T(y) the area of K in the face below y, and A the area of K in the trapezoid between a segment
and the face's lower edge,

    area = - sum over segments of sgn(dy) A + sum over ends on the upper edge of +- T(y) [+ T(1)],

the last one if the piece has the face's upper right corner, as it has if the same sum without K lacks a face of what is
open of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from petfsi.fields.mac.grid.sides import Jet
from petfsi.fields.mac.walls.cut import Links
from petfsi.geometry.clipping import CutCells, Lattice
from petfsi.geometry.openings import DUMMY, areas_within
from petfsi.scene.fluids import MacFluid

#: What is open of a face by its segments must be what it is by the divergence theorem; where bodies overlap it is not.
AGREES = 1e-9
#: More pieces than a cell can have.
MOST_PIECES = 1 << 20


@dataclass(frozen=True)
class Bounds:
    """Segments that bound fluid in faces of a side, and their ends on the faces' upper edges.

    Attributes
    ----------
    key, cell : ndarray of int64, shape (n,)
        Of cell and piece together, and the cell's flat index in the box.
    ends : ndarray, shape (n, 2, 2)
        [segment, end, coordinate], from 0 to 1 in the face, with the fluid on the left.
    on_top : ndarray of bool, shape (n, 2)
    """

    key: np.ndarray
    cell: np.ndarray
    ends: np.ndarray
    on_top: np.ndarray


def jet_openings(
    cut: CutCells, facets: np.ndarray, lattice: Lattice, links: Links, jets: list[Jet], fluid: MacFluid,
    number: Callable[[Jet], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Return how open links through sides are to jets; set how much of its open part each jet gets of a face.

    Where bodies overlap a jet is spread evenly over what is open of a face. Not collective.

    Parameters
    ----------
    cut : CutCells
        Of a box of cells.
    facets : ndarray of int, shape (m, dim)
        As ``cut`` numbers them.
    lattice : Lattice
    links : Links
        Those through sides with a given velocity.
    jets : list of Jet
    fluid : MacFluid
        The table of the scene.
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
        if not jet.divides:
            continue
        faces = number(jet)
        some = np.flatnonzero((links.axis == jet.axis) & ((links.above < 0) if jet.upper else (links.below < 0)))
        order = np.argsort(faces)
        at = order[np.minimum(np.searchsorted(faces[order], links.face[some]), len(order) - 1)]
        use = (faces[at] == links.face[some]) & (jet.part[at] < 1.0)
        if np.any(use):
            some, at = some[use], at[use]
            openness = links.openness[some]
            of_jet, good = _parts(cut, facets, lattice, links, jet, fluid, some, jet.part[at])
            face, which = np.unique(at, return_inverse=True)
            good = np.bincount(which, ~good) == 0
            opened, gets = np.bincount(which, openness), np.bincount(which, of_jet)
            jet.mean[face[good]] = np.maximum(gets[good], 0.0) / opened[good]
            shares = of_jet * opened[which] / np.where(gets > 0.0, gets, 1.0)[which]
            opening[some] = np.where(good[which], shares, openness)
    return opening


def _parts(
    cut: CutCells, facets: np.ndarray, lattice: Lattice, links: Links, jet: Jet, fluid: MacFluid, some: np.ndarray,
    part: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return what links have of a jet, as fractions of faces of which it takes a part, and where that is known."""
    slot = np.maximum(links.below[some], links.above[some])
    n_box = int(np.prod(lattice.shape))
    further = slot >= n_box
    cell, piece = slot.copy(), np.zeros(len(slot), dtype=np.int64)
    cell[further] = cut.extra_cell[slot[further] - n_box]
    piece[further] = cut.extra_piece[slot[further] - n_box]
    wanted = cell * MOST_PIECES + piece
    bounds = _bounds(cut, facets, lattice, jet)
    order = np.argsort(wanted)
    at = order[np.minimum(np.searchsorted(wanted[order], bounds.key), len(order) - 1)]
    use = wanted[at] == bounds.key
    bounds, at = Bounds(bounds.key[use], bounds.cell[use], bounds.ends[use], bounds.on_top[use]), at[use]
    whole = np.bincount(at, _sums(bounds, _areas), len(wanted))
    corner = np.rint(links.openness[some] - whole)
    good = (np.abs(links.openness[some] - whole - corner) < AGREES) & ((corner == 0.0) | (corner == 1.0))
    taken = _sums(bounds, lambda corners: _of_jet(corners, bounds.cell, lattice, jet, fluid))
    return np.bincount(at, taken, len(wanted)) + corner * part, good


def _sums(bounds: Bounds, area: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return what each segment adds to the area of its piece; ``area`` is that of quadrilaterals in the same faces."""
    (y0, z0), (y1, z1) = bounds.ends[:, 0].T, bounds.ends[:, 1].T
    forth = y0 <= y1
    left, right = np.where(forth, (y0, z0), (y1, z1)), np.where(forth, (y1, z1), (y0, z0))
    total = np.where(forth, -1.0, 1.0) * area(_trapezoids(*left, *right))
    for end, sign in ((0, -1.0), (1, 1.0)):
        y = np.where(bounds.on_top[:, end], bounds.ends[:, end, 0], 0.0)
        total += sign * area(_trapezoids(np.zeros_like(y), np.ones_like(y), y, np.ones_like(y)))
    return total


def _trapezoids(y0: np.ndarray, z0: np.ndarray, y1: np.ndarray, z1: np.ndarray) -> np.ndarray:
    """Return the corners between the lower edges of faces and segments from (y0, z0) to (y1, z1), (n, 4, 2)."""
    flat = np.zeros_like(y0)
    return np.stack((y0, flat, y1, flat, y1, z1, y0, z0), axis=1).reshape(-1, 4, 2)


def _areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas of trapezoids on the lower edges of faces."""
    width = corners[:, 1, 0] - corners[:, 0, 0]
    return 0.5 * width * (corners[:, 2, 1] + corners[:, 3, 1])


def _of_jet(corners: np.ndarray, cell: np.ndarray, lattice: Lattice, jet: Jet, fluid: MacFluid) -> np.ndarray:
    """Return what the jet takes of trapezoids in faces, as fractions of the faces."""
    dim = len(lattice.shape)
    others = [b for b in range(dim) if b != jet.axis]
    index = np.array(np.unravel_index(cell, lattice.shape)) + np.asarray(lattice.lo)[:, None]
    real, size = np.empty_like(corners), 1.0
    real[:, :, 1] = DUMMY[0] + corners[:, :, 1]
    for n, b in enumerate(others):
        first = index[b] % lattice.cells[b]
        real[:, :, n] = lattice.origin[b] + (first[:, None] + corners[:, :, n]) * lattice.dx[b]
        size *= lattice.dx[b]
    at = lattice.origin[jet.axis] + (lattice.cells[jet.axis] * lattice.dx[jet.axis] if jet.upper else 0.0)
    assert jet.spec.region is not None
    return areas_within(fluid, jet.spec.region, jet.axis, float(at), real) / size


def _bounds(cut: CutCells, facets: np.ndarray, lattice: Lattice, jet: Jet) -> Bounds:
    """Return the segments in the faces of a jet's side."""
    a, dim = jet.axis, len(lattice.shape)
    others = [b for b in range(dim) if b != a]
    index = np.array(np.unravel_index(cut.cell, lattice.shape)) + np.asarray(lattice.lo)[:, None]
    near = np.flatnonzero(index[a] == (lattice.cells[a] - 1 if jet.upper else 0))
    _, first = np.unique(cut.cell[near] * (1 + int(cut.facet.max(initial=0))) + cut.facet[near], return_index=True)
    near = near[first]
    # corners in the order of their numbers, so that facets that share an edge share the point on it
    corners = (cut.points[np.sort(facets[cut.facet[near]], axis=1)] - lattice.origin) / lattice.dx
    away = corners[:, :, a] - (lattice.cells[a] if jet.upper else 0)
    above = away > 0.0
    through = np.any(above, axis=1) & ~np.all(above, axis=1)
    near, corners, away, above = near[through], corners[through], away[through], above[through]
    ends = _through_plane(corners, away, above)[:, :, others]
    place = index[np.array(others)[:, None], near].T
    normal = cut.normals[cut.facet[near]][:, others]
    if dim == 2:
        ends = np.stack((ends[:, :, 0], np.broadcast_to([0.0, 1.0], (len(ends), 2))), axis=2)
        place, normal = (np.column_stack((part, np.zeros(len(part)))) for part in (place, normal))
    ends = ends - place[:, None, :]
    for n, b in enumerate(others):
        if lattice.periodic[b]:
            turns = np.rint((0.5 - ends[:, :, n].mean(axis=1)) / lattice.cells[b])
            ends[:, :, n] += (turns * lattice.cells[b])[:, None]
    along = ends[:, 1] - ends[:, 0]
    turned = along[:, 0] * normal[:, 1] * lattice.dx[others[0]] < along[:, 1] * normal[:, 0] * lattice.dx[others[-1]]
    ends[turned] = ends[turned][:, ::-1]
    ends, on_top, inside = _within_face(ends)
    cell = cut.cell[near]
    return Bounds((cell * MOST_PIECES + cut.piece[near])[inside], cell[inside], ends[inside], on_top[inside])


def _through_plane(corners: np.ndarray, away: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return where edges of facets pass a plane, (n, 2, dim): triangles at two points, segments at one twice."""
    n, width, _ = corners.shape
    pairs = [(0, 1)] if width == 2 else [(0, 1), (0, 2), (1, 2)]
    points = []
    crossed = []
    for i, j in pairs:
        passes = above[:, i] != above[:, j]
        share = away[:, i] / np.where(passes, away[:, i] - away[:, j], 1.0)
        points.append(corners[:, i] + share[:, None] * (corners[:, j] - corners[:, i]))
        crossed.append(passes)
    if width == 2:
        return np.stack((points[0], points[0]), axis=1)
    first = np.argmax(crossed, axis=0)
    last = 2 - np.argmax(crossed[::-1], axis=0)
    every = np.stack(points)
    return np.stack((every[first, np.arange(n)], every[last, np.arange(n)]), axis=1)


def _within_face(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return segments clipped to the unit square, which of their ends are on its upper edge, and which are inside."""
    begin, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    inside = np.ones(len(ends), dtype=bool)
    top = np.column_stack((begin[:, 1] == 1.0, ends[:, 1, 1] == 1.0))
    for n in range(2):
        for bound, sign in ((0.0, 1.0), (1.0, -1.0)):
            here, rate = sign * (begin[:, n] - bound), sign * along[:, n]
            inside &= (rate != 0.0) | (here >= 0.0)
            at = -here / np.where(rate != 0.0, rate, 1.0)
            enters, leaves = (rate > 0.0) & (at > low), (rate < 0.0) & (at < high)
            low, high = np.where(enters, at, low), np.where(leaves, at, high)
            upper = n == 1 and bound == 1.0
            top[:, 0], top[:, 1] = np.where(enters, upper, top[:, 0]), np.where(leaves, upper, top[:, 1])
    inside &= low < high
    clipped = np.stack((begin + low[:, None] * along, begin + high[:, None] * along), axis=1)
    return np.clip(clipped, 0.0, 1.0), top, inside
