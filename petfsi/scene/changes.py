"""What of a scene may change when a run goes on, and what has changed."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from petfsi.scene.dump import as_toml

#: What may be changed when a run is resumed: nothing that the state at hand, or a column of history.csv, depends on.
#: ``*`` is any name. A table means all that is in it.
RESUMABLE = (
    "time.end",
    "time.dt",
    "time.above_limit",
    "time.retries",
    "time.energy_limit",
    "gravity",
    "solids.*.damping",
    "solids.*.body_force",
    "solids.*.loads",
    "output.every",
    "checkpoint",
)


def is_under(parts: Sequence[str], allowed: Sequence[str]) -> bool:
    """Return whether a key, in its parts, is one of those allowed or in one of them."""
    return any(_matches(parts, pattern.split(".")) for pattern in allowed)


def _matches(parts: Sequence[str], pattern: Sequence[str]) -> bool:
    return len(parts) >= len(pattern) and all(w in ("*", p) for p, w in zip(parts, pattern, strict=False))


def settings(scene_text: str, options_text: str) -> dict[str, str]:
    """Return by key, as TOML, what may change of a scene, and by ``-name`` PETSc's options.

    Parameters
    ----------
    scene_text, options_text : str
        What ``scene.toml`` and ``options.opts`` hold.
    """
    found = {".".join(key): as_toml(value) for key, value in _leaves(tomllib.loads(scene_text), ())}
    for line in options_text.splitlines():
        name, _, value = line.partition("  #")[0].partition(" ")  # behind that is where it is from
        if name.startswith("-"):
            found[name] = value
    return found


def _leaves(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Return the settings in a table that may change, by their keys in parts; a list is one of them."""
    for name, value in table.items():
        here = (*path, name)
        if isinstance(value, dict):
            yield from _leaves(value, here)
        elif is_under(here, RESUMABLE):
            yield here, value


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[tuple[str, str | None, str | None]]:
    """Return the keys that differ, with the old and the new value; None where there is none."""
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            yield key, before.get(key), now.get(key)
