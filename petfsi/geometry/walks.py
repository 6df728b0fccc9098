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
from petfsi.geometry.union_find import join

#: Volumes and faces (fractions) that may be left out.
NOTHING = 1e-13


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


@njit(cache=True)
def position_of(facets, facet):
    """Return where a facet stands in an ascending list, -1 if it does not."""
    i = np.searchsorted(facets, facet)
    return i if i < len(facets) and facets[i] == facet else -1


@njit(cache=True)
def patch_of(facet, image, wanted, wanted_image):
    """Return the number of the patch of a facet and image among patches in their order, -1 if there is none."""
    low, high = 0, len(facet)
    while low < high:
        i = (low + high) // 2
        if image[i] < wanted_image or (image[i] == wanted_image and facet[i] < wanted):
            low = i + 1
        else:
            high = i
    return low if low < len(facet) and image[low] == wanted_image and facet[low] == wanted else -1


@njit(cache=True)
def line_of(dim, axis, fixed, side, other_side):
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
def _comes_before(crossings, c, d):
    """Return whether a crossing has a lower line, or one as high and a lower position."""
    if crossings[c, 0] != crossings[d, 0]:
        return crossings[c, 0] < crossings[d, 0]
    return crossings[c, 1] < crossings[d, 1]


@njit(cache=True)
def find_lines(dim, crossings, open_corner, n_parts, parent):
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
    order, position = np.empty(n, np.int64), np.empty(n)
    for c in range(n):
        for line in range(int(crossings[c, 0]), n_lines):
            start[line + 1] += 1
        i = c
        while i > 0 and _comes_before(crossings, c, order[i - 1]):
            order[i] = order[i - 1]
            i -= 1
        order[i] = c
    for c in range(n):
        position[c] = crossings[order[c], 1]
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
        for corner in range(1 << dim):
            state[corner] = open_corner
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
            ends[p, i, 0], ends[p, i, 1] = points[1, i, 0], points[1, i, 1]
            if tags[1, i] >= PLANE:
                axis, side = (tags[1, i] - PLANE) // 2, (tags[1, i] - PLANE) % 2
                # fluid is to the right of the way out of the cell
                sign = (2 * side - 1) * (2 * i - 1) * (1 if axis == 1 else -1)
                crossings[count, 0] = line_of(2, 1 - axis, axis, side, 0)
                crossings[count, 1], crossings[count, 2], crossings[count, 3] = ends[p, i, 1 - axis], part[p], sign
                shut[part[p]] = False
                count += 1
    lines, state = find_lines(2, crossings[:count], opening[0] > 0.5, n_parts, parent)
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
    area, u, v = 0.0, -np.inf, 0.0
    for p in range(len(part)):
        if part[p] == s:
            area += ends[p, 0, 0] * ends[p, 1, 1] - ends[p, 1, 0] * ends[p, 0, 1]
            if ends[p, 0, 0] > u:
                u, v = ends[p, 0, 0], ends[p, 0, 1]
    if area <= 0.0:
        return True
    node, nearest = -1, np.inf
    for p in range(len(part)):
        if part[p] != s:
            at = hit(ends[p], v)
            if u <= at < nearest:
                node, nearest = part[p], at
    if node < 0:
        node = stretch(lines, line_of(2, 1, 0, 1, 0), v)
    if node >= 0:
        join(parent, s, node)
    return node >= 0


@njit(cache=True)
def hit(ends, v):
    """Return where a segment has the second coordinate v, infinite if nowhere."""
    if (ends[0, 1] <= v) == (ends[1, 1] <= v):
        return np.inf
    return ends[0, 0] + (v - ends[0, 1]) / (ends[1, 1] - ends[0, 1]) * (ends[1, 0] - ends[0, 0])


@njit(cache=True)
def stretch(lines, line, position):
    """Return the node of the stretch of a line that holds a position, -1 if it is not open."""
    c = lines.start[line]
    while c < lines.start[line + 1] and lines.position[c] <= position:
        c += 1
    return lines.node[c + line]
