"""Arrays that every rank has, into a file and back."""

from __future__ import annotations

import numpy as np

from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.stored import outside


def whole_slab(rank: int, array: np.ndarray) -> Slab:
    """Return an array that all ranks have as one that rank 0 owns, its length before it."""
    mine = rank == 0
    data = np.concatenate(([len(array)], array)) if mine else np.zeros(0)
    return Slab(data, (0 if mine else 1 + len(array),), (1 + len(array),))


def read_whole(read: Reader, name: str, length: int | None = None) -> np.ndarray:
    """Return what ``whole_slab`` stored, on every rank. Collective; ValueError if that has not the length it must."""
    stored = read(name, (0,), (1,))
    n_most = float(np.iinfo(np.int32).max) if length is None else length
    if fault := outside(f"the length of {name}", stored, 0 if length is None else length, n_most, whole=True):
        raise ValueError(fault)  # every rank has read the same
    n = int(stored[0])
    return np.asarray(read(name, (1,), (n,)), dtype=float) if n else np.zeros(0)
