"""Geometric multigrid for the pressure: what carries vectors between grids, and the operators of coarse grids.

Cells are merged by twos along the axes of the shortest spacing: along all where cells are about as long as wide, else
first along those that couple them most, until they are. The point smoother then does at any ratio. With Q the piecewise
constant and P the (bi-, tri-) linear interpolation between cell centres, level by level,

    corrections   x += P x_c             with P handed to PCMG,
    fluxes        L_c = Q^T L Q / 2      open parts of faces are averaged, the distance between centres doubles,
    walls         E_c = Q^T E Q          what moving walls let through (see ``schur``) adds up.

Coarse operators keep the 5 or 7 points of L, so they cost next to nothing to make and to apply, and the cycle is
symmetric and positive whatever the geometry. Where only some axes are halved, L_c and E_c are P^T . P.

Where cells are merged along their short side only, walls are soon too thin for the grid, and what they part, column by
column, is as good as unconnected otherwise. If there are walls in a stretched grid, the second level is therefore the
first one again, with L + E as its operator, and solved by a cycle of algebraic multigrid (see ``preconditioners``).

References
----------
W. A. Mulder, A new multigrid approach to convection problems, Journal of Computational Physics 83 (1989): merging
along some axes.
M. Mohr and R. Wienands, Cell-centred multigrid revisited, Computing and Visualization in Science 7 (2004).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc
from petfsi.errors import InputError
from petfsi.petsc import IntType, Layout
from petfsi.solving.preconditioners import LastLevel
from petfsi.solving.resisted import Resisted
from petfsi.solving.smoothers import Walls

if TYPE_CHECKING:
    from petfsi.fields.mac.fluid import MacFluid

#: Grids are coarsened while they have more cells than this along an axis.
COARSEST = 4
#: An axis is halved while its spacing is below this times the shortest one: then they come as near as they can.
SIMILAR = 2.0**0.5
#: Ratio of spacings from which on walls want algebraic multigrid.
STRETCHED = 4.0


@dataclass(frozen=True)
class Lattice:
    """The cells of one level on all ranks: a box of ranks, each with a box of cells; numbers run x first.

    Attributes
    ----------
    bounds : list of ndarray
        Per axis the first cell of each rank along it, and the number of cells.
    periodic : tuple of bool
    spacing : tuple of float
        Distance of neighbours per axis, in any unit.
    """

    bounds: list[np.ndarray]
    periodic: tuple[bool, ...]
    spacing: tuple[float, ...]

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells per axis."""
        return tuple(int(b[-1]) for b in self.bounds)

    @property
    def merged(self) -> tuple[bool, ...]:
        """Whether the next level has half as many cells, per axis."""
        sides = list(zip(self.spacing, self.cells, strict=True))
        shortest = min((h for h, n in sides if n > 1), default=0.0)
        return tuple(n > 1 and h < SIMILAR * shortest for h, n in sides)

    def halved(self) -> Lattice:
        """Return the next level; a rank keeps the coarse cells whose first cell is its own."""
        halves = self.merged
        return Lattice(
            [(b + 1) // 2 if half else b for b, half in zip(self.bounds, halves, strict=True)],
            self.periodic,
            tuple(2 * h if half else h for h, half in zip(self.spacing, halves, strict=True)),
        )

    def sizes(self) -> np.ndarray:
        """Return the number of cells of each rank, ranks along the first axis first."""
        count = np.ones(1, dtype=np.int64)
        for b in self.bounds:
            count = (np.diff(b)[:, None] * count[None, :]).ravel()
        return count

    def layout(self, rank: int) -> Layout:
        """Return how a vector of the level lies on the ranks."""
        ends = np.cumsum(self.sizes())
        return Layout(int(self.sizes()[rank]), int(ends[rank] - self.sizes()[rank]), int(ends[-1]))

    def owned(self, rank: int) -> list[np.ndarray]:
        """Return the cells of a rank per axis."""
        place = np.unravel_index(rank, [len(b) - 1 for b in self.bounds], order="F")
        return [np.arange(b[p], b[p + 1]) for b, p in zip(self.bounds, place, strict=True)]

    def numbers(self, index: list[np.ndarray]) -> np.ndarray:
        """Return the unknowns of all cells of the product of the given cells per axis, flat, x first."""
        starts = np.cumsum(self.sizes()) - self.sizes()
        rank, local = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
        step, ranks = np.ones(1, dtype=np.int64), 1
        for i, b in zip(index, self.bounds, strict=True):
            owner = np.searchsorted(b, i, side="right") - 1
            rank = (owner[:, None] * ranks + rank[None, :]).ravel()
            local = ((i - b[owner])[:, None] * step[None, :] + local[None, :]).ravel()
            step = (np.diff(b)[owner][:, None] * step[None, :]).ravel()
            ranks *= len(b) - 1
        return starts[rank] + local


def line_weights(n: int, periodic: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each of n cells in a row its coarse cell, the next nearest one, and that one's weight.

    Beyond a side that is not periodic values go on as they are.
    """
    cell = np.arange(n)
    parent, n_coarse = cell // 2, (n + 1) // 2
    begin = 2 * np.arange(n_coarse)
    centre = (begin + np.minimum(begin + 2, n)) / 2
    away = cell + 0.5 - centre[parent]
    other = parent + np.sign(away).astype(int)
    if periodic:
        distance = np.abs(centre[other % n_coarse] + n * (other // n_coarse) - centre[parent])
        other %= n_coarse
    else:
        other = np.clip(other, 0, n_coarse - 1)
        distance = np.abs(centre[other] - centre[parent])
    weight = np.divide(np.abs(away), distance, out=np.zeros(n), where=distance > 0)
    return parent, other, weight


@dataclass(frozen=True)
class Transfer:
    """The two interpolations from a level to the next finer one, and whether every axis was halved."""

    linear: PETSc.Mat
    constant: PETSc.Mat
    regular: bool


def _pairs(fine: Lattice, owned: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return ``line_weights`` of a rank's cells per axis; an axis that stays carries over as it is."""
    lines = []
    for n, i, periodic, merged in zip(fine.cells, owned, fine.periodic, fine.merged, strict=True):
        lines.append(tuple(w[i] for w in line_weights(n, periodic)) if merged else (i, i, np.zeros(len(i))))
    return lines


class Hierarchy:
    """The interpolations between all levels of a fluid's grid, made once per run and layout of its unknowns.

    Attributes
    ----------
    transfers : list of Transfer
        From the finest level on; at least one.
    walled : bool
        Whether the cells are long and there are walls among them.
    """

    def __init__(self, fluid: MacFluid) -> None:
        grid, self.comm = fluid.grid, fluid.grid.comm
        bounds = []
        for axis in range(grid.dim):
            lows = sorted(set(self.comm.allgather(grid.lo[axis])))
            bounds.append(np.array([*lows, grid.cells[axis]]))
        self._lattice = Lattice(bounds, grid.periodic[: grid.dim], tuple(grid.dx))
        self.walled = bool(fluid.scene.obstacles or fluid.scene.solids) and max(grid.dx) >= STRETCHED * min(grid.dx)
        self.transfers: list[Transfer] = []
        self._layout: Layout | None = None
        self._extra_cells = np.zeros(0, dtype=np.int64)
        level, fine = self._lattice, self._lattice.layout(self.comm.rank)
        while not self.transfers or max(level.cells) > COARSEST:
            self.transfers.append(self._transfer(level, fine, np.zeros(0, dtype=np.int64)))
            level = level.halved()
            fine = level.layout(self.comm.rank)
        self.follow(fluid)

    def follow(self, fluid: MacFluid) -> None:
        """Give extra unknowns behind the grid's the values of their cells' coarse cells. Collective."""
        grid = fluid.grid
        cells = np.zeros(0, dtype=np.int64)
        if fluid.extras is not None:
            place = np.unravel_index(fluid.extras.cell, grid.shape(None))
            inner = [p - g for p, g in zip(place, grid.ghost, strict=True)]
            cells = np.ravel_multi_index(inner[: grid.dim], grid.owned_shape[: grid.dim], order="F")
        same = self._layout == fluid.layout and np.array_equal(cells, self._extra_cells)
        if not self.comm.allreduce(not same) and self._layout is not None:
            return
        if self._layout is not None or fluid.extras is not None:
            self.transfers[0] = self._transfer(self._lattice, fluid.layout, cells)
        self._layout, self._extra_cells = fluid.layout, cells

    @cached_property
    def _finest(self) -> tuple[_Rows, _Rows]:
        return _interpolations(self._lattice, self._lattice.halved(), self.comm.rank)

    def _transfer(self, fine: Lattice, rows: Layout, extras: np.ndarray) -> Transfer:
        """Return the interpolations to a level's cells and, behind them, to extra unknowns in some of those."""
        coarse, rank = fine.halved(), self.comm.rank
        linear, constant = self._finest if fine is self._lattice else _interpolations(fine, coarse, rank)
        columns, parents = coarse.layout(rank), constant.indices[extras]
        return Transfer(
            linear.matrix(self.comm, rows, columns, parents),
            constant.matrix(self.comm, rows, columns, parents),
            regular=all(fine.merged),
        )


@dataclass(frozen=True)
class _Rows:
    """A rank's rows of an interpolation, in compressed form; they stay while what is behind them changes."""

    indptr: np.ndarray
    indices: np.ndarray
    values: np.ndarray

    @classmethod
    def weighted(cls, number: np.ndarray, weight: np.ndarray) -> _Rows:
        """Return rows with a few weights each, equal columns of a row added up."""
        order = np.argsort(number, axis=1, kind="stable")
        number, weight = np.take_along_axis(number, order, 1), np.take_along_axis(weight, order, 1)
        for k in range(number.shape[1] - 1, 0, -1):
            twice = number[:, k] == number[:, k - 1]
            weight[twice, k - 1] += weight[twice, k]
            weight[twice, k] = 0.0
        keep = weight > 0
        indptr = np.concatenate(([0], np.cumsum(keep.sum(axis=1)))).astype(IntType)
        return cls(indptr, number[keep].astype(IntType), weight[keep])

    def matrix(self, comm: MPI.Comm, rows: Layout, columns: Layout, extras: np.ndarray) -> PETSc.Mat:
        """Return them as a matrix, and behind them rows that hold a single one each, in the given columns."""
        ends = self.indptr[-1] + np.arange(1, len(extras) + 1)
        indptr = np.concatenate((self.indptr, ends)).astype(IntType)
        indices = np.concatenate((self.indices, extras)).astype(IntType)
        values = np.concatenate((self.values, np.ones(len(extras))))
        return PETSc.Mat().createAIJ((rows.sizes, columns.sizes), csr=(indptr, indices, values), comm=comm)


def _interpolations(fine: Lattice, coarse: Lattice, rank: int) -> tuple[_Rows, _Rows]:
    """Return the linear and the constant interpolation to a rank's cells of a level from the next coarser one."""
    lines = _pairs(fine, fine.owned(rank))
    near = coarse.numbers([parent for parent, _, _ in lines])
    corners, weights = [], []
    for corner in np.ndindex(*(2,) * len(lines)):
        index = [line[bit] for line, bit in zip(lines, corner, strict=True)]
        weight = np.ones(1)
        for line, bit in zip(lines, corner, strict=True):
            weight = ((line[2] if bit else 1 - line[2])[:, None] * weight[None, :]).ravel()
        corners.append(coarse.numbers(index))
        weights.append(weight)
    linear = _Rows.weighted(np.stack(corners, axis=1), np.stack(weights, axis=1))
    return linear, _Rows.weighted(near[:, None], np.ones((len(near), 1)))


class Multigrid:
    """Hands a PCMG its interpolations and, unless it makes them itself, the operators of its coarse levels.

    Parameters
    ----------
    pc : PETSc.PC
        Of type mg, after ``setFromOptions`` and before ``setUp``.
    hierarchy : Hierarchy
    fine : PETSc.Mat
        The operator of the finest level, L + E; the same object for the life of the PC.
    """

    def __init__(self, pc: PETSc.PC, hierarchy: Hierarchy, fine: PETSc.Mat) -> None:
        options = PETSc.Options(pc.getOptionsPrefix())
        available = len(hierarchy.transfers) + 1
        levels = options.getInt("pc_mg_levels", available)
        if not 2 <= levels <= available:
            name = f"-{pc.getOptionsPrefix()}pc_mg_levels"
            raise InputError(f"option {name} {levels}: must be from 2 to {available} for this grid")
        self.transfers = hierarchy.transfers[: levels - 1]
        self._last = LastLevel(pc)
        if hierarchy.walled and self._last.be_algebraic():
            self.transfers, levels = [_unchanged(fine)], 2
        self._galerkin = options.getString("pc_mg_galerkin", "none") != "none"
        self._fluxes: list[PETSc.Mat] = []
        self._pattern_version = 0
        self._operators: list[PETSc.Mat] = []
        self._read = False
        self._pc, self._fine = pc, fine
        pc.setMGLevels(levels)
        for n, transfer in enumerate(self.transfers):
            pc.setMGInterpolation(levels - 1 - n, transfer.linear)
            rows, columns = transfer.linear.getSize()
            if rows == columns:  # PETSc cannot tell which grid is the coarser one
                scale = transfer.linear.createVecRight()
                scale.set(1.0)
                pc.setMGRScale(levels - 1 - n, scale)

    def refresh(
        self,
        block: PETSc.Mat,
        fluxes: PETSc.Mat,
        walls: PETSc.Mat | None,
        resisted: Resisted | None,
        pattern_version: int,
    ) -> None:
        """Make the coarse operators, in place if the pattern of L is that of the last call. Collective.

        Parameters
        ----------
        block : PETSc.Mat
            L and what slivers of fluid at walls add to it, which coarse grids do not see.
        fluxes : PETSc.Mat
            L; may be the same.
        walls : PETSc.Mat or None
            E.
        resisted : Resisted or None
            L + E of the finest level where it is no matrix.
        pattern_version : int
            Of L's pattern.
        """
        if not self._read:
            self._last.read(fluxes, self.transfers[-1].linear.getSize()[1])
        if pattern_version != self._pattern_version:
            self._fluxes, self._pattern_version = [], pattern_version
        if self._galerkin:
            for level in range(1, len(self.transfers) + 1):  # of the coarse ones nobody knows the parts
                self._tell(level, (block, walls) if level == len(self.transfers) else (None, None))
            self._read = True
            return
        first = not self._fluxes
        levels = len(self.transfers) + 1
        finest = block if walls is None else self._fine if resisted is None else resisted.operator()
        operators, parts = [], [(block, walls)]
        for n, transfer in enumerate(self.transfers):
            carry = transfer.constant if transfer.regular else transfer.linear
            fluxes = _carried(fluxes, carry, None if first else self._fluxes[n])
            if transfer.regular:
                fluxes.scale(0.5)
            if first:
                self._fluxes.append(fluxes)
            operator = fluxes
            if walls is not None:
                walls = _carried(walls, carry, None)
                operator = fluxes.copy()
                operator.axpy(1.0, walls, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
            operators.append(operator)
            parts.append((fluxes, walls))
        for n, operator in enumerate([finest, *operators]):
            level = levels - 1 - n
            solver = self._pc.getMGSmoother(level) if level else self._pc.getMGCoarseSolve()
            solver.setOperators(operator, operator)
            if level:
                petsc.set_mg_residual(self._pc, level, operator)
        for n, part in enumerate(parts[: levels - 1]):
            self._tell(levels - 1 - n, part, None if n else resisted)
        self._operators, self._read = operators, True

    def can_resist(self) -> bool:
        """Return whether the finest level does with an operator that is no matrix. Collective."""
        if self._galerkin:
            return False
        solver = self._pc.getMGSmoother(len(self.transfers))
        if not self._read:
            solver.setFromOptions()
        return solver.getPC().getType() == PETSc.PC.Type.PYTHON

    def _tell(
        self, level: int, parts: tuple[PETSc.Mat | None, PETSc.Mat | None], resisted: Resisted | None = None
    ) -> None:
        """Give the smoother of a level the two parts of its operator, if it cares."""
        solver = self._pc.getMGSmoother(level)
        if not self._read:
            solver.setFromOptions()
        pc = solver.getPC()
        if pc.getType() == PETSc.PC.Type.PYTHON:
            # not by the option pc_python_type: such a context outlives Python and crashes PETSc's end
            if pc.getPythonContext() is None:
                pc.setPythonContext(Walls())
            pc.getPythonContext().parts, pc.getPythonContext().resisted = parts, resisted


def _unchanged(fine: PETSc.Mat) -> Transfer:
    """Return the transfer between a level and itself. Collective."""
    first, last = fine.getOwnershipRange()
    n = np.arange(last - first + 1, dtype=IntType)
    one = PETSc.Mat().createAIJ(fine.getSizes(), csr=(n, first + n[:-1], np.ones(last - first)), comm=fine.comm)
    return Transfer(one, one, regular=False)


def _carried(fine: PETSc.Mat, transfer: PETSc.Mat, result: PETSc.Mat | None) -> PETSc.Mat:
    """Return transfer^T fine transfer, in place of ``result`` if that is given."""
    return fine.ptap(transfer) if result is None else fine.ptap(transfer, result)
