"""How a command ends, on one rank or on all: its exit code, and what is said of an exception."""

from __future__ import annotations

import errno
import os
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from petfsi.errors import PetfsiError, is_memory
from petfsi.messages import screen, shown
from petfsi.runs.console import is_launched

if TYPE_CHECKING:
    from mpi4py import MPI

#: The exit code of a command that was interrupted.
INTERRUPTED = 130
#: Seconds that ranks have to fail together before one that failed alone ends the others.
AGREE_SECONDS = 10.0
#: Names that a system has no place for, as too long ones.
NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR)
#: What the machine, not petfsi, refuses.
MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EMFILE, errno.EIO)


def launched_rank() -> int:
    """Return this process's rank as the launcher says, without starting MPI; 0 where there is none."""
    names = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "MV2_COMM_WORLD_RANK")
    return next((int(os.environ[name]) for name in names if os.environ.get(name, "").isdigit()), 0)


def say(text: str) -> None:
    """Say something on rank 0."""
    if launched_rank() == 0:
        click.echo(text)


def _complain(text: str) -> None:
    with suppress(OSError):  # nobody listens; the exit code still tells
        click.echo(f"petfsi: {text}", err=True)


def alone(work: Callable[[], int]) -> int:
    """Return the exit code of work that every rank does by itself; rank 0 alone speaks."""
    try:
        return work()
    except BrokenPipeError:
        raise  # click's: the reader of our output has left
    except (Exception, KeyboardInterrupt) as error:
        code, text = _verdict(error)
        if launched_rank() == 0:
            _complain(text)
        return code


def together(work: Callable[[Any], int]) -> int:
    """Return the exit code of collective work.

    Ranks that fail together end together, and rank 0 says why. A rank that fails alone ends the others, who wait
    for it in some collective call, once they have had ``AGREE_SECONDS`` to join.
    """
    try:
        start_mpi()
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


def say_briefly_what_cannot_be_freed() -> None:
    """Let PETSc, which has been started, have a line where it cannot free a solver at the process's end."""
    sys.unraisablehook = _say_in_a_line


def _say_in_a_line(what: sys.UnraisableHookArgs) -> None:
    if what.exc_value is None or type(what.exc_value).__module__ != "petsc4py.PETSc":
        sys.__unraisablehook__(what)
    elif launched_rank() == 0:
        _complain(f"PETSc could not free all that it held: {shown(str(what.exc_value).splitlines()[0], 200)}")


def start_mpi() -> None:
    """Start MPI; a process that no launcher has started looks for no network cards, for which it would wait."""
    alone = not is_launched() and "OMPI_MCA_pml" not in os.environ
    if alone:
        os.environ["OMPI_MCA_pml"] = "ob1"
    try:
        import mpi4py.MPI  # noqa: F401
    finally:
        if alone:  # what it starts is not alone
            del os.environ["OMPI_MCA_pml"]


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
    package = str(Path(__file__).parents[1])
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(package)]
    if not frames:
        return "an unknown place"
    return f"petfsi/{Path(frames[-1].filename).relative_to(package)}:{frames[-1].lineno}"
