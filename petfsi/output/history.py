"""``history.csv``: a row for every step, always the same columns, exact numbers."""

from __future__ import annotations

import csv
import errno
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petfsi.errors import InputError, SolveError
from petfsi.output import files
from petfsi.output.growing import Changed, Table
from petfsi.output.manifest import Rows
from petfsi.ranks import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

#: The columns that hold whole numbers.
WHOLE = ("step", "iterations", "newton", "substeps")


def column_names(probes: Sequence[str], others: Sequence[str] = ()) -> list[str]:
    """Return the columns of a run: step, time, dt, those of the probes, iterations, residual, then others."""
    return ["step", "time", "dt", *probes, "iterations", "residual", *others]


class History:
    """The growing table of a run. All methods are collective; only rank 0 touches the file.

    Parameters
    ----------
    path : Path
    columns : sequence of str
    comm : MPI.Comm
    known : Rows, optional
        Of a run that goes on: the rows that its checkpoint counts. Those behind them are dropped. Without it the table
        is new.
    spare : collection of str
        Columns that come and go with what may change when a run goes on. It keeps those that its table began with.

    Attributes
    ----------
    columns : list of str
        Of the table.

    Raises
    ------
    InputError
        When the known rows are not what they were, or have columns that differ by more than ``spare``.
    """

    def __init__(
        self,
        path: Path,
        columns: Sequence[str],
        comm: MPI.Comm,
        known: Rows | None = None,
        spare: Collection[str] = (),
    ) -> None:
        self.path = Path(path)
        self.columns = list(columns)
        self.comm = comm
        if comm.rank == 0 and len(set(columns)) != len(self.columns):
            raise ValueError(f"a column stands twice in {columns}")
        self._table: Table | None = None
        self._on_root(lambda: self._open(known, spare))
        self.columns = comm.bcast(self.columns)

    def append(self, row: Mapping[str, float]) -> None:
        """Write the columns of a row and hand it to the system, so that it outlives the process. Collective.

        Raises
        ------
        SolveError
            On all ranks, when the disk does not take it.
        """
        self._on_root(lambda: self._write(row))

    def drop_last(self) -> None:
        """Take the last row back, that of a step of which not all could be written. Collective."""
        self._on_root(lambda: self._table.drop_last() if self._table else None)

    def on_disk(self) -> Rows:
        """Return how many rows there are, once they are on the disk. Collective.

        Raises
        ------
        SolveError
            On all ranks, when the disk does not take them.
        """
        return self._on_root(lambda: self._table.on_disk() if self._table else None)

    def _on_root(self, work: Callable[[], Any]) -> Any:
        try:
            return on_root(self.comm, work)
        except OSError as error:
            last = ""
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                last = " The run can be resumed from its last checkpoint once there is room."
            why = files.agreed_reason(self.comm, error)
            raise SolveError(f"{self.path} could not be written: {why}.{last}") from error

    def _open(self, known: Rows | None, spare: Collection[str]) -> None:
        if known is None:
            self._table = Table.begun(self.path, ",".join(self.columns))
            return
        self._table, _behind = known_rows(self.path, known)
        with open(files.open_plain(self.path), encoding="utf-8", errors="replace") as file:
            found = file.readline().rstrip("\n").split(",")
        if [name for name in found if name not in spare] != [name for name in self.columns if name not in spare]:
            raise InputError(f"{self.path} has the columns {', '.join(found)}, not {', '.join(self.columns)}")
        self.columns = found
        self._table.cut()

    def _write(self, row: Mapping[str, float]) -> None:
        if not row.keys() >= set(self.columns):
            raise ValueError(f"a row of {self.path} has {sorted(row)} and should have {sorted(self.columns)}")
        assert self._table is not None
        self._table.append(",".join(str(int(row[c])) if c in WHOLE else repr(float(row[c])) for c in self.columns))


def known_rows(path: Path, known: Rows) -> tuple[Table, bytes]:
    """Return a history whose first rows are those that a checkpoint counts, and what is behind them. Not collective.

    Raises
    ------
    InputError
        When they are not: how, and what can be done.
    """
    try:
        return Table.known(path, known)
    except Changed as error:
        how = str(error)
    with suppress(OSError):
        found = len(_rows(path)[1])
        if found < known.rows:
            how = f"it has {found} rows and should have {known.rows} or more"
    raise InputError(f"{path} is not the one whose {known.rows} rows the checkpoint counts: {how}; put it back")


def _rows(path: Path) -> tuple[list[str] | None, list[list[str]]]:
    """Return header and whole rows as text; a last row without its line end is left out."""
    with open(files.open_plain(path), encoding="utf-8", errors="replace", newline="") as file:
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
