"""What became of a run, as its directory tells: nothing else is remembered of it."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.output import files
from petfsi.output.summary import read_summary
from petfsi.runs.failure import NO_RESULT
from petfsi.sweeps.attempts import Attempt, read_attempts
from petfsi.sweeps.claim import at_work, is_busy
from petfsi.sweeps.folder import OUTPUT
from petfsi.sweeps.plan import Planned
from petfsi.sweeps.settings import differences

#: In the order of their telling. A failed run is a result: the same scene and options will fail again.
STATES = ("done", "failed", "running", "new", "stopped", "broken", "lost", "refused", "changed")
RESULTS = ("done", "failed")
#: Of these none is run again before that is asked for.
LEFT_ALONE = ("lost", "refused", "changed")
#: So many attempts without a step gained are enough.
MOST_ATTEMPTS = 3
REFUSED, FAILED, STOPPED = 2, 3, 75
#: What is told to stop before it can hear that ends so, or its mpirun does.
_UNHEARD = (-signal.SIGUSR1, 128 + signal.SIGUSR1)
#: Bytes at the end of the output in which its last message is looked for.
_WORDS = 4000
#: What a number in a summary is below.
_LARGEST = 1e300


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
    attempts, step = read_attempts(path), newest_step(path)
    summary, damage = _summary(path)
    failure = summary.get("failure")
    kind = str(failure.get("kind", "")) if isinstance(failure, dict) else ""
    found = Look("new", "", step, kind, summary, attempts)
    if is_busy(path) if busy is None else busy:
        found.state, found.reason = "running", at_work(path)
        return found
    if told := differences(path, run, summary):  # its figures are not those of the plan
        return Look("changed", told, step, attempts=attempts)
    found.state, found.reason = _ended(path, run, summary, kind, attempts, damage)
    if found.state == "broken" and is_lost(attempts, step):
        found.state = "lost"
        found.reason = f"{MOST_ATTEMPTS} attempts gained no step: {found.reason}"
    return found


def _summary(path: Path) -> tuple[dict[str, Any], str]:
    """Return what a summary says, and in words why it cannot be believed."""
    try:
        summary = read_summary(path / "summary.json")
    except InputError as error:
        there = os.path.lexists(path / "summary.json")
        return {}, str(error).removeprefix(f"{path}/") if there else ""
    wrong = next(_misfits(summary), "")
    return ({}, f"summary.json is damaged: {wrong}") if wrong else (summary, "")


def _misfits(summary: dict[str, Any]) -> Iterator[str]:
    """Yield what of a summary has another form than petfsi gives it."""
    for key in ("steps", "time", "wall_s", "ranks"):
        if not _is_number(summary.get(key, 0), int if key in ("steps", "ranks") else (int, float)):
            yield f"{key} is {shown(summary[key])}"
    for key in ("unknowns", "iterations", "phases", "probes", "versions", "failure"):
        table = summary.get(key)
        if table is not None and not isinstance(table, dict):
            yield f"{key} is {shown(table)}"
        for name, value in table.items() if isinstance(table, dict) else ():
            if key in ("unknowns", "iterations", "phases") and not _is_number(value, (int, float)):
                yield f"{key}.{shown(name)} is {shown(value)}"


def _is_number(value: Any, kinds: type | tuple[type, ...]) -> bool:
    """Return whether a value is a number, or None, as a number that is not finite is written down."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value is None
    return isinstance(value, kinds) and abs(value) < _LARGEST


def newest_step(path: Path) -> int:
    """Return the step of a run's newest checkpoint, -1 if there is none."""
    names = [one.stem for one in (path / "checkpoint").glob("*.json")]
    return max((int(name) for name in names if name.isascii() and name.isdigit()), default=-1)


def is_lost(attempts: list[Attempt], step: int) -> bool:
    """Return whether the last attempts, those not counted that were told to stop, have gained nothing."""
    last = [attempt for attempt in attempts if not attempt.told][-MOST_ATTEMPTS:]
    return len(last) == MOST_ATTEMPTS and all(attempt.step >= step for attempt in last)


def _ended(
    path: Path, run: Planned, summary: dict[str, Any], kind: str, attempts: list[Attempt], damage: str
) -> tuple[str, str]:
    """Return state and reason of a run at which nobody is at work."""
    if damage:  # whatever its exit code is, what came out was not written down
        return "broken", damage
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
        with open(files.open_plain(path / OUTPUT), "rb") as file:
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
