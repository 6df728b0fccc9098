"""The equations of a step: of fields, couplings and closed regions, assembled into one system and solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.errors import InputError, NoSolutionError
from petfsi.fields.base import Field
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.solids import SolidField
from petfsi.solving.balance import Balance
from petfsi.solving.convergence import Outcome
from petfsi.solving.diagonal import DiagonalSolver
from petfsi.solving.regions import ClosedRegions
from petfsi.solving.solver import Solver
from petfsi.solving.system import System

#: A step is solved again at most so many times to close the volumes of regions, mostly twice; the next one sees what
#: is left.
REPEATS = 6


class Equations:
    """The equations of a step: the fields' and the couplings', in which closed regions keep their volume.

    Parameters
    ----------
    comm : MPI.Comm
    fields : sequence of Field
    couplings : sequence of Coupling
    static : bool
        Whether there is no inertia.

    Attributes
    ----------
    system : System
        The system of the step; another one where unknowns came or went.
    solver : Solver or DiagonalSolver
    regions : ClosedRegions or None
        Those of a fluid with pressures.
    """

    def __init__(self, comm: MPI.Comm, fields: Sequence[Field], couplings: Sequence[Coupling], static: bool) -> None:
        self.comm, self.fields, self.couplings = comm, fields, couplings
        self.solid = next((field for field in fields if isinstance(field, SolidField)), None)
        self.fluid = next((field for field in fields if isinstance(field, PressureFluid)), None)
        self.system = System(comm, fields, couplings)
        self.solver = self._make_solver(static)
        self.regions: ClosedRegions | None = None
        if self.fluid is not None:
            self.regions = ClosedRegions(self.system, self.fluid, self.solid, self.solver.decoupled)

    def _make_solver(self, static: bool) -> Solver | DiagonalSolver:
        if all(field.diagonal for field in self.system.fields) and len(self.system.fields) < 2:
            return DiagonalSolver(self.system)
        return Solver(self.system, static)

    def assemble(self, t: float, dt: float) -> bool:
        """Assemble the step of dt that begins at t; return whether the operator has changed. Collective."""
        if self.regions:
            self.regions.find()
            self.regions.aim(t, dt)
        for field in self.fields:
            field.assemble(t, dt)
        for coupling in self.couplings:
            coupling.assemble(t, dt)
        if self.system.is_outdated():  # unknowns came or went
            self.system = System(self.comm, self.fields, self.couplings, before=self.system)
            self.solver.adopt(self.system)
            if self.regions:
                self.regions.adopt(self.system)
        changed = self.system.refresh()
        if self.regions:
            self.regions.attach()
        return changed

    def balance(self, dt: float) -> None:
        """Raise if what flows into closed regions has nowhere to go, else make up for what is left over. Collective.

        Raises
        ------
        NoSolutionError
            On all ranks.
        """
        if not self.regions:
            return
        balance = Balance(self.regions)
        fault = balance.fault(dt)
        if fault:
            raise NoSolutionError(fault)
        if balance.make_up():
            self.system.refresh(guess=False)

    def squeezed(self) -> str:
        """Return what comes into a closed region whose solids it squeezes, or nothing; of a step assembled. Collective.

        See ``Balance.squeezed``.
        """
        return Balance(self.regions).squeezed() if self.regions else ""

    def check(self, t: float, dt: float) -> None:
        """Refuse a scene whose first step, assembled, has no solution: before anything is written. Collective.

        Raises
        ------
        InputError
            On all ranks.
        """
        wrong = self.solid.unheld() if self.solid else []
        if self.regions:
            fluid = self.regions.fluid
            fluid.rehearse(t, dt)
            fault = Balance(self.regions).fault(dt)
            fluid.rehearse(t, 0.0)
            wrong += [f"{fault} (in the first step)"] if fault else []
        if wrong:
            raise InputError("\n".join(wrong))

    def solve(self, changed: bool, t: float, dt: float) -> Outcome:
        """Solve the step assembled. Collective.

        Parameters
        ----------
        changed : bool
            Whether the operator differs from that of the last step solved.
        t, dt : float
            When the step begins, and its length, s.

        Raises
        ------
        SolveError
            On all ranks.
        """
        return self.solver.solve(changed, lambda values: self._restage(values, t, dt)) + self._close(t, dt)

    def _close(self, t: float, dt: float) -> Outcome:
        """Solve again, with sources that close the volumes of regions, while that is wanted. Collective."""
        outcome = Outcome(0, 0.0)
        if not self.regions or not self.solid or isinstance(self.solver, DiagonalSolver):
            return outcome
        for repeat in range(REPEATS + 1):
            self.regions.measure(self.system.values()[self.system.fields.index(self.solid)], dt)
            if repeat == REPEATS or self.solver.fixed_iterations or not self.regions.improve():
                break
            Balance(self.regions).make_up()
            self.system.refresh(guess=False)
            outcome += self.solver.improve(lambda values: self._restage(values, t, dt))
        return outcome

    def _restage(self, values: list[np.ndarray], t: float, dt: float) -> bool:
        """Make the system that of other values of the fields; return whether the operator has changed. Collective."""
        # not any(): every field must hear
        if not sum([field.relinearise(x) for field, x in zip(self.system.fields, values, strict=True)]):
            return False
        parts: list[Field | Coupling] = [*self.fields, *self.couplings]
        for part in parts:
            part.assemble(t, dt)
        return self.system.refresh(guess=False)

    def divergence(self) -> float:
        """Return the largest net outflow of a fluid cell in the last step, walls included, per face area, m/s.

        Collective.
        """
        if self.fluid is None:
            return 0.0
        outflow = self.system.residual.array[self.system.piece(self.fluid.name)] / self.fluid.row_scale
        area = self.fluid.cell_volume ** ((self.fluid.dim - 1) / self.fluid.dim)
        return self.comm.allreduce(float(np.abs(outflow).max(initial=0.0)), MPI.MAX) / area

    def assemblies(self) -> dict[str, int]:
        """Return how often each block was assembled."""
        return {
            **{field.name: field.n_assembled for field in self.system.fields},
            **{
                "-".join(next(iter(coupling.blocks))): coupling.n_assembled
                for coupling in self.couplings
                if coupling.blocks
            },
        }

    def rewind(self) -> None:
        """Go back to before a step that has failed: nothing of it was accepted. Collective."""
        parts: list[Field | Coupling] = [*self.fields, *self.couplings]
        for part in parts:
            part.rewind()
        if self.regions:
            self.regions.rewind()
        self.solver.reset()

    def close(self) -> None:
        """Free what PETSc holds of them. Collective."""
        self.solver.reset()
        self.system.close()
