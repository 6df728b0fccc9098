"""A walk around one cell that several parts of a surface cut: which of them bound the same piece of fluid.

Each connected part of the surface in the cell has fluid on one side of it, in one piece. Two parts bound the same
piece if an open stretch of a line (an edge of the cell, in 2D a side) ends at both; an open corner joins the lines
that meet there. That is all there is to join, except for parts that surround each other: closed loops on a face and
closed shells inside the cell, for which a ray looks for what lies around them.

Faces are numbered 2 axis + side. A line has the number axis 2^(dim - 1) + sides, with one bit for the side of each
axis that follows its own in turn; a corner has one bit an axis. Nodes are the parts, then the corners. Coordinates
are in units of cells about the cell's centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.slabs import MOST, PLANE, clip_to_cell


class Lines(NamedTuple):
    """Where the surface crosses the lines of the cell, and the stretches in between.

    Attributes
    ----------
    start : ndarray of int, shape (n_lines + 1,)
        Line l has crossings start[l]:start[l + 1] of ``position``, ascending, and stretches start[l] + l up to and
        with start[l + 1] + l of ``node`` and ``length``.
    position : ndarray, shape (n,)
    node : ndarray of int, shape (n + n_lines,)
        A node that has this stretch in its piece, -1 where it is not open.
    length : ndarray, shape (n + n_lines,)
    """

    start: np.ndarray
    position: np.ndarray
    node: np.ndarray
    length: np.ndarray


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
def find(parent, i):
    """Return the root of a node."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def join(parent, i, j):
    """Make two nodes one piece; the lower root stays."""
    i, j = find(parent, i), find(parent, j)
    parent[max(i, j)] = min(i, j)


@njit(cache=True)
def position_of(facets, facet):
    """Return where a facet stands in an ascending list, -1 if it does not."""
    i = np.searchsorted(facets, facet)
    return i if i < len(facets) and facets[i] == facet else -1


@njit(cache=True)
def _line(dim, axis, fixed, side, other_side):
    """Return the line along ``axis`` on the given side of axis ``fixed`` (and of the third one)."""
    if dim == 2:
        return 2 * axis + side
    first = fixed == (axis + 1) % 3
    return 4 * axis + (side + 2 * other_side if first else other_side + 2 * side)


@njit(cache=True)
def _corners(dim, line):
    """Return the corners at the low and high end of a line."""
    per = 1 << (dim - 1)
    axis, sides = line // per, line % per
    corner = 0
    for b in range(dim - 1):
        corner |= ((sides >> b) & 1) << ((axis + 1 + b) % dim)
    return corner, corner | (1 << axis)


@njit(cache=True)
def _find_lines(dim, crossings, open_corner, n_parts, parent):
    """Return the lines and join what their open stretches join.

    Parameters
    ----------
    crossings : ndarray, shape (n, 4)
        Line, position, part, and +1 where the line leaves the solid upwards, -1 where it enters.
    open_corner : bool
        What the corners are if nothing crosses any line.
    parent : ndarray of int, shape (n_parts + 2^dim,)
    """
    n_lines = dim * (1 << (dim - 1))
    n = len(crossings)
    start = np.zeros(n_lines + 1, np.int64)
    for c in range(n):
        start[int(crossings[c, 0]) + 1] += 1
    start = np.cumsum(start)
    order = np.argsort(crossings[:, 1], kind="mergesort")
    order = order[np.argsort(crossings[order, 0], kind="mergesort")]
    position = crossings[order, 1]
    node, length = np.full(n + n_lines, -1), np.zeros(n + n_lines)
    state = np.full(1 << dim, -1)
    for line in range(n_lines):
        first, last = start[line], start[line + 1]
        if first == last:
            continue
        depth = lowest = 0
        for c in range(first, last):
            depth -= int(crossings[order[c], 3])
            lowest = min(lowest, depth)
        depth = -lowest
        low, high = _corners(dim, line)
        for c in range(first, last + 1):
            if depth == 0:
                below = n_parts + low if c == first else int(crossings[order[c - 1], 2])
                above = n_parts + high if c == last else int(crossings[order[c], 2])
                join(parent, below, above)
                node[c + line] = below
            bottom, top = -0.5 if c == first else position[c - 1], 0.5 if c == last else position[c]
            length[c + line] = top - bottom
            if c == first:
                state[low] = depth == 0
            if c == last:
                state[high] = depth == 0
            else:
                depth -= int(crossings[order[c], 3])
    if n == 0:
        state[:] = open_corner
    _follow_whole_lines(dim, start, state, n_parts, parent, node, length)
    return Lines(start, position, node, length), state


@njit(cache=True)
def _follow_whole_lines(dim, start, state, n_parts, parent, node, length):
    """Give corners the state of those to which lines without crossings lead; join the open ones."""
    for _ in range(1 << dim):
        for line in range(len(start) - 1):
            low, high = _corners(dim, line)
            if start[line] == start[line + 1]:
                state[low] = state[high] = max(state[low], state[high])
    for line in range(len(start) - 1):
        low, high = _corners(dim, line)
        if start[line] == start[line + 1]:
            length[start[line] + line] = 1.0
            if state[low] == 1:
                node[start[line] + line] = n_parts + low
                join(parent, n_parts + low, n_parts + high)


# ---- in two dimensions --------------------------------------------------------------------------------------


@njit(cache=True)
def walk_2d(x, facets, cells, facet, image, part, n_parts, opening):
    """Return what the patches of one cell join.

    Parameters
    ----------
    x : ndarray, shape (n_points, dim)
        In units of cells.
    facets : ndarray of int, shape (m, dim)
    cells : ndarray of int, shape (n_images, dim)
        Where the cell lies as each image sees it.
    facet, image : ndarray of int, shape (n,)
        The patches, ordered by image, then facet.
    part : ndarray of int, shape (n,)
        The connected part that each belongs to, counted from 0.
    opening : ndarray, shape (2 dim,)
        The open fractions of the cell's faces.

    Returns
    -------
    parent : ndarray of int, shape (n_parts + 2^dim,)
        Nodes of one piece have one root.
    state : ndarray of int, shape (2^dim,)
        1 for open corners.
    elements : ndarray, shape (l, 3)
        Face, node and what that adds to the open area of the node's piece on the face (a fraction of it).
    keys : ndarray of int64, shape (l,)
        The same for the same element seen from the cell beyond the face, where they have the same order.
    good : bool
        False if the walk got lost.
    """
    n = len(facet)
    parent = np.arange(n_parts + 4)
    points, tags = np.empty((2, MOST, 4)), np.empty((2, MOST), np.int64)
    ends = np.empty((n, 2, 2))
    crossings = np.empty((2 * n, 4))
    count = 0
    shut = np.ones(n_parts, np.bool_)
    for p in range(n):
        clip_to_cell(x, facets[facet[p]], cells[image[p]], points, tags)
        for i in range(2):
            ends[p, i] = points[1, i, :2]
            if tags[1, i] >= PLANE:
                axis, side = (tags[1, i] - PLANE) // 2, (tags[1, i] - PLANE) % 2
                # fluid is to the right of the way out of the cell
                sign = (2 * side - 1) * (2 * i - 1) * (1 if axis == 1 else -1)
                crossings[count, 0] = _line(2, 1 - axis, axis, side, 0)
                crossings[count, 1], crossings[count, 2], crossings[count, 3] = ends[p, i, 1 - axis], part[p], sign
                shut[part[p]] = False
                count += 1
    lines, state = _find_lines(2, crossings[:count], opening[0] > 0.5, n_parts, parent)
    good = True
    for s in range(n_parts):
        if shut[s]:
            good = _surround_2d(ends, part, s, lines, parent) and good
    elements, keys = np.empty((len(lines.node), 3)), np.empty(len(lines.node), np.int64)
    count = 0
    for line in range(4):
        axis, side = line // 2, line % 2
        for c in range(lines.start[line] + line, lines.start[line + 1] + line + 1):
            if lines.node[c] >= 0:
                elements[count, 0], elements[count, 1] = 2 * (1 - axis) + side, lines.node[c]
                elements[count, 2], keys[count] = lines.length[c], c - lines.start[line] - line
                count += 1
    return parent, state, elements[:count], keys[:count], good


@njit(cache=True)
def _surround_2d(ends, part, s, lines, parent):
    """Join a closed curve with the fluid around it, if that is on its outside; False if none is found."""
    area, top = 0.0, np.array([-np.inf, 0.0])
    for p in range(len(part)):
        if part[p] == s:
            area += ends[p, 0, 0] * ends[p, 1, 1] - ends[p, 1, 0] * ends[p, 0, 1]
            if ends[p, 0, 0] > top[0]:
                top[:] = ends[p, 0]
    if area <= 0.0:
        return True
    node, nearest = -1, np.inf
    for p in range(len(part)):
        if part[p] != s:
            u = _hit(ends[p], top[1])
            if top[0] <= u < nearest:
                node, nearest = part[p], u
    if node < 0:
        node = _stretch(lines, _line(2, 1, 0, 1, 0), top[1])
    if node >= 0:
        join(parent, s, node)
    return node >= 0


@njit(cache=True)
def _hit(ends, v):
    """Return where a segment has the second coordinate v, infinite if nowhere."""
    if (ends[0, 1] <= v) == (ends[1, 1] <= v):
        return np.inf
    return ends[0, 0] + (v - ends[0, 1]) / (ends[1, 1] - ends[0, 1]) * (ends[1, 0] - ends[0, 0])


@njit(cache=True)
def _stretch(lines, line, position):
    """Return the node of the stretch of a line that holds a position, -1 if it is not open."""
    c = lines.start[line]
    while c < lines.start[line + 1] and lines.position[c] <= position:
        c += 1
    return lines.node[c + line]


# ---- in three dimensions ------------------------------------------------------------------------------------


@njit(cache=True)
def walk_3d(x, facets, cells, facet, image, part, n_parts, opening, neighbours):
    """Return what the patches of one cell join; see ``walk_2d``.

    Parameters
    ----------
    neighbours : ndarray of int, shape (m, 3)
        The facet beyond each edge.
    """
    n = len(facet)
    parent = np.arange(n_parts + 8)
    traces = Traces(np.zeros((n, 6, 2, 2)), np.full((n, 6), -1), np.full((n, 6), -1), np.full((n, 6), -1))
    crossings, heights, good = _trace(x, facets, cells, facet, image, part, traces)
    covered = 0.0
    for p in range(n):
        if traces.after[p, 0] >= 0:
            covered += _green(traces.ends[p, 0], 0)
    lines, state = _find_lines(3, crossings, opening[0] - covered > 0.5, n_parts, parent)
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
            crossings[count, 0] = _line(3, along, axis, side, other_side)
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
            height[1:] = polygon[i]
    for i in range(1, len(polygon) - 1):
        b, c = polygon[i] - polygon[0], polygon[i + 1] - polygon[0]
        height[0] += (b[0] * c[1] - b[1] * c[0]) * (polygon[0, 2] + polygon[i, 2] + polygon[i + 1, 2]) / 6.0


@njit(cache=True)
def _green(ends, face):
    """Return what a segment on a face adds to the area of the opening beside it."""
    side = 1.0 if face % 2 else -1.0
    return 0.5 * side * (ends[0, 0] * ends[1, 1] - ends[1, 0] * ends[0, 1])


@njit(cache=True)
def _join_loops(face, facet, image, part, traces, neighbours, lines, parent):
    """Number the chains on a face and join loops around solids with what is around them; return False if lost."""
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
                q = _patch(facet, image, neighbours[facet[q], after], image[q])
                good = good and q >= 0 and traces.after[q, face] >= 0
                if not good:
                    return False
            number += 1
        if loops == 0:
            n_open = number
    for loop in range(n_open, number):
        if area[loop] >= 0.0:
            continue
        top = np.array([-np.inf, 0.0])
        for p in range(n):
            if traces.chain[p, face] == loop and traces.ends[p, face, 0, 0] > top[0]:
                top[:] = traces.ends[p, face, 0]
        node = _beside(face, top, loop, part, traces, lines)
        if node < 0:
            return False
        join(parent, part[first[loop]], node)
    return good


@njit(cache=True)
def _patch(facet, image, wanted, wanted_image):
    """Return the number of the patch of a facet and image, -1 if there is none."""
    low, high = np.searchsorted(image, wanted_image), np.searchsorted(image, wanted_image, side="right")
    i = position_of(facet[low:high], wanted)
    return low + i if i >= 0 else -1


@njit(cache=True)
def _beside(face, at, loop, part, traces, lines):
    """Return the node whose opening on a face holds a point: what a ray along the first coordinate meets."""
    node, nearest = -1, np.inf
    for p in range(len(part)):
        if traces.after[p, face] >= 0 and traces.chain[p, face] != loop:
            u = _hit(traces.ends[p, face], at[1])
            if at[0] <= u < nearest:
                node, nearest = part[p], u
    if node >= 0:
        return node
    axis = face // 2
    return _stretch(lines, _line(3, (axis + 2) % 3, (axis + 1) % 3, 1, face % 2), at[1])


@njit(cache=True)
def _surround_3d(x, facets, cells, facet, image, part, s, heights, traces, lines, parent):
    """Join a closed shell with the fluid around it, if that is on its outside; False if none is found."""
    volume, top = 0.0, np.full(3, -np.inf)
    for p in range(len(part)):
        if part[p] == s:
            volume += heights[p, 0]
            if heights[p, 3] > top[2]:
                top[:] = heights[p, 1:]
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
        node = _beside(5, top[:2], -1, part, traces, lines)
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
            line = _line(3, 3 - axis - fixed, fixed, e % 2, side)
            for c in range(lines.start[line] + line, lines.start[line + 1] + line + 1):
                if lines.node[c] >= 0:
                    elements[count, 0], elements[count, 1] = face, lines.node[c]
                    # each of the four sides is half a cell from the centre
                    elements[count, 2] = 0.25 * lines.length[c]
                    keys[count] = -1 - e - 4 * (c - lines.start[line] - line)
                    count += 1
    return elements[:count], keys[:count]
