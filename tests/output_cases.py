"""Fields with known values, cut into slabs in whatever way, for the tests of what a run leaves on the disk."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from processes import environment, launcher

from petfsi.fields.slabs import Slab
from petfsi.output.xdmf import GridInfo

#: A scene that pictures may be drawn of.
SCENE = """
dim = 2
time = { end = 1, dt = 0.1 }
fluid = { density = 1, origin = [0.5, -1.0], size = [1.5, 2.5], cells = [6, 5] }
"""


def shared_directory(tmp_path: Path, comm: MPI.Comm) -> Path:
    """Return rank 0's temporary directory on all ranks."""
    return comm.bcast(tmp_path)


def cut(whole: np.ndarray, comm: MPI.Comm, axis: int = 0) -> Slab:
    """Return this rank's piece of an array, cut along one axis."""
    n = whole.shape[axis]
    begin, end = n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size
    start = [0] * whole.ndim
    start[axis] = begin
    piece = np.take(whole, np.arange(begin, end), axis=axis)
    return Slab(piece, tuple(start), whole.shape)


def state(dim: int) -> dict[str, dict[str, np.ndarray]]:
    """Return the whole arrays of two fields."""
    rng = np.random.default_rng(dim)
    cells = (6, 5, 4)[:dim]
    return {
        "pressure": {
            "pressure": rng.standard_normal(cells),
            "velocity_x": rng.standard_normal((cells[0] + 1, *cells[1:])),
            "kind": rng.integers(0, 5, cells).astype(np.uint8),
        },
        "solid": {
            "displacement": rng.standard_normal((11, dim)),
            "nothing": np.zeros((0, dim)),
            "one": rng.standard_normal((1, dim)),
        },
    }


def slabs(whole: dict[str, dict[str, np.ndarray]], comm: MPI.Comm) -> dict[str, dict[str, Slab]]:
    """Cut arrays with two or more axes along the second one half of the time."""
    return {
        group: {name: cut(a, comm, axis=1 if name == "velocity_x" else 0) for name, a in arrays.items()}
        for group, arrays in whole.items()
    }


def grid(dim: int) -> GridInfo:
    """Return a grid with a different number of cells and another spacing along every axis."""
    return GridInfo((0.5, -1.0, 2.0)[:dim], (0.25, 0.5, 0.125)[:dim], (6, 5, 4)[:dim])


def centres(info: GridInfo) -> np.ndarray:
    """Return the cells' centres, (nx, ny[, nz], dim)."""
    axes = [o + h * (np.arange(n) + 0.5) for o, h, n in zip(info.origin, info.spacing, info.cells, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def grid_fields(info: GridInfo, time: float) -> dict[str, np.ndarray]:
    """Return cell data that say where they belong."""
    x = centres(info)
    kind = np.zeros(x.shape[:-1], dtype=np.uint8)
    kind[0] = 2
    return {"velocity": x + time, "pressure": x[..., 0] + 10.0 * x[..., 1] + 100.0 * x[..., -1] + time, "kind": kind}


def solid_fields(dim: int, time: float) -> dict[str, np.ndarray]:
    """Return a square or cube around (1.25, 0, 2.25), rising with time."""
    corners = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=float
    )
    if dim == 2:
        cells = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    else:
        cells = np.array([[0, 1, 2, 5], [0, 2, 3, 7], [0, 5, 7, 4], [2, 5, 6, 7], [0, 2, 5, 7]], dtype=np.int32)
    points = corners[: 2**dim, :dim] * 0.4 + np.array([1.05, -0.2, 2.05])[:dim]
    displacement = np.zeros_like(points)
    displacement[:, 1] = time
    return {
        "points": points,
        "cells": cells,
        "body": np.arange(len(cells), dtype=np.int32),
        "displacement": displacement,
        "velocity": np.ones_like(points),
    }


def output(dim: int, time: float, comm: MPI.Comm) -> dict[str, dict[str, Slab]]:
    """Return what the fields of a run give for output."""
    return slabs({"pressure": grid_fields(grid(dim), time), "solid": solid_fields(dim, time)}, comm)


PREAMBLE = """
import resource, sys
from pathlib import Path
from mpi4py import MPI
sys.path.insert(0, {tests!r})
from output_cases import *
from petfsi.errors import PetfsiError
comm, directory = MPI.COMM_WORLD, Path({directory!r})

"""


def say(text: str) -> None:
    """Print a line for every rank, on rank 0: what ranks print themselves arrives interleaved."""
    lines = MPI.COMM_WORLD.gather(text)
    if MPI.COMM_WORLD.rank == 0:
        print(*lines, sep="\n")


def run_on(ranks: int, code: str, directory: Path) -> subprocess.CompletedProcess:
    """Run code on so many ranks; it finds ``comm``, ``directory`` and all that stands above here."""
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("mpirun does not start under mpirun")
    text = PREAMBLE.format(tests=os.path.dirname(__file__), directory=str(directory)) + code
    return subprocess.run(
        [*launcher(ranks), sys.executable, "-c", text],
        capture_output=True,
        text=True,
        timeout=180,
        env=environment(),
    )
