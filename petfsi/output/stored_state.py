"""Whether a file holds what petfsi stores as a state: a checksum that matches says nothing of who wrote it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from petfsi.output import files
from petfsi.output.hdf5 import lies_here
from petfsi.output.manifest import Manifest

#: Groups that may hold what is not finite: a stable step that nothing limits, the volume of a region that was opened.
_BOOKS = ("stable", "accounts", "regions")
#: Numbers of fields are smaller.
LARGEST = 1e100
#: Numbers that are looked at in one go.
_CHUNK = 1 << 22
_KINDS = ("float64", "float32", "int64", "int32", "uint8", "int8", "uint16", "int16", "uint32", "uint64", "bool")


def fault(path: Path, manifest: Manifest) -> str:
    """Return in words why a checkpoint's data cannot be petfsi's; nothing if they can. Not collective.

    Arrays lie in the file itself, plainly, in groups of one level; numbers of fields are finite and not absurd. Reads
    them all.
    """
    try:
        with h5py.File(path, "r") as file:
            return _about(file, manifest) or next((wrong for wrong in _faults(file) if wrong), "")
    except OSError as error:
        if error.filename or not isinstance(error.errno, int):
            return files.reason(error)
        return f"HDF5 cannot read it ({str(error)[:100]})"
    except (KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError) as error:
        return f"it holds what is no state ({type(error).__name__})"


def _about(file: h5py.File, manifest: Manifest) -> str:
    """Return what is wrong with step, time and dt."""
    for name, want in (("step", manifest.step), ("time", manifest.time), ("dt", manifest.dt)):
        if name not in file.attrs or file.attrs[name] != want:
            return f"its {name} is not that of its manifest"
    if not isinstance(json.loads(file.attrs["attributes"]), dict):
        return "its attributes are no table"
    return ""


def _faults(file: h5py.File) -> Iterator[str]:
    left = file.id.get_filesize()
    for group in file:
        if not lies_here(file, group) or not isinstance(file[group], h5py.Group):
            yield f"'{group}' is no group of it"
            continue
        for name in file[group]:
            path = f"{group}/{name}"
            if not lies_here(file[group], name) or not isinstance(file[path], h5py.Dataset):
                yield f"'{path}' is no array of it"
                continue
            yield _layout_fault(file[path], path, left) or _value_fault(file[path], path)
            left -= file[path].id.get_storage_size()


def _layout_fault(array: h5py.Dataset, path: str, left: int) -> str:
    """Return what is wrong with how an array is stored, of a file with so many bytes left for it."""
    if array.dtype.name not in _KINDS or array.dtype.byteorder == ">":
        return f"'{path}' holds {array.dtype}, which is no number of a state"
    plist = array.id.get_create_plist()
    if plist.get_layout() != h5py.h5d.CONTIGUOUS or plist.get_external_count() or plist.get_nfilters():
        return f"'{path}' is not stored plainly in the file"
    needed = math.prod(array.shape) * array.dtype.itemsize
    if needed and (array.id.get_storage_size() != needed or needed > left):
        return f"'{path}' has shape {array.shape}, for which the file has no room"
    return ""


def _value_fault(array: h5py.Dataset, path: str) -> str:
    """Return whether some number of a field is not finite."""
    if path.split("/")[0] in _BOOKS:
        return ""
    if array.dtype.kind != "f" or not array.size or not array.shape:
        return ""
    rows = max(1, _CHUNK // max(1, math.prod(array.shape[1:])))
    for begin in range(0, array.shape[0], rows):
        values = array[begin : begin + rows]
        if not np.isfinite(values).all():
            return f"'{path}' holds what is not finite"
        if values.size and np.abs(values).max() > LARGEST:
            return f"'{path}' holds {values.flat[np.abs(values).argmax()]:.3g}, which is no quantity of a scene"
    return ""
