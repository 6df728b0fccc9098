"""What is wrong with a scene, in the words of a user: the key, its value, and what is allowed."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from petfsi.messages import shown
from petfsi.scene.fluids import DEFAULT
from petfsi.scene.keys import NAME, NUMBER, Key, every_key, is_form, is_model, kind_of, settings, walk
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Shape

#: No value stands at the key.
ABSENT = object()
#: Characters of a key that are shown.
LONGEST = 100
#: What numbers must be, by pydantic's names of bounds.
BOUNDS = {
    "gt": "greater than {:g}",
    "ge": "{:g} or more",
    "lt": "less than {:g}",
    "le": "{:g} or less",
    "multiple_of": "a multiple of {:g}",
}
#: How much alike names of different tables must be, from 0 to 1, for one to be taken for the other.
ALIKE = 0.75
#: More places than this that a setting may be meant for are none.
MEANT = 2
#: What only a solid's shape can be or have.
OF_SOLIDS = ("beam", "cavity")
#: What of a shape is said of a mesh file alone.
OF_MESHES = ("cells", "scale", "translate")
#: What is known of a scene where there is none.
NO_SCENE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Problem:
    """One mistake.

    Attributes
    ----------
    key : str
        Dotted path, as ``--set`` takes it.
    value : object
        What stands there.
    allowed : str
        What may stand there.
    uses : tuple of str
        Other keys the verdict rests on; while one of them is wrong itself, the verdict is withheld.
    """

    key: str
    value: Any
    allowed: str
    uses: tuple[str, ...] = ()

    def __str__(self) -> str:
        value = "" if self.value is ABSENT else f" = {shorten(self.value)}"
        return f"{shown(self.key, LONGEST)}{value}: {self.allowed}"

    def follows_from(self, wrong: Iterable[str]) -> bool:
        """Whether one of the keys it rests on, or one inside or around them, is known to be wrong."""
        return any(_overlap(mine, other) for mine in (self.key, *self.uses) for other in wrong)


def _overlap(a: str, b: str) -> bool:
    short, long = sorted((a.split("."), b.split(".")), key=len)
    return long[: len(short)] == short


def shorten(value: Any) -> str:
    """Return a value on one line of bounded length."""
    return shown(f'"{value}"' if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else value)


# ---- from pydantic ------------------------------------------------------------------------------------------


def describe(entry: Mapping[str, Any], data: Mapping[str, Any]) -> Problem:
    """Return pydantic's finding in the tables of a scene as a problem."""
    loc = [part for part in entry["loc"] if not str(part).startswith("[")]
    key = ".".join(str(part) for part in loc if not is_form(part))
    field = _field(loc)
    value = ABSENT if entry["type"] == "missing" or entry["loc"][-1] == "[key]" else entry["input"]
    if entry["type"] == "extra_forbidden":
        return Problem(key, value, unknown(loc, data))
    allowed = _allowed(entry)
    unit = f" ({field.description})" if field is not None and field.description else ""
    return Problem(key, value, allowed + unit)


def _allowed(entry: Mapping[str, Any]) -> str:
    context = entry.get("ctx", {})
    for bound, words in BOUNDS.items():
        if bound in context:
            return f"must be {words.format(context[bound])}"
    match entry["type"]:
        case "missing":
            return "is missing"
        case "float_type":
            return "must be a number"
        case "finite_number":
            return "must be a finite number"
        case "int_type":
            return "must be a whole number"
        case "bool_type":
            return "must be true or false"
        case "string_type":
            return "must be a text in quotes"
        case "list_type":
            return "must be a list [..., ...]"
        case "model_type" | "dict_type":
            return "must be a table"
        case "literal_error":
            return f"must be {context['expected']}"
        case "too_short" | "string_too_short":
            return "must not be empty"
    return entry["msg"]


def unknown(loc: list[Any], data: Mapping[str, Any] = NO_SCENE) -> str:
    """Say that there is no such setting, and which one may be meant: beside it, or else in another table.

    Parameters
    ----------
    loc : list of str or int
        The path of the setting, with pydantic's forms of tables or without; that of its table is sound.
    data : mapping
        The scene's tables, as far as it has any.
    """
    name, table = str(loc[-1]), _model(loc[:-1])
    given = shown(name)
    fields = settings(table) if table is not None else {}
    path = tuple(part for part in loc if not is_form(part))
    kinds = [kind for kind in walk(list(path[:-1]))[0] if is_model(kind) and kind_of(kind)]
    having = [kind_of(kind) for kind in kinds if name in settings(kind)]
    if having:
        return f"belongs to kind = {' and '.join(having)}; known here are {', '.join(fields)}"
    inside = [names for names in _elsewhere(loc, name, data) if names[: len(path) - 1] == _words(path[:-1])]
    near = difflib.get_close_matches(name, fields, 1)
    if near and not inside:
        unit = fields[near[0]].description
        return f"no setting '{given}'; did you mean '{near[0]}'" + (f" ({unit})?" if unit else "?")
    everywhere = {key.path: key.path[-1] for key in every_key()}
    if path in everywhere:  # of another form of this table
        return f"does not belong here; known here are {', '.join(fields)}"
    if (name,) in everywhere:
        return f"no setting '{given}' here; it stands at the top of the scene, before any [table]"
    alike = difflib.get_close_matches(name, dict.fromkeys(everywhere.values()), 1, ALIKE)
    meant = _elsewhere(loc, alike[0], data) if alike else []
    if meant:
        return f"no setting '{given}' here; did you mean {' or '.join(repr('.'.join(names)) for names in meant)}?"
    return f"no setting '{given}'; known here are {', '.join(fields)}"


def _elsewhere(loc: list[Any], name: str, data: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return where else a setting may be meant to stand that is called so: at one place or two, or at none.

    Parameters
    ----------
    loc : list of str or int
        Where it stands instead.
    name : str
    data : mapping
        The scene's tables: of several places those in tables that it has come first.
    """
    at = _words(part for part in loc[:-1] if not is_form(part))
    fluid = _table_at(("fluid",), data)
    given = set() if fluid is None else {str(fluid.get("kind", DEFAULT))}
    kinds = {key.kind for key in every_key()} & ({str(part).strip("<>") for part in loc if is_form(part)} | given)
    keys = [key for key in every_key() if key.path[-1] == name and len(key.path) > 1
            and not (kinds and key.kind and key.kind not in kinds) and not _only_of_solids(key)]  # fmt: skip
    paths = {path: key for key in keys if not _of_no_mesh(path := _as_given(key.path, at), key, data)}
    common = {path: _common(path, at) for path in paths}
    nearest = [path for path in paths if common[path] == max(common.values())]
    below = any(common[path] == len(at) for path in nearest) and at != ()
    if not below and len(paths) > MEANT and any(key.tables for key in keys):
        return []  # a table that may stand in many others is not meant for the one that happens to be near
    nearest = [path for path in nearest if _table_at(path[:-1], data) is not None] or nearest
    found = [path for path in nearest if len(path) == min(map(len, nearest))]
    return found if len(found) <= MEANT else []


def _words(parts: Iterable[Any]) -> tuple[str, ...]:
    return tuple(map(str, parts))


def _only_of_solids(key: Key) -> bool:
    """Whether a key is of a shape that solids alone may be, and stands where none can."""
    return not set(key.path).isdisjoint(OF_SOLIDS) and key.path[:3] != ("solids", NAME, "shape")


def _of_no_mesh(path: tuple[str, ...], key: Key, data: Mapping[str, Any]) -> bool:
    """Whether a key is of mesh files, and would stand in a shape that is none."""
    shape = _table_at(path[:-1], data)
    return key.owner is Shape and path[-1] in OF_MESHES and shape is not None and "mesh" not in shape


def _table_at(path: tuple[str, ...], data: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the table that a scene has at a path, None if it has none."""
    here: Any = data
    for part in path:
        if isinstance(here, list) and part.isdigit() and int(part) < len(here):
            here = here[int(part)]
        else:
            here = here.get(part) if isinstance(here, Mapping) else None
    return here if isinstance(here, Mapping) else None


def _common(path: tuple[str, ...], at: tuple[str, ...]) -> int:
    """Return how many parts the tables of a key and the one at a path have in common, from the top."""
    pairs = list(zip(path[:-1], at, strict=False))
    return next((n for n, (one, other) in enumerate(pairs) if one != other), len(pairs))


def _as_given(path: tuple[str, ...], at: tuple[str, ...]) -> tuple[str, ...]:
    """Return a key's path with the names and numbers that a table's has, as far as both go the same way."""
    found = list(path)
    for n, (part, given) in enumerate(zip(path, at, strict=False)):
        if not (part == given or part == NAME or (part == NUMBER and given.isdigit())):
            break
        found[n] = given
    return tuple(found)


def _field(loc: list[Any]) -> FieldInfo | None:
    return walk(loc)[1]


def _model(loc: list[Any]) -> type[BaseModel] | None:
    return next((kind for kind in walk(loc)[0] if is_model(kind)), None)


# ---- going on -----------------------------------------------------------------------------------------------

#: Harmless values for settings that are required: what stands there is wrong, the rest can still be judged.
_STAND_IN: dict[str, Any] = {
    "time": {"end": 1.0, "dt": 1.0},
    "dt": 1.0,
    "density": 1.0,
    "young": 1.0,
    "poisson": 0.0,
    "radius": 1.0,
    "speed": 0.0,
    "shape": {},
    "of": "fluid",
    "quantity": "velocity",
    "where": "all",
    "fix": ["x"],
    "tag": "facets",
}
_VECTORS = ("origin", "size", "cells", "centre", "start", "point", "normal", "at")


def mend(data: dict[str, Any], error: ValidationError, context: dict[str, Any]) -> Scene | None:
    """Return the scene with harmless values where pydantic found mistakes, or None where that does not help.

    It serves to look for further mistakes, so that a user sees all of them at once, and is never run.
    """
    data = copy.deepcopy(data)
    dim = 3 if data.get("dim") == 3 else 2
    for entry in error.errors(include_url=False):
        loc = [part for part in entry["loc"] if not str(part).startswith(("<", "["))]
        _replace(data, loc, dim, required=entry["type"] != "extra_forbidden")
    try:
        return Scene.model_validate(data, context=context)
    except ValidationError:
        return None


def _replace(data: Any, loc: list[Any], dim: int, required: bool) -> None:
    """Put a harmless value at the path, or nothing where nothing is needed."""
    for part in loc[:-1]:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return  # an earlier replacement has taken it along
    name = loc[-1]
    if isinstance(data, list):
        data[name] = "x" if loc[-2] == "fix" else 1
    elif isinstance(data, dict):
        value = _stand_in(loc, dim) if required else None
        if value is None:
            data.pop(name, None)
        else:
            data[name] = value


def _stand_in(loc: list[Any], dim: int) -> Any:
    name = loc[-1]
    if name == "dim":
        return dim
    if name == "end":  # of the time, or of a cylinder
        return 1.0 if loc[0] == "time" else [1.0] * dim
    if name == "cells" and "ball" in loc:
        return 2
    return [1] * dim if name in _VECTORS else copy.deepcopy(_STAND_IN.get(name))
