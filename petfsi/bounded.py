"""Work that may hang or want all memory on what it is given, ended within limits in the process that does it.

A process of its own costs as much as a third of a ``check``, and starting one is not safe beside every MPI. The limits
hold in Python code and wherever memory is asked for; a library that never returns would not be ended.
"""

from __future__ import annotations

import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn


class TooLongError(BaseException):
    """Time is up. No ``Exception``: what catches all of these shall not catch it."""


@contextmanager
def bounded(seconds: float, memory: float) -> Iterator[None]:
    """End what runs within: with TooLongError after so many seconds, with MemoryError where so many bytes are passed.

    Memory is address space beyond what the process has, and known on Linux alone; time is looked at in the main thread.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ends = [end for end in (soft, hard, _address_space() + int(memory)) if end != resource.RLIM_INFINITY]
    main = threading.current_thread() is threading.main_thread()
    try:
        resource.setrlimit(resource.RLIMIT_AS, (min(ends), hard))
        handler = signal.signal(signal.SIGALRM, _late) if main else None
        try:
            if main:  # and again each second, should somebody catch it
                signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
            yield
        finally:
            if main:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
                signal.signal(signal.SIGALRM, handler)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _late(number: int, frame: FrameType | None) -> NoReturn:
    raise TooLongError


def _address_space() -> int:
    """Return how many bytes this process has mapped; where nobody says, so many that no limit follows."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        return 2**62
