"""Fluid stays in its cells whatever weighs beside it: the residual of stiff bodies hides that of light fluid."""

import numpy as np
import pytest
from step_cases import prepared

from petfsi.errors import SolveError
from petfsi.scene.schema import Scene
from petfsi.solving import linear

DEFAULT = ("-options_file", "monolithic.opts")
DIRECT = ("-options_file", "monolithic-direct.opts")


def swinging_bar(density, dt, end=0.4):
    """A stiff bar of 1 x 0.01 m, hinged at one end, that turns by 1 rad/s: its energy is 1.667 J, its tip at sin t."""
    beam = {"start": [0.0, 0.0], "end": [1.0, 0.0], "thickness": 0.01, "elements": 4}
    bar = {"shape": {"beam": beam}, "density": 1000.0, "young": 1e11, "poisson": 0.3}
    bar |= {"supports": [{"where": "start", "fix": ["x", "y"]}], "initial": {"velocity": ["-y", "x", "1"]}}
    sides = dict.fromkeys(("left", "right", "bottom", "top"), "open")
    fluid = {"density": density, "origin": [-0.6, -1.2], "size": [1.8, 2.4], "cells": [36, 48], "sides": sides}
    probe = {"p": {"of": "b", "at": [1.0, 0.0], "quantity": "displacement"}}
    table = {"dim": 2, "time": {"end": end, "dt": dt}, "fluid": fluid, "solids": {"b": bar}, "probes": probe}
    return Scene.model_validate(table)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(("density", "dt"), [(1e-9, 0.2), (1e-6, 0.05), (1e-3, 0.2), (1.0, 0.2), (1.0, 0.05)])
def test_light_fluid_around_a_stiff_bar_comes_from_nowhere(density, dt):
    """By default as by a direct solver; the fluid of 1 kg/m^3 weighs as much in the bar's motion as physics has it."""
    scene = swinging_bar(density, dt)
    found = {}
    for name, options in (("default", DEFAULT), ("direct", DIRECT)):
        with prepared(scene, *options) as sim:
            rows = []
            while not sim.finished:
                sim.advance()
                rows.append([*sim.probe(), sim.accounts.values["kinetic"], sim.divergence()])
            found[name] = np.array(rows)
    motion = found["default"][:, :-1]
    np.testing.assert_allclose(motion, found["direct"][:, :-1], rtol=1e-5, atol=1e-5)
    assert found["default"][:, -1].max() < 1e-4  # m/s, of 1 m/s; it was 0.1 to 10^4
    assert motion[:, 2].max() < 1.667


def test_a_step_that_leaks_all_the_same_has_failed(monkeypatch):
    monkeypatch.setattr(linear, "MENDS", 0)
    with prepared(swinging_bar(1e-6, 0.2), *DEFAULT) as sim, pytest.raises(SolveError, match="keeps fluid in its"):
        sim.advance()
