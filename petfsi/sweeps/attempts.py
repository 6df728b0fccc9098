"""``attempts.jsonl`` in a run's directory: a line when an attempt begins, and one when it ends."""

from __future__ import annotations

import json
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
        Where it began: that of the newest checkpoint.
    how : str
        ``run`` or ``resume``.
    exit : int or None
        Its exit code, negative for the signal that ended it; None while it runs, or where whoever started it has gone.
    told : bool
        Whether it was told to stop: then it says nothing about the run that it did not get further.
    peak_kb : int
        Of the memory of its largest process.
    """

    step: int
    how: str
    exit: int | None = None
    told: bool = False
    peak_kb: int = 0


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
                found.append(Attempt(int(entry["step"]), str(entry["how"])))
            elif found:
                found[-1].exit, found[-1].told = int(entry["exit"]), bool(entry["told"])
                found[-1].peak_kb = int(entry["peak_kb"])
        except (ValueError, TypeError, KeyError, RecursionError):
            continue
    return found


def began(path: Path, how: str, step: int) -> None:
    """Note that an attempt begins."""
    _append(path, {"time": _now(), "host": socket.gethostname(), "driver": os.getpid(), "how": how, "step": step})


def ended(path: Path, code: int, seconds: float, gained: int, told: bool, peak_kb: int) -> None:
    """Note how an attempt ended, and how many steps it has gained."""
    figures = {"seconds": round(seconds, 3), "gained": gained, "told": told, "peak_kb": peak_kb}
    _append(path, {"time": _now(), "exit": code, **figures})


def again(path: Path, state: str) -> None:
    """Note that a run is to be tried again, although it was lost or refused."""
    _append(path, {"time": _now(), "retry": state})


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def _append(path: Path, entry: dict[str, Any]) -> None:
    handle = os.open(path / NAME, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        data = (json.dumps(entry) + "\n").encode()
        if os.write(handle, data) != len(data):
            raise OSError(28, os.strerror(28), str(path / NAME))
    finally:
        os.close(handle)
