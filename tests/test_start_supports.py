"""Bodies set off by supports that move from the first instant on: what is as good as rigid in a step goes with them."""

import numpy as np
import pytest
from load_cases import COMM
from step_cases import block, prepared
from test_start import velocities

from petfsi.scene.load import scene_from_dict
from petfsi.solving.linear import LinearSolver

IMPLICIT = ["newmark", "bdf2", "midpoint"]
RHO, STIFF, DT, SPEED, OMEGA = 1000.0, 1e14, 0.01, 1.5, 1e-3
#: Around the origin, as a prescribed displacement.
TURN = {
    "x": f"x*(cos({OMEGA}*t) - 1) - y*sin({OMEGA}*t)",
    "y": f"x*sin({OMEGA}*t) + y*(cos({OMEGA}*t) - 1)",
}


def box(dim, supports, integrator, cells=(3, 2), young=STIFF, elements="linear", velocity=None):
    """A box of 1 x 0.5 (x 0.4) m with a corner in the origin."""
    shape = {"origin": [0.0] * dim, "size": [1.0, 0.5, 0.4][:dim], "cells": [*cells, 1][:dim]}
    return scene_from_dict(
        {
            "dim": dim,
            "time": {"end": 1.0, "dt": DT, "integrator": integrator},
            "solids": {
                "b": {
                    "shape": {"box": shape}, "elements": elements, "density": RHO, "young": young, "poisson": 0.3,
                    "supports": supports, "initial": {"velocity": velocity} if velocity else {},
                }
            },
        }
    )  # fmt: skip


def beam(theory, supports, integrator):
    """A metre of .1 m thickness along x from the origin, clamped or hinged there."""
    shape = {"start": [0.0, 0.0], "end": [1.0, 0.0], "thickness": 0.1, "elements": 6, "theory": theory}
    body = {"shape": {"beam": shape}, "density": RHO, "young": STIFF, "poisson": 0.3, "supports": supports}
    time = {"end": 1.0, "dt": DT, "integrator": integrator}
    return scene_from_dict({"dim": 2, "time": time, "solids": {"b": body}})


def pushed(dim, **velocity):
    return [{"where": "left", "fix": list("xyz"[:dim]), "velocity": velocity}]


def kept(scene, kinetic, rel, steps=10):
    """Hold the kinetic energy at the start, and after every step, against its value; return the velocities then."""
    with prepared(scene, comm=COMM) as sim:
        begin = velocities(sim)
        assert len(sim.notes) == 1 and "did not fit those of supports" in sim.notes[0]
        found = [sim.accounts.values["kinetic"]]
        for _ in range(steps):
            sim.advance()
            found.append(sim.accounts.values["kinetic"])
            assert sim.accounts.values["elastic"] < rel * kinetic
        assert np.allclose(found, kinetic, rtol=rel, atol=0.0)
        return begin, velocities(sim)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", IMPLICIT)
@pytest.mark.parametrize("dim, elements", [(2, "linear"), (2, "quadratic"), (3, "quadratic")])
def test_a_stiff_body_moves_on_with_its_support(integrator, dim, elements):
    volume = [0.5, 0.2][dim - 2]
    scene = box(dim, pushed(dim, x=SPEED), integrator, elements=elements)
    both = kept(scene, 0.5 * RHO * volume * SPEED**2, rel=1e-5)
    for u in both:
        assert np.allclose(u, np.eye(dim)[0] * SPEED, atol=1e-5 * SPEED)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_stiff_body_turns_with_its_support(integrator):
    """Its left side turns about the origin: all points have omega r, and the energy is I omega^2 / 2."""
    scene = box(2, [{"where": "left", "fix": ["x", "y"], "displacement": TURN}], integrator, young=1e13)
    inertia = RHO * 0.5 * (1.0 + 0.25) / 3
    kept(scene, 0.5 * inertia * OMEGA**2, rel=5e-4)
    with prepared(scene, comm=COMM) as sim:
        x = sim.solid.reference
        assert np.allclose(sim.solid.velocity, OMEGA * np.stack((-x[:, 1], x[:, 0]), axis=1), atol=1e-4 * OMEGA)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_stiff_body_struck_at_a_point_turns_as_its_inertia_wants(integrator):
    """A point at (0, 1/4) is sent upwards: the impulse J = v / (1/m + r^2/I) leaves J v / 2."""
    point = {"box": {"origin": [-0.1, 0.2], "size": [0.2, 0.1]}}
    scene = box(2, [{"where": point, "fix": ["y"], "velocity": {"y": SPEED}}], integrator)
    m = RHO * 0.5
    impulse = SPEED / (1 / m + 0.25 * 12 / (m * (1.0 + 0.25)))
    with prepared(scene, comm=COMM) as sim:
        assert sim.accounts.values["kinetic"] == pytest.approx(0.5 * impulse * SPEED, rel=1e-5)
        assert sim.accounts.values["momentum.y"] == pytest.approx(impulse, rel=1e-5)
        assert abs(sim.accounts.values["momentum.x"]) < 1e-5 * impulse


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", IMPLICIT)
@pytest.mark.parametrize("theory", ["timoshenko", "euler-bernoulli"])
def test_a_stiff_beam_moves_on_with_its_clamp(integrator, theory):
    clamp = {"where": "start", "fix": ["x", "y", "angle"]}
    kept(beam(theory, [clamp | {"velocity": {"y": SPEED}}], integrator), 0.5 * RHO * 0.1 * SPEED**2, rel=1e-4)


@pytest.mark.parallel([1, 2])
def test_bodies_of_several_kinds_move_on_each_with_its_own_support():
    """And a third one, that nothing pushes, stays."""
    shape = {"start": [0.0, 2.0], "end": [1.0, 2.0], "thickness": 0.1, "elements": 6}
    body = {"density": RHO, "young": STIFF, "poisson": 0.3}
    still, block_ = ({"box": {"origin": [x, 0.0], "size": [1.0, 0.5], "cells": [3, 2]}} for x in (2.0, 0.0))
    clamp = [{"where": "start", "fix": ["x", "y", "angle"], "velocity": {"y": SPEED}}]
    solids = {
        "beam": body | {"shape": {"beam": shape}, "supports": clamp},
        "block": body | {"shape": block_, "supports": pushed(2, x=2 * SPEED)},
        "still": body | {"shape": still},
    }
    data = {"dim": 2, "time": {"end": 1.0, "dt": DT, "integrator": "bdf2"}, "solids": solids}
    with prepared(scene_from_dict(data), comm=COMM) as sim:
        momentum = [sim.accounts.values[f"momentum.{axis}"] for axis in "xy"]
    assert np.allclose(momentum, [RHO * 0.5 * 2 * SPEED, RHO * 0.1 * SPEED], rtol=1e-4, atol=0.0)


def test_a_thrown_body_stops_at_once_where_it_is_clamped():
    """It is the same jump: as given the first step had 1e11 J."""
    with prepared(box(2, pushed(2), "bdf2", velocity=[1.0, 0.0])) as sim:
        assert sim.accounts.values["kinetic"] < 1e-6
        sim.advance()
        assert sim.accounts.values["elastic"] < 1e-6


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_stiff_piston_takes_the_water_along(integrator):
    """It fills a channel between open sides: all that is in there moves alike."""
    water = {
        "density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 0.5], "cells": [12, 6],
        "sides": {"left": "open", "right": "open"},
    }  # fmt: skip
    shape = {"box": {"origin": [0.4, 0.0], "size": [0.23, 0.5], "cells": [3, 4]}}
    piston = {"shape": shape, "density": 3000.0, "young": 1e13, "poisson": 0.0, "supports": pushed(2, x=SPEED)}
    time = {"end": 1.0, "dt": DT, "integrator": integrator}
    scene = scene_from_dict({"dim": 2, "time": time, "fluid": water, "solids": {"piston": piston}})
    exact = 0.5 * (1000.0 * 0.77 + 3000.0 * 0.23) * 0.5 * SPEED**2
    both = kept(scene, exact, rel=1e-5)
    for u in both:
        assert np.allclose(u, [SPEED, 0.0], atol=1e-5 * SPEED)


def test_a_soft_body_is_set_off_next_to_its_support_alone():
    """Shear waves in it cross a hundredth of a cell in a step; its mass alone says what is nearest."""
    with prepared(box(2, pushed(2, y=SPEED), "bdf2", cells=(20, 2), young=1e3)) as sim:
        far = sim.solid.reference[:, 0] > 0.3
        assert np.abs(sim.solid.velocity[far]).max() < 2e-3 * SPEED
        assert np.all(sim.solid.velocity[sim.solid.reference[:, 0] == 0.0] == [0.0, SPEED])


STILL = [{"where": "left", "fix": ["x", "y"], "displacement": {"x": 0.3, "y": "0.1 + 2*t**2 + 3*t**3"}}]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    "supports, velocity, integrator",
    [
        (pushed(2), None, "bdf2"),
        (pushed(2, x="sin(t)"), None, "bdf2"),
        (pushed(2, x=SPEED), [SPEED, 0.0], "bdf2"),
        ([{"where": "left", "fix": ["x", "y"], "displacement": TURN}], [f"-{OMEGA}*y", f"{OMEGA}*x"], "bdf2"),
        (STILL, None, "midpoint"),
        (pushed(2, x=SPEED), None, "static"),
        (pushed(2, x=SPEED), None, "symplectic-euler"),
    ],
    ids=["still", "from rest", "as given", "turns as given", "displaced", "static", "explicit"],
)
def test_nothing_is_solved_where_supports_agree_with_what_is_given(supports, velocity, integrator, monkeypatch):
    """Nor where no step follows a support beyond its neighbours, or all are at rest."""

    def solve(*_):
        raise AssertionError("something was solved")

    monkeypatch.setattr(LinearSolver, "solve", solve)
    young = 1e3 if integrator == "symplectic-euler" else STIFF
    with prepared(box(2, supports, integrator, young=young, velocity=velocity), comm=COMM) as sim:
        assert not sim.notes


def test_a_displacement_given_at_the_start_stays_as_it_is():
    stretched = {"displacement": ["0.1*x", 0.0]}
    with prepared(block((4, 3), time={"integrator": "midpoint"}, initial=stretched)) as sim:
        assert np.all(sim.solid.velocity == 0.0) and not sim.notes
        assert np.allclose(sim.solid.displacement[:, 0], 0.1 * sim.solid.reference[:, 0], atol=1e-15)
