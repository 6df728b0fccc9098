"""Which rank owns which cells: boxes found by recursive bisection, so that all ranks hold about as many particles."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.fields.sph.cells import CellGrid

#: Boxes are made anew when the fullest rank has so many times the mean number of particles.
UNEVEN = 1.1
#: New boxes are taken only if they lessen the excess of the fullest rank over the mean by this part.
_WORTH = 0.1


@dataclass(frozen=True)
class Link:
    """Cells of one rank that stand in another's halo.

    Attributes
    ----------
    rank : int
        The other rank; the rank itself where cells are their own rank's images.
    shift : ndarray of int, shape (dim,)
        They stand there as images moved by so many periods, each -1, 0 or 1.
    low, high : ndarray of int, shape (dim,)
        The cells ``low <= cell < high``, in the indices of their owner: not moved.
    """

    rank: int
    shift: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class Boxes:
    """The boxes of cells that the ranks own. They fill the grid; more ranks than cells have empty ones.

    Attributes
    ----------
    low, high : ndarray of int, shape (size, dim)
        Rank r owns the cells ``low[r] <= cell < high[r]``.
    loads : ndarray of int, shape (size,)
        How many particles each rank had to own when the boxes were made.
    axis, cut : ndarray of int, shape (size - 1,)
        The cuts, as a tree of which the first is the root: cells below ``cut`` along ``axis`` go one way.
    below, above : ndarray of int, shape (size - 1,)
        What stands on either side: the number of a cut, or ``~rank``.
    """

    low: np.ndarray
    high: np.ndarray
    loads: np.ndarray
    axis: np.ndarray
    cut: np.ndarray
    below: np.ndarray
    above: np.ndarray

    @property
    def size(self) -> int:
        """Number of ranks."""
        return len(self.low)

    def owner(self, cells: np.ndarray) -> np.ndarray:
        """Return the rank that owns each cell, -1 outside the grid.

        Parameters
        ----------
        cells : ndarray of int, shape (n, dim)
        """
        node = np.full(len(cells), 0 if len(self.cut) else ~0)
        open_ = np.flatnonzero(node >= 0)
        while open_.size:
            at = node[open_]
            is_below = cells[open_, self.axis[at]] < self.cut[at]
            node[open_] = np.where(is_below, self.below[at], self.above[at])
            open_ = open_[node[open_] >= 0]
        rank = ~node
        inside = np.all((cells >= self.low[rank]) & (cells < self.high[rank]), axis=1)
        return np.where(inside, rank, -1)

    def links(self, rank: int, counts: np.ndarray, periodic: np.ndarray) -> tuple[list[Link], list[Link]]:
        """Return which cells of a rank stand in halos one cell wide, and which cells stand in its own halo.

        Both are sorted by (rank, shift): what one rank sends another is in the order in which that one expects it.

        Parameters
        ----------
        rank : int
        counts : ndarray of int, shape (dim,)
            Cells of the grid.
        periodic : ndarray of bool, shape (dim,)
        """
        sends: list[Link] = []
        receives: list[Link] = []
        filled = np.all(self.high > self.low, axis=1)
        for shift in product(*((-1, 0, 1) if p else (0,) for p in periodic)):
            moved = np.array(shift) * counts
            others = filled & filled[rank]
            others[rank] &= any(shift)
            for links, first, last in (
                (sends, self.low - 1 - moved, self.high + 1 - moved),
                (receives, self.low[rank] - 1 - moved, self.high[rank] + 1 - moved),
            ):
                owned = rank if links is sends else slice(None)
                low, high = np.maximum(first, self.low[owned]), np.minimum(last, self.high[owned])
                for other in np.flatnonzero(others & np.all(high > low, axis=1)):
                    links.append(Link(int(other), np.array(shift), low[other], high[other]))
        return sorted(sends, key=_order), sorted(receives, key=_order)


def _order(link: Link) -> tuple[int, tuple[int, ...]]:
    return link.rank, tuple(link.shift)


def is_uneven(n: np.ndarray) -> bool:
    """Return whether ranks that hold so many particles each, shape (size,), should have other boxes."""
    return bool(n.max() * len(n) > UNEVEN * n.sum())


def is_better(boxes: Boxes, n: np.ndarray) -> bool:
    """Return whether boxes just made would even out, by more than a trifle, ranks that hold ``n``, shape (size,).

    Cuts run between cells: where these are few no boxes may be even, and making them again would not help.
    """
    return bool((n.max() - boxes.loads.max()) * len(n) > _WORTH * (n.max() * len(n) - n.sum()))


def bisect(comm: MPI.Comm, grid: CellGrid, cells: np.ndarray) -> Boxes:
    """Return boxes that share particles out evenly: the same on all ranks, whatever they hold before. Collective.

    The grid is cut in two across the longest side of what is filled, between cells, so that each half has its share
    of the ranks and about the same share of the particles; and then the halves. Without particles it is the number of
    cells that is shared out.

    Parameters
    ----------
    comm : MPI.Comm
    grid : CellGrid
    cells : ndarray of int, shape (n, dim)
        The cells of this rank's particles; what lies outside the grid counts for the nearest cell.

    References
    ----------
    M. J. Berger, S. H. Bokhari, A partitioning strategy for nonuniform problems on multiprocessors (1987).
    """
    counts = np.asarray(grid.counts, dtype=np.int64)
    dim, size = len(counts), comm.size
    low, high = np.zeros((size, dim), dtype=np.int64), np.tile(counts, (size, 1))
    loads = np.full(size, len(cells))
    axis, cut, below, above = np.zeros((4, size - 1), dtype=np.int64)
    # a node to be cut: its number, the ranks [begin, end) that share it; all of them have its box until it is cut
    level = [(0, 0, size)] if size > 1 else []
    cells = np.clip(cells, 0, counts - 1) if level else cells
    at = np.zeros(len(cells), dtype=np.int64)
    n_cuts = len(level)
    while level:
        histograms = _histograms(comm, cells, at, [(low[begin], high[begin]) for _, begin, _ in level])
        chosen, goes = [], []
        children: list[tuple[int, int, int]] = []
        for (node, begin, end), along in zip(level, histograms, strict=True):
            middle = (begin + end) // 2
            a, k, n_below, n_above = _best_cut(along, grid.side, middle - begin, end - begin)
            axis[node], cut[node] = a, low[begin, a] + k
            high[begin:middle, a] = low[middle:end, a] = cut[node]
            chosen.append((a, cut[node]))
            ends = []
            for first, last, n in ((begin, middle, n_below), (middle, end, n_above)):
                loads[first:last] = n
                ends.append(~first if last - first == 1 else n_cuts)
                goes.append(-1 if last - first == 1 else len(children))
                if last - first > 1:
                    children.append((n_cuts, first, last))
                    n_cuts += 1
            below[node], above[node] = ends
        cells, at = _descend(cells, at, np.array(chosen), np.array(goes).reshape(-1, 2))
        level = children
    return Boxes(low, high, loads, axis, cut, below, above)


def _histograms(
    comm: MPI.Comm, cells: np.ndarray, at: np.ndarray, boxes: list[tuple[np.ndarray, np.ndarray]]
) -> list[list[np.ndarray]]:
    """Return for each box, along each axis, how many particles of all ranks each layer of cells holds. Collective."""
    lengths = np.array([high - low for low, high in boxes])
    starts = np.append(0, np.cumsum(lengths))
    offset = starts[:-1].reshape(lengths.shape) - np.array([low for low, _ in boxes])
    mine = np.zeros(starts[-1], dtype=np.int64)
    for a in range(lengths.shape[1]):
        mine += np.bincount(offset[at, a] + cells[:, a], minlength=len(mine))
    total = np.empty_like(mine)
    comm.Allreduce(mine, total)
    pieces = np.split(total, starts[1:-1])
    dim = lengths.shape[1]
    return [pieces[dim * k : dim * (k + 1)] for k in range(len(boxes))]


def _best_cut(along: list[np.ndarray], side: np.ndarray, part: int, whole: int) -> tuple[int, int, int, int]:
    """Return axis, number of layers below the cut, and how many particles are below and above it.

    The cut leaves ``part`` of ``whole`` of the particles below, as nearly as may be.
    """
    total = int(along[0].sum())
    weights = along if total else [np.ones_like(n) for n in along]
    filled = [np.flatnonzero(n) for n in weights]
    extents = [(f[-1] - f[0] + 1) * s if f.size else 0.0 for f, s in zip(filled, side, strict=True)]
    a = int(np.argmax(extents))
    sums = np.append(0, np.cumsum(weights[a]))
    k = int(np.argmin(np.abs(sums * whole - sums[-1] * part)))
    n_below = int(sums[k]) if total else 0
    return a, k, n_below, total - n_below


def _descend(cells: np.ndarray, at: np.ndarray, chosen: np.ndarray, goes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of particles in boxes that are to be cut again, and the number of that box."""
    axis, cut = chosen.T
    is_above = cells[np.arange(len(cells)), axis[at]] >= cut[at]
    at = goes[at, is_above.astype(np.int64)]
    again = at >= 0
    return cells[again], at[again]


@njit(cache=True)
def located(x, owned, low, side, corner, counts):
    """Return the owned rows in a rank's box, their local cells, and the owned rows outside of it.

    ``CellGrid.of`` and what follows from it, in one pass. Local cells are counted from ``corner``, the first one of the
    box grown by a halo of one cell; what is nowhere (NaN) is outside.

    Parameters
    ----------
    x : ndarray, shape (n, dim)
        m.
    owned : ndarray of bool, shape (n,)
    low, side : ndarray, shape (dim,)
        Of the grid, m.
    corner, counts : ndarray of int, shape (dim,)
        First local cell and numbers of local cells.
    """
    n, dim = x.shape
    rows, leaving = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    cells = np.empty((n, dim), dtype=np.int64)
    n_rows = n_leaving = 0
    for i in range(n):
        if not owned[i]:
            continue
        inside = True
        for a in range(dim):
            cell = np.floor((x[i, a] - low[a]) / side[a]) - corner[a]
            if 1 <= cell < counts[a] - 1:
                cells[n_rows, a] = np.int64(cell)
            else:
                inside = False
        if inside:
            rows[n_rows] = i
            n_rows += 1
        else:
            leaving[n_leaving] = i
            n_leaving += 1
    return rows[:n_rows], cells[:n_rows], leaving[:n_leaving].copy()


@njit(cache=True)
def seen(cells, counts, low, high):
    """Return the entries of ``cells`` that lie in each of the boxes [low, high), box after box, and their numbers.

    Boxes are at the edges of the rank's own.
    """
    n, dim = cells.shape
    sizes = np.zeros(len(low), dtype=np.int64)
    edge = np.empty(n, dtype=np.int64)
    n_edge = 0
    for i in range(n):
        on_edge = False
        for a in range(dim):
            on_edge |= cells[i, a] == 1 or cells[i, a] == counts[a] - 2
        edge[n_edge] = i
        n_edge += on_edge
    place = np.zeros(len(low), dtype=np.int64)
    seen = np.empty(0, dtype=np.int64)
    for filling in range(2):
        if filling:
            seen = np.empty(sizes.sum(), dtype=np.int64)
            place[1:] = np.cumsum(sizes)[:-1]
        for i in edge[:n_edge]:
            for k in range(len(low)):
                inside = True
                for a in range(dim):
                    inside &= low[k, a] <= cells[i, a] < high[k, a]
                if inside and filling:
                    seen[place[k]] = i
                    place[k] += 1
                elif inside:
                    sizes[k] += 1
    return seen, sizes
