"""``fields/outputs.csv``: the files of the output times, a row each, so that a run knows which files are its own."""

from __future__ import annotations

import math
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from petfsi.output import files
from petfsi.output.growing import Table
from petfsi.output.manifest import Rows

HEADER = "file,step,time,bytes,blake2b,modified"
_NAME = re.compile(r"([0-9]{6,18})\.h5")
#: Up to so many bytes all output is read again when a run goes on; of more, those files that look touched.
READ_AGAIN = 2e9


@dataclass(frozen=True)
class Written:
    """An output file as it was written; ``modified`` in ns, as the system says."""

    file: str
    step: int
    time: float
    bytes: int
    blake2b: str
    modified: int

    @classmethod
    def of(cls, path: Path, name: str, step: int, time: float) -> Written:
        """Return what a file is now, to be known as ``name``; it is read once."""
        size, found = files.digest(path)
        return cls(name, step, time, size, found, os.lstat(path).st_mtime_ns)

    @classmethod
    def read(cls, line: str) -> Written | None:
        """Return what a row says; None of anything else."""
        words = line.split(",")
        try:
            file, step, time, size, found, modified = words
            row = cls(file, int(step), float(time), int(size), found, int(modified))
        except ValueError:
            return None
        match = _NAME.fullmatch(file)
        right = match and int(match[1]) == row.step and math.isfinite(row.time) and row.line() == line
        return row if right else None

    def line(self) -> str:
        """Return the row."""
        return f"{self.file},{self.step},{self.time!r},{self.bytes},{self.blake2b},{self.modified}"

    def damage(self, directory: Path, thorough: bool) -> str:
        """Return what is wrong with the file by now; nothing if it is as it was written."""
        path = directory / self.file
        try:
            stat = os.lstat(path)
            if path.is_symlink():
                return "is a link"
            if stat.st_size != self.bytes:
                return "has another size"
            if (thorough or stat.st_mtime_ns != self.modified) and files.digest(path)[1] != self.blake2b:
                return "has been changed"
        except FileNotFoundError:
            return "is missing"
        except OSError as error:
            return files.reason(error)
        return ""


class Outputs:
    """The list of a run's output files. Rank 0 alone."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.path = directory / "outputs.csv"
        self.rows: list[Written] = []
        self._table: Table | None = None

    def append(self, row: Written) -> None:
        """Add a file, before it gets its name: a kill in between leaves a row without a file."""
        self._started().append(row.line())
        self.rows.append(row)

    def _started(self) -> Table:
        if self._table is None:
            self._table = Table.begun(self.path, HEADER)
        return self._table

    def on_disk(self) -> Rows | None:
        """Return how much of the list there is, once it is on the disk."""
        return self._table.on_disk() if self._table else None

    def go_on(self, known: Rows | None, step: int) -> None:
        """Take up the known rows; remove the files of later ones, and the rows.

        Raises
        ------
        Changed
            If the known rows are not what they were; nothing is removed then.
        """
        if known is None:
            with suppress(OSError):
                self._remove(files.read_plain(self.path), step)
                self.path.unlink()
            return
        table, behind = Table.known(self.path, known)
        rows = map(Written.read, files.read_plain(self.path, known.bytes).decode(errors="replace").splitlines()[1:])
        self.rows = [row for row in rows if row is not None and row.step <= step]
        self._remove(behind, step)
        table.cut()
        self._table = table

    def _remove(self, behind: bytes, step: int) -> None:
        """Remove the files of rows after a step, whole or written in part."""
        for row in map(Written.read, behind.decode(errors="replace").split("\n")):
            if row is not None and row.step > step:
                (self.directory / row.file).unlink(missing_ok=True)

    def begin_anew(self, rows: list[Written]) -> None:
        """Write the list anew, of these files."""
        self._table, self.rows = Table.begun(self.path, HEADER), []
        for row in rows:
            self.append(row)

    def damaged(self) -> dict[str, str]:
        """Return what is wrong with which files."""
        thorough = sum(row.bytes for row in self.rows) <= READ_AGAIN
        found = {row.file: row.damage(self.directory, thorough) for row in self.rows}
        return {name: how for name, how in found.items() if how}
