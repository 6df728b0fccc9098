"""Closed regions keep their volume: at the end of every step, whatever closes them, on any number of ranks."""

from pathlib import Path

import meshio
import numpy as np
import pytest
from load_cases import COMM
from mpi4py import MPI
from scipy.sparse import csr_matrix
from step_cases import loaded, prepared
from test_accounts import fluid, scene, solid
from test_restart import goes_on

from petfsi.couplings.enclosure import Enclosure
from petfsi.errors import SolveError
from petfsi.fields.mac.walls.cut import Walls
from petfsi.geometry.slabs import area_vectors
from petfsi.scene.load import scene_from_dict

DIRECT = ("-options_file", "monolithic-direct.opts")
JOBS = Path(__file__).parents[1] / "jobs"


def kept(data, steps, *options, comm=COMM):
    """Return the volume of each region, over that at the start, after every step, and the simulation."""
    data = scene_from_dict(data) if isinstance(data, dict) else data
    with prepared(data, *(options or DIRECT), comm=comm) as sim:
        rows = [sim.regions.volumes]
        for _ in range(steps):
            sim.advance()
            rows.append(sim.regions.volumes)
    return np.array(rows) / rows[0], sim


def box_with_water(origin, thrown):
    """A soft box with water in it, thrown so that it turns and is pulled out of shape."""
    shape = {"origin": origin, "size": [0.36, 0.36], "cells": [6, 6]}
    cavity = {"origin": [origin[0] + 0.06, origin[1] + 0.06], "size": [0.24, 0.24]}
    return {
        "shape": {"box": shape, "cavity": cavity}, "density": 800.0, "young": 1e5, "poisson": 0.3,
        "initial": {"velocity": thrown},
    }  # fmt: skip


# ---- volumes as polynomials -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_the_change_of_volume_is_exact_for_any_way(dim):
    rng = np.random.default_rng(dim)
    n = {2: 7, 3: 4}[dim]
    if dim == 2:
        angle = 2 * np.pi * np.arange(n) / n
        points = np.column_stack((np.cos(angle), np.sin(angle)))
        facets = np.column_stack((np.arange(n), (np.arange(n) + 1) % n))
    else:
        points, facets = rng.normal(size=(4, 3)), np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

    def enclosed(x):
        return np.linalg.det(x[facets]).sum() / (2.0 if dim == 2 else 6.0)

    area = area_vectors(points, facets)
    # every facet is one patch, in one cell, of the only region
    facet, axis = np.repeat(np.arange(len(facets)), dim), np.tile(np.arange(dim), len(facets))
    flux = np.repeat(-area.ravel()[:, None] / dim, dim, axis=1)
    walls = Walls(facet, axis, np.full(len(facet), 5), flux)
    nothing = csr_matrix((1, points.size))
    around = Enclosure(points, facets, np.arange(len(facets)), len(facets), walls, 5, nothing, [np.ones(1)])
    there = points + rng.normal(size=points.shape)
    assert around.change(there)[0] == pytest.approx(enclosed(points) - enclosed(there), rel=1e-13)


# ---- steps ----------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("integrator, most", [("newmark", 1e-5), ("bdf2", 1e-10), ("midpoint", 1e-10)])
def test_several_regions_and_bodies_keep_their_volumes(integrator, most):
    """Two boxes with water in them, in a closed box of water: three regions, of which one lies around both bodies."""
    data = scene(
        integrator, gravity=[0.0, -9.81], fluid=fluid((20, 20)),
        solids={
            "left": box_with_water([0.07, 0.31], ["0.4*(y - 0.5)", "0.5*x"]),
            "right": box_with_water([0.55, 0.28], ["-0.3*y", "0.4*(x - 0.7)"]),
        },
    )  # fmt: skip
    ratio, sim = kept(data, 12, "-options_file", "monolithic.opts")
    assert ratio.shape[1] == 3
    assert np.abs(ratio - 1).max() < most, ratio - 1
    # it is the boxes' bending that would change them
    assert np.abs(sim.solid.moved).max(initial=0.0) > 1e-4
    assert sim.accounts.values["energy_residual"] < 0 or integrator == "midpoint"


def test_a_box_in_three_dimensions_keeps_its_volume():
    box = {"origin": [0.21, 0.22, 0.23], "size": [0.5, 0.5, 0.5], "cells": [5, 5, 5]}
    cavity = {"origin": [0.31, 0.32, 0.33], "size": [0.3, 0.3, 0.3]}
    block = {"shape": {"box": box, "cavity": cavity}, "density": 900.0, "young": 1e5, "poisson": 0.3}
    block["initial"] = {"velocity": ["0.5*y", "0.3*z", "0.4*x"]}
    water = {"density": 1000.0, "origin": [0, 0, 0], "size": [1, 1, 1], "cells": [9, 9, 9]}
    data = {"dim": 3, "time": {"end": 1.0, "dt": 0.02, "integrator": "bdf2"}, "fluid": water, "solids": {"box": block}}
    ratio, _ = kept(data, 4, "-options_file", "monolithic.opts")
    assert ratio.shape[1] == 2
    assert np.abs(ratio - 1).max() < 1e-10


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_a_piston_goes_as_far_as_a_jet_drives_it(integrator):
    """Water below a block that spans the box: what comes in at the left lifts it, exactly as much as came."""
    jet = {"inflow": {"speed": "0.5*t", "region": {"box": {"origin": [-1, 0.1], "size": [2, 0.2]}}}}
    guides = [{"where": side, "fix": ["x"]} for side in ("left", "right")]
    data = scene(
        integrator, dt=0.02, fluid=fluid((10, 20), size=[0.5, 1.0], sides={"left": jet, "top": "open"}),
        solids={"piston": solid([0.0, 0.43], [0.5, 0.2], [4, 2], supports=guides)},
    )  # fmt: skip
    ratio, sim = kept(data, 10)
    t = 0.02 * np.arange(11)
    np.testing.assert_allclose(ratio[:, 0], 1 + 0.2 * 0.25 * t**2 / 0.215, rtol=1e-9)
    assert sim.time == pytest.approx(0.2)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_free_piston_goes_on_with_a_steady_jet_from_the_first_step(integrator):
    """All starts with the jet's velocity, and keeps it: what comes in at the start makes room for itself once."""
    sides = {"left": {"inflow": {"speed": 0.1}}, "right": "open"}
    data = scene(
        integrator, dt=0.01, fluid=fluid((16, 4), size=[1.0, 0.25], sides=sides),
        solids={"piston": solid([0.4, 0.0], [0.2, 0.25], [2, 2], young=1e9)},
    )  # fmt: skip
    with prepared(scene_from_dict(data), *DIRECT, comm=COMM) as sim:
        for _ in range(4):
            sim.advance()
            assert np.allclose(sim.solid.velocity, [0.1, 0.0], atol=1e-3)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_beam_that_closes_a_box_leaves_it_its_volume(integrator):
    """Clamped at both walls. Above it is open: a beam's sections do not thin, so two closed sides would stop it."""
    beam = {"beam": {"start": [0.0, 0.47], "end": [1.0, 0.47], "thickness": 0.02, "elements": 11}}
    ends = [{"where": end, "fix": ["x", "y", "angle"]} for end in ("start", "end")]
    sheet = {"shape": beam, "density": 1000.0, "young": 1e6, "poisson": 0.3, "supports": ends}
    sheet["initial"] = {"velocity": [0.0, "sin(2*pi*x)"]}
    data = scene(integrator, fluid=fluid((20, 20), sides={"top": "open"}), solids={"sheet": sheet})
    ratio, sim = kept(data, 8)
    assert ratio.shape[1] == 1
    assert np.abs(ratio - 1).max() < {"newmark": 5e-6}.get(integrator, 1e-10), ratio - 1
    assert np.abs(sim.solid.displacement).max(initial=0.0) > 1e-3


def test_newton_keeps_volumes_too_and_so_does_a_step_taken_in_halves():
    data = scene(
        "bdf2", dt=0.02, fluid=fluid((16, 16)), solids={"box": box_with_water([0.31, 0.31], ["0.8*(y - 0.5)", "0.8*x"])}
    )
    ratio, _ = kept(data, 4, *DIRECT, "-fsi_snes_type", "newtonls")
    assert np.abs(ratio - 1).max() < 1e-10
    data["time"]["retries"] = 2
    with prepared(scene_from_dict(data), *DIRECT) as sim:
        judge, calls = sim.solid.judge, []

        def refuse(x, dt):
            calls.append(dt)
            if len(calls) in (2, 4):
                raise SolveError("not this one: try again")
            judge(x, dt)

        sim.solid.judge = refuse
        first = sim.regions.volumes
        for _ in range(4):
            sim.advance()
        assert min(calls) == 0.005
        assert np.abs(sim.regions.volumes / first - 1).max() < 1e-10


def test_a_split_solver_is_left_alone():
    """Where the pressure is solved for by itself no source can close a volume: it goes with the walls, and is told."""
    data = scene(
        "bdf2", fluid=fluid((16, 16)), solids={"box": box_with_water([0.31, 0.31], ["0.1*(y - 0.5)", "0.1*x"])}
    )
    data["solids"]["box"]["density"] = 1e5
    with prepared(scene_from_dict(data), "-options_file", "split.opts") as sim:
        sim.advance()
        assert sim.fluid.source is None
        assert np.isfinite(sim.regions.volumes).all()


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_what_volumes_are_kept_is_in_the_checkpoint(integrator):
    changing = {"dt": "0.01*(1 + 0.4*sin(300*t))"}
    data = scene(
        integrator, gravity=[0.0, -9.81], fluid=fluid((18, 18)),
        solids={"box": box_with_water([0.31, 0.31], ["0.8*(y - 0.5)", "0.8*x"])},
    )  # fmt: skip
    data["time"] |= changing
    sim = goes_on(scene_from_dict(data), "-options_file", "monolithic.opts")
    assert sim.regions.volumes.size == 2


@pytest.mark.parallel([1, 2])
def test_checkpoints_have_room_for_regions_that_close_and_open():
    """A block leaves the gap below an obstacle, and with that the water behind it is no longer closed."""
    jet = {"inflow": {"speed": 1.0, "region": {"box": {"origin": [-0.1, 0.0], "size": [0.2, 0.5]}}}}
    block = solid(
        [0.3, 0.0], [0.2, 0.5], [2, 3], supports=[{"where": "all", "fix": ["x", "y"], "velocity": {"x": 1.0}}]
    )
    data = scene("bdf2", dt=0.05, fluid=fluid((12, 12), sides={"left": jet, "right": "open"}), solids={"block": block})
    data["obstacles"] = {"above": {"shape": {"box": {"origin": [-0.1, 0.5], "size": [0.6, 0.6]}}}}
    with prepared(scene_from_dict(data), *DIRECT, comm=COMM) as sim:
        shapes = []
        while len(shapes) < 6:
            shapes.append({name: slab.shape for name, slab in sim.state()["regions"].items()})
            sim.advance()
        assert np.isnan(sim.regions.volumes).all()
    assert all(shape == shapes[0] for shape in shapes)


@pytest.mark.parallel([2])
def test_two_ranks_go_the_way_of_one():
    data = scene("bdf2", fluid=fluid(), solids={"box": box_with_water([0.31, 0.31], ["0.8*(y - 0.5)", "0.8*x"])})
    ways = []
    for comm in (COMM, MPI.COMM_SELF):
        _, sim = kept(data, 5, comm=comm)
        ways.append(sim.accounts.values)
    assert ways[0] == pytest.approx(ways[1], rel=1e-7, abs=1e-7)


@pytest.mark.slow
def test_the_cavity_keeps_its_volume_over_a_thousand_steps():
    """jobs/cavity.toml: 1e-10, without a drift."""
    data = loaded(JOBS / "cavity.toml", "time.end=20.0")
    ratio, _ = kept(data, 1000, "-options_file", "monolithic.opts")
    off = np.abs(ratio[:, 0] - 1)
    assert off.max() < 1e-10
    assert off[500:].mean() < 2 * off[:500].mean() + 1e-12


# ---- what comes of it -----------------------------------------------------------------------------------------


def spinning_disk(integrator, across=8, side="slip"):
    """A stiff disk as dense as the water around it, which turns once a second in a box."""
    ball = {"ball": {"centre": [0.5, 0.5], "radius": 0.2, "cells": across}}
    disk = {"shape": ball, "density": 1.0, "young": 1e7, "poisson": 0.3}
    disk["initial"] = {"velocity": ["-2*pi*(y - 0.5)", "2*pi*(x - 0.5)"]}
    water = fluid((24, 24), density=1.0, sides={"top": side})
    data = scene(integrator, fluid=water, solids={"disk": disk})
    return data | {"probes": {"p": {"of": "fluid", "at": [0.1, 0.1], "quantity": "pressure"}}}


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator, kinetic", [("newmark", 0.8), ("bdf2", 0.975)])
def test_a_stiff_disk_spins_in_a_closed_box(integrator, kinetic):
    """A disk that may not change its area needs rho (omega R)^2 / 4 around it (virial theorem)."""
    pressure, elastic = [], []
    with prepared(scene_from_dict(spinning_disk(integrator)), "-options_file", "monolithic.opts") as sim:
        first = sim.accounts.values
        for _ in range(40):
            sim.advance()
            pressure.append(sim.probe()[0])
            elastic.append(sim.accounts.values["elastic"])
        last = sim.accounts.values
    turned = last["kinetic"] / first["kinetic"]
    assert turned > kinetic
    wanted = 0.25 * (2 * np.pi * 0.2) ** 2 * turned
    assert np.mean(pressure[20:]) == pytest.approx(wanted, rel={"newmark": 0.25, "bdf2": 0.05}[integrator])
    assert np.max(elastic[20:]) < 1e-6 * first["kinetic"]
    if integrator == "bdf2":
        assert last["region_volume.1"] == pytest.approx(first["region_volume.1"], rel=1e-10)
        assert np.max(np.abs(pressure)) < 5  # of 5e4 with straight predictions


@pytest.fixture
def ring_of_water(tmp_path):
    """A thin ring, full of water that turns with it, in a closed box of water at rest."""
    path = COMM.bcast(tmp_path) / "ring.msh"
    inner, outer, n = 0.2, 0.22, 36
    angle = 2 * np.pi * np.arange(n) / n
    unit = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(n)))
    points = np.concatenate((inner * unit, outer * unit)) + [0.5, 0.5, 0.0]
    i = np.arange(n)
    j = (i + 1) % n
    cells = np.concatenate((np.column_stack((i, i + n, j + n)), np.column_stack((i, j + n, j))))
    if COMM.rank == 0:
        meshio.Mesh(points, [("triangle", cells)]).write(path)
    COMM.barrier()
    velocity = ["-2*pi*(y - 0.5)", "2*pi*(x - 0.5)"]
    ring = {"shape": {"mesh": str(path)}, "density": 10.0, "young": 1e5, "poisson": 0.3}
    ring["initial"] = {"velocity": velocity}
    within = "heaviside(0.21 - sqrt((x - 0.5)**2 + (y - 0.5)**2))"
    water = fluid((24, 24), density=1.0, initial={"velocity": [f"({v})*{within}" for v in velocity]})
    probes = {
        name: {"of": "fluid", "at": at, "quantity": "pressure"}
        for name, at in (("inside", [0.5, 0.5]), ("outside", [0.1, 0.1]))
    }
    return scene("bdf2", fluid=water, solids={"ring": ring}) | {"probes": probes}


@pytest.mark.parallel([1, 2])
def test_a_ring_full_of_water_turns_over(ring_of_water):
    """What holds it together is the pressure: lower inside by rho_s omega^2 (R_o^2 - R_i^2)/2 + rho omega^2 R_i^2/2."""
    gap = []
    with prepared(scene_from_dict(ring_of_water), "-options_file", "monolithic.opts") as sim:
        first, volumes = sim.accounts.values, sim.regions.volumes
        for _ in range(20):
            sim.advance()
            inside, outside = sim.probe()
            gap.append(outside - inside)
            assert np.abs(sim.regions.volumes / volumes - 1).max() < 1e-10
        last = sim.accounts.values
    turned = last["kinetic"] / first["kinetic"]
    assert turned > 0.93
    wanted = (2 * np.pi) ** 2 / 2 * (10.0 * (0.22**2 - 0.2**2) + 0.2**2) * turned
    assert np.mean(gap[10:]) == pytest.approx(wanted, rel=0.05)
    assert last["elastic"] < 1e-5 * first["kinetic"]
    assert last["energy_residual"] < 0


# ---- pressures that nothing feels ---------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
def test_two_rooms_on_the_sides_of_a_beam_have_a_pressure_in_common_that_it_does_not_feel():
    """A beam does not get thinner: it feels the difference alone, and the system is solved all the same."""
    beam = {"start": [0.0, 0.525], "end": [1.0, 0.525], "thickness": 0.002, "elements": 12, "theory": "euler-bernoulli"}
    plate = {"shape": {"beam": beam}, "density": 1000.0, "young": 1e12, "poisson": 0.0}
    plate |= {"supports": [{"where": end, "fix": ["x", "angle"]} for end in ("start", "end")]}
    plate |= {"initial": {"velocity": ["0", "1e-7*cos(pi*x)"]}}
    data = scene("bdf2", time={"end": 1.0, "dt": 1e-3}, fluid=fluid((16, 16)), solids={"plate": plate})
    with prepared(scene_from_dict(data), *DIRECT) as sim:
        for _ in range(12):
            sim.advance()
            assert sim.outcome.residual < 1e-8
        (unfelt,) = sim.regions.unfelt
        assert np.ptp(unfelt[unfelt != 0]) < 1e-12 * np.abs(unfelt).max()
        assert sim.fluid.volumes()[unfelt == 0].max(initial=0.0) == 0.0


def test_a_sheet_that_runs_into_a_side_stops_by_name():
    """Regions part and join as its steps are taken again; overlapping walls leave less than nothing between them."""
    beam = {"start": [0.2, 0.3], "end": [0.2, 0.7], "thickness": 0.004, "elements": 6}
    sheet = {"shape": {"beam": beam}, "density": 1000.0, "young": 1e9, "poisson": 0.3}
    sheet |= {"initial": {"velocity": ["-2.0", "0.3"]}}
    data = scene("bdf2", fluid=fluid((16, 16)) | {"density": 1.0}, solids={"sheet": sheet})
    with prepared(scene_from_dict(data)) as sim, pytest.raises(SolveError):
        for _ in range(60):
            sim.advance()
