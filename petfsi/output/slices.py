"""Tetrahedra cut by a plane, for pictures."""

from __future__ import annotations

import numpy as np

#: Which pairs of corners, sorted by height, the plane passes between when so many of four lie above it.
_CUT_EDGES = {
    1: np.array([(0, 3), (1, 3), (2, 3)]),
    2: np.array([(0, 2), (0, 3), (1, 3), (1, 2)]),
    3: np.array([(0, 1), (0, 2), (0, 3)]),
}


def cut_tetrahedra(points: np.ndarray, cells: np.ndarray, axis: int, at: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the polygons in which the plane ``x[axis] = at`` cuts tetrahedra, and the cell of each.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes.
    cells : ndarray, shape (ne, 4)
        Tetrahedra.
    axis, at : int, float
        The plane's normal and place.

    Returns
    -------
    polygons : list of ndarray, shape (3 or 4, 2)
        Corners in order around the polygon, without the coordinate along ``axis``.
    owners : ndarray of int
        The cell that each polygon belongs to.
    """
    height = points[cells, axis] - at
    above = (height > 0.0).sum(axis=1)
    order = np.argsort(height, axis=1)
    rest = [a for a in range(3) if a != axis]
    polygons: list[np.ndarray] = []
    owners = []
    for n_above, edges in _CUT_EDGES.items():
        cut = np.flatnonzero(above == n_above)
        corner, h = np.take_along_axis(cells[cut], order[cut], 1), np.take_along_axis(height[cut], order[cut], 1)
        low, high = h[:, edges[:, 0]], h[:, edges[:, 1]]
        weight = (low / (low - high))[:, :, None]
        x = points[:, rest]
        polygons.extend((1.0 - weight) * x[corner[:, edges[:, 0]]] + weight * x[corner[:, edges[:, 1]]])
        owners.append(cut)
    return polygons, np.concatenate(owners)
