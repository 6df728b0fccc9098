"""Connected sets of numbered things, for kernels: ``parent`` starts as ``arange(n)``."""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def find(parent, i):
    """Return the root of a thing's set."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def join(parent, i, j):
    """Make two sets one; the lower root stays, so that the first thing met stands for its set."""
    i, j = find(parent, i), find(parent, j)
    parent[max(i, j)] = min(i, j)
