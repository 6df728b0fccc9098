"""The solver of a step: a linear system once, or Newton's method around it, as PETSc options say."""

from __future__ import annotations

from weakref import proxy

from petsc4py import PETSc

from petfsi import releases
from petfsi.errors import InputError
from petfsi.solving import option_database
from petfsi.solving.convergence import Outcome
from petfsi.solving.linear import LinearSolver
from petfsi.solving.newton import Newton, Restage, as_it_is, snes_type
from petfsi.solving.option_rules import PREFIX
from petfsi.solving.option_stories import options_blamed, refuse_unread
from petfsi.solving.system import System

#: How Newton's method goes unless options say otherwise. In statics the residual, mostly that of stretch, has to grow
#: first: thin bodies bend along a narrow valley of their energy, out of which every whole step leads, by EA L^2 / EI.
#: Whole steps need a third of the iterations of searches (Cook's membrane, CSM1), and where they go astray a smaller
#: step of the load helps more than a search. Where there is inertia whole steps nearly always do.
STATICS = {"snes_linesearch_type": "basic", "snes_divergence_tolerance": "1e12"}
DYNAMICS = {"snes_linesearch_type": "bt"}


class Solver:
    """Solves the system of a step, linearised once or iterated by Newton's method.

    Parameters
    ----------
    system : System
    static : bool
        Whether Newton's method is the default.

    Attributes
    ----------
    linear : LinearSolver
        Solves its linear systems.
    iterates : bool
        Whether each step is solved by Newton's method.
    decoupled, splits, fixed_iterations : bool
        See ``Method``.
    """

    def __init__(self, system: System, static: bool = False) -> None:
        self._static = static
        self.iterates = snes_type(PREFIX, static) != "ksponly"
        self.linear = LinearSolver(system)
        method = self.linear.method
        self.decoupled, self.splits, self.fixed_iterations = method.decoupled, method.splits, method.fixed_iterations
        if self.fixed_iterations and self.iterates:
            raise InputError(
                f"option -{PREFIX}snes_type newtonls: wants linear systems solved, and -{method.prefix}"
                f"ksp_convergence_test skip takes a fixed number of iterations; try split-iterated.opts"
            )
        self._newton: Newton | None = None

    def solver_of(self, name: str) -> PETSc.KSP | None:
        """Return a field's own solver inside that of the whole, or None if nothing is split or set up."""
        return self.linear.solver_of(name)

    def reset(self) -> None:
        """Forget everything but the options, so that the next solve is that of a fresh process. Collective."""
        self.linear.reset()
        if self._newton is not None:
            self._release_newton()
            self._newton = None

    def adopt(self, system: System) -> None:
        """Solve another system of the same fields from now on. Collective."""
        self.reset()
        self.linear.adopt(system)

    def solve(self, changed: bool, restage: Restage = as_it_is) -> Outcome:
        """Solve for the system's solution, from its first guess. Collective.

        Parameters
        ----------
        changed : bool
            Whether the operator differs from that of the last call.
        restage : callable
            Makes the system that of other values of the fields, for Newton's method.

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        linear = self.linear
        changed = changed or not linear.is_set_up
        if self.iterates:
            if not linear.is_set_up:
                linear.set_up()
            return self._iterate(changed, restage)
        linear.system.check()  # before anything is made of numbers that are none
        if changed:
            linear.set_up()
        iterations, norms = linear.solve(linear.system.rhs, linear.system.solution)
        return Outcome(iterations, linear.relative(norms))

    def improve(self, restage: Restage = as_it_is) -> Outcome:
        """Solve again for a right-hand side that has changed a little, see ``LinearSolver.improve``. Collective."""
        if self.iterates:
            return self._iterate(True, restage)
        iterations, norms = self.linear.improve()
        return Outcome(iterations, self.linear.relative(norms))

    def _iterate(self, changed: bool, restage: Restage) -> Outcome:
        newton, iterations, residual = self._iteration().solve(changed, restage)
        return Outcome(iterations, residual, newton)

    def _iteration(self) -> Newton:
        if self._newton is None:
            system = self.linear.system
            # what PETSc runs in Python holds the iteration: were that to hold the solver, neither would ever be let go
            newton = Newton(system, proxy(self.linear), PREFIX, STATICS if self._static else DYNAMICS)
            self._newton = newton
            self._release_newton = releases.of(system.comm).add(self, newton.release)
        return self._newton

    def check_options(self) -> list[str]:
        """Set up, refuse petfsi options that nothing has read, and return the other unread ones, to warn of.

        Collective.

        Raises
        ------
        InputError
            Naming each option, with the nearest one that was read.
        """
        linear = self.linear
        linear.system.check_operator()
        linear.set_up()
        with options_blamed(linear.method.prefix):
            if self.iterates:
                self._iteration()
            linear.rehearse(iterates=bool(option_database.in_force().given))
        return refuse_unread(linear.method.prefix, [field.name for field in linear.system.fields])
