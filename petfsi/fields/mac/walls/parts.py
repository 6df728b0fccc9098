"""The parts that a surface divides cells and faces into, by names that all ranks share.

A divided cell holds pieces of fluid; a face of such a cell consists of links, each between a piece below and one
above. Velocity belongs to links and smoke to pieces: a sheet thinner than a cell has water of its own on either side.
There are as many of them as the sheets are large, not the grid: every rank knows all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product

import numpy as np

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.replicated import read_whole, whole_slab
from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.stored import EXACT, outside


@dataclass(frozen=True)
class Parts:
    """The further pieces of divided cells, and the links of their faces, of the whole grid, the same on all ranks.

    Attributes
    ----------
    cell, piece : ndarray of int64, shape (n_extras,)
        Pieces 1, 2, ... of the cells (natural global index), in this order; piece 0 is the cell's own.
    volume : ndarray, shape (n_extras,)
        Fraction of the cell.
    axis, face, below, above : ndarray of int64, shape (n_links,)
        Faces (natural global index among those of the axis) and the pieces that they join, -1 beyond a side; in this
        order.
    openness : ndarray, shape (n_links,)
        Fraction of the face.
    wall_cell, wall_piece, wall_facet : ndarray of int64, shape (n_walls,)
    wall_area : ndarray, shape (n_walls,)
        How much of which facets bounds which piece, m^2 (m in 2D).
    """

    cell: np.ndarray
    piece: np.ndarray
    volume: np.ndarray
    axis: np.ndarray
    face: np.ndarray
    below: np.ndarray
    above: np.ndarray
    openness: np.ndarray
    wall_cell: np.ndarray
    wall_piece: np.ndarray
    wall_facet: np.ndarray
    wall_area: np.ndarray

    @classmethod
    def none(cls) -> Parts:
        """Return those of a grid that nothing divides."""
        return cls(*(np.zeros(0, np.int64 if f.name not in REAL else float) for f in fields(cls)))

    @classmethod
    def gathered(cls, grid: MacGrid, pieces: np.ndarray, links: np.ndarray, walls: np.ndarray) -> Parts:
        """Return all that ranks know of their own. Collective.

        Parameters
        ----------
        grid : MacGrid
        pieces : ndarray, shape (n, 3)
            Cell, piece, volume.
        links : ndarray, shape (m, 5)
            Axis, face, pieces below and above, openness. Indices are small enough to be exact as floats.
        walls : ndarray, shape (k, 4)
            Cell, piece, facet, area.
        """
        columns: list[np.ndarray] = []
        for table, keys in ((pieces, 2), (links, 4), (walls, 3)):
            whole = np.concatenate(grid.comm.allgather(table.astype(float)))
            order = np.lexsort(whole[:, :keys].T[::-1])
            columns += list(whole[order].T.copy())
        kept = zip(columns, fields(cls), strict=True)
        return cls(*(c if f.name in REAL else c.astype(np.int64) for c, f in kept))

    def __len__(self) -> int:
        """Return the number of links."""
        return len(self.axis)

    def alike(self, other: Parts) -> bool:
        """Return whether pieces and links have the same names, however open."""
        names = ("cell", "piece", "axis", "face", "below", "above")
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in names)

    @cached_property
    def first(self) -> np.ndarray:
        """Where the links of each divided face begin, and one beyond the last, shape (n_faces + 1,)."""
        new = np.ones(len(self), dtype=bool)
        new[1:] = (np.diff(self.axis) != 0) | (np.diff(self.face) != 0)
        return np.append(np.flatnonzero(new), len(self))

    def rows_of_faces(self, axis: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Return the first link of each of some faces; -1 where it is not divided."""
        begin = self.first[:-1]
        which = _find((self.axis[begin], self.face[begin]), (axis, face))
        return np.where(which >= 0, self.first[which], -1)

    def first_piece(self, cell: np.ndarray) -> np.ndarray:
        """Return the row of piece 1 of each of some cells; -1 where it is not divided."""
        return _find((self.cell, self.piece), (cell, np.ones_like(cell)))

    def rows(self, axis: np.ndarray, face: np.ndarray, below: np.ndarray, above: np.ndarray) -> np.ndarray:
        """Return which links have these names; -1 for none."""
        return _find((self.axis, self.face, self.below + 1, self.above + 1), (axis, face, below + 1, above + 1))

    def state(self, rank: int) -> dict[str, Slab]:
        """Return the table as arrays that rank 0 owns."""
        return {f"parts_{f.name}": whole_slab(rank, getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def restored(cls, grid: MacGrid, read: Reader) -> Parts:
        """Return the table that ``state`` stored. Collective; ValueError if it cannot be one of the grid's."""
        columns: dict[str, np.ndarray] = {}
        for f in fields(cls):
            first = next(name for names in TABLES for name in names if f.name in names)
            columns[f.name] = read_whole(read, f"parts_{f.name}", len(columns[first]) if first in columns else None)
        if wrong := next(filter(None, _faults(grid, columns)), ""):
            raise ValueError(wrong)  # every rank has read the same
        return cls(*(column if name in REAL else column.astype(np.int64) for name, column in columns.items()))


#: Columns of ``Parts`` that are no integers.
REAL = ("volume", "openness", "wall_area")
#: Columns of equal length.
TABLES = (
    ("cell", "piece", "volume"),
    ("axis", "face", "below", "above", "openness"),
    ("wall_cell", "wall_piece", "wall_facet", "wall_area"),
)
#: Pieces of a cell, more than any surface makes.
_MOST = 1 << 20
#: Fractions are so exact.
_SLACK = 1e-6


def _faults(grid: MacGrid, columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield what is wrong with a table that a file holds: each entry may be used as an index."""
    n_cells, n_faces = math.prod(grid.cells), max(math.prod(_whole(grid, a)) for a in range(grid.dim))
    ranges = {
        "cell": (0, n_cells - 1), "piece": (1, _MOST), "axis": (0, grid.dim - 1), "face": (0, n_faces - 1),
        "below": (-1, _MOST), "above": (-1, _MOST), "wall_cell": (0, n_cells - 1), "wall_piece": (0, _MOST),
        "wall_facet": (0, EXACT),
    }  # fmt: skip
    for name, (low, high) in ranges.items():
        yield outside(f"parts_{name}", columns[name], low, high, whole=True)
    for name, high in (("volume", 1.0), ("openness", 1.0), ("wall_area", np.inf)):
        yield outside(f"parts_{name}", columns[name], -_SLACK, high * (1.0 + _SLACK))
    of_axis = np.array([math.prod(_whole(grid, a)) for a in range(grid.dim)])[columns["axis"].astype(int)]
    yield outside("parts_face", columns["face"] - of_axis, -EXACT, -1)
    for names in (("cell", "piece"), ("axis", "face", "below", "above")):
        if not _ascends([columns[name] for name in names]):
            yield f"the rows of {', '.join(f'parts_{name}' for name in names)} do not ascend, or one is there twice"
    if np.any(np.diff(columns["wall_cell"]) < 0):
        yield "'parts_wall_cell' does not ascend"
    yield from _piece_faults(grid, columns)


def _ascends(keys: list[np.ndarray]) -> bool:
    """Return whether rows are in the order of their keys, each there once."""
    after = np.zeros(max(len(keys[0]) - 1, 0), dtype=bool)
    for key in reversed(keys):
        step = np.diff(key)
        after = (step > 0) | ((step == 0) & after)
    return bool(after.all())


def _piece_faults(grid: MacGrid, columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield what is wrong with pieces: those of a cell are counted from 1, and links and walls know no others."""
    whole = {name: column if name in REAL else column.astype(np.int64) for name, column in columns.items()}
    parts = Parts(**whole)
    new = np.diff(parts.cell, prepend=-1) > 0
    begin = np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))
    yield outside("parts_piece", parts.piece - (np.arange(len(new)) - begin), 1, 1)
    beside = ((cells_beside(grid, parts, True), parts.below), (cells_beside(grid, parts, False), parts.above))
    walls = (parts.wall_cell, parts.wall_piece)
    for name, (cell, piece) in zip(("below", "above", "wall_piece"), (*beside, walls), strict=True):
        if np.any((cell < 0) != (piece < 0)):
            yield f"'parts_{name}' has pieces beyond a side, or none within"
        further = piece > 0
        if np.any(_find((parts.cell, parts.piece), (cell[further], piece[further])) < 0):
            yield f"'parts_{name}' names pieces that 'parts_piece' does not have"


def _find(table: tuple[np.ndarray, ...], wanted: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return the rows of a sorted table of keys that are not negative; -1 where a wanted one is not in it."""
    key, want = np.zeros(len(table[0]), np.int64), np.zeros(len(wanted[0]), np.int64)
    for column, other in zip(table, wanted, strict=True):
        size = 1 + max(column.max(initial=0), other.max(initial=0))
        key, want = key * size + column, want * size + other
    if not len(key):
        return np.full(len(want), -1)
    row = np.minimum(np.searchsorted(key, want), len(key) - 1)
    return np.where(key[row] == want, row, -1)


def global_index(grid: MacGrid, axis: int | None, flat: np.ndarray) -> np.ndarray:
    """Return the natural global index of local faces of an axis (cells: None), given by their flat local index."""
    index = np.unravel_index(flat, grid.shape(axis))
    place = []
    for b, i in enumerate(index):
        i = i + grid.lo[b] - grid.ghost[b]
        place.append(i % grid.cells[b] if grid.periodic[b] else i)
    return np.ravel_multi_index(place, _whole(grid, axis)).astype(np.int64)


def _whole(grid: MacGrid, axis: int | None) -> tuple[int, ...]:
    return tuple(n + (b == axis) for b, n in enumerate(grid.cells))


def cells_beside(grid: MacGrid, table: Parts, below: bool) -> np.ndarray:
    """Return the natural indices of the cells below or above the links' faces; -1 beyond a side."""
    cell = np.full(len(table), -1, dtype=np.int64)
    for a in range(grid.dim):
        mine = np.flatnonzero(table.axis == a)
        place = list(np.unravel_index(table.face[mine], [n + (b == a) for b, n in enumerate(grid.cells)]))
        place[a] = place[a] - below
        if grid.periodic[a]:
            place[a] = place[a] % grid.cells[a]
        inside = (place[a] >= 0) & (place[a] < grid.cells[a])
        cell[mine[inside]] = np.ravel_multi_index([i[inside] for i in place], grid.cells)
    return cell


def local_images(grid: MacGrid, axis: int | None, natural: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the local entries, ghosts and periodic images included, of faces of an axis (cells: None).

    Parameters
    ----------
    natural : ndarray of int64, shape (n,)
        Natural global indices.

    Returns
    -------
    flat, which : ndarray of int64, shape (m,)
        Flat local indices, and which of the given ones they are.
    """
    index = np.array(np.unravel_index(natural, _whole(grid, axis))).reshape(3, -1)
    shape = grid.shape(axis)
    found, which = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    turns = [
        range(-(g // n) - 1, g // n + 2) if p else (0,)
        for p, g, n in zip(grid.periodic, grid.ghost, grid.cells, strict=True)
    ]
    for turn in product(*turns):
        place = [i + t * n - m + g for i, t, n, m, g in zip(index, turn, grid.cells, grid.lo, grid.ghost, strict=True)]
        here = np.flatnonzero(np.all([(i >= 0) & (i < s) for i, s in zip(place, shape, strict=True)], axis=0))
        found.append(np.ravel_multi_index([i[here] for i in place], shape).astype(np.int64))
        which.append(here)
    return np.concatenate(found), np.concatenate(which)


def owned(grid: MacGrid, axis: int | None, flat: np.ndarray) -> np.ndarray:
    """Return which local faces of an axis (cells: None) are this rank's own."""
    index = np.unravel_index(flat, grid.shape(axis))
    pairs = zip(index, grid.owned(axis), strict=True)
    return np.all([(i >= s.start) & (i < s.stop) for i, s in pairs], axis=0)
