"""Quadratic simplices: nodes in the middle of edges, and the linear simplices that stand for them where one only looks.

An element has its corners first, then the middles of ``EDGES`` in their order. Sides are straight.
"""

from __future__ import annotations

import numpy as np

#: The corners at the ends of each edge of a segment, a triangle and a tetrahedron.
EDGES = {
    1: np.array([[0, 1]]),
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]),
}
#: Four triangles; four tetrahedra at the corners and four around a diagonal of the octahedron between them.
_PARTS = {
    2: np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]),
    3: np.array(
        [[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3], [4, 9, 8, 5], [4, 9, 7, 8], [4, 9, 6, 7], [4, 9, 5, 6]]
    ),
}


def with_middles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points with the middles of all edges behind them, and the quadratic elements.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        m.
    cells : ndarray of int, shape (ne, dim + 1)

    Returns
    -------
    points : ndarray, shape (n + n_edges, dim)
    elements : ndarray of int, shape (ne, 6) in 2D, (ne, 10) in 3D
    """
    dim = points.shape[1]
    ends = np.sort(cells[:, EDGES[dim]].reshape(-1, 2), axis=1)
    edges, which = np.unique(ends, axis=0, return_inverse=True)
    middles = len(points) + which.reshape(len(cells), -1)
    return np.concatenate((points, points[edges].mean(axis=1))), np.concatenate((cells, middles), axis=1)


def facets_with_middles(facets: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return facets with the middles of their edges, where the elements have some.

    Parameters
    ----------
    facets : ndarray of int, shape (n, dim)
        Corners; every edge is one of the elements'.
    elements : ndarray of int, shape (ne, dim + 1), (ne, 6) or (ne, 10)

    Returns
    -------
    ndarray of int, shape (n, dim), or (n, 3) in 2D and (n, 6) in 3D
    """
    dim = facets.shape[1]
    if elements.shape[1] == dim + 1:
        return facets
    size = int(elements.max()) + 1

    def key(ends: np.ndarray) -> np.ndarray:
        return ends.min(axis=-1).astype(np.int64) * size + ends.max(axis=-1)

    keys = key(elements[:, EDGES[dim]]).ravel()
    order = np.argsort(keys)
    found = order[np.searchsorted(keys, key(facets[:, EDGES[dim - 1]]), sorter=order)]
    return np.concatenate((facets, elements[:, dim + 1 :].ravel()[found]), axis=1)


def linear_parts(elements: np.ndarray, dim: int) -> np.ndarray:
    """Return the 4 triangles or 8 tetrahedra of each quadratic element, oriented as it is, one element's in a row."""
    return elements[:, _PARTS[dim]].reshape(-1, dim + 1)
