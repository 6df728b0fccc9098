"""Which reader takes a mesh file: what its beginning says first, then its ending."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import meshio
import numpy as np
from meshio._helpers import reader_map
from meshio._mesh import topological_dimension

from petfsi.geometry.readers.abaqus import read_abaqus
from petfsi.geometry.readers.exodus import read_exodus
from petfsi.geometry.readers.gmsh import read_gmsh
from petfsi.geometry.readers.nastran import read_nastran

#: Takes a file and a list of what its user should know of how it was read.
Reader = Callable[[Path, list[str]], meshio.Mesh]

#: What a file's beginning is looked at, bytes.
HEAD = 4096
#: Formats by how files begin, whatever they are called.
_BEGINNINGS = tuple(
    (re.compile(pattern, re.IGNORECASE), name)
    for pattern, name in (
        (rb"\$(MeshFormat|NOD|Comments)\b", "gmsh"),
        (rb"(<\?xml[^>]*>)?\s*<VTKFile[^>]*UnstructuredGrid", "vtu"),
        (rb"# vtk DataFile", "vtk"),
        (rb"MeshVersionFormatted", "medit"),
        (rb"MFEM ", "MFEM"),
        (rb"(\*\*[^\n]*\n|\s)*\*[a-z]", "abaqus"),
        (rb"(#[^\n]*\n|\s)*\d+ +\d+ +\d+ +\d+ +\d+\s*\n", "avsucd"),
        (rb"\d+ +\d+ +\d+ *\r?\n *[-+.\de]+ +[-+.\de]+ +\d+ *\r?\n", "freefem"),
        (rb"\(", "ansys"),
        (rb"(?ms).*?^\s*(BEGIN\s+BULK|CEND|GRID\*?[\s,]+\d)", "nastran"),
    )
)
#: Formats by endings, where meshio has none, or one that the beginning should have told.
_ENDINGS = {".ucd": "avsucd", ".exii": "exodus", ".g": "exodus", ".inp": "inp", ".msh": "msh"}
#: What is not read, and why.
_REFUSED = {
    "MFEM": "meshes of MFEM are not read",
    "mdpa": "meshes of Kratos are not read: they name elements, not their cells",
    "svg": "pictures are not read",
    "inp": "it begins neither as Abaqus's files do nor as AVS's",
    "msh": "it begins as files of neither Gmsh, nor ANSYS, Abaqus or FreeFem do",
}
#: Parts of medit's files with what remeshing must keep.
_MEDIT_KEPT = re.compile(r"\s*(Required|Ridges|Corners|Normal|Tangent|ParallelE)")
#: Formats of surfaces that trimesh reads, too.
_SURFACES = ("obj", "off", "ply", "stl")


# meshio and the readers here know such cells, but it has no dimension for them
topological_dimension.update(wedge15=3, pyramid13=3)


def find_readers(path: Path) -> list[tuple[str, Reader]]:
    """Return what can read a file, the first first, each with the format that it takes the file for."""
    with path.open("rb") as file:
        head = file.read(HEAD).removeprefix(b"\xef\xbb\xbf").lstrip()
    name = next((name for pattern, name in _BEGINNINGS if pattern.match(head)), "") or _by_ending(path)
    found: list[tuple[str, Reader]] = []
    if name in _OWN:
        found.append((name, _OWN[name]))
    elif name and name not in _REFUSED:
        found.append((name, partial(_by_meshio, name)))
    elif name:
        found.append((name, partial(_not_read, _REFUSED[name])))
    if name in _SURFACES:
        found.append((name, _by_trimesh))
    return found


def endings() -> list[str]:
    """Return the endings of files that are read."""
    known = {ending for ending, names in meshio.extension_to_filetypes.items() if set(names) - set(_REFUSED)}
    return sorted(known | set(_ENDINGS))


def _by_ending(path: Path) -> str:
    ending = path.suffix.lower()
    return _ENDINGS.get(ending) or next(iter(meshio.extension_to_filetypes.get(ending, [])), "")


def _not_read(why: str, path: Path, notes: list[str]) -> meshio.Mesh:
    raise meshio.ReadError(why)


def _by_meshio(name: str, path: Path, notes: list[str]) -> meshio.Mesh:
    mesh = reader_map[name](str(path))
    if name in _SURFACES and any(block.type == "polygon" for block in mesh.cells):
        raise meshio.ReadError("faces of more than four corners")
    if name in _SURFACES and mesh.points.ndim == 2:
        mesh.points = mesh.points[:, :3]  # colours may follow
    return mesh


def _by_trimesh(path: Path, notes: list[str]) -> meshio.Mesh:
    import trimesh

    # no pictures, of which it tells in tracebacks that they are not there, and points as they are in the file
    surface = trimesh.load_mesh(path, process=False, skip_materials=True, fix_texture=False)
    if not len(surface.faces):  # it reads what is no mesh as one without faces
        raise meshio.ReadError("no faces")
    told = _faces_told(path)
    if told and told != len(surface.faces):
        notes.append(f"{told:,} faces, of which some have more than three corners, are cut into {len(surface.faces):,}")
    return meshio.Mesh(np.asarray(surface.vertices), [("triangle", np.asarray(surface.faces))])


def _faces_told(path: Path) -> int:
    """Return how many faces a file says that it has, or 0 if that is not found."""
    data, ending = path.read_bytes(), path.suffix.lower()
    if ending == ".obj":
        return len(re.findall(rb"^\s*f\s", data, re.MULTILINE))
    pattern = rb"element\s+face\s+(\d+)" if ending == ".ply" else rb"\s*OFF\s+(?:#[^\n]*\s+)*\d+\s+(\d+)"
    found = re.search(pattern, data[:HEAD]) if ending in (".ply", ".off") else None
    return int(found[1]) if found else 0


def _of_text(text: str, name: str) -> meshio.Mesh:
    """Return what meshio makes of a text; its readers lose their place where lines end as on Windows."""
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory, f"mesh.{name}")
        copy.write_text(text, newline="\n")
        return reader_map[name](str(copy))


def _read_vtk(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return what meshio reads; where it does not know what results are of, the mesh without them."""
    try:
        return reader_map["vtk"](str(path))
    except (Exception, SystemExit):
        data = path.read_bytes()
        end = re.search(rb"\n(CELL|POINT)_DATA\b", data)
        if end is None:
            raise
        with tempfile.TemporaryDirectory() as directory:
            copy = Path(directory, "mesh.vtk")
            copy.write_bytes(data[: end.start() + 1])
            mesh = reader_map["vtk"](str(copy))
        notes.append("values at cells and points cannot be read, and so no groups")
        return mesh


def _read_stl(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return the facets of a text, however its solids begin and end, or what meshio makes of binary files."""
    data = path.read_bytes()
    if b"\0" in data[:HEAD] or b"facet" not in data[:HEAD].lower():
        return reader_map["stl"](str(path))
    points = np.array(re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data, re.IGNORECASE), dtype=float)
    if not len(points) or len(points) % 3:
        raise meshio.ReadError("facets that have not three vertices")
    return meshio.Mesh(points, [("triangle", np.arange(len(points)).reshape(-1, 3))])


def _read_medit(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return what meshio reads, which ends at parts that say nothing of the mesh but what remeshing must keep."""
    if path.read_bytes()[:4] in (b"\1\0\0\0", b"\0\0\0\1"):  # how binary files begin
        return reader_map["medit"](str(path))
    pieces = re.split(r"(?m)^(?=[^\S\n]*[A-Za-z])", path.read_text(errors="replace"))
    return _of_text("".join(piece for piece in pieces if not _MEDIT_KEPT.match(piece)), "medit")


def _read_su2(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return what meshio reads, with the names of markers instead of numbers.

    It is given numbers: of names it says that it replaces them, and it may take one that another marker has.
    """
    text = path.read_text(errors="replace")
    if len(re.findall(r"^\s*NDIME\s*=", text, re.MULTILINE)) > 1:
        raise meshio.ReadError("more than one zone")
    names: list[str] = []

    def numbered(line: re.Match[str]) -> str:
        names.append(line[2])
        return f"{line[1]}{len(names)}"

    mesh = _of_text(re.sub(r"^(\s*MARKER_TAG\s*=[ \t]*)(\S+).*$", numbered, text, flags=re.MULTILINE), "su2")
    mesh.cell_tags = {number: [name] for number, name in enumerate(names, 1)}
    return mesh


def _read_freefem(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return triangles, edges and their labels of FreeFem's files in the plane."""
    numbers = np.fromstring(path.read_bytes(), sep=" ")
    points, triangles, edges = numbers[:3].astype(int).tolist()
    ends = np.cumsum([3, 3 * points, 4 * triangles, 3 * edges])
    if ends[-1] != len(numbers):
        raise meshio.ReadError("another number of points, triangles or edges than it announces")
    x, cells, facets = (
        part.reshape(-1, width) for part, width in zip(np.split(numbers, ends)[1:4], (3, 4, 3), strict=True)
    )
    blocks = [("triangle", cells[:, :3].astype(int) - 1), ("line", facets[:, :2].astype(int) - 1)]
    return meshio.Mesh(x[:, :2], blocks, cell_data={"label": [cells[:, 3].astype(int), facets[:, 2].astype(int)]})


_OWN: dict[str, Reader] = {
    "gmsh": read_gmsh, "abaqus": read_abaqus, "exodus": read_exodus, "nastran": read_nastran, "su2": _read_su2,
    "freefem": _read_freefem, "medit": _read_medit, "vtk": _read_vtk, "stl": _read_stl,
}  # fmt: skip
