"""Sides of a grid: jets through parts of them, given pressures, fluid at rest beyond, total pressure, oblique flow."""

import numpy as np
import pytest
from mpi4py import MPI
from test_two_sides import stepped

from petfsi.bench.case import simulation
from petfsi.errors import InputError
from petfsi.fields.mac.grid import kinds
from petfsi.runs.plan import describe_plan
from petfsi.scene.load import scene_from_dict

COMM = MPI.COMM_WORLD
RHO = 1000.0
INTEGRATORS = ["newmark", "bdf2", "midpoint"]


def scene(cells, sides, integrator="bdf2", dt=0.01, size=None, fluid=None, **more):
    dim = len(cells)
    table = {"density": RHO, "origin": [0.0] * dim, "size": size or [1.0] * dim, "cells": list(cells), "sides": sides}
    time = {"end": 1e3 * dt, "dt": dt, "integrator": integrator}
    return scene_from_dict({"dim": dim, "time": time, "fluid": table | (fluid or {})} | more)


def running(data, comm=COMM):
    return simulation(comm, data, "monolithic-direct.opts")


def own(fluid, axis):
    return fluid.velocity[axis][fluid.grid.owned(axis)]


def fastest(fluid):
    most = max(np.abs(own(fluid, axis)).max(initial=0.0) for axis in range(fluid.dim))
    return fluid.comm.allreduce(most, MPI.MAX)


def box(low, size):
    return {"shape": {"box": {"origin": low, "size": size}}}


# ---- jets ---------------------------------------------------------------------------------------------------


def test_a_jet_beside_faces_brings_its_part_and_the_momentum_of_that():
    region = {"box": {"origin": [-0.1, 0.32], "size": [0.2, 0.36]}}
    sides = {"left": {"inflow": {"speed": 1.0, "region": region}}, "right": "open"}
    with running(scene((8, 8), sides)) as sim:
        sim.advance()
        assert sim.accounts.values["momentum.x"] == pytest.approx(RHO * 0.36 * 7.5 / 8, rel=1e-11)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_jet_that_changes_leaves_what_it_drives_with_its_own_speed(integrator):
    """The energy of a full channel is that of the jet at the end of each step, and nothing swings after a jump."""
    for speed, exact in (
        ("cos(20*t)", lambda t: np.cos(20 * t)),
        ("1 + heaviside(t - 0.035)", lambda t: 1 + (t > 0.035)),
    ):
        with running(scene((8, 1), {"left": {"inflow": {"speed": speed}}, "right": "open"}, integrator)) as sim:
            for _ in range(12):
                sim.advance()
                wanted = RHO / 2 * exact(sim.time) ** 2 * 7.5 / 8
                assert sim.accounts.values["kinetic"] == pytest.approx(wanted, rel=0.02)


def test_what_a_jet_carries_comes_in_by_its_flux():
    """Through half a face at 2 m/s as much smoke as through a whole one at 1 m/s."""
    jet = {"speed": 2.0, "region": {"box": {"origin": [-0.1, 0.0], "size": [0.2, 0.25]}}, "smoke": 3.0}
    more = {"smoke": {}, "initial": {"velocity": [1.0, 0.0]}}
    data = scene((40, 1), {"left": {"inflow": jet}, "right": "open"}, dt=0.1, size=[10.0, 0.5], fluid=more)
    with running(data) as sim:
        for _ in range(40):
            sim.advance()
        smoke = sim.fluid.smoke[sim.fluid.grid.owned(None)].sum() * sim.fluid.grid.cell_volume
        assert smoke == pytest.approx(3.0 * 0.5 * sim.time, rel=0.01)


def test_the_power_of_a_jet_is_that_of_its_own_speed():
    """Half a face at 2 m/s goes on as a whole one at 1 m/s, and what is lost in that is in the residual."""
    region = {"box": {"origin": [-0.1, 0.0], "size": [0.2, 0.25]}}
    sides = {"left": {"inflow": {"speed": 2.0, "region": region}}, "right": "open"}
    data = scene((20, 1), sides, "midpoint", size=[10.0, 0.5], fluid={"initial": {"velocity": [1.0, 0.0]}})
    with running(data) as sim:
        for _ in range(3):
            sim.advance()
        power = 0.5 * (0.5 * RHO * 2.0**2 - 0.5 * RHO * 1.0**2)
        assert sim.accounts.values["boundary_work"] == pytest.approx(power * sim.time, rel=1e-10)
        assert sim.accounts.values["energy_residual"] == pytest.approx(-power * sim.time, rel=1e-10)


@pytest.mark.parametrize("height", [0.55, 0.502, 0.58])
def test_a_jet_that_ends_at_a_sheet_within_a_cell_stays_on_its_side(height):
    """It feeds the water above alone, which goes on as a plug; that below stays at rest."""
    region = {"box": {"origin": [-0.1, height + 0.005], "size": [0.2, 1.0]}}
    sides = {"left": {"inflow": {"speed": 1.0, "region": region, "smoke": 1.0}}, "right": "open"}
    walls = {"sheet": box([-1.0, height], [4.0, 0.01])}
    start = {"smoke": {}}
    with running(scene((8, 8), sides, "newmark", dt=0.05, obstacles=walls, fluid=start)) as sim:
        for _ in range(6):
            sim.advance()
        fluid, y = sim.fluid, (np.arange(8) + 0.5) / 8
        plain = np.abs(y - height) > 1 / 16 + 0.01
        still = np.where(y > height, 1.0, 0.0)
        assert np.abs(own(fluid, 0)[:, plain, 0] - still[plain]).max() < 1e-12
        parts = fluid.velocity.parts[fluid.sheets.table.axis == 0]
        assert len(parts) >= 14 and np.minimum(np.abs(parts), np.abs(parts - 1)).max() < 1e-12
        assert np.abs(own(fluid, 1)).max() < 1e-12
        assert np.all(fluid.smoke[fluid.grid.owned(None)][:, y < height - 1 / 16] == 0.0)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_an_inflow_says_what_obstacles_leave_of_it(transfer):
    """Cut cells: the exact part. Ray: whole cells."""

    def notes(low, high, side):
        jet = {"speed": "t", "region": box([-1.0, 0.25], [3.0, 0.25])["shape"]}
        sides = {"left": "open", "right": "open"} | {side: {"inflow": jet}}
        more = {"obstacles": {"block": box([-0.2, low], [1.4, high - low])}, "coupling": {"transfer": transfer}}
        with running(scene((8, 20), sides, **more)) as sim:
            return sim.fluid.notes

    for side in ("left", "right"):
        left = 0.11 if transfer == "cutcell" else 0.1
        said = f"fluid.sides.{side}.inflow: obstacles leave {left} of its 0.25 m open; what comes in is as much less"
        assert notes(0.1, 0.39, side) == [said]
        assert notes(0.6, 0.9, side) == []
        with pytest.raises(InputError, match=f"fluid.sides.{side}.inflow: obstacles cover all of it"):
            notes(0.1, 0.6, side)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("cells", [(14, 12), (12, 7, 6)])
def test_an_oblique_stream_through_inflows_stays_as_it_is(cells, integrator):
    U = [1.0, 0.5, 0.25][: len(cells)]
    names = [("left", "right"), ("bottom", "top"), ("back", "front")][: len(cells)]
    sides = {}
    for axis, (low, high) in enumerate(names):
        along = [0.0 if b == axis else u for b, u in enumerate(U)]
        sides |= {low: {"inflow": {"speed": U[axis], "along": along}}, high: "open"}
    with running(scene(cells, sides, integrator, dt=0.2, fluid={"initial": {"velocity": U}})) as sim:
        for _ in range(4):
            sim.advance()
        assert max(np.abs(own(sim.fluid, axis) - u).max(initial=0.0) for axis, u in enumerate(U)) < 1e-13


@pytest.mark.parametrize("upper", [False, True])
def test_velocity_along_an_inflow_is_carried_in(upper):
    jet = {"inflow": {"speed": 1.0, "along": [0.0, "0.5"]}}
    sides = {"right": jet, "left": "open"} if upper else {"left": jet, "right": "open"}
    sides |= {"bottom": "periodic", "top": "periodic"}
    data = scene((40, 3), sides, dt=0.02, size=[1.0, 0.075], fluid={"initial": {"velocity": [-1 if upper else 1, 0]}})
    with running(data) as sim:
        for _ in range(20):
            sim.advance()
        v = own(sim.fluid, 1)[::-1, 0, 0] if upper else own(sim.fluid, 1)[:, 0, 0]
    x = (np.arange(40) + 0.5) / 40
    assert np.abs(v - 0.5)[x < 0.25].max() < 0.01 and np.abs(v)[x > 0.55].max() < 0.01
    assert v.sum() / 40 == pytest.approx(0.5 * 0.4, abs=0.5 / 40)


# ---- given pressures ----------------------------------------------------------------------------------------


def channel(dim, integrator, **more):
    sides = {"left": {"pressure": "300 + 0*y"}, "right": {"pressure": 100.0}}
    return scene(
        (12, 7, 6)[:dim], sides, integrator, size=[2.0, 1.0, 1.0][:dim], fluid={"smoke": {"initial": 1.0}}, **more
    )


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_channel_between_two_pressures_speeds_up_as_they_differ(dim, integrator):
    with running(channel(dim, integrator)) as sim:
        for _ in range(5):
            sim.advance()
        assert np.abs(own(sim.fluid, 0) / (200.0 / (RHO * 2.0) * sim.time) - 1).max(initial=0.0) < 1e-12
        if integrator == "midpoint":
            assert abs(sim.accounts.values["energy_residual"]) < 1e-11 * sim.accounts.values["kinetic"]


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_so_it_does_between_walls_off_the_grid_and_along_a_sheet(integrator):
    walls = {
        "a": box([-1.0, -1.0], [4.0, 1.13]),
        "b": box([-1.0, 0.87], [4.0, 1.0]),
        "c": box([-1.0, 0.55], [4.0, 0.01]),
    }
    with running(channel(2, integrator, obstacles=walls)) as sim:
        for _ in range(5):
            sim.advance()
        wanted = 200.0 / (RHO * 2.0) * sim.time
        wet = np.isin(sim.fluid.face_kind[0][sim.fluid.grid.owned(0)], (kinds.PRESSURE, kinds.OPEN))
        assert np.abs(own(sim.fluid, 0)[wet] / wanted - 1).max() < 1e-11
        parts = sim.fluid.velocity.parts[sim.fluid.sheets.table.axis == 0]
        assert len(parts) > 20 and np.abs(parts / wanted - 1).max() < 1e-11
        if integrator == "midpoint":
            assert abs(sim.accounts.values["energy_residual"]) < 1e-11 * sim.accounts.values["kinetic"]


@pytest.mark.parametrize("integrator, order", [("newmark", 1), ("bdf2", 2), ("midpoint", 2)])
def test_a_pressure_that_changes_is_taken_where_the_scheme_takes_its_forces(integrator, order):
    errors = []
    for n in (10, 20, 40):
        sides = {"left": {"pressure": "1000*exp(2*t)"}, "right": "open"}
        with running(scene((4, 1), sides, integrator, dt=1.0 / n, size=[1.0, 0.25])) as sim:
            for _ in range(n):
                sim.advance()
            errors.append(abs(own(sim.fluid, 0).mean() - (np.exp(2.0) - 1) / 2))
    assert np.log2(errors[1] / errors[2]) == pytest.approx(order, abs=0.15)


# ---- fluid at rest beyond a side ----------------------------------------------------------------------------

STILL = {
    "as high as the grid": ([0.0, -9.81], {"right": "hydrostatic"}, {}),
    "a level": ([0.0, -9.81], {"right": {"hydrostatic": 0.7}, "left": {"hydrostatic": 0.7}}, {}),
    "an open top": ([0.0, -9.81], {"right": {"hydrostatic": 0.5}, "top": "open"}, {}),
    "any direction, of time": (["3*sin(5*t)", "-9.81*cos(t)"], {"right": "hydrostatic", "bottom": "hydrostatic"}, {}),
    "beside a slope": (
        [0.0, 9.81],
        {"right": {"hydrostatic": -0.1}},
        {"shape": {"ball": {"centre": [1.9, 0.2], "radius": 0.31}}},
    ),
    "beside a sheet": ([0.0, -9.81], {"right": "hydrostatic"}, box([1.6, 0.23], [0.5, 0.01])),
}


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
@pytest.mark.parametrize("name", STILL)
def test_still_water_beside_a_hydrostatic_side_stays_still(name, transfer, integrator):
    gravity, sides, obstacle = STILL[name]
    if obstacle and transfer == "ray":
        pytest.skip("obstacles of whole cells")
    more = {"gravity": gravity, "coupling": {"transfer": transfer}, "obstacles": {"post": obstacle} if obstacle else {}}
    with running(scene((16, 8), sides, integrator, dt=0.02, size=[2.0, 0.5], **more)) as sim:
        for _ in range(5):
            sim.advance()
        assert fastest(sim.fluid) < 1e-13
    if name == "a level" and transfer == "cutcell":
        assert sim.fluid.probe("pressure", [1.0, 0.1]) == pytest.approx(RHO * 9.81 * 0.6, rel=1e-12)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_it_does_in_space_and_around_a_held_solid(transfer):
    shape = {"box": {"origin": [0.37, 0.1, 0.3], "size": [0.31, 0.5, 0.29], "cells": [2, 3, 2]}}
    supports = [{"where": "all", "fix": ["x", "y", "z"]}]
    solid = {"shape": shape, "density": 2 * RHO, "young": 1e6, "poisson": 0.3, "supports": supports}
    more = {"gravity": [1.0, -9.81, 2.0], "coupling": {"transfer": transfer}, "solids": {"block": solid}}
    sides = dict.fromkeys(("left", "right", "back"), {"hydrostatic": 2.0})
    with running(scene((18, 8, 7), sides, "bdf2", dt=0.02, **more)) as sim:
        for _ in range(3):
            sim.advance()
        assert fastest(sim.fluid) < 1e-12


def test_faces_of_a_side_that_a_body_uncovers_have_its_pressure_at_once():
    """What a level adds everywhere moves nothing."""
    speeds = []
    for level in (1.0, 3.0):
        shape = {"box": {"origin": [0.81, 0.1], "size": [0.4, 0.23], "cells": [3, 3]}}
        support = {"where": "all", "fix": ["x", "y"], "velocity": {"y": 0.5}}
        solid = {"shape": shape, "density": RHO, "young": 1e6, "poisson": 0.3, "supports": [support]}
        sides, more = {"right": {"hydrostatic": level}}, {"gravity": [0.0, -9.81], "solids": {"block": solid}}
        with running(scene((16, 16), sides, dt=0.02, **more)) as sim:
            speeds.append([])
            for _ in range(12):
                sim.advance()
                speeds[-1].append(fastest(sim.fluid))
    np.testing.assert_allclose(speeds[0], speeds[1], rtol=1e-11)
    assert max(speeds[0]) < 2.5


def test_a_scene_tells_of_sides_that_are_open_below_the_top():
    weight, sides = {"gravity": [0.0, -9.81]}, {"right": "open", "top": "open"}
    for data, wanted in (
        (scene((8, 8), sides, **weight), 1),
        (scene((8, 8), {"right": "hydrostatic", "top": "open"}, **weight), 0),
        (scene((8, 8), {"bottom": "open", "left": {"inflow": {"speed": 1.0, "rest": "open"}}}, **weight), 2),
        (scene((8, 8), sides), 0),
        (scene((8, 8), {"right": "open"}, gravity=["9.81*sin(t)", 0.0]), 1),
    ):
        assert describe_plan(data).count('"open": p = 0 at every depth') == wanted
    with running(scene((8, 8), sides, **weight)) as sim:
        assert len(sim.fluid.notes) == 1 and "fluid.sides.right" in sim.fluid.notes[0]


def test_a_level_needs_gravity_and_particles_have_no_such_sides():
    with pytest.raises(InputError, match='fluid.sides.right = "hydrostatic": .* gravity'):
        scene((8, 8), {"right": {"hydrostatic": 1.0}})
    for side in ("hydrostatic", {"pressure": 1.0}, {"inflow": {"speed": 1.0, "along": [0.0, 1.0]}}):
        table = {"kind": "sph", "spacing": 0.1, "fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, 1.0]}}]}
        with pytest.raises(InputError, match="fluid.sides.right"):
            scene_from_dict(
                {
                    "dim": 2,
                    "gravity": [0.0, -9.81],
                    "time": {"end": 1.0, "dt": 0.1, "integrator": "bdf2"},
                    "fluid": table | {"density": RHO, "origin": [0, 0], "size": [1, 1], "sides": {"right": side}},
                }
            )


# ---- the total pressure of what comes in --------------------------------------------------------------------


def driven(integrator, dt, **more):
    """A channel of 2 m driven by a total pressure of 500 Pa: v = tanh(t/4) m/s."""
    sides = {"left": {"pressure": 500.0, "entering": "total"}, "right": {"pressure": 0.0, "entering": "total"}}
    return scene((12, 7), sides, integrator, dt=dt, size=[2.0, 1.0], **more)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_total_pressure_drives_a_channel_to_its_speed_at_any_step(integrator):
    with running(driven(integrator, 4.0)) as sim:
        for _ in range(40):
            sim.advance()
        assert np.abs(own(sim.fluid, 0) - 1.0).max(initial=0.0) < 1e-12
        if integrator == "midpoint":
            assert abs(sim.accounts.values["energy_residual"]) < 1e-11 * sim.accounts.values["kinetic"]


@pytest.mark.parametrize("integrator, order", [("newmark", 1), ("bdf2", 2), ("midpoint", 2)])
def test_it_does_so_with_the_schemes_order(integrator, order):
    errors = []
    for n in (10, 20, 40):
        with running(driven(integrator, 2.0 / n)) as sim:
            for _ in range(n):
                sim.advance()
            errors.append(abs(own(sim.fluid, 0).mean() - np.tanh(0.5)))
    assert np.log2(errors[1] / errors[2]) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_it_does_so_alike_along_a_sheet(integrator):
    walls = {"a": box([-1.0, -1.0], [4.0, 1.13]), "c": box([-1.0, 0.55], [4.0, 0.01])}
    with running(driven(integrator, 0.5)) as plain, running(driven(integrator, 0.5, obstacles=walls)) as sim:
        for _ in range(6):
            plain.advance()
            sim.advance()
        parts = sim.fluid.velocity.parts[sim.fluid.sheets.table.axis == 0]
        assert len(parts) > 20 and np.abs(parts / own(plain.fluid, 0).mean() - 1.0).max() < 1e-12
        if integrator == "midpoint":
            assert abs(sim.accounts.values["energy_residual"]) < 1e-11 * sim.accounts.values["kinetic"]


def entrained(entering):
    """What comes in beside a jet of 1 m/s through all other sides after 2 s, over what the jet brings."""
    rest = {"pressure": 0.0, "entering": entering}
    jet = {"speed": 1.0, "region": {"box": {"origin": [-0.1, 0.4], "size": [0.2, 0.2]}}, "rest": rest, "ramp": 0.2}
    sides = {"left": {"inflow": jet}} | dict.fromkeys(("right", "bottom", "top"), rest)
    with running(scene((20, 20), sides, dt=0.04)) as sim:
        for _ in range(50):
            sim.advance()
        flow = 0.0
        for axis in (0, 1):
            v, kind = np.moveaxis(own(sim.fluid, axis), axis, 0), sim.fluid.face_kind[axis][sim.fluid.grid.owned(axis)]
            kind = np.moveaxis(kind, axis, 0)
            for end, sign in ((0, 1.0), (-1, -1.0)):
                flow += np.maximum(sign * v[end], 0.0)[kind[end] == kinds.OPEN].sum() / 20
    return flow / 0.2


def test_a_jet_beside_sides_of_given_total_pressure_entrains_little():
    assert entrained("static") > 4.0
    assert entrained("total") < 1.6


# ---- going on -----------------------------------------------------------------------------------------------


def everything(integrator):
    """Jets through parts of sides, along them and of time, all kinds of pressure, a free body, smoke."""
    region = {"ball": {"centre": [0.0, 0.5], "radius": 0.23}}
    rest = {"pressure": "20*sin(9*t)", "entering": "total"}
    jet = {"speed": "1 + t", "along": [0.0, "0.3*cos(t)"], "region": region, "rest": rest, "smoke": 1.0}
    sides = {"left": {"inflow": jet}, "right": {"hydrostatic": 1.1, "entering": "total"}, "top": "open"}
    shape = {"beam": {"start": [0.52, 0.25], "end": [0.79, 0.57], "thickness": 0.004, "elements": 6}}
    solid = {"shape": shape, "young": 1e8, "poisson": 0.3, "density": RHO}
    more = {"fluid": {"smoke": {"buoyancy": 0.1}}, "gravity": ["0.5*sin(t)", -9.81]}
    more |= {"solids": {"strip": solid}}
    return scene((18, 14), sides, integrator, dt=0.03, **more)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_all_of_it_comes_back_from_a_checkpoint_bit_for_bit(integrator):
    data = everything(integrator)
    _, whole = stepped(COMM, data, 5, checkpoint=3)
    _, parts = stepped(COMM, data, 2, stepped(COMM, data, 3))
    for group, arrays in whole.items():
        for name, array in arrays.items():
            assert np.array_equal(array, parts[group][name]), (group, name)


@pytest.mark.parallel([2, 3, 4])
def test_all_of_it_is_alike_on_any_number_of_ranks():
    got, want = (stepped(comm, everything("bdf2"), 4)[1] for comm in (COMM, MPI.COMM_SELF))
    for name, array in want["pressure"].items():
        scale = np.abs(array).max(initial=0.0)
        np.testing.assert_allclose(got["pressure"][name], array, rtol=0, atol=1e-7 * scale, err_msg=name)
    work = [state["accounts"]["boundary_work"][0] for state in (got, want)]
    assert work[0] == pytest.approx(work[1], rel=1e-6)
