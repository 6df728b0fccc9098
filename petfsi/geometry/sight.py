"""Which points can be seen from another one past a surface."""

from __future__ import annotations

import numpy as np


def seen_from(place: np.ndarray, targets: np.ndarray, points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return whether no facet lies between a place and each target.

    Parameters
    ----------
    place : ndarray, shape (dim,)
    targets : ndarray, shape (n, dim)
    points : ndarray, shape (n_points, dim)
    facets : ndarray of int, shape (m, dim)

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    low, high = np.minimum(place, targets.min(axis=0)), np.maximum(place, targets.max(axis=0))
    corners = points[facets]
    near = np.all((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low), axis=1)
    corners = corners[near]
    way = targets - place
    # place + s way = corner 0 + sum_i t_i (corner i - corner 0), one system per facet and target
    edges = corners[:, 1:] - corners[:, :1]
    system = np.empty((len(way), len(corners), *(2 * (points.shape[1],))))
    system[..., 0] = way[:, None, :]
    system[..., 1:] = -np.swapaxes(edges, 1, 2)
    flat = np.abs(np.linalg.det(system)) <= 1e-300
    system[flat] = np.eye(points.shape[1])
    found = np.linalg.solve(system, np.broadcast_to(corners[:, 0] - place, system.shape[:-1])[..., None])[..., 0]
    s, t = found[..., 0], found[..., 1:]
    crossed = (s >= 0.0) & (s <= 1.0) & np.all(t >= 0.0, axis=-1) & (t.sum(axis=-1) <= 1.0) & ~flat
    return ~crossed.any(axis=1)
