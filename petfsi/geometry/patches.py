"""Patches: the parts of facets in the cells of a box, and what is integrated over them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.slabs import MOST, PLANE, clip_polygon, clip_segment, load_facet, slab_range


class Frame(NamedTuple):
    """The box as the kernels see it, with a margin of one cell.

    Attributes
    ----------
    lo, hi : ndarray of int64, shape (dim,)
        The box and its margin in whole coordinates.
    dx : ndarray, shape (dim,)
    normals : ndarray, shape (m, dim)
        The facets' unit normals.
    """

    lo: np.ndarray
    hi: np.ndarray
    dx: np.ndarray
    normals: np.ndarray


class Patches(NamedTuple):
    """What the kernels keep of each patch, in the order in which they are found or sorted by cell.

    Attributes
    ----------
    facet, image : ndarray of int32, shape (n,)
        ``image`` counts the periodic images of the surface.
    cell : ndarray of int64, shape (n,)
        Flat index in the box with its margin.
    edges : ndarray of int8, shape (n,)
        Bit i says that the patch has something of the facet's edge i (corner i in 2D).
    integrals : ndarray, shape (n, dim + dim * dim)
        Integrals and moments as in ``clipping.CutCells``.
    vectors : ndarray, shape (n, dim + 1)
        The area vector and int x_a dA_a for the last axis a, in units of cells about the cell's centre.
    """

    facet: np.ndarray
    image: np.ndarray
    cell: np.ndarray
    edges: np.ndarray
    integrals: np.ndarray
    vectors: np.ndarray


def find_patches(
    x: np.ndarray, facets: np.ndarray, frame: Frame, images: np.ndarray, sums: list[np.ndarray] | None = None
) -> tuple[Patches, list[np.ndarray]]:
    """Return the patches in the box and its margin, and per axis the sums of area in front of each face.

    The sums have one more entry along the axis than cells: the first is what lies below the box. Those that are given
    are added to.
    """
    dim = x.shape[1]
    shape = frame.hi - frame.lo
    if sums is None:
        sums = [np.zeros(shape + (np.arange(dim) == a)) for a in range(dim)]
    kernel = _clip_2d if dim == 2 else _clip_3d
    found = []
    for number, shift in enumerate(images):
        # it is the box that is moved, not the surface: an image's patches are the original's to the last bit
        moved = Frame(frame.lo - shift, frame.hi - shift, frame.dx, frame.normals)
        facet, cell, *others = kernel(x, facets, moved, *sums)
        found.append(Patches(facet, np.full(len(facet), number, dtype=np.int32), cell, *others))
    if not found:
        none = np.zeros(0, dtype=np.int32)
        numbers = np.zeros((0, dim * (dim + 1))), np.zeros((0, dim + 1))
        return Patches(none, none, none.astype(np.int64), none.astype(np.int8), *numbers), sums
    if len(found) == 1:
        return found[0], sums
    return Patches(*(np.concatenate(part) for part in zip(*found, strict=True))), sums


@njit(cache=True)
def _room(n, dim):
    """Return room for n patches: facet, cell, edges, integrals and vectors."""
    integrals, vectors = np.empty((n, dim * (dim + 1))), np.empty((n, dim + 1))
    return np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int8), integrals, vectors


@njit(cache=True)
def _enlarged(room):
    """Return twice the room, with what is in it."""
    n = len(room[0])
    more = _room(2 * n, room[4].shape[1] - 1)
    for i in range(n):  # loops: they compile in a tenth of the time that slices take
        more[0][i], more[1][i], more[2][i] = room[0][i], room[1][i], room[2][i]
        for a in range(room[3].shape[1]):
            more[3][i, a] = room[3][i, a]
        for a in range(room[4].shape[1]):
            more[4][i, a] = room[4][i, a]
    return more


@njit(cache=True)
def _own_edges(tags, n):
    """Return one bit for each of the facet's edges that is among the tags."""
    bits = 0
    for i in range(n):
        if tags[i] < PLANE:
            bits |= 1 << tags[i]
    return bits


@njit(cache=True)
def _clip_3d(x, facets, frame, sums0, sums1, sums2):
    """Return the patches of triangles as ``_room`` has them; add their area vectors to the sums."""
    lo, hi = frame.lo, frame.hi
    ny, nz = hi[1] - lo[1], hi[2] - lo[2]
    room = _room(4 * len(facets) + 64, 3)
    part, tags = np.empty((4, MOST, 6)), np.empty((4, MOST), np.int64)
    at = np.empty(3, np.int64)
    count = 0
    for f in range(len(facets)):
        load_facet(x, facets[f], part[0], tags[0])
        if not _near(part[0], 3, lo, hi):
            continue
        # where a slab holds all that is left nothing is cut, and the next axis goes on with the same points
        i0, i1, whole_x = slab_range(part[0], 3, 0, lo[0], hi[0])
        for i in range(i0, i1):
            a, n = 0, 3
            if not whole_x:
                a, n = 1, clip_polygon(part[0], tags[0], 3, 0, _low(i, lo[0]), i + 1.0, part[1], tags[1])
            j0, j1, whole_y = slab_range(part[a], n, 1, lo[1], hi[1])
            for j in range(max(j0, lo[1]) if i < lo[0] else j0, j1):
                b, m = a, n
                if not whole_y:
                    b, m = 2, clip_polygon(part[a], tags[a], n, 1, _low(j, lo[1]), j + 1.0, part[2], tags[2])
                k0, k1, whole_z = slab_range(part[b], m, 2, lo[2], hi[2])
                for k in range(max(k0, lo[2]) if i < lo[0] or j < lo[1] else k0, k1):
                    c, o = b, m
                    if not whole_z:
                        c, o = 3, clip_polygon(part[b], tags[b], m, 2, _low(k, lo[2]), k + 1.0, part[3], tags[3])
                    if o < 3:
                        continue
                    if count == len(room[0]):
                        room = _enlarged(room)
                    integral, vector = room[3][count], room[4][count]
                    at[0], at[1], at[2] = i, j, k
                    measure_polygon(part[c], o, at, frame.dx, frame.normals[f], integral, vector)
                    # what lies below the box has its area added to the first entry of its row
                    i_, j_, k_ = i - lo[0], j - lo[1], k - lo[2]
                    if j_ >= 0 and k_ >= 0:
                        sums0[i_ + 1, j_, k_] += vector[0]
                    if i_ >= 0 and k_ >= 0:
                        sums1[i_, j_ + 1, k_] += vector[1]
                    if i_ >= 0 and j_ >= 0:
                        sums2[i_, j_, k_ + 1] += vector[2]
                    if i_ < 0 or j_ < 0 or k_ < 0:
                        continue
                    room[0][count], room[1][count] = f, (i_ * ny + j_) * nz + k_
                    room[2][count] = _own_edges(tags[c], o)
                    count += 1
    return room[0][:count], room[1][:count], room[2][:count], room[3][:count], room[4][:count]


@njit(cache=True)
def _clip_2d(x, facets, frame, sums0, sums1):
    """Return the patches of segments as ``_room`` has them; add their area vectors to the sums."""
    lo, hi = frame.lo, frame.hi
    room = _room(4 * len(facets) + 64, 2)
    part, tags = np.empty((3, 2, 4)), np.empty((3, 2), np.int64)
    at = np.empty(2, np.int64)
    count = 0
    for f in range(len(facets)):
        load_facet(x, facets[f], part[0], tags[0])
        if not _near(part[0], 2, lo, hi):
            continue
        i0, i1, _ = slab_range(part[0], 2, 0, lo[0], hi[0])
        for i in range(i0, i1):
            if clip_segment(part[0], tags[0], 0, _low(i, lo[0]), i + 1.0, part[1], tags[1]) == 0:
                continue
            j0, j1, _ = slab_range(part[1], 2, 1, lo[1], hi[1])
            for j in range(max(j0, lo[1]) if i < lo[0] else j0, j1):
                if clip_segment(part[1], tags[1], 1, _low(j, lo[1]), j + 1.0, part[2], tags[2]) == 0:
                    continue
                if count == len(room[0]):
                    room = _enlarged(room)
                integral, vector = room[3][count], room[4][count]
                at[0], at[1] = i, j
                measure_segment(part[2], at, frame.dx, frame.normals[f], integral, vector)
                i_, j_ = i - lo[0], j - lo[1]
                if j_ >= 0:
                    sums0[i_ + 1, j_] += vector[0]
                if i_ >= 0:
                    sums1[i_, j_ + 1] += vector[1]
                if i_ < 0 or j_ < 0:
                    continue
                room[0][count], room[1][count] = f, i_ * (hi[1] - lo[1]) + j_
                room[2][count] = _own_edges(tags[2], 2)
                count += 1
    return room[0][:count], room[1][:count], room[2][:count], room[3][:count], room[4][:count]


@njit(cache=True)
def _low(i, lo):
    """Return the lower plane of slab i; the slab lo - 1 is all that lies below the box."""
    return float(i) if i >= lo else -np.inf


@njit(cache=True)
def _near(points, n, lo, hi):
    """Return whether a facet may reach into the box or into the rows below it."""
    below = 0
    for a in range(len(lo)):
        low = high = points[0, a]
        for i in range(1, n):
            low, high = min(low, points[i, a]), max(high, points[i, a])
        if low >= hi[a]:
            return False
        below += high < lo[a]
    return below < 2


@njit(cache=True)
def measure_polygon(points, n, at, dx, normal, integral, vector):
    """Set the integrals and vectors of a patch (see ``Patches``), by a fan of triangles; exact for what is integrated.

    The points are moved to be about the cell's centre.
    """
    for a in range(4):
        vector[a] = 0.0
    for a in range(12):
        integral[a] = 0.0
    for i in range(n):
        for a in range(3):
            points[i, a] -= at[a] + 0.5
    for i in range(1, n - 1):
        whole = 0.0
        for a in range(3):
            e, g = (a + 1) % 3, (a + 2) % 3
            area = (points[i, e] - points[0, e]) * (points[i + 1, g] - points[0, g])
            area = 0.5 * (area - (points[i, g] - points[0, g]) * (points[i + 1, e] - points[0, e]))
            vector[a] += area
            whole += area * dx[e] * dx[g] * normal[a]
            if a == 2:
                vector[3] += area * (points[0, 2] + points[i, 2] + points[i + 1, 2]) / 3.0
        for s in range(3, 6):
            # int N x dA over a triangle is area / 12 times the sum of N x, plus the sum of N times that of x
            w0, w1, w2 = points[0, s], points[i, s], points[i + 1, s]
            total = w0 + w1 + w2
            integral[s - 3] += whole * total / 3.0
            w0, w1, w2 = w0 + total, w1 + total, w2 + total
            for a in range(3):
                sum_of = w0 * points[0, a] + w1 * points[i, a] + w2 * points[i + 1, a]
                integral[3 * s - 6 + a] += whole * dx[a] / 12.0 * sum_of


@njit(cache=True)
def measure_segment(points, at, dx, normal, integral, vector):
    """Set the integrals and vectors of a patch (see ``Patches``)."""
    vector[0] = points[1, 1] - points[0, 1]
    vector[1] = points[0, 0] - points[1, 0]
    vector[2] = vector[1] * (0.5 * (points[0, 1] + points[1, 1]) - at[1] - 0.5)
    whole = vector[0] * dx[1] * normal[0] + vector[1] * dx[0] * normal[1]
    for s in range(2):
        w0, w1 = points[0, 2 + s], points[1, 2 + s]
        integral[s] = 0.5 * whole * (w0 + w1)
        for a in range(2):
            x0, x1 = points[0, a] - at[a] - 0.5, points[1, a] - at[a] - 0.5
            integral[2 + 2 * s + a] = whole * dx[a] * (w0 * x0 + w1 * x1 + (w0 + w1) * (x0 + x1)) / 6.0
