"""What one rank does for all, and what all must agree on: a rank that raised alone would leave the others waiting."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar, cast

if TYPE_CHECKING:
    from mpi4py import MPI

T = TypeVar("T")


def on_root(comm: MPI.Comm, work: Callable[[], T]) -> T:
    """Return on every rank what ``work`` returns on rank 0, or raise there what it raises. Collective."""
    result, failure = None, None
    if comm.rank == 0:
        try:
            result = work()
        except Exception as error:
            failure = error
    result, failure = comm.bcast((result, failure))
    if failure is not None:
        raise failure
    return cast(T, result)


def agreed(comm: MPI.Comm, call: Callable[[], T]) -> T:
    """Return what ``call`` returns; if it raises on any rank, raise the lowest rank's exception on all. Collective."""
    result, failure = None, None
    try:
        result = call()
    except Exception as error:
        failure = error
    agree(comm, failure)
    return cast(T, result)


def agree(comm: MPI.Comm, failure: Exception | None) -> None:
    """Raise the failure of the lowest rank that has one on every rank. Collective."""
    failures = [f for f in comm.allgather(failure) if f is not None]
    if failures:
        raise failures[0]
