"""Shapes, meshes, their boundaries, and every way a mesh file can be unfit."""

import meshio
import numpy as np
import pytest

from petfsi.errors import InputError
from petfsi.geometry.meshes import SimplexMesh, box_mesh, build_mesh, read_surface
from petfsi.geometry.shapes import inside
from petfsi.geometry.surfaces import boundary_facets, shells, signed_volumes
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Box, Shape

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def solid(**shape) -> Solid:
    return Solid.model_validate({"shape": shape, "density": 1.0, "young": 1.0, "poisson": 0.3})


def box(dim: int, n: int = 4, **more) -> Solid:
    return solid(box={"origin": [0.5] * dim, "size": [2.0, 1.0, 3.0][:dim], "cells": [n, n + 1, n + 2][:dim]}, **more)


def write(path, points, cells, kind="triangle"):
    points = np.asarray(points, dtype=float)
    if points.shape[1] == 2:
        points = np.column_stack((points, np.zeros(len(points))))
    meshio.Mesh(points, [(kind, np.asarray(cells))]).write(path)
    return path


def from_file(path, dim=2, **more):
    return build_mesh(solid(mesh=path.name, **more), dim, "solids.body", path.parent)


def total_normal(points, facets):
    corner = points[facets]
    if points.shape[1] == 2:
        tangent = corner[:, 1] - corner[:, 0]
        return np.column_stack((tangent[:, 1], -tangent[:, 0]))
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


# ---- shapes -------------------------------------------------------------------------------------------------


def test_shapes_take_their_boundary_and_nothing_beyond():
    cases = [
        (Shape(box={"origin": [0, 0], "size": [1, 2]}), [[1, 2], [0, 0]], [[1.01, 1], [0.5, -0.01]]),
        (Shape(ball={"centre": [1, 1], "radius": 0.5}), [[1.5, 1], [1.3, 1.4]], [[1.51, 1], [1.4, 1.4]]),
        (
            Shape(cylinder={"start": [0, 0, 0], "end": [0, 0, 2], "radius": 1}),
            [[1, 0, 0], [0.6, 0.8, 2]],
            [[1.01, 0, 1], [0, 0, 2.01], [0, 0, -0.01]],
        ),
        (Shape(halfspace={"point": [0, 1], "normal": [0, 3]}), [[9, 1], [-5, 0]], [[0, 1.01]]),
    ]
    for shape, within, beyond in cases:
        assert inside(shape, np.array(within, dtype=float)).all(), shape
        assert not inside(shape, np.array(beyond, dtype=float)).any(), shape


def test_a_turned_cylinder_holds_its_share_of_points():
    """Counts points in a ball around a cylinder: the volume is pi r^2 l to the sampling error."""
    points = np.random.default_rng(0).uniform(-1, 1, (400_000, 3))
    end = np.array([0.4, 0.4, 0.2])
    shape = Shape(cylinder={"start": (-end).tolist(), "end": end.tolist(), "radius": 0.3})
    assert 8 * inside(shape, points).mean() == pytest.approx(np.pi * 0.09 * 1.2, rel=0.02)


# ---- boxes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_is_filled_exactly_by_positive_cells(dim):
    points, cells = build_mesh(box(dim), dim, "solids.b", ".")
    volumes = signed_volumes(points, cells)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx([2.0, 6.0][dim - 2], rel=1e-14)
    assert len(points) == np.prod([5, 6, 7][:dim])
    assert len(cells) == {2: 2, 3: 6}[dim] * np.prod([4, 5, 6][:dim])


@pytest.mark.parametrize("dim", [2, 3])
def test_the_boundary_of_a_box_is_closed_and_points_outward(dim):
    points, cells = build_mesh(box(dim), dim, "solids.b", ".")
    facets = boundary_facets(points, cells)
    normals = total_normal(points, facets)
    assert np.abs(normals.sum(axis=0)).max() < 1e-14
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx([6.0, 22.0][dim - 2], rel=1e-14)
    centre = points.mean(axis=0)
    assert np.all(np.einsum("fi,fi->f", normals, points[facets].mean(axis=1) - centre) > 0)
    flipped = boundary_facets(points, cells[:, [1, 0, *range(2, dim + 1)]])
    assert {tuple(sorted(f)) for f in flipped.tolist()} == {tuple(sorted(f)) for f in facets.tolist()}
    np.testing.assert_allclose(total_normal(points, flipped).sum(axis=0), 0, atol=1e-14)
    assert shells(points, flipped)[1][0] > 0


def test_diagonals_of_a_flat_box_alternate():
    points, cells = box_mesh(Box(origin=[0, 0], size=[1, 1], cells=[2, 2]))
    degree = np.bincount(cells.ravel(), minlength=9)
    assert degree[4] == 8  # all four diagonals meet in the middle
    assert sorted(degree.tolist()) == [2, 2, 2, 2, 2, 2, 2, 2, 8]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_cavity_is_an_inner_shell_of_negative_volume(dim):
    hole = {"origin": [1.0, 0.7, 1.4][:dim], "size": [1.0, 0.6, 1.2][:dim]}
    points, cells = build_mesh(box(dim, cavity=hole), dim, "solids.b", ".")
    label, volume = shells(points, boundary_facets(points, cells))
    # whole grid cells are left out: those whose centre lies in the hole
    empty = [1.0 * 0.6, 1.0 * 0.6 * 1.0][dim - 2]
    whole = [2.0, 6.0][dim - 2]
    assert len(volume) == 2
    assert sorted(volume) == pytest.approx([-empty, whole], rel=1e-12)
    assert signed_volumes(points, cells).sum() == pytest.approx(whole - empty, rel=1e-12)
    assert len(np.unique(cells)) == len(points)
    assert set(label.tolist()) == {0, 1}


def test_a_cavity_that_takes_everything_is_refused():
    with pytest.raises(InputError, match=r"solids\.b\.shape\.cavity.*nothing"):
        build_mesh(box(2, cavity={"origin": [0, 0], "size": [9, 9]}), 2, "solids.b", ".")


def test_a_union_keeps_bodies_apart():
    mesh = SimplexMesh.union([(SQUARE, TWO_TRIANGLES), (SQUARE, TWO_TRIANGLES[:1])])
    assert mesh.body.tolist() == [0, 0, 1]
    assert mesh.cells.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]
    assert len(shells(mesh.points, boundary_facets(mesh.points, mesh.cells))[1]) == 2


def test_shells_that_share_one_vertex_are_two():
    a = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    cells = np.array([[0, 1, 2, 3], [0, 4, 5, 6]])
    _, volume = shells(a, boundary_facets(a, cells))
    assert volume == pytest.approx([1 / 6, 1 / 6])


def test_no_facets_have_no_shells():
    label, volume = shells(SQUARE, np.zeros((0, 2), dtype=int))
    assert len(label) == len(volume) == 0


# ---- files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["vtk", "msh", "vtu"])
def test_a_file_gives_the_mesh_it_holds(tmp_path, suffix):
    points, cells = build_mesh(box(3), 3, "b", ".")
    path = write(tmp_path / f"mesh.{suffix}", points, cells, "tetra")
    got_points, got_cells = from_file(path, 3, scale=2.0, translate=[1.0, 0.0, -1.0])
    np.testing.assert_allclose(got_points, 2 * points + [1, 0, -1], atol=1e-14)
    np.testing.assert_array_equal(got_cells, cells)


def test_a_flat_file_keeps_triangles_and_drops_points_without_a_cell(tmp_path):
    stray = np.vstack((SQUARE[:1] - 3, SQUARE))
    path = tmp_path / "mesh.vtk"
    points = np.column_stack((stray, np.full(5, 0.25)))
    meshio.Mesh(points, [("line", [[1, 2]]), ("triangle", TWO_TRIANGLES + 1)]).write(path)
    got_points, got_cells = from_file(path)
    np.testing.assert_array_equal(got_points, SQUARE)
    np.testing.assert_array_equal(got_cells, TWO_TRIANGLES)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_file_that_is_left_handed_throughout_is_turned(tmp_path, dim):
    points, cells = build_mesh(box(dim), dim, "b", ".")
    kind = {2: "triangle", 3: "tetra"}[dim]
    path = write(tmp_path / "mesh.vtk", points, cells[:, [1, 0, *range(2, dim + 1)]], kind)
    got_points, got_cells = from_file(path, dim)
    assert signed_volumes(got_points, got_cells).min() > 0


BAD = {
    "folded": (SQUARE, [[0, 1, 2], [0, 1, 3]], "1 facets whose two cells lie on the same side"),
    "zero": (np.vstack((SQUARE, [[0.5, 0.0]])), [*TWO_TRIANGLES, [0, 4, 1]], "1 cells with zero volume"),
    "duplicate cell": (SQUARE, [*TWO_TRIANGLES, [1, 2, 0]], "2 duplicate cells"),
    "duplicate point": (
        np.vstack((SQUARE, SQUARE[[0, 2]])),
        [[0, 1, 2], [4, 5, 3]],
        "4 duplicate points",
    ),
    "not a number": (SQUARE * [[1, 1], [1, np.nan], [1, 1], [1, 1]], TWO_TRIANGLES, "1 points with a coordinate"),
    "three at an edge": (
        np.vstack((SQUARE, [[0.9, 0.1]])),
        [*TWO_TRIANGLES, [0, 4, 2]],
        "1 facets that belong to more than two cells",
    ),
    "pinched": (np.vstack((SQUARE, SQUARE[1:] + [0, 2], [[2, 2], [2, 3]]))[[0, 1, 2, 7, 8]], [[0, 1, 2], [2, 3, 4]],
                "1 boundary points at which the surface meets itself"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_an_unfit_file_is_refused_with_key_file_and_count(tmp_path, name):
    points, cells, message = BAD[name]
    path = write(tmp_path / "bad.vtu", points, cells)
    with pytest.raises(InputError) as error:
        from_file(path)
    assert message in str(error.value)
    assert str(error.value).startswith("solids.body.shape.mesh = 'bad.vtu': ")
    assert error.value.exit_code == 2


def test_tetrahedra_that_share_an_edge_alone_are_refused(tmp_path):
    points = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    path = write(tmp_path / "bad.vtk", points, [[0, 2, 3, 1], [0, 4, 5, 1]], "tetra")
    with pytest.raises(InputError, match="1 boundary edges at which"):
        from_file(path, 3)


def test_files_that_are_no_mesh_are_refused(tmp_path, capfd):
    (tmp_path / "broken.vtk").write_text("this is no mesh\n")
    (tmp_path / "broken.msh").write_bytes(b"$MeshFormat\n4.1 0 8\n")
    (tmp_path / "mesh.unknown").write_text("")
    for name in ("broken.vtk", "broken.msh", "mesh.unknown"):
        with pytest.raises(InputError, match=f"shape.mesh = '{name}': cannot be read as a mesh"):
            from_file(tmp_path / name)
    with pytest.raises(InputError, match="no file .*absent.vtk"):
        from_file(tmp_path / "absent.vtk")
    assert capfd.readouterr() == ("", "")


def test_a_file_of_the_wrong_dimension_says_what_it_holds(tmp_path):
    path = write(tmp_path / "flat.vtk", SQUARE, TWO_TRIANGLES)
    with pytest.raises(InputError, match="no tetra cells, which dim = 3 wants; found triangle"):
        from_file(path, 3)
    bent = np.column_stack((SQUARE, [0.0, 0.0, 0.3, 0.0]))
    path = write(tmp_path / "bent.vtk", bent, TWO_TRIANGLES)
    with pytest.raises(InputError, match="do not lie in one plane"):
        from_file(path, 2)


def test_cells_that_name_missing_points_are_refused(tmp_path):
    path = write(tmp_path / "bad.vtu", SQUARE, [[0, 1, 2], [0, 2, 9]])
    with pytest.raises(InputError, match="points that the file does not hold"):
        from_file(path)


# ---- cells of all kinds -------------------------------------------------------------------------------------


def grid_of(kind, n=3, seed=0):
    """Return points in a random order and cells of one kind that fill a cube of side n."""
    shape = (n + 1,) * 3
    place = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.random.default_rng(seed).permutation(len(place))
    points = np.zeros(place.shape)
    points[number] = place
    number = number.reshape(shape)
    corner = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    blocks = [number[tuple(slice(c, c + n) for c in at)].ravel() for at in corner]
    cells = np.stack(blocks, axis=1)
    if kind == "wedge":
        cells = cells[:, [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]].reshape(-1, 6)
    if kind == "pyramid":
        faces = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
        tip = len(points) + np.arange(len(cells))
        points = np.concatenate((points, points[cells].mean(axis=1)))
        cells = np.concatenate([np.column_stack((cells[:, face], tip)) for face in faces])
    return points, cells


@pytest.mark.parametrize("kind, each", [("hexahedron", 6), ("wedge", 3), ("pyramid", 2)])
@pytest.mark.parametrize("seed", range(3))
def test_other_cells_become_simplices_that_fit_together(tmp_path, kind, each, seed):
    points, cells = grid_of(kind, seed=seed)
    path, notes = write(tmp_path / "m.vtu", points, cells, kind), []
    got, tets = build_mesh(solid(mesh=path.name), 3, "solids.body", tmp_path, notes)
    volumes = signed_volumes(got, tets)
    assert len(tets) == each * len(cells) and volumes.min() > 0.01 and volumes.sum() == pytest.approx(27.0)
    facets = boundary_facets(got, tets)
    assert len(facets) == 2 * 9 * 6 and np.all(np.ptp(got[facets], axis=1).min(axis=1) == 0)
    # each cell's own, by their centroids
    owner = tets.reshape(-1, each, 4) if kind == "hexahedron" else None
    if owner is not None:
        assert np.ptp(np.floor(got[owner].mean(axis=2)), axis=1).max() == 0
    assert notes[0].startswith(f"solids.body.shape.mesh: {len(cells)} cells of type {kind} are cut into {len(tets)}")


def test_cells_of_several_kinds_meet(tmp_path):
    """A hexahedron, a wedge on one side of it and a pyramid on top share faces of four corners."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [2, 0, 0], [2, 0, 1],
         [0.5, 0.5, 2]], dtype=float
    )  # fmt: skip
    for seed in range(10):
        number = np.random.default_rng(seed).permutation(len(points))
        x = np.zeros(points.shape)
        x[number] = points
        blocks = [
            ("hexahedron", number[[[0, 1, 2, 3, 4, 5, 6, 7]]]),
            ("wedge", number[[[1, 8, 2, 5, 9, 6]]]),
            ("pyramid", number[[[4, 5, 6, 7, 10]]]),
        ]
        meshio.Mesh(x, blocks).write(tmp_path / "m.vtu")
        got, tets = from_file(tmp_path / "m.vtu", 3)
        assert signed_volumes(got, tets).sum() == pytest.approx(1 + 0.5 + 1 / 3) and len(tets) == 6 + 3 + 2


def test_quads_and_triangles_in_the_plane(tmp_path):
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]]
    meshio.Mesh(np.array(points, float), [("triangle", [[0, 1, 2], [0, 2, 3]]), ("quad", [[4, 5, 2, 1]])]).write(
        tmp_path / "m.vtk"
    )
    points, cells = from_file(tmp_path / "m.vtk")
    assert signed_volumes(points, cells).tolist() == pytest.approx([0.5] * 4)


def test_what_is_turned_bent_or_not_read_is_told(tmp_path):
    turned = write(tmp_path / "turned.vtu", SQUARE, [[0, 1, 2], [0, 3, 2]])
    notes = []
    points, cells = build_mesh(solid(mesh=turned.name), 2, "s", tmp_path, notes)
    assert signed_volumes(points, cells).tolist() == [0.5, 0.5]
    assert notes == ["s.shape.mesh: 1 of 2 cells had their corners in the other order"]
    six = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, -0.1, 0], [0.5, 0.5, 0], [0, 0.5, 0], [9, 9, 0]], float)
    meshio.Mesh(six, [("triangle6", [[0, 1, 2, 3, 4, 5]]), ("tetra", [[0, 1, 2, 6]])]).write(tmp_path / "six.vtu")
    notes = []
    points, cells = build_mesh(solid(mesh="six.vtu"), 2, "s", tmp_path, notes)
    assert points.tolist() == [[0, 0], [1, 0], [0, 1]] and cells.tolist() == [[0, 1, 2]]
    assert [note.removeprefix("s.shape.mesh: ") for note in notes] == [
        "1 cells of type triangle6 are read by their corners: sides are straight, up to 0.1 (in the file's unit) "
        "beside the middles of curved ones",
        "1 cells of type tetra are not read",
        "1 points that belong to no cell are left out",
    ]


# ---- surfaces in files --------------------------------------------------------------------------------------


def cube():
    points, cells = box_mesh(Box(origin=[0, 0, 0], size=[1, 2, 3], cells=[2, 2, 2]))
    return points, boundary_facets(points, cells)


def surface_of(path, dim=3, **more):
    return read_surface(Shape(mesh=path.name, **more), dim, "obstacles.o.shape", path.parent)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_surface_comes_back_closed_and_outward(tmp_path, suffix, turned):
    points, facets = cube()
    path = write(tmp_path / f"s.{suffix}", points, facets[:, ::-1] if turned else facets)
    got_points, got = surface_of(path, scale=2.0)
    label, volume = shells(got_points, got)
    assert volume == pytest.approx([6.0 * 8], rel=1e-6)
    assert len(got_points) == 26
    assert len(got) == len(facets)


def test_a_flat_outline_is_read_as_segments(tmp_path):
    path = write(tmp_path / "s.vtk", SQUARE, [[1, 0], [2, 1], [3, 2], [0, 3]], "line")
    points, facets = surface_of(path, 2)
    assert shells(points, facets)[1] == pytest.approx([1.0])


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda f: f[1:], "3 edges that do not lie between exactly two facets"),
        (lambda f: np.vstack((f[:1, ::-1], f[1:])), "3 edges at which the facets' orientations disagree"),
        (lambda f: np.vstack((f, f[:1])), "2 duplicate facets"),
        (lambda f: np.vstack((f, [[0, 0, 1]])), "1 facets without extent"),
    ],
)
def test_an_unfit_surface_is_refused(tmp_path, change, message):
    points, facets = cube()
    path = write(tmp_path / "s.vtu", points, change(facets))
    with pytest.raises(InputError) as error:
        surface_of(path)
    assert message in str(error.value)
    assert str(error.value).startswith("obstacles.o.shape.mesh = 's.vtu': ")
