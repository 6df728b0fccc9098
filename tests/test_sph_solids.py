"""Particles beside solids: an exact frequency, momentum, light bodies, ranks and restart. About 10 s."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.optimize import brentq
from test_sph import Stored, whole

from petfsi.bench.case import only_options
from petfsi.scene.load import scene_from_dict
from petfsi.simulation import Simulation

DIRECT = ["-options_file", "monolithic-direct.opts"]
PERIODIC = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")
RHO, SOUND = 1000.0, 100.0
#: The elastic layer: its thickness, the water's height above it, both m, and its P-wave modulus over Young's.
LAYER, WATER, MODULUS = 0.5, 1.5, 0.7 / (1.3 * 0.4)


def prepared(scene, comm=MPI.COMM_WORLD):
    sim = Simulation(comm, scene)
    sim.prepare()
    return sim


def layer(n, ratio, integrator, end):
    """Return an elastic layer under a column of water that is set going in its first mode, n particles a metre."""
    held = [{"where": "bottom", "fix": ["x", "y"]}, *({"where": w, "fix": ["x"]} for w in ("left", "right"))]
    shape = {"box": {"origin": [0.0, 0.0], "size": [0.5, LAYER], "cells": [8, 8]}}
    solid = {"shape": shape, "density": RHO * ratio, "young": 1e5, "poisson": 0.3, "supports": held}
    solid["initial"] = {"velocity": ["0.0", f"1e-3*sin(pi*y/{2 * LAYER})"]}
    fluid = {"kind": "sph", "density": RHO, "origin": [0.0, 0.0], "size": [0.5, 2.3], "spacing": 1 / n}
    # nothing weighs on the layer, so half of the time it draws
    fluid |= {"sound_speed": SOUND, "artificial_viscosity": 0.0, "suction": True, "sides": {"top": "open"}}
    fluid |= {"fill": [{"box": {"origin": [0.0, LAYER], "size": [0.5, WATER]}}]}
    fluid |= {"initial": {"velocity": ["0.0", "1e-3"]}}
    probes = {"top": {"of": "layer", "at": [0.25, LAYER], "quantity": "displacement"}}
    time = {"end": end, "dt": "auto", "integrator": integrator}
    return scene_from_dict({"dim": 2, "time": time, "fluid": fluid, "solids": {"layer": solid}, "probes": probes})


def exact(ratio):
    """Return the first angular frequency of layer and column, both of them elastic in one dimension."""
    speed = np.sqrt(MODULUS * 1e5 / (RHO * ratio))

    def balance(w):
        return RHO * ratio * speed / np.tan(w * LAYER / speed) - RHO * SOUND * np.tan(w * WATER / SOUND)

    return brentq(balance, 1e-3, 0.999 * np.pi / 2 * min(SOUND / WATER, speed / LAYER))


def frequency(scene):
    """Return the angular frequency of the layer's top, and the ratio of its last extremum to the first."""
    with only_options(DIRECT):
        sim, t, y = prepared(scene), [], []
        while not sim.finished:
            sim.advance()
            t.append(sim.time)
            y.append(sim.probe()[1])
    t, y = np.array(t), np.array(y)
    k = np.flatnonzero(np.diff(np.sign(y)))
    zeros = t[k] - y[k] * (t[k + 1] - t[k]) / (y[k + 1] - y[k])
    peaks = [np.abs(y[a:b]).max() for a, b in zip(k[:-1], k[1:], strict=True)]
    return np.pi * (len(zeros) - 1) / (zeros[-1] - zeros[0]), peaks[-1] / peaks[0]


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_layer_under_water_swings_with_its_frequency(integrator):
    """Its error is of first order in the spacing: half a row's mass is missing at the wall."""
    w, left = frequency(layer(10, 1.2, integrator, 0.8))
    assert w == pytest.approx(exact(1.2), rel=0.05)
    assert 0.95 < left < 1.02


@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
@pytest.mark.parametrize("ratio", [0.1, 0.001])
def test_a_light_layer_under_water_stays(ratio, integrator):
    w, left = frequency(layer(10, ratio, integrator, 0.6))
    assert w == pytest.approx(exact(ratio), rel=0.06)
    assert 0.9 < left < 1.02


def free(kind, integrator, end=0.1):
    """Return a body that flies and turns through a periodic sea."""
    box = {"box": {"origin": [0.35, 0.4], "size": [0.3, 0.2], "cells": [6, 4]}}
    beam = {"beam": {"start": [0.3, 0.52], "end": [0.7, 0.47], "thickness": 0.02, "elements": 8}}
    body = {"shape": box if kind == "box" else beam, "young": 1e4 if kind == "box" else 1e6}
    body |= {"density": 500.0, "poisson": 0.3, "initial": {"velocity": ["0.3 + 0.5*(y - 0.5)", "-0.5*(x - 0.5)"]}}
    if kind == "beam":
        body["initial"] = {"velocity": ["0.1", "0.3"]}
    fluid = {
        "kind": "sph",
        "density": RHO,
        "origin": [0.0, 0.0],
        "size": [1.0, 1.0],
        "spacing": 0.05,
        "sides": PERIODIC,
    }
    fluid |= {"sound_speed": 10.0, "fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, 1.0]}}]}
    time = {"end": end, "dt": "auto", "integrator": integrator}
    return scene_from_dict({"dim": 2, "time": time, "fluid": fluid, "solids": {"body": body}})


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    "kind, integrator",
    [("box", "newmark"), ("beam", "newmark"), ("box", "bdf2"), ("beam", "bdf2"), ("box", "symplectic-euler")],
)
def test_a_free_body_and_the_fluid_keep_their_momentum_to_round_off(kind, integrator):
    with only_options(DIRECT):
        sim = prepared(free(kind, integrator, 0.03 if integrator == "symplectic-euler" else 0.1))
        first = None
        while not sim.finished:
            sim.advance()
            now = np.array([sim.accounts.values[f"momentum.{axis}"] for axis in "xy"])
            first = now if first is None else first
            assert np.abs(now - first).max() < 1e-13 * 30.0
    assert np.abs(first).max() > 0.1


def goes_on_alike(scene, slack_v):
    """See that a run that is resumed, and one on all ranks, end as one on one rank does; return that one's state.

    Resumed on one rank bit for bit; MUMPS' sums in another order are all that ranks change.
    """
    with only_options(DIRECT):
        straight = prepared(scene, MPI.COMM_SELF)
        for _ in range(6):
            straight.advance()
        stored, at = Stored(straight), (straight.step, straight.time, straight.dt)
        straight.forget()
        resumed, other = prepared(scene), prepared(scene)
        resumed.forget()
        resumed.restore(*at, stored.group)
        for _ in range(6):
            straight.advance()
            resumed.advance()
        for _ in range(6):
            other.advance()
        other.forget()  # which particles a thin body hides from others is asked when pairs are listed
        for _ in range(6):
            other.advance()
    one = whole(straight)
    for name, slack in (("x", 1e-13), ("v", slack_v), ("rho", 1e-9)):
        np.testing.assert_allclose(whole(other)[name], one[name], rtol=0, atol=slack)
        atol = 0 if MPI.COMM_WORLD.size == 1 else slack
        np.testing.assert_allclose(whole(resumed)[name], one[name], rtol=0, atol=atol)
    return one


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("kind, integrator", [("box", "newmark"), ("beam", "bdf2"), ("beam", "midpoint")])
def test_a_body_among_particles_goes_on_and_on_any_ranks_alike(kind, integrator):
    goes_on_alike(free(kind, integrator), 1e-12)
