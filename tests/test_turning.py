"""Predictions that turn: exact for rotations, nothing without one, of second order, and what comes of them."""

import numpy as np
import pytest
from load_cases import COMM
from mpi4py import MPI
from scipy.spatial.transform import Rotation
from solid_cases import body, field, step, wave
from step_cases import prepared
from test_restart import goes_on

from petfsi.integrators import named
from petfsi.registry import INTEGRATORS
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Scene

ROLLER = [{"where": "left", "fix": ["x"]}]


def rotation(dim, angle):
    """Return the rotation by an angle, in 3D about an axis along no edge."""
    if dim == 2:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Rotation.from_rotvec(angle * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()


def spin(dim):
    """Return the rotation's rate, as a matrix."""
    return (rotation(dim, 1e-4) - rotation(dim, -1e-4)) / 2e-4


@pytest.fixture(params=[2, 3])
def dim(request):
    return request.param


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("elements", ["linear", "quadratic"])
@pytest.mark.parametrize("ratio", [1.0, 0.4])
def test_a_strained_body_that_turns_about_its_centre_is_predicted_exactly(dim, elements, ratio):
    solid = field(dim, COMM, integrator="bdf2", b=body(dim, elements=elements))
    mass = np.stack([solid._uniform[a][:, a] for a in range(dim)], axis=1)[:, :1]
    x = solid.reference + wave(len(solid._number), dim, size=0.02)[solid._mesh.natural[: solid._mesh.n_owned]]
    x -= COMM.allreduce((mass * x).sum(axis=0)) / COMM.allreduce(mass.sum())
    at = [x @ rotation(dim, angle).T - solid.reference for angle in (0.0, 0.2, 0.2 + 0.2 * ratio)]
    straight = at[1] + ratio * (at[1] - at[0])
    added = solid._turning.onward(at[1], at[0], ratio)
    assert COMM.allreduce(np.abs(at[2] - straight).max(initial=0.0), MPI.MAX) > 1e-3
    np.testing.assert_allclose(straight + added, at[2], atol=1e-13)
    # from a velocity, the way of a steady rotation by Cayley's map
    omega, h = spin(dim), 0.2
    cayley = np.linalg.solve(np.eye(dim) - h / 2 * omega, np.eye(dim) + h / 2 * omega)
    there = x @ cayley.T - solid.reference
    d, u = x - solid.reference, x @ omega.T
    np.testing.assert_allclose(d + solid._turning.in_place(d, u, h), there, atol=1e-9)
    np.testing.assert_allclose(d + h * u + solid._turning.setting_out(d, u, h), there, atol=1e-9)


@pytest.mark.parallel([1, 2])
def test_a_body_that_is_held_turns_about_what_holds_it(dim):
    """A corner, or in 3D the edge above it, stays; the other nodes go on around it."""
    edge = {"box": {"origin": [-0.1] * dim, "size": [0.2, 0.2, 2.0][:dim]}}
    solid = field(dim, COMM, integrator="bdf2", b=body(dim, supports=[{"where": edge, "fix": ["x", "y", "z"][:dim]}]))
    x = solid.reference
    at = [x @ np.pad(rotation(2, angle), (0, dim - 2)).T - x for angle in (0.0, 0.1, 0.2)]
    for d in at:
        d[:, 2:] = 0.0
    added = solid._turning.onward(at[1], at[0], 1.0)
    np.testing.assert_allclose(2 * at[1] - at[0] + added, at[2], atol=1e-13)


@pytest.mark.parallel([1, 2])
def test_what_does_not_turn_is_predicted_as_ever(dim):
    solid = field(dim, COMM, integrator="bdf2", b=body(dim))
    x = solid.reference
    pull = np.array([[0.3, 0.1, -0.1], [0.1, -0.2, 0.05], [-0.1, 0.05, 0.1]])[:dim, :dim]
    for d in (np.tile([0.3, -0.2, 0.7][:dim], (len(x), 1)), x @ pull):
        assert np.abs(solid._turning.onward(d, -d, 1.0)).max(initial=0.0) < 1e-14
        assert np.abs(solid._turning.setting_out(0 * x, d, 0.1)).max(initial=0.0) < 1e-14
        assert np.abs(solid._turning.in_place(0 * x, d, 0.1)).max(initial=0.0) < 1e-14


def test_a_material_that_minds_being_turned_is_left_alone():
    solid = field(2, COMM, integrator="bdf2", b=body(2, material="linear"))
    assert solid._turning is None
    both = {"a": body(2, material="linear"), "b": body(2, origin=(3.0, 0.0))}
    solid = field(2, COMM, integrator="bdf2", **both)
    x = solid.reference
    turned = [x @ rotation(2, angle).T - x for angle in (0.0, 0.1)]
    added = solid._turning.onward(turned[1], turned[0], 1.0)
    assert np.all(added[x[:, 0] < 2] == 0.0) and np.abs(added[x[:, 0] > 2]).max() > 1e-4


def test_parts_that_turn_each_in_their_own_way_are_predicted_without_strain():
    """A strip that rolls up: its axis keeps its length, and every element turns by another angle."""
    solid = field(2, COMM, integrator="bdf2", b=body(2, cells=(60, 2), size=(6.0, 0.1)))
    s, z = solid.reference[:, 0], solid.reference[:, 1] - 0.05

    def rolled(curvature):
        angle = curvature * s
        centre = np.column_stack((np.sin(angle), 1 - np.cos(angle))) / curvature
        return centre + z[:, None] * np.column_stack((-np.sin(angle), np.cos(angle))) - solid.reference

    now, before, wanted = rolled(0.6), rolled(0.57), rolled(0.63)

    def strain(d):
        axis = np.flatnonzero(np.abs(z) < 1e-12)
        axis = axis[np.argsort(s[axis])]
        length = np.linalg.norm(np.diff((solid.reference + d)[axis], axis=0), axis=1)
        exact = np.linalg.norm(np.diff((solid.reference + wanted)[axis], axis=0), axis=1)
        return np.abs(length / exact - 1).max()

    straight = 2 * now - before
    turned = straight + solid._turning.onward(now, before, 1.0)
    assert strain(straight) > 0.01
    assert strain(turned) < 2e-5


# ---- steps ----------------------------------------------------------------------------------------------------


def flying(integrator, dt, young=1e3, spin=3.0, **more):
    """A soft block that spins and swings."""
    box = {"box": {"origin": [-0.2, -0.1], "size": [0.4, 0.2], "cells": [6, 3]}}
    start = {"velocity": [f"-{spin}*y + 0.5*x", f"{spin}*x - 0.2*y"]}
    solid = {"shape": box, "density": 10.0, "young": young, "poisson": 0.3, "initial": start} | more
    return Scene.model_validate(
        {"dim": 2, "time": {"end": 0.4, "dt": dt, "integrator": integrator}, "solids": {"block": solid}}
    )


def at_the_end(data):
    with prepared(data) as sim:
        while not sim.finished:
            sim.advance()
        return sim.solid.displacement.copy(), sim


@pytest.mark.parametrize("integrator, order", [("newmark", 1), ("bdf2", 2), ("midpoint", 2)])
def test_schemes_keep_their_order_where_bodies_turn(integrator, order):
    ways = [at_the_end(flying(integrator, 0.01 / 2**n, young=30.0))[0] for n in range(4)]
    gaps = [np.abs(a - b).max() for a, b in zip(ways[:-1], ways[1:], strict=True)]
    seen = np.log2(np.array(gaps[:-1]) / gaps[1:])
    assert seen[-1] == pytest.approx(order, abs=0.25), seen


@pytest.mark.parametrize(
    "integrator, angle, energy, elastic",
    [("newmark", 0.08, 0.1, 1e-4), ("bdf2", 0.01, 0.005, 1e-4), ("midpoint", 1e-3, 0.006, 5e-3)],
)
def test_a_stiff_block_goes_on_turning(integrator, angle, energy, elastic):
    """By 3 rad in a second; straight predictions of 10 ms lose a third of the angle, and newmark nearly all energy."""
    size = {"origin": [-0.1, -0.2, -0.3], "size": [0.2, 0.4, 0.6], "cells": [2, 3, 4]}
    block = {"shape": {"box": size}, "density": 1000.0, "young": 1e7, "poisson": 0.3}
    block["initial"] = {"velocity": ["-3*y", "3*x", 0]}
    data = {"dim": 3, "time": {"end": 1.0, "dt": 0.01, "integrator": integrator}, "solids": {"block": block}}
    d, sim = at_the_end(scene_from_dict(data))
    x = sim.solid.reference
    moment = (x + d).T @ x
    u, _, v = np.linalg.svd(moment)
    turned = u @ v
    assert np.arctan2(turned[1, 0], turned[0, 0]) == pytest.approx(3.0, abs=angle)
    values = sim.accounts.values
    first = values["kinetic"] + values["elastic"] - values["energy_residual"]
    assert first == pytest.approx(0.5 * 48 * 9 * 0.2 / 12, rel=0.03)  # the mesh has a smaller I
    assert values["kinetic"] == pytest.approx(first, rel=energy)
    assert values["elastic"] < elastic * values["kinetic"]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_a_stiff_beam_spins_about_its_end(integrator):
    beam = {"beam": {"start": [0.0, 0.0], "end": [1.0, 0.0], "thickness": 0.02, "elements": 6}}
    hinge = [{"where": "start", "fix": ["x", "y"]}]
    rod = {"shape": beam, "density": 1000.0, "young": 1e9, "poisson": 0.3, "supports": hinge}
    rod["initial"] = {"velocity": [0.0, "2*x", 2.0]}
    data = {"dim": 2, "time": {"end": 1.0, "dt": 0.02, "integrator": integrator}, "solids": {"rod": rod}}
    with prepared(scene_from_dict(data)) as sim:
        first = sim.accounts.values["kinetic"]
        for _ in range(50):
            sim.advance()
        got = sim.accounts.values
        assert got["elastic"] < 1e-4 * first
        assert got["kinetic"] == pytest.approx(first, rel={"newmark": 0.08, "bdf2": 0.01}[integrator])
        tip = np.array([1.0, 0.0]) + sim.solid.probe("rod", [1.0, 0.0], "displacement")
        assert np.linalg.norm(tip) == pytest.approx(1.0, abs=1e-4)
        assert np.arctan2(tip[1], tip[0]) == pytest.approx(2.0, abs={"newmark": 0.05, "bdf2": 0.01}[integrator])


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_a_body_that_turns_goes_on_from_a_checkpoint(integrator):
    goes_on(flying(integrator, "(1 + 0.4*sin(20*t))/50", young=1e5))


def disk(young, dt):
    """A disk that turns once a second."""
    ball = {"ball": {"centre": [0.5, 0.5], "radius": 0.2, "cells": 6}}
    solid = {"shape": ball, "density": 1.0, "young": young, "poisson": 0.3}
    solid["initial"] = {"velocity": ["-2*pi*(y - 0.5)", "2*pi*(x - 0.5)"]}
    return scene_from_dict(
        {"dim": 2, "time": {"end": 1.0, "dt": dt, "integrator": "midpoint"}, "solids": {"disk": solid}}
    )


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    "young, dt, warns", [(1e3, 0.01, False), (1e4, 0.01, True), (1e5, 0.0025, False), (1e6, 0.005, True)]
)
def test_midpoint_warns_of_a_body_too_stiff_for_its_turning(young, dt, warns):
    """And only then: without a warning the energy stays within 2% for half a turn."""
    told = []
    with prepared(disk(young, dt)) as sim:
        sim.report = told.append
        first, most = sim.accounts.values["kinetic"], 0.0
        for _ in range(3 if warns else round(0.5 / dt)):
            sim.advance()
            most = max(most, abs(sim.accounts.values["kinetic"] + sim.accounts.values["elastic"] - first) / first)
    assert len(told) == warns, told
    assert warns or most < 0.02
    if warns:
        assert "solids.disk turns by" in told[0] and "bdf2" in told[0]


def test_every_scheme_says_what_turning_adds():
    solid = field(2, b=body(2))
    for name in INTEGRATORS:
        scheme, motion = named(name), solid._motion()
        added = scheme.turned(motion, 0.1, solid._turning)
        assert (added is None) == (name in ("midpoint", "symplectic-euler", "static"))
    step(solid, 0.0, 0.1)
