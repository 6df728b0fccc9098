"""A walk around one cell in three dimensions, see ``walks``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.slabs import MOST, PLANE, clip_to_cell
from petfsi.geometry.union_find import join
from petfsi.geometry.walks import find_lines, hit, line_of, patch_of, stretch


class Traces(NamedTuple):
    """Where patches, in order, end on the faces of the cell: a segment for each patch and face.

    Attributes
    ----------
    ends : ndarray, shape (n, 6, 2, 2)
        Start and end in the face's coordinates, along the axes that follow its own in turn.
    before, after : ndarray of int, shape (n, 6)
        Tags of the patch's sides before and after the segment; -1 where there is none.
    chain : ndarray of int, shape (n, 6)
        Number of the chain of segments on the face.
    """

    ends: np.ndarray
    before: np.ndarray
    after: np.ndarray
    chain: np.ndarray


@njit(cache=True)
def walk_3d(x, facets, cells, facet, image, part, n_parts, opening, neighbours):
    """Return what the patches of one cell join; see ``walk_2d``.

    Parameters
    ----------
    neighbours : tuple of ndarray of int
        The facet beyond each edge, and what else ``pieces.split_cells`` says of it.
    """
    n = len(facet)
    parent = np.arange(n_parts + 8)
    traces = Traces(np.zeros((n, 6, 2, 2)), np.full((n, 6), -1), np.full((n, 6), -1), np.full((n, 6), -1))
    crossings, heights, good = _trace(x, facets, cells, facet, image, part, traces)
    covered = 0.0
    for p in range(n):
        if traces.after[p, 0] >= 0:
            covered += _green(traces.ends[p, 0], 0)
    lines, state = find_lines(3, crossings, opening[0] - covered > 0.5, n_parts, parent)
    for face in range(6):
        good = _join_loops(face, facet, image, part, traces, neighbours, lines, parent) and good
    for s in range(n_parts):
        touches = False
        for p in range(n):
            if part[p] == s:
                touches = touches or traces.after[p].max() >= 0
        if not touches:
            good = _surround_3d(x, facets, cells, facet, image, part, s, heights, traces, lines, parent) and good
    elements, keys = _elements_3d(facet, image, part, len(facets), traces, lines)
    return parent, state, elements, keys, good


@njit(cache=True)
def _trace(x, facets, cells, facet, image, part, traces):
    """Fill the traces; return the crossings of lines, and each patch's int x_2 dA_2 and its highest point."""
    points, tags = np.empty((2, MOST, 6)), np.empty((2, MOST), np.int64)
    crossings = np.empty((6 * len(facet), 4))
    heights = np.empty((len(facet), 4))
    count = 0
    good = True
    for p in range(len(facet)):
        n = clip_to_cell(x, facets[facet[p]], cells[image[p]], points, tags)
        polygon = points[1, :n, :3]
        _height(polygon, heights[p])
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            if tags[1, i] < PLANE:
                continue
            face = tags[1, i] - PLANE
            axis, side = face // 2, face % 2
            u, v = (axis + 1) % 3, (axis + 2) % 3
            good = good and traces.after[p, face] < 0
            traces.before[p, face], traces.after[p, face] = tags[1, i - 1 if i > 0 else n - 1], tags[1, j]
            traces.ends[p, face, 0, 0], traces.ends[p, face, 0, 1] = polygon[i, u], polygon[i, v]
            traces.ends[p, face, 1, 0], traces.ends[p, face, 1, 1] = polygon[j, u], polygon[j, v]
            if tags[1, j] < PLANE:
                continue
            other, other_side = (tags[1, j] - PLANE) // 2, (tags[1, j] - PLANE) % 2
            if other == axis or count == len(crossings):
                good = False
                continue
            along = 3 - axis - other
            turn = 1 if other == u else -1
            crossings[count, 0] = line_of(3, along, axis, side, other_side)
            crossings[count, 1], crossings[count, 2] = polygon[j, along], part[p]
            crossings[count, 3] = turn * (2 * side - 1) * (2 * other_side - 1)
            count += 1
    return crossings[:count], heights, good


@njit(cache=True)
def _height(polygon, height):
    """Set int x_2 dA_2 over a polygon and its highest point."""
    height[0], height[3] = 0.0, -np.inf
    for i in range(len(polygon)):
        if polygon[i, 2] > height[3]:
            height[1], height[2], height[3] = polygon[i, 0], polygon[i, 1], polygon[i, 2]
    for i in range(1, len(polygon) - 1):
        twice = (polygon[i, 0] - polygon[0, 0]) * (polygon[i + 1, 1] - polygon[0, 1])
        twice -= (polygon[i, 1] - polygon[0, 1]) * (polygon[i + 1, 0] - polygon[0, 0])
        height[0] += twice * (polygon[0, 2] + polygon[i, 2] + polygon[i + 1, 2]) / 6.0


@njit(cache=True)
def _green(ends, face):
    """Return what a segment on a face adds to the area of the opening beside it."""
    side = 1.0 if face % 2 else -1.0
    return 0.5 * side * (ends[0, 0] * ends[1, 1] - ends[1, 0] * ends[0, 1])


@njit(cache=True)
def _join_loops(face, facet, image, part, traces, neighbours, lines, parent):
    """Return whether the walk along a face succeeds: chains get numbers, loops join what is around."""
    n = len(facet)
    number, n_open = 0, 0
    good = True
    first = np.empty(n, np.int64)
    area = np.zeros(n)
    for loops in range(2):
        for p in range(n):
            begins = traces.after[p, face] >= 0 and traces.chain[p, face] < 0
            if not begins or (loops == 0 and traces.before[p, face] < PLANE):
                continue
            q = p
            first[number] = p
            while q >= 0 and traces.chain[q, face] < 0:
                traces.chain[q, face] = number
                area[number] += _green(traces.ends[q, face], face)
                after = traces.after[q, face]
                if after >= PLANE:
                    break
                beyond, step, there = neighbours
                q = patch_of(facet, image, beyond[facet[q], after], there[image[q], step[facet[q], after]])
                good = good and q >= 0 and traces.after[q, face] >= 0
                if not good:
                    return False
            number += 1
        if loops == 0:
            n_open = number
    for loop in range(n_open, number):
        if area[loop] >= 0.0:
            continue
        u, v = -np.inf, 0.0
        for p in range(n):
            if traces.chain[p, face] == loop and traces.ends[p, face, 0, 0] > u:
                u, v = traces.ends[p, face, 0, 0], traces.ends[p, face, 0, 1]
        node = _beside(face, u, v, loop, part, traces, lines)
        if node < 0:
            return False
        join(parent, part[first[loop]], node)
    return good


@njit(cache=True)
def _beside(face, u, v, loop, part, traces, lines):
    """Return the node whose opening on a face holds a point: what a ray along the first coordinate meets."""
    node, nearest = -1, np.inf
    for p in range(len(part)):
        if traces.after[p, face] >= 0 and traces.chain[p, face] != loop:
            at = hit(traces.ends[p, face], v)
            if u <= at < nearest:
                node, nearest = part[p], at
    if node >= 0:
        return node
    axis = face // 2
    return stretch(lines, line_of(3, (axis + 2) % 3, (axis + 1) % 3, 1, face % 2), v)


@njit(cache=True)
def _surround_3d(x, facets, cells, facet, image, part, s, heights, traces, lines, parent):
    """Join a closed shell with the fluid around it, if that is on its outside; False if none is found."""
    volume, top = 0.0, np.full(3, -np.inf)
    for p in range(len(part)):
        if part[p] == s:
            volume += heights[p, 0]
            if heights[p, 3] > top[2]:
                top[0], top[1], top[2] = heights[p, 1], heights[p, 2], heights[p, 3]
    if volume <= 0.0:
        return True
    points, tags = np.empty((2, MOST, 6)), np.empty((2, MOST), np.int64)
    node, nearest = -1, np.inf
    for p in range(len(part)):
        if part[p] != s:
            n = clip_to_cell(x, facets[facet[p]], cells[image[p]], points, tags)
            z = _above(points[1, :n, :3], top)
            if top[2] <= z < nearest:
                node, nearest = part[p], z
    if node < 0:
        node = _beside(5, top[0], top[1], -1, part, traces, lines)
    if node >= 0:
        join(parent, s, node)
    return node >= 0


@njit(cache=True)
def _above(polygon, at):
    """Return the height at which an upright line meets a polygon, infinite if it does not."""
    inside = False
    area, moment = np.zeros(3), 0.0
    n = len(polygon)
    for i in range(n):
        p, q = polygon[i], polygon[i + 1 if i + 1 < n else 0]
        if (p[1] <= at[1]) != (q[1] <= at[1]):
            inside ^= p[0] + (at[1] - p[1]) / (q[1] - p[1]) * (q[0] - p[0]) > at[0]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            area[a] += (p[b] - at[b]) * (q[c] - at[c]) - (q[b] - at[b]) * (p[c] - at[c])
    if not inside or area[2] == 0.0:
        return np.inf
    for a in range(3):
        moment += area[a] * (polygon[0, a] - at[a])
    return at[2] + moment / area[2]


@njit(cache=True)
def _elements_3d(facet, image, part, n_facets, traces, lines):
    """Return elements and keys as ``walk_2d`` does: segments and open stretches on the faces."""
    n = len(facet)
    room = 6 * n + 2 * len(lines.node)
    elements, keys = np.empty((room, 3)), np.empty(room, np.int64)
    count = 0
    for face in range(6):
        for p in range(n):
            if traces.after[p, face] >= 0:
                elements[count, 0], elements[count, 1] = face, part[p]
                elements[count, 2] = _green(traces.ends[p, face], face)
                keys[count] = image[p] * n_facets + facet[p]
                count += 1
        axis, side = face // 2, face % 2
        for e in range(4):
            fixed = (axis + 1 + e // 2) % 3
            line = line_of(3, 3 - axis - fixed, fixed, e % 2, side)
            for c in range(lines.start[line] + line, lines.start[line + 1] + line + 1):
                if lines.node[c] >= 0:
                    elements[count, 0], elements[count, 1] = face, lines.node[c]
                    # each of the four sides is half a cell from the centre
                    elements[count, 2] = 0.25 * lines.length[c]
                    keys[count] = -1 - e - 4 * (c - lines.start[line] - line)
                    count += 1
    return elements[:count], keys[:count]
