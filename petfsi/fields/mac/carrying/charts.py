"""What the water on one side of a sheet sees of its surroundings: its own side's values, and none of the other's.

A target, a piece of fluid in a cell, gets a chart: small arrays of the cells around it and their faces. A search
through open faces, nearest cells first, finds which piece of each cell the target's water is joined with; faces and
cells take the values of those, and whatever is not reached (beyond a sheet, in a wall) is extrapolated: faces
linearly, smoke by means, which keep it within its bounds. Paths and stencils then read the chart as they read the grid
elsewhere. Nothing looks at the geometry, so nothing needs a tolerance; and the chart of a target is the same on any
number of ranks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.fields.mac.carrying.extrapolate import LINEAR, on_line
from petfsi.fields.mac.grid.kinds import DEAD, NARROW, PRESSURE, SPLIT

#: Layers of entries not reached: narrow parts of divided faces, unknown yet, and beyond the sides of the domain.
SLIVER, UNKNOWN, BEYOND = 125, 126, 127

#: Entries around a chart that nothing is known of, so that no neighbour has to be looked for in vain.
MARGIN = 2


class Cut(NamedTuple):
    """A grid that surfaces cut, as a kernel reads it; in 2D the third of three is the first once more.

    Attributes
    ----------
    kind, narrow, first : tuple of three ndarray
        Face arrays: kinds, which are narrow (see ``kinds.narrow_faces``), first links of divided ones (else -1).
    kinds, firsts : ndarray, shape (n_faces,)
        Kinds and first links again, one axis after the other.
    extra : ndarray of int32
        Cell array: row of piece 1 of a divided cell, else -1.
    fluid, given : ndarray of bool
        Cell arrays; beyond the sides, where a jet says what smoke comes in.
    ends : ndarray of int64, shape (n_links,)
        Where the links of a link's face end.
    below, above : ndarray of int64, shape (n_links,)
        The pieces that it joins.
    part : ndarray, shape (n_links,)
        Its openness.
    low, high : ndarray of int64, shape (3,)
        The local cells that lie in the domain.
    dim : int
    """

    kind: tuple[np.ndarray, np.ndarray, np.ndarray]
    narrow: tuple[np.ndarray, np.ndarray, np.ndarray]
    first: tuple[np.ndarray, np.ndarray, np.ndarray]
    kinds: np.ndarray
    firsts: np.ndarray
    extra: np.ndarray
    fluid: np.ndarray
    given: np.ndarray
    ends: np.ndarray
    below: np.ndarray
    above: np.ndarray
    part: np.ndarray
    low: np.ndarray
    high: np.ndarray
    dim: int


@njit(cache=True)
def reach_pieces(cut, base, start, piece, pick, queue):
    """Find which piece of each cell of a window a piece is joined with.

    Parameters
    ----------
    cut : Cut
    base : tuple of int
        The local cell of the chart's first entry.
    start : tuple of int
        Where the piece's cell is in the chart.
    piece : int
    pick : ndarray of int8
        Filled: the piece of each cell that is reached first, -1 where none is. The margin stays as it is, no entry of
        it -1.
    queue : ndarray of int64, shape (n, 4)
        Room for as many cells.
    """
    # the counting of references to arrays that are handed on costs more than the search: flat arrays, and no calls
    kinds, firsts, fluid, dim = cut.kinds, cut.firsts, cut.fluid, cut.dim
    links = cut.ends, cut.below, cut.above, cut.part
    _, m1, m2 = fluid.shape
    n0, n1, n2 = pick.shape
    deep = MARGIN if dim == 3 else 0
    for i in range(MARGIN, n0 - MARGIN):
        for j in range(MARGIN, n1 - MARGIN):
            for k in range(deep, n2 - deep):
                pick[i, j, k] = -1
    picked = pick.reshape(-1)
    begin = np.array([0, cut.kind[0].size, cut.kind[0].size + cut.kind[1].size])
    rows = np.array([m1, m1 + 1, m1])  # of faces along the second axis, and along the third
    columns = np.array([m2, m2, m2 + 1])
    strides, up = np.array([n1 * n2, n2, 1]), np.array([m1 * m2, m2, 1])
    at = (start[0] * n1 + start[1]) * n2 + start[2]
    picked[at] = piece
    queue[0, 0], queue[0, 1], queue[0, 2], queue[0, 3] = at, base[0] + start[0], base[1] + start[1], base[2] + start[2]
    head, tail = 0, 1
    while head < tail:
        at, i, j, k = queue[head, 0], queue[head, 1], queue[head, 2], queue[head, 3]
        head += 1
        here = picked[at]
        for a in range(dim):
            face = begin[a] + (i * rows[a] + j) * columns[a] + k
            for side in range(2):
                step = 2 * side - 1
                beside = at + step * strides[a]
                if picked[beside] != -1:
                    continue
                kind, to = kinds[face + side * up[a]], -1
                if kind == PRESSURE:
                    to = 0
                elif kind == SPLIT:
                    to = through(links, firsts[face + side * up[a]], here, side)
                if to >= 0:
                    picked[beside] = to
                    queue[tail, 0], queue[tail, 1] = beside, i + step * (a == 0)
                    queue[tail, 2], queue[tail, 3] = j + step * (a == 1), k + step * (a == 2)
                    tail += 1


@njit(cache=True)
def through(links, first, piece, up):
    """Return the piece on the other side of a divided face that the widest link from a piece leads to; -1 for none."""
    ends, lower, upper, part = links
    best, width = -1, 0.0
    if first >= 0:
        for link in range(first, ends[first]):
            own, other = (lower[link], upper[link]) if up else (upper[link], lower[link])
            if own == piece and other >= 0 and part[link] > width:
                best, width = other, part[link]
    return best


@njit(cache=True)
def _link_of(links, first, below, above):
    """Return the link of a divided face between two pieces or, failing that, of one of them; -1 for none."""
    ends, lower, upper, part = links
    best, most = -1, 0.0
    for link in range(first, ends[first]):
        match = 0.0
        if below >= 0 and lower[link] == below:
            match += 2.0
        if above >= 0 and upper[link] == above:
            match += 2.0
        if match > 0.0 and match + part[link] > most:
            best, most = link, match + part[link]
    return best


@njit(cache=True)
def is_inside(cut, base, shape):
    """Return whether the cells and faces of a chart, but for its margin, all lie in the domain."""
    for b in range(cut.dim):
        if base[b] + MARGIN < cut.low[b] or base[b] + shape[b] - MARGIN > cut.high[b]:
            return False
    return True


@njit(cache=True)
def fill_faces(cut, a, base, pick, values, parts, known, q, layer, todo):
    """Fill a chart of the faces of an axis; return how many are known, and how many are to be extrapolated.

    Parameters
    ----------
    cut : Cut
    a : int
        Axis.
    base : tuple of int
        The local cell of the chart's first entry.
    pick : ndarray of int8
        As ``reach_pieces`` fills it.
    values, parts : ndarray
        Face array, and values of links.
    known : ndarray of bool, shape (n_links,)
        Which of those may be read.
    q : ndarray
        The chart, a face longer than ``pick`` along the axis.
    layer : ndarray of int8
        The same shape: distance from what is known. The margin stays as it is, BEYOND.
    todo : ndarray of int64
        Filled with the flat indices of entries that are not known.
    """
    n0, n1, n2 = q.shape
    kind, narrow, first = cut.kind[a], cut.narrow[a], cut.first[a]
    links, low, high, dim = (cut.ends, cut.below, cut.above, cut.part), cut.low, cut.high, cut.dim
    whole = is_inside(cut, base, q.shape)
    di, dj, dk = int(a == 0), int(a == 1), int(a == 2)
    deep = MARGIN if dim == 3 else 0
    some = slivers = left = 0
    for i in range(MARGIN, n0 - MARGIN):
        for j in range(MARGIN, n1 - MARGIN):
            for k in range(deep, n2 - deep):
                f = (base[0] + i, base[1] + j, base[2] + k)
                q[i, j, k] = 0.0
                if not whole and _beyond(low, high, dim, a, f):
                    layer[i, j, k] = BEYOND
                    continue
                layer[i, j, k] = UNKNOWN
                above, below = pick[i, j, k], pick[i - di, j - dj, k - dk]
                here = kind[f]
                if here != DEAD and (above >= 0 or below >= 0):
                    if here == SPLIT:
                        link = _link_of(links, first[f], below, above)
                        if link >= 0 and known[link]:
                            q[i, j, k], layer[i, j, k] = parts[link], 0
                            if links[3][link] < NARROW:
                                layer[i, j, k] = SLIVER
                                slivers += 1
                    elif not narrow[f]:
                        q[i, j, k], layer[i, j, k] = values[f], 0
                if layer[i, j, k] == UNKNOWN:
                    todo[left] = (i * n1 + j) * n2 + k
                    left += 1
                else:
                    some += 1
    if slivers > 0:
        left = _pass_slivers(a, dim, layer, todo, left)
    return some, left


@njit(cache=True)
def _beyond(low, high, dim, a, f):
    """Return whether a face of an axis lies beyond the sides of the domain (cells: axis 3)."""
    for b in range(dim):
        if f[b] < low[b] or f[b] >= high[b] + (a == b):
            return True
    return False


@njit(cache=True)
def _pass_slivers(a, dim, layer, todo, left):
    """Leave narrow parts to be extrapolated where a face beside them is wide, see ``kinds.narrow_faces``."""
    n1, n2 = layer.shape[1:]
    layers, strides = layer.reshape(-1), (n1 * n2, n2, 1)
    for at in range(len(layers)):
        if layers[at] != SLIVER:
            continue
        wide = False
        for b in range(dim):
            if b != a:
                wide = wide or layers[at - strides[b]] == 0 or layers[at + strides[b]] == 0
        if wide:
            layers[at] = UNKNOWN
            todo[left] = at
            left += 1
    for at in range(len(layers)):
        if layers[at] == SLIVER:
            layers[at] = 0
    return left


@njit(cache=True)
def fill_cells(cut, base, pick, values, extras, q, layer, todo):
    """Fill a chart of cells, as ``fill_faces`` does one of faces; what is not a number is not known."""
    n0, n1, n2 = q.shape
    whole = is_inside(cut, base, q.shape)
    low, high, dim, extra = cut.low, cut.high, cut.dim, cut.extra
    deep = MARGIN if dim == 3 else 0
    some = left = 0
    for i in range(MARGIN, n0 - MARGIN):
        for j in range(MARGIN, n1 - MARGIN):
            for k in range(deep, n2 - deep):
                c = (base[0] + i, base[1] + j, base[2] + k)
                q[i, j, k], layer[i, j, k] = 0.0, UNKNOWN
                if not whole and _beyond(low, high, dim, 3, c):
                    layer[i, j, k] = BEYOND
                    continue
                piece = pick[i, j, k]
                if piece >= 0:
                    value = values[c] if piece == 0 else extras[extra[c] + piece - 1]
                    if not np.isnan(value):
                        q[i, j, k], layer[i, j, k] = value, 0
                if layer[i, j, k] == UNKNOWN:
                    todo[left] = (i * n1 + j) * n2 + k
                    left += 1
                else:
                    some += 1
    return some, left


@njit(cache=True)
def extend(q, layer, dim, linear, todo, left):
    """Give entries that are not known the values of their neighbours in lower layers, layer by layer.

    An entry takes the mean over the directions in which such a neighbour lies: what the line through it says if
    ``linear``, as in ``extrapolate.Band``, and the neighbour's neighbour is in no higher layer than it, else its value.

    Parameters
    ----------
    q : ndarray
        Chart.
    layer : ndarray of int8
    dim : int
    linear : bool
    todo : ndarray of int64
        The flat indices of those entries, ``left`` of them; used up.
    left : int
    """
    n1, n2 = q.shape[1:]
    values, layers, strides = q.reshape(-1), layer.reshape(-1), (n1 * n2, n2, 1)
    for number in range(1, SLIVER):
        rest = 0
        for n in range(left):
            at = todo[n]
            total, count = 0.0, 0
            for a in range(dim):
                for step in (-strides[a], strides[a]):
                    one = at + step
                    if layers[one] < number:
                        value = values[one]
                        if linear and number <= LINEAR and layers[one + step] <= layers[one]:
                            value = on_line(value, values[one + step])
                        total += value
                        count += 1
            if count > 0:
                values[at], layers[at] = total / count, number
            else:
                todo[rest] = at
                rest += 1
        if rest == 0 or rest == left:
            break
        left = rest


@njit(cache=True)
def clamp_faces(cut, a, base, q, layer):
    """Copy the outermost faces in the domain to those beyond its sides."""
    deep = MARGIN if cut.dim == 3 else 0
    for i in range(MARGIN, q.shape[0] - MARGIN):
        for j in range(MARGIN, q.shape[1] - MARGIN):
            for k in range(deep, q.shape[2] - deep):
                if layer[i, j, k] == BEYOND:
                    q[i, j, k] = q[
                        min(max(i, cut.low[0] - base[0]), cut.high[0] - base[0] - (a != 0)),
                        min(max(j, cut.low[1] - base[1]), cut.high[1] - base[1] - (a != 1)),
                        min(max(k, cut.low[2] - base[2]), cut.high[2] - base[2] - (a != 2)),
                    ]


@njit(cache=True)
def clamp_cells(cut, base, pick, values, q, layer):
    """Give cells beyond the sides what the grid has there, or where the chart differs what that has next to them.

    What jets carry in is the same for all pieces.
    """
    deep = MARGIN if cut.dim == 3 else 0
    for i in range(MARGIN, q.shape[0] - MARGIN):
        for j in range(MARGIN, q.shape[1] - MARGIN):
            for k in range(deep, q.shape[2] - deep):
                if layer[i, j, k] == BEYOND:
                    w = (
                        min(max(i, cut.low[0] - base[0]), cut.high[0] - base[0] - 1),
                        min(max(j, cut.low[1] - base[1]), cut.high[1] - base[1] - 1),
                        min(max(k, cut.low[2] - base[2]), cut.high[2] - base[2] - 1),
                    )
                    c = (base[0] + i, base[1] + j, base[2] + k)
                    plain = pick[w] == 0 and cut.extra[base[0] + w[0], base[1] + w[1], base[2] + w[2]] < 0
                    q[i, j, k] = values[c] if plain or cut.given[c] else q[w]


@njit(cache=True)
def complete_faces(cut, a, base, pick, values, parts, known, q, layer, todo):
    """Fill and extend a chart of the faces of an axis; return whether any of it was known. It is zero if not."""
    some, left = fill_faces(cut, a, base, pick, values, parts, known, q, layer, todo)
    if some > 0:
        extend(q, layer, cut.dim, True, todo, left)
        if not is_inside(cut, base, q.shape):
            clamp_faces(cut, a, base, q, layer)
    return some > 0


@njit(cache=True)
def room(reach, dim, a, value):
    """Return a chart of the faces of an axis (cells: 3) around a cell, with a margin, full of a value."""
    n = 2 * (reach + MARGIN) + 1
    return np.full((n + (a == 0), n + (a == 1), n + (a == 2) if dim == 3 else 1), value)


@njit(cache=True)
def search_room(reach, dim):
    """Return room for a search: which pieces are reached, and a queue."""
    pick = room(reach, dim, 3, np.int8(-2))
    return pick, np.empty((pick.size, 4), np.int64)


@njit(cache=True)
def empty_layers(reach, dim):
    """Return empty layers for charts of faces of each axis, and of cells."""
    none = np.int8(BEYOND)
    return (
        room(reach, dim, 0, none), room(reach, dim, 1, none), room(reach, dim, 2, none), room(reach, dim, 3, none),
    )  # fmt: skip


@njit(cache=True)
def empty_charts(reach, dim):
    """Return empty charts of the faces of each axis; in 2D the third is another of the first."""
    last = 2 if dim == 3 else 0
    return (room(reach, dim, 0, 0.0), room(reach, dim, 1, 0.0), room(reach, dim, last, 0.0))
