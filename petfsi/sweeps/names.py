"""Names of runs: readable, and the same whatever other points a sweep has."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Collection, Sequence
from typing import Any

from petfsi.scene.dump import as_toml

#: Characters of the longest name: that of a folder, beside others in a path.
LONGEST = 120
#: Of the hash that stands for what a name cannot say.
_DIGITS = 8
#: Of digests in the names of files.
DIGITS = 12
_REFUSED = re.compile(r"[^A-Za-z0-9._+-]+")
_REPEAT = re.compile(r"_r[0-9]+$")


def digest_of(data: bytes) -> str:
    """Return what stands for some bytes in the name of a file."""
    return hashlib.sha256(data).hexdigest()[:DIGITS]


def point_text(value: Any) -> str:
    """Return the text of an axis's value: of a number the shortest that ``%g`` has for it, 1e-06."""
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        texts = (f"{value:.{digits}g}" for digits in range(6, 18))
        return next((text for text in texts if float(text) == value), repr(value))
    return as_toml(value)


def points_meant(texts: Collection[str], wanted: str) -> list[str]:
    """Return which points of an axis are meant: the one of that text, else the same number or list, 1e-6 for 1e-06."""
    return [wanted] if wanted in texts else [text for text in texts if _is_same_value(text, wanted)]


def _is_same_value(text: str, wanted: str) -> bool:
    try:
        if text.startswith("[") and wanted.startswith("["):
            return bool(tomllib.loads(f"v = {text}")["v"] == tomllib.loads(f"v = {wanted}")["v"])
        return float(text) == float(wanted)
    except (ValueError, RecursionError):  # TOML that is wrong is a ValueError, too
        return False


def run_name(points: Sequence[tuple[str, str]], repeat: int = 1) -> str:
    """Return the name of the run at some points of axes, ``solver-paper_rtol-1e-06_r2``.

    What cannot stand in it, is too long, or could be read in two ways is told apart by a hash at its end, over all
    points: two runs of a sweep never share a name, and none hangs on what other points there are.

    Parameters
    ----------
    points : sequence of (axis, point)
    repeat : int
        From 1; the first has no mark.
    """
    plain = "_".join(f"{axis}-{point}" for axis, point in points) or "run"
    last = f"_r{repeat}" if repeat > 1 else ""
    name = _REFUSED.sub("_", plain) + last
    if _is_clear(points) and name == plain + last and len(name) <= LONGEST:
        return name
    mark = "_" + hashlib.sha256(json.dumps([list(points), repeat]).encode()).hexdigest()[:_DIGITS]
    return name[: LONGEST - len(mark)] + mark


def _is_clear(points: Sequence[tuple[str, str]]) -> bool:
    """Return whether a name can be taken apart again: the next axis begins where it first seems to."""
    for (_, point), (axis, _) in zip(points, points[1:], strict=False):
        between = f"_{axis}-"
        if (point + between).index(between) != len(point):
            return False
    return not points or not _REPEAT.search(points[-1][1])
