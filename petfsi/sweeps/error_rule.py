"""``[error]`` of a sweep's file: what is compared with what.

A reference is a file with its source, another run, or comes from the sweep itself: of the runs along some axes the
finest, or what the finest three tend to.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.norms import NORMS, Series
from petfsi.output.history import read_history
from petfsi.sweeps.names import digest_of

KEYS = ("of", "norm", "window", "reference", "along", "factor", "order", "bound")
#: Keys of a scene that are the smaller the finer it is.
SMALLER_IS_FINER = {"time.dt", "fluid.spacing"}
#: References that the sweep's own runs are.
FINEST, RICHARDSON = "finest", "richardson"
#: Above all schemes' orders.
HIGHEST = 8.0
#: How far factors of one axis may differ.
_SAME = 0.01


@dataclass(frozen=True)
class ErrorRule:
    """How runs are judged.

    Attributes
    ----------
    of : list of str
        Columns of histories, judged together as components of one vector.
    norm : str
    window : tuple of float or None
        s.
    reference : str
        ``finest``, ``richardson``, or the name of a table among the folder's inputs.
    source : str
        Where that table's numbers are from.
    along : dict of str to list of str
        Axes whose points go from coarse to fine, together, and those points.
    factor : float or None
        By which a point is finer than the one before.
    order : float or None
        The scheme's; None for what its integrator says of itself.
    bound : float or None
        An error beyond it is far off.
    """

    of: list[str]
    norm: str = "l2"
    window: tuple[float, float] | None = None
    reference: str = RICHARDSON
    source: str = ""
    along: dict[str, list[str]] = field(default_factory=dict)
    factor: float | None = None
    order: float | None = None
    bound: float | None = None

    @property
    def own(self) -> bool:
        """Whether the reference comes from the sweep's runs."""
        return self.reference in (FINEST, RICHARDSON)

    def text(self) -> str:
        """Return it as JSON."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def read(cls, text: bytes) -> ErrorRule:
        """Return what ``text`` gave; ValueError if it is another's."""
        try:
            data = json.loads(text)
            data["window"] = data["window"] and tuple(data["window"])
            return cls(**data)
        except (TypeError, KeyError, RecursionError) as error:
            raise ValueError(str(error)) from error


# ---- what a file says ---------------------------------------------------------------------------------------


def read_rule(
    given: Any,
    directory: Path,
    axes: Mapping[str, Sequence[str]],
    decides: Mapping[str, Collection[str]],
    mistakes: list[str],
) -> tuple[ErrorRule | None, bytes]:
    """Return what ``[error]`` of a file says, and the table that is its reference, if it is one; mistakes are added.

    Parameters
    ----------
    given : object
        As TOML has it.
    directory : Path
        What files are relative to.
    axes : mapping of str to sequence of str
        Points by axis.
    decides : mapping of str to collection of str
        By axis the keys of the scene that it sets.
    mistakes : list of str
    """
    before = len(mistakes)
    if not isinstance(given, dict):
        mistakes.append("error: must be a table of what is judged, and against what")
        return None, b""
    for key in given:
        if key not in KEYS:
            mistakes.append(f"error.{shown(key)}: no such key; known here are {', '.join(KEYS)}")
    of = given.get("of")
    of = [of] if isinstance(of, str) else of
    if not isinstance(of, list) or not of or not all(isinstance(one, str) and one for one in of):
        mistakes.append('error.of: must name a column of history.csv, or several: "top.y"')
        of = []
    norm = given.get("norm", "l2")
    if norm not in NORMS:
        mistakes.append(f"error.norm = {shown(norm)}: must be one of {', '.join(NORMS)}")
    window = _window(given.get("window"), mistakes)
    reference, source, table = _reference(given.get("reference", RICHARDSON), directory, of, mistakes)
    along = _along(given, reference, axes, mistakes)
    mistakes += _reversed(along, decides)
    factor = _number("factor", given.get("factor"), 1.0, 1e6, mistakes)
    order = _number("order", given.get("order"), 0.0, HIGHEST, mistakes)
    bound = _number("bound", given.get("bound"), 0.0, math.inf, mistakes)
    if reference == RICHARDSON and along and "factor" not in given:
        factor = _factor(along, mistakes)
    if len(mistakes) > before:
        return None, b""
    return ErrorRule(of, norm, window, reference, source, along, factor, order, bound), table


def _number(key: str, value: Any, low: float, high: float, mistakes: list[str]) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        most = "" if high == math.inf else f" and below {high:g}"
        mistakes.append(f"error.{key} = {shown(value)}: must be a number above {low:g}{most}")
        return None
    return float(value)


def _window(value: Any, mistakes: list[str]) -> tuple[float, float] | None:
    if value is None:
        return None
    numbers = isinstance(value, list) and len(value) == 2
    numbers = numbers and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not numbers or not -math.inf < value[0] < value[1] < math.inf:
        mistakes.append(f"error.window = {shown(value)}: must be two times, from and to, in seconds")
        return None
    return float(value[0]), float(value[1])


def _along(
    given: Mapping[str, Any], reference: str, axes: Mapping[str, Sequence[str]], mistakes: list[str]
) -> dict[str, list[str]]:
    value = given.get("along", [])
    along = [value] if isinstance(value, str) else value
    if not isinstance(along, list) or not all(isinstance(axis, str) for axis in along):
        mistakes.append("error.along: must name axes, each from coarse to fine")
        return {}
    for axis in along:
        if axis not in axes:
            mistakes.append(f"error.along: there is no axis {shown(axis)}; there are {', '.join(axes) or 'none'}")
    own = reference in (FINEST, RICHARDSON)
    if own and not along:
        mistakes.append(f"error.along: {reference} wants the axes along which runs are finer, each from coarse to fine")
    if reference and not own:
        for key in ("along", "factor", "order"):
            if key in given:
                mistakes.append(f"error.{key}: is for finest and richardson; this reference is a table")
    return {axis: list(axes[axis]) for axis in along if axis in axes}


def _reversed(along: Mapping[str, Sequence[str]], decides: Mapping[str, Collection[str]]) -> Iterator[str]:
    """Yield axes that are seen to go from fine to coarse."""
    for axis, points in along.items():
        values = [value for value in map(_float, points) if value is not None]
        rises = len(values) == len(points) > 1 and values[0] < values[-1]
        if rises and set(decides[axis]) & SMALLER_IS_FINER:
            ends = f"{points[0]} to {points[-1]}"
            yield f"error.along: {axis} goes from {ends}, from fine to coarse: list it the other way"


def _float(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _factor(along: Mapping[str, Sequence[str]], mistakes: list[str]) -> float | None:
    """Return by which the points of axes are finer than those before them, where their values say it."""
    found = []
    for points in along.values():
        values = [value for value in map(_float, points) if value is not None]
        steps = [max(a / b, b / a) if a > 0.0 and b > 0.0 else 0.0 for a, b in zip(values, values[1:], strict=False)]
        if len(steps) != len(points) - 1 or not steps or max(steps) - min(steps) > _SAME * max(steps):
            continue
        found.append(steps[0])
    if not found or max(found) - min(found) > _SAME * max(found):
        mistakes.append("error.factor: must say by how much each point along is finer; the axes' values do not tell")
        return None
    return found[0]


def _reference(given: Any, directory: Path, of: Sequence[str], mistakes: list[str]) -> tuple[str, str, bytes]:
    """Return the reference's name, its source, and the table that is to be copied."""
    if given in (FINEST, RICHARDSON):
        return given, "", b""
    if not isinstance(given, dict) or len({"file", "run"} & set(given)) != 1:
        mistakes.append(
            f'error.reference: must be "{RICHARDSON}", "{FINEST}", {{ file = "x.csv", source = "..." }} or '
            '{ run = "DIR" }'
        )
        return "", "", b""
    for key in given:
        if key not in ("file", "run", "source"):
            mistakes.append(f"error.reference.{shown(key)}: no such key; known here are file or run, and source")
    which = "file" if "file" in given else "run"
    name, source = given[which], given.get("source", "")
    if not isinstance(name, str) or not name or not isinstance(source, str):
        mistakes.append(f"error.reference.{which}: must be a name in quotes")
        return "", "", b""
    if which == "file" and not source:
        mistakes.append("error.reference.source: must say where the numbers are from")
    path = directory / name / "history.csv" if which == "run" else directory / name
    try:
        columns = read_history(path)
        series_of(columns, of)
    except InputError as error:
        mistakes.append(f"error.reference.{which}: {error}")
        return "", "", b""
    wanted = ["time", *of]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(wanted)
    writer.writerows([repr(float(value)) for value in row] for row in zip(*(columns[c] for c in wanted), strict=True))
    table = out.getvalue().encode()
    return f"reference-{digest_of(table)}.csv", source or f"the run {path.parent.name}", table


def series_of(columns: Mapping[str, np.ndarray], of: Sequence[str]) -> Series:
    """Return columns of a history over time; InputError if it has none of that name, or times that go back."""
    for name in ("time", *of):
        if name not in columns:
            known = [column for column in columns if column not in ("step", "time")]
            raise InputError(f"has no column {shown(name)}; it has {shown(', '.join(known) or 'none', 300)}")
    times = np.asarray(columns["time"], dtype=float)
    if not len(times) or np.any(np.diff(times) <= 0.0):
        raise InputError("has no rows, or times that do not rise")
    values = np.column_stack([columns[name] for name in of]).astype(float)
    if not np.all(np.isfinite(values)):
        raise InputError(f"has values of {', '.join(of)} that are no numbers")
    return Series(times, values)
