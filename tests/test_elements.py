"""Elements of both orders and both volumetric rules: identities, orders of accuracy, locking, their spectrum."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.linalg import eigh
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve
from solid_cases import (
    DENSITY,
    LAME,
    MU,
    YOUNG,
    bent_mesh,
    body,
    elements_of,
    field,
    gathered,
    pattern_of,
    respond,
    simplices,
    step,
    wave,
)

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.equations.spectrum import TOLERANCE, largest_eigenvalue
from petfsi.fields.solid.materials import lame_parameters
from petfsi.fields.solid.patches import barycentric_gradients, grouped_mesh, grown_patches
from petfsi.fields.solid.rules import quadratic_rule, shape_functions
from petfsi.geometry.balls import ball_mesh
from petfsi.geometry.meshes import box_mesh
from petfsi.geometry.quadratic import shape_forms
from petfsi.scene.tables import Ball, Box

KINDS = [(order, rule) for order in ("linear", "quadratic") for rule in ("full", "reduced")]
MATERIALS = ["green", "linear", "neohookean", "stable-neohookean"]


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


@pytest.fixture(params=KINDS, ids="-".join)
def kind(request):
    return request.param


def bent(dim, kind, n=3):
    points, cells, _ = bent_mesh(dim, n)
    return simplices(points, cells, *kind)


def unit_box(dim, n, kind):
    points, cells = box_mesh(Box(origin=[0] * dim, size=[1] * dim, cells=[n] * dim))
    return simplices(points, cells, *kind)


def on_rim(mesh):
    return np.any((np.abs(mesh.points) < 1e-9) | (np.abs(mesh.points - 1) < 1e-9), axis=1)


# ---- identities ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", MATERIALS)
def test_patch_an_affine_displacement_loads_no_inner_node(dim, kind, material):
    mesh = bent(dim, kind)
    inner = ~on_rim(mesh)
    H = wave(dim, dim, size=0.15)
    elements = elements_of(mesh, material, volumetric=kind[1])
    _, b = respond(elements, pattern_of(mesh), mesh.points @ H.T)
    assert np.abs(b[~inner]).max() > 0.1
    assert np.abs(b[inner]).max() < 1e-13 * np.abs(b).max()


@pytest.mark.parametrize("material", ["green", "neohookean", "stable-neohookean"])
def test_a_turned_body_has_no_force(dim, kind, material):
    mesh = bent(dim, kind)
    R = np.eye(dim)
    R[:2, :2] = [[np.cos(1.1), -np.sin(1.1)], [np.sin(1.1), np.cos(1.1)]]
    d = mesh.points @ (R - np.eye(dim)).T + 3.0
    A, b = respond(elements_of(mesh, material, volumetric=kind[1]), pattern_of(mesh), d)
    assert np.abs(b).max() < 1e-13 * np.abs(A).max()


def test_force_is_the_derivative_of_energy_and_tangent_of_force(dim, kind):
    mesh = bent(dim, kind, n=2)
    elements, pattern = elements_of(mesh, "neohookean", volumetric=kind[1]), pattern_of(mesh)
    d, way = wave(len(mesh.points), dim, size=0.02), wave(len(mesh.points), dim, seed=9, size=1.0)
    A, b = respond(elements, pattern, d)
    h = 1e-6
    energy = [elements.energies(d + s * h * way, d, mesh.counted)[1] for s in (1, -1)]
    assert (energy[0] - energy[1]) / (2 * h) == pytest.approx(-(b * way).sum(), rel=1e-7)
    force = [-respond(elements, pattern, d + s * h * way)[1] for s in (1, -1)]
    expected = (force[0] - force[1]).ravel() / (2 * h)
    np.testing.assert_allclose(A @ way.ravel(), expected, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_array_equal(A, A.T)


def test_forces_alone_are_those_beside_the_matrix(dim, kind):
    mesh = bent(dim, kind, n=2)
    elements = elements_of(mesh, "neohookean", volumetric=kind[1])
    d, inertia, shift = (wave(len(mesh.points), dim, seed=seed, size=0.02) for seed in (3, 4, 5))
    A, b = respond(elements, pattern_of(mesh), d, inertia, shift)
    M = respond(elements, pattern_of(mesh), 0 * d, a=1.0, k=0.0)[0]
    np.testing.assert_array_equal(M, M.T)
    alone = np.empty_like(d)
    elements.forces(State(d, inertia, shift), alone)
    np.testing.assert_array_equal(alone, b)
    elements.forces(State(d, 0 * d, 0 * d), alone)
    expected = b.ravel() - M @ inertia.ravel() + A @ shift.ravel()
    np.testing.assert_allclose(alone.ravel(), expected, atol=1e-13 * np.abs(b).max())


def test_damping_and_residuals_are_those_of_the_matrices(dim, kind):
    mesh = bent(dim, kind, n=2)
    elements, pattern = elements_of(mesh, "neohookean", volumetric=kind[1]), pattern_of(mesh)
    elements.bodies.mass_damping[:], elements.bodies.stiffness_damping[:] = 0.4, 0.1
    d, V, s, w = (wave(len(mesh.points), dim, seed=seed, size=0.02) for seed in range(4))
    A, b = respond(elements, pattern, d, V, s, a=2.0, k=0.3)
    C = A - respond(elements_of(mesh, "neohookean", volumetric=kind[1]), pattern, d, a=2.0, k=0.3)[0]
    assert elements.damping(d, w, mesh.counted) == pytest.approx(w.ravel() @ C @ w.ravel(), rel=1e-11)
    left = np.empty_like(d)
    elements.forces(State(d, V - (2.0 + 0.4) * w, s + (0.3 + 0.1) * w), left)
    np.testing.assert_allclose(left.ravel(), b.ravel() - A @ w.ravel(), atol=1e-11 * np.abs(b).max())


def test_at_rest_only_rigid_motions_cost_nothing(dim, kind):
    for mesh in (bent(dim, kind, n=2), unit_box(dim, 1, kind)):
        elements = elements_of(mesh, "neohookean", volumetric=kind[1])
        K, _ = respond(elements, pattern_of(mesh), np.zeros_like(mesh.points))
        values = np.linalg.eigvalsh(K) / np.abs(K).max()
        rigid = dim * (dim + 1) // 2
        assert np.abs(values[:rigid]).max() < 1e-13
        assert values[rigid] > 1e-3, values[: rigid + 3]


def test_masses(dim, kind):
    mesh = bent(dim, kind)
    elements, n = elements_of(mesh, volumetric=kind[1]), len(mesh.points)
    M, _ = respond(elements, pattern_of(mesh), np.zeros_like(mesh.points), a=1.0, k=0.0)
    lumped, uniform = elements.lumped_mass(n), elements.uniform_load(n)
    assert lumped.min() > 0
    np.testing.assert_allclose(lumped.sum(axis=0), DENSITY, rtol=1e-13)
    for axis in range(dim):
        e = np.zeros((n, dim))
        e[:, axis] = 1.0
        np.testing.assert_allclose(uniform[axis].ravel(), M @ e.ravel(), atol=1e-14)
        # polynomials of the elements' own degree: int x^2 = 1/3, int x^4 = 1/5 over the unit box
        degree = 1 if kind[0] == "linear" else 2
        u = (e * mesh.points**degree).ravel()
        assert u @ M @ u == pytest.approx(DENSITY / (2 * degree + 1), rel=1e-13)
    diagonal = elements_of(mesh, lumped=True, volumetric=kind[1])
    D, _ = respond(diagonal, pattern_of(mesh), np.zeros_like(mesh.points), a=1.0, k=0.0)
    np.testing.assert_allclose(D, np.diag(lumped.ravel()), atol=1e-15)


def test_shape_functions_are_one_at_their_own_node(dim):
    mesh = unit_box(dim, 1, ("quadratic", "full"))
    nodes = mesh.groups[0].nodes[0]
    corners = mesh.points[nodes[: dim + 1]]
    gradients = barycentric_gradients(mesh.points, nodes[None])[0]
    at = 1 / (dim + 1) + (mesh.points[nodes] - corners.mean(axis=0)) @ gradients.T
    np.testing.assert_allclose(shape_functions(at, len(nodes)), np.eye(len(nodes)), atol=1e-14)
    # the same along every barycentric coordinate, whose gradients add up to zero
    assert np.ptp(quadratic_rule(dim, False).table.sum(axis=1), axis=1).max() < 1e-14


# ---- accuracy -----------------------------------------------------------------------------------------------


def exact(x):
    """Return a displacement that vanishes on the rim of the unit box, its gradient and -div of its stress."""
    dim = x.shape[1]
    s, c = np.sin(np.pi * x), np.cos(np.pi * x)
    one, total = s.prod(axis=1), np.zeros_like(x)
    slope, hessian = np.empty_like(x), np.empty((*x.shape, dim))
    for i in range(dim):
        others = [k for k in range(dim) if k != i]
        slope[:, i] = np.pi * c[:, i] * s[:, others].prod(axis=1)
        for j in range(dim):
            rest = [k for k in range(dim) if k not in (i, j)]
            hessian[:, i, j] = -(np.pi**2) * one if i == j else np.pi**2 * c[:, i] * c[:, j] * s[:, rest].prod(axis=1)
    way = np.arange(1, dim + 1)
    u, gradient = np.outer(one, way), np.einsum("i,nj->nij", way, slope)
    total -= MU * np.outer(hessian.trace(axis1=1, axis2=2), way) + (LAME + MU) * hessian @ way
    return u, gradient, total


def static_error(dim, n, kind):
    """Return the errors in L2 and of the gradient, by sampling at the corners and the centre of every element."""
    mesh = unit_box(dim, n, kind)
    elements, pattern = elements_of(mesh, "linear", volumetric=kind[1]), pattern_of(mesh)
    size = mesh.points.size
    zero, values, b = np.zeros_like(mesh.points), np.empty(len(pattern.indices)), np.empty_like(mesh.points)
    elements.assemble(State(zero, exact(mesh.points)[2] / DENSITY, zero), 0.0, 1.0, pattern, values, b)
    K = csr_matrix((values, pattern.indices, pattern.indptr), shape=(size, size))
    free, d = np.flatnonzero(np.repeat(~on_rim(mesh), dim)), np.zeros(size)
    d[free] = spsolve(K[free][:, free].tocsc(), b.ravel()[free])
    nodes = mesh.groups[0].nodes
    gradients, d = barycentric_gradients(mesh.points, nodes), d.reshape(-1, dim)
    value, slope = [], []
    for at in np.concatenate((0.8 * np.eye(dim + 1) + 0.2 / (dim + 1), np.full((1, dim + 1), 1 / (dim + 1)))):
        N = shape_functions(at, nodes.shape[1])
        table = np.eye(dim + 1) if nodes.shape[1] == dim + 1 else 2 * shape_forms(dim) @ at
        u, gradient, _ = exact(np.einsum("a,eaj->ej", at, mesh.points[nodes[:, : dim + 1]]))
        value.append(np.einsum("a,eai->ei", N, d[nodes]) - u)
        slope.append(np.einsum("am,emj,eai->eij", table, gradients, d[nodes]) - gradient)
    return np.sqrt(np.mean(np.square(value))), np.sqrt(np.mean(np.square(slope)))


@pytest.mark.parametrize("order, expected", [("linear", (2, 1)), ("quadratic", (3, 2))])
def test_static_errors_have_their_order(dim, order, expected):
    n = {(2, "linear"): (16, 32), (3, "linear"): (8, 16), (2, "quadratic"): (8, 16), (3, "quadratic"): (4, 8)}
    coarse, fine = (np.array(static_error(dim, m, (order, "full"))) for m in n[dim, order])
    seen = np.log2(coarse / fine)
    np.testing.assert_allclose(seen, expected, atol=0.25 if dim == 3 else 0.1)


def deflection(dim, kind, poisson, n, patches=None):
    """Return the deflection of a beam of length 4 under a load on its end, over that of a slender one."""
    size, cells = [4.0, 1.0, 1.0][:dim], [4 * n, n, n][:dim]
    points, cells = box_mesh(Box(origin=[0] * dim, size=size, cells=cells))
    if dim == 2:  # with all diagonals one way, since triangles whose diagonals alternate hardly lock
        a = np.arange(len(points)).reshape(4 * n + 1, n + 1)[:-1, :-1].reshape(-1, 1)
        cells = (a + np.array([0, n + 1, n + 2, 0, n + 2, 1])).reshape(-1, 3)
    mesh = simplices(points, cells, *kind, patches=patches)
    elements, pattern = (
        elements_of(mesh, "linear", *lame_parameters(YOUNG, poisson), volumetric=kind[1]),
        pattern_of(mesh),
    )
    zero, values, b = np.zeros_like(mesh.points), np.empty(len(pattern.indices)), np.empty_like(mesh.points)
    elements.assemble(State(zero, zero, zero), 0.0, 1.0, pattern, values, b)
    size = mesh.points.size
    K = csr_matrix((values, pattern.indices, pattern.indptr), shape=(size, size))
    end = mesh.points[:, 0] > 4 - 1e-9
    b[end, 1] = 1e-3 / end.sum()
    free, d = np.flatnonzero(np.repeat(mesh.points[:, 0] > 1e-9, dim)), np.zeros(size)
    d[free] = spsolve(K[free][:, free].tocsc(), b.ravel()[free])
    modulus = YOUNG / (1 - poisson**2) if dim == 2 else YOUNG
    return d.reshape(-1, dim)[end, 1].mean() / (1e-3 * 4**3 / (3 * modulus / 12))


def test_only_fully_integrated_linear_elements_lock(dim):
    n = 8 if dim == 2 else 3
    fine = deflection(dim, ("quadratic", "reduced"), 0.4999, n)
    assert 0.95 < fine < 1.15  # shear adds to the slender beam's
    found = {kind: deflection(dim, kind, 0.4999, n) / fine for kind in KINDS}
    assert found["linear", "full"] < 0.7, found
    assert found["linear", "reduced"] > (0.95 if dim == 2 else 0.75), found
    assert found["quadratic", "full"] > 0.9, found
    grown = deflection(dim, ("linear", "reduced"), 0.4999, n, patches=grown_patches)
    assert grown > (0.9 if dim == 2 else 0.7) * fine, (grown, fine)


# ---- Cook's membrane ----------------------------------------------------------------------------------------

#: Deflection of (48, 52) for a neo-Hookean body in plane strain, Q3 to Q4 elements, known to 0.0005 and 0.005.
COOK = {0.3: 7.8927, 0.4999: 6.960}


def cook_mesh(n, kind):
    points, cells = box_mesh(Box(origin=[0, 0], size=[1, 1], cells=[n, n]))
    xi, eta = points.T
    return simplices(np.column_stack((48 * xi, 44 * xi + eta * (44 - 28 * xi))), cells, *kind)


def end_load(mesh, order):
    """Return the nodal forces of a dead shear traction of 6.25 on the right edge."""
    x, load = mesh.points, np.zeros_like(mesh.points)
    edge = np.flatnonzero(x[:, 0] > 48 - 1e-9)
    edge = edge[np.argsort(x[edge, 1])]
    weights = [1 / 2, 1 / 2] if order == "linear" else [1 / 6, 4 / 6, 1 / 6]
    n = len(weights) - 1
    for a, weight in enumerate(weights):
        np.add.at(load[:, 1], edge[a::n][: (len(edge) - 1) // n], weight * 6.25 * 16 * n / (len(edge) - 1))
    return load


def cook_deflection(n, kind, poisson, steps):
    """Return the deflection of (48, 52) by Newton's method, the load grown in equal steps."""
    mesh = cook_mesh(n, kind)
    elements = elements_of(mesh, "neohookean", *lame_parameters(240.565, poisson), volumetric=kind[1])
    pattern, load = pattern_of(mesh), end_load(mesh, kind[0])
    d, rest, b = np.zeros_like(load), np.zeros_like(load), np.empty_like(load)
    values, free = np.empty(len(pattern.indices)), np.repeat(mesh.points[:, 0] > 1e-9, 2)

    def residual(d, share):
        elements.forces(State(d, rest, rest), b)
        return np.where(free, (b + share * load).ravel(), 0.0)

    for share in np.arange(1, steps + 1) / steps:
        r = residual(d, share)
        while np.linalg.norm(r) > 1e-7 * np.linalg.norm(load):
            elements.assemble(State(d, rest, rest), 0.0, 1.0, pattern, values, b)
            K = csr_matrix((values, pattern.indices, pattern.indptr), shape=(d.size, d.size))
            way, length, before = np.zeros(d.size), 1.0, np.linalg.norm(r)
            way[free] = spsolve(K[free][:, free].tocsc(), r[free])
            start = d
            while True:
                d = start + length * way.reshape(d.shape)
                r = residual(d, share)
                if np.linalg.norm(r) < before or length < 1e-3:
                    break
                length /= 2
            assert length >= 1e-3, (share, before)
    return d[np.argmin(np.linalg.norm(mesh.points - [48, 52], axis=1)), 1]


@pytest.mark.slow
@pytest.mark.parametrize("poisson, order, rule, bar", [
    (0.3, "linear", "full", 0.01), (0.3, "linear", "reduced", 0.01),
    (0.3, "quadratic", "full", 0.005), (0.3, "quadratic", "reduced", 0.005),
    (0.4999, "linear", "reduced", 0.02), (0.4999, "quadratic", "full", 0.02), (0.4999, "quadratic", "reduced", 0.02),
])  # fmt: skip
def test_cooks_membrane(poisson, order, rule, bar):
    tip = cook_deflection(32, (order, rule), poisson, 4 if poisson < 0.4 else 8)
    assert tip == pytest.approx(COOK[poisson], rel=bar)


# ---- ranks --------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2, 3])
def test_ranks_agree_with_one_rank(dim, kind):
    order, rule = kind
    left = [{"where": "left", "fix": ["x", "y"], "velocity": {"x": "0.2*cos(9*t)"}}]
    first = body(dim, (4, 3, 2), supports=left, elements=order, volumetric=rule, damping={"stiffness": 0.01})
    second = body(dim, (2, 2, 3), origin=(0.3, 2.0, 0.1), mass="lumped", initial={"displacement": ["0.1*x"] * dim})
    scene = {"gravity": ["sin(t)", -1.0, 0.2][:dim], "integrator": "bdf2", "first": first, "second": second}
    many, one = field(dim, MPI.COMM_WORLD, **scene), field(dim, MPI.COMM_SELF, **scene)
    for k in range(3):
        step(many, 0.05 * k, 0.05)
        step(one, 0.05 * k, 0.05)
    for name in ("points", "cells", "body", "displacement", "velocity"):
        np.testing.assert_allclose(gathered(many, name), gathered(one, name), rtol=0, atol=1e-12, err_msg=name)
    assert many.energies() == pytest.approx(one.energies(), rel=1e-12)
    assert many.volumes() == pytest.approx(one.volumes(), rel=1e-12)
    assert many.quality() == pytest.approx(one.quality(), rel=1e-12)
    for at in ([0.31, 0.44, 0.2], [0.75, 0.5, 0.4]):
        expected = one.probe("first", at[:dim], "displacement")
        np.testing.assert_allclose(many.probe("first", at[:dim], "displacement"), expected, atol=1e-12)


@pytest.mark.parallel([1, 3])
def test_a_probe_of_a_quadratic_body_reads_quadratic_functions(dim):
    squares = ["x*x - y", "x*y", "z*x"][:dim]
    solid = field(dim, MPI.COMM_WORLD, b=body(dim, elements="quadratic", initial={"velocity": squares}))
    at = np.array([0.77, 0.31, 0.52][:dim])
    x, y, z = np.append(at, 0.0)[:3]
    np.testing.assert_allclose(solid.probe("b", at.tolist(), "velocity"), [x * x - y, x * y, z * x][:dim])


# ---- the spectrum -------------------------------------------------------------------------------------------


def shapes(dim):
    n = 6 if dim == 2 else 3
    points, cells = box_mesh(Box(origin=[0] * dim, size=[1] * dim, cells=[n] * dim))
    graded = points.copy()
    graded[:, 0], graded[:, 1] = np.exp(2 * points[:, 0]), 0.2 * points[:, 1]
    disk = ball_mesh(Ball(centre=[0] * dim, radius=1.0, cells=4), dim)
    return {"box": (points, cells), "graded": (graded, cells), "ball": disk, "bent": bent_mesh(dim, n)[:2]}


@pytest.mark.parametrize("shape", ["box", "graded", "ball", "bent"])
def test_the_largest_eigenvalue_is_estimated_from_above(dim, kind, shape):
    points, cells = shapes(dim)[shape]
    mesh = simplices(points, cells, *kind, patches=grown_patches if shape == "ball" else None)
    elements = elements_of(mesh, "neohookean", volumetric=kind[1])
    d = 0.02 * np.sin(3 * mesh.points)
    mass, zero, at_rest = elements.lumped_mass(len(d)), np.zeros_like(d), np.empty_like(d)
    K, _ = respond(elements, pattern_of(mesh), d)
    true = eigh(K, np.diag(mass.ravel()), eigvals_only=True, subset_by_index=[d.size - 1, d.size - 1])[0]
    elements.forces(State(d, zero, zero), at_rest)

    def product(v):
        b = np.empty_like(d)
        elements.forces(State(d, zero, v), b)
        return at_rest - b

    estimate = largest_eigenvalue(MPI.COMM_SELF, product, mass, wave(*d.shape))
    assert true <= estimate <= true * (1 + 1.5 * TOLERANCE)


@pytest.mark.parallel([1, 3])
def test_the_stable_step_is_that_of_the_free_unknowns_on_any_ranks(kind):
    held = [{"where": "left", "fix": ["x", "y"]}]
    block = body(2, (5, 4), elements=kind[0], volumetric=kind[1], supports=held)
    many, one = (field(2, comm, integrator="symplectic-euler", b=block) for comm in (MPI.COMM_WORLD, MPI.COMM_SELF))
    d = np.zeros_like(one.reference)
    K, _ = respond(one._elements, pattern_of(one._mesh), d)
    free = ~one._equation.is_held.ravel()
    mass = one._elements.lumped_mass(len(d)).ravel()[free]
    limit = 2 / np.sqrt(eigh(K[free][:, free], np.diag(mass), eigvals_only=True)[-1])
    assert one.stable_step() == pytest.approx(limit, rel=TOLERANCE)
    assert one.stable_step() <= limit
    assert many.stable_step() == pytest.approx(one.stable_step(), rel=1e-9)


def test_patches_cover_a_mesh_and_keep_their_size(dim):
    points, cells = ball_mesh(Ball(centre=[0] * dim, radius=1.0, cells=6), dim)
    patch = grown_patches(cells, dim)
    counts = np.bincount(patch)
    assert counts.min() >= {2: 2, 3: 4}[dim]
    assert counts.max() <= {2: 4, 3: 12}[dim]
    group = grouped_mesh([(points, cells, patch)]).groups[1]
    # the mean gradient of a linear function is its own
    np.testing.assert_allclose(np.einsum("eaj,eai->eij", group.gradients, points[group.nodes]),
                               np.broadcast_to(np.eye(dim), (len(group.nodes), dim, dim)), atol=1e-12)  # fmt: skip
