"""What a run has taken since its first step, over all the parts that stops and failures divide it into."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.output.history import read_history
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import read_summary
from petfsi.ranks import on_root


@dataclass
class Effort:
    """What was taken so far.

    Attributes
    ----------
    wall_s : float
        Of earlier parts, s.
    phases, assemblies : dict
        Of earlier parts, as in ``Summary``.
    steps, iterations, most : int
        How many steps, their iterations, and the most in one.
    volume_error : float
        The largest in a step.
    """

    wall_s: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    assemblies: dict[str, int] = field(default_factory=dict)
    steps: int = 0
    iterations: int = 0
    most: int = 0
    volume_error: float = 0.0

    def add_step(self, iterations: int, volume_error: float) -> None:
        """Count a step."""
        self.steps += 1
        self.iterations += iterations
        self.most = max(self.most, iterations)
        self.volume_error = max(self.volume_error, volume_error)

    def mean_and_max(self) -> dict[str, float]:
        """Return the mean and the largest number of iterations in a step."""
        return {"mean": self.iterations / max(self.steps, 1), "max": self.most}


def summed(earlier: Mapping[str, Any], present: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sums by name."""
    return {name: earlier.get(name, 0) + present.get(name, 0) for name in {**present, **earlier}}


def earlier_effort(files: RunDirectory, step: int, comm: MPI.Comm, tell: Callable[[str], None]) -> Effort:
    """Return what a run took up to a step whose row is the last in its history. Collective.

    Iterations are those of the history; the rest is in the summary of the part before. What that does not tell is said.
    """

    def look() -> tuple[Effort, str]:
        effort = _of_history(files)
        lost = "seconds and assemblies of earlier parts are not counted"
        if not files.summary.exists():
            return effort, f"there is no {files.summary.name}: {lost}"
        try:
            known = _take_summary(effort, read_summary(files.summary))
        except (InputError, KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
            return effort, f"{files.summary.name} is damaged: {lost}"
        missing = (
            f"{files.summary.name} ends at step {known}: seconds and assemblies of what came after are not counted"
        )
        return effort, "" if known >= step else missing

    found, missing = on_root(comm, look)
    if missing:
        tell(missing)
    return found


def _of_history(files: RunDirectory) -> Effort:
    """Return what the rows of the history tell."""
    rows = read_history(files.history)
    iterations, errors = rows["iterations"][rows["step"] > 0], rows.get("volume_error", np.zeros(0))
    return Effort(
        steps=len(iterations),
        iterations=int(iterations.sum()),
        most=int(iterations.max(initial=0)),
        volume_error=float(errors.max(initial=0.0)),
    )


def _take_summary(effort: Effort, content: dict[str, Any]) -> int:
    """Add what a summary tells, and return its last step; raise, with nothing added, if it is none."""
    wall_s = float(content["wall_s"])
    phases = {str(name): float(value) for name, value in content["phases"].items()}
    assemblies = {str(name): int(value) for name, value in content["assemblies"].items()}
    step = int(content["steps"])
    if not all(math.isfinite(value) and value >= 0 for value in [step, wall_s, *phases.values(), *assemblies.values()]):
        raise ValueError
    effort.wall_s, effort.phases, effort.assemblies = wall_s, phases, assemblies
    return step
