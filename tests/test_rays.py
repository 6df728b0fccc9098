"""Rays between lattice points: exact masks, closure at degenerate positions, hits."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from petfsi.geometry import predicates, rays


def boundary(cells):
    """Facets of positively oriented simplices that belong to one of them only, outward."""
    dim = cells.shape[1] - 1
    opposite = [[1, 2], [2, 0], [0, 1]] if dim == 2 else [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]
    facets = cells[:, opposite].reshape(-1, dim)
    _, first, count = np.unique(np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True)
    return facets[np.sort(first[count == 1])]


def oriented(points, cells):
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    negative = np.linalg.det(edges) < 0
    cells = cells.copy()
    cells[negative, :2] = cells[negative, 1::-1]
    return cells


def kuhn(shape):
    """Points and simplices of a lattice of unit squares (2 each) or cubes (6 each)."""
    dim = len(shape)
    points = np.array(list(itertools.product(*(range(n + 1) for n in shape))), dtype=float)
    number = np.arange(len(points)).reshape([n + 1 for n in shape])
    cells = []
    for corner in itertools.product(*(range(n) for n in shape)):
        for path in itertools.permutations(range(dim)):
            walk = [np.array(corner)]
            for a in path:
                walk.append(walk[-1] + np.eye(dim, dtype=int)[a])
            cells.append([number[tuple(p)] for p in walk])
    return points, oriented(points, np.array(cells))


def box_surface(low, high):
    dim = len(low)
    points, cells = kuhn((1,) * dim)
    return np.asarray(low) + points * (np.asarray(high) - np.asarray(low)), boundary(cells)


def circle(n, centre, radius):
    angle = 2 * np.pi * np.arange(n) / n
    i = np.arange(n)
    return centre + radius * np.column_stack((np.cos(angle), np.sin(angle))), np.column_stack((i, (i + 1) % n))


def hull(points):
    shape = ConvexHull(points)
    facets = shape.simplices.copy()
    q = points[facets]
    if points.shape[1] == 2:
        e = q[:, 1] - q[:, 0]
        normals = np.column_stack((e[:, 1], -e[:, 0]))
    else:
        normals = np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0])
    inward = np.sum(normals * shape.equations[:, :-1], axis=1) < 0
    facets[inward, :2] = facets[inward, 1::-1]
    return facets, shape.equations


def lattice_points(coords):
    return np.stack(np.meshgrid(*coords, indexing="ij"), axis=-1)


def contains(points, cells, at):
    """Brute force: which of the moved points lie in a simplex (all coordinates multiples of 1/2, so exact)."""
    dim = points.shape[1]
    at = at + 2.0 ** (-8 * np.arange(1, dim + 1))
    inside = np.zeros(at.shape[:-1], dtype=bool)
    for cell in cells:
        q = points[cell]
        bary = np.linalg.solve((q[1:] - q[0]).T, (at - q[0]).reshape(-1, dim).T)
        inside |= np.all(bary > 0, axis=0).reshape(inside.shape) & (bary.sum(axis=0) < 1).reshape(inside.shape)
    return inside


def windings_along(points, facets, coords, axis):
    return rays.windings(rays.cast(points, facets, coords, axis), tuple(len(c) for c in coords), axis)


# ---- predicates ---------------------------------------------------------------------------------------------


def test_the_side_of_a_line_is_exact_where_floats_are_not():
    # p lies 2^-53 off the line through (12, 12), (24, 24): the plain formula returns noise (Kettner et al. 2008)
    ulp = 2.0**-53
    for i, j in itertools.product(range(40), repeat=2):
        p = (0.5 + i * ulp, 0.5 + j * ulp)
        expected = np.sign(p[1] - p[0]) or -1  # on the line: moved along x first, to its right
        assert predicates.side(*p, 12.0, 12.0, 24.0, 24.0, True) == expected
        assert predicates.side(*p, 24.0, 24.0, 12.0, 12.0, True) == -expected


def test_ties_follow_the_infinitesimal_of_the_leading_axis():
    assert predicates.side(0.0, 0.0, -1.0, -1.0, 1.0, 1.0, True) == -1
    assert predicates.side(0.0, 0.0, -1.0, -1.0, 1.0, 1.0, False) == 1
    assert predicates.side(0.0, 0.0, -1.0, 0.0, 1.0, 0.0, True) == 1  # x says nothing, y decides
    assert predicates.side(0.0, 0.0, 3.0, 3.0, 3.0, 3.0, True) == 0


@pytest.mark.parametrize("spread", [1.0, 2.0**-40, 2.0**-52])
def test_the_side_of_a_plane_is_exact(spread):
    random = np.random.default_rng(5)
    for _ in range(100):
        q = 1 + random.random((3, 3))
        weights = random.dirichlet(np.ones(3))
        p = weights @ q + spread * random.normal(size=3)
        a, b, c = ([Fraction(x) - Fraction(y) for x, y in zip(corner, p, strict=True)] for corner in q)
        det = sum(a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3))
        assert predicates.above(p, q) == (-1 if det > 0 else 1)
        assert predicates.above(p, q[[1, 0, 2]]) == (1 if det > 0 else -1)


def test_points_on_a_plane_are_moved_along_the_first_axis_that_leaves_it():
    q = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert predicates.above(np.array([0.0, 0.3, 0.2]), q) == 1
    assert predicates.above(np.array([0.3, 0.2, 0.0]), q[:, [2, 1, 0]]) == -1
    assert predicates.above(np.zeros(3), np.zeros((3, 3))) == 0


# ---- masks --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_convex_hulls_of_random_points(dim, seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(30, dim))
    facets, planes = hull(points)
    coords = [np.linspace(-3, 3, n) for n in (37, 41, 29)[:dim]]
    expected = np.all(lattice_points(coords) @ planes[:, :-1].T + planes[:, -1] < 0, axis=-1)
    assert expected.sum() > 20
    assert np.array_equal(rays.inside_mask(points, facets, coords), expected)
    for axis in range(dim):
        assert np.array_equal(windings_along(points, facets, coords, axis), expected)


def test_a_mask_needs_no_more_than_the_points_of_its_own_box():
    """Parts of the lattice that see the surface only partly, or not at all, agree with the whole."""
    random = np.random.default_rng(7)
    points = random.normal(size=(40, 3))
    facets, _ = hull(points)
    coords = [np.linspace(-3, 3, 24)] * 3
    whole = rays.inside_mask(points, facets, coords)
    for i, j, k in itertools.product([slice(0, 9), slice(9, 13), slice(13, 24)], repeat=3):
        part = rays.inside_mask(points, facets, [coords[0][i], coords[1][j], coords[2][k]])
        assert np.array_equal(part, whole[i, j, k])


def test_a_2d_mask_may_carry_a_third_axis():
    points, facets = circle(50, np.array([0.1, 0.2]), 0.7)
    coords = [np.linspace(-1, 1, 21), np.linspace(-1, 1, 17)]
    flat = rays.inside_mask(points, facets, coords)
    assert flat.dtype == np.uint8
    assert np.array_equal(rays.inside_mask(points, facets, [*coords, np.zeros(1)]), flat[:, :, None])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_on_lattice_points_is_half_open(dim):
    coords = [np.arange(8) * 0.125] * dim
    for low in itertools.product((0.0, 0.125, 0.25), repeat=dim):
        for size in (0.125, 0.5):
            low = np.array(low)
            points, facets = box_surface(low, low + size)
            at = lattice_points(coords)
            expected = np.all((at >= low) & (at < low + size), axis=-1)
            for axis in range(dim):
                assert np.array_equal(windings_along(points, facets, coords, axis), expected)


@pytest.mark.parametrize("dim", [2, 3])
def test_cavities_overlaps_and_reversed_surfaces(dim):
    outer, facets = box_surface([0.0] * dim, [1.0] * dim)
    inner, _ = box_surface([0.3] * dim, [0.6] * dim)
    coords = [np.linspace(-0.5, 1.5, 24)] * dim
    at = lattice_points(coords)
    in_outer = np.all((at > 0) & (at < 1), axis=-1)
    in_inner = np.all((at > 0.3) & (at < 0.6), axis=-1)
    both = np.concatenate((outer, inner))
    hollow = np.concatenate((facets, facets[:, ::-1] + len(outer)))
    assert np.array_equal(rays.inside_mask(both, hollow, coords), in_outer & ~in_inner)
    twice = np.concatenate((facets, facets + len(outer)))
    assert np.array_equal(rays.inside_mask(both, twice, coords), in_outer)
    assert np.array_equal(windings_along(both, twice, coords, 0), in_outer.astype(int) + in_inner)
    assert np.array_equal(rays.inside_mask(outer, facets[:, ::-1], coords), in_outer)


def test_nothing_comes_of_no_facets():
    coords = [np.arange(3.0), np.arange(4.0)]
    assert not rays.inside_mask(np.zeros((0, 2)), np.zeros((0, 2), dtype=int), coords).any()
    assert len(rays.nearest_hits(rays.cast(np.zeros((0, 2)), np.zeros((0, 2), int), coords, 1), coords, 1).segment) == 0


# ---- degenerate positions -----------------------------------------------------------------------------------


@st.composite
def degenerate_bodies(draw, dim):
    """Any set of simplices of a small lattice, sheared, scaled to integers or half-integers, and shifted likewise."""
    points, cells = kuhn((2,) * dim)
    chosen = draw(st.lists(st.booleans(), min_size=len(cells), max_size=len(cells)))
    shear = np.eye(dim)
    shear[0, -1] = draw(st.integers(-2, 2))
    shear[-1, 0] = draw(st.integers(-1, 1)) * (shear[0, -1] == 0)
    stretch = np.array([draw(st.sampled_from([0.5, 1.0, 1.5, 2.0])) for _ in range(dim)])
    shift = np.array([draw(st.integers(-4, 4)) * 0.5 for _ in range(dim)])
    return (points * stretch) @ shear.T + shift, cells[np.array(chosen, dtype=bool)]


@pytest.mark.parametrize("dim", [2, 3])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_degenerate_surfaces_are_seen_alike_along_all_axes(dim, data):
    points, cells = data.draw(degenerate_bodies(dim))
    facets = boundary(cells) if len(cells) else np.zeros((0, dim), dtype=int)
    coords = [np.arange(-6, 12) * 0.5 for _ in range(dim)]
    expected = contains(points, cells, lattice_points(coords))
    shape = expected.shape
    for axis in range(dim):
        crossings = rays.cast(points, facets, coords, axis)
        winding = rays.windings(crossings, shape, axis)
        assert np.array_equal(winding, expected)
        # a segment is cut an odd number of times exactly where its ends differ
        inner = crossings.beyond[:, axis] > 0
        at = crossings.beyond[inner].copy()
        at[:, axis] -= 1
        n_cuts = np.zeros([n - (a == axis) for a, n in enumerate(shape)], dtype=int)
        np.add.at(n_cuts, tuple(at.T), 1)
        differ = np.diff(winding, axis=axis) != 0
        assert np.array_equal(n_cuts % 2 == 1, differ)
        hits = rays.nearest_hits(crossings, coords, axis)
        assert np.array_equal(hits.segment, np.flatnonzero(n_cuts))
        crossed = n_cuts > 0
        assert np.array_equal(crossed, differ | (n_cuts >= 2))
        assert_hits_lie_on_their_segments(points, facets, coords, axis, hits, crossed.shape)


def assert_hits_lie_on_their_segments(points, facets, coords, axis, hits, shape, tolerance=1e-12):
    index = np.unravel_index(hits.segment, shape)
    where = np.einsum("nk,nka->na", hits.weights, points[facets[hits.facet]])
    for a, line in enumerate(coords):
        last = line[index[a] + 1] if a == axis else line[index[a]]
        assert np.all(where[:, a] >= line[index[a]] - tolerance)
        assert np.all(where[:, a] <= last + tolerance)
    assert np.allclose(hits.weights.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    assert np.all(hits.weights >= 0)


@pytest.mark.parametrize("seed", range(4))
def test_surfaces_close_whatever_rounding_does(seed):
    """Nearly degenerate positions: multiples of 0.1 with a few units in the last place added at random."""
    random = np.random.default_rng(seed)
    base, cells = kuhn((3, 3, 3))
    coords = [(np.arange(-3, 9) + 0.5) * 0.1] * 3
    for _ in range(20):
        points = 0.05 * np.round(base * random.integers(1, 4) + random.integers(-4, 5, size=3))
        points *= 1 + random.integers(-2, 3, size=points.shape) * 2.0**-53
        facets = boundary(cells[random.random(len(cells)) < 0.6])
        # a lattice that reaches past the surface: the last point of each line is outside again
        far = [np.r_[c, 9.0] for c in coords]
        windings = [windings_along(points, facets, far, axis) for axis in range(3)]
        for axis in range(3):
            assert np.all(np.take(windings[axis], -1, axis=axis) == 0)
            assert np.array_equal(windings[axis], windings[0])
        assert windings[0].min() >= 0 and windings[0].max() <= 1


# ---- hits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_hits_on_a_smooth_surface(dim):
    if dim == 2:
        points, facets = circle(100, np.zeros(2), 0.8)
    else:
        points = np.random.default_rng(0).normal(size=(300, 3))
        points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
        facets, _ = hull(points)
    coords = [np.linspace(-1, 1, 30)] * dim
    inside = rays.inside_mask(points, facets, coords)
    for axis in range(dim):
        hits = rays.nearest_hits(rays.cast(points, facets, coords, axis), coords, axis)
        shape = tuple(30 - (a == axis) for a in range(dim))
        differ = np.diff(inside.astype(int), axis=axis) != 0
        assert np.all(np.isin(np.flatnonzero(differ), hits.segment))
        assert_hits_lie_on_their_segments(points, facets, coords, axis, hits, shape)


def test_of_several_hits_the_one_nearest_to_the_middle_counts():
    coords = [np.array([0.0, 1.0]), np.array([0.5])]
    points = np.array([[0.1, 1.0], [0.1, 0.0], [0.6, 0.0], [0.6, 1.0], [0.95, 0.0], [0.95, 1.0]])
    facets = np.array([[0, 1], [2, 3], [4, 5]])
    hits = rays.nearest_hits(rays.cast(points, facets, coords, 0), coords, 0)
    assert hits.segment.tolist() == [0]
    assert hits.facet.tolist() == [1]
    assert hits.weights.tolist() == [[0.5, 0.5]]


def test_hits_are_linear_interpolation_on_the_facet():
    points = np.array([[0.2, 0.0, 0.0], [0.4, 2.0, 0.0], [0.8, 0.0, 2.0]])
    coords = [np.array([0.0, 1.0]), np.array([0.5]), np.array([0.25])]
    hits = rays.nearest_hits(rays.cast(points, np.array([[0, 1, 2]]), coords, 0), coords, 0)
    assert hits.weights[0] == pytest.approx([1 - 0.25 - 0.125, 0.25, 0.125], abs=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_nearest_point_on_facets(dim):
    random = np.random.default_rng(3)
    points = random.normal(size=(12, dim))
    facets = np.array([random.permutation(12)[:dim] for _ in range(20)])
    at = 2 * random.normal(size=(50, dim))
    facet, weights = rays.nearest_on_facets(points, facets, at)
    found = np.linalg.norm(np.einsum("nk,nka->na", weights, points[facets[facet]]) - at, axis=1)
    # all facets densely sampled come close to it and never closer
    grid = np.array([w for w in itertools.product(np.linspace(0, 1, 41), repeat=dim) if abs(sum(w) - 1) < 1e-9])
    samples = np.einsum("sk,fka->fsa", grid, points[facets]).reshape(-1, dim)
    best = np.min(np.linalg.norm(samples[None] - at[:, None], axis=2), axis=1)
    assert np.all(found <= best + 1e-12)
    assert np.all(found >= best - 0.1)
    assert np.allclose(weights.sum(axis=1), 1, rtol=0, atol=1e-14) and np.all(weights >= 0)
