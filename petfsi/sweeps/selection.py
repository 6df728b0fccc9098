"""Which runs of a sweep ``--only`` means."""

from __future__ import annotations

import re
from collections.abc import Sequence

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.sweeps.folder import axes_of
from petfsi.sweeps.names import points_meant
from petfsi.sweeps.plan import Planned

#: A bracket, or a comma.
_MARKS = re.compile(r"[\[\]{},]")


def select(text: str, runs: Sequence[Planned]) -> list[Planned]:
    """Return the runs that ``--only`` names, in their order.

    Parameters
    ----------
    text : str
        ``axis=point,...``: several points of an axis are alternatives, and all axes must fit. Names of runs may
        stand among them; those runs are taken, too.
    runs : sequence of Planned

    Raises
    ------
    InputError
        If a part of it is neither, or no run is at the points.
    """
    axes, names = axes_of(runs), {run.name for run in runs}
    rules: dict[str, list[str]] = {}
    named = set()
    for part in _parts(text):
        axis, separator, point = (word.strip() for word in part.partition("="))
        if axis in names and not separator:
            named.add(axis)
            continue
        if not separator or axis not in axes:
            known = ", ".join(axes) or "none"
            raise InputError(f"--only {shown(part)}: must be axis=point, or the name of a run; axes are {known}")
        meant = points_meant(axes[axis], point)
        if not meant:
            raise InputError(f"--only {shown(part)}: no such point; {axis} has {shown(', '.join(axes[axis]), 500)}")
        rules.setdefault(axis, []).extend(meant)
    at = {run.name for run in runs if rules and _is_at(run, rules)}
    if rules and not at:
        raise InputError(f"--only {shown(text, 200)}: no run is at these points; they are excluded")
    return [run for run in runs if run.name in at | named]


def _parts(text: str) -> list[str]:
    """Return what stands between commas; those in brackets part nothing."""
    parts, begin, depth = [], 0, 0
    for mark in _MARKS.finditer(text):
        if mark[0] != ",":
            depth = depth + 1 if mark[0] in "[{" else max(depth - 1, 0)
        elif depth == 0:
            parts.append(text[begin : mark.start()])
            begin = mark.end()
    return [*parts, text[begin:]]


def _is_at(run: Planned, rules: dict[str, list[str]]) -> bool:
    return all(run.axes[axis] in points for axis, points in rules.items())
