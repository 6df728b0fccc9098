"""Obstacles as surfaces: closed, turned the right way, and with the volume of what they stand for."""

import math

import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

from petfsi.errors import InputError
from petfsi.geometry import obstacles
from petfsi.geometry.bodies import enclosed
from petfsi.geometry.clipping import Lattice, cut
from petfsi.geometry.obstacles import obstacle_surface, obstacle_surfaces
from petfsi.geometry.seams import find_seams
from petfsi.geometry.shapes import inside
from petfsi.geometry.surfaces import occurrences, ridges, shells
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Obstacle

SPACING = 0.05

#: Shapes of 2D and 3D with their volume; a half space has none.
SHAPES = {
    "rectangle": ({"box": {"origin": [0.1, -0.2], "size": [0.5, 0.7]}}, 0.35),
    "disk": ({"ball": {"centre": [0.4, 0.3], "radius": 0.33}}, math.pi * 0.33**2),
    "small disk": ({"ball": {"centre": [0.4, 0.3], "radius": 0.01}}, math.pi * 0.01**2),
    "half plane": ({"halfspace": {"point": [0.3, 0.2], "normal": [-0.2, 3.0]}}, None),
    "floor 2D": ({"halfspace": {"point": [0.3, 0.2], "normal": [0.0, 3.0]}}, None),
    "box": ({"box": {"origin": [0.1, -0.2, 0.3], "size": [0.5, 0.7, 0.2]}}, 0.07),
    "ball": ({"ball": {"centre": [0.4, 0.3, 0.5], "radius": 0.33}}, 4 / 3 * math.pi * 0.33**3),
    "small ball": ({"ball": {"centre": [0.4, 0.3, 0.5], "radius": 0.01}}, 4 / 3 * math.pi * 0.01**3),
    "cylinder": (
        {"cylinder": {"start": [0.1, 0.2, 0.3], "end": [0.5, 0.4, 0.9], "radius": 0.21}},
        math.pi * 0.21**2 * math.sqrt(0.56),
    ),
    "coin": (
        {"cylinder": {"start": [0.5, 0.5, 0.3], "end": [0.5, 0.5, 0.29], "radius": 0.4}},
        math.pi * 0.4**2 * 0.01,
    ),
    "half space": ({"halfspace": {"point": [0.5, 0.6, 0.5], "normal": [1.0, -2.0, 0.5]}}, None),
    "floor": ({"halfspace": {"point": [0.5, 0.6, 0.5], "normal": [0.0, 0.0, 0.1]}}, None),
}


def surface(shape, outside=False, periodic=None):
    obstacle = Obstacle.model_validate({"shape": shape, "outside": outside})
    dim = 2 if len(next(iter(next(iter(shape.values())).values()))) == 2 else 3
    return obstacle_surface(obstacle, dim, SPACING, np.zeros(dim), np.ones(dim), "o.shape", ".", periodic)


def enclosed_volume(points, facets):
    return np.linalg.det(points[facets]).sum() / math.factorial(points.shape[1])


def assert_closed(facets):
    dim = facets.shape[1]
    rim = ridges(facets).reshape(-1, dim - 1)
    assert np.all(occurrences(rim) == 2)
    ends = rim if dim == 3 else facets[:, :1]
    assert len(np.unique(ends, axis=0)) == len(ends), "neighbours disagree on their orientation"


def edges(points, facets):
    """Return the length of every edge."""
    pairs = facets if facets.shape[1] == 2 else ridges(facets).reshape(-1, 2)
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("outside", [False, True])
def test_a_surface_is_closed_of_one_piece_and_has_the_shapes_volume(name, outside):
    shape, volume = SHAPES[name]
    points, facets = surface(shape, outside)
    assert_closed(facets)
    assert len(np.unique(facets)) == len(points)
    _, found = shells(points, facets)
    sign = -1 if outside else 1
    assert len(found) == 1 and sign * found[0] > 0
    if volume is not None:
        assert sign * found[0] == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_a_surface_winds_around_what_lies_inside_its_shape(name):
    shape, _ = SHAPES[name]
    points, facets = surface(shape)
    obstacle = Obstacle.model_validate({"shape": shape})
    # in the grid; small things are looked at closely
    low, high = (np.clip(c, 0, 1) for c in (points.min(axis=0) - 0.01, points.max(axis=0) + 0.01))
    at = np.random.default_rng(1).uniform(low, high, (4000, points.shape[1]))
    differ = enclosed(points, facets, at) != inside(obstacle.shape, at)
    if "box" in shape or "halfspace" in shape:
        assert not differ.any()
    else:
        # facets and the round shape lie a sagitta apart, of the order of edge^2 / (8 radius)
        radius = next(iter(shape.values()))["radius"]
        edge = np.median(edges(points, facets))
        assert differ.mean() < 0.25 * (edge / radius) ** 2


@pytest.mark.parametrize("name", ["disk", "ball", "cylinder"])
def test_facets_of_round_shapes_are_as_large_as_asked(name):
    points, facets = surface(SHAPES[name][0])
    length = edges(points, facets)
    assert 0.6 * SPACING < length.min() and length.max() < 1.7 * SPACING
    assert length.mean() == pytest.approx(SPACING, rel=0.2)


def test_round_shapes_keep_the_symmetry_of_the_grid():
    for shape in ({"ball": {"centre": [0.0, 0.0], "radius": 1.0}}, {"ball": {"centre": [0.0] * 3, "radius": 1.0}}):
        points, facets = surface(shape)
        tree = cKDTree(points)
        mirrors = [points * (1 - 2 * unit) for unit in np.eye(points.shape[1])]
        for image in [*mirrors, np.roll(points, 1, axis=1)]:
            assert tree.query(image)[0].max() < 1e-14


@pytest.mark.parametrize("name", ["half plane", "floor 2D", "half space", "floor"])
def test_a_half_space_covers_its_part_of_the_grid_with_a_margin(name):
    shape, _ = SHAPES[name]
    points, facets = surface(shape)
    dim = points.shape[1]
    at = np.random.default_rng(2).uniform(-0.05, 1.05, (2000, dim))
    assert np.array_equal(enclosed(points, facets, at), inside(Obstacle.model_validate({"shape": shape}).shape, at))
    plane = shape["halfspace"]
    normal = np.array(plane["normal"]) / np.linalg.norm(plane["normal"])
    height = (points - plane["point"]) @ normal
    assert np.count_nonzero(np.abs(height) < 1e-14) == 2 ** (dim - 1)


def test_a_half_space_below_the_grid_is_a_slab_below_it():
    points, facets = surface({"halfspace": {"point": [0.0, -3.0], "normal": [0.0, 1.0]}})
    assert points[:, 1].max() == -3.0 and points[:, 1].min() < -3.0
    assert_closed(facets)
    points, _ = surface({"halfspace": {"point": [0.0, 7.0], "normal": [0.0, 1.0]}})
    assert points[:, 1].max() == 7.0 and points[:, 1].min() < 0.0


# ---- periodic axes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape",
    [
        {"halfspace": {"point": [0.3, 0.2, 0.0], "normal": [0.0, 0.7, 0.0]}},
        {"box": {"origin": [-1.0, -0.2, -5.0], "size": [3.0, 0.4, 9.0]}},
    ],
)
def test_what_reaches_through_a_periodic_grid_has_no_ends_there(shape):
    points, facets = surface(shape, periodic=[True, False, True])
    assert_closed(facets)
    seams = find_seams(points, facets, np.ones(3), np.array([True, False, True]))
    walls = facets[seams.walls]
    assert len(walls) == 4 and [len(cap) for cap in seams.caps] == [2, 0, 2]
    assert np.array_equal(np.unique(points[:, 0]), [0, 1]) and np.array_equal(np.unique(points[:, 2]), [0, 1])
    assert points[:, 1].max() == pytest.approx(0.2)
    a, b, c = points[walls].transpose(1, 0, 2)
    area = 0.5 * np.cross(b - a, c - a)
    assert area[:, [0, 2]] == pytest.approx(0.0)
    assert sorted(area[:, 1]) == pytest.approx([-0.5, -0.5, 0.5, 0.5])
    # with ends only along x it is a tunnel
    points, facets = surface(shape, periodic=[False, False, True])
    seams = find_seams(points, facets, np.ones(3), np.array([False, False, True]))
    assert len(seams.walls) == 8 and np.array_equal(np.unique(points[:, 2]), [0, 1])


def test_a_leaning_floor_repeats_along_the_axis_it_does_not_lean_to():
    points, facets = surface({"halfspace": {"point": [0, 0.5, 0], "normal": [0.6, 0.8, 0.0]}}, periodic=[0, 0, 1])
    assert len(find_seams(points, facets, np.ones(3), np.array([False, False, True])).walls) == 8
    assert np.array_equal(np.unique(points[:, 2]), [0.0, 1.0])
    assert np.linalg.det(points[facets] - [0.5, 0.5, 0.5]).sum() != 0


def test_a_box_that_ends_within_a_periodic_grid_keeps_its_ends():
    points, facets = surface({"box": {"origin": [0.8, 0.1], "size": [0.5, 0.2]}}, periodic=[True, True])
    assert_closed(facets)
    assert enclosed_volume(points, facets) == pytest.approx(0.1)


# ---- files and whole scenes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("outside", [False, True])
def test_a_file_is_its_surface(tmp_path, outside):
    points, facets = surface(SHAPES["ball"][0])
    meshio.Mesh(points, [("triangle", facets)]).write(tmp_path / "ball.vtk")
    obstacle = Obstacle.model_validate({"shape": {"mesh": "ball.vtk"}, "outside": outside})
    got = obstacle_surface(obstacle, 3, SPACING, np.zeros(3), np.ones(3), "o.shape", tmp_path)
    assert_closed(got[1])
    assert enclosed_volume(*got) == pytest.approx((-1 if outside else 1) * SHAPES["ball"][1], rel=1e-12)


def scene(obstacles, directory=".", **sides):
    fluid = {"density": 1.0, "origin": [0.0, -1.0], "size": [2.0, 2.0], "cells": [20, 40], "sides": sides}
    data = {"dim": 2, "time": {"end": 1.0, "dt": 0.1, "integrator": "newmark"}, "fluid": fluid, "obstacles": obstacles}
    return scene_from_dict(data, directory)


ROOM = {"shape": {"ball": {"centre": [1.0, 0.0], "radius": 0.9}}, "outside": True}
POST = {"shape": {"box": {"origin": [0.9, -0.2], "size": [0.2, 0.3]}}}
FLOOR = {"shape": {"halfspace": {"point": [0.0, -0.8], "normal": [0.0, 1.0]}}}


def test_all_obstacles_of_a_scene_follow_each_other():
    every = obstacle_surfaces(scene({"room": ROOM, "post": POST}))
    assert every.base == 1
    assert_closed(every.facets)
    label, volume = shells(every.points, every.facets)
    assert volume == pytest.approx([-math.pi * 0.81, 0.06], rel=1e-12)
    assert np.array_equal(np.unique(every.facets), np.arange(len(every.points)))
    # the shorter side of a cell says how fine
    assert edges(every.points, every.facets[label == 0]) == pytest.approx(0.05, rel=0.05)


def test_a_scene_without_obstacles_has_no_surface():
    none = obstacle_surfaces(scene({}))
    assert none.points.shape == none.facets.shape == (0, 2) and none.base == 0
    assert none.facets.dtype.kind == "i"


def test_a_floor_of_a_periodic_scene_has_no_ends():
    every = obstacle_surfaces(scene({"floor": FLOOR}, left="periodic", right="periodic"))
    assert len(every.seams.walls) == 2 and np.array_equal(np.unique(every.points[:, 0]), [0.0, 2.0])
    assert len(obstacle_surfaces(scene({"floor": FLOOR})).seams.walls) == 4


def test_shapes_that_need_too_many_facets_and_unfit_files_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(obstacles, "MAX_FACETS", 1000)
    (tmp_path / "bad.stl").write_text("no mesh")
    moon = {"shape": {"ball": {"centre": [1.0, -1e3], "radius": 1e3}}}
    with pytest.raises(InputError) as error:
        obstacle_surfaces(scene({"moon": moon, "post": POST, "bad": {"shape": {"mesh": "bad.stl"}}}, tmp_path))
    first, second = str(error.value).splitlines()
    assert first.startswith("obstacles.moon.shape.ball.radius = 1000: its surface needs 1.3e+05 facets")
    assert second.startswith("obstacles.bad.shape.mesh = ") and error.value.exit_code == 2
    for shape in ({"ball": {"centre": [0.0] * 3, "radius": 1.0}}, SHAPES["cylinder"][0]):
        with pytest.raises(InputError, match=r"o\.shape\.(ball|cylinder)\.radius = .* at most 1e\+03 may be"):
            surface(shape)


# ---- cut by the grid ----------------------------------------------------------------------------------------

LEANING = {"shape": {"halfspace": {"point": [0.5, 0.1, 0.5], "normal": [0.0, 2.0, 1.0]}}}
PIPE = {"shape": {"box": {"origin": [-1.0, 0.25, 0.1], "size": [3.0, 0.5, 0.8]}}, "outside": True}
TUBE = {"shape": {"cylinder": {"start": [-1.0, 0.5, 0.5], "end": [2.0, 0.5, 0.5], "radius": 0.4}}, "outside": True}
CAVE = {"shape": {"ball": {"centre": [0.5, 0.5, 0.5], "radius": 0.45}}, "outside": True}
PEBBLE = {"shape": {"ball": {"centre": [0.45, 0.5, 0.5], "radius": 0.2}}}
BALL_VOLUME = 4 / 3 * math.pi


@pytest.mark.parametrize(
    "obstacles, room, sides",
    [
        ({"floor": LEANING}, 1 - 0.5 * 0.35 * 0.7, {}),
        ({"floor": LEANING}, 1 - 0.5 * 0.35 * 0.7, {"left": "periodic", "right": "periodic"}),
        ({"pipe": PIPE}, 0.4, {}),
        ({"pipe": PIPE}, 0.4, {"left": "periodic", "right": "periodic"}),
        ({"tube": TUBE}, math.pi * 0.16, {}),
        ({"cave": CAVE, "pebble": PEBBLE}, BALL_VOLUME * (0.45**3 - 0.2**3), {}),
    ],
)
def test_the_grid_finds_the_room_that_obstacles_leave(obstacles, room, sides):
    fluid = {"density": 1.0, "origin": [0.0] * 3, "size": [1.0] * 3, "cells": [10, 12, 14], "sides": sides}
    data = {"dim": 3, "time": {"end": 1.0, "dt": 0.1, "integrator": "newmark"}, "fluid": fluid, "obstacles": obstacles}
    every = obstacle_surfaces(scene_from_dict(data))
    cells = np.array([10, 12, 14])
    periodic = np.array(["left" in sides, False, False])
    lattice = Lattice(np.zeros(3), 1 / cells, cells, periodic, np.zeros(3, dtype=int), cells)
    got = cut(every.points, every.facets, lattice, every.base, None, every.seams)
    assert got.volume.mean() == pytest.approx(room, rel=2e-8)
    if sides:  # what reaches around the axis covers its rows, too
        assert np.ptp(got.open[0], axis=0).max() < 1e-14
        assert got.open[0][0].mean() == pytest.approx(room, rel=2e-8)
    # every cell is closed: its open faces and its walls
    wall = np.zeros((cells.prod(), 3))
    np.add.at(wall, got.cell, got.integrals.sum(axis=1)[:, None] * got.normals[got.facet])
    for axis in range(3):
        flux = np.diff(got.open[axis], axis=axis) / (cells.prod() / cells[axis])
        assert np.abs(flux.ravel() - wall[:, axis]).max() < 1e-13
