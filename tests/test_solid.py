"""The solid field: forces, one step, order in time, supports, surface, ranks and state."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from petfsi.errors import InputError
from petfsi.fields.solid import SimplexSolid
from petfsi.fields.solid.elements import CHUNK, Bodies, Elements
from petfsi.fields.solid.materials import MATERIALS, lame_parameters
from petfsi.fields.solid.partition import Fetch, LocalMesh, bisect
from petfsi.fields.solid.pattern import Pattern
from petfsi.geometry.meshes import box_mesh
from petfsi.integrators import Coefficients
from petfsi.petsc import Layout
from petfsi.scene.schema import Box, Scene

DENSITY, YOUNG, POISSON = 1.3, 20.0, 0.3
LAME, MU = lame_parameters(YOUNG, POISSON)


def body(dim, cells=(3, 2, 2), origin=(0.0, 0.0, 0.0), size=(1.5, 1.0, 0.8), cavity=None, **more):
    shape = {"box": {"origin": list(origin[:dim]), "size": list(size[:dim]), "cells": list(cells[:dim])}}
    if cavity:
        shape["cavity"] = cavity
    return {"shape": shape, "density": DENSITY, "young": YOUNG, "poisson": POISSON, **more}


def field(dim, comm=MPI.COMM_SELF, gravity=None, **solids):
    scene = {"dim": dim, "gravity": gravity, "time": {"end": 1.0, "dt": 0.1}, "solids": solids}
    return SimplexSolid(comm, Scene.model_validate(scene))


def step(solid, time, dt):
    """Advance by a direct solve."""
    solid.predict(time, dt)
    solid.assemble(time, dt)
    ksp = PETSc.KSP().create(solid.comm)
    ksp.setOperators(solid.block)
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    ksp.getPC().setFactorSolverType("mumps")
    x, b = solid.block.createVecs()
    b.setArray(solid.rhs)
    ksp.solve(b, x)
    solid.accept(x.getArray().copy(), time, dt)
    for thing in (ksp, x, b):
        thing.destroy()


def gathered(solid, name):
    """Return a quantity in natural order, whole, on every rank."""
    slabs = solid.comm.allgather(solid.output()[name])
    assert [s.start[0] for s in slabs] == np.cumsum([0] + [len(s.data) for s in slabs[:-1]]).tolist()
    whole = np.concatenate([s.data for s in slabs])
    assert whole.shape == slabs[0].shape
    return whole


def dense(mat):
    copy = mat.convert("dense", PETSc.Mat())
    values = copy.getDenseArray().copy()
    copy.destroy()
    return values


def wave(n, dim, seed=3, size=0.05):
    return size * np.random.default_rng(seed).standard_normal((n, dim))


# ---- an independent, slow statement of the finite elements --------------------------------------------------


class Slow:
    """M, K(d) and, by complex steps, K'(d), in the mesh's own order; also takes complex d."""

    def __init__(self, points, cells, lumped=False):
        self.points, self.cells, self.dim = points, cells, points.shape[1]
        n, corners = points.shape[0], self.dim + 1
        self.M = np.zeros((n, n))
        self.elements = []
        for cell in cells:
            X = np.column_stack((np.ones(corners), points[cell]))
            V = np.linalg.det(X) / [2, 6][self.dim - 2]
            self.elements.append((V, np.linalg.inv(X)[1:].T))
            weights = np.eye(corners) / corners if lumped else (1 + np.eye(corners)) / (corners * (corners + 1))
            self.M[np.ix_(cell, cell)] += DENSITY * V * weights
        self.M = np.kron(self.M, np.eye(self.dim))

    def force(self, d):
        f = np.zeros_like(d)
        for (V, g), cell in zip(self.elements, self.cells, strict=True):
            F = np.eye(self.dim) + d[cell].T @ g
            E = (F.T @ F - np.eye(self.dim)) / 2
            S = LAME * np.trace(E) * np.eye(self.dim) + 2 * MU * E
            f[cell] += V * g @ (F @ S).T
        return f

    def tangent(self, d):
        columns = []
        for j in range(d.size):
            e = np.zeros(d.size, dtype=complex)
            e[j] = 1e-30j
            columns.append(self.force(d + e.reshape(d.shape)).imag.ravel() / 1e-30)
        return np.array(columns).T


def bent_mesh(dim, n=3):
    """Return a box mesh whose inner points are moved about."""
    points, cells = box_mesh(Box(origin=[0] * dim, size=[1] * dim, cells=[n] * dim))
    inner = np.all((points > 1e-9) & (points < 1 - 1e-9), axis=1)
    points = points + inner[:, None] * wave(len(points), dim, seed=5, size=0.2 / n**1.5)
    return points, cells.astype(np.int32), inner


def elements_of(points, cells):
    one = np.ones(1)
    bodies = Bodies(
        DENSITY * one, LAME * one, MU * one, [MATERIALS["green"]], np.zeros(1, dtype=bool), 0 * one, 0 * one
    )
    return Elements(points, cells, np.zeros(len(cells), dtype=np.int32), bodies)


def pattern_of(points, cells):
    n = len(points)
    everything = np.arange(n)
    return Pattern.of(
        LocalMesh(points, cells, np.zeros(len(cells), np.int32), np.arange(len(cells)), np.ones(len(cells), bool),
                  everything.astype(np.int32), everything, Layout(n, 0, n))
    )  # fmt: skip


def respond(elements, pattern, d, u=None, step=None):
    """Return the dense matrix and b for given factors; by default K' and -K(d)."""
    n = d.size
    values, b = np.empty(len(pattern.indices)), np.empty_like(d)
    step = step or Coefficients(0.0, 1.0, 0.0, 0.0)
    elements.assemble(d, np.zeros_like(d) if u is None else u, step, pattern, values, b)
    A = np.zeros((n, n))
    A[np.repeat(np.arange(n), np.diff(pattern.indptr)), pattern.indices] = values
    return A, b


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


# ---- forces -------------------------------------------------------------------------------------------------


def test_patch_a_linear_displacement_loads_no_inner_node(dim):
    points, cells, inner = bent_mesh(dim)
    F = np.eye(dim) + wave(dim, dim, size=0.3)
    _, b = respond(elements_of(points, cells), pattern_of(points, cells), points @ (F - np.eye(dim)).T)
    assert np.abs(b[~inner]).max() > 0.1
    assert np.abs(b[inner]).max() < 1e-14 * np.abs(b).max() * 30


def test_a_rigid_motion_costs_nothing(dim):
    points, cells, _ = bent_mesh(dim)
    angle = 1.1
    R = np.eye(dim)
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    d = points @ (R - np.eye(dim)).T + 3.0
    elements = elements_of(points, cells)
    A, b = respond(elements, pattern_of(points, cells), d)
    assert np.abs(b).max() < 1e-13 * np.abs(A).max()
    assert elements.energies(d, 0 * d, np.ones(len(cells), dtype=bool))[1] < 1e-28 * YOUNG
    # and the turned body answers no rigid motion on top
    x = points + d
    spin = np.zeros_like(x)
    spin[:, 0], spin[:, 1] = -x[:, 1], x[:, 0]
    assert np.abs(A @ spin.ravel()).max() < 1e-12 * np.abs(A).max() * np.abs(x).max()


def test_force_is_the_derivative_of_energy_and_tangent_of_force(dim):
    points, cells, _ = bent_mesh(dim, n=2)
    elements, pattern = elements_of(points, cells), pattern_of(points, cells)
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
    slow = Slow(points, cells)
    d, u = wave(len(points), dim), wave(len(points), dim, seed=4, size=1.0)
    A, b = respond(elements_of(points, cells), pattern_of(points, cells), d, u, Coefficients(2.0, 0.3, 5.0, 0.7))
    K = slow.tangent(d)
    expected = 2.0 * slow.M + 0.3 * K
    np.testing.assert_allclose(A, expected, atol=1e-13 * np.abs(expected).max())
    load = (5.0 * slow.M - 0.7 * K) @ u.ravel() - slow.force(d).ravel()
    np.testing.assert_allclose(b.ravel(), load, atol=1e-13 * np.abs(load).max())


def test_more_elements_than_a_chunk_give_the_same_as_one_by_one():
    points, cells, _ = bent_mesh(3, n=5)
    assert len(cells) > CHUNK
    d = wave(len(points), 3, size=0.01)
    _, b = respond(elements_of(points, cells), pattern_of(points, cells), d)
    np.testing.assert_allclose(b, -Slow(points, cells).force(d), atol=1e-13)


# ---- one step -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_a_step_is_equation_18(dim, mass):
    """(M/h + C + h/2 K') u1 = (M/h - h/2 K') u0 - K(d0) + f_e,  C = a0 M + a1 K',  d1 = d0 + h/2 (u0 + u1)."""
    h, a0, a1 = 0.07, 0.4, 0.02
    solid = field(dim, gravity=["0.5*t", -2.0, 0.3][:dim],
                  b=body(dim, (2, 2, 1), mass=mass, damping={"mass": a0, "stiffness": a1}))  # fmt: skip
    points, cells = gathered(solid, "points"), gathered(solid, "cells")
    slow = Slow(points, cells, lumped=mass == "lumped")
    solid.displacement, solid.velocity = wave(len(points), dim), wave(len(points), dim, seed=4, size=1.0)
    d, u = solid.displacement.copy(), solid.velocity.ravel().copy()
    K, M = slow.tangent(d), slow.M
    g = np.tile(np.array([0.5 * (0.2 + h), -2.0, 0.3][:dim]), len(points))
    A = M / h + a0 * M + a1 * K + h / 2 * K
    b = (M / h - h / 2 * K) @ u - slow.force(d).ravel() + M @ g
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
    A, _ = respond(solid._elements, solid._pattern, rest, step=Coefficients(1.0, 0.0, 0.0, 0.0))
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


def test_newmark_keeps_first_order_on_a_nonlinear_oscillation():
    """Against M a = -K(d) integrated to 1e-10 on the same mesh; strains reach a third."""
    support = [{"where": "left", "fix": ["x", "y"]}]
    start = {"velocity": [0.0, "1.5*x"]}
    end, errors = 0.6, []
    solid = field(2, b=body(2, (3, 1), size=(1.5, 0.5), supports=support, initial=start))
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
    exact = solve_ivp(rate, (0, end), y0, method="DOP853", rtol=1e-9, atol=1e-10).y[:, -1]
    for steps in (160, 320, 640):
        solid = field(2, b=body(2, (3, 1), size=(1.5, 0.5), supports=support, initial=start))
        for k in range(steps):
            step(solid, k * end / steps, end / steps)
        errors.append(np.linalg.norm(solid.displacement.ravel() - exact[:n]))
    seen = np.diff(np.log(errors)) / np.log(0.5)
    assert np.abs(exact[:n]).max() > 0.2
    assert seen == pytest.approx(1.0, abs=0.1), (seen, errors)


def test_a_bar_swings_axially_at_its_closed_form_frequency():
    """Fixed at one end: omega = pi c / (2 L), c^2 = E / density at zero Poisson ratio; error of second order."""
    length, young, errors = 2.0, 100.0, []
    for n in (8, 16, 32):
        points, cells = box_mesh(Box(origin=[0, 0], size=[length, length / n], cells=[n, 1]))
        elements = elements_of(points, cells.astype(np.int32))
        elements.bodies.lame[:], elements.bodies.mu[:] = lame_parameters(young, 0.0)
        pattern, rest = pattern_of(points, cells.astype(np.int32)), np.zeros_like(points)
        M = respond(elements, pattern, rest, step=Coefficients(1.0, 0.0, 0.0, 0.0))[0]
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
    diagonal = np.diag(got)[fixed]
    rest = field(2, b=body(2))
    rest.assemble(0.0, 0.1)
    np.testing.assert_allclose(diagonal, np.diag(dense(rest.block)).mean(), rtol=1e-13)


@pytest.mark.parallel([1, 3])
def test_mistakes_are_raised_on_every_rank(tmp_path):
    nowhere = [{"where": {"ball": {"centre": [9, 9], "radius": 1}}, "fix": ["x"]}]
    with pytest.raises(InputError, match=r"solids\.b\.supports\.0\.where: no node"):
        field(2, MPI.COMM_WORLD, b=body(2, supports=nowhere))
    with pytest.raises(InputError, match=r"solids\.b\.initial\.velocity\.1 = '1/x'"):
        field(2, MPI.COMM_WORLD, b=body(2, initial={"velocity": [0.0, "1/x"]}))
    with pytest.raises(InputError, match=r"solids\.b\.shape\.mesh = '/no/such\.vtk': no file"):
        field(2, MPI.COMM_WORLD, b={**body(2), "shape": {"mesh": "/no/such.vtk"}})


# ---- the solver's side --------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_the_near_null_space_is_that_of_the_stiffness(dim):
    solid = field(dim, MPI.COMM_WORLD, b=body(dim))
    rest, b = np.zeros_like(solid._mesh.points), np.empty_like(solid.reference)
    modes = solid.near_null_space()
    assert len(modes) == {2: 3, 3: 6}[dim]
    for mode in modes:
        u = solid._with_shared(mode.reshape(-1, dim))
        values = np.empty(len(solid._pattern.indices))
        solid._elements.assemble(rest, u, Coefficients(0.0, 0.0, 0.0, 1.0), solid._pattern, values, b)
        assert np.abs(b).max(initial=0) < 1e-12 * YOUNG
    solid.assemble(0.0, 0.1)
    assert len(solid.block.getNearNullSpace().getVecs()) == len(modes)
    assert solid.block.getBlockSize() == dim


@pytest.mark.parallel([1, 3])
def test_multigrid_counts_hardly_grow_with_the_mesh():
    counts = []
    for n in (4, 8, 16):
        bar = body(3, (2 * n, n, n), size=(2, 1, 1), supports=[{"where": "left", "fix": ["x", "y", "z"]}])
        solid = field(3, MPI.COMM_WORLD, gravity=[0, 0, -9.81], b=bar)
        solid.assemble(0.0, 10.0)  # a long step: stiffness rules
        ksp = PETSc.KSP().create(solid.comm)
        ksp.setOperators(solid.block)
        ksp.setType("cg")
        ksp.getPC().setType("gamg")
        ksp.setTolerances(rtol=1e-8)
        x, b = solid.block.createVecs()
        b.setArray(solid.rhs)
        ksp.solve(b, x)
        assert ksp.getConvergedReason() > 0
        counts.append(ksp.getIterationNumber())
        for thing in (ksp, x, b):
            thing.destroy()
    assert counts[-1] <= 1.6 * counts[0], counts
    assert counts[-1] <= 30, counts


# ---- the surface --------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_the_surface_moves_with_the_nodes(dim):
    support = [{"where": "left", "fix": ["x", "y"], "velocity": {"x": 2.0}}]
    solid = field(dim, MPI.COMM_WORLD, gravity=[1.0] * dim, b=body(dim, supports=support))
    surface = solid.surface()
    for k in range(2):
        step(solid, 0.1 * k, 0.1)
    everything = np.concatenate(solid.comm.allgather(solid.unknown()))
    moved = surface.point_map @ everything + surface.fixed_map @ solid.fixed_velocity()
    np.testing.assert_allclose(moved.reshape(-1, dim), solid.surface_velocity(), atol=1e-14)
    assert surface.fixed_map.nnz == 2 * np.prod([3, 3][: dim - 1])
    assert surface.fixed_map.nnz + surface.point_map.nnz == surface.n_points * dim
    points, shift = gathered(solid, "points"), gathered(solid, "displacement")
    on_rim = np.any((np.abs(points) < 1e-12) | (np.abs(points - [1.5, 1.0, 0.8][:dim]) < 1e-12), axis=1)
    np.testing.assert_allclose(solid.surface_positions(), (points + shift)[on_rim], atol=1e-14)
    assert all(np.array_equal(f, surface.facets) for f in solid.comm.allgather(surface.facets))
    corner = solid.surface_positions()[surface.facets]
    enclosed = np.linalg.det(corner).sum() / [2, 6][dim - 2]
    assert enclosed == pytest.approx(solid.volumes()["b"], rel=1e-12)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("interior", ["fluid", "void"])
def test_cavities_are_marked_and_empty_ones_too(dim, interior):
    hole = {"origin": [1.0] * dim, "size": [1.0] * dim}
    shell = body(dim, (3, 3, 3), size=(3, 3, 3), cavity=hole, interior=interior)
    solid = field(dim, MPI.COMM_WORLD, plain=body(dim, origin=(9, 9, 9), interior="void"), shell=shell)
    surface, x = solid.surface(), solid.surface_positions()
    middle = x[surface.facets].mean(axis=1)
    inner = np.all((middle > 0.99) & (middle < 2.01), axis=1)
    assert inner.sum() == {2: 4, 3: 12}[dim]
    np.testing.assert_array_equal(surface.cavity, inner)
    np.testing.assert_array_equal(surface.void, inner & (interior == "void"))


# ---- ranks and state ----------------------------------------------------------------------------------------


def busy(comm, dim):
    support = [{"where": "left", "fix": ["x", "y"], "velocity": {"x": "0.2*cos(9*t)"}}]
    first = body(dim, (5, 3, 2), supports=support, damping={"stiffness": 0.01},
                 initial={"velocity": ["y", "0.5*x", 0.1][:dim]})  # fmt: skip
    second = body(dim, (2, 4, 3), origin=(0.3, 2.0, 0.1), mass="lumped", initial={"displacement": ["0.1*x"] * dim})
    return field(dim, comm, gravity=["sin(t)", -1.0, 0.2][:dim], first=first, second=second)


@pytest.mark.parallel([1, 3])
def test_ranks_agree_with_one_rank(dim):
    many, one = busy(MPI.COMM_WORLD, dim), busy(MPI.COMM_SELF, dim)
    for k in range(5):
        step(many, 0.05 * k, 0.05)
        step(one, 0.05 * k, 0.05)
    for name in ("points", "cells", "body", "displacement", "velocity"):
        np.testing.assert_allclose(gathered(many, name), gathered(one, name), rtol=0, atol=1e-12, err_msg=name)
    assert many.energies() == pytest.approx(one.energies(), rel=1e-12)
    assert many.volumes() == pytest.approx(one.volumes(), rel=1e-12)
    assert many.quality() == pytest.approx(one.quality(), rel=1e-12)
    np.testing.assert_allclose(many.surface_positions(), one.surface_positions(), atol=1e-12)
    for at in ([0.31, 0.44, 0.2], [1.5, 1.0, 0.8], [0.5, 0.5, 0.4]):
        expected = one.probe("first", at[:dim], "displacement")
        np.testing.assert_allclose(many.probe("first", at[:dim], "displacement"), expected, atol=1e-12)


@pytest.mark.parallel([1, 3])
def test_state_comes_back_bit_for_bit_on_other_ranks(dim):
    many, one = busy(MPI.COMM_WORLD, dim), busy(MPI.COMM_SELF, dim)
    for solid in (many, one):
        n = len(gathered(solid, "points"))
        own = solid._mesh.natural[: len(solid.reference)]
        solid.displacement, solid.velocity = wave(n, dim)[own], wave(n, dim, seed=6)[own]

    def store(solid):
        return {name: gathered(solid, name) for name in solid.state()}

    def reader(stored):
        def read(name, start, count):
            return stored[name][tuple(slice(s, s + c) for s, c in zip(start, count, strict=True))]

        return read

    def state_of(solid):
        return solid.displacement, solid.velocity

    for source, target in ((many, one), (one, many), (many, many)):
        fresh = busy(target.comm, dim)
        fresh.restore(reader(store(source)))
        for got, expected in zip(state_of(fresh), state_of(target), strict=True):
            np.testing.assert_array_equal(got, expected)
        fresh.assemble(0.3, 0.05)
        target.assemble(0.3, 0.05)
        np.testing.assert_array_equal(fresh.rhs, target.rhs)
        np.testing.assert_array_equal(fresh.block.getValuesCSR()[2], target.block.getValuesCSR()[2])


@pytest.mark.parallel([1, 3])
def test_a_probe_interpolates_and_does_not_reach_far(dim):
    linear = ["1 + x - 2*y", "3*x*1 + y", "z - x"][:dim]
    comm = MPI.COMM_WORLD
    solid = field(dim, comm, b=body(dim, initial={"velocity": linear}), c=body(dim, origin=(0.2, 0.2, 0.2)))
    at = np.array([0.77, 0.31, 0.52][:dim])
    x, y, z = np.append(at, 0.0)[:3]
    np.testing.assert_allclose(solid.probe("b", at.tolist(), "velocity"), [1 + x - 2 * y, 3 * x + y, z - x][:dim])
    np.testing.assert_array_equal(solid.probe("c", at.tolist(), "velocity"), 0)
    # outside: the nearest node, here the corner (1.5, 1, 0.8)
    corner = [1.6, 1.1, 0.8][:dim]
    np.testing.assert_allclose(solid.probe("b", corner, "velocity"), [0.5, 5.5, -0.7][:dim], atol=1e-13)
    with pytest.raises(InputError, match=r"probe of solids\.b at \[4, 1.* lies 2\.5 m outside it"):
        solid.probe("b", [4.0, 1.0, 0.8][:dim], "velocity")
    with pytest.raises(InputError, match="known solids are b, c"):
        solid.probe("a", at.tolist(), "velocity")
    with pytest.raises(InputError, match="'pressure' is not known"):
        solid.probe("b", at.tolist(), "pressure")


@pytest.mark.parallel([1, 3])
def test_fetch_brings_any_rows_in_the_order_asked():
    comm = MPI.COMM_WORLD
    owned = Layout.of(comm, [4, 0, 3][comm.rank % 3])
    rows = np.arange(owned.start, owned.end)
    wanted = np.random.default_rng(comm.rank).integers(0, owned.n_global, 17)
    fetch = Fetch(comm, owned, wanted)
    np.testing.assert_array_equal(fetch(np.column_stack((rows, rows**2))), np.column_stack((wanted, wanted**2)))
    assert fetch(rows.astype(np.int32)).dtype == np.int32


def test_bisection_shares_evenly_and_compactly():
    points = np.random.default_rng(0).uniform(size=(1000, 2)) * [3, 1]
    part = bisect(points, 3)
    assert np.bincount(part).tolist() == [333, 333, 334]
    assert all(np.ptp(points[part == p], axis=0).max() < 1.3 for p in range(3))
    assert np.array_equal(bisect(np.zeros((2, 2)), 4) >= 0, [True, True])


@pytest.mark.parallel([1, 3])
def test_fewer_nodes_than_ranks_still_work(tmp_path_factory):
    comm = MPI.COMM_WORLD
    path = comm.bcast(tmp_path_factory.mktemp("mesh") / "one.vtk" if comm.rank == 0 else None)
    if comm.rank == 0:
        meshio.Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), [("triangle", [[0, 1, 2]])]).write(path)
    solid = field(2, comm, gravity=[0, -1], b={**body(2), "shape": {"mesh": str(path)}})
    step(solid, 0.0, 0.1)
    np.testing.assert_allclose(solid.velocity[:, 1], -0.1, atol=1e-14)
    assert solid.volumes() == pytest.approx({"b": 0.5})
