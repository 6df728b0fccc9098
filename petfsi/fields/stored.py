"""What a file says of a state is looked at before anything is computed from it.

Numbers and tables may be anything: a checksum does not say who made it. What could send a loop astray, or cannot be, is
told by the name of its array.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from mpi4py import MPI

#: Integers that floats hold exactly end here.
EXACT = float(1 << 53)
#: Steps are longer, s, so that the square of a ratio of two is a number.
SHORTEST = 1e-50


def outside(name: str, values: np.ndarray, low: float, high: float, whole: bool = False) -> str:
    """Return in words that some values are not within [low, high], or not whole; nothing if all are. Not collective."""
    values = np.asarray(values)
    wrong = ~((values >= low) & (values <= high))
    if whole and values.dtype.kind == "f":
        wrong |= values != np.floor(values)
    if not wrong.any():
        return ""
    first = values[wrong].flat[0]
    allowed = (
        f"{low:g} is" if low == high else f"{'whole numbers' if whole else 'numbers'} from {low:g} to {high:g} are"
    )
    return f"'{name}' holds {first:g}; {allowed} allowed"


def refuse(comm: MPI.Comm, faults: Iterable[str]) -> None:
    """Raise ValueError on all ranks with the first fault of the lowest rank that has one. Collective."""
    found = [fault for fault in comm.allgather(next(filter(None, faults), "")) if fault]
    if found:
        raise ValueError(found[0])


def step_fault(past_dt: float) -> str:
    """Return in words that this is no length of a last step, s, of which there may be none yet: 0. Not collective."""
    return "" if past_dt == 0.0 else outside("past_dt", np.array(past_dt), SHORTEST, 1.0 / SHORTEST)
