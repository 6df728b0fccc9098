"""Tolerances where the right-hand side vanishes, and numbers that are none: rest is rest, and the rest has a name."""

import numpy as np
import pytest
from step_cases import prepared

from petfsi.errors import InputError, SolveError
from petfsi.scene.schema import Scene

LEFT = [{"where": "left", "fix": ["x", "y"]}]
HELD = [{"where": "all", "fix": ["x", "y"]}]


def water(**more):
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16], "sides": {"top": "open"}}
    return fluid | more


def box(**more):
    shape = {"box": {"origin": [0.31, 0.23], "size": [0.3, 0.2], "cells": [3, 2]}}
    return {"shape": shape, "density": 1200.0, "young": 1e5, "poisson": 0.3} | more


def beam(**more):
    shape = {"beam": {"start": [0.3, 0.6], "end": [0.7, 0.6], "thickness": 0.05, "elements": 4}}
    return {"shape": shape, "density": 1200.0, "young": 1e5, "poisson": 0.3} | more


def scene(fluid, solids, integrator="bdf2", gravity=(0.0, -9.81), retries=0, dt=0.01, **more):
    time = {"end": 1.0, "dt": dt, "integrator": integrator, "retries": retries}
    data = {"dim": 2, "time": time, "gravity": list(gravity), "solids": solids, "fluid": fluid}
    return Scene.model_validate({key: value for key, value in data.items() if value is not None} | more)


# ---- the floor ----------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_still_water_around_a_held_box_is_still(integrator):
    """The right-hand side vanishes: the weight of water at rest is split off, and its first guess is round-off."""
    with prepared(scene(water(), {"b": box(supports=HELD)}, integrator)) as sim:
        for _ in range(4):
            sim.advance()
            assert sim.outcome.iterations == 0 or sim.step == 1
            assert max(float(np.abs(v).max()) for v in sim.fluid.velocity) == 0.0
        assert sim.fluid.probe("pressure", [0.5, 0.1]) == pytest.approx(8829.0, rel=1e-12)


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_stiff_body_rests_however_stiff_it_is(integrator):
    """A disk as heavy as water is squeezed in proportion to 1/E, though round-off of A w is up to a millionth of b."""
    squeezed = []
    for young in (1e7, 1e10, 1e12, 1e13):
        ball = {"ball": {"centre": [0.513, 0.471], "radius": 0.17, "cells": 8}}
        with prepared(scene(water(), {"b": box(shape=ball, density=1000.0, young=young)}, integrator)) as sim:
            for _ in range(10):
                sim.advance()
                assert sim.outcome.residual < 1e-8
            squeezed.append(young * float(np.abs(sim.solid.displacement).max()))
    if integrator == "midpoint":  # it rings, faster than the step
        assert max(squeezed) < 1.1 * squeezed[0]
    else:
        assert squeezed == pytest.approx([squeezed[0]] * 4, rel=0.01)


@pytest.mark.parametrize("options", [(), ("-fsi_snes_type", "newtonls"), ("-options_file", "monolithic-direct.opts")])
def test_a_motion_far_below_the_weight_is_solved_as_well_as_any(options):
    """The pressure of water at rest is 1e16 times that of the motion, and not part of what is solved for."""
    speeds = []
    for size in (1e-6, 1e-12, 1e-18):
        start = {"velocity": [f"{size}*sin(pi*x)*cos(pi*y)", f"-{size}*cos(pi*x)*sin(pi*y)"]}
        with prepared(scene(water(initial=start), {"b": box(supports=HELD)}), *options) as sim:
            for _ in range(3):
                sim.advance()
            speeds.append(np.concatenate([v.ravel() for v in sim.fluid.velocity]) / size)
    for speed in speeds[1:]:
        np.testing.assert_allclose(speed, speeds[0], atol=1e-6 * np.abs(speeds[0]).max())


@pytest.mark.parametrize("fluid", [water(), None], ids=["wet", "dry"])
def test_a_body_beyond_double_precision_is_no_round_off(fluid):
    """Against such a stiffness a mass is nothing: the body would hang where it is, and the floor must not let it."""
    with prepared(scene(fluid, {"b": box(young=1e60)})) as sim, pytest.raises(SolveError, match="Round-off alone"):
        for _ in range(3):
            sim.advance()


# ---- what is no number --------------------------------------------------------------------------------------

PRESSED = {"where": "right", "pressure": "1e7*t/.01"}
#: Scenes that blow up in the first steps, with options: none may end but by an error that says so.
MONSTERS = {
    "speed": scene(water(), {"b": box(initial={"velocity": [1e12, 0.0]})}),
    "more speed": scene(water(), {"b": box(initial={"velocity": [1e308, 0.0]})}, "newmark"),
    "speed, three times": scene(water(), {"b": box(initial={"velocity": [0.0, 1e200]})}, "midpoint", retries=2),
    "speed of half of it": scene(water(), {"b": box(initial={"velocity": ["where(x>.5,1e300,0)", 0.0]})}, "newmark"),
    "dry speed": scene(None, {"b": box(initial={"velocity": [1e308, "x*1e300"]})}),
    "turn of a beam": scene(water(), {"b": beam(initial={"velocity": [0.0, 0.0, 1e308]})}),
    "speed of a beam": scene(water(), {"b": beam(initial={"velocity": [0.0, 1e150]}), "c": box()}, "midpoint"),
    "ray": scene(water(), {"b": box(initial={"velocity": [1e150, 0.0]})}, coupling={"transfer": "ray"}),
    "explicit": scene(water(), {"b": box(initial={"velocity": [1e308, 0.0]})}, "symplectic-euler", dt=1e-4),
    "flow": scene(water(initial={"velocity": [1e200, 0.0]}), {"b": box()}),
    "inflow": scene(water(sides={"left": {"inflow": {"speed": 1e308}}, "right": "open"}), {"b": box(supports=LEFT)}),
    "weight": scene(water(), {"b": box()}, gravity=[0.0, -1e300]),
    "load": scene(water(), {"b": box(supports=LEFT, loads=[{"where": "right", "traction": [0.0, 1e300]}])}),
    "pressed flat": scene(
        water(), {"b": box(supports=LEFT, material="neohookean", poisson=0.45, loads=[PRESSED])}, retries=2
    ),
    "static load": scene(
        None, {"b": box(supports=LEFT, material="neohookean", loads=[{"where": "right", "traction": [-1e300, 0]}])},
        "static",
    ),
    "support": scene(water(), {"b": box(supports=[LEFT[0] | {"velocity": {"x": 1e300}}])}),
    "way": scene(water(), {"b": box(supports=[LEFT[0] | {"displacement": {"x": "t*1e300"}}])}),
    "far off": scene(water(), {"b": box(initial={"displacement": [1e300, 0.0]})}),
    "held far off": scene(water(), {"b": box(supports=[LEFT[0] | {"displacement": {"x": 1e300}}])}),
    "heavy": scene(water(), {"b": box(density=1e300)}),
    "light": scene(None, {"b": box(density=1e-300)}),
    "nothing": scene(water(), {"b": box(density=5e-324)}),
    "heavy water": scene(water(density=1e150), {"b": box()}),
    "light water": scene(water(density=1e-300), {"b": box()}),
    "stiff": scene(water(), {"b": beam(young=1e308, supports=[{"where": "start", "fix": ["x", "y", "angle"]}])}),
}  # fmt: skip


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("options", [(), ("-fsi_snes_type", "newtonls")], ids=["once", "newton"])
def test_what_is_beyond_numbers_ends_by_name(options):
    for name, monster in MONSTERS.items():
        if options and monster.time.integrator == "symplectic-euler":
            continue
        with np.errstate(all="ignore"), pytest.raises((SolveError, InputError)) as found:  # noqa: SIM117
            with prepared(monster, *options) as sim:
                for _ in range(6):
                    sim.advance()
        assert len(str(found.value)) > 20, name
