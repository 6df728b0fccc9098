"""HDF5 files that all ranks write together, and that come out whole or not at all.

The HDF5 library does not survive a write that fails: under MPI the ranks wait for each other for ever when the file
is closed, and on one rank the process crashes at its end. So it never meets one. Rank 0 lays the file out alone
(names, shapes, attributes: a few kilobytes) and then has the file system set the space for all of the data aside;
a full disk, a quota or a limit on file sizes shows there, in a plain system call. The ranks then open the file
together and write their pieces into space that is theirs already, without touching the layout any more.
"""

from __future__ import annotations

import errno
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Debian ships h5py twice, and takes the one with MPI for a process that mpirun did not start only when told so.
os.environ.setdefault("H5PY_ALWAYS_USE_MPI", "1")

import h5py
import numpy as np
from mpi4py import MPI

from petfsi.errors import PetfsiError
from petfsi.fields.slabs import Slab
from petfsi.output import files
from petfsi.ranks import agree, on_root

#: Room for the file's own tables, beyond the data: in all, and for every dataset.
_TABLES, _TABLES_EACH = 65536, 4096


@dataclass(frozen=True)
class View:
    """The same stored numbers under a second name and shape, in the same order; it takes no space."""

    source: str
    shape: tuple[int, ...]


def plain(value: Any) -> Any:
    """Turn NumPy's numbers and arrays into Python's, for JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no place in a JSON file")


def n_bytes(arrays: Mapping[str, Slab]) -> int:
    """Return how much disk the whole arrays take, in bytes."""
    data = sum(int(np.prod(slab.shape, dtype=np.int64)) * slab.data.dtype.itemsize for slab in arrays.values())
    return data + _TABLES + _TABLES_EACH * len(arrays)


def write_file(
    path: Path,
    arrays: Mapping[str, Slab],
    attributes: Mapping[str, Any],
    comm: MPI.Comm,
    views: Mapping[str, View] | None = None,
) -> None:
    """Write whole arrays from the ranks' pieces, down to the disk. Collective.

    The bytes depend on nothing but the arguments, and not on the number of ranks.

    Parameters
    ----------
    path : Path
        Is replaced; when writing fails it is gone.
    arrays : mapping of str to Slab
        By HDF5 path (``group/name``); the same names, shapes and types on all ranks.
    attributes : mapping
        Of the file; numbers and strings as they are, everything else as JSON.
    comm : MPI.Comm
        The ranks that hold pieces.
    views : mapping of str to View, optional
        Further names of the same data.

    Raises
    ------
    OSError
        The same on all ranks.
    """
    arrays = {name: arrays[name] for name in sorted(arrays)}
    try:
        on_root(comm, lambda: _lay_out(path, arrays, attributes, views or {}))
        _fill(path, arrays, comm)
        on_root(comm, lambda: _sync(path))
    except OSError:
        on_root(comm, lambda: path.unlink(missing_ok=True))
        raise


def _lay_out(path: Path, arrays: Mapping[str, Slab], attributes: Mapping[str, Any], views: Mapping[str, View]) -> None:
    """Create the file with everything but the data, and make sure of the space for the data."""
    tables = _TABLES + _TABLES_EACH * (len(arrays) + len(views))
    with _naming(path), open(files.new_file(path), "wb") as file:
        os.truncate(file.fileno(), n_bytes(arrays) + tables)
        _set_aside(file.fileno(), tables)
    with h5py.File(path, "w") as file:
        _set_attributes(file, attributes)
        for name, slab in arrays.items():
            dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
            dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
            dcpl.set_obj_track_times(False)
            _create(file, name, slab.shape, slab.data.dtype, dcpl)
        for name, view in views.items():
            source = arrays[view.source]
            dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            dcpl.set_obj_track_times(False)
            space, whole = h5py.h5s.create_simple(view.shape), h5py.h5s.create_simple(source.shape)
            dcpl.set_virtual(space, b".", view.source.encode(), whole)
            _create(file, name, view.shape, source.data.dtype, dcpl)
    with _naming(path), open(path, "r+b") as file:
        _set_aside(file.fileno(), os.fstat(file.fileno()).st_size)


def _set_aside(handle: int, size: int) -> None:
    """Have the file system promise the first ``size`` bytes of a file; some cannot, and then a write may fail."""
    try:
        os.posix_fallocate(handle, 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
            raise


def _set_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    with warnings.catch_warnings():
        # h5py 3.7, as Debian 12 ships it, calls a function here that NumPy 1.25 warns of
        warnings.simplefilter("ignore", DeprecationWarning)
        for key, value in attributes.items():
            plain_value = isinstance(value, (str, int, float, np.integer, np.floating))
            file.attrs[key] = value if plain_value else json.dumps(value, default=plain, sort_keys=True)


def _create(file: h5py.File, name: str, shape: tuple[int, ...], dtype: np.dtype, dcpl: h5py.h5p.PropDCID) -> None:
    group, _, last = name.rpartition("/")
    parent = file.require_group(group) if group else file
    space, kind = h5py.h5s.create_simple(shape), h5py.h5t.py_create(dtype)
    h5py.h5d.create(parent.id, last.encode(), kind, space, dcpl=dcpl)


def _fill(path: Path, arrays: Mapping[str, Slab], comm: MPI.Comm) -> None:
    """Write every rank's pieces into a file that is laid out."""
    file = open_file(path, "r+", comm)
    failure = None
    try:
        for name, slab in arrays.items():
            if slab.data.size:
                _write_piece(file[name].id, slab)
    except OSError as error:
        failure = OSError(error.errno or errno.EIO, str(error), str(path))
    finally:
        file.close()
    agree(comm, failure)


def _write_piece(dataset: h5py.h5d.DatasetID, slab: Slab) -> None:
    data = np.ascontiguousarray(slab.data)
    memory, stored = h5py.h5s.create_simple(data.shape), dataset.get_space()
    stored.select_hyperslab(tuple(slab.start), data.shape)
    # transfers stay independent: OpenMPI's collective ones (4.1.4) do not report that they failed
    dataset.write(memory, stored, data)


def read_piece(dataset: h5py.h5d.DatasetID, start: tuple[int, ...], data: np.ndarray) -> None:
    """Fill ``data`` (contiguous, of the stored type) with the piece that begins at ``start``. Not collective."""
    memory, stored = h5py.h5s.create_simple(data.shape), dataset.get_space()
    stored.select_hyperslab(start, data.shape)
    dataset.read(memory, stored, data)


def _sync(path: Path) -> None:
    with _naming(path), open(path, "rb") as file:
        os.fsync(file.fileno())


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Give the system's errors the name of the file, which calls on an open file leave out."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def lies_here(group: h5py.Group, name: str) -> bool:
    """Return whether what has a name in a group is in the same file, and under this name: no link to elsewhere."""
    return type(group.get(name, getlink=True)) is h5py.HardLink


@contextmanager
def reading(path: Path) -> Iterator[h5py.File]:
    """Open a file of the output on this rank alone; OSError where it, or something in it, is a link to elsewhere."""
    os.close(files.open_plain(path))
    with h5py.File(path, "r") as file:
        for name in file:
            _refuse_links(file, name, path)
            for array in file[name] if isinstance(file[name], h5py.Group) else ():
                _refuse_links(file[name], array, path)
        yield file


def _refuse_links(group: h5py.Group, name: str, path: Path) -> None:
    """Raise OSError if what has a name in a group is not in the file itself."""
    if lies_here(group, name):
        found = group[name]
        if not isinstance(found, h5py.Dataset) or found.id.get_create_plist().get_external_count() == 0:
            return
    raise OSError(
        errno.ELOOP, f"'{group.name.strip('/')}/{name}' of it lies elsewhere, and links are not followed", str(path)
    )


def open_file(path: Path, mode: str, comm: MPI.Comm) -> h5py.File:
    """Open a file on all ranks together. Collective."""
    if comm.size == 1:
        return h5py.File(path, mode)
    if not h5py.get_config().mpi:
        raise PetfsiError("this h5py was built without MPI, so petfsi can only run on one rank")
    return h5py.File(path, mode, driver="mpio", comm=comm)
