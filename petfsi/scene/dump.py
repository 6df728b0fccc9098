"""A scene as TOML text."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from typing import Any

from petfsi.scene.schema import Scene


def dump_scene(scene: Scene, meshes: Mapping[str, str] | None = None) -> str:
    """Return the scene with every default filled in; read again, from any folder, it is an equal scene.

    Parameters
    ----------
    scene : Scene
    meshes : mapping of str to str, optional
        Other names for mesh files, by their paths: those of a run directory's own copies, relative to it.
    """
    data = scene.model_dump(exclude_none=True, by_alias=True)
    if scene.fluid is not None and scene.dim == 2:
        for side in ("back", "front"):
            del data["fluid"]["sides"][side]
    for item in (*data["solids"].values(), *data["obstacles"].values()):
        if "mesh" in item["shape"]:
            item["shape"]["mesh"] = os.path.abspath(scene.directory / item["shape"]["mesh"])
    _rename(data, meshes or {})
    drop_idle(data)
    text = "\n".join(_table(data, ())).lstrip("\n") + "\n"
    text.encode()  # what is no text is found before there is a file
    return text


def _rename(data: Any, meshes: Mapping[str, str]) -> None:
    """Give mesh files other names."""
    if isinstance(data, dict) and isinstance(data.get("mesh"), str):
        data["mesh"] = meshes.get(data["mesh"], data["mesh"])
    for item in data.values() if isinstance(data, dict) else data if isinstance(data, list) else ():
        _rename(item, meshes)


def drop_idle(data: Any) -> None:
    """Leave out the mesh scale of shapes that are no mesh."""
    if isinstance(data, dict) and "scale" in data and "mesh" not in data:
        del data["scale"]
    for item in data.values() if isinstance(data, dict) else data if isinstance(data, list) else ():
        drop_idle(item)


def _table(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    """Return the lines of a table: its plain settings first, as TOML wants it, then the tables inside."""
    lines = [f"{_key(name)} = {as_toml(value)}" for name, value in table.items() if not isinstance(value, dict)]
    inner = [(name, value) for name, value in table.items() if isinstance(value, dict)]
    if path and lines:
        lines = ["", f"[{'.'.join(map(_key, path))}]", *lines]
    for name, value in inner:
        lines += _table(value, (*path, name))
    return lines


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def as_toml(value: Any) -> str:
    """Return a value as it stands in a TOML file."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return _text(value)
        case list():
            return "[" + ", ".join(map(as_toml, value)) + "]"
        case dict():
            items = ", ".join(f"{_key(name)} = {as_toml(item)}" for name, item in value.items())
            return f"{{ {items} }}" if items else "{}"
    return repr(value)
