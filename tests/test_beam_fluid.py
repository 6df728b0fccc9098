"""Beams in a fluid, thinner than a cell: identities, forces, schemes and ranks against each other."""

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from test_cutcell import DIRECT, PERIODIC, RHO, G, buoyancy, make_scene, unscaled
from test_run import last_output, petfsi

from petfsi.bench.case import job, simulation

CELL = 1 / 16
ALL = [{"where": "all", "fix": ["x", "y", "angle"]}]
LAID = {
    "level": ([0.21, 0.53], [0.77, 0.53]),
    "upright": ([0.53, 0.21], [0.53, 0.77]),
    "slanted": ([0.2, 0.3], [0.7, 0.6]),
}


def strip(start, end, thickness=0.3 * CELL, elements=5, **more):
    return {"beam": {"start": start, "end": end, "thickness": thickness, "elements": elements, **more}}


@pytest.fixture(params=["timoshenko", "euler-bernoulli"])
def theory(request):
    return request.param


# ---- cut cells ----------------------------------------------------------------------------------------------


def test_force_and_flux_are_transposes_for_a_bent_beam(theory):
    bent = {"displacement": ["-0.1*(x - 0.2)**2", "0.4*(x - 0.2)**2", "0.8*(x - 0.2)"]}
    solid = {"shape": strip(*LAID["slanted"], theory=theory), "initial": bent}
    with simulation(MPI.COMM_SELF, make_scene(2, [16, 16], [1.0, 1.0], solid), DIRECT) as sim:
        J, flux = unscaled(sim)
    assert np.abs(J[2::3]).max() > 0
    assert np.abs(J - flux.T).max() <= 1e-15 * np.abs(J).max()


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_fluid_and_beam_that_move_alike_go_on_so(integrator, theory):
    speed = [0.37, 0.21]
    solid = {"shape": strip(*LAID["slanted"], theory=theory), "initial": {"velocity": speed}}
    scene = make_scene(2, [24, 20], [1.2, 1.0], solid, PERIODIC, flow=speed, dt=0.02, integrator=integrator)
    with simulation(MPI.COMM_WORLD, scene, "monolithic.opts") as sim:
        for _ in range(60):
            sim.advance()
        for a in range(2):
            assert np.abs(sim.fluid.velocity[a][sim.fluid.grid.owned(a)] - speed[a]).max() < 1e-10
        assert np.abs(sim.solid.velocity - [*speed, 0.0]).max(initial=0.0) < 1e-10


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("name", LAID)
def test_a_fluid_at_rest_carries_a_held_beam(name):
    start, end = LAID[name]
    solid = {"shape": strip(start, end), "supports": ALL}
    scene = make_scene(2, [16, 16], [1.0, 1.0], solid, {"top": "open"}, [0.0, -G])
    with simulation(MPI.COMM_WORLD, scene, DIRECT) as sim:
        for _ in range(3):
            sim.advance()
        assert all(np.abs(v).max() < 1e-10 for v in sim.fluid.velocity)
        weight = RHO * G * 0.3 * CELL * np.hypot(*np.subtract(end, start))
        assert buoyancy(sim) == pytest.approx([0.0, weight], abs=1e-11 * weight)


@pytest.mark.parallel([1, 2])
def test_a_clamped_plate_bends_under_the_water_on_it(theory):
    """Under q = rho g (water above + water that hangs below) + its own weight, q L^4/384 EI + q L^2/8 GA."""
    h, young, nu, floor = 0.02, 2e11, 0.3, 0.253
    clamp = [{"where": end, "fix": ["x", "y", "angle"]} for end in ("start", "end")]
    solid = {"shape": strip([0.0, floor], [1.0, floor], h, 16, theory=theory), "supports": clamp, "young": young,
             "poisson": nu, "density": 2000.0, "damping": {"mass": 20.0, "stiffness": 0.01}}  # fmt: skip
    scene = make_scene(2, [16, 16], [1.0, 1.0], solid, {"top": "open", "bottom": "open"}, [0.0, -G], dt=0.1)
    with simulation(MPI.COMM_WORLD, scene, DIRECT) as sim:
        for _ in range(60):
            sim.advance()
        seen = sim.solid.probe("body", [0.5, floor], "displacement")[1]
    load = RHO * G * (1.0 - h) + 2000.0 * G * h
    shear = load / (8 * 5 / 6 * young / 2.6 * h) if theory == "timoshenko" else 0.0
    assert -seen == pytest.approx(load / (384 * young * h**3 / 12) + shear, rel=0.01)


# ---- the gate -----------------------------------------------------------------------------------------------

SMALL = {"fluid.cells": [60, 20], "time.end": 0.4, "time.dt": 0.02, "solids.gate.shape.beam.elements": 4}


def tip(comm, options, steps=12, **sets):
    with simulation(comm, job(comm, "gate", SMALL | sets), options) as sim:
        for _ in range(steps):
            sim.advance()
        return np.array(sim.probe())


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_a_gate_moves_alike_on_any_number_of_ranks(transfer):
    sets = {"coupling.transfer": transfer}
    alone, shared = (tip(comm, "monolithic.opts", **sets) for comm in (MPI.COMM_SELF, MPI.COMM_WORLD))
    assert abs(alone[0]) > 1e-3
    np.testing.assert_allclose(shared, alone, rtol=1e-8)


@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_a_gate_moves_alike_solved_at_once_or_split(transfer):
    """In a fluid so light that splitting is stable: that of the job outweighs the gate. One pass is late by a step."""
    late = []
    for n in (24, 48):
        sets = {"coupling.transfer": transfer, "fluid.density": 3.0, "solids.gate.young": 1e5, "time.dt": 0.24 / n}
        names = ("monolithic.opts", "split-iterated.opts", "split.opts")
        whole, iterated, split = (tip(MPI.COMM_SELF, name, n, **sets) for name in names)
        assert abs(whole[0]) > 1e-3
        np.testing.assert_allclose(iterated, whole, rtol=1e-6)
        late.append(np.linalg.norm(split - whole))
    assert late[1] < 0.6 * late[0]


def test_a_gate_resumes_bit_for_bit(tmp_path):
    words = [w for key, value in SMALL.items() for w in ("--set", f"{key}={value}")]
    words += ["--set", "checkpoint.every=0.08", "--set", "output.every=0.2", "--set", "time.end=0.2"]
    gate = Path(__file__).parents[1] / "jobs" / "gate.toml"
    petfsi("run", gate, "--out", tmp_path / "whole", *words)
    petfsi("run", gate, "--out", tmp_path / "parts", *words, "--steps", 7)
    petfsi("resume", tmp_path / "parts")
    want, got = last_output(tmp_path / "whole"), last_output(tmp_path / "parts")
    assert want.keys() == got.keys()
    assert not [name for name in want if not np.array_equal(want[name], got[name])]
