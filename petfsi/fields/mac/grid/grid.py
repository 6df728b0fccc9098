"""A regular staggered grid, distributed over ranks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.fields.mac.grid.halo import Halo, ranks_per_axis
from petfsi.fields.slabs import Reader, Slab
from petfsi.petsc import IntType, Layout

#: Ghost layers: a departure point up to four cells away, half a cell of staggering, and its interpolation.
GHOST = 5


def three(arrays: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an array per axis for a kernel: in 2D the first stands in for the third, which is not read there."""
    return arrays[0], arrays[1], arrays[2 if len(arrays) == 3 else 0]


class MacGrid:
    """Cells and faces of a box, with the part of them that this rank owns and the ghosts around it.

    Local arrays always have three axes ``[i, j, k]``; in 2D the last one has one cell and no ghosts. The local
    index of a cell is ``global - lo + ghost``; the local index of a face along its axis is that of the cell above.

    Attributes
    ----------
    dim : int
    origin, size, dx : ndarray, shape (dim,)
        Lower corner, lengths and cell sizes, m.
    cells : tuple of int, shape (3,)
        Cells of the whole grid (1 on the third axis in 2D).
    periodic : tuple of bool, shape (3,)
    lo, hi : tuple of int, shape (3,)
        The cells ``lo[a] <= i < hi[a]`` are this rank's.
    ghost : tuple of int, shape (3,)
    dm : PETSc.DMDA
        One unknown per cell.
    layout : Layout
        Of a vector with one entry per cell, in the DMDA's numbering.
    index : ndarray of int32
        Cell array of these numbers, ghosts included; -1 outside the domain.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        origin: Sequence[float],
        size: Sequence[float],
        cells: Sequence[int],
        periodic: Sequence[bool],
    ):
        self.comm = comm
        self.dim = dim = len(cells)
        self.origin, self.size = np.array(origin, dtype=float), np.array(size, dtype=float)
        self.dx = self.size / np.array(cells)
        self.cells = tuple(int(n) for n in cells) + (1,) * (3 - dim)
        self.periodic = tuple(bool(p) for p in periodic) + (False,) * (3 - dim)
        self.ghost = (GHOST,) * dim + (0,) * (3 - dim)
        # a rank's neighbour must own the face one past its ghosts, too
        shares = ranks_per_axis(self.cells[:dim], comm.size, GHOST + 1)
        self.dm = PETSc.DMDA().create(
            dim=dim,
            dof=1,
            sizes=self.cells[:dim],
            proc_sizes=shares,
            boundary_type=["periodic" if p else "none" for p in self.periodic[:dim]],
            stencil_type=PETSc.DMDA.StencilType.BOX,
            stencil_width=1,
            comm=comm,
        )
        ranges = self.dm.getRanges()
        self.lo = tuple(int(r[0]) for r in ranges) + (0,) * (3 - dim)
        self.hi = tuple(int(r[1]) for r in ranges) + (1,) * (3 - dim)
        self.owned_shape = tuple(h - m for h, m in zip(self.hi, self.lo, strict=True))
        self.layout = Layout.of(comm, math.prod(self.owned_shape))
        self.halo = Halo(comm, self.lo, self.hi, self.cells, self.ghost, self.periodic, self._neighbours(shares))
        self.index = np.full(self.shape(None), -1, dtype=IntType)
        self.from_vec(self.layout.start + np.arange(self.layout.n_local, dtype=IntType), self.index)
        self.exchange_cells(self.index)

    def _neighbours(self, shares: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
        """Return the ranks below and above per axis; ranks count along the first axis first, as in a DMDA."""
        shares = shares + (1,) * (3 - self.dim)
        place = np.unravel_index(self.comm.rank, shares, order="F")
        neighbours = []
        for axis in range(3):
            pair = []
            for step in (-1, 1):
                there = [int(p) for p in place]
                there[axis] += step
                if self.periodic[axis] or shares[axis] == 1:
                    there[axis] %= shares[axis]
                outside = not 0 <= there[axis] < shares[axis]
                pair.append(MPI.PROC_NULL if outside else int(np.ravel_multi_index(there, shares, order="F")))
            neighbours.append((pair[0], pair[1]))
        return tuple(neighbours)

    # ---- sizes ------------------------------------------------------------------------------------------------

    @property
    def cell_volume(self) -> float:
        """Volume of a cell, m^3 (in 2D m^3 per metre of thickness)."""
        return float(np.prod(self.dx))

    def face_area(self, axis: int) -> float:
        """Return the area of a face normal to ``axis``, m^2 (in 2D m^2 per metre of thickness)."""
        return self.cell_volume / float(self.dx[axis])

    def shape(self, axis: int | None) -> tuple[int, ...]:
        """Return the shape of a local array of faces of ``axis``, or of cells if that is None."""
        return tuple(self.owned_shape[b] + 2 * self.ghost[b] + (b == axis) for b in range(3))

    def zeros_cells(self, dtype: type = float) -> np.ndarray:
        """Return a local array with an entry per cell."""
        return np.zeros(self.shape(None), dtype=dtype)

    def zeros_faces(self, axis: int, dtype: type = float) -> np.ndarray:
        """Return a local array with an entry per face normal to ``axis``."""
        return np.zeros(self.shape(axis), dtype=dtype)

    # ---- parts of local arrays --------------------------------------------------------------------------------

    def owned(self, axis: int | None) -> tuple[slice, slice, slice]:
        """Return this rank's own part of an array of faces of ``axis`` (cells: None).

        Of the two ends of a rank's range the lower faces are its own, and the upper ones only at the domain's end.
        """
        parts = []
        for b in range(3):
            last = b == axis and self.hi[b] == self.cells[b] and not self.periodic[b]
            parts.append(slice(self.ghost[b], self.ghost[b] + self.owned_shape[b] + last))
        return tuple(parts)  # type: ignore[return-value]

    def owned_ranges(self, axis: int | None) -> tuple[tuple[int, int], ...]:
        """Return what ``owned`` does as begin and end along each axis, which kernels take."""
        return tuple((part.start, part.stop) for part in self.owned(axis))

    def inside(self, axis: int | None) -> tuple[slice, slice, slice]:
        """Return the part of a local array, ghosts included, that lies in the domain."""
        return tuple(self.halo.inside(b, axis) for b in range(3))  # type: ignore[return-value]

    def cell_centres(self, axis: int) -> np.ndarray:
        """Return the coordinates along ``axis`` of the local cells' centres, ghosts included, m."""
        i = np.arange(self.shape(None)[axis]) + self.lo[axis] - self.ghost[axis]
        return self._coordinate(axis, i + 0.5)

    def face_coords(self, axis: int) -> np.ndarray:
        """Return the coordinates along ``axis`` of the local faces normal to it, ghosts included, m."""
        i = np.arange(self.shape(axis)[axis]) + self.lo[axis] - self.ghost[axis]
        return self._coordinate(axis, i.astype(float))

    def _coordinate(self, axis: int, i: np.ndarray) -> np.ndarray:
        if axis >= self.dim:
            return np.zeros(len(i))
        return self.origin[axis] + i * self.dx[axis]

    def lines(self, axis: int | None) -> list[np.ndarray]:
        """Return the coordinates along x, y, z (z = 0 in 2D) of the local faces of ``axis`` (cells: None), m."""
        return [self.face_coords(b) if b == axis else self.cell_centres(b) for b in range(3)]

    def coordinates(self, axis: int | None) -> list[np.ndarray]:
        """Return x, y, z (as open grids, z = 0 in 2D) of the local faces of ``axis`` (cells: None)."""
        return list(np.meshgrid(*self.lines(axis), indexing="ij", sparse=True))

    # ---- exchange ---------------------------------------------------------------------------------------------

    def exchange_cells(self, array: np.ndarray, width: int | None = None) -> None:
        """Fill the ghosts of a cell array in place (only ``width`` layers of them). Collective."""
        self.halo.exchange(array, None, width)

    def exchange_faces(self, axis: int, array: np.ndarray, width: int | None = None) -> None:
        """Fill the ghosts of a face array in place (only ``width`` layers of them). Collective."""
        self.halo.exchange(array, axis, width)

    def fill_sides(self, array: np.ndarray, axis: int | None) -> None:
        """Copy the outermost entries inside the domain to the ghosts beyond its sides that are not periodic."""
        for b, part in enumerate(self.inside(axis)):
            view = np.moveaxis(array, b, 0)
            view[: part.start] = view[part.start]
            view[part.stop :] = view[part.stop - 1]

    # ---- vectors and slabs ------------------------------------------------------------------------------------

    def to_vec(self, array: np.ndarray) -> np.ndarray:
        """Return the owned cells of a cell array as a flat vector in the DMDA's order."""
        return array[self.owned(None)].ravel(order="F")

    def from_vec(self, vec: np.ndarray, array: np.ndarray) -> None:
        """Write a flat vector in the DMDA's order into the owned cells of a cell array."""
        array[self.owned(None)] = vec.reshape(self.owned_shape, order="F")

    def slab(self, array: np.ndarray, axis: int | None) -> Slab:
        """Return this rank's piece of a global array of faces of ``axis`` (cells: None), without ghosts."""
        data = array[self.owned(axis)]
        shape, start = self._global_shape(axis), self.lo[: self.dim]
        return Slab(data.reshape(data.shape[: self.dim]).copy(), start, shape)

    def read_slab(self, read: Reader, name: str, array: np.ndarray, axis: int | None) -> None:
        """Fill the owned part of a local array from a stored global one."""
        part = array[self.owned(axis)]
        part[...] = read(name, self.lo[: self.dim], part.shape[: self.dim]).reshape(part.shape)

    def _global_shape(self, axis: int | None) -> tuple[int, ...]:
        return tuple(self.cells[b] + (b == axis and not self.periodic[b]) for b in range(self.dim))
