"""Reading a scene: TOML and ``--set`` into a ``Scene``, with every mistake reported at once."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from petfsi.errors import InputError
from petfsi.scene import checks, mistakes
from petfsi.scene.changes import is_under
from petfsi.scene.dump import dump_scene
from petfsi.scene.mistakes import Problem
from petfsi.scene.schema import Scene

__all__ = ["apply_set", "dump_scene", "load_scene", "parse_value", "scene_from_dict"]

MAX_LINES = 40


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
    data = _read(path)
    for setting in sets:
        apply_set(data, setting, only)
    return _validate(data, path.parent, str(path))


def scene_from_dict(data: dict[str, Any], directory: Path | str = Path()) -> Scene:
    """Return the scene that a dictionary says, judged like a file in ``directory``."""
    return _validate(copy.deepcopy(data), Path(directory), "scene")


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a scene is a TOML file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a scene is a TOML file (a run folder is for 'petfsi resume')") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); a scene is a TOML file") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


# ---- --set --------------------------------------------------------------------------------------------------


def apply_set(data: dict[str, Any], setting: str, only: Sequence[str] | None = None) -> None:
    """Put one ``a.b.c=value`` into the raw scene; missing tables are made, list items count from 0."""
    key, separator, text = setting.partition("=")
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
    for n, part in enumerate(parts):
        path = ".".join(parts[:n])
        if isinstance(holder, list):
            if not (part.isascii() and part.isdigit() and int(part) < len(holder)):
                raise InputError(f"--set {setting}: {path} is a list; its items are numbered 0 to {len(holder) - 1}")
        elif not isinstance(holder, dict):
            raise InputError(f"--set {setting}: {path} is {mistakes.shorten(holder)}, not a table")
        index = int(part) if isinstance(holder, list) else part
        if n == len(parts) - 1:
            holder[index] = parse_value(text.strip())
        else:
            holder = holder.setdefault(index, {}) if isinstance(holder, dict) else holder[index]


def parse_value(text: str) -> Any:
    """Return a TOML value, or the text itself where it is none, so that quotes need not survive a shell."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    return parsed["value"] if parsed.keys() == {"value"} else text


# ---- judging ------------------------------------------------------------------------------------------------


def _validate(data: dict[str, Any], directory: Path, source: str) -> Scene:
    context = {"directory": directory}
    try:
        scene: Scene | None = Scene.model_validate(data, context=context)
        problems: list[Problem] = []
    except ValidationError as error:
        problems = [mistakes.describe(entry) for entry in error.errors(include_url=False)]
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
