"""Cells in three dimensions in which solids overlap, see ``unions``.

Patches meet along chords. The chords in a patch, and the traces of patches on a face, divide them into tiles of one
depth W. The outer side of a tile of a patch is fluid where W = 0, and so is a tile of a face. Tiles that share a border
bound the same piece of fluid: an edge of a facet, a chord, a trace, a line of the cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.geometry.planes import chord, face_plane, patch_plane, point, polygons_of, settle_face, settle_patch
from petfsi.geometry.slabs import PLANE
from petfsi.geometry.tiles import SHARED, measure
from petfsi.geometry.union_find import find, join
from petfsi.geometry.walks import NOTHING, line_of, patch_of

#: Kinds of lines that tiles share.
EDGE, TRACE, CHORD, LINE = 0, 1, 2, 3


@njit(cache=True)
def union_3d(x, facets, cells, facet, image, part, covered, neighbours):
    """Return what is left of the patches of a cell in which solids overlap.

    Parameters
    ----------
    x, facets, cells, facet, image, part
        As for ``walks_3d.walk_3d``.
    covered : ndarray, shape (6,)
        Integral of W over each face.
    neighbours : tuple of ndarray of int
        As for ``walk_3d``.

    Returns
    -------
    parent : ndarray of int, shape (n_nodes,)
        Nodes are the kept tiles of patches, then the open tiles of faces; those of one piece have one root.
    kept : ndarray, shape (n_kept, 4, 6)
        The corners of the kept tiles in their facet's sense: coordinates, and weights of the facet's corners.
    patch : ndarray of int, shape (n_kept,)
        What each is a part of.
    elements, keys : ndarray
        As ``walk_3d`` returns them; on faces that are covered more than once, by tiles.
    opened : ndarray, shape (6,)
        The open fraction of each face.
    good : bool
    """
    n = len(facet)
    polygons = polygons_of(x, facets, cells, facet, image)
    chords, pairs = _chords(polygons, part)
    good = True
    faces = [face_plane(polygons, face) for face in range(6)]
    for face in range(6):
        good = settle_face(faces[face], covered[face]) and good
    planes = [patch_plane(polygons, p, chords, pairs) for p in range(n)]
    for p in range(n):
        good = good and settle_patch(planes[p], p, polygons, faces)
    # nodes
    start = np.zeros(n + 7, np.int64)
    for i in range(n + 6):
        tiles = planes[i].tiles if i < n else faces[i - n].tiles
        start[i + 1] = start[i] + len(tiles.depth)
    node, n_nodes, n_kept = np.full(start[n + 6], -1), 0, 0
    for i in range(n + 6):
        tiles = planes[i].tiles if i < n else faces[i - n].tiles
        for k in range(len(tiles.depth)):
            if tiles.depth[k] == 0:
                node[start[i] + k] = n_nodes
                n_nodes += 1
        n_kept = n_nodes if i < n else n_kept
    parent, size = np.arange(n_nodes), np.empty(n_nodes)
    keys, ends = np.empty(2 * n_nodes, np.int64), np.empty((2 * n_nodes, 2, 3))
    for i in range(n + 6):
        plane = planes[i] if i < n else faces[i - n]
        for k in range(len(plane.tiles.depth)):
            if node[start[i] + k] < 0:
                continue
            size[node[start[i] + k]] = measure(plane.tiles, k)
            join(parent, node[start[i] + k], node[start[i] + plane.tiles.area[k]])
            for e in range(2):
                r, line = 2 * node[start[i] + k] + e, plane.tiles.line[k, e]
                for s in range(2):
                    point(plane, plane.tiles.ends[k, s], plane.tiles.height[k, 2 * e + s], ends[r, s])
                keys[r] = _key(i, n, line, plane, polygons, facet, image, neighbours)
    _join_shared(keys, ends, parent)
    kept, patch = _kept(planes, node, start, polygons, n_kept)
    good = _join_shells(parent, kept, size) and good
    elements, names, opened = _elements(faces, node, start, n, polygons, facet, image, len(facets))
    return parent, kept, patch, elements, names, opened, good


@njit(cache=True)
def _chords(polygons, part):
    """Return the chords of all pairs of patches of different parts, and these pairs."""
    n = len(part)
    chords, pairs = np.empty((n * (n - 1) // 2, 2, 3)), np.empty((n * (n - 1) // 2, 2), np.int64)
    m = 0
    for p in range(n):
        for q in range(p + 1, n):
            if part[p] != part[q] and chord(polygons, p, q, chords[m]):
                pairs[m, 0], pairs[m, 1] = p, q
                m += 1
    return chords[:m].copy(), pairs[:m].copy()


@njit(cache=True)
def _key(i, n, line, plane, polygons, facet, image, neighbours):
    """Return a number for a line that bounds a tile of patch i (of face i - n), the same for all that share it."""
    kind, number = -1, 0
    if i < n and line < plane.n_edges:
        tag = polygons.tags[i, line]
        if tag >= PLANE:
            kind, number = TRACE, (tag - PLANE) * n + i
        else:
            beyond, step, there = neighbours
            q = patch_of(facet, image, beyond[facet[i], tag], there[image[i], step[facet[i], tag]])
            if q >= 0:
                kind, number = EDGE, min(i, q) * n + max(i, q)
    elif i < n:
        kind, number = CHORD, plane.segment[line - plane.n_edges]
    elif line < plane.n_edges:
        axis, side = (i - n) // 2, (i - n) % 2
        u, v = (axis + 1) % 3, (axis + 2) % 3
        if line % 2 == 0:
            number = line_of(3, u, v, line // 2, side)
        else:
            number = line_of(3, v, u, 1 if line == 1 else 0, side)
        kind = LINE
    else:
        kind, number = TRACE, (i - n) * n + plane.segment[line - plane.n_edges]
    return -1 if kind < 0 else number * 4 + kind


@njit(cache=True)
def _join_shared(keys, ends, parent):
    """Join tiles that share a stretch of a line."""
    order = np.argsort(keys)
    begin = 0
    while begin < len(keys):
        end = begin + 1
        while end < len(keys) and keys[order[end]] == keys[order[begin]]:
            end += 1
        if keys[order[begin]] >= 0 and end > begin + 1:
            # along the longest
            along, longest = np.zeros(3), 0.0
            for r in order[begin:end]:
                d = ends[r, 1] - ends[r, 0]
                size = np.sqrt(np.sum(d * d))
                if size > longest:
                    longest, along = size, d / size
            for i in range(begin, end):
                for j in range(begin, i):
                    r, s = order[i], order[j]
                    a, b = np.sum(along * ends[r, 0]), np.sum(along * ends[r, 1])
                    c, d = np.sum(along * ends[s, 0]), np.sum(along * ends[s, 1])
                    if min(max(a, b), max(c, d)) - max(min(a, b), min(c, d)) > SHARED:
                        join(parent, r // 2, s // 2)
        begin = end


@njit(cache=True)
def _kept(planes, node, start, polygons, n_kept):
    """Return the kept tiles of patches as ``union_3d`` does."""
    kept, patch = np.empty((n_kept, 4, 6)), np.empty(n_kept, np.int64)
    for p in range(len(planes)):
        plane = planes[p]
        # weights are linear in the plane's coordinates: by three corners of the patch that are far apart
        tiles = plane.tiles
        turn = 0.0
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            turn += polygons.normal[p, a] * (plane.axes[0, b] * plane.axes[1, c] - plane.axes[0, c] * plane.axes[1, b])
        for k in range(len(tiles.depth)):
            r = node[start[p] + k]
            if r < 0:
                continue
            patch[r] = p
            u, h = tiles.ends[k], tiles.height[k]
            for i in range(4):
                e = 1 if i in (1, 2) else 0
                slot = i if turn > 0.0 else 3 - i
                point(plane, u[e], h[e] if i < 2 else h[2 + e], kept[r, slot, :3])
                _weigh(polygons, p, kept[r, slot])
    return kept, patch


@njit(cache=True)
def _weigh(polygons, p, point):
    """Write the weights of the facet's corners at a point of patch p, by those of the patch's fan of triangles."""
    normal = polygons.normal[p]
    size = np.sum(normal * normal)
    n = polygons.n_points[p]
    # barycentric about the widest triangle of the fan
    best, i = 0.0, 1
    for j in range(1, n - 1):
        area = abs(_turn(polygons.points[p, 0], polygons.points[p, j], polygons.points[p, j + 1], normal))
        if area > best:
            best, i = area, j
    a, b, c = polygons.points[p, 0], polygons.points[p, i], polygons.points[p, i + 1]
    whole = _turn(a, b, c, normal)
    for s in range(3, 6):
        if whole == 0.0 or size == 0.0:
            point[s] = a[s]
        else:
            point[s] = (_turn(point, b, c, normal) * a[s] + _turn(a, point, c, normal) * b[s]) / whole
            point[s] += _turn(a, b, point, normal) * c[s] / whole


@njit(cache=True)
def _turn(a, b, c, normal):
    """Return the area of a triangle along a normal, times some number."""
    total = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total += normal[i] * ((b[j] - a[j]) * (c[k] - a[k]) - (b[k] - a[k]) * (c[j] - a[j]))
    return total


@njit(cache=True)
def _elements(faces, node, start, n, polygons, facet, image, n_facets):
    """Return elements, keys and the open fractions of faces."""
    room = 4
    for face in faces:
        room += len(face.tiles.depth) + 2 * len(face.segment) + 12
    elements, keys, opened = np.empty((room, 3)), np.empty(room, np.int64), np.zeros(6)
    lines, at, m = np.empty(6 * n + 1, np.int64), np.empty(6 * n + 1), 0
    for p in range(n):
        for j in range(polygons.n_points[p]):
            one, other = polygons.tags[p, j - 1 if j > 0 else polygons.n_points[p] - 1], polygons.tags[p, j]
            if one >= PLANE and other >= PLANE and (one - PLANE) // 2 != (other - PLANE) // 2 and m < len(at):
                axis, fixed = (one - PLANE) // 2, (other - PLANE) // 2
                lines[m] = line_of(3, 3 - axis - fixed, fixed, (other - PLANE) % 2, (one - PLANE) % 2)
                at[m] = polygons.points[p, j, 3 - axis - fixed]
                m += 1
    count = 0
    for face in range(6):
        tiles, plane = faces[face].tiles, faces[face]
        simple = True
        for k in range(len(tiles.depth)):
            simple = simple and tiles.depth[k] <= 1
            if tiles.depth[k] == 0:
                opened[face] += measure(tiles, k)
        if not simple:
            for k in range(len(tiles.depth)):
                if tiles.depth[k] == 0:
                    elements[count, 0], elements[count, 1] = face, node[start[n + face] + k]
                    elements[count, 2], keys[count] = measure(tiles, k), k
                    count += 1
            continue
        count = _plain_face(
            face, plane, node[start[n + face] : start[n + face + 1]], polygons, facet, image, n_facets, lines[:m],
            at[:m], elements, keys, count,
        )  # fmt: skip
    return elements[:count].copy(), keys[:count].copy(), opened


@njit(cache=True)
def _plain_face(face, plane, node, polygons, facet, image, n_facets, lines, at, elements, keys, count):
    """Write the elements of a face that nothing covers twice as ``walk_3d`` does; return how many there are now."""
    tiles = plane.tiles
    axis, side = face // 2, face % 2
    u, v = (axis + 1) % 3, (axis + 2) % 3
    for s in range(len(plane.segment)):
        p = plane.segment[s]
        beside, widest = -1, 0.0
        for k in range(len(tiles.depth)):
            borders = tiles.line[k, 0] == 4 + s or tiles.line[k, 1] == 4 + s
            if tiles.depth[k] == 0 and borders and tiles.ends[k, 1] - tiles.ends[k, 0] > widest:
                beside, widest = node[k], tiles.ends[k, 1] - tiles.ends[k, 0]
        for i in range(polygons.n_points[p]):
            if polygons.tags[p, i] == PLANE + face and beside >= 0:
                a, b = polygons.points[p, i], polygons.points[p, i + 1 if i + 1 < polygons.n_points[p] else 0]
                elements[count, 0], elements[count, 1] = face, beside
                elements[count, 2] = (side - 0.5) * (a[u] * b[v] - b[u] * a[v])
                keys[count] = image[p] * n_facets + facet[p]
                count += 1
                break
    ends, place = np.empty((2, 3)), np.empty(3)
    for e in range(4):
        fixed = (axis + 1 + e // 2) % 3
        along = 3 - axis - fixed
        line = line_of(3, along, fixed, e % 2, side)
        here = np.sort(at[lines == line])
        # the same edge in the order of the polygon's corners
        edge = (0 if e % 2 == 0 else 2) if fixed == v else (3 if e % 2 == 0 else 1)
        for c in range(len(here) + 1):
            low = -0.5 if c == 0 else here[c - 1]
            high = 0.5 if c == len(here) else here[c]
            # a closed stretch touches open tiles by rounding alone
            beside, widest = -1, 1e-3 * (high - low)
            for k in range(len(tiles.depth)):
                for b in range(2):
                    if tiles.depth[k] != 0 or tiles.line[k, b] != edge:
                        continue
                    for s in range(2):
                        point(plane, tiles.ends[k, s], tiles.height[k, 2 * b + s], place)
                        ends[s] = place
                    shared = min(high, max(ends[0, along], ends[1, along]))
                    shared -= max(low, min(ends[0, along], ends[1, along]))
                    if shared > widest:
                        beside, widest = node[k], shared
            if beside >= 0:
                elements[count, 0], elements[count, 1] = face, beside
                elements[count, 2], keys[count] = 0.25 * (high - low), -1 - e - 4 * c
                count += 1
    return count


@njit(cache=True)
def _join_shells(parent, kept, size):
    """Join closed shells that fluid surrounds with the fluid around; return whether that is known.

    It is if all the fluid that the faces show is in one piece.
    """
    n_kept, good = len(kept), True
    outer, several = -1, False
    for m in range(n_kept, len(parent)):
        if size[m] <= NOTHING:
            continue
        several = several or (outer >= 0 and find(parent, m) != find(parent, outer))
        outer = m
    for k in range(n_kept):
        root, volume, alone = find(parent, k), 0.0, True
        if root != k:
            continue
        for m in range(n_kept, len(parent)):
            alone = alone and find(parent, m) != root
        if not alone:
            continue
        for m in range(n_kept):
            if find(parent, m) == root:
                for i in range(1, 3):
                    a, b, c = kept[m, 0], kept[m, i], kept[m, i + 1]
                    twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
                    volume += twice * (a[2] + b[2] + c[2]) / 6.0
        if volume > NOTHING:
            good = good and outer >= 0 and not several
            if outer >= 0:
                join(parent, k, outer)
    return good
