"""Solids of several kinds in one scene: what each does alone, together; with a fluid, on ranks, and resumed."""

import numpy as np
import pytest
from mpi4py import MPI
from solid_cases import dense, gathered
from step_cases import prepared, stepped
from test_cutcell import unscaled
from test_run import last_output, petfsi

from petfsi.errors import InputError
from petfsi.registry import INTEGRATORS
from petfsi.scene.load import dump_scene, scene_from_dict
from petfsi.simulation import Simulation

LU = ["-options_file", "monolithic-direct.opts"]
CLAMP = [{"where": "start", "fix": ["x", "y", "angle"]}]
#: What every integrator can step: no body is free, loads grow from nothing.
BODIES = {
    "spring": {
        "shape": {"beam": {"start": [0.0, 1.0], "end": [0.7, 1.2], "thickness": 0.06, "elements": 3}},
        "density": 1.5, "young": 900.0, "poisson": 0.2, "supports": CLAMP, "damping": {"mass": 0.2, "stiffness": 1e-4},
        "loads": [{"where": "all", "traction": [0.0, "-0.5*t"]},
                  {"at": [0.7, 1.2], "force": ["3*t", 0.0], "moment": "0.4*t"}],
    },
    "block": {
        "shape": {"box": {"origin": [0.0, 0.0], "size": [1.0, 0.5], "cells": [4, 2]}},
        "density": 1.3, "young": 200.0, "poisson": 0.3, "material": "neohookean",
        "supports": [{"where": "left", "fix": ["x", "y"], "velocity": {"y": "0.3*t"}}],
        "loads": [{"where": "right", "pressure": "8*t"}], "body_force": ["2*t", 0.0],
    },
    "blade": {
        "shape": {"beam": {"start": [2.0, 0.1], "end": [2.0, 0.8], "thickness": 0.05, "elements": 3,
                           "theory": "euler-bernoulli"}},
        "density": 2.0, "young": 700.0, "poisson": 0.3, "supports": CLAMP, "mass": "lumped",
        "loads": [{"where": "all", "pressure": "0.4*t"}],
    },
    "brick": {
        "shape": {"box": {"origin": [3.0, 0.0], "size": [0.4, 0.4], "cells": [2, 2]}},
        "density": 1.1, "young": 300.0, "poisson": 0.3, "material": "linear", "elements": "quadratic",
        "supports": [{"where": "bottom", "fix": ["x", "y"]}],
    },
}  # fmt: skip
PROBES = {
    "turn": {"of": "spring", "at": [0.7, 1.2], "quantity": "angle"},
    "tip": {"of": "spring", "at": [0.7, 1.2], "quantity": "displacement"},
    "corner": {"of": "block", "at": [1.0, 0.5], "quantity": "displacement"},
    "edge": {"of": "blade", "at": [2.0, 0.8], "quantity": "displacement"},
    "top": {"of": "brick", "at": [3.2, 0.4], "quantity": "displacement"},
}


def scene_of(*names, integrator="newmark", **more):
    chosen = names or tuple(BODIES)
    undamped = {"damping": {}} if integrator == "static" else {}
    return scene_from_dict(
        {
            "dim": 2,
            "gravity": ["0.5*t", "-9.81*t"],
            "time": {"end": 1.0, "dt": 0.002, "integrator": integrator},
            "solids": {name: BODIES[name] | undamped for name in chosen},
            "probes": {name: probe for name, probe in PROBES.items() if probe["of"] in chosen},
        }
        | more
    )


def probed(sim):
    return dict(zip(sim.probe_columns(), sim.probe(), strict=True))


# ---- alone --------------------------------------------------------------------------------------------------


KINDS = (["spring"], ["block", "brick"], ["blade"])
NEWTON = ["-fsi_snes_type", "newtonls", "-fsi_snes_rtol", "1e-12"]
WAYS = [(name, NEWTON if name == "static" else []) for name in INTEGRATORS] + [("bdf2", NEWTON), ("newmark", NEWTON)]


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator, newton", WAYS)
def test_bodies_move_as_if_each_kind_were_alone(integrator, newton):
    together = stepped(scene_of(integrator=integrator), 20, *LU, *newton)
    want, accounts = {}, {}
    for kind in KINDS:
        alone = stepped(scene_of(*kind, integrator=integrator), 20, *LU, *newton)
        want |= probed(alone)
        for name, value in alone.accounts.values.items():
            accounts[name] = accounts.get(name, 0.0) + value
    got = probed(together)
    assert sorted(got) == sorted(want) and min(map(abs, want.values())) > 1e-9
    assert got == pytest.approx(want, rel=1e-9, abs=1e-13)
    scale = max(map(abs, accounts.values()))
    assert together.accounts.values == pytest.approx(accounts, rel=1e-9, abs=1e-12 * scale)


@pytest.mark.parametrize("integrator", ["newmark", "symplectic-euler"])
@pytest.mark.parallel([1, 2, 3])
def test_the_block_is_that_of_the_parts(integrator):
    with prepared(scene_of(integrator=integrator), *LU) as sim:
        sim.advance()
        solid = sim.solid
        whole = dense(solid.block) / solid.row_scale
        rest = np.ones(whole.shape, dtype=bool)
        for part, piece, number in zip(solid.parts, solid._pieces, solid._number, strict=True):
            own = dense(part.block)
            np.testing.assert_allclose(whole[piece][:, number], own, rtol=1e-14)
            np.testing.assert_array_equal(np.diff(number) > 0, True)
            rest[np.ix_(np.arange(piece.start, piece.stop), number)] = False
        np.testing.assert_array_equal(whole[rest], 0.0)
        assert sorted(np.concatenate(solid._number)) == list(range(solid.layout.n_global))
        assert sim.assemblies()["solid"] == (1 if integrator == "symplectic-euler" else 2)


@pytest.mark.parallel([1, 3])
def test_a_scene_of_linear_bodies_assembles_once():
    bodies = {name: BODIES["brick"] for name in ("brick",)} | {"block": BODIES["block"] | {"material": "linear"}}
    del bodies["block"]["loads"]
    with prepared(scene_of(solids=bodies | {"blade": BODIES["blade"]}, probes={}), *LU) as sim:
        for _ in range(3):
            sim.advance()
        simplices, blade = sim.solid.parts
        assert (simplices.n_assembled, blade.n_assembled, sim.solid.n_assembled) == (1, 4, 4)
        whole = dense(sim.solid.block) / sim.solid.row_scale
        own = whole[sim.solid._pieces[0]][:, sim.solid._number[0]]
        np.testing.assert_allclose(own, dense(simplices.block), rtol=1e-14)


def test_one_kind_is_no_joint():
    assert type(stepped(scene_of("spring"), 0, *LU).solid).__name__ == "BeamSolid"
    assert type(stepped(scene_of("block", "brick"), 0, *LU).solid).__name__ == "SimplexSolid"


# ---- ranks and state ----------------------------------------------------------------------------------------


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_ranks_agree(integrator):
    many, one = (stepped(scene_of(integrator=integrator), 5, *LU, comm=c) for c in (MPI.COMM_WORLD, MPI.COMM_SELF))
    assert probed(many) == pytest.approx(probed(one), rel=1e-9, abs=1e-12)
    for name in ("points", "cells", "body", "displacement", "velocity"):
        got, want = gathered(many.solid, name), gathered(one.solid, name)
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * max(1.0, np.abs(want).max()), err_msg=name)
    assert many.solid.extent == pytest.approx(one.solid.extent, rel=1e-15)
    assert many.solid.stable_step() == pytest.approx(one.solid.stable_step(), rel=1e-6)
    np.testing.assert_allclose(many.solid.surface_positions(), one.solid.surface_positions(), atol=1e-12)


@pytest.mark.parallel([1, 2])
def test_output_has_all_bodies_in_the_order_of_the_scene():
    solid = stepped(scene_of(), 3, *LU).solid
    points, cells, body = (gathered(solid, name) for name in ("points", "cells", "body"))
    corners = points[cells]
    area = np.bincount(body, weights=np.linalg.det(corners[:, 1:] - corners[:, :1]) / 2)
    np.testing.assert_allclose(area, [0.06 * np.hypot(0.7, 0.2), 0.5, 0.05 * 0.7, 0.16])
    np.testing.assert_array_equal(np.bincount(cells.ravel(), minlength=len(points)) > 0, True)
    blade = np.abs(corners[body == 2].mean(axis=1) - [2.0, 0.45]).max(axis=0)
    assert blade[0] < 0.03 and blade[1] < 0.35


def stored(solid):
    slabs = {name: solid.comm.allgather(piece) for name, piece in solid.state().items()}
    return {name: np.concatenate([piece.data for piece in pieces]) for name, pieces in slabs.items()}


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_state_comes_back_bit_for_bit(integrator):
    scene = scene_of(integrator=integrator)
    with prepared(scene, *LU) as sim:
        for _ in range(3):
            sim.advance()
        sim.forget()
        state = stored(sim.solid)
        with prepared(scene, *LU) as other:

            def read(name, start, count):
                return state[name][tuple(slice(a, a + n) for a, n in zip(start, count, strict=True))]

            other.solid.restore(read)
            other.step, other.time, other.dt = sim.step, sim.time, sim.dt
            for _ in range(2):
                sim.advance()
                other.advance()
            want, got = stored(sim.solid), stored(other.solid)
    assert any(name.startswith("euler-bernoulli_") for name in want)
    assert want.keys() == got.keys()
    for name, values in want.items():
        # on several ranks MUMPS adds up what comes in, in the order in which it comes
        atol = 0.0 if sim.comm.size == 1 else 1e-14 * np.abs(values).max(initial=0.0)
        np.testing.assert_allclose(got[name], values, rtol=0.0, atol=atol, err_msg=name)


# ---- in a fluid ---------------------------------------------------------------------------------------------

#: Two basins side by side, an elastic post in one and a blade in the other.
WET = {
    "post": {
        "shape": {"box": {"origin": [0.35, 0.0], "size": [0.2, 0.5], "cells": [2, 5]}},
        "density": 1.3, "young": 2e3, "poisson": 0.3, "supports": [{"where": "bottom", "fix": ["x", "y"]}],
        "initial": {"velocity": ["y", 0.0]},
    },
    "blade": {
        "shape": {"beam": {"start": [1.513, 0.0], "end": [1.513, 0.6], "thickness": 0.04, "elements": 4}},
        "density": 1.2, "young": 2e4, "poisson": 0.3,
        "supports": [{"where": "start", "fix": ["x", "y", "angle"], "velocity": {"angle": "0.2*t"}}],
        "initial": {"velocity": ["-y", 0.0, 0.8]},
    },
}  # fmt: skip
ENDS = {"post": [0.55, 0.5], "blade": [1.513, 0.6]}


def basins(*names, transfer="cutcell", integrator="newmark", wall=True, dt=0.01, density=1.0, **more):
    names = names or tuple(WET)
    post = {"shape": {"box": {"origin": [0.75, -0.1], "size": [0.55, 1.3]}}}
    return scene_from_dict(
        {
            "dim": 2,
            "gravity": [0.0, -9.81],
            "time": {"end": 1.0, "dt": dt, "integrator": integrator},
            "fluid": {"density": density, "origin": [0.0, 0.0], "size": [2.0, 1.0], "cells": [32, 16],
                      "sides": {"top": "open"}},
            "solids": {name: WET[name] for name in names},
            "obstacles": {"wall": post} if wall else {},
            "coupling": {"transfer": transfer},
            "probes": {name: {"of": name, "at": ENDS[name], "quantity": "displacement"} for name in names},
        }
        | more
    )  # fmt: skip


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint", "symplectic-euler"])
def test_bodies_in_separate_basins_move_as_if_alone(integrator, transfer):
    options = {"transfer": transfer, "integrator": integrator, "dt": 2e-4 if integrator == "symplectic-euler" else 0.01}
    want = {}
    for name in WET:
        want |= probed(stepped(basins(name, **options), 6, *LU))
    got = probed(stepped(basins(**options), 6, *LU))
    assert min(abs(got["post.x"]), abs(got["blade.x"])) > 5e-5
    assert got == pytest.approx(want, rel=1e-9, abs=1e-13)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_ranks_agree_in_one_basin(transfer):
    scene, default = basins(transfer=transfer, wall=False), ["-options_file", "monolithic.opts"]
    many, one = (stepped(scene, 6, *default, comm=comm) for comm in (MPI.COMM_WORLD, MPI.COMM_SELF))
    assert probed(many) == pytest.approx(probed(one), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_bodies_feel_each_other_through_the_fluid(transfer):
    both = probed(stepped(basins(transfer=transfer, wall=False), 6, *LU))
    one = probed(stepped(basins("blade", transfer=transfer, wall=False), 6, *LU))
    assert abs(both["blade.x"] - one["blade.x"]) > 1e-3 * abs(one["blade.x"])


@pytest.mark.parallel([1, 3])
def test_split_and_whole_solve_the_same_equations():
    ways = ("monolithic.opts", "split-iterated.opts")
    whole, split = (probed(stepped(basins(wall=False, density=0.02), 4, "-options_file", name)) for name in ways)
    assert split == pytest.approx(whole, rel=1e-5, abs=1e-8)


def test_force_and_flux_are_transposes():
    with prepared(basins(), *LU) as sim:
        sim.advance()
        sim.advance()
        J, flux = unscaled(sim)
    for number in sim.solid._number:
        assert np.abs(J[number]).max() > 0
    assert np.abs(J - flux.T).max() <= 1e-15 * np.abs(J).max()


@pytest.mark.parallel([1, 3])
def test_the_surface_moves_with_the_unknowns_of_all_parts():
    with prepared(basins(), *LU) as sim:
        before = sim.solid.surface()
        assert sim.solid.surface() is before
        sim.advance()
        solid, surface = sim.solid, sim.solid.surface()
        assert surface is not before
    everything = np.concatenate(solid.comm.allgather(solid.unknown()))
    moved = surface.point_map @ everything + surface.fixed_map @ solid.fixed_velocity()
    np.testing.assert_allclose(moved.reshape(-1, 2), solid.surface_velocity(), atol=1e-13)
    assert np.abs(solid.surface_velocity()).max() > 0.1
    np.testing.assert_array_equal(np.bincount(surface.facets.ravel()), 2)
    area = np.linalg.det(solid.surface_positions()[surface.facets]).sum() / 2
    assert area == pytest.approx(0.1 + 0.6 * 0.04, rel=0.05)


@pytest.mark.parallel([1, 3])
def test_fluid_and_bodies_that_move_alike_go_on_so():
    speed, periodic = [0.37, 0.21], dict.fromkeys(("left", "right", "bottom", "top"), "periodic")
    solids = {name: body | {"supports": [], "initial": {"velocity": speed}} for name, body in WET.items()}
    fluid = {"density": 1.0, "origin": [0.0, -0.2], "size": [2.0, 1.2], "cells": [32, 20], "sides": periodic,
             "initial": {"velocity": speed}}  # fmt: skip
    scene = {"dim": 2, "time": {"end": 1.0, "dt": 0.02, "integrator": "bdf2"}, "fluid": fluid, "solids": solids}
    sim = stepped(scene_from_dict(scene), 20, "-options_file", "monolithic.opts")
    for a in range(2):
        assert np.abs(sim.fluid.velocity[a][sim.fluid.grid.owned(a)] - speed[a]).max() < 1e-10
    for part in sim.solid.parts:
        assert np.abs(part.velocity[:, :2] - speed).max(initial=0.0) < 1e-10


@pytest.mark.parallel([1, 3])
def test_light_bodies_of_all_parts_have_motions():
    assert len(stepped(basins(), 0, *LU).solid.light_motions(3, 0.5, 60)) == 0
    scene = basins(solids={name: body | {"density": 0.01} for name, body in WET.items()})
    with prepared(scene, "-options_file", "monolithic.opts") as sim:
        motions = sim.solid.light_motions(3, 0.5, 60)
        assert motions.shape == (2 * 10 + 2 * 4, sim.solid.layout.n_local)
        assert len(sim.solid.light_motions(3, 0.5, 27)) == 2 * 6 + 2 * 3
        assert len(sim.solid.light_motions(3, 0.5, 3)) == 0
        everything = np.concatenate(
            [np.ones(piece.stop - piece.start) * n for n, piece in enumerate(sim.solid._pieces)]
        )
        assert not motions[:20, everything == 1].any() and not motions[20:, everything == 0].any()
        sim.advance()
        assert sim.outcome.residual < 1e-8


# ---- a run --------------------------------------------------------------------------------------------------


def test_a_run_resumes_bit_for_bit_and_is_drawn(tmp_path):
    scene = tmp_path / "basins.toml"
    scene.write_text(dump_scene(basins(wall=False)))
    words = ["--set", "checkpoint.every=0.02", "--set", "output.every=0.02", "--set", "time.end=0.06"]
    petfsi("run", scene, "--out", tmp_path / "whole", *words)
    petfsi("run", scene, "--out", tmp_path / "parts", *words, "--steps", 3)
    petfsi("resume", tmp_path / "parts")
    want, got = last_output(tmp_path / "whole"), last_output(tmp_path / "parts")
    assert want.keys() == got.keys()
    assert not [name for name in want if not np.array_equal(want[name], got[name])]
    assert "checkpoint/solid/timoshenko_velocity" in want
    petfsi("plot", tmp_path / "whole")
    assert list(tmp_path.glob("whole/**/*.png"))


@pytest.mark.parametrize(
    "start, end, how",
    [([0.4, 0.25], [0.5, 0.25], "cells"), ([0.02, 0.1], [0.9, 0.1], "their outlines cross")],
    ids=["inside", "across"],
)
def test_a_beam_in_a_block_is_refused(start, end, how):
    shape = {"beam": {"start": start, "end": end, "thickness": 0.01, "elements": 1}}
    scene = basins(solids=WET | {"blade": WET["blade"] | {"shape": shape}})
    with pytest.raises(InputError, match=rf"solids.blade.shape: overlaps solids.post \(.*{how}"):
        Simulation(MPI.COMM_SELF, scene)


def test_a_beam_may_stand_on_a_block():
    shape = {"beam": {"start": [0.45, 0.5], "end": [0.45, 0.9], "thickness": 0.02, "elements": 2}}
    both = basins(solids=WET | {"blade": WET["blade"] | {"shape": shape}})
    with prepared(both, *LU) as sim:
        sim.advance()


def test_a_probe_of_no_body_is_refused():
    solid = stepped(basins(), 0, *LU).solid
    with pytest.raises(InputError, match="known solids are post, blade"):
        solid.probe("other", [0.0, 0.0], "velocity")
    with pytest.raises(InputError, match="'angle' is not known"):
        solid.probe("post", [0.4, 0.2], "angle")
