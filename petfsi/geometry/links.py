"""How the pieces of fluid in split cells join those of their neighbours through faces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.walks import NOTHING, position_of


class Split(NamedTuple):
    """The split cells, in order, and what their faces are made of.

    Attributes
    ----------
    cell, n_pieces : ndarray of int, shape (n,)
    start : ndarray of int, shape (2 dim n + 1,)
        Of the elements of each cell and face.
    piece : ndarray of int, shape (l,)
    area : ndarray, shape (l,)
        What the element adds to the open area of its piece, fractions of the face.
    key : ndarray of int64, shape (l,)
        The same from both sides of a face.
    """

    cell: np.ndarray
    n_pieces: np.ndarray
    start: np.ndarray
    piece: np.ndarray
    area: np.ndarray
    key: np.ndarray


@njit(cache=True)
def link_pieces(split, stride, lower_end, upper_end):
    """Return the links of split cells' faces: axis, cell above, piece below and above; and their open fractions.

    Parameters
    ----------
    split : Split
    stride : ndarray of int, shape (dim,)
        From a cell to the next along each axis.
    lower_end, upper_end : ndarray of bool, shape (n, dim)
        Where the face below (above) a split cell has nothing of the box behind it.
    """
    dim = len(stride)
    room = 2 * dim * split.n_pieces.sum()
    for n in split.n_pieces:
        room += dim * n * n
    links, opening = np.empty((room, 4), np.int64), np.empty(room)
    count = 0
    for s in range(len(split.cell)):
        for face in range(2 * dim):
            axis, side = face // 2, face % 2
            end = upper_end[s, axis] if side else lower_end[s, axis]
            other = -1 if end else position_of(split.cell, split.cell[s] + (2 * side - 1) * stride[axis])
            above = split.cell[s] + side * stride[axis]
            if other >= 0 and side == 0:
                continue
            if other >= 0:
                table = _match(
                    split, 2 * dim * s + face, 2 * dim * other + face - 1, split.n_pieces[s], split.n_pieces[other]
                )
                for i in range(table.shape[0]):
                    for j in range(table.shape[1]):
                        if table[i, j] > NOTHING:
                            links[count, 0], links[count, 1], links[count, 2], links[count, 3] = axis, above, i, j
                            opening[count] = table[i, j]
                            count += 1
                continue
            for i, area in enumerate(_areas(split, 2 * dim * s + face, split.n_pieces[s])):
                if area > NOTHING:
                    beyond = -1 if end else 0
                    links[count, 0], links[count, 1] = axis, above
                    links[count, 2 + (1 - side)], links[count, 2 + side] = i, beyond
                    opening[count] = area
                    count += 1
    return links[:count].copy(), opening[:count].copy()


@njit(cache=True)
def _areas(split, slot, n):
    """Return the open area of each piece of a cell on one face."""
    area = np.zeros(n)
    for e in range(split.start[slot], split.start[slot + 1]):
        area[split.piece[e]] += split.area[e]
    return area


@njit(cache=True)
def _match(split, below, above, n_below, n_above):
    """Return the open area between each piece below and above a face, whose elements both cells have in one order."""
    table = np.zeros((n_below, n_above))
    b, e = split.start[below], split.start[above]
    n = split.start[below + 1] - b
    same = n == split.start[above + 1] - e
    for i in range(n if same else 0):
        same = same and split.key[b + i] == split.key[e + i]
    if same:
        for i in range(n):
            table[split.piece[b + i], split.piece[e + i]] += 0.5 * (split.area[b + i] + split.area[e + i])
        return table
    # not seen alike by both, by rounding: give each as much as it opens
    rest, left = _areas(split, below, n_below), _areas(split, above, n_above)
    for i in range(n_below):
        for j in range(n_above):
            table[i, j] = min(rest[i], left[j])
            rest[i] -= table[i, j]
            left[j] -= table[i, j]
    return table
