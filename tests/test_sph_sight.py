"""What thin bodies hide, against every pair and every facet: 3 s, 60 s before anything is compiled."""

import numpy as np
import pytest

from petfsi.fields.sph.cells import Pairs, cell_grid, fluid_pairs, sorted_rows
from petfsi.fields.sph.sight import Sight
from petfsi.fields.sph.thin import thin_facets, wet_on_both_sides

DX = 0.05
REACH = 3.15 * DX


# what is looked at


def lattice(dim, n, shift=0.5, noise=0.0, seed=0):
    """Particles in the unit box, n along each axis."""
    k = (np.arange(n) + shift) / n
    x = np.stack(np.meshgrid(*dim * [k], indexing="ij"), axis=-1).reshape(-1, dim)
    return x + noise / n * np.random.default_rng(seed).uniform(-1, 1, x.shape)


def listed(x, low=-1.0, high=2.0, owned=None):
    """Rows sorted into cells, with the pairs of those nearer than the reach, and what wall pairs need, too."""
    dim = x.shape[1]
    grid = cell_grid(dim * [low], dim * [high], REACH, dim * [False])
    order, first = sorted_rows(grid.of(x), grid.counts, np.arange(len(x)))
    x = np.ascontiguousarray(x[order])
    owned = np.ones(len(x), dtype=bool) if owned is None else owned[order]
    return x, fluid_pairs(x, owned, first, grid.counts, REACH), (owned, first, grid.counts)


def tuples(pairs):
    return np.column_stack((np.repeat(np.arange(len(pairs.start) - 1), np.diff(pairs.start)), pairs.other))


def copied(pairs):
    return Pairs(pairs.start.copy(), pairs.other.copy())


def det(*rows):
    u, v = rows[0], rows[1]
    if len(rows) == 2:
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return sum((u[..., k] * det(v[..., [k - 2, k - 1]], rows[2][..., [k - 2, k - 1]])) for k in range(3))


def crossing(p, q, corners):
    """Which segments p q (n, dim) cross any of the facets, nothing being in a special position."""
    found = np.zeros(len(p), dtype=bool)
    for corner in corners:
        low, high = corner.min(axis=0), corner.max(axis=0)
        near = np.flatnonzero(np.all((np.minimum(p, q) <= high) & (np.maximum(p, q) >= low), axis=1))
        s, d, n = p[near], (q - p)[near], len(corner)
        to = [c - s for c in corner]
        if n == 2:
            through = det(d, to[0]) * det(d, to[1]) < 0
        else:
            past = [det(d, to[k], to[(k + 1) % 3]) > 0 for k in range(3)]
            through = (past[0] == past[1]) & (past[1] == past[2])
        edges = [np.broadcast_to(c - corner[0], d.shape) for c in corner[1:]]
        found[near] |= through & (det(*edges, -to[0]) * det(*edges, d - to[0]) < 0)
    return found


def polyline(points, closed=False):
    k = np.arange(len(points))
    return np.array(points, dtype=float), np.column_stack((k, np.roll(k, -1)))[: len(k) if closed else len(k) - 1]


def beam(along, thickness):
    """A closed strip around a curve, normals outwards."""
    along = np.array(along, dtype=float)
    tangent = np.gradient(along, axis=0)
    normal = thickness / 2 * (tangent @ [[0, 1], [-1, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
    return polyline(np.concatenate((along - normal, (along + normal)[::-1])), closed=True)


def sheet(n, at=lambda u: np.column_stack((u, 0 * u[:, 0]))):
    """A square of n by n cells of two triangles, normals along z, brought somewhere."""
    k = np.arange(n + 1) / n
    points = at(np.stack(np.meshgrid(k, k, indexing="ij"), axis=-1).reshape(-1, 2))
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return points, np.concatenate((np.column_stack((a, b, c)), np.column_stack((a, c, d))))


def plate(n, thickness, at):
    """Two sheets, normals apart, and the rim between them."""
    points, facets = sheet(n)
    m = len(points)
    both = np.concatenate((points + [0, 0, thickness / 2], points - [0, 0, thickness / 2]))
    edges = np.concatenate([facets[:, [k, (k + 1) % 3]] for k in range(3)])
    rim = np.array([e for e in edges.tolist() if not np.any(np.all(edges == e[::-1], axis=1))])
    a, b = rim.T
    sides = np.concatenate((np.column_stack((a, a + m, b + m)), np.column_stack((a, b + m, b))))
    return at(both), np.concatenate((facets, facets[:, ::-1] + m, sides))


def turned(angle, about=0.5):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return lambda x: np.concatenate(((x[:, :2] - about) @ turn.T + about, x[:, 2:]), axis=1)


def swung(angle, offset=(0, 0, 0.45)):
    """Turn a plate about the axis y through the middle of the box."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return lambda x: (x + offset - 0.5) @ turn.T + 0.5


def random_facets(dim, seed):
    rng = np.random.default_rng(seed)
    if dim == 2:
        points, facets = polyline(0.5 + np.cumsum(rng.normal(scale=0.07, size=(40, 2)), axis=0))
        return points + (0.5 - points.mean(axis=0)), facets
    return sheet(6, lambda u: np.column_stack((u, 0.5 + rng.normal(scale=0.05, size=len(u)))))


curve = np.column_stack((np.linspace(0.2, 0.8, 25), 0.5 + 0.1 * np.sin(np.linspace(0, 5, 25))))
BODIES = {
    "random lines": random_facets(2, 1),
    "random sheet": random_facets(3, 2),
    "long facets": polyline([[-0.3, 0.31], [0.51, 0.62], [1.3, 0.11]]),
    "bent beam": beam(curve, DX / 4),
    "turned beam": beam(turned(1.0)(curve), DX / 4),
    "plate": plate(6, DX / 4, swung(0.3)),
    "crossed plates": plate(5, DX / 4, swung(-1.2)),
    "large triangles": sheet(1, lambda u: np.column_stack((3 * u - 1, 0.3 + 0.2 * u[:, 0] + 0.1 * u[:, 1]))),
}


# pairs of particles


@pytest.mark.parametrize("name", BODIES)
def test_pairs_are_struck_just_if_a_facet_is_between(name):
    points, facets = BODIES[name]
    dim = facets.shape[1]
    x, pairs, _ = listed(lattice(dim, 20 if dim == 2 else 9, noise=0.4))
    before = tuples(pairs)
    expected = before[~crossing(x[before[:, 0]], x[before[:, 1]], points[facets])]
    sight = Sight(facets, np.ones(len(facets), dtype=bool), REACH)
    sight.place(points, x)
    found = tuples(sight.strike(pairs, x))
    np.testing.assert_array_equal(found, expected)
    assert len(before) > len(found) > 0
    # placed again
    x, pairs, _ = listed(x + 10.0, 9.0, 12.0)
    sight.place(points, x)
    assert len(sight.strike(pairs, x).other) == len(pairs.other)


@pytest.mark.parametrize("shift", (0.5, 0.0))
@pytest.mark.parametrize("thickness", (0.0, DX / 4))
def test_a_wall_across_a_lattice_hides_all_of_the_other_side(thickness, shift):
    """Rows of the lattice lie on the wall (shift 0), and their lines run through its corners."""
    points, facets = beam(np.column_stack((np.arange(-2, 23) / 20, np.full(25, 0.5))), thickness)
    x, pairs, _ = listed(lattice(2, 20, shift))
    sight = Sight(facets, thin_facets(points, facets, REACH), REACH)
    sight.place(points, x)
    before, found = tuples(pairs), tuples(sight.strike(pairs, x))
    # what lies on it counts as a little above; in what has a thickness it is alone
    height = x[:, 1] - 0.5
    side = np.where(np.abs(height) < 1e-9, float(thickness == 0), np.sign(height))
    np.testing.assert_array_equal(found, before[side[before[:, 0]] == side[before[:, 1]]])


@pytest.mark.parametrize("shift", (0.5, 0.0))
@pytest.mark.parametrize("offset", (0.0, 0.25))
@pytest.mark.parametrize("normal_axis", (0, 1, 2))
def test_nothing_slips_through_edges_and_corners_of_a_plate(shift, offset, normal_axis):
    """Corners, edges and diagonals lie on the lattice's planes and lines."""

    def at(u):
        return np.roll(np.column_stack((1.5 * u - 0.25, np.full(len(u), 0.5 + offset / 8))), normal_axis + 1, axis=1)

    points, facets = sheet(12, at)
    x, pairs, _ = listed(lattice(3, 8, shift))
    sight = Sight(facets, np.ones(len(facets), dtype=bool), REACH)
    sight.place(points, x)
    before, found = tuples(pairs), tuples(sight.strike(pairs, x))
    side = x[:, normal_axis] >= 0.5 + offset / 8
    np.testing.assert_array_equal(found, before[side[before[:, 0]] == side[before[:, 1]]])


def test_a_closed_body_on_the_lattice_has_an_inside():
    """Each particle is inside or outside for all: even those on corners, and on lines along the sides."""
    corners = [[0.25, 0.25], [0.5, 0.1], [0.75, 0.25], [0.9, 0.5], [0.75, 0.75], [0.25, 0.75], [0.25, 0.5]]
    points, facets = polyline(corners, closed=True)
    x, pairs, _ = listed(lattice(2, 20, 0.0))
    sight = Sight(facets, np.ones(len(facets), dtype=bool), REACH)
    sight.place(points, x)
    before, found = tuples(pairs), tuples(sight.strike(pairs, x))
    edge = np.roll(points, -1, axis=0) - points
    moved = x + [1e-7, 1e-10]
    inside = np.all(det(edge, moved[:, None] - points) > 0, axis=1)
    kept = {tuple(pair) for pair in found.tolist()}
    for i, j in before.tolist():
        if inside[i] != inside[j]:
            assert (i, j) not in kept
        elif inside[i]:
            assert (i, j) in kept
    free = ~crossing(moved[before[:, 0]], moved[before[:, 1]], points[facets])
    np.testing.assert_array_equal(found, before[free])


@pytest.mark.parametrize("name", ("bent beam", "plate"))
def test_other_rows_do_not_matter(name):
    points, facets = BODIES[name]
    dim = facets.shape[1]
    sight = Sight(facets, thin_facets(points, facets, REACH), REACH)
    x, pairs, _ = listed(lattice(dim, 20 if dim == 2 else 9))
    sight.place(points, x)
    whole = x[tuples(sight.strike(pairs, x))]
    for low, high in ((0.0, 0.4), (0.4, 0.65), (0.65, 1.0)):
        mine = (x[:, 0] >= low) & (x[:, 0] < high)
        near = (x[:, 0] >= low - REACH) & (x[:, 0] < high + REACH)
        part, pairs, _ = listed(x[near], owned=mine[near])
        sight.place(points, part)
        some = part[tuples(sight.strike(pairs, part))]
        inner = (whole[:, :, 0] >= low) & (whole[:, :, 0] < high)
        np.testing.assert_array_equal(some, whole[inner.any(axis=1)])


def test_surfaces_have_images():
    """A wall beyond the end of a period hides what it would hide one period before."""
    grid = cell_grid([0.0, 0.0], [1.0, 1.0], REACH, [True, False])
    points, facets = polyline([[0.97, -0.5], [0.97, 0.4], [0.97, 1.5]])
    x, pairs, _ = listed(lattice(2, 20) - [0.5, 0.0])
    sight = Sight(facets, np.ones(2, dtype=bool), REACH, grid=grid)
    for periods in (0, -1, 7):
        sight.place(points + [periods, 0], x)
        before, found = tuples(pairs), tuples(sight.strike(copied(pairs), x))
        left = x[:, 0] < -0.03
        np.testing.assert_array_equal(found, before[left[before[:, 0]] == left[before[:, 1]]])


@pytest.mark.parametrize("dim", (2, 3))
def test_nothing_is_fine(dim):
    points, facets = polyline([[0, 0.5], [1, 0.5]]) if dim == 2 else sheet(2)
    nobody, pairs, _ = listed(np.zeros((0, dim)))
    sights = [
        Sight(facets, np.ones(len(facets), dtype=bool), REACH),
        Sight(facets, np.zeros(len(facets), dtype=bool), REACH),
        Sight(np.zeros((0, dim), dtype=int), np.zeros(0, dtype=bool), REACH),
    ]
    x, some, _ = listed(lattice(dim, 6))
    for k, sight in enumerate(sights):
        sight.place(points, nobody)
        assert len(sight.strike(pairs, nobody).other) == 0
        assert len(sight.crossed(nobody, nobody, nobody, points, points, 1.0, 0.1).rows) == 0
        sight.place(points, x)
        if k > 0:
            assert sight.strike(some, x) is some
    assert len(thin_facets(points, np.zeros((0, dim), dtype=int), REACH)) == 0


# which facets are thin


def test_thin_is_what_has_its_back_within_reach():
    line = np.column_stack((np.linspace(0, 1, 21), np.zeros(21)))
    for thickness in (0.0, DX / 4, 0.97 * REACH, 1.1 * REACH, 5 * REACH):
        points, facets = beam(line, thickness)
        thin = thin_facets(points, facets, REACH)
        # the ends, too, unless they are long
        assert np.all(thin == (thickness < REACH))
        assert not wet_on_both_sides(points, facets, REACH).any()
    points, facets = plate(8, DX / 4, swung(0.3))
    assert thin_facets(points, facets, REACH).all()
    points, facets = plate(4, 2 * REACH, swung(0.3))
    assert not thin_facets(points, facets, REACH).any()
    # of a wedge, what is near its tips
    points, facets = polyline(np.concatenate((np.linspace([0, 0], [0.5, 1], 11), np.linspace([0.5, 1], [0, 1], 6)[1:],
                                              np.linspace([0, 1], [0, 0], 11)[1:-1])), closed=True)  # fmt: skip
    thin = thin_facets(points, facets, REACH)
    assert thin[0] and thin[-1] and not thin[5:7].any()


def test_single_sheets_are_wet_on_both_sides():
    points, facets = sheet(4)
    assert thin_facets(points, facets, REACH).all() and wet_on_both_sides(points, facets, REACH).all()
    points, facets = polyline(curve)
    assert wet_on_both_sides(points, facets, REACH).all()
    # two bodies that face each other across a narrow gap
    boxes = [polyline([[0, y], [1, y], [1, y + 0.9], [0, y + 0.9]], closed=True) for y in (0.0, 0.95)]
    points, facets = np.concatenate([p for p, _ in boxes]), np.concatenate((boxes[0][1], boxes[1][1] + 4))
    assert not thin_facets(points, facets, REACH).any()


# the guard


def side_of(x, points, facets, n_one):
    """+1 beyond the first ``n_one`` facets' middle plane and -1 behind it, for plates that are flat."""
    corners = points[facets[:n_one]]
    edges = corners[:, 1:] - corners[:, :1]
    normal = edges[:, 0] @ np.array([[0, -1], [1, 0]]) if len(edges[0]) == 1 else np.cross(edges[:, 0], edges[:, 1])
    return np.sign((x - points.mean(axis=0)) @ normal.sum(axis=0))


@pytest.mark.parametrize("thickness", (None, 0.0, DX / 4))
@pytest.mark.parametrize("dim", (2, 3))
def test_nothing_gets_through_a_plate_that_swings(dim, thickness):
    """Particles at up to 4 dx a step against a plate at up to 2; it is wider than they get in the time."""
    rng = np.random.default_rng(5)

    def at(angle, lift):
        if dim == 3:
            if thickness is None:
                points, facets = sheet(12)
                points = np.column_stack((points, points[:, :0]))
            else:
                points, facets = plate(12, thickness, lambda x: x)
            wide = (points - [0.5, 0.5, 0]) * [4, 4, 1] + [0.5, 0.5, 0]
            return swung(angle, (0, 0, 0.5 + lift))(wide), facets, 288
        line = np.column_stack((np.linspace(2.5, -1.5, 41), np.full(41, 0.5 + lift)))
        points, facets = polyline(line) if thickness is None else beam(line, thickness)
        return turned(angle)(points), facets, 40

    points, facets, n_one = at(0.0, 0.0)
    both = wet_on_both_sides(points, facets, REACH)
    assert both.all() if thickness is None else not both.any()
    sight = Sight(facets, np.ones(len(facets), dtype=bool), REACH, both)
    x = rng.uniform(0.2, 0.8, (400, dim))
    side = side_of(x, points, facets, n_one)
    x[np.abs(x[:, -1] - 0.5) < DX / 4] += DX * np.eye(dim)[-1]
    side = side_of(x, points, facets, n_one)
    put = 0
    for step in range(25):
        v = rng.normal(size=x.shape)
        v *= 4 * DX / np.linalg.norm(v, axis=1)[:, None]
        v[:, -1] += 0.3 * (0.5 - x[:, -1])
        angle = 0.2 * np.sin(0.8 * (step + 1))
        moved, _, _ = at(angle, 0.05 * np.sin(1.9 * (step + 1)))
        after = x + v
        found = sight.crossed(x, after, v, points, moved, 1.0, 0.1 * DX)
        put += len(found.rows)
        after[found.rows] = found.x
        assert np.all(np.diff(found.rows) > 0)
        np.testing.assert_array_equal(side_of(after, moved, facets, n_one), side)
        # in a beam there is nobody
        gap = np.abs((after - moved.mean(axis=0)) @ unit_normal(moved, facets[0]))
        assert gap.min() > (thickness or 0.0) / 2
        x, points = after, moved
    assert put > 400


def unit_normal(points, facet):
    edges = points[facet[1:]] - points[facet[0]]
    n = np.array([edges[0, 1], -edges[0, 0]]) if len(edges) == 1 else np.cross(*edges)
    return n / np.linalg.norm(n)


def test_what_is_put_back_moves_away():
    points, facets = beam(np.column_stack((np.linspace(0, 1, 21), np.full(21, 0.5))), DX / 4)
    sight = Sight(facets, np.ones(len(facets), dtype=bool), REACH)
    x = np.array([[0.5, 0.56], [0.525, 0.44], [0.3, 0.53], [0.7, 0.7], [0.4, 0.5], [0.95, 0.5]])
    v = np.array([[0.0, -2.0], [0.1, 4.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.01], [3.0, 0.0]])
    # the beam rises by 0.1 in 0.05 s: to where the third is, too, which flees too slowly; two are in it
    end = points + [0, 0.1]
    found = sight.crossed(x, x + 0.05 * v, v, points, end, 0.05, 0.1 * DX)
    assert found.rows.tolist() == [0, 1, 2]
    top = 0.6 + DX / 8
    np.testing.assert_allclose(found.x[0], [0.5, top + 0.1 * DX], atol=0.01 * DX)
    np.testing.assert_allclose(found.v[0], [0.0, 2 * 2.0 + 2.0])
    np.testing.assert_allclose(found.v[-1], [0.0, 2 * 2.0 - 1.0])
    still = sight.crossed(x[4:5], x[4:5], 0 * v[4:5], points, points, 0.05, 0.1 * DX)
    assert still.rows.tolist() == [0] and abs(still.x[0, 1] - 0.5) == pytest.approx(DX / 8 + 0.1 * DX)
    nobody = sight.crossed(x, x + 0.05 * v, v, points, end, 0.05, 0.1 * DX, owned=np.zeros(len(x), dtype=bool))
    assert len(nobody.rows) == 0
