"""Integrals over the patches of quadratic facets, with the facets' own shape functions.

Patches are made by ``patches``, with the hat functions of the corners of flat parts. The few that belong to quadratic
facets are clipped once more here, to the same points, so that others pay nothing for them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.geometry.patches import Frame
from petfsi.geometry.quadratic import part_forms
from petfsi.geometry.slabs import MOST, clip_to_cell

#: Points (barycentric coordinates) and weights of rules on a segment and on a triangle, exact to degree 3: a shape
#: function times a coordinate.
_RULES = {
    2: (np.array([[1, 0], [0, 1], [0.5, 0.5]]), np.array([1, 1, 4]) / 6),
    3: (
        np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3, 1 / 3, 1 / 3]]),
        np.array([3, 3, 3, 8, 8, 8, 27]) / 60,
    ),
}


def node_integrals(
    x: np.ndarray, facets: np.ndarray, part: np.ndarray, frame: Frame, facet: np.ndarray, place: np.ndarray,
    integrals: np.ndarray, moments: np.ndarray, shapes: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return integrals and moments of patches by the nodes of their facets, (n, width) and (n, width, dim).

    Parameters
    ----------
    x : ndarray, shape (n_points, dim)
        In units of cells.
    facets : ndarray of int32, shape (m, dim)
    part : ndarray of int8, shape (m,)
        As in ``quadratic.Curved``.
    frame : Frame
    facet : ndarray of int32, shape (n,)
    place : ndarray of int, shape (n, dim)
        The cell of each patch where the surface itself is, not the image that the patch is of.
    integrals, moments : ndarray, shape (n, dim) and (n, dim, dim)
        Those of the corners, as in ``clipping.CutCells``.
    shapes : tuple of ndarray
        For patches that are parts of facets' parts in cells the number of their polygon, else -1, shape (n,); and these
        polygons as in ``overlaps.Rest``.
    """
    dim, n = facets.shape[1], len(facet)
    pairs = np.array([(i, j) for i in range(dim) for j in range(i, dim)])
    # N_k by the products L_i L_j, i <= j, of which there are as many as nodes
    table = part_forms(dim)[:, :, pairs[:, 0], pairs[:, 1]] * np.where(pairs[:, 0] == pairs[:, 1], 1.0, 2.0)
    whole, first = np.zeros((n, len(pairs))), np.zeros((n, len(pairs), dim))
    whole[:, :dim], first[:, :dim] = integrals, moments
    bent = np.flatnonzero(part[facet] >= 0)
    _integrate(
        x, facets, part, facet, bent, place, frame.dx, frame.normals, pairs, np.ascontiguousarray(table), *_RULES[dim],
        *shapes, whole, first,
    )  # fmt: skip
    return whole, first


@njit(cache=True)
def _integrate(
    x, facets, part, facet, bent, place, dx, normals, pairs, table, rule, weights, own, polygons, integrals, moments
):
    """Fill the rows ``bent`` of integrals and moments."""
    dim, width = len(dx), len(pairs)
    points, tags = np.empty((2, MOST, 2 * dim)), np.empty((2, MOST), np.int64)
    at, sums = np.empty(2 * dim), np.empty((width, 1 + dim))
    for p in bent:
        f = facet[p]
        n, polygon = polygons.shape[1], points[1]
        if own[p] >= 0:
            polygon = polygons[own[p]]
        else:
            n = clip_to_cell(x, facets[f], place[p], points, tags)
        sums[:] = 0.0
        # a fan of triangles; in 2D one segment
        for i in range(1, n - (dim - 2)):
            area = _area(polygon, i, dx, normals[f])
            for q in range(len(weights)):
                for a in range(2 * dim):
                    at[a] = rule[q, 0] * polygon[0, a] + rule[q, 1] * polygon[i, a]
                    if dim == 3:
                        at[a] += rule[q, 2] * polygon[i + 1, a]
                for k in range(width):
                    product = area * weights[q] * at[dim + pairs[k, 0]] * at[dim + pairs[k, 1]]
                    sums[k, 0] += product
                    for a in range(dim):
                        sums[k, 1 + a] += product * dx[a] * at[a]
        for k in range(width):
            integrals[p, k], moments[p, k] = 0.0, 0.0
            for m in range(width):
                integrals[p, k] += table[part[f], k, m] * sums[m, 0]
                for a in range(dim):
                    moments[p, k, a] += table[part[f], k, m] * sums[m, 1 + a]


@njit(cache=True)
def _area(polygon, i, dx, normal):
    """Return the area (length) of one triangle of a polygon's fan, or of a segment."""
    if len(dx) == 2:
        return (polygon[1, 1] - polygon[0, 1]) * dx[1] * normal[0] - (polygon[1, 0] - polygon[0, 0]) * dx[0] * normal[1]
    area = 0.0
    for a in range(3):
        e, g = (a + 1) % 3, (a + 2) % 3
        twice = (polygon[i, e] - polygon[0, e]) * (polygon[i + 1, g] - polygon[0, g])
        twice -= (polygon[i, g] - polygon[0, g]) * (polygon[i + 1, e] - polygon[0, e])
        area += 0.5 * twice * dx[e] * dx[g] * normal[a]
    return area
