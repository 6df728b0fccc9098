"""Quadratic simplices: nodes in the middle of edges, and the linear simplices that stand for them where one only looks.

An element has its corners first, then the middles of ``EDGES`` in their order. Sides are straight.

What a fluid meets of a quadratic facet are flat parts, two segments or four triangles. They meet in vertices beyond the
middles of its edges,

    v_ab = x_ab + (x_ab - (x_a + x_b) / 2) / 3 ,

so that they enclose as much as the face itself when it is bent: in 2D exactly (a parabola has 2/3 of the area around
it, a triangle 1/2), in 3D to first order in how far it is bent. They move with the facet's own shape functions: in the
barycentric coordinates L of a part these are quadratic forms, N_k = sum_ij L_i Q_kij L_j. Of straight faces ∫ N_k dA
is exact on every piece; and summed over pieces ∫ N_k n dA is how the enclosed volume changes with x_k, as exactly as
the volume is enclosed, though a single part's is not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: The corners at the ends of each edge of a segment, a triangle and a tetrahedron.
EDGES = {
    1: np.array([[0, 1]]),
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]),
}
#: Two segments; four triangles; four tetrahedra at the corners, four around a diagonal of the octahedron between them.
_PARTS = {
    1: np.array([[0, 2], [2, 1]]),
    2: np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]),
    3: np.array(
        [[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3], [4, 9, 8, 5], [4, 9, 7, 8], [4, 9, 6, 7], [4, 9, 5, 6]]
    ),
}


def with_middles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points with the middles of all edges behind them, and the quadratic elements.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        m.
    cells : ndarray of int, shape (ne, dim + 1)

    Returns
    -------
    points : ndarray, shape (n + n_edges, dim)
    elements : ndarray of int, shape (ne, 6) in 2D, (ne, 10) in 3D
    """
    dim = points.shape[1]
    ends = np.sort(cells[:, EDGES[dim]].reshape(-1, 2), axis=1)
    edges, which = np.unique(ends, axis=0, return_inverse=True)
    middles = len(points) + which.reshape(len(cells), -1)
    return np.concatenate((points, points[edges].mean(axis=1))), np.concatenate((cells, middles), axis=1)


def facets_with_middles(facets: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return facets with the middles of their edges, where the elements have some.

    Parameters
    ----------
    facets : ndarray of int, shape (n, dim)
        Corners; every edge is one of the elements'.
    elements : ndarray of int, shape (ne, dim + 1), (ne, 6) or (ne, 10)

    Returns
    -------
    ndarray of int, shape (n, dim), or (n, 3) in 2D and (n, 6) in 3D
    """
    dim = facets.shape[1]
    if elements.shape[1] == dim + 1:
        return facets
    size = int(elements.max()) + 1

    def key(ends: np.ndarray) -> np.ndarray:
        return ends.min(axis=-1).astype(np.int64) * size + ends.max(axis=-1)

    keys = key(elements[:, EDGES[dim]]).ravel()
    order = np.argsort(keys)
    found = order[np.searchsorted(keys, key(facets[:, EDGES[dim - 1]]), sorter=order)]
    return np.concatenate((facets, elements[:, dim + 1 :].ravel()[found]), axis=1)


def beyond_middles(x: np.ndarray, elements: np.ndarray, dim: int) -> np.ndarray:
    """Return points of which the middles of edges are farther out by a third, see the module.

    Parameters
    ----------
    x : ndarray, shape (n, 2 or 3)
        m.
    elements : ndarray of int, shape (ne, m)
        Quadratic simplices of dimension ``dim``.
    """
    middles, ends = elements[:, dim + 1 :], elements[:, EDGES[dim]]
    moved = x.copy()
    moved[middles] += (x[middles] - x[ends].mean(axis=2)) / 3
    return moved


def linear_parts(elements: np.ndarray, dim: int) -> np.ndarray:
    """Return the 2 segments, 4 triangles or 8 tetrahedra of each quadratic simplex of dimension ``dim``.

    Oriented as it is, one simplex' in a row.
    """
    return elements[:, _PARTS[dim]].reshape(-1, dim + 1)


class Curved(NamedTuple):
    """How facets move of which some are parts of quadratic ones.

    Attributes
    ----------
    nodes : ndarray of int, shape (m, 3) in 2D, (m, 6) in 3D
        The points whose shape functions a facet has: of a part those of the quadratic facet, corners and middles. A
        facet that is none has its own corners, and the first of them again with the function zero.
    part : ndarray of int8, shape (m,)
        Which part each is, a row of ``part_forms``; -1 of none.
    """

    nodes: np.ndarray
    part: np.ndarray

    def take(self, chosen: np.ndarray) -> Curved:
        """Return some of the facets, by number or mask."""
        return Curved(self.nodes[chosen], self.part[chosen])

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """Return where the vertices of flat parts are (see the module), given the points as nodes of the solid.

        Both of shape (n_points, dim); points that are the middle of no edge stay.
        """
        dim = x.shape[1]
        return beyond_middles(x, self.nodes[self.part == 0], dim - 1)

    def values(self, facet: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the shape functions where facets (n,) have the barycentric coordinates (n, dim), shape (n, width)."""
        dim = weights.shape[1]
        values = np.zeros((len(weights), self.nodes.shape[1]))
        values[:, :dim] = weights
        bent = np.flatnonzero(self.part[facet] >= 0)
        L = weights[bent]
        values[bent] = np.einsum("ni,nkij,nj->nk", L, part_forms(dim)[self.part[facet[bent]]], L)
        return values

    def means(self, facet: np.ndarray, weights: np.ndarray, pieces: np.ndarray) -> np.ndarray:
        """Return the shape functions' means over pieces of facets, each facet cut into k (2D) or k^2 (3D) equal ones.

        Parameters
        ----------
        facet, pieces : ndarray of int, shape (n,)
            Of each piece, and k.
        weights : ndarray, shape (n, dim)
            Barycentric coordinates of its centroid.
        """
        dim = weights.shape[1]
        values = self.values(facet, weights)
        bent = np.flatnonzero(self.part[facet] >= 0)
        # the mean of L L^T less that of the centroid, over the whole facet
        spread = (np.eye(dim) - 1.0 / dim) / (dim * (dim + 1))
        more = np.einsum("pkij,ij->pk", part_forms(dim), spread)
        values[bent] += more[self.part[facet[bent]]] / pieces[bent, None] ** 2
        return values

    def to_corners(self, facet: np.ndarray, integrals: np.ndarray) -> np.ndarray:
        """Return the integrals of the hat functions of facets' corners (n, dim), given those of their nodes (n, width).

        On a part these are linear, and so made of the quadratic functions by their values at the nodes, inside the
        part or not. With them moves the volume that flat parts enclose.
        """
        dim = {3: 2, 6: 3}[self.nodes.shape[1]]
        hats = integrals[:, :dim].copy()
        bent = np.flatnonzero(self.part[facet] >= 0)
        nodes = _node_places(dim - 1)
        corners = nodes @ np.linalg.inv(nodes[_PARTS[dim - 1]])
        hats[bent] = np.einsum("nk,nki->ni", integrals[bent], corners[self.part[facet[bent]]])
        return hats

    @classmethod
    def joined(cls, pieces: list[tuple[np.ndarray, Curved | None]]) -> Curved | None:
        """Return how pieces of a surface move, each given by its facets and by what is known of them if any is part.

        None if none of all is.
        """
        if all(curved is None for _, curved in pieces):
            return None
        every = [_flat(facets) if curved is None else curved for facets, curved in pieces]
        return cls(*(np.concatenate(column) for column in zip(*every, strict=True)))


def _flat(facets: np.ndarray) -> Curved:
    """Return how facets move none of which is part of another."""
    dim = facets.shape[1]
    more = np.repeat(facets[:, :1], len(EDGES[dim - 1]), axis=1)
    return Curved(np.concatenate((facets, more), axis=1), np.full(len(facets), -1, dtype=np.int8))


def facet_parts(facets: np.ndarray, dim: int) -> tuple[np.ndarray, Curved | None]:
    """Return facets as flat ones, parts of a quadratic one in a row, and how they move if they are parts.

    Parameters
    ----------
    facets : ndarray of int, shape (n, dim), or (n, 3) in 2D and (n, 6) in 3D
        As from ``facets_with_middles``.
    """
    if facets.shape[1] == dim:
        return facets, None
    parts, count = linear_parts(facets, dim - 1), len(_PARTS[dim - 1])
    part = np.tile(np.arange(count, dtype=np.int8), len(facets))
    return parts, Curved(np.repeat(facets, count, axis=0), part)


def part_forms(dim: int) -> np.ndarray:
    """Return Q of the parts of a quadratic facet, shape (parts, nodes, dim, dim); see above.

    With the facet's own barycentric coordinates x = B^T L, and N_k = x . Q_k x, these are B Q_k B^T.
    """
    places = _node_places(dim - 1)[_PARTS[dim - 1]]
    return np.einsum("pia,kab,pjb->pkij", places, shape_forms(dim - 1), places)


def _node_places(dim: int) -> np.ndarray:
    """Return the barycentric coordinates of the nodes of a simplex of dimension ``dim``."""
    corners = np.eye(dim + 1)
    return np.concatenate((corners, corners[EDGES[dim]].mean(axis=1)))


def shape_forms(dim: int) -> np.ndarray:
    """Return the symmetric Q_a of N_a = x . Q_a x: corners x_a (x_a - the others), middles 4 x_a x_b."""
    corners = dim + 1
    forms = np.zeros((corners + len(EDGES[dim]), corners, corners))
    for a in range(corners):
        forms[a, a, :] = forms[a, :, a] = -0.5
        forms[a, a, a] = 1.0
    for n, (a, b) in enumerate(EDGES[dim]):
        forms[corners + n, a, b] = forms[corners + n, b, a] = 2.0
    return forms
