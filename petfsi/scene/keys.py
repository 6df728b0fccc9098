"""The keys of a scene: how dotted paths go through the models of its tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from petfsi.scene.schema import Scene

#: What stands in a path for the name of a table, and for the number of an item of a list.
NAME, NUMBER = "NAME", "N"


@dataclass(frozen=True)
class Key:
    """A key that a scene may have.

    Attributes
    ----------
    path : tuple of str
        Its parts, with ``NAME`` and ``NUMBER`` for those that a scene chooses.
    field : FieldInfo
        What may stand there.
    owner : type
        The model that says so: of kinds that share a key the one that they have it from.
    kind : str
        The kind of fluid that alone has it; empty where all do.
    """

    path: tuple[str, ...]
    field: FieldInfo
    owner: type[BaseModel]
    kind: str = ""

    @property
    def inside(self) -> tuple[str, ...]:
        """The path of what stands in it: of a list of tables that of an item, of named tables that of one of them."""
        steps = {dict: NAME, list: NUMBER}
        origins = [get_origin(part) for part in members(self.field.annotation)]
        return (*self.path, *(steps[origin] for origin in origins if origin in steps))

    @property
    def tables(self) -> list[type[BaseModel]]:
        """The tables that may stand there, or as items there."""
        return [table for part in members(self.field.annotation) for table in members(_item(part)) if is_model(table)]


@cache
def every_key() -> tuple[Key, ...]:
    """Return all keys of a scene, in the order of the models."""
    found: dict[tuple[tuple[str, ...], type[BaseModel]], Key] = {}
    for key in _keys(Scene, (), ""):
        place = key.path, key.owner
        found[place] = replace(key, kind="") if place in found else key
    return tuple(found.values())


def _keys(model: type[BaseModel], path: tuple[str, ...], kind: str) -> Iterator[Key]:
    kind = kind_of(model) or kind
    for name, field in model.model_fields.items():
        owner = next(base for base in model.__mro__ if name in base.__dict__.get("__annotations__", {}))
        key = Key((*path, field.alias or name), field, owner, kind)
        yield key
        for table in key.tables:
            yield from _keys(table, key.inside, kind)


def kind_of(model: type[BaseModel]) -> str:
    """Return the kind that a table is the only one to be of, as fluids have several; empty of others."""
    return getattr(model, "form", "").strip("<>") if "kind" in model.model_fields else ""


def settings(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields of a table as a scene spells them."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def is_model(annotation: Any) -> bool:
    """Whether an annotation is a table's model."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def members(annotation: Any) -> list[Any]:
    """Return the members of a union, the annotation itself otherwise, bare of ``Annotated``."""
    if get_origin(annotation) is Annotated:
        return members(get_args(annotation)[0])
    if get_origin(annotation) in (dict, list) or not get_args(annotation):
        return [annotation]
    return [inner for part in get_args(annotation) for inner in members(part)]


def _item(annotation: Any) -> Any:
    """Return what the items of a list or the entries of a table with any names are, else the annotation itself."""
    return get_args(annotation)[-1] if get_origin(annotation) in (dict, list) else annotation


def is_form(part: Any) -> bool:
    """Whether a part of pydantic's path tells which form of a table is meant, and is no key."""
    return str(part).startswith("<")


def walk(loc: list[Any]) -> tuple[list[Any], FieldInfo | None]:
    """Follow pydantic's path through the models: what may stand there, and the last field passed."""
    here: list[Any] = [Scene]
    field: FieldInfo | None = None
    for part in loc:
        following: list[Any] = []
        if is_form(part):
            here = [kind for kind in here if getattr(kind, "form", part) == part]
            continue
        for kind in here:
            if is_model(kind) and part in settings(kind):
                field = settings(kind)[part]
                following += members(field.annotation)
            elif get_origin(kind) in (dict, list):
                following += members(_item(kind))
        here = following
    return here, field
