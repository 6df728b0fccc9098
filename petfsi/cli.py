"""The commands, nothing else: what they import, they import when they run."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from petfsi import __version__
from petfsi.messages import screen
from petfsi.runs.arguments import Duration, Seconds, SolverCommand
from petfsi.runs.console import open_streams
from petfsi.runs.ending import (
    INTERRUPTED,
    alone,
    launched_rank,
    say,
    say_briefly_what_cannot_be_freed,
    start_mpi,
    together,
)

if TYPE_CHECKING:
    from mpi4py import MPI

    from petfsi.scene.schema import Scene
    from petfsi.simulation import Simulation

_set = click.option("--set", "sets", multiple=True, metavar="KEY=VALUE", help="Override a setting, e.g. time.dt=0.01.")
_steps = click.option("--steps", type=click.IntRange(min=1), help="Take at most this many steps, then stop, resumable.")
_wall = click.option(
    "--wall-limit",
    type=Duration(min=0, min_open=True),
    metavar="SECONDS",
    help="Checkpoint and stop, resumable, before this much time has passed since the process began.",
)


@click.group(context_settings={"max_content_width": 100})
@click.version_option(__version__, prog_name="petfsi", message="%(prog)s %(version)s")
def cli() -> None:
    """Advance fluids and deformable solids together, solved with PETSc.

    Works alone and under mpirun. Exit codes: 0 done, or as many steps taken as --steps says; 2 the scene or the
    options are wrong; 3 the solve failed or the state blew up; 75 stopped by a signal or --wall-limit, with a
    checkpoint; 130 interrupted a second time, at once.
    """


@cli.command(cls=SolverCommand)
@click.argument("scene", type=click.Path(path_type=Path))
@_set
@click.option("--out", type=click.Path(path_type=Path), help="Run directory; runs/<scene> by default.")
@_steps
@click.option("--overwrite", is_flag=True, help="Replace the run that stands in the run directory.")
@click.option(
    "--from",
    "source",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Begin at t = 0 with the state in the last good checkpoint of the run in DIR.",
)
@_wall
@click.pass_context
def run(
    ctx: click.Context,
    scene: Path,
    sets: tuple[str, ...],
    out: Path | None,
    steps: int | None,
    overwrite: bool,
    source: Path | None,
    wall_limit: float | None,
) -> NoReturn:
    """Run SCENE, a TOML file, into a new run directory."""
    petsc = ctx.meta["petsc"]

    def work(comm: MPI.Comm) -> int:
        with _staying():
            from petfsi.ranks import on_root
            from petfsi.scene.load import load_scene

            loaded = on_root(comm, lambda: load_scene(scene, sets))
            _start_petsc(petsc, comm)
            from petfsi.runs.run import run_scene

        return run_scene(loaded, out or Path("runs") / scene.stem, steps, petsc, wall_limit, overwrite, sets, source)

    ctx.exit(together(work))


@cli.command(cls=SolverCommand)
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@_set
@_steps
@_wall
@click.pass_context
def resume(
    ctx: click.Context, directory: Path, sets: tuple[str, ...], steps: int | None, wall_limit: float | None
) -> NoReturn:
    """Go on with the run in DIR from its last good checkpoint.

    --set may change [time] but its integrator, gravity, damping, body_force and loads of solids, output.every and
    [checkpoint]; PETSc options may change, too. The run remembers that.
    """
    petsc = ctx.meta["petsc"]

    def work(comm: MPI.Comm) -> int:
        with _staying():
            _start_petsc(petsc, comm)
            from petfsi.runs.run import resume_run

        return resume_run(directory, steps, petsc, wall_limit, list(sets))

    ctx.exit(together(work))


@cli.command(cls=SolverCommand)
@click.argument("scene", type=click.Path(path_type=Path))
@_set
@click.option("--quick", is_flag=True, help="Judge what the scene says alone: half a second, and no first step.")
@click.pass_context
def check(ctx: click.Context, scene: Path, sets: tuple[str, ...], quick: bool) -> NoReturn:
    """Print what SCENE would solve, or every mistake in it, without running.

    Its first step is made ready, too, which finds what only equations tell: probes outside bodies, options that PETSc
    refuses, steps without a solution.
    """

    def work() -> int:
        import numpy as np

        from petfsi.geometry.mesh_files import read_once
        from petfsi.runs.ahead import ahead
        from petfsi.runs.memory import refuse_too_large
        from petfsi.runs.plan import describe_plan, is_rehearsed
        from petfsi.scene.load import load_scene

        petsc = ctx.meta["petsc"]
        loaded = load_scene(scene, sets)
        refuse_too_large(loaded)
        if begun := ahead(loaded, ready=not quick and is_rehearsed(loaded)):
            say(begun)
        # what overflows is told of by those who judge what it gives
        with np.errstate(all="ignore"), read_once():
            plan = describe_plan(loaded, petsc, None if quick else lambda: _ready(loaded, petsc))
        say(plan)
        return 0

    ctx.exit(alone(work))


@cli.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--quantity",
    metavar="NAME",
    help="What is coloured: smoke, speed, pressure, vorticity or displacement, as far as the run has it; by default "
    "the first of smoke, speed and pressure that varies, or the displacement where there is no fluid.",
)
@click.option("--from", "begin", type=Seconds(), metavar="T", help="Draw outputs from this time on, s.")
@click.option("--to", "end", type=Seconds(), metavar="T", help="Draw outputs up to this time, s.")
@click.option("--every", type=click.IntRange(min=1), default=1, help="Draw every K-th of these only.", metavar="K")
@click.option("--format", "kind", type=click.Choice(["png", "pdf", "svg"]), help="Of pictures; png by default.")
@click.option(
    "--film",
    is_flag=False,
    flag_value="",
    metavar="[FILE]",
    help="Draw a film instead: FILE.gif, or FILE.mp4 where ffmpeg is installed; DIR/pictures/film.gif by default.",
)
@click.option("--fps", type=float, help="Frames per second of the film; by default real time, within 5 and 30.")
@click.pass_context
def plot(
    ctx: click.Context,
    directory: Path,
    quantity: str | None,
    begin: float | None,
    end: float | None,
    every: int,
    kind: str | None,
    film: str | None,
    fps: float | None,
) -> NoReturn:
    """Draw pictures of the run in DIR, or a film of it."""
    if fps is not None and film is None:
        raise click.UsageError("--fps is the speed of a film: give --film, too", ctx)
    if kind is not None and film is not None:
        raise click.UsageError("--format is that of pictures: a film is what the ending of --film FILE says", ctx)

    def work() -> int:
        _start_petsc()  # before the fields' code does, with a signal handler
        from petfsi.output.frames import Wanted

        wanted = Wanted(every, begin, end, quantity)
        if film is not None:
            if launched_rank() > 0:
                return 0  # a film is one file
            from petfsi.output.film import film_run

            file, frames, speed = film_run(directory, Path(film) if film else None, wanted, fps)
            say(f"{file}: {frames} frame{'s' if frames != 1 else ''}, {speed:.3g} per second")
            return 0
        from petfsi.output.pictures import plot_run

        for picture in plot_run(directory, wanted, kind or "png"):
            say(str(picture))
        return 0

    ctx.exit(alone(work))


@cli.command()
@click.argument("name", required=False)
@click.option("--out", type=click.Path(path_type=Path), default="runs/bench", help="Folder; runs/bench by default.")
@click.option("--quick", is_flag=True, help="Measure less, in a fraction of the time.")
@click.pass_context
def bench(ctx: click.Context, name: str | None, out: Path, quick: bool) -> NoReturn:
    """Measure petfsi against theory: bench NAME, or list what there is.

    Writes a table and a picture. Exit code 1 if a row is out of its bounds.
    """

    def work(comm: MPI.Comm) -> int:
        from petfsi.bench import describe, run_bench

        if name is None:
            say(describe())
            return 0
        _start_petsc()
        return run_bench(comm, name, out, quick)

    ctx.exit(together(work))


@cli.command()
@click.argument("target", metavar="SWEEP.toml|DIR", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the sweep; runs/<its file's name> by default.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Ranks at a time; by default one per core.")
@click.option("--only", default="", metavar="AXIS=POINT,...", help="Take these points, or runs of these names, alone.")
@click.option(
    "--retry",
    type=click.Choice(["failed", "lost", "refused", "changed"]),
    help="Run those of a state again: failed and changed ones from their start, and what was there is put aside.",
)
@click.option("--anew", is_flag=True, help="With --retry lost or refused: from their start, too.")
@click.option(
    "--dry-run", is_flag=True, help="Check all and print the runs, and which --retry begins again; write nothing."
)
@click.option("--status", is_flag=True, help="Print what became of the runs; start nothing.")
@click.option("--collect", is_flag=True, help="Write runs.csv again; start nothing.")
@click.pass_context
def sweep(ctx: click.Context, target: Path, **wanted: Any) -> NoReturn:
    """Run a scene at all points of axes, as SWEEP.toml says, or go on with the sweep in DIR.

    Exit codes: 0 every run has a result, be it that it failed; 1 some are lost or refused; 2 the file is wrong, and
    nothing was written; 75 stopped, goes on.
    """

    def work() -> int:
        if launched_rank() > 0:
            return 0
        from petfsi.runs.console import say  # which survives a reader who has left: runs are at work
        from petfsi.sweeps.command import Wanted
        from petfsi.sweeps.command import sweep as run_sweep

        return run_sweep(Wanted(target, **wanted), say)

    ctx.exit(alone(work))


@cli.command()
@click.pass_context
def info(ctx: click.Context) -> NoReturn:
    """Print versions, what PETSc was built with, solver prefixes and the shipped options files."""

    def work() -> int:
        _start_petsc()
        from petfsi.runs.plan import describe_info

        say(describe_info())
        return 0

    ctx.exit(alone(work))


@cli.command("help")
@click.argument("key", required=False)
@click.pass_context
def help_(ctx: click.Context, key: str | None) -> NoReturn:
    """Say what KEY of a scene means: its unit, default and choices, or those of all.

    KEY is a key or a table such as fluid.sides or solids.layer.young, or the last word of one: young.
    """

    def work() -> int:
        command = cli.get_command(ctx, key or "")
        if command is not None:
            say(command.get_help(click.Context(command, info_name=key, parent=ctx.parent)))
            return 0
        from petfsi.scene.reference import explain, reference

        say(reference() if key is None else explain(key))
        return 0

    ctx.exit(alone(work))


@cli.command()
@click.argument("path", type=click.Path(path_type=Path), default="scene.toml")
@click.option(
    "--kind",
    type=click.Choice(["grid", "particles", "solid"]),
    default="grid",
    help="What is in it: a fluid on a grid with an elastic flap (the default), particles with a beam, a solid alone.",
)
@click.pass_context
def new(ctx: click.Context, path: Path, kind: str) -> NoReturn:
    """Write a scene to begin with to PATH, scene.toml by default: it runs as it is, in seconds.

    What stands at PATH already stays.
    """

    def work() -> int:
        if launched_rank() > 0:
            return 0  # one file
        from petfsi.scene.starters import write_starter

        say(write_starter(path, kind))
        return 0

    ctx.exit(alone(work))


def _ready(scene: Scene, petsc: list[str]) -> Simulation:
    """Return the simulation of a scene, ready for its first step on this process alone."""
    with _staying():
        start_mpi()
        _start_petsc(petsc)
        from mpi4py import MPI

        from petfsi.runs.ready import made_ready

    return made_ready(MPI.COMM_SELF, scene, petsc)[0]


@contextmanager
def _staying() -> Iterator[None]:
    """Let Python look for no garbage in what is imported meanwhile, then or later: all of it stays.

    Looking through it, last when the process ends, takes longer than most of what is imported.
    """
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # once: of another run in one process there may be garbage by now
            gc.freeze()
        gc.enable()


def _start_petsc(words: Sequence[str] | None = None, comm: MPI.Comm | None = None) -> None:
    """Start PETSc with the options that count at its start, of a run or of none; nothing else reaches it from outside.

    The others are read later, by those who know where to look, but all are judged here. Collective if there is a comm.
    """
    import petsc4py

    from petfsi.ranks import on_root
    from petfsi.solving import options

    def read() -> list[str]:
        return [] if words is None else options.resolve(words, os.environ).starting()

    given = read() if comm is None else on_root(comm, read)
    hidden = {name: os.environ.pop(name) for name in ("PETSC_OPTIONS", "PETSC_OPTIONS_YAML") if name in os.environ}
    try:
        # PETSc's signal handler would end a run whose reader has left, or that is asked to stop while it sets up
        petsc4py.init(["petfsi", "-skip_petscrc", "-no_signal_handler", *given])
    finally:
        os.environ.update(hidden)
    say_briefly_what_cannot_be_freed()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code."""
    open_streams()
    try:
        return cli.main(args=arguments, prog_name="petfsi", standalone_mode=False) or 0
    except click.ClickException as error:
        if launched_rank() == 0:
            error.__dict__["message"] = screen(error.message)
            with suppress(OSError):
                error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
