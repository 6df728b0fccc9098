"""Patches of a cell and its faces, each in its plane, divided into tiles by what meets it there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.slabs import MOST, PLANE, clip_to_cell
from petfsi.geometry.tiles import Tiles, divide, measure, tile_at
from petfsi.geometry.unions import SURE
from petfsi.geometry.walks import NOTHING


class Polygons(NamedTuple):
    """The patches of a cell about its centre.

    Attributes
    ----------
    points : ndarray, shape (n, MOST, 6)
        Coordinates, and weights of the facet's corners.
    tags : ndarray of int, shape (n, MOST)
        As in ``slabs``.
    n_points : ndarray of int, shape (n,)
    normal : ndarray, shape (n, 3)
        The facet's; not of unit length.
    """

    points: np.ndarray
    tags: np.ndarray
    n_points: np.ndarray
    normal: np.ndarray


class Plane(NamedTuple):
    """A plane with the tiles of a polygon in it.

    Attributes
    ----------
    origin : ndarray, shape (3,)
    axes : ndarray, shape (2, 3)
        Orthonormal.
    tiles : Tiles
    segment : ndarray of int, shape (m,)
        Which chord, or whose trace, each segment is.
    n_edges : int
    """

    origin: np.ndarray
    axes: np.ndarray
    tiles: Tiles
    segment: np.ndarray
    n_edges: int


@njit(cache=True)
def polygons_of(x, facets, cells, facet, image):
    """Return the patches of a cell."""
    n = len(facet)
    found = Polygons(np.zeros((n, MOST, 6)), np.zeros((n, MOST), np.int64), np.zeros(n, np.int64), np.zeros((n, 3)))
    points, tags = np.empty((2, MOST, 6)), np.empty((2, MOST), np.int64)
    for p in range(n):
        corners = facets[facet[p]]
        m = clip_to_cell(x, corners, cells[image[p]], points, tags)
        found.n_points[p] = m
        for i in range(m):
            found.tags[p, i] = tags[1, i]
            for a in range(6):
                found.points[p, i, a] = points[1, i, a]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            first, second = x[corners[1]] - x[corners[0]], x[corners[2]] - x[corners[0]]
            found.normal[p, a] = first[b] * second[c] - first[c] * second[b]
    return found


@njit(cache=True)
def _cut_by(polygons, p, q, ends):
    """Write where the plane of q cuts polygon p, entering and leaving; return whether it does."""
    origin, normal = polygons.points[q, 0], polygons.normal[q]
    n = polygons.n_points[p]
    found = 0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        a, b = polygons.points[p, i], polygons.points[p, j]
        # from the lower end, whoever's edge it is
        swap = False
        for c in range(3):
            if a[c] != b[c]:
                swap = b[c] < a[c]
                break
        if swap:
            a, b = b, a
        first = last = 0.0
        for c in range(3):
            first += normal[c] * (a[c] - origin[c])
            last += normal[c] * (b[c] - origin[c])
        if (first >= 0.0) != (last >= 0.0) and found < 2:
            t = first / (first - last)
            for c in range(3):
                ends[found, c] = a[c] + t * (b[c] - a[c])
            found += 1
    return found == 2


@njit(cache=True)
def chord(polygons, p, q, out):
    """Write the ends of the segment in which two patches meet; return whether they do."""
    for a in range(3):
        low_p = high_p = polygons.points[p, 0, a]
        low_q = high_q = polygons.points[q, 0, a]
        for i in range(1, polygons.n_points[p]):
            low_p, high_p = min(low_p, polygons.points[p, i, a]), max(high_p, polygons.points[p, i, a])
        for i in range(1, polygons.n_points[q]):
            low_q, high_q = min(low_q, polygons.points[q, i, a]), max(high_q, polygons.points[q, i, a])
        if low_p > high_q or low_q > high_p:
            return False
    ends = np.empty((2, 2, 3))
    if not _cut_by(polygons, p, q, ends[0]) or not _cut_by(polygons, q, p, ends[1]):
        return False
    one, other = polygons.normal[p], polygons.normal[q]
    along = np.empty(3)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        along[a] = one[b] * other[c] - one[c] * other[b]
    size = np.sqrt(np.sum(along**2))
    if size == 0.0:
        return False
    s = np.empty((2, 2))
    for k in range(2):
        for i in range(2):
            s[k, i] = np.sum(along * ends[k, i]) / size
    low, high = np.argmin(s[0]), np.argmin(s[1])
    low_p, low_q = s[0, low], s[1, high]
    high_p, high_q = s[0, 1 - low], s[1, 1 - high]
    if max(low_p, low_q) >= min(high_p, high_q):
        return False
    out[0] = ends[0, low] if low_p > low_q else ends[1, high]
    out[1] = ends[0, 1 - low] if high_p < high_q else ends[1, 1 - high]
    return True


@njit(cache=True)
def overlap_3d(polygons, part):
    """Return whether patches of two parts of the surface meet."""
    out = np.empty((2, 3))
    for p in range(len(part)):
        for q in range(p):
            if part[p] != part[q] and chord(polygons, p, q, out):
                return True
    return False


@njit(cache=True)
def _tiled(corners, ends, normals, numbers, first, second):
    """Return a plane with its tiles.

    Parameters
    ----------
    corners : ndarray, shape (n, 3)
        The polygon.
    ends : ndarray, shape (m, 2, 3)
        The segments in it.
    normals : ndarray, shape (m, 3)
        Of the patches that they are in: depth falls along them.
    numbers : ndarray of int, shape (m,)
    first, second : ndarray, shape (3,)
        Orthonormal axes; they are turned so that nothing is upright.
    """
    n, m = len(corners), len(ends)
    origin = corners[0].copy()
    best, turn = -1.0, 0.0
    for k in range(7):
        angle = 0.1 + k * np.pi / 7.0
        c, s = np.cos(angle), np.sin(angle)
        least = 1.0
        for i in range(n + m):
            d = corners[(i + 1) % n] - corners[i] if i < n else ends[i - n, 1] - ends[i - n, 0]
            a, b = np.sum(d * first), np.sum(d * second)
            size = np.sqrt(a * a + b * b)
            if size > 0.0:
                least = min(least, abs(c * a + s * b) / size)
        if least > best:
            best, turn = least, angle
    axes = np.empty((2, 3))
    for a in range(3):
        axes[0, a] = np.cos(turn) * first[a] + np.sin(turn) * second[a]
        axes[1, a] = np.cos(turn) * second[a] - np.sin(turn) * first[a]
    polygon, segments, rise = np.empty((n, 2)), np.empty((m, 4)), np.empty(m, np.int64)
    for i in range(n):
        for k in range(2):
            polygon[i, k] = np.sum((corners[i] - origin) * axes[k])
    for i in range(m):
        for e in range(2):
            for k in range(2):
                segments[i, 2 * e + k] = np.sum((ends[i, e] - origin) * axes[k])
        if segments[i, 2] < segments[i, 0]:
            for k in range(2):
                segments[i, k], segments[i, 2 + k] = segments[i, 2 + k], segments[i, k]
        du, dv = segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1]
        up = 0.0
        for a in range(3):
            up += normals[i, a] * (du * axes[1, a] - dv * axes[0, a])
        rise[i] = -1 if up > 0.0 else 1
    return Plane(origin, axes, divide(polygon, segments, rise), numbers, n)


@njit(cache=True)
def patch_plane(polygons, p, chords, pairs):
    """Return the tiles of a patch, cut by its chords."""
    m = 0
    for c in range(len(pairs)):
        m += pairs[c, 0] == p or pairs[c, 1] == p
    ends, normals, numbers = np.empty((m, 2, 3)), np.empty((m, 3)), np.empty(m, np.int64)
    m = 0
    for c in range(len(pairs)):
        if pairs[c, 0] == p or pairs[c, 1] == p:
            ends[m], numbers[m] = chords[c], c
            normals[m] = polygons.normal[pairs[c, 1] if pairs[c, 0] == p else pairs[c, 0]]
            m += 1
    normal = polygons.normal[p] / np.sqrt(np.sum(polygons.normal[p] ** 2))
    least = np.argmin(np.abs(normal))
    first, second = np.zeros(3), np.empty(3)
    first[least] = 1.0
    first -= normal[least] * normal
    first /= np.sqrt(np.sum(first**2))
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        second[a] = normal[b] * first[c] - normal[c] * first[b]
    corners = polygons.points[p, : polygons.n_points[p], :3].copy()
    return _tiled(corners, ends, normals, numbers, first, second)


@njit(cache=True)
def face_plane(polygons, face):
    """Return the tiles of a face, cut by the traces of patches; it is the same from both sides."""
    axis, side = face // 2, face % 2
    u, v = (axis + 1) % 3, (axis + 2) % 3
    n = len(polygons.n_points)
    ends, normals, numbers = np.empty((n, 2, 3)), np.empty((n, 3)), np.empty(n, np.int64)
    m = 0
    for p in range(n):
        for i in range(polygons.n_points[p]):
            if polygons.tags[p, i] == PLANE + face:
                j = i + 1 if i + 1 < polygons.n_points[p] else 0
                a, b = polygons.points[p, i], polygons.points[p, j]
                if a[u] > b[u] or (a[u] == b[u] and a[v] > b[v]):
                    a, b = b, a
                for c in range(3):
                    ends[m, 0, c], ends[m, 1, c] = a[c], b[c]
                ends[m, 0, axis] = ends[m, 1, axis] = 0.0
                normals[m], numbers[m] = polygons.normal[p], p
                m += 1
                break
    corners = np.zeros((4, 3))
    for i in range(4):
        corners[i, u] = 0.5 if i in (1, 2) else -0.5
        corners[i, v] = 0.5 if i in (2, 3) else -0.5
    first, second = np.zeros(3), np.zeros(3)
    first[u] = second[v] = 1.0
    plane = _tiled(corners, ends[:m], normals[:m], numbers[:m].copy(), first, second)
    plane.origin[axis] = side - 0.5
    return plane


@njit(cache=True)
def point(plane, u, v, out):
    """Write a point of a plane."""
    for a in range(3):
        out[a] = plane.origin[a] + u * plane.axes[0, a] + v * plane.axes[1, a]


@njit(cache=True)
def settle_face(plane, covered):
    """Make the depths of a face's tiles what they are; return whether that is sure."""
    total = 0.0
    for k in range(len(plane.tiles.depth)):
        total += plane.tiles.depth[k] * measure(plane.tiles, k)
    base = np.rint(covered - total)
    plane.tiles.depth[:] += int(base)
    return abs(covered - total - base) < SURE and _is_sound(plane.tiles)


@njit(cache=True)
def _is_sound(tiles):
    """Return whether nothing is covered less than not at all, but for what rounding makes of tiles without extent."""
    for k in range(len(tiles.depth)):
        if tiles.depth[k] < 0 and measure(tiles, k) > NOTHING:
            return False
    return True


@njit(cache=True)
def settle_patch(plane, p, polygons, faces):
    """Make the depths of a patch's tiles those of their outer sides, by a ray from the largest to a face."""
    tiles = plane.tiles
    if len(tiles.depth) == 0:
        return True
    best, k = -1.0, 0
    for i in range(len(tiles.depth)):
        if measure(tiles, i) > best:
            best, k = measure(tiles, i), i
    # off the middle, where other things may have their corners
    h, t = tiles.height[k], 0.5371
    low, high = h[0] + t * (h[1] - h[0]), h[2] + t * (h[3] - h[2])
    at = np.empty(3)
    point(plane, tiles.ends[k, 0] + t * (tiles.ends[k, 1] - tiles.ends[k, 0]), low + 0.4683 * (high - low), at)
    axis = np.argmax(np.abs(polygons.normal[p]))
    face = faces[2 * axis + 1]
    there = at.copy()
    there[axis] = 0.5
    u, v = np.sum((there - face.origin) * face.axes[0]), np.sum((there - face.origin) * face.axes[1])
    tile = tile_at(face.tiles, u, v)
    if tile < 0:
        return False
    level = face.tiles.depth[tile]
    for q in range(len(polygons.n_points)):
        if q != p:
            level += _crossed(polygons, q, at, axis)
    if polygons.normal[p, axis] < 0.0:
        level -= 1
    tiles.depth[:] += level - tiles.depth[k]
    return _is_sound(tiles)


@njit(cache=True)
def _crossed(polygons, q, at, axis):
    """Return by how much depth falls where a ray from a point along an axis crosses a patch; 0 if it does not."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    n, inside = polygons.n_points[q], False
    for i in range(n):
        one, other = polygons.points[q, i], polygons.points[q, i + 1 if i + 1 < n else 0]
        if (one[c] <= at[c]) != (other[c] <= at[c]):
            inside ^= one[b] + (at[c] - one[c]) / (other[c] - one[c]) * (other[b] - one[b]) > at[b]
    normal, origin = polygons.normal[q], polygons.points[q, 0]
    if not inside or normal[axis] == 0.0:
        return 0
    ahead = normal[b] * (origin[b] - at[b]) + normal[c] * (origin[c] - at[c])
    if origin[axis] + ahead / normal[axis] <= at[axis]:
        return 0
    return 1 if normal[axis] > 0.0 else -1
