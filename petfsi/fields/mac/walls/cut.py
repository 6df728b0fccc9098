"""A grid cut by surfaces: how open its faces are, which pressures they join, and what the walls add.

With p at cell centres x_c and v on faces, n the normal out of the solid, A_f the area of a whole face and alpha_f its
open fraction,

    (D v)_c = sum_f +- alpha_f A_f v_f,    J[i, c] = -∫ N_i n dA over the walls of c,    D v + J^T u = 0 .

A fluid and solids that move alike have no net outflow anywhere, nor has a flow along a plane wall, whatever its slope:
the openings and walls of a cell close. This is the scheme of Ng, Min and Gibou (An efficient fluid-solid coupling
algorithm for single-phase flows, 2009); it takes the pressure on a wall from the centre of its cell, which is of first
order. See ``slivers`` for what makes it second.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit

from petfsi.geometry.clipping import CutCells


@dataclass(frozen=True)
class Walls:
    """What surfaces let through, by the nodes of facets.

    The net outflow of unknown ``slot`` is ``flux[:, i]`` times the velocity along ``axis`` of the facet's node i.

    Attributes
    ----------
    facet, axis : ndarray of int, shape (n,)
    slot : ndarray of int, shape (n,)
        A cell of the box, flat, or the number of its cells plus the number of an extra unknown.
    flux : ndarray, shape (n, width)
        m^2 (m in 2D); of as many nodes as ``CutCells.integrals``.
    """

    facet: np.ndarray
    axis: np.ndarray
    slot: np.ndarray
    flux: np.ndarray


@dataclass(frozen=True)
class Wet:
    """The patches of moving facets that bound fluid in this rank's cells.

    Attributes
    ----------
    facet : ndarray of int, shape (n,)
    first : ndarray, shape (n, width, dim, dim)
        [patch, i, a, b]: the integral of N_i n_a (x_b - origin_b) dA, m^3 (m^2 in 2D).
    """

    facet: np.ndarray
    first: np.ndarray


def first_moments(cut: CutCells, patches: np.ndarray, centres: np.ndarray) -> Wet:
    """Return what a linear pressure on some patches needs; ``centres`` are their cells', from the origin, (n, dim)."""
    facet = cut.facet[patches]
    moments = cut.moments[patches] + cut.integrals[patches, :, None] * centres[:, None, :]
    return Wet(facet, cut.normals[facet][:, None, :, None] * moments[:, :, None, :])


@dataclass(frozen=True)
class Links:
    """How faces of cells next to a surface join unknowns.

    Attributes
    ----------
    axis : ndarray of int, shape (n,)
    face : ndarray of int, shape (n,)
        Flat index among the box's faces of that axis.
    below, above : ndarray of int, shape (n,)
        Slots, see ``Walls``; -1 beyond a side.
    openness : ndarray, shape (n,)
        alpha_f.
    split : ndarray of bool, shape (n,)
        Whether one of the two cells holds more than one piece of fluid.
    """

    axis: np.ndarray
    face: np.ndarray
    below: np.ndarray
    above: np.ndarray
    openness: np.ndarray
    split: np.ndarray

    def where(self, chosen: np.ndarray) -> Links:
        """Return some of them."""
        return Links(*(getattr(self, f.name)[chosen] for f in fields(self)))


def links_of(cut: CutCells, shape: tuple[int, ...]) -> Links:
    """Return the links of all faces next to a surface. Not collective.

    Parameters
    ----------
    cut : CutCells
        Of a box of cells.
    shape : tuple of int
        The box's cells per axis.
    """
    cells = np.unique(cut.cell)
    walled, is_split = np.zeros((2, int(np.prod(shape))), dtype=bool)
    walled[cells] = True
    is_split[cut.extra_cell] = True
    columns = []
    for a in range(len(shape)):
        alpha = cut.open[a].reshape(-1)
        columns.append(_plain_links(a, cells, walled, is_split, np.array(shape), alpha))
    if len(cut.link_axis):
        below, above = (_link_slots(cut, shape, side) for side in (0, 1))
        columns.append(
            (cut.link_axis.astype(np.int64), cut.link_face, below, above, cut.link_open,
             np.ones(len(below), dtype=bool))
        )  # fmt: skip
    parts = [np.concatenate(c) for c in zip(*columns, strict=True)]
    keep = parts[4] > 0.0
    return Links(*parts).where(keep)


def walls_of(cut: CutCells, slot: np.ndarray, n_moving: int) -> Walls:
    """Return what the facets below the number ``n_moving`` let through; ``slot`` is that of each patch."""
    mine = np.flatnonzero(cut.facet < n_moving)
    normals = cut.normals[cut.facet[mine]]
    patch, axis = np.nonzero(normals)
    flux = -normals[patch, axis][:, None] * cut.integrals[mine[patch]]
    return Walls(cut.facet[mine[patch]], axis, slot[mine[patch]], flux)


def patch_slots(cut: CutCells, n_box: int) -> np.ndarray:
    """Return the slot of each patch."""
    slot = cut.cell.copy()
    other = np.flatnonzero(cut.piece > 0)
    if len(other):
        most = int(cut.extra_piece.max()) + 1
        key = cut.extra_cell * most + cut.extra_piece
        order = np.argsort(key)
        slot[other] = n_box + order[np.searchsorted(key[order], cut.cell[other] * most + cut.piece[other])]
    return slot


def _link_slots(cut: CutCells, shape: tuple[int, ...], side: int) -> np.ndarray:
    """Return the slots below (side 0) or above the faces of split cells' links."""
    n_box = int(np.prod(shape))
    piece = (cut.link_below, cut.link_above)[side].astype(np.int64)
    cell = np.full(len(piece), -1, dtype=np.int64)
    for a in range(len(shape)):
        mine = np.flatnonzero((cut.link_axis == a) & (piece >= 0))
        faces = tuple(n + (b == a) for b, n in enumerate(shape))
        index = list(np.unravel_index(cut.link_face[mine], faces))
        index[a] = index[a] - 1 + side
        cell[mine] = np.ravel_multi_index(index, shape)
    slot = cell.copy()
    other = np.flatnonzero(piece > 0)
    if len(other):
        most = int(cut.extra_piece.max()) + 1
        key = cut.extra_cell * most + cut.extra_piece
        order = np.argsort(key)
        slot[other] = n_box + order[np.searchsorted(key[order], cell[other] * most + piece[other])]
    return slot


@njit(cache=True)
def _plain_links(a, cells, walled, is_split, shape, alpha):
    """Return the links of one axis' faces next to the cells with walls, but those of split cells."""
    stride, outer = 1, 1
    for b in range(a + 1, len(shape)):
        stride *= shape[b]
    n = shape[a]
    face, below, above = np.empty((3, 2 * len(cells)), np.int64)
    count = 0
    for cell in cells:
        i = (cell // stride) % n
        outer = cell // (stride * n)
        first = outer * stride * (n + 1) + i * stride + cell % stride  # its lower face
        for upper in range(2):
            other = cell + stride if upper else cell - stride
            inside = i + 1 < n if upper else i > 0
            if is_split[cell] or (inside and is_split[other]):
                continue
            if upper and inside and walled[other]:
                continue  # that one's lower face
            face[count] = first + upper * stride
            neighbour = other if inside else -1
            below[count] = cell if upper else neighbour
            above[count] = neighbour if upper else cell
            count += 1
    found = face[:count]
    return np.full(count, a), found, below[:count], above[:count], alpha[found], np.zeros(count, np.bool_)
