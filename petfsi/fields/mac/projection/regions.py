"""Connected regions of fluid, across ranks and periodic borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.kinds import OPEN, PRESSURE
from petfsi.fields.mac.projection.extras import Extras
from petfsi.geometry.union_find import find, join
from petfsi.petsc import Layout

#: More pieces than a cell can have.
MOST_PIECES = 1 << 20


@njit(cache=True)
def _label(active, kind0, kind1, kind2, part, flat, labels):
    """Write the number of each cell's region on this rank, in the order of first cells; return those cells, flat."""
    (b0, e0), (b1, e1), (b2, e2) = part
    m1, m2 = e1 - b1, e2 - b2
    parent = np.arange((e0 - b0) * m1 * m2)
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                c = ((i - b0) * m1 + j - b1) * m2 + k - b2
                if i > b0 and kind0[i, j, k] == PRESSURE:
                    join(parent, c, c - m1 * m2)
                if j > b1 and kind1[i, j, k] == PRESSURE:
                    join(parent, c, c - m2)
                if not flat and k > b2 and kind2[i, j, k] == PRESSURE:
                    join(parent, c, c - 1)
    number = np.full(len(parent), -1)
    first = np.empty(len(parent), np.int64)
    count = 0
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if not active[i, j, k]:
                    continue
                c = ((i - b0) * m1 + j - b1) * m2 + k - b2
                root = find(parent, c)
                if number[root] < 0:
                    number[root] = count
                    first[count] = c
                    count += 1
                labels[i, j, k] = number[root]
    return first[:count].copy()


@dataclass(frozen=True)
class Regions:
    """The closed regions: those without an OPEN face.

    Attributes
    ----------
    members : list of ndarray
        Per region 1 for its unknowns on this rank and 0 for the others. Regions are in the order of their first cells
        in the global grid, and of their pieces there, on any number of ranks.
    """

    grid: MacGrid
    members: list[np.ndarray]

    def touching(self, touched: np.ndarray | None) -> list[bool]:
        """Return for each region whether any rank has one of its unknowns marked. Collective."""
        if touched is None or not self.members:
            return [False] * len(self.members)
        here = np.array([touched.astype(float) @ vec > 0 for vec in self.members])
        return [bool(t) for t in np.logical_or.reduce(self.grid.comm.allgather(here))]


def find_regions(
    grid: MacGrid,
    active: np.ndarray,
    face_kind: list[np.ndarray],
    layout: Layout,
    index: np.ndarray,
    extras: Extras | None,
) -> Regions:
    """Return the closed regions among the active cells and the extra unknowns. Collective."""
    comm = grid.comm
    labels = np.full(grid.shape(None), -1, dtype=np.int64)
    own, part = grid.owned(None), grid.owned_ranges(None)
    kind_x, kind_y, kind_z = three(face_kind)
    first = _label(active, kind_x, kind_y, kind_z, part, grid.dim == 2, labels)
    place = np.unravel_index(first, grid.owned_shape)
    natural = MOST_PIECES * np.ravel_multi_index([p + m for p, m in zip(place, grid.lo, strict=True)], grid.cells)
    n_extra = 0 if extras is None else len(extras.cell)
    n_labels = len(first) + n_extra
    if extras is not None:
        # an extra unknown counts from the start as a region of its own, which comes after its cell and those before
        cell = np.array(np.unravel_index(extras.cell, grid.shape(None))) - np.array(grid.ghost)[:, None]
        begins = MOST_PIECES * np.ravel_multi_index(cell + np.array(grid.lo)[:, None], grid.cells) + extras.piece
        natural = np.concatenate((natural, begins))
    counts = comm.allgather(n_labels)
    offset = sum(counts[: comm.rank])
    labels[labels >= 0] += offset
    grid.exchange_cells(labels, width=1)

    pairs = _pairs(grid, labels, face_kind)
    is_open = np.zeros(n_labels, dtype=bool)
    for axis, kind in enumerate(face_kind):
        for shift in (0, 1):
            faces = list(own)
            faces[axis] = slice(own[axis].start + shift, own[axis].stop + shift)
            at = labels[own][kind[tuple(faces)] == OPEN]
            is_open[at[at >= 0] - offset] = True

    if extras is not None:
        of_unknown = np.concatenate((grid.to_vec(labels), offset + len(first) + np.arange(n_extra)))
        pairs = np.concatenate((pairs, _extra_pairs(grid, labels, of_unknown, layout, index, extras, is_open, offset)))
    links = np.concatenate(comm.allgather(pairs))
    total = sum(counts)
    if total == 0:
        return Regions(grid, [])
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(total, total))
    n_regions, region = connected_components(graph, directed=False)
    has_exit = np.bincount(region, np.concatenate(comm.allgather(is_open)), n_regions) > 0
    begin = np.full(n_regions, np.iinfo(np.int64).max)
    np.minimum.at(begin, region, np.concatenate(comm.allgather(natural)))
    closed = [r for r in np.argsort(begin, kind="stable") if not has_exit[r]]
    label = np.concatenate((grid.to_vec(labels), offset + len(first) + np.arange(n_extra)))
    mine = np.where(label >= 0, region[label], -1)
    return Regions(grid, [(mine == r).astype(float) for r in closed])


def _pairs(grid: MacGrid, labels: np.ndarray, face_kind: list[np.ndarray]) -> np.ndarray:
    """Return the label pairs that meet across the lower border of this rank's cells, each once."""
    found = [np.empty((0, 2), dtype=np.int64)]
    for axis, kind in enumerate(face_kind):
        plane = list(grid.owned(None))
        plane[axis] = slice(grid.ghost[axis], grid.ghost[axis] + 1)
        behind = list(plane)
        behind[axis] = slice(grid.ghost[axis] - 1, grid.ghost[axis])
        joined = kind[tuple(plane)] == PRESSURE
        found.append(np.stack([labels[tuple(plane)][joined], labels[tuple(behind)][joined]], axis=1))
    return np.unique(np.concatenate(found), axis=0)


def _extra_pairs(
    grid: MacGrid, labels: np.ndarray, of_unknown: np.ndarray, layout: Layout, index: np.ndarray, extras: Extras,
    is_open: np.ndarray, offset: int,
) -> np.ndarray:  # fmt: skip
    """Return the pairs of labels that split cells' links join; note which labels reach an open side. Collective."""
    numbers = np.concatenate(grid.comm.allgather(layout.start + np.arange(grid.layout.n_local, layout.n_local)))
    every = np.concatenate(grid.comm.allgather(of_unknown[grid.layout.n_local :]))
    ends = []
    for number, step in ((extras.below, -1), (extras.above, 0)):
        label = np.full(len(number), -1, dtype=np.int64)
        for a in range(grid.dim):
            at = np.flatnonzero((extras.axis == a) & (number >= 0))
            where = list(np.unravel_index(extras.face[at], grid.shape(a)))
            where[a] = where[a] + step
            own = index[tuple(where)] == number[at]
            label[at] = labels[tuple(where)]
            label[at[~own]] = every[np.searchsorted(numbers, number[at[~own]])]
        ends.append(label)
    inner = (ends[0] >= 0) & (ends[1] >= 0)
    exits = np.maximum(*ends)[(extras.below < 0) | (extras.above < 0)] - offset
    is_open[exits[(exits >= 0) & (exits < len(is_open))]] = True
    return np.stack(ends, axis=1)[inner]


def box_around(grid: MacGrid, extras: Extras | None, member: np.ndarray) -> str:
    """Return in words the box around the cells of unknowns, of which ``member`` is not zero. Collective."""
    n_cells = grid.layout.n_local
    cells, shape = member[:n_cells] != 0.0, grid.shape(None)
    ends = np.full((2, grid.dim), -np.inf)
    for a in range(grid.dim):
        centres = np.broadcast_to(grid.coordinates(None)[a], shape)
        x = grid.to_vec(centres)[cells]
        if extras is not None:
            x = np.append(x, centres.reshape(-1)[extras.cell][member[n_cells:] != 0.0])
        if len(x):
            ends[:, a] = grid.dx[a] / 2 + np.array([x.max(), -x.min()])
    high, low = grid.comm.allreduce(ends, op=np.maximum)
    return ", ".join(f"{axis} {0.0 - b:.4g} to {e:.4g}" for axis, b, e in zip("xyz", low, high, strict=False)) + " m"
