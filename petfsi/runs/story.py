"""How a run's log begins, and how it ends: who ran what, where, with what; what that took, and where things are."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections import Counter
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import numpy as np
from mpi4py import MPI

from petfsi import __version__, petsc
from petfsi.messages import shown
from petfsi.output.rundir import RunDirectory
from petfsi.output.summary import Summary
from petfsi.simulation import Simulation
from petfsi.solving.options import Options

#: Characters of a command or a name.
_LONG = 400


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "petfsi": __version__,
        "python": platform.python_version(),
        "petsc": ".".join(map(str, petsc.PETSc.Sys.getVersion())),
        "numpy": np.__version__,
    }


def beginning(simulation: Simulation, options: Options, files: RunDirectory) -> list[str]:
    """Return the first lines of a run, or of a part of it. Not collective."""
    title = shown(simulation.scene.title, 200) or "untitled"
    size = ", ".join(f"{name} {n:,}" for name, n in simulation.system.unknowns.items()) or "none"
    words = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return [
        f"petfsi {__version__}: {title}; unknowns: {size}; ranks: {simulation.comm.size}",
        f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S %z} on {platform.node()}, in {shown(_here(), _LONG)}",
        f"command: {shown(words, _LONG)}",
        f"versions: {_versions()}",
        f"options: {_in_force(options)}; they are in {files.options}",
    ]


def _here() -> str:
    try:
        return os.getcwd()
    except OSError:
        return "a folder that is gone"


def _versions() -> str:
    names = {"petfsi": "petfsi", "python": "Python", "petsc": "PETSc", "numpy": "NumPy"}
    library = MPI.Get_library_version().split(",")[0].split("\n")[0].strip("\0 ")
    return ", ".join([*(f"{names[name]} {number}" for name, number in versions().items()), library])


def _in_force(options: Options) -> str:
    """Return how many options are from where; those of users are told one by one beside."""
    origins = Counter(option.origin for option in options.chosen.values())
    return ", ".join(f"{number} of {shown(origin, _LONG)}" for origin, number in origins.items()) or "none"


def ending(summary: Summary, files: RunDirectory, seconds: float) -> list[str]:
    """Return the last lines of a run, or of a part of it: what was done and what it took, and where things are.

    Not collective.

    Parameters
    ----------
    summary : Summary
    files : RunDirectory
    seconds : float
        Of this part, s.
    """
    parts = "" if summary.wall_s - seconds < 0.01 else f", {_time(summary.wall_s)} with its earlier parts"
    steps = f"{summary.steps} step{'s' * (summary.steps != 1)}"
    lines = [f"{summary.status}: {steps}, t = {summary.time:.6g} s, in {_time(seconds)}{parts}"]
    if shares := _shares(summary.phases):
        lines.append(f"seconds of steps: {shares}; iterations: {_iterations(summary.iterations)}")
    return [*lines, f"in {files.path}: {', '.join(_present(files))}; pictures: petfsi plot {files.path}"]


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 120 else f"{minutes} min {rest:02d} s"


def _shares(phases: Mapping[str, float]) -> str:
    whole = sum(phases.values())
    longest = sorted(phases.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {_time(part)} ({part / whole:.0%})" for name, part in longest if part > 0)


def _iterations(iterations: Mapping[str, float]) -> str:
    return f"{iterations.get('mean', 0.0):.3g} a step, {iterations.get('max', 0):g} at most"


def _present(files: RunDirectory) -> list[str]:
    """Return the names of what a run has left in its directory."""
    known = [
        files.history,
        files.summary,
        *sorted(files.path.glob("*.xdmf")),
        *sorted(files.checkpoints.glob("*.h5"))[-1:],
    ]
    return [str(path.relative_to(files.path)) for path in known if path.is_file()]
