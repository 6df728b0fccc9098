"""Which particles stand before which facets of a surface, how near, and on whose points they lean.

Each part of a surface, be it a facet, an edge or a point, has the particles for which it is the nearest place on all
facets that it belongs to. So before a face that is flat or convex a particle meets one part: the facet where its foot
is, or at a convex edge or corner the edge or the point, which push straight away from themselves; normals and weights
go over into each other without a jump. Before a concave edge it meets both facets. If these hardly differ in direction
(a surface that bends), each has its share, one over the sum of the cosines between their normals: one in all where it
is flat, one each in a square corner. What lies behind the plane of a facet that it meets is hidden, be it across a
body thinner than particles see, or the edge of a body flush with another.

With psi the distance, R the reach and lambda the barycentric coordinates of the foot on the facet's points a,

    q = max(psi/R, FLOOR),     w_a = (1 - cos(pi lambda_a)) / sum_b (1 - cos(pi lambda_b)),

which on a segment of length db is (1 + cos(pi xi/db))/2 of Monaghan and Kos, xi along it from the point. A particle
whose nearest place it stands behind meets that place alone, with q = FLOOR, and is pushed out through it.

References
----------
J. J. Monaghan, A. Kos, J. Waterway, Port, Coastal, Ocean Eng. 125 (1999), 145: nodes and the cosine along the surface.
J. A. Baerentzen, H. Aanaes, IEEE Trans. Vis. Comput. Graph. 11 (2005), 243: the side of an edge or a point by the
normals around it, weighted by angle. C. Ericson, Real-Time Collision Detection (2005), 5.1.5: nearest on a triangle.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.fields.sph.particles import Swarm
from petfsi.geometry.slabs import area_vectors

#: Particles are not nearer than this part of the reach. From here contacts are stiffer than the fluid's sound, and the
#: way there stops whatever is slower than a fifth of sound.
FLOOR = 0.01
#: Places that are less than this part of the reach apart are at the same height.
FLUSH = 1e-9


class Contacts(NamedTuple):
    """Contacts of this rank's particles with facets, by particle and facet.

    Attributes
    ----------
    row, facet : ndarray of int, shape (k,)
        Of the swarm and of the surface.
    weight : ndarray, shape (k, dim)
        w of the facet's points, in their order; sums to one.
    normal : ndarray, shape (k, dim)
        Unit, towards the fluid.
    q : ndarray, shape (k,)
        Distance over the reach, from FLOOR to 1.
    share : ndarray, shape (k,)
        How much of the contact counts, up to 1.
    n_behind : int
        So many of the particles stand behind the surface.
    """

    row: np.ndarray
    facet: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    q: np.ndarray
    share: np.ndarray
    n_behind: int


def contacts(swarm: Swarm, points: np.ndarray, facets: np.ndarray, reach: float, slack: float) -> Contacts:
    """Return the contacts of owned particles nearer than ``reach`` to a surface and its periodic images.

    Not collective.

    Parameters
    ----------
    swarm : Swarm
        Sorted; since then no particle has gone farther than ``slack``, m.
    points : ndarray, shape (n_points, dim)
        m.
    facets : ndarray of int, shape (m, dim)
        Normals into the fluid.
    reach, slack : float
        m.
    """
    facet, point, corner = _images(swarm, points, facets, reach + slack)
    vectors = area_vectors(points, facets)
    area = np.linalg.norm(vectors, axis=1)
    normal = (vectors / np.where(area > 0.0, area, 1.0)[:, None])[facet]
    x = swarm["x"]
    low, high = corner.min(axis=1) - reach, corner.max(axis=1) + reach
    cells = [swarm.grid.of(low - slack) - swarm.corner, swarm.grid.of(high + slack) - swarm.corner]
    counts = np.asarray(swarm.counts, dtype=np.int64)
    first_cell, last_cell = (np.clip(c, 0, counts - 1) for c in cells)
    start, near = _near(x, swarm.owned, swarm.first, counts, low, high, first_cell, last_cell)
    row, image, weight, push, q, share, n_behind = _meet(x, start, near, point, corner, normal, reach)
    return Contacts(row, facet[image], weight, push, q, share, n_behind)


def _images(swarm: Swarm, points: np.ndarray, facets: np.ndarray, margin: float) -> tuple[np.ndarray, ...]:
    """Return the facets, or their images, that reach into this rank's cells: which, their points, and where these are.

    Points of different images have different numbers.
    """
    grid = swarm.grid
    period = np.where(grid.periodic, grid.counts * grid.side, 0.0)
    low = grid.low + swarm.corner * grid.side - margin
    high = grid.low + (swarm.corner + swarm.counts) * grid.side + margin
    corner = points[facets]
    parts = []
    for number, shift in enumerate(product(*((0, -1, 1) if p > 0 else (0,) for p in period))):
        place = corner + np.array(shift) * period
        use = np.flatnonzero(np.all((place.max(axis=1) > low) & (place.min(axis=1) < high), axis=1))
        parts.append((use, facets[use] + number * len(points), place[use]))
    facet, point, place = (np.concatenate(part) for part in zip(*parts, strict=True))
    return facet, point.astype(np.int64), np.ascontiguousarray(place)


@njit(cache=True)
def _near(x, owned, first, counts, low, high, first_cell, last_cell):
    """Return for each row the boxes from ``low`` to ``high`` that it is in, in increasing order, as a list of lists."""
    n, dim = x.shape
    start = np.zeros(n + 1, dtype=np.int64)
    fill = np.zeros(n, dtype=np.int64)
    near = np.zeros(0, dtype=np.int64)
    for fills in (False, True):
        if fills:
            start[1:] = np.cumsum(start[1:])
            fill[:] = start[:-1]
            near = np.zeros(start[n], dtype=np.int64)
        for f in range(low.shape[0]):
            a, b = first_cell[f], last_cell[f]
            for c0 in range(a[0], b[0] + 1):
                for c1 in range(a[1] if dim == 3 else 0, (b[1] if dim == 3 else 0) + 1):
                    line = c0 * counts[1] + c1 if dim == 3 else c0
                    begin = first[line * counts[dim - 1] + a[dim - 1]]
                    end = first[line * counts[dim - 1] + b[dim - 1] + 1]
                    for i in range(begin, end):
                        inside = owned[i]
                        for axis in range(dim):
                            inside = inside and low[f, axis] < x[i, axis] < high[f, axis]
                        if inside and fills:
                            near[fill[i]] = f
                            fill[i] += 1
                        elif inside:
                            start[i + 1] += 1
    return start, near


@njit(cache=True)
def _dot(a, b):
    total = 0.0
    for axis in range(a.size):
        total += a[axis] * b[axis]
    return total


@njit(cache=True)
def _nearest(x, corner, weight):
    """Write the barycentric coordinates of the place on a facet (dim, dim) that is nearest to x.

    Of places on an edge or a point those of other points are zero exactly.
    """
    weight[:] = 0.0
    if x.size == 3:
        _nearest_on_triangle(x, corner, weight)
        return
    edge = corner[1] - corner[0]
    to_first, to_second = _dot(x - corner[0], edge), _dot(corner[1] - x, edge)
    if to_first <= 0.0:
        weight[0] = 1.0
    elif to_second <= 0.0:
        weight[1] = 1.0
    else:
        weight[0] = to_second / (to_first + to_second)
        weight[1] = to_first / (to_first + to_second)


@njit(cache=True)
def _nearest_on_triangle(x, corner, weight):
    along = np.empty((3, 3))  # (b - a).(x - a)
    for a in range(3):
        for b in range(3):
            along[a, b] = _dot(corner[b] - corner[a], x - corner[a])
    for a in range(3):
        if along[a, (a + 1) % 3] <= 0.0 and along[a, (a + 2) % 3] <= 0.0:
            weight[a] = 1.0
            return
    vector = _cross(corner[1] - corner[0], corner[2] - corner[0])
    total = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        inside = _dot(_cross(corner[c] - corner[b], x - corner[b]), vector)
        if inside <= 0.0 and along[b, c] > 0.0 and along[c, b] > 0.0:
            weight[:] = 0.0
            weight[b] = along[c, b] / (along[b, c] + along[c, b])
            weight[c] = along[b, c] / (along[b, c] + along[c, b])
            return
        weight[a] = max(inside, 0.0)
        total += weight[a]
    for a in range(3):
        weight[a] /= total if total > 0.0 else 1.0


@njit(cache=True)
def _add(a, factor, b):
    """Add factor b to a."""
    for axis in range(a.size):
        a[axis] += factor * b[axis]


@njit(cache=True)
def _cross(a, b):
    c = np.empty(3)
    for axis in range(3):
        n, m = (axis + 1) % 3, (axis + 2) % 3
        c[axis] = a[n] * b[m] - a[m] * b[n]
    return c


@njit(cache=True)
def _has(point, weight, j, k):
    """Whether facet j has all the points of the part of the surface that facet k's nearest place is on."""
    for a in range(point.shape[1]):
        if weight[k, a] > 0.0:
            found = False
            for b in range(point.shape[1]):
                found = found or point[j, b] == point[k, a]
            if not found:
                return False
    return True


@njit(cache=True)
def _is_same(point, weight, j, k):
    """Whether the nearest places of facets j and k are on the same part."""
    n = 0
    for a in range(point.shape[1]):
        n += (weight[j, a] > 0.0) - (weight[k, a] > 0.0)
    return n == 0 and _has(point, weight, j, k) and _has(point, weight, k, j)


@njit(cache=True)
def _touches(point, j, k):
    """Whether facets j and k have a point in common."""
    for a in range(point.shape[1]):
        for b in range(point.shape[1]):
            if point[j, a] == point[k, b]:
                return True
    return False


@njit(cache=True)
def _angle(corner, a):
    """Return the angle of a triangle at its point a."""
    first, second = corner[(a + 1) % 3] - corner[a], corner[(a + 2) % 3] - corner[a]
    return np.arctan2(np.sqrt(max(_dot(_cross(first, second), _cross(first, second)), 0.0)), _dot(first, second))


@njit(cache=True)
def _part(point, weight, corner, normal, k, outward):
    """Write the normal of the part that facet k's nearest place is on, not of length one; return what it is to it.

    Returns
    -------
    agreed, closed : bool
        Whether the part is nearest on all its facets, and whether an edge has more than one of them.
    """
    dim = point.shape[1]
    corners = 0
    for a in range(dim):
        corners += weight[k, a] > 0.0
    outward[:] = 0.0
    if corners == dim:
        _add(outward, 1.0, normal[k])
        return True, True
    agreed, number = True, 0
    for j in range(point.shape[0]):
        if not _has(point, weight, j, k):
            continue
        agreed = agreed and _is_same(point, weight, j, k)
        number += 1
        factor = 1.0
        if dim == 3 and corners == 1:
            for a in range(3):
                for b in range(3):
                    if weight[k, a] > 0.0 and point[j, b] == point[k, a]:
                        factor = _angle(corner[j], b)
        _add(outward, factor, normal[j])
    return agreed, number > 1


@njit(cache=True)
def _way(x, corner, weight, normal, way):
    """Write the way from the nearest place on a facet to x, along its normal inside of it; return how long it is."""
    way[:] = 0.0
    _add(way, 1.0, x)
    corners = 0
    for a in range(weight.size):
        _add(way, -weight[a], corner[a])
        corners += weight[a] > 0.0
    if corners == weight.size:
        height = _dot(way, normal)
        way[:] = 0.0
        _add(way, height, normal)
        return abs(height)
    return np.sqrt(_dot(way, way))


@njit(cache=True)
def _met(x, point, corner, normal, reach, weight, push, psi, counts):
    """Find the facets that the particle at x meets among those near it, and how.

    Writes ``weight`` (k, dim) of the nearest places, ``push`` (k, dim) towards the fluid, ``psi`` (k,) and whether each
    ``counts`` (k,). Returns whether the particle stands behind the surface.
    """
    k = point.shape[0]
    way, outward = np.empty(x.size), np.empty(x.size)
    counts[:] = False
    nearest = -1
    for f in range(k):
        _nearest(x, corner[f], weight[f])
        psi[f] = _way(x, corner[f], weight[f], normal[f], way)
        push[f, :] = 0.0
        if psi[f] > 0.0:
            _add(push[f], 1.0 / psi[f], way)
        else:
            _add(push[f], 1.0, normal[f])
        if nearest < 0 or psi[f] < psi[nearest]:
            nearest = f
    if nearest < 0 or psi[nearest] >= reach:
        return False
    _, closed = _part(point, weight, corner, normal, nearest, outward)
    if closed and (psi[nearest] == 0.0 or _dot(push[nearest], outward) < 0.0):
        if psi[nearest] > 0.0:
            _add(push[nearest], -2.0, push[nearest])
        psi[nearest], counts[nearest] = 0.0, True
        return True
    for f in range(k):
        if psi[f] < reach:
            agreed, closed = _part(point, weight, corner, normal, f, outward)
            counts[f] = (agreed or f == nearest) and closed and _dot(push[f], outward) > 0.0
            for j in range(f):
                counts[f] = counts[f] and not (counts[j] and _is_same(point, weight, j, f))
    _hide(weight, push, psi, reach, counts)
    return False


@njit(cache=True)
def _hide(weight, push, psi, reach, counts):
    """Let what lies behind the plane of a facet that the particle meets not count; nor edges and points in it."""
    faces = counts.copy()
    for g in range(psi.size):
        for a in range(weight.shape[1]):
            faces[g] = faces[g] and weight[g, a] > 0.0
    for f in np.flatnonzero(counts):
        least = -FLUSH * reach if faces[f] else FLUSH * reach
        for g in np.flatnonzero(faces):
            if g != f and psi[g] - psi[f] * _dot(push[f], push[g]) < least:
                counts[f] = False


@njit(cache=True)
def _meet(x, start, near, image_point, image_corner, image_normal, reach):
    """Return the columns of ``Contacts``, with images for facets."""
    dim, most = x.shape[1], near.size
    row, image = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    weights, normals, q, share = np.empty((most, dim)), np.empty((most, dim)), np.empty(most), np.empty(most)
    n = n_behind = 0
    for i in range(x.shape[0]):
        these = near[start[i] : start[i + 1]]
        k = these.size
        if k == 0:
            continue
        point, corner, normal = image_point[these], image_corner[these], image_normal[these]
        weight, push, psi, counts = np.empty((k, dim)), np.empty((k, dim)), np.empty(k), np.zeros(k, dtype=np.bool_)
        n_behind += _met(x[i], point, corner, normal, reach, weight, push, psi, counts)
        for f in np.flatnonzero(counts):
            alike = 1.0
            for j in np.flatnonzero(counts):
                if j != f and _touches(point, j, f):
                    alike += max(_dot(push[j], push[f]), 0.0)
            total = 0.0
            for a in range(dim):
                total += 1.0 - np.cos(np.pi * weight[f, a])
            for a in range(dim):
                weights[n, a], normals[n, a] = (1.0 - np.cos(np.pi * weight[f, a])) / total, push[f, a]
            row[n], image[n], q[n], share[n] = i, these[f], max(psi[f] / reach, FLOOR), 1.0 / alike
            n += 1
    return row[:n], image[:n], weights[:n], normals[:n], q[:n], share[:n], n_behind
