"""A convex polygon in the plane divided by segments into tiles, in each of which the same solids cover it.

Between the abscissas at which something begins, ends or crosses the segments lie one above the other; what is between
two of them there is a tile, a trapezoid. Axes are turned so that no edge is upright.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

#: Tiles side by side that share more than this of a border are of one area.
SHARED = 1e-11


class Tiles(NamedTuple):
    """The tiles of a polygon.

    Attributes
    ----------
    ends : ndarray, shape (n, 2)
        The abscissas between which each lies.
    height : ndarray, shape (n, 4)
        Ordinates of its lower line at both ends, then of its upper one.
    line : ndarray of int, shape (n, 2)
        The lower and upper line: an edge of the polygon, or the number of its edges plus that of a segment.
    depth : ndarray of int, shape (n,)
        How many solids cover it, less what is the same for all.
    area : ndarray of int, shape (n,)
        The first tile of the connected area of one depth that it belongs to.
    """

    ends: np.ndarray
    height: np.ndarray
    line: np.ndarray
    depth: np.ndarray
    area: np.ndarray


@njit(cache=True)
def _at(segment, u):
    """Return the ordinate of a line at an abscissa."""
    u0, v0, u1, v1 = segment[0], segment[1], segment[2], segment[3]
    if u <= u0:
        return v0
    if u >= u1:
        return v1
    return v0 + (u - u0) / (u1 - u0) * (v1 - v0)


@njit(cache=True)
def _abscissas(lines):
    """Return where lines begin, end and cross, ascending."""
    n = len(lines)
    found = np.empty(2 * n + n * n)
    m = 0
    for i in range(n):
        found[m], found[m + 1] = lines[i, 0], lines[i, 2]
        m += 2
    for i in range(n):
        for j in range(i):
            low, high = max(lines[i, 0], lines[j, 0]), min(lines[i, 2], lines[j, 2])
            if low >= high:
                continue
            first = _at(lines[i], low) - _at(lines[j], low)
            last = _at(lines[i], high) - _at(lines[j], high)
            if (first < 0.0 and last > 0.0) or (first > 0.0 and last < 0.0):
                found[m] = low + first / (first - last) * (high - low)
                m += 1
    return np.sort(found[:m])


@njit(cache=True)
def divide(polygon, segments, rise):
    """Return the tiles of a polygon.

    Parameters
    ----------
    polygon : ndarray, shape (n, 2)
        Its corners, in either sense.
    segments : ndarray, shape (m, 4)
        Abscissa and ordinate of both ends, left to right.
    rise : ndarray of int, shape (m,)
        By how much the depth grows across each segment, upwards.
    """
    n, m = len(polygon), len(segments)
    lines = np.empty((n + m, 4))
    for i in range(n):
        a, b = polygon[i], polygon[(i + 1) % n]
        if b[0] < a[0]:
            a, b = b, a
        lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3] = a[0], a[1], b[0], b[1]
    for i in range(m):
        lines[n + i] = segments[i]
    at = _abscissas(lines)
    room = len(at) * (m + 1)
    ends, height = np.empty((room, 2)), np.empty((room, 4))
    line, depth, area = np.empty((room, 2), np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    active, middle = np.empty(n + m, np.int64), np.empty(n + m)
    count = before = 0
    for s in range(len(at) - 1):
        u0, u1 = at[s], at[s + 1]
        if u1 <= u0:
            continue
        # the polygon's own edges below and above, the segments between
        k, mid, low, high = 0, 0.5 * (u0 + u1), -1, -1
        for i in range(n):
            if lines[i, 0] <= u0 and lines[i, 2] >= u1:
                if low < 0 or _at(lines[i], mid) < _at(lines[low], mid):
                    low = i
                if high < 0 or _at(lines[i], mid) > _at(lines[high], mid):
                    high = i
        if low < 0 or low == high:
            continue
        for i in range(n, n + m):
            if lines[i, 0] <= u0 and lines[i, 2] >= u1:
                v = _at(lines[i], mid)
                j = k
                while j > 0 and middle[j - 1] > v:
                    active[j], middle[j] = active[j - 1], middle[j - 1]
                    j -= 1
                active[j], middle[j] = i, v
                k += 1
        begin = count
        for j in range(k + 1):
            lower = low if j == 0 else active[j - 1]
            upper = high if j == k else active[j]
            ends[count, 0], ends[count, 1] = u0, u1
            line[count, 0], line[count, 1] = lower, upper
            for e in range(2):
                floor, top = _at(lines[low], ends[count, e]), _at(lines[high], ends[count, e])
                height[count, e] = min(max(_at(lines[lower], ends[count, e]), floor), top)
                height[count, 2 + e] = min(max(_at(lines[upper], ends[count, e]), floor), top)
            depth[count] = 0 if j == 0 else depth[count - 1] + rise[active[j - 1] - n]
            area[count] = count
            count += 1
        _fit(height, depth, area, before, begin, count)
        before = begin
    return Tiles(ends[:count].copy(), height[:count].copy(), line[:count].copy(), depth[:count].copy(), area[:count])


@njit(cache=True)
def _fit(height, depth, area, before, begin, end):
    """Shift the depth of the tiles of a slab to that of the one before, and join areas across the border."""
    if before == begin:
        return
    widest, shift = -1.0, 0
    for i in range(before, begin):
        for j in range(begin, end):
            shared = min(height[i, 3], height[j, 2]) - max(height[i, 1], height[j, 0])
            if shared > widest:
                widest, shift = shared, depth[i] - depth[j]
    for j in range(begin, end):
        depth[j] += shift
    for i in range(before, begin):
        for j in range(begin, end):
            shared = min(height[i, 3], height[j, 2]) - max(height[i, 1], height[j, 0])
            if shared > SHARED and depth[i] == depth[j]:
                a, b = i, j
                while area[a] != a:
                    a = area[a]
                while area[b] != b:
                    b = area[b]
                area[max(a, b)] = min(a, b)


@njit(cache=True)
def measure(tiles, k):
    """Return the area of a tile."""
    h = tiles.height[k]
    return 0.5 * (tiles.ends[k, 1] - tiles.ends[k, 0]) * (h[2] - h[0] + h[3] - h[1])


@njit(cache=True)
def tile_at(tiles, u, v):
    """Return the tile that holds a point, -1 if none does."""
    for k in range(len(tiles.ends)):
        u0, u1 = tiles.ends[k]
        if u0 <= u < u1:
            t = (u - u0) / (u1 - u0)
            h = tiles.height[k]
            if h[0] + t * (h[1] - h[0]) <= v < h[2] + t * (h[3] - h[2]):
                return k
    return -1
