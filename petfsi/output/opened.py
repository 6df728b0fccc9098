"""A run as Python reads it: ``petfsi.open_run``. Reads only, starts no MPI."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petfsi.errors import InputError
from petfsi.output.files import RUN_MARKER
from petfsi.output.summary import read_summary

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
        if not (self.path / RUN_MARKER).is_file():
            raise InputError(f"{self.path} is not the directory of a run: it has no {RUN_MARKER}")

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says; InputError if there is none."""
        return read_summary(self.path / "summary.json")

    @cached_property
    def history(self) -> dict[str, np.ndarray]:
        """The columns of ``history.csv``: an entry per step, the state at t = 0 first."""
        from petfsi.output.history import read_history

        columns = read_history(self.path / "history.csv")
        if "step" not in columns:
            raise InputError(f"{self.path / 'history.csv'} is not a history: it has no columns")
        return columns

    @cached_property
    def scene(self) -> Scene:
        """The scene as it was resolved."""
        from petfsi.scene.load import load_scene

        return load_scene(self.path / "scene.toml")

    def __repr__(self) -> str:
        return f"OpenedRun({str(self.path)!r})"
