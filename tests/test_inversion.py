"""Blocks of stable neo-Hookean material that are turned inside out come back, and energy only falls."""

import numpy as np
import pytest
from mpi4py import MPI
from solid_cases import DENSITY, LAME, MU, body, step

from petfsi.bench.case import only_options
from petfsi.errors import SolveError
from petfsi.fields.solid import SimplexSolid
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

#: Speed of pressure waves, m/s: strains are those of a block of 1 m thrown at a multiple of it.
SOUND = np.sqrt((LAME + 2 * MU) / DENSITY)
STARTS = {
    "stretched": {"velocity": [f"{10 * SOUND}*(x - 0.5)", "0.0"]},
    "squeezed": {"velocity": [f"{-10 * SOUND}*(x - 0.5)", "0.0"]},
    # the right third lies folded back over the middle one
    "folded": {"displacement": ["-(x - 2/3) - abs(x - 2/3)", "0.0"]},
}


def scene(integrator, tangent="projected", stiffness_damping=0.02, dim=2, initial=None, **more):
    """Return a block of 1 m, steps in which waves cross a tenth of it."""
    initial = {name: [*given, "0.0"][:dim] for name, given in (initial or {}).items()}
    block = body(
        dim, cells=(6, 6) if dim == 2 else (4, 4, 4), size=(1.0, 1.0, 1.0), tangent=tangent, initial=initial,
        damping={"stiffness": stiffness_damping / SOUND}, **{"material": "stable-neohookean"} | more,
    )  # fmt: skip
    time = {"end": 12 / SOUND, "dt": 0.1 / SOUND, "integrator": integrator}
    return Scene.model_validate({"dim": dim, "time": time, "solids": {"block": block}})


def block(*args, **kwargs):
    return SimplexSolid(MPI.COMM_SELF, scene(*args, **kwargs))


def measured(solid):
    """Return energy and smallest det F."""
    return sum(solid.energies().values()), solid.quality()


def history(solid, steps, dt=0.1 / SOUND):
    """Return what is measured at the start and after every step."""
    seen = [measured(solid)]
    for n in range(steps):
        step(solid, n * dt, dt)
        seen.append(measured(solid))
    return np.transpose(seen)


def explicit_history(solid, end):
    """Return the same of explicit steps of a third of the stable one, which is looked up every fifth step."""
    seen, time, dt = [measured(solid)], 0.0, 0.0
    while time < end:
        if len(seen) % 5 == 1:
            dt = solid.stable_step() / 3
        solid.predict(time, dt)
        solid.assemble(time, dt)
        solid.accept(solid.rhs / solid.block.getDiagonal().getArray(), time, dt)
        time += dt
        seen.append(measured(solid))
    return np.transpose(seen)


def newton_history(scene):
    """Return the same of a run with Newton's method."""
    with only_options(["-options_file", "monolithic.opts", "-fsi_snes_type", "newtonls"]):
        sim = Simulation(MPI.COMM_SELF, scene)
        sim.prepare()
        seen = [measured(sim.solid)]
        while not sim.finished:
            sim.advance()
            seen.append(measured(sim.solid))
    return np.transpose(seen)


def inverted(solid):
    """Return the part of the triangles that lie on their other side."""
    now = {name: slab.data for name, slab in solid.output().items()}
    corners = (now["points"] + now["displacement"])[now["cells"]]
    return np.mean(np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0)


def recovers(energy, quality, swing=1e-12):
    """Check that elements were inverted, none is at the end, and energy never exceeded that at the start."""
    assert np.all(np.isfinite(energy)) and energy.max() <= energy[0] * (1 + swing)
    assert energy[-1] < 0.1 * energy[0]
    assert quality.min() < -0.9
    assert np.all(quality[-10:] > 0), quality[-10:]


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
@pytest.mark.parametrize("throw", ["stretched", "squeezed"])
def test_a_block_thrown_at_ten_times_its_speed_of_sound_recovers(throw, integrator):
    recovers(*history(block(integrator, initial=STARTS[throw]), 120))


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_mesh_with_a_third_of_its_elements_inverted_recovers(integrator):
    solid = block(integrator, initial=STARTS["folded"])
    assert inverted(solid) == pytest.approx(1 / 3)
    recovers(*history(solid, 60))


@pytest.mark.parametrize("start", ["stretched", "folded"])
def test_with_newtons_method_they_recover(start):
    recovers(*newton_history(scene("bdf2", initial=STARTS[start])))


@pytest.mark.parametrize("start", STARTS)
def test_under_the_explicit_scheme_they_recover(start):
    """Its energy, of velocities half a step before, swings by what is of the order of the step."""
    solid = block("symplectic-euler", tangent="exact", initial=STARTS[start])
    recovers(*explicit_history(solid, 12 / SOUND), swing=0.01)


@pytest.mark.parametrize("start", ["stretched", "squeezed"])
@pytest.mark.parametrize(
    "kind", [{"elements": "quadratic"}, {"volumetric": "reduced"}, {"dim": 3}], ids=["quadratic", "reduced", "3d"]
)
def test_so_do_other_elements(kind, start):
    recovers(*history(block("bdf2", initial=STARTS[start], **kind), 120))


def test_a_scrambled_mesh_recovers():
    """Every node starts somewhere else: here any element may be inverted, in any direction."""
    solid = block("bdf2")
    solid.displacement = np.random.default_rng(1).uniform(-0.2, 0.2, solid.displacement.shape)
    assert inverted(solid) > 1 / 4
    recovers(*history(solid, 60))


def test_without_damping_of_its_own_bdf2_recovers():
    recovers(*history(block("bdf2", stiffness_damping=0.0, initial=STARTS["stretched"]), 300))


def test_exact_tangents_are_what_does_not():
    """The step's matrix is no longer positive then, and a step goes anywhere."""
    energy, _ = history(block("bdf2", "exact", 0.0, initial=STARTS["stretched"]), 60)
    assert energy.max() > 10 * energy[0]


@pytest.mark.parallel([1, 2])
def test_an_inverted_neohookean_element_is_an_error_on_all_ranks():
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(
            MPI.COMM_WORLD, scene("bdf2", material="neohookean", tangent="exact", initial=STARTS["folded"])
        )
        with pytest.raises(
            SolveError, match="solids.block has turned an element.*equations of solid hold numbers that are not finite"
        ):
            sim.prepare()
            sim.advance()


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("more", [{}, {"elements": "quadratic"}, {"volumetric": "reduced"}], ids=str)
def test_a_step_that_turns_another_material_inside_out_is_refused_by_name(more):
    thrown = scene("bdf2", "exact", initial=STARTS["squeezed"], material="green", **more)
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(MPI.COMM_WORLD, thrown)
        sim.prepare()
        told = []
        sim.report = told.append
        with pytest.raises(SolveError, match="solids.block has turned an element inside out: det F = -"):
            for _ in range(20):
                sim.advance()
    assert len(told) >= 3 and sim.solid.quality() > 0
    assert all("solids.block has turned an element inside out" in text for text in told[:3])


@pytest.mark.parallel([1, 2])
def test_a_block_pushed_through_itself_in_statics_is_named_before_what_the_solver_says():
    """Its logarithm is no number then, and Newton's method ends with that alone."""
    supports = [
        {"where": "left", "fix": ["x", "y"]},
        {"where": "right", "fix": ["x"], "displacement": {"x": "-2.5*t"}},
    ]
    table = {"dim": 2, "time": {"end": 1.0, "dt": 1.0, "integrator": "static"}}
    block = body(2, cells=(3, 3), size=(1.0, 1.0), material="neohookean", supports=supports)
    said = "solids.block has turned an element inside out: det F = -"
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(MPI.COMM_WORLD, Scene.model_validate(table | {"solids": {"block": block}}))
        sim.prepare()
        told = []
        sim.report = told.append
        with pytest.raises(SolveError, match=said + ".*: solver 'fsi_snes_' stopped with DIVERGED_FNORM_NAN"):
            sim.advance()
    assert told[0].endswith("taken again as two halves: solids.block has turned an element inside out")
