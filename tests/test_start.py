"""A run starts with velocities of fluid and solids that fit each other."""

from pathlib import Path

import numpy as np
import pytest
from load_cases import COMM
from mpi4py import MPI
from step_cases import loaded, motion, prepared

from petfsi.scene.load import scene_from_dict
from petfsi.solving.linear import LinearSolver

SCENES = Path(__file__).parent / "scenes"
OPTIONS = {
    "default": (),
    "direct": ("-options_file", "monolithic-direct.opts"),
    "split": ("-options_file", "split.opts"),
    "newton": ("-fsi_snes_type", "newtonls"),
}


def disk(velocity, young=1e13, radius=0.4, **more):
    """A disk at the origin, as good as rigid within a step if nothing else is said."""
    shape = {"ball": {"centre": [0.0, 0.0], "radius": radius, "cells": 16}}
    return {
        "shape": shape, "density": 2000.0, "young": young, "poisson": 0.3, "initial": {"velocity": velocity},
    } | more  # fmt: skip


def box(
    solids, integrator="bdf2", cells=32, size=2.2, sides=None, transfer="cutcell", dt=1e-3, initial=None, **more
):  # fmt: skip
    water = {"density": 1000.0, "origin": [-size / 2] * 2, "size": [size] * 2, "cells": [cells] * 2}
    time = {"end": 1.0, "dt": dt, "integrator": integrator}
    data = {
        "dim": 2,
        "time": time,
        "fluid": water | {"sides": sides or {}, "initial": initial or {}},
        "coupling": {"transfer": transfer},
    }
    return scene_from_dict(data | {"solids": solids} | more)


CONTAINER = {"obstacles": {"container": {"shape": {"ball": {"centre": [0.0, 0.0], "radius": 1.0}}, "outside": True}}}
PERIODIC = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")


def left_over(sim):
    """Return the largest net outflow of a cell over its size, m/s."""
    out = sim.fluid.net_outflow() + sum(coupling.outflow() for coupling in sim.couplings)
    return sim.comm.allreduce(float(np.abs(out).max(initial=0.0)), MPI.MAX) / sim.fluid.grid.dx[0]


def velocities(sim):
    """Return those of all nodes, on every rank."""
    return np.split(motion(sim), 2)[1]


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize(
    "integrator, options",
    [("newmark", "default"), ("midpoint", "default"), ("bdf2", "default"), ("bdf2", "direct"), ("midpoint", "split"),
     ("bdf2", "newton")],
)  # fmt: skip
def test_a_rigid_disk_set_off_at_once_takes_its_added_mass_along(integrator, options):
    """Its momentum is shared: m u0 = (m + m_a) u, in a container with m_a = rho pi R^2 (B^2 + R^2) / (B^2 - R^2).

    No velocities that fit are nearer in kinetic energy: the change is M-orthogonal to them, 2 K_f = m u (u0 - u).
    """
    scene = box({"disk": disk([0.0, 1.0])}, integrator, **CONTAINER)
    with prepared(scene, *OPTIONS[options], comm=COMM) as sim:
        own, kinetic, u = sim.solid.energies()["kinetic"], sim.accounts.values["kinetic"], velocities(sim)
        assert left_over(sim) < 1e-9
        assert len(sim.notes) == 1 and f"kinetic energy {kinetic:.4g} J, not 501.8 J" in sim.notes[0]
    assert np.ptp(u, axis=0).max() < 1e-4
    speed = u[:, 1].mean()
    m, added = 2 * own / speed**2, 1000.0 * np.pi * 0.16 * (1 + 0.16) / (1 - 0.16)
    assert speed == pytest.approx(m / (m + added), rel=5e-3)
    assert kinetic == pytest.approx(0.5 * m * speed, rel=1e-5)


@pytest.mark.parametrize("integrator", ["newmark", "symplectic-euler"])
def test_the_impulse_goes_only_as_far_into_a_body_as_waves_do_in_a_step(integrator):
    """Sound in it crosses .01 of 1 m in the step."""
    soft = disk([1.0, 0.0], young=1e5, radius=0.5)
    with prepared(box({"disk": soft}, integrator, sides=PERIODIC, dt=1e-4)) as sim:
        u = velocities(sim)[:, 0]
        middle = np.linalg.norm(sim.solid.reference, axis=1) < 0.25
        assert left_over(sim) < 1e-9
    assert np.allclose(u[middle], 1.0, atol=0.02) and np.ptp(u) > 0.3


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_supports_and_inflows_keep_their_velocities(transfer):
    """A plate is pushed along, and a jet has no ramp: both are there from the first instant."""
    push = [{"where": "bottom", "fix": ["x", "y"], "velocity": {"x": "0.3 + t"}}]
    shape = {"box": {"origin": [-0.2, -1.0], "size": [0.3, 1.1], "cells": [4, 12]}}
    plate = {"shape": shape, "density": 900.0, "young": 1e6, "poisson": 0.3, "supports": push}
    sides = {"left": {"inflow": {"speed": 0.5}}, "right": "open"}
    scene = box({"plate": plate}, "midpoint", size=2.0, cells=24, sides=sides, transfer=transfer, dt=0.01)
    with prepared(scene, *OPTIONS["direct"], comm=COMM) as sim:
        assert left_over(sim) < 1e-9
        assert np.count_nonzero(velocities(sim) == [0.3, 0.0], axis=0).min() == 5
        through = sim.comm.allreduce(float(sim.fluid.inflow().sum()))
        assert through == pytest.approx(0.5 * 2.0, rel=1e-12)
        assert sim.accounts.values["momentum.x"] > 0.4 * 1000.0


def test_both_sides_of_a_sheet_start_alike():
    """Cells that it divides have a pressure on either side."""
    sheet = loaded(SCENES / "sheet.toml", "time.integrator=midpoint", "solids.sheet.initial.velocity=[0.5, 0.0]")
    with prepared(sheet) as sim:
        assert sim.fluid.extras is not None and len(sim.fluid.velocity.parts)
        assert left_over(sim) < 1e-9
        parts = sim.fluid.velocity.parts[sim.fluid.sheets.table.axis == 1]
        sim.advance()
        assert len(parts) and sim.divergence() < 1e-8


def test_a_start_that_fits_is_left_alone(monkeypatch):
    """Nothing is solved for where all is at rest, or moves alike."""

    def solve(*_):
        raise AssertionError("something was solved")

    monkeypatch.setattr(LinearSolver, "solve", solve)
    for velocity in ([0.0, 0.0], [0.3, -0.2]):
        scene = box({"disk": disk(velocity)}, sides=PERIODIC, initial={"velocity": velocity})
        with prepared(scene, comm=COMM) as sim:
            assert np.all(velocities(sim) == velocity) and not sim.notes


@pytest.mark.parametrize("young, dt, steps", [(1e6, 2.7e-3, 20), (1e9, 0.01, 20)], ids=["soft", "stiff"])
def test_midpoint_keeps_the_energy_of_a_body_set_off_at_once(young, dt, steps):
    """The soft one swings in ten steps; with velocities as given it has 6% more in twenty, 44 times it in sixty."""
    free = disk([1.0, 0.0], young=young, radius=0.3, density=1500.0)
    with prepared(box({"disk": free}, "midpoint", size=2.0, dt=dt)) as sim:
        sim.advance()
        first, others = held(sim), []
        for _ in range(steps):
            sim.advance()
            others.append(held(sim))
    assert np.abs(np.array(others) / first - 1).max() < 0.01


def held(sim):
    return sim.accounts.values["kinetic"] + sim.accounts.values["elastic"]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("body", [False, True])
def test_jets_that_balance_at_every_steps_end_may_not_at_the_start(body):
    """A source makes up for that instant; a side whose parts balance may be the only one that lets fluid in."""
    sides = {"left": {"inflow": {"speed": 0.1}}, "right": {"inflow": {"speed": "-0.1*where(t>0,1,0)"}}}
    solids = {"d": disk([0.0, 0.0])} if body else {}
    profile = {"left": {"inflow": {"speed": "0.1*y"}}}
    for chosen in (sides, profile):
        with prepared(box(solids, sides=chosen, cells=16)) as sim:
            sim.advance()
            sim.advance()
            assert sim.divergence() < 1e-9


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("density", [1.0, 2000.0, 1e15])
def test_a_start_that_fits_leaves_nothing_and_shows_it(density):
    """The first row of divergence is that of the velocities there, not what solvers were tried on."""
    sides = dict.fromkeys(("left", "right"), "periodic")
    flies = disk([1.0, 0.0], radius=0.3, density=density)
    with prepared(box({"d": flies}, sides=sides, cells=16, initial={"velocity": [1.0, 0.0]})) as sim:
        assert sim.divergence() < 1e-14
    swirls = box({}, sides=sides, cells=16, initial={"velocity": ["sin(pi*y/1.1)", 0.0]})
    with prepared(swirls) as sim:
        assert sim.divergence() < 1e-14
