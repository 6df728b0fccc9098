"""The solver of a field that is alone and has a diagonal block, or of fields without any: none."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from petfsi.solving import option_database
from petfsi.solving.convergence import Outcome
from petfsi.solving.newton import Restage, as_it_is
from petfsi.solving.system import System


class DiagonalSolver:
    """Divides by the diagonal of the system's operator, if it has one.

    It has the face of ``Solver`` and reads no option.
    """

    decoupled = splits = iterates = False

    def __init__(self, system: System) -> None:
        self.system = system
        self._diagonal: np.ndarray | None = None

    def set_up(self) -> None:
        """Take the operator's diagonal. Collective."""
        if self.system.fields:
            self._diagonal = self.system.operator.getDiagonal().array_r.copy()

    def solver_of(self, name: str) -> PETSc.KSP | None:
        """Return None: there is none."""
        return None

    def reset(self) -> None:
        """Forget the diagonal."""
        self._diagonal = None

    def adopt(self, system: System) -> None:
        """Solve another system of the same field from now on."""
        self.system, self._diagonal = system, None

    def solve(self, changed: bool, restage: Restage = as_it_is) -> Outcome:
        """Solve for the system's solution; what is not finished is found by its speed."""
        if not self.system.fields:
            return Outcome(0, 0.0)
        if changed or self._diagonal is None:
            self.set_up()
        self.system.solution.array = self.system.rhs.array_r / self._diagonal
        return Outcome(0, 0.0)

    def check_options(self) -> list[str]:
        """Return the options that were given and that nothing reads. Collective."""
        self.set_up()
        return [*option_database.unread(), *(option.name for option in option_database.in_force().left_out)]
