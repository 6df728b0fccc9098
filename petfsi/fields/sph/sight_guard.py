"""What goes through a thin facet that moves, and where it is put back: compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.sph.sight_cells import BEFORE, SAME
from petfsi.fields.sph.sight_lists import blocked_2d, blocked_3d, exactly, span, surely_2d, surely_3d


@njit(cache=True)
def minus(u, v):
    """Return u - v."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(cache=True)
def plus(u, t, v):
    """Return u + t v."""
    return u[0] + t * v[0], u[1] + t * v[1], u[2] + t * v[2]


@njit(cache=True)
def dot(u, v):
    """Return u . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True)
def in_space(x):
    """Return three coordinates of a point, in the plane z = 0 in 2D."""
    return x[0], x[1], x[2] if x.size == 3 else 0.0


@njit(cache=True)
def _frame(corner):
    """Return a facet's first corner and the way to the others; in 2D as that of a wall along z."""
    a, b = in_space(corner[0]), in_space(corner[1])
    if corner.shape[0] == 2:
        return a, minus(b, a), (0.0, 0.0, 1.0)
    return a, minus(b, a), minus(in_space(corner[2]), a)


@njit(cache=True)
def _weights(w, e, f):
    """Return the last two barycentric coordinates of the foot of a + w on the triangle a, a + e, a + f; if inside."""
    n = _cross(e, f)
    nn = dot(n, n)
    if nn == 0.0:
        return 0.0, 0.0, False
    s, t = dot(_cross(w, f), n) / nn, dot(_cross(e, w), n) / nn
    return s, t, min(s, t, 1.0 - s - t) >= -SAME


@njit(cache=True)
def _turning_points(c1, c2, c3):
    """Return where the derivative c1 + 2 c2 t + 3 c3 t^2 is zero, in order; 1 where it is not."""
    q = c2 * c2 - 3.0 * c1 * c3
    if q <= 0.0:
        return 1.0, 1.0
    q = -c2 - np.copysign(np.sqrt(q), c2)
    s = c1 / q if abs(c1) < abs(q) else 1.0
    t = q / (3.0 * c3) if abs(q) < abs(3.0 * c3) else 1.0
    return min(s, t), max(s, t)


@njit(cache=True)
def _passage(x0, x1, before, after, both):
    """Return when a particle first comes through a facet from before it, or, if ``both``, from any side.

    The height over the moving facet, times its area, is a polynomial of degree dim in time; at both ends it is taken
    from the places there, so that one drift begins as the one before ended.

    Returns
    -------
    t : float
        Part of the drift; 2 if it does not.
    from_front : bool
    s, w : float
        The last two barycentric coordinates of the place.
    """
    (a0, e0, f0), (a1, e1, f1) = _frame(before), _frame(after)
    w0, w1, n0 = minus(x0, a0), minus(x1, a1), _cross(e0, f0)
    at_0, at_1 = dot(w0, n0), dot(w1, _cross(e1, f1))
    dw, de, df = minus(w1, w0), minus(e1, e0), minus(f1, f0)
    n1, n2 = plus(_cross(de, f0), 1.0, _cross(e0, df)), _cross(de, df)
    c1, c2, c3 = dot(w0, n1) + dot(dw, n0), dot(w0, n2) + dot(dw, n1), dot(dw, n2)
    first, second = _turning_points(c1, c2, c3)
    begin, height = 0.0, at_0
    for end in (first, second, 1.0):
        if not begin < end <= 1.0:
            continue
        next_height = at_1 if end == 1.0 else at_0 + end * (c1 + end * (c2 + end * c3))
        front = height >= 0.0
        if front != (next_height >= 0.0) and (front or both):
            t, last = begin, end
            for _ in range(52):  # between turning points there is one root
                middle = 0.5 * (t + last)
                if (at_0 + middle * (c1 + middle * (c2 + middle * c3)) >= 0.0) == front:
                    t = middle
                else:
                    last = middle
            s, w, inside = _weights(plus(w0, t, dw), plus(e0, t, de), plus(f0, t, df))
            if inside:
                return t, front, s, w
        begin, height = end, next_height
    return 2.0, True, 0.0, 0.0


@njit(cache=True)
def cell_range(p, q, cells, dim, first, last):
    """Write from which to which cell the box around two points reaches; return whether it meets the grid."""
    for a in range(dim):
        s, t = (p[a] - cells.low[a]) * cells.inverse[a], (q[a] - cells.low[a]) * cells.inverse[a]
        if not (max(s, t) >= 0.0 and min(s, t) < cells.counts[a]):
            return False
        first[a], last[a] = span(s, t, cells.counts[a])
    return True


@njit(cache=True)
def _facets_near(p, q, cells, dim, found, mark, query):
    """Write the facets in the cells around two points, each once; return how many they are."""
    first, last, n = np.zeros(3, np.int64), np.zeros(3, np.int64), 0
    if cell_range(p, q, cells, dim, first, last):
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * cells.counts[1] + b) * cells.counts[2]
                for k in range(cells.start[line + first[2]], cells.start[line + last[2] + 1]):
                    f = cells.item[k]
                    if mark[f] != query:
                        mark[f], found[n] = query, f
                        n += 1
    return n


@njit(cache=True)
def touching(x0, x1, owned, cells):
    """Return the rows whose ways come into cells with facets."""
    rows, n, dim = np.empty(len(x0), np.int64), 0, x0.shape[1]
    low, inverse, counts, start, _ = cells
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(len(x0)):
        inside = owned[i]
        for a in range(dim):
            s, t = (x0[i, a] - low[a]) * inverse[a], (x1[i, a] - low[a]) * inverse[a]
            inside &= max(s, t) >= 0.0 and min(s, t) < counts[a]
            if not inside:
                break
            first[a], last[a] = span(s, t, counts[a])
        if not inside:
            continue
        some = False
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * counts[1] + b) * counts[2]
                some |= start[line + first[2]] < start[line + last[2] + 1]
        if some:
            rows[n] = i
            n += 1
    return rows[:n]


@njit(cache=True)
def _nearest_behind(x, found, after, both, reach):
    """Return the facet of a closed body next to a point, and where on it; -1 if the point is before it, or none is."""
    best, least, at, before = np.int64(-1), reach, (0.0, 0.0), False
    for f in found:
        if both[f]:
            continue
        a, e, g = _frame(after[f])
        n, w = _cross(e, g), minus(x, a)
        height, nn = dot(w, n), dot(n, n)
        if nn == 0.0 or height * height > least * least * nn:
            continue
        s, t, inside = _weights(w, e, g)
        if inside:
            distance = abs(height) / np.sqrt(nn)
            if distance < least or height >= 0.0 or (not before and f < best):
                best, least, at, before = np.int64(f), distance, (s, t), height >= 0.0
    return np.int64(-1) if before else best, at[0], at[1]


@njit(cache=True)
def _on_facet(before, after, s, t, dt):
    """Return where a place of a facet is at the end, a little inside of the rim, its velocity, and the unit normal."""
    (a0, e0, f0), (a1, e1, f1) = _frame(before), _frame(after)
    dim = after.shape[0]
    s = 0.99 * min(max(s, 0.0), 1.0) + 0.01 / dim
    t = 0.0 if dim == 2 else 0.99 * min(max(t, 0.0), 1.0) + 0.01 / dim
    y, start = plus(plus(a1, s, e1), t, f1), plus(plus(a0, s, e0), t, f0)
    n, u = _cross(e1, f1), minus(y, start)
    size = np.sqrt(dot(n, n))
    return y, (u[0] / dt, u[1] / dt, u[2] / dt), (n[0] / size, n[1] / size, n[2] / size)


@njit(cache=True)
def _first_passage(p, q, found, before, after, both):
    dim = before.shape[1]
    best, from_front, at, soonest = np.int64(-1), True, (0.0, 0.0), 2.0
    for f in found:
        apart = False
        for a in range(dim):
            low, high = before[f, 0, a], before[f, 0, a]
            for k in range(dim):
                low = min(low, before[f, k, a], after[f, k, a])
                high = max(high, before[f, k, a], after[f, k, a])
            more = SAME * (high - low)
            apart |= max(p[a], q[a]) < low - more or min(p[a], q[a]) > high + more
        if not apart:
            t, front, s, w = _passage(p, q, before[f], after[f], both[f])
            if t < soonest or (t == soonest and t < 2.0 and f < best):
                best, from_front, at, soonest = np.int64(f), front, (s, w), t
    return best, from_front, at[0], at[1]


@njit(cache=True)
def _is_inside(y, q, found, after, both):
    """Return whether the way from y crosses the surfaces of closed bodies an odd number of times."""
    odd = False
    for f in found:
        if both[f]:
            continue
        if after.shape[1] == 2:
            crosses = surely_2d(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        else:
            crosses = surely_3d(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        if crosses == 2:
            crosses = exactly(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        odd ^= crosses == 1
    return odd


@njit(cache=True)
def _is_blocked(p, q, cells, corners):
    if corners.shape[1] == 2:
        return blocked_2d(*p, *q, cells, corners) >= 0
    return blocked_3d(*p, *q, cells, corners) >= 0


@njit(cache=True)
def put_back(x0, x1, v, before, after, both, cells, dt, gap, reach):
    """Return the facet that each particle went through or is behind, else -1, its place, and its velocity."""
    dim = x0.shape[1]
    facet, x, v = np.full(len(x0), -1, np.int64), x1.copy(), v.copy()
    mark, found, query = np.full(len(before), -1, np.int64), np.empty(len(before), np.int64), 0
    for i in range(len(x0)):
        p, q = in_space(x0[i]), in_space(x1[i])
        n = _facets_near(p, q, cells, dim, found, mark, query)
        query += 1
        best, front, s, t = _first_passage(p, q, found[:n], before, after, both)
        if best < 0:
            best, s, t = _nearest_behind(q, found[:n], after, both, reach)
            if best >= 0:
                y, u, normal = _on_facet(before[best], after[best], s, t, dt)
                y = plus(y, BEFORE * gap, normal)
                n = _facets_near(y, q, cells, dim, found, mark, query)
                query += 1
                if not _is_inside(y, q, found[:n], after, both):
                    best = -1
        if best < 0:
            continue
        y, u, normal = _on_facet(before[best], after[best], s, t, dt)
        if not front:
            normal = minus((0.0, 0.0, 0.0), normal)
        step = gap
        near, there = plus(y, BEFORE * gap, normal), plus(y, gap, normal)
        while step > 1e-3 * gap and _is_blocked(near, there, cells, after):
            step *= 0.5
            there = plus(y, step, normal)
        speed = dot(minus(in_space(v[i]), u), normal)
        facet[i] = best
        for a in range(dim):
            x[i, a] = there[a]
            if speed < 0.0:
                v[i, a] -= 2.0 * speed * normal[a]
    return facet, x, v
