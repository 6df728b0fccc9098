"""Arrays that do not depend on the number of ranks, as each rank has its piece of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI


@dataclass(frozen=True)
class Slab:
    """One rank's contiguous piece of a global array that does not depend on the number of ranks.

    Attributes
    ----------
    data : ndarray
        The piece; ``data.ndim == len(shape)``.
    start : tuple of int
        Where it begins in the global array.
    shape : tuple of int
        The shape of the global array: cells or faces as ``(nx, ny[, nz])``, nodes as ``(n, dim)``.
    """

    data: np.ndarray
    start: tuple[int, ...]
    shape: tuple[int, ...]


#: By name the arrays of a state.
State = dict[str, Slab]


def held(state: State) -> Callable[[], State]:
    """Return what gives a state as it is now, whatever becomes of the arrays it was made of."""
    copy = {name: replace(slab, data=slab.data.copy()) for name, slab in state.items()}
    return lambda: copy


def scalar_slab(comm: MPI.Comm, value: float) -> Slab:
    """Return a number, the same on all ranks, as a global array of one entry that rank 0 owns."""
    mine = comm.rank == 0
    return Slab(np.array([value] if mine else []), (0 if mine else 1,), (1,))


#: Reads the piece ``[start, start + count)`` of the stored array of that name: ``read(name, start, count)``.
Reader = Callable[[str, tuple[int, ...], tuple[int, ...]], np.ndarray]
