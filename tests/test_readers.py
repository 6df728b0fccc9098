"""Mesh files as others write them, which meshio alone would refuse or misread, and such as announce too much."""

import resource
import signal
import time
import warnings
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from scipy.io import netcdf_file

from petfsi.bounded import TooLongError, bounded
from petfsi.errors import InputError
from petfsi.geometry import mesh_files
from petfsi.geometry.meshes import box_mesh, build_mesh, read_surface
from petfsi.geometry.places import read_tags
from petfsi.geometry.surfaces import boundary_facets, signed_volumes
from petfsi.output import mesh_files as run_files
from petfsi.scene.schema import Solid
from petfsi.scene.tables import Box, Shape

#: A square of four triangles around its middle; the right half is in a group of its own, and so is the left side.
POINTS = ["0 0 0", "1 0 0", "1 1 0", "0 1 0", "0.5 0.5 0"]
CELLS = [[1, 2, 5], [2, 3, 5], [3, 4, 5], [4, 1, 5]]
NUMBERED = "".join(f"{n} {x}\n" for n, x in enumerate(POINTS, 1))
NAMES = '$PhysicalNames\n3\n1 7 "foot"\n2 1 "water"\n2 2 "flag"\n$EndPhysicalNames\n'


def version_1():
    rows = ["1 1 7 1 2 4 1", *(f"{n} 2 {1 + (n == 3)} 1 3 {a} {b} {c}" for n, (a, b, c) in enumerate(CELLS, 2))]
    return f"$NOD\n5\n{NUMBERED}$ENDNOD\n$ELM\n5\n" + "\n".join(rows) + "\n$ENDELM\n"


def version_2(tags="2 {0} {0}"):
    rows = [f"1 1 {tags.format(7)} 4 1", *(f"{n} 2 {tags.format(1 + (n == 3))} {a} {b} {c}"
                                           for n, (a, b, c) in enumerate(CELLS, 2))]  # fmt: skip
    elements = f"$Elements\n{len(rows)}\n" + "\n".join(rows) + "\n$EndElements\n"
    data = '$ElementData\n1\n"x"\n1\n0\n3\n0\n1\n1\n2 0.5\n$EndElementData\n'
    return f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{NAMES}$Nodes\n5\n{NUMBERED}$EndNodes\n{elements}{data}"


def version_2_binary():
    def rows(*numbers):
        return np.array(numbers, dtype="<i4").tobytes()

    nodes = b"".join(rows(n) + np.array(x.split(), dtype="<f8").tobytes() for n, x in enumerate(POINTS, 1))
    lines = rows(1, 1, 2, 1, 7, 7, 4, 1)
    cells = rows(2, 4, 2) + b"".join(rows(n, 1 + (n == 3), 9, *cell) for n, cell in enumerate(CELLS, 2))
    return (
        b"$MeshFormat\n2.2 1 8\n" + rows(1) + b"\n$EndMeshFormat\n" + NAMES.encode() + b"$Nodes\n5\n" + nodes
        + b"\n$EndNodes\n$Elements\n5\n" + lines + cells + b"\n$EndElements\n"
    )  # fmt: skip


def version_40():
    points = "".join(f"{n} {x}\n" for n, x in enumerate(POINTS, 1))
    entities = "0 1 2 0\n1 0 0 0 0 1 0 1 7 0\n1 0 0 0 1 1 0 1 1 0\n2 0 0 0 1 1 0 1 2 0\n"
    return (
        f"$MeshFormat\n4 0 8\n$EndMeshFormat\n{NAMES}$Entities\n{entities}$EndEntities\n"
        f"$Nodes\n1 5\n1 2 0 5\n{points}$EndNodes\n"
        "$Elements\n3 5\n1 1 1 1\n1 4 1\n1 2 2 3\n2 1 2 5\n4 3 4 5\n5 4 1 5\n2 2 2 1\n3 2 3 5\n$EndElements\n"
    )


def version_41(partitioned=False):
    """Return a file with parameters of points, with an entity in no group and, if asked, with partitions."""
    head = "0 1 2 0\n1 0 0 0 0 1 0 1 7 0\n1 0 0 0 1 1 0 1 1 0\n2 0 0 0 1 1 0 {} 0\n"
    cut = "1\n0\n0 0 1 0\n12 2 2 1 1 0 0 0 1 1 0 1 2 0\n"
    flag = 12 if partitioned else 2
    entities = f"$Entities\n{head.format('0' if partitioned else '1 2')}$EndEntities\n"
    if partitioned:
        entities += f"$PartitionedEntities\n{cut}$EndPartitionedEntities\n"
    points = "\n".join(f"{x} 0.5 0.5" for x in POINTS)
    return (
        f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{NAMES}{entities}"
        f"$Nodes\n1 5 1 5\n2 2 1 5\n1\n2\n3\n4\n5\n{points}\n$EndNodes\n"
        f"$Elements\n3 5 1 5\n1 1 1 1\n1 4 1\n2 1 2 3\n2 1 2 5\n4 3 4 5\n5 4 1 5\n2 {flag} 2 1\n3 2 3 5\n$EndElements\n"
    )


def version_41_binary(order="<"):
    def ints(*numbers):
        return np.array(numbers, dtype=f"{order}i4").tobytes()

    def sizes(*numbers):
        return np.array(numbers, dtype=f"{order}u8").tobytes()

    entity = [
        ints(n) + np.zeros(6).tobytes() + sizes(1) + ints(group) + sizes(0) for n, group in ((1, 7), (1, 1), (2, 2))
    ]
    nodes = sizes(1, 5, 1, 5) + ints(2, 1, 0) + sizes(5, 1, 2, 3, 4, 5)
    nodes += np.array([x.split() for x in POINTS], dtype=f"{order}f8").tobytes()
    cells = sizes(3, 5, 1, 5) + ints(1, 1, 1) + sizes(1, 1, 4, 1) + ints(2, 1, 2) + sizes(3)
    cells += b"".join(sizes(n, *CELLS[n - 2]) for n in (2, 4, 5)) + ints(2, 2, 2) + sizes(1, 3, *CELLS[1])
    return (
        b"$MeshFormat\n4.1 1 8\n" + ints(1) + b"\n$EndMeshFormat\n" + NAMES.encode() + b"$Entities\n"
        + sizes(0, 1, 2, 0) + b"".join(entity) + b"\n$EndEntities\n$Nodes\n" + nodes + b"\n$EndNodes\n$Elements\n"
        + cells + b"\n$EndElements\n"
    )  # fmt: skip


GMSH = {
    "1": (version_1(), ("7", "1", "2")), "1, of Windows": (version_1().replace("\n", "\r\n"), ("7", "1", "2")),
    "2.2": (version_2(), None), "2.2, one tag": (version_2("1 {0}"), None), "2.2 binary": (version_2_binary(), None),
    "4.0": (version_40(), None), "4.1": (version_41(), None), "4.1 in parts": (version_41(True), None),
    "4.1 binary": (version_41_binary(), None), "4.1 big-endian": (version_41_binary(">"), None),
}  # fmt: skip


def solid(path, tag=None, **shape):
    supports = [{"where": {"tag": tag}, "fix": ["x"]}] if tag is not None else []
    return Solid.model_validate(
        {"shape": {"mesh": str(path), **shape}, "density": 1.0, "young": 1.0, "poisson": 0.3, "supports": supports}
    )


def size(path, dim, notes=None, **shape):
    points, cells = build_mesh(solid(path, **shape), dim, "solids.b", Path(), notes)
    return signed_volumes(points, cells).sum()


def written(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("version", GMSH)
def test_gmsh_of_all_versions(tmp_path, version):
    text, names = GMSH[version]
    foot, water, flag = names or ("foot", "water", "flag")
    path = written(tmp_path / "m.msh", text)
    notes = []
    assert (
        size(path, 2, notes) == pytest.approx(1.0)
        and f"one of the groups {', '.join(sorted([water, flag]))}" in notes[0]
    )
    assert size(path, 2, cells=water) == pytest.approx(0.75) and size(path, 2, cells=flag) == pytest.approx(0.25)
    tags = read_tags(solid(path, foot, cells=water), 2, "solids.b", Path())
    assert tags[foot].facets.shape == (1, 2)


@pytest.mark.parametrize("version", ["2.2", "4.1", "4.1 binary", "2.2 binary"])
def test_gmsh_cut_short_anywhere_is_refused_or_whole(tmp_path, version):
    """Every cut of a file is told; only what stands after the last element may be missing."""
    text = GMSH[version][0]
    text = text if isinstance(text, bytes) else text.encode()
    end = text.index(b"$EndElements")
    for cut in range(1, end, 7):
        with pytest.raises(InputError, match="cannot be read as a mesh"):
            size(written(tmp_path / "m.msh", text[:cut]), 2)


ABAQUS = """** a comment
*Heading
 something
*Part, name=one
*Node, nset=all
1,, 0.
2, 1.0D0, 0.
3, 1., 1., 0.
4, 0., 1.,
*INCLUDE, INPUT=./cells.txt
*Element, type=SPRINGA
9, 1, 2
*NSET, NSET="left side", GENERATE
1, 4, 3
*nset, nset=Foot
LEFT SIDE
*Elset, elset=Upper
8,
*End Part
*Instance, name=one-1, part=one
*End Instance
*Step
*Node print
U
"""


def test_abaqus_with_all_that_it_allows(tmp_path):
    path = written(tmp_path / "m.inp", ABAQUS)
    written(tmp_path / "cells.txt", "*ELEMENT, TYPE=cps3t,\nELSET=body\n7, 1,\n2, 3\n8, 1, 3, 4\n")
    notes = []
    assert size(path, 2, notes) == pytest.approx(1.0) and size(path, 2, cells="Upper") == pytest.approx(0.5)
    assert "1 lines of elements of type SPRINGA are not read" in notes[0]
    tags = read_tags(solid(path, "Foot"), 2, "solids.b", Path())
    assert tags["Foot"].nodes.tolist() == tags["left side"].nodes.tolist() == [0, 3]
    assert [file.name for file in run_files._with_companions(path)] == ["m.inp", "cells.txt"]


@pytest.mark.parametrize(
    "card, why",
    [
        ("*NGEN\n1, 4", r"\*NGEN: nodes and elements must be written out"),
        ("*INSTANCE, NAME=a\n1., 0., 0.", "moved or there more than once"),
        ("*INSTANCE, NAME=a\n*END INSTANCE\n*INSTANCE, NAME=b", "moved or there more than once"),
        ("*NODE, SYSTEM=C\n9, 1., 90.", "not rectangular"),
        ("*ELEMENT, TYPE=CPS3\n1, 2, 3", "CPS3 do not have 3 nodes each"),
        ("*ELEMENT, TYPE=CPS3\n1, 2, 3, 99", "nodes that the file does not hold"),
        ("*INCLUDE, INPUT=none.txt", "it needs none.txt, which is not beside it"),
        ("*INCLUDE, INPUT=m.inp", "it includes itself"),
        ("*INCLUDE, INPUT=.", "beside the file"),
        ("*INCLUDE, INPUT=..", r"\*INCLUDE of \.\.: it must be a file, beside the file"),
        ("*NODE, INPUT=n.txt", r"put \*INCLUDE, INPUT=n.txt in the line after it"),
        ("*INCLUDE, INPUT=../m.inp", "beside the file"),
    ],
)
def test_abaqus_that_would_be_misread_is_refused(tmp_path, card, why):
    path = written(tmp_path / "m.inp", f"*NODE\n1, 0., 0.\n2, 1., 0.\n3, 1., 1.\n{card}\n")
    with pytest.raises(InputError, match=rf"cannot be read as a mesh \(abaqus: .*{why}"):
        size(path, 2)


@pytest.mark.parametrize("kind", ["old", "new"])
def test_exodus_without_its_library(tmp_path, kind):
    """A cube of a hexahedron, in a block with a name, with a side set and a node set."""
    x = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=float)
    name = np.array([list("flag".ljust(8, "\0"))], dtype="S1")
    arrays = {"coordx": x[:, 0], "coordy": x[:, 1], "coordz": x[:, 2], "eb_names": name, "eb_prop1": np.array([4]),
              "connect1": np.arange(1, 9)[None], "ss_prop1": np.array([30]), "elem_ss1": np.array([1]),
              "side_ss1": np.array([5]), "ns_prop1": np.array([20]), "node_ns1": np.array([1, 5])}  # fmt: skip
    path = tmp_path / "m.e"
    if kind == "new":
        with h5py.File(path, "w") as file:
            for key, values in arrays.items():
                file[key] = values
            with warnings.catch_warnings():  # of h5py's own use of numpy
                warnings.simplefilter("ignore")
                file["connect1"].attrs["elem_type"] = "HEX8"
    else:
        with netcdf_file(path, "w") as file:
            for key, values in arrays.items():
                dims = [f"{key}_{n}" for n in range(values.ndim)]
                for dim, length in zip(dims, values.shape, strict=True):
                    file.createDimension(dim, length)
                values = values.astype("i4") if values.dtype.kind == "i" else values
                file.createVariable(key, values.dtype, dims)[:] = values
            file.variables["connect1"].elem_type = b"HEX8"
    assert size(path, 3, cells="flag") == pytest.approx(1.0)
    tags = read_tags(solid(path, "30"), 3, "solids.b", Path())
    assert tags["30"].nodes.tolist() == [0, 1, 2, 3] and tags["30"].facets.shape == (2, 3)
    assert tags["20"].nodes.tolist() == [0, 4]


FREEFEM = "4 2 1\n0 0 1\n1 0 1\n1 1 1\n0 1 1\n1 2 3 5\n1 3 4 6\n4 1 8\n"
UCD = "# of AVS\n4 2 0 0 0\n1 0 0 0\n2 1 0 0\n3 1 1 0\n4 0 1 0\n1 1 tri 1 2 3\n2 1 tri 1 3 4\n"
SU2 = (
    "NDIME= 2\r\nNELEM= 2\r\n5 0 1 2 0\r\n5 0 2 3 1\r\nNPOIN= 4\r\n0 0 0\r\n1 0 1\r\n1 1 2\r\n0 1 3\r\n"
    "NMARK= 2\r\nMARKER_TAG= inlet\r\nMARKER_ELEMS= 1\r\n3 3 0\r\nMARKER_TAG= wall\r\nMARKER_ELEMS= 1\r\n3 0 1\r\n"
)
NASTRAN = "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,1.,1.,0.\nGRID,4,,0.,1.,0.\nCTRIA3,1,1,1,2,3\nCTRIA3,2,1,1,3,4\n"
VTK = """# vtk DataFile Version 2.0
by FreeFem
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 4 float
0 0 0 1 0 0 1 1 0 0 1 0
CELLS 2 8
3 0 1 2
3 0 2 3
CELL_TYPES 2
5 5
CELL_DATA 2
SCALARS Label int1
LOOKUP_TABLE default
1 1
"""
FLAT = {
    "m.msh": FREEFEM, "m.ucd": UCD, "m.inp": UCD, "m.su2": SU2, "m.bdf": NASTRAN,
    "m.nas": f"SOL 101\nBEGIN BULK\n{NASTRAN}",
    "m.vtk": VTK, "abaqus.msh": "*NODE\n1,0,0\n2,1,0\n3,1,1\n4,0,1\n*ELEMENT,TYPE=S4R\n1,1,2,3,4\n",
}  # fmt: skip


@pytest.mark.parametrize("name", FLAT)
def test_a_unit_square_of_many_programs(tmp_path, name):
    assert size(written(tmp_path / name, FLAT[name]), 2) == pytest.approx(1.0)


def test_groups_of_freefem_and_names_of_su2(tmp_path):
    path = written(tmp_path / "m.msh", FREEFEM)
    assert size(path, 2, cells=5) == pytest.approx(0.5)
    assert read_tags(solid(path, 8), 2, "solids.b", Path())["8"].nodes.tolist() == [0, 3]
    path = written(tmp_path / "m.su2", SU2)
    tags = read_tags(solid(path, "wall"), 2, "solids.b", Path())
    assert tags["inlet"].nodes.tolist() == [0, 3] and tags["wall"].nodes.tolist() == [0, 1]


def test_markers_of_su2_have_their_names_whatever_these_are(tmp_path):
    """Nothing is said of names, which serve; a marker that is called 1 is not the first; what else is wrong is told."""
    path, notes = written(tmp_path / "m.su2", SU2.replace("= wall", "= 1")), []
    assert size(path, 2, notes) == pytest.approx(1.0) and notes == []
    tags = read_tags(solid(path, "1"), 2, "solids.b", Path())
    assert tags["inlet"].nodes.tolist() == [0, 3] and tags["1"].nodes.tolist() == [0, 1]
    size(written(path, SU2.replace("NMARK= 2", "NMARK= 3")), 2, notes)
    assert len(notes) == 1 and "expected 3 markers" in notes[0] and "string type" not in notes[0]


@pytest.mark.parametrize(
    "name, text, why",
    [
        ("m.su2", SU2 + SU2, "more than one zone"),
        ("m.bdf", NASTRAN.replace("GRID,4,,", "GRID,4,2,"), "coordinates of their own"),
        ("m.msh", FREEFEM.replace("4 2 1", "4 2 2"), "another number of points, triangles or edges"),
        ("m.mesh", "MFEM mesh v1.0\n", "MFEM"),
        ("m.mdpa", "Begin Nodes\nEnd Nodes\n", "Kratos"),
        ("m.msh", "mesh of mine\n", "of neither Gmsh"),
        ("m.step", "ISO-10303-21;\n", r"such files end in .*\.vtu"),
        ("m.vtu", "", "it is empty"),
        ("m.vtk", VTK.replace("UNSTRUCTURED_GRID", "POLYDATA"), "POLYDATA"),
        ("m.node", "1 3 0 0\n1 0 0 0\n", "it needs m.ele, which is not beside it"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_told_with_a_way_out(tmp_path, capfd, name, text, why):
    with pytest.raises(InputError, match=f"cannot be read as a mesh.*{why}") as error:
        size(written(tmp_path / name, text), 2)
    assert text == "" or "save it as Gmsh 4.1" in str(error.value)
    assert len(str(error.value)) < 1500 and capfd.readouterr() == ("", "")


def test_a_surface_is_read_however_its_solids_end(tmp_path):
    x = np.array([[0.3, 0.3, 0.3], [0.7, 0.3, 0.3], [0.3, 0.7, 0.3], [0.3, 0.3, 0.7]])
    facets = x[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    vertices = [["  vertex {} {} {}".format(*x) for x in facet] for facet in facets]
    parts = ["facet normal 0 0 0\nouter loop\n" + "\n".join(facet) + "\nendloop\nendfacet\n" for facet in vertices]
    text = f"solid a\n{parts[0]}{parts[1]}end solid\nsolid b\n{parts[2]}{parts[3]}endsolid b\n"
    points, found = read_surface(Shape(mesh=str(written(tmp_path / "s.stl", text))), 3, "obstacles.o.shape", Path())
    assert np.linalg.det(points[found]).sum() / 6 == pytest.approx(0.4**3 / 6, rel=1e-6)


@pytest.mark.parametrize("kind, count", [("triangle10", 10), ("quad16", 16)])
def test_cells_of_third_order_are_read_by_their_corners(tmp_path, kind, count):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)[: 4 if kind == "quad16" else 3]
    points = np.concatenate((corners, np.random.default_rng(0).uniform(0, 1, (count - len(corners), 3)) * [1, 1, 0]))
    meshio.Mesh(points, [(kind, np.arange(count)[None])]).write(tmp_path / "m.msh", file_format="gmsh")
    notes = []
    assert size(tmp_path / "m.msh", 2, notes) == pytest.approx(0.5 * (len(corners) - 2))
    assert any("by their corners" in note for note in notes)


# ---- bounds -------------------------------------------------------------------------------------------------

N = 10**12
ABSURD = {
    "m.msh": GMSH["4.1"][0].replace("1 5 1 5", f"1 {N} 1 {N}").replace("2 2 1 5", f"2 2 1 {N}"),
    "b.msh": GMSH["2.2"][0].replace("\n5\n", f"\n{N}\n"),
    "m.vtk": VTK.replace("POINTS 4", f"POINTS {N}"), "c.vtk": VTK.replace("CELLS 2 8", f"CELLS {N} {4 * N}"),
    "m.off": f"OFF\n{N} {N} 0\n0 0 0\n", "m.mesh": f"MeshVersionFormatted 2\nDimension 3\nVertices\n{N}\n0 0 0 0\n",
    "m.su2": SU2.replace("NPOIN= 4", f"NPOIN= {N}"), "n.su2": SU2.replace("NELEM= 2", f"NELEM= {N}"),
    "m.inp": f"*NODE\n1,0,0\n*NSET,NSET=a,GENERATE\n1,{N}\n", "m.ucd": UCD.replace("4 2 0", f"{N} {N} 0"),
    "m.ply": f"ply\nformat binary_little_endian 1.0\nelement vertex {N}\nproperty double x\nend_header\n",
    "m.xml": f'<dolfin><mesh celltype="triangle" dim="2"><vertices size="{N}"></vertices></mesh></dolfin>',
    "m.ele": f"{N} 4 0\n1 1 2 3 4\n",
}  # fmt: skip


@pytest.mark.parametrize("name", ABSURD)
def test_a_file_that_announces_too_much_is_soon_refused(tmp_path, name):
    written(tmp_path / "m.node", f"{N} 3 0 0\n1 0 0 0\n")
    path = written(tmp_path / name, ABSURD[name])
    before, limit = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, resource.getrlimit(resource.RLIMIT_AS)
    begin = time.monotonic()
    with pytest.raises(InputError, match=r"cannot be read as a mesh|holds no triangle"):
        size(path, 2)
    assert time.monotonic() - begin < 10.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1.3e6  # kB
    assert resource.getrlimit(resource.RLIMIT_AS) == limit


def test_a_reader_that_hangs_is_ended_and_its_file_asked_once(tmp_path, monkeypatch):
    asked = []

    def hang(path, notes):
        asked.append(path)
        while True:
            try:
                time.sleep(0.01)
            except Exception:
                continue

    monkeypatch.setattr("petfsi.geometry.readers.formats.find_readers", lambda path: [("gmsh", hang)])
    monkeypatch.setattr(mesh_files, "SECONDS", 0.2)
    path, handler = written(tmp_path / "m.msh", "x"), signal.getsignal(signal.SIGALRM)
    with mesh_files.read_once():
        for _ in range(3):
            with pytest.raises(InputError, match="gmsh: takes longer than 0 s"):
                size(path, 2)
    assert len(asked) == 1 and signal.getsignal(signal.SIGALRM) is handler


def test_bounds_hold_and_are_taken_back():
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(MemoryError), bounded(10.0, 3e8):
        np.ones(10**8)
    with pytest.raises(TooLongError), bounded(0.05, 1e9):
        while True:
            pass
    assert resource.getrlimit(resource.RLIMIT_AS) == before and signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    np.ones(10**7)


def test_what_a_reader_prints_is_told_and_not_printed(tmp_path, monkeypatch, capfd):
    mesh = meshio.Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), [("triangle", [[0, 1, 2]])])

    def speak(path, notes):
        print("of 7 things\none was odd")
        return mesh

    monkeypatch.setattr("petfsi.geometry.readers.formats.find_readers", lambda path: [("gmsh", speak)])
    notes = []
    size(written(tmp_path / "m.msh", "x"), 2, notes)
    assert notes == ["solids.b.shape.mesh: of 7 things one was odd"] and capfd.readouterr() == ("", "")


HEAD = "ply\nformat ascii 1.0\ncomment TextureFile gone.jpg\nelement vertex {} \n" + "".join(
    f"property float {x}\n" for x in "xyz"
)
CORNERS = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
SIDES = "3 0 2 1 6 0 0 0 1 1 0\n3 0 1 3 6 0 0 0 1 1 0\n3 0 3 2 6 0 0 0 1 1 0\n3 1 2 3 6 0 0 0 1 1 0\n"
LISTS = "property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"


def test_a_surface_whose_picture_is_not_there_is_read_without_a_word(tmp_path):
    text = HEAD.format(4) + "element face 4\n" + LISTS + CORNERS + SIDES
    read = mesh_files.open_mesh(Shape(mesh="s.ply"), "key", written(tmp_path / "s.ply", text).parent)
    assert len(read.mesh.points) == 4 and read.notes == ()


@pytest.mark.parametrize(
    "text", [HEAD.format(0) + "element face 0\n" + LISTS, HEAD.format(1) + "element face 1\n" + LISTS + "0 0 0\n"]
)
def test_words_of_python_are_told_as_what_the_file_is_not(tmp_path, text):
    with pytest.raises(InputError, match=r"\(ply: it is not as this format should be"):
        mesh_files.open_mesh(Shape(mesh="s.ply"), "key", written(tmp_path / "s.ply", text).parent)


# ---- a channel with a flag ----------------------------------------------------------------------------------

CHANNEL = """
dim = 2
[time]
end = 0.02
dt = 0.01
[fluid]
origin = [0.0, 0.0]
size = [2.0, 1.0]
cells = [16, 8]
density = 1.0
sides = { left = { inflow = { speed = 1.0 } }, right = "open" }
[solids.flag]
shape = SHAPE
density = 10.0
young = 1e4
poisson = 0.3
supports = [{ where = WHERE, fix = ["x", "y"] }]
[probes.tip]
of = "flag"
at = [1.25, 0.5]
quantity = "displacement"
"""


def test_a_flag_in_a_channel_of_one_file_is_that_of_a_box(tmp_path, here, monkeypatch):
    """Its cells are taken by their group, its clamped edge by its tag; a box is the other road to one history."""
    monkeypatch.chdir(tmp_path)
    box = Box(origin=[0.5, 0.375], size=[0.75, 0.25], cells=[6, 2])
    points, cells = box_mesh(box)
    around, others = box_mesh(Box(origin=[0, 0], size=[2.0, 0.375], cells=[16, 3]))
    foot = np.array([[0, 1], [1, 2]])
    at = np.concatenate((around, points))
    groups = [np.repeat([1, 2], [len(others), len(cells)]), np.full(len(foot), 5)]
    meshio.Mesh(
        np.column_stack((at, np.zeros(len(at)))),
        [("triangle", np.concatenate((others, cells + len(around)))), ("line", foot + len(around))],
        cell_data={"gmsh:physical": groups, "gmsh:geometrical": groups},
        field_data={"water": np.array([1, 2]), "solid": np.array([2, 2]), "clamped": np.array([5, 1])},
    ).write("channel.msh", file_format="gmsh22", binary=False)
    plain = "{ box = { origin = [0.5, 0.375], size = [0.75, 0.25], cells = [6, 2] } }"
    roads = {"box": (plain, '"left"'), "file": ('{ mesh = "channel.msh", cells = "solid" }', '{ tag = "clamped" }')}
    for name, (shape, where) in roads.items():
        Path(f"{name}.toml").write_text(CHANNEL.replace("SHAPE", shape).replace("WHERE", where))
        assert here("run", f"{name}.toml", "--out", name).returncode == 0
    one, other = (np.genfromtxt(Path(name, "history.csv"), delimiter=",", names=True) for name in roads)
    assert abs(one["tipx"][-1]) > 0 and one["tipx"] == pytest.approx(other["tipx"], rel=1e-9)


def test_a_surface_with_a_point_far_away_is_refused_soon(tmp_path):
    """Beside its extent all others are in one place: their pairs would not fit into memory."""
    points, cells = box_mesh(Box(origin=[0, 0, 0], size=[1, 1, 1], cells=[20, 20, 20]))
    facets = boundary_facets(points, cells)
    points[0] = [1e12, 0, 0]
    meshio.Mesh(points, [("triangle", facets)]).write(tmp_path / "s.vtu")
    with pytest.raises(InputError, match="points lie within 100000 of others: one may be far away"):
        read_surface(Shape(mesh=str(tmp_path / "s.vtu")), 3, "obstacles.o.shape", Path())
