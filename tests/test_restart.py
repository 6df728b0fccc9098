"""A checkpoint holds all that the next step reads: runs that go on repeat, bit for bit, those that wrote it as well.

In one process, so that every integrator, solver and kind of solid can be had; through the command: ``test_run``.
"""

from pathlib import Path

import numpy as np
import pytest
from step_cases import SWING, block, loaded, prepared, stored

from petfsi.registry import INTEGRATORS
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Scene

SCENES = Path(__file__).parent / "scenes"
NEWTON = ("-fsi_snes_type", "newtonls")
SOLVERS = [(name, options) for name in INTEGRATORS for options in ((), NEWTON)]
#: Steps whose length changes; the explicit ones must be divided.
STEPS = {"dt": "(1 + 0.4*sin(20*t))/50", "above_limit": "subcycle", "end": 2.0}


def reader(arrays):
    return lambda name, start, count: arrays[name][tuple(slice(a, a + n) for a, n in zip(start, count, strict=True))]


def goes_on(scene, *options, forgets=True, before=4, after=3):
    """Take steps, go on in another simulation as well, and hold the two against each other after each step.

    Without ``forgets`` the first one does not know that a checkpoint was written.
    """
    with prepared(scene, *options) as straight, prepared(scene, *options) as again:
        for _ in range(before):
            straight.advance()
        arrays, kept = stored(straight), straight.keep()
        if forgets:
            straight.forget()
        again.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        for _ in range(after):
            for sim in (straight, again):
                sim.advance()
            assert (again.time, again.substeps, again.outcome) == (straight.time, straight.substeps, straight.outcome)
            assert (again.accounts.values, again.stable.limit) == (straight.accounts.values, straight.stable.limit)
            want, got = stored(straight), stored(again)
            different = [(g, name) for g in want for name in want[g] if not np.array_equal(want[g][name], got[g][name])]
            assert want.keys() == got.keys() and not different
        for group, part in kept.items():  # what is kept of a state does not change with it
            for name, slab in part().items():
                place = tuple(slice(a, a + n) for a, n in zip(slab.start, slab.data.shape, strict=True))
                assert np.array_equal(slab.data, arrays[group][name][place], equal_nan=True), (group, name)
    return straight


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("integrator, options", SOLVERS, ids=lambda value: "newtonls" if value == NEWTON else None)
def test_a_solid_alone(integrator, options):
    start = {} if integrator == "static" else {"initial": SWING}
    damping = {"stiffness": 0.002, "mass": 0.1}
    steps = STEPS | {"integrator": integrator, "dt": "(1 + 0.4*sin(20*t))/12"}
    scene = block((4, 3), time=steps, gravity=["t", -0.5], damping=damping, **start)
    sim = goes_on(scene, *options)
    assert np.abs(sim.solid.displacement).max() > 1e-3
    assert (sim.substeps > 1) == (integrator == "symplectic-euler")


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("theory", ["timoshenko", "euler-bernoulli"])
@pytest.mark.parametrize("integrator, options", SOLVERS, ids=lambda value: "newtonls" if value == NEWTON else None)
def test_a_beam(integrator, options, theory):
    blade = {
        "shape": {"beam": {"start": [0, 0], "end": [1, 0], "thickness": 0.1, "elements": 6, "theory": theory}},
        "density": 10.0, "young": 1e4, "poisson": 0.3, "supports": [{"where": "start", "fix": ["x", "y", "angle"]}],
    }  # fmt: skip
    goes_on(
        Scene.model_validate(
            {
                "dim": 2,
                "gravity": [0.0, "-1 - t"],
                "time": STEPS | {"integrator": integrator},
                "solids": {"blade": blade},
            }
        ),
        *options,
    )


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("density", [20, 2000])
@pytest.mark.parametrize(
    "integrator, options",
    [case for case in SOLVERS if case[0] != "static"],
    ids=lambda value: "newtonls" if value == NEWTON else None,
)
def test_a_solid_in_a_fluid(integrator, options, density):
    """A light bar's preconditioner is made in every step, a heavy one's is kept while it pays."""
    if integrator == "symplectic-euler" and density == 20:
        pytest.skip("needs a thousand sub-steps")
    sets = [f"time.{key}={value!r}" for key, value in (STEPS | {"integrator": integrator}).items()]
    sets += ["fluid.cells=[32, 24]", "solids.bar.shape.box.cells=[2, 12]", f"solids.bar.density={density}"]
    if integrator == "symplectic-euler":
        sets.append("solids.bar.damping={}")
    sim = goes_on(loaded(SCENES / "bar2d.toml", *sets), "-options_file", "monolithic.opts", *options)
    assert np.abs(sim.solid.displacement).max() > 1e-4


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("before", [3, 17])
def test_an_explicit_solid_alone_may_stop_anywhere(before):
    """When its stable step is found anew is part of the state: the run that goes on does not find another one."""
    steps = {"integrator": "symplectic-euler", "dt": 0.03, "end": 9.0, "above_limit": "subcycle"}
    scene = block((4, 3), time=steps, initial={"velocity": ["-0.1*x", "0.05*x"]})
    with prepared(scene) as sim:
        at_rest = sim.stable.limit
    assert goes_on(scene, forgets=False, before=before, after=20).stable.limit != at_rest


def _water(size, cells, **more):
    return {"density": 1000.0, "origin": [0.0, 0.0], "size": size, "cells": cells} | more


def _bar(origin, size, cells, **more):
    shape = {"box": {"origin": origin, "size": size, "cells": cells}}
    return {"shape": shape, "density": 1000.0, "young": 1e8, "poisson": 0.0} | more


def _held(*where):
    return [{"where": side, "fix": ["x", "y"]} for side in where]


#: By name the integrator, dt, the fluid and the solid.
KINDS = {
    "a pressure side": (
        "bdf2", 0.01, _water([2.0, 1.0], [24, 12], sides={"left": {"pressure": 500.0}, "right": "open"}),
        _bar([0.71, 0.0], [0.3, 1.0], [3, 8], body_force=["100*sin(10*t)", 0.0]),
    ),
    "a jet past a sheet": (
        "bdf2", 0.01,
        _water([1.0, 1.0], [16, 16], sides={
            "left": {"inflow": {"speed": 1.0, "region": {"box": {"origin": [-1, 0.21], "size": [2, 0.37]}}}},
            "right": "open",
        }),
        _bar([0.0, 0.4], [1.0, 0.01], [20, 1], supports=_held("left", "right", "top")),
    ),
    "sub-steps in a light fluid": (
        "symplectic-euler", 0.02,
        _water([2.0, 1.0], [24, 12], density=1.0, sides=dict.fromkeys(["left", "right", "bottom", "top"], "open")),
        _bar([0.25, 0.5], [1.0, 0.25], [8, 2], density=10.0, young=1e4, material="linear",
             supports=_held("left"), initial={"velocity": ["0.1*sin(pi*(x-0.25)/2)", 0.0]}),
    ),
    "sub-steps under particles": (
        "symplectic-euler", 2e-3,
        {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [0.6, 0.5], "spacing": 0.05,
         "sound_speed": 20.0, "fill": [{"box": {"origin": [0.0, 0.1], "size": [0.6, 0.2]}}], "sides": {"top": "open"}},
        _bar([0.0, 0.0], [0.6, 0.1], [12, 2], young=1e6, supports=_held("bottom", "left", "right")),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_what_else_a_step_may_read(name):
    integrator, dt, fluid, solid = KINDS[name]
    time = {"integrator": integrator, "dt": dt, "end": 1.0, "above_limit": "subcycle"}
    gravity = [0.0, -9.81 if "particles" in name else 0.0]
    scene = scene_from_dict({"dim": 2, "gravity": gravity, "time": time, "fluid": fluid, "solids": {"bar": solid}})
    goes_on(scene, before=3, after=2)
