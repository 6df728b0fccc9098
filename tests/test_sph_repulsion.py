"""Surfaces that push particles away: pairs against sums by hand, momentum, weight, light bodies, ranks. About 15 s."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from test_sph_solids import DIRECT, goes_on_alike, prepared

from petfsi.bench.case import only_options
from petfsi.couplings.repulsion import STILL, _Pairs, repulsion
from petfsi.fields.sph.cells import cell_grid
from petfsi.fields.sph.facets import FLOOR, contacts
from petfsi.fields.sph.particles import Swarm
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.load import scene_from_dict

REACH, C, S = 0.15, 10.0, 0.075
SQUARE = np.array([[0.3, 0.3], [0.7, 0.3], [0.7, 0.7], [0.3, 0.7]])


def swarm_of(x, periodic=None):
    dim = x.shape[1]
    width = {name: (dim, np.float64) for name in ("v", "a")} | {"m": ((), np.float64)}
    swarm = Swarm(MPI.COMM_SELF, cell_grid([0.0] * dim, [1.0] * dim, 0.16, periodic or [False] * dim), width)
    swarm.insert({"id": np.arange(len(x)), "x": x})
    swarm.rebuild()
    return swarm


def loop(n):
    return np.column_stack([np.arange(n), (np.arange(n) + 1) % n])


def square(n):
    """Return a square body with n facets a side."""
    t = np.arange(n)[:, None] / n
    return np.concatenate([(1 - t) * SQUARE[k] + t * SQUARE[(k + 1) % 4] for k in range(4)]), loop(4 * n)


def cube(n):
    """Return the same in 3D, of tetrahedra."""
    axis = np.linspace(0.3, 0.7, n + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    i = np.arange(n)
    base = ((i[:, None, None] * (n + 1) + i[:, None]) * (n + 1) + i).reshape(-1, 1)
    steps = [(n + 1) ** 2, n + 1, 1]
    ways = [(a, b, 3 - a - b) for a in range(3) for b in range(3) if a != b]
    cells = [np.hstack([base, *(base + sum(steps[k] for k in way[: m + 1]) for m in range(3))]) for way in ways]
    return points, boundary_facets(points, np.concatenate(cells))


def by_hand(x, points, facets):
    """Return foot, distance and weights of points for a place before the convex body, from all of its facets."""
    foot = np.clip(x, 0.3, 0.7)
    for corners in facets:
        matrix = np.vstack([points[corners].T, np.ones(len(corners))])
        weights, *_ = np.linalg.lstsq(matrix, np.append(foot, 1.0), rcond=None)
        if weights.min() > -1e-12 and np.abs(matrix @ weights - np.append(foot, 1.0)).max() < 1e-12:
            w = np.zeros(len(points))
            w[corners] = 1 - np.cos(np.pi * weights)
            return foot, np.linalg.norm(x - foot), w / w.sum()
    raise AssertionError(x)


@pytest.mark.parametrize("dim, n", [(2, 1), (2, 5), (3, 2)])
def test_forces_of_pairs_are_those_summed_by_hand(dim, n):
    """Before faces, edges and corners; velocities, masses and the step at random."""
    rng = np.random.default_rng(3)
    points, facets = square(n) if dim == 2 else cube(n)
    x = rng.random((400, dim))
    x = x[np.any((x < 0.3) | (x > 0.7), axis=1)]
    swarm = swarm_of(x)
    swarm["v"], swarm["m"] = rng.normal(size=x.shape), 1 + rng.random(len(x))
    velocity, h = rng.normal(size=points.shape), 0.005
    law = SimpleNamespace(c=C, s=S)
    fluid = SimpleNamespace(law=law, swarm=swarm, room=SimpleNamespace(reach=REACH, near=0.0), dim=dim)
    pairs = _Pairs(fluid, points, velocity, facets, h)
    on_points = pairs.push(pairs.force).reshape(points.shape)
    expected, met = np.zeros_like(points), 0
    for place, v, m, a in zip(swarm["x"], swarm["v"], swarm["m"], swarm["a"], strict=True):
        foot, psi, w = by_hand(place, points, facets)
        f = np.zeros(dim)
        if psi < REACH:
            normal, q = (place - foot) / psi, psi / REACH
            gamma = C / S * (1 - q) / np.sqrt(q)
            f = m * (0.01 * C * gamma + gamma / (1 + h * gamma) * max((w @ velocity - v) @ normal, 0.0)) * normal
            met += 1
        np.testing.assert_allclose(m * a, f, rtol=1e-9, atol=1e-9)
        expected -= w[:, None] * f
    np.testing.assert_allclose(on_points, expected, rtol=1e-9, atol=1e-8)
    assert len(pairs.force) == met > 50 and pairs.n_behind == 0
    total = (swarm["m"][:, None] * swarm["a"]).sum(axis=0)
    np.testing.assert_allclose(total + on_points.sum(axis=0), 0.0, atol=1e-13 * np.abs(on_points).sum())


def test_a_segment_is_monaghan_and_kos_two_nodes():
    points, db = np.array([[0.2, 0.5], [0.4, 0.5], [0.6, 0.5], [0.8, 0.5]]), 0.2
    swarm = swarm_of(np.column_stack([np.linspace(0.21, 0.79, 30), np.full(30, 0.55)]))
    found = contacts(swarm, points, np.array([[1, 0], [2, 1], [3, 2]]), REACH, 0.0)
    assert len(found.row) == 30
    for k, row in enumerate(found.row):
        corners = np.array([[1, 0], [2, 1], [3, 2]])[found.facet[k]]
        xi = swarm["x"][row, 0] - points[corners, 0]
        np.testing.assert_allclose(found.weight[k], (1 + np.cos(np.pi * xi / db)) / 2, atol=1e-12)
        assert found.q[k] == pytest.approx(0.05 / REACH)
    np.testing.assert_array_equal(found.share, 1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_weights_sum_to_one_wherever_the_foot_is(dim):
    """On lattices, too, where feet are on points and edges."""
    points, facets = square(8) if dim == 2 else cube(4)
    axis = np.arange(0.025, 1.0, 0.05)
    x = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    near = np.linalg.norm(x - np.clip(x, 0.3, 0.7), axis=1)
    found = contacts(swarm := swarm_of(x), points, facets, REACH, 0.0)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0, rtol=1e-14)
    total = np.bincount(found.row, found.share, len(x))
    outside = np.linalg.norm(swarm["x"] - np.clip(swarm["x"], 0.3, 0.7), axis=1)
    np.testing.assert_allclose(total[(outside > 0) & (outside < REACH - 1e-9)], 1.0, rtol=1e-12)
    assert found.n_behind == np.count_nonzero((near == 0) & (np.abs(x - 0.5).max(axis=1) > 0.2 - REACH + 1e-9))


def test_a_square_corner_pushes_with_both_walls_and_a_bend_hardly_more_than_a_plane():
    x = np.array([[0.55, 0.57]])
    walls = np.array([[0.9, 0.5], [0.5, 0.5], [0.5, 0.9]])
    found = contacts(swarm_of(x), walls, np.array([[1, 0], [2, 1]])[:, ::-1], REACH, 0.0)
    np.testing.assert_allclose(sorted(map(tuple, found.normal)), [(0.0, 1.0), (1.0, 0.0)], atol=1e-12)
    np.testing.assert_array_equal(found.share, 1.0)
    bend = np.array([[0.9, 0.51], [0.5, 0.5], [0.1, 0.51]])
    found = contacts(swarm_of(np.array([[0.5, 0.57]])), bend, np.array([[0, 1], [1, 2]]), REACH, 0.0)
    assert len(found.share) == 2
    np.testing.assert_allclose(found.share.sum(), 1.0, rtol=1e-3)


def test_what_is_behind_the_nearest_place_is_pushed_out_of_it_and_counted():
    """Also of a plate that is thinner than half a particle; across a periodic side."""
    plate = np.array([[0.02, 0.30], [0.98, 0.30], [0.98, 0.32], [0.02, 0.32]])
    x = np.array([[0.5, 0.315], [0.5, 0.305], [0.5, 0.32], [0.5, 0.33], [0.5, 0.29], [0.0, 0.31]])
    found = contacts(swarm := swarm_of(x), plate, loop(4), REACH, 0.0)
    up = {int(swarm["id"][r]): n for r, n in zip(found.row, found.normal, strict=True)}
    assert found.n_behind == 3 and np.count_nonzero(found.q == FLOOR) == 3
    for k, sign in enumerate([1, -1, 1, 1, -1]):
        np.testing.assert_allclose(up[k], [0.0, sign], atol=1e-12)
    np.testing.assert_allclose(up[5], [-1.0, 0.0], atol=1e-12)
    found = contacts(swarm_of(x[5:], [True, False]), plate, loop(4), REACH, 0.0)
    np.testing.assert_allclose(found.normal[:, 0].sum(), 0.0, atol=1e-12)
    assert len(found.row) == 2


def test_what_grows_with_the_surfaces_velocity_is_the_derivative():
    q, h = np.array([0.02, 0.2, 0.9]), 1e-9
    for u in (1.0, -1.0):
        (a, z), (b, _) = (repulsion(q, np.full(3, u + d), 0.5, C, S, h) for d in (0.0, 1e-3))
        np.testing.assert_allclose((b - a) / 1e-3, z, rtol=1e-4, atol=1e-4)
    (a, z), (b, _) = (repulsion(q + d, np.full(3, -1.0), 0.5, C, S, h) for d in (0.0, -1e-6))
    np.testing.assert_allclose((b - a) / (2e-6 * S), z / h, rtol=1e-3, atol=0.03 * STILL * (C / S) ** 2)


# ---- in a scene -----------------------------------------------------------------------------------------------------


PERIODIC = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")


def free(kind, integrator, density=500.0, end=0.1):
    """Return a body that flies and turns through a periodic sea, with room between the two."""
    box = {"box": {"origin": [0.35, 0.4], "size": [0.3, 0.2], "cells": [6, 4]}}
    beam = {"beam": {"start": [0.3, 0.53], "end": [0.7, 0.47], "thickness": 0.02, "elements": 8}}
    body = {"shape": box if kind == "box" else beam, "young": 1e6, "density": density, "poisson": 0.3}
    body["initial"] = {"velocity": ["0.3", "0.2"] if kind == "beam" else ["0.3 + 0.5*(y - 0.5)", "-0.5*(x - 0.5)"]}
    rest = [([0.0, 0.0], [1.0, 0.35]), ([0.0, 0.65], [1.0, 0.35]), ([0.0, 0.35], [0.3, 0.3]), ([0.7, 0.35], [0.3, 0.3])]
    fill = [{"box": {"origin": origin, "size": size}} for origin, size in rest]
    fluid = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "spacing": 0.05}
    fluid |= {"sides": PERIODIC, "sound_speed": 10.0, "fill": fill}
    time = {"end": end, "dt": "auto", "integrator": integrator}
    table = {"dim": 2, "time": time, "fluid": fluid, "solids": {"body": body}, "coupling": {"transfer": "repulsion"}}
    return scene_from_dict(table)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("kind, integrator", [("beam", "newmark"), ("box", "newmark"), ("box", "symplectic-euler")])
def test_a_free_body_and_the_fluid_keep_their_momentum_to_round_off(kind, integrator):
    with only_options(DIRECT):
        sim = prepared(free(kind, integrator))
        first = None
        while not sim.finished:
            sim.advance()
            now = np.array([sim.accounts.values[f"momentum.{axis}"] for axis in "xy"])
            first = now if first is None else first
            assert np.abs(now - first).max() < 1e-13 * 30.0
    assert np.abs(first).max() > 0.1


def test_a_block_in_3d_keeps_momentum_too():
    shape = {"box": {"origin": [0.3] * 3, "size": [0.4] * 3, "cells": [3] * 3}}
    body = {"shape": shape, "young": 1e6, "poisson": 0.3, "density": 500.0}
    body["initial"] = {"velocity": ["y - 0.2", "0.5 - x", "0.1"]}
    fluid = {"kind": "sph", "density": 1000.0, "origin": [0.0] * 3, "size": [1.0] * 3, "spacing": 0.1}
    fluid |= {"sides": dict.fromkeys((*PERIODIC, "back", "front"), "periodic"), "sound_speed": 10.0}
    fluid["fill"] = [{"box": {"origin": [0.0, 0.0, z], "size": [1.0, 1.0, 0.2]}} for z in (0.0, 0.8)]
    time, coupling = {"end": 0.1, "dt": "auto", "integrator": "newmark"}, {"transfer": "repulsion"}
    table = {"dim": 3, "time": time, "fluid": fluid, "solids": {"body": body}, "coupling": coupling}
    with only_options(DIRECT):
        sim, momenta, met = prepared(scene_from_dict(table)), [], []
        while not sim.finished:
            sim.advance()
            momenta.append([sim.accounts.values[f"momentum.{axis}"] for axis in "xyz"])
            met.append(len(sim.couplings[0]._pairs.force))
    assert min(met) > 50 and np.abs(momenta[0]).max() > 3.0
    np.testing.assert_allclose(momenta, momenta[:1] * len(momenta), rtol=0, atol=1e-13 * 32.0)


def layer(ratio, gap, end):
    """Return an elastic layer under still water that begins ``gap`` spacings above it."""
    held = [{"where": "bottom", "fix": ["x", "y"]}, *({"where": w, "fix": ["x"]} for w in ("left", "right"))]
    shape = {"box": {"origin": [0.0, 0.0], "size": [0.5, 0.5], "cells": [4, 4]}}
    solid = {"shape": shape, "density": 1000.0 * ratio, "young": 1e6, "poisson": 0.3, "supports": held}
    solid["damping"] = {"mass": 5.0}
    probes = {"top": {"of": "layer", "at": [0.25, 0.5], "quantity": "displacement"}}
    fluid = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [0.5, 2.0], "spacing": 0.1}
    fluid |= {"sound_speed": 40.0, "artificial_viscosity": 0.3}
    fluid["sides"] = PERIODIC | {"top": "open", "bottom": "slip"}
    fluid |= {"fill": [{"box": {"origin": [0.0, 0.5 + (gap - 0.5) * 0.1], "size": [0.5, 1.0]}}]}
    time = {"end": end, "dt": "auto", "integrator": "newmark"}
    return scene_from_dict({
        "dim": 2, "time": time, "fluid": fluid, "gravity": [0.0, -9.81],
        "solids": {"layer": solid}, "probes": probes, "coupling": {"transfer": "repulsion"},
    })  # fmt: skip


@pytest.mark.parametrize("ratio, end", [(1.2, 0.6), (0.01, 2.0)])
def test_a_layer_carries_the_weight_of_still_water(ratio, end):
    """Also one whose points weigh a hundredth of a particle: on it the water bounces longer."""
    with only_options(DIRECT):
        sim, force = prepared(layer(ratio, 1.5, end)), []
        assert not sim.fluid.notes
        while not sim.finished:
            sim.advance()
            force.append(sim.couplings[0].last[:, 1].sum())
    swarm = sim.fluid.swarm
    weight = 9.81 * swarm["m"][swarm.owned].sum()
    settled = np.array(force[len(force) // 2 :])
    assert settled.mean() == pytest.approx(-weight, rel=0.01)
    assert settled.std() < 0.05 * weight
    assert sim.fluid.tally()["particles_behind"] == 0
    assert 0.12 < swarm["x"][swarm.owned, 1].min() - sim.probe()[1] - 0.5 < 0.16


def test_a_fill_that_begins_too_near_is_noted():
    with only_options(DIRECT):
        notes = prepared(layer(1.2, 0.5, 0.1)).fluid.notes
    assert len(notes) == 1 and "5 particles begin less than 0.1 m before solids" in notes[0]


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("kind, integrator", [("box", "newmark"), ("beam", "bdf2"), ("box", "symplectic-euler")])
def test_a_pushed_body_goes_on_and_on_any_ranks_alike(kind, integrator):
    one = goes_on_alike(free(kind, integrator), 1e-11)
    assert np.abs(one["repulsion_force"]).max() > 1.0
