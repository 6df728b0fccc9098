"""A sweep as Python reads it: ``petfsi.open_sweep``. Reads only, starts no MPI."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from petfsi.output.opened import OpenedRun
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.table import rows_of


class OpenedSweep:
    """The folder of a sweep: by the name of a run its directory, in the order of the plan.

    Attributes
    ----------
    path : Path
    names : list of str
    """

    def __init__(self, path: Path | str) -> None:
        self._folder = SweepFolder.open(Path(path))
        self._runs = {run.name: run for run in self._folder.planned()}
        self.path, self.names = self._folder.path, list(self._runs)

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of ``runs.csv`` as they are now: name, axes, state, figures, errors."""
        return rows_of(self._folder, list(self._runs.values()))

    def __getitem__(self, name: str) -> OpenedRun:
        """Return a run; InputError if it has not begun."""
        if name not in self._runs:
            raise KeyError(name)
        return OpenedRun(self._folder.run(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)
