"""Simulations for measurements: in this process, without run directories, each with its own PETSc options."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.ranks import on_root
from petfsi.scene.load import apply_set, scene_from_dict
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation
from petfsi.solving.option_database import only_options

MONOLITHIC, SPLIT, ITERATED = "monolithic.opts", "split.opts", "split-iterated.opts"
DIRECT = "monolithic-direct.opts"


@dataclass(frozen=True)
class Case:
    """How a bench is run: on these ranks, in full or not."""

    comm: MPI.Comm
    quick: bool


def job(comm: MPI.Comm, name: str, sets: dict[str, Any]) -> Scene:
    """Return a scene of ``jobs/`` with settings changed. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    name : str
        Without folder and ending.
    sets : dict
        Values by key, such as ``{"time.dt": 0.01}``; missing tables are made.
    """
    path = Path(__file__).parents[2] / "jobs" / f"{name}.toml"

    def read() -> Scene:
        if not path.is_file():
            raise InputError(f"{path}: no such file; a bench needs the jobs/ of petfsi's checkout")
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        for key, value in sets.items():
            apply_set(data, f"{key}=0")  # finds or makes the place
            _put(data, key, copy.deepcopy(value))
        return scene_from_dict(data, path.parent)

    return on_root(comm, read)


def _put(data: Any, key: str, value: Any) -> None:
    *tables, last = key.split(".")
    for part in tables:
        data = data[int(part) if isinstance(data, list) else part]
    data[int(last) if isinstance(data, list) else last] = value


@contextmanager
def simulation(comm: MPI.Comm, scene: Scene, options: str) -> Iterator[Simulation]:
    """Have a simulation of a scene, solved as a shipped options file says, and close it. Collective."""
    with only_options(["-options_file", options]):
        sim = Simulation(comm, scene)
        sim.prepare()
        yield sim
        sim.close()


def history(comm: MPI.Comm, scene: Scene, options: str, steps: int, column: str = "top.y") -> np.ndarray:
    """Return a probe's value at the start and after each of ``steps`` steps. Collective."""
    with simulation(comm, scene, options) as sim:
        wanted = sim.probe_columns().index(column)
        values = [sim.probe()[wanted]]
        for _ in range(steps):
            sim.advance()
            values.append(sim.probe()[wanted])
    return np.array(values)


def dense(mat: PETSc.Mat) -> np.ndarray:
    """Return a small matrix whole, on every rank. Collective."""
    copy = mat.convert("dense", PETSc.Mat())
    rows = copy.getDenseArray().copy()
    copy.destroy()
    return np.concatenate(mat.comm.tompi4py().allgather(rows))
