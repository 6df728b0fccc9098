"""The pieces of fluid in one cell by what bounds them: how many, their volumes, whether they close."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.union_find import find
from petfsi.geometry.walks import NOTHING

#: A cell is only split if its pieces close, and fill its faces, to this fraction; solids that overlap do not.
CLOSED = 1e-11

#: Volumes that differ less than this fraction of a cell are as large, whatever rounding makes of them.
SAME = 1e-9


class Box(NamedTuple):
    """The part of the box that the surface reaches, with a margin of one cell.

    Attributes
    ----------
    lo : ndarray of int64, shape (dim,)
        The margin's lowest cell.
    shape : ndarray of int64, shape (dim,)
        With the margin.
    images : ndarray of int64, shape (k, dim)
        How far each image of the surface is moved, in cells.
    box_lo, box_hi : ndarray of int64, shape (dim,)
        The box.
    """

    lo: np.ndarray
    shape: np.ndarray
    images: np.ndarray
    box_lo: np.ndarray
    box_hi: np.ndarray


@njit(cache=True)
def account(elements, parent, state, part, n_parts, vectors, opening):
    """Return the pieces of a cell: how many, that of each node, their volumes; none if they do not close.

    Parameters
    ----------
    elements, parent, state
        As ``walk_2d`` returns them.
    part : ndarray of int, shape (n,)
    vectors : ndarray, shape (n, dim + 1)
        The patches' area vectors and int x_a dA_a for the last axis a.
    opening : ndarray, shape (2 dim,)
        The open fractions of the cell's faces.
    """
    dim = vectors.shape[1] - 1
    n_nodes = len(parent)
    piece = np.full(n_nodes, -1)
    n = 0
    for node in range(n_nodes):
        if node < n_parts or state[node - n_parts] == 1:
            root = find(parent, node)
            if piece[root] < 0:
                piece[root] = n
                n += 1
            piece[node] = piece[root]
    volume = np.zeros(n)
    area, normal = np.zeros((n, 2 * dim)), np.zeros((n, dim))
    for e in range(len(elements)):
        area[piece[int(elements[e, 1])], int(elements[e, 0])] += elements[e, 2]
    for p in range(len(part)):
        normal[piece[part[p]]] += vectors[p, :dim]
        volume[piece[part[p]]] -= vectors[p, dim]
    error = 0.0
    for a in range(dim):
        for i in range(n):
            error = max(error, abs(area[i, 2 * a + 1] - area[i, 2 * a] - normal[i, a]))
        for s in range(2):
            error = max(error, abs(area[:, 2 * a + s].sum() - opening[2 * a + s]))
    volume += 0.5 * (area[:, 2 * dim - 2] + area[:, 2 * dim - 1])
    if n == 0 or error > CLOSED or volume.min() < -CLOSED or area.min() < -CLOSED:
        return 0, piece, volume
    n, number = _by_volume(volume, area)
    ordered = np.zeros(n)
    for i in range(len(volume)):
        ordered[number[i]] += volume[i]
    for node in range(n_nodes):
        if piece[node] >= 0:
            piece[node] = number[piece[node]]
    return n, piece, ordered


@njit(cache=True)
def _by_volume(volume, area):
    """Return how many pieces there are, and their numbers by falling volume; what is next to nothing joins piece 0.

    Of equal ones that which has the first patch comes first, as they come here.
    """
    n = 0
    number = np.full(len(volume), -1)
    for _ in range(len(volume)):
        largest = -np.inf
        for i in range(len(volume)):
            if number[i] < 0:
                largest = max(largest, volume[i])
        for i in range(len(volume)):
            if number[i] < 0 and volume[i] >= largest - SAME:
                tiny = n > 0 and volume[i] <= NOTHING and area[i].max() <= NOTHING
                number[i] = 0 if tiny else n
                n += not tiny
                break
    return n, number


@njit(cache=True)
def count_parts(first_patch):
    """Return the connected parts' numbers, counted from 0 in the order of their first patches, and how many."""
    number, n = np.full(len(first_patch), -1), 0
    for p in range(len(first_patch)):
        q = first_patch[p] - first_patch[0]
        if q == p:
            number[p] = n
            n += 1
        else:
            number[p] = number[q]
    return number, n


@njit(cache=True)
def enter_elements(elements, key, piece, start, pieces, areas, keys):
    """Enter the elements of a cell's faces behind those of other cells, face after face.

    Parameters
    ----------
    elements, key
        As ``walk_2d`` returns them.
    piece : ndarray of int
        That of each node.
    start : ndarray of int64, shape (2 dim + 1,)
        Where each face's elements begin; all but the first are set.
    pieces, areas, keys : ndarray
        What is entered of each: its piece, its area, its key.
    """
    total = start[0]
    for face in range(len(start) - 1):
        for e in range(len(elements)):
            if elements[e, 0] == face:
                pieces[total], areas[total], keys[total] = piece[int(elements[e, 1])], elements[e, 2], key[e]
                total += 1
        start[face + 1] = total


@njit(cache=True)
def places(cell, box):
    """Return where a cell lies as each image of the surface sees it."""
    at = np.empty(box.images.shape, np.int64)
    for a in range(len(box.shape) - 1, -1, -1):
        at[:, a] = cell % box.shape[a] + box.lo[a] - box.images[:, a]
        cell //= box.shape[a]
    return at
