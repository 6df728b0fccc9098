"""Surfaces: the only place where fluids and solids meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from petfsi.geometry.quadratic import Curved

#: The facets of a positively oriented simplex, each ordered so that its normal points out of it.
_FACETS = {
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]),
}
_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


@dataclass(frozen=True)
class Surface:
    """The wet surface of a field, the same on every rank.

    Attributes
    ----------
    facets : ndarray of int, shape (n_facets, dim)
        Points of each segment (2D) or triangle (3D), ordered so that normals point out of the solid: in 2D the
        tangent b - a turned by -90 degrees, in 3D (b - a) x (c - a).
    cavity : ndarray of bool, shape (n_facets,)
        Facets of an inner shell, which bounds a closed cavity of the solid.
    void : ndarray of bool, shape (n_facets,)
        Facets of a cavity that holds nothing (pressure zero) rather than fluid.
    point_map : scipy.sparse.csr_matrix, shape (n_points * dim, n_unknowns)
        From the owner's unknowns (global numbers) to point velocities, point-major: row ``point * dim + axis``.
        Columns of unknowns whose value is prescribed are empty here and stand in ``fixed_map``.
    fixed_map : scipy.sparse.csr_matrix, shape (n_points * dim, n_unknowns)
        The rest of the map: what prescribed unknowns contribute.
    curved : Curved or None
        How facets move if some are parts of quadratic ones; all others with the hat functions of their corners.
    """

    facets: np.ndarray
    cavity: np.ndarray
    void: np.ndarray
    point_map: csr_matrix
    fixed_map: csr_matrix
    curved: Curved | None = None

    @property
    def nodes(self) -> np.ndarray:
        """The points whose shape functions each facet has, shape (n_facets, width)."""
        return self.facets if self.curved is None else self.curved.nodes

    def shape_functions(self, facet: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the functions of ``nodes`` where facets (n,) have the barycentric coordinates (n, dim)."""
        return weights if self.curved is None else self.curved.values(facet, weights)

    @property
    def n_points(self) -> int:
        """The number of points."""
        return self.point_map.shape[0] // self.facets.shape[1]


def signed_volumes(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the signed volume (area in 2D) of each simplex: det(x_1 - x_0, ...) / dim!."""
    dim = points.shape[1]
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    return np.linalg.det(edges) / (2.0 if dim == 2 else 6.0)


def boundary_facets(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the facets that belong to one cell only, with normals out of it.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
    cells : ndarray of int, shape (ne, dim + 1)
        Of either orientation.

    Returns
    -------
    ndarray of int, shape (n_facets, dim)
        In the order of the cells.
    """
    dim = points.shape[1]
    facets = cells[:, _FACETS[dim]]
    negative = signed_volumes(points, cells) < 0
    facets[negative] = facets[negative][:, :, ::-1]
    facets = facets.reshape(-1, dim)
    return facets[occurrences(facets) == 1]


def occurrences(tuples: np.ndarray) -> np.ndarray:
    """Return for each row how many rows hold the same numbers, in whatever order."""
    rows = np.sort(tuples, axis=1)
    order = np.lexsort(rows.T[::-1])
    new = np.concatenate(([True], np.any(np.diff(rows[order], axis=0) != 0, axis=1)))[: len(rows)]
    group = np.cumsum(new) - 1
    count = np.empty(len(rows), dtype=np.int64)
    count[order] = np.bincount(group)[group] if len(rows) else 0
    return count


def ridges(facets: np.ndarray) -> np.ndarray:
    """Return what neighbouring facets share: the points of segments, the edges of triangles.

    Returns
    -------
    ndarray of int, shape (n_facets, dim, dim - 1)
        In a triangle each edge runs in the triangle's sense.
    """
    return facets[:, :, None] if facets.shape[1] == 2 else facets[:, _EDGES]


def shells(points: np.ndarray, facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed shell each facet belongs to, and the volume each shell encloses.

    The volume of an outer shell is positive, that of an inner shell, which bounds a cavity, negative.

    Returns
    -------
    label : ndarray of int, shape (n_facets,)
        Shells are numbered in the order of their first facets.
    volume : ndarray, shape (n_shells,)
        m^3, in 2D m^2.
    """
    n_facets, dim = facets.shape
    if n_facets == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    _, ridge = np.unique(np.sort(ridges(facets).reshape(-1, dim - 1), axis=1), axis=0, return_inverse=True)
    facet = np.repeat(np.arange(n_facets), dim)
    ridge = n_facets + ridge.ravel()
    n_nodes = int(ridge.max()) + 1
    graph = coo_matrix((np.ones(len(facet), dtype=np.int8), (facet, ridge)), shape=(n_nodes, n_nodes))
    _, component = connected_components(graph, directed=False)
    _, first, label = np.unique(component[:n_facets], return_index=True, return_inverse=True)
    label = np.argsort(np.argsort(first))[label.ravel()]
    corner = points[facets] - points[facets].mean(axis=(0, 1))
    volume = np.linalg.det(corner) / (2.0 if dim == 2 else 6.0)
    return label, np.bincount(label, weights=volume)
