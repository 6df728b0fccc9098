"""Quadrature and shape functions of simplices of one to three dimensions, linear and quadratic."""

from __future__ import annotations

import numpy as np
from scipy.special import roots_jacobi

#: The corners between which the middle nodes of a quadratic simplex lie, in their order behind the corners.
EDGES = {
    1: np.array([[0, 1]]),
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]),
}


def simplex_rule(dim: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return n^dim points, exact up to degree 2 n - 1: a cube's Gauss points, drawn together into the simplex.

    Returns
    -------
    points : ndarray, shape (n**dim, dim + 1)
        Barycentric coordinates.
    weights : ndarray, shape (n**dim,)
        Their sum is 1 / dim!.

    References
    ----------
    A. H. Stroud, Approximate Calculation of Multiple Integrals (1971), section 2.4.
    """
    points, weights = np.zeros((1, 0)), np.ones(1)
    for axis in range(dim):
        power = dim - 1 - axis
        x, w = roots_jacobi(n, power, 0)
        new = (1 - points.sum(axis=1))[:, None] * (1 + x) / 2
        points = np.column_stack((np.repeat(points, n, axis=0), new.ravel()))
        weights = np.outer(weights, w / 2 ** (power + 1)).ravel()
    return np.column_stack((1 - points.sum(axis=1), points)), weights


def shape_functions(points: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape functions of a linear or quadratic simplex, and their slopes.

    Corners come first, x_a or x_a (2 x_a - 1), then the middles of ``EDGES``, 4 x_a x_b. Slopes are along the edges
    from the first corner to each of the others.

    Parameters
    ----------
    points : ndarray, shape (q, dim + 1)
        Barycentric coordinates.
    nodes : int
        dim + 1, or with the middles.

    Returns
    -------
    values : ndarray, shape (q, nodes)
    slopes : ndarray, shape (q, nodes, dim)
    """
    n_points, corners = points.shape
    unit = np.broadcast_to(np.eye(corners), (n_points, corners, corners))
    if nodes == corners:
        values, gradients = points, unit
    else:
        a, b = EDGES[corners - 1].T
        values = np.concatenate((points * (2 * points - 1), 4 * points[:, a] * points[:, b]), axis=1)
        middles = 4 * (points[:, a, None] * unit[:, b] + points[:, b, None] * unit[:, a])
        gradients = np.concatenate(((4 * points[:, :, None] - 1) * unit, middles), axis=1)
    return values, gradients[:, :, 1:] - gradients[:, :, :1]


def with_middles(facets: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return facets of quadratic elements with the middles of their edges.

    Parameters
    ----------
    facets : ndarray of int, shape (n, dim)
        Corners.
    elements : ndarray of int, shape (ne, 6) or (ne, 10)

    Returns
    -------
    ndarray of int, shape (n, 3) or (n, 6)
    """
    dim = facets.shape[1]
    size = int(elements.max()) + 1

    def key(ends: np.ndarray) -> np.ndarray:
        return ends.min(axis=-1).astype(np.int64) * size + ends.max(axis=-1)

    keys = key(elements[:, EDGES[dim]]).ravel()
    order = np.argsort(keys)
    found = order[np.searchsorted(keys, key(facets[:, EDGES[dim - 1]]), sorter=order)]
    return np.concatenate((facets, elements[:, dim + 1 :].ravel()[found]), axis=1)
