"""A smoother for pressures, also beside walls that give way easily: ``mg_levels_pc_type python``.

Jacobi, with a diagonal that bounds the operator,

    D_i = max(a_ii, sum_j |a_ij| / 2)    of the fluxes L, plus the same of the walls E (see ``schur``),

so that no eigenvalue of D^-1 (L + E) exceeds 2, whatever the geometry, and Chebyshev's bounds need no estimate.
Where walls are light, E is much larger than L, and singular: pressures that push on no node feel L alone. A diagonal
then smooths nothing. There the rows that walls touch are solved together, the others by their diagonal:

    M = [ (L + E)_ww      0      ]        w: unknowns with walls.
        [      0      diag(L)_oo ]

No eigenvalue of M^-1 (L + E) exceeds 2 either. Those of what E alone resists are all 1: damped to a root of
Chebyshev's polynomial, they are not reduced but gone, which a coarse grid that knows little of E needs.
Where E is no matrix (see ``resisted``), the block has unknowns of its own, and is solved in any case.

    -..._mg_levels_walls_from 10      largest E_ii / L_ii from which on the block is solved; 0 is always
    -..._mg_levels_walls_damping .634 of the block; the lower root for two iterations between 0.4 and 2
    -..._mg_levels_walls_pc_type      how; redundant Cholesky unless told otherwise
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numba import njit
from petsc4py import PETSc

from petfsi.petsc import factorised
from petfsi.solving.resisted import Resisted

#: Largest E_ii / L_ii up to which the diagonal is good enough.
DOMINANT = 10.0
#: The lower root of Chebyshev's polynomial of degree 2 on [0.4, 2].
DAMPING = 1.2 - 0.8 * np.sqrt(0.5)


class Walls:
    """Jacobi, with the rows that walls touch solved together where walls dominate.

    Attributes
    ----------
    parts : (PETSc.Mat or None, PETSc.Mat or None)
        L and E of the operator; set before ``setUp``. Without them the operator is L.
    resisted : Resisted or None
        What the operator is where E is not a matrix; set before ``setUp``, too.
    """

    def __init__(self) -> None:
        self.parts: tuple[PETSc.Mat | None, PETSc.Mat | None] = None, None
        self.resisted: Resisted | None = None
        self._inverse: PETSc.Vec | None = None
        self._ksp: PETSc.KSP | None = None

    def setUp(self, pc: PETSc.PC) -> None:  # noqa: N802 - PETSc's name
        """Take up the operator's present values. Collective."""
        self._prefix = f"{pc.getOptionsPrefix()}walls_"
        own = PETSc.Options(self._prefix)
        self._dominant, self._damping = own.getReal("from", DOMINANT), own.getReal("damping", DAMPING)
        self._drop()
        fluxes, walls = self.parts
        diagonal = _bound(fluxes if fluxes is not None else pc.getOperators()[1])
        if walls is not None:
            if fluxes is not None and (self.resisted is not None or self._dominates(fluxes, walls)):
                self._solve_together(fluxes, walls)
            else:
                diagonal.axpy(1.0, _bound(walls))
        diagonal.reciprocal()
        self._inverse = diagonal

    def _dominates(self, fluxes: PETSc.Mat, walls: PETSc.Mat) -> bool:
        here = float((walls.getDiagonal().array / fluxes.getDiagonal().array).max(initial=0.0))
        return fluxes.comm.tompi4py().allreduce(here, MPI.MAX) > self._dominant

    def _solve_together(self, fluxes: PETSc.Mat, walls: PETSc.Mat) -> None:
        self._rows = np.flatnonzero(walls.getDiagonal().array)
        numbers = walls.getOwnershipRange()[0] + self._rows
        chosen = PETSc.IS().createGeneral(numbers.astype(PETSc.IntType), comm=walls.comm)
        if self.resisted is not None:
            block = self.resisted.block(chosen)
        else:
            block = fluxes.createSubMatrix(chosen, chosen)
            block.axpy(1.0, walls.createSubMatrix(chosen, chosen), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        self._ksp, (self._x, self._b) = factorised(block, self._prefix), block.createVecs()

    def _drop(self) -> None:
        for thing in (self._ksp, self._inverse):
            if thing is not None:
                thing.destroy()
        self._ksp = None

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write M^-1 x into y. Collective."""
        y.pointwiseMult(x, self._inverse)
        if self._ksp is not None:
            n = len(self._rows)
            self._b.array[:n] = x.array_r[self._rows]  # beyond, if anything, lies 0
            self._ksp.solve(self._b, self._x)
            y.array[self._rows] = self._damping * self._x.array_r[:n]


def _bound(mat: PETSc.Mat) -> PETSc.Vec:
    """Return max(a_ii, sum_j |a_ij| / 2) by row. Collective."""
    diagonal = mat.getDiagonal()
    indptr, _, values = mat.getValuesCSR()
    sums = np.empty(len(indptr) - 1)
    _absolute_sums(indptr, values, sums)
    diagonal.array = np.maximum(diagonal.array_r, 0.5 * sums)
    return diagonal


@njit(cache=True)
def _absolute_sums(indptr, values, out):
    """Write the sum of the magnitudes of each row of a matrix in compressed rows."""
    for row in range(len(out)):
        total = 0.0
        for n in range(indptr[row], indptr[row + 1]):
            total += abs(values[n])
        out[row] = total
