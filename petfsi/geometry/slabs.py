"""Facets cut into the slabs between the planes of a regular grid, where those planes have whole coordinates.

A part of a facet is a row of points and of tags. In 3D tag ``i`` says what the side from point ``i`` to the next
one is part of, in 2D what ends the part at point ``i``: the facet's own edge (corner) ``tag < 3``, or the plane
``PLANE + 2 axis + side``. A point that lies exactly on a plane counts as above it. Two facets with a common edge are
cut there at the same points, to the last bit, and the parts of a facet on both sides of a plane share theirs; so
which parts touch in a cell is known from tags alone, and whatever is degenerate stays consistent.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: The tag of the low side of the x axis; then its high side, the low side of y, ...
PLANE = 3

#: Points that a part can have: a triangle gains two in each of three slabs; rounding may add a few.
MOST = 32


@njit(cache=True)
def _crossing(points, i, j, axis, plane, out, m):
    """Write the point where the line between two points meets a plane; it does not depend on their order."""
    width = points.shape[1]
    for a in range(width // 2):
        if points[i, a] != points[j, a]:
            if points[j, a] < points[i, a]:
                i, j = j, i
            break
    begin, end = points[i, axis], points[j, axis]
    t = (plane - begin) / (end - begin)
    if begin == plane or end == plane:
        t = 0.0
        i = i if begin == plane else j
        j = i
    for a in range(width):
        p, q = points[i, a], points[j, a]
        x = p + t * (q - p)
        # never beyond the ends: a part must stay in the slabs it was cut to before
        low, high = (p, q) if p < q else (q, p)
        out[m, a] = low if x < low else (high if x > high else x)
    out[m, axis] = plane


@njit(cache=True)
def _zone(x, low, high):
    return -1 if x < low else (1 if x >= high else 0)


@njit(cache=True)
def clip_polygon(points, tags, n, axis, low, high, out, out_tags):
    """Write the part of a convex polygon with low <= x_axis < high and return its number of points, maybe 0.

    Parameters
    ----------
    points, out : ndarray, shape (MOST, 6)
        Three coordinates and three weights of the facet's corners a point.
    tags, out_tags : ndarray of int, shape (MOST,)
    """
    m = 0
    zone = _zone(points[0, axis], low, high)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        next_zone = _zone(points[j, axis], low, high)
        if zone == 0:
            for a in range(6):
                out[m, a] = points[i, a]
            out_tags[m] = tags[i]
            m += 1
        elif next_zone != zone:
            _crossing(points, i, j, axis, low if zone < 0 else high, out, m)
            out_tags[m] = tags[i]
            m += 1
        if next_zone != 0 and next_zone != zone:
            _crossing(points, i, j, axis, low if next_zone < 0 else high, out, m)
            out_tags[m] = PLANE + 2 * axis + (next_zone > 0)
            m += 1
        zone = next_zone
    return m


@njit(cache=True)
def clip_segment(points, tags, axis, low, high, out, out_tags):
    """Write the part of a segment with low <= x_axis < high and return its number of points, 2 or 0.

    Parameters
    ----------
    points, out : ndarray, shape (2, 4)
        Two coordinates and two weights of the facet's corners a point.
    tags, out_tags : ndarray of int, shape (2,)
    """
    for i in range(2):
        zone = _zone(points[i, axis], low, high)
        if zone == 0:
            for a in range(4):
                out[i, a] = points[i, a]
            out_tags[i] = tags[i]
        elif zone == _zone(points[1 - i, axis], low, high):
            return 0
        else:
            _crossing(points, 0, 1, axis, low if zone < 0 else high, out, i)
            out_tags[i] = PLANE + 2 * axis + (zone > 0)
    return 2


@njit(cache=True)
def slab_range(points, n, axis, lo, hi):
    """Return the first slab and one past the last that n points reach, and whether it is one that holds them all.

    The slabs are those from lo to below hi, and lo - 1 for all that lies below.
    """
    if n == 0:
        return hi, hi, False
    low = high = points[0, axis]
    for i in range(1, n):
        low, high = min(low, points[i, axis]), max(high, points[i, axis])
    if low >= hi:
        return hi, hi, False
    first, last = math.floor(max(low, lo - 1.0)), math.floor(max(min(high, hi - 1.0), lo - 1.0))
    return int(first), int(last) + 1, first >= lo and high < first + 1.0


@njit(cache=True)
def load_facet(x, corners, points, tags):
    """Write a facet's corners, their weights and tags."""
    dim = len(corners)
    for i in range(dim):
        for a in range(dim):
            points[i, a] = x[corners[i], a]
            points[i, dim + a] = 1.0 if a == i else 0.0
        tags[i] = i


@njit(cache=True)
def clip_to_cell(x, corners, cell, points, tags):
    """Write the part of a facet in one cell to points[-1], tags[-1], in coordinates about its centre.

    Parameters
    ----------
    points : ndarray, shape (2, MOST, 2 dim)
        Room for parts.
    tags : ndarray of int, shape (2, MOST)

    Returns
    -------
    int
        The number of points.
    """
    dim = len(cell)
    load_facet(x, corners, points[0], tags[0])
    n = dim
    for axis in range(dim):
        low = float(cell[axis])
        if dim == 3:
            n = clip_polygon(points[0], tags[0], n, axis, low, low + 1.0, points[1], tags[1])
        else:
            n = clip_segment(points[0], tags[0], axis, low, low + 1.0, points[1], tags[1])
        if n == 0:
            return 0
        for i in range(n):
            for a in range(2 * dim):
                points[0, i, a] = points[1, i, a]
            tags[0, i] = tags[1, i]
    for i in range(n):
        for axis in range(dim):
            points[1, i, axis] -= cell[axis] + 0.5
    return n


#: Vertices nearer to a plane than this fraction of a cell are moved beyond it.
SNAP = 1e-9


def off_planes(x: np.ndarray, facets: np.ndarray, place: np.ndarray | None = None) -> np.ndarray:
    """Return points in units of cells, none of them nearer than ``SNAP`` to a plane.

    A vertex at a plane is moved beyond it to where the solid grows, along the sum of the adjacent facets' area
    vectors, so that a surface in a plane leaves no sliver of fluid. Points of one ``place`` (ndarray of int, shape
    (n,)) move alike.
    """
    plane = np.rint(x)
    near = np.abs(x - plane) < SNAP
    if near.any():
        dim = x.shape[1]
        x = x.copy()
        area = area_vectors(x, facets)
        normal = np.zeros_like(x)
        corners = facets.ravel() if place is None else place[facets].ravel()
        for a in range(dim):
            normal[:, a] = np.bincount(corners, weights=np.repeat(area[:, a], dim), minlength=len(x))
        if place is not None:
            normal = normal[place]
        x[near] = (plane + np.where(normal >= 0.0, SNAP, -SNAP))[near]
    return x


def area_vectors(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return each facet's area times its outward unit normal, shape (m, dim)."""
    corner = points[facets]
    if points.shape[1] == 2:
        edge = corner[:, 1] - corner[:, 0]
        return np.column_stack((edge[:, 1], -edge[:, 0]))
    return 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
