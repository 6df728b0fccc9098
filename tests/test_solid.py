"""The solid field: forces, one step, order in time, supports."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from solid_cases import (
    DENSITY,
    LAME,
    MU,
    YOUNG,
    Slow,
    bent_mesh,
    body,
    dense,
    elements_of,
    field,
    gathered,
    pattern_of,
    respond,
    simplices,
    step,
    wave,
)

from petfsi.errors import InputError
from petfsi.fields.solid.elements import CHUNK
from petfsi.fields.solid.materials import lame_parameters
from petfsi.geometry.meshes import box_mesh
from petfsi.integrators import named
from petfsi.registry import INTEGRATORS
from petfsi.scene.tables import Box


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


# ---- forces -------------------------------------------------------------------------------------------------


def test_patch_a_linear_displacement_loads_no_inner_node(dim):
    points, cells, inner = bent_mesh(dim)
    mesh = simplices(points, cells)
    F = np.eye(dim) + wave(dim, dim, size=0.3)
    _, b = respond(elements_of(mesh), pattern_of(mesh), points @ (F - np.eye(dim)).T)
    assert np.abs(b[~inner]).max() > 0.1
    assert np.abs(b[inner]).max() < 1e-13 * np.abs(b).max()


def test_a_rigid_motion_costs_nothing(dim):
    points, cells, _ = bent_mesh(dim)
    mesh = simplices(points, cells)
    angle = 1.1
    R = np.eye(dim)
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    d = points @ (R - np.eye(dim)).T + 3.0
    elements = elements_of(mesh)
    A, b = respond(elements, pattern_of(mesh), d)
    assert np.abs(b).max() < 1e-13 * np.abs(A).max()
    assert elements.energies(d, 0 * d, np.ones(len(cells), dtype=bool))[1] < 1e-28 * YOUNG
    # and the turned body answers no rigid motion on top
    x = points + d
    spin = np.zeros_like(x)
    spin[:, 0], spin[:, 1] = -x[:, 1], x[:, 0]
    assert np.abs(A @ spin.ravel()).max() < 1e-12 * np.abs(A).max() * np.abs(x).max()


def test_force_is_the_derivative_of_energy_and_tangent_of_force(dim):
    points, cells, _ = bent_mesh(dim, n=2)
    mesh = simplices(points, cells)
    elements, pattern = elements_of(mesh), pattern_of(mesh)
    d, direction = wave(len(points), dim), wave(len(points), dim, seed=9, size=1.0)
    A, b = respond(elements, pattern, d)
    h = 1e-6
    counted = np.ones(len(cells), dtype=bool)
    energy = [elements.energies(d + s * h * direction, d, counted)[1] for s in (1, -1)]
    work = -(b * direction).sum()
    assert (energy[0] - energy[1]) / (2 * h) == pytest.approx(work, rel=1e-8)
    forces = [-respond(elements, pattern, d + s * h * direction)[1] for s in (1, -1)]
    expected = (forces[0] - forces[1]).ravel() / (2 * h)
    np.testing.assert_allclose(A @ direction.ravel(), expected, atol=1e-8 * np.abs(expected).max())


def test_matrix_and_right_hand_side_are_those_of_the_slow_statement(dim):
    points, cells, _ = bent_mesh(dim, n=2)
    mesh = simplices(points, cells)
    slow = Slow(points, cells)
    d, inertia, shift = (wave(len(points), dim, seed=seed) for seed in (3, 4, 5))
    elements = elements_of(mesh)
    elements.bodies.mass_damping[:], elements.bodies.stiffness_damping[:] = 0.4, 0.1
    A, b = respond(elements, pattern_of(mesh), d, inertia, shift, a=2.0, k=0.3)
    K = slow.tangent(d)
    expected = 2.4 * slow.M + 0.4 * K
    np.testing.assert_allclose(A, expected, atol=1e-13 * np.abs(expected).max())
    load = slow.M @ inertia.ravel() - K @ shift.ravel() - slow.force(d).ravel()
    np.testing.assert_allclose(b.ravel(), load, atol=1e-13 * np.abs(load).max())


def test_more_elements_than_a_chunk_give_the_same_as_one_by_one():
    points, cells, _ = bent_mesh(3, n=5)
    mesh = simplices(points, cells)
    assert len(cells) > CHUNK
    d = wave(len(points), 3, size=0.01)
    _, b = respond(elements_of(mesh), pattern_of(mesh), d)
    np.testing.assert_allclose(b, -Slow(points, cells).force(d), atol=1e-13)


# ---- one step -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_a_step_is_equation_18(dim, mass):
    """(M/h + C + h/2 K') u1 = M/h u0 - K'(d0 + h/2 u0 - d~) - K(d~) + f_e,  C = a0 M + a1 K',  d1 = d0 + h/2 (u0 + u1).

    With d~ = d0 the equation as published, else linearised where d0 turns to.
    """
    h, a0, a1 = 0.07, 0.4, 0.02
    solid = field(dim, gravity=["0.5*t", -2.0, 0.3][:dim],
                  b=body(dim, (2, 2, 1), mass=mass, damping={"mass": a0, "stiffness": a1}))  # fmt: skip
    points, cells = gathered(solid, "points"), gathered(solid, "cells")
    slow = Slow(points, cells, lumped=mass == "lumped")
    solid.displacement, solid.velocity = wave(len(points), dim), wave(len(points), dim, seed=4, size=1.0)
    d, u = solid.displacement.copy(), solid.velocity.ravel().copy()
    there = d + solid._turning.in_place(d, u.reshape(d.shape), h)
    K, M = slow.tangent(there), slow.M
    g = np.tile(np.array([0.5 * (0.2 + h), -2.0, 0.3][:dim]), len(points))
    A = M / h + a0 * M + a1 * K + h / 2 * K
    b = (M / h - h / 2 * K) @ u - K @ (d - there).ravel() - slow.force(there).ravel() + M @ g
    step(solid, 0.2, h)
    np.testing.assert_allclose(dense(solid.block), A, atol=1e-13 * np.abs(A).max())
    np.testing.assert_allclose(solid.rhs, b, atol=1e-13 * np.abs(b).max())
    expected = np.linalg.solve(A, b)
    np.testing.assert_allclose(solid.velocity.ravel(), expected, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(solid.displacement, d + h / 2 * (u + expected).reshape(d.shape), atol=1e-12)


def test_the_matrix_is_symmetric_with_supports(dim):
    solid = field(dim, b=body(dim, supports=[{"where": "left", "fix": ["x", "y"], "velocity": {"x": 1.0}}]))
    solid.displacement = wave(*solid.displacement.shape)
    solid.assemble(0.0, 0.1)
    A = dense(solid.block)
    assert np.abs(A - A.T).max() < 1e-14 * np.abs(A).max()
    assert np.linalg.eigvalsh(A).min() > 0


def test_mass_is_density_times_volume_and_rows_scale_by_it(dim):
    cavity = {"origin": [0.5, 0.0, 0.0][:dim], "size": [0.5, 0.5, 0.8][:dim]}
    solid = field(dim, b=body(dim, cavity=cavity))
    volume = {2: 1.5 - 0.25, 3: (1.5 - 0.25) * 0.8}[dim]
    assert solid.volumes()["b"] == pytest.approx(volume, rel=1e-14)
    rest = np.zeros_like(solid.reference)
    A, _ = respond(solid._elements, solid._pattern, rest, a=1.0, k=0.0)
    ones = np.tile(np.eye(dim)[0], len(rest))
    assert ones @ A @ ones == pytest.approx(DENSITY * volume, rel=1e-13)
    solid.assemble(0.0, 0.1)
    assert solid.row_scale == pytest.approx(0.1 / (DENSITY * volume / len(rest)))
    solid.set_scale(7.0)
    solid.assemble(0.0, 0.1)
    assert (solid.row_scale, solid.col_scale, solid.n_assembled) == (0.1 / 7.0, 1.0, 2)


def test_a_free_body_falls_exactly_and_does_not_deform(dim):
    start = {"velocity": ["1.0", 0.0, "2"][:dim], "displacement": [0.5, 0.0, 0.0][:dim]}
    solid = field(dim, gravity=[0.0, -9.81, 0.0][:dim], b=body(dim, initial=start))
    h, n = 0.05, 10
    for k in range(n):
        step(solid, k * h, h)
    t = n * h
    expected = np.array([0.5 + t, -9.81 * t * t / 2, 2 * t][:dim])
    np.testing.assert_allclose(solid.displacement, np.broadcast_to(expected, solid.displacement.shape), atol=1e-11)
    assert solid.quality() == pytest.approx(1.0, abs=1e-11)


# ---- integrators --------------------------------------------------------------------------------------------

SWING = body(2, (3, 1), size=(1.5, 0.5), supports=[{"where": "left", "fix": ["x", "y"]}],
             initial={"velocity": [0.0, "1.5*x"]})  # fmt: skip
END = 0.6


@pytest.fixture(scope="module")
def swing():
    """Displacement and velocity of a nonlinear oscillation at its end: M a = -K(d) integrated to 1e-10."""
    solid = field(2, b=SWING)
    points, cells = gathered(solid, "points"), gathered(solid, "cells")
    slow = Slow(points, cells)
    free = np.repeat(points[:, 0] > 1e-9, 2)
    inverse = np.linalg.inv(slow.M[np.ix_(free, free)])
    n = points.size

    def rate(_, y):
        acceleration = np.zeros(n)
        acceleration[free] = -inverse @ slow.force(y[:n].reshape(points.shape)).ravel()[free]
        return np.concatenate((y[n:], acceleration))

    y0 = np.concatenate((np.zeros(n), solid.velocity.ravel()))
    exact = solve_ivp(rate, (0, END), y0, method="DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    assert np.abs(exact[:n]).max() > 0.2  # strains reach a third
    return exact.reshape(2, *points.shape)


def steps_of(n, uneven):
    """Return the lengths of n steps to END; uneven ones differ from their neighbours by factors up to 1.74."""
    lengths = 1.0 + uneven * 0.35 * np.sin(1.7 * np.arange(n))
    return END * lengths / lengths.sum()


def swing_error(integrator, n, exact, uneven=False):
    solid = field(2, integrator=integrator, b=SWING)
    t = 0.0
    for h in steps_of(n, uneven):
        step(solid, t, h)
        t += h
    return np.array([np.linalg.norm(solid.displacement - exact[0]), np.linalg.norm(solid.velocity - exact[1])])


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize(
    "integrator, counts", [("newmark", (320, 640)), ("bdf2", (240, 480)), ("midpoint", (120, 240))]
)
def test_an_integrator_keeps_its_order_on_a_nonlinear_oscillation(integrator, counts, uneven, swing):
    errors = np.array([swing_error(integrator, n, swing, uneven) for n in counts])
    seen = np.log2(errors[:-1] / errors[1:])[-1]
    assert seen == pytest.approx(named(integrator).order, abs=0.1), errors


def test_midpoint_keeps_the_energy_of_small_swings():
    """So small that the force is linear, and the energy quadratic; Newmark's scheme loses most of it."""
    left = {}
    for integrator in ("newmark", "midpoint"):
        start = {"velocity": [0.0, "1e-7*sin(3*x)"]}
        support = [{"where": "left", "fix": ["x", "y"]}]
        solid = field(2, integrator=integrator, b=body(2, (6, 3), supports=support, initial=start))
        first = sum(solid.energies().values())
        energies = []
        for n in range(40):
            step(solid, 0.1 * n, 0.1)
            energies.append(sum(solid.energies().values()) / first)
        left[integrator] = energies
    np.testing.assert_allclose(left["midpoint"], 1.0, rtol=1e-6)
    assert left["newmark"][-1] < 0.5


@pytest.mark.parametrize("integrator", [name for name in INTEGRATORS if name != "static"])
def test_any_integrator_lets_a_free_body_fall_without_deforming(dim, integrator):
    solid = field(dim, gravity=[0.0, -9.81, 0.0][:dim], integrator=integrator, b=body(dim))
    h, n = 0.05, 10
    for k in range(n):
        step(solid, k * h, h)
    speed = -9.81 * n * h
    np.testing.assert_allclose(solid.velocity, np.tile([0.0, speed, 0.0][:dim], (len(solid.velocity), 1)), atol=1e-11)
    assert np.ptp(solid.displacement, axis=0).max() < 1e-11
    assert solid.quality() == pytest.approx(1.0, abs=1e-11)


@pytest.mark.parametrize("integrator, at_end", [("bdf2", True), ("midpoint", False)])
def test_prescribed_nodes_and_the_surface_follow_the_scheme(integrator, at_end):
    """w holds at the end of BDF2's step and in the middle of midpoint's; the surface waits where the step will be."""
    supports = [{"where": "all", "fix": ["x", "y"], "velocity": {"x": "1 + t**2"}}]
    solid = field(2, integrator=integrator, b=body(2, supports=supports))
    h, t, rest = 0.1, 0.0, solid.surface_positions()
    for _ in range(4):
        d = solid.displacement[:, 0].copy()
        solid.predict(t, h)
        waits = (solid.surface_positions() - rest)[:, 0]
        step(solid, t, h)
        t += h
        np.testing.assert_allclose(solid.velocity[:, 0], 1 + t**2, rtol=1e-12)
        w = 1 + t**2 if at_end else 1 + (t**2 + (t - h) ** 2) / 2
        np.testing.assert_allclose(solid.surface_velocity()[:, 0], w, rtol=1e-12)
        np.testing.assert_allclose(solid.fixed_velocity()[::2], w, rtol=1e-12)
        there = solid.displacement[:, 0] if at_end else (solid.displacement[:, 0] + d) / 2
        assert np.abs(waits - there[0]).max() < 2 * h**2
        np.testing.assert_allclose((solid.surface_positions() - rest)[:, 0], solid.displacement[0, 0], rtol=1e-12)


def test_a_bar_swings_axially_at_its_closed_form_frequency():
    """Fixed at one end: omega = pi c / (2 L), c^2 = E / density at zero Poisson ratio; error of second order."""
    length, young, errors = 2.0, 100.0, []
    for n in (8, 16, 32):
        points, cells = box_mesh(Box(origin=[0, 0], size=[length, length / n], cells=[n, 1]))
        mesh = simplices(points, cells)
        elements = elements_of(mesh, "green", *lame_parameters(young, 0.0))
        pattern, rest = pattern_of(mesh), np.zeros_like(points)
        M = respond(elements, pattern, rest, a=1.0, k=0.0)[0]
        K = respond(elements, pattern, rest)[0]
        axial = np.flatnonzero(np.column_stack((points[:, 0] > 0, np.zeros(len(points), dtype=bool))).ravel())
        squares = eigh(K[np.ix_(axial, axial)], M[np.ix_(axial, axial)], eigvals_only=True)
        omega = np.pi / 2 * np.sqrt(young / DENSITY) / length
        errors.append(abs(np.sqrt(squares[0]) / omega - 1))
    assert errors[-1] < 2e-4
    assert np.diff(np.log(errors)) / np.log(0.5) == pytest.approx(2.0, abs=0.1)


def test_two_bodies_in_one_field_move_as_each_alone():
    stiff = {**body(2), "young": 500.0, "density": 9.0}
    soft = body(2, origin=(5.0, 0.0))
    both = field(2, gravity=[1.0, 0.0], stiff={**stiff, "supports": [{"where": "left", "fix": ["x", "y"]}]}, soft=soft)
    alone = field(2, gravity=[1.0, 0.0], stiff={**stiff, "supports": [{"where": "left", "fix": ["x", "y"]}]})
    for solid in (both, alone):
        for k in range(3):
            step(solid, 0.1 * k, 0.1)
    n = len(alone.displacement)
    np.testing.assert_allclose(both.displacement[:n], alone.displacement, atol=1e-13)
    np.testing.assert_allclose(both.displacement[n:, 0], 0.3**2 / 2, atol=1e-13)
    assert both.volumes().keys() == {"stiff", "soft"}
    assert both.volumes()["soft"] == pytest.approx(1.5, rel=1e-12)


# ---- supports -----------------------------------------------------------------------------------------------

PULLED = {
    2: [{"where": w, "fix": ["x", "y"], "velocity": {"x": "0.3*x-0.2*y", "y": "0.1*x+0.4*y"}}
        for w in ("left", "right", "bottom", "top")],
    3: [{"where": w, "fix": ["x", "y", "z"], "velocity": {"x": "0.3*x-0.2*z", "y": "0.1*x+0.4*y", "z": "0.5*z"}}
        for w in ("left", "right", "bottom", "top", "back", "front")],
}  # fmt: skip
LINEAR = {
    2: np.array([[0.3, -0.2], [0.1, 0.4]]),
    3: np.array([[0.3, 0, -0.2], [0.1, 0.4, 0], [0, 0, 0.5]]),
}


@pytest.mark.parallel([1, 3])
def test_patch_a_boundary_pulled_linearly_carries_the_inside_along(dim):
    """u = L x solves the nonlinear problem exactly: no acceleration, and no inner force at any stretch."""
    linear = [" + ".join(f"({c})*{x}" for c, x in zip(row, "xyz", strict=False)) for row in LINEAR[dim].tolist()]
    solid = field(dim, MPI.COMM_WORLD, b=body(dim, (4, 4, 3), supports=PULLED[dim], initial={"velocity": linear}))
    h, n = 0.1, 5
    for k in range(n):
        step(solid, k * h, h)
    expected = solid.reference @ LINEAR[dim].T
    np.testing.assert_allclose(solid.velocity, expected, atol=1e-12)
    np.testing.assert_allclose(solid.displacement, n * h * expected, atol=1e-12)
    F = np.eye(dim) + n * h * LINEAR[dim]
    assert solid.quality() == pytest.approx(np.linalg.det(F), rel=1e-11)
    E = (F.T @ F - np.eye(dim)) / 2
    volume = {2: 1.5, 3: 1.2}[dim]
    density = LAME / 2 * np.trace(E) ** 2 + MU * (E * E).sum()
    assert solid.energies()["elastic"] == pytest.approx(density * volume, rel=1e-11)
    assert solid.volumes()["b"] == pytest.approx(volume * np.linalg.det(F), rel=1e-11)


def test_prescribed_velocities_follow_time_and_the_later_support_holds():
    supports = [
        {"where": "left", "fix": ["x", "y"], "velocity": {"x": "sin(t)"}},
        {"where": {"box": {"origin": [-1, 0.9], "size": [1.2, 1]}}, "fix": ["y"], "velocity": {"y": "t + x"}},
    ]
    solid = field(2, b=body(2, supports=supports))
    left, corner = solid.reference[:, 0] == 0, (solid.reference == [0, 1]).all(axis=1)
    step(solid, 0.0, 0.1)
    step(solid, 0.1, 0.1)
    np.testing.assert_allclose(solid.velocity[left, 0], np.sin(0.2), atol=1e-14)
    np.testing.assert_allclose(solid.velocity[left & ~corner, 1], 0, atol=1e-14)
    np.testing.assert_allclose(solid.velocity[corner, 1], 0.2, atol=1e-14)
    np.testing.assert_allclose(solid.displacement[left, 0], 0.05 * (2 * np.sin(0.1) + np.sin(0.2)), atol=1e-14)
    g = solid.fixed_velocity().reshape(-1, 2)
    np.testing.assert_array_equal(g != 0, (np.outer(left, [1, 0]) + np.outer(corner, [0, 1])) > 0)


def test_elimination_gives_the_solution_of_the_reduced_system():
    support = [{"where": "bottom", "fix": ["x", "y"], "velocity": {"y": "0.3 - x"}}]
    free_body, held_body = field(2, b=body(2)), field(2, b=body(2, supports=support))
    for solid in (free_body, held_body):
        solid.displacement, solid.velocity = wave(*solid.displacement.shape), wave(*solid.displacement.shape, seed=8)
        solid.assemble(0.0, 0.1)
    A, b = dense(free_body.block), free_body.rhs
    fixed = np.repeat(held_body.reference[:, 1] == 0, 2)
    g = np.column_stack((0 * held_body.reference[:, 0], 0.3 - held_body.reference[:, 0])).ravel()
    expected = g.copy()
    lifted = b[~fixed] - A[np.ix_(~fixed, fixed)] @ g[fixed]
    expected[~fixed] = np.linalg.solve(A[np.ix_(~fixed, ~fixed)], lifted)
    got = dense(held_body.block)
    np.testing.assert_allclose(np.linalg.solve(got, held_body.rhs), expected, atol=1e-12)
    assert np.abs(got[np.ix_(fixed, ~fixed)]).max() == 0
    # inertia: with stiffness |b|, which the solver's bound is relative to, would grow with it
    np.testing.assert_allclose(np.diag(got)[fixed], held_body.mean_mass / 0.1, rtol=1e-13)


@pytest.mark.parallel([1, 3])
def test_mistakes_are_raised_on_every_rank(tmp_path):
    nowhere = [{"where": {"ball": {"centre": [9, 9], "radius": 1}}, "fix": ["x"]}]
    with pytest.raises(InputError, match=r"solids\.b\.supports\.0\.where: no node"):
        field(2, MPI.COMM_WORLD, b=body(2, supports=nowhere))
    with pytest.raises(InputError, match=r"solids\.b\.initial\.velocity\.1 = '1/x'"):
        field(2, MPI.COMM_WORLD, b=body(2, initial={"velocity": [0.0, "1/x"]}))
    with pytest.raises(InputError, match=r"solids\.b\.shape\.mesh = '/no/such\.vtk': no file"):
        field(2, MPI.COMM_WORLD, b={**body(2), "shape": {"mesh": "/no/such.vtk"}})
