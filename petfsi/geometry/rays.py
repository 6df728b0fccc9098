"""Where the lines of a lattice of points cross a surface: which points lie inside, which neighbours are cut apart.

Every lattice point stands for itself plus an infinitesimal shift (see ``predicates``), so that a line never meets a
vertex or an edge, a closed surface is left as often as it is entered, and a point on the surface belongs to the side
that a half-open box [low, high) would give it. Nothing here communicates, and nothing depends on how a larger
lattice is cut among ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.predicates import above, side


class Crossings(NamedTuple):
    """Crossings of the lattice lines along one axis with facets, ``m`` in all.

    Attributes
    ----------
    beyond : ndarray of int64, shape (m, dim)
        The lattice point that is the first beyond the crossing; 0 along the axis where the crossing lies below all.
    facet : ndarray of int32, shape (m,)
        Facet numbers.
    weights : ndarray, shape (m, dim)
        Barycentric coordinates of the crossing on its facet; they sum to one.
    coordinate : ndarray, shape (m,)
        Of the crossing, along the axis.
    sign : ndarray of int8, shape (m,)
        +1 where the line enters the surface (against the normal), -1 where it leaves.
    """

    beyond: np.ndarray
    facet: np.ndarray
    weights: np.ndarray
    coordinate: np.ndarray
    sign: np.ndarray


class Hits(NamedTuple):
    """At most one crossing per segment between neighbouring lattice points: the one nearest to its middle.

    Attributes
    ----------
    segment : ndarray of int64, shape (m,)
        Ascending flat index into an array of the lattice's shape with one fewer along the axis.
    facet, weights
        As in ``Crossings``.
    """

    segment: np.ndarray
    facet: np.ndarray
    weights: np.ndarray


def cast(points: np.ndarray, facets: np.ndarray, coords: Sequence[np.ndarray], axis: int) -> Crossings:
    """Return all crossings of the lattice lines along ``axis`` with facets, those above the last point left out.

    The cost is that of the lines that pass through the facets' bounding boxes.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        Points of the surface.
    facets : ndarray of int, shape (n_facets, dim)
        Segments (2D) or triangles (3D) with outward normals as in ``surfaces.Surface``.
    coords : sequence of ndarray
        Ascending coordinates of the lattice points along each axis.
    axis : int
        The direction of the lines.
    """
    dim = points.shape[1]
    corners = points[facets]
    low, high = corners.min(axis=1), corners.max(axis=1)
    begin = np.empty((len(facets), dim), dtype=np.int64)
    end = np.empty_like(begin)
    for a in range(dim):
        begin[:, a] = np.searchsorted(coords[a], low[:, a], side="left")
        end[:, a] = np.searchsorted(coords[a], high[:, a], side="right")
    others = [a for a in range(dim) if a != axis]
    lines = np.prod(end[:, others] - begin[:, others], axis=1)
    lines[begin[:, axis] == len(coords[axis])] = 0
    some = np.flatnonzero(lines)
    n_lines = int(lines[some].sum())
    found = Crossings(
        np.empty((n_lines, dim), dtype=np.int64),
        np.empty(n_lines, dtype=np.int32),
        np.empty((n_lines, dim)),
        np.empty(n_lines),
        np.empty(n_lines, dtype=np.int8),
    )
    lattice = tuple(np.ascontiguousarray(c, dtype=float) for c in coords[:dim])
    kernel = _cast_2d if dim == 2 else _cast_3d
    count = kernel(corners, some, begin, end, lattice, axis, *found)
    below_top = np.flatnonzero(found.beyond[:count, axis] < len(coords[axis]))
    return select(found, below_top)


def select(crossings: Crossings, which: np.ndarray) -> Crossings:
    """Return some of the crossings, by number or mask."""
    return Crossings(*(part[which] for part in crossings))


def windings(crossings: Crossings, shape: tuple[int, ...], axis: int) -> np.ndarray:
    """Return how many times the surface winds around each lattice point, int16: 0 outside, 1 inside.

    A surface whose normals point inward gives -1, two bodies that overlap give 2, a cavity gives 0 again.
    """
    dim = crossings.beyond.shape[1]
    steps = np.zeros(shape, dtype=np.int16)
    np.add.at(steps.reshape(shape[:dim]), tuple(crossings.beyond.T), crossings.sign.astype(np.int16))
    return np.cumsum(steps, axis=axis, dtype=np.int16, out=steps)


def inside_mask(points: np.ndarray, facets: np.ndarray, coords_per_axis: Sequence[np.ndarray]) -> np.ndarray:
    """Return 1 for each lattice point inside a closed surface, else 0: uint8, shape ``(len(x), len(y)[, len(z)])``.

    In 2D a third axis with one coordinate may be given; it only adds an axis to the shape.
    """
    shape = tuple(len(c) for c in coords_per_axis)
    return (windings(cast(points, facets, coords_per_axis, 0), shape, 0) != 0).astype(np.uint8)


def nearest_hits(crossings: Crossings, coords: Sequence[np.ndarray], axis: int) -> Hits:
    """Return, for every segment between lattice neighbours along ``axis`` that is crossed, the hit at its middle.

    Of hits equally near the one of the lower facet is taken.
    """
    dim = crossings.beyond.shape[1]
    on = np.flatnonzero(crossings.beyond[:, axis] > 0)
    index = crossings.beyond[on].copy()
    index[:, axis] -= 1
    shape = tuple(len(c) - (a == axis) for a, c in enumerate(coords[:dim]))
    segment = np.ravel_multi_index(tuple(index.T), shape)
    line = np.asarray(coords[axis])
    middle = 0.5 * (line[index[:, axis]] + line[index[:, axis] + 1])
    distance = np.abs(crossings.coordinate[on] - middle)
    order = np.lexsort((crossings.facet[on], distance, segment))
    segment, first = np.unique(segment[order], return_index=True)
    chosen = on[order[first]]
    return Hits(segment, crossings.facet[chosen], crossings.weights[chosen])


def nearest_on_facets(points: np.ndarray, facets: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the facet (n,) nearest to each of the points ``at`` (n, dim) and the barycentric weights (n, dim) there.

    Every facet is looked at for every point: for the few that need it.
    """
    facet = np.empty(len(at), dtype=np.int32)
    weights = np.empty((len(at), points.shape[1]))
    _nearest_on_facets(points[facets], np.ascontiguousarray(at, dtype=float), facet, weights)
    return facet, weights


@njit(cache=True)
def _cast_2d(corners, some, begin, end, lattice, axis, index, facet, weights, coordinate, sign):
    """Fill the crossings of lines along ``axis`` with segments and return their number."""
    other = 1 - axis
    along, across = lattice[axis], lattice[other]
    p = np.empty(2)
    n = 0
    for f in some:
        u, v = corners[f, 0], corners[f, 1]
        up = v[other] > u[other]
        low, high = (u[other], v[other]) if up else (v[other], u[other])
        enters = up == (axis == 1)
        for j in range(begin[f, other], end[f, other]):
            if not low <= across[j] < high:
                continue
            p[other] = across[j]
            t = min(max((p[other] - u[other]) / (v[other] - u[other]), 0.0), 1.0)
            x = (1.0 - t) * u[axis] + t * v[axis]
            k = min(max(np.searchsorted(along, x), begin[f, axis]), end[f, axis])
            # outside is to the right of the segment; beyond the crossing is outside where the line leaves
            beyond = 1 if enters else -1
            while k < end[f, axis]:
                p[axis] = along[k]
                if side(p[0], p[1], u[0], u[1], v[0], v[1], True) == beyond:
                    break
                k += 1
            while k > begin[f, axis]:
                p[axis] = along[k - 1]
                if side(p[0], p[1], u[0], u[1], v[0], v[1], True) != beyond:
                    break
                k -= 1
            index[n, axis], index[n, other], facet[n] = k, j, f
            weights[n, 0], weights[n, 1], coordinate[n] = 1.0 - t, t, x
            sign[n] = 1 if enters else -1
            n += 1
    return n


@njit(cache=True)
def _cast_3d(corners, some, begin, end, lattice, axis, index, facet, weights, coordinate, sign):
    """Fill the crossings of lines along ``axis`` with triangles and return their number."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    along, across_b, across_c = lattice[axis], lattice[b], lattice[c]
    w, p = np.empty(3), np.empty(3)
    n = 0
    for f in some:
        q = corners[f]
        for j in range(begin[f, b], end[f, b]):
            for m in range(begin[f, c], end[f, c]):
                y, z = across_b[j], across_c[m]
                turn = side(y, z, q[0, b], q[0, c], q[1, b], q[1, c], b < c)
                if turn == 0 or turn != side(y, z, q[1, b], q[1, c], q[2, b], q[2, c], b < c):
                    continue
                if turn != side(y, z, q[2, b], q[2, c], q[0, b], q[0, c], b < c):
                    continue
                for i in range(3):
                    r, s = q[(i + 1) % 3], q[(i + 2) % 3]
                    w[i] = max(turn * ((r[b] - y) * (s[c] - z) - (r[c] - z) * (s[b] - y)), 0.0)
                total = w[0] + w[1] + w[2]
                for i in range(3):
                    weights[n, i] = w[i] / total if total > 0.0 else 1.0 / 3.0
                x = weights[n, 0] * q[0, axis] + weights[n, 1] * q[1, axis] + weights[n, 2] * q[2, axis]
                p[b], p[c] = y, z
                index[n, axis] = _first_beyond(q, p, along, axis, turn, x, begin[f, axis], end[f, axis])
                index[n, b], index[n, c], facet[n] = j, m, f
                coordinate[n] = x
                sign[n] = -turn
                n += 1
    return n


@njit(cache=True)
def _first_beyond(q, p, along, axis, turn, x, begin, end):
    """Return the first index in [begin, end] whose (moved) point lies beyond the plane of a triangle.

    ``p`` is a point of the line along ``axis``, its entry there is scratch; ``x`` is the crossing up to rounding;
    ``turn`` is the sign of the normal along the line.
    """
    k = min(max(np.searchsorted(along, x), begin), end)
    while k < end:
        p[axis] = along[k]
        if above(p, q) == turn:
            break
        k += 1
    while k > begin:
        p[axis] = along[k - 1]
        if above(p, q) != turn:
            break
        k -= 1
    return k


@njit(cache=True)
def _nearest_on_facets(corners, at, facet, weights):
    """Fill the nearest facet and the weights of the nearest point on it, for each point of ``at``."""
    dim = at.shape[1]
    w = np.empty(dim)
    for i in range(len(at)):
        best = np.inf
        for f in range(len(corners)):
            if dim == 2:
                _nearest_on_segment(corners[f], at[i], w)
            else:
                _nearest_on_triangle(corners[f], at[i], w)
            distance = 0.0
            for a in range(dim):
                x = 0.0
                for k in range(dim):
                    x += w[k] * corners[f, k, a]
                distance += (x - at[i, a]) ** 2
            if distance < best:
                best = distance
                facet[i] = f
                weights[i] = w


@njit(cache=True)
def _nearest_on_segment(q, x, w):
    """Fill the weights of the point of a segment nearest to x."""
    e = q[1] - q[0]
    length2 = np.dot(e, e)
    t = np.dot(x - q[0], e) / length2 if length2 > 0.0 else 0.0
    w[1] = min(max(t, 0.0), 1.0)
    w[0] = 1.0 - w[1]


@njit(cache=True)
def _nearest_on_triangle(q, x, w):
    """Fill the weights of the point of a triangle nearest to x: its foot, or the nearest point of its edges."""
    e, g, r = q[1] - q[0], q[2] - q[0], x - q[0]
    ee, eg, gg, re, rg = np.dot(e, e), np.dot(e, g), np.dot(g, g), np.dot(r, e), np.dot(r, g)
    det = ee * gg - eg * eg
    if det > 0.0:
        s, t = (gg * re - eg * rg) / det, (ee * rg - eg * re) / det
        if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
            w[0], w[1], w[2] = 1.0 - s - t, s, t
            return
    best = np.inf
    edge, v = np.empty((2, 3)), np.empty(2)
    for i in range(3):
        j = (i + 1) % 3
        edge[0], edge[1] = q[i], q[j]
        _nearest_on_segment(edge, x, v)
        gap = v[0] * edge[0] + v[1] * edge[1] - x
        if np.dot(gap, gap) < best:
            best = np.dot(gap, gap)
            w[:] = 0.0
            w[i], w[j] = v[0], v[1]
