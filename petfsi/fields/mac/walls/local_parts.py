"""Where a rank's own arrays hold the parts of divided cells and faces, and their values there."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.walls.parts import Parts, cells_beside, local_images, owned


class LocalParts:
    """Where this rank's local arrays hold divided cells and faces.

    Attributes
    ----------
    table : Parts
    number : ndarray of int64, shape (n_links,)
        Which divided face each link belongs to.
    faces : list of (ndarray, ndarray)
        By axis, the flat index of local entries of divided faces, and which divided face it is.
    link, entry : ndarray of int64
        The links of this rank's own faces and their flat local index.
    pieces, piece_cell : ndarray of int64
        The rows of this rank's own further pieces and the flat local index of their cells.
    """

    def __init__(self, grid: MacGrid, table: Parts) -> None:
        self.grid, self.table = grid, table
        begin, count = table.first[:-1], np.diff(table.first)
        self.number = np.repeat(np.arange(len(begin)), count)
        self.faces, link, entry = [], [], []
        for a in range(grid.dim):
            mine = np.flatnonzero(table.axis[begin] == a)
            flat, which = local_images(grid, a, table.face[begin[mine]])
            which = mine[which]
            self.faces.append((flat, which))
            own = owned(grid, a, flat)
            link.append(ranges(begin[which[own]], count[which[own]]))
            entry.append(np.repeat(flat[own], count[which[own]]))
        self.link, self.entry = np.concatenate(link), np.concatenate(entry)
        self._cells = local_images(grid, None, table.cell)
        flat, which = self._cells
        own = owned(grid, None, flat)
        self.pieces, self.piece_cell = which[own], flat[own]

    @cached_property
    def first(self) -> list[np.ndarray]:
        """By axis, a face array: the first link of a divided face, else -1."""
        found = []
        for a, (flat, which) in enumerate(self.faces):
            array = np.full(self.grid.shape(a), -1, dtype=np.int32)
            array.reshape(-1)[flat] = self.table.first[which]
            found.append(array)
        return found

    @cached_property
    def extra(self) -> np.ndarray:
        """Cell array: the row of piece 1 of a divided cell, else -1."""
        array = np.full(self.grid.shape(None), -1, dtype=np.int32)
        flat, which = self._cells
        one = self.table.piece[which] == 1
        array.reshape(-1)[flat[one]] = which[one]
        return array

    def gathered(self, values: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return values of links or pieces, of which every rank contributes its own rows. Collective."""
        if self.grid.comm.size == 1 or not len(values):
            return values
        out = values.copy()
        for rows, part in self.grid.comm.allgather((own, values[own])):
            out[rows] = part
        return out

    def at_cells(self, array: np.ndarray, extras: np.ndarray) -> np.ndarray:
        """Return the mean over the two pieces of each link of what cells and further pieces hold. Collective."""
        grid, table = self.grid, self.table
        values = np.zeros(len(table))
        for a in range(grid.dim):
            mine = table.axis[self.link] == a
            rows, place = self.link[mine], np.array(np.unravel_index(self.entry[mine], grid.shape(a)))
            for piece, step in ((table.below[rows], 1), (table.above[rows], 0)):
                at = place.copy()
                at[a] -= step
                flat = np.ravel_multi_index(tuple(at), grid.shape(None))
                further = piece > 0
                value = array.reshape(-1)[flat]
                value[further] = extras[self.extra.reshape(-1)[flat[further]] + piece[further] - 1]
                values[rows] += 0.5 * value
        return self.gathered(values, self.link)

    def at_faces(self, arrays: list[np.ndarray]) -> np.ndarray:
        """Return what face arrays hold at the links of this rank's own faces; zero for others."""
        values = np.zeros(len(self.table))
        axis = self.table.axis[self.link]
        for a, array in enumerate(arrays):
            mine = axis == a
            values[self.link[mine]] = array.reshape(-1)[self.entry[mine]]
        return values

    def in_first_pieces(self, arrays: list[np.ndarray], parts: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return this rank's own divided cells, flat, and the velocity of their first pieces, which are the largest.

        Parameters
        ----------
        arrays : list of ndarray
            Face arrays.
        parts : ndarray
            Values of links.

        Returns
        -------
        cells : ndarray of int64, shape (n,)
        velocity : list of ndarray, shape (n,)
            By axis: the mean of what passes through both faces, or through the one that lets any through.
        """
        grid, table, cells = self.grid, self.table, np.unique(self.table.cell)
        flat, which = local_images(grid, None, cells)
        own = owned(grid, None, flat)
        columns = []
        for a, array in enumerate(arrays):
            sides, weights = [], []
            for upper, piece in ((0, table.above), (1, table.below)):
                mine = np.flatnonzero((table.axis == a) & (piece == 0))
                cell = cells_beside(grid, table, upper == 1)[mine]
                at = np.minimum(np.searchsorted(cells, cell), max(len(cells) - 1, 0))
                use = np.flatnonzero(cells[at] == cell) if len(cells) else mine[:0]
                open_part = np.bincount(at[use], table.openness[mine[use]], len(cells))
                flow = np.bincount(at[use], (table.openness * parts)[mine[use]], len(cells))
                # faces on a side with a given velocity are no links
                place = np.array(np.unravel_index(flat[own], grid.shape(None)))
                place[a] += upper
                on_side = (place[a] - grid.ghost[a] + grid.lo[a]) == (grid.cells[a] if upper else 0)
                given = array[tuple(place)]
                here, flow = open_part[which[own]], flow[which[own]]
                linked = here > 0.0
                sides.append(np.where(linked, flow / np.where(linked, here, 1.0), given))
                weights.append(linked | (on_side & (not grid.periodic[a])))
            count = np.maximum(weights[0].astype(int) + weights[1], 1)
            columns.append((weights[0] * sides[0] + weights[1] * sides[1]) / count)
        return flat[own], columns

    def mean_into(self, arrays: list[np.ndarray], parts: np.ndarray) -> None:
        """Write the mean over the parts of divided faces into face arrays, ghosts included."""
        n = len(self.table.first) - 1
        if n == 0:
            return
        weight = np.bincount(self.number, self.table.openness, minlength=n)
        mean = np.bincount(self.number, self.table.openness * parts, minlength=n) / weight
        for array, (flat, which) in zip(arrays, self.faces, strict=True):
            array.reshape(-1)[flat] = mean[which]


def ranges(begin: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return begin, begin + 1, ... of each range, one after the other."""
    if not len(begin):
        return np.zeros(0, dtype=np.int64)
    ends = np.cumsum(count)
    return np.repeat(begin - ends + count, count) + np.arange(ends[-1])
