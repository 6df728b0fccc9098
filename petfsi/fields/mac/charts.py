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

from petfsi.fields.mac.advect import keep_own, sweep
from petfsi.fields.mac.extrapolate import LINEAR, on_line
from petfsi.fields.mac.kinds import DEAD, NARROW, PRESSURE, SPLIT

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
                    to = _through(links, firsts[face + side * up[a]], here, side)
                if to >= 0:
                    picked[beside] = to
                    queue[tail, 0], queue[tail, 1] = beside, i + step * (a == 0)
                    queue[tail, 2], queue[tail, 3] = j + step * (a == 1), k + step * (a == 2)
                    tail += 1


@njit(cache=True)
def lead_around(cut, cells, pieces, reach):
    """Return which further pieces water leads around to from the first ones of their cells within so many cells.

    Parameters
    ----------
    cut : Cut
    cells, pieces : ndarray of int64, shape (n, 3), (n,)
    reach : int
    """
    dim = cut.dim
    pick, queue = _search_room(reach, dim)
    links = cut.ends, cut.below, cut.above, cut.part
    mid = reach + MARGIN
    deep = mid if dim == 3 else 0
    found = np.zeros(len(cells), np.bool_)
    for n in range(len(cells)):
        c = (cells[n, 0], cells[n, 1], cells[n, 2])
        reach_pieces(cut, (c[0] - mid, c[1] - mid, c[2] - deep), (mid, mid, deep), pieces[n], pick, queue)
        for a in range(dim):
            for side in range(2):
                f = (c[0] + side * (a == 0), c[1] + side * (a == 1), c[2] + side * (a == 2))
                to = -1
                if cut.kind[a][f] == PRESSURE:
                    to = 0
                elif cut.kind[a][f] == SPLIT:
                    to = _through(links, cut.first[a][f], 0, side)
                step = 2 * side - 1
                w = (mid + step * (a == 0), mid + step * (a == 1), deep + step * (a == 2))
                if to >= 0 and pick[w] == to:
                    found[n] = True
    return found


@njit(cache=True)
def _through(links, first, piece, up):
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
def _inside(cut, base, shape):
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
    whole = _inside(cut, base, q.shape)
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
    whole = _inside(cut, base, q.shape)
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
        if not _inside(cut, base, q.shape):
            clamp_faces(cut, a, base, q, layer)
    return some > 0


@njit(cache=True)
def _room(reach, dim, a, value):
    """Return a chart of the faces of an axis (cells: 3) around a cell, with a margin, full of a value."""
    n = 2 * (reach + MARGIN) + 1
    return np.full((n + (a == 0), n + (a == 1), n + (a == 2) if dim == 3 else 1), value)


@njit(cache=True)
def _search_room(reach, dim):
    """Return room for a search: which pieces are reached, and a queue."""
    pick = _room(reach, dim, 3, np.int8(-2))
    return pick, np.empty((pick.size, 4), np.int64)


@njit(cache=True)
def _layers(reach, dim):
    """Return empty layers for charts of faces of each axis, and of cells."""
    none = np.int8(BEYOND)
    return (
        _room(reach, dim, 0, none), _room(reach, dim, 1, none), _room(reach, dim, 2, none), _room(reach, dim, 3, none),
    )  # fmt: skip


@njit(cache=True)
def _rooms(reach, dim):
    """Return empty charts of the faces of each axis; in 2D the third is another of the first."""
    last = 2 if dim == 3 else 0
    return (_room(reach, dim, 0, 0.0), _room(reach, dim, 1, 0.0), _room(reach, dim, last, 0.0))


@njit(cache=True)
def _limits(low, high, base, w, crossed):
    """Return the ends of the domain in a chart, no farther from a target than the chart is made for."""
    lows = (
        max(low[0] - base[0], float(w[0] - crossed)), max(low[1] - base[1], float(w[1] - crossed)),
        max(low[2] - base[2], float(w[2] - crossed)),
    )  # fmt: skip
    highs = (
        min(high[0] - base[0], w[0] + crossed + 1.0), min(high[1] - base[1], w[1] + crossed + 1.0),
        min(high[2] - base[2], w[2] + crossed + 1.0),
    )  # fmt: skip
    return lows, highs


@njit(cache=True)
def carry_faces(
    cut, cells, pieces, reach, same, path, path_parts, faces, parts, known, from_below, moved, courant, low,
    high, cubic, keep, own_faces, out, out_parts, done, kept,
):  # fmt: skip
    """Carry what is on faces to those of some pieces near sheets, each along its own side.

    Parameters
    ----------
    cut : Cut
    cells : ndarray of int64, shape (n, 3)
        Local cells.
    pieces : ndarray of int64, shape (n,)
    reach : int
        Cells that the flow crosses, and the stencil.
    same : bool
        Whether what is carried is the path's own velocity.
    path, path_parts, faces, parts
        Velocity of the path and what is carried: three face arrays, and values of links.
    known, from_below : ndarray of bool, shape (n_links,)
        Which of the latter may be read; whether a link sees what its piece below sees.
    moved, courant, low, high, cubic
        As for ``advect.sweep``; a mask per axis.
    keep : bool
        Whether what targets have beyond the values that are read stays with them, see ``advect.keep_own``.
    own_faces : tuple of three ndarray
        What faces have themselves.
    out, out_parts
        What is carried to plain faces and to links.
    done : ndarray of bool, shape (n_links,)
        Set where that was written.
    kept : tuple of three ndarray of bool
        Set where faces were told to keep their own.
    """
    dim = cut.dim
    pick, queue = _search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    flow, carried, new, own = _rooms(reach, dim), _rooms(reach, dim), _rooms(reach, dim), _rooms(reach, dim)
    layer = _layers(reach, dim)
    every = (np.ones(new[0].shape, np.bool_), np.ones(new[1].shape, np.bool_), np.ones(new[2].shape, np.bool_))
    some = np.zeros(3, np.bool_)
    mid = reach + MARGIN
    deep, crossed = mid if dim == 3 else 0, reach - (2 if cubic else 1)
    start = (mid, mid, deep)
    for n in range(len(cells)):
        c, piece = (cells[n, 0], cells[n, 1], cells[n, 2]), pieces[n]
        base = (c[0] - mid, c[1] - mid, c[2] - deep)
        reach_pieces(cut, base, start, piece, pick, queue)
        for a in range(dim):
            some[a] = complete_faces(cut, a, base, pick, path[a], path_parts, known, flow[a], layer[a], todo)
        for a in range(dim):
            if same:
                q = flow[a]
            else:
                q = carried[a]
                some[a] = complete_faces(cut, a, base, pick, faces[a], parts, known, q, layer[a], todo)
            if not some[a]:
                continue
            offset = (0.5 * (a != 0), 0.5 * (a != 1), 0.5 * (a != 2))
            for up in range(2):
                f = (c[0] + up * (a == 0), c[1] + up * (a == 1), c[2] + up * (a == 2))
                w = (start[0] + up * (a == 0), start[1] + up * (a == 1), start[2] + up * (a == 2))
                divided = cut.kind[a][f] == SPLIT
                if not divided:
                    ends = up == 0 or c[a] == cut.high[a] - 1
                    if not ends or cut.kind[a][f] == DEAD or not moved[a][f]:
                        continue
                elif not _leads(cut, cut.first[a][f], piece, up, from_below):
                    continue
                part = ((w[0], w[0] + 1), (w[1], w[1] + 1), (w[2], w[2] + 1))
                lows, highs = _limits(low, high, base, w, crossed)
                sweep(
                    q, new[a], every[a], flow[0], flow[1], flow[2], offset, part, courant, lows, highs, 0.0, cubic,
                    False,
                )  # fmt: skip
                value, first = new[a][w], cut.first[a][f] if divided else 0
                for link in range(first, cut.ends[first] if divided else 1):
                    if divided:
                        if from_below[link] != (up == 1) or piece != (cut.below[link] if up else cut.above[link]):
                            continue
                    if keep:
                        own[a][w], new[a][w] = parts[link] if divided else own_faces[a][f], value
                        keep_own(new[a], own[a], q, flow[0], flow[1], flow[2], offset, part, courant)
                    if divided:
                        out_parts[link], done[link] = new[a][w], True
                    else:
                        out[a][f], kept[a][f] = new[a][w], keep


@njit(cache=True)
def _leads(cut, first, piece, up, from_below):
    """Return whether any link of a divided face sees what a piece next to it sees."""
    for link in range(first, cut.ends[first]):
        if from_below[link] == (up == 1) and piece == (cut.below[link] if up else cut.above[link]):
            return True
    return False


@njit(cache=True)
def carry_cells(
    cut, cells, pieces, reach, path, path_parts, known, smoke, extras, courant, low, high, beyond, cubic, out,
    out_extras, done,
):  # fmt: skip
    """Carry smoke to some pieces near sheets; see ``carry_faces``.

    Parameters
    ----------
    smoke, extras : ndarray
        Cell array, and values of the further pieces.
    beyond : float
        As ``reach`` for ``advect.sweep``.
    """
    dim = cut.dim
    pick, queue = _search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    flow, q, new = _rooms(reach, dim), _room(reach, dim, 3, 0.0), _room(reach, dim, 3, 0.0)
    layer, every = _layers(reach, dim), np.ones(new.shape, np.bool_)
    mid = reach + MARGIN
    deep, crossed = mid if dim == 3 else 0, reach - (2 if cubic else 1)
    w = (mid, mid, deep)
    part = ((w[0], w[0] + 1), (w[1], w[1] + 1), (w[2], w[2] + 1))
    for n in range(len(cells)):
        c, piece = (cells[n, 0], cells[n, 1], cells[n, 2]), pieces[n]
        base = (c[0] - mid, c[1] - mid, c[2] - deep)
        reach_pieces(cut, base, w, piece, pick, queue)
        for a in range(dim):
            complete_faces(cut, a, base, pick, path[a], path_parts, known, flow[a], layer[a], todo)
        _, left = fill_cells(cut, base, pick, smoke, extras, q, layer[3], todo)
        extend(q, layer[3], dim, False, todo, left)
        if not _inside(cut, base, q.shape):
            clamp_cells(cut, base, pick, smoke, q, layer[3])
        lows, highs = _limits(low, high, base, w, crossed)
        sweep(
            q, new, every, flow[0], flow[1], flow[2], (0.5, 0.5, 0.5), part, courant, lows, highs, beyond, cubic, True,
        )  # fmt: skip
        if piece == 0:
            out[c] = new[w]
        else:
            row = cut.extra[c] + piece - 1
            out_extras[row], done[row] = new[w], True


@njit(cache=True)
def guess_links(cut, rows, axis, cells, pieces, up, reach, faces, parts, known, out):
    """Extrapolate what is on some links from what is known on their own sides; leave it where nothing is.

    Parameters
    ----------
    cut : Cut
    rows, axis : ndarray of int64, shape (n,)
        The links.
    cells, pieces, up : ndarray of int64, shape (n, 3), (n,), (n,)
        A piece that each touches, in a local cell, and whether it lies above that.
    reach : int
    faces, parts, known
        As for ``carry_faces``.
    out : ndarray, shape (n_links,)
    """
    dim = cut.dim
    pick, queue = _search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    chart, layer = _rooms(reach, dim), _layers(reach, dim)
    mid = reach + MARGIN
    deep = mid if dim == 3 else 0
    for n in range(len(rows)):
        a = axis[n]
        base = (cells[n, 0] - mid, cells[n, 1] - mid, cells[n, 2] - deep)
        reach_pieces(cut, base, (mid, mid, deep), pieces[n], pick, queue)
        if complete_faces(cut, a, base, pick, faces[a], parts, known, chart[a], layer[a], todo):
            w = (mid + up[n] * (a == 0), mid + up[n] * (a == 1), deep + up[n] * (a == 2))
            if layer[a][w] != UNKNOWN:
                out[rows[n]] = chart[a][w]


@njit(cache=True)
def guess_cells(cut, cells, pieces, reach, smoke, extras):
    """Return the means of what is known around some pieces on their own sides; not a number where nothing is.

    Parameters
    ----------
    cut : Cut
    cells, pieces : ndarray of int64, shape (n, 3), (n,)
    reach : int
    smoke, extras : ndarray
        Cell array, and values of further pieces; not numbers where not known.
    """
    dim = cut.dim
    pick, queue = _search_room(reach, dim)
    q, layer, todo = _room(reach, dim, 3, 0.0), _layers(reach, dim)[3], np.empty(pick.size, np.int64)
    mid = reach + MARGIN
    deep = mid if dim == 3 else 0
    w = (mid, mid, deep)
    out = np.full(len(cells), np.nan)
    for n in range(len(cells)):
        base = (cells[n, 0] - mid, cells[n, 1] - mid, cells[n, 2] - deep)
        reach_pieces(cut, base, w, pieces[n], pick, queue)
        some, left = fill_cells(cut, base, pick, smoke, extras, q, layer, todo)
        if some > 0:
            extend(q, layer, dim, False, todo, left)
            if layer[w] != UNKNOWN:
                out[n] = q[w]
    return out
