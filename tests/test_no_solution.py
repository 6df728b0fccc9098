"""Steps whose equations have no solution are named as such, and no others: closed regions, and statics. About 15 s."""

import re

import numpy as np
import pytest
from mpi4py import MPI
from step_cases import prepared

from petfsi.errors import InputError, NoSolutionError, SolveError
from petfsi.runs.ready import made_ready
from petfsi.scene.schema import Scene

# ---- flows that have nowhere to go --------------------------------------------------------------------------

PLUG = {"plug": {"shape": {"box": {"origin": [0.41, -0.1], "size": [0.2, 0.6]}}}}
#: A wall with a hole from y = .15 to .25, along which a block slides that covers it after .11 s.
HOLE = {
    "below": {"shape": {"box": {"origin": [0.5, -0.1], "size": [0.1, 0.25]}}},
    "above": {"shape": {"box": {"origin": [0.5, 0.25], "size": [0.1, 0.25]}}},
}
#: Turns about (.5, .2) by 8 rad/s.
TURN = {"x": "(x-.5)*(cos(8*t)-1)-(y-.2)*sin(8*t)", "y": "(x-.5)*sin(8*t)+(y-.2)*(cos(8*t)-1)"}
ENDS = [{"where": where, "fix": ["x", "y", "angle"]} for where in ("start", "end")]


def flow(sides, solids=None, obstacles=None, integrator="bdf2", dim=2, dt=0.01, **more):
    size, cells = ([1.0, 0.4], [18, 8]) if dim == 2 else ([1.0, 0.4, 0.4], [18, 4, 4])
    fluid = {"density": 1000.0, "origin": [0.0] * dim, "size": size, "cells": cells, "sides": sides}
    time = {"end": 0.5, "dt": dt, "integrator": integrator}
    scene = {"dim": dim, "time": time, "fluid": fluid, "solids": solids or {}, "obstacles": obstacles or {}}
    return Scene.model_validate(scene | more)


def jet(speed, **more):
    return {"inflow": {"speed": speed, **more}}


def held(**motion):
    return [{"where": "all", "fix": ["x", "y"], **motion}]


def body(shape, supports=()):
    return {"shape": shape, "density": 1200.0, "young": 1e5, "poisson": 0.3, "supports": list(supports)}


def box(origin, size, supports=()):
    return body({"box": {"origin": origin, "size": size, "cells": [2] * len(size)}}, supports)


def disk(**motion):
    return body({"ball": {"centre": [0.5, 0.2], "radius": 0.11, "cells": 4}}, held(**motion))


def wall():
    return body({"beam": {"start": [0.5, 0.0], "end": [0.5, 0.4], "thickness": 0.03, "elements": 4}}, ENDS)


def piston(**motion):
    return box([0.0, 0.0], [0.3, 0.4], held(**motion))


#: Scenes, and what is said of each before anything is written.
BLOCKED = {
    "as it grows": (flow({"left": jet("0.2*t"), "right": "open"}, None, PLUG), "left.inflow +0.0008 m^2/s"),
    "ray": (
        flow({"left": jet("0.2*t"), "right": "open"}, None, PLUG, coupling={"transfer": "ray"}),
        "the fluid in x 0 to 0.3889, y 0 to 0.4 m is closed",
    ),
    "newmark": (flow({"left": jet(0.2), "right": "open"}, None, PLUG, "newmark"), "take up 0.08 m^2/s"),
    "midpoint": (flow({"left": jet("0.2*t"), "right": "open"}, None, PLUG, "midpoint"), "take up 0.0004 m^2/s"),
    "drained": (flow({"left": jet(-0.2), "right": "open"}, None, PLUG), "give off 0.08 m^2/s"),
    "more in than out": (
        flow({"left": jet(0.2), "right": jet(-0.1)}),
        "sides.left.inflow +0.08, fluid.sides.right.inflow -0.04 m^2/s",
    ),
    "two in": (flow({"left": jet(0.2), "top": jet(0.1)}), "take up 0.18 m^2/s"),
    "almost": (flow({"left": jet(0.2), "right": jet(-0.2 * (1 + 1e-6))}), "give off 8e-08 m^2/s"),
    "part of a side": (
        flow({"left": jet(0.1, region={"ball": {"centre": [0.0, 0.2], "radius": 0.11}}), "right": "open"}, None, PLUG),
        "take up 0.022 m^2/s",
    ),
    "periodic": (flow({"left": "periodic", "right": "periodic", "bottom": jet(0.1)}, {"d": disk()}), "take up 0.1 m"),
    "held plug": (
        flow({"left": jet(0.2), "right": "open"}, {"p": box([0.41, 0.0], [0.2, 0.4], held())}),
        "left.inflow +0.08 m^2/s",
    ),
    "behind a beam": (flow({"left": jet(0.1)}, {"b": wall()}), "x 0 to 1, y 0 to 0.4 m is closed"),
    "piston": (flow({}, {"p": piston(velocity={"x": 0.1})}), "solids.p.supports +0.04 m^2/s"),
    "piston by its way": (flow({}, {"p": piston(displacement={"x": "0.1*t"})}), "x 0.2778 to 1, y 0 to 0.4 m"),
    "piston before a plug": (
        flow({"right": "open"}, {"p": box([0.0, 0.0], [0.1, 0.4], held(velocity={"x": 0.1}))}, PLUG),
        "solids.p.supports +0.04 m^2/s",
    ),
    "swelling": (flow({}, {"d": disk(velocity={"x": "(x-.5)*.1", "y": "(y-.2)*.1"})}), "solids.d.supports +0.0074"),
    "one of two": (
        flow({}, {"p": piston(velocity={"x": 0.1}), "d": box([0.6, 0.1], [0.1, 0.1], held(velocity={"x": -0.1}))}),
        "petfsi: solids.p.supports +0.04 m^2/s: what",
    ),
    "plug in 3D": (
        flow(
            {"left": jet("0.2*t"), "right": "open"},
            None,
            {"plug": {"shape": {"box": {"origin": [0.41, -0.1, -0.1], "size": [0.2, 0.6, 0.6]}}}},
            dim=3,
        ),
        "left.inflow +0.00032 m^3/s",
    ),
    "piston in 3D": (
        flow(
            {},
            {"p": box([0.0] * 3, [0.3, 0.4, 0.4], [{"where": "all", "fix": ["x", "y", "z"], "velocity": {"x": 0.1}}])},
            dim=3,
        ),
        "solids.p.supports +0.016 m^3/s",
    ),
}


@pytest.mark.parametrize("name", BLOCKED)
def test_what_cannot_leave_is_named_before_anything_is_written(name):
    scene, said = BLOCKED[name]
    with pytest.raises(InputError) as found, prepared(scene):
        pass
    assert said.removeprefix("petfsi: ") in str(found.value)
    assert not said.startswith("petfsi: ") or str(found.value).startswith(said.removeprefix("petfsi: "))


@pytest.mark.parametrize("options", ["split.opts", "split-iterated.opts", "monolithic-direct.opts"])
def test_whatever_the_solver(options):
    scene, said = BLOCKED["held plug"]
    with pytest.raises(InputError, match="does not balance"), prepared(scene, "-options_file", options):
        pass


#: What closes, or opens, only later; and in which step that shows.
LATER = {
    "jet": (flow({"left": jet("where(t<0.025,0,1)"), "right": "open"}, None, PLUG), 3, "left.inflow +0.4 m^2/s"),
    "piston": (flow({}, {"p": piston(velocity={"x": "where(t<0.025,0,.1)"})}), 3, "solids.p.supports +0.04 m^2/s"),
    "the hole is covered": (
        flow(
            {"left": jet(0.1), "right": "open"}, {"p": box([0.4, 0.26], [0.1, 0.12], held(velocity={"y": -1.0}))}, HOLE,
            dt=0.02,
        ),
        None,
        "left.inflow +0.04",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LATER)
def test_what_can_leave_no_longer_fails_the_step_at_once(name):
    scene, step, said = LATER[name]
    with prepared(scene) as sim:
        told = []
        sim.report = told.append
        with pytest.raises(NoSolutionError) as found:
            for _ in range(8):
                sim.advance()
    assert said in str(found.value) and not any("two halves" in text for text in told)
    assert step is None or sim.step == step - 1


@pytest.mark.parametrize(
    ("sides", "said"),
    [({"left": jet(1.0), "right": jet(1.0)}, "sides.left.inflow +0.4, fluid.sides.right.inflow +0.4 m^2/s"),
     ({"left": jet(1.0)}, "sides.left.inflow +0.4 m^2/s")],
)  # fmt: skip
def test_what_only_solids_give_way_to_is_named_where_a_step_fails(sides, said):
    scene = flow(sides, {"b": box([0.4, 0.1], [0.2, 0.2])}, dt=0.01)
    with prepared(scene) as sim, pytest.raises(SolveError, match=r"solids alone give way to what comes in") as found:
        for _ in range(20):
            sim.advance()
    told = str(found.value)
    assert said in told and "Let as much out as in, or open a side. The step failed of it: s" in told
    assert 0 < float(re.search(r"solids.b has (\S+) times the volume that it has at rest", told)[1]) < 0.9


#: What balances, or what something gives way to.
SOUND = {
    "through": flow({"left": jet(0.2), "right": jet(-0.2)}),
    "across": flow({"left": jet(0.2), "top": jet(-0.08)}, None, None, "midpoint"),
    "almost through": flow({"left": jet(0.2), "right": jet(-0.2 * (1 + 1e-12))}),
    "pushed and pulled as a jet goes": flow(
        {"left": jet("0.1*sin(20*t)"), "right": jet("-0.1*sin(20*t)")},
        {"p": box([0.4, 0.0], [0.2, 0.4], held(velocity={"x": "0.1*sin(20*t)"}))},
        None,
        "midpoint",
    ),
    "open": flow({"left": jet(0.2), "right": "open"}, {"d": disk()}),
    "a body that moves": flow({}, {"p": box([0.3, 0.1], [0.3, 0.2], held(velocity={"x": 0.1}))}),
    "swelling": flow({"top": "open"}, {"d": disk(velocity={"x": "(x-.5)*.1", "y": "(y-.2)*.1"})}),
    "beside what yields": flow(
        {}, {"d": disk(velocity={"x": "(x-.5)*.1", "y": "(y-.2)*.1"}), "f": box([0.1, 0.1], [0.1, 0.1])}
    ),
    "plug that yields": flow(
        {"left": jet("0.2*t"), "right": "open"},
        {"p": box([0.41, 0.0], [0.2, 0.4], [{"where": w, "fix": ["x", "y"]} for w in ("bottom", "top")])},
    ),
    "beam between": flow({"left": jet(0.1), "right": jet(-0.1)}, {"b": wall()}),
    "disk that turns": flow({}, {"d": disk(displacement=TURN)}),
    "box that turns": flow({}, {"p": box([0.4, 0.15], [0.2, 0.1], held(displacement=TURN))}, None, "newmark"),
    "middle of a turn": flow({}, {"p": box([0.4, 0.15], [0.2, 0.1], held(displacement=TURN))}, None, "midpoint"),
    "turn, push and pull": flow({"left": jet(0.2), "right": jet(-0.2)}, {"d": disk(displacement=TURN)}),
}


@pytest.mark.parametrize("name", SOUND)
def test_what_balances_is_solved(name):
    with prepared(SOUND[name]) as sim:
        for _ in range(3):
            sim.advance()
            assert sim.divergence() < 0.2, "of what made up for a turn, some h omega^2 R at first"
        assert sim.outcome.residual < 1e-8


def test_what_makes_up_for_a_turn_shrinks_with_the_step():
    """The velocity of BDF2 is off by h^2/3 of the third derivative, which lies along the turn; the next term not."""
    left = []
    for dt in (0.02, 0.01, 0.005):
        with prepared(flow({}, {"d": disk(displacement=TURN)}, dt=dt)) as sim:
            for _ in range(round(0.04 / dt)):
                sim.advance()
            left.append(abs(float(sim.fluid.source.sum())))
    order = np.diff(np.log(left)) / np.diff(np.log([0.02, 0.01, 0.005]))
    assert order[-1] == pytest.approx(3.0, abs=0.2) and left[0] < 0.02


# ---- what nothing holds in statics --------------------------------------------------------------------------

BEAM = {"start": [0.0, 0.0], "end": [2.0, 0.0], "thickness": 0.1, "elements": 4}
UP = [{"where": "right", "traction": [1.0, 0.5]}]
NO_ANGLE = [{"where": "start", "fix": ["x", "y"]}]


def solid(supports, shape, loads=()):
    return {"shape": shape, "density": 1.0, "young": 1e3, "poisson": 0.3, "supports": supports, "loads": list(loads)}


def static(supports, loads=(), gravity=None, shape=None, dim=2, others=None, **more):
    shape = shape or {"box": {"origin": [0.0] * dim, "size": [1.0] * dim, "cells": [2] * dim}}
    time = {"end": 1.0, "dt": 1.0, "integrator": "static", "retries": 0}
    solids = {"b": solid(supports, shape, loads) | more} | (others or {})
    return Scene.model_validate({"dim": dim, "time": time, "gravity": gravity, "solids": solids})


def pin(*at, fix=("x", "y")):
    return {"where": {"ball": {"centre": list(at), "radius": 0.01}}, "fix": list(fix)}


def beam(supports, loads=(), theory="timoshenko", **more):
    return static(supports, loads, shape={"beam": BEAM | {"theory": theory}}, **more)


TORN = {"box": {"origin": [0, 0], "size": [3, 1], "cells": [3, 1]}, "cavity": {"origin": [1, -1], "size": [1, 3]}}
LEFT = [{"where": "left", "fix": ["x", "y"]}]
LOOSE = {
    "along y": (static([{"where": "left", "fix": ["x"]}], UP), "along y, where 0.5 N/m act: there is no equilibrium"),
    "linear": (static([{"where": "left", "fix": ["x"]}], UP, material="linear"), "along y, where 0.5 N/m act"),
    "quadratic": (static([{"where": "left", "fix": ["x"]}], UP, elements="quadratic"), "along y, where 0.5 N/m act"),
    "weight": (static([{"where": "left", "fix": ["x"]}], (), [0.0, -9.81]), "along y, where -9.81 N/m act"),
    "unpushed": (static([{"where": "left", "fix": ["x"]}]), "along y: where it comes to rest is not determined"),
    "pinned": (static([pin(0.0, 1.0)], (), [0.0, -9.81]), "around (0, 1), where -4.905 N m/m act"),
    "a linear pendulum": (static([pin(0.5, 1.0)], (), [0.0, -9.81], material="linear"), "around (0.5, 1): where it"),
    "one roller": (static([pin(0.0, 0.0, fix=["x"])]), "along y; around (0.5, 0): where"),
    "free": (static([]), "along x; along y; around (0.5, 0.5): where"),
    "3D": (
        static([{"where": "bottom", "fix": ["y"]}], [{"where": "right", "traction": [2.0, 0.0, 0.0]}], dim=3),
        "along x, where 2 N act; along z; around the axis along y through (",
    ),
    "an edge": (
        static(
            [{"where": {"box": {"origin": [-0.1, -0.1, -1], "size": [0.2, 0.2, 3]}}, "fix": ["x", "y", "z"]}],
            [{"where": "right", "traction": [0.0, 3.0, 0.0]}],
            dim=3,
        ),
        "around the axis along z through (0, 0, 0.5), where 3 N m act",
    ),
    "beam on a hinge": (beam(NO_ANGLE, [{"at": [2.0, 0.0], "force": [0.0, 3.0]}]), "around (0, 0), where 6 N m/m act"),
    "beam on a slide": (
        beam([{"where": "start", "fix": ["x", "angle"]}], [{"at": [2.0, 0.0], "force": [0.0, 3.0]}]),
        "along y, where 3 N/m act",
    ),
    "moment on a hinge": (
        beam(NO_ANGLE, [{"at": [1.0, 0.0], "moment": 5.0}], "euler-bernoulli"),
        "around (0, 0), where 5 N m/m act",
    ),
    "the second of two": (
        static(LEFT, others={"c": solid([], {"box": {"origin": [3, 0], "size": [1, 1], "cells": [1, 1]}})}),
        "solids.c.supports: in statics nothing holds the solid along x",
    ),
    "the part torn off": (static(LEFT, UP, shape=TORN), "along x, where 1 N/m act; along y, where 0.5 N/m act"),
    "beam beside a box": (
        static(LEFT, others={"c": solid(NO_ANGLE, {"beam": BEAM | {"start": [3.0, 0.0], "end": [5.0, 0.0]}})}),
        "solids.c.supports: in statics nothing holds the solid around (3, 0)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LOOSE)
def test_what_nothing_holds_is_named(name):
    scene, said = LOOSE[name]
    with pytest.raises(InputError) as found, prepared(scene):
        pass
    assert said in str(found.value)


STEADY = {
    "clamped": static(LEFT, UP),
    "pin and roller": static([pin(0.0, 0.0), pin(1.0, 0.0, fix=["y"])], UP),
    "three rollers": static([pin(0.0, 0.0, fix=["x"]), pin(0.0, 1.0, fix=["x"]), pin(1.0, 0.0, fix=["y"])], UP),
    "three rollers near one corner": static(
        [pin(0.0, 0.0), pin(0.05, 0.0, fix=["y"])], UP,
        shape={"box": {"origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [20, 1]}},
    ),
    "pendulum": static([pin(0.5, 1.0)], (), [0.0, -9.81]),
    "moving": static([pin(0.0, 0.0, fix=["x", "y"]), pin(1.0, 1.0, fix=["x", "y"]) | {"displacement": {"x": 0.01}}]),
    "beam": beam([{"where": "start", "fix": ["x", "y", "angle"]}], [{"at": [2.0, 0.0], "force": [0.0, 1e-3]}]),
    "beam on two supports": beam([*NO_ANGLE, {"where": "end", "fix": ["y"]}], [{"at": [1.0, 0.0], "force": [0, 0.1]}]),
    "3D": static(
        [pin(0.0, 0.0, 0.0, fix=["x", "y", "z"]), pin(1.0, 0.0, 0.0, fix=["y", "z"]), pin(0.0, 1.0, 0.0, fix=["z"])],
        [{"where": "top", "traction": [0.0, 0.1, 0.0]}], dim=3,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STEADY)
def test_what_is_held_comes_to_rest(name):
    with prepared(STEADY[name]) as sim:
        sim.advance()
        assert sim.outcome.residual < 1e-7


@pytest.mark.parallel([2, 3])
def test_ranks_know_as_much():
    for scene, said in (*(BLOCKED[name] for name in ("more in than out", "piston in 3D", "behind a beam")),
                        *(LOOSE[name] for name in ("an edge", "the part torn off", "beam beside a box"))):  # fmt: skip
        with pytest.raises(InputError) as found, prepared(scene):
            pass
        assert said in str(found.value)
    for name in ("beam between", "disk that turns", "almost through"):
        with prepared(SOUND[name]) as sim:
            sim.advance()
    with prepared(LATER["piston"][0]) as sim, pytest.raises(NoSolutionError, match=re.escape("+0.04 m^2/s")):
        for _ in range(3):
            sim.advance()


def test_check_knows_as_much():
    for scene, said in (BLOCKED["piston"], LOOSE["along y"]):
        with pytest.raises(InputError) as found:
            made_ready(MPI.COMM_SELF, scene, [])
        assert said in str(found.value)
    made_ready(MPI.COMM_SELF, SOUND["through"], [])
