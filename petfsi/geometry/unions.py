"""Cells in which solids overlap: what of each patch still bounds fluid, and what of each face is still open.

Where bodies overlap a point may be covered several times. In a cell the number W of solids that cover a point follows
from the patches, which it changes at by one, and from the faces, each of which knows its integral. Patches are cut
where they cross; what is left of them bounds fluid if nothing covers its outer side. Pieces of fluid are what these
parts and the open stretches of faces join where they end.

Points are in units of cells about the cell's centre. Faces, lines and keys are as in ``walks``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.geometry.slabs import MOST, PLANE, clip_to_cell
from petfsi.geometry.union_find import find, join

#: Faces that are covered more than once, or not as often as a whole number of times, by more than this.
SURE = 1e-6
#: Points nearer than this are one.
SAME_POINT = 1e-12


@njit(cache=True)
def cross_2d(ends, one, other):
    """Return where segment ``one`` crosses another, as a part of its length and of the other's; -1 if nowhere."""
    a, b = ends[one, 0], ends[one, 1]
    c, d = ends[other, 0], ends[other, 1]
    ab_c = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    ab_d = (b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0])
    cd_a = (d[0] - c[0]) * (a[1] - c[1]) - (d[1] - c[1]) * (a[0] - c[0])
    cd_b = (d[0] - c[0]) * (b[1] - c[1]) - (d[1] - c[1]) * (b[0] - c[0])
    if (ab_c <= 0.0) == (ab_d <= 0.0) or (cd_a <= 0.0) == (cd_b <= 0.0):
        return -1.0, -1.0
    return cd_a / (cd_a - cd_b), ab_c / (ab_c - ab_d)


@njit(cache=True)
def overlap_2d(ends, part):
    """Return whether segments of two parts of the surface cross."""
    for p in range(len(ends)):
        for q in range(p):
            if part[p] != part[q] and cross_2d(ends, p, q)[0] >= 0.0:
                return True
    return False


@njit(cache=True)
def ends_2d(x, facets, cells, facet, image):
    """Return the ends of a cell's patches, (n, 2, 4): coordinates and weights of the facet's corners; their tags."""
    ends, tags = np.empty((len(facet), 2, 4)), np.empty((len(facet), 2), np.int64)
    points, tag = np.empty((2, MOST, 4)), np.empty((2, MOST), np.int64)
    for p in range(len(facet)):
        clip_to_cell(x, facets[facet[p]], cells[image[p]], points, tag)
        for i in range(2):
            tags[p, i] = tag[1, i]
            for a in range(4):
                ends[p, i, a] = points[1, i, a]
    return ends, tags


@njit(cache=True)
def union_2d(x, facets, cells, facet, image, part, covered):
    """Return what is left of the patches of a cell in which solids overlap.

    Parameters
    ----------
    x, facets, cells, facet, image, part
        As for ``walks.walk_2d``.
    covered : ndarray, shape (4,)
        Integral of W over each face.

    Returns
    -------
    parent : ndarray of int, shape (n_nodes,)
        Nodes are the kept parts, then the open stretches; those of one piece have one root.
    kept : ndarray, shape (n_kept, 2, 4)
        The ends of the parts of patches that bound fluid: coordinates, and weights of the facet's corners.
    patch : ndarray of int, shape (n_kept,)
        What each is a part of.
    elements, keys : ndarray
        As ``walk_2d`` returns them.
    opened : ndarray, shape (4,)
        The open fraction of each face.
    good : bool
    """
    n = len(facet)
    ends, tags = ends_2d(x, facets, cells, facet, image)
    # the faces' stretches
    on_face, at, sign, order, count = _on_faces_2d(ends, tags)
    depth, good = _depths_2d(on_face, at, sign, order, covered)
    # all parts, and which of them are kept
    parts, start = _parts_2d(ends, part)
    n_parts = len(parts)
    of = np.empty(n_parts, np.int64)
    for p in range(n):
        of[start[p] : start[p + 1]] = p
    kept, n_kept = np.full(n_parts, -1), 0
    for k in range(n_parts):
        outside, sure = _outside_2d(parts, ends, k, of[k], on_face, at, sign, order, depth)
        good = good and sure
        if outside == 0:
            kept[k] = n_kept
            n_kept += 1
    parent = np.arange(n_kept + len(at) + 4)
    _join_parts_2d(parts, start, kept, parent, on_face, order, depth, count, n_kept)
    _join_corners_2d(parent, depth, count, n_kept)
    _join_loops_2d(parts, kept, parent, on_face, at, order, count, depth, n_kept)
    elements, keys, opened = _open_stretches_2d(at, order, depth, count, n_kept)
    rest, patch = np.empty((n_kept, 2, 4)), np.empty(n_kept, np.int64)
    for k in range(n_parts):
        if kept[k] >= 0:
            rest[kept[k]], patch[kept[k]] = parts[k], of[k]
    return parent, rest, patch, elements, keys, opened, good


@njit(cache=True)
def _stretch_number(count, face, j):
    """Return the number of stretch j of a face among those of all faces."""
    number = j
    for other in range(face):
        number += count[other] + 1
    return number


@njit(cache=True)
def _on_faces_2d(ends, tags):
    """Return the face, position and sign of each end of each patch, and their order on each face, with how many.

    An end is number 2 patch + end; its face is -1 if it lies within the cell. The sign is +1 where W falls along the
    face.
    """
    n = len(ends)
    face, at, sign = np.full(2 * n, -1), np.zeros(2 * n), np.zeros(2 * n, np.int64)
    order, count = np.full((4, 2 * n), -1), np.zeros(4, np.int64)
    for p in range(n):
        for i in range(2):
            if tags[p, i] < PLANE:
                continue
            c = 2 * p + i
            axis, side = (tags[p, i] - PLANE) // 2, (tags[p, i] - PLANE) % 2
            face[c], at[c] = 2 * axis + side, ends[p, i, 1 - axis]
            sign[c] = (2 * side - 1) * (2 * i - 1) * (1 if axis == 1 else -1)
            k = count[face[c]]
            while k > 0 and at[order[face[c], k - 1]] > at[c]:
                order[face[c], k] = order[face[c], k - 1]
                k -= 1
            order[face[c], k] = c
            count[face[c]] += 1
    return face, at, sign, order, count


@njit(cache=True)
def _depths_2d(on_face, at, sign, order, covered):
    """Return W on each stretch of each face, and whether it is whole as it must be."""
    depth, good = np.zeros((4, len(at) + 1), np.int64), True
    for face in range(4):
        level, total, low, j = 0, 0.0, -0.5, 0
        while j < len(at) and order[face, j] >= 0:
            c = order[face, j]
            total += level * (at[c] - low)
            low = at[c]
            level -= sign[c]
            depth[face, j + 1] = level
            j += 1
        total += level * (0.5 - low)
        base = np.rint(covered[face] - total)
        good = good and abs(covered[face] - total - base) < SURE
        for k in range(j + 1):
            depth[face, k] += int(base)
            good = good and depth[face, k] >= 0
    return depth, good


@njit(cache=True)
def _parts_2d(ends, part):
    """Return the parts into which patches cut each other, as ``kept`` of ``union_2d``, and the first of each patch."""
    n = len(ends)
    start = np.zeros(n + 1, np.int64)
    cuts, room = np.empty((n + 1, 4)), np.empty((n * (n + 1), 2, 4))
    total = 0
    for p in range(n):
        m = 0
        for q in range(n):
            if q == p or part[q] == part[p]:
                continue
            # one point for both, however flat the angle
            one, other = min(p, q), max(p, q)
            s, t = cross_2d(ends, one, other)
            if s < 0.0:
                continue
            k, own = m, s if p == one else t
            weight = ends[p, 0, 3] + own * (ends[p, 1, 3] - ends[p, 0, 3])
            while k > 0 and cuts[k - 1, 3] > weight:
                cuts[k] = cuts[k - 1]
                k -= 1
            for a in range(2):
                cuts[k, a] = ends[one, 0, a] + s * (ends[one, 1, a] - ends[one, 0, a])
                cuts[k, 2 + a] = ends[p, 0, 2 + a] + own * (ends[p, 1, 2 + a] - ends[p, 0, 2 + a])
            m += 1
        for k in range(m + 1):
            room[total, 0] = ends[p, 0] if k == 0 else cuts[k - 1]
            room[total, 1] = ends[p, 1] if k == m else cuts[k]
            total += 1
        start[p + 1] = total
    return room[:total].copy(), start


@njit(cache=True)
def _outside_2d(parts, ends, k, p, on_face, at, sign, order, depth):
    """Return W on the outer side of a part, by a ray from its middle to a face, and whether that is sure."""
    mid_0, mid_1 = 0.5 * (parts[k, 0, 0] + parts[k, 1, 0]), 0.5 * (parts[k, 0, 1] + parts[k, 1, 1])
    n_0, n_1 = ends[p, 1, 1] - ends[p, 0, 1], ends[p, 0, 0] - ends[p, 1, 0]
    axis = 0 if abs(n_0) >= abs(n_1) else 1
    u, v = (mid_0, mid_1) if axis == 0 else (mid_1, mid_0)
    out = n_0 if axis == 0 else n_1
    # W at the face above, less what lies between
    face = 2 * axis + 1
    j = 0
    while j < len(at) and order[face, j] >= 0 and at[order[face, j]] <= v:
        j += 1
    level = depth[face, j]
    for q in range(len(ends)):
        if q == p:
            continue
        a, b = ends[q, 0], ends[q, 1]
        if (a[1 - axis] <= v) == (b[1 - axis] <= v):
            continue
        s = a[axis] + (v - a[1 - axis]) / (b[1 - axis] - a[1 - axis]) * (b[axis] - a[axis])
        if s > u:
            # the normal of q along the ray: going up through it W falls if it points up
            normal = b[1] - a[1] if axis == 0 else a[0] - b[0]
            level += 1 if normal > 0.0 else -1
    if out < 0.0:
        level -= 1
    return level, level >= 0


@njit(cache=True)
def _join_parts_2d(parts, start, kept, parent, on_face, order, depth, count, n_kept):
    """Join kept parts with each other where they end, or with the open stretches that they end at."""
    for k in range(len(parts)):
        if kept[k] < 0:
            continue
        for i in range(2):
            _join_end_2d(parts, k, i, kept, parent)
    for c in range(len(on_face)):
        face, place = on_face[c], 0
        if face < 0:
            continue
        while order[face, place] != c:
            place += 1
        k = start[c // 2] if c % 2 == 0 else start[c // 2 + 1] - 1
        for j in (place, place + 1):
            if kept[k] >= 0 and depth[face, j] == 0:
                join(parent, kept[k], n_kept + _stretch_number(count, face, j))


@njit(cache=True)
def _join_corners_2d(parent, depth, count, n_kept):
    """Join the open stretches of faces that meet in the cell's corners."""
    for corner in range(4):
        one, other = corner & 1, 2 + (corner >> 1)
        j = count[one] if corner >> 1 else 0
        m = count[other] if corner & 1 else 0
        if depth[one, j] == 0 and depth[other, m] == 0:
            join(parent, n_kept + _stretch_number(count, one, j), n_kept + _stretch_number(count, other, m))


@njit(cache=True)
def _open_stretches_2d(at, order, depth, count, n_kept):
    """Return the open stretches as ``elements`` and ``keys`` of ``union_2d``, and how much of each face they are."""
    n_stretches = len(at) + 4
    elements, keys = np.empty((n_stretches, 3)), np.empty(n_stretches, np.int64)
    m, opened = 0, np.zeros(4)
    for face in range(4):
        for j in range(count[face] + 1):
            if depth[face, j] == 0:
                low = -0.5 if j == 0 else at[order[face, j - 1]]
                high = 0.5 if j == count[face] else at[order[face, j]]
                elements[m, 0], elements[m, 1] = face, n_kept + _stretch_number(count, face, j)
                elements[m, 2], keys[m] = high - low, j
                opened[face] += high - low
                m += 1
    return elements[:m].copy(), keys[:m].copy(), opened


@njit(cache=True)
def _join_end_2d(parts, k, i, kept, parent):
    """Join a part with the kept ones that begin where it ends, or end where it begins."""
    for m in range(len(parts)):
        if m == k or kept[m] < 0:
            continue
        near = abs(parts[k, i, 0] - parts[m, 1 - i, 0]) < SAME_POINT
        if near and abs(parts[k, i, 1] - parts[m, 1 - i, 1]) < SAME_POINT:
            join(parent, kept[k], kept[m])


@njit(cache=True)
def _join_loops_2d(parts, kept, parent, on_face, at, order, count, depth, n_kept):
    """Join closed curves that fluid surrounds with what is to their right."""
    for k in range(len(parts)):
        if kept[k] < 0 or find(parent, kept[k]) != kept[k]:
            continue
        u, v, area, closed = -np.inf, 0.0, 0.0, True
        for c in range(len(parent) - n_kept):
            closed = closed and find(parent, n_kept + c) != kept[k]
        if not closed:
            continue
        for m in range(len(parts)):
            if kept[m] >= 0 and find(parent, kept[m]) == kept[k]:
                area += parts[m, 0, 0] * parts[m, 1, 1] - parts[m, 1, 0] * parts[m, 0, 1]
                if parts[m, 0, 0] > u:
                    u, v = parts[m, 0, 0], parts[m, 0, 1]
        if area <= 0.0:
            continue
        node, nearest = -1, np.inf
        for m in range(len(parts)):
            if kept[m] < 0 or find(parent, kept[m]) == kept[k]:
                continue
            a, b = parts[m, 0], parts[m, 1]
            if (a[1] <= v) != (b[1] <= v):
                s = a[0] + (v - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
                if u <= s < nearest:
                    node, nearest = kept[m], s
        if node < 0:
            j = 0
            while j < count[1] and at[order[1, j]] <= v:
                j += 1
            if depth[1, j] == 0:
                node = n_kept + _stretch_number(count, 1, j)
        if node >= 0:
            join(parent, kept[k], node)
