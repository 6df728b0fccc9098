"""A simulation with its run directory: its steps, what they write, and when they stop."""

from __future__ import annotations

import re
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Literal

from mpi4py import MPI

from petfsi import __version__
from petfsi.errors import InputError, SolveError
from petfsi.fields.slabs import Slab
from petfsi.output import checkpoint as checkpoints
from petfsi.output.fields import FieldWriter
from petfsi.output.history import History, column_names
from petfsi.output.lock import Lock
from petfsi.output.manifest import Record
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import Summary, write_summary
from petfsi.output.xdmf import GridInfo
from petfsi.runs.console import Console
from petfsi.runs.effort import Effort, earlier_effort, summed
from petfsi.runs.failure import describe_failure
from petfsi.runs.kept import Kept
from petfsi.runs.plan import skipped
from petfsi.runs.stop import Stop
from petfsi.runs.story import ending, versions
from petfsi.simulation import Simulation

DONE, STOPPED = 0, 75
#: Columns of history.csv that a scene has, or not, by what may change when its run goes on.
SPARE = ("newton", "substeps", "potential", "load_work")
Status = Literal["running", "done", "stopped", "failed"]
#: What those who write files say of checkpoints.
_LAST_GOOD = re.compile(r"\s*(Last good checkpoint: .*\.h5\.|There is no checkpoint\.)")


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
        self.effort = Effort()
        self.probes: dict[str, float] = {}
        self._saved: int | None = None
        self._row = -1
        self._taking = simulation.step
        self._slowest = self._writing = 0.0

    def open(self, after: int | None = None) -> None:
        """Open what the run writes; of a run that goes on drop all after a step, that of its checkpoint. Collective."""
        simulation = self.simulation
        simulation.report = self.console.note
        others = [*self.counts(), *self.flaws(), *simulation.accounts.columns]
        columns = column_names(simulation.probe_columns(), others)
        self.history = History(self.files.history, columns, self.comm, self.known.history, SPARE)
        if absent := set(columns) - set(self.history.columns):
            self.console.note(f"{self.files.history} keeps its columns: {', '.join(sorted(absent))} will not be in it")
        self.writer = FieldWriter(self.files.path, self.comm, _grid_info(simulation))
        if after is not None:
            self.writer.go_on(self.known, after, self.fields, self.console.warn)
            self.effort = earlier_effort(self.files, after, self.comm, self.console.note)
            self._saved = after
            self.probes = self._read_probes()

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Leave a summary that says that this is running, and when it fails, in whatever way, so. Not collective."""
        first = self.comm.rank == 0
        if first:
            self.files.keep_reserve()
            with suppress(OSError, SolveError):  # what keeps it from being written keeps the last one, and is told then
                write_summary(self.files.summary, self.summary("running", ""), MPI.COMM_SELF)
        try:
            yield
        except BaseException as error:
            if first:
                self.files.free_reserve()
                summary = self.summary("failed", str(error).split("\n")[0])
                summary.failure = self._failure(error)
                with suppress(OSError, SolveError):  # what has failed already is the message, not this
                    write_summary(self.files.summary, summary, MPI.COMM_SELF)
                self.console.log(f"failed: {error}")
                with suppress(OSError):
                    self.tell(self.console.log, summary)
            raise
        finally:
            if first:
                self.files.free_reserve()

    def _failure(self, error: BaseException) -> dict[str, Any]:
        """Return what the summary says of a failure. Not collective."""
        newest = checkpoints.newest_checkpoint(self.files.checkpoints)
        where = "" if newest is None else str(newest.relative_to(self.files.path))
        return describe_failure(error, self._taking, self.simulation.time, where)

    def loop(self, steps: int | None, stop: Stop) -> int:
        """Step until the scene's end, or ``steps`` times, or until told to stop; return the exit status. Collective."""
        simulation = self.simulation
        last = None if steps is None else simulation.step + steps
        while not simulation.finished and simulation.step != last:
            why = stop.asked(self._slowest + self._writing)
            if why:
                return self.end("stopped", why)
            begin = clock.perf_counter()
            self.take_step(last)
            seconds = clock.perf_counter() - begin
            self._slowest = max(self._slowest, seconds)
            outcome = simulation.outcome
            self.console.step(
                simulation.step, simulation.time, simulation.dt, outcome.iterations, outcome.residual, seconds
            )
        if simulation.finished:
            return self.end("done")
        self.end("stopped", f"--steps {steps}")
        return DONE

    def end(self, status: Status, why: str = "") -> int:
        """Leave a checkpoint of the present step, and a summary; return the exit status. Collective."""
        step = self.simulation.step
        if self._saved != step:
            self.checkpoint()
        else:  # whoever wrote it may have been killed before there were no more than are to be kept
            keep = self.simulation.scene.checkpoint.keep
            checkpoints.prune_checkpoints(self.files.checkpoints, step, keep, self.comm)
        summary = self.summary(status, why)
        write_summary(self.files.summary, summary, self.comm)
        self.tell(self.console.note, summary)
        doubt = self.simulation.guard.last_doubt(step)
        if doubt:
            self.console.warn(f"in the last step {doubt}")
        if status == "done":
            return DONE
        self.console.note(f"stopped by {why} after step {step}; go on with: petfsi resume {self.files.path}")
        return STOPPED

    def take_step(self, last: int | None) -> None:
        """Take a step and write what is due; leave the state before it if that fails. Collective.

        Raises
        ------
        SolveError
            On all ranks; what is wrong with the scene only now has become the step's failure.
        """
        simulation = self.simulation
        self._taking = simulation.step + 1
        before = None if self._saved == simulation.step else Kept.of(simulation)
        try:
            self.advance()
            final = simulation.finished or simulation.step == last
            with simulation.phase("observe"):
                self.observe(final)
        except SolveError as error:
            what = _LAST_GOOD.sub("", str(error))  # there may be a newer one now
            raise SolveError(f"{what}\n{self.rescue(before)}") from error
        every = simulation.scene.checkpoint.every
        if every and not final and self._due(every):
            with simulation.phase("observe"):
                self.checkpoint()

    def advance(self) -> None:
        """Take one step. Collective."""
        simulation = self.simulation
        try:
            simulation.advance()
        except (SolveError, InputError) as error:
            now = simulation.time + simulation.dt
            raise SolveError(f"step {simulation.step + 1}, t = {now:.6g} s: {error}") from error

    def rescue(self, before: Kept | None) -> str:
        """Write a checkpoint of the state before a failed step, if it is good; say where to go on. Collective."""
        newest = checkpoints.find_checkpoint(self.files.checkpoints, self.comm, lambda _line: None)
        if before is not None and before.is_finite() and (newest is None or newest.step < before.step):
            with suppress(SolveError):  # the disk that has failed, as a rule
                if self._row > before.step:  # then the step's fields could not be written
                    self.history.drop_last()
                self._write_checkpoint(before)
        last = checkpoints.last_good(self.files.checkpoints, self.comm)
        resumable = before is not None or newest is not None
        return f"{last} Go on from there with: petfsi resume {self.files.path}" if resumable else last

    def observe(self, final: bool) -> None:
        """Write the row, and the fields if they are due, after a step. Collective."""
        simulation = self.simulation
        every = simulation.scene.output.every
        if self.lock is not None:
            self.lock.touch()
        self.effort.add_step(simulation.outcome.iterations, simulation.volume_error)
        self.append_row()
        if every and (final or self._due(every)):
            self.write_fields()

    def counts(self) -> dict[str, int]:
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

    def _read_probes(self) -> dict[str, float]:
        """Return what the probes show now, by column. Collective."""
        return dict(zip(self.simulation.probe_columns(), self.simulation.probe(), strict=True))

    def append_row(self) -> None:
        """Add the present state to the history. Collective."""
        simulation = self.simulation
        self.probes = self._read_probes()
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
        self._row = simulation.step

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
        """Write a checkpoint, and let the solver forget what a resumed run could not know. Collective."""
        begin = clock.perf_counter()
        self._write_checkpoint(Kept.of(self.simulation))
        self.simulation.forget()
        self._writing = max(self._writing, clock.perf_counter() - begin)

    def _write_checkpoint(self, kept: Kept) -> None:
        """Write a checkpoint; what it counts is on the disk before it. Collective."""
        present = {"history": self.history.on_disk(), **self.writer.on_disk()}
        checkpoints.write_checkpoint(
            self.files.checkpoints,
            kept.step,
            kept.time,
            kept.dt,
            kept.state(),
            {"version": __version__},
            self.comm,
            self.simulation.scene.checkpoint.keep,
            self.known.model_copy(update=present),
        )
        self._saved = kept.step

    def conservation(self) -> dict[str, float]:
        """Return what the run kept, and how well. Not collective."""
        simulation = self.simulation
        of_pressure = simulation.fluid is None or simulation.regions is not None
        largest = {"volume_error": self.effort.volume_error} if of_pressure else {}
        return largest | simulation.accounts.values

    def tell(self, say: Callable[[str], None], summary: Summary) -> None:
        """Say what the run was so far, and where things are. Not collective."""
        if self.comm.rank == 0:
            for line in ending(summary, self.files, clock.perf_counter() - self._begin):
                say(line)

    def summary(self, status: Status, why: str) -> Summary:
        """Return what the run was so far. Not collective."""
        simulation, before = self.simulation, self.effort
        return Summary(
            status=status,
            reason=why,
            steps=simulation.step,
            time=simulation.time,
            ranks=self.comm.size,
            unknowns=simulation.system.unknowns,
            wall_s=before.wall_s + clock.perf_counter() - self._begin,
            phases=summed(before.phases, simulation.phases),
            iterations=before.mean_and_max(),
            assemblies=summed(before.assemblies, simulation.assemblies()),
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
