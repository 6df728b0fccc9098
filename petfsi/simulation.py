"""The step, in six calls."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from mpi4py import MPI

from petfsi import build, causes, limits, petsc
from petfsi.accounts import Accounts
from petfsi.errors import FinalError, InputError, NotStoredError, SolveError
from petfsi.fields.fluids import FluidField, PressureFluid
from petfsi.fields.slabs import Reader, State, held, scalar_slab
from petfsi.fields.solids import SolidField
from petfsi.guard import EnergyGuard
from petfsi.probes import Probes
from petfsi.scene.schema import Scene
from petfsi.scene.stepping import Stepping
from petfsi.solving import start
from petfsi.solving.convergence import Outcome
from petfsi.solving.diagonal import DiagonalSolver
from petfsi.solving.equations import Equations
from petfsi.solving.solver import Solver
from petfsi.solving.splitting import SplitWatch
from petfsi.solving.system import System
from petfsi.substeps import StableStep
from petfsi.touch import watch

#: By what equal steps are counted: their length, from which step and time.
CLOCK = ("length", "step", "time")

PHASES = ("predict", "couple", "assemble", "solve", "accept", "observe")

#: The solution of a field without unknowns.
NOTHING = np.zeros(0)

#: A start that changes the kinetic energy by more than this part of it is told of.
START_NOTED = 1e-3


class Simulation:
    """Fields, couplings and solver of a scene, at one instant.

    Attributes
    ----------
    step, time, dt : int, float, float
        The present step number, its time (s) and the length of the step that led there (s; at first of the next).
    equations : Equations
        Those of a step, with their system, solver and closed regions.
    substeps : int
        Into how many the last step was divided: because an explicit scheme needs shorter ones, or a solve failed.
    report : callable
        Is told in a line what a user should know of a step.
    notes : list of str
        What a user should know of how it begins, from ``prepare`` on.
    outcome : Outcome
        What the solves of the last step reported.
    volume_error : float
        Largest relative change of a closed region's fluid volume in a (sub-)step, |sum of net outflows| h / V.
        A split solve spreads a compatible correction over the region: then this is its size.
    guard : EnergyGuard
        Stops a run whose energy grows out of nothing.
    splitting : SplitWatch or None
        Stops a run whose splitting scheme is unstable.
    accounts : Accounts
        Momentum, energy and volumes, from ``prepare`` on.
    phases : dict
        Seconds spent in each of the six phases.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene) -> None:
        self.comm = comm
        self.scene = scene
        self._stepping = Stepping(scene.time)
        self.step, self.time = 0, 0.0
        self.fields = build.build_fields(comm, scene)
        self.couplings = build.build_couplings(scene, self.fields)
        self.solid = next((field for field in self.fields if isinstance(field, SolidField)), None)
        self.fluid = next((field for field in self.fields if isinstance(field, FluidField)), None)
        if self.solid and self.fluid:
            self.solid.set_scale(self.fluid.density * self.fluid.cell_volume)
        self.equations = Equations(comm, self.fields, self.couplings, static=not scene.time.scheme.inertia)
        self.solver, self.regions = self.equations.solver, self.equations.regions
        self.stable = StableStep(self.fields, scene.time)
        self.dt = self._stepping.length(0.0)
        # an explicit step fails for being too long, which is found before it is taken
        self._retries = 0 if self.stable.limited else scene.time.retries
        self.substeps = 1
        self.report: Callable[[str], None] = lambda text: None
        self.notes: list[str] = []
        if self.solid:
            limits.refuse_far_start(self.solid)
        self._probes = Probes(scene, self.solid, self.fluid)
        self.watch = watch(comm, scene, self.solid)
        self.accounts = Accounts(comm, scene, self.fields, self.couplings, self.regions)
        self.guard = EnergyGuard(comm, scene)
        self.splitting = None
        if self.solver.splits and self.solid:
            self.splitting = SplitWatch(comm, self.solid, scene.time.energy_limit >= 0)
        self.outcome = Outcome(0, 0.0)
        self.volume_error = 0.0
        self.phases = dict.fromkeys(PHASES, 0.0)

    @property
    def system(self) -> System:
        """The system of the present step."""
        return self.equations.system

    @property
    def divides(self) -> bool:
        """Whether a step may be divided."""
        return self._retries > 0 or self.stable.divides

    @property
    def finished(self) -> bool:
        """Whether the scene's end is reached."""
        return self._stepping.finished(self.time, self.dt)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the seconds spent inside to one of the phases."""
        start = clock.perf_counter()
        yield
        self.phases[name] += clock.perf_counter() - start

    def advance(self) -> None:
        """Take one step, in several if it must be divided. Collective.

        Raises
        ------
        SolveError
            On all ranks; the state is then that of the failed step and must not be used.
        """
        t = self.time
        dt = self.dt = self._length(t)
        self.substeps, self.outcome, self.volume_error = 0, Outcome(0, 0.0), 0.0
        for begin, length in self.stable.parts(t, dt):
            self._take(begin, length, self._retries)
        self.guard.judge(self.accounts, t + dt, self._advice())
        self.step += 1
        self.time = self._stepping.after(self.step, t, dt)

    def _length(self, t: float) -> float:
        """Return the length of the step that begins at t, no more than the time between outputs if it is free."""
        if not self._stepping.auto:
            return self._stepping.length(t)
        return min(self._stepping.length(t, self.stable.present()[0]), self.scene.output.every or np.inf)

    def check_step(self) -> None:
        """Refuse a next step, of a run that goes on, that has no length or is longer than the stable one. Collective.

        Raises
        ------
        InputError
            On all ranks.
        """
        try:
            self.stable.count(self.time, self._length(self.time))
        except SolveError as error:
            raise InputError(str(error)) from error

    def last_step(self, most: int) -> int | None:
        """Return the number of the last step; None where they differ and are more than ``most``. Not collective."""
        return self._stepping.count(most)

    def _take(self, t: float, dt: float, retries: int) -> None:
        """Take a step, or two halves in its place if it fails and so on, at most ``retries`` times. Collective."""
        try:
            self._attempt(t, dt, last=retries == 0)
        except SolveError as error:
            if retries == 0 or isinstance(error, FinalError):
                raise
            why = str(error).split(": ")[0]
            self.report(f"t = {t:.6g} s: the step of {dt:g} s is taken again as two halves: {why}")
            self._rewind()
            self._take(t, dt / 2, retries - 1)
            self._take(t + dt / 2, dt / 2, retries - 1)

    def _attempt(self, t: float, dt: float, last: bool) -> None:
        with self.phase("predict"):
            for field in self.fields:
                field.predict(t, dt)
            if self.solid and not self.solid.explicit:  # before anything looks for where that is
                self._check_speed(self.solid, self.solid.predicted() / dt, dt)
        touch = causes.touch_named(self.solid, self.watch, t, dt, last)
        with causes.splitting_named(self.splitting), touch, causes.squeezing_named(self.equations, last):
            outcome = self._solve(t, dt)
        if self.splitting is not None:
            self.splitting.judge(self.system)
        squeezing = causes.squeezing_named(self.equations, last)
        with self.phase("accept"), causes.splitting_named(self.splitting), squeezing:
            self._accept(t, dt)
            if not isinstance(self.solver, DiagonalSolver):  # else no step makes any
                petsc.collect_garbage()
        self.outcome, self.substeps = self.outcome + outcome, self.substeps + 1

    def _solve(self, t: float, dt: float) -> Outcome:
        with self.phase("couple"):
            for coupling in self.couplings:
                coupling.couple(t, dt)
        with self.phase("assemble"):
            changed = self.equations.assemble(t, dt)
            self.equations.balance(dt)
        with self.phase("solve"), causes.elements_named(self.solid):
            return self.equations.solve(changed, t, dt)

    def _rewind(self) -> None:
        """Put everything back to before the step that has failed; nothing of it was accepted. Collective."""
        self.equations.rewind()
        if self.splitting is not None:
            self.splitting.forget()

    def forget(self) -> None:
        """Forget what a resumed run could not know: it must go on in the same way. Collective."""
        self.solver.reset()
        for field in self.fields:
            field.forget()

    def close(self) -> None:
        """Free what PETSc holds of it: it can be asked nothing afterwards. Collective."""
        self.equations.close()
        petsc.collect_garbage()

    def prepare(self, resumes_at: float | None = None) -> list[str]:
        """Assemble and set the solver up once without moving, so that every mistake in the options shows now.

        Then let the velocities of fluid and solids fit each other, unless a run resumes with those of a checkpoint.
        Collective. Returns the options of others that nothing reads.

        Parameters
        ----------
        resumes_at : float, optional
            The time (s) of that checkpoint: a step must have a length then, which it need not have at time zero.

        Raises
        ------
        SolveError
            On all ranks, if that start cannot be found.
        """
        self.rehearse(resumes_at)
        with causes.elements_named(self.solid):
            unread = self.solver.check_options()
        self.accounts.start()
        if resumes_at is None:
            self._fit_velocities()
        return unread

    def rehearse(self, resumes_at: float | None = None) -> None:
        """Assemble the first step without moving, and refuse a scene in which it has no solution. Collective."""
        if resumes_at is None:
            self.dt = self._length(self.time)
            self.notes += self.stable.notes(self.time, self.dt)
        else:
            self.dt = self._stepping.length(resumes_at)
        for coupling in self.couplings:
            coupling.couple(self.time, self.dt)
        self.equations.assemble(self.time, self.dt)
        with np.errstate(all="ignore"):  # what overflows is found by those who judge the solve
            self.equations.check(self.time, self.dt)

    def _fit_velocities(self) -> None:
        """Let supports, solids and fluid begin with velocities that fit each other; note what that did. Collective."""
        if not isinstance(self.solver, Solver):
            return
        fluid = self.fluid if isinstance(self.fluid, PressureFluid) else None
        before = self.accounts.values.get("kinetic", np.nan)
        changed = start.fit_velocities(self.system, self.solver, self.regions, fluid, self.solid, self.dt)
        if not changed:
            return
        self.accounts.start()
        after = self.accounts.values.get("kinetic", np.nan)
        if abs(after - before) > START_NOTED * max(before, after):
            what = {start.SUPPORTS: "those of supports", start.FLUID: "each other"}
            misfit = ", nor ".join(what[reason] for reason in changed)
            self.notes.append(
                f"the velocities given at t = 0 did not fit {misfit}, and were brought to the nearest that do: "
                f"kinetic energy {after:.4g} J, not {before:.4g} J"
            )

    def _accept(self, t: float, dt: float) -> None:
        if self.regions:
            self.volume_error = max(self.volume_error, self.regions.volume_error(dt))
        values = dict(zip((field.name for field in self.system.fields), self.system.values(), strict=True))
        if self.solid:
            fastest = float(np.abs(self.solid.along_axes(values[self.solid.name])).max(initial=0.0))
            fastest = self._check_speed(self.solid, fastest, dt)
            if self.stable.limited:
                self.stable.moved(fastest * dt)
            self.solid.judge(values[self.solid.name], dt)
            if self.watch:
                self.watch.judge(self.solid.surface_arrival(values[self.solid.name], dt), t, dt)
            self.solid.accept(values[self.solid.name], t, dt)
        for coupling in self.couplings:
            coupling.accept(values, t, dt)
        if self.fluid:
            self.fluid.accept(values.get(self.fluid.name, NOTHING), t, dt)
        if self.regions:
            self.regions.settle()
        remarks = [self.solid.remark(dt) if self.solid else None, self.fluid.remark() if self.fluid else None]
        remarks.append(self.splitting.doubt if self.splitting else None)
        for remark in filter(None, remarks):
            self.report(f"t = {t + dt:.6g} s: {remark}")
        self.accounts.update(values.get(self.fluid.name) if self.regions and self.fluid else None, dt)

    def _check_speed(self, solid: SolidField, fastest: float, dt: float) -> float:
        """Return the largest speed of all ranks, from this rank's (m/s); see ``limits``. Collective."""
        extent = self.fluid.extent if self.fluid else 10.0 * solid.extent
        return limits.largest_speed(self.comm, fastest, dt, extent, self._advice)

    def _advice(self) -> str:
        """Return what may help a run that blows up."""
        limited = self.stable.limited
        return causes.advice(self.scene.time, self.solid, self.solver.iterates or limited, self.splitting)

    def probe_columns(self) -> list[str]:
        """Return the names of the probes' columns in history.csv."""
        return self._probes.columns()

    def probe(self) -> list[float]:
        """Return the probes' present values, one per column. Collective."""
        return self._probes.values()

    def divergence(self) -> float:
        """Return the largest net outflow of a fluid cell in the last step, see ``Equations``. Collective."""
        return self.equations.divergence()

    def assemblies(self) -> dict[str, int]:
        """Return how often each block was assembled."""
        return self.equations.assemblies()

    def state(self) -> dict[str, State]:
        """Return all that the next step reads, by field, and of clock, closed regions, accounts and stable step."""
        return {name: part() for name, part in self.keep().items()}

    def keep(self) -> dict[str, Callable[[], State]]:
        """Return what gives ``state`` of now, whatever steps are tried since. Collective, and so is each of it."""
        kept = {field.name: field.keep() for field in self.fields}
        clock = zip(CLOCK, self._stepping.stored, strict=True)
        kept["clock"] = held({name: scalar_slab(self.comm, value) for name, value in clock})
        if self.regions:
            kept["regions"] = self.regions.keep()
        if self.accounts.columns:
            kept["accounts"], kept["guard"] = held(self.accounts.state()), held(self.guard.state())
        if self.stable.limited:
            kept["stable"] = held(self.stable.state(self.comm))
        if self.splitting is not None:
            kept["splitting"] = self.splitting.keep()
        return kept

    def restore(self, step: int, time: float, dt: float, group: Callable[[str], Reader]) -> None:
        """Take up the state of a checkpoint; ``prepare`` comes first. Collective.

        Parameters
        ----------
        step, time, dt : int, float, float
        group : callable
            Returns the reader of a group of ``state`` by its name.
        """
        self.step, self.time, self.dt = step, time, dt
        length, begin, start = (float(group("clock")(name, (0,), (1,))[0]) for name in CLOCK)
        self._stepping.go_on(step, time, (length, int(begin), start))
        self.begin_with([field.name for field in self.fields], group)
        if self.accounts.columns:
            self.accounts.restore(group("accounts"))
        if self.accounts.columns:
            self.guard.restore(group("guard"))
        if self.stable.limited:
            self.stable.restore(group("stable"))
        if self.splitting is not None:
            with suppress(NotStoredError):  # of a run that was not split so far
                self.splitting.restore(group("splitting"))

    def begin_with(self, names: Collection[str], group: Callable[[str], Reader]) -> None:
        """Take up the state of some fields of a checkpoint: after ``prepare`` all, before it others. Collective.

        Parameters
        ----------
        names : collection of str
            Of fields.
        group : callable
            Returns the reader of a group of ``state`` by its name.
        """
        whole = len(names) == len(self.fields)
        if whole:
            self.forget()  # of the scene's start
        for field in self.fields:
            if field.name in names:
                field.restore(group(field.name))
        if self.solid and self.watch:
            self.watch.resume(self.solid)
        for coupling in self.couplings:
            coupling.restored()
        if self.regions and whole:
            self.regions.restore(group("regions"))
