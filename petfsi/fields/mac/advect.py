"""Semi-Lagrangian advection on a staggered grid.

The new value at x is the old one where the flow was a time step ago, with the midpoint rule for the path:

    x_mid = x - dt/2 v(x),   x_dep = x - dt v(x_mid),   q_new(x) = q(x_dep) .

Everything here is in index units of the local arrays: cell i reaches from i to i + 1, displacements are multiples
of the cell size. Values between grid points are (bi-, tri-)linear. Numba inlines the small functions itself, because
left to LLVM they stay calls and a sweep takes more than twice as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit


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


@njit(cache=True)
def velocity_at(u, v, w, s0, s1, s2, flat):
    """Return the velocity at a point in index units (cells reach from i to i + 1)."""
    a = _interpolate(u, s0, s1 - 0.5, s2 - 0.5, flat)
    b = _interpolate(v, s0 - 0.5, s1, s2 - 0.5, flat)
    c = 0.0 if flat else _interpolate(w, s0 - 0.5, s1 - 0.5, s2, flat)
    return a, b, c


@njit(cache=True)
def sweep(q, out, moved, u, v, w, offset, part, courant, low, high, reach):
    """Advect q by one step into ``out`` on a part of the grid.

    Parameters
    ----------
    q, out : ndarray
        Local arrays of faces or cells, old (with ghosts) and new.
    moved : ndarray of bool
        Where to advect; elsewhere ``out`` is q.
    u, v, w : ndarray
        Face arrays of the velocity, ghosts valid; in 2D w is not read.
    offset : tuple of float
        Where entry (0, 0, 0) of q lies: 1/2 across the axes on which it is centred, 0 along that of faces.
    part : tuple of (int, int)
        Range of indices per axis to work on.
    courant : tuple of float
        dt / dx per axis; the displacement must not exceed four cells.
    low, high : tuple of float
        The domain (ghosts across ranks and periodic borders belong to it).
    reach : float
        How far beyond the domain a departure point may lie.
    """
    flat = q.shape[2] == 1
    (b0, e0), (b1, e1), (b2, e2) = part
    c0, c1, c2 = courant
    h0, h1, h2 = offset
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if not moved[i, j, k]:
                    out[i, j, k] = q[i, j, k]
                    continue
                s0, s1, s2 = i + h0, j + h1, k + h2
                a, b, c = velocity_at(u, v, w, s0, s1, s2, flat)
                m0 = _clamp(s0 - 0.5 * c0 * a, low[0], high[0])
                m1 = _clamp(s1 - 0.5 * c1 * b, low[1], high[1])
                m2 = _clamp(s2 - 0.5 * c2 * c, low[2], high[2])
                a, b, c = velocity_at(u, v, w, m0, m1, m2, flat)
                d0 = _clamp(s0 - c0 * a, low[0] - reach, high[0] + reach)
                d1 = _clamp(s1 - c1 * b, low[1] - reach, high[1] + reach)
                d2 = _clamp(s2 - c2 * c, low[2] - reach, high[2] + reach)
                out[i, j, k] = _interpolate(q, d0 - h0, d1 - h1, d2 - h2, flat)


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
