"""Reading a scene: TOML and ``--set`` into a ``Scene``, with every mistake reported at once."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.scene import checks, mistakes
from petfsi.scene.changes import is_under
from petfsi.scene.dump import dump_scene
from petfsi.scene.mistakes import Problem
from petfsi.scene.raw import MAX_DEPTH, judge_raw, read_raw
from petfsi.scene.schema import Scene

__all__ = ["apply_set", "dump_scene", "load_scene", "parse_value", "scene_from_dict"]

#: Characters of a file's name, or a setting, that are shown.
LONGEST = 200
#: Mistakes that are told, on a screen; of the others the number.
MAX_LINES = 20


def load_scene(path: Path | str, sets: Sequence[str] = (), only: Sequence[str] | None = None) -> Scene:
    """Return the scene in a TOML file. Not collective: one rank reads, and gives the scene to the others.

    Parameters
    ----------
    path : Path
        The file; its folder is where relative mesh paths start.
    sets : sequence of str
        Settings ``a.b.c=value`` that override the file.
    only : sequence of str, optional
        The keys, or tables, that ``sets`` may change, ``RESUMABLE``; all by default.

    Raises
    ------
    InputError
        With every mistake in the scene: its key, its value and what is allowed.
    """
    path = Path(path)
    data = read_raw(path)
    for setting in sets:
        apply_set(data, setting, only)
    return _validate(data, path.parent, shown(path, LONGEST))


def scene_from_dict(data: dict[str, Any], directory: Path | str = Path()) -> Scene:
    """Return the scene that a dictionary says, judged like a file in ``directory``."""
    judge_raw(data, "scene")
    return _validate(copy.deepcopy(data), Path(directory), "scene")


# ---- --set --------------------------------------------------------------------------------------------------


def apply_set(data: dict[str, Any], setting: str, only: Sequence[str] | None = None) -> None:
    """Put one ``a.b.c=value`` into the raw scene; missing tables are made, list items count from 0."""
    key, separator, text = setting.partition("=")
    setting = shown(setting, LONGEST)
    key = key.strip()
    parts = key.split(".")
    if not separator or not all(parts):
        raise InputError(f"--set {setting}: must be key=value, such as --set time.dt=0.01")
    if only is not None and not is_under(parts, only):
        raise InputError(
            f"--set {setting}: a run that goes on may change {', '.join(only)} and PETSc options; what "
            "else may differ in a new run from this one's state: petfsi run NEW.toml --from DIR"
        )
    holder: Any = data
    if len(parts) > MAX_DEPTH:
        raise InputError(f"--set {setting}: tables are nested no deeper than {MAX_DEPTH} levels")
    for n, part in enumerate(parts):
        path = ".".join(parts[:n])
        if isinstance(holder, list):
            if not (part.isascii() and part.isdigit() and int(part) < len(holder)):
                raise InputError(f"--set {setting}: {path} is a list; its items are numbered 0 to {len(holder) - 1}")
        elif not isinstance(holder, dict):
            raise InputError(f"--set {setting}: {path} is {shown(holder)}, not a table")
        index = int(part) if isinstance(holder, list) else part
        if n == len(parts) - 1:
            holder[index] = parse_value(text.strip(), f"--set {setting}")
        else:
            holder = holder.setdefault(index, {}) if isinstance(holder, dict) else holder[index]


def parse_value(text: str, source: str = "value") -> Any:
    """Return a TOML value, or the text itself where it is none, so that quotes need not survive a shell.

    Raises
    ------
    InputError
        If it holds what no scene does (see ``raw.py``); the message begins with ``source``.
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        parsed = {}
    except (ValueError, RecursionError, OverflowError):
        raise InputError(f"{source}: holds a number of too many digits, or is nested too deep") from None
    if parsed.keys() != {"value"}:
        parsed = {"value": text}
    judge_raw(parsed, source)
    return parsed["value"]


# ---- judging ------------------------------------------------------------------------------------------------


def _validate(data: dict[str, Any], directory: Path, source: str) -> Scene:
    context = {"directory": directory}
    try:
        scene: Scene | None = Scene.model_validate(data, context=context)
        problems: list[Problem] = []
    except ValidationError as error:
        problems = [mistakes.describe(entry, data) for entry in error.errors(include_url=False)]
        scene = mistakes.mend(data, error, context)
    wrong = [problem.key for problem in problems]
    if scene is not None:
        problems += [problem for problem in checks.problems(scene) if not problem.follows_from(wrong)]
    if problems or scene is None:
        raise InputError(_report(source, problems))
    return scene


def _report(source: str, problems: list[Problem]) -> str:
    count = "one mistake" if len(problems) == 1 else f"{len(problems)} mistakes"
    lines = [f"{source}: {count}", *(f"  {problem}" for problem in problems[:MAX_LINES])]
    if len(problems) > MAX_LINES:
        lines.append(f"  and {len(problems) - MAX_LINES} more")
    return "\n".join(lines)
