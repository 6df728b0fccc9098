"""The commands, nothing else: what they import, they import when they run."""

from __future__ import annotations

import errno
import gc
import os
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from petfsi import __version__
from petfsi.errors import PetfsiError, is_memory
from petfsi.messages import screen, shown
from petfsi.runs.console import is_launched, open_streams

if TYPE_CHECKING:
    from mpi4py import MPI

    from petfsi.scene.schema import Scene
    from petfsi.simulation import Simulation

INTERRUPTED = 130
#: Seconds that ranks have to fail together before one that failed alone ends the others.
AGREE_SECONDS = 10.0
#: Names that a system has no place for, as too long ones.
NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR)
#: What the machine, not petfsi, refuses.
MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EMFILE, errno.EIO)

_OPTION = re.compile(r"--?[A-Za-z]")


class SolverCommand(click.Command):
    """A command whose words with one dash belong to PETSc, each with the value behind it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take PETSc's options out, then parse the rest as click does."""
        own, petsc = self._split(ctx, args)
        ctx.meta["petsc"] = petsc
        try:
            return super().parse_args(ctx, own)
        except click.MissingParameter as error:
            if not petsc:
                raise
            hint = "Give it before the PETSc options: a word that follows one of them is its value."
            raise click.UsageError(f"{error.format_message()} {hint}", ctx) from None

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """Put the arguments first, as they must stand before PETSc's options."""
        arguments = [p.make_metavar(ctx) for p in self.get_params(ctx) if isinstance(p, click.Argument)]
        return [*arguments, "[OPTIONS]", "[PETSc options]..."]

    def _split(self, ctx: click.Context, args: list[str]) -> tuple[list[str], list[str]]:
        flags = {name: getattr(p, "is_flag", False) for p in self.get_params(ctx) for name in p.opts}
        own: list[str] = []
        petsc: list[str] = []
        words = list(reversed(args))
        while words:
            word = words.pop()
            if word == "-h":
                own.append("--help")
            elif f"-{word}" in flags and not word.startswith("--"):
                raise click.UsageError(f"'{word}': petfsi's own options have two dashes: -{word}", ctx)
            elif re.match(r"-[A-Za-z]", word):
                petsc.append(word)
                if words and not _OPTION.match(words[-1]):
                    petsc.append(words.pop())
            else:
                own.append(word)
                if flags.get(word) is False and words:
                    own.append(words.pop())
        return own, petsc


class Seconds(click.types.FloatParamType):
    """A time: a number."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return it; what is no number is within no range, and passes for one."""
        found = super().convert(value, param, ctx)
        if found != found:
            self.fail(f"{value!r} is no number", param, ctx)
        return found


class Duration(Seconds, click.FloatRange):
    """A time within a range."""


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

    ctx.exit(_together(work))


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

    ctx.exit(_together(work))


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
            _say(begun)
        # what overflows is told of by those who judge what it gives
        with np.errstate(all="ignore"), read_once():
            plan = describe_plan(loaded, petsc, None if quick else lambda: _ready(loaded, petsc))
        _say(plan)
        return 0

    ctx.exit(_alone(work))


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
            if _launched_rank() > 0:
                return 0  # a film is one file
            from petfsi.output.film import film_run

            file, frames, speed = film_run(directory, Path(film) if film else None, wanted, fps)
            _say(f"{file}: {frames} frame{'s' if frames != 1 else ''}, {speed:.3g} per second")
            return 0
        from petfsi.output.pictures import plot_run

        for picture in plot_run(directory, wanted, kind or "png"):
            _say(str(picture))
        return 0

    ctx.exit(_alone(work))


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
            _say(describe())
            return 0
        _start_petsc()
        return run_bench(comm, name, out, quick)

    ctx.exit(_together(work))


@cli.command()
@click.pass_context
def info(ctx: click.Context) -> NoReturn:
    """Print versions, what PETSc was built with, solver prefixes and the shipped options files."""

    def work() -> int:
        _start_petsc()
        from petfsi.runs.plan import describe_info

        _say(describe_info())
        return 0

    ctx.exit(_alone(work))


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
            _say(command.get_help(click.Context(command, info_name=key, parent=ctx.parent)))
            return 0
        from petfsi.scene.reference import explain, reference

        _say(reference() if key is None else explain(key))
        return 0

    ctx.exit(_alone(work))


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
        if _launched_rank() > 0:
            return 0  # one file
        from petfsi.scene.starters import write_starter

        _say(write_starter(path, kind))
        return 0

    ctx.exit(_alone(work))


def _ready(scene: Scene, petsc: list[str]) -> Simulation:
    """Return the simulation of a scene, ready for its first step on this process alone."""
    with _staying():
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


# ---- how commands end ---------------------------------------------------------------------------------------


def _launched_rank() -> int:
    """Return this process's rank as the launcher says, without starting MPI; 0 where there is none."""
    names = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "MV2_COMM_WORLD_RANK")
    return next((int(os.environ[name]) for name in names if os.environ.get(name, "").isdigit()), 0)


def _want_no_network() -> None:
    """Let Open MPI look for no network cards in a process that no launcher has started: it waits for them."""
    if not is_launched():
        os.environ.setdefault("OMPI_MCA_pml", "ob1")


def _say(text: str) -> None:
    if _launched_rank() == 0:
        click.echo(text)


def _complain(text: str) -> None:
    with suppress(OSError):  # nobody listens; the exit code still tells
        click.echo(f"petfsi: {text}", err=True)


def _alone(work: Callable[[], int]) -> int:
    """Return the exit code of work that every rank does by itself; rank 0 alone speaks."""
    try:
        return work()
    except BrokenPipeError:
        raise  # click's: the reader of our output has left
    except (Exception, KeyboardInterrupt) as error:
        code, text = _verdict(error)
        if _launched_rank() == 0:
            _complain(text)
        return code


def _together(work: Callable[[Any], int]) -> int:
    """Return the exit code of collective work.

    Ranks that fail together end together, and rank 0 says why. A rank that fails alone ends the others, who wait
    for it in some collective call, once they have had ``AGREE_SECONDS`` to join.
    """
    try:
        from mpi4py import MPI
    except Exception as error:
        code, text = _verdict(error)
        _complain(text)
        return code
    comm = MPI.COMM_WORLD
    apart = comm.Dup()  # a meeting here cannot be mistaken for one of the computation's own collectives
    try:
        return work(comm)
    except (Exception, KeyboardInterrupt) as error:
        code, text = _verdict(error)
    if not _all_arrive(apart):
        _complain(f"rank {comm.rank} of {comm.size} failed alone: {text}")
        comm.Abort(code)
    verdicts = apart.allgather((code, text))
    if comm.rank == 0:
        for said in dict.fromkeys(said for _, said in verdicts):
            _complain(said)
    return verdicts[0][0]


def _all_arrive(comm: MPI.Comm) -> bool:
    """Return whether every rank comes here in time."""
    request = comm.Ibarrier()
    limit = time.monotonic() + AGREE_SECONDS
    while not request.Test():
        if time.monotonic() > limit:
            return False
        time.sleep(0.01)
    return True


def _verdict(error: BaseException) -> tuple[int, str]:
    """Return the exit code and the words for an exception."""
    if os.environ.get("PETFSI_TRACEBACK") == "1":
        story = "".join(traceback.format_exception(error)).rstrip()
        return _verdict_in_short(error)[0], story
    return _verdict_in_short(error)


def _verdict_in_short(error: BaseException) -> tuple[int, str]:
    if isinstance(error, PetfsiError):
        return error.exit_code, screen(str(error), first=len("petfsi: "))
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, "interrupted"
    if is_memory(error):
        return 1, "the machine's memory is used up; 'petfsi check' estimates what a scene needs"
    if isinstance(error, OSError) and error.errno in NAMES:
        return 2, f"{shown(error.filename or 'a file', 200)}: {error.strerror}"
    if isinstance(error, UnicodeEncodeError):
        return 2, f"{shown(error.object, 200)}: is no text that can be written down (UTF-8)"
    if isinstance(error, OSError) and error.errno in MACHINE:
        return 1, f"{shown(error.filename or 'a file', 200)}: {error.strerror}"
    what = shown(" ".join(str(error).split()), 300)
    return 1, (
        f"{type(error).__name__}: {what} (at {_place(error)}); this is a defect in petfsi; "
        "set PETFSI_TRACEBACK=1 and run again to see where it comes from"
    )


def _place(error: BaseException) -> str:
    """Return the innermost line of petfsi that an exception passed."""
    package = str(Path(__file__).parent)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(package)]
    if not frames:
        return "an unknown place"
    return f"petfsi/{Path(frames[-1].filename).relative_to(package)}:{frames[-1].lineno}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code."""
    open_streams()
    _want_no_network()
    try:
        return cli.main(args=arguments, prog_name="petfsi", standalone_mode=False) or 0
    except click.ClickException as error:
        if _launched_rank() == 0:
            error.__dict__["message"] = screen(error.message)
            with suppress(OSError):
                error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
