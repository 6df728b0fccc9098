"""A sparse stand-in for the pressure's Schur complement S = L + D1 H A^-1 J.

With X thrice the inverse of A's diagonal, Sp = L + E and E = J^T X J differ from L only in rows of cells that moving
walls touch. X keeps what matters near the walls: a mass alone would be wrong for stiff solids, nothing at all for
light ones. The factor was found by trial: A^-1 is X / 3 for motions of single nodes, and far more for smooth ones.
Where E is small beside L, as for most solids, it is left out and costs nothing. What X lacks are the
large motions of light bodies; see ``modes``.

Where a coupling has added J T J^T to A (see ``projection.slivers``), pressures have T to push besides: E becomes
E (I + T E)^-1, of which the diagonal of E is taken in the place of the second one. That does where walls matter little,
and on coarse grids. Where they dominate, the finest grid of multigrid has the whole one, see ``resisted``: without it,
soft and light solids take up to three times the iterations, whatever the factor.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix, vstack

from petfsi.petsc import IntType, Layout, new_block, set_csr, sum_csr
from petfsi.solving.resisted import Resisted
from petfsi.solving.system import System

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
        self._system = system
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

    def resisted(self, least: float, prefix: str) -> Resisted | None:
        """Return L + E with the masses that walls push as they are, if it matters. Collective.

        Parameters
        ----------
        least : float
            Largest E_ii / L_ii up to which it does not.
        prefix : str
            Of the options of its factorisation.
        """
        solid, fluid = self._system.fields
        pushes = [coupling.push for coupling in self._system.couplings if coupling.push is not None]
        if not pushes or not self.matter or self._strength(self.walls.getDiagonal().array_r) <= least:
            return None
        rows = vstack([csr_matrix((v, i, p), shape=(len(p) - 1, solid.layout.n_global)) for p, i, v in pushes], "csr")
        csr = rows.indptr.astype(IntType), rows.indices.astype(IntType), rows.data
        sizes = Layout.of(self._comm, rows.shape[0]).sizes, solid.layout.sizes
        push = PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._comm)
        push.scale(np.sqrt(solid.row_scale * solid.col_scale))
        every = push.createVecLeft()
        every.set(1.0)
        own, added = self.solid_block.getDiagonal(), _squares(push, every)
        own.axpy(-1.0, added)
        own.reciprocal()
        own.scale(SOFTER)
        found = Resisted(self.fluxes, self.force_block, own, push, prefix)
        for thing in (push, every, own, added):
            thing.destroy()
        return found

    def _fill_walls(self) -> None:
        inverse, factors = self._yielding()
        squares = _squares(self.force_block, inverse)
        relief = squares.duplicate()
        relief.array = 1.0 / np.sqrt(1.0 + factors * squares.array_r)
        self.matter = self._strength(squares.array_r * relief.array_r**2) > self._faint
        if self.matter:
            felt = self.force_block.copy()
            felt.diagonalScale(R=relief)
            yielding = felt.copy()
            yielding.diagonalScale(L=inverse)
            # J^T X J, positive also where the transfer is not symmetric and D1 H is not J^T
            walls = felt.transposeMatMult(yielding)
            rows = walls.getValuesCSR()
            for thing in (felt, yielding, walls):
                thing.destroy()
        else:
            rows = np.zeros(self.walls.getLocalSize()[0] + 1, dtype=IntType), np.zeros(0, dtype=IntType), np.zeros(0)
        self._walls_pattern = self._set(self.walls, rows, self._walls_pattern)
        for vec in (inverse, squares, relief):
            vec.destroy()

    def _yielding(self) -> tuple[PETSc.Vec, np.ndarray]:
        """Return X, and T by this rank's unknowns in the solver's units."""
        fluid = self._system.fields[1]
        inverse, factors = self.solid_block.getDiagonal(), np.zeros(fluid.layout.n_local)
        inverse.reciprocal()
        inverse.scale(SOFTER)
        for coupling in self._system.couplings:
            if coupling.pushed is not None:
                factors += coupling.pushed / (fluid.row_scale * fluid.col_scale)
        return inverse, factors

    def _strength(self, walls: np.ndarray) -> float:
        """Return the largest E_ii / L_ii. Collective."""
        resistance = self.fluxes.getDiagonal()
        strongest = float((walls / resistance.array_r).max(initial=0.0))
        resistance.destroy()
        return self._comm.allreduce(strongest, MPI.MAX)

    def _fill_operator(self) -> None:
        rows = sum_csr(*self.fluxes.getValuesCSR(), *self.walls.getValuesCSR())
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


def _squares(mat: PETSc.Mat, weights: PETSc.Vec) -> PETSc.Vec:
    """Return the diagonal of  mat^T diag(weights) mat. Collective."""
    squares = mat.copy()
    indptr, indices, values = squares.getValuesCSR()
    set_csr(squares, indptr, indices, values**2, new_pattern=False)
    diagonal = squares.createVecRight()
    squares.multTranspose(weights, diagonal)
    squares.destroy()
    return diagonal
