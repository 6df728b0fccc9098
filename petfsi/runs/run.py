"""Runs begin and go on: what has to fit before anything is written, and what is told first."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from mpi4py import MPI

from petfsi import __version__
from petfsi.errors import InputError
from petfsi.geometry.mesh_files import read_once
from petfsi.output import checkpoint as checkpoints
from petfsi.output.lock import held, refuse_if_held
from petfsi.output.manifest import Change, Leg, OriginMark
from petfsi.output.mesh_files import mesh_files, own_names
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import read_summary
from petfsi.ranks import on_root
from petfsi.runs.ahead import ahead
from petfsi.runs.console import Console, say
from petfsi.runs.legs import describe_changes, find_changes, judge_changes
from petfsi.runs.origin import Origin
from petfsi.runs.plan import MAX_COUNTED, read_files, told_of
from petfsi.runs.ready import made_ready
from petfsi.runs.running import DONE, Run
from petfsi.runs.stop import Stop
from petfsi.runs.story import beginning
from petfsi.scene.changes import RESUMABLE
from petfsi.scene.load import dump_scene, load_scene
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation
from petfsi.solving.option_database import load_options
from petfsi.solving.options import Options

#: Lines about what is wrong with a run directory.
MAX_TOLD = 8


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
    with read_once():
        simulation, unread, options = made_ready(comm, scene, petsc_args, origin, _say_ahead)
        begins = on_root(comm, lambda: _begins(simulation))
    text = dump_scene(scene, own_names([mesh.mark for mesh in meshes], out))
    with held(out, comm, make=True) as lock:
        files = RunDirectory.create(out, text, options.dump(), overwrite, comm, meshes)
        leg = _leg(simulation, sets, petsc_args, origin=None if origin is None else origin.mark)
        known = on_root(comm, lambda: files.first_record(meshes, leg))
        with Console(comm.rank, files.log, total=_total(simulation, steps)) as console:
            _greet(console, simulation, options, unread, files, begins)
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
        options = load_options(petsc_args, stored=files.options)
        _say_ahead(comm, scene)
        with read_once():
            simulation = Simulation(comm, scene)
            # of the scene's start: it would move the fluid's faces to the restored solid
            unread = simulation.prepare(resumes_at=found.time)
        _restore(simulation, found)
        text = dump_scene(scene, own_names(list(known.meshes), directory))
        changes = find_changes(known.settings, text, options.dump())
        told = find_changes(on_root(comm, files.settings), text, options.dump())
        judge_changes(scene, changes, found.time)
        if changes and not simulation.finished:
            simulation.check_step()
        with Console(comm.rank, files.log, total=_total(simulation, None)) as console:
            if simulation.finished and on_root(comm, lambda: _is_done(files, found.step)):
                console.say(
                    f"{directory}: this run is done, at step {found.step}, t = {found.time:.6g} s; nothing was "
                    f"changed. To go on, give it a later end: petfsi resume {directory} --set time.end=..."
                )
                return DONE
            for line in damaged:
                console.warn(line)
            # what is wrong with a scene as it was has been said
            begins = on_root(comm, lambda: _begins(simulation)) if told else ([], [])
            _greet(console, simulation, options, unread, files, begins)
            console.note(f"resuming at step {found.step}, t = {found.time:.6g} s, from {found.path}")
            run = Run(simulation, files, console, known, lock)
            run.open(after=found.step)
            leg = _leg(simulation, sets, petsc_args, changes)
            run.known = on_root(comm, lambda: files.change(known, text, options.dump(), leg))
            for line in describe_changes(told, found.step, found.time):
                console.note(line)
            with run.recorded():
                return run.loop(steps, stop)


def _say_ahead(comm: MPI.Comm, scene: Scene) -> None:
    """Say what is made ready now, where that takes long. Collective."""
    line = on_root(comm, lambda: ahead(scene, comm.size))
    if line and comm.rank == 0:
        say(line)


def _restore(simulation: Simulation, found: checkpoints.CheckpointInfo) -> None:
    """Take up the state of a checkpoint. Collective; InputError on all ranks if it is not one of the scene's."""
    with checkpoints.read_checkpoint(found, simulation.comm) as stored, checkpoints.taken_up(found):
        simulation.restore(stored.step, stored.time, stored.dt, stored.group)


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


def _is_done(files: RunDirectory, step: int) -> bool:
    """Return whether a run has said that it is done; one that was killed at its end goes on to say so."""
    try:
        told = read_summary(files.summary)
        return (told["status"], told["steps"]) == ("done", step)
    except (InputError, KeyError, TypeError):
        return False


def _total(simulation: Simulation, steps: int | None) -> int | None:
    """Return the number of the last step, for the bar; None where counting would take long."""
    known = [n for n in (simulation.last_step(MAX_COUNTED), steps) if n is not None]
    return min(known, default=None)


def _greet(
    console: Console,
    simulation: Simulation,
    options: Options,
    unread: list[str],
    files: RunDirectory,
    begins: tuple[list[str], list[str]] = ([], []),
) -> None:
    if begun := ahead(simulation.scene, simulation.comm.size):
        console.log(begun)  # it was said before there was a log
    for line in beginning(simulation, options, files):
        console.note(line)
    told = [part.notes for part in (simulation.fluid, simulation.watch, simulation.guard) if part is not None]
    read, warned = begins
    for note in [*options.notes, *chain.from_iterable(told), *read, *simulation.notes]:
        console.note(note)
    for line in warned:
        console.warn(line)
    for name in unread:
        console.warn(f"option -{name} was read by nothing")


def _begins(simulation: Simulation) -> tuple[list[str], list[str]]:
    """Return what to say of the mesh files of a run that begins, and what to warn of. Not collective."""
    meshes, files = read_files(simulation.scene)
    return files, [note.text for note in told_of(simulation, meshes) if note.warns]
