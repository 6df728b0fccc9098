"""Carrying velocity and smoke along sheets, each side by its charts, and values for parts that are new."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.mac.carrying.advect import keep_own, sweep
from petfsi.fields.mac.carrying.charts import (
    MARGIN,
    UNKNOWN,
    clamp_cells,
    complete_faces,
    empty_charts,
    empty_layers,
    extend,
    fill_cells,
    is_inside,
    reach_pieces,
    room,
    search_room,
    through,
)
from petfsi.fields.mac.grid.kinds import DEAD, PRESSURE, SPLIT


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
    pick, queue = search_room(reach, dim)
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
                    to = through(links, cut.first[a][f], 0, side)
                step = 2 * side - 1
                w = (mid + step * (a == 0), mid + step * (a == 1), deep + step * (a == 2))
                if to >= 0 and pick[w] == to:
                    found[n] = True
    return found


@njit(cache=True)
def _limits(low, high, base, w, crossed):
    """Return the ends of the domain in a chart, no farther from a target than the chart is made for."""
    lows = (
        max(low[0] - base[0], w[0] - crossed - 1.0), max(low[1] - base[1], w[1] - crossed - 1.0),
        max(low[2] - base[2], w[2] - crossed - 1.0),
    )  # fmt: skip
    highs = (
        min(high[0] - base[0], w[0] + crossed + 1.0), min(high[1] - base[1], w[1] + crossed + 1.0),
        min(high[2] - base[2], w[2] + crossed + 1.0),
    )  # fmt: skip
    return lows, highs


@njit(cache=True)
def carry_faces(
    cut, cells, pieces, reach, same, path, path_parts, faces, parts, known, from_below, moved, there, courant,
    long, low, high, cubic, keep, own_faces, limit, out, out_parts, done, left, kept,
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
    moved, courant, long, low, high, cubic
        As for ``advect.sweep``; a mask per axis.
    there : tuple of three ndarray of bool
        Cell arrays: in which cells faces of each axis are carried.
    keep : bool
        Whether what targets have beyond the values that are read stays with them, see ``advect.keep_own``.
    own_faces : tuple of three ndarray
        What faces have themselves.
    limit : float
        As for ``advect.sweep``.
    out, out_parts
        What is carried to plain faces and to links.
    done : ndarray of bool, shape (n_links,)
        Set where that was written.
    left : tuple of three ndarray of bool
        Cell arrays, by axis: set where a face comes from farther away than the limit, and nothing was written.
    kept : tuple of three ndarray of bool
        Set where faces were told to keep their own.
    """
    dim = cut.dim
    pick, queue = search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    flow, carried = empty_charts(reach, dim), empty_charts(reach, dim)
    new, own = empty_charts(reach, dim), empty_charts(reach, dim)
    layer = empty_layers(reach, dim)
    every = (np.ones(new[0].shape, np.bool_), np.ones(new[1].shape, np.bool_), np.ones(new[2].shape, np.bool_))
    some, far = np.zeros(3, np.bool_), np.zeros(new[0].shape, np.bool_)
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
            if not some[a] or not there[a][c]:
                continue
            offset = (0.5 * (a != 0), 0.5 * (a != 1), 0.5 * (a != 2))
            for up in range(2):
                f = (c[0] + up * (a == 0), c[1] + up * (a == 1), c[2] + up * (a == 2))
                w = (start[0] + up * (a == 0), start[1] + up * (a == 1), start[2] + up * (a == 2))
                if not _is_target(cut, c, piece, a, up, f, moved[a], from_below):
                    continue
                divided = cut.kind[a][f] == SPLIT
                part = ((w[0], w[0] + 1), (w[1], w[1] + 1), (w[2], w[2] + 1))
                lows, highs = _limits(low, high, base, w, crossed)
                sweep(
                    q, new[a], every[a], flow[0], flow[1], flow[2], offset, part, courant, long, lows, highs, 0.0,
                    cubic, False, limit, far,
                )  # fmt: skip
                if far[w]:
                    far[w], left[a][c] = False, True
                    continue
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
def _is_target(cut, c, piece, a, up, f, moved, from_below):
    """Return whether values are carried to the face f below or above a cell c from a piece of it.

    A whole face takes them from the cell above, the last one from that below.
    """
    if cut.kind[a][f] == SPLIT:
        return _leads(cut, cut.first[a][f], piece, up, from_below)
    return (up == 0 or c[a] == cut.high[a] - 1) and cut.kind[a][f] != DEAD and moved[f]


@njit(cache=True)
def _leads(cut, first, piece, up, from_below):
    """Return whether any link of a divided face sees what a piece next to it sees."""
    for link in range(first, cut.ends[first]):
        if from_below[link] == (up == 1) and piece == (cut.below[link] if up else cut.above[link]):
            return True
    return False


@njit(cache=True)
def carry_cells(
    cut, cells, pieces, reach, path, path_parts, known, smoke, extras, courant, long, low, high, beyond, cubic,
    limit, out, out_extras, done, left,
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
    pick, queue = search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    flow, q, new = empty_charts(reach, dim), room(reach, dim, 3, 0.0), room(reach, dim, 3, 0.0)
    layer, every, far = empty_layers(reach, dim), np.ones(new.shape, np.bool_), np.zeros(new.shape, np.bool_)
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
        _, unknown = fill_cells(cut, base, pick, smoke, extras, q, layer[3], todo)
        extend(q, layer[3], dim, False, todo, unknown)
        if not is_inside(cut, base, q.shape):
            clamp_cells(cut, base, pick, smoke, q, layer[3])
        lows, highs = _limits(low, high, base, w, crossed)
        sweep(
            q, new, every, flow[0], flow[1], flow[2], (0.5, 0.5, 0.5), part, courant, long, lows, highs, beyond,
            cubic, True, limit, far,
        )  # fmt: skip
        if far[w]:
            far[w], left[c] = False, True
        elif piece == 0:
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
    pick, queue = search_room(reach, dim)
    todo = np.empty(2 * pick.size, np.int64)
    chart, layer = empty_charts(reach, dim), empty_layers(reach, dim)
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
    pick, queue = search_room(reach, dim)
    q, layer, todo = room(reach, dim, 3, 0.0), empty_layers(reach, dim)[3], np.empty(pick.size, np.int64)
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
