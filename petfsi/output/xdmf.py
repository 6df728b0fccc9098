"""XDMF: the small XML files through which ParaView and meshio find their way in the HDF5 files.

``fields.xdmf`` is for ParaView: at every time the grid or the particles, and the deformed solid, side by side.
``fluid.xdmf`` and ``solid.xdmf`` are series on one mesh that never moves, as ``meshio.xdmf.TimeSeriesReader`` wants
them; the solid's displacement is a point data there. ``particles.xdmf`` is a series of point clouds: every time has its
own points, and as many as there are then. ``TimeSeriesReader`` reads the points of the first time unless told, by
``reader.mesh_grid = reader.collection[k]``, which. ParaView opens those too; where a cloud is empty its reader says
that it found no data, and shows none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args
from xml.etree import ElementTree

from petfsi.output.manifest import Index

#: Shape and NumPy type of every array of a file, by HDF5 path.
Arrays = Mapping[str, tuple[tuple[int, ...], str]]

_NUMBERS = {
    "float64": ("Float", "8"),
    "float32": ("Float", "4"),
    "int64": ("Int", "8"),
    "int32": ("Int", "4"),
    "uint8": ("UChar", "1"),
}
_TOPOLOGY = {
    ("solid", 3): "Triangle",
    ("solid", 4): "Tetrahedron",
    ("grid", 4): "Quadrilateral",
    ("grid", 8): "Hexahedron",
}
#: The indexes that a run may have; that of particles from the first output time with some on.
NAMES: tuple[Index, ...] = get_args(Index)
_CLOUD = "particles/points"


@dataclass(frozen=True)
class GridInfo:
    """A regular grid: its lower corner (m), its cells' edges (m) and their numbers, per axis."""

    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    cells: tuple[int, ...]


@dataclass(frozen=True)
class Entry:
    """One output time: its file, relative to the run, and what is in it."""

    step: int
    time: float
    file: str
    arrays: Arrays


#: What opens and closes the series of all times.
BEGIN = '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n <Domain>\n'
BEGIN += '  <Grid Name="run" GridType="Collection" CollectionType="Temporal">\n'
END = "  </Grid>\n </Domain>\n</Xdmf>\n"


def parts(mesh: str, static: Arrays, entry: Entry, grid: GridInfo | None) -> dict[Index, str]:
    """Return what an output time adds to the index files, by their names, for the parts that the scene has.

    Parameters
    ----------
    mesh : str
        File of the parts that never change, relative to the run.
    static : mapping
        Its arrays: ``grid/points``, ``grid/cells``, ``solid/reference``, ``solid/cells``, ``solid/body``.
    entry : Entry
        The output time.
    grid : GridInfo or None
        The fluid's grid.
    """
    found: dict[Index, ElementTree.Element] = {"fields.xdmf": _both(mesh, static, entry, grid)}
    if "grid/cells" in static:
        found["fluid.xdmf"] = _timed(_flat_grid(mesh, static, entry), entry)
    if "solid/cells" in static:
        found["solid.xdmf"] = _timed(_solid(mesh, static, entry, (mesh, "solid/reference", static)), entry)
    if _CLOUD in entry.arrays:
        found["particles.xdmf"] = _timed(_particles(entry), entry)
    return {name: _text(element) for name, element in found.items()}


def _text(element: ElementTree.Element) -> str:
    ElementTree.indent(element, " ", level=3)
    return f"   {ElementTree.tostring(element, encoding='unicode').strip()}\n"


def _both(mesh: str, static: Arrays, entry: Entry, grid: GridInfo | None) -> ElementTree.Element:
    scene = _timed(ElementTree.Element("Grid", Name="scene", GridType="Collection", CollectionType="Spatial"), entry)
    if grid:
        # VTK's reader turns a plane regular grid into the y-z plane, so in 2D the quadrilaterals are listed
        scene.append(_flat_grid(mesh, static, entry) if len(grid.cells) == 2 else _regular_grid(grid, entry))
    if "solid/points" in entry.arrays:
        scene.append(_solid(mesh, static, entry, (entry.file, "solid/points", entry.arrays)))
    if _CLOUD in entry.arrays and entry.arrays[_CLOUD][0][0] > 0:  # VTK's reader complains of a cloud of no points
        scene.append(_particles(entry))
    return scene


def _timed(grid: ElementTree.Element, entry: Entry) -> ElementTree.Element:
    grid.insert(0, ElementTree.Element("Time", Value=repr(entry.time)))
    return grid


def _regular_grid(grid: GridInfo, entry: Entry) -> ElementTree.Element:
    """Return the 3D grid; XDMF counts points, and names z first everywhere."""
    element = ElementTree.Element("Grid", Name="fluid", GridType="Uniform")
    points = " ".join(str(n + 1) for n in reversed(grid.cells))
    ElementTree.SubElement(element, "Topology", TopologyType="3DCoRectMesh", Dimensions=points)
    geometry = ElementTree.SubElement(element, "Geometry", GeometryType="ORIGIN_DXDYDZ")
    for values in (grid.origin, grid.spacing):
        about = {"Dimensions": "3", "NumberType": "Float", "Precision": "8", "Format": "XML"}
        item = ElementTree.SubElement(geometry, "DataItem", about)
        item.text = " ".join(repr(float(value)) for value in reversed(values))
    for name in _names(entry.arrays, "fluid/"):
        _attribute(element, name, "Cell", len(grid.cells), entry.file, f"fluid/{name}", entry.arrays)
    return element


def _flat_grid(mesh: str, static: Arrays, entry: Entry) -> ElementTree.Element:
    """Return the grid as a list of quadrilaterals or hexahedra."""
    element = _unstructured("fluid", "grid", mesh, static, (mesh, "grid/points", static))
    for name in _names(entry.arrays, "cells/"):
        _attribute(element, name, "Cell", 1, entry.file, f"cells/{name}", entry.arrays)
    return element


def _solid(mesh: str, static: Arrays, entry: Entry, points: tuple[str, str, Arrays]) -> ElementTree.Element:
    element = _unstructured("solid", "solid", mesh, static, points)
    n_points = static["solid/reference"][0][0]
    for name in _names(entry.arrays, "solid/"):
        if name != "points":
            center = "Node" if entry.arrays[f"solid/{name}"][0][0] == n_points else "Cell"
            _attribute(element, name, center, 1, entry.file, f"solid/{name}", entry.arrays)
    _attribute(element, "body", "Cell", 1, mesh, "solid/body", static)
    return element


def _particles(entry: Entry) -> ElementTree.Element:
    """Return the particles of one time as a cloud of points; it may be empty."""
    file, arrays = entry.file, entry.arrays
    element = ElementTree.Element("Grid", Name="particles", GridType="Uniform")
    n, dim = arrays[_CLOUD][0]
    about = {"TopologyType": "Polyvertex", "NumberOfElements": str(n), "NodesPerElement": "1"}
    _data(ElementTree.SubElement(element, "Topology", about), file, "particles/vertices", arrays)
    _data(ElementTree.SubElement(element, "Geometry", GeometryType=_geometry(dim)), file, _CLOUD, arrays)
    for name in _names(arrays, "particles/"):
        if name not in ("points", "vertices"):
            _attribute(element, name, "Node", 1, file, f"particles/{name}", arrays)
    return element


def _geometry(dim: int) -> str:
    return "XY" if dim == 2 else "XYZ"


def _unstructured(
    name: str, group: str, mesh: str, static: Arrays, points: tuple[str, str, Arrays]
) -> ElementTree.Element:
    element = ElementTree.Element("Grid", Name=name, GridType="Uniform")
    n, corners = static[f"{group}/cells"][0]
    kind = _TOPOLOGY[group, corners]
    topology = ElementTree.SubElement(element, "Topology", TopologyType=kind, NumberOfElements=str(n))
    _data(topology, mesh, f"{group}/cells", static)
    file, path, arrays = points
    geometry = ElementTree.SubElement(element, "Geometry", GeometryType=_geometry(arrays[path][0][1]))
    _data(geometry, file, path, arrays)
    return element


def _names(arrays: Arrays, prefix: str) -> list[str]:
    return sorted(path.removeprefix(prefix) for path in arrays if path.startswith(prefix))


def _attribute(
    grid: ElementTree.Element, name: str, center: str, axes: int, file: str, path: str, arrays: Arrays
) -> None:
    kind = "Scalar" if len(arrays[path][0]) == axes else "Vector"
    attribute = ElementTree.SubElement(grid, "Attribute", Name=name, AttributeType=kind, Center=center)
    _data(attribute, file, path, arrays)


def _data(parent: ElementTree.Element, file: str, path: str, arrays: Arrays) -> None:
    shape, dtype = arrays[path]
    number, precision = _NUMBERS[dtype]
    item = ElementTree.SubElement(
        parent,
        "DataItem",
        Dimensions=" ".join(map(str, shape)),
        NumberType=number,
        Precision=precision,
        Format="HDF",
    )
    item.text = f"{file}:/{path}"
