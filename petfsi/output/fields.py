"""The fields at the output times: one HDF5 file each, which no later accident can damage, and their indexes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.slabs import Slab
from petfsi.output import checkpoint, files, hdf5, xdmf
from petfsi.output.growing import Changed, GrowingXml
from petfsi.output.manifest import Index, Mark, Record, Rows
from petfsi.output.outputs import Outputs, Written
from petfsi.output.xdmf import Arrays, Entry, GridInfo
from petfsi.ranks import on_root

#: Arrays of the solid that never change and are stored once.
STATIC = ("points", "cells", "body")
#: The file of what never changes, relative to the run.
MESH = "fields/mesh.h5"
#: So many damaged files are told of one by one.
MAX_TOLD = 5

Groups = Mapping[str, Mapping[str, Slab]]


class FieldWriter:
    """Writes ``fields/NNNNNN.h5``, ``fields/mesh.h5`` and the XDMF files of a run. All methods are collective.

    Parameters
    ----------
    directory : Path
        The run's.
    comm : MPI.Comm
        The ranks that hold pieces.
    grid : GridInfo or None
        The fluid's grid; None without a fluid.
    """

    def __init__(self, directory: Path, comm: MPI.Comm, grid: GridInfo | None) -> None:
        self.directory = Path(directory)
        self.comm = comm
        self.grid = grid
        self._mesh = self.directory / "fields" / "mesh.h5"
        self._static: Arrays | None = None  # until there is a mesh.h5, which has no arrays where nothing is fixed
        self._mesh_mark: Mark | None = None
        self._outputs = Outputs(self.directory / "fields")
        self._indexes = Indexes(self.directory)

    def write(self, step: int, time: float, groups: Groups) -> Path:
        """Write the fields of one time and return their file.

        Parameters
        ----------
        step, time : int, float
            The step that was finished last and the time, s.
        groups : mapping of str to mapping of str to Slab
            ``pressure``: cell data of the grid, (nx, ny[, nz]) or with components last. ``solid``: ``points``
            (reference), ``cells`` and ``body``, which never change, and ``displacement``, ``velocity`` and
            whatever else there is per node or per cell. ``particles``: ``points`` and whatever else there is per
            particle; their number is the file's own, and may be zero.

        Raises
        ------
        SolveError
            On all ranks, when the disk does not take it; earlier output is untouched.
        """
        path = self.directory / "fields" / f"{step:06d}.h5"
        arrays, views = self._arrays(groups)
        needed = hdf5.n_bytes(arrays)
        part = files.part_of(path)
        try:
            on_root(self.comm, lambda: files.own_directory(path.parent))
            if self._static is None:
                self._write_mesh(groups.get("solid", {}))
            hdf5.write_file(part, arrays, {"step": step, "time": time}, self.comm, views)
            entry = Entry(step, time, f"fields/{path.name}", _described(arrays, views))
            on_root(self.comm, lambda: self._publish(part, path, entry))
        except OSError as error:
            on_root(self.comm, lambda: _discard(part))
            self._fail(f"step {step}, t = {time:g} s: fields {path} could not be written", error, needed)
        return path

    def _publish(self, part: Path, path: Path, entry: Entry) -> None:
        """Give a file its name, once the list has it; what had the name already is not the run's, and steps aside."""
        self._outputs.append(Written.of(part, path.name, entry.step, entry.time))
        if os.path.lexists(path):
            os.replace(path, _aside(path))
        files.publish(part, path)
        self._indexes.append(xdmf.parts(MESH, self._static or {}, entry, self.grid))

    def _arrays(self, groups: Groups) -> tuple[dict[str, Slab], dict[str, hdf5.View]]:
        """Return what the file of one time holds, and the second names in it for readers that want a list of cells."""
        fluid, solid, particles = (groups.get(name, {}) for name in ("pressure", "solid", "particles"))
        arrays = {f"fluid/{name}": _z_first(slab, len(self.grid.cells)) for name, slab in fluid.items() if self.grid}
        views = {f"cells/{path[6:]}": hdf5.View(path, self._listed(slab.shape)) for path, slab in arrays.items()}
        arrays |= {f"solid/{name}": slab for name, slab in solid.items() if name not in STATIC}
        if solid:
            arrays["solid/points"] = _moved(solid["points"], solid["displacement"])
        arrays |= {f"particles/{name}": slab for name, slab in particles.items()}
        if particles:
            arrays["particles/vertices"] = _vertices(particles["points"])
        return arrays, views

    def _fail(self, what: str, error: OSError, needed: int) -> None:
        last = checkpoint.last_good(self.directory / "checkpoint", self.comm)
        why = files.agreed_reason(self.comm, error, needed)
        raise SolveError(f"{what}: {why}. {last}") from error

    def _listed(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        axes = len(self.grid.cells) if self.grid else 0
        return (math.prod(shape[:axes]), *shape[axes:])

    def _write_mesh(self, solid: Mapping[str, Slab]) -> None:
        arrays = _grid_cells(self.grid, self.comm) if self.grid else {}
        if solid:
            arrays |= {"solid/reference": solid["points"], "solid/cells": solid["cells"], "solid/body": solid["body"]}
        about = {} if self.grid is None else {k: list(getattr(self.grid, k)) for k in ("origin", "spacing", "cells")}
        part = files.part_of(self._mesh)
        hdf5.write_file(part, arrays, about, self.comm)

        def publish() -> Mark:
            size, found = files.digest(part)
            files.publish(part, self._mesh)
            return Mark(bytes=size, blake2b=found)

        self._mesh_mark = on_root(self.comm, publish)
        self._static = _described(arrays, {})

    # ---- what a manifest says, and going on ---------------------------------------------------------------------

    def on_disk(self) -> dict[str, Any]:
        """Return what a ``Record`` says of output, once that is on the disk; meant for rank 0."""
        try:
            return on_root(
                self.comm,
                lambda: {
                    "outputs": self._outputs.on_disk(),
                    "mesh": self._mesh_mark,
                    "indexes": self._indexes.on_disk(),
                },
            )
        except OSError as error:
            self._fail(f"output in {self.directory} could not be written", error, 0)
            raise

    def go_on(self, known: Record, step: int, groups: Callable[[], Groups], report: Callable[[str], None]) -> None:
        """Go on from a checkpoint: drop the output after it, look at the rest, and mend what can be made again.

        Parameters
        ----------
        known : Record
            Of the checkpoint.
        step : int
            The checkpoint's.
        groups : callable
            Returns the present fields as ``write`` takes them; for a lost ``mesh.h5``. Collective.
        report : callable
            Is told, on rank 0 alone, what is damaged or missing; nothing else is lost by that.
        """
        try:
            said, whole = on_root(self.comm, lambda: self._look(known, step))
            # all ranks must know alike whether there is a mesh.h5: they write it together
            self._static, self._mesh_mark = self.comm.bcast((self._static, self._mesh_mark))
            if not whole:
                self._write_mesh(groups().get("solid", {}))
            said += on_root(self.comm, lambda: self._take_up_indexes(known, bool(said)))
        except OSError as error:
            self._fail(f"{self.directory}: output after step {step} could not be removed", error, 0)
        if self.comm.rank == 0:
            for line in said:
                report(line)

    def _look(self, known: Record, step: int) -> tuple[list[str], bool]:
        """Take up the list of files; return what is to be told and whether ``mesh.h5`` is whole. Rank 0 alone."""
        directory = self._mesh.parent
        if known.outputs is None and not directory.exists():
            return [], True
        files.own_directory(directory)
        said = self._take_up_list(known.outputs, step)
        _sweep(directory)
        damaged = self._outputs.damaged()
        said += [f"{directory / name} {how}" for name, how in list(damaged.items())[:MAX_TOLD]]
        if len(damaged) > MAX_TOLD:
            said.append(f"and so are {len(damaged) - MAX_TOLD} more of {len(self._outputs.rows)} output files")
        ours = {row.file for row in self._outputs.rows}
        others = [path.name for path in field_files(self.directory) if path.name not in ours]
        if others:
            count = f" and {len(others) - 1} more" if len(others) > 1 else ""
            said.append(f"{directory / others[0]}{count}: not in the list of this run's output; left alone")
        if known.mesh is None:
            return said, True
        try:
            size, found = files.digest(self._mesh)
            whole = (size, found) == (known.mesh.bytes, known.mesh.blake2b)
            if whole:
                with hdf5.reading(self._mesh) as file:
                    self._static, self._mesh_mark = _stored(file), known.mesh
        except OSError:
            whole = False
        return said + ([] if whole else [f"{self._mesh} is missing or has been changed; it is written anew"]), whole

    def _take_up_list(self, known: Rows | None, step: int) -> list[str]:
        try:
            self._outputs.go_on(known, step)
            return []
        except Changed as error:
            rows = []
            for path in field_files(self.directory):
                entry = _entry(path)
                if entry is not None and entry.step <= step and path.stem == f"{entry.step:06d}":
                    rows.append(Written.of(path, path.name, entry.step, entry.time))
            self._outputs.begin_anew(rows)
            return [f"{self._outputs.path}: {error}; it is written anew of the {len(rows)} files found"]

    def _take_up_indexes(self, known: Record, damaged: bool) -> list[str]:
        """Take up the indexes, or write them anew of the files that can be read. Rank 0 alone."""
        said = [] if damaged else self._indexes.go_on(known.indexes)
        if damaged or said:
            found = [_entry(self._mesh.parent / row.file) for row in self._outputs.rows]
            entries = [entry for entry in found if entry is not None]
            self._indexes.begin_anew(xdmf.parts(MESH, self._static or {}, entry, self.grid) for entry in entries)
        return said


class Indexes:
    """The XDMF files of a run. Rank 0 alone."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._files: dict[Index, GrowingXml] = {}

    def append(self, parts: Mapping[Index, str]) -> None:
        """Add what an output time says, by index."""
        for name, text in parts.items():
            if name not in self._files:
                self._files[name] = GrowingXml(self.directory / name, xdmf.BEGIN, xdmf.END)
            self._files[name].append(text)

    def on_disk(self) -> dict[Index, Mark]:
        """Return what is final of them, once it is on the disk."""
        return {name: file.on_disk() for name, file in self._files.items()}

    def go_on(self, known: Mapping[Index, Mark]) -> list[str]:
        """Take up the indexes and drop what is behind that; return which are not what they were."""
        said = []
        for name, mark in known.items():
            file = GrowingXml(self.directory / name, xdmf.BEGIN, xdmf.END)
            try:
                file.go_on(mark)
                self._files[name] = file
            except Changed as error:
                said.append(f"{file.path}: {error}; it is written anew")
        self._remove_others()
        return said

    def begin_anew(self, all_parts: Iterable[Mapping[Index, str]]) -> None:
        """Write them anew."""
        self._files = {}
        for parts in all_parts:
            self.append(parts)
        self._remove_others()

    def _remove_others(self) -> None:
        """Remove the indexes of output that has been dropped."""
        for name in xdmf.NAMES:
            if name not in self._files:
                (self.directory / name).unlink(missing_ok=True)


def _entry(path: Path) -> Entry | None:
    """Return what an output file holds; None of one that cannot be read."""
    try:
        with hdf5.reading(path) as file:
            return Entry(int(file.attrs["step"]), float(file.attrs["time"]), f"fields/{path.name}", _stored(file))
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError):
        return None


def _sweep(directory: Path) -> None:
    """Remove what an interrupted write left."""
    for part in directory.glob("*.h5.part"):
        if part.name == "mesh.h5.part" or part.name.removesuffix(".h5.part").isdecimal():
            part.unlink(missing_ok=True)


def _discard(part: Path) -> None:
    with suppress(OSError):
        part.unlink(missing_ok=True)


def _aside(path: Path) -> Path:
    """Return a free name beside a file."""
    names = (path.with_name(f"{path.name}.aside{n or ''}") for n in count())
    return next(name for name in names if not os.path.lexists(name))


def field_files(directory: Path) -> list[Path]:
    """Return the files of the output times of a run, in the order of time."""
    found = [path for path in (Path(directory) / "fields").glob("*.h5") if path.stem.isdecimal()]
    return sorted(found, key=lambda path: int(path.stem))


def _stored(file: h5py.File) -> Arrays:
    return {
        f"{group}/{name}": (array.shape, array.dtype.name)
        for group, arrays in file.items()
        for name, array in arrays.items()
    }


def _described(arrays: Mapping[str, Slab], views: Mapping[str, hdf5.View]) -> Arrays:
    described = {name: (tuple(slab.shape), slab.data.dtype.name) for name, slab in arrays.items()}
    return described | {name: (view.shape, described[view.source][1]) for name, view in views.items()}


def _z_first(slab: Slab, dim: int) -> Slab:
    """Return cell data with its axes in XDMF's order: z, y, x, components."""
    order = [*reversed(range(dim)), *range(dim, len(slab.shape))]
    start, shape = (tuple(int(values[a]) for a in order) for values in (slab.start, slab.shape))
    return Slab(slab.data.transpose(order), start, shape)


def _moved(points: Slab, displacement: Slab) -> Slab:
    if tuple(points.start) != tuple(displacement.start) or points.data.shape != displacement.data.shape:
        raise ValueError("a solid's points and displacement must be cut into pieces alike")
    return Slab(points.data + displacement.data, displacement.start, displacement.shape)


def _vertices(points: Slab) -> Slab:
    """Return the particles' own numbers: the cells of a cloud of points, of one corner each, which readers ask for."""
    n, start = points.shape[0], points.start[0]
    numbers = np.arange(start, start + len(points.data), dtype=np.int32 if n < 2**31 else np.int64)
    return Slab(numbers[:, None], (start, 0), (n, 1))


def _grid_cells(grid: GridInfo, comm: MPI.Comm) -> dict[str, Slab]:
    """Return the grid as quadrilaterals or hexahedra in VTK's order of corners, x counting fastest."""
    cells, points = np.array(grid.cells), np.array(grid.cells) + 1
    dtype = np.int32 if points.prod() < 2**31 else np.int64
    place = _numbered(points, comm)
    coordinates = np.array(grid.origin) + np.array(grid.spacing) * place
    lower = _numbered(cells, comm)
    stride = np.concatenate(([1], np.cumprod(points)[:-1]))
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
    corners = corners[: 2 ** len(cells), : len(cells)]
    connectivity = ((lower @ stride)[:, None] + corners @ stride).astype(dtype)
    return {
        "grid/points": _rows(coordinates, points, comm),
        "grid/cells": _rows(connectivity, cells, comm),
    }


def _numbered(counts: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Return the indices (n, dim) of this rank's share of a lattice, x counting fastest."""
    n = int(counts.prod())
    share = np.arange(n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size)
    return np.stack(np.unravel_index(share, counts[::-1])[::-1], axis=-1)


def _rows(data: np.ndarray, counts: np.ndarray, comm: MPI.Comm) -> Slab:
    n = int(counts.prod())
    return Slab(data, (n * comm.rank // comm.size, 0), (n, data.shape[1]))
