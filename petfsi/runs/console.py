"""What a run says while it runs: lines on rank 0, a progress bar where somebody watches, and log.txt."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from petfsi.messages import escaped

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

#: Number, name and mode of what a process is given.
STREAMS = ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w"))

#: What MPI launchers tell a process; Open MPI's gives rank 0 a terminal of its own, wherever its output goes.
LAUNCHERS = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK", "MV2_COMM_WORLD_SIZE")


def is_launched() -> bool:
    """Return whether an MPI launcher has started this process."""
    return any(name in os.environ for name in LAUNCHERS)


def open_streams() -> None:
    """Let what a process was not given of its streams lead nowhere: files opened next would take their numbers."""
    for number, name, mode in STREAMS:
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))


def say(line: str) -> None:
    """Print a line at once; a reader who has left ends nothing."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except (OSError, ValueError):
        # what is left in the buffer would be tried again, and complained of, when Python ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Console:
    """Rank 0's voice; on other ranks every call does nothing. Not collective.

    On a terminal a bar shows the step and the rest stands above it; elsewhere, in a batch log or under an MPI
    launcher, each step is a line. ``log_path`` gets every line, always; it is appended to, so that a resumed run
    continues it. Neither a full disk nor a reader who has left ends the run here: other files tell of the first.

    Parameters
    ----------
    rank : int
        This process's rank.
    log_path : Path, optional
        The file that gets a copy.
    total : int, optional
        The number of the last step, for the bar.
    """

    def __init__(self, rank: int, log_path: Path | None = None, total: int | None = None) -> None:
        self._speaks = rank == 0
        self._log: int | None = None
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        if not self._speaks:
            return
        if log_path is not None:
            with suppress(OSError):
                self._log = os.open(
                    log_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666
                )
        if sys.stdout.isatty() and not is_launched():
            self._start_bar(total)

    def _start_bar(self, total: int | None) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        self._bar = Progress(*columns, transient=True)
        self._task = self._bar.add_task("", total=total)
        self._bar.start()

    def step(self, step: int, time: float, dt: float, iterations: int, residual: float, seconds: float) -> None:
        """Report a finished step."""
        if not self._speaks:
            return
        numbers = f"t {time:.4f}  dt {dt:.4g}  its {iterations}  res {residual:.1e}  {seconds:.2f} s"
        self._write(f"step {step}  {numbers}", shown=self._bar is None)
        if self._bar is not None and self._task is not None:
            with self._watched() as bar:
                bar.update(self._task, completed=step, description=numbers)

    def note(self, text: str) -> None:
        """Say something once."""
        self._write(text)

    def warn(self, text: str) -> None:
        """Say what a user should look at though the run goes on."""
        self._write(f"warning: {text}")

    def say(self, text: str) -> None:
        """Say something that the log file has no need of."""
        self._write(text, logged=False)

    def log(self, text: str) -> None:
        """Say something in the log file only."""
        self._write(text, shown=False)

    def _write(self, line: str, shown: bool = True, logged: bool = True) -> None:
        if not self._speaks:
            return
        line = "\n".join(escaped(part) for part in line.split("\n"))
        if shown and self._bar is not None:
            with self._watched() as bar:
                bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif shown:
            say(line)
        if logged and self._log is not None:
            with suppress(OSError):  # unbuffered: a killed run leaves its last words
                os.write(self._log, (line + "\n").encode())

    @contextmanager
    def _watched(self) -> Iterator[Progress]:
        """Give the bar up when its terminal has gone."""
        assert self._bar is not None
        try:
            yield self._bar
        except OSError:
            self._bar = None

    def close(self) -> None:
        """Take the bar down and close the log."""
        if self._bar is not None:
            with self._watched() as bar:
                bar.stop()
            self._bar = None
        if self._log is not None:
            os.close(self._log)
            self._log = None

    def __enter__(self) -> Console:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
