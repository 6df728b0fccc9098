"""What a step does to each particle by itself: kick, drift, shift; and how fast and how far they go.

All work on this rank's rows, ghosts included: what they hold is fetched anew before it is read. Sums and maxima are of
owned rows alone.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Particles are shifted in full where what they see is full (see ``passes``), and not at all below the first of these.
EMPTY, FULL = 0.75, 0.95
#: Shifting moves a particle by this many s h |S| |v|.
SHIFT = 16.0
#: Slow is what goes at less than this part of the speed of sound.
SLOW = 0.01


@njit(cache=True)
def advance(x: np.ndarray, v: np.ndarray, t: float) -> None:
    """Add t v to x, both (n, dim): positions and velocities drift, velocities and accelerations kick."""
    flat, rates = x.reshape(-1), v.reshape(-1)
    for i in range(flat.size):
        flat[i] += t * rates[i]


@njit(cache=True)
def shift(x, v, sums, m, owned, h, s, slow, way):
    """Move particles from where they are crowded to where they are not, and add the sum of m times that to ``way``.

    By min(16 s h |S|, h/2) |v| along -S, and less where particles are slow: in still water shifting would feed the
    motion that it lives on.

    Parameters
    ----------
    x, v, sums : ndarray, shape (n, dim)
        ``sums`` is S, 1/m, see ``passes``; fading out towards free surfaces, see ``fade``.
    m : ndarray, shape (n,)
    owned : ndarray of bool, shape (n,)
    h, s, slow : float
        The step, s; the smoothing length, m; the speed below which they are shifted by |v|/slow times as much, m/s.
    way : ndarray, shape (dim,)
        kg m.

    References
    ----------
    A. Skillen, S. Lind, P. K. Stansby, B. D. Rogers, Comput. Meth. Appl. Mech. Eng. 265 (2013), 163: by local speed.
    """
    dim = x.shape[1]
    for i in range(x.shape[0]):
        size2, speed2 = 0.0, 0.0
        for axis in range(dim):
            size2 += sums[i, axis] * sums[i, axis]
            speed2 += v[i, axis] * v[i, axis]
        size = np.sqrt(size2)
        if size == 0.0:
            continue
        speed = np.sqrt(speed2)
        factor = -min(SHIFT * s * h, 0.5 * h / size) * speed * min(1.0, speed / slow)
        for axis in range(dim):
            d = factor * sums[i, axis]
            x[i, axis] += d
            if owned[i]:
                way[axis] += m[i] * d


@njit(cache=True)
def fade(sums: np.ndarray, full: np.ndarray, faded: np.ndarray) -> None:
    """Write S (n, dim) without what would spread a free surface, or spray: these have room on one side or all around.

    A switch at the surface alone, as by |S|, lets jets swell to several times their volume.
    """
    for i in range(sums.shape[0]):
        part = min(max((full[i] - EMPTY) / (FULL - EMPTY), 0.0), 1.0)
        for axis in range(sums.shape[1]):
            faded[i, axis] = sums[i, axis] * part


@njit(cache=True)
def accelerate(f: np.ndarray, m: np.ndarray, g: np.ndarray, a: np.ndarray) -> None:
    """Write a = f/m + g (n, dim)."""
    for i in range(f.shape[0]):
        for axis in range(f.shape[1]):
            a[i, axis] = f[i, axis] / m[i] + g[axis]


@njit(cache=True)
def momentum(m: np.ndarray, v: np.ndarray, owned: np.ndarray) -> np.ndarray:
    """Return the sum of m v over owned rows, shape (dim,)."""
    total = np.zeros(v.shape[1])
    for i in range(v.shape[0]):
        if owned[i]:
            for axis in range(v.shape[1]):
                total[axis] += m[i] * v[i, axis]
    return total


@njit(cache=True)
def kinetic(m: np.ndarray, v: np.ndarray, owned: np.ndarray) -> float:
    """Return the sum of m v^2 / 2 over owned rows."""
    total = 0.0
    for i in range(v.shape[0]):
        if owned[i]:
            v2 = 0.0
            for axis in range(v.shape[1]):
                v2 += v[i, axis] * v[i, axis]
            total += 0.5 * m[i] * v2
    return total


@njit(cache=True)
def total(m: np.ndarray, e: np.ndarray, owned: np.ndarray) -> float:
    """Return the sum of m e over owned rows."""
    found = 0.0
    for i in range(e.size):
        if owned[i]:
            found += m[i] * e[i]
    return found


@njit(cache=True)
def compression(m: np.ndarray, p: np.ndarray, rho: np.ndarray, rate: np.ndarray, owned: np.ndarray) -> float:
    """Return the power that rates of density store in owned rows, the sum of m p/rho^2 rate, W."""
    found = 0.0
    for i in range(p.size):
        if owned[i]:
            found += m[i] * p[i] / (rho[i] * rho[i]) * rate[i]
    return found


@njit(cache=True)
def extremes(v: np.ndarray, a: np.ndarray, rho: np.ndarray, owned: np.ndarray) -> tuple[float, float, float, float]:
    """Return the largest squares of v and a (n, dim) and the least and largest rho of owned rows; nan if one is not."""
    most = most_a = 0.0
    low, high = np.inf, -np.inf
    for i in range(rho.size):
        if owned[i]:
            v2 = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1]
            a2 = a[i, 0] * a[i, 0] + a[i, 1] * a[i, 1]
            if v.shape[1] == 3:
                v2, a2 = v2 + v[i, 2] * v[i, 2], a2 + a[i, 2] * a[i, 2]
            # a sum that is not finite must stay
            most, most_a = (most if v2 <= most else v2), (most_a if a2 <= most_a else a2)
            if not np.isfinite(v2 + a2):
                return np.nan, np.nan, np.nan, np.nan
            low, high = min(low, rho[i]), max(high, rho[i])
    return most, most_a, low, high


@njit(cache=True)
def farthest(x: np.ndarray, anchor: np.ndarray, owned: np.ndarray) -> float:
    """Return how far an owned row is from its anchor at most, m; nan if a place is not finite."""
    most = 0.0
    for i in range(x.shape[0]):
        if owned[i]:
            d, e = x[i, 0] - anchor[i, 0], x[i, 1] - anchor[i, 1]
            d2 = d * d + e * e
            if x.shape[1] == 3:
                d = x[i, 2] - anchor[i, 2]
                d2 += d * d
            if not d2 <= most:
                most = d2
                if not np.isfinite(d2):
                    return np.nan
    return np.sqrt(most)


@njit(cache=True)
def spread(x: np.ndarray, anchor: np.ndarray, first: np.ndarray, counts: np.ndarray) -> float:
    """Return how much the ways of two rows at most two cells apart differ at most, or a little more, m.

    That is the largest diagonal of a box that holds the ways of all rows in a cell and those around it. Cells of the
    halo are not at the middle: those are other ranks' own.

    Parameters
    ----------
    x, anchor : ndarray, shape (n, dim)
        Places of sorted rows now, and when they were sorted, m.
    first : ndarray of int64, shape (n_cells + 1,)
    counts : ndarray of int, shape (dim,)
        See ``Swarm``.
    """
    dim, layer = x.shape[1], (first.size - 1) // counts[0]
    # others hold nothing: layers of cells before the first that has a row, and after the last
    c0 = (np.searchsorted(first, first[0], side="right") - 1) // layer * layer
    n_cells = max((np.searchsorted(first, first[-1]) - 1) // layer * layer + layer - c0, 0)
    low, high = np.full((n_cells, dim), np.inf), np.full((n_cells, dim), -np.inf)
    for c in range(n_cells):
        for axis in range(dim):
            least, most = np.inf, -np.inf
            for i in range(first[c0 + c], first[c0 + c + 1]):
                way = x[i, axis] - anchor[i, axis]
                least, most = min(least, way), max(most, way)
            low[c, axis], high[c, axis] = least, most
    stride = 1
    for axis in range(dim - 1, -1, -1):
        _widen(low, high, stride)
        stride *= counts[axis]
    most = 0.0
    for c in range(n_cells):
        rest, size2, inner = c0 + c, 0.0, True
        for axis in range(dim - 1, -1, -1):
            rest, k = rest // counts[axis], rest % counts[axis]
            inner &= 0 < k < counts[axis] - 1
            size2 += max(high[c, axis] - low[c, axis], 0.0) ** 2
        if inner:
            most = max(most, size2)
    return np.sqrt(most)


@njit(cache=True)
def _widen(low, high, stride):
    """Let each box hold those so many places before and after it as well."""
    n, dim = low.shape
    for axis in range(dim):
        for begin in range(min(stride, n)):
            low_before, high_before = np.inf, -np.inf
            for c in range(begin, n, stride):
                low_here, high_here = low[c, axis], high[c, axis]
                after = c + stride if c + stride < n else c
                low[c, axis] = min(min(low_before, low_here), low[after, axis])
                high[c, axis] = max(max(high_before, high_here), high[after, axis])
                low_before, high_before = low_here, high_here
