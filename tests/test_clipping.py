"""Surfaces cut by cells: closure, volumes, sub-boxes, periodic images, containers."""

from __future__ import annotations

import numpy as np
import pytest
from cut_cases import box, check, enclosed_volume, grid, piece_residuals, polygon, rotation, star, together
from hypothesis import given, settings
from hypothesis import strategies as st

from petfsi.geometry.clipping import cut
from petfsi.geometry.slabs import area_vectors

CELLS = {2: [9, 7], 3: [7, 6, 6]}
DIMS = pytest.mark.parametrize("dim", [2, 3])


def sheet(rng, dim, thickness):
    low, high = np.full(dim, -1.4), np.full(dim, 1.4)
    low[1], high[1] = -thickness / 2, thickness / 2
    points, facets = box(low, high)
    return points, facets, rotation(rng, dim)


def shape(kind, rng, dim):
    """A random surface inside the grid."""
    middle = np.array(CELLS[dim]) / 2 + rng.uniform(-0.5, 0.5, dim)
    if kind == "rough":
        return star(rng, rng.integers(6, 60), middle, 0.2, 1.9)
    if kind == "fine":
        return star(rng, rng.integers(100, 300), middle, 1.7, 1.8)
    if kind == "small":
        return star(rng, rng.integers(6, 20), middle, 0.05, 0.3)
    if kind == "planes":  # a box in grid planes, or with corners at cells' centres
        low = rng.integers(1, 3, dim) + rng.choice([0.0, 0.5])
        return box(low, low + rng.integers(1, 3, dim))
    if kind == "diagonal":  # turned by 45 degrees, through the cells' corners
        turn = np.eye(dim)
        turn[:2, :2] = [[1.0, -1.0], [1.0, 1.0]]
        points, facets = box(-np.full(dim, 1.0), np.ones(dim))
        return np.floor(middle) + rng.choice([0.0, 0.5], dim) + points @ turn.T, facets
    if kind in ("sheet", "thin sheet"):
        points, facets, turn = sheet(rng, dim, 0.1 if kind == "sheet" else 1e-3)
        return middle + points @ turn.T, facets
    if kind == "pair":
        points, facets, turn = sheet(rng, dim, 0.3)
        above = points + np.eye(dim)[1] * (0.3 + rng.choice([0.2, 0.01, 1e-6]))
        return together((middle + points @ turn.T, facets), (middle + above @ turn.T, facets))
    if kind == "crowd":
        places = np.array(list(np.ndindex(*(5,) * dim))) * 0.4 + 1.0
        return together(*[star(rng, 7, place, 0.02, 0.19) for place in places])
    raise AssertionError(kind)


KINDS = ["rough", "fine", "small", "planes", "diagonal", "sheet", "thin sheet", "pair", "crowd"]


@DIMS
@settings(max_examples=300, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**31))
def test_cells_and_pieces_close_and_volumes_are_exact(dim, kind, seed):
    points, facets = shape(kind, np.random.default_rng(seed), dim)
    lattice = grid(CELLS[dim], dx=[0.5, 0.8, 1.1][:dim])
    points = points * lattice.dx
    cuts = cut(points, facets, lattice)
    check(points, facets, cuts, lattice, within=enclosed_volume(points, facets))
    area = np.linalg.norm(area_vectors(points, facets), axis=1)
    found = np.array([np.bincount(cuts.facet, weights=part, minlength=len(facets)) for part in cuts.integrals.T])
    np.testing.assert_allclose(found, np.tile(area / dim, (dim, 1)), atol=1e-7)


@DIMS
@settings(max_examples=100, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**31))
def test_boxes_see_what_the_whole_grid_sees(dim, kind, seed):
    rng = np.random.default_rng(seed)
    points, facets = shape(kind, rng, dim)
    points += rng.uniform(-3.0, 3.0, dim)  # perhaps partly outside the grid
    whole_grid = grid(CELLS[dim])
    whole = cut(points, facets, whole_grid)
    check(points, facets, whole, whole_grid)
    lo = rng.integers(0, np.array(CELLS[dim]) - 1)
    hi = rng.integers(lo + 1, np.array(CELLS[dim]) + 1)
    lattice = grid(CELLS[dim], lo, hi)
    part = cut(points, facets, lattice)
    check(points, facets, part, lattice)
    within = tuple(slice(a, b) for a, b in zip(lo, hi, strict=True))
    number = np.full(whole_grid.shape, -1)
    number[within] = np.arange(np.prod(lattice.shape)).reshape(lattice.shape)
    mine = number.ravel()[whole.cell] >= 0
    for name in ("facet", "piece", "integrals", "moments"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[mine])
    np.testing.assert_array_equal(part.cell, number.ravel()[whole.cell[mine]])
    mine = number.ravel()[whole.extra_cell] >= 0
    np.testing.assert_array_equal(part.extra_cell, number.ravel()[whole.extra_cell[mine]])
    np.testing.assert_array_equal(part.extra_piece, whole.extra_piece[mine])
    np.testing.assert_array_equal(part.extra_volume, whole.extra_volume[mine])
    np.testing.assert_allclose(part.volume, whole.volume[within], atol=1e-13, rtol=0)
    for a in range(dim):
        faces = tuple(slice(s.start, s.stop + (b == a)) for b, s in enumerate(within))
        np.testing.assert_allclose(part.open[a], whole.open[a][faces], atol=1e-13, rtol=0)
        for value in (0.0, 1.0):
            np.testing.assert_array_equal(part.open[a] == value, whole.open[a][faces] == value)
        mapped = np.full(whole.open[a].shape, -1)
        mapped[faces] = np.arange(part.open[a].size).reshape(part.open[a].shape)
        ours, theirs = links(part, a), links(whole, a)
        inner = {key: open_ for key, open_ in ours.items() if -1 not in key[1:]}
        moved = {(int(mapped.ravel()[key[0]]), *key[1:]): open_ for key, open_ in theirs.items()}
        for key, open_ in inner.items():
            assert moved[key] == pytest.approx(open_, abs=1e-13)


def links(cuts, axis):
    mine = cuts.link_axis == axis
    keys = zip(cuts.link_face[mine], cuts.link_below[mine], cuts.link_above[mine], strict=True)
    return {tuple(map(int, key)): float(o) for key, o in zip(keys, cuts.link_open[mine], strict=True)}


@DIMS
@settings(max_examples=60, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**31))
def test_ghost_cells_repeat_the_cells_they_stand_for(dim, kind, seed):
    rng = np.random.default_rng(seed)
    points, facets = shape(kind, rng, dim)
    cells = np.array(CELLS[dim])
    points += rng.integers(-2, 3, dim) * cells + rng.uniform(-3.0, 3.0, dim)
    lattice = grid(cells, np.full(dim, -2), cells + 2, periodic=True)
    ghosted = cut(points, facets, lattice)
    check(points, facets, ghosted, lattice)
    plain_grid = grid(cells, periodic=True)
    plain = cut(points, facets, plain_grid)
    check(points, facets, plain, plain_grid, within=enclosed_volume(points, facets))
    index = np.array(np.unravel_index(np.arange(ghosted.volume.size), lattice.shape))
    stands_for = np.ravel_multi_index(tuple((index - 2) % cells[:, None]), tuple(cells))
    first, last = np.searchsorted(plain.cell, stands_for), np.searchsorted(plain.cell, stands_for, side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    np.testing.assert_array_equal(ghosted.cell, np.repeat(np.arange(len(first)), last - first))
    for name in ("facet", "piece", "integrals", "moments"):
        np.testing.assert_array_equal(getattr(ghosted, name), getattr(plain, name)[rows])
    np.testing.assert_allclose(ghosted.volume.ravel(), plain.volume.ravel()[stands_for], atol=1e-13, rtol=0)


@DIMS
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_containers_leave_open_what_they_hold(dim, seed):
    rng = np.random.default_rng(seed)
    room, walls = star(rng, 40, np.array(CELLS[dim]) / 2, 1.5, 2.2)
    body, facets = star(rng, 12, np.array(CELLS[dim]) / 2, 0.2, 0.5)
    points, facets = together((room, walls[:, ::-1]), (body, facets))
    lattice = grid(CELLS[dim])
    cuts = cut(points, facets, lattice, base=1)
    free = enclosed_volume(room, walls) - enclosed_volume(body, facets[len(walls) :] - len(room))
    check(points, facets, cuts, lattice, within=np.prod(CELLS[dim]) - free)


@DIMS
def test_what_stands_outside_the_grid_covers_its_faces(dim):
    low, high = np.full(dim, -2.0), np.full(dim, 1.5)
    surface = box(low, high)
    lattice = grid([4] * dim)
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice, within=1.5**dim)
    assert cuts.open[0][(0,) * dim] == 0.0
    assert cuts.open[0][(1,) + (0,) * (dim - 1)] == 0.0
    assert cuts.open[0][(0, 1) + (0,) * (dim - 2)] == pytest.approx(0.5)
    assert cuts.open[0][(2,) + (0,) * (dim - 1)] == 1.0


@DIMS
def test_a_surface_in_grid_planes_leaves_no_sliver(dim):
    surface = box(np.full(dim, 1.0), np.full(dim, 3.0))
    lattice = grid([4] * dim)
    cuts = cut(*surface, lattice)
    solid = np.zeros((4,) * dim, dtype=bool)
    solid[(slice(1, 3),) * dim] = True
    assert np.all(cuts.volume[solid] == 0.0)
    np.testing.assert_allclose(cuts.volume[~solid], 1.0, atol=1e-8)
    for a in range(dim):
        below = np.take(solid, range(3), axis=a)
        above = np.take(solid, range(1, 4), axis=a)
        between = np.take(cuts.open[a], range(1, 4), axis=a)
        assert np.all(between[below | above] == 0.0)
        np.testing.assert_allclose(between[~(below | above)], 1.0, atol=1e-8)


def test_integrals_and_moments_of_a_segment():
    points, facets = polygon([[0.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    lattice = grid([3, 3])
    cuts = cut(points + [0.5, 0.5], facets, lattice)
    first = np.flatnonzero((cuts.facet == 0) & (cuts.cell == 0))[0]  # from (0.5, 0.5) to (1, 0.75)
    length = np.sqrt(5.0) / 4.0
    np.testing.assert_allclose(cuts.integrals[first], [0.875 * length, 0.125 * length], rtol=1e-8)
    # x - 0.5 = 2 s with weight s = N_1 from 0 to 1/4: mean of 2 s^2 is 2/48
    assert cuts.moments[first, 1, 0] == pytest.approx(length * 2 / 48, rel=1e-8)
    assert cuts.moments[first, 0, 0] == pytest.approx(length * (0.25 - 2 / 48), rel=1e-8)
    assert cuts.moments[first, 1, 1] == pytest.approx(length / 48, rel=1e-8)


def test_integrals_and_moments_of_a_triangle():
    points, facets = box([0.25, 0.25, 0.25], [0.75, 0.75, 0.75])
    lattice = grid([1, 1, 1], dx=[2.0, 1.0, 1.0])
    points = points * lattice.dx
    cuts = cut(points, facets, lattice)
    assert cuts.open[0].ravel().tolist() == [1.0, 1.0]
    assert cuts.volume.item() == pytest.approx(0.875, rel=1e-14)
    corner = points[facets] - np.array([1.0, 0.5, 0.5])
    area = np.linalg.norm(area_vectors(points, facets), axis=1)
    np.testing.assert_allclose(cuts.integrals, np.tile(area[:, None] / 3, (1, 3)), rtol=1e-14)
    # int N_i x dA = area / 12 (x_i + sum of all x)
    expected = area[:, None, None] / 12 * (corner + corner.sum(axis=1, keepdims=True))
    np.testing.assert_allclose(cuts.moments, expected, atol=1e-15)


@DIMS
def test_nothing_to_cut(dim):
    for base in (0, 1):
        cuts = cut(np.zeros((0, dim)), np.zeros((0, dim), dtype=int), grid([3] * dim), base)
        assert np.all(cuts.volume == 1 - base)
        assert all(np.all(part == 1 - base) for part in cuts.open)
        assert len(cuts.facet) == len(cuts.link_axis) == 0


@DIMS
def test_solids_that_overlap_leave_finite_numbers(dim):
    rng = np.random.default_rng(1)
    middle = np.array(CELLS[dim]) / 2
    surface = together(*[star(rng, 20, middle + rng.uniform(-1, 1, dim), 0.5, 1.5) for _ in range(4)])
    cuts = cut(*surface, grid(CELLS[dim]))
    for part in (cuts.volume, cuts.integrals, cuts.moments, *cuts.open, cuts.extra_volume, cuts.link_open):
        assert np.all(np.isfinite(part))
    assert all(np.all((part >= 0.0) & (part <= 1.0)) for part in cuts.open)


def test_facets_without_area_are_harmless():
    points, facets = box([0.5, 0.5, 0.5], [1.5, 1.5, 1.5])
    facets = np.concatenate((facets, [[0, 1, 1], [1, 0, 0]]))
    cuts = cut(points, facets, grid([2, 2, 2]))
    assert np.abs(piece_residuals(cuts, grid([2, 2, 2]))).max() < 1e-12
    assert np.all(np.isfinite(cuts.normals))
