"""The solver of a step, from PETSc options, and the story it tells when it fails."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from weakref import proxy

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc, releases
from petfsi.errors import InputError, SolveError, is_memory
from petfsi.fields.fluids import PressureFluid
from petfsi.ranks import on_root
from petfsi.solving import option_database, options
from petfsi.solving.multigrid import Hierarchy
from petfsi.solving.newton import Newton, Restage, as_it_is, snes_type
from petfsi.solving.option_rules import PREFIX
from petfsi.solving.option_stories import option_story, petsc_text, unread_story
from petfsi.solving.options import COMMAND_LINE, DEFAULT, ENVIRONMENT, Options
from petfsi.solving.pressure import PressureSolver
from petfsi.solving.system import System, blown_up

#: How Newton's method goes unless options say otherwise. In statics the residual, mostly that of stretch, has to grow
#: first: thin bodies bend along a narrow valley of their energy, out of which every whole step leads, by EA L^2 / EI.
#: Whole steps need a third of the iterations of searches (Cook's membrane, CSM1), and where they go astray a smaller
#: step of the load helps more than a search. Where there is inertia whole steps nearly always do.
STATICS = {"snes_linesearch_type": "basic", "snes_divergence_tolerance": "1e12"}
DYNAMICS = {"snes_linesearch_type": "bt"}

#: How far the true residual may lie above the tolerance that the solver itself tested.
SLACK = 10.0
#: Round-off of the solution may leave this part of the right-hand side; where it is more, K is singular to double
#: precision, and what is solved for may be anything.
COARSEST = 1e-4
#: What round-off of a first guess of the pressure may leave, as a part of the right-hand side.
COARSEST_PRESSURE = 1e-8


def field_prefix(name: str) -> str:
    """Return the options prefix of a field's own solver."""
    return f"{PREFIX}fieldsplit_{name}_"


def load_options(args: list[str], base: str = DEFAULT, stored: Path | None = None) -> Options:
    """Fill PETSc's database with what files, PETSC_OPTIONS and the command line say; return it. Collective.

    Parameters
    ----------
    args : list of str
        PETSc options as given; ``-options_file`` may name a shipped file without its folder.
    base : str
        The shipped file used when the command line names none.
    stored : Path, optional
        The options of a run that goes on: used in place of the shipped file and of PETSC_OPTIONS.

    Raises
    ------
    InputError
        On all ranks, with every option that is refused.
    """

    def read() -> Options:
        if stored is not None:
            return options.resolve_stored(args, os.environ, stored, option_database.fits)
        return options.resolve(args, os.environ, base, option_database.fits)

    found = on_root(MPI.COMM_WORLD, read)
    option_database.put(found)
    return found


@contextmanager
def only_options(args: list[str]) -> Iterator[None]:
    """Have these PETSc options of petfsi's, and no others, in force inside. Collective.

    Solvers read theirs when they are set up, some when they are first applied, so both must happen inside.
    """
    with option_database.only(on_root(MPI.COMM_WORLD, lambda: options.resolve(args, {}, fits=option_database.fits))):
        yield


@dataclass(frozen=True)
class Outcome:
    """What the solves of a step report.

    Attributes
    ----------
    iterations : int
        Of all linear solves; of the pressure's solver where the outer one only applies it.
    residual : float
        Largest |b - Kx|/|b|.
    newton : int
        Newton's iterations.
    """

    iterations: int
    residual: float
    newton: int = 0

    def __add__(self, other: Outcome) -> Outcome:
        """Return the outcome of both."""
        residual = max(self.residual, other.residual)
        return Outcome(self.iterations + other.iterations, residual, self.newton + other.newton)


class _Iterations:
    """Counts the iterations of inner solvers. PETSc holds it, and through it nothing else: a solver can be let go."""

    number = 0

    def __call__(self, _ksp: PETSc.KSP, iteration: int, _norm: float) -> None:
        self.number += iteration > 0


class Solver:
    """One KSP on the system's operator.

    Its type, tolerances and everything inside come from PETSc options under ``fsi_``; see ``options/``. A field
    that is alone is solved as the options say for the whole, or, where they split the whole into fields, as they
    say for that field.

    Parameters
    ----------
    system : System
    static : bool
        Whether Newton's method is the default.

    Attributes
    ----------
    decoupled : bool
        Whether each block is inverted by itself (a fieldsplit other than Schur's), so that a region closed by
        an elastic wall is singular to the pressure block though not to the system.
    splits : bool
        Whether that is done so often and no more: a splitting scheme in time, which leaves a residual.
    iterates : bool
        Whether each step is solved by Newton's method.
    """

    def __init__(self, system: System, static: bool = False) -> None:
        self.system = system
        self._static = static
        self.iterates = snes_type(PREFIX, static) != "ksponly"
        single = len(system.fields) == 1
        splits = PETSc.Options(PREFIX).getString("pc_type", "") == PETSc.PC.Type.FIELDSPLIT
        self.prefix = field_prefix(system.fields[0].name) if single and splits else PREFIX
        options = PETSc.Options(self.prefix)
        mat_type = options.getString("mat_type", "nest")
        if not single and mat_type not in ("nest", "aij"):
            raise InputError(f"option -{self.prefix}mat_type {mat_type}: must be nest or aij")
        self.converts = mat_type == "aij" and not single
        kind = options.getString("pc_type", PETSc.PC.Type.FIELDSPLIT)
        if not single and not self.converts and kind not in NEST:  # some crash on a nest, before they are refused
            raise InputError(
                f"option -{self.prefix}pc_type {kind}: the matrix type nest is for {', '.join(NEST)}; "
                f"all of the matrix can be factorised with -{self.prefix}mat_type aij"
            )
        split = options.getString("pc_fieldsplit_type", "multiplicative")
        self.decoupled = not single and splits and split != "schur"
        # a fixed number of iterations from the last step's solution is a splitting scheme: nothing converges
        self.fixed_iterations = options.getString("ksp_convergence_test", "default") == "skip"
        self.splits = self.decoupled and self.fixed_iterations
        if self.fixed_iterations and self.iterates:
            raise InputError(
                f"option -{PREFIX}snes_type newtonls: wants linear systems solved, and -{self.prefix}"
                f"ksp_convergence_test skip takes a fixed number of iterations; try split-iterated.opts"
            )
        self._ksp: PETSc.KSP | None = None
        self._monolith: PETSc.Mat | None = None
        self._pressure: PressureSolver | None = None
        self._hierarchy: Hierarchy | None = None
        self._newton: Newton | None = None
        self._correction: tuple[PETSc.Vec, PETSc.Vec] | None = None
        self._inner = _Iterations()

    def set_up(self) -> None:
        """Create the KSP if there is none and let everything inside it read its options. Collective."""
        try:
            if self._ksp is None:
                held = releases.of(self.system.comm)
                held.sweep(self.system.comm)
                self._ksp = self._create()
                # what PETSc runs in Python must be gone before Python is
                self._release = held.add(self, partial(_release, self._ksp, self._pressure))
            elif self.converts:
                self._ksp.setOperators(self._convert())
            elif self._pressure is not None:
                self._pressure.refresh(self._inner.number)
            self._ksp.setUp()
            if self._pressure is not None and self._sub_solvers(self._ksp):
                fluid = self._pressure.fluid
                self._pressure.settle(self._sub_solvers(self._ksp)[-1], self._grids(fluid))
        except PETSc.Error as error:
            if is_memory(error):
                raise
            raise InputError(option_story(self.prefix, error)) from None

    def _create(self) -> PETSc.KSP:
        system = self.system
        ksp = PETSc.KSP().create(system.comm)
        ksp.setOptionsPrefix(self.prefix)
        ksp.setOperators(self._convert() if self.converts else system.operator)
        ksp.setFromOptions()
        if system.index_sets and ksp.getPC().getType() == PETSc.PC.Type.FIELDSPLIT:
            ksp.getPC().setFieldSplitIS(*system.index_sets)  # heard only between setFromOptions and setUp
        fluid = next((field for field in system.fields if isinstance(field, PressureFluid)), None)
        if fluid is not None and not self.converts:
            self._pressure = PressureSolver(system, ksp, fluid)
            if not system.index_sets:
                self._pressure.connect(ksp, self._grids(fluid))
        ksp.setUp()
        for sub in self._sub_solvers(ksp):
            if sub.getType() != PETSc.KSP.Type.PREONLY:
                sub.setMonitor(self._inner)
        return ksp

    def _grids(self, fluid: Any) -> Hierarchy | None:
        """Return the hierarchy of the fluid's grids, made once per run; None if it has no grid. Collective."""
        if getattr(fluid, "grid", None) is not None:
            if self._hierarchy is None:
                self._hierarchy = Hierarchy(fluid)
            self._hierarchy.follow(fluid)
        return self._hierarchy

    def _convert(self) -> PETSc.Mat:
        if self._monolith is not None:
            self._monolith.destroy()  # its pattern may have changed
        self._monolith = self.system.operator.convert("aij", PETSc.Mat())
        return self._monolith

    @staticmethod
    def _sub_solvers(ksp: PETSc.KSP) -> list[PETSc.KSP]:
        pc = ksp.getPC()
        return list(pc.getFieldSplitSubKSP()) if pc.getType() == PETSc.PC.Type.FIELDSPLIT else []

    def solver_of(self, name: str) -> PETSc.KSP | None:
        """Return a field's own solver inside that of the whole, or None if nothing is split or set up."""
        names = [field.name for field in self.system.fields]
        subs = self._sub_solvers(self._ksp) if self._ksp is not None else []
        return subs[names.index(name)] if subs and name in names else None

    def reset(self) -> None:
        """Forget everything but the options, so that the next solve is that of a fresh process. Collective."""
        if self._ksp is not None:
            self._release()
            self._ksp = self._pressure = None
        if self._newton is not None:
            self._release_newton()
            self._newton = None

    def adopt(self, system: System) -> None:
        """Solve another system of the same fields from now on. Collective."""
        self.reset()
        self.system, self._monolith, self._correction = system, None, None

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
        changed = changed or self._ksp is None
        if self.iterates:
            if self._ksp is None:
                self.set_up()
            newton, iterations, residual = self._iteration().solve(changed, restage)
            return Outcome(iterations, residual, newton)
        self.system.check()  # before anything is made of numbers that are none
        if changed:
            self.set_up()
        iterations, norms = self.solve_linear(self.system.rhs, self.system.solution)
        return Outcome(iterations, self._relative(norms))

    def improve(self, restage: Restage = as_it_is) -> Outcome:
        """Solve again for a right-hand side that has changed a little, from the solution there. Collective.

        What is left is no more than a thousandth of the change, nor than the solver's tolerance.

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        if self.iterates:
            newton, iterations, residual = self._iteration().solve(True, restage)
            return Outcome(iterations, residual, newton)
        system, ksp, kept = self.system, self._ksp, self._inner.number
        assert ksp is not None
        norms = system.update_residual()
        if self._correction is None:
            self._correction = system.solution.duplicate(), system.rhs.duplicate()
        y, r = self._correction
        system.residual.copy(r)
        rtol, warm = ksp.getTolerances()[0], ksp.getInitialGuessNonzero()
        ksp.setTolerances(rtol=min(rtol * norms["rhs"] / norms[""], 1e-3) if norms[""] > 0 else rtol)
        ksp.setInitialGuessNonzero(False)
        try:
            iterations, _ = self.solve_linear(r, y)
        finally:
            ksp.setTolerances(rtol=rtol)
            ksp.setInitialGuessNonzero(warm)
        # what the preconditioner is judged by is a whole solve
        self._inner.number = kept
        system.solution.axpy(1.0, y)
        return Outcome(iterations, self._relative(system.update_residual()))

    def _relative(self, norms: dict[str, float]) -> float:
        """Return |b - Kx|/|b|; of no more than round-off, the part that it is of what it is the round-off of.

        Collective.
        """
        left, size = norms[""], norms["rhs"]
        assert self._ksp is not None
        if left > SLACK * self._ksp.getTolerances()[0] * size and not self.fixed_iterations:
            lost = self.system.round_off_at(self.system.solution) + self.system.rhs_round_off()
            size = max(size, lost / float(np.finfo(float).eps))
        return left / size if size > 0 else 0.0

    def _iteration(self) -> Newton:
        if self._newton is None:
            # what PETSc runs in Python holds the iteration: were that to hold this, neither would ever be let go
            newton = Newton(self.system, proxy(self), PREFIX, STATICS if self._static else DYNAMICS)
            self._newton = newton
            self._release_newton = releases.of(self.system.comm).add(self, newton.release)
        return self._newton

    def solve_linear(self, b: PETSc.Vec, x: PETSc.Vec, slack: float = SLACK) -> tuple[int, dict[str, float]]:
        """Solve for x, from what it holds, with the operator as it was set up. Collective.

        Parameters
        ----------
        b, x : PETSc.Vec
        slack : float
            How far the true residual may lie above the tolerance that the solver itself tested.

        Returns
        -------
        int, dict of str to float
            Iterations, and the residual's norms (see ``System.update_residual``).

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        system, ksp = self.system, self._ksp
        assert ksp is not None
        size = b.norm()
        rtol, warm = ksp.getTolerances()[0], ksp.getInitialGuessNonzero() and not self.fixed_iterations
        if warm:
            self._drop_coarse_guess(b, x, rtol * size, size)
        floor = self._floor(b, x, size)
        if not np.isfinite(size + floor):
            raise SolveError(blown_up([field.name for field in system.fields]))
        if ksp.getType() != PETSc.KSP.Type.PREONLY:
            if not PETSc.Options(self.prefix).hasName("ksp_atol"):
                ksp.setTolerances(atol=floor)
            if self._pressure is not None:
                self._pressure.aim(max(rtol * size, floor))
        iterations = self._run(b, x)
        lost = 0.0
        norms = system.update_residual(x, b)
        if norms[""] > max(rtol * size, floor) and not self.fixed_iterations:
            floor = self._floor(b, x, size)  # the first guess may have been nothing
            if warm and ksp.getConvergedReason() > 0 and norms[""] > max(rtol * size, floor):
                # what iterations update drifts from the true residual by round-off: they go on from there
                iterations += self._run(b, x)
                self._inner.number = iterations
                norms = system.update_residual(x, b)
            lost = system.round_off_at(x)
        self._judge(ksp, norms, slack, floor, lost)
        return iterations, norms

    def _drop_coarse_guess(self, b: PETSc.Vec, x: PETSc.Vec, wanted: float, size: float) -> None:
        """Begin from zero if the guess is too coarse to get from it to what is wanted, and no better. Collective."""
        if wanted < self.system.round_off_at(x) and not self.system.update_residual(x, b)[""] <= size:
            x.set(0.0)

    def _floor(self, b: PETSc.Vec, x: PETSc.Vec, size: float) -> float:
        """Return what the residual cannot fall below at the pressures in x; ``size`` is that of b. Collective.

        Pressures of a first guess may be anything: their round-off is no more than ``COARSEST_PRESSURE`` of b.
        """
        floor = self.system.rhs_round_off()
        if self._pressure is None:
            return floor
        return max(floor, min(self._pressure.round_off(b, x), COARSEST_PRESSURE * size))

    def _run(self, b: PETSc.Vec, x: PETSc.Vec) -> int:
        """Run the solver; return its iterations, of the inner one if that takes more. Collective."""
        assert self._ksp is not None
        self._inner.number = 0
        try:
            self._ksp.solve(b, x)
        except PETSc.Error as error:
            if is_memory(error):
                raise
            raise SolveError(f"solver '{self.prefix}' broke down: {petsc_text(error)}") from None
        return max(self._inner.number, self._ksp.getIterationNumber())

    def _judge(self, ksp: PETSc.KSP, norms: dict[str, float], slack: float, floor: float, lost: float) -> None:
        """Raise unless the solve can be trusted: PETSc's word is not enough when an inner solver gave up."""
        solvers = [ksp, *self._sub_solvers(ksp)]
        iterative = [s.getTolerances()[0] for s in solvers if s.getType() != PETSc.KSP.Type.PREONLY]
        outer = ksp.getType() != PETSc.KSP.Type.PREONLY
        rtol: float = iterative[0] if outer else max(iterative, default=1e-8)
        round_off: float = SLACK * min(lost, COARSEST * norms["rhs"])
        wanted = max(slack * max(rtol * norms["rhs"], floor), round_off)
        failed = [s for s in solvers if s.getConvergedReason() < 0]
        finite = np.isfinite(norms[""])
        if self.fixed_iterations:
            good = finite and not failed
        else:
            # iterations may not tell that round-off lets them get no farther
            ended = ksp.getConvergedReason() >= 0 or norms[""] <= round_off
            good = finite and ended and norms[""] <= wanted
        if good:
            return
        by_field = ", ".join(f"{field.name} {norms[field.name]:.1e}" for field in self.system.fields)
        culprit = failed[-1] if failed else ksp
        doubt = ""
        if lost > COARSEST * norms["rhs"]:
            doubt = (
                f" Round-off alone may be {lost:.1e}: what resists least is lost beside what resists most, as where "
                f"nothing holds a body, or where stiffness, density or step are extreme."
            )
        raise SolveError(
            f"solver '{culprit.getOptionsPrefix()}' stopped with {petsc.reason_name(culprit)} after "
            f"{culprit.getIterationNumber()} iterations: |b - Kx| = {norms['']:.1e}, wanted {wanted:.1e} "
            f"(|b| = {norms['rhs']:.1e}); by field: {by_field}.{doubt} {self._advice(culprit)}"
        )

    def _advice(self, culprit: PETSc.KSP) -> str:
        """Return what helps where a solver inside, or the whole one, has not converged."""
        whole = culprit.getOptionsPrefix() == self.prefix
        if whole and self.decoupled and culprit.getType() == PETSc.KSP.Type.RICHARDSON:
            return (
                "Iterated splitting diverges where the fluid that moves with the solid outweighs it (added mass), its "
                "stiffness and damping in a step included: go on with -options_file monolithic.opts."
            )
        if whole and culprit.getPC().getType() in (PETSc.PC.Type.LU, PETSc.PC.Type.CHOLESKY):
            return "Smaller steps may help; look at densities, stiffness and supports."
        return "To tell the solver from the physics, run this step with -options_file monolithic-direct.opts."

    def check_options(self) -> list[str]:
        """Set up, refuse petfsi options that nothing has read, and return the other unread ones, to warn of.

        Collective. Some inner solvers read their options when they are first used, so the preconditioner is
        applied once.

        Raises
        ------
        InputError
            Naming each option, with the nearest one that was read.
        """
        self.system.check_operator()
        self.set_up()
        assert self._ksp is not None
        try:
            if self.iterates:
                self._iteration()
            self._ksp.getPC().apply(self.system.rhs, self.system.residual)
            if option_database.in_force().given:
                self._try()
        except PETSc.Error as error:
            if is_memory(error):
                raise
            raise InputError(option_story(self.prefix, error)) from None
        self._refuse_unread()
        return self._unused()

    def _try(self) -> None:
        """Iterate once, so that what PETSc refuses only when it solves shows now. Collective."""
        ksp = self._ksp
        assert ksp is not None
        most = ksp.getTolerances()[3]
        ksp.setTolerances(max_it=min(most, 1))
        try:
            ksp.solve(self.system.rhs, self.system.residual)
        except PETSc.Error as error:
            if error.ierr not in petsc.NUMERICAL:
                raise
        finally:
            ksp.setTolerances(max_it=most)

    def _refuse_unread(self) -> None:
        unread = [name for name in option_database.unread() if not name.startswith(self._absent())]
        if not self.system.index_sets:  # options of the others wait for a scene that couples
            unread = [name for name in unread if name.startswith(self._mine()) and not name.startswith(self._others())]
        if unread:
            raise InputError(unread_story(unread, self.prefix, [field.name for field in self.system.fields]))

    def _absent(self) -> tuple[str, ...]:
        """Return how options begin of fields that the scene has not."""
        return tuple(map(field_prefix, {*SHIPPED} - {field.name for field in self.system.fields}))

    def _mine(self) -> tuple[str, ...]:
        return self.prefix, f"{PREFIX}snes_"

    def _others(self) -> str:
        return f"{PREFIX}fieldsplit_" if self.prefix == PREFIX else "-"

    def _unused(self) -> list[str]:
        """Return what was given for this run, and not in a file for many, and that nothing reads."""
        now = option_database.in_force()
        given = [name for name in option_database.unread() if now.chosen[name].origin in (COMMAND_LINE, ENVIRONMENT)]
        return given + [option.name for option in now.left_out]


def _release(ksp: PETSc.KSP, pressure: PressureSolver | None) -> None:
    if pressure is not None:
        pressure.release()
    ksp.destroy()


#: Preconditioners of a matrix in blocks.
NEST = ("fieldsplit", "jacobi", "none")
#: Fields that the shipped files have options for, whether they are in a scene or not.
SHIPPED = ("solid", "pressure", "particles")
