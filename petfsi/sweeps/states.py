"""What became of a run, as its directory tells: nothing else is remembered of it."""

from __future__ import annotations

import itertools
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from petfsi.runs.failure import NO_RESULT
from petfsi.sweeps.attempts import Attempt, read_attempts
from petfsi.sweeps.claim import at_work, is_busy
from petfsi.sweeps.folder import OUTPUT, known
from petfsi.sweeps.plan import Planned

#: In the order of their telling. A failed run is a result: the same scene and options will fail again.
STATES = ("done", "failed", "running", "new", "stopped", "broken", "lost", "refused")
RESULTS = ("done", "failed")
#: So many attempts without a step gained are enough.
MOST_ATTEMPTS = 3
REFUSED, FAILED, STOPPED = 2, 3, 75
#: What is told to stop before it can hear that ends so, or its mpirun does.
_UNHEARD = (-signal.SIGUSR1, 128 + signal.SIGUSR1)
#: Bytes at the end of the output in which its last message is looked for.
_WORDS = 4000


@dataclass
class Look:
    """What a run's directory tells.

    Attributes
    ----------
    state : str
        One of ``STATES``.
    reason : str
        Why it stopped, failed, was refused or lost.
    step : int
        Of the newest checkpoint, -1 if there is none.
    kind : str
        Of a failure.
    summary : dict
        As far as there is one.
    attempts : list of Attempt
    """

    state: str
    reason: str
    step: int
    kind: str = ""
    summary: dict[str, Any] = field(default_factory=dict)
    attempts: list[Attempt] = field(default_factory=list)


def look_at(path: Path, run: Planned, busy: bool | None = None) -> Look:
    """Return what has become of a run.

    Parameters
    ----------
    path : Path
        Its directory.
    run : Planned
    busy : bool, optional
        Whether it is at work, where that is known: whoever claims a run knows.
    """
    attempts, summary, step = read_attempts(path), known(path / "summary.json"), newest_step(path)
    failure = summary.get("failure")
    kind = str(failure.get("kind", "")) if isinstance(failure, dict) else ""
    found = Look("new", "", step, kind, summary, attempts)
    if is_busy(path) if busy is None else busy:
        found.state, found.reason = "running", at_work(path)
        return found
    found.state, found.reason = _ended(path, run, summary, kind, attempts)
    if found.state == "broken" and is_lost(attempts, step):
        found.state = "lost"
        found.reason = f"{MOST_ATTEMPTS} attempts gained no step: {found.reason}"
    return found


def newest_step(path: Path) -> int:
    """Return the step of a run's newest checkpoint, -1 if there is none."""
    names = [one.stem for one in (path / "checkpoint").glob("*.json")]
    return max((int(name) for name in names if name.isascii() and name.isdigit()), default=-1)


def is_lost(attempts: list[Attempt], step: int) -> bool:
    """Return whether the last attempts, those not counted that were told to stop, have gained nothing."""
    last = [attempt for attempt in attempts if not attempt.told][-MOST_ATTEMPTS:]
    return len(last) == MOST_ATTEMPTS and all(attempt.step >= step for attempt in last)


def _ended(path: Path, run: Planned, summary: dict[str, Any], kind: str, attempts: list[Attempt]) -> tuple[str, str]:
    """Return state and reason of a run at which nobody is at work."""
    status, reason = summary.get("status"), str(summary.get("reason", ""))
    steps, last = summary.get("steps"), attempts[-1].exit if attempts else None
    enough = run.steps is not None and isinstance(steps, int) and steps >= run.steps
    if status == "done" or (status == "stopped" and enough):
        return "done", ""
    if status == "failed" and kind not in NO_RESULT:
        return "failed", reason
    if last == REFUSED:
        return "refused", last_words(path, attempts)
    if status == "failed":
        return "broken", f"{kind}: {reason}"
    told = bool(attempts) and attempts[-1].told
    if told and last in _UNHEARD:  # while it started, before it could hear
        return "stopped", "told to stop"
    if status == "stopped" and (told or last in (None, 0, STOPPED)):  # else it is an earlier attempt's
        return "stopped", reason
    if not attempts and not summary:
        return "new", ""
    if last == FAILED and not summary:  # before there was anything to write down
        return "failed", last_words(path, attempts)
    if status in ("running", "stopped") or not summary:
        return "broken", _how(path, attempts)
    return "broken", "summary.json is damaged"


def _how(path: Path, attempts: list[Attempt]) -> str:
    code = attempts[-1].exit if attempts else None
    if code is None:
        return "its process has gone"
    return f"killed by signal {-code}" if code < 0 else f"exit code {code}: {last_words(path, attempts)}"


def said_so_far(path: Path) -> int:
    """Return how many bytes the attempts at a run have printed."""
    try:
        return (path / OUTPUT).stat().st_size
    except OSError:
        return 0


def last_words(path: Path, attempts: list[Attempt]) -> str:
    """Return what the last attempt said last: its last message, without what mpirun has to say of it in its frames."""
    try:
        with open(path / OUTPUT, "rb") as file:
            file.seek(max(attempts[-1].output if attempts else 0, file.seek(0, 2) - _WORDS))
            lines = [line.strip() for line in file.read().decode(errors="replace").strip().splitlines()]
    except OSError:
        return ""
    begins = [n for n, line in enumerate(lines) if line.startswith("petfsi: ")]
    if begins:
        said = list(itertools.takewhile(lambda line: not _is_frame(line), lines[begins[-1] :]))
    else:
        said = [line for line in lines if not _is_frame(line)][-1:]
    return "; ".join(line.removeprefix("petfsi: ") for line in said[:8])


def _is_frame(line: str) -> bool:
    return bool(line) and not line.strip("-")
