"""Mesh files of other programs: groups of cells, facets and nodes, and surfaces that one reader alone takes."""

from pathlib import Path

import meshio
import numpy as np
import pytest

from petfsi.errors import InputError
from petfsi.geometry.meshes import build_mesh, read_surface
from petfsi.geometry.places import located, located_facets, read_tags, with_middles
from petfsi.geometry.quadratic import with_middles as quadratic
from petfsi.geometry.surfaces import boundary_facets, signed_volumes
from petfsi.output.history import read_history
from petfsi.scene.solids import Solid, Tagged
from petfsi.scene.tables import Shape

#: Two unit squares side by side, two triangles each: the right one is the solid; the left edge of that is between them.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]], dtype=float)
CELLS = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
EDGES = np.array([[1, 4], [2, 5], [0, 3]])
GMSH_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 1 "clamped"
2 3 "body"
$EndPhysicalNames
$Entities
0 2 1 0
1 0 0 0 0 1 0 1 1 0
2 1 0 0 1 1 0 0 0
1 0 0 0 1 1 0 1 3 0
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
3 4 1 4
1 1 1 1
1 1 4
1 2 1 1
2 2 3
2 1 2 2
3 1 2 3
4 1 3 4
$EndElements
"""
ABAQUS = """*NODE, NSET=ALLN
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
*ELEMENT, TYPE={}, ELSET=BODY
1, 1, 2, 3
2, 1, 3, 4
*NSET, NSET=FOOT
1, 4
"""
OBJ = """v 0.3 0.3 0.3
v 0.7 0.3 0.3
v 0.3 0.7 0.3
v 0.3 0.3 0.7
vt 0 0
vn 0 0 -1
vn 0 -1 0
vn -1 0 0
f 1/1/1 3/1/1 2/1/1
f 1//2 2//2 4//2
f 1//3 4//3 3//3
f 2//1 3//1 4//1
"""
OFF = """OFF
8 6 12
0 0 0
1 0 0
1 1 0
0 1 0
0 0 1
1 0 1
1 1 1
0 1 1
4 3 2 1 0
4 4 5 6 7
4 0 1 5 4
4 1 2 6 5
4 2 3 7 6
4 3 0 4 7
"""
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 4
property list uchar int vertex_indices
property list uchar float texcoord
end_header
0.3 0.3 0.3 9 9 9
0.7 0.3 0.3 9 9 9
0.3 0.7 0.3 9 9 9
0.3 0.3 0.7 9 9 9
3 0 2 1 6 0 0 1 0 0 1
3 0 1 3 6 0 0 1 0 0 1
3 0 3 2 6 0 0 1 0 0 1
3 1 2 3 6 0 0 1 0 0 1
"""


def solid(path, tag=None, **shape):
    supports = [{"where": {"tag": tag}, "fix": ["x"]}] if tag else []
    return Solid.model_validate(
        {"shape": {"mesh": str(path), **shape}, "density": 1.0, "young": 1.0, "poisson": 0.3, "supports": supports}
    )


def held(path, tag, dim=2, elements="linear", **shape):
    """Return where the nodes of a tag are, and those of its facets."""
    body = solid(path, tag, **shape)
    points, cells = build_mesh(body, dim, "solids.b", Path())
    tags, where = read_tags(body, dim, "solids.b", Path()), Tagged(tag=tag)
    facets = boundary_facets(points, cells)
    if elements == "quadratic":
        points, cells = quadratic(points, cells)
    tags = with_middles(tags, cells)
    chosen = facets[located_facets(where, points, facets, "solids.b.loads.0", tags)]
    return points[located(where, points, "solids.b.supports.0", tags)], points[chosen].mean(axis=1)


@pytest.mark.parametrize("kind", ["gmsh", "gmsh numbers", "medit", "xdmf", "vtk"])
def test_a_group_of_cells_is_a_body_and_one_of_facets_its_edge(tmp_path, kind):
    cells, facets = np.array([1, 1, 2, 2]), np.array([5, 6, 7])
    name, edge = "2", "5"
    if kind.startswith("gmsh"):
        names = (
            {} if "numbers" in kind else {"water": np.array([1, 2]), "flag": np.array([2, 2]), "at": np.array([5, 1])}
        )
        name, edge = ("2", "5") if "numbers" in kind else ("flag", "at")
        data = {"gmsh:physical": [cells, facets], "gmsh:geometrical": [cells, facets]}
        path = tmp_path / "m.msh"
        meshio.Mesh(POINTS, [("triangle", CELLS), ("line", EDGES)], cell_data=data, field_data=names).write(
            path, file_format="gmsh22", binary=False
        )
    elif kind == "medit":
        path, data = tmp_path / "m.mesh", {"medit:ref": [cells, facets]}
        meshio.Mesh(POINTS, [("triangle", CELLS), ("line", EDGES)], cell_data=data).write(path)
    else:
        path = tmp_path / f"m.{'xdmf' if kind == 'xdmf' else 'vtu'}"
        made = meshio.Mesh(POINTS, [("triangle", CELLS), ("line", EDGES)], cell_data={"marker": [cells, facets]})
        made.write(path, **({"data_format": "XML"} if kind == "xdmf" else {}))
    points, found = build_mesh(solid(path, cells=name), 2, "solids.b", Path())
    assert points[:, 0].min() == 1.0 and signed_volumes(points, found).sum() == pytest.approx(1.0)
    for elements, n in (("linear", 2), ("quadratic", 3)):
        nodes, middles = held(path, edge, elements=elements, cells=name)
        assert len(nodes) == n and np.all(nodes[:, 0] == 1.0) and middles.tolist() == [[1.0, 0.5]]
    with pytest.raises(
        InputError, match=r"solids.b.shape.cells = 'x': the mesh file has no such group of cells; it has"
    ):
        build_mesh(solid(path, cells="x"), 2, "solids.b", Path())


def test_groups_of_gmsh_where_some_are_in_none(tmp_path):
    path = tmp_path / "m.msh"
    path.write_text(GMSH_41)
    nodes, middles = held(path, "clamped")
    assert nodes.tolist() == [[0, 0], [0, 1]] and middles.tolist() == [[0, 0.5]]


@pytest.mark.parametrize("kind", ["CPS3", "CPE3", "CPE3H"])
def test_nodes_and_elements_of_abaqus(tmp_path, kind):
    path = tmp_path / "m.inp"
    path.write_text(ABAQUS.format(kind))
    for elements, n in (("linear", 2), ("quadratic", 3)):
        nodes, middles = held(path, "FOOT", elements=elements)
        assert len(nodes) == n and np.all(nodes[:, 0] == 0.0) and middles.tolist() == [[0, 0.5]]
    assert len(held(path, "BODY")[0]) == 4
    path.write_text(ABAQUS.format("XYZ3"))
    with pytest.raises(InputError, match="holds no triangle cells.*2 lines of elements of type XYZ3 are not read"):
        build_mesh(solid(path), 2, "solids.b", Path())


def test_facets_of_hexahedra_are_cut_as_the_cells_are(tmp_path):
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
    for seed in range(8):
        number = np.random.default_rng(seed).permutation(8)
        points = np.zeros((8, 3))
        points[number] = corner
        blocks = [("hexahedron", number[None]), ("quad", number[[[1, 2, 6, 5]]])]
        path = tmp_path / "m.vtu"
        meshio.Mesh(points, blocks, cell_data={"tag": [np.array([1]), np.array([3])]}).write(path)
        nodes, middles = held(path, "3", dim=3)
        assert len(nodes) == 4 and len(middles) == 2 and np.all(middles[:, 0] == 1.0)


@pytest.mark.parametrize(
    "suffix, text, volume", [("obj", OBJ, 0.4**3 / 6), ("off", OFF, 1.0), ("ply", PLY, 0.4**3 / 6)]
)
def test_surfaces_with_normals_colours_and_faces_of_four_corners(tmp_path, suffix, text, volume):
    path = tmp_path / f"s.{suffix}"
    path.write_text(text)
    points, facets = read_surface(Shape(mesh=str(path)), 3, "obstacles.o.shape", Path())
    assert np.linalg.det(points[facets]).sum() / 6 == pytest.approx(volume, rel=1e-6)


def test_points_of_a_surface_meet_within_round_off(tmp_path):
    """Every facet has points of its own, each off by a few units in the last place of single precision."""
    corner = np.array([[0.3, 0.3, 0.3], [0.7, 0.3, 0.3], [0.3, 0.7, 0.3], [0.3, 0.3, 0.7]])
    facets = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    points = corner[facets].reshape(-1, 3)
    points = points + 1e-8 * np.random.default_rng(0).uniform(-1, 1, points.shape)
    meshio.Mesh(points, [("triangle", np.arange(12).reshape(4, 3))]).write(tmp_path / "s.vtu")
    got, found = read_surface(Shape(mesh=str(tmp_path / "s.vtu")), 3, "obstacles.o.shape", Path())
    assert len(got) == 4 and np.linalg.det(got[found]).sum() / 6 == pytest.approx(0.4**3 / 6, rel=1e-6)


def test_run_and_check_say_how_a_file_was_read(tmp_path, here, monkeypatch):
    """A bar of two triangles and a square, pulled: sigma L/E at its end, sigma A u/2 of energy."""
    monkeypatch.chdir(tmp_path)
    blocks = [("triangle", CELLS[:2]), ("quad", np.array([[2, 5, 4, 1]]))]
    meshio.Mesh(POINTS, blocks).write("bar.vtk")
    Path("bar.toml").write_text("""
dim = 2
[time]
end = 1.0
dt = 1.0
integrator = "static"
[solids.bar]
shape = { mesh = "bar.vtk" }
density = 1.0
young = 1000.0
poisson = 0.0
material = "linear"
supports = [{ where = "left", fix = ["x", "y"] }]
loads = [{ where = "right", traction = [10.0, 0.0] }]
[probes.tip]
of = "bar"
at = [2.0, 0.5]
quantity = "displacement"
""")
    for words in (["check", "bar.toml"], ["run", "bar.toml", "--out", "run"]):
        done = here(*words)
        assert done.returncode == 0
        assert "solids.bar.shape.mesh: 1 cells of type quad are cut into 2 of type triangle" in done.stdout
    history = read_history(Path("run/history.csv"))
    assert history["tip.x"][-1] == pytest.approx(0.02) and history["elastic"][-1] == pytest.approx(0.1)
