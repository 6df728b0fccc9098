"""What closed regions of fluid gain and lose when the surface that bounds them moves, exactly."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from petfsi.fields.mac.walls.cut import Walls
from petfsi.geometry.quadratic import Curved
from petfsi.geometry.slabs import area_vectors


class Enclosure:
    """The parts of a surface that bound some regions, as the cells' walls have them.

    While points go straight from where the surface was cut to x, the area vector a_f of facet f is a polynomial of the
    way of degree dim - 1, and the region k gains

        V_k(x) - V_k = - sum_f  sum_i W[k, f, i] (x_i - x_i^cut) . mean(a_f),      W[k, f, i] = ∫ N_i dA / |a_f|,

    over the patches of f that bound it. Of facets that bound one region alone, W = 1/dim: then it is exact for any
    way. Where a facet leaves the region (through a side or an obstacle) it is exact to first order.

    Parameters
    ----------
    cut_at : ndarray, shape (n_points, dim)
        Where the surface was cut.
    facets : ndarray of int, shape (n_walls, dim)
        Those that are walls.
    number : ndarray of int, shape (n_walls,)
        Which of all ``n_facets`` of the surface they are.
    n_facets : int
    walls : Walls
        This rank's.
    first : int
        Number of this rank's first unknown.
    point_flux : csr_matrix, shape (n_local, n_points * dim)
        Net outflow of this rank's unknowns by velocities of points.
    members : list of ndarray, shape (n_local,)
        Per region 1 for its unknowns, 0 for the others.
    curved : Curved or None
        How facets move that are parts of quadratic ones.
    """

    def __init__(
        self, cut_at: np.ndarray, facets: np.ndarray, number: np.ndarray, n_facets: int, walls: Walls, first: int,
        point_flux: csr_matrix, members: list[np.ndarray], curved: Curved | None = None,
    ) -> None:  # fmt: skip
        self._cut_at = cut_at
        self._slope = np.array([point_flux.T @ member for member in members])
        area = area_vectors(cut_at, facets)
        squares = np.sum(area**2, axis=1)
        label = np.full(len(members[0]), -1)
        for k, member in enumerate(members):
            label[member > 0] = k
        region = label[walls.slot - first]
        use = np.flatnonzero((region >= 0) & (squares[walls.facet] > 0.0))
        facet = walls.facet[use]
        # flux[:, i] = -n_a ∫ N_i dA of every axis a, so that times -a_f,a / |a_f|^2 they add up to W
        part = -walls.flux[use] * (area[facet, walls.axis[use]] / squares[facet])[:, None]
        if curved is not None:
            part = curved.to_corners(facet, part)
        bounding, place = np.unique(facet, return_inverse=True)
        self._bounding, self._n_facets = number[bounding], n_facets
        self._facets = facets[bounding]
        n = part.shape[1]
        rows, columns = np.repeat(region[use], n), (n * place[:, None] + np.arange(n)).ravel()
        shape = len(members), n * len(bounding)
        self._share = coo_matrix((part.ravel(), (rows, columns)), shape=shape).tocsr()

    def parts(self) -> np.ndarray:
        """Return which part of each facet bounds which region in this rank's cells, shape (n_regions, n_facets)."""
        found = np.zeros((self._share.shape[0], self._n_facets))
        if len(self._bounding):
            found[:, self._bounding] = self._share.toarray().reshape(len(found), len(self._bounding), -1).sum(axis=2)
        return found

    def slope(self, way: np.ndarray) -> np.ndarray:
        """Return this rank's share of what the regions gain if points go so far (m), to first order: m . J^T way."""
        return self._slope @ way.ravel()

    def change(self, there: np.ndarray) -> np.ndarray:
        """Return this rank's share of what the regions gain when the points are there, m^3 (m^2 in 2D).

        Parameters
        ----------
        there : ndarray, shape (n_points, dim)
        """
        way = (there - self._cut_at)[self._facets]
        begin, end = area_vectors(self._cut_at, self._facets), area_vectors(there, self._facets)
        mean = (begin + end) / 2
        if there.shape[1] == 3:  # Simpson's rule is exact for parabolas
            mean = (mean + 2 * area_vectors((self._cut_at + there) / 2, self._facets)) / 3
        return -(self._share @ np.sum(way * mean[:, None, :], axis=2).ravel())
