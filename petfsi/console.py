"""What a run says while it runs: lines on rank 0, a progress bar where somebody watches, and log.txt."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Console:
    """Rank 0's voice; on other ranks every call does nothing. Not collective.

    On a terminal a bar shows the step and the rest stands above it; elsewhere, in a batch log, each step is a line.
    ``log_path`` gets every line, always; it is appended to, so that a resumed run continues it.

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
        self._log: IO[str] | None = None
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        if not self._speaks:
            return
        if log_path is not None:
            self._log = open(log_path, "a", encoding="utf-8")
        if sys.stdout.isatty():
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
            self._bar.update(self._task, completed=step, description=numbers)

    def note(self, text: str) -> None:
        """Say something once."""
        self._write(text)

    def warn(self, text: str) -> None:
        """Say what a user should look at though the run goes on."""
        self._write(f"warning: {text}")

    def _write(self, line: str, shown: bool = True) -> None:
        if not self._speaks:
            return
        if shown and self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif shown:
            print(line, flush=True)
        if self._log is not None:
            self._log.write(line + "\n")
            self._log.flush()  # a killed run must leave its last words

    def close(self) -> None:
        """Take the bar down and close the log."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
        if self._log is not None:
            self._log.close()
            self._log = None

    def __enter__(self) -> Console:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
