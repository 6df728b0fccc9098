"""Semi-Lagrangian advection on a staggered grid.

The new value at x is the old one where the flow was a time step ago, with the midpoint rule for the path,

    x_mid = x - dt/2 v(x),   x_dep = x - dt v(x_mid),   q_new(x) = q(x_dep) ,

or, where a path is followed for longer than for a fast flow, with Ralston's rule of third order,

    x_far = x - 3/4 dt v(x_mid),   x_dep = x - dt/9 (2 v(x) + 3 v(x_mid) + 4 v(x_far)) .

Everything here is in index units of the local arrays: cell i reaches from i to i + 1, displacements are multiples
of the cell size. The path follows velocities between grid points that are (bi-, tri-)linear; q at the departure point
is linear or, along each axis, Lagrange's cubic through the four points around it, which costs an error of dx^4 where
the linear one costs dx^2. Numba inlines the small functions itself, because left to LLVM they stay calls and a sweep
takes more than twice as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.mac.grid.rows import sum_of_rows


@njit(cache=True, inline="always")
def _clamp(s, low, high):
    """Return s within the bounds; not a number becomes ``low``, so that no index ever is wild."""
    if not s > low:
        return low
    return s if s < high else high


@njit(cache=True, inline="always")
def _interpolate(q, s0, s1, s2, flat):
    """Return q at a point, where q[i, j, k] is the value at the point (i, j, k)."""
    n0, n1, n2 = q.shape
    s0, s1 = _clamp(s0, 0.0, n0 - 1.0), _clamp(s1, 0.0, n1 - 1.0)
    i0, j0 = min(int(s0), n0 - 2), min(int(s1), n1 - 2)
    f0, f1 = s0 - i0, s1 - j0
    # unsigned, because numba tests signed indices for counting from the end
    i, j, i1, j1 = np.uint64(i0), np.uint64(j0), np.uint64(i0 + 1), np.uint64(j0 + 1)
    if flat:
        k = np.uint64(0)
        low = q[i, j, k] + f1 * (q[i, j1, k] - q[i, j, k])
        high = q[i1, j, k] + f1 * (q[i1, j1, k] - q[i1, j, k])
        return low + f0 * (high - low)
    s2 = _clamp(s2, 0.0, n2 - 1.0)
    k0 = min(int(s2), n2 - 2)
    f2 = s2 - k0
    k, k1 = np.uint64(k0), np.uint64(k0 + 1)
    a = q[i, j, k] + f2 * (q[i, j, k1] - q[i, j, k])
    b = q[i, j1, k] + f2 * (q[i, j1, k1] - q[i, j1, k])
    c = q[i1, j, k] + f2 * (q[i1, j, k1] - q[i1, j, k])
    d = q[i1, j1, k] + f2 * (q[i1, j1, k1] - q[i1, j1, k])
    a += f1 * (b - a)
    c += f1 * (d - c)
    return a + f0 * (c - a)


@njit(cache=True, inline="always")
def _weights(f):
    """Return the weights of Lagrange's cubic through the values at -1, 0, 1, 2."""
    below, above, beyond = f + 1.0, f - 1.0, f - 2.0
    product = below * f / 6.0
    return -f * above * beyond / 6.0, 0.5 * below * above * beyond, -3.0 * product * beyond, product * above


@njit(cache=True, inline="always")
def _line(q, i, j, b0, b1, b2, b3):
    """Return the sum of four values along the second axis of a plane grid, from j on."""
    k = np.uint64(0)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    return b0 * q[i, j, k] + b1 * q[i, j + one, k] + b2 * q[i, j + two, k] + b3 * q[i, j + three, k]


@njit(cache=True, inline="always")
def _cubic(q, s0, s1, s2, flat):
    """Return q at a point by cubics; at the array's ends through the four outermost points."""
    n0, n1, n2 = q.shape
    s0, s1 = _clamp(s0, 0.0, n0 - 1.0), _clamp(s1, 0.0, n1 - 1.0)
    i0, j0 = max(min(int(s0), n0 - 3), 1), max(min(int(s1), n1 - 3), 1)
    a0, a1, a2, a3 = _weights(s0 - i0)
    b0, b1, b2, b3 = _weights(s1 - j0)
    i, j = np.uint64(i0 - 1), np.uint64(j0 - 1)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    if flat:
        low = a0 * _line(q, i, j, b0, b1, b2, b3) + a1 * _line(q, i + one, j, b0, b1, b2, b3)
        high = a2 * _line(q, i + two, j, b0, b1, b2, b3) + a3 * _line(q, i + three, j, b0, b1, b2, b3)
        return low + high
    s2 = _clamp(s2, 0.0, n2 - 1.0)
    k0 = max(min(int(s2), n2 - 3), 1)
    return sum_of_rows(q, i0 - 1, j0 - 1, k0 - 1, (a0, a1, a2, a3), (b0, b1, b2, b3), _weights(s2 - k0))


@njit(cache=True)
def _within(value, q, s0, s1, s2, flat):
    """Return ``value`` moved between the least and the greatest of the grid points around s."""
    n0, n1, n2 = q.shape
    i = min(int(_clamp(s0, 0.0, n0 - 1.0)), n0 - 2)
    j = min(int(_clamp(s1, 0.0, n1 - 1.0)), n1 - 2)
    k = 0 if flat else min(int(_clamp(s2, 0.0, n2 - 1.0)), n2 - 2)
    least = most = q[i, j, k]
    for a in range(2):
        for b in range(2):
            for c in range(1 if flat else 2):
                corner = q[i + a, j + b, k + c]
                least, most = min(least, corner), max(most, corner)
    return min(max(value, least), most)


@njit(cache=True)
def velocity_at(u, v, w, s0, s1, s2, flat):
    """Return the velocity at a point in index units (cells reach from i to i + 1)."""
    a = _interpolate(u, s0, s1 - 0.5, s2 - 0.5, flat)
    b = _interpolate(v, s0 - 0.5, s1, s2 - 0.5, flat)
    c = 0.0 if flat else _interpolate(w, s0 - 0.5, s1 - 0.5, s2, flat)
    return a, b, c


@njit(cache=True, inline="always")
def _velocity_of(u, v, w, i, j, k, offset, flat):
    """Return the velocity at an entry of a sweep: of its own faces, or the mean of those around."""
    i, j, k = np.uint64(i), np.uint64(j), np.uint64(k)
    one = np.uint64(1)
    b = c = 0.0
    if offset[0] == 0.0:
        h = i - one
        a = u[i, j, k]
        b = 0.25 * ((v[h, j, k] + v[h, j + one, k]) + (v[i, j, k] + v[i, j + one, k]))
        if not flat:
            c = 0.25 * ((w[h, j, k] + w[h, j, k + one]) + (w[i, j, k] + w[i, j, k + one]))
    elif offset[1] == 0.0:
        h = j - one
        a = 0.25 * ((u[i, h, k] + u[i + one, h, k]) + (u[i, j, k] + u[i + one, j, k]))
        b = v[i, j, k]
        if not flat:
            c = 0.25 * ((w[i, h, k] + w[i, h, k + one]) + (w[i, j, k] + w[i, j, k + one]))
    elif offset[2] == 0.0:
        h = k - one
        a = 0.25 * ((u[i, j, h] + u[i + one, j, h]) + (u[i, j, k] + u[i + one, j, k]))
        b = 0.25 * ((v[i, j, h] + v[i, j + one, h]) + (v[i, j, k] + v[i, j + one, k]))
        c = w[i, j, k]
    else:
        a = 0.5 * (u[i, j, k] + u[i + one, j, k])
        b = 0.5 * (v[i, j, k] + v[i, j + one, k])
        if not flat:
            c = 0.5 * (w[i, j, k] + w[i, j, k + one])
    return a, b, c


@njit(cache=True, inline="always")
def track_back(u, v, w, i, j, k, offset, courant, long, low, high, reach, flat):
    """Return the begin of the path that ends at an entry, and the least and greatest coordinates on the way.

    The arguments are those of ``sweep``.
    """
    c0, c1, c2 = courant
    s0, s1, s2 = i + offset[0], j + offset[1], k + offset[2]
    a, b, c = _velocity_of(u, v, w, i, j, k, offset, flat)
    m0 = _clamp(s0 - 0.5 * c0 * a, low[0], high[0])
    m1 = _clamp(s1 - 0.5 * c1 * b, low[1], high[1])
    m2 = _clamp(s2 - 0.5 * c2 * c, low[2], high[2])
    l0, l1, l2 = min(s0, m0), min(s1, m1), min(s2, m2)
    g0, g1, g2 = max(s0, m0), max(s1, m1), max(s2, m2)
    am, bm, cm = velocity_at(u, v, w, m0, m1, m2, flat)
    if long:
        m0 = _clamp(s0 - 0.75 * c0 * am, low[0], high[0])
        m1 = _clamp(s1 - 0.75 * c1 * bm, low[1], high[1])
        m2 = _clamp(s2 - 0.75 * c2 * cm, low[2], high[2])
        l0, l1, l2 = min(l0, m0), min(l1, m1), min(l2, m2)
        g0, g1, g2 = max(g0, m0), max(g1, m1), max(g2, m2)
        al, bl, cl = velocity_at(u, v, w, m0, m1, m2, flat)
        am, bm, cm = (2 * a + 3 * am + 4 * al) / 9, (2 * b + 3 * bm + 4 * bl) / 9, (2 * c + 3 * cm + 4 * cl) / 9
    d0 = _clamp(s0 - c0 * am, low[0] - reach, high[0] + reach)
    d1 = _clamp(s1 - c1 * bm, low[1] - reach, high[1] + reach)
    d2 = _clamp(s2 - c2 * cm, low[2] - reach, high[2] + reach)
    return (d0, d1, d2), (min(l0, d0), min(l1, d1), min(l2, d2)), (max(g0, d0), max(g1, d1), max(g2, d2))


@njit(cache=True)
def sweep(q, out, moved, u, v, w, offset, part, courant, long, low, high, reach, cubic, bounded, limit, left):
    """Advect q by one step into ``out`` on a part of the grid.

    Parameters
    ----------
    q, out : ndarray
        Local arrays of faces or cells, old (with ghosts) and new.
    moved : ndarray of bool
        Where to advect; elsewhere ``out`` is left as it is.
    u, v, w : ndarray
        Face arrays of the velocity, ghosts valid; in 2D w is not read.
    offset : tuple of float
        Where entry (0, 0, 0) of q lies: 1/2 across the axes on which it is centred, 0 along that of faces.
    part : tuple of (int, int)
        Range of indices per axis to work on.
    courant : tuple of float
        dt / dx per axis; the displacement must not exceed four cells, or three if ``cubic``.
    long : bool
        Whether paths are of third order instead of second.
    low, high : tuple of float
        The domain (ghosts across ranks and periodic borders belong to it).
    reach : float
        How far beyond the domain a departure point may lie.
    cubic : bool
        How q is interpolated.
    bounded : bool
        Whether cubic values are kept between those of the grid points around.
    limit : float
        Cells along any axis that a path may go; where it goes farther, ``out`` is left as it is, too.
    left : ndarray of bool
        Cell array: marked where that is so.
    """
    flat = q.shape[2] == 1
    (b0, e0), (b1, e1), (b2, e2) = part
    h0, h1, h2 = offset
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if not moved[i, j, k]:
                    continue
                d, low_end, high_end = track_back(
                    u, v, w, i, j, k, offset, courant, long, low, high, reach, flat
                )  # fmt: skip
                d0, d1, d2 = d[0] - h0, d[1] - h1, d[2] - h2
                far = max(i + h0 - low_end[0], high_end[0] - i - h0, j + h1 - low_end[1], high_end[1] - j - h1)
                if not flat:
                    far = max(far, k + h2 - low_end[2], high_end[2] - k - h2)
                if not far <= limit:
                    left[i, j, k] = True
                elif cubic:
                    value = _cubic(q, d0, d1, d2, flat)
                    out[i, j, k] = _within(value, q, d0, d1, d2, flat) if bounded else value
                else:
                    out[i, j, k] = _interpolate(q, d0, d1, d2, flat)


@njit(cache=True)
def mark_read(read, there, but, u, v, w, offset, part, courant, low, high, reach, stencil):
    """Mark the entries that a sweep reads along paths of second order for some of those on a part of the grid.

    Parameters
    ----------
    read : ndarray of bool
        Marked.
    there, but : ndarray of bool
        For which; for which not.
    u, v, w, offset, part, courant, low, high, reach
        As for ``sweep``.
    stencil : int
        Entries on either side of a point that are read.
    """
    flat = there.shape[2] == 1
    (b0, e0), (b1, e1), (b2, e2) = part
    n0, n1, n2 = read.shape
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if not there[i, j, k] or but[i, j, k]:
                    continue
                (d0, d1, d2), _, _ = track_back(u, v, w, i, j, k, offset, courant, False, low, high, reach, flat)
                f0, f1 = int(np.floor(d0 - offset[0])), int(np.floor(d1 - offset[1]))
                f2 = 0 if flat else int(np.floor(d2 - offset[2]))
                for a in range(max(f0 - stencil + 1, 0), min(f0 + stencil, n0 - 1) + 1):
                    for b in range(max(f1 - stencil + 1, 0), min(f1 + stencil, n1 - 1) + 1):
                        for c in range(max(f2 - stencil + 1, 0), min(f2 + stencil, n2 - 1) + 1):
                            read[a, b, c] = True


@njit(cache=True)
def keep_own(out, own, read, u, v, w, offset, part, courant):
    """Add to what was advected what an entry has beyond the values that are read, as far as it has not flowed on.

    ``own - read`` belongs to single entries. Advected with linear interpolation it leaves  1 - |displacement|  of
    itself behind along each axis, in cells; what goes on is lost. So what stands still keeps all of it.

    Parameters
    ----------
    out : ndarray
        The result of sweeps.
    own, read : ndarray
        Before them.
    u, v, w, offset, part
        As for ``sweep``.
    courant : tuple of float
        Time / dx per axis, of all sweeps together.
    """
    flat = own.shape[2] == 1
    (b0, e0), (b1, e1), (b2, e2) = part
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                beyond = own[i, j, k] - read[i, j, k]
                if beyond == 0.0:
                    continue
                a, b, c = velocity_at(u, v, w, i + offset[0], j + offset[1], k + offset[2], flat)
                left = max(1.0 - abs(courant[0] * a), 0.0) * max(1.0 - abs(courant[1] * b), 0.0)
                if not flat:
                    left *= max(1.0 - abs(courant[2] * c), 0.0)
                out[i, j, k] += left * beyond


@njit(cache=True)
def largest(q):
    """Return the largest magnitude in an array; entries that are not numbers are passed over."""
    most = 0.0
    for value in q.ravel():
        most = max(most, abs(value))
    return most


@njit(cache=True)
def all_finite(q):
    """Return whether no entry of an array is infinite or not a number."""
    total = 0.0
    for value in q.ravel():
        total += value - value
    return total == 0.0
