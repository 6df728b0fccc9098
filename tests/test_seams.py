"""Periodic axes: what reaches around them or stands across a side is where it is, wherever the seam lies."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench.case import only_options
from petfsi.errors import SolveError
from petfsi.geometry.clipping import Lattice, cut
from petfsi.geometry.meshes import box_mesh
from petfsi.geometry.seams import find_seams
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.load import scene_from_dict
from petfsi.scene.tables import Box
from petfsi.simulation import Simulation

COMM = MPI.COMM_WORLD
AROUND = {
    2: {"left": "periodic", "right": "periodic"},
    3: {"left": "periodic", "right": "periodic", "back": "periodic", "front": "periodic"},
}
HELD = {2: [{"where": "all", "fix": ["x", "y"]}], 3: [{"where": "all", "fix": ["x", "y", "z"]}]}


def solid(shape, **more):
    return {"shape": shape, "density": 1.0, "young": 1e4, "poisson": 0.3} | more


def box(origin, size, cells=None):
    return {"box": {"origin": list(origin), "size": list(size)} | ({} if cells is None else {"cells": list(cells)})}


def scene(dim, velocity, cells=None, **more):
    cells = cells or [16, 12, 12][:dim]
    fluid = {"density": 1.0, "origin": [0.0] * dim, "size": [1.0] * dim, "cells": cells, "sides": AROUND[dim]}
    fluid |= {"initial": {"velocity": velocity}} | more.pop("fluid", {})
    return {"dim": dim, "time": {"end": 1.0, "dt": 0.01, "integrator": "midpoint"}, "fluid": fluid} | more


def run(data, steps):
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(COMM, scene_from_dict(data))
        sim.prepare()
        for _ in range(steps):
            sim.advance()
    return sim


def departure(sim, velocity):
    """The largest departure of the flow from a uniform one, on faces that the pressure acts on."""
    fluid, worst = sim.fluid, 0.0
    for a, v in enumerate(velocity):
        part = fluid.grid.owned(a)
        acts = np.isin(fluid.face_kind[a][part], (1, 2, 5))
        worst = max(worst, np.abs(fluid.velocity[a][part] - v)[acts].max(initial=0.0))
    return COMM.allreduce(worst, op=MPI.MAX)


# ---- solids -------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("start", [0.0, 0.37, -0.25])
@pytest.mark.parametrize("dim", [2, 3])
def test_water_flows_along_a_layer_around_periodic_axes_for_ever(dim, start):
    if dim == 3 and COMM.size > 2:
        pytest.skip("too small a grid")
    velocity = [1.0, 0.0, 0.5][:dim]
    layer = box([start, 0.0, 0.8 * start][:dim], [1.0, 0.3, 1.0][:dim], [6, 2, 5][:dim])
    cells = [32, 12] if dim == 2 else None
    sim = run(scene(dim, velocity, cells, solids={"layer": solid(layer, supports=HELD[dim])}), 5)
    assert departure(sim, velocity) < 1e-14
    assert sim.accounts.values["momentum.x"] == pytest.approx(0.7, rel=1e-12)
    assert sim.accounts.values["region_volume.1"] == pytest.approx(0.7, rel=1e-8)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("start", [0.0, 0.37])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_sheet_around_periodic_axes_lets_nothing_through(dim, start):
    """Water above and below it that moves differently, and two closed regions; the seam lies within a cell, or not."""
    sheet = box([start, 0.43, 0.8 * start][:dim], [1.0, 0.01, 1.0][:dim], [4, 1, 3][:dim])
    above = "1 - 2*heaviside(y - 0.435)"
    data = scene(dim, [above, 0.0, above][:dim], solids={"sheet": solid(sheet, supports=HELD[dim])})
    sim = run(data, 5)
    assert sim.regions.volumes == pytest.approx([0.43, 0.56], rel=1e-7)
    assert abs(sim.fluid.velocity[1]).max() < 1e-13


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_layer_that_nothing_holds_drifts_around_with_the_water(dim):
    velocity = [0.9, 0.0, -0.7][:dim]
    layer = solid(box([0.05, 0.31, 0.2][:dim], [1.0, 0.3, 1.0][:dim], [6, 3, 5][:dim]), initial={"velocity": velocity})
    sim = run(scene(dim, velocity, solids={"layer": layer}), 12)
    assert departure(sim, velocity) < 1e-10
    assert np.abs(sim.solid.surface_velocity() - velocity).max() < 1e-10


def test_a_layer_whose_ends_come_apart_stops_the_run():
    layer = solid(box([0.0, 0.31], [1.0, 0.3], [6, 3]), initial={"velocity": ["x", 0.0]})
    with pytest.raises(SolveError, match="meet at a periodic side have come apart by .* cells: no force joins them"):
        run(scene(2, [0.0, 0.0], solids={"layer": layer}), 20)


# ---- obstacles ----------------------------------------------------------------------------------------------

FLOOR = {"halfspace": {"point": [0.2, 0.33], "normal": [0.0, 1.0]}}
ROOMS = [
    (2, {"shape": FLOOR}, 0.67),
    (2, {"shape": box([-0.4, 0.1], [1.8, 0.2])}, 0.8),
    (2, {"shape": box([0.3, 0.1], [1.0, 0.2])}, 0.8),
    (2, {"shape": box([-1.0, 0.2], [3.0, 0.5]), "outside": True}, 0.5),
    (3, {"shape": {"halfspace": {"point": [0.2, 0.33, 0.0], "normal": [0.0, 1.0, 0.0]}}}, 0.67),
    (3, {"shape": box([0.1, 0.1, -0.3], [1.0, 0.2, 2.0])}, 0.8),
]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("dim, obstacle, room", ROOMS)
def test_water_flows_along_obstacles_around_periodic_axes_for_ever(dim, obstacle, room):
    velocity = [1.0, 0.0, 0.5][:dim]
    sim = run(scene(dim, velocity, obstacles={"o": obstacle}), 5)
    assert departure(sim, velocity) < 1e-14
    assert sim.accounts.values["momentum.x"] == pytest.approx(room, rel=1e-8)
    assert sim.accounts.values["kinetic"] == pytest.approx(0.5 * room * np.square(velocity).sum(), rel=1e-8)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("outside", [False, True])
def test_water_flows_along_a_rod_and_in_a_tube_around_an_axis_for_ever(outside):
    rod = {"cylinder": {"start": [1.5, 0.5, 0.45], "end": [-0.5, 0.5, 0.45], "radius": 0.3}}
    sim = run(scene(3, [1.0, 0.0, 0.0], obstacles={"o": {"shape": rod, "outside": outside}}), 5)
    area = np.pi * 0.09
    assert departure(sim, [1.0, 0.0, 0.0]) < 1e-13
    assert sim.accounts.values["momentum.x"] == pytest.approx(area if outside else 1.0 - area, rel=1e-7)


# ---- wherever the seam lies ---------------------------------------------------------------------------------


def crowd(dim, steps, start, transfer="cutcell", gravity=None):
    """A body on its way, a held one and an obstacle, and the first cell of a grid along the periodic axes."""
    cells = [24, 12, 12][:dim]
    bodies = {
        "thrown": solid(
            {"ball": {"centre": [0.02, 0.3, 0.4][:dim], "radius": 0.15, "cells": 4}},
            initial={"velocity": [0.5, 0.3, 0.2][:dim]},
        ),
        "held": solid(box([0.45, 0.52, 0.31][:dim], [0.21, 0.2, 0.33][:dim], [2] * dim), supports=HELD[dim]),
    }
    post = {"shape": {"ball": {"centre": [0.96, 0.72, 0.95][:dim], "radius": 0.14}}}
    origin = [n / c * (a != 1) for a, (n, c) in enumerate(zip(start, cells, strict=False))]
    data = scene(dim, [0.4, 0.0, 0.1][:dim], cells, solids=bodies, obstacles={"post": post}, fluid={"origin": origin})
    data |= {"coupling": {"transfer": transfer}}
    data |= {"probes": {"p": {"of": "thrown", "at": [0.02, 0.3, 0.4][:dim], "quantity": "displacement"}}}
    data["probes"]["q"] = {"of": "fluid", "at": [1.31, 0.8, 0.7][:dim], "quantity": "velocity"}
    if gravity:
        data["gravity"] = gravity
    sim = run(data, steps)
    return np.array([*sim.probe(), *(sim.accounts.values[name] for name in ("momentum.x", "kinetic"))])


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_where_a_periodic_grid_begins_does_not_matter(transfer):
    """Bodies and obstacles astride a side are those within the grid."""
    wanted = crowd(2, 6, [-7, 0], transfer, [0.3, -1.0])
    for start in (0, 1, 11, 100):
        assert crowd(2, 6, [start, 0], transfer, [0.3, -1.0]) == pytest.approx(wanted, rel=1e-8, abs=1e-8)


@pytest.mark.parallel([1, 2])
def test_where_a_grid_with_two_periodic_axes_begins_does_not_matter():
    wanted = crowd(3, 2, [-7, 0, -3])
    for start in ([0, 0, 0], [1, 0, 10]):
        assert crowd(3, 2, start) == pytest.approx(wanted, rel=1e-8, abs=1e-8)


@pytest.mark.parallel([1, 3])
def test_a_body_astride_a_side_moves_with_the_water_and_falls_with_it():
    """Gravity along the periodic axis is borne by nothing: u_x = x_0 + t + g t^2 / 2."""
    ball = {"ball": {"centre": [0.02, 0.25], "radius": 0.1, "cells": 6}}
    data = scene(2, [1.0, 0.0], [32, 16], solids={"b": solid(ball, initial={"velocity": [1.0, 0.0]})})
    data["fluid"]["size"] = [1.0, 0.5]
    data |= {"gravity": [2.0, 0.0], "probes": {"c": {"of": "b", "at": [-0.05, 0.25], "quantity": "displacement"}}}
    sim = run(data, 50)
    assert sim.probe() == pytest.approx([0.5 + 0.25, 0.0], abs=1e-9)
    assert departure(sim, [2.0, 0.0]) < 1e-8


# ---- geometry -----------------------------------------------------------------------------------------------


def refined(points, facets, one):
    """A facet of three points cut in three about its middle."""
    a, b, c = facets[one]
    m = len(points)
    points = np.vstack((points, points[facets[one]].mean(axis=0)))
    return points, np.vstack((np.delete(facets, one, axis=0), [[a, b, m], [b, c, m], [c, a, m]]))


@pytest.mark.parametrize("dim", [2, 3])
def test_ends_meet_that_are_divided_differently(dim):
    mesh = box_mesh(Box(origin=[0.4, 0.2, 0.1][:dim], size=[1.0, 0.3, 0.4][:dim], cells=[3, 1, 2][:dim]))
    points, facets = mesh[0], boundary_facets(*mesh)
    periodic = np.arange(dim) == 0
    plain = find_seams(points, facets, np.ones(dim), periodic)
    ends = 1 if dim == 2 else 4
    assert len(plain.caps[0]) == ends and len(plain.walls) == len(facets) - 2 * ends
    if dim == 3:
        end = int(np.flatnonzero(np.all(points[facets, 0] > 1.39, axis=1))[0])
        points, facets = refined(points, facets, end)
        other = find_seams(points, facets, np.ones(dim), periodic)
        assert len(other.caps[0]) == ends and len(other.walls) == len(plain.walls)
    # a corner that is elsewhere leaves both ends as they are
    points[np.lexsort(points.T[::-1])[-1]] += 0.01
    assert len(find_seams(points, facets, np.ones(dim), periodic).caps[0]) < ends


def test_faces_across_the_axis_are_covered_in_every_box():
    """A layer that stands aslant along the axis, in boxes far from its ends."""
    mesh = box_mesh(Box(origin=[0.4, 0.2], size=[1.0, 0.3], cells=[4, 2]))
    points = mesh[0] + 0.1 * np.column_stack((mesh[0][:, 1], np.sin(2 * np.pi * mesh[0][:, 0])))
    facets = boundary_facets(*mesh)
    seams = find_seams(points, facets, np.array([1.0, 1.0]), np.array([True, False]))
    assert len(seams.caps[0]) == 2
    n = np.array([12, 10])
    whole = cut(
        points, facets, Lattice(np.zeros(2), 1 / n, n, np.array([True, False]), np.zeros(2, int), n), 0, None, seams
    )
    assert (1.0 - whole.volume).sum() / n.prod() == pytest.approx(0.3, rel=1e-6)
    for lo, hi in (([2, 1], [7, 9]), ([-3, 0], [4, 10]), ([9, 3], [15, 7])):
        lattice = Lattice(np.zeros(2), 1 / n, n, np.array([True, False]), np.array(lo), np.array(hi))
        part = cut(points, facets, lattice, 0, None, seams)
        columns, rows = np.arange(lo[0], hi[0]) % 12, slice(lo[1], hi[1])
        np.testing.assert_allclose(part.volume, whole.volume[columns, rows], atol=1e-13)
        np.testing.assert_allclose(part.open[0][:-1], whole.open[0][columns, rows], atol=1e-13)
