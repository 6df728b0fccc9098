"""The machine's memory, and what a scene would take of it at least: compared before anything is made."""

from __future__ import annotations

import itertools
import math
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.shapes import bounds
from petfsi.messages import shown
from petfsi.runs.plan_fluids import ENTRY_BYTES, KRYLOV_VECTORS, PRECONDITIONER, grid_bytes
from petfsi.scene.beam_checks import corners
from petfsi.scene.fluids import MacFluid, SphFluid
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Shape

#: Resident memory of a rank before it holds anything (Python, NumPy, PETSc, compiled kernels), bytes.
PROGRAM_BYTES = 250e6
#: What a point of a surface beside particles takes, while they are looked for.
SAMPLE_BYTES = 400.0
#: What reading a mesh file takes, over its size, at least.
FILE = 10.0


def available_bytes() -> float:
    """Return how much memory this process, and others that begin now, may still take on this machine.

    The least of what is free, of what its control groups leave, and of its own limit; infinite where nothing says.
    """
    found = [_free(), *_control_groups()]
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        found.append(float(limit))
    return min(found)


def _free() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError, IndexError):
        return math.inf


def _control_groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[float]:
    """Yield what each control group around this process leaves, bytes: those of version 2, and of memory's in 1."""
    try:
        groups = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        return
    for _, controllers, path in (group for group in groups if len(group) == 3):
        if controllers and "memory" not in controllers.split(","):
            continue
        base = root / "memory" if controllers else root
        limit, used = ("limit_in_bytes", "usage_in_bytes") if controllers else ("max", "current")
        here = base / path.lstrip("/")
        for folder in [here, *here.parents]:
            try:
                most = (folder / f"memory.{limit}").read_text().strip()
                if most.isdigit():
                    yield max(0.0, float(most) - float((folder / f"memory.{used}").read_text()))
            except (OSError, ValueError):
                pass
            if folder == base:
                break


def launched_ranks() -> tuple[int, int]:
    """Return how many ranks the launcher has started, in all and on this machine, without starting MPI."""
    names = (
        ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_SIZE"),
        ("PMI_SIZE", "MPI_LOCALNRANKS"),
        ("MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_LOCAL_SIZE"),
    )
    for every, here in names:
        size = os.environ.get(every, "")
        if size.isdigit() and int(size) > 0:
            local = os.environ.get(here, "")
            return int(size), min(int(size), int(local) if local.isdigit() and int(local) > 0 else int(size))
    return 1, 1


def refuse_too_large(scene: Scene, available: float | None = None, ranks: tuple[int, int] | None = None) -> None:
    """Raise an InputError if a scene takes more memory than there is. Not collective; makes nothing, reads no mesh.

    Parameters
    ----------
    scene : Scene
    available : float, optional
        Bytes; those of this machine by default.
    ranks : tuple of int, optional
        How many ranks there are, and how many on this machine; as the launcher says by default.
    """
    free = available_bytes() if available is None else available
    size, here = ranks or launched_ranks()
    parts = {key: (value, need * here / size) for key, value, need in needs(scene)}
    whole = sum(need for _, need in parts.values()) + PROGRAM_BYTES * here
    if whole <= free:
        return
    key = max(parts, key=lambda key: parts[key][1], default="")
    what = f"{key}{parts[key][0]}: " if key else ""
    on = f" on {here} rank{'s' * (here > 1)}"
    raise InputError(
        f"{what}the scene takes about {as_bytes(whole)} of memory{on}, and this machine has {as_bytes(free)} left; "
        f"{'less of it' if key and parts[key][1] > PROGRAM_BYTES * here else 'fewer ranks here'}, or more machines"
    )


def needs(scene: Scene) -> Iterator[tuple[str, str, float]]:
    """Yield the key that something's size hangs on, what stands there, and the bytes that it takes on all ranks."""
    fluid, dim = scene.fluid, scene.dim
    if isinstance(fluid, MacFluid):
        yield "fluid.cells", f" = {fluid.cells}", grid_bytes(fluid, dim)
    elif isinstance(fluid, SphFluid):
        places = math.prod(size / fluid.spacing for size in fluid.size)
        yield "fluid.spacing", f" = {fluid.spacing:g}", places * 8.0 * dim
    for name, solid in scene.solids.items():
        key, value, nodes, cells = solid_counts(f"solids.{name}.shape", solid, dim)
        yield key, value, solid_bytes(dim, nodes, cells)
    for table in ("solids", "obstacles"):
        for name, item in getattr(scene, table).items():
            if isinstance(fluid, SphFluid):
                need = SAMPLE_BYTES * _samples(item.shape, fluid.spacing)
                yield f"{table}.{name}.shape", f": beside fluid.spacing = {fluid.spacing:g}", need
            if item.shape.mesh is not None:
                path = scene.directory / item.shape.mesh
                yield f"{table}.{name}.shape.mesh", f" = {shown(path, 200)}", FILE * path.stat().st_size


def _samples(shape: Shape, spacing: float) -> float:
    """Return how many points lie on a surface beside particles, by what its bounding box has; of files none."""
    reach = corners(shape.beam) if shape.beam is not None else bounds(shape)
    if reach is None:
        return 0.0
    size = np.subtract(reach[1], reach[0]) / spacing
    return 2.0 * float(sum(math.prod(face) for face in itertools.combinations(size.tolist(), len(size) - 1)))


def solid_counts(key: str, solid: Solid, dim: int) -> tuple[str, str, float, float]:
    """Return the key that says how fine a body is, what stands there, and its nodes and cells; of files none."""
    box, ball, beam = solid.shape.box, solid.shape.ball, solid.shape.beam
    order = 2 if solid.elements == "quadratic" else 1
    if beam is not None:
        return f"{key}.beam.elements", f" = {beam.elements}", 2.0 * beam.elements, 2.0 * beam.elements
    counts = box.cells if box is not None else [ball.cells] * dim if ball is not None else None
    if counts is None:
        return key, "", 0.0, 0.0
    number = [n or 0 for n in counts]
    nodes = math.prod(order * n + 1.0 for n in number)
    kind, value = ("box", number) if box is not None else ("ball", number[0])
    return f"{key}.{kind}.cells", f" = {value}", nodes, math.factorial(dim) * math.prod(map(float, number))


def solid_bytes(dim: int, nodes: float, cells: float) -> float:
    """Return an estimate of what all ranks hold of solids: state, matrices, preconditioner, Krylov vectors."""
    neighbours = 7 if dim == 2 else 15
    matrix = ENTRY_BYTES * dim**2 * neighbours * (1 + PRECONDITIONER)
    # an element keeps where its matrix goes, the matrix while it is assembled, and its gradients
    return nodes * (matrix + 8 * dim * KRYLOV_VECTORS) + cells * (16 * (dim * (dim + 1)) ** 2 + 8 * dim * (dim + 1))


def as_bytes(count: float) -> str:
    """Return a number of bytes as people read it."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
