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
def kick(v: np.ndarray, a: np.ndarray, t: float) -> None:
    """Add t a to the velocities v (n, dim)."""
    for i in range(v.shape[0]):
        for axis in range(v.shape[1]):
            v[i, axis] += t * a[i, axis]


@njit(cache=True)
def drift(x: np.ndarray, v: np.ndarray, t: float) -> None:
    """Add t v to the positions x (n, dim)."""
    for i in range(x.shape[0]):
        for axis in range(x.shape[1]):
            x[i, axis] += t * v[i, axis]


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


def fade(sums: np.ndarray, full: np.ndarray) -> np.ndarray:
    """Return S (n, dim) without what would spread a free surface, or spray: these have room on one side or all around.

    A switch at the surface alone, as by |S|, lets jets swell to several times their volume.
    """
    return sums * np.clip((full - EMPTY) / (FULL - EMPTY), 0.0, 1.0)[:, None]


@njit(cache=True)
def farthest(x: np.ndarray, anchor: np.ndarray, owned: np.ndarray) -> float:
    """Return how far an owned row is from its anchor at most, m; nan if a place is not finite."""
    most = 0.0
    for i in range(x.shape[0]):
        if owned[i]:
            d2 = 0.0
            for axis in range(x.shape[1]):
                d = x[i, axis] - anchor[i, axis]
                d2 += d * d
            if not d2 <= most:
                most = d2
                if not np.isfinite(d2):
                    return np.nan
    return np.sqrt(most)


@njit(cache=True)
def fastest(v: np.ndarray, owned: np.ndarray) -> float:
    """Return the largest length of the vectors v (n, dim) of owned rows; nan if one is not finite."""
    most = 0.0
    for i in range(v.shape[0]):
        if owned[i]:
            v2 = 0.0
            for axis in range(v.shape[1]):
                v2 += v[i, axis] * v[i, axis]
            if not v2 <= most:
                most = v2
                if not np.isfinite(v2):
                    return np.nan
    return np.sqrt(most)
