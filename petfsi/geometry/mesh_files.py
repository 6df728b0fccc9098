"""Mesh files through the readers that others keep: meshio, and trimesh for surfaces that it cannot read."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.scene.tables import Shape

if TYPE_CHECKING:
    import meshio

#: Plane and solid elements of Abaqus that meshio has no name for: how they integrate is none of a mesh's business.
_ABAQUS = {
    "triangle": ("CPE3", "CPE3H", "CPS3", "M3D3", "DC2D3", "CPEG3"),
    "triangle6": ("CPE6", "CPE6H", "CPE6M", "CPS6", "CPS6M", "M3D6", "DC2D6", "CPEG6"),
    "quad": ("CPE4", "CPE4H", "CPE4I", "CPE4R", "CPE4RH", "CPS4", "CPS4I", "CPS4R", "M3D4", "DC2D4", "CPEG4"),
    "quad8": ("CPE8", "CPE8H", "CPE8R", "CPE8RH", "CPS8", "CPS8R", "M3D8", "DC2D8"),
    "tetra": ("C3D4", "C3D4H", "DC3D4"),
    "tetra10": ("C3D10", "C3D10H", "C3D10M", "C3D10MH", "C3D10I", "DC3D10"),
    "pyramid": ("C3D5", "C3D5H"),
    "wedge": ("C3D6", "C3D6H", "DC3D6"),
    "wedge15": ("C3D15", "C3D15H", "DC3D15"),
    "hexahedron": ("C3D8", "DC3D8"),
    "hexahedron20": ("C3D20", "DC3D20"),
}
#: Formats of surfaces that trimesh reads.
_SURFACES = (".obj", ".off", ".ply", ".stl")


def open_mesh(shape: Shape, key: str, directory: Path) -> meshio.Mesh:
    """Return what a reader makes of a shape's file; whatever it does to say no becomes one InputError. Not collective.

    Parameters
    ----------
    shape : Shape
        With ``mesh``.
    key : str
        Where that stands in the scene, for messages: ``"solids.layer.shape.mesh"``.
    directory : Path
        What the path is relative to.
    """
    path = Path(directory) / str(shape.mesh)
    if not path.is_file():
        raise InputError(f"{key} = {shape.mesh!r}: no file {path}")
    readers: list[Callable[[Path], meshio.Mesh]] = [_by_meshio]
    if path.suffix.lower() in _SURFACES:
        readers.append(_by_trimesh)
    first = ""
    for read in readers:
        said = io.StringIO()
        try:
            # on a broken file some readers print, warn or even exit
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                return read(path)
        except (Exception, SystemExit) as error:
            why = str(error) if isinstance(error, Exception) else ""
            first = first or " ".join(f"{why} {said.getvalue()}".split()) or type(error).__name__
    raise InputError(f"{key} = {shape.mesh!r}: cannot be read as a mesh ({shown(first, 300)})")


def _by_meshio(path: Path) -> meshio.Mesh:
    import meshio
    from meshio.abaqus import _abaqus
    from meshio.gmsh import _gmsh41

    for kind, names in _ABAQUS.items():
        for name in names:
            _abaqus.abaqus_to_meshio_type.setdefault(name, kind)
    read_entities = _gmsh41._read_entities
    _gmsh41._read_entities = lambda *words: _all_in_groups(*read_entities(*words))
    try:
        return meshio.read(path)
    finally:
        _gmsh41._read_entities = read_entities


def _all_in_groups(physical, bounding):
    """Return what meshio reads of gmsh's entities; those in no group are in 0, or it loses count of them."""
    return tuple({tag: groups or [0] for tag, groups in of.items()} for of in physical), bounding


def _by_trimesh(path: Path) -> meshio.Mesh:
    import meshio
    import trimesh

    surface = trimesh.load_mesh(path, process=False)
    if not len(surface.faces):  # it reads what is no mesh as one without faces
        raise ValueError("no faces")
    return meshio.Mesh(np.asarray(surface.vertices), [("triangle", np.asarray(surface.faces))])
