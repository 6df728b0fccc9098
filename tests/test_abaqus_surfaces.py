"""Surfaces of Abaqus's files as places: on cells whose sides are known one by one."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from petfsi.errors import InputError
from petfsi.geometry.mesh_cells import read_cells
from petfsi.geometry.meshes import build_mesh, read_surface
from petfsi.geometry.places import located, located_facets, read_tags, with_middles
from petfsi.geometry.quadratic import with_middles as quadratic
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.solids import Solid, Tagged
from petfsi.scene.tables import Shape

CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
#: By a type: where its corners are, and the nodes of its sides S1, S2, ... as Abaqus's manual lists them.
SOLIDS = {
    "C3D4": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(1, 2, 3), (1, 4, 2), (2, 4, 3), (3, 4, 1)]),
    "C3D5": ([*CUBE[:4], (0.5, 0.5, 1)], [(1, 2, 3, 4), (1, 5, 2), (2, 5, 3), (3, 5, 4), (4, 5, 1)]),
    "C3D6": ([*CUBE[:3], *CUBE[4:7]], [(1, 2, 3), (4, 6, 5), (1, 4, 5, 2), (2, 5, 6, 3), (3, 6, 4, 1)]),
    "C3D8R": (CUBE, [(1, 2, 3, 4), (5, 8, 7, 6), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 8, 4), (4, 8, 5, 1)]),
    "CPS3": ([(0, 0), (1, 0), (0, 1)], [(1, 2), (2, 3), (3, 1)]),
    "CPE4": (CUBE[:4], [(1, 2), (2, 3), (3, 4), (4, 1)]),
}
#: The edges of those that have a type with nodes in their middles, in the order of these.
EDGES = {
    "C3D10": ("C3D4", [(1, 2), (2, 3), (3, 1), (1, 4), (2, 4), (3, 4)]),
    "CPS6": ("CPS3", [(1, 2), (2, 3), (3, 1)]),
    "CPE8R": ("CPE4", [(1, 2), (2, 3), (3, 4), (4, 1)]),
    "C3D20": ("C3D8R", [(1, 2), (2, 3), (3, 4), (4, 1), (5, 6), (6, 7), (7, 8), (8, 5),
                        (1, 5), (2, 6), (3, 7), (4, 8)]),
}  # fmt: skip


def solid(path, tag, **shape):
    held = [{"where": {"tag": tag}, "fix": ["x"]}]
    return Solid.model_validate(
        {"shape": {"mesh": str(path), **shape}, "density": 1.0, "young": 1.0, "poisson": 0.0, "supports": held}
    )


def places(path, tag, dim, elements="linear", **shape):
    """Return the nodes of a place, as a set of points, and its boundary facets."""
    body = solid(path, tag, **shape)
    points, cells = build_mesh(body, dim, "solids.b", Path())
    facets = boundary_facets(points, cells)
    tags = read_tags(body, dim, "solids.b", Path())
    if elements == "quadratic":
        points, cells = quadratic(points, cells)
    tags = with_middles(tags, cells)
    nodes = located(Tagged(tag=tag), points, "solids.b.supports.0", tags)
    chosen = facets[located_facets(Tagged(tag=tag), points, facets, "solids.b.loads.0", tags)]
    return {tuple(x) for x in points[nodes].tolist()}, points[chosen]


def size(facets):
    """Return length or area."""
    if facets.shape[1] == 2:
        return np.linalg.norm(facets[:, 1] - facets[:, 0], axis=1).sum()
    return np.linalg.norm(np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0]), axis=1).sum() / 2


def size_of(corners):
    """Return the length of an edge, or the area of a flat face."""
    x = np.array(corners)
    return size(x[None] if len(x) == 2 else np.stack([x[[0, k, k + 1]] for k in range(1, len(x) - 1)]))


def written(path, points, elements, rest):
    rows = [f"{n}, " + ", ".join(map(str, x)) for n, x in enumerate(points, 1)]
    path.write_text("\n".join(["*NODE", *rows, elements, rest, ""]))
    return path


def notes_of(path, dim):
    notes = []
    read_cells(Shape(mesh=str(path)), dim, dim, "mesh", Path(), notes)
    return notes


@pytest.mark.parametrize("kind", [*SOLIDS, *EDGES])
def test_the_sides_of_an_element_are_those_of_the_manual(tmp_path, kind):
    """Every side by element and by set: its own corners and no other, its whole area, cut or not; with middles too."""
    linear, edges = EDGES.get(kind, (kind, []))
    corners, sides = SOLIDS[linear]
    middles = [tuple(np.mean([corners[a - 1], corners[b - 1]], axis=0).tolist()) for a, b in edges]
    dim, points = 3 if linear.startswith("C3D") else 2, [*corners, *middles]
    corners = [tuple(map(float, x[:dim])) for x in corners]
    cell = f"*ELEMENT, TYPE={kind}, ELSET=body\n7, " + ", ".join(map(str, range(1, len(points) + 1)))
    surfaces = [f"*SURFACE, NAME=side{n}\n{('7', 'Body')[n % 2]}, s{n}" for n in range(1, len(sides) + 1)]
    path = written(tmp_path / "m.inp", points, cell, "\n".join(surfaces))
    for n, side in enumerate(sides, 1):
        nodes, facets = places(path, f"side{n}", dim)
        assert nodes == {corners[a - 1] for a in side}
        assert size(facets) == pytest.approx(size_of([corners[a - 1] for a in side]))
        nodes, _ = places(path, f"side{n}", dim, "quadratic")
        between = {tuple(((np.array(corners[a - 1]) + corners[b - 1]) / 2).tolist())
                   for a, b in itertools.pairwise([*side, side[0]])}  # fmt: skip
        assert between <= nodes and len(nodes) == {2: 3, 3: 6, 4: 9}[len(side)]


#: Two hexahedra side by side along x, the second turned over; the first's skin at x = 0 is a shell, too.
BAR = """*NODE, NSET=nall
1, 0, 0, 0
2, 1, 0, 0
3, 2, 0, 0
4, 0, 1, 0
5, 1, 1, 0
6, 2, 1, 0
7, 0, 0, 1
8, 1, 0, 1
9, 2, 0, 1
10, 0, 1, 1
11, 1, 1, 1
12, 2, 1, 1
*ELEMENT, TYPE=C3D8, ELSET=one
1, 1, 2, 5, 4, 7, 8, 11, 10
*ELEMENT, TYPE=C3D8R, ELSET=two
2, 3, 6, 5, 2, 9, 12, 11, 8
*ELEMENT, TYPE=S4R, ELSET=skin
3, 1, 7, 10, 4
*ELEMENT, TYPE=SPRINGA, ELSET=spring
4, 1, 2
*ELSET, ELSET=both
one, two
*NSET, NSET=end
3, 6, 9
"""


@pytest.mark.parametrize(
    "surface, low, high",
    [
        ("NAME=S\none, S6\n", (0, 0, 0), (0, 1, 1)),
        ("NAME=S, TYPE=element\nskin, SPOS\n", (0, 0, 0), (0, 1, 1)),
        ("TYPE=ELEMENT, NAME=S\n3, SNEG\n1, S6\n", (0, 0, 0), (0, 1, 1)),
        ("NAME=S\nskin\n", (0, 0, 0), (0, 1, 1)),
        ("NAME=S\nBAR-1.both, S2\n", (0, 0, 1), (2, 1, 1)),
        ("NAME=S\n1, S1\nbar-1.2, S1\n", (0, 0, 0), (2, 1, 0)),
        ("NAME=S\n1, S3\n2, S6\n", (0, 0, 0), (2, 0, 1)),
        ("NAME=S, TYPE=NODE\nend, 0.5\n12, 2\n", (2, 0, 0), (2, 1, 1)),
    ],
)
def test_a_surface_is_a_place_of_facets_or_nodes(tmp_path, surface, low, high):
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, {surface}*STEP\n")
    assert not [note for note in notes_of(path, 3) if "surface" in note]
    nodes, facets = places(path, "S", 3)
    every = itertools.product((0.0, 1.0, 2.0), (0.0, 1.0), (0.0, 1.0))
    assert nodes == {x for x in every if all(a <= b <= c for a, b, c in zip(low, x, high, strict=True))}
    assert size(facets) == pytest.approx(np.prod([b - a for a, b in zip(low, high, strict=True) if b > a]))


def test_without_sides_a_surface_is_what_lies_bare(tmp_path):
    """The side between the two is none, of one of them neither."""
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, NAME=hull\nboth,\n*SURFACE, NAME=half\none\n")
    assert size(places(path, "hull", 3)[1]) == pytest.approx(10.0)
    assert size(places(path, "half", 3)[1]) == pytest.approx(5.0)
    tags = read_tags(solid(path, "half"), 3, "solids.b", Path())
    assert len(tags["hull"].facets) == 20 and len(tags["half"].facets) == 10


def test_shells_in_the_plane_have_edges(tmp_path):
    path = tmp_path / "m.inp"
    path.write_text("*NODE\n1,0,0\n2,1,0\n3,1,1\n4,0,1\n*ELEMENT,TYPE=S4R\n1,1,2,3,4\n*SURFACE,NAME=S\n1, E2\n")
    nodes, facets = places(path, "S", 2)
    assert nodes == {(1.0, 0.0), (1.0, 1.0)} and size(facets) == 1.0


@pytest.mark.parametrize(
    "surface, why",
    [
        ("NAME=S\none, S7", "S7 is no side of C3D8"),
        ("NAME=S\nboth, S1\ntwo, SPOS", "SPOS is no side of C3D8R"),
        ("NAME=S\nskin, S1", "S1 is no side of S4R"),
        ("NAME=S\nspring, S1", "no set of elements SPRING is read"),
        ("NAME=S\n4, S1", "it names 1 elements that are not read or not there"),
        ("NAME=S\n1, S1\n99, S1", "it names 1 elements that are not read or not there"),
        ("NAME=S\nthree, S1", "no set of elements THREE is read"),
        ("NAME=S\n1, S1\n, S2", "a line names no elements"),
        ("NAME=S\n1, S1\n*SURFACE, NAME=S\n99, S1", "it names 1 elements that are not read or not there"),
        ("NAME=S\nskin\n*SURFACE, NAME=S, TYPE=NODE\n13", "it names 1 nodes that are not read or not there"),
        ("NAME=S, TYPE=NODE\none", "no set of nodes ONE is read"),
        ("NAME=S, TYPE=NODE\n13", "it names 1 nodes that are not read or not there"),
        ("NAME=end, TYPE=NODE\n1", "a set of other nodes has its name"),
        ("NAME=S", "it names no elements"),
        ("NAME=S, TYPE=CUTTING SURFACE\n1, 2, 3", "TYPE=CUTTING SURFACE"),
        ("NAME=S, COMBINE=UNION\nA, B", "COMBINE"),
        ("NAME=skin\n2, S6", "a set of other elements has its name"),
    ],
)
def test_a_surface_that_is_not_read_whole_is_told_and_is_no_place(tmp_path, surface, why):
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, {surface}\n")
    name = next((name for name in ("end", "skin") if f"={name}" in surface), "S")
    assert f"mesh: surface {name} is not read: {why}" in notes_of(path, 3)
    if name == "S":
        with pytest.raises(InputError) as error:
            places(path, "S", 3)
        assert f"where.tag = 'S': could not be read from the mesh file: {why}; it has " in str(error.value)
        assert ", S" not in str(error.value).split("it has")[-1]
    else:
        tag = read_tags(solid(path, name), 3, "solids.b", Path())[name]
        assert len(tag.nodes) == {"end": 3, "skin": 4}[name]


def test_facets_that_several_surfaces_or_shells_share_are_there_once(tmp_path):
    """Else the skin would be no surface of an obstacle: a closed one has each facet once."""
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, NAME=S\none\nboth\n*SURFACE, NAME=T\n1, S6\n*SURFACE, NAME=S\nskin,\n")
    points, facets = read_cells(Shape(mesh=str(path), cells="S"), 3, 2, "mesh", Path(), [])
    assert size(points[facets]) == pytest.approx(10.0)
    assert len(np.unique(np.sort(facets, axis=1), axis=0)) == len(facets) == 20


@pytest.mark.parametrize(
    "surface, told",
    [
        ("NAME=end\n1, S6", "end is a surface and a set of other nodes: as a place it is the surface"),
        ("NAME=one\n1, S6", "one is a surface and a set of other elements: as a place it is the surface"),
        ("NAME=nall\n1, S1\n1, S2\n2, S1\n2, S2", None),
        ("NAME=skin\n1, S6", None),
    ],
)
def test_a_surface_that_takes_the_name_of_another_place_is_told(tmp_path, surface, told):
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, {surface}\n")
    assert [note for note in notes_of(path, 3) if "surface" in note] == ([f"mesh: {told}"] if told else [])


def test_names_of_surfaces_have_no_case(tmp_path):
    """Cards of one name are one surface, as the first spells it, and are read all or none."""
    path = tmp_path / "m.inp"
    path.write_text(f"{BAR}*SURFACE, NAME=Low\n1, S1\n*SURFACE, NAME=LOW\n2, S1\n")
    assert size(places(path, "Low", 3)[1]) == pytest.approx(2.0)
    assert "LOW" not in read_tags(solid(path, "Low"), 3, "solids.b", Path())
    path.write_text(f"{BAR}*SURFACE, NAME=Low\n1, S1\n*SURFACE, NAME=LOW\n2, S7\n")
    assert "mesh: surface Low is not read: S7 is no side of C3D8R" in notes_of(path, 3)
    assert read_tags(solid(path, "Low"), 3, "solids.b", Path())["Low"].unread


def test_a_set_of_a_surface_s_nodes_with_their_middles_is_no_other_place(tmp_path):
    corners, cell = [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)], "*ELEMENT, TYPE=CPS6\n1, 1, 2, 3, 4, 5, 6"
    path = written(tmp_path / "m.inp", corners, cell, "*NSET, NSET=S\n1, 2, 4\n*SURFACE, NAME=S\n1, S1")
    assert not [note for note in notes_of(path, 2) if "surface" in note]


#: The rest of the skin of BAR.
SKIN = """*ELEMENT, TYPE=S4R, ELSET=skin
12, 3, 6, 12, 9
13, 1, 4, 5, 2
14, 2, 5, 6, 3
15, 7, 8, 11, 10
16, 8, 9, 12, 11
17, 1, 2, 8, 7
18, 2, 3, 9, 8
19, 4, 10, 11, 5
20, 5, 11, 12, 6
"""


def test_a_surface_within_a_skin_of_shells_is_no_part_of_an_obstacle(tmp_path):
    path, notes = tmp_path / "m.inp", []
    path.write_text(f"{BAR}{SKIN}*SURFACE, NAME=contact\n1, S4\n")
    _, facets = read_surface(Shape(mesh=str(path)), 3, "obstacles.o.shape", Path(), notes)
    assert len(facets) == 20
    assert notes[-1] == (
        "obstacles.o.shape.mesh: all cells are taken, of whatever group, but no surfaces made of other cells' sides; "
        "cells = ... would take one of the groups contact, skin"
    )


def test_surfaces_that_close_nothing_together_are_named(tmp_path):
    """Without elements that are facets, all that surfaces name is taken: one of them may be what is meant."""
    path = tmp_path / "m.inp"
    solids = BAR.replace("*ELEMENT, TYPE=S4R, ELSET=skin\n3, 1, 7, 10, 4\n", "")
    path.write_text(f"{solids}*SURFACE, NAME=hull\nboth\n*SURFACE, NAME=contact\n1, S4\n")
    with pytest.raises(InputError) as error:
        read_surface(Shape(mesh=str(path)), 3, "obstacles.o.shape", Path())
    assert str(error.value).endswith(
        "the surface must be closed (all cells are taken, of whatever group; cells = ... would take one of the groups "
        "contact, hull)"
    )
    assert len(read_surface(Shape(mesh=str(path), cells="hull"), 3, "obstacles.o.shape", Path())[1]) == 20
