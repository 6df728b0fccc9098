"""Quadrature over simplices of one to three dimensions."""

from __future__ import annotations

import numpy as np
from scipy.special import roots_jacobi


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
