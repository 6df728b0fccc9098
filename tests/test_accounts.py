"""The conservation accounts: what must stay stays, what is done is entered, on any number of ranks."""

from contextlib import contextmanager

import numpy as np
import pytest
from mac_cases import reader, whole
from mpi4py import MPI

from petfsi.bench import column
from petfsi.bench.case import only_options
from petfsi.errors import InputError
from petfsi.scene.load import scene_from_dict
from petfsi.simulation import Simulation
from petfsi.solving.regions import ClosedRegions

COMM = MPI.COMM_WORLD
PERIODIC = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")


def scene(integrator="midpoint", dt=0.01, transfer="cutcell", **parts):
    data = {
        "dim": 2,
        "time": {"end": 1e3 * dt, "dt": dt, "integrator": integrator},
        "coupling": {"transfer": transfer},
    }
    return data | parts


def fluid(cells=(16, 16), **more):
    return {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": list(cells), **more}


def solid(origin, size, cells, **more):
    shape = {"box": {"origin": origin, "size": size, "cells": cells}}
    return {"shape": shape, "density": 800.0, "young": 1e5, "poisson": 0.3, **more}


@contextmanager
def simulation(data, options="monolithic-direct.opts"):
    with only_options(["-options_file", options]):
        sim = Simulation(COMM, scene_from_dict(data) if isinstance(data, dict) else data)
        sim.prepare()
        yield sim
        sim.solver.reset()  # at once on all ranks


def history(data, steps):
    """Return each column at the start and after every step."""
    with simulation(data) as sim:
        rows = [sim.accounts.values]
        for _ in range(steps):
            sim.advance()
            rows.append(sim.accounts.values)
    assert all(row.keys() == rows[0].keys() for row in rows)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


# ---- identities ---------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_fluid_and_a_solid_that_move_alike_keep_everything(integrator):
    drift = [0.3, -0.2]
    data = scene(
        integrator,
        fluid=fluid(sides=PERIODIC, initial={"velocity": drift}),
        solids={"block": solid([0.31, 0.42], [0.3, 0.2], [4, 3], initial={"velocity": drift})},
    )
    got = history(data, 12)
    mass = 1000.0 * (1 - 0.3 * 0.2) + 800.0 * 0.3 * 0.2
    # the masses of faces and slivers add up, but for those at the block's corners: there the walls have no normal
    np.testing.assert_allclose(got["momentum.x"], 0.3 * mass, rtol=2.5e-3)
    np.testing.assert_allclose(got["momentum.y"], -0.2 * mass, rtol=2.5e-3)
    np.testing.assert_allclose(got["kinetic"], 0.5 * mass * (0.3**2 + 0.2**2), rtol=2.5e-3)
    assert np.abs(got["energy_residual"]).max() < 2.5e-3 * got["kinetic"][0]
    np.testing.assert_allclose(got["region_volume.1"], 1 - 0.3 * 0.2, rtol=1e-9)


@pytest.mark.parallel([1, 2])
def test_a_fluid_at_rest_around_a_held_solid_keeps_its_energies():
    held = [{"where": "all", "fix": ["x", "y"]}]
    data = scene(
        "bdf2", gravity=[0.0, -9.81], fluid=fluid(sides={"top": "open"}),
        solids={"block": solid([0.31, 0.42], [0.3, 0.2], [4, 3], supports=held)},
    )  # fmt: skip
    got = history(data, 5)
    assert "region_volume.1" not in got  # it is open above
    for name, values in got.items():
        assert np.abs(values).max() < 1e-9, name  # of a weight of 10 kJ


@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_a_closed_box_only_loses(integrator, transfer):
    data = scene(
        integrator, transfer=transfer, fluid=fluid(),
        solids={"block": solid([0.26, 0.32], [0.3, 0.2], [4, 3], initial={"velocity": ["1e-3*cos(9*x)", "1e-3"]})},
    )  # fmt: skip
    got = history(data, 15)
    assert got["energy_residual"][-1] < -0.05 * got["kinetic"][0]
    assert np.all(np.diff(got["energy_residual"]) < 1e-3 * got["kinetic"][0])
    assert np.abs(got["boundary_work"]).max() < 1e-5 * got["kinetic"][0]  # what closes the volume is all there is
    if transfer == "cutcell":
        # the start is no flow yet: nodes go half of their first step with its velocities
        np.testing.assert_allclose(got["region_volume.1"][2:], got["region_volume.1"][2], rtol=1e-8)


@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_what_falls_gains_what_gravity_does(integrator):
    data = scene(integrator, gravity=["2*t", -9.81], solids={"block": solid([0, 0], [0.3, 0.2], [3, 2])})
    got = history(data, 10)
    h, m = 0.01, 800.0 * 0.06
    np.testing.assert_allclose(got["momentum.y"], -9.81 * m * h * np.arange(11), rtol=1e-9, atol=1e-9)
    # newmark lets the force at the end of a step act all the time: half of the step's growth too much
    u = 2 * h * h * np.cumsum(np.arange(11))
    way = h / 2 * np.concatenate(([0.0], np.cumsum(u[1:] + u[:-1])))
    too_much = m * h * way if integrator == "newmark" else 0.0
    np.testing.assert_allclose(got["kinetic"], -got["potential"] + too_much, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got["energy_residual"], too_much, rtol=1e-9, atol=1e-12)
    assert not {"region_volume.1", "momentum.z"} & got.keys()


def forced(integrator="midpoint", **damping):
    """A layer between waters that are open above and below, driven at its foot, all at small amplitude."""
    sides = [{"where": side, "fix": ["x"]} for side in ("left", "right")]
    foot = {"where": "bottom", "fix": ["x", "y"], "velocity": {"y": "1e-4*sin(30*t)"}}
    block = solid([0.0, 0.23], [1.0, 0.2], [4, 3], supports=[*sides, foot], damping=damping)
    return scene(integrator, fluid=fluid((4, 16), sides={"top": "open", "bottom": "open"}), solids={"block": block})


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("damping", [{}, {"mass": 3.0, "stiffness": 0.01}])
def test_supports_and_damping_are_entered_exactly(damping):
    got = history(forced(**damping), 40)
    assert np.abs(got["boundary_work"]).max() > 1e-9
    assert (np.diff(got["dissipated"]).min() > 0) == bool(damping)
    assert np.abs(got["energy_residual"]).max() < 1e-5 * np.abs(got["boundary_work"]).max()


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("held", [False, True])
def test_midpoint_keeps_the_energy_that_dead_loads_bring(held):
    foot = {"where": "bottom", "fix": ["x", "y"], "velocity": {"y": "0.1*sin(30*t)"} if held else {}}
    loads = [{"where": "right", "traction": [300.0, "1e3*y"]}, {"at": [0.1, 0.2], "force": [40.0, -20.0]}]
    block = solid(
        [0.0, 0.0], [0.3, 0.2], [4, 3], material="linear", supports=[foot], loads=loads, body_force=["1e3*x", 500.0]
    )
    got = history(scene("midpoint", gravity=[0.0, -9.81], solids={"block": block}), 60)
    most = np.abs(got["load_work"]).max()
    assert most > 0.01
    assert np.any(got["boundary_work"] != 0.0) == held
    assert np.abs(got["energy_residual"]).max() < 1e-11 * most
    columns = list(got)
    assert columns.index("load_work") == columns.index("boundary_work") - 1


@pytest.mark.parallel([1, 2])
def test_what_followers_and_timed_loads_do_is_entered_as_the_step_uses_it():
    """The linear material leaves nothing out, so that what is left is what the tangents of the loads leave out."""
    foot = {"where": "bottom", "fix": ["x", "y"], "displacement": {"x": "1e-4*sin(30*t)"}}
    loads = [
        {"where": "all", "pressure": "2e3*sin(20*t)"},
        {"where": "right", "traction": ["100*t", 9.0], "follower": True},
    ]
    block = solid([0.0, 0.0], [0.3, 0.2], [4, 3], material="linear", supports=[foot], loads=loads)
    got = history(scene("midpoint", solids={"block": block}), 60)
    assert np.abs(got["boundary_work"]).max() > 1e-4 < np.abs(got["load_work"]).max()
    assert np.abs(got["energy_residual"]).max() < 1e-11 * np.abs(got["load_work"]).max()


@pytest.mark.parallel([1, 2])
def test_loads_on_a_wet_solid_are_entered():
    """A layer between waters that are open above and below, loaded on both faces, all at small amplitude."""
    sides = [{"where": side, "fix": ["x"]} for side in ("left", "right")]
    top = {"where": "top", "traction": [0.0, "0.1*sin(20*t)*cos(pi*x)"]}
    loads = [top, {"where": "bottom", "pressure": "0.05*sin(9*t)"}]
    block = solid([0.0, 0.23], [1.0, 0.2], [4, 3], supports=sides, loads=loads)
    water = fluid((4, 16), sides={"top": "open", "bottom": "open"})
    got = history(scene("midpoint", fluid=water, solids={"block": block}), 40)
    assert np.abs(got["load_work"]).max() > 1e-8
    assert np.abs(got["energy_residual"]).max() < 1e-5 * np.abs(got["load_work"]).max()


def test_a_force_pays_for_what_it_throws():
    block = solid([0.0, 0.0], [0.3, 0.2], [3, 2], body_force=["600*t", 0.0])
    got = history(scene("midpoint", dt=0.01, solids={"block": block}), 10)
    mass, speed = 800.0 * 0.06, 600.0 / 800.0 * 0.1**2 / 2
    np.testing.assert_allclose(got["momentum.x"][-1], mass * speed, rtol=1e-9)
    np.testing.assert_allclose(got["load_work"][-1], mass * speed**2 / 2, rtol=1e-9)
    assert "load_work" not in history(scene(solids={"block": solid([0, 0], [0.3, 0.2], [1, 1])}), 1)


def test_what_sinks_gains_what_its_weight_does():
    block = solid([0.31, 0.53], [0.3, 0.2], [4, 3]) | {"density": 2000.0}
    got = history(scene(gravity=[0.0, -9.81], fluid=fluid(), solids={"block": block}), 10)
    sunk = -got["potential"] / (9.81 * 0.06 * 1000.0)  # m, under its weight less buoyancy
    assert 0.005 < sunk[-1] < 0.05
    stored = got["kinetic"] + got["elastic"]
    np.testing.assert_allclose(stored[2:], -got["potential"][2:], rtol=0.02)


def test_a_jet_pays_for_what_it_drives():
    """All water in a pipe is sped up: the work of the pressure on the piston is its energy."""
    sides = {"left": {"inflow": {"speed": "1e-4*t"}}, "right": "open"}
    got = history(scene(fluid=fluid((16, 8), sides=sides)), 20)
    assert got["boundary_work"][-1] > 0.0
    assert np.abs(got["energy_residual"]).max() < 0.05 * got["boundary_work"][-1]


def test_what_flows_through_leaves_no_trace():
    sides = {"left": {"inflow": {"speed": 0.5}}, "right": "open"}
    got = history(scene(fluid=fluid(sides=sides, initial={"velocity": [0.5, 0.0]})), 10)
    scale = got["kinetic"][0]
    for name in ("kinetic", "boundary_work", "energy_residual"):
        assert np.ptp(got[name]) < 1e-9 * scale, name


# ---- regions ------------------------------------------------------------------------------------------------


class Cells:
    """Stands in for a fluid of four cells."""

    n_cells, bounds = 4, None

    def __init__(self, *members):
        self.members, self.geometry_version = members, 0

    def closed_regions(self, touched):
        return [(np.array(member, dtype=float), True) for member in self.members]

    def volumes(self):
        return np.array([1.0, 2.0, 4.0, 8.0])

    def inflow(self):
        return None


class Empty:
    """Stands in for a system without couplings."""

    comm, couplings, index_sets = MPI.COMM_SELF, (), ()


@pytest.mark.parametrize(
    "later, wanted",
    [
        ([(1, 1, 0, 0), (0, 0, 0, 1)], [3.0, 8.0]),
        ([(1, 0, 0, 0), (0, 0, 1, 1)], [1.0, 12.0]),
        ([(0, 0, 1, 1), (1, 0, 0, 0)], [1.0, 12.0]),  # found in another order
        ([(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1)], [np.nan, 12.0]),  # divided
        ([(1, 1, 1, 1)], [np.nan, np.nan]),  # joined
        ([(0, 0, 0, 1)], [np.nan, 8.0]),  # opened or filled
    ],
)
def test_a_region_keeps_its_number_as_long_as_it_is_one(later, wanted):
    cells = Cells((1, 1, 0, 0), (0, 0, 1, 1))
    regions = ClosedRegions(Empty(), cells, None, decoupled=False)
    regions.find()
    assert regions.volumes.tolist() == [3.0, 12.0]
    cells.members, cells.geometry_version = later, 1
    regions.find()
    np.testing.assert_array_equal(regions.volumes, wanted)
    cells.geometry_version = 2
    regions.find()
    np.testing.assert_array_equal(regions.volumes, wanted)


# ---- state, ranks, options ----------------------------------------------------------------------------------


@pytest.mark.parallel([2])
def test_two_ranks_keep_the_books_of_one():
    got = history(forced("bdf2", stiffness=0.01), 10)
    with only_options(["-options_file", "monolithic-direct.opts"]):
        sim = Simulation(MPI.COMM_SELF, scene_from_dict(forced("bdf2", stiffness=0.01)))
        sim.prepare()
        for _ in range(10):
            sim.advance()
    for name, value in sim.accounts.values.items():
        scale = np.abs(got["momentum.y" if "momentum" in name else "boundary_work"]).max()
        assert got[name][-1] == pytest.approx(value, rel=1e-7, abs=1e-8 * scale), name


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_a_restored_state_keeps_the_same_books(integrator):
    """A box with water in it, in water, thrown: both regions are followed, and what was done so far is known."""
    throw = {"velocity": ["0.5*y", 0.1]}
    cavity = {"origin": [0.36, 0.37], "size": [0.3, 0.3]}
    box = solid([0.26, 0.27], [0.5, 0.5], [10, 10], damping={"stiffness": 0.001}, initial=throw)
    box["shape"]["cavity"] = cavity
    data = scene(integrator, gravity=[0.0, -9.81], fluid=fluid((20, 20)), solids={"box": box})
    # MUMPS on several ranks does not repeat itself bit for bit
    default = "monolithic.opts"
    with simulation(data, default) as sim, simulation(data, default) as other:
        for _ in range(4):
            sim.advance()
        stored = {name: {key: whole(COMM, slab) for key, slab in part.items()} for name, part in sim.state().items()}
        sim.solver.reset()
        other.solver.reset()
        other.restore(sim.step, sim.time, sim.dt, lambda name: reader(stored[name]))
        assert other.accounts.values == sim.accounts.values
        for _ in range(4):
            sim.advance()
            other.advance()
            assert other.accounts.values == sim.accounts.values
        assert sim.accounts.values["region_volume.2"] == pytest.approx(0.09, rel=0.1)


def test_without_accounts_there_are_no_columns():
    data = scene(fluid=fluid(), output={"accounts": False})
    with simulation(data) as sim:
        sim.advance()
        assert sim.accounts.columns == []
        assert "accounts" not in sim.state()


def test_accounts_are_true_or_false():
    with pytest.raises(InputError, match="output.accounts"):
        scene_from_dict(scene(fluid=fluid(), output={"accounts": "some"}))


# ---- a thousand steps ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("wide", [1, 32])
def test_midpoint_keeps_the_energy_of_the_column(wide, monkeypatch):
    """jobs/column.toml in its first mode, which the start of the job itself excites among others."""
    monkeypatch.setattr(column, "SPEED", 1e-6)
    given = column.Column(1.2, 64, wide).scene(COMM, 0.01)
    changes = {
        "coupling": given.coupling.model_copy(update={"transfer": "cutcell"}),
        "time": given.time.model_copy(update={"integrator": "midpoint"}),
    }
    got = history(given.model_copy(update=changes), 1000)
    assert np.ptp(got["elastic"]) > 0.4 * got["kinetic"][0]  # it does swing
    assert np.abs(got["energy_residual"]).max() < 1e-8 * got["kinetic"][0]
