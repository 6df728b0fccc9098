"""What changes when a run goes on: found, judged, told."""

from __future__ import annotations

from collections.abc import Sequence

from petfsi.errors import InputError
from petfsi.output.manifest import Change
from petfsi.scene.changes import changed, settings
from petfsi.scene.schema import Scene

#: Characters of a value that are told.
_SHOWN = 100


def find_changes(before: dict[str, str], scene_text: str, options_text: str) -> tuple[Change, ...]:
    """Return how a run's new ``scene.toml`` and ``options.opts`` differ from the settings before.

    Against those that its checkpoint was written with it may be more than what this leg was told, or less, if an
    earlier one that changed something came to no checkpoint.
    """
    now = settings(scene_text, options_text)
    return tuple(Change(key=key, old=old, new=new) for key, old, new in changed(before, now))


def judge_changes(scene: Scene, changes: Sequence[Change], time: float) -> None:
    """Refuse what may not change at the time (s) that has been reached.

    Raises
    ------
    InputError
    """
    keys = [change.key for change in changes]
    if "time.end" in keys and scene.time.end < time:
        raise InputError(f"--set time.end={scene.time.end:g}: the run has reached t = {time:.6g} s already")
    if "gravity" in keys and scene.fluid is not None and getattr(scene.fluid, "sound_speed", 0.0) is None:
        raise InputError(
            "--set gravity: the scene leaves fluid.sound_speed to be found from gravity, and pressures hang on that; "
            "with a fluid.sound_speed it may change, in a new run"
        )


def describe_changes(changes: Sequence[Change], step: int, time: float) -> list[str]:
    """Return a line on each change, to take effect after a step and its time (s)."""
    return [
        f"changed after step {step}, t = {time:.6g} s: {change.key}: {_said(change.old)} -> {_said(change.new)}"
        for change in changes
    ]


def _said(value: str | None) -> str:
    if value is None:
        return "none"
    return value if len(value) <= _SHOWN else f"{value[: _SHOWN - 3]}..."
