"""A sparse stand-in for the pressure's Schur complement S = L + D1 H A^-1 J.

With X thrice the inverse of A's diagonal, Sp = L + E and E = J^T X J differ from L only in rows of cells that moving
walls touch. X keeps what matters near the walls: a mass alone would be wrong for stiff solids, nothing at all for
light ones. The factor was found by trial: A^-1 is X / 3 for motions of single nodes, and far more for smooth ones.
Where E is small beside L, as for most solids, it is left out and costs nothing. What X lacks are the
large motions of light bodies; see ``modes``.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numba import njit
from petsc4py import PETSc

from petfsi.petsc import IntType, Layout, new_block, set_csr
from petfsi.system import System

#: X times the diagonal of A.
SOFTER = 3.0
#: Largest E_ii / L_ii up to which E is left out.
FAINT = 0.03


class SchurStandIn:
    """Sp of a system of one solid and one fluid, refreshed on demand.

    Parameters
    ----------
    system : System
    faint : float
        Largest E_ii / L_ii up to which E is left out.

    Attributes
    ----------
    operator : PETSc.Mat
        Sp; the same object for the whole life.
    walls : PETSc.Mat
        E; the same object, too. Empty where it is left out.
    matter : bool
        Whether E is there.
    """

    def __init__(self, system: System, faint: float) -> None:
        solid, fluid = system.fields
        layout: Layout = fluid.layout
        self.solid_block, self.fluxes = solid.block, fluid.block
        self.force_block = system.operator.getNestSubMatrix(0, 1)
        self._comm = system.comm
        self._pattern: tuple[np.ndarray, np.ndarray] | None = None
        self._walls_pattern: tuple[np.ndarray, np.ndarray] | None = None
        self.walls = new_block(system.comm, layout, layout)
        self._faint, self.matter = faint, True
        self.operator = new_block(system.comm, layout, layout)
        self.refresh()

    def refresh(self) -> None:
        """Compute E and Sp from the present blocks. Collective."""
        self._fill_walls()
        self._fill_operator()

    def _fill_walls(self) -> None:
        inverse = self.solid_block.getDiagonal()
        inverse.reciprocal()
        inverse.scale(SOFTER)
        self.matter = self._strength(inverse) > self._faint
        if self.matter:
            yielding = self.force_block.copy()
            yielding.diagonalScale(L=inverse)
            # J^T X J, positive also where the transfer is not symmetric and D1 H is not J^T
            walls = self.force_block.transposeMatMult(yielding)
            rows = walls.getValuesCSR()
            yielding.destroy()
            walls.destroy()
        else:
            rows = np.zeros(self.walls.getLocalSize()[0] + 1, dtype=IntType), np.zeros(0, dtype=IntType), np.zeros(0)
        self._walls_pattern = self._set(self.walls, rows, self._walls_pattern)
        inverse.destroy()

    def _strength(self, inverse: PETSc.Vec) -> float:
        """Return the largest E_ii / L_ii. Collective."""
        squares = self.force_block.copy()
        indptr, indices, values = squares.getValuesCSR()
        set_csr(squares, indptr, indices, values**2, new_pattern=False)
        diagonal, resistance = squares.createVecRight(), self.fluxes.getDiagonal()
        squares.multTranspose(inverse, diagonal)
        strongest = float((diagonal.array_r / resistance.array_r).max(initial=0.0))
        for thing in (squares, diagonal, resistance):
            thing.destroy()
        return self._comm.allreduce(strongest, MPI.MAX)

    def _fill_operator(self) -> None:
        rows = _sum(*self.fluxes.getValuesCSR(), *self.walls.getValuesCSR())
        self._pattern = self._set(self.operator, rows, self._pattern)

    def _set(
        self,
        mat: PETSc.Mat,
        rows: tuple[np.ndarray, np.ndarray, np.ndarray],
        known: tuple[np.ndarray, np.ndarray] | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        indptr, indices, values = rows
        new = known is None or not (np.array_equal(indptr, known[0]) and np.array_equal(indices, known[1]))
        set_csr(mat, indptr, indices, values, new_pattern=self._comm.allreduce(new) > 0)
        return indptr, indices


def _sum(
    ptr_a: np.ndarray, col_a: np.ndarray, val_a: np.ndarray, ptr_b: np.ndarray, col_b: np.ndarray, val_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sum of two matrices in compressed rows with sorted columns."""
    most = len(col_a) + len(col_b)
    indptr, indices = np.zeros(len(ptr_a), dtype=IntType), np.empty(most, dtype=IntType)
    values = np.empty(most)
    n = _merge(ptr_a, col_a, val_a, ptr_b, col_b, val_b, indptr, indices, values)
    return indptr, indices[:n], values[:n]


@njit(cache=True)
def _merge(ptr_a, col_a, val_a, ptr_b, col_b, val_b, indptr, indices, values):
    n = 0
    for row in range(len(ptr_a) - 1):
        a, b = ptr_a[row], ptr_b[row]
        while a < ptr_a[row + 1] or b < ptr_b[row + 1]:
            from_a = a < ptr_a[row + 1] and (b == ptr_b[row + 1] or col_a[a] <= col_b[b])
            from_b = b < ptr_b[row + 1] and (a == ptr_a[row + 1] or col_b[b] <= col_a[a])
            indices[n] = col_a[a] if from_a else col_b[b]
            values[n] = 0.0
            if from_a:
                values[n] += val_a[a]
                a += 1
            if from_b:
                values[n] += val_b[b]
                b += 1
            n += 1
        indptr[row + 1] = n
    return n
