"""The two off-diagonal blocks between a fluid and a solid, filled in place."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.fields.fluids import FluidField
from petfsi.fields.solids import SolidField
from petfsi.petsc import new_block, set_csr

#: This rank's rows of a matrix: indptr, global columns, values.
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]


class TransferBlocks:
    """D1 H and -J, for the present unknowns of a fluid and a solid.

    Attributes
    ----------
    flux : PETSc.Mat
        D1 H: rows of the fluid.
    force : PETSc.Mat
        -J: rows of the solid.
    """

    def __init__(self, comm: MPI.Comm, fluid: FluidField, solid: SolidField) -> None:
        self._comm = comm
        self.flux = new_block(comm, fluid.layout, solid.layout)
        self.force = new_block(comm, solid.layout, fluid.layout)
        self._names = fluid.name, solid.name
        self._patterns: list[tuple[np.ndarray, ...]] = []

    @property
    def by_name(self) -> dict[tuple[str, str], PETSc.Mat]:
        """The blocks by (name of the row's field, name of the column's field)."""
        fluid, solid = self._names
        return {(fluid, solid): self.flux, (solid, fluid): self.force}

    def fill(self, flux: Rows, force: Rows) -> bool:
        """Fill both with this rank's rows; return whether a pattern is new on any rank. Collective."""
        rows = (flux, force)
        new = 0
        for bit, (indptr, indices, _) in enumerate(rows):
            if not self._patterns or not all(map(np.array_equal, (indptr, indices), self._patterns[bit])):
                new |= 1 << bit
        new = self._comm.allreduce(new, op=MPI.BOR)
        for bit, block in enumerate((self.flux, self.force)):
            set_csr(block, *rows[bit], new_pattern=bool(new >> bit & 1))
        self._patterns = [part[:2] for part in rows]
        return new > 0
