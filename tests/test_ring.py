"""A ring from a mesh file with tags, inflated: in equilibrium, in load steps and swinging."""

import numpy as np
import pytest
from load_cases import COMM, ORDERS, annulus, resultant, ring
from petsc4py import PETSc
from solid_cases import gathered

from petfsi.bench.case import only_options
from petfsi.errors import InputError
from petfsi.fields.solid import SimplexSolid
from petfsi.integrators.base import Stage
from petfsi.scene.load import scene_from_dict
from petfsi.simulation import Simulation


@pytest.fixture
def shared_path(tmp_path):
    return COMM.bcast(tmp_path)


@pytest.mark.parallel([1, 3])
@ORDERS
def test_tags_of_a_mesh_file_pick_facets_and_nodes(shared_path, elements):
    annulus(shared_path / "ring.msh", 2, 8)
    load = {"where": {"tag": "inner"}, "pressure": 2.0}
    solid = SimplexSolid(COMM, scene_from_dict(ring(shared_path / "ring.msh", elements=elements, loads=[load])))
    np.testing.assert_allclose(resultant(solid)[:2], [2.0, 2.0], rtol=1e-12)
    assert len(solid._supports.unknowns) == {"linear": 6, "quadratic": 10}[elements]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("where", ["loads", "supports"])
def test_an_unknown_tag_is_named_with_those_that_the_file_has(shared_path, where):
    annulus(shared_path / "ring.msh", 1, 4)
    item = {"loads": {"pressure": 1.0}, "supports": {"fix": ["x"]}}[where] | {"where": {"tag": "iner"}}
    data = ring(shared_path / "ring.msh", **{where: [item]})
    with pytest.raises(InputError, match=rf"solids.ring.{where}.0.where.tag = 'iner'.*it has 3, body, floor, inner$"):
        SimplexSolid(COMM, scene_from_dict(data))


# ---- statics ------------------------------------------------------------------------------------------------


def newton(solid, most=25, tolerance=1e-12):
    """Bring a solid into equilibrium; return the norms of the residuals on the way."""
    norms = []
    ksp = PETSc.KSP().create(solid.comm)
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    ksp.getPC().setFactorSolverType("mumps")
    x, b = solid.block.createVecs()
    while len(norms) < most and (not norms or norms[-1] > tolerance):
        zero = np.zeros_like(solid.displacement)
        solid._stage = Stage(a=0.0, k=1.0, inertia=zero, tangent_at=solid.displacement, shift=zero)
        solid.assemble(0.0, 1.0)
        b.setArray(solid.rhs)
        norms.append(b.norm())
        ksp.setOperators(solid.block)
        ksp.solve(b, x)
        solid.displacement = solid.displacement + x.getArray().reshape(-1, solid.dim)
    for thing in (ksp, x, b):
        thing.destroy()
    return norms


def inflate(path, n, pressure, elements="linear"):
    """Return the stretch of the inner radius and the residuals of Newton's iterations."""
    annulus(path, n, 8 * n)
    load = {"where": {"tag": "inner"}, "pressure": pressure}
    solid = SimplexSolid(COMM, scene_from_dict(ring(path, material="neohookean", elements=elements, loads=[load])))
    norms = newton(solid)
    return inner_stretch(solid), norms


def inner_stretch(solid):
    X, d = gathered(solid, "points"), gathered(solid, "displacement")
    inner = np.isclose(np.linalg.norm(X, axis=1), 1.0)
    return np.linalg.norm(X + d, axis=1)[inner].mean()


@pytest.mark.parallel([1, 2])
def test_a_thick_cylinder_inflates_as_derived_and_newton_converges_quadratically(shared_path):
    table = np.genfromtxt("tests/data/cylinder_inflation_planestrain.csv", delimiter=",", comments="#", skip_header=4)
    for _, stretch, pressure, _ in table[:4]:
        found = [inflate(shared_path / f"{n}.msh", n, pressure) for n in (2, 4)]
        errors = [abs(a - stretch) for a, _ in found]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.25), (stretch, errors)
        norms = np.array(found[1][1])
        assert norms[-1] < 1e-12, norms
        late = norms[(norms < 1e-2) & (norms > 1e-7)]
        assert len(norms) <= 12 and np.all(norms[np.flatnonzero(np.isin(norms, late)) + 1] < 100 * late**1.8), norms
    assert errors[1] < 0.005 * stretch


@pytest.mark.parallel([1, 2])
def test_load_steps_of_the_program_end_in_the_same_equilibrium(shared_path):
    pressure, path = 0.1226763839, shared_path / "ring.msh"
    wanted, _ = inflate(path, 2, pressure)
    load = {"where": {"tag": "inner"}, "pressure": f"{pressure}*t"}
    data = ring(path, material="neohookean", loads=[load])
    data["time"] = {"end": 1.0, "dt": 0.25, "integrator": "static"}
    with only_options(["-options_file", "monolithic-direct.opts", "-fsi_snes_rtol", "1e-12"]):
        sim = Simulation(COMM, scene_from_dict(data))
        sim.prepare()
        for _ in range(4):
            sim.advance()
    assert inner_stretch(sim.fields[0]) == pytest.approx(wanted, rel=1e-10)


@pytest.mark.parametrize("integrator, most, falls", [("newmark", 1e-3, 3), ("bdf2", 1e-5, 10), ("midpoint", 1e-6, 0)])
def test_an_inflated_ring_swings_alike_with_newton_and_with_one_solve_a_step(shared_path, integrator, most, falls):
    """What one linearisation leaves out, of the follower too, is less than the scheme's own error.

    It falls with the step faster, as h^2 of newmark and h^4 of bdf2; of midpoint it is below 1e-6 at once.
    """
    path, load = shared_path / "ring.msh", {"where": {"tag": "inner"}, "pressure": "0.08*sin(2*t)"}
    annulus(path, 1, 8)

    def final(options, dt):
        data = ring(path, material="neohookean", loads=[load])
        data["time"] = {"end": 1.6, "dt": dt, "integrator": integrator}
        with only_options(["-options_file", "monolithic-direct.opts", *options]):
            sim = Simulation(COMM, scene_from_dict(data))
            sim.prepare()
            for _ in range(round(1.6 / dt)):
                sim.advance()
        return inner_stretch(sim.fields[0]) - 1

    newton_options = ["-fsi_snes_type", "newtonls", "-fsi_snes_rtol", "1e-11"]
    gaps = [abs(final([], dt) - final(newton_options, dt)) for dt in (0.1, 0.05)]
    assert final([], 0.05) > 0.2
    assert gaps[1] < most and gaps[0] > falls * gaps[1], gaps
