"""Cells of a box and what touches them, for bodies thinner than particles see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

#: What hangs on a facet is looked at from this part of the way to it before it.
BEFORE = 1e-6
#: Places nearer than this part of a length are the same.
SAME = 1e-9
#: There are no more fine cells than this: they grow instead.
MOST_CELLS = 4_000_000


class _Cells(NamedTuple):
    """What touches the cells of a box: items ``item[start[c]:start[c + 1]]``; a third axis in 2D has one cell."""

    low: tuple[float, float, float]
    inverse: tuple[float, float, float]
    counts: tuple[int, int, int]
    start: np.ndarray
    item: np.ndarray


class Clusters(NamedTuple):
    """Facets of a coarse cell together: normal, heights of the planes, box, and bit."""

    normal: np.ndarray
    slab: np.ndarray
    box: np.ndarray
    bit: np.ndarray


def boxes_of(corners) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest places (k, dim) of facets that are at all these corners (k, dim, dim)."""
    low, high = _box(corners[0])
    for other in corners[1:]:
        also_low, also_high = _box(other)
        low, high = np.minimum(low, also_low), np.maximum(high, also_high)
    return low, high


@njit(cache=True)
def _box(corners):
    """Return the lowest and highest places (k, dim) of points (k, n, dim): NumPy is slow at rows of few."""
    low, high = corners[:, 0].copy(), corners[:, 0].copy()
    for k in range(corners.shape[0]):
        for i in range(1, corners.shape[1]):
            for a in range(corners.shape[2]):
                low[k, a], high[k, a] = min(low[k, a], corners[k, i, a]), max(high[k, a], corners[k, i, a])
    return low, high


@njit(cache=True)
def meeting(box_low, box_high, low, high):
    """Return which boxes meet another one."""
    found, n = np.empty(len(box_low), np.int64), 0
    for k in range(len(box_low)):
        meets = True
        for a in range(box_low.shape[1]):
            meets &= box_low[k, a] <= high[a] and box_high[k, a] >= low[a]
        if meets:
            found[n] = k
            n += 1
    return found[:n]


@njit(cache=True)
def mean_width(box_low, box_high):
    """Return the mean of the boxes' longest sides."""
    total = 0.0
    for k in range(len(box_low)):
        longest = 0.0
        for a in range(box_low.shape[1]):
            longest = max(longest, box_high[k, a] - box_low[k, a])
        total += longest
    return total / len(box_low)


def extent(x) -> np.ndarray:
    """Return the lowest and the highest place of points (n, dim), shape (2, dim)."""
    low, high = _box(np.ascontiguousarray(x)[None])
    return np.concatenate((low, high))


def fitting(length, wide: float, fine: int) -> tuple[float, np.ndarray]:
    """Return the side of a box's cells, ``wide`` unless they were too many then, and how many there are, shape (3,)."""
    counts = np.ones(3, dtype=np.int64)
    while True:
        wanted = np.ceil(np.maximum(length, SAME * wide) / wide)
        if np.prod(fine * wanted) <= MOST_CELLS:
            counts[: len(length)] = wanted
            return wide, counts
        wide *= 1.5


def sorted_into(low, wide: float, counts, box_low, box_high) -> _Cells:
    """Return the cells of a grid with the numbers of the boxes that touch them; a cell reaches a little farther."""
    n, dim = box_low.shape
    first, last = np.zeros((n, 3), np.int64), np.zeros((n, 3), np.int64)
    for out, box, more in ((first, box_low, -SAME), (last, box_high, SAME)):
        out[:, :dim] = np.clip(np.floor((box - low) / wide + more), 0, counts[:dim] - 1)
    rest = 3 - dim
    origin, inverse = (*map(float, low), *[0.0] * rest), (*[1.0 / wide] * dim, *[1.0] * rest)
    return _Cells(origin, inverse, tuple(map(int, counts)), *_bucket(first, last, counts))  # type: ignore[arg-type]


@njit(cache=True)
def _bucket(first, last, counts):
    """Return, by cell, the boxes that reach from cell ``first`` to ``last`` (n, 3), both included."""
    start = np.zeros(counts[0] * counts[1] * counts[2] + 2, np.int64)
    item = np.empty(0, np.int32)
    for filling in range(2):
        for k in range(len(first)):
            for a in range(first[k, 0], last[k, 0] + 1):
                for b in range(first[k, 1], last[k, 1] + 1):
                    line = (a * counts[1] + b) * counts[2]
                    for c in range(line + first[k, 2], line + last[k, 2] + 1):
                        if filling:
                            item[start[c + 1]] = k
                            start[c + 1] += 1
                        else:
                            start[c + 2] += 1
        if not filling:
            start[:] = np.cumsum(start)
            item = np.empty(start[-1], np.int32)
    return start[:-1], item


@njit(cache=True)
def normal_of(corner):
    """Return the normal of a facet (dim, dim) as three numbers, as long as a segment, or as twice the area."""
    e0, e1 = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1]
    if corner.shape[0] == 2:
        return e1, -e0, 0.0
    e2 = corner[1, 2] - corner[0, 2]
    f0, f1, f2 = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    return e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0


@njit(cache=True)
def hull(corners, order, first):
    """Return normal (n, dim), heights (n, 2) and box (n, 2, dim) of clusters ``order[first[c]:first[c + 1]]``."""
    n, dim = len(first) - 1, corners.shape[1]
    normal, slab, box = np.zeros((n, dim)), np.empty((n, 2)), np.empty((n, 2, dim))
    for c in range(n):
        mine = normal[c]
        for f in order[first[c] : first[c + 1]]:
            one = normal_of(corners[f])
            same = 0.0
            for a in range(dim):
                same += one[a] * mine[a]
            for a in range(dim):
                mine[a] += one[a] if same >= 0.0 else -one[a]
        # two neighbours share a bit more often to their use if their normals agree
        mine *= np.sign(mine[np.argmax(np.abs(mine))]) / max(np.sqrt(np.sum(mine**2)), 1e-300)
        slab[c], box[c, 0], box[c, 1] = (np.inf, -np.inf), np.inf, -np.inf
        for f in order[first[c] : first[c + 1]]:
            for k in range(dim):
                height = 0.0
                for a in range(dim):
                    height += mine[a] * corners[f, k, a]
                    box[c, 0, a] = min(box[c, 0, a], corners[f, k, a])
                    box[c, 1, a] = max(box[c, 1, a], corners[f, k, a])
                slab[c, 0], slab[c, 1] = min(slab[c, 0], height), max(slab[c, 1], height)
    return normal, slab, box
