"""Where surfaces that move first meet, against dense samples of their ways and against exact times."""

import numpy as np
import pytest

from petfsi.geometry.collisions import Way, crossings, first_meeting
from petfsi.geometry.touching import (
    depths,
    drawn_in,
    first_on_ways,
    shortest_edges,
    stations,
    straight_parts,
    turn_of,
)

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def random_ways(dim, rng):
    """Two facets that do not cross at the start and fly through each other's surroundings."""
    facet = np.arange(dim)[None]
    while True:
        one, other = (rng.uniform(-1.0, 1.0, (dim, dim)) for _ in range(2))
        ways = [
            Way(x, x + rng.normal(0.0, 1.5, (1, dim)) + rng.normal(0.0, 0.3, (dim, dim)), facet) for x in (one, other)
        ]
        if not any(np.any(c) for c in crossings(*ways)):
            return ways


def there(way, part):
    x = (1.0 - part) * way.start + part * way.end
    return Way(x, x, way.facets)


@pytest.mark.parametrize("dim, n", [(2, 400), (3, 400)])
def test_no_crossing_is_missed_and_each_meeting_begins_one(dim, n):
    rng, met = np.random.default_rng(dim), 0
    for _ in range(n):
        ways = random_ways(dim, rng)
        found = first_meeting(*ways)
        parts = np.linspace(0.0, 1.0, 101)
        crossed = [part for part in parts if np.any(crossings(*(there(way, part) for way in ways))[0])]
        if crossed:
            assert found is not None and found.part <= crossed[0]
        if found is not None and found.part < 1.0 - 1e-5:
            met += 1
            before, after = (crossings(*(there(way, found.part + d) for way in ways))[0] for d in (-1e-6, 1e-6))
            assert np.any(after) and not np.any(before)
    assert met > n / 10


def test_a_point_through_a_plate_thinner_than_a_thousandth_of_its_way_is_met_at_the_exact_time():
    plate = np.array([[-1.0, 0.0], [1.0, 0.0], [1.0, 1e-3], [-1.0, 1e-3]])
    plate = Way(plate, plate, SQUARE[1])
    body = SQUARE[0] * 0.1 + [0.3, 0.5]
    found = first_meeting(Way(body, body - [0.0, 5.0], SQUARE[1]), plate)
    assert found.part == pytest.approx((0.5 - 1e-3) / 5.0, abs=1e-12)
    np.testing.assert_allclose(found.place[1], 1e-3, atol=1e-12)


def test_edges_meet_where_no_corner_does():
    """Two bars crosswise: each end is far from the other's faces."""
    bar = np.array([[-1.0, -0.1, 0.0], [1.0, -0.1, 0.0], [0.0, 0.1, 0.0]])
    cross = bar[:, [1, 0, 2]] + [0.0, 0.0, 0.7]
    way = Way(cross, cross - [0.0, 0.0, 2.8], np.array([[0, 1, 2]]))
    found = first_meeting(Way(bar, bar, np.array([[0, 1, 2]])), way)
    assert found.part == pytest.approx(0.25, abs=1e-12)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-10, 1e-8])
def test_edges_that_stay_parallel_but_for_round_off_meet_nothing_far_away(noise):
    """Triangles that come near each other, straight, an edge of the one parallel to one of the other."""
    rng, facet = np.random.default_rng(1), np.array([[0, 1, 2]])
    for _ in range(500):
        along = rng.normal(0.0, 1.0, 3) * [1.0, 0.0, 1.0]
        still = np.array([[0.0, 0.0, 0.0], along, rng.uniform(-1.0, 1.0, 3) * [1.0, 0.0, 1.0]])
        over = [rng.uniform(-0.5, 0.5), 2.0, rng.uniform(-0.5, 0.5)]
        body = np.array([[0.0, 0.0, 0.0], rng.uniform(0.1, 0.9) * along, rng.uniform(-1.0, 1.0, 3)]) + over
        ways = [Way(x, x + d + rng.normal(0.0, noise, x.shape), facet) for x, d in ((body, [0, -0.5, 0]), (still, 0.0))]
        assert first_meeting(*ways) is None


def test_round_off_that_turns_an_edge_by_less_than_itself_meets_nothing():
    """Of a ball thrown at a box: an edge level with a diagonal, .36 above it, and a solver's round-off in the ways."""
    body = np.array([[0.5, 1.401, 0.5], [0.5, 1.4007071067811867, 0.5992928932188135],
                     [0.4007071067811866, 1.4007071067811867, 0.5]])  # fmt: skip
    way = np.array([[7.7838080425607359e-08, -0.49999944935898866, 7.7701605483149194e-08],
                    [-5.3403902966486783e-09, -0.49999936782532850, -2.4931681275042195e-07],
                    [1.0218764695535398e-07, -0.49999965657219769, 1.9069120937853512e-07]])  # fmt: skip
    box = np.array([[0.3, 1.037, 0.3], [0.7, 1.037, 0.3], [0.7, 1.037, 0.7]])
    facet = np.array([[0, 1, 2]])
    found = first_meeting(Way(body, body + way, facet), Way(box, box, facet))
    assert found.part == pytest.approx((1.401 - 1.037) / 0.5, abs=1e-5)


def test_a_small_thing_that_ends_wholly_inside_has_crossed():
    small = SQUARE[0] * 1e-3 + [0.5, 3.0]
    found = first_meeting(Way(small, small - [0.0, 2.5], SQUARE[1]), Way(SQUARE[0], SQUARE[0], SQUARE[1]))
    assert found.part == pytest.approx(2.0 / 2.5, abs=1e-12)


def test_drawn_in_surfaces_are_off_by_a_part_of_their_edges():
    points, facets = SQUARE
    edge = shortest_edges(points, facets)
    np.testing.assert_allclose(edge, 1.0)
    inner = drawn_in(points, facets, 0.01 * edge)
    np.testing.assert_allclose(inner, points + 0.01 / np.sqrt(2.0) * np.sign(0.5 - points))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [0.01, 0.5, 2.0, 3.0])
def test_bodies_turn_on_arcs(dim, angle):
    rng = np.random.default_rng(3)
    start, turn = rng.uniform(-1.0, 1.0, (20, dim)), np.array([0.0, 0.0, 1.0]) if dim == 2 else rng.normal(size=3)
    turn *= angle / np.linalg.norm(turn)

    def at(part):
        a = part * angle
        k = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]]) / angle
        rotation = (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k)[:dim, :dim]
        centre = start.mean(axis=0)
        return (start - centre) @ rotation.T + centre + part * 0.3

    slack = 1e-4
    turning = turn_of(start, at(1.0), np.full(dim, 0.3))
    n = straight_parts(start, turning, slack)
    places = stations(start, at(1.0), turning, n)
    assert len(places) == n + 1 and (n == 1) == (angle < 0.02)
    for k, x in enumerate(places):
        np.testing.assert_allclose(x, at(k / n), atol=1e-12)
    middle = [0.5 * (a + b) - at((k + 0.5) / n) for k, (a, b) in enumerate(zip(places[:-1], places[1:], strict=True))]
    assert np.linalg.norm(middle, axis=2).max() < 1.01 * slack


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.25, 1.0, 3.0])
@pytest.mark.parametrize("along", [0.0, 0.7])
def test_bodies_turn_about_pivots_far_from_their_centres(dim, angle, along):
    """Told by the direction in which they set out; in 3D they may go along the axis, too, as on a screw."""
    rng = np.random.default_rng(5)
    axis = np.array([0.0, 0.0, 1.0]) if dim == 2 else rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    pivot, start = rng.uniform(-4.0, 4.0, dim), rng.uniform(-0.1, 0.1, (20, dim))
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    drift = (along * axis)[:dim] * (dim == 3)

    def at(part):
        a = part * angle
        rotation = (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k)[:dim, :dim]
        return (start - pivot) @ rotation.T + pivot + part * drift

    sets_out = angle * k[:dim, :dim] @ (start.mean(axis=0) - pivot) + drift
    slack = 1e-5
    turning = turn_of(start, at(1.0), sets_out)
    n = max(straight_parts(start, turning, slack), 2)
    for part, x in zip(np.arange(n + 1) / n, stations(start, at(1.0), turning, n), strict=True):
        np.testing.assert_allclose(x, at(part), atol=2e-13 / min(angle, 1e-3) if angle < 0.1 else 1e-12)
    assert n > 2 or angle < 0.1
    # what flies straight and spins by the same angle has the same ends, and another way
    straight = turn_of(start, at(1.0), (at(1.0) - start).mean(axis=0))
    middle = stations(start, at(1.0), straight, 2)[1].mean(axis=0)
    np.testing.assert_allclose(middle, 0.5 * (start + at(1.0)).mean(axis=0), atol=1e-12)


def test_a_bar_that_turns_half_around_in_a_step_meets_what_its_chords_pass_by():
    """A bar of 2 x 0.1 turns by 3 rad; a pin at 0.9 above the centre is off all straight ways of its corners."""
    bar = (SQUARE[0] - 0.5) * [2.0, 0.1]
    pin = (SQUARE[0] - 0.5) * 1e-4 + [0.0, 0.9]
    c, s = np.cos(3.0), np.sin(3.0)
    end = bar @ np.array([[c, s], [-s, c]])
    turning = turn_of(bar, end, np.zeros(2))
    n = straight_parts(bar, turning, 1e-5)
    places = stations(bar, end, turning, n)
    ways = [Way(a, b, SQUARE[1]) for a, b in zip(places[:-1], places[1:], strict=True)]
    found = first_on_ways(ways, [Way(pin, pin, SQUARE[1])] * n)
    # its upper face reaches the pin's corner when the distance from the bar's axis is half its thickness
    x, y = pin[1]
    angle = np.arctan2(y, x) - np.arcsin(0.05 / np.hypot(x, y))
    assert found.part == pytest.approx(angle / 3.0, abs=1e-5)
    assert first_meeting(Way(bar, end, SQUARE[1]), Way(pin, pin, SQUARE[1])) is None


@pytest.mark.parametrize("outside", [False, True])
def test_depths_behind_a_square_and_behind_the_walls_of_a_square_room(outside):
    points, facets = SQUARE
    facets = facets[:, ::-1] if outside else facets
    found = depths(np.array([[0.5, 0.9], [0.5, 1.2], [2.0, 2.0]]), points, facets, outside)
    np.testing.assert_allclose(found, np.array([0.1, -0.2, -np.sqrt(2.0)]) * (-1.0 if outside else 1.0))
