"""The output times of a run, read back: which of them are wanted, and what each holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from petfsi.errors import InputError
from petfsi.output import hdf5
from petfsi.output.fields import field_files

#: Times that differ by no more, as a part of the later one, are the same: they are sums of steps.
_SAME = 1e-9


@dataclass(frozen=True)
class Frame:
    """What one output file holds; cell data as (nx, ny[, nz]), all else a row per node or particle."""

    step: int
    time: float
    fluid: dict[str, np.ndarray]
    solid: dict[str, np.ndarray] = field(default_factory=dict)
    particles: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def points(self) -> np.ndarray | None:
        """Where the solids' nodes are, m."""
        return self.solid.get("points")


@dataclass(frozen=True)
class Wanted:
    """What of a run is to be drawn.

    Attributes
    ----------
    every : int
        Every so many output times, of those between ``begin`` and ``end``.
    begin, end : float or None
        The first and the last time, s; None where that is the run's.
    quantity : str or None
        What is coloured, of ``QUANTITIES``; None for the first of them that the run has and that varies.
    """

    every: int = 1
    begin: float | None = None
    end: float | None = None
    quantity: str | None = None

    @property
    def all_times(self) -> bool:
        """Whether it names no time."""
        return self.begin is None and self.end is None

    def holds(self, time: np.ndarray) -> np.ndarray:
        """Return which times lie between ``begin`` and ``end``, both included."""
        slack = _SAME * np.abs(time)
        begin, end = (-math.inf if self.begin is None else self.begin), (math.inf if self.end is None else self.end)
        return (time >= begin - slack) & (time <= end + slack)


def wanted_files(directory: Path, wanted: Wanted) -> list[Path]:
    """Return the files of the output times that are wanted; none of a run without fields.

    Raises
    ------
    InputError
        When the run has output times, but none of them is wanted.
    OSError
        When a file cannot be read.
    """
    paths = field_files(directory)
    if paths and not wanted.all_times:
        times = np.array([time_of(path) for path in paths])
        chosen = wanted.holds(times)
        if not chosen.any():
            raise InputError(f"{_range(wanted)}: no output time of {directory} lies there; {_told(times)}")
        paths = [path for path, inside in zip(paths, chosen, strict=True) if inside]
    return paths[:: wanted.every]


def wanted_rows(table: dict[str, np.ndarray], wanted: Wanted) -> dict[str, np.ndarray]:
    """Return the rows of a history that are wanted, whatever ``every`` says."""
    if "time" not in table or wanted.all_times:
        return table
    inside = wanted.holds(table["time"])
    if len(inside) and not inside.any():
        raise InputError(f"{_range(wanted)}: no step of the run lies there; {_told(table['time'])}")
    return {name: column[inside] for name, column in table.items()}


def time_of(path: Path) -> float:
    """Return the time of an output file, s."""
    with hdf5.reading(path) as file:
        return float(file.attrs["time"])


def _range(wanted: Wanted) -> str:
    ends = (("--from", wanted.begin), ("--to", wanted.end))
    return " ".join(f"{name} {time:g}" for name, time in ends if time is not None)


def _told(times: Sequence[float] | np.ndarray) -> str:
    if len(times) == 1:
        return f"there is t = {times[0]:.6g} s alone"
    return f"there are {len(times)} from t = {np.min(times):.6g} s to {np.max(times):.6g} s"


def read_frame(path: Path) -> Frame:
    """Return what a file of ``fields/`` holds."""
    with hdf5.reading(path) as file:
        fluid = {}
        for name, array in file.get("fluid", {}).items():
            data = array[()]
            dim = data.ndim - (name == "velocity")
            fluid[name] = data.transpose([*reversed(range(dim)), *range(dim, data.ndim)])
        solid, particles = (
            {name: file[group][name][()] for name in names if name in file.get(group, {})}
            for group, names in (
                ("solid", ("points", "displacement", "velocity")),
                ("particles", ("points", "velocity", "pressure")),
            )
        )
        return Frame(int(file.attrs["step"]), float(file.attrs["time"]), fluid, solid, particles)
