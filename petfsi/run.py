"""A run from its first step to its last: what it writes, when it stops, and how it goes on."""

from __future__ import annotations

import platform
import signal
import time as clock
from pathlib import Path
from typing import Literal

import numpy as np
from mpi4py import MPI

from petfsi import __version__, petsc, solve
from petfsi.build import field_names
from petfsi.console import Console
from petfsi.errors import InputError, SolveError
from petfsi.output import checkpoint as checkpoints
from petfsi.output.fields import FieldWriter
from petfsi.output.history import History, column_names
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import Summary, write_summary
from petfsi.output.xdmf import GridInfo
from petfsi.scene.load import RESUMABLE, dump_scene, load_scene
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

DONE, STOPPED = 0, 75

#: What a row of history.csv says besides the probes and the solver.
ACCOUNTS = ("volume_error", "divergence")


class Stop:
    """Whether the run should stop early: a signal, or the wall-time limit.

    SIGTERM, SIGUSR1, SIGUSR2 and SIGHUP on any rank stop all ranks at the same step.
    """

    def __init__(self, comm: MPI.Comm, wall_limit: float | None) -> None:
        self.comm = comm
        self.limit = wall_limit
        self.start = clock.monotonic()
        self._signal = 0
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP):
            signal.signal(number, self._hear)  # after PETSc has put its own in

    def _hear(self, number: int, _frame: object) -> None:
        self._signal = number

    def asked(self, slowest_step: float) -> str:
        """Return why to stop, or nothing. Collective: one reduction.

        Parameters
        ----------
        slowest_step : float
            Seconds that the slowest step took: one more must fit under the limit.
        """
        late = self.limit is not None and clock.monotonic() - self.start + slowest_step > self.limit
        everyone = np.array([self._signal, int(late)])
        self.comm.Allreduce(MPI.IN_PLACE, everyone, MPI.MAX)
        number, late = everyone.tolist()
        if number:
            return signal.Signals(number).name
        return f"the wall-time limit of {self.limit:g} s" if late else ""


class Run:
    """A simulation with its run directory."""

    def __init__(self, simulation: Simulation, files: RunDirectory, console: Console) -> None:
        self.simulation = simulation
        self.files = files
        self.console = console
        self.comm = simulation.comm
        self.history = History(files.history, column_names(simulation.probe_columns(), ACCOUNTS), self.comm)
        self.writer = FieldWriter(files.path, self.comm, _grid_info(simulation))
        self.start = clock.perf_counter()
        self.iterations: list[int] = []
        self.volume_error = 0.0
        self.probes: dict[str, float] = {}
        self.last_checkpoint: Path | None = None
        self._slowest = 0.0

    def loop(self, last: int, stop: Stop) -> int:
        """Step until ``last``; return the exit status. Collective."""
        simulation = self.simulation
        try:
            while simulation.step < last:
                begin = clock.perf_counter()
                simulation.advance()
                with simulation.phase("observe"):
                    self.observe(final=simulation.step == last)
                self._slowest = max(self._slowest, clock.perf_counter() - begin)
                outcome = simulation.outcome
                self.console.step(
                    simulation.step,
                    simulation.time,
                    simulation.dt,
                    outcome.iterations,
                    outcome.residual,
                    clock.perf_counter() - begin,
                )
                why = stop.asked(self._slowest) if simulation.step < last else ""
                if why:
                    self.checkpoint()
                    self.console.note(
                        f"stopped by {why} after step {simulation.step}; go on with: petfsi resume {self.files.path}"
                    )
                    self.summarise("stopped")
                    return STOPPED
        except SolveError as error:
            self.summarise("failed")
            raise SolveError(self._story(error)) from None
        self.checkpoint()
        self.summarise("done")
        return DONE

    def observe(self, final: bool) -> None:
        """Write what is due after a step. Collective."""
        simulation = self.simulation
        scene = simulation.scene
        self.iterations.append(simulation.outcome.iterations)
        self.volume_error = max(self.volume_error, simulation.volume_error)
        self.append_row()
        if scene.output.every and (final or self._due(scene.output.every)):
            self.write_fields()
        if scene.checkpoint.every and not final and self._due(scene.checkpoint.every):
            self.checkpoint()

    def append_row(self) -> None:
        """Add the present state to the history. Collective."""
        simulation = self.simulation
        self.probes = dict(zip(simulation.probe_columns(), simulation.probe(), strict=True))
        self.history.append(
            {
                "step": simulation.step,
                "time": simulation.time,
                "dt": simulation.dt,
                **self.probes,
                "iterations": simulation.outcome.iterations,
                "residual": simulation.outcome.residual,
                "volume_error": simulation.volume_error,
                "divergence": simulation.divergence(),
            }
        )

    def _due(self, every: float) -> bool:
        now, dt = self.simulation.time, self.simulation.dt
        return int((now + 1e-6 * dt) / every) > int((now - dt + 1e-6 * dt) / every)

    def write_fields(self) -> None:
        """Write the fields of the present step. Collective."""
        simulation = self.simulation
        self.writer.write(simulation.step, simulation.time, {field.name: field.output() for field in simulation.fields})

    def checkpoint(self) -> None:
        """Write a checkpoint, and let the solver forget what a resumed run could not know. Collective."""
        simulation = self.simulation
        self.last_checkpoint = checkpoints.write_checkpoint(
            self.files.checkpoints,
            simulation.step,
            simulation.time,
            simulation.dt,
            simulation.state(),
            {"version": __version__},
            self.comm,
            simulation.scene.checkpoint.keep,
        )
        simulation.solver.reset()

    def summarise(self, status: Literal["done", "stopped", "failed"]) -> None:
        """Write summary.json. Collective."""
        simulation = self.simulation
        iterations = self.iterations or [0]
        summary = Summary(
            status=status,
            steps=simulation.step,
            time=simulation.time,
            ranks=self.comm.size,
            unknowns=simulation.system.unknowns,
            wall_s=clock.perf_counter() - self.start,
            phases=simulation.phases,
            iterations={"mean": float(np.mean(iterations)), "max": max(iterations)},
            assemblies=simulation.assemblies(),
            conservation={"volume_error": self.volume_error},
            probes=self.probes,
            skipped=simulation.skipped(),
            versions=versions(),
        )
        write_summary(self.files.summary, summary, self.comm)

    def _story(self, error: SolveError) -> str:
        simulation = self.simulation
        last = (
            f"Last good checkpoint: {self.last_checkpoint}." if self.last_checkpoint else "There is no checkpoint yet."
        )
        return f"step {simulation.step + 1}, t = {simulation.time + simulation.dt:.6g} s: {error}\n{last}"


def _grid_info(simulation: Simulation) -> GridInfo | None:
    grid = getattr(simulation.fluid, "grid", None)
    if grid is None:
        return None
    return GridInfo(tuple(map(float, grid.origin)), tuple(map(float, grid.dx)), tuple(grid.cells[: grid.dim]))


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "petfsi": __version__,
        "python": platform.python_version(),
        "petsc": ".".join(map(str, petsc.PETSc.Sys.getVersion())),
        "numpy": np.__version__,
    }


def run_scene(
    scene: Scene,
    out: Path,
    steps: int | None,
    petsc_args: list[str],
    wall_limit: float | None,
    overwrite: bool,
) -> int:
    """Run a scene into a new directory; return the exit status. Collective.

    Everything that can be wrong with the scene and the options is found before the directory is made.
    """
    comm = MPI.COMM_WORLD
    solve.load_options(petsc_args, field_names(scene))
    simulation = Simulation(comm, scene)
    unread = simulation.prepare()
    files = RunDirectory.create(out, dump_scene(scene), solve.dump_options(), overwrite, comm)
    with Console(comm.rank, files.log, total=simulation.n_steps) as console:
        _greet(console, simulation, unread)
        run = Run(simulation, files, console)
        run.append_row()
        if scene.output.every:
            run.write_fields()
        last = simulation.n_steps if steps is None else min(steps, simulation.n_steps)
        return run.loop(last, Stop(comm, wall_limit))


def resume_run(
    directory: Path, steps: int | None, petsc_args: list[str], wall_limit: float | None, sets: list[str]
) -> int:
    """Go on from a run's newest good checkpoint; return the exit status. Collective."""
    comm = MPI.COMM_WORLD
    files = RunDirectory.open(directory, comm)
    scene = load_scene(files.scene, sets, only=RESUMABLE)
    solve.load_options(petsc_args, field_names(scene), base=files.options)
    simulation = Simulation(comm, scene)
    with Console(comm.rank, files.log, total=simulation.n_steps) as console:
        found = checkpoints.find_checkpoint(files.checkpoints, comm, console.warn)
        if found is None:
            raise InputError(
                f"{directory}: no checkpoint can be read; start again with 'petfsi run {files.scene} --out ...'"
            )
        unread = simulation.prepare()  # of the scene's start: it would move the fluid's faces to the restored solid
        simulation.solver.reset()
        with checkpoints.read_checkpoint(found, comm) as stored:
            simulation.restore(found.step, {field.name: stored.group(field.name) for field in simulation.fields})
        _greet(console, simulation, unread)
        console.note(f"resuming at step {found.step}, t = {found.time:.6g} s, from {found.path}")
        run = Run(simulation, files, console)
        run.last_checkpoint = found.path
        run.history.truncate(found.step)
        run.writer.truncate(found.step)
        last = simulation.n_steps if steps is None else min(found.step + steps, simulation.n_steps)
        return run.loop(last, Stop(comm, wall_limit))


def _greet(console: Console, simulation: Simulation, unread: list[str]) -> None:
    size = ", ".join(f"{name} {n:,}" for name, n in simulation.system.unknowns.items())
    title = simulation.scene.title or "untitled"
    console.note(f"petfsi {__version__}: {title}; unknowns: {size}; ranks: {simulation.comm.size}")
    for name in unread:
        console.warn(f"option -{name} was read by nothing")
