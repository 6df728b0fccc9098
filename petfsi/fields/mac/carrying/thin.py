"""Where walls are so thin that stencils mix what is on their two sides, and which paths meet such walls."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.mac.carrying.advect import track_back
from petfsi.fields.mac.grid.kinds import OPEN, PRESSURE, SPLIT, WALL

#: Walls of so many cells or fewer are sheets, too: stencils and bands of both sides would meet in their middle.
THICKEST = 4
#: Walls of 0, 1, ... cells that water leads around within so many cells are edges: where walls are as thick as the band
#: of either side is wide, stencils read little of the other.
AROUND = (2, 3, 5, 5, 5)
#: Further pieces smaller than this part of their cell count for nothing where water leads around to them.
SLIGHT = 0.1


@njit(cache=True)
def thin_walls(kind, fluid, low, high, dim):
    """Return the cells beside a wall, along an axis, no thicker than ``THICKEST`` cells, but at the edges of bodies.

    Parameters
    ----------
    kind : tuple of three ndarray of uint8
        Face arrays.
    fluid : ndarray of bool
        Cell array.
    low, high : ndarray of int64, shape (3,)
        The local cells that lie in the domain.
    dim : int
    """
    found = np.zeros(fluid.shape, np.bool_)
    side = 2 * max(AROUND) + 1
    seen, queue = np.zeros((side, side, side), np.bool_), np.empty((side**3, 3), np.int64)
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for k in range(low[2], high[2]):
                if not fluid[i, j, k]:
                    continue
                for a in range(dim):
                    c, end = (i, j, k), high[a]
                    f = (i + (a == 0), j + (a == 1), k + (a == 2))
                    if c[a] + 1 >= end or kind[a][f] == PRESSURE or kind[a][f] == SPLIT:
                        continue
                    for m in range(1, min(THICKEST + 1, end - 1 - c[a]) + 1):
                        other = (i + m * (a == 0), j + m * (a == 1), k + m * (a == 2))
                        if fluid[other]:
                            if not _joined(kind, c, other, a, AROUND[m - 1], low, high, dim, seen, queue):
                                found[c], found[other] = True, True
                            break
    return found


@njit(cache=True)
def _joined(kind, one, other, axis, around, low, high, dim, seen, queue):
    """Return whether open faces lead from a cell to one above it along an axis through cells so near to both."""
    begin = (
        max((other[0] if axis == 0 else one[0]) - around, low[0]),
        max((other[1] if axis == 1 else one[1]) - around, low[1]),
        max((other[2] if axis == 2 else one[2]) - around, low[2]),
    )
    end = (
        min(one[0] + around + 1, high[0]), min(one[1] + around + 1, high[1]), min(one[2] + around + 1, high[2])
    )  # fmt: skip
    seen[:] = False
    seen[one[0] - begin[0], one[1] - begin[1], one[2] - begin[2]] = True
    queue[0, 0], queue[0, 1], queue[0, 2] = one
    head, tail = 0, 1
    while head < tail:
        c = (queue[head, 0], queue[head, 1], queue[head, 2])
        head += 1
        for a in range(dim):
            for up in range(2):
                to = (c[0] + (2 * up - 1) * (a == 0), c[1] + (2 * up - 1) * (a == 1), c[2] + (2 * up - 1) * (a == 2))
                if to[a] < begin[a] or to[a] >= end[a]:
                    continue
                at = (to[0] - begin[0], to[1] - begin[1], to[2] - begin[2])
                if seen[at] or kind[a][to if up else c] != PRESSURE:
                    continue
                if to == other:
                    return True
                seen[at] = True
                queue[tail, 0], queue[tail, 1], queue[tail, 2] = to
                tail += 1
    return False


def odd_cells(
    kind: list[np.ndarray], narrow: list[np.ndarray], divided: np.ndarray, fluid: np.ndarray, low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the cells of the domain that are no whole ones of fluid with wide faces all around.

    Parameters
    ----------
    kind, narrow : list of ndarray
        Face arrays by axis.
    divided, fluid : ndarray of bool
        Cell arrays.
    low, high : ndarray of int64, shape (3,)
        The local cells that lie in the domain.
    """
    odd = divided.copy()
    inside = tuple(slice(b, e) for b, e in zip(low, high, strict=True))
    odd[inside] |= ~fluid[inside]
    for a, (of, slim) in enumerate(zip(kind, narrow, strict=True)):
        shut = slim | ((of != PRESSURE) & (of != OPEN) & (of != WALL))
        shut = np.delete(shut, 0, axis=a) | np.delete(shut, -1, axis=a)
        odd[inside] |= shut[inside]
    return odd


def count_before(marked: np.ndarray) -> np.ndarray:
    """Return how many of the cells before each i, j, k are marked, shape (n + 1, m + 1, k + 1)."""
    total = np.zeros([n + 1 for n in marked.shape], dtype=np.int32)
    total[1:, 1:, 1:] = marked.cumsum(axis=0, dtype=np.int32).cumsum(axis=1).cumsum(axis=2)
    return total


@njit(cache=True)
def _any(before, begin, end):
    """Return whether any cell of a box is marked, given ``count_before``."""
    total = 0
    for corner in range(8):
        i = end[0] if corner & 1 else begin[0]
        j = end[1] if corner & 2 else begin[1]
        k = end[2] if corner & 4 else begin[2]
        sign = 2 * ((corner + (corner >> 1) + (corner >> 2)) & 1) - 1
        total += sign * before[i, j, k]
    return total > 0


@njit(cache=True)
def in_need(odd, near, cells, divided, faces, high_cell, path, courant, long, low, high, beyond, cubic, dim):
    """Return which cells' paths, as the grid has them, read what may be of the other side of a sheet.

    A path that reads whole cells of open water alone, all joined with each other, or no wall that is thin, needs no
    more than the grid. Of a thin wall that it reads, the cell beside it on its own side is among those, or next to one.

    Parameters
    ----------
    odd, near : ndarray of int32
        ``count_before`` of ``odd_cells``, and of cells that are divided or at thin walls.
    cells : ndarray of int64, shape (n, 3)
    divided : ndarray of bool, shape (n,)
        Which of them are divided: these always need more.
    faces : bool
        Whether paths end at their faces, lower ones and those at the domain's end, or else at their centres.
    high_cell : ndarray of int64, shape (3,)
        Where the local cells of the domain end.
    path : tuple of three ndarray
        Face arrays: the velocity.
    courant, long, low, high, beyond, cubic
        As for ``advect.sweep``.
    dim : int

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    need = np.zeros(len(cells), np.bool_)
    flat, wide = dim == 2, 2 if cubic else 1
    begin, end = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(cells)):
        c = (cells[n, 0], cells[n, 1], cells[n, 2])
        begin[0], begin[1], begin[2] = c
        end[0], end[1], end[2] = c[0] + 1, c[1] + 1, c[2] + 1
        for a in range(dim if faces else 1):
            for up in range(2 if faces and c[a] == high_cell[a] - 1 else 1):
                f = (c[0] + up * (a == 0), c[1] + up * (a == 1), c[2] + up * (a == 2))
                offset = (
                    0.0 if faces and a == 0 else 0.5, 0.0 if faces and a == 1 else 0.5, 0.0 if faces and a == 2 else 0.5
                )  # fmt: skip
                d, least, most = track_back(
                    path[0], path[1], path[2], f[0], f[1], f[2], offset, courant, long, low, high, beyond, flat
                )  # fmt: skip
                for b in range(dim):
                    first = min(int(least[b]) - 1, int(np.floor(d[b])) - wide)
                    last = max(int(most[b]) + 1, int(np.floor(d[b])) + wide)
                    begin[b], end[b] = min(begin[b], first), max(end[b], last + 1)
        for b in range(dim):
            begin[b], end[b] = max(begin[b], 0), min(end[b], odd.shape[b] - 1)
        if not _any(odd, begin, end):
            continue
        for b in range(dim):
            begin[b], end[b] = max(begin[b] - 1, 0), min(end[b] + 1, odd.shape[b] - 1)
        need[n] = divided[n] or _any(near, begin, end)
    return need
