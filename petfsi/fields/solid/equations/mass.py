"""Rows that others add to a solid's block: the mass of what its surface moves."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.petsc import forget_inodes, set_csr, sum_csr

#: Local rows of a matrix: indptr, global columns, values.
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]


class AddedRows:
    """Fills a block with its own rows and those that were added, in place while the pattern stays.

    Attributes
    ----------
    version : int
        Grows whenever others rows are added.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._rows: Rows | None = None
        self._pattern: tuple[np.ndarray, np.ndarray] | None = None
        self.version = 0

    def take(self, rows: Rows | None) -> None:
        """Add these from now on, in place of those before."""
        if rows is not None or self._rows is not None:
            self._rows, self.version = rows, self.version + 1

    def fill(self, block: PETSc.Mat, own: Rows) -> bool:
        """Fill a block, which had its own pattern at first; return whether the pattern is another one. Collective."""
        if self._rows is None and self._pattern is None:
            set_csr(block, *own, new_pattern=False)
            return False
        if self._pattern is None:
            forget_inodes(block)
        rows = own if self._rows is None else sum_csr(*own, *self._rows)
        new = self._pattern is None or not all(map(np.array_equal, self._pattern, rows[:2]))
        new = self._comm.allreduce(new, op=MPI.LOR)
        set_csr(block, *rows, new_pattern=new)
        self._pattern = rows[:2]
        return new
