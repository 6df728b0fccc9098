"""Bodies and surfaces cut by a plane, for pictures."""

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


def section(points: np.ndarray, facets: np.ndarray, axis: int | None, at: float) -> list[np.ndarray]:
    """Return the closed lines in which the plane ``x[axis] = at`` cuts a closed surface; without axis, its own.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        Corners.
    facets : ndarray of int, shape (m, dim)
        Segments or triangles, all turned alike.
    axis, at : int or None, float
        The plane's normal and place; None for segments in the plane.

    Returns
    -------
    list of ndarray, shape (k, 2)
        The corners of each line, which ends where it begins, without the coordinate along ``axis``.
    """
    if axis is None:
        return [points[facets[line, 0]] for line in _chains(facets)]
    above = points[facets, axis] > at
    cut = above.any(axis=1) & ~above.all(axis=1)
    above, corners = above[cut], facets[cut]
    # the corner that is alone on its side comes first; an edge that goes down is left, one that goes up is entered
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    corners = np.take_along_axis(corners, (alone[:, None] + np.arange(3)) % 3, axis=1)
    leaving, coming = corners[:, [0, 1]], corners[:, [0, 2]]
    falls = np.take_along_axis(above, alone[:, None], axis=1)
    edges = np.stack((np.where(falls, leaving, coming), np.where(falls, coming, leaving)), axis=1)
    edges.sort(axis=2)
    low, high = points[edges[:, 0, 0]], points[edges[:, 0, 1]]
    weight = (at - low[:, axis]) / (high[:, axis] - low[:, axis]) if len(low) else np.zeros(0)
    x = np.delete(low + weight[:, None] * (high - low), axis, axis=1)
    return [x[line] for line in _chains(edges @ np.array([len(points), 1]))]


def _chains(pairs: np.ndarray) -> list[list[int]]:
    """Return directed pairs put in rows, each beginning where the one before ends."""
    leaving: dict[int, list[int]] = {}
    for number, begin in enumerate(pairs[:, 0].tolist()):
        leaving.setdefault(begin, []).append(number)
    ends = pairs[:, 1].tolist()
    chains = []
    while leaving:
        place, chain = next(iter(leaving)), []
        while place in leaving:
            number = leaving[place].pop()
            if not leaving[place]:
                del leaving[place]
            chain.append(number)
            place = ends[number]
        chains.append(chain)
    return chains
