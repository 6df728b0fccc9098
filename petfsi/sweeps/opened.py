"""Runs and sweeps as Python reads them: ``petfsi.open_run`` and ``petfsi.open_sweep``. Reads only, starts no MPI."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petfsi.errors import InputError
from petfsi.output.summary import read_summary
from petfsi.sweeps.folder import BEGUN, SweepFolder
from petfsi.sweeps.states import look_at
from petfsi.sweeps.table import row_of

if TYPE_CHECKING:
    import numpy as np

    from petfsi.scene.schema import Scene


class OpenedRun:
    """A run directory. What it holds is read when it is asked for.

    Attributes
    ----------
    path : Path
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not (self.path / BEGUN).is_file():
            raise InputError(f"{self.path} is not the directory of a run: it has no {BEGUN}")

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says; InputError if there is none."""
        return read_summary(self.path / "summary.json")

    @cached_property
    def history(self) -> dict[str, np.ndarray]:
        """The columns of ``history.csv``: an entry per step, the state at t = 0 first."""
        from petfsi.output.history import read_history

        return read_history(self.path / "history.csv")

    @cached_property
    def scene(self) -> Scene:
        """The scene as it was resolved."""
        from petfsi.scene.load import load_scene

        return load_scene(self.path / "scene.toml")

    def __repr__(self) -> str:
        return f"OpenedRun({str(self.path)!r})"


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
        """Return the rows of ``runs.csv`` as they are now: name, axes, state, figures."""
        return [row_of(run, look_at(self._folder.run(name), run)) for name, run in self._runs.items()]

    def __getitem__(self, name: str) -> OpenedRun:
        """Return a run; InputError if it has not begun."""
        if name not in self._runs:
            raise KeyError(name)
        return OpenedRun(self._folder.run(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)
