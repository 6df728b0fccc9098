"""``history.csv``: a row for every step, always the same columns, exact numbers."""

from __future__ import annotations

import csv
import errno
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError, SolveError
from petfsi.output import files
from petfsi.ranks import on_root

#: The columns that hold whole numbers.
WHOLE = ("step", "iterations", "newton", "substeps")


def column_names(probes: Sequence[str], others: Sequence[str] = ()) -> list[str]:
    """Return the columns of a run: step, time, dt, those of the probes, iterations, residual, then others."""
    return ["step", "time", "dt", *probes, "iterations", "residual", *others]


class History:
    """The growing table of a run. All methods are collective; only rank 0 touches the file.

    An existing file is continued, after the end of its last whole row.

    Raises
    ------
    InputError
        When an existing file has other columns, or is damaged before its last row.
    """

    def __init__(self, path: Path, columns: Sequence[str], comm: MPI.Comm) -> None:
        self.path = Path(path)
        self.columns = list(columns)
        self.comm = comm
        if comm.rank == 0 and len(set(columns)) != len(self.columns):
            raise ValueError(f"a column stands twice in {columns}")
        self.truncate(None)

    def truncate(self, step: int | None) -> None:
        """Drop the rows after ``step``, or none but a torn last one. Collective."""
        self._on_root(lambda: self._rewrite(step))

    def append(self, row: Mapping[str, float]) -> None:
        """Write a row and hand it to the system, so that it outlives the process. Collective.

        Raises
        ------
        SolveError
            On all ranks, when the disk does not take it.
        """
        self._on_root(lambda: self._write(row))

    def _on_root(self, work: Callable[[], None]) -> None:
        try:
            on_root(self.comm, work)
        except OSError as error:
            last = ""
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                last = " The run can be resumed from its last checkpoint once there is room."
            why = files.agreed_reason(self.comm, error)
            raise SolveError(f"{self.path} could not be written: {why}.{last}") from error

    def _rewrite(self, step: int | None) -> None:
        rows: list[list[str]] = []
        if self.path.exists() and self.path.stat().st_size:
            header, rows = _rows(self.path)
            if header is not None and header != self.columns:
                raise InputError(f"{self.path} has the columns {', '.join(header)}, not {', '.join(self.columns)}")
        kept = [row for row in rows if step is None or int(row[0]) <= step]
        files.replace_text(self.path, "".join(",".join(row) + "\n" for row in [self.columns, *kept]))

    def _write(self, row: Mapping[str, float]) -> None:
        if row.keys() != set(self.columns):
            raise ValueError(f"a row of {self.path} has {sorted(row)} and should have {sorted(self.columns)}")
        text = ",".join(str(int(row[c])) if c in WHOLE else repr(float(row[c])) for c in self.columns)
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND)
        size = os.fstat(handle).st_size
        left = (text + "\n").encode()
        try:
            # in one call to the system, so that a kill tears at most the last row; a disk with room for a part of
            # it takes that and refuses the rest
            while left:
                left = left[os.write(handle, left) :]
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(handle, size)
            error.filename = str(self.path)
            raise
        finally:
            os.close(handle)


def _rows(path: Path) -> tuple[list[str] | None, list[list[str]]]:
    """Return header and whole rows as text; a last row without its line end is left out."""
    with open(path, encoding="utf-8", errors="replace", newline="") as file:
        lines = file.read().split("\n")[:-1]
    if not lines:
        return None, []
    header, *rows = csv.reader(lines)
    for number, row in enumerate(rows, start=2):
        try:
            good = len(row) == len(header) and [float(value) for value in row]
        except ValueError:
            good = False
        if not good:
            raise InputError(f"{path}, line {number}: not a row of {len(header)} numbers")
    return header, rows


def read_history(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a history; a torn last row is left out. Not collective."""
    try:
        header, rows = _rows(Path(path))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {os.strerror(error.errno or errno.EIO)}") from error
    table = list(zip(*rows, strict=True)) if rows else [()] * len(header or [])
    return {
        name: np.array([int(v) for v in column], dtype=np.int64) if name in WHOLE else np.array(column, dtype=float)
        for name, column in zip(header or [], table, strict=True)
    }
