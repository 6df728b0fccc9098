"""Elements or facets with what their integrals need: quadrature points, weights, normals."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from petfsi.fields.solid.loads.rules import simplex_rule
from petfsi.fields.solid.rules import shape_functions, shape_slopes

Coordinates = dict[str, np.ndarray | float]


class Simplices:
    """A rank's elements or facets of one body and one kind.

    Parameters
    ----------
    points : ndarray, shape (n_nodes, dim)
        Reference positions of this rank's nodes, m.
    nodes : ndarray of int, shape (n, m)
        Local numbers, corners first; facets are ordered so that their normals point out of the body.
    corners : int
        dim + 1 of elements, dim of facets.
    per_axis : int
        Gauss points along an axis; integrals are exact to degree 2 * per_axis - 1.

    Attributes
    ----------
    values : ndarray, shape (q, m)
        Shape functions at the quadrature points.
    slopes : ndarray, shape (q, m, corners - 1)
    rule : ndarray, shape (q,)
        The points' weights over the unit simplex.
    weights : ndarray, shape (n, q)
        Over the reference volume or area, m^3 or m^2 (2D: m^2 or m).
    """

    def __init__(self, points: np.ndarray, nodes: np.ndarray, corners: int, per_axis: int) -> None:
        self.nodes, self.dim, self._reference = nodes, points.shape[1], points
        where, self.rule = simplex_rule(corners - 1, per_axis)
        self.values, self.slopes = shape_functions(where, nodes.shape[1]), shape_slopes(where, nodes.shape[1])
        edges = self.tangents(points)
        gram = np.einsum("eqik,eqil->eqkl", edges, edges)
        self.weights = self.rule * np.sqrt(np.linalg.det(gram))

    @property
    def coordinates(self) -> Coordinates:
        """Return the reference positions of the quadrature points by axis, each of shape (n, q)."""
        x = np.einsum("qa,eai->ieq", self.values, self._reference[self.nodes])
        return {"z": 0.0, **dict(zip("xyz", x, strict=False))}

    def tangents(self, x: np.ndarray) -> np.ndarray:
        """Return dx/dxi at the quadrature points, shape (n, q, dim, corners - 1), for nodes at x."""
        return np.einsum("qak,eai->eqik", self.slopes, x[self.nodes])

    def area_vectors(self, x: np.ndarray) -> np.ndarray:
        """Return n da of facets whose nodes are at x, over that of the unit simplex, shape (n, q, dim)."""
        return area_vector(self.tangents(x))

    def reference_normals(self) -> np.ndarray:
        """Return the unit normals of facets at rest at the quadrature points, shape (n, q, dim)."""
        normal = self.area_vectors(self._reference)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def spread(self, n_rows: int) -> csr_matrix:
        """Return the map from densities at the quadrature points to forces of the first ``n_rows`` nodes.

        Of shape (n_rows, n * q); entry (a, q) is the integral's weight times N_a.
        """
        n, q = self.weights.shape
        row = np.repeat(self.nodes[:, None, :], q, axis=1).ravel()
        column = np.repeat(np.arange(n * q), self.nodes.shape[1])
        entry = (self.weights[:, :, None] * self.values).ravel()
        kept = row < n_rows
        return csr_matrix((entry[kept], (row[kept], column[kept])), shape=(n_rows, n * q))

    def gather(self, forces: np.ndarray, n_rows: int) -> np.ndarray:
        """Return the sum of forces of shape (n, m, dim) at the first ``n_rows`` nodes."""
        where = self.nodes.ravel()
        size = max(n_rows, int(where.max(initial=-1)) + 1)
        parts = forces.reshape(-1, self.dim).T
        return np.column_stack([np.bincount(where, weights=part, minlength=size)[:n_rows] for part in parts])


def area_vector(tangents: np.ndarray) -> np.ndarray:
    """Return t turned by -90 degrees in 2D, t_1 x t_2 in 3D; tangents of shape (..., dim, dim - 1)."""
    if tangents.shape[-1] == 1:
        return np.stack((tangents[..., 1, 0], -tangents[..., 0, 0]), axis=-1)
    return np.cross(tangents[..., 0], tangents[..., 1])
