"""Loads on solids: resultants, what turns and what does not, tangents, and what is refused."""

from math import factorial

import numpy as np
import pytest
from load_cases import COMM, ORDERS, SIZE, forces, loaded, resultant
from mpi4py import MPI
from solid_cases import wave

from petfsi.errors import InputError
from petfsi.fields.solid.loads.rules import simplex_rule
from petfsi.fields.solid.rules import shape_functions, shape_slopes
from petfsi.geometry.quadratic import EDGES, facets_with_middles
from petfsi.geometry.surfaces import boundary_facets


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


# ---- rules --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("simplex", [1, 2, 3])
def test_a_rule_is_exact_to_its_degree(simplex):
    x, w = simplex_rule(simplex, 3)
    for powers in np.ndindex(*(6,) * simplex):
        if sum(powers) <= 5:
            exact = np.prod([factorial(p) for p in powers]) / factorial(sum(powers) + simplex)
            assert w @ np.prod(x[:, 1:] ** powers, axis=1) == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize("simplex", [1, 2, 3])
def test_quadratic_shape_functions_are_one_at_their_node_and_reproduce_squares(simplex):
    corners = np.eye(simplex + 1)
    nodes = np.concatenate((corners, corners[EDGES[simplex]].mean(axis=1)))
    np.testing.assert_allclose(shape_functions(nodes, len(nodes)), np.eye(len(nodes)), atol=1e-15)
    x, _ = simplex_rule(simplex, 2)
    values, slopes = shape_functions(x, len(nodes)), shape_slopes(x, len(nodes))
    np.testing.assert_allclose(values @ nodes[:, 1] ** 2, x[:, 1] ** 2, atol=1e-14)
    np.testing.assert_allclose(np.einsum("qak,a->qk", slopes, nodes[:, 1] ** 2)[:, 0], 2 * x[:, 1], atol=1e-14)


# ---- resultants ---------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2, 3])
def test_a_traction_gives_its_resultant_and_its_moment(dim):
    load = {"where": "right", "traction": [2.0, "y - 3*y*y", "x"][:dim]}
    lx, ly, lz = 1.5, 1.0, (1.0 if dim == 2 else 0.8)
    f = np.array([2 * ly, ly**2 / 2 - ly**3, lx * ly][:dim]) * lz
    got = resultant(loaded(dim, loads=[load]))
    np.testing.assert_allclose(got[:dim], f, rtol=1e-12)
    np.testing.assert_allclose(got[dim], lx * f[1] - 2 * ly**2 / 2 * lz, rtol=1e-12)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("follower", [True, False])
def test_a_pressure_pushes_inward(dim, follower):
    load = {"where": "top", "pressure": "3*x", "follower": follower}
    lz = 1.0 if dim == 2 else 0.8
    got = resultant(loaded(dim, loads=[load]))
    wanted = np.array([0, -3 * 1.5**2 / 2, 0][:dim]) * lz
    np.testing.assert_allclose(got[:dim], wanted, atol=1e-13)
    np.testing.assert_allclose(got[dim], -(1.5**3) * lz, rtol=1e-12)


@pytest.mark.parallel([1, 2, 3])
def test_a_body_force_fills_the_volume(dim):
    volume = np.prod(SIZE[:dim])
    got = resultant(loaded(dim, body_force=["x*y", 5.0, "t*y"][:dim]), time=2.0)
    wanted = np.array([1.5 / 2 / 2, 5.0, 2 * 0.5][:dim]) * volume
    np.testing.assert_allclose(got[:dim], wanted, rtol=1e-12)
    np.testing.assert_allclose(got[dim], (5 * 0.75 - 1.5 / 2 / 3) * volume, rtol=1e-12)


@pytest.mark.parallel([1, 2, 3])
@ORDERS
@pytest.mark.parametrize("at", [(0.61, 0.37, 0.22), (1.5, 1.0, 0.8)])
def test_a_point_force_acts_at_its_point(dim, at, elements):
    solid = loaded(dim, elements=elements, loads=[{"at": list(at[:dim]), "force": ["1 + t*x", -2.0, 3.0][:dim]}])
    got = resultant(solid, time=2.0)
    f = np.array([1 + 2 * at[0], -2.0, 3.0])
    np.testing.assert_allclose(got[:dim], f[:dim], rtol=1e-12)
    np.testing.assert_allclose(got[dim], at[0] * f[1] - at[1] * f[0], rtol=1e-12)


@pytest.mark.parallel([1, 2])
def test_loads_follow_time_and_what_does_not_is_integrated_once(dim):
    static = {"where": "right", "traction": ["y", 1.0, 0.0][:dim]}
    timed = {"where": "left", "traction": ["sin(t)", 0.0, "t*y"][:dim]}
    alone, both = loaded(dim, loads=[static]), loaded(dim, loads=[static, timed])
    lz = 1.0 if dim == 2 else 0.8
    for time in (0.3, 1.7):
        extra = np.array([np.sin(time), 0.0, time / 2][:dim]) * lz
        difference = resultant(both, time=time)[:dim] - resultant(alone, time=time)[:dim]
        np.testing.assert_allclose(difference, extra, atol=1e-13)
    assert alone._loads._dead.forces(0.3) is alone._loads._dead.forces(1.7)


def test_a_scene_without_loads_has_none(dim):
    assert loaded(dim, MPI.COMM_SELF)._loads is None


# ---- what turns ---------------------------------------------------------------------------------------------


def turn(dim):
    """Return a large rotation."""
    q, _ = np.linalg.qr(np.random.default_rng(4).standard_normal((dim, dim)))
    return q if np.linalg.det(q) > 0 else q[:, ::-1]


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize(
    "load", [{"pressure": "1 + x*y"}, {"traction": ["1 + x", 2.0, "y"]}], ids=lambda a: next(iter(a))
)
def test_a_follower_turns_with_the_body_and_a_dead_load_does_not(dim, load):
    load = {name: value[:dim] if isinstance(value, list) else value for name, value in load.items()}
    Q = turn(dim)

    def move(x):
        return x @ Q.T + 3.0 - x

    for follower in (True, False):
        solid = loaded(dim, loads=[{"where": "all", "follower": follower, **load}])
        rest, turned = forces(solid), forces(solid, move=move)
        assert np.abs(rest).max(initial=0) > 0.01 or not len(rest)
        np.testing.assert_allclose(turned, rest @ Q.T if follower else rest, atol=1e-13)


def test_a_follower_traction_is_per_area_at_rest_and_turns_by_the_polar_rotation(dim):
    """A stretch leaves it as it is; a stretch before a rotation does not change how far it turns."""
    solid = loaded(dim, MPI.COMM_SELF, loads=[{"where": "right", "follower": True, "traction": [1.0, 2.0, 3.0][:dim]}])
    Q, stretch = turn(dim), np.diag([1.0, 1.7, 0.6][:dim])
    rest = forces(solid)
    np.testing.assert_allclose(forces(solid, move=lambda x: x @ stretch - x), rest, atol=1e-13)
    np.testing.assert_allclose(forces(solid, move=lambda x: x @ stretch @ Q.T - x), rest @ Q.T, atol=1e-13)


def enclosed_volume(x, facets):
    corners = x[facets]
    return np.linalg.det(corners).sum() / factorial(x.shape[1])


@pytest.mark.parallel([1, 2])
@ORDERS
def test_a_uniform_pressure_on_a_closed_surface_has_no_resultant(dim, elements):
    solid = loaded(dim, elements=elements, loads=[{"where": "all", "pressure": 7.0}])

    def move(x):
        return 0.1 * np.sin(3 * x + x[:, ::-1])

    f, x = forces(solid, move=move), solid.reference + move(solid.reference)
    assert COMM.allreduce(np.abs(f).sum()) > 1
    np.testing.assert_allclose(COMM.allreduce(f.sum(axis=0)), 0.0, atol=1e-12)
    np.testing.assert_allclose(COMM.allreduce(x.T @ f - f.T @ x), 0.0, atol=1e-12)


def test_a_uniform_pressure_works_on_the_volume(dim):
    solid = loaded(dim, MPI.COMM_SELF, loads=[{"where": "all", "pressure": 7.0}])
    points, facets = solid._mesh.points, boundary_facets(solid._mesh.points, solid._mesh.cells)
    d, v, e = wave(len(points), dim), wave(len(points), dim, seed=8, size=1.0), 1e-5
    change = enclosed_volume(points + d + e * v, facets) - enclosed_volume(points + d - e * v, facets)
    power = np.vdot(forces(solid, move=lambda x: d), v)
    assert power == pytest.approx(-7.0 * change / (2 * e), rel=1e-8)


# ---- tangents -----------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
@ORDERS
def test_the_tangent_of_a_pressure_on_a_closed_surface_is_that_of_its_forces(dim, elements):
    solid = loaded(dim, elements=elements, loads=[{"where": "all", "pressure": 7.0}])

    def move(x):
        return 0.1 * np.sin(3 * x + x[:, ::-1])

    def way(x):
        return np.cos(2 * x - x[:, ::-1])

    e = 1e-5
    slope = (
        (forces(solid, move=lambda x: move(x) + e * way(x)) - forces(solid, move=lambda x: move(x) - e * way(x)))
        / e
        / 2
    )
    values = np.zeros(len(solid._pattern.indices))
    shifted = forces(solid, move=move, shift=way, k=0.5, values=values)
    np.testing.assert_allclose(solid._loads.felt(way(solid._mesh.points)) - shifted, 0.5 * slope, atol=1e-8)
    np.testing.assert_allclose(shifted - forces(solid, move=move), slope, atol=1e-8)
    everything = np.concatenate(COMM.allgather(way(solid.reference))).ravel()
    rows = np.repeat(np.arange(solid.layout.n_local), np.diff(solid._pattern.indptr))
    product = np.bincount(rows, weights=values * everything[solid._pattern.indices], minlength=solid.layout.n_local)
    np.testing.assert_allclose(product.reshape(-1, dim), -0.5 * slope, atol=1e-8)


def test_the_pressure_leaves_the_matrix_symmetric(dim):
    """Also where the surface is open and the pressure uneven."""
    solid = loaded(dim, MPI.COMM_SELF, loads=[{"where": "top", "pressure": "3 + x"}])
    values = np.zeros(len(solid._pattern.indices))
    forces(solid, move=lambda x: 0.1 * np.sin(3 * x), k=1.0, values=values)
    A = np.zeros((solid.layout.n_global,) * 2)
    A[np.repeat(np.arange(len(A)), np.diff(solid._pattern.indptr)), solid._pattern.indices] = values
    assert np.abs(A).max() > 0.01
    np.testing.assert_allclose(A, A.T, atol=1e-15)


# ---- quadratic elements -------------------------------------------------------------------------------------


def test_facets_of_quadratic_elements_have_their_middles(dim):
    solid = loaded(dim, MPI.COMM_SELF, elements="quadratic")
    x, elements = solid._mesh.points, solid._mesh.elements(0)
    facets = facets_with_middles(boundary_facets(x, elements[:, : dim + 1]), elements)
    assert facets.shape[1] == {2: 3, 3: 6}[dim]
    np.testing.assert_allclose(x[facets[:, dim:]], x[facets[:, :dim]][:, EDGES[dim - 1]].mean(axis=2), atol=1e-15)


@pytest.mark.parallel([1, 3])
def test_loads_on_quadratic_elements_have_their_resultants(dim):
    solid = loaded(
        dim,
        elements="quadratic",
        loads=[{"where": "right", "traction": ["y*y", 1.0, 0.0][:dim]}, {"where": "top", "pressure": "x*x"}],
        body_force=["x*y*y", 0.0, 0.0][:dim],
    )
    lz = 1.0 if dim == 2 else 0.8
    got = resultant(solid)
    wanted = [1 / 3 + 1.5**2 / 2 / 3, 1.0 - 1.5**3 / 3, 0.0][:dim]
    np.testing.assert_allclose(got[:dim], np.array(wanted) * lz, atol=1e-12)
    np.testing.assert_allclose(got[dim] / lz, 1.5 - 1.5**4 / 4 - 1 / 4 - 1.5**2 / 2 / 4, rtol=1e-12)


def test_a_uniform_traction_loads_the_middles_of_quadratic_facets(dim):
    """By Simpson's rule 1, 4, 1 sixths of a segment; of a triangle a third each and nothing at the corners."""
    solid = loaded(dim, MPI.COMM_SELF, elements="quadratic", loads=[{"where": "right", "traction": [6.0, 0, 0][:dim]}])
    f, x = forces(solid)[:, 0], solid.reference
    corner = np.isin(np.arange(len(x)), solid._mesh.elements(0)[:, : dim + 1])
    assert f[~corner].sum() == pytest.approx(4.0 if dim == 2 else 4.8, rel=1e-12)
    assert f.sum() == pytest.approx(6.0 if dim == 2 else 4.8, rel=1e-12)


# ---- what is refused ----------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
def test_a_load_that_finds_no_facet_and_a_force_outside_are_refused(dim):
    ball = {"ball": {"centre": SIZE[:dim].tolist(), "radius": 0.01}}
    with pytest.raises(
        InputError, match=r"solids.b.loads.0.where: none of the \d+ boundary facets .* lies there whole"
    ):
        loaded(dim, loads=[{"where": ball, "pressure": 1.0}])
    with pytest.raises(InputError, match=r"solids.b.loads.0.at = \[9.0, 9.0.*: lies 1\d.* away from"):
        loaded(dim, loads=[{"at": [9.0] * dim, "force": [1.0] * dim}])


@pytest.mark.parallel([1, 2])
def test_an_expression_that_blows_up_is_named_on_every_rank(dim):
    solid = loaded(dim, loads=[{"where": "left", "pressure": "sqrt(y - t)"}])
    forces(solid, time=0.0)
    with pytest.raises(InputError, match="solids.b.loads.0.pressure"):
        forces(solid, time=0.5)
    with pytest.raises(InputError, match="solids.b.loads.0.traction.1"):
        loaded(dim, loads=[{"where": "left", "traction": [0.0, "log(y - 0.5)", 0.0][:dim]}])
