"""When facets whose points move straight first meet: points with facets, and edges with edges.

With A, B and C the differences of four points that move straight, det(A, B, C) is a cubic of time that vanishes where
they lie in one plane (of three points in 2D the quadratic A x B, in one line). Between surfaces that do not cross
something always meets at such a time: a corner of the one and a facet of the other, or, in 3D, two edges.

References
----------
X. Provot, Graphics Interface (1997): points that move straight, and their cubic. R. Bridson, R. Fedkiw, J. Anderson,
ACM Trans. Graph. 21 (2002). C. Ericson, Real-Time Collision Detection (2005), 7.4: sorted boxes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

#: What is beyond the end of an edge by this part of it counts: points must not pass between neighbouring facets.
BEYOND = 1e-9
#: Edges whose sine is less meet in their ends; the square of a lesser one is round-off of lengths.
PARALLEL = 1e-7
#: What is farther apart than this part of all lengths does not meet: of points that stay in one plane (line), the cubic
#: is round-off, and so are its roots.
APART = 1e-6
#: So many bisections leave no more than round-off.
BISECTIONS = 52
#: Corners, in a pair of triangles, of a point and a triangle, and of two edges.
_MEETINGS_3D = np.array(
    [(i, 3, 4, 5) for i in range(3)]
    + [(i, 0, 1, 2) for i in range(3, 6)]
    + [(i, (i + 1) % 3, 3 + j, 3 + (j + 1) % 3) for i in range(3) for j in range(3)]
)
#: Of a point and a segment in a pair of segments.
_MEETINGS_2D = np.array([(0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1)])


class Way(NamedTuple):
    """A surface whose points move straight.

    Attributes
    ----------
    start, end : ndarray, shape (n, dim)
        m.
    facets : ndarray of int, shape (m, dim)
    """

    start: np.ndarray
    end: np.ndarray
    facets: np.ndarray


class Meeting(NamedTuple):
    """Where surfaces meet first: the part of the way, 0 to 1, and the place, m."""

    part: float
    place: np.ndarray


def first_meeting(one: Way, other: Way) -> Meeting | None:
    """Return where two surfaces that do not cross meet first on their way; None if they do not. Not collective."""
    pairs = near_pairs(one, other)
    if not len(pairs):
        return None
    place = np.zeros(one.start.shape[1])
    meetings = _MEETINGS_2D if len(place) == 2 else _MEETINGS_3D
    ends = [[_rows(x) for x in (way.start, way.end)] for way in (one, other)]
    part = _first_meeting(
        ends[0][0], ends[0][1], ends[1][0], ends[1][1], one.facets, other.facets, pairs, meetings, place
    )
    return Meeting(part, place) if part <= 1.0 else None


def crossings(one: Way, other: Way) -> tuple[np.ndarray, np.ndarray]:
    """Return which facets of either surface cross one of the other where they start, shapes (m,). Not collective."""
    pairs = near_pairs(one, other)
    corners = [np.ascontiguousarray(way.start[way.facets], dtype=float) for way in (one, other)]
    crosses = np.zeros(len(pairs), dtype=bool)
    if one.start.shape[1] == 2:
        _crossings_2d(corners[0], corners[1], pairs, crosses)
    else:
        _crossings_3d(corners[0], corners[1], pairs, crosses)
    found = [np.zeros(len(way.facets), dtype=bool) for way in (one, other)]
    for n in range(2):
        found[n][pairs[crosses, n]] = True
    return found[0], found[1]


def near_pairs(one: Way, other: Way) -> np.ndarray:
    """Return the pairs of facets whose boxes meet on their way, one of each surface, shape (k, 2)."""
    n, dim = len(one.facets), one.start.shape[1]
    low, high = np.empty((n + len(other.facets), dim)), np.empty((n + len(other.facets), dim))
    bounds = []
    for way, part in ((one, slice(n)), (other, slice(n, None))):
        _boxes(_rows(way.start), _rows(way.end), way.facets, low[part], high[part])
        bounds.append((low[part].min(axis=0, initial=np.inf), high[part].max(axis=0, initial=-np.inf)))
    begin, end = np.maximum(bounds[0][0], bounds[1][0]), np.minimum(bounds[0][1], bounds[1][1])
    kept = np.flatnonzero(np.all((low <= end) & (high >= begin), axis=1))
    # along the axis along which boxes overlap least
    crowd = (high[kept] - low[kept]).sum(axis=0) / np.maximum(end - begin, 1e-300)
    axis = int(np.argmin(crowd))
    return _sweep(low, high, n, axis, kept[np.argsort(low[kept, axis], kind="stable")])


def _rows(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x, dtype=float)


@njit(cache=True)
def any_within(points, facets, low, high):
    """Whether the box of any facet meets a box."""
    for f in facets:
        meets = True
        for a in range(points.shape[1]):
            least = most = points[f[0], a]
            for i in f[1:]:
                least, most = min(least, points[i, a]), max(most, points[i, a])
            meets = meets and least <= high[a] and most >= low[a]
        if meets:
            return True
    return False


@njit(cache=True)
def _boxes(start, end, facets, low, high):
    """Fill the corners of the box that each facet stays in."""
    for f in range(len(facets)):
        for a in range(start.shape[1]):
            least, most = np.inf, -np.inf
            for i in facets[f]:
                least = min(least, min(start[i, a], end[i, a]))
                most = max(most, max(start[i, a], end[i, a]))
            low[f, a], high[f, a] = least, most


@njit(cache=True)
def _sweep(low, high, n, axis, order):
    """Return pairs of boxes that meet, one of the first n; ``order`` sorts their low ends along an axis."""
    found, k = np.empty((64, 2), dtype=np.int64), 0
    for a in range(len(order)):
        i = order[a]
        for b in range(a + 1, len(order)):
            j = order[b]
            if low[j, axis] > high[i, axis]:
                break
            if (i < n) == (j < n):
                continue
            meets = True
            for c in range(low.shape[1]):
                meets = meets and low[j, c] <= high[i, c] and low[i, c] <= high[j, c]
            if not meets:
                continue
            if k == len(found):
                more = np.empty((2 * k, 2), dtype=np.int64)
                more[:k] = found
                found = more
            found[k, 0], found[k, 1] = min(i, j), max(i, j) - n
            k += 1
    return found[:k]


# ---- on the way ---------------------------------------------------------------------------------------------


@njit(cache=True)
def _first_meeting(start, end, start_b, end_b, facets, facets_b, pairs, meetings, place):
    """Return the least part of the way at which any pair of facets meets, 2 if none does, and fill the place."""
    dim = start.shape[1]
    first, roots = 2.0, np.empty(3)
    x0, x1, x = np.empty((2 * dim, dim)), np.empty((2 * dim, dim)), np.empty((2 * dim, dim))
    for k in range(len(pairs)):
        for i in range(dim):
            f, g = facets[pairs[k, 0], i], facets_b[pairs[k, 1], i]
            for a in range(dim):
                x0[i, a], x1[i, a] = start[f, a], end[f, a]
                x0[dim + i, a], x1[dim + i, a] = start_b[g, a], end_b[g, a]
        for corners in meetings:
            for r in range(_flat_times(x0, x1, corners, roots)):
                t = roots[r]
                if t >= first:
                    break
                for i in corners:
                    for a in range(dim):
                        x[i, a] = (1.0 - t) * x0[i, a] + t * x1[i, a]
                if _meet(x, corners):
                    first = t
                    s = _edge_weights(x, corners)[0] if _are_edges(corners) else 0.0
                    for a in range(dim):
                        place[a] = (1.0 - s) * x[corners[0], a] + s * x[corners[1], a]
                    break
    return first


@njit(cache=True)
def _are_edges(corners):
    return len(corners) == 4 and corners[0] < 3 and corners[1] < 3


@njit(cache=True)
def _flat_times(x0, x1, corners, roots):
    """Fill the times at which points lie in one plane (line), ascending, and return their number."""
    p, q = corners[0], corners[1]
    if len(corners) == 3:
        r = corners[2]
        b0, b2 = _turn(x0, x0, p, q, r), _turn(x1, x1, p, q, r)
        middle = 0.5 * (_turn(x0, x1, p, q, r) + _turn(x1, x0, p, q, r))
        return _roots(b0, (b0 + 2.0 * middle) / 3.0, (b2 + 2.0 * middle) / 3.0, b2, roots)
    b0, b3 = _volume(x0, x0, x0, corners), _volume(x1, x1, x1, corners)
    b1 = _volume(x1, x0, x0, corners) + _volume(x0, x1, x0, corners) + _volume(x0, x0, x1, corners)
    b2 = _volume(x0, x1, x1, corners) + _volume(x1, x0, x1, corners) + _volume(x1, x1, x0, corners)
    return _roots(b0, b1 / 3.0, b2 / 3.0, b3, roots)


@njit(cache=True)
def _turn(x, y, p, q, r):
    """Return (x_p - x_q) x (y_r - y_q)."""
    return (x[p, 0] - x[q, 0]) * (y[r, 1] - y[q, 1]) - (x[p, 1] - x[q, 1]) * (y[r, 0] - y[q, 0])


@njit(cache=True)
def _volume(x, y, z, corners):
    """Return det(x_b - x_a, y_c - y_a, z_d - z_a), of edges a b and c d det(x_b - x_a, y_c - y_a, z_d - z_c)."""
    p, q, r, s = corners[0], corners[1], corners[2], corners[3]
    last = r if p < 3 and q < 3 else p
    ax, ay, az = x[q, 0] - x[p, 0], x[q, 1] - x[p, 1], x[q, 2] - x[p, 2]
    bx, by, bz = y[r, 0] - y[p, 0], y[r, 1] - y[p, 1], y[r, 2] - y[p, 2]
    cx, cy, cz = z[s, 0] - z[last, 0], z[s, 1] - z[last, 1], z[s, 2] - z[last, 2]
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)


@njit(cache=True)
def _roots(b0, b1, b2, b3, roots):
    """Fill where a cubic, by its Bernstein coefficients, changes its sign on [0, 1], ascending; return how often."""
    least, most = min(min(b0, b1), min(b2, b3)), max(max(b0, b1), max(b2, b3))
    if least > 0.0 or most < 0.0 or least == most:
        return 0
    # where it is monotone: between the roots of its derivative a t^2 + 2 b t + c
    c, b, a = b1 - b0, b2 - 2.0 * b1 + b0, b3 - 3.0 * b2 + 3.0 * b1 - b0
    knots, n = np.empty(4), 1
    knots[0] = 0.0
    under = b * b - a * c
    if under > 0.0:
        q = -(b + np.sqrt(under)) if b > 0.0 else -b + np.sqrt(under)
        s, t = q / a if a != 0.0 else -1.0, c / q if q != 0.0 else -1.0
        for u in (min(s, t), max(s, t)):
            if 0.0 < u < 1.0:
                knots[n] = u
                n += 1
    knots[n] = 1.0
    count, before = 0, b0
    for k in range(n):
        after = _cubic(b0, b1, b2, b3, knots[k + 1])
        if before * after <= 0.0 and before != after:
            roots[count] = _bisected(b0, b1, b2, b3, knots[k], knots[k + 1], before)
            count += 1
        before = after
    return count


@njit(cache=True)
def _cubic(b0, b1, b2, b3, t):
    s = 1.0 - t
    return s * s * (s * b0 + 3.0 * t * b1) + t * t * (3.0 * s * b2 + t * b3)


@njit(cache=True)
def _bisected(b0, b1, b2, b3, low, high, at_low):
    if at_low == 0.0:
        return low
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if (_cubic(b0, b1, b2, b3, middle) > 0.0) == (at_low > 0.0):
            low = middle
        else:
            high = middle
    return low


@njit(cache=True)
def _meet(x, corners):
    """Whether points in one plane (line) are a point on a facet, or edges that meet."""
    if len(corners) == 3:
        p, a, b = corners[0], corners[1], corners[2]
        along, length2 = _dot(x, p, a, b, a), _dot(x, b, a, b, a)
        if not -BEYOND * length2 <= along <= (1.0 + BEYOND) * length2 or length2 == 0.0:
            return False
        return _touch(x, p, p, 0.0, a, b, along / length2, b, 0.0)
    if _are_edges(corners):
        p, q, a, b = corners[0], corners[1], corners[2], corners[3]
        s, t = _edge_weights(x, corners)
        if not (-BEYOND <= s <= 1.0 + BEYOND and -BEYOND <= t <= 1.0 + BEYOND):
            return False
        return _touch(x, p, q, s, a, b, t, b, 0.0)
    p, a, b, c = corners[0], corners[1], corners[2], corners[3]
    ee, eg, gg = _dot(x, b, a, b, a), _dot(x, b, a, c, a), _dot(x, c, a, c, a)
    re, rg = _dot(x, p, a, b, a), _dot(x, p, a, c, a)
    det = ee * gg - eg * eg
    s, t = gg * re - eg * rg, ee * rg - eg * re
    if not (det > 0.0 and s >= -BEYOND * det and t >= -BEYOND * det and s + t <= (1.0 + BEYOND) * det):
        return False
    return _touch(x, p, p, 0.0, a, b, s / det, c, t / det)


@njit(cache=True)
def _touch(x, p, q, s, a, b, t, c, u):
    """Whether p + s (q - p) is as good as a + t (b - a) + u (c - a)."""
    gap = size = 0.0
    for k in range(x.shape[1]):
        pq, ab, ac, pa = x[q, k] - x[p, k], x[b, k] - x[a, k], x[c, k] - x[a, k], x[p, k] - x[a, k]
        gap += (pa + s * pq - t * ab - u * ac) ** 2
        size += pa**2 + pq**2 + ab**2 + ac**2
    return gap <= APART**2 * size


@njit(cache=True)
def _edge_weights(x, corners):
    """Return where on the lines of two edges they are nearest, 0 to 1 on the edges; beyond if they are parallel."""
    p, q, r, s = corners[0], corners[1], corners[2], corners[3]
    ee, eg, gg = _dot(x, q, p, q, p), _dot(x, q, p, s, r), _dot(x, s, r, s, r)
    we, wg = _dot(x, p, r, q, p), _dot(x, p, r, s, r)
    det = ee * gg - eg * eg
    if det <= PARALLEL**2 * ee * gg:
        return -1.0, -1.0
    return (eg * wg - gg * we) / det, (ee * wg - eg * we) / det


@njit(cache=True)
def _dot(x, a, b, c, d):
    """Return (x_a - x_b) . (x_c - x_d)."""
    total = 0.0
    for k in range(x.shape[1]):
        total += (x[a, k] - x[b, k]) * (x[c, k] - x[d, k])
    return total


# ---- where they stand ---------------------------------------------------------------------------------------


@njit(cache=True)
def _crossings_2d(one, other, pairs, crosses):
    """Mark pairs of segments (n, 2, 2) that cross."""
    x = np.empty((4, 2))
    for k in range(len(pairs)):
        x[:2], x[2:] = one[pairs[k, 0]], other[pairs[k, 1]]
        astride = _turn(x, x, 0, 2, 3) * _turn(x, x, 1, 2, 3) < 0.0
        crosses[k] = astride and _turn(x, x, 2, 0, 1) * _turn(x, x, 3, 0, 1) < 0.0


@njit(cache=True)
def _crossings_3d(one, other, pairs, crosses):
    """Mark pairs of triangles (n, 3, 3) of which an edge of one goes through the other."""
    x = np.empty((6, 3))
    for k in range(len(pairs)):
        x[:3], x[3:] = one[pairs[k, 0]], other[pairs[k, 1]]
        for i in range(3):
            j = (i + 1) % 3
            crosses[k] = crosses[k] or _pierces(x, i, j, 3) or _pierces(x, 3 + i, 3 + j, 0)


@njit(cache=True)
def _pierces(x, p, q, first):
    """Whether the edge from p to q goes through the triangle of the points from ``first``."""
    if _side(x, first, first + 1, first + 2, p) * _side(x, first, first + 1, first + 2, q) >= 0.0:
        return False
    positive, negative = True, True
    for i in range(3):
        turn = _side(x, p, q, first + i, first + (i + 1) % 3)
        positive, negative = positive and turn > 0.0, negative and turn < 0.0
    return positive or negative


@njit(cache=True)
def _side(x, a, b, c, d):
    """Return det(x_b - x_a, x_c - x_a, x_d - x_a)."""
    total = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        cross = (x[c, i] - x[a, i]) * (x[d, j] - x[a, j]) - (x[c, j] - x[a, j]) * (x[d, i] - x[a, i])
        total += (x[b, k] - x[a, k]) * cross
    return total
