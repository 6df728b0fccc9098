"""The fields at the output times: one HDF5 file each, which no later accident can damage, and their indexes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError, SolveError
from petfsi.fields.base import Slab
from petfsi.output import checkpoint, files, hdf5, xdmf
from petfsi.output.xdmf import Arrays, Entry, GridInfo
from petfsi.ranks import on_root

#: Arrays of the solid that never change and are stored once.
STATIC = ("points", "cells", "body")


class FieldWriter:
    """Writes ``fields/NNNNNN.h5``, ``fields/mesh.h5`` and the XDMF files of a run. All methods are collective.

    An existing run is continued; call ``truncate`` first to drop what came after the step it resumes from.

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
        self._entries: list[Entry] = []
        self._static, self._entries = on_root(comm, self._find)

    @property
    def times(self) -> list[float]:
        """The output times so far, s."""
        return [entry.time for entry in self._entries]

    def write(self, step: int, time: float, groups: Mapping[str, Mapping[str, Slab]]) -> Path:
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
        about = {"step": step, "time": time}
        needed = hdf5.n_bytes(arrays)
        try:
            on_root(self.comm, lambda: path.parent.mkdir(exist_ok=True))
            if self._static is None:
                self._write_mesh(groups.get("solid", {}))
            part = files.part_of(path)
            hdf5.write_file(part, arrays, about, self.comm, views)
            entry = Entry(step, time, f"fields/{path.name}", _described(arrays, views))
            self._entries = sorted([*(e for e in self._entries if e.step != step), entry], key=lambda e: e.step)
            on_root(self.comm, lambda: files.publish(part, path))
            on_root(self.comm, self._index)
        except OSError as error:
            self._fail(f"step {step}, t = {time:g} s: fields {path} could not be written", error, needed)
        return path

    def _arrays(self, groups: Mapping[str, Mapping[str, Slab]]) -> tuple[dict[str, Slab], dict[str, hdf5.View]]:
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

    def truncate(self, step: int) -> None:
        """Drop the output after a step, and what an interrupted write left."""
        self._entries = [entry for entry in self._entries if entry.step <= step]
        try:
            on_root(self.comm, self._remove_others)
        except OSError as error:
            self._fail(f"{self.directory}: output after step {step} could not be removed", error, 0)

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
        on_root(self.comm, lambda: files.publish(part, self._mesh))
        self._static = _described(arrays, {})

    def _index(self) -> None:
        mesh = self._mesh.relative_to(self.directory).as_posix()
        texts = xdmf.indexes(mesh, self._static or {}, self._entries, self.grid)
        for name, text in texts.items():
            files.replace_text(self.directory / name, text)
        if xdmf.CLOUDS not in texts:  # of output that has been dropped
            (self.directory / xdmf.CLOUDS).unlink(missing_ok=True)

    def _find(self) -> tuple[Arrays | None, list[Entry]]:
        """Return the mesh's arrays and the entries of the files that are there."""
        if not self._mesh.exists():
            return None, []
        try:
            entries = []
            for path in field_files(self.directory):
                with h5py.File(path, "r") as file:
                    step, time = int(file.attrs["step"]), float(file.attrs["time"])
                    entries.append(Entry(step, time, f"fields/{path.name}", _stored(file)))
            with h5py.File(self._mesh, "r") as file:
                return _stored(file), sorted(entries, key=lambda entry: entry.step)
        except (OSError, KeyError) as error:
            raise InputError(f"output in {self._mesh.parent} cannot be read: {error}") from error

    def _remove_others(self) -> None:
        kept = {self.directory / entry.file for entry in self._entries}
        if self._static is not None:
            self._index()  # before the files go, so that the index never names one that is gone
        for path in field_files(self.directory):
            if path not in kept:
                path.unlink()
        for part in (self.directory / "fields").glob("*.part"):
            with suppress(FileNotFoundError):
                part.unlink()


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
