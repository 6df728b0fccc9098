"""Values for the band of faces or cells around those where the flow is determined."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.fields.mac.grid.grid import MacGrid

#: Layers of a band: more than the ghost width, so that whatever a departure point meets is filled.
LAYERS = 6
#: Layers between two exchanges; ghosts are worked on redundantly, each layer spoiling two from outside.
BATCH = 2
#: Layers that are extrapolated along lines.
LINEAR = 2
#: The layer of entries that no layer reaches, and of those outside the domain.
FAR = 255


@njit(cache=True)
def _unknown(known, part):
    """Return the flat indices of entries of a part of the array that are not known."""
    (b0, e0), (b1, e1), (b2, e2) = part
    _, n1, n2 = known.shape
    count = 0
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                count += not known[i, j, k]
    found = np.empty(count, np.int64)
    count = 0
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if not known[i, j, k]:
                    found[count] = (i * n1 + j) * n2 + k
                    count += 1
    return found


@njit(cache=True)
def _mark(layer, entries, strides, number):
    """Give ``number`` to those entries without a layer that have a neighbour in a lower one."""
    for entry in entries:
        if layer[entry] == FAR:
            for s in strides:
                if layer[entry - s] < number or layer[entry + s] < number:
                    layer[entry] = number
                    break


@njit(cache=True)
def _average(q, layer, entries, strides):
    """Set entries of one layer to the mean of their neighbours in lower ones."""
    for entry in entries:
        total, count = 0.0, 0
        for s in strides:
            if layer[entry - s] < layer[entry]:
                total += q[entry - s]
                count += 1
            if layer[entry + s] < layer[entry]:
                total += q[entry + s]
                count += 1
        q[entry] = total / count


@njit(cache=True)
def on_line(near, far):
    """Return what comes after ``near`` on the line from ``far`` through it, within half as much again as the two.

    Lines through lines would grow without bound.
    """
    most = 1.5 * max(abs(near), abs(far))
    return min(max(2.0 * near - far, -most), most)


@njit(cache=True)
def _extrapolate(q, layer, entries, strides):
    """Set entries of one layer to the mean of what lines through their neighbours in lower ones say.

    A line needs a second entry behind the neighbour that is known no later than it; else the neighbour's value goes on.
    So it does beyond ``LINEAR`` layers.
    """
    for entry in entries:
        total, count = 0.0, 0
        for stride in strides:
            for s in (-stride, stride):
                if layer[entry + s] < layer[entry]:
                    value = q[entry + s]
                    if layer[entry] <= LINEAR and layer[entry + 2 * s] <= layer[entry + s]:
                        value = on_line(value, q[entry + 2 * s])
                    total += value
                    count += 1
        q[entry] = total / count


class Band:
    """The layers of undetermined faces of an axis (or cells: None) next to determined ones.

    An entry's layer is its distance from the known entries, in steps along the grid. Velocities are extrapolated
    linearly from lower layers; values of cells, which must stay within bounds, take the mean of their neighbours there.
    Neither depends on the ranks.

    Attributes
    ----------
    layer : ndarray of uint8
        Zero where known, up to ``LAYERS`` in the band, ``FAR`` elsewhere.
    empty : bool
        Whether everything is known, on all ranks.
    """

    def __init__(self, grid: MacGrid, axis: int | None):
        self.grid, self.axis = grid, axis
        self.empty = True
        shape = grid.shape(axis)
        self.layer = np.full(shape, FAR, dtype=np.uint8)
        self._strides = tuple((shape[1] * shape[2], shape[2], 1)[: grid.dim])
        self._lists: list[np.ndarray] = []
        # entries at the very end of the array lack neighbours there; the exchange fills them
        self._part = tuple(
            (max(s.start, 2), min(s.stop, n - 2)) if b < grid.dim else (0, 1)
            for b, (s, n) in enumerate(zip(grid.inside(axis), shape, strict=True))
        )

    def rebuild(self, known: np.ndarray) -> None:
        """Find the layers anew; ``known`` is valid in all ghosts. Collective."""
        inside = self.grid.inside(self.axis)
        self.layer[inside] = np.where(known[inside], 0, FAR)
        entries = _unknown(known, self._part)
        self.empty = not self.grid.comm.allreduce(len(entries) > 0, op=MPI.LOR)
        if self.empty:
            return
        flat = self.layer.reshape(-1)
        for first in range(1, LAYERS + 1, BATCH):
            for number in range(first, first + BATCH):
                _mark(flat, entries, self._strides, number)
            self.grid.halo.exchange(self.layer, self.axis)
        layers = flat[entries]
        order = np.argsort(layers, kind="stable")
        ends = np.searchsorted(layers[order], np.arange(1, LAYERS + 2))
        self._lists = [entries[order[a:b]] for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def fill(self, q: np.ndarray) -> None:
        """Fill the band of an array whose known entries are valid in all ghosts. Collective."""
        if self.empty:
            return
        flat = q.reshape(-1)
        spread = _average if self.axis is None else _extrapolate
        for first in range(0, LAYERS, BATCH):
            for entries in self._lists[first : first + BATCH]:
                spread(flat, self.layer.reshape(-1), entries, self._strides)
            self.grid.halo.exchange(q, self.axis)
