"""Rims of a surface's faces: where facets meet at an edge, or end.

A place behind a face is seen through that face alone: the straight way to it crosses the face's plane on this side of
all rims. So what is behind a body's edge is seen once, by way of one face or the other, and not from where the way
goes past the edge.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from petfsi.geometry.slabs import area_vectors
from petfsi.geometry.surfaces import ridges

#: Facets whose normals have a smaller scalar product have an edge between them.
EDGE_COSINE = 0.85
#: So many rims at most bound what is seen of a place: of those in about one direction, the nearest.
BOUNDS = {2: 2, 3: 3}
#: Rims whose outward directions have a larger scalar product are in about one direction.
ALIKE = 0.9


class Rims:
    """The rims of a surface, seen from the facets that have them.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        At rest, m.
    facets : ndarray of int, shape (n_facets, dim)

    Attributes
    ----------
    facet : ndarray of int, shape (n,)
        Whose rim it is.
    corner : ndarray of int, shape (n,)
        The facet's corner that is not on the rim.
    ends : ndarray of int, shape (n, dim - 1)
        The points on it.
    patch : ndarray of int, shape (n_facets,)
        Facets between the same rims have the same number.
    """

    def __init__(self, points: np.ndarray, facets: np.ndarray) -> None:
        dim, m = points.shape[1], len(facets)
        normal = unit_normals(points, facets)
        edge = np.sort(ridges(facets), axis=2).reshape(-1, dim - 1)
        owner = np.repeat(np.arange(m), dim)
        order = np.lexsort(edge.T[::-1])
        same = np.all(edge[order[1:]] == edge[order[:-1]], axis=1)
        one, other = order[:-1][same], order[1:][same]
        smooth = np.sum(normal[owner[one]] * normal[owner[other]], axis=1) > EDGE_COSINE
        is_rim = np.ones(len(edge), dtype=bool)
        is_rim[one[smooth]] = is_rim[other[smooth]] = False
        links = coo_matrix((np.ones(smooth.sum()), (owner[one[smooth]], owner[other[smooth]])), shape=(m, m))
        self.patch = connected_components(links, directed=False)[1]
        which = np.flatnonzero(is_rim)
        self.facet, self.ends = owner[which], ridges(facets).reshape(-1, dim - 1)[which]
        rest = np.all(facets[self.facet][:, :, None] != self.ends[:, None, :], axis=2)
        self.corner = facets[self.facet, np.argmax(rest, axis=1)]

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Return the unit vectors along the facets, away from them across the rim, shape (n, dim)."""
        begin = points[self.ends[:, 0]]
        way = begin - points[self.corner]
        if points.shape[1] == 3:
            along = points[self.ends[:, 1]] - begin
            square = np.sum(along**2, axis=1)
            way -= (np.sum(way * along, axis=1) / np.where(square > 0.0, square, 1.0))[:, None] * along
        length = np.linalg.norm(way, axis=1)
        return way / np.where(length > 0.0, length, 1.0)[:, None]

    def beside(
        self, points: np.ndarray, which: np.ndarray, spacing: float, layers: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return places along rims, and beyond: the rim, weights of its ends, how far beyond, what length it is for.

        Lengths are in m, in 2D the last is 1.

        Parameters
        ----------
        points : ndarray, shape (n_points, dim)
        which : ndarray of int, shape (k,)
            These rims.
        spacing : float
            m; between places, along and across.
        layers : int
            So many of them across.
        """
        dim, ends = points.shape[1], self.ends[which]
        number, length = np.ones(len(which), dtype=np.int64), np.ones(len(which))
        if dim == 3:
            length = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
            number = np.maximum(1, np.rint(length / spacing)).astype(np.int64)
        begin = np.repeat(np.cumsum(number) - number, number)
        part = (np.arange(number.sum()) - begin + 0.5) / np.repeat(number, number)
        weights = np.ones((len(part), 1)) if dim == 2 else np.column_stack([1.0 - part, part])
        way = np.tile((np.arange(layers) + 0.5) * spacing, len(part))
        rim, length = np.repeat(which, number), np.repeat(length / number, number)
        return np.repeat(rim, layers), np.repeat(weights, layers, axis=0), way, np.repeat(length, layers)

    def bounds(self, points: np.ndarray, feet: np.ndarray, facet: np.ndarray, spacing: float, reach: float):
        """Return which rims bound what is seen of places with these feet, shape (n, BOUNDS), -1 of none.

        Parameters
        ----------
        points : ndarray, shape (n_points, dim)
        feet : ndarray, shape (n, dim)
            m.
        facet : ndarray of int, shape (n,)
            On which they are.
        spacing, reach : float
            m; rims farther than ``reach`` bound nothing.
        """
        most = BOUNDS[points.shape[1]]
        found = np.full((len(feet), most), -1)
        if not len(self.ends) or not len(feet):
            return found
        rim, weights, *_ = self.beside(points, np.arange(len(self.ends)), 0.5 * spacing, 1)
        places = np.einsum("na,nad->nd", weights, points[self.ends[rim]])
        near = cKDTree(feet).sparse_distance_matrix(cKDTree(places), reach + spacing, output_type="coo_matrix")
        foot, at, distance = near.row, rim[near.col], near.data
        kept = self.patch[facet[foot]] == self.patch[self.facet[at]]
        foot, at, distance = foot[kept], at[kept], distance[kept]
        order = np.lexsort((at, distance, foot))
        foot, at = foot[order], at[order]
        outward = self.outward(points)
        for k in range(most):
            rows, first = np.unique(foot, return_index=True)
            found[rows, k] = at[first]
            chosen = np.zeros((len(feet), points.shape[1]))
            chosen[rows] = outward[at[first]]
            apart = np.sum(chosen[foot] * outward[at], axis=1) < ALIKE
            foot, at = foot[apart], at[apart]
        return found


def unit_normals(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return the unit normals of facets, zero of those without area, shape (n_facets, dim)."""
    vectors = area_vectors(points, facets)
    area = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(area > 0.0, area, 1.0)[:, None]
