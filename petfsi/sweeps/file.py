"""A sweep's file: which scene, which axes, and what of them is left out. All mistakes are found before any is told."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.scene.dump import as_toml
from petfsi.scene.raw import read_raw
from petfsi.sweeps.error_rule import ErrorRule, read_rule
from petfsi.sweeps.names import point_text, points_meant
from petfsi.sweeps.values import is_dated, read_values

KEYS = ("scene", "set", "repeat", "steps", "axis", "exclude", "error")
#: Words of an axis whose points are values, and of a point that has a name.
BY_VALUE, BY_NAME = ("key", "option", "ranks", "values"), ("options_file", "options", "set", "ranks")
#: Runs of the largest sweep, ranks of the largest run, and rounds.
MOST_RUNS, MOST_RANKS, MOST_ROUNDS = 100_000, 100_000, 1000
_AXIS = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")


@dataclass(frozen=True)
class Point:
    """A point of an axis, and what it changes.

    Attributes
    ----------
    text : str
        Its name, or its value.
    sets : dict of str to str
        Keys of the scene and their values, as TOML.
    options : dict of str to str
        Of PETSc, without the dash.
    options_file : str
        As it was named; empty if none is.
    ranks : int or None
    """

    text: str
    sets: dict[str, str] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    options_file: str = ""
    ranks: int | None = None

    def touches(self) -> set[str]:
        """Return what it decides, in the words of a file."""
        named = {"options_file"} if self.options_file else set()
        ranks = set() if self.ranks is None else {"ranks"}
        return {f"set.{key}" for key in self.sets} | {f"options.{name}" for name in self.options} | named | ranks


@dataclass(frozen=True)
class SweepFile:
    """What a sweep's file says.

    Attributes
    ----------
    path : Path
    scene : Path or None
        None if it is not named.
    text : bytes
        As given.
    sets : dict of str to str
        For every run, as TOML.
    repeat : int
    steps : int or None
    axes : dict of str to list of Point
    excluded : list of dict
        By axis the points that do not go together.
    rule : ErrorRule or None
        How runs are judged, if they are.
    table : bytes
        The reference for that, where it is a table.
    """

    path: Path
    text: bytes
    scene: Path | None
    sets: dict[str, str]
    repeat: int
    steps: int | None
    axes: dict[str, list[Point]]
    excluded: list[dict[str, list[str]]]
    rule: ErrorRule | None = None
    table: bytes = b""

    def excludes(self, points: Mapping[str, Point]) -> bool:
        """Return whether a combination of points is left out."""
        return any(all(points[axis].text in wanted for axis, wanted in rule.items()) for rule in self.excluded)


def read_sweep_file(path: Path, mistakes: list[str]) -> SweepFile:
    """Return what a file says; what is wrong with it is added to ``mistakes``, and left out.

    Raises
    ------
    InputError
        If there is none, or it is no TOML.
    """
    if not path.exists():
        raise InputError(f"{shown(path, 200)}: no such file; a sweep is a TOML file, or the folder of an earlier one")
    data = read_raw(path)
    for key in data:
        if key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known here are {', '.join(KEYS)}"
            mistakes.append(f"{shown(key)}: no such key of a sweep; {hint}")
    scene = data.get("scene")
    if not isinstance(scene, str) or not scene:
        mistakes.append("scene: must name a scene's file, relative to this one")
        scene = ""
    axes = _axes(data.get("axis", {}), mistakes)
    rule, table = _rule(data["error"], path.parent, axes, mistakes) if "error" in data else (None, b"")
    return SweepFile(
        path=path,
        text=path.read_bytes(),
        scene=path.parent / scene if scene else None,
        sets=_settings("set", data.get("set", {}), mistakes),
        repeat=_whole("repeat", data.get("repeat", 1), MOST_ROUNDS, mistakes) or 1,
        steps=_whole("steps", data["steps"], 2**53, mistakes) if "steps" in data else None,
        axes=axes,
        excluded=_excluded(data.get("exclude", []), data.get("axis", {}), axes, mistakes),
        rule=rule,
        table=table,
    )


def _rule(
    given: Any, directory: Path, axes: Mapping[str, list[Point]], mistakes: list[str]
) -> tuple[ErrorRule | None, bytes]:
    texts = {name: [point.text for point in points] for name, points in axes.items()}
    decides = {name: {key for point in points for key in point.sets} for name, points in axes.items()}
    return read_rule(given, directory, texts, decides, mistakes)


# ---- axes ---------------------------------------------------------------------------------------------------


def _axes(given: Any, mistakes: list[str]) -> dict[str, list[Point]]:
    if not isinstance(given, dict):
        mistakes.append("axis: must be a table of axes")
        return {}
    found: dict[str, list[Point]] = {}
    for name, axis in given.items():
        key = f"axis.{shown(name)}"
        if not _AXIS.fullmatch(name) or len(name) > 60:
            mistakes.append(f"{key}: an axis's name has up to 60 letters, digits and . _ + -, the first no sign")
        elif not isinstance(axis, dict) or not axis:
            mistakes.append(f"{key}: must be a table of points, or have key, option or ranks with values")
        else:
            by_value = any(word in axis for word in BY_VALUE)
            found[name] = _points_by_value(key, axis, mistakes) if by_value else _named_points(key, axis, mistakes)
    mistakes += _clashes(found)
    return {name: points for name, points in found.items() if points}  # what the others say can still be judged


def _clashes(axes: Mapping[str, list[Point]]) -> Iterator[str]:
    """Yield what two axes decide: the same, or one a table and the other what stands in it."""
    by: dict[str, str] = {}
    inside: dict[str, tuple[str, str]] = {}  # by table: who decides what of it
    for name, points in axes.items():
        mine = {what: _around(what) for what in sorted({what for point in points for what in point.touches()})}
        for what, around in mine.items():
            here = f"axis.{name}: decides {shown(what)}"
            table = next((table for table in around if table in by), None)
            if what in by:
                yield f"{here}, as axis.{by[what]} does"
            elif table is not None or what in inside:
                axis, other = inside[what] if table is None else (by[table], table)
                yield f"{here}, and axis.{axis} {shown(other)}: one would undo what the other sets"
        for what, around in mine.items():
            by.setdefault(what, name)
            for table in around:
                inside.setdefault(table, (name, what))


def _around(key: str) -> list[str]:
    """Return the tables that a dotted key stands in."""
    parts = key.split(".")
    return [".".join(parts[:n]) for n in range(1, len(parts))]


def _points_by_value(key: str, axis: dict[str, Any], mistakes: list[str]) -> list[Point]:
    """Return the points of an axis of values: of a key of the scene, an option, or ranks."""
    what = [word for word in ("key", "option", "ranks") if word in axis]
    for word in (word for word in axis if word not in BY_VALUE):
        mistakes.append(f"{key}.{shown(word)}: no such word of an axis of values: key, option or ranks, and values")
    if len(what) != 1:
        mistakes.append(f"{key}: must have one of key, option and ranks, and has {' and '.join(what) or 'none'}")
        return []
    if what[0] == "ranks" and "values" in axis:
        mistakes.append(f"{key}.values: the values of ranks stand there: ranks = [1, 2]")
        return []
    place = f"{key}.ranks" if what[0] == "ranks" else f"{key}.values"
    values = read_values(place, axis["ranks"] if what[0] == "ranks" else axis.get("values"), mistakes)
    texts = [point_text(value) for value in values]
    twice = [text for text, count in Counter(texts).items() if count > 1]
    if twice:
        mistakes.append(f"{place}: {shown(', '.join(twice), 200)} stand{'s' * (len(twice) == 1)} there more than once")
    if what[0] == "ranks":
        counts = [_whole(place, value, MOST_RANKS, mistakes) for value in values]
        return [Point(text, ranks=count) for text, count in zip(texts, counts, strict=True)]
    target = axis[what[0]]
    if not isinstance(target, str) or not target:
        mistakes.append(f"{key}.{what[0]}: must be a text in quotes")
        return []
    if what[0] == "option":
        found = [_options(place, {target: value}, mistakes) for value in values]
        return [Point(text, options=one) for text, one in zip(texts, found, strict=True)]
    return [Point(text, sets={target: as_toml(value)}) for text, value in zip(texts, values, strict=True)]


def _named_points(key: str, axis: dict[str, Any], mistakes: list[str]) -> list[Point]:
    found = []
    for name, point in axis.items():
        here = f"{key}.{shown(name)}"
        if not isinstance(point, dict):
            mistakes.append(f"{here}: must be a table, of {', '.join(BY_NAME)}")
            continue
        for word in (word for word in point if word not in BY_NAME):
            mistakes.append(f"{here}.{shown(word)}: no such word of a point; it may have {', '.join(BY_NAME)}")
        file = point.get("options_file", "")
        if not isinstance(file, str) or ("options_file" in point and not file):
            mistakes.append(f"{here}.options_file: must name an options file")
            file = ""
        found.append(
            Point(
                name,
                sets=_settings(f"{here}.set", point.get("set", {}), mistakes),
                options=_options(f"{here}.options", point.get("options", {}), mistakes),
                options_file=file,
                ranks=_whole(f"{here}.ranks", point["ranks"], MOST_RANKS, mistakes) if "ranks" in point else None,
            )
        )
    return found


def _excluded(
    given: Any, tables: Any, axes: Mapping[str, list[Point]], mistakes: list[str]
) -> list[dict[str, list[str]]]:
    """Return the rules of ``[[exclude]]`` that can be followed."""
    if not isinstance(given, list) or not all(isinstance(rule, dict) and rule for rule in given):
        mistakes.append("exclude: must be [[exclude]] tables, of axes and their points")
        return []
    found = []
    for number, rule in enumerate(given):
        wrong = [axis for axis, points in rule.items() if points == [] or is_dated(points)]
        mistakes += [
            f"exclude.{number}.{shown(axis)} = {shown(rule[axis])}: must be a point or several" for axis in wrong
        ]
        if wrong:
            continue
        wanted = {axis: [point_text(one) for one in (v if isinstance(v, list) else [v])] for axis, v in rule.items()}
        right = True
        for axis, points in wanted.items():
            if axis not in axes:
                right = False
                if not isinstance(tables, dict) or axis not in tables:  # else what is wrong with it is told already
                    mistakes.append(f"exclude.{number}.{shown(axis)}: there is no such axis")
                continue
            meant = {point: points_meant([one.text for one in axes[axis]], point) for point in points}
            for point in (point for point in points if not meant[point]):
                right = False
                mistakes.append(f"exclude.{number}.{axis} = {shown(point)}: the axis has no such point")
            wanted[axis] = [text for texts in meant.values() for text in texts]
        found += [wanted] if right else []
    return found


# ---- entries ------------------------------------------------------------------------------------------------


def _settings(key: str, given: Any, mistakes: list[str]) -> dict[str, str]:
    """Return settings of a scene as TOML, by key."""
    if not isinstance(given, dict):
        mistakes.append(f"{key}: must be a table of keys and values")
        return {}
    found = {}
    for name, value in given.items():
        if isinstance(value, dict) and "." not in name:
            # TOML reads time.end = 1 as a table [time], which as a setting would take the place of the scene's own
            mistakes.append(f'{key}.{shown(name)}: is a table; keys of a scene stand in quotes: "{shown(name)}...." = ')
        elif is_dated(value):
            mistakes.append(f"{key}.{shown(name)}: no setting is a date or a time; a text stands in quotes")
        else:
            found[name] = as_toml(value)
    return found


def _options(key: str, given: Any, mistakes: list[str]) -> dict[str, str]:
    if not isinstance(given, dict):
        mistakes.append(f"{key}: must be a table of options and their values")
        return {}
    found = {}
    for name, value in given.items():
        if not isinstance(value, int | float | str):
            mistakes.append(f"{key}.{shown(name)}: an option's value is a number, a text, true or false")
        elif name.lstrip("-").lower() == "options_file":
            mistakes.append(f"{key}.{shown(name)}: options_file is a word of its own, beside options")
        elif name.lstrip("-").lower() in found:
            mistakes.append(f"{key}.{shown(name)}: stands there twice, in another spelling")
        else:
            found[name.lstrip("-").lower()] = point_text(value)
    return found


def _whole(key: str, value: Any, most: int, mistakes: list[str]) -> int | None:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        given = as_toml(value) if isinstance(value, str | bool) else value
        mistakes.append(f"{key} = {shown(given)}: must be a whole number from 1 to {most:,}")
        return None
    return value
