"""Bodies and surfaces cut by a plane, for pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Which pairs of corners, sorted by height, the plane passes between when so many of four lie above it.
_CUT_EDGES = {
    1: np.array([(0, 3), (1, 3), (2, 3)]),
    2: np.array([(0, 2), (0, 3), (1, 3), (1, 2)]),
    3: np.array([(0, 1), (0, 2), (0, 3)]),
}


@dataclass(frozen=True)
class Plane:
    """The plane of a picture.

    Attributes
    ----------
    across : (int, int)
        The axes along x and y of the picture.
    at : float or None
        Where it cuts the third axis, m; None in a scene of two.
    """

    across: tuple[int, int] = (0, 1)
    at: float | None = None

    @property
    def axis(self) -> int | None:
        """The axis that it cuts."""
        return None if self.at is None else 3 - sum(self.across)

    def cut(self, points: np.ndarray, facets: np.ndarray) -> list[np.ndarray]:
        """Return the closed lines of a closed surface in it, as ``section`` does."""
        return section(points, facets, self.axis, self.at or 0.0)


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


def clip_triangles(triangles: np.ndarray, axis: int, at: float, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what of triangles lies beyond, or before, the plane ``x[axis] = at``, and which of them each is of.

    Parameters
    ----------
    triangles : ndarray, shape (n, 3, 3)
    axis, at, sign : int, float, float
        The plane, and 1 to keep what is above it, -1 for what is below.

    Returns
    -------
    pieces : ndarray, shape (m, 3, 3)
        Turned as the triangles that they are of.
    owners : ndarray of int, shape (m,)
    """
    height = sign * (triangles[:, :, axis] - at)
    above = height >= 0.0
    count = above.sum(axis=1)
    pieces, owners = [triangles[count == 3]], [np.flatnonzero(count == 3)]
    for inside in (1, 2):
        cut = np.flatnonzero(count == inside)
        # the corner that is alone on its side comes first
        alone = np.argmax(above[cut] == (inside == 1), axis=1)
        order = (alone[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(triangles[cut], order[:, :, None], axis=1).swapaxes(0, 1)
        h = np.take_along_axis(height[cut], order, axis=1)
        ab, ac = (a + (h[:, :1] / (h[:, :1] - h[:, n : n + 1])) * (x - a) for n, x in ((1, b), (2, c)))
        for piece in [(a, ab, ac)] if inside == 1 else [(ab, b, c), (ab, c, ac)]:
            pieces.append(np.stack(piece, axis=1))
            owners.append(cut)
    return np.concatenate(pieces), np.concatenate(owners)


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
