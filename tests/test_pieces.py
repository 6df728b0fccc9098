"""Cells whose fluid falls into pieces: how many, how large, how they join."""

from __future__ import annotations

import numpy as np
import pytest
from cut_cases import box, check, enclosed_volume, grid, polygon, rotation, star, together
from scipy.ndimage import label

from petfsi.geometry.clipping import cut
from petfsi.geometry.rays import inside_mask

DIMS = pytest.mark.parametrize("dim", [2, 3])


def bar(dim, low, high, axis=1, length=2.0):
    """A box between two coordinates along an axis, sticking out of the cells 0 to 1 along the others."""
    lower, upper = np.full(dim, -length), np.full(dim, 1.0 + length)
    lower[axis], upper[axis] = low, high
    return box(lower, upper)


def volumes(cuts, cell=0):
    """The volumes of a cell's pieces."""
    extra = cuts.extra_volume[cuts.extra_cell == cell]
    return [float(cuts.volume.ravel()[cell] - extra.sum()), *extra.tolist()]


def flood(surface, lattice, cell, n=48, base=0):
    """The volumes of a cell's pieces, large to small, found by filling a fine raster."""
    index = np.array(np.unravel_index(cell, lattice.shape))
    coords = [i + (np.arange(n) + 0.5) / n for i in index]
    fluid = inside_mask(*surface, coords) == base
    count = np.bincount(label(fluid)[0].ravel())[1:]
    return np.sort(count)[::-1] / n ** len(coords)


@DIMS
def test_a_sheet_makes_two_pieces_of_a_cell(dim):
    surface = bar(dim, 0.6, 0.65)
    lattice = grid([1] * dim)
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice)
    assert volumes(cuts) == pytest.approx([0.6, 0.35])
    assert cuts.piece[cuts.normals[cuts.facet, 1] < 0].tolist() == [0] * (dim - 1)
    assert cuts.piece[cuts.normals[cuts.facet, 1] > 0].tolist() == [1] * (dim - 1)
    across = {(f, b, a): o for f, b, a, o in zip(*links(cuts, 1), strict=True)}
    assert across == {(0, -1, 0): pytest.approx(1.0), (1, 1, -1): pytest.approx(1.0)}
    along = {(f, b, a): o for f, b, a, o in zip(*links(cuts, 0), strict=True)}
    expected = {(0, -1, 0): 0.6, (0, -1, 1): 0.35, (1, 0, -1): 0.6, (1, 1, -1): 0.35}
    assert along == {key: pytest.approx(value) for key, value in expected.items()}


def links(cuts, axis):
    mine = cuts.link_axis == axis
    return [part[mine].tolist() for part in (cuts.link_face, cuts.link_below, cuts.link_above, cuts.link_open)]


@DIMS
@pytest.mark.parametrize("thickness", [0.1, 1e-3, 1e-6])
def test_a_tilted_sheet_joins_pieces_on_its_own_side_only(dim, thickness):
    rng = np.random.default_rng(3)
    low, high = np.full(dim, -20.0), np.full(dim, 20.0)
    low[1], high[1] = -thickness / 2, thickness / 2
    points, facets = box(low, high)
    turn = rotation(rng, dim)
    points = 3.0 + points @ turn.T
    lattice = grid([6] * dim)
    cuts = cut(points, facets, lattice)
    check(points, facets, cuts, lattice)
    assert len(cuts.extra_cell) > 5 ** (dim - 1)
    normal = turn[:, 1]
    n = cuts.volume.size
    number = np.full((n, 2), -1)
    number[:, 0] = np.arange(n)
    number[cuts.extra_cell, cuts.extra_piece] = n + np.arange(len(cuts.extra_cell))
    centre = np.array(np.unravel_index(np.arange(n), lattice.shape)).T + 0.5 - 3.0
    side = np.zeros(n + len(cuts.extra_cell))
    side[:n] = np.sign(centre @ normal)
    wall = np.sign(cuts.normals[cuts.facet] @ normal)
    np.testing.assert_array_equal(np.abs(cuts.normals[cuts.facet] @ normal) > 0.99, True)
    side[number[cuts.cell, cuts.piece]] = wall  # of a piece with several patches all have the same sign:
    np.testing.assert_array_equal(side[number[cuts.cell, cuts.piece]], wall)
    for a in range(dim):
        mine = (cuts.link_axis == a) & (cuts.link_below >= 0) & (cuts.link_above >= 0)
        face = np.array(np.unravel_index(cuts.link_face[mine], cuts.open[a].shape))
        above = np.ravel_multi_index(tuple(face), lattice.shape)
        below = np.ravel_multi_index(tuple(face - (np.arange(dim) == a)[:, None]), lattice.shape)
        np.testing.assert_array_equal(
            side[number[below, cuts.link_below[mine]]], side[number[above, cuts.link_above[mine]]]
        )


@DIMS
def test_pieces_of_equal_size_are_numbered_by_their_first_patch(dim):
    low, high = bar(dim, 0.2, 0.3), bar(dim, 0.7, 0.8)
    lattice = grid([1] * dim)
    for first, second in ((low, high), (high, low)):
        cuts = cut(*together(first, second), lattice)
        assert volumes(cuts) == pytest.approx([0.4, 0.2, 0.2])
        assert set(cuts.piece[cuts.facet < len(first[1])]) == {0, 1}
        assert set(cuts.piece[cuts.facet >= len(first[1])]) == {0, 2}


@DIMS
def test_bodies_inside_one_cell_leave_it_whole(dim):
    rng = np.random.default_rng(0)
    bodies = [star(rng, 12, place, 0.05, 0.12) for place in np.array(list(np.ndindex(*(3,) * dim))) * 0.3 + 0.2]
    surface = together(*bodies)
    lattice = grid([1] * dim)
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice, within=enclosed_volume(*surface))
    assert len(cuts.extra_cell) == 0
    assert all(np.all(part == 1.0) for part in cuts.open)


@DIMS
def test_a_cavity_inside_one_cell_is_a_piece_without_links(dim):
    hollow = box(np.full(dim, 0.1), np.full(dim, 0.9))
    inner, facets = box(np.full(dim, 0.3), np.full(dim, 0.7))
    grain = box(np.full(dim, 0.45), np.full(dim, 0.55))
    surface = together(hollow, (inner, facets[:, ::-1]), grain)
    lattice = grid([1] * dim)
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice, within=enclosed_volume(*surface))
    expected = sorted([1.0 - 0.8**dim, 0.4**dim - 0.1**dim])
    assert volumes(cuts) == pytest.approx(expected[::-1])
    outer = int(1.0 - 0.8**dim < 0.1)  # which of the two has the outer wall
    n = len(facets)
    assert set(cuts.piece[cuts.facet < n]) == {outer}
    assert set(cuts.piece[cuts.facet >= n]) == {1 - outer}
    assert set(cuts.link_below) | set(cuts.link_above) == {-1, outer}


def test_a_cavity_that_fills_more_than_the_rest():
    outer, walls = box([-2.0, -2.0, -2.0], [3.0, 3.0, 3.0])
    inner, facets = box([0.1, 0.1, 0.1], [0.9, 0.9, 0.9])
    lattice = grid([1, 1, 1])
    surface = together((outer, walls), (inner, facets[:, ::-1]), box([0.4, 0.4, 0.4], [0.6, 0.6, 0.6]))
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice)
    assert len(cuts.extra_cell) == 0
    assert cuts.volume.item() == pytest.approx(0.8**3 - 0.2**3)
    assert all(np.all(part == 0.0) for part in cuts.open)


def test_tubes_on_faces_belong_to_what_surrounds_them():
    """Rods through the cell, beside a sheet with a hole, inside a hollow rod: loops on two faces."""
    rods = [box([-1.0, y, z], [2.0, y + 0.1, z + 0.1]) for y, z in ((0.1, 0.1), (0.8, 0.1), (0.5, 0.15))]
    shell = box([-1.0, 0.2, 0.5], [2.0, 0.8, 0.95])
    points, facets = box([-0.9, 0.25, 0.55], [1.9, 0.75, 0.9])
    core = box([-0.8, 0.45, 0.7], [1.8, 0.55, 0.8])
    surface = together(*rods, shell, (points, facets[:, ::-1]), core, bar(3, 0.3, 0.35, axis=2))
    lattice = grid([1, 1, 1])
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice)
    above, below, held = 0.65 - 0.6 * 0.45, 0.3 - 0.03, 0.5 * 0.35 - 0.01
    assert volumes(cuts) == pytest.approx([above, below, held])
    assert [set(cuts.piece[(cuts.facet >= 12 * i) & (cuts.facet < 12 * (i + 1))]) for i in range(7)] == [
        {1}, {1}, {1}, {0}, {2}, {2}, {0, 1}
    ]  # fmt: skip
    mine = (cuts.link_axis == 0) & (cuts.link_face == 0)
    opening = dict(zip(cuts.link_above[mine], cuts.link_open[mine], strict=True))
    assert opening == {0: pytest.approx(above), 1: pytest.approx(below), 2: pytest.approx(held)}


def test_a_body_between_two_sheets_belongs_to_the_piece_between():
    grain = box([0.4, 0.4, 0.45], [0.6, 0.6, 0.5])
    surface = together(bar(3, 0.3, 0.31, axis=2), bar(3, 0.7, 0.75, axis=2), grain)
    cuts = cut(*surface, grid([1, 1, 1]))
    check(*surface, cuts, grid([1, 1, 1]))
    between = 0.39 - 0.2 * 0.2 * 0.05
    assert volumes(cuts) == pytest.approx([between, 0.3, 0.25])
    assert set(cuts.piece[cuts.facet >= 24]) == {0}


def test_a_tongue_and_a_sheet_in_the_plane():
    """Two fingers reach into a cell from one side, and a third across its corner."""
    fingers = [polygon([[-1, y], [0.7, y], [0.7, y + 0.1], [-1, y + 0.1]]) for y in (0.2, 0.6)]
    corner = polygon([[0.8, -0.1], [1.1, 0.2], [1.0, 0.3], [0.7, 0.0]])
    surface = together(*fingers, corner)
    lattice = grid([1, 1])
    cuts = cut(*surface, lattice)
    check(*surface, cuts, lattice)
    assert len(cuts.extra_cell) == 1
    assert cuts.extra_volume[0] == pytest.approx(0.1**2 / 2, rel=1e-6)


@DIMS
@pytest.mark.parametrize("seed", range(12))
def test_pieces_are_those_that_a_raster_shows(dim, seed):
    """Sheets, turned as they happen to be, with bodies between them."""
    rng = np.random.default_rng(seed)
    turn, place = rotation(rng, dim), rng.uniform(0.8, 1.2, dim)
    bodies = []
    for k in range(-4, 5):
        low, high = np.full(dim, -3.0), np.full(dim, 3.0)
        low[1], high[1] = 0.5 * k, 0.5 * k + 0.1
        bodies.append(box(low, high))
        if k % 2:
            bodies += [star(rng, 10, [x, 0.5 * k + 0.3, 0.1][:dim], 0.05, 0.15) for x in (-0.4, 0.0, 0.4)]
    points, facets = together(*bodies)
    points = place + points @ turn.T
    lattice = grid([2] * dim)
    cuts = cut(points, facets, lattice)
    check(points, facets, cuts, lattice)
    assert len(cuts.extra_cell) > 0
    n = 64 if dim == 2 else 40
    for cell in range(2**dim):
        shown, found = flood((points, facets), lattice, cell, n), np.array(volumes(cuts, cell))
        large = 0.02
        assert np.all(np.diff(found) <= 1e-9)
        np.testing.assert_allclose(found[found > large], shown[: np.count_nonzero(found > large)], atol=0.03)
        assert abs(found.sum() - shown.sum()) < 0.03
        assert np.count_nonzero(shown > 2 * large) <= np.count_nonzero(found > large)


@pytest.mark.parametrize("shift", [0.0, 1e-17, 1e-10, 3e-9, 1e-6])
def test_sheets_through_the_corners_of_cells_close(shift):
    """Sheets along the cells' diagonals, where every face is met in its edge."""
    for dim in (2, 3):
        low, high = np.full(dim, -4.0), np.full(dim, 4.0)
        low[1], high[1] = 0.0, 0.1
        points, facets = box(low, high)
        turn = np.eye(dim)
        turn[:2, :2] = [[1.0, -1.0], [1.0, 1.0]]
        points = points @ turn.T + 2.0 + shift
        lattice = grid([4] * dim)
        cuts = cut(points, facets, lattice)
        check(points, facets, cuts, lattice)
        diagonal = np.ravel_multi_index((np.arange(4),) * 2 + (np.zeros(4, int),) * (dim - 2), lattice.shape)
        assert np.all(np.isin(diagonal, cuts.extra_cell))
