"""What all ranks must give back together, though each rank's collector of garbage comes at a time of its own.

Destroying a solver is collective: a factorisation says goodbye to the other ranks. A rank that did so whenever Python
happens to collect what held the solver would wait for ranks that are elsewhere, for ever. So what is collected is only
noted; it is destroyed where all ranks meet next, and the rest at the end of the process, in the order of making.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from itertools import count
from weakref import finalize

from mpi4py import MPI

Release = Callable[[], None]


class Releases:
    """What the ranks of one communicator hold together."""

    def __init__(self) -> None:
        self._numbers = count()
        self._held: dict[int, Release] = {}
        self._collected: set[int] = set()

    def add(self, owner: object, release: Release) -> Release:
        """Return what releases something, at once and for good; it must not hold its owner. Collective, as that is."""
        number = next(self._numbers)  # the same on all ranks
        self._held[number] = release
        noted = finalize(owner, self._collected.add, number)
        noted.atexit = False

        def now() -> None:
            noted.detach()
            self._held.pop(number)()

        return now

    def sweep(self, comm: MPI.Comm) -> None:
        """Release what has been collected on all ranks. Collective."""
        common = set.intersection(*comm.allgather(self._collected)) if comm.size > 1 else set(self._collected)
        self._collected -= common
        for number in sorted(common):
            self._held.pop(number)()

    def end(self) -> None:
        """Release what is left. Collective, with what the process does last."""
        for number in sorted(self._held):
            self._held.pop(number)()


_OF: dict[int, Releases] = {}


def of(comm: MPI.Comm) -> Releases:
    """Return what the ranks of a communicator hold."""
    handle = comm.py2f()
    if handle not in _OF:
        _OF[handle] = Releases()
        atexit.register(_OF[handle].end)
    return _OF[handle]
