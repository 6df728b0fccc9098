"""Bodies that enter another, an obstacle or a wall stop the run by name, at the first touch, and nothing else does."""

import subprocess

import numpy as np
import pytest
from processes import environment
from step_cases import prepared, stored
from test_guard import until_it_stops
from test_restart import reader
from test_run import PETFSI
from touch_cases import (
    CELL,
    KINDS,
    LU,
    SPEEDS,
    THINGS,
    WAYS,
    ball,
    beam,
    box,
    led,
    moving,
    run,
    said,
    scene,
    solid,
    turning,
)

from petfsi.errors import SolveError, TouchError
from petfsi.scene.dump import dump_scene
from petfsi.scene.load import scene_from_dict
from petfsi.solving.balance import Balance
from petfsi.touch import TOUCH

#: Bodies whose lowest point is y = 0.5 in the middle of the box, by name: shape, dim, and their shortest edge there.
BODIES = {
    "disk": (solid(ball([0.5, 0.6], 0.1, 8)), 2),
    "quadratic disk": (solid(ball([0.5, 0.6], 0.1, 4), elements="quadratic"), 2),
    "block": (solid(box([0.4, 0.5], [0.2, 0.2], [4, 4])), 2),
    "beam, upright": (solid(beam([0.5, 0.5], [0.5, 0.8], 0.01)), 2),
    "beam, flat": (solid(beam([0.35, 0.505], [0.65, 0.505], 0.01, theory="euler-bernoulli")), 2),
    "ball": (solid(ball([0.5, 0.6, 0.2], 0.1, 4)), 3),
    "brick": (solid(box([0.4, 0.5, 0.1], [0.2, 0.2, 0.2], [2, 2, 2]), elements="quadratic"), 3),
}
FLOOR = {"slab": {"shape": box([0.0, 0.0], [1.0, 0.3])}}
FLOOR_3D = {"slab": {"shape": box([0.0, 0.0, 0.0], [1.0, 0.3, 0.4])}}


def steps_of(speed, gap):
    """Return the step (s) at 1 m/s, and how many are too many."""
    return speed * CELL, int(gap / (speed * CELL)) + 2


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("name", BODIES)
def test_what_falls_on_an_obstacle_is_stopped_when_it_touches(name, speed):
    body, dim = BODIES[name]
    gap = 0.2 if speed > 0.01 else 0.005
    slab = box([0.0] * dim, [1.0, 0.5 - gap, 0.4][:dim])
    step, steps = steps_of(speed, gap + 0.01)
    what, _ = led(scene({"body": body}, dim, {"slab": {"shape": slab}}), moving(*[0.0, -1.0, 0.0][:dim]), step, steps)
    assert what[0] == "obstacles.slab"
    assert gap - 1e-9 <= what[1] <= gap + 2 * TOUCH * CELL


@pytest.mark.parametrize("speed", SPEEDS[1:])
@pytest.mark.parametrize("name", BODIES)
def test_what_falls_on_a_body_a_wall_or_a_post_thinner_than_its_step_is_stopped(name, speed):
    body, dim = BODIES[name]
    step, steps = steps_of(speed, 0.6)
    down = moving(*[0.0, -1.0, 0.0][:dim])
    other = solid(box([0.2, 0.25, 0.0][:dim], [0.6, 0.05, 0.4][:dim], [3, 1, 2][:dim]))
    what, _ = led(scene({"body": body, "other": other}, dim, wet=dim == 2), down, step, steps)
    assert what[0] == "solids.other" and 0.2 - 1e-9 <= what[1] <= 0.2 + TOUCH * (0.2 + 0.1)
    what, _ = led(scene({"body": body}, dim), down, step, steps)
    assert what[0] == "fluid.sides.bottom" and 0.5 - 1e-9 <= what[1] <= 0.5 + 2 * TOUCH * CELL
    wire = {"wire": {"shape": box([0.499, 0.3, 0.199][:dim], [0.002, 0.002, 0.002][:dim])}}
    what, _ = led(scene({"body": body}, dim, wire), down, step, steps)
    assert what[0] == "obstacles.wire" and 0.198 - 1e-9 <= what[1] <= 0.198 + 0.002


@pytest.mark.parametrize("speed", SPEEDS[2:])
@pytest.mark.parametrize("name", ["disk", "beam, upright", "ball"])
def test_open_sides_let_out_and_periodic_ones_lead_to_what_is_behind_them(name, speed):
    body, dim = BODIES[name]
    step, steps = steps_of(speed, 2.5)
    right = moving(*[1.0, 0.0, 0.0][:dim])
    what, _ = led(scene({"body": body}, dim, sides={"right": "open"}), right, step, steps)
    assert what[0] is None
    around = {"left": "periodic", "right": "periodic"}
    what, _ = led(scene({"body": body}, dim, sides=around), right, step, steps)
    assert what[0] is None
    post = {"post": {"shape": box([0.1, 0.45, 0.0][:dim], [0.02, 0.3, 0.4][:dim])}}
    what, _ = led(scene({"body": body}, dim, post, around), right, step, steps)
    half = 0.005 if "beam" in name else 0.1
    assert what[0] == "obstacles.post" and 0.6 - half - 1e-9 <= what[1] <= 0.6 - half + 2 * TOUCH * CELL
    other = solid(box([0.1, 0.45, 0.0][:dim], [0.05, 0.3, 0.4][:dim], [1, 2, 2][:dim]))
    what, _ = led(scene({"body": body, "other": other}, dim, sides=around), right, step, steps)
    assert what[0] == "solids.other" and 0.6 - half - 1e-9 <= what[1] <= 0.6 - half + 4 * TOUCH * CELL


@pytest.mark.parametrize("speed", SPEEDS[1:])
@pytest.mark.parametrize("theory", ["timoshenko", "block"])
def test_a_bar_that_turns_meets_a_pin_when_its_face_does(theory, speed):
    """Its end goes at so many cells a step: on the chord of a long step it would pass below the pin."""
    shape = box([0.1, 0.49], [0.8, 0.02], [8, 1]) if theory == "block" else beam([0.1, 0.5], [0.9, 0.5], 0.02)
    pin = np.array([0.86, 0.651])
    table = scene({"bar": solid(shape)}, obstacles={"pin": {"shape": box(pin, [0.001, 0.001])}})
    # of the pin's corners the lower right one is first
    x, y = pin + [0.001, 0.0] - 0.5
    angle = np.arctan2(y, x) - np.arcsin(0.01 / np.hypot(x, y))
    what, _ = led(table, turning([0.5, 0.5], 1.0), speed * CELL / 0.4, int(1.0 / (speed * CELL / 0.4)) + 2)
    assert what[0] == "obstacles.pin" and angle - 1e-3 <= what[1] <= angle + 3e-3


# ---- no false alarms ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", SPEEDS[2:])
@pytest.mark.parametrize("name", BODIES)
def test_what_slides_along_walls_and_obstacles_that_it_touches_goes_on(name, speed):
    """With rounding of its own, a near miss by half of what bodies are drawn in, too."""
    body, dim = BODIES[name]
    rng = np.random.default_rng(1)
    slab = {"slab": {"shape": box([0.0, 0.0, 0.0][:dim], [0.5, 0.5, 0.4][:dim])}}
    slab["next"] = {"shape": box([0.5, 0.2, 0.0][:dim], [0.5, 0.3, 0.4][:dim])}
    step, steps = steps_of(speed, 0.3)

    def way(x, s):
        return x + s * np.array([1.0, 0.0, 0.0][:dim]) + rng.uniform(-1e-12, 1e-12, x.shape)

    what, notes = led(scene({"body": body}, dim, slab, {"right": "open"}), way, step, steps)
    assert what[0] is None and not notes


def test_a_body_in_the_cavity_of_another_and_one_in_a_container_are_in_nothing():
    shell = solid(box([0.2, 0.2], [0.6, 0.6], [6, 6]) | {"cavity": {"origin": [0.3, 0.3], "size": [0.4, 0.4]}})
    core = solid(ball([0.5, 0.5], 0.1, 4))
    room = {"room": {"shape": ball([0.5, 0.5], 0.45), "outside": True}}
    table = scene({"core": core, "shell": shell}, obstacles=room)
    what, notes = led(table, moving(0.095, 0.0), 0.1, 10)
    assert what[0] is None and not notes
    what, _ = led(table, moving(0.095, 0.0), 0.1, 12)
    assert what[0] == "solids.shell" and what[1] == pytest.approx(0.1 / 0.095, abs=0.02)
    what, _ = led(scene({"core": core}, obstacles=room), moving(1.0, 0.0), 0.02, 30)
    assert what[0] == "obstacles.room" and what[1] == pytest.approx(0.35, abs=5e-3)


def test_a_beam_hinged_at_a_wall_turns_there_but_may_not_go_on_into_it():
    hinged = {"supports": [{"where": "start", "fix": ["x", "y"]}]}
    table = scene({"beam": solid(beam([0.0, 0.5], [0.5, 0.5], 0.04), **hinged)})
    assert led(table, turning([0.0, 0.5], 1.0), 0.1, 10) == ((None, None), [])
    what, _ = led(table, moving(-0.1, 0.0), 0.1, 10)
    assert what[0] == "fluid.sides.left" and what[1] <= 0.5


def test_what_is_held_in_an_obstacle_may_swing_but_not_go_deeper():
    held = {"supports": [{"where": "bottom", "fix": ["x", "y"]}]}
    table = scene({"body": solid(box([0.4, 0.25], [0.1, 0.4], [2, 8]), **held)}, obstacles=FLOOR)

    def swing(x, s):
        high = np.maximum(x[:, 1] - 0.25, 0.0)
        return x + np.column_stack((high**2 * np.sin(s), -0.1 * high * np.sin(s) ** 2))

    assert led(table, swing, 0.1, 60)[0] == (None, None)
    what, _ = led(table, moving(0.0, -0.1), 0.1, 20)
    assert what[0] == "obstacles.slab" and what[1] <= 0.5
    assert led(table, moving(0.0, 0.1), 0.1, 20)[0] == (None, None)


def test_what_begins_in_another_body_is_told_of_and_may_come_out():
    one = solid(box([0.2, 0.2], [0.2, 0.2], [4, 4]), initial={"displacement": [0.15, 0.0]})
    two = solid(box([0.5, 0.2], [0.2, 0.2], [4, 4]))
    table = scene({"one": one, "two": two}, wet=False)
    what, notes = led(table, moving(-1.0, 0.0), 0.01, 20)
    assert what[0] is None
    assert len(notes) == 2 and "solids.one begins with a part of it in solids.two" in notes[0]
    what, _ = led(table, moving(1.0, 0.0), 0.01, 20)
    assert what[0] == "solids.two" and what[1] <= 0.11


# ---- whole runs ---------------------------------------------------------------------------------------------


def fallen(shape, obstacles, t, checkpoint=None, **others):
    """Return a scene in which gravity brings a heavy body down."""
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [32, 32], "sides": {"top": "open"}}
    table = {"dim": 2, "gravity": [0.0, -9.81], "time": {"end": t, "dt": 0.01, "integrator": "bdf2"}, "fluid": fluid}
    solids = {"d": solid(shape, density=5000.0)} | others
    return scene_from_dict(table | {"solids": solids, "obstacles": obstacles, "checkpoint": checkpoint or {}})


FALLS = {
    "post": (ball([0.52, 0.7], 0.1, 8), {"post": {"shape": ball([0.5, 0.3], 0.1)}}, "obstacles.post", 0.4),
    "floor": (ball([0.5, 0.3], 0.15, 8), {}, "fluid.sides.bottom", 0.0),
}


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("name", FALLS)
def test_a_body_that_sinks_stops_at_what_is_below_it_and_is_not_stepped_again(name):
    shape, obstacles, what, height = FALLS[name]
    with prepared(fallen(shape, obstacles, 1.0), *LU) as sim:
        told = []
        sim.report = told.append
        with pytest.raises(TouchError, match=rf"solids\.d .* {what} at \(.*\) m, t = ") as error:
            while not sim.finished:
                sim.advance()
        lowest = sim.solid.surface_present()[:, 1].min()
    assert not told
    assert said(error.value)[1] == pytest.approx(sim.time, abs=0.01) and sim.time < said(error.value)[1]
    # the step that ends in a touch is not accepted: the body is where it was before, above
    assert height < lowest < height + 0.02


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint", "symplectic-euler"])
def test_thrown_bodies_meet_on_the_way_whatever_the_scheme(integrator):
    """At a cell a step, from .31 apart; with neither fluid nor gravity they fly straight, and meet at .155 s."""
    one = solid(box([0.0, 0.0], [0.2, 0.2], [2, 2]), initial={"velocity": [1.0, 0.0]})
    two = solid(ball([0.61, 0.1], 0.1, 4), initial={"velocity": [-1.0, 0.0]})
    blade = solid(beam([0.3, 0.5], [0.3, 0.9], 0.02))
    table = scene(
        {"one": one, "two": two, "blade": blade}, wet=False, integrator=integrator, dt=0.05, above_limit="subcycle"
    )
    with prepared(table, *LU) as sim, pytest.raises(TouchError) as error:
        while not sim.finished:
            sim.advance()
    assert said(error.value) == ("solids.two", pytest.approx(0.155, abs=2e-3))


def test_a_run_that_goes_on_stops_as_the_one_that_was_never_interrupted():
    """A beam whose end an obstacle holds from the start, and a disk that falls on it."""
    held = solid(beam([0.08, 0.4], [0.6, 0.4], 0.02), supports=[{"where": "start", "fix": ["x", "y", "angle"]}])
    rock = {"rock": {"shape": box([0.0, 0.0], [0.1, 0.6])}}
    table = fallen(ball([0.3, 0.6], 0.1, 8), rock, 1.0, arm=held)
    with prepared(table, *LU) as straight, prepared(table, *LU) as again:
        for _ in range(4):
            straight.advance()
        arrays = stored(straight)
        straight.forget()
        again.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        errors = []
        for sim in (straight, again):
            with pytest.raises(TouchError) as error:
                while not sim.finished:
                    sim.advance()
            errors.append(str(error.value))
    assert errors[0] == errors[1] and "solids.arm" in errors[0] and "solids.d" in errors[0]


def test_the_command_says_so_and_exits_with_3(tmp_path):
    path = tmp_path / "fall.toml"
    path.write_text(dump_scene(fallen(*FALLS["floor"][:2], 1.0, checkpoint={"every": 0.1})))
    done = subprocess.run(
        [PETFSI, "run", path, "--out", tmp_path / "run"], capture_output=True, text=True, env=environment(), timeout=300
    )
    assert done.returncode == 3
    lines = done.stderr.splitlines()
    assert "t = 0.23 s: solids.d leaves the fluid's box through fluid.sides.bottom at (0.5, 0) m, t = 0.22" in lines[0]
    assert "checkpoint" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("kind, thing, how, speed", [
    ("triangles", "plate", "held", 10.0), ("quadratic triangles", "image", "thrown", 10.0),
    ("straight beam", "wall", "held", 10.0), ("beam", "plate", "thrown", 1.0), ("beam", "open", "thrown", 10.0),
    ("triangles", "periodic", "thrown", 10.0),
])  # fmt: skip
def test_whole_runs_stop_at_the_first_touch(kind, thing, how, speed):
    found = run(kind, thing, how, speed, wet=True)
    check_run(kind, thing, found)


def check_run(kind, thing, found):
    """Check what a run went into, and that it was no deeper than what bodies are drawn in by."""
    wanted = {"wall": "fluid.sides.bottom", "body": "solids.other", "open": None, "periodic": None}
    assert found[0] == wanted.get(thing, "obstacles.post")
    if found[0] is not None:
        cell, edge = (CELL, 0.1) if KINDS[kind][1] == 2 else (0.1, 0.4)
        assert -1e-3 <= found[1] <= TOUCH * (2 * edge if thing == "body" else cell) / cell + 1e-3
    else:
        assert found[1] > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("thing", THINGS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_body_into_every_kind_of_thing(kind, thing, how, speed):
    """About 10 minutes."""
    for wet in (True, False) if thing == "body" else (True,):
        check_run(kind, thing, run(kind, thing, how, speed, wet))


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_a_pendulum_swings_into_a_post_and_past_what_it_does_not_reach(dt):
    """A beam hinged at its upper end falls from the horizontal: below its hinge it has sqrt(3 g L), 4.9 m/s."""
    rod = {"density": 1e5, "young": 1e10, "supports": [{"where": "start", "fix": ["x", "y"]}]}
    hinged = solid(beam([0.3, 0.8], [0.6, 0.8], 0.02, 2), **rod)
    posts = {"near": {"shape": ball([0.3, 0.45], 0.04)}, "far": {"shape": ball([0.15, 0.6], 0.04)}}
    table = {"dim": 2, "gravity": [0.0, -9.81], "time": {"end": 1.0, "dt": dt, "integrator": "bdf2"}}
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [20, 20], "sides": {"top": "open"}}
    table = scene_from_dict(table | {"fluid": fluid, "solids": {"rod": hinged}, "obstacles": posts})
    with prepared(table, *LU) as sim, pytest.raises(TouchError) as error:
        while not sim.finished:
            sim.advance()
    what, when = said(error.value)
    assert what == "obstacles.far"
    # from the horizontal to 45 degrees beyond the vertical, by the pendulum's own equation
    assert 0.25 < when < 0.6


def on_a_string(angle, radius, at):
    """Return a scene of a block of 0.5 m, 4 m below a pivot that it swings about by ``angle`` a step, and of a pin."""
    turned = {"x": f"x*(cos({angle}*t)-1) - y*sin({angle}*t)", "y": f"x*sin({angle}*t) + y*(cos({angle}*t)-1)"}
    block = {
        "shape": {"box": {"origin": [-0.25, -4.25], "size": [0.5, 0.5], "cells": [2, 2]}},
        "density": 1000.0,
        "young": 1e6,
        "poisson": 0.3,
        "supports": [{"where": "all", "fix": ["x", "y"], "displacement": turned}],
    }
    pin = {"shape": ball([radius * np.sin(at), -radius * np.cos(at)], 0.01)}
    fluid = {"density": 1e-3, "origin": [-2.0, -5.0], "size": [5.0, 4.0], "cells": [50, 40]}
    fluid["sides"] = dict.fromkeys(("left", "right", "top", "bottom"), "open")
    table = {"dim": 2, "time": {"end": 2.0, "dt": 1.0}, "solids": {"b": block}, "obstacles": {"pin": pin}}
    return scene_from_dict(table | {"fluid": fluid})


@pytest.mark.parametrize("angle", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("part", [0.3, 0.5])
def test_what_swings_far_from_its_pivot_meets_what_is_on_its_arc_and_no_more(angle, part):
    """Its outer face is at 4.25 m and more, its inner one at 3.75 m and more: its chord is up to 0.08 m off."""
    outer = np.hypot(4.25, 0.25)
    for radius, meets in ((outer - 0.02, True), (outer + 0.02, False), (3.77, True), (3.735, False)):
        # beside the block's corners at both ends of the step in which it passes
        with prepared(on_a_string(angle, radius, (1.0 + part) * angle), *LU) as sim:
            _, why = until_it_stops(sim, 2)
        assert ("enters obstacles.pin" in why) == meets, (radius, why)


@pytest.mark.parametrize("dt", [0.02, 0.2])
def test_a_bar_hinged_above_the_floor_turns_down_to_it_in_any_step(dt):
    """Its lowest point is 0.0015 - 0.001 sin(0.4) m above the floor."""
    bar = beam([0.0, 0.0015], [0.0, 1.0015], 0.002, 4)
    hinged = solid(bar, density=1000.0, young=1e11, supports=[{"where": "start", "fix": ["x", "y"]}],
                   initial={"velocity": ["-(y-.0015)", "0", "1"]})  # fmt: skip
    fluid = {"density": 1e-6, "origin": [-0.6, 0.0], "size": [1.2, 1.2], "cells": [30, 30],
             "sides": dict.fromkeys(("left", "right", "top"), "open")}  # fmt: skip
    table = {"dim": 2, "time": {"end": 0.4, "dt": dt}, "fluid": fluid, "solids": {"bar": hinged}}
    with prepared(scene_from_dict(table)) as sim:
        while not sim.finished:
            sim.advance()


def test_a_spinning_brick_meets_another_with_an_edge():
    """It stands beside it, nearer than its diagonal: at a quarter of a turn a step its edge meets the other's face."""
    spin = {"initial": {"velocity": ["-10*(y-0.1)", "10*(x-0.1)", 0.0]}}
    one = solid(box([0.0, 0.0, 0.0], [0.2, 0.2, 0.2], [1, 1, 1]), **spin)
    two = solid(box([0.22, -0.1, 0.0], [0.1, 0.4, 0.2], [1, 2, 1]))
    table = scene({"one": one, "two": two}, 3, wet=False, dt=0.02)
    with prepared(table, *LU) as sim, pytest.raises(TouchError) as error:
        while not sim.finished:
            sim.advance()
    # half a diagonal, turned by a from 45 degrees: 0.1414 cos(pi/4 - a) = 0.12
    what, when = said(error.value)
    assert what == "solids.two" and when == pytest.approx(
        (np.pi / 4 - np.arccos(0.12 / np.hypot(0.1, 0.1))) / 10, abs=4e-3
    )


# ---- in closed boxes, where the step's own equations fail first -------------------------------------------------

#: What a block driven to the right (or around, to the left) at so many m/s meets, where, and when, s.
POST = {"post": {"shape": box([0.52, 0.45], [0.1, 0.1])}}
AROUND = {"left": "periodic", "right": "periodic"}
DRIVEN = {
    "post": (5.0, 0.2, {"obstacles": POST}, "solids.a enters obstacles.post at (0.52, 0.45) m", 0.044),
    "at a step's end": (5.0, 0.22, {"obstacles": POST}, "solids.a enters obstacles.post at (0.52, 0.45) m", 0.04),
    "slowly": (0.05, 0.415, {"obstacles": POST}, "solids.a enters obstacles.post at (0.52, 0.45) m", 0.1),
    "wall": (5.0, 0.72, {}, "solids.a leaves the fluid's box through fluid.sides.right at (1, 0.4", 0.036),
    "body": (5.0, 0.2, {"other": box([0.52, 0.45], [0.1, 0.1], [2, 2])}, "solids.a enters solids.other at (0.5", 0.044),
    "over the seam": (
        -1.0, 0.05, {"sides": AROUND, "obstacles": {"o": {"shape": box([0.85, 0.42], [0.1, 0.1])}}},
        "solids.a enters obstacles.o at (0.95, 0.4", 0.1,
    ),
}  # fmt: skip
HELD = [{"where": "all", "fix": ["x", "y"]}]


def driven(speed, at, integrator="bdf2", sides=None, obstacles=None, other=None, retries=3):
    """Return a closed box in which supports move a block along x."""
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16], "sides": sides or {}}
    block = solid(box([at, 0.4], [0.1, 0.2], [3, 4]), supports=[HELD[0] | {"velocity": {"x": speed}}])
    others = {"other": solid(other, supports=HELD)} if other else {}
    time = {"end": 0.2, "dt": 0.01, "integrator": integrator, "retries": retries}
    table = {"dim": 2, "time": time, "fluid": fluid, "solids": {"a": block} | others, "obstacles": obstacles or {}}
    return scene_from_dict(table)


def driven_to_its_end(table):
    """Return what ends a run, and what was reported."""
    with prepared(table, *LU) as sim:
        told = []
        sim.report = told.append
        with pytest.raises(SolveError) as error:
            while not sim.finished:
                sim.advance()
    return error.value, told


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("name", DRIVEN)
def test_what_supports_drive_into_something_is_told_of_as_that_and_not_as_what_does_not_balance(name):
    speed, at, more, what, when = DRIVEN[name]
    error, told = driven_to_its_end(driven(speed, at, **more))
    assert isinstance(error, TouchError) and not told
    assert str(error).startswith(what) and str(error).endswith("so the run stops where they touch")
    # bodies are drawn in by a hundredth of a cell, and an edge of .05 m by a quarter at most
    assert when - 1e-9 <= said(error)[1] <= when + min(3 * TOUCH / 16 / abs(speed), 0.001)


@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_so_it_is_with_other_schemes(integrator):
    error, _ = driven_to_its_end(driven(5.0, 0.2, integrator, obstacles=POST))
    assert isinstance(error, TouchError) and said(error) == ("obstacles.post", pytest.approx(0.044, abs=4e-4))


def test_what_slows_down_before_a_wall_is_followed_in_shorter_steps():
    """At 5 m/s a step goes beyond the wall, .03 m ahead; at 1 m/s it meets it .03 s later."""
    error, told = driven_to_its_end(driven("where(t<0.031,5,1)", 0.72))
    assert said(error) == ("fluid.sides.right", pytest.approx(0.0527, abs=1e-3))
    assert told and all("ahead of the step, where its equations are taken, solids.a leaves" in text for text in told)
    error, told = driven_to_its_end(driven("where(t<0.031,5,1)", 0.72, retries=0))
    assert str(error).startswith("ahead of the step, where its equations are taken, solids.a leaves the fluid's box")
    assert not isinstance(error, TouchError) and "shorter steps go on from nearer by" in str(error) and not told


def test_a_solve_that_fails_where_bodies_meet_says_so_before_what_the_solver_says(monkeypatch):
    """Elsewhere the solver alone speaks."""
    for at, retries in ((0.2, 0), (0.2, 3), (0.1, 3)):
        with prepared(driven(5.0, at, obstacles=POST, retries=retries), *LU) as sim:
            for _ in range(4):
                sim.advance()
            monkeypatch.setattr(sim.solver, "solve", fails)
            monkeypatch.setattr(Balance, "fault", lambda *_: None)
            with pytest.raises(SolveError) as error:
                sim.advance()
            monkeypatch.undo()
        text = str(error.value)
        if retries == 0:
            assert said(error.value) == ("obstacles.post", pytest.approx(0.044, abs=2e-4))
            assert text.endswith("the run stops where they touch. The step failed of it: the solver gave up")
        else:
            # of shorter steps the first one ends before the touch
            assert text == "the solver gave up"


def fails(*_):
    raise SolveError("the solver gave up")
