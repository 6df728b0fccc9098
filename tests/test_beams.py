"""The beams of a scene: their surface, motion, ranks, state and probes; and with a fluid."""

import numpy as np
import pytest
from mpi4py import MPI
from solid_cases import gathered, step

from petfsi.errors import InputError
from petfsi.fields.beam.beam import BeamSolid
from petfsi.scene.schema import Scene

LENGTH = 1.25


def beam(theory="timoshenko", elements=6, start=(0.0, 0.0), end=(0.75, 1.0), thickness=0.1, **more):
    shape = {"start": list(start), "end": list(end), "thickness": thickness, "elements": elements, "theory": theory}
    return {"shape": {"beam": shape}, "density": 1.3, "young": 400.0, "poisson": 0.3, **more}


def field(comm=MPI.COMM_SELF, gravity=None, integrator="newmark", **solids):
    time = {"end": 1.0, "dt": 0.1, "integrator": integrator}
    return BeamSolid(comm, Scene.model_validate({"dim": 2, "gravity": gravity, "time": time, "solids": solids}))


#: Steps of each scheme with inertia; that of the explicit one is below its limit.
STEPS = {"newmark": 0.05, "bdf2": 0.05, "midpoint": 0.05, "symplectic-euler": 5e-4}
CLAMP = [{"where": "start", "fix": ["x", "y", "angle"]}]


@pytest.fixture(params=["timoshenko", "euler-bernoulli"])
def theory(request):
    return request.param


def outline_area(surface, positions):
    return float(np.linalg.det(positions[surface.facets]).sum() / 2)


# ---- the surface --------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_the_outline_is_closed_and_turned_outward(theory):
    solid = field(MPI.COMM_WORLD, a=beam(theory), b=beam(theory, start=(3.0, 1.0), end=(2.0, 1.0), thickness=0.2))
    surface, x = solid.surface(), solid.surface_positions()
    assert len(surface.facets) == surface.n_points == len(x)
    np.testing.assert_array_equal(np.bincount(surface.facets.ravel()), 2)
    assert outline_area(surface, x) == pytest.approx(0.1 * LENGTH + 0.2 * 1.0, rel=1e-12)
    edges = np.diff(x[surface.facets], axis=1)[:, 0]
    normals = np.column_stack((edges[:, 1], -edges[:, 0]))
    np.testing.assert_allclose(normals.sum(axis=0), 0, atol=1e-14)
    middle = x[surface.facets].mean(axis=1)
    lower = (np.abs(middle[:, 1] - 0.9) < 1e-9) & (middle[:, 0] > 1.9)
    assert lower.sum() == (12 if theory == "timoshenko" else 6)
    np.testing.assert_array_equal(np.sign(normals[lower, 1]), -1.0)


@pytest.mark.parallel([1, 3])
def test_the_surface_moves_with_its_sections(theory):
    """Positions after a small step differ by the map's velocities; the map is new once sections have turned."""
    support = [{"where": "end", "fix": ["x", "angle"], "velocity": {"x": 0.2, "angle": "2 - t"}}]
    start = {"displacement": ["0.1*y", "0.2*x", "0.3*x*y"]}
    solid = field(MPI.COMM_WORLD, gravity=[1.0, -3.0], b=beam(theory, supports=support, initial=start))
    before = solid.surface()
    for k in range(2):
        step(solid, 0.1 * k, 0.1)
    assert solid.surface() is not before
    assert solid.surface() is solid.surface()
    surface, x = solid.surface(), solid.surface_positions()
    everything = np.concatenate(solid.comm.allgather(solid.unknown()))
    moved = surface.point_map @ everything + surface.fixed_map @ solid.fixed_velocity()
    np.testing.assert_allclose(moved.reshape(-1, 2), solid.surface_velocity(), atol=1e-13)
    assert surface.fixed_map.nnz == 2 * (1 + 2)
    tiny = 1e-6
    solid.displacement = solid.displacement + tiny * solid._integrator.solved(solid._motion())
    np.testing.assert_allclose((solid.surface_positions() - x) / tiny, moved.reshape(-1, 2), atol=1e-4)
    assert all(np.array_equal(f, surface.facets) for f in solid.comm.allgather(surface.facets))


@pytest.mark.parallel([1, 3])
def test_between_predict_and_accept_the_surface_is_where_the_tangent_is():
    solid = field(MPI.COMM_WORLD, integrator="bdf2", b=beam(initial={"velocity": [0.3, 0.1, "y"]}))
    rest = solid.surface_positions()
    solid.predict(0.0, 0.1)
    ahead = solid.surface_positions()
    np.testing.assert_allclose(ahead[:2].mean(axis=0) - rest[:2].mean(axis=0), [0.03, 0.01], atol=1e-14)
    assert solid.surface() is solid.surface()


@pytest.mark.parallel([1, 3])
def test_output_is_the_strip_between_the_faces(theory):
    start = {"displacement": ["0.1*y", "0.2*x", "0.3*x*y"], "velocity": [1.0, "x", "y"]}
    solid = field(MPI.COMM_WORLD, b=beam(theory, initial=start))
    points, cells = gathered(solid, "points"), gathered(solid, "cells")
    moved = points + gathered(solid, "displacement")
    np.testing.assert_allclose(moved, solid.surface_positions(), atol=1e-14)
    np.testing.assert_allclose(gathered(solid, "velocity"), solid.surface_velocity(), atol=1e-14)
    corners = points[cells]
    areas = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(0.1 * LENGTH)


# ---- motion -------------------------------------------------------------------------------------------------


def busy(comm, theory, integrator):
    supports = [{"where": "start", "fix": ["x", "y", "angle"], "velocity": {"x": "0.2*cos(9*t)", "angle": "0.1*t"}}]
    first = beam(theory, supports=supports, damping={"stiffness": 0.01, "mass": 0.1})
    other = beam(theory, 4, (3.0, 0.0), (3.0, 1.0), mass="lumped", initial={"velocity": ["0.1*y", "0.2", "0.3*y"]})
    return field(comm, [0.0, -9.81], integrator, one=first, two=other)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("integrator, dt", STEPS.items())
def test_ranks_agree(theory, integrator, dt):
    alone, shared = busy(MPI.COMM_SELF, theory, integrator), busy(MPI.COMM_WORLD, theory, integrator)
    for k in range(3):
        step(alone, dt * k, dt)
        step(shared, dt * k, dt)
    for name in ("displacement", "velocity"):
        np.testing.assert_allclose(gathered(shared, name), gathered(alone, name), atol=1e-10)
    np.testing.assert_allclose(shared.surface_positions(), alone.surface_positions(), atol=1e-11)
    assert shared.energies() == pytest.approx(alone.energies(), rel=1e-8)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator, dt", STEPS.items())
def test_a_restored_beam_goes_on_bit_for_bit(theory, integrator, dt):
    comm = MPI.COMM_WORLD
    solid, again = busy(comm, theory, integrator), busy(comm, theory, integrator)
    for k in range(2):
        step(solid, dt * k, dt)
    whole = {name: np.concatenate(comm.allgather(slab.data)) for name, slab in solid.state().items()}

    def read(name, start, count):
        return whole[name][tuple(slice(s, s + c) for s, c in zip(start, count, strict=True))]

    again.restore(read)
    for one in (solid, again):
        step(one, 2 * dt, dt)
    np.testing.assert_array_equal(solid.displacement, again.displacement)
    np.testing.assert_array_equal(solid.velocity, again.velocity)


@pytest.mark.parallel([1, 3])
def test_the_near_null_space_is_that_of_the_stiffness(theory):
    solid = field(MPI.COMM_WORLD, b=beam(theory, 5))
    rest = np.zeros((len(solid._mesh.points), 3))
    _, f, K = solid._elements.theory.respond(solid._elements._of_elements(rest))
    modes = solid.near_null_space()
    assert len(modes) == 3
    for mode in modes:
        u = solid._elements._of_elements(solid._exchange.with_shared(mode.reshape(-1, 3)))
        assert np.abs(K @ u[:, :, None]).max(initial=0.0) < 1e-12 * np.abs(K).max(initial=1.0)
    assert solid.block.getBlockSize() == 3


@pytest.mark.parallel([1, 3])
def test_light_motions_bend_without_shear():
    solid = field(MPI.COMM_WORLD, heavy=beam(), light=beam(start=(2.0, 0.0), end=(2.75, 1.0)) | {"density": 0.1})
    assert solid.light_motions(2, 0.05, 60).shape == (0, solid.layout.n_local)
    motions = solid.light_motions(2, 0.2, 60)
    assert len(motions) == 2 * 3
    assert len(solid.light_motions(5, 0.2, 6)) == 6
    for motion in motions:
        u = solid._exchange.with_shared(motion.reshape(-1, 3))[solid._mesh.cells]
        across = (u[:, :, :2] @ [-0.8, 0.6])[:, :2]
        slope = (across[:, 1] - across[:, 0]) / solid._elements.length
        # of a parabola the mean of the slopes at both ends is that of the chord
        np.testing.assert_allclose(u[:, :2, 2].mean(axis=1), slope, atol=1e-12)
        assert np.abs(u[solid._mesh.body == 0]).max(initial=0.0) == 0.0


def test_a_heavy_chain_swings_as_a_rigid_pendulum_while_it_is_stiff():
    """A pinned uniform rod: omega^2 = 3 g/2 L (1 + h^2/4 L^2)^-1."""
    hinge = [{"where": "start", "fix": ["x", "y"]}]
    rod = beam(start=(0, 0), end=(0, -1), thickness=0.05, supports=hinge) | {"young": 1e7}
    rod["initial"] = {"velocity": ["-0.01*y", 0.0, 0.01]}
    solid = field(gravity=[0.0, -9.81], integrator="midpoint", b=rod)
    omega = np.sqrt(1.5 * 9.81 / (1 + 0.05**2 / 4))
    n = 200
    h = 2 * np.pi / omega / n
    for k in range(n):
        step(solid, k * h, h)
    angle = solid.probe("b", [0.0, -1.0], "angle")[0]
    assert abs(angle) < 0.01 / omega * 5e-3
    assert solid.probe("b", [0.0, -1.0], "velocity")[0] == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("integrator, order", [("newmark", 1), ("bdf2", 2), ("midpoint", 2)])
def test_a_large_swing_keeps_the_integrators_order(integrator, order):
    ends = []
    for n in (20, 40, 80, 160):
        bar = beam(elements=2, end=(LENGTH, 0), thickness=0.2, supports=CLAMP) | {"young": 50.0}
        solid = field(gravity=[0.0, "-20*t**2"], integrator=integrator, b=bar)
        for k in range(n):
            step(solid, k * 0.8 / n, 0.8 / n)
        ends.append(solid.probe("b", [LENGTH, 0.0], "displacement"))
    assert ends[-1][1] < -0.5 * LENGTH
    change = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    seen = np.log2(change[:-1] / change[1:])
    np.testing.assert_allclose(seen, order, atol=0.1)


# ---- probes -------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_a_probe_reads_the_axis(theory):
    start = {"displacement": ["0.1*x", "0.2*x", 0.16], "velocity": [1.0, "x", 0.6]}
    solid = field(MPI.COMM_WORLD, b=beam(theory, start=(0, 0), end=(1, 0), initial=start))
    for x in (0.0, 0.3, 1.0):
        np.testing.assert_allclose(solid.probe("b", [x, 0.03], "displacement")[0], 0.1 * x, atol=1e-14)
        assert solid.probe("b", [x, 0.03], "velocity")[0] == pytest.approx(1.0)
    assert solid.probe("b", [0.5, 0.0], "displacement")[1] == pytest.approx(0.1)
    assert solid.probe("b", [0.5, 0.0], "angle") == pytest.approx([0.16])
    with pytest.raises(InputError, match=r"lies 0.2 m from the axis of solids.b, more than its thickness \(0.1 m\)"):
        solid.probe("b", [0.5, 0.2], "displacement")
    with pytest.raises(InputError, match="'stress' is not known"):
        solid.probe("b", [0.5, 0.0], "stress")
    with pytest.raises(InputError, match="known solids are b"):
        solid.probe("c", [0.5, 0.0], "angle")
