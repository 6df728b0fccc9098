"""``attempts.jsonl`` in a run's directory: a line when an attempt begins, and one when it ends."""

from __future__ import annotations

import json
import math
import os
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from petfsi.output import files

NAME = "attempts.jsonl"
_MOST = 16_000_000


@dataclass
class Attempt:
    """A start of a run.

    Attributes
    ----------
    step : int
        That of the newest checkpoint when it began.
    how : str
        ``run`` or ``resume``.
    output : int
        How many bytes earlier attempts have printed: its own words begin there.
    exit : int or None
        Its exit code, negative for the signal that ended it; None while it runs, or where whoever started it has gone.
    told : bool
        Whether it was told to stop: then it says nothing about the run that it did not get further.
    peak_kb : int
        Of the memory of its largest process.
    seconds : float or None
        From its start to its end; None as for ``exit``.
    """

    step: int
    how: str
    output: int = 0
    exit: int | None = None
    told: bool = False
    peak_kb: int = 0
    seconds: float | None = None


def read_attempts(path: Path) -> list[Attempt]:
    """Return the attempts in a run's directory since it was last to be tried again; a torn line is left out."""
    found: list[Attempt] = []
    try:
        lines = files.read_small(path / NAME, _MOST).splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            entry = json.loads(line)
            if "retry" in entry:
                found.clear()
            elif "how" in entry:
                found.append(Attempt(int(entry["step"]), str(entry["how"]), int(entry.get("output", 0))))
            elif found:
                found[-1].exit, found[-1].told = int(entry["exit"]), bool(entry["told"])
                found[-1].peak_kb, found[-1].seconds = int(entry["peak_kb"]), _seconds(entry)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            continue
    return found


def began(path: Path, how: str, step: int, output: int) -> None:
    """Note that an attempt begins, with the newest checkpoint's step and the bytes of output that are there."""
    who = {"host": socket.gethostname(), "driver": os.getpid()}
    _append(path, {"time": _now(), **who, "how": how, "step": step, "output": output})


def ended(path: Path, code: int, seconds: float, gained: int, told: bool, peak_kb: int) -> None:
    """Note how an attempt ended, and how many steps it has gained."""
    figures = {"seconds": round(seconds, 3), "gained": gained, "told": told, "peak_kb": peak_kb}
    _append(path, {"time": _now(), "exit": code, **figures})


def again(path: Path, state: str) -> None:
    """Note that a run is to be tried again, although it was lost or refused."""
    _append(path, {"time": _now(), "retry": state})


def _seconds(entry: dict[str, Any]) -> float | None:
    seconds = float(entry.get("seconds", math.nan))
    return seconds if 0 <= seconds < math.inf else None


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def _append(path: Path, entry: dict[str, Any]) -> None:
    handle = files.open_plain(path / NAME, os.O_RDWR | os.O_APPEND | os.O_CREAT)
    try:
        data = (json.dumps(entry) + "\n").encode()
        size = os.fstat(handle).st_size
        if size and os.pread(handle, 1, size - 1) != b"\n":  # a torn line would swallow this one
            data = b"\n" + data
        if os.write(handle, data) != len(data):
            raise OSError(28, os.strerror(28), str(path / NAME))
    finally:
        os.close(handle)
