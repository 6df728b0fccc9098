"""Why a run failed, in one word: whoever runs many decides by it which are results and which are to be run again."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from typing import Any

from petfsi.errors import EnergyError, InputError, NoSolutionError, SolveError, TouchError, is_memory

#: What a file system without room answers.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Kinds that say nothing about the scene: the same run may well get further the next time.
NO_RESULT = ("interrupted", "disk", "memory", "defect")
#: Characters of a message that are kept.
_MOST = 2000


def kind_of(error: BaseException) -> str:
    """Return the kind of a failure, by the exception and those that it comes from.

    ``interrupted``; ``memory``; ``disk``, of whatever could not be written or read; ``touch``; ``no-solution``;
    ``energy``, that came out of nothing; ``scene``, wrong in what shows only on the way; ``diverged``, a solve that
    failed or a state that blew up; ``defect``, all else.
    """
    chain = list(_chain(error))
    if any(isinstance(one, KeyboardInterrupt) for one in chain):
        return "interrupted"
    if any(is_memory(one) for one in chain):
        return "memory"
    if any(isinstance(one, OSError) for one in chain):
        return "disk"
    for kind, cause in (
        ("touch", TouchError),
        ("no-solution", NoSolutionError),
        ("energy", EnergyError),
        ("scene", InputError),
        ("diverged", SolveError),
    ):
        if any(isinstance(one, cause) for one in chain):
            return kind
    return "defect"


def describe_failure(error: BaseException, step: int, time: float, checkpoint: str) -> dict[str, Any]:
    """Return what ``summary.json`` says of a failure.

    Parameters
    ----------
    error : BaseException
    step : int
        The step that failed.
    time : float
        Reached before it, s.
    checkpoint : str
        The newest, relative to the run directory; empty if there is none.
    """
    message = str(error)[:_MOST] or type(error).__name__
    return {"kind": kind_of(error), "step": step, "time": time, "message": message, "checkpoint": checkpoint}


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Return an exception and those that it was raised from."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__
