"""Both sides of sheets thinner than a cell: water of its own on each, at rest or moving, on any number of ranks."""

import meshio
import numpy as np
import pytest
from mac_cases import reader, whole_state
from mpi4py import MPI
from step_cases import stored
from test_cutcell import DIRECT, PERIODIC, RHO

from petfsi.bench import theory
from petfsi.bench.case import simulation
from petfsi.scene.schema import Scene

N = 18


def own_part(fluid, array, axis):
    """Return the values and the coordinates of this rank's own faces of an axis (cells: None)."""
    part = fluid.grid.owned(axis)
    x = np.broadcast_arrays(*fluid.grid.coordinates(axis), array)[: fluid.dim]
    return array[part], [line[part] for line in x]


def sheared(dim, height, thickness, cells=N, **more):
    """Return a vortex above a sheet at rest across a closed box, over water at rest; smoke above."""
    low = height + thickness / 2
    depth = 1 - low
    u = f"pi/{depth}*sin(pi*x)*cos(pi*(y-{low})/{depth})/3"
    v = f"-pi*cos(pi*x)*sin(pi*(y-{low})/{depth})/3"
    velocity = [f"where(y>{height},{u},0)", f"where(y>{height},{v},0)", "0"][:dim]
    fluid = {"density": 1.0, "origin": [0.0] * dim, "size": [1.0] * dim, "cells": [cells] * dim}
    fluid |= {"initial": {"velocity": velocity}, "smoke": {"initial": f"where(y>{height},1,0)"}}
    shape = {"box": {"origin": [-1.0, height - thickness / 2, -1.0][:dim], "size": [3.0, thickness, 3.0][:dim]}}
    time = {"end": 10.0, "dt": 0.5 / cells, "integrator": more.pop("integrator", "bdf2")}
    return Scene.model_validate(
        {"dim": dim, "time": time, "fluid": fluid, "obstacles": {"sheet": {"shape": shape}}, **more}
    )


#: Where sheets lie: in a cell's middle, off it, in a plane of the grid, and walls of one cell and of two.
SHEETS = {
    "middle": (8.5 / N, 0.002),
    "off": (8.8 / N, 0.002),
    "plane": (8 / N, 0.002),
    "one cell": (8.5 / N, 1 / N),
    "two cells": (8 / N, 2 / N),
}


def see_rest_below(comm, name, integrator):
    height, thickness = SHEETS[name]
    with simulation(comm, sheared(2, height, thickness, integrator=integrator), DIRECT) as sim:
        for _ in range(12):
            sim.advance()
        for axis in range(2):
            v, x = own_part(sim.fluid, sim.fluid.velocity[axis], axis)
            assert np.abs(v[x[1] < height - 0.5 / N]).max(initial=0.0) < 1e-12
        smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
        assert np.abs(smoke[x[1] < height - thickness / 2 - 0.5 / N]).max(initial=0.0) == 0.0
        above = smoke[x[1] > height + thickness / 2 + 0.5 / N]
        assert np.abs(above - 1.0).max(initial=0.0) < 1e-14
        assert np.all(np.isin(np.round(sim.fluid.smoke_parts, 13), (0.0, 1.0)))


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
@pytest.mark.parametrize("name", SHEETS)
def test_water_below_a_sheet_stays_at_rest_and_clear(name, integrator):
    see_rest_below(MPI.COMM_SELF, name, integrator)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("name", ["middle", "off"])
def test_ranks_keep_the_sides_of_a_sheet_apart(name):
    see_rest_below(MPI.COMM_WORLD, name, "bdf2")


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("name", SHEETS)
def test_probes_and_pictures_see_one_side_at_a_time(name):
    height, thickness = SHEETS[name]
    with simulation(MPI.COMM_WORLD, sheared(2, height, thickness), DIRECT) as sim:
        for _ in range(12):
            sim.advance()
        for off in (1e-4, 0.01, 0.03):
            below, above = ([0.47, height + side * (thickness / 2 + off)] for side in (-1, 1))
            assert np.abs(sim.fluid.probe("velocity", below)).max() < 1e-12
            assert sim.fluid.probe("velocity", above)[0] > 1.5
            assert [sim.fluid.probe("smoke", at) for at in (below, above)] == pytest.approx([0.0, 1.0], abs=1e-14)
        drawn = sim.fluid.output()
        y = (drawn["kind"].start[1] + np.arange(drawn["kind"].data.shape[1]) + 0.5) / N
        under = y < height - thickness / 2 - 1e-9
        assert np.abs(drawn["velocity"].data[:, under]).max(initial=0.0) < 1e-12
        assert np.abs(drawn["smoke"].data[:, under]).max(initial=0.0) == 0.0


def test_a_sheet_in_space_keeps_its_sides_apart():
    height, thickness = 6.4 / 12, 0.002
    with simulation(MPI.COMM_SELF, sheared(3, height, thickness, 12), "monolithic.opts") as sim:
        for _ in range(3):
            sim.advance()
        for axis in range(3):
            v, x = own_part(sim.fluid, sim.fluid.velocity[axis], axis)
            assert np.abs(v[x[1] < height - 0.5 / 12]).max() < 1e-12
        smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
        assert np.abs(smoke[x[1] < height - 0.5 / 12]).max() == 0.0
        assert np.abs(smoke[x[1] > height + 0.5 / 12] - 1.0).max() < 1e-14


# ---- sheets that move -------------------------------------------------------------------------------------------


def piston(speed, start, end, integrator="bdf2", sides=None, dt=0.02):
    """Return a strip that is moved through water that moves alike, smoke to the right of where it begins."""
    held = [{"where": "all", "fix": ["x", "y", "angle"], "velocity": {"x": speed[0], "y": speed[1]}}]
    shape = {"beam": {"start": start, "end": end, "thickness": 0.004, "elements": 10}}
    fluid = {"density": RHO, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [N, N], "sides": sides or {}}
    slope = (end[0] - start[0]) / (end[1] - start[1])
    right = f"where(x>{start[0]}+{slope}*(y-{start[1]}),1,0)"
    fluid |= {"initial": {"velocity": [str(s) for s in speed]}, "smoke": {"initial": right}}
    solid = {"shape": shape, "supports": held, "young": 1e6, "poisson": 0.3, "density": RHO}
    time = {"end": 10.0, "dt": dt, "integrator": integrator}
    return Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "solids": {"body": solid}})


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_piston_carries_the_water_on_both_sides_and_mixes_none(integrator):
    """Across nine cells, each step nearly half of one."""
    scene = piston([0.9, 0.0], [0.31, 0.0], [0.31, 1.0], integrator, {"left": "open", "right": "open"}, dt=0.03)
    with simulation(MPI.COMM_WORLD, scene, DIRECT) as sim:
        for _ in range(18):
            sim.advance()
        place = 0.31 + 0.9 * sim.time
        for axis, speed in enumerate((0.9, 0.0)):
            v, _ = own_part(sim.fluid, sim.fluid.velocity[axis], axis)
            assert np.abs(v - speed).max() < 1e-10
        smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
        assert np.abs(smoke[x[0] < place - 0.51 / N]).max(initial=0.0) == 0.0
        assert np.abs(smoke[x[0] > place + 0.51 / N] - 1.0).max(initial=0.0) < 1e-14
        assert np.all(np.isin(np.round(sim.fluid.smoke_parts, 13), (0.0, 1.0)))


@pytest.mark.parallel([1, 2])
def test_a_slanting_sheet_mixes_no_smoke_as_it_crosses_cells():
    scene = piston([0.5, 0.2], [0.2, -0.3], [0.45, 1.1], sides=dict.fromkeys(PERIODIC, "open"))
    with simulation(MPI.COMM_WORLD, scene, "monolithic.opts") as sim:
        for _ in range(25):
            sim.advance()
        for axis, speed in enumerate((0.5, 0.2)):
            v, _ = own_part(sim.fluid, sim.fluid.velocity[axis], axis)
            assert np.abs(v - speed).max() < 1e-8
        smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
        side = x[0] - 0.5 * sim.time - 0.2 - 0.25 / 1.4 * (x[1] - 0.2 * sim.time + 0.3)
        assert np.abs(smoke[side < -0.6 / N]).max(initial=0.0) < 1e-12
        assert np.abs(smoke[side > 0.6 / N] - 1.0).max(initial=0.0) < 1e-12


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator, late", [("newmark", 1.0), ("bdf2", 0.0), ("midpoint", 0.5)])
@pytest.mark.parametrize("cells", [0.8, 1.4, 4.3])
def test_sheets_that_go_over_cells_in_a_step_mix_none(cells, integrator, late):
    """The schemes take their equations so many steps before the end: there the sheet is for the water behind it."""
    upright = ([0.9, 0.0], [0.31, 0.0], [0.31, 1.0], dict.fromkeys(("left", "right"), "open"))
    slanting = ([0.5, 0.2], [0.2, -0.3], [0.45, 1.1], dict.fromkeys(PERIODIC, "open"))
    for speed, start, end, sides in (upright, slanting):
        scene = piston(speed, start, end, integrator, sides=sides, dt=cells / N / speed[0])
        with simulation(MPI.COMM_WORLD, scene, "monolithic.opts") as sim:
            while sim.time < 0.4 / speed[0]:
                sim.advance()
            assert all(
                np.abs(own_part(sim.fluid, v, axis)[0] - speed[axis]).max() < 1e-8
                for axis, v in enumerate(sim.fluid.velocity)
            )
            smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
            slope = (end[0] - start[0]) / (end[1] - start[1])
            for t, beyond, inside in ((sim.time - late * sim.dt, -1.0, 0.0), (sim.time, 1.0, 1.0)):
                side = x[0] - speed[0] * t - start[0] - slope * (x[1] - speed[1] * t - start[1])
                assert np.abs(smoke[beyond * side > 0.6 / N] - inside).max(initial=0.0) < 1e-12


def thick_piston(cells, speed, integrator):
    """Return a wall so many cells thick that is moved through water; to its right smoke, and water that goes across."""
    n, start = 16, 4.96 / 16
    shape = {"origin": [start - cells / n / 2, 0.0], "size": [cells / n, 1.0], "cells": [1, 4]}
    held = [{"where": "all", "fix": ["x", "y"], "velocity": {"x": speed}}]
    body = {"shape": {"box": shape}, "supports": held, "young": 1e6, "poisson": 0.3, "density": RHO}
    right = f"where(x>{start},1,0)"
    fluid = {"density": RHO, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [n, n], "smoke": {"initial": right}}
    fluid |= {"sides": {"left": "open", "right": "open", "bottom": "periodic", "top": "periodic"}}
    fluid |= {"initial": {"velocity": [str(speed), right]}}
    time = {"end": 10.0, "dt": 0.02, "integrator": integrator}
    return Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "solids": {"body": body}}), start


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
@pytest.mark.parametrize("cells", [0.8, 1.0, 1.6, 2.2, 3.1, 4.1])
def test_walls_of_some_cells_that_move_mix_neither_smoke_nor_velocity(cells, integrator):
    speed = 0.3 / 16 / 0.02
    scene, start = thick_piston(cells, speed, integrator)
    with simulation(MPI.COMM_SELF, scene, "monolithic.opts") as sim:
        for _ in range(12):
            sim.advance()
            # where the grid is cut is a step behind
            place, far = start + speed * sim.time, (cells / 2 + 0.51 + 0.3) / 16
            for array, axis in ((sim.fluid.smoke, None), (sim.fluid.velocity[1], 1)):
                value, x = own_part(sim.fluid, array, axis)
                assert np.abs(value[x[0] < place - far]).max() < 1e-13
                assert np.abs(value[x[0] > place + far] - 1.0).max() < 1e-13


@pytest.mark.parametrize("low", [5.1, 5.3, 5.45])
def test_midpoint_leaks_nothing_through_a_wall_that_leaves_cells_nearly_shut(low):
    jet = {"speed": 1.0, "rest": "open", "region": {"box": {"origin": [0.2, -1.0], "size": [0.3, 3.0]}}}
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [12, 12]}
    fluid |= {"sides": {"top": {"inflow": jet}}}
    wall = {"shape": {"box": {"origin": [-1.0, low / 12], "size": [3.0, 1.1 / 12]}}}
    time = {"end": 10.0, "dt": 0.5 / 12, "integrator": "midpoint"}
    scene = Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "obstacles": {"wall": wall}})
    with simulation(MPI.COMM_SELF, scene, DIRECT) as sim:
        for _ in range(12):
            sim.advance()
        for axis in range(2):
            v, x = own_part(sim.fluid, sim.fluid.velocity[axis], axis)
            assert np.abs(v[x[1] < low / 12]).max() < 1e-11


def stepped(comm, scene, steps, state=None, checkpoint=None):
    """Return the whole state after steps, from another state if there is one; a checkpoint makes the solver forget."""
    with simulation(comm, scene, "monolithic.opts") as sim:
        if state is not None:
            sim.restore(*state[0], lambda name: reader(state[1][name]))
        for _ in range(steps):
            sim.advance()
            if sim.step == checkpoint:
                sim.forget()
        groups = {name: whole_state(AsField(sim.comm, slabs)) for name, slabs in sim.state().items()}
        return (sim.step, sim.time, sim.dt), groups


class AsField:
    """What ``whole_state`` asks of a field."""

    def __init__(self, comm, slabs):
        self.comm, self.slabs = comm, slabs

    def state(self):
        return self.slabs


def bent(integrator="bdf2", start=(0.22, 0.35), end=(0.79, 0.57)):
    """Return a free slanting strip in a vortex that bends and turns it, smoke above it."""
    shape = {"beam": {"start": list(start), "end": list(end), "thickness": 0.004, "elements": 12}}
    solid = {"shape": shape, "young": 1e9, "poisson": 0.3, "density": RHO, "initial": {"velocity": ["0.3", "0.2"]}}
    fluid = {"density": RHO, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [24, 24]}
    fluid |= {"initial": {"velocity": ["sin(pi*x)*cos(pi*y)", "-cos(pi*x)*sin(pi*y)"]}}
    fluid |= {"smoke": {"initial": "where(y>0.47+0.386*(x-0.5),1,0)"}}
    time = {"end": 1.0, "dt": 0.01, "integrator": integrator}
    return Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "solids": {"body": solid}})


def same(got, want):
    """Compare states, but for the pressure's level, which a closed box owes to a stiff strip's last digits."""
    for name, array in want.items():
        level = [np.mean(state[name]) if name.startswith("pressure") else 0.0 for state in (got, want)]
        scale = np.abs(array).max(initial=0.0)
        np.testing.assert_allclose(got[name] - level[0], array - level[1], rtol=0, atol=1e-7 * scale, err_msg=name)


@pytest.mark.parallel([2, 3, 4])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_a_strip_bends_alike_on_any_number_of_ranks(integrator):
    states = [stepped(comm, bent(integrator), 10)[1]["pressure"] for comm in (MPI.COMM_SELF, MPI.COMM_WORLD)]
    assert len(states[0]["parts_axis"]) > 40
    same(states[1], states[0])


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_both_sides_of_a_strip_come_back_from_a_checkpoint(integrator):
    """Bit for bit on as many ranks."""
    comm = MPI.COMM_WORLD
    # it divides the same cells as at the start for a while
    lasting = bent(integrator, [0.367, 0.35], [0.645, 0.36])
    quick = piston([0.9, 0.1], [0.2, -0.3], [0.45, 1.1], integrator, dict.fromkeys(PERIODIC, "open"), dt=0.06)
    for scene in (bent(integrator), lasting, quick):
        _, whole = stepped(comm, scene, 8, checkpoint=5)
        _, parts = stepped(comm, scene, 3, stepped(comm, scene, 5))
        assert not [
            (group, name)
            for group, arrays in whole.items()
            for name, array in arrays.items()
            if not np.array_equal(array, parts[group][name])
        ]


@pytest.mark.parallel([2])
def test_a_strip_goes_on_alike_on_other_ranks():
    _, whole = stepped(MPI.COMM_SELF, bent(), 6)
    _, parts = stepped(MPI.COMM_WORLD, bent(), 2, stepped(MPI.COMM_SELF, bent(), 4))
    same(parts["pressure"], whole["pressure"])


# ---- the plate between two layers -------------------------------------------------------------------------------

THICKNESS, STIFFNESS = 0.002, 1000.0


def plate(cells, place):
    """Return a plate across a closed box that swings as cos(pi x), its water with it, and its angular frequency."""
    height, k = 0.5 + place / cells, np.pi
    above, below = 1 - height, height
    water = RHO / k * (1 / np.tanh(k * above) + 1 / np.tanh(k * below))
    omega = np.sqrt(STIFFNESS * k**4 / (RHO * THICKNESS + water))
    up, down = f"1e-7/sinh(pi*{above})", f"1e-7/sinh(pi*{below})"
    u = f"where(y>{height},{up}*sin(pi*x)*cosh(pi*(1-y)),-{down}*sin(pi*x)*cosh(pi*y))"
    v = f"where(y>{height},{up}*cos(pi*x)*sinh(pi*(1-y)),{down}*cos(pi*x)*sinh(pi*y))"
    shape = {"start": [0.0, height], "end": [1.0, height], "thickness": THICKNESS, "elements": 32}
    solid = {"shape": {"beam": shape | {"theory": "euler-bernoulli"}}, "density": RHO, "poisson": 0.0}
    solid |= {"young": 12 * STIFFNESS / THICKNESS**3, "initial": {"velocity": ["0", "1e-7*cos(pi*x)"]}}
    solid |= {"supports": [{"where": end, "fix": ["x", "angle"]} for end in ("start", "end")]}
    fluid = {"density": RHO, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [cells, cells]}
    scene = {"dim": 2, "fluid": fluid | {"initial": {"velocity": [u, v]}}, "solids": {"plate": solid}}
    scene["time"] = {"end": 100.0, "dt": 2 * np.pi / omega / 50, "integrator": "bdf2"}
    scene["probes"] = {"middle": {"of": "plate", "at": [0.0, height], "quantity": "displacement"}}
    return Scene.model_validate(scene), omega


def test_a_plate_inside_a_cell_swings_with_second_order():
    modes, damping = [], []
    for cells in (8, 16, 32):
        scene, omega = plate(cells, 0.4)
        # not by LU: the beam does not give way to a pressure that both rooms have in common
        with simulation(MPI.COMM_SELF, scene, "monolithic.opts") as sim:
            swing = []
            for _ in range(75):
                sim.advance()
                swing.append(sim.probe()[1])
        t = sim.dt * np.arange(1, 76)
        seen, lost = theory.fit_damped_sinusoid(t[6:], np.array(swing[6:]), omega, 0.0)
        modes.append(theory.undo("bdf2", seen, sim.dt) / omega - 1)
        damping.append(lost / omega - theory.observed("bdf2", omega, sim.dt)[1] / omega)
    steps = np.diff(modes)
    assert np.log2(steps[0] / steps[1]) == pytest.approx(2.0, abs=0.25), modes
    assert abs(modes[-1]) < 2e-3, modes
    assert np.abs(damping[1:]).max() < 2e-5, damping


# ---- sheets beside other things ---------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
def test_buoyancy_at_links_that_come_and_go_is_entered():
    """A box that turns above a strip divides other cells in every step."""
    scene = {
        "dim": 2, "gravity": [0.5, -9.81], "time": {"end": 1.0, "dt": 0.01, "integrator": "bdf2"},
        "fluid": {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [20, 20],
                  "smoke": {"initial": "where(x>0.5,1,0)", "buoyancy": 0.1},
                  "sides": {"left": "periodic", "right": "periodic", "top": "open"}},
        "solids": {"ring": {"shape": {"box": {"origin": [0.42, 0.4], "size": [0.4, 0.4], "cells": [8, 8]}},
                            "density": 2.0, "young": 2000.0, "poisson": 0.3,
                            "initial": {"velocity": ["-10*(y-0.6)", "10*(x-0.62)"]}}},
        "obstacles": {"strip": {"shape": {"box": {"origin": [0.0, 0.27], "size": [0.45, 0.002]}}}},
    }  # fmt: skip
    with simulation(MPI.COMM_WORLD, Scene.model_validate(scene), "monolithic.opts") as sim:
        tables = set()
        for _ in range(6):
            sim.advance()
            tables.add(len(sim.fluid.sheets.table))
            assert np.all(np.isfinite(list(sim.accounts.values.values())))
        assert len(tables) > 1


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_flow_too_fast_for_one_sweep_stays_on_its_side_of_a_sheet(integrator):
    """Above the sheet a parallel flow from rest to seven cells a step, which is steady; below, rest."""
    height, speed = 8.8 / N, 7.0 / N / 0.1
    profile = f"{speed}*(y-{height})/{1 - height}"
    scene = sheared(2, height, 0.002, integrator=integrator).model_dump(exclude_unset=True)
    scene["fluid"] |= {
        "initial": {"velocity": [f"where(y>{height},{profile},0)", "0"]},
        "smoke": {"initial": f"where(y>{height},1+sin(2*pi*x),0)"},
        "sides": {"left": "periodic", "right": "periodic"},
    }
    scene["time"] |= {"dt": 0.1}
    with simulation(MPI.COMM_WORLD, Scene.model_validate(scene), DIRECT) as sim:
        for _ in range(4):
            sim.advance()
        u, x = own_part(sim.fluid, sim.fluid.velocity[0], 0)
        open_water = np.abs(x[1] - height) > 0.5 / N
        exact = np.where(x[1] > height, speed * (x[1] - height) / (1 - height), 0.0)
        assert np.abs(u - exact)[open_water].max(initial=0.0) < 1e-11
        smoke, x = own_part(sim.fluid, sim.fluid.smoke, None)
        above = x[1] > height + 0.5 / N
        gone = speed * (x[1] - height) / (1 - height) * sim.time
        assert np.abs(smoke - 1 - np.sin(2 * np.pi * (x[0] - gone)))[above].max(initial=0.0) < 0.06
        assert np.abs(smoke[x[1] < height - 0.5 / N]).max(initial=0.0) == 0.0


# ---- walls about a cell thick that move, with water that slides along on one side --------------------------------


def strip(middle, normal, thick, length, n=24):
    """Return points and triangles of a strip about a point, across a direction in the plane."""
    along = np.array([-normal[1], normal[0]])
    reach = np.linspace(-length / 2, length / 2, n + 1)[:, None] * along
    k = np.arange(n)
    halves = np.stack(((k, k + 1, k + n + 2), (k, k + n + 2, k + n + 1)), axis=0).transpose(0, 2, 1).reshape(-1, 3)
    return np.concatenate([middle + reach + side * thick / 2 * normal for side in (1, -1)]), halves


def slab(middle, normal, thick, length, n=6):
    """Return points and tetrahedra of a square plate about a point, across a direction in space."""
    u, v = np.linalg.svd(normal[None])[2][1:]
    a, b = np.meshgrid(*[np.linspace(-length / 2, length / 2, n + 1)] * 2, indexing="ij")
    layer = middle + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    points = np.concatenate([layer + side * thick / 2 * normal for side in (-1, 1)])
    i, j = np.mgrid[:n, :n].reshape(2, -1)
    corner = [s * (n + 1) ** 2 + (i + p) * (n + 1) + j + q for s in (0, 1) for p in (0, 1) for q in (0, 1)]
    paths = [(0, 1, 3, 7), (0, 5, 1, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 6, 4, 7)]
    cells = np.concatenate([np.stack([corner[c] for c in path], axis=1) for path in paths])
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    mirrored = np.linalg.det(edges) < 0
    cells[mirrored] = cells[mirrored][:, [0, 2, 1, 3]]
    return points, cells


class SlidingWall:
    """A wall that moves through water that moves alike; on its normal's side that slides along, too, full of smoke.

    All is uniform on either side.
    """

    def __init__(self, cells, size, normal, middle, thick, speed, slide):
        self.cells, self.size, self.normal, self.middle = cells, size, normal, middle
        self.thick, self.speed, self.slide = thick, speed, slide

    def scene(self, mesh, integrator, dt):
        dim = len(self.cells)
        make, kind, length = (strip, "triangle", 3.0) if dim == 2 else (slab, "tetra", 3.2)
        points, parts = make(self.middle, self.normal, self.thick, length * max(self.size))
        meshio.write_points_cells(mesh, np.column_stack((points, np.zeros((len(points), 3 - dim)))), [(kind, parts)])
        axes = "xyz"[:dim]
        held = [{"where": "all", "fix": list(axes), "velocity": dict(zip(axes, self.speed, strict=True))}]
        body = {"shape": {"mesh": str(mesh)}, "supports": held, "young": 1e6, "poisson": 0.3, "density": RHO}
        off = "+".join(f"{c}*({x}-{m})" for c, x, m in zip(self.normal, axes, self.middle, strict=True))
        right = f"where({off}>0,1,0)"
        sides = ("left", "right", "bottom", "top", "back", "front")[: 2 * dim]
        fluid = {"density": RHO, "origin": [0.0] * dim, "size": self.size, "cells": self.cells}
        fluid |= {"smoke": {"initial": right}, "sides": dict.fromkeys(sides, "open")}
        velocity = [f"{v}+{s}*{right}" for v, s in zip(self.speed, self.slide, strict=True)]
        fluid |= {"initial": {"velocity": velocity}}
        time = {"end": 10.0, "dt": dt, "integrator": integrator}
        return Scene.model_validate({"dim": dim, "time": time, "fluid": fluid, "solids": {"body": body}})

    def error(self, sim, far):
        """Return the largest error of smoke and velocity on this rank, farther than that from the wall's middle."""
        fluid, worst = sim.fluid, 0.0
        quantities = [(fluid.smoke, None, 0.0, 1.0)]
        quantities += [(v, a, self.speed[a], self.slide[a]) for a, v in enumerate(fluid.velocity)]
        for array, axis, low, step in quantities:
            value, x = own_part(fluid, array, axis)
            aside = sum((x[b] - self.middle[b] - self.speed[b] * sim.time) * self.normal[b] for b in range(len(x)))
            worst = max(worst, np.abs(value - low - step * (aside > 0))[np.abs(aside) > far].max(initial=0.0))
        return worst


#: Walls nearly along the grid: cells, size, slope and thickness in cells of a wall, its heading, scheme, step, cells
#: that it goes in a step, and where it begins, in parts of the box.
THIN_WALLS = [
    ((17, 24), (0.892, 0.9034), 0.1311, 1.4666, 3.4843, "newmark", 0.01236, 0.3951, (0.589451, 0.470758)),
    ((23, 20), (0.8914, 0.8514), 0.1096, 1.0057, 4.1775, "bdf2", 0.03559, 0.5126, (0.418287, 0.520205)),
    ((14, 17), (0.6737, 0.6736), 1.7001, 0.7477, 1.4116, "midpoint", 0.02686, 0.5427, (0.504881, 0.456123)),
    ((18, 16), (0.8007, 0.7658), 0.0366, 1.0155, 3.0809, "midpoint", 0.01071, 0.5167, (0.411763, 0.571253)),
]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("cells, size, angle, thick, heading, integrator, dt, stride, at", THIN_WALLS)
def test_thin_slanting_walls_that_move_keep_water_apart(
    cells, size, angle, thick, heading, integrator, dt, stride, at, tmp_path
):
    """Cells that hold one side's water become the other's, and parts of sides, too."""
    h = min(np.divide(size, cells))
    normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    speed = stride * h / dt * np.array([np.cos(heading), np.sin(heading)])
    wall = SlidingWall(cells, size, normal, np.multiply(size, at), thick * h, speed, 0.8 * h / dt * along)
    with simulation(MPI.COMM_WORLD, wall.scene(tmp_path / "wall.vtk", integrator, dt), "monolithic.opts") as sim:
        for _ in range(12):
            sim.advance()
            # where the grid is cut is a step behind
            assert wall.error(sim, (thick / 2 + 0.72 + stride) * h) < 1e-9


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_a_thin_slanting_wall_that_moves_in_space_keeps_water_apart(integrator, tmp_path):
    """Faces that are mere slits between two steps, and open wide after the next cut, are of their own side's water."""
    h, dt = 1.0 / 12, 0.02
    normal = np.array([0.068, 0.047, 0.997])
    normal /= np.linalg.norm(normal)
    middle, speed = np.array([0.47, 0.52, 0.55]), h / dt * np.array([0.13, -0.19, -0.16])
    slide = 0.6 * h / dt * np.cross(normal, [0.08, -0.28, 0.0]) / 0.29
    wall = SlidingWall([12] * 3, [1.0] * 3, normal, middle, 1.76 * h, speed, slide)
    with simulation(MPI.COMM_SELF, wall.scene(tmp_path / "wall.vtk", integrator, dt), "monolithic.opts") as sim:
        for _ in range(6):
            sim.advance()
            assert wall.error(sim, (0.88 + 0.9 + 0.3) * h) < 1e-9


def test_a_film_between_two_sheets_in_a_cell_begins_with_the_scenes_smoke():
    """Also where it opens into rooms at its ends."""
    sheets = {}
    for name, low in (("lower", 0.50625), ("upper", 0.5395)):
        box = {"origin": [0.25, low], "size": [0.5, 0.002], "cells": [8, 1]}
        held = [{"where": "all", "fix": ["x", "y"]}]
        sheets[name] = {"shape": {"box": box}, "supports": held, "young": 1e6, "poisson": 0.3, "density": RHO}
    fluid = {"density": RHO, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16], "smoke": {"initial": 0.7}}
    time = {"end": 1.0, "dt": 0.01, "integrator": "bdf2"}
    scene = Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "solids": sheets})
    with simulation(MPI.COMM_SELF, scene, "monolithic.opts") as sim:
        assert len(sim.fluid.smoke_parts) > 8
        for _ in range(2):
            np.testing.assert_allclose(sim.fluid.smoke_parts, 0.7, rtol=0, atol=1e-12)
            sim.advance()


def test_a_fluid_that_comes_back_has_a_pattern_of_its_own():
    """As large and as full as that of the scene's start it would pass for it, and a product kept from there broke."""
    with simulation(MPI.COMM_SELF, bent(), "monolithic.opts") as sim:
        sim.advance()
        state, before = stored(sim), sim.fluid.pattern_version
        sim.restore(sim.step, sim.time, sim.dt, lambda group: reader(state[group]))
        sim.advance()
        assert sim.fluid.pattern_version > before
