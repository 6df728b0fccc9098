"""A run from its first step to its last: what it writes, when it stops, and how it goes on."""

from __future__ import annotations

import platform
import signal
import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Literal

import numpy as np
from mpi4py import MPI

from petfsi import __version__, petsc, solve
from petfsi.console import Console
from petfsi.errors import InputError, SolveError
from petfsi.fields.base import Slab
from petfsi.legs import describe_changes, find_changes, judge_changes
from petfsi.origin import Origin
from petfsi.output import checkpoint as checkpoints
from petfsi.output.fields import FieldWriter
from petfsi.output.history import History, column_names
from petfsi.output.lock import Lock, held, refuse_if_held
from petfsi.output.manifest import Change, Leg, OriginMark, Record
from petfsi.output.mesh_files import mesh_files, own_names
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import Summary, write_summary
from petfsi.output.xdmf import GridInfo
from petfsi.plan import MAX_COUNTED, default_options, skipped
from petfsi.ranks import on_root
from petfsi.scene.changes import RESUMABLE
from petfsi.scene.load import dump_scene, load_scene
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

DONE, STOPPED = 0, 75
#: Lines about what is wrong with a run directory.
MAX_TOLD = 8
#: Columns of history.csv that a scene has, or not, by what may change when its run goes on.
SPARE = ("newton", "substeps", "potential", "load_work")
Status = Literal["done", "stopped", "failed"]


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

    def __init__(
        self, simulation: Simulation, files: RunDirectory, console: Console, known: Record, lock: Lock | None
    ) -> None:
        self.simulation = simulation
        self.files = files
        self.known = known
        self.lock = lock
        self.console = console
        self.comm = simulation.comm
        self._begin = clock.perf_counter()
        self.iterations: list[int] = []
        self.volume_error = 0.0
        self.probes: dict[str, float] = {}
        self._slowest = 0.0

    def open(self, after: int | None = None) -> None:
        """Open what the run writes; of a run that goes on drop all after a step. Collective."""
        simulation = self.simulation
        simulation.report = self.console.note
        others = [*self.effort(), *self.flaws(), *simulation.accounts.columns]
        columns = column_names(simulation.probe_columns(), others)
        self.history = History(self.files.history, columns, self.comm, self.known.history, SPARE)
        if absent := set(columns) - set(self.history.columns):
            self.console.note(f"{self.files.history} keeps its columns: {', '.join(sorted(absent))} will not be in it")
        self.writer = FieldWriter(self.files.path, self.comm, _grid_info(simulation))
        if after is not None:
            self.writer.go_on(self.known, after, self.fields, self.console.warn)

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Leave a summary that says so when what is done inside fails, in whatever way. Not collective."""
        first = self.comm.rank == 0
        if first:
            self.files.keep_reserve()
        try:
            yield
        except BaseException as error:
            if first:
                self.files.free_reserve()
                with suppress(OSError, SolveError):  # what has failed already is the message, not this
                    write_summary(self.files.summary, self.summary("failed"), MPI.COMM_SELF)
                self.console.log(f"failed: {error}")
            raise
        finally:
            if first:
                self.files.free_reserve()

    def loop(self, steps: int | None, stop: Stop) -> int:
        """Step until the scene's end, or ``steps`` times; return the exit status. Collective."""
        simulation = self.simulation
        last = None if steps is None else simulation.step + steps
        done = simulation.finished
        while not done:
            begin = clock.perf_counter()
            self.advance()
            done = simulation.finished or simulation.step == last
            with simulation.phase("observe"):
                self.observe(final=done)
            seconds = clock.perf_counter() - begin
            self._slowest = max(self._slowest, seconds)
            outcome = simulation.outcome
            self.console.step(
                simulation.step, simulation.time, simulation.dt, outcome.iterations, outcome.residual, seconds
            )
            why = "" if done else stop.asked(self._slowest)
            if why:
                self.checkpoint()
                self.summarise("stopped")
                here = f"stopped by {why} after step {simulation.step}"
                self.console.note(f"{here}; go on with: petfsi resume {self.files.path}")
                return STOPPED
        self.checkpoint()
        self.summarise("done")
        return DONE

    def advance(self) -> None:
        """Take one step; what is wrong with the scene only now has become the step's failure. Collective."""
        simulation = self.simulation
        try:
            simulation.advance()
        except (SolveError, InputError) as error:
            now = simulation.time + simulation.dt
            last = checkpoints.last_good(self.files.checkpoints, self.comm)
            raise SolveError(f"step {simulation.step + 1}, t = {now:.6g} s: {error}\n{last}") from error

    def observe(self, final: bool) -> None:
        """Write what is due after a step. Collective."""
        simulation = self.simulation
        scene = simulation.scene
        if self.lock is not None:
            self.lock.touch()
        self.iterations.append(simulation.outcome.iterations)
        self.volume_error = max(self.volume_error, simulation.volume_error)
        self.append_row()
        if scene.output.every and (final or self._due(scene.output.every)):
            self.write_fields()
        if scene.checkpoint.every and not final and self._due(scene.checkpoint.every):
            self.checkpoint()

    def effort(self) -> dict[str, int]:
        """Return what the last step took besides iterations; what no step of the scene can take is left out."""
        simulation = self.simulation
        newton = {"newton": simulation.outcome.newton} if simulation.solver.iterates else {}
        return newton | ({"substeps": simulation.substeps} if simulation.divides else {})

    def flaws(self) -> dict[str, float]:
        """Return how far the last step's flow was from keeping volumes, or what else a fluid has to say. Collective."""
        simulation = self.simulation
        if simulation.fluid is not None and simulation.regions is None:
            return simulation.fluid.tally()
        return {"volume_error": simulation.volume_error, "divergence": simulation.divergence()}

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
                "newton": simulation.outcome.newton,
                "substeps": simulation.substeps,
                **simulation.accounts.sums,
                **self.flaws(),
                **simulation.accounts.values,
            }
        )

    def _due(self, every: float) -> bool:
        now, dt = self.simulation.time, self.simulation.dt
        return int((now + 1e-6 * dt) / every) > int((now - dt + 1e-6 * dt) / every)

    def fields(self) -> dict[str, dict[str, Slab]]:
        """Return the fields of the present step. Collective."""
        return {field.name: field.output() for field in self.simulation.fields}

    def write_fields(self) -> None:
        """Write the fields of the present step. Collective."""
        self.writer.write(self.simulation.step, self.simulation.time, self.fields())

    def checkpoint(self) -> None:
        """Write a checkpoint, and let the solver forget what a resumed run could not know. Collective.

        What the checkpoint counts is on the disk before it.
        """
        simulation = self.simulation
        present = {"history": self.history.on_disk(), **self.writer.on_disk()}
        checkpoints.write_checkpoint(
            self.files.checkpoints,
            simulation.step,
            simulation.time,
            simulation.dt,
            simulation.state(),
            {"version": __version__},
            self.comm,
            simulation.scene.checkpoint.keep,
            self.known.model_copy(update=present),
        )
        simulation.forget()

    def conservation(self) -> dict[str, float]:
        """Return what the run kept, and how well. Not collective."""
        simulation = self.simulation
        of_pressure = simulation.fluid is None or simulation.regions is not None
        return ({"volume_error": self.volume_error} if of_pressure else {}) | simulation.accounts.values

    def summarise(self, status: Status) -> None:
        """Write summary.json. Collective."""
        write_summary(self.files.summary, self.summary(status), self.comm)

    def summary(self, status: Status) -> Summary:
        """Return what the run was so far. Not collective."""
        simulation = self.simulation
        iterations = self.iterations or [0]
        return Summary(
            status=status,
            steps=simulation.step,
            time=simulation.time,
            ranks=self.comm.size,
            unknowns=simulation.system.unknowns,
            wall_s=clock.perf_counter() - self._begin,
            phases=simulation.phases,
            iterations={"mean": float(np.mean(iterations)), "max": max(iterations)},
            assemblies=simulation.assemblies(),
            conservation=self.conservation(),
            probes=self.probes,
            skipped=skipped(simulation.scene),
            versions=versions(),
        )


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


# what overflows is found by those who judge a step and what it is made of, and told by them
@np.errstate(all="ignore")
def run_scene(
    scene: Scene,
    out: Path,
    steps: int | None,
    petsc_args: list[str],
    wall_limit: float | None,
    overwrite: bool,
    sets: Sequence[str] = (),
    source: Path | None = None,
) -> int:
    """Run a scene into a new directory, from the state of the run in ``source`` if any; return the exit status.

    Collective. Everything that can be wrong with the scene and the options is found before the directory is made.
    """
    comm = MPI.COMM_WORLD
    stop = Stop(comm, wall_limit)
    on_root(comm, lambda: RunDirectory.check_place(out, overwrite))
    on_root(comm, lambda: refuse_if_held(out))
    origin = Origin.find(source, out, comm) if source is not None else None
    meshes = on_root(comm, lambda: mesh_files(scene))
    solve.load_options(petsc_args, base=Path(on_root(comm, lambda: default_options(scene))))
    simulation = Simulation(comm, scene)
    unread = origin.begin(simulation) if origin is not None else simulation.prepare()
    simulation.probe()
    text = dump_scene(scene, own_names([mesh.mark for mesh in meshes], out))
    with held(out, comm, make=True) as lock:
        files = RunDirectory.create(out, text, solve.dump_options(), overwrite, comm, meshes)
        leg = _leg(simulation, sets, petsc_args, origin=None if origin is None else origin.mark)
        known = on_root(comm, lambda: files.first_record(meshes, leg))
        with Console(comm.rank, files.log, total=_total(simulation, steps)) as console:
            _greet(console, simulation, unread)
            run = Run(simulation, files, console, known, lock)
            with run.recorded():
                run.open()
                run.append_row()
                if scene.output.every:
                    run.write_fields()
                return run.loop(steps, stop)


@np.errstate(all="ignore")
def resume_run(
    directory: Path, steps: int | None, petsc_args: list[str], wall_limit: float | None, sets: list[str]
) -> int:
    """Go on from a run's newest good checkpoint; return the exit status. Collective.

    Nothing is written before all fits: the scene, the options, the meshes and the rows that the checkpoint counts.
    """
    comm = MPI.COMM_WORLD
    stop = Stop(comm, wall_limit)
    files = RunDirectory.open(directory, comm)
    with held(directory, comm) as lock:
        damaged: list[str] = []
        found = checkpoints.find_checkpoint(files.checkpoints, comm, damaged.append)
        if found is None:
            why = "".join(f"\n  {line}" for line in comm.bcast(damaged)[:MAX_TOLD])
            raise InputError(
                f"{directory}: no checkpoint can be read; start again with 'petfsi run {files.scene} --out ...'{why}"
            )
        known = found.manifest.run
        if misfits := on_root(comm, lambda: files.misfits(known)):
            lines = "".join(f"\n  {line}" for line in misfits[:MAX_TOLD])
            raise InputError(f"{directory} does not fit its checkpoint {found.path.name}; nothing was changed:{lines}")
        scene = on_root(comm, lambda: load_scene(files.scene, sets, only=RESUMABLE))
        solve.load_options(petsc_args, base=files.options)
        simulation = Simulation(comm, scene)
        # of the scene's start: it would move the fluid's faces to the restored solid
        unread = simulation.prepare(resumes_at=found.time)
        _restore(simulation, found)
        text, options = dump_scene(scene, own_names(list(known.meshes), directory)), solve.dump_options()
        changes = find_changes(known, text, options)
        judge_changes(scene, changes, found.time)
        if changes and not simulation.finished:
            simulation.check_step()
        with Console(comm.rank, files.log, total=_total(simulation, None)) as console:
            for line in damaged:
                console.warn(line)
            _greet(console, simulation, unread)
            console.note(f"resuming at step {found.step}, t = {found.time:.6g} s, from {found.path}")
            run = Run(simulation, files, console, known, lock)
            run.open(after=found.step)
            leg = _leg(simulation, sets, petsc_args, changes)
            run.known = on_root(comm, lambda: files.change(known, text, options, leg))
            for line in describe_changes(changes, found.step, found.time):
                console.note(line)
            with run.recorded():
                return run.loop(steps, stop)


def _restore(simulation: Simulation, found: checkpoints.CheckpointInfo) -> None:
    """Take up the state of a checkpoint. Collective; InputError on all ranks if it is not one of the scene's."""
    with checkpoints.read_checkpoint(found, simulation.comm) as stored:
        try:
            simulation.restore(stored.step, stored.time, stored.dt, stored.group)
        except (ValueError, IndexError, KeyError, TypeError, OverflowError, MemoryError) as error:
            what = " ".join(str(error).split())[:200]
            raise InputError(f"checkpoint {found.path} holds no state of this scene: {what}") from error


def _leg(
    simulation: Simulation,
    sets: Sequence[str],
    options: Sequence[str],
    changes: tuple[Change, ...] = (),
    origin: OriginMark | None = None,
) -> Leg:
    return Leg(
        step=simulation.step,
        time=simulation.time,
        ranks=simulation.comm.size,
        petfsi=__version__,
        sets=tuple(sets),
        options=tuple(options),
        changes=changes,
        origin=origin,
    )


def _total(simulation: Simulation, steps: int | None) -> int | None:
    """Return the number of the last step, for the bar; None where counting would take long."""
    known = [n for n in (simulation.last_step(MAX_COUNTED), steps) if n is not None]
    return min(known, default=None)


def _greet(console: Console, simulation: Simulation, unread: list[str]) -> None:
    size = ", ".join(f"{name} {n:,}" for name, n in simulation.system.unknowns.items())
    title = simulation.scene.title or "untitled"
    console.note(f"petfsi {__version__}: {title}; unknowns: {size}; ranks: {simulation.comm.size}")
    told = [part.notes for part in (simulation.fluid, simulation.watch, simulation.guard) if part is not None]
    for note in [*chain.from_iterable(told), *simulation.notes]:
        console.note(note)
    for name in unread:
        console.warn(f"option -{name} was read by nothing")
