"""Viscosity that is solved for beside solids: blocks, momentum, schemes, ranks and restart. About 15 s."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_sph import whole
from test_sph_solids import DIRECT, free, goes_on_alike, prepared

from petfsi.bench.case import dense, only_options
from petfsi.errors import InputError
from petfsi.scene.load import scene_from_dict

WORLD = MPI.COMM_WORLD


def stirred(kind, integrator="newmark", dt=0.005, end=0.05, solve="implicit", held=None, **fluid):
    """Return a body that flies and turns through a periodic sea of syrup, or is moved through it."""
    made = free(kind, integrator, end).model_dump(exclude_unset=True)
    made["time"]["dt"] = dt
    made["fluid"] |= {"viscosity": 300.0, "viscosity_solve": solve} | fluid
    if held:
        made["solids"]["body"]["supports"] = [held]
    return scene_from_dict(made)


def final(scene, options=DIRECT):
    """Return velocities of particles, by id, and of nodes at the end, and the simulation."""
    with only_options(options):
        sim = prepared(scene)
        while not sim.finished:
            sim.advance()
    return whole(sim)["v"], np.concatenate(WORLD.allgather(sim.solid.velocity)), sim


def test_the_nest_is_symmetric_and_positive():
    with only_options(DIRECT):
        sim = prepared(stirred("beam"), MPI.COMM_SELF)
        sim.advance()
    rows = np.concatenate([np.full(field.layout.n_global, field.row_scale) for field in sim.system.fields])
    A = dense(sim.system.operator.convert("aij", PETSc.Mat())) / rows[:, None]
    assert np.abs(A - A.T).max() <= 1e-15 * np.abs(A).max()
    assert np.linalg.eigvalsh(A).min() > 0
    assert set(sim.couplings[0].blocks) == {("particles", "solid"), ("solid", "particles")}
    assert all(block.norm() > 0 for block in sim.couplings[0].blocks.values())


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("kind", ["box", "beam"])
def test_a_body_and_syrup_keep_their_momentum(kind):
    """To round-off where both are solved for directly."""
    with only_options(DIRECT):
        sim, first = prepared(stirred(kind)), None
        while not sim.finished:
            sim.advance()
            now = np.array([sim.accounts.values[f"momentum.{axis}"] for axis in "xy"])
            first = now if first is None else first
            assert np.abs(now - first).max() < 1e-13 * 30.0
    assert np.abs(first).max() > 0.1


def test_a_body_in_space_keeps_its_momentum_too():
    cube = {"origin": [0.35] * 3, "size": [0.3] * 3}
    body = {"shape": {"box": cube | {"cells": [2, 2, 2]}}, "density": 500.0, "young": 1e5, "poisson": 0.3}
    body["initial"] = {"velocity": ["0.3", "0.1*(x - 0.5)", "-0.2"]}
    fluid = {"kind": "sph", "density": 1000.0, "origin": [0.0] * 3, "size": [1.0] * 3, "spacing": 0.1}
    fluid |= {"sound_speed": 10.0, "viscosity": 3000.0, "fill": [{"box": {"origin": [0.0] * 3, "size": [1.0] * 3}}]}
    fluid["sides"] = dict.fromkeys(("left", "right", "bottom", "top", "back", "front"), "periodic")
    scene = scene_from_dict(
        {"dim": 3, "time": {"end": 0.1, "dt": 0.01, "integrator": "newmark"}, "fluid": fluid, "solids": {"body": body}}
    )
    with only_options(DIRECT):
        sim = prepared(scene)
        assert sim.fluid.has_block
        seen = []
        for _ in range(3):
            sim.advance()
            seen.append([sim.accounts.values[f"momentum.{axis}"] for axis in "xyz"])
    assert np.ptp(seen, axis=0).max() < 1e-13 * np.abs(seen).max()


@pytest.mark.parametrize("options, tolerance", [("monolithic.opts", 1e-8), ("split-iterated.opts", 1e-7)])
def test_monolithic_and_split_find_what_a_factorisation_does(options, tolerance):
    scene = stirred("box", integrator="midpoint")
    exact, found = final(scene), final(scene, ["-options_file", options])
    for a, b in zip(exact[:2], found[:2], strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * np.abs(a).max())


@pytest.mark.parametrize("held", [None, {"where": "all", "fix": ["x", "y"], "velocity": {"x": "0.5", "y": "0.0"}}])
def test_short_steps_lead_to_what_explicit_viscosity_does(held):
    """With a body that is free, and one whose motion is given."""
    exact = final(stirred("box", dt=2e-4, solve="explicit", held=held))[0]
    errors = []
    for dt in (0.0025, 0.00125):
        v = final(stirred("box", dt=dt, held=held))[0]
        errors.append(np.sqrt(np.mean((v - exact) ** 2)) / np.abs(exact).max())
    assert errors[1] < 0.03
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("kind, integrator", [("box", "newmark"), ("beam", "midpoint")])
def test_a_body_in_syrup_goes_on_and_on_any_ranks_alike(kind, integrator):
    goes_on_alike(stirred(kind, integrator), 1e-12)


def test_a_light_body_comes_to_rest_in_syrup():
    """A hundredth of water's density: a step's drag is many times its momentum; coupled explicitly it blows up."""
    made = stirred("box", end=0.1).model_dump(exclude_unset=True)
    made["solids"]["body"]["density"] = 10.0
    _, u, sim = final(scene_from_dict(made), ["-options_file", "monolithic.opts"])
    assert np.abs(u).max() < 0.01
    assert sim.accounts.values["kinetic"] < 0.01 * 0.0278


def test_a_first_guess_that_is_far_off_does_not_end_a_solve():
    """The velocities before, with the drag of tar, leave 1e5 times the right side."""
    made = stirred("box", end=0.01, viscosity=1e7).model_dump(exclude_unset=True)
    made["solids"]["body"]["density"] = 10.0
    found = final(scene_from_dict(made), ["-options_file", "monolithic.opts"])
    exact = final(scene_from_dict(made))
    for a, b in zip(exact[:2], found[:2], strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-7 * np.abs(a).max())


@pytest.mark.parametrize("change, told", [
    ({"time": {"end": 1.0, "dt": "auto", "integrator": "symplectic-euler"}}, "symplectic-euler solves for nothing"),
    ({"coupling": {"transfer": "repulsion"}}, "repulsion has no drag"),
])  # fmt: skip
def test_what_cannot_be_solved_for_together_is_refused(change, told):
    made = stirred("box").model_dump(exclude_unset=True)
    with pytest.raises(InputError, match=f"fluid.viscosity_solve.*{told}"):
        scene_from_dict(made | change)
