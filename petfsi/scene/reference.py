"""What the keys of a scene mean, as ``petfsi help`` tells it: all of it is read off the models."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo
from typing_extensions import Doc

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.scene.dump import as_toml
from petfsi.scene.keys import NAME, NUMBER, Key, every_key, is_model
from petfsi.scene.mistakes import BOUNDS, unknown
from petfsi.scene.tables import OneOf, either

#: Columns of what is told.
WIDTH = 100
_INTRODUCTION = f"""\
The keys of a scene, a TOML file, table by table; all units are SI. {NAME} is a name of your own, {NUMBER} the number
of an item of a list, from 0. Lists of numbers have one per axis, x first. Expressions are texts of x, y, z, t, pi and
e, the usual functions, min, max, where and heaviside. 'petfsi help fluid.sides' tells of a table, 'petfsi help young'
of a key, wherever it stands, and 'petfsi new' writes a scene to begin with."""
_WORDS: dict[Any, tuple[str, str]] = {
    float: ("a number", "numbers"),
    int: ("a whole number", "whole numbers"),
    bool: ("true or false", "true or false"),
    str: ("a text", "texts"),
}

Path = tuple[str, ...]


def reference() -> str:
    """Return what every key means, each table once, at the first place where it may stand."""
    homes = _homes()
    tables = _by_table(every_key())
    told = [_filled(_INTRODUCTION)]
    for (path, table), keys in _by_table(_at_home(homes)).items():
        told.append([*_heading(path, table, keys), ""])
        for names, key in _alike(keys):
            elsewhere = {homes[inner] for path, inner in tables if path == key.inside} - {key.inside}
            told[-1] += _entry(", ".join(names), key, "  ")
            told[-1] += _filled("Its keys: " + ", ".join(sorted(map(_title, elsewhere))), "      ") if elsewhere else []
    return "\n\n".join("\n".join(lines) for lines in told)


def explain(asked: str) -> str:
    """Return what one key means, and if it is a table what its keys are.

    Parameters
    ----------
    asked : str
        A dotted path, with any names and numbers in it, or the last words of one.

    Raises
    ------
    InputError
        If a scene has no such key.
    """
    words = asked.strip().strip("[]").split(".")
    found = _standing_at(words) or _ending_in(words)
    if not found:
        raise InputError(f"{shown(asked)}: {_why_not(words)} ('petfsi help' lists every key)")
    if len({key.path for key in found}) > 1:
        told = {".".join(key.path) + _of_kind(key.kind): key for key in found}
        return "\n".join([f"{len(told)} keys end in '{asked}':", "", *_lines(told)])
    return "\n\n".join(_full(found))


# ---- which keys ---------------------------------------------------------------------------------------------


def _homes() -> dict[type[BaseModel], Path]:
    """Return where each table is told of: the highest place that it may have, and no item of a list if it can."""
    homes: dict[type[BaseModel], Path] = {}
    for key in sorted(every_key(), key=lambda key: (len(key.path), key.path.count(NUMBER))):
        homes.setdefault(key.owner, key.path[:-1])
    return homes


def _at_home(homes: Mapping[type[BaseModel], Path]) -> list[Key]:
    return [key for key in every_key() if key.path[:-1] == homes[key.owner]]


def _by_table(keys: Iterable[Key]) -> dict[tuple[Path, type[BaseModel]], list[Key]]:
    tables: dict[tuple[Path, type[BaseModel]], list[Key]] = {}
    for key in keys:
        tables.setdefault((key.path[:-1], key.owner), []).append(key)
    return tables


def _standing_at(words: Sequence[str]) -> list[Key]:
    """Return the keys at a whole path; of several kinds of fluid each has one."""
    return [key for key in every_key() if any(_fits(words, path) for path in (key.path, key.inside))]


def _ending_in(words: Sequence[str]) -> list[Key]:
    """Return the keys whose paths end in some words, of those that are told of."""
    return [key for key in _at_home(_homes()) if any(_fits(words, end) for end in _ends(key))]


def _ends(key: Key) -> Iterator[Path]:
    """Yield how the path of a key ends, and that of what stands in it, from each part on that is a key itself."""
    for path in (key.path, key.inside):
        yield from (path[n:] for n, part in enumerate(key.path) if part not in (NAME, NUMBER))


def _fits(words: Sequence[str], path: Sequence[str]) -> bool:
    """Return whether words are a path: any for a name, a number or nothing for that of an item."""
    bare = [part for part in path if part != NUMBER]
    return any(len(words) == len(parts) and all(map(_may_be, words, parts)) for parts in (path, bare))


def _may_be(word: str, part: str) -> bool:
    return word == part or part == NAME or (part == NUMBER and word.isdigit())


def _why_not(words: Sequence[str]) -> str:
    """Return what is wrong with a path that no key has."""
    for n in range(len(words) - 1, 0, -1):
        table = _standing_at(words[:n]) or _ending_in(words[:n])
        if table and table[0].tables:
            return unknown([*table[0].inside, words[n]])
        if table:
            return f"{'.'.join(table[0].path)} is no table"
    return unknown([words[0] or ".".join(words)])


# ---- how they are told --------------------------------------------------------------------------------------


def _full(keys: Sequence[Key]) -> Iterator[str]:
    """Yield all of one key, of each kind that has it, and a line for each key in it."""
    for key in keys:
        yield "\n".join(_entry(".".join(key.path) + _of_kind(key.kind), key))
    inside = {key.inside for key in keys}
    for (path, table), inner in _by_table(key for key in every_key() if key.path[:-1] in inside).items():
        yield "\n".join([*_heading(path, table, inner), "", *_lines({", ".join(n): k for n, k in _alike(inner)})])


def _heading(path: Path, table: type[BaseModel], keys: Sequence[Key]) -> list[str]:
    purpose = inspect.cleandoc(table.__doc__ or "").replace("``", "")
    return [_title(path) + _of_kind(keys[0].kind), *_filled(purpose, "  ")]


def _title(path: Path) -> str:
    return f"[{'.'.join(path)}]" if path else "At the top, before any [table]"


def _of_kind(kind: str) -> str:
    return f'  (kind = "{kind}")' if kind else ""


def _alike(keys: Sequence[Key]) -> list[tuple[list[str], Key]]:
    """Return the keys of a table with their names, those that say the same, as sides do, as one."""
    groups: list[tuple[list[str], Key]] = []
    for key in keys:
        said = meaning(key.field), _terms(key.field)
        if groups and said == (meaning(groups[-1][1].field), _terms(groups[-1][1].field)):
            groups[-1][0].append(key.path[-1])
        else:
            groups.append(([key.path[-1]], key))
    return groups


def _entry(name: str, key: Key, indent: str = "") -> list[str]:
    """Return the lines of a key: what may stand there, and what it means."""
    return [*_filled(f"{name} = {_terms(key.field)}", indent, "    "), *_filled(meaning(key.field), indent + "    ")]


def _lines(named: Mapping[str, Key]) -> list[str]:
    """Return a line for each key: its name and what it means in short."""
    longest = max(map(len, named))
    return [f"  {name:{longest}}  {brief(key.field)}" for name, key in named.items()]


def _filled(text: str, indent: str = "", hanging: str = "") -> list[str]:
    """Return a text in lines, those after the first one indented by so much more."""
    return textwrap.wrap(
        " ".join(text.split()), WIDTH, initial_indent=indent, subsequent_indent=indent + hanging, break_on_hyphens=False
    )


def meaning(field: FieldInfo) -> str:
    """Return what a key means, empty if nobody has said so."""
    return next((mark.documentation for mark in field.metadata if isinstance(mark, Doc)), "")


def brief(field: FieldInfo) -> str:
    """Return the first sentence of what a key means."""
    return re.split(r"(?<=\S\.) ", meaning(field), maxsplit=1)[0]


# ---- what may stand there -----------------------------------------------------------------------------------


def _terms(field: FieldInfo) -> str:
    """Return what may stand at a key, its unit and its default."""
    said = field.description or ""
    unit = f" ({said})" if said and not said.startswith("or ") else ""  # the form says what else it may be
    if field.is_required():
        default = "required"
    elif field.default is None or isinstance(field.default, BaseModel | dict | list):
        default = "may be left out"
    else:
        default = f"default {as_toml(field.default)}"
    return f"{_form(field.annotation, field.metadata)}{unit}; {default}"


def _form(annotation: Any, metadata: Iterable[Any] = (), many: bool = False) -> str:
    """Return what a type lets pass, in the words of errors; ``many`` are the items of a list."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _form(parts[0], parts[1:], many)
    marks = [mark for item in metadata for mark in (item.metadata if isinstance(item, FieldInfo) else [item])]
    bounds = " and ".join(_bounds(marks))
    return _type(annotation, marks, many) + (f", {bounds}" if bounds else "")


def _type(annotation: Any, marks: Sequence[Any], many: bool) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    for mark in marks:
        if isinstance(mark, BeforeValidator) and isinstance(mark.func, OneOf):
            return either(mark.func.names)
    if origin is Literal:
        return either(parts)
    if origin is list:
        return f"a list of {_form(parts[0], many=True)}"
    if origin is dict:
        return "tables by name" if is_model(parts[1]) else f"{_form(parts[1], many=True)} by {_form(parts[0])}"
    if origin in (Union, UnionType):
        if set(parts) >= {float, str}:
            return ("a number or an expression", "numbers or expressions")[many]
        return ", or ".join(dict.fromkeys(_form(part, (), many) for part in parts if part is not type(None)))
    return ("a table", "tables")[many] if is_model(annotation) else _WORDS[annotation][many]


def _bounds(marks: Sequence[Any]) -> list[str]:
    """Return the bounds of a number, and that a text or a list must not be empty."""
    said = [
        words.format(getattr(mark, name)) for mark in marks for name, words in BOUNDS.items() if hasattr(mark, name)
    ]
    return said + ["not empty" for mark in marks if hasattr(mark, "min_length")]
