"""A run's own copies of the mesh files that its scene names: ``meshes/1/bunny.msh``, ``meshes/2/...``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from petfsi.errors import InputError
from petfsi.output import files
from petfsi.output.manifest import MeshMark
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Shape

DIRECTORY = "meshes"
#: Of a format in two files, the endings that belong together.
_PAIRS = ({".node", ".ele"},)
_HDF5_ITEM = re.compile(r"([^\s<>:/\\]+\.(?:h5|hdf5|bin))\s*:?")


@dataclass(frozen=True)
class MeshFile:
    """A mesh file as it was when the scene was read."""

    source: Path
    mark: MeshMark


def mesh_files(scene: Scene) -> list[MeshFile]:
    """Return the files of a scene's meshes and what they are now. Not collective.

    Raises
    ------
    InputError
        When one cannot be read.
    """
    found = []
    for number, mesh in enumerate(sorted({os.path.abspath(mesh) for mesh in _named(scene)}), 1):
        for source in _with_companions(Path(mesh)):
            try:
                size, digest = files.digest(source.resolve())
            except OSError as error:
                raise InputError(f"mesh file {source}: {files.reason(error)}") from error
            name = f"{DIRECTORY}/{number}/{source.name}"
            origin = files.name_of(source)
            found.append(MeshFile(source, MeshMark(file=name, source=origin, bytes=size, blake2b=digest)))
    return found


def copy_meshes(meshes: list[MeshFile], directory: Path) -> None:
    """Copy mesh files into a folder that stands for ``meshes``.

    Raises
    ------
    InputError
        When one has changed since the scene was read.
    """
    for mesh in meshes:
        copy_mesh(mesh, directory / Path(mesh.mark.file).relative_to(DIRECTORY))


def copy_mesh(mesh: MeshFile, path: Path) -> None:
    """Copy a mesh file; InputError, and no copy, when it has changed since the scene was read."""
    data = mesh.source.read_bytes()
    if (len(data), files.digest_of(data)) != (mesh.mark.bytes, mesh.mark.blake2b):
        raise InputError(f"mesh file {mesh.source} has changed while the scene was set up; run again")
    path.parent.mkdir(parents=True, exist_ok=True)
    files.replace_text(path, data)


def own_names(meshes: list[MeshMark], directory: Path) -> dict[str, str]:
    """Return the names of the copies in a run's scene, by the names that the present scene has for the files."""
    return {mesh.source: mesh.file for mesh in meshes} | {
        os.path.abspath(directory / mesh.file): mesh.file for mesh in meshes
    }


def changed_meshes(meshes: tuple[MeshMark, ...], directory: Path) -> Iterator[str]:
    """Say what of a run's meshes is not what it was: its copies, and the files they came from where those are left."""
    for mesh in meshes:
        path = directory / mesh.file
        try:
            linked = any(p.is_symlink() for p in (path, path.parent, path.parent.parent))
            if linked or files.digest(path) != (mesh.bytes, mesh.blake2b):
                yield f"{path} is another mesh than the run began with; put that back"
        except OSError as error:
            yield f"{path}, the run's mesh: {files.reason(error)}; put it back"
        if _has_changed(mesh):
            yield (
                f"{mesh.source} is another mesh than the run began with: start a new run with it; to go on with the "
                f"run's own copy, {mesh.file}, rename it"
            )


def _has_changed(mesh: MeshMark) -> bool:
    source = Path(mesh.source)
    try:
        return source.is_file() and files.digest(source.resolve()) != (mesh.bytes, mesh.blake2b)
    except (OSError, ValueError):
        return False


def _named(model: Any) -> Iterator[str]:
    """Return the mesh files that shapes name, anywhere in a scene."""
    if isinstance(model, Shape):
        if model.mesh is not None:
            yield model.mesh
    elif isinstance(model, BaseModel):
        for name in type(model).model_fields:
            yield from _named(getattr(model, name))
    elif isinstance(model, dict | list | tuple):
        for item in model.values() if isinstance(model, dict) else model:
            yield from _named(item)


def _with_companions(path: Path) -> list[Path]:
    """Return a mesh file and those that it cannot be read without; what is no file is told by who opens it."""
    if not path.is_file():
        return [path]
    ending = path.suffix.lower()
    others = {path.with_suffix(e) for pair in _PAIRS if ending in pair for e in pair - {ending}}
    if ending in (".xdmf", ".xmf"):
        others |= {path.parent / name for name in _HDF5_ITEM.findall(path.read_text(errors="replace"))}
    others |= _included(path)
    return [path, *sorted(other for other in others if other.is_file() and other != path)]


def _included(path: Path) -> set[Path]:
    """Return the files that one of Abaqus's or Nastran's includes, and those that these do."""
    from petfsi.geometry.readers import abaqus_cards, nastran_cards
    from petfsi.geometry.readers.formats import find_readers
    from petfsi.geometry.readers.included import read_text

    known = {"abaqus": abaqus_cards, "nastran": nastran_cards}
    cards = next((known[name] for name, _ in find_readers(path) if name in known), None)
    found: set[Path] = set()
    rest = [path] if cards else []
    while cards and rest:
        names = cards.included_names(read_text(rest.pop()))
        new = {path.parent / name for name in names if Path(name).name == name} - found
        found |= new
        rest += [other for other in new if other.is_file()]
    return found
