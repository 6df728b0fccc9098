"""Disks and balls as meshes: their shape, their quality, and that no direction is preferred."""

import math
from itertools import permutations, product

import numpy as np
import pytest
from scipy.spatial import cKDTree
from solid_cases import field, gathered, step

from petfsi.errors import InputError
from petfsi.geometry.balls import ball_mesh, unit_ball
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.meshes import _check, build_mesh
from petfsi.geometry.surfaces import boundary_facets, shells, signed_volumes
from petfsi.scene.load import scene_from_dict
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Ball

VOLUME = {2: math.pi, 3: 4 * math.pi / 3}


def quality(points, cells):
    """Return the volume of each simplex over that of a regular one with edges of the same mean square, as a length."""
    dim = points.shape[1]
    pairs = [(a, b) for a in range(dim + 1) for b in range(a)]
    square = sum(((points[cells[:, a]] - points[cells[:, b]]) ** 2).sum(axis=1) for a, b in pairs) / len(pairs)
    regular = {2: math.sqrt(3) / 4, 3: math.sqrt(2) / 12}[dim]
    return (signed_volumes(points, cells) / regular) ** (2 / dim) / square


def nodal_volumes(points, cells):
    share = np.repeat(signed_volumes(points, cells), cells.shape[1]) / cells.shape[1]
    return np.bincount(cells.ravel(), weights=share)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n", [2, 4, 10])
def test_a_ball_is_a_sound_mesh_with_its_boundary_on_the_sphere(dim, n):
    ball = Ball(centre=[0.3, -0.2, 0.5][:dim], radius=0.7, cells=n)
    points, cells = ball_mesh(ball, dim)
    assert len(points) == (n + 1) ** dim and len(cells) == math.factorial(dim) * n**dim
    _check(points, cells, "ball")
    facets = boundary_facets(points, cells)
    assert len(facets) == 2 * dim * n ** (dim - 1) * math.factorial(dim - 1)
    radius = np.linalg.norm(points - ball.centre, axis=1)
    assert np.abs(radius[np.unique(facets)] / 0.7 - 1).max() < 1e-15
    assert np.all(np.delete(radius, np.unique(facets)) < 0.7 * (1 - 0.5 / n))
    _, volume = shells(points, facets)
    assert volume == pytest.approx([signed_volumes(points, cells).sum()], rel=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_volume_is_second_order(dim):
    error = [1 - signed_volumes(*unit_ball(dim, n)).sum() / VOLUME[dim] for n in (4, 8, 16)]
    assert np.log2(np.array(error[:-1]) / error[1:]) == pytest.approx([2.0, 2.0], abs=0.15)


@pytest.mark.parametrize("dim, worst, spread", [(2, 0.86, 2.6), (3, 0.7, 7.0)])
def test_simplices_are_well_shaped_at_every_size(dim, worst, spread):
    """The right triangles and tetrahedra of boxes have 0.87 and 0.76, regular ones 1."""
    for n in (2, 6, 24):
        points, cells = unit_ball(dim, n)
        volumes = signed_volumes(points, cells)
        assert quality(points, cells).min() > worst
        assert volumes.max() < spread * volumes.min()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ball_looks_the_same_along_all_axes_and_in_all_mirrors(dim):
    points, cells = unit_ball(dim, 6)
    tree, mass = cKDTree(points), nodal_volumes(points, cells)
    wanted = np.unique(np.sort(cells, axis=1), axis=0)
    for axes in permutations(range(dim)):
        for signs in product((-1, 1), repeat=dim):
            distance, image = tree.query(points[:, axes] * signs)
            assert distance.max() < 1e-15
            assert np.abs(mass[image] / mass - 1).max() < 1e-12
            assert np.array_equal(np.unique(np.sort(image[cells], axis=1), axis=0), wanted)


def test_points_on_axes_stay_there():
    points, _ = unit_ball(3, 8)
    assert np.array_equal(points[len(points) // 2], [0.0, 0.0, 0.0])
    assert any(np.array_equal(p, [0.0, -1.0, 0.0]) for p in points)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ball_falls_without_turning_or_bending(dim):
    ball = {"ball": {"centre": [0.1] * dim, "radius": 0.4, "cells": 6}}
    solid = field(dim, gravity=[0.0, -2.0, 1.0][:dim], b={"shape": ball, "density": 3.0, "young": 9.0, "poisson": 0.3})
    step(solid, 0.0, 0.1)
    assert np.abs(gathered(solid, "velocity") - [0.0, -0.2, 0.1][:dim]).max() < 1e-12


# ---- in scenes ----------------------------------------------------------------------------------------------


def solid(**shape):
    return Solid.model_validate({"shape": shape, "density": 1.0, "young": 1.0, "poisson": 0.3})


def test_a_solid_ball_is_the_ball_of_its_table():
    table = {"centre": [1.0, 2.0], "radius": 0.5, "cells": 4}
    points, cells = build_mesh(solid(ball=table), 2, "solids.b", ".")
    wanted = ball_mesh(Ball(**table), 2)
    assert np.array_equal(points, wanted[0]) and np.array_equal(cells, wanted[1])


def test_a_ball_without_cells_is_no_mesh():
    with pytest.raises(InputError, match=r"solids\.b\.shape: a solid wants a box or a ball with cells"):
        build_mesh(solid(ball={"centre": [0, 0], "radius": 1}), 2, "solids.b", ".")


def body(*centre, radius=0.1, **more):
    shape = {"ball": {"centre": list(centre), "radius": radius, "cells": 8}}
    return {"shape": shape, "density": 1.0, "young": 1.0, "poisson": 0.3, **more}


def scene(solids, obstacles=None):
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [8, 8]}
    time = {"end": 1.0, "dt": 0.1, "integrator": "newmark"}
    return scene_from_dict({"dim": 2, "time": time, "fluid": fluid, "solids": solids, "obstacles": obstacles or {}})


def test_a_ball_in_an_obstacle_or_out_of_its_container_is_refused():
    post = {"shape": {"box": {"origin": [0.4, 0.4], "size": [0.2, 0.2]}}}
    with pytest.raises(InputError, match=r"solids\.b\.shape: overlaps obstacles\.post with"):
        build_bodies(scene({"b": body(0.3, 0.5, radius=0.15)}, {"post": post}))
    room = {"shape": {"ball": {"centre": [0.5, 0.5], "radius": 0.4}}, "outside": True}
    build_bodies(scene({"b": body(0.5, 0.5, radius=0.35)}, {"room": room}))
    with pytest.raises(InputError, match=r"solids\.b\.shape: overlaps obstacles\.room with"):
        build_bodies(scene({"b": body(0.5, 0.7, radius=0.29)}, {"room": room}))


def test_a_ball_can_be_held_by_its_sides():
    held = [{"where": "left", "fix": ["x", "y"]}]
    assert "b" in build_bodies(scene({"b": body(0.5, 0.5, supports=held)}))
