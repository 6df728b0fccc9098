"""Which segments between particles, or to walls, cross a thin facet: compiled for 2 and for 3 dimensions."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.compiled import compiled_for
from petfsi.geometry.predicates import _exact_height, _sign_of_sum, _two_product, above, side

_HALF = np.uint64(32)


# bounds of the plain formulas' rounding errors, relative to products of the largest lengths
_ROUNDING_2D, _ROUNDING_3D = 8e-15, 4e-14
#: So many facets that hid pairs last are looked at first.
HIDING = {2: 4, 3: 4}


@njit(cache=True, inline="always")
def surely_2d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1; 2 if rounding might matter."""
    d0, d1 = q0 - p0, q1 - p1
    a0, a1, b0, b1 = corners[f, 0, 0] - p0, corners[f, 0, 1] - p1, corners[f, 1, 0] - p0, corners[f, 1, 1] - p1
    size = abs(d0) + abs(d1)
    bound = _ROUNDING_2D * (size + abs(a0) + abs(a1)) * (size + abs(b0) + abs(b1))
    # on which side of the line p q the corners are
    s, t = d0 * a1 - d1 * a0, d0 * b1 - d1 * b0
    if (s > bound and t > bound) or (s < -bound and t < -bound):
        return 0
    # on which side of the facet p and q are
    u = a0 * b1 - a1 * b0
    w = u + s - t
    if (u > bound and w > bound) or (u < -bound and w < -bound):
        return 0
    if min(abs(s), abs(t)) > bound and min(abs(u), abs(w)) > bound:
        return 1
    return 2


@njit(cache=True)
def _exactly_2d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f."""
    a0, a1, b0, b1 = corners[f, 0, 0], corners[f, 0, 1], corners[f, 1, 0], corners[f, 1, 1]
    if side(p0, p1, a0, a1, b0, b1, True) == side(q0, q1, a0, a1, b0, b1, True):
        return False
    # that p and q move by e is that the corners move by -e
    return side(-a0, -a1, -p0, -p1, -q0, -q1, True) != side(-b0, -b1, -p0, -p1, -q0, -q1, True)


@njit(cache=True, inline="always")
def surely_3d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1; 2 if rounding might matter."""
    d0, d1, d2 = q0 - p0, q1 - p1, q2 - p2
    a0, a1, a2 = corners[f, 0, 0] - p0, corners[f, 0, 1] - p1, corners[f, 0, 2] - p2
    b0, b1, b2 = corners[f, 1, 0] - p0, corners[f, 1, 1] - p1, corners[f, 1, 2] - p2
    c0, c1, c2 = corners[f, 2, 0] - p0, corners[f, 2, 1] - p1, corners[f, 2, 2] - p2
    size = abs(d0) + abs(d1) + abs(d2)
    size += max(abs(a0) + abs(a1) + abs(a2), abs(b0) + abs(b1) + abs(b2), abs(c0) + abs(c1) + abs(c2))
    bound = _ROUNDING_3D * size * size * size
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    # on which side of each edge the line p q passes
    s = d0 * n0 + d1 * n1 + d2 * n2
    t = d0 * (c1 * a2 - c2 * a1) + d1 * (c2 * a0 - c0 * a2) + d2 * (c0 * a1 - c1 * a0)
    u = d0 * (a1 * b2 - a2 * b1) + d1 * (a2 * b0 - a0 * b2) + d2 * (a0 * b1 - a1 * b0)
    low, high = min(s, t, u), max(s, t, u)
    if low < -bound and high > bound:
        return 0
    # on which side of the facet p and q are
    v = a0 * n0 + a1 * n1 + a2 * n2
    w = v - (s + t + u)
    if (v > bound and w > bound) or (v < -bound and w < -bound):
        return 0
    if (low > bound or high < -bound) and min(abs(v), abs(w)) > bound:
        return 1
    return 2


@njit(cache=True)
def _exactly_3d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f."""
    p, q, corner = np.array([p0, p1, p2]), np.array([q0, q1, q2]), corners[f]
    if above(p, corner) == above(q, corner):
        return False
    first = _past_edge(p, q, corner[0], corner[1])
    return first == _past_edge(p, q, corner[1], corner[2]) and first == _past_edge(p, q, corner[2], corner[0])


@njit(cache=True)
def exactly(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1."""
    if corners.shape[1] == 2:
        return int(_exactly_2d(p0, p1, p2, q0, q1, q2, corners, f))
    return int(_exactly_3d(p0, p1, p2, q0, q1, q2, corners, f))


@njit(cache=True)
def _past_edge(p, q, a, b):
    """Return the sign of det(q - p, a - p, b - p) for moved p and q; 0 only if p q and a b are parallel."""
    rows = np.empty((3, 3))
    rows[0], rows[1], rows[2] = p, q, a
    sign = _exact_height(b, rows)
    for k in range(3):
        if sign == 0:  # the derivative: (q - p) x (b - a) along each axis in turn
            i, j = (k + 1) % 3, (k + 2) % 3
            sign = _exact_cross(p[i], q[i], a[j], b[j], p[j], q[j], a[i], b[i])
    return sign


@njit(cache=True)
def _exact_cross(p0, q0, a1, b1, p1, q1, a0, b0):
    """Return the sign of (q0 - p0) (b1 - a1) - (q1 - p1) (b0 - a0)."""
    left, right = (q0, -q0, -p0, p0, -q1, q1, p1, -p1), (b1, a1, b1, a1, b0, a0, b0, a0)
    parts = np.empty(16)
    for i in range(8):
        parts[2 * i], parts[2 * i + 1] = _two_product(left[i], right[i])
    return _sign_of_sum(parts)


@njit(cache=True, inline="always")
def span(s, t, count):
    """Return the first and last of so many cells between s and t, in units of cells."""
    low, high = (s, t) if s < t else (t, s)
    return np.int64(np.floor(max(low, 0.0))), np.int64(np.floor(min(high, count - 0.5)))


@njit(cache=True, inline="always")
def _part(p, inverse, cell, only, begin, end):
    """Return between what t of ``begin`` to ``end`` the coordinate p + t / inverse is in a cell."""
    if only:
        return begin, end
    s, t = (cell - p) * inverse, (cell + 1 - p) * inverse
    return max(begin, min(s, t)), min(end, max(s, t))


def _compile_blocked(dim):
    @compiled_for(dim, error_model="numpy")
    def blocked(p0, p1, p2, q0, q1, q2, cells, corners):
        """Return a facet that crosses the segment from p to q, of those in the cells that it goes through, else -1."""
        low, inverse, counts, start, item = cells
        x, y, z = (p0 - low[0]) * inverse[0], (p1 - low[1]) * inverse[1], (p2 - low[2]) * inverse[2]
        d, e, f = (q0 - p0) * inverse[0], (q1 - p1) * inverse[1], (q2 - p2) * inverse[2]
        # where the segment is in one cell along an axis, its inverse is not needed
        inverse_d, inverse_e = 1.0 / d, 1.0 / e
        first, last = span(x, x + d, counts[0])
        only = np.floor(x) == np.floor(x + d)
        for a in range(first, last + 1):
            t0, t1 = _part(x, inverse_d, a, only, 0.0, 1.0)
            first_b, last_b = span(y + t0 * e, y + t1 * e, counts[1])
            # cells along the last axis are one run
            begin, end = a * counts[1] + first_b, a * counts[1] + last_b + 1
            for b in range(first_b if dim == 3 else last_b, last_b + 1):
                if dim == 3:
                    s0, s1 = _part(y, inverse_e, b, np.floor(y) == np.floor(y + e), t0, t1)
                    first_c, last_c = span(z + s0 * f, z + s1 * f, counts[2])
                    line = (a * counts[1] + b) * counts[2]
                    begin, end = line + first_c, line + last_c + 1
                if begin < end:
                    for k in range(start[begin], start[end]):
                        if dim == 2:
                            crosses = surely_2d(p0, p1, p2, q0, q1, q2, corners, item[k])
                        else:
                            crosses = surely_3d(p0, p1, p2, q0, q1, q2, corners, item[k])
                        if crosses == 2:
                            crosses = exactly(p0, p1, p2, q0, q1, q2, corners, item[k])
                        if crosses == 1:
                            return np.int64(item[k])
        return np.int64(-1)

    return blocked


# by their names: what closes over compiled functions is not found again in Numba's cache on disk
blocked_2d, blocked_3d = _compile_blocked(2), _compile_blocked(3)


def _compile_words(dim):
    @compiled_for(dim)
    def words(x, cells, clusters, reach, same):
        """Return the bits of where points may be: above (the lower half of a word) and below clusters."""
        low, inverse, counts, start, item = cells
        normal, slab, box, bit = clusters
        word = np.zeros(len(x), np.uint64)
        one = np.uint64(1)
        for i in range(len(x)):
            c, there = 0, True
            for a in range(dim):
                place = (x[i, a] - low[a]) * inverse[a]
                there &= 0.0 <= place < counts[a]
                c = c * counts[a] + np.int64(place if there else 0.0)
            if not there:
                continue
            for k in range(start[c], start[c + 1]):
                m = item[k]
                height = 0.0
                for a in range(dim):
                    height += normal[m, a] * x[i, a]
                near = slab[m, 0] - reach <= height <= slab[m, 1] + reach
                for a in range(dim):
                    near &= box[m, 0, a] - reach <= x[i, a] <= box[m, 1, a] + reach
                if near:
                    if height >= slab[m, 0] - same:
                        word[i] |= one << bit[m]
                    if height <= slab[m, 1] + same:
                        word[i] |= one << (bit[m] + _HALF)
        return word

    return words


WORDS = {dim: _compile_words(dim) for dim in (2, 3)}


def _compile_strike(dim):
    z, most = dim - 1, HIDING[dim]

    @compiled_for(dim)
    def strike(start, other, x, word, cells, corners):
        """Strike pairs of particles; return how many are left."""
        kept, begin = start[0], start[0]
        # what hid the last ones mostly hides the next, too
        hiding, n_hiding = np.zeros(most, np.int64), 0
        for i in range(len(start) - 1):
            end = start[i + 1]
            across = word[i] >> _HALF | word[i] << _HALF
            if across == 0:
                if kept != begin:
                    for k in range(begin, end):
                        other[kept + k - begin] = other[k]
                kept += end - begin
                begin, start[i + 1] = end, kept
                continue
            p0, p1, p2 = x[i, 0], x[i, 1], x[i, z]
            for k in range(begin, end):
                j = other[k]
                if across & word[j] != 0:
                    q0, q1, q2 = x[j, 0], x[j, 1], x[j, z]
                    h, crosses = 0, 0
                    while h < n_hiding:
                        if dim == 2:
                            crosses = surely_2d(p0, p1, p2, q0, q1, q2, corners, hiding[h])
                        else:
                            crosses = surely_3d(p0, p1, p2, q0, q1, q2, corners, hiding[h])
                        if crosses == 1:
                            break
                        h += 1
                    if h == n_hiding:
                        if dim == 2:
                            f = blocked_2d(p0, p1, p2, q0, q1, q2, cells, corners)
                        else:
                            f = blocked_3d(p0, p1, p2, q0, q1, q2, cells, corners)
                        if f < 0:
                            other[kept] = j
                            kept += 1
                            continue
                        n_hiding = min(n_hiding + 1, hiding.size)
                        h = n_hiding - 1
                    else:
                        f = hiding[h]
                    if h > 0:
                        hiding[h] = hiding[h // 2]
                        hiding[h // 2] = f
                    else:
                        hiding[0] = f
                else:
                    other[kept] = j
                    kept += 1
            begin, start[i + 1] = end, kept
        return kept

    return strike


STRIKE = {dim: _compile_strike(dim) for dim in (2, 3)}
