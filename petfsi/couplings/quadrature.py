"""Pressure at points on a surface, interpolated among the fluid cells in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

from petfsi.geometry.quadratic import Curved

# A stencil whose usable cells weigh less than this in sum says too little about the point.
_LEAST_WEIGHT = 1e-3
# A fluid cell whose centre lies in the facet's plane up to rounding is still in front of it (in cell sizes).
_ON_PLANE = 1e-6


@dataclass(frozen=True)
class Box:
    """The cells a rank owns, and how its arrays number them.

    Attributes
    ----------
    origin, dx : ndarray, shape (dim,)
        Lower corner of the whole grid and cell size.
    cells, periodic : ndarray, shape (dim,)
        Of the whole grid.
    lo, hi : ndarray of int, shape (dim,)
        Owned cells.
    ghost : ndarray of int, shape (dim,)
        Ghost layers of the local arrays.
    """

    origin: np.ndarray
    dx: np.ndarray
    cells: np.ndarray
    periodic: np.ndarray
    lo: np.ndarray
    hi: np.ndarray
    ghost: np.ndarray

    @classmethod
    def of(cls, grid) -> Box:
        """Return the box of a ``MacGrid``."""
        parts = (grid.origin, grid.dx, grid.cells, grid.periodic, grid.lo, grid.hi, grid.ghost)
        kinds = (float, float, np.int64, np.bool_, np.int64, np.int64, np.int64)
        return cls(*(np.array(part, dtype=kind)[: grid.dim] for part, kind in zip(parts, kinds, strict=True)))


def area_normals(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return each facet's outward normal times its area (its length in 2D), shape (n_facets, dim)."""
    q = points[facets]
    e = q[:, 1] - q[:, 0]
    if points.shape[1] == 2:
        return np.column_stack((e[:, 1], -e[:, 0]))
    return 0.5 * np.cross(e, q[:, 2] - q[:, 0])


def pieces_per_edge(points: np.ndarray, facets: np.ndarray, dx: np.ndarray, quadrature: int) -> np.ndarray:
    """Return into how many parts each facet's edges are cut, so that none is longer than a cell / ``quadrature``."""
    q = points[facets] / dx
    longest = np.max([np.linalg.norm(q[:, i] - q[:, i - 1], axis=1) for i in range(facets.shape[1])], axis=0)
    return np.maximum(np.ceil(quadrature * longest - 1e-9), 1).astype(np.int64)


def pressure_integrals(
    points: np.ndarray, facets: np.ndarray, box: Box, usable: np.ndarray, quadrature: int, curved: Curved | None = None
) -> tuple[csr_matrix, csr_matrix]:
    """Return this rank's share of the integrals of facet shape functions times the pressure, in two factors.

    Their product S holds S[f * width + i, c], with the facet's functions i (``width`` of them),

        Σ_c S[f * width + i, c] p_c = 1 / |f| ∫_f N_i p dA ,

    by the mean of N_i over equal pieces of the facet and p in the middle of each (exact for a uniform p), with p(x)
    interpolated linearly along each axis among those cells of the stencil around x that are usable and not behind
    the facet. Each piece belongs to the rank that owns its middle's cell. Not collective.

    Parameters
    ----------
    points, facets : ndarray
        The surface, with outward normals.
    box : Box
        This rank's cells.
    usable : ndarray of bool
        Cells that have a pressure, in the local shape with ghosts.
    quadrature : int
        Facets are cut until no piece is longer than a cell divided by this.
    curved : Curved or None
        What functions parts of quadratic facets have; others the hat functions of their corners.

    Returns
    -------
    shape_weights : csr_matrix, shape (n_facets * width, n_quadrature)
    stencils : csr_matrix, shape (n_quadrature, usable.size)
        Rows sum to one; columns are flat local cells.
    """
    dim = points.shape[1]
    pieces = pieces_per_edge(points, facets, box.dx, quadrature)
    near = _facets_near(points[facets], box)
    bound = int((pieces[near] ** (dim - 1)).sum())
    facet = np.empty(bound, dtype=np.int64)
    shapes = np.empty((bound, dim))
    cells = np.empty((bound, 2**dim), dtype=np.int64)
    weights = np.empty((bound, 2**dim))
    normals = area_normals(points, facets)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    strides = np.array(usable.strides[:dim], dtype=np.int64) // usable.itemsize
    n = _sample(
        points[facets], normals, pieces, near, box.origin, box.dx, box.cells, box.periodic, box.lo, box.hi, box.ghost,
        strides, usable.ravel(), facet, shapes, cells, weights,
    )  # fmt: skip
    facet, shapes, cells, weights = facet[:n], shapes[:n], cells[:n], weights[:n]
    if curved is not None:
        shapes = curved.means(facet, shapes, pieces[facet])
    shapes = shapes / pieces[facet, None] ** (dim - 1)
    width = shapes.shape[1]
    rows = np.arange(0, n * width + 1, width)
    shape_weights = csr_matrix(
        (shapes.ravel(), (facet[:, None] * width + np.arange(width)).ravel(), rows), shape=(n, len(facets) * width)
    ).T.tocsr()
    used = weights.ravel() != 0.0
    indptr = np.concatenate(([0], np.cumsum(used.reshape(n, 2**dim).sum(axis=1))))
    stencils = csr_matrix((weights.ravel()[used], cells.ravel()[used], indptr), shape=(n, usable.size))
    return shape_weights, stencils


def _facets_near(corners: np.ndarray, box: Box) -> np.ndarray:
    """Return the facets that may have points in owned cells; on periodic axes all of them may."""
    low = (corners.min(axis=1) - box.origin) / box.dx
    high = (corners.max(axis=1) - box.origin) / box.dx
    # points outside the grid belong to the nearest cell
    meets = ((high >= box.lo - 1) | (box.lo == 0)) & ((low <= box.hi + 1) | (box.hi == box.cells))
    return np.flatnonzero(np.all(meets | box.periodic, axis=1))


@njit(cache=True)
def _sample(
    corners, normals, pieces, near, origin, dx, n_cells, periodic, lo, hi, ghost, strides, usable,
    facet, shapes, cells, weights,
):  # fmt: skip
    """Fill facet, barycentric coordinates and stencil of each quadrature point of this rank; return their number."""
    dim = len(dx)
    n = 0
    s = np.empty(dim)
    for f in near:
        k = pieces[f]
        for piece in range(k ** (dim - 1)):
            _centroid(dim, k, piece, shapes[n])
            mine = True
            for a in range(dim):
                x = 0.0
                for i in range(dim):
                    x += shapes[n, i] * corners[f, i, a]
                s[a] = (x - origin[a]) / dx[a]
                if periodic[a]:
                    s[a] -= np.floor(s[a] / n_cells[a]) * n_cells[a]
                cell = min(max(int(np.floor(s[a])), 0), n_cells[a] - 1)
                mine = mine and lo[a] <= cell < hi[a]
            if mine and _stencil(s, normals[f], dx, lo, ghost, hi, strides, usable, cells[n], weights[n]):
                facet[n] = f
                n += 1
    return n


@njit(cache=True)
def _centroid(dim, k, piece, shape):
    """Fill the barycentric coordinates of the centroid of one of the k (2D) or k² (3D) equal pieces of a facet."""
    if dim == 2:
        shape[1] = (piece + 0.5) / k
        shape[0] = 1.0 - shape[1]
        return
    # pairs of triangles in a k x k square; those beyond the diagonal are folded back
    i, j = piece // k, piece % k
    if i + j < k:
        shape[1], shape[2] = (i + 1.0 / 3.0) / k, (j + 1.0 / 3.0) / k
    else:
        shape[1], shape[2] = (k - 1 - i + 2.0 / 3.0) / k, (k - 1 - j + 2.0 / 3.0) / k
    shape[0] = 1.0 - shape[1] - shape[2]


@njit(cache=True)
def _stencil(s, normal, dx, lo, ghost, hi, strides, usable, cells, weights):
    """Fill the cells and weights that give the pressure at ``s`` (in cells from the grid's corner); False if none.

    Tried first around the point itself, then half a cell and a cell in front of the facet.
    """
    dim = len(s)
    smallest = dx.min()
    for step in range(3):
        total = 0.0
        for corner in range(2**dim):
            weight, flat, height, there = 1.0, 0, 0.0, True
            for a in range(dim):
                r = s[a] + 0.5 * step * normal[a] - 0.5
                cell = int(np.floor(r))
                t = r - cell
                if corner >> a & 1:
                    cell += 1
                    weight *= t
                else:
                    weight *= 1.0 - t
                local = cell - lo[a] + ghost[a]
                there = there and 0 <= local < hi[a] - lo[a] + 2 * ghost[a]
                flat += local * strides[a]
                height += (cell + 0.5 - s[a]) * dx[a] * normal[a]
            good = there and height > -_ON_PLANE * smallest and usable[flat]
            cells[corner] = flat if good else 0
            weights[corner] = weight if good else 0.0
            total += weights[corner]
        if total > _LEAST_WEIGHT:
            weights /= total
            return True
    return False
