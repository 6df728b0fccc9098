"""Cells, the order of rows, and lists of pairs.

Space is cut into one global grid of cells that no number of ranks changes. A rank's rows (its own particles and ghosts)
are sorted by (cell, id), cells counted lexicographically with the last axis fastest, so that they are a subsequence of
one global sequence and sums in row order come out the same, bit for bit, on any ranks. Neighbours within ``reach`` (at
most a cell's side) are then in runs of rows: three cells along the last axis are one run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.compiled import compiled_for


@dataclass(frozen=True)
class CellGrid:
    """The global grid of cells: cell c reaches from low + c side to low + (c + 1) side along each axis.

    Attributes
    ----------
    low : ndarray, shape (dim,)
        Lower corner, m.
    side : ndarray, shape (dim,)
        Sides of a cell, m.
    counts : ndarray of int, shape (dim,)
        Numbers of cells.
    periodic : ndarray of bool, shape (dim,)
        Along these axes ``counts`` cells are exactly the period.
    """

    low: np.ndarray
    side: np.ndarray
    counts: np.ndarray
    periodic: np.ndarray

    def of(self, x: np.ndarray) -> np.ndarray:
        """Return the cells (n, dim) that hold the points x (n, dim), m: not clamped, not wrapped."""
        return _cells(np.ascontiguousarray(x, dtype=float), self.low, self.side)


def cell_grid(low, high, reach: float, periodic) -> CellGrid:
    """Return the grid of the smallest cells of at least ``reach`` (m) a side over a box.

    Along a periodic axis the sides divide the length; along others the last cell may stick out.
    Raises ValueError where a periodic length is below ``reach``: a particle would meet its own image.
    """
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    periodic = np.array(periodic, dtype=bool)
    length = high - low
    if not (reach > 0 and np.all(length > 0)):
        raise ValueError(f"a cell grid needs a positive reach and box, not {reach:g} m and {length} m")
    side = np.full(length.shape, float(reach))
    counts = np.maximum(np.ceil(length / reach), 1).astype(np.int64)
    for axis in np.flatnonzero(periodic):
        if length[axis] < reach:
            raise ValueError(
                f"the period along axis {axis} is {length[axis]:g} m, and particles see {reach:g} m far: "
                "make it longer or the spacing of particles smaller"
            )
        n = int(length[axis] / reach)
        while length[axis] / n < reach:
            n -= 1
        counts[axis], side[axis] = n, length[axis] / n
    return CellGrid(low, side, counts, periodic)


def sorted_rows(cells: np.ndarray, counts: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of rows by (cell, id), and where each cell's rows begin.

    A counting sort over cells, then by id within each: O(n), fastest if rows are nearly in order.

    Parameters
    ----------
    cells : ndarray of int, shape (n, dim)
        Cells of the rows, counted from the lowest cell (halo included) of this rank's box.
    counts : ndarray of int, shape (dim,)
        Numbers of cells of the box, halo included.
    ids : ndarray of int64, shape (n,)
        Numbers of the particles.

    Returns
    -------
    order : ndarray of int64, shape (n,)
        Row ``order[k]`` comes k-th.
    first : ndarray of int64, shape (n_cells + 1,)
        The sorted rows of cell c are ``first[c]:first[c + 1]``.
    """
    counts = np.asarray(counts, dtype=np.int64)
    cells = np.ascontiguousarray(cells, dtype=np.int64).reshape(-1, counts.size)
    order, first, outside = _sort(cells, counts, np.ascontiguousarray(ids, dtype=np.int64))
    if outside >= 0:
        raise ValueError(f"particle {ids[outside]} is in cell {cells[outside]} of a box of {counts} cells")
    return order, first


class Pairs(NamedTuple):
    """Pairs by the first one's row: row i meets the rows ``other[start[i]:start[i + 1]]``, in increasing order.

    ``start`` (n + 1,) int64, ``other`` (n_pairs,) int32.
    """

    start: np.ndarray
    other: np.ndarray


class PairLists:
    """Builder of both lists, which keeps their memory: a list is valid until the next one of its kind is built."""

    def __init__(self):
        self._fluid = np.empty(0, dtype=np.int32)
        self._wall = np.empty(0, dtype=np.int32)

    def fluid(self, x, owned, first, counts, reach: float) -> Pairs:
        """Return the pairs i < j of fluid rows nearer than ``reach``, of which at least one is owned.

        Parameters
        ----------
        x : ndarray, shape (n, dim)
            Positions of the sorted rows, m.
        owned : ndarray of bool, shape (n,)
            Whether a row is this rank's own.
        first : ndarray of int64, shape (n_cells + 1,)
            Where each cell's rows begin, from ``sorted_rows``.
        counts : ndarray of int, shape (dim,)
            Numbers of cells of the box, halo included.
        reach : float
            Support of the kernel and skin, m; not above a cell's side.
        """
        counts = np.asarray(counts, dtype=np.int64)
        start, self._fluid, n = _FLUID_PAIRS[counts.size](_axes(x), owned, first, counts, reach**2, LANES, self._fluid)
        return Pairs(start, self._fluid[:n])

    def wall(self, x, owned, first, x_wall, owned_wall, first_wall, counts, reach: float) -> Pairs:
        """Return for each fluid row the wall rows nearer than ``reach``, if one of the two is owned.

        Arguments as in ``fluid``, for the rows of the fluid and for those of walls, sorted into the same cells.
        """
        counts = np.asarray(counts, dtype=np.int64)
        args = (_axes(x), owned, first, _axes(x_wall), owned_wall, first_wall, counts, reach**2, LANES, self._wall)
        start, self._wall, n = _WALL_PAIRS[counts.size](*args)
        return Pairs(start, self._wall[:n])


def fluid_pairs(x, owned, first, counts, reach: float) -> Pairs:
    """Return ``PairLists.fluid`` in memory of its own."""
    return PairLists().fluid(x, owned, first, counts, reach)


def wall_pairs(x, owned, first, x_wall, owned_wall, first_wall, counts, reach: float) -> Pairs:
    """Return ``PairLists.wall`` in memory of its own."""
    return PairLists().wall(x, owned, first, x_wall, owned_wall, first_wall, counts, reach)


def _axes(x):
    """Return the coordinates (n, dim) axis by axis, (dim, n), each contiguous."""
    return np.ascontiguousarray(x.T)


@njit(cache=True, error_model="numpy")
def _cells(x, low, side):
    cells = np.empty(x.shape, dtype=np.int64)
    for i in range(x.shape[0]):
        for axis in range(x.shape[1]):
            cells[i, axis] = np.int64(np.floor((x[i, axis] - low[axis]) / side[axis]))
    return cells


@njit(cache=True)
def _sort(cells, counts, ids):
    """Return order, first, and a row that lies outside of the box or -1."""
    n, dim = cells.shape
    n_cells = 1
    for axis in range(dim):
        n_cells *= counts[axis]
    number = np.empty(n, dtype=np.int64)
    first = np.zeros(n_cells + 1, dtype=np.int64)
    order = np.empty(n, dtype=np.int64)
    for i in range(n):
        c = 0
        for axis in range(dim):
            if not 0 <= cells[i, axis] < counts[axis]:
                return order, first, i
            c = c * counts[axis] + cells[i, axis]
        number[i] = c
        first[c + 1] += 1
    for c in range(n_cells):
        first[c + 1] += first[c]
    place = first[:-1].copy()
    for i in range(n):
        c = number[i]
        order[place[c]] = i
        place[c] += 1
    for c in range(n_cells):
        _sort_by_id(order, ids, first[c], first[c + 1])
    return order, first, -1


@njit(cache=True)
def _sort_by_id(order, ids, begin, end):
    """Sort ``order[begin:end]`` by id: by insertion, because cells hold few rows, or by Shell's steps."""
    step = 1 if end - begin < 64 else (end - begin) // 2
    while step > 0:
        for k in range(begin + step, end):
            row = order[k]
            m = k
            while m >= begin + step and ids[order[m - step]] > ids[row]:
                order[m] = order[m - step]
                m -= step
            order[m] = row
        step = 0 if step == 1 else max(5 * step // 11, 1)


@njit(cache=True)
def _grown(other, n, needed):
    """Return memory for at least ``needed`` entries, with the first n kept."""
    if needed <= other.size:
        return other
    longer = np.empty(needed + needed // 2, dtype=np.int32)
    longer[:n] = other[:n]
    return longer


@njit(cache=True)
def line_of_cells(first, counts, cell, a, b, dim):
    """Return the run of rows in the three cells around ``cell`` moved by (a, b) along the axes but the last."""
    last = dim - 1
    low, high = max(cell[last] - 1, 0), min(cell[last] + 2, counts[last])
    if dim == 2:
        line = cell[0] + a
        inside = 0 <= line < counts[0]
    else:
        line = (cell[0] + a) * counts[1] + cell[1] + b
        inside = 0 <= cell[0] + a < counts[0] and 0 <= cell[1] + b < counts[1]
    if not inside:
        return np.int64(0), np.int64(0)
    return first[line * counts[last] + low], first[line * counts[last] + high]


@njit(cache=True)
def _locate(cell, counts, c, dim):
    """Write the indices of cell number c."""
    for axis in range(dim - 1, -1, -1):
        cell[axis] = c % counts[axis]
        c = c // counts[axis]


#: Candidates stand in blocks of eight; an argument, because of a loop with a known end LLVM makes copies, not vectors.
LANES = np.uint64(8)


@njit(cache=True)
def _box(axes, begin, end, box):
    """Write the lowest and highest coordinates of these rows."""
    for axis in range(axes.shape[0]):
        low = high = axes[axis, begin]
        for i in range(begin + 1, end):
            low, high = min(low, axes[axis, i]), max(high, axes[axis, i])
        box[axis, 0], box[axis, 1] = low, high


@njit(cache=True)
def _candidates(dim, n):
    """Return memory for n candidates and more: their places and distances in blocks, all finite, and their rows."""
    n_blocks = n // 4 + 2
    return np.zeros((dim, n_blocks, 8)), np.zeros((n_blocks, 8)), np.empty(8 * n_blocks, dtype=np.uint32)


@njit(cache=True, error_model="numpy")
def _collect(axes, begin, end, box, reach2, blocks, rows, n):
    """Append to the blocks the places of rows from ``begin`` to ``end`` nearer to a box than the reach; count them."""
    dim = axes.shape[0]
    for j in range(np.uint64(begin), np.uint64(end)):
        far2 = 0.0
        block, lane = n >> np.uint64(3), n & np.uint64(7)
        for axis in range(dim):
            x = axes[axis, j]
            blocks[axis, block, lane] = x
            far = max(max(box[axis, 0] - x, x - box[axis, 1]), 0.0)
            far2 += far * far
        rows[n] = j
        n += np.uint64(far2 < reach2)
    return n


@njit(cache=True, error_model="numpy", inline="always")
def _append_near(other, n, blocks, rows, begin, end, x, y, z, reach2, mine, owned, lanes, far2, flat):
    """Append the candidates from ``begin`` to ``end`` that are near the point; return the new number of entries.

    The first loop, over whole blocks, is one for the processor's vectors; the last writes each row and moves the count
    on only if it is near, without a branch to guess wrong.
    """
    for block in range(begin >> np.uint64(3), (end + np.uint64(7)) >> np.uint64(3)):
        for lane in range(lanes):
            r0, r1 = x - blocks[0, block, lane], y - blocks[1, block, lane]
            r2 = r0 * r0 + r1 * r1
            if not flat:
                r = z - blocks[2, block, lane]
                r2 += r * r
            far2[block, lane] = r2
    n = np.uint64(n)
    if mine:
        for k in range(begin, end):
            other[n] = rows[k]
            n += np.uint64(far2[k >> np.uint64(3), k & np.uint64(7)] < reach2)
    else:
        for k in range(begin, end):
            j = rows[k]
            other[n] = j
            n += np.uint64(owned[j] & (far2[k >> np.uint64(3), k & np.uint64(7)] < reach2))
    return np.int64(n)


def _compile_fluid_pairs(dim):
    """Compile the half list for 2 or 3 dimensions."""
    runs, flat = 2 if dim == 2 else 5, dim == 2

    @compiled_for(dim)
    def fluid(axes, owned, first, counts, reach2, lanes, other):
        start = np.zeros(owned.size + 1, dtype=np.int64)
        begin, end = np.empty(runs, dtype=np.int64), np.empty(runs, dtype=np.int64)
        cell, box = np.empty(dim, dtype=np.int64), np.empty((dim, 2))
        blocks, far2, rows = _candidates(dim, 0)
        n = 0
        for c in range(first.size - 1):
            if first[c] == first[c + 1]:
                continue
            _locate(cell, counts, c, dim)
            # the rest of this line of three cells, then the lines after it
            for run in range(runs):
                a, b = (run, 0) if dim == 2 else ((run + 1) // 3, (run + 1) % 3 - 1 if run > 1 else run)
                begin[run], end[run] = line_of_cells(first, counts, cell, a, b, dim)
            begin[0] = first[c]
            most = np.sum(end - begin)
            if rows.size <= most:
                blocks, far2, rows = _candidates(dim, most)
            _box(axes, first[c], first[c + 1], box)
            found = np.uint64(0)
            for run in range(runs):
                found = _collect(axes, begin[run], end[run], box, reach2, blocks, rows, found)
            other = _grown(other, n, n + np.int64(found) * (first[c + 1] - first[c]) + 1)
            for k in range(first[c + 1] - first[c]):
                i = first[c] + k
                x, y, z = axes[0, i], axes[1, i], axes[dim - 1, i]
                n = _append_near(
                    other, n, blocks, rows, np.uint64(k + 1), found, x, y, z, reach2, owned[i], owned, lanes, far2, flat
                )
                start[i + 1] = n
        return start, other, n

    return fluid


def _compile_wall_pairs(dim):
    """Compile the list of wall rows near fluid rows for 2 or 3 dimensions."""
    runs, flat = 3 if dim == 2 else 9, dim == 2

    @compiled_for(dim)
    def wall(axes, owned, first, axes_wall, owned_wall, first_wall, counts, reach2, lanes, other):
        start = np.zeros(owned.size + 1, dtype=np.int64)
        begin, end = np.empty(runs, dtype=np.int64), np.empty(runs, dtype=np.int64)
        cell, box = np.empty(dim, dtype=np.int64), np.empty((dim, 2))
        blocks, far2, rows = _candidates(dim, 0)
        n = 0
        for c in range(first.size - 1):
            if first[c] == first[c + 1]:
                continue
            _locate(cell, counts, c, dim)
            for run in range(runs):
                a, b = (run - 1, 0) if dim == 2 else (run // 3 - 1, run % 3 - 1)
                begin[run], end[run] = line_of_cells(first_wall, counts, cell, a, b, dim)
            most, found = np.sum(end - begin), np.uint64(0)
            if most > 0:
                if rows.size <= most:
                    blocks, far2, rows = _candidates(dim, most)
                _box(axes, first[c], first[c + 1], box)
                for run in range(runs):
                    found = _collect(axes_wall, begin[run], end[run], box, reach2, blocks, rows, found)
                other = _grown(other, n, n + np.int64(found) * (first[c + 1] - first[c]) + 1)
            for i in range(first[c], first[c + 1]):
                if found > 0:
                    x, y, z = axes[0, i], axes[1, i], axes[dim - 1, i]
                    n = _append_near(
                        other, n, blocks, rows, np.uint64(0), found, x, y, z, reach2, owned[i], owned_wall, lanes, far2,
                        flat,
                    )  # fmt: skip
                start[i + 1] = n
        return start, other, n

    return wall


_FLUID_PAIRS = {dim: _compile_fluid_pairs(dim) for dim in (2, 3)}
_WALL_PAIRS = {dim: _compile_wall_pairs(dim) for dim in (2, 3)}
