"""A grid cut by surfaces: how open its faces are, which pressures they join, and what the walls add.

With p at cell centres x_c and v on faces, n the normal out of the solid and A_f the area of a whole face,

    (D v)_c = sum_f +- B_f A_f v_f,    J[i, c] = -∫ N_i n_a w_c^a dA,    D v + J^T u = 0 .

With w = 1 in the wall's own cell and B_f the open fraction alpha_f of a face this is the scheme of Ng, Min and Gibou
(An efficient fluid-solid coupling algorithm for single-phase flows, 2009). It takes the pressure on a wall from
the centre of a cell. Along a wall that is parallel to an axis that is wrong by the same part of a cell everywhere:
first order. There the a-component of the traction takes p by linear extrapolation along axis a from the wall's own
cell and the next one on the fluid's side, t = theta (x_a - x_c,a) / dx towards it: w = 1 - t on the one, t on the
other; and what J so takes from a cell is given to the face between the two,

    B_f = alpha_f - (theta / (A_f dx)) sum over both cells' walls that face f of ∫ n_a (x_a - x_c,a) dA ,

so that rho B_f A_f dx is the mass of the fluid between the two pressures along the axis, counted to the walls. A
fluid and solids that move alike have no net outflow anywhere, whatever theta. A flow along a slanting wall has none
only if theta = 0: different weights for the components of n would let it through. Hence theta = max(0, 1 - |N_t| /
|N_a|), N_a and N_t being the normal's part along the axis and the rest. On disks and balls, whose walls slant
everywhere but at a few places, the errors of Ng's scheme average out, and little is left to mend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from petfsi.fields.mac.kinds import OPEN
from petfsi.geometry.clipping import CutCells

#: A face that is open at all has at least this openness: openings below it would let round-off become a flow. The
#: difference is made good in J as a flow with the wall's velocity.
LEAST_OPEN = 1e-4
#: Walls may take at most so much of what a face lets through, so that no mass becomes negative.
LEAST_PART = 0.1


@dataclass(frozen=True)
class Walls:
    """What surfaces let through, by the corners of facets.

    The net outflow of unknown ``slot`` is ``flux[:, i]`` times the velocity along ``axis`` of the facet's corner i.

    Attributes
    ----------
    facet, axis : ndarray of int, shape (n,)
    slot : ndarray of int, shape (n,)
        A cell of the box, flat, or the number of its cells plus the number of an extra unknown.
    flux : ndarray, shape (n, dim)
        m^2 (m in 2D).
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
    first : ndarray, shape (n, dim, dim, dim)
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
        B_f.
    split : ndarray of bool, shape (n,)
        Whether one of the two cells holds more than one piece of fluid.
    """

    axis: np.ndarray
    face: np.ndarray
    below: np.ndarray
    above: np.ndarray
    openness: np.ndarray
    split: np.ndarray


def join(
    cut: CutCells, shape: tuple[int, ...], dx: np.ndarray, side_kind: list[np.ndarray], n_moving: int
) -> tuple[Links, Walls]:
    """Return the links of all faces next to a surface, and what walls let through. Not collective.

    Parameters
    ----------
    cut : CutCells
        Of a box of cells.
    shape : tuple of int
        The box's cells per axis.
    dx : ndarray, shape (dim,)
    side_kind : list of ndarray of uint8
        The box's faces per axis: OPEN or not, read beyond sides alone.
    n_moving : int
        Facets below this number can move; of the others no flux is wanted.
    """
    dim = len(dx)
    n_box = int(np.prod(shape))
    cells = np.unique(cut.cell)
    # compact numbers: cells with walls, then the extra pieces
    compact = np.full(n_box + len(cut.extra_cell), -1, dtype=np.int32)
    compact[cells] = np.arange(len(cells), dtype=np.int32)
    compact[n_box:] = len(cells) + np.arange(len(cut.extra_cell), dtype=np.int32)
    axis, face, below, above, alpha, split = _links(cut, cells, compact, shape)
    slot = patch_slots(cut, n_box)
    of = np.ascontiguousarray(compact[slot])
    moment = np.zeros((len(cells) + len(cut.extra_cell), dim, 2))
    area = np.array([np.prod(dx) / d for d in dx])
    _sum_moments(cut.facet, of, cut.moments, cut.normals, area * dx, moment)
    alignment = np.zeros_like(moment)
    _align(cut.facet, of, cut.integrals, cut.normals, alignment)
    moment *= alignment
    stretch = np.ones(len(axis))
    for a in range(dim):
        beyond = (axis == a) & ((below < 0) | (above < 0))
        kind = side_kind[a].reshape(-1)[face[beyond]]
        stretch[beyond] = np.where(kind == OPEN, 2.0, 0.0)
    best = np.full((len(moment), dim, 2), -1, dtype=np.int64)
    _widest(axis, below, above, alpha, compact, best)
    part, openness, floor = np.zeros((3, len(axis)))
    _open(axis, below, above, alpha, stretch, compact, best, moment, part, openness, floor)
    walls = _walls(cut, slot, of, below, above, stretch, best, part, alignment, dx, n_moving)
    walls = _and_floors(walls, cut, slot, axis, below, above, floor * area[axis], compact, n_moving)
    return Links(axis, face, below, above, openness, split), walls


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


def _links(
    cut: CutCells, cells: np.ndarray, compact: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return axis, face, slots below and above, open fraction of each link, and whether a cell of it is split."""
    n_box = int(np.prod(shape))
    is_split = np.zeros(n_box, dtype=bool)
    is_split[cut.extra_cell] = True
    columns = []
    for a in range(len(shape)):
        alpha = cut.open[a].reshape(-1)
        columns.append(_plain_links(a, cells, compact, is_split, np.array(shape), alpha))
    if len(cut.link_axis):
        below, above = (_link_slots(cut, shape, side) for side in (0, 1))
        columns.append(
            (cut.link_axis.astype(np.int64), cut.link_face, below, above, cut.link_open,
             np.ones(len(below), dtype=bool))
        )  # fmt: skip
    axis, face, below, above, alpha, split = (np.concatenate(c) for c in zip(*columns, strict=True))
    keep = alpha > 0.0
    return axis[keep], face[keep], below[keep], above[keep], alpha[keep], split[keep]


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
def _plain_links(a, cells, compact, is_split, shape, alpha):
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
            if upper and inside and compact[other] >= 0:
                continue  # that one's lower face
            face[count] = first + upper * stride
            neighbour = other if inside else -1
            below[count] = cell if upper else neighbour
            above[count] = neighbour if upper else cell
            count += 1
    found = face[:count]
    return np.full(count, a), found, below[:count], above[:count], alpha[found], np.zeros(count, np.bool_)


@njit(cache=True)
def _sum_moments(facet, of, moments, normals, volume, out):
    """Add ∫ n_a (x_a - x_c,a) dA / (A dx) of each patch, by the side along the axis that it faces."""
    for p in range(len(facet)):
        for a in range(out.shape[1]):
            n = normals[facet[p], a]
            total = 0.0
            for i in range(moments.shape[1]):
                total += moments[p, i, a]
            out[of[p], a, 1 if n < 0.0 else 0] += n * total / volume[a]


@njit(cache=True)
def _align(facet, of, integrals, normals, out):
    """Fill theta of the walls of each slot that face either side along an axis."""
    dim = out.shape[1]
    total = np.zeros((*out.shape, dim))
    for p in range(len(facet)):
        size = integrals[p].sum()
        for a in range(dim):
            side = 1 if normals[facet[p], a] < 0.0 else 0
            # a wall along the axis faces neither side: which one round-off makes it face must not matter
            weight = abs(normals[facet[p], a]) * size
            for b in range(dim):
                total[of[p], a, side, b] += normals[facet[p], b] * weight
    for k in range(len(out)):
        for a in range(dim):
            for side in range(2):
                along = abs(total[k, a, side, a])
                across = np.sum(total[k, a, side] ** 2) - along**2
                if along > 0.0 and across < along**2:
                    out[k, a, side] = 1.0 - np.sqrt(max(across, 0.0)) / along


@njit(cache=True)
def _widest(axis, below, above, alpha, compact, best):
    """Find for each compact slot and side (0 up, 1 down) along an axis its widest link."""
    for link in range(len(axis)):
        a = axis[link]
        for side in range(2):
            slot = above[link] if side else below[link]
            if slot < 0 or compact[slot] < 0:
                continue
            k = compact[slot]
            if best[k, a, side] < 0 or alpha[link] > alpha[best[k, a, side]]:
                best[k, a, side] = link


@njit(cache=True)
def _open(axis, below, above, alpha, stretch, compact, best, moment, part, openness, floor):
    """Fill each link's openness, which part of the extrapolation it bears, and what its floor adds."""
    for link in range(len(axis)):
        a = axis[link]
        taken, total = 0.0, 0.0
        for side in range(2):
            slot = above[link] if side else below[link]
            if slot >= 0 and compact[slot] >= 0 and best[compact[slot], a, side] == link:
                m = stretch[link] * moment[compact[slot], a, side]
                total += m
                taken += max(m, 0.0)
        size = alpha[link]
        openness[link] = size
        if stretch[link] == 0.0:
            continue
        bears = 1.0 if size > LEAST_OPEN else 0.0
        if taken > (1.0 - LEAST_PART) * size:
            bears = min(bears, (1.0 - LEAST_PART) * size / taken)
        if -total > size:
            bears = min(bears, size / -total)
        part[link] = bears
        openness[link] = size - bears * total
        if openness[link] < LEAST_OPEN:
            floor[link] = LEAST_OPEN - openness[link]
            openness[link] = LEAST_OPEN


def _walls(
    cut: CutCells, slot: np.ndarray, of: np.ndarray, below: np.ndarray, above: np.ndarray,
    stretch: np.ndarray, best: np.ndarray, part: np.ndarray, alignment: np.ndarray, dx: np.ndarray, n_moving: int,
) -> Walls:  # fmt: skip
    """Return the entries of the moving patches."""
    mine = np.flatnonzero(cut.facet < n_moving)
    n, dim = len(mine), len(dx)
    facet, axes, to = np.empty((3, 2 * dim * n), dtype=np.int64)
    flux = np.empty((2 * dim * n, dim))
    count = _fill_walls(
        mine, cut.facet, cut.integrals, cut.moments, cut.normals, slot, of, below, above, stretch, best, part,
        alignment, dx, facet, axes, to, flux,
    )  # fmt: skip
    return Walls(facet[:count], axes[:count], to[:count], flux[:count])


@njit(cache=True)
def _fill_walls(
    mine, facets, integrals, moments, normals, slots, of, below, above, stretch, best, part, alignment, dx,
    facet, axes, to, flux,
):  # fmt: skip
    dim = len(dx)
    count = 0
    for p in mine:
        for a in range(dim):
            n = normals[facets[p], a]
            if n == 0.0:
                continue
            side = 1 if n < 0.0 else 0
            link = best[of[p], a, side]
            weight = 0.0
            if link >= 0:
                weight = alignment[of[p], a, side] * part[link] * stretch[link] / dx[a] * (-1.0 if side else 1.0)
            facet[count], axes[count], to[count] = facets[p], a, slots[p]
            for i in range(dim):
                flux[count, i] = -n * (integrals[p, i] - weight * moments[p, i, a])
            count += 1
            if weight != 0.0:
                other = below[link] if side else above[link]
                if other >= 0:
                    facet[count], axes[count], to[count] = facets[p], a, other
                    for i in range(dim):
                        flux[count, i] = -n * weight * moments[p, i, a]
                    count += 1
    return count


def _and_floors(
    walls: Walls, cut: CutCells, slot: np.ndarray, axis: np.ndarray, below: np.ndarray, above: np.ndarray,
    added: np.ndarray, compact: np.ndarray, n_moving: int,
) -> Walls:  # fmt: skip
    """Return the walls with what makes good the floors of narrow links: a backflow with the wall's velocity there."""
    narrow = np.flatnonzero(added > 0.0)
    if not len(narrow):
        return walls
    # the largest moving patch of each slot stands for its wall
    size = np.where(cut.facet < n_moving, cut.integrals.sum(axis=1), -1.0)
    order = np.lexsort((size, compact[slot]))
    last = np.concatenate((np.diff(compact[slot][order]) != 0, [True]))
    largest = np.full(int(compact.max()) + 1, -1, dtype=np.int64)
    largest[compact[slot][order[last]]] = order[last]
    patch = np.full(len(narrow), -1, dtype=np.int64)
    for side in (above, below):  # the one below wins, on every rank
        at = side[narrow]
        k = np.where(at >= 0, compact[at], -1)
        found = np.where(k >= 0, largest[k], -1)
        found = np.where((found >= 0) & (size[found] > 0.0), found, -1)
        patch = np.where(found >= 0, found, patch)
    columns = [walls]
    for side, sign in ((below, -1.0), (above, 1.0)):
        use = np.flatnonzero((patch >= 0) & (side[narrow] >= 0))
        p, link = patch[use], narrow[use]
        shape = cut.integrals[p] / cut.integrals[p].sum(axis=1, keepdims=True)
        columns.append(Walls(cut.facet[p], axis[link], side[link], sign * added[link, None] * shape))
    return Walls(*(np.concatenate([getattr(c, name) for c in columns]) for name in ("facet", "axis", "slot", "flux")))
