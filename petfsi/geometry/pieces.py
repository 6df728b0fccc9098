"""Cells whose fluid a surface cuts into pieces that do not touch, and how the pieces of neighbouring cells join."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.links import Split, link_pieces
from petfsi.geometry.patches import Patches
from petfsi.geometry.union_find import find, join
from petfsi.geometry.walks import NOTHING, position_of, walk_2d
from petfsi.geometry.walks_3d import walk_3d

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


class Pieces(NamedTuple):
    """Pieces and links as in ``clipping.CutCells``, but cells are numbered in ``Box`` with its margin.

    ``link_cell`` is the cell above the face, which may lie in the margin.
    """

    patch_piece: np.ndarray
    extra_cell: np.ndarray
    extra_piece: np.ndarray
    extra_volume: np.ndarray
    link_axis: np.ndarray
    link_cell: np.ndarray
    link_below: np.ndarray
    link_above: np.ndarray
    link_open: np.ndarray


def find_pieces(
    x: np.ndarray,
    facets: np.ndarray,
    box: Box,
    patches: Patches,
    inner: np.ndarray,
    opening: list[np.ndarray],
) -> Pieces:
    """Return the pieces of the box's cells.

    Parameters
    ----------
    x : ndarray, shape (n_points, dim)
        In units of cells.
    facets : ndarray of int32, shape (m, dim)
    box : Box
    patches : Patches
        Sorted by cell, image and facet.
    inner : ndarray of bool, shape (n,)
        Which of them are in the box, not in its margin.
    opening : list of ndarray
        The open fractions of the box's faces normal to each axis.
    """
    dim = x.shape[1]
    beyond = neighbours(facets, len(x))
    parts = connected_parts(patches.facet, patches.image, patches.cell, patches.edges, beyond)
    ranges = cells_in_doubt(patches.cell, parts, inner)
    cell = patches.cell[ranges[:, 0]]
    openings = np.empty((len(ranges), 2 * dim))
    index = np.array(np.unravel_index(cell, box.shape)).reshape(dim, -1) - 1
    for face in range(2 * dim):
        side = (np.arange(dim) == face // 2) * (face % 2)
        openings[:, face] = opening[face // 2][tuple(index + side[:, None])]
    split, patch_piece, extras = split_cells(
        x,
        facets,
        beyond if dim == 3 else None,
        box,
        patches.facet,
        patches.image,
        patches.cell,
        parts,
        patches.vectors,
        ranges,
        openings,
    )
    place = np.column_stack(np.unravel_index(split.cell, box.shape)).reshape(-1, dim) + box.lo
    stride = np.append(np.cumprod(box.shape[:0:-1])[::-1], 1)
    links, link_open = link_pieces(split, stride, place == box.box_lo, place == box.box_hi - 1)
    return Pieces(
        patch_piece,
        extras[:, 0].astype(np.int64),
        extras[:, 1].astype(np.int32),
        extras[:, 2].copy(),
        links[:, 0].astype(np.int32),
        links[:, 1].copy(),
        links[:, 2].astype(np.int32),
        links[:, 3].astype(np.int32),
        link_open,
    )


def neighbours(facets: np.ndarray, n_points: int) -> np.ndarray:
    """Return the facet beyond each edge (3D) or corner (2D), shape (m, dim): that which has it in the other sense.

    Edge i runs from corner i to the next; -1 where nothing is.
    """
    if len(facets) == 0:
        return np.zeros(facets.shape, dtype=np.int32)
    if facets.shape[1] == 2:
        at = np.full((2, n_points), -1, dtype=np.int32)
        for i in range(2):
            at[i, facets[:, i]] = np.arange(len(facets))
        return np.column_stack((at[1, facets[:, 0]], at[0, facets[:, 1]]))
    begin = np.concatenate(([0], np.cumsum(np.bincount(facets.ravel(), minlength=n_points))))
    return _beyond_edges(facets, begin)


@njit(cache=True)
def _beyond_edges(facets, begin):
    """Return ``neighbours`` of triangles; edges that leave point i stand in begin[i]:begin[i + 1]."""
    room, filled = np.empty(begin[-1], np.int32), begin[:-1].copy()
    for f in range(len(facets)):
        for i in range(3):
            room[filled[facets[f, i]]] = f
            filled[facets[f, i]] += 1
    beyond = np.full(facets.shape, -1, np.int32)
    for f in range(len(facets)):
        for i in range(3):
            here, there = facets[f, i], facets[f, (i + 1) % 3]
            for g in room[begin[there] : begin[there + 1]]:
                if (
                    (facets[g, 0] == there and facets[g, 1] == here)
                    or (facets[g, 1] == there and facets[g, 2] == here)
                    or (facets[g, 2] == there and facets[g, 0] == here)
                ):
                    beyond[f, i] = g
                    break
    return beyond


@njit(cache=True)
def connected_parts(facet, image, cell, edges, beyond):
    """Return the first patch of the connected part of the surface in its cell that each patch belongs to.

    Parameters
    ----------
    facet, image, cell : ndarray of int, shape (n,)
        The patches, sorted by cell, image and facet.
    edges : ndarray of int, shape (n,)
        Bit i says that the patch has something of edge (corner) i of its facet.
    beyond : ndarray of int, shape (m, dim)
        As ``neighbours`` returns it.
    """
    n = len(facet)
    parent = np.arange(n)
    first = 0
    while first < n:
        last = first + 1
        while last < n and cell[last] == cell[first] and image[last] == image[first]:
            last += 1
        for p in range(first, last):
            for i in range(beyond.shape[1]):
                if edges[p] >> i & 1 and beyond[facet[p], i] > facet[p]:
                    q = position_of(facet[first:last], beyond[facet[p], i])
                    if q >= 0:
                        join(parent, p, first + q)
        first = last
    for p in range(n):
        parent[p] = find(parent, p)
    return parent


@njit(cache=True)
def cells_in_doubt(cell, parts, inner):
    """Return the ranges of patches of the box's cells in which the surface has several connected parts."""
    n = len(cell)
    ranges = np.empty((n, 2), np.int64)
    count = first = 0
    while first < n:
        last, several = first + 1, False
        while last < n and cell[last] == cell[first]:
            several = several or parts[last] != first
            last += 1
        if several and inner[first]:
            ranges[count, 0], ranges[count, 1] = first, last
            count += 1
        first = last
    return ranges[:count].copy()


@njit(cache=True)
def _account(elements, parent, state, part, n_parts, vectors, opening):
    """Return the pieces of a cell: how many, that of each node, their volumes; 1 piece if they do not close.

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
    if n == 1 or error > CLOSED or volume.min() < -CLOSED or area.min() < -CLOSED:
        return 1, piece, volume
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
def split_cells(x, facets, beyond, box, facet, image, cell, parts, vectors, ranges, openings):
    """Return the split cells, the piece of each patch, and the extra pieces' cells, numbers and volumes.

    Parameters
    ----------
    beyond : ndarray of int, shape (m, 3)
        As ``neighbours`` returns it; None in 2D.
    parts : ndarray of int, shape (n,)
        As ``connected_parts`` returns them.
    ranges : ndarray of int, shape (k, 2)
        As ``cells_in_doubt`` returns them.
    openings : ndarray, shape (k, 2 dim)
        The open fractions of those cells' faces.
    """
    dim = facets.shape[1]
    n_patches = (ranges[:, 1] - ranges[:, 0]).sum()
    room = 18 * n_patches + 24 * len(ranges)
    cells, n_pieces = np.empty(len(ranges), np.int64), np.empty(len(ranges), np.int64)
    start = np.zeros(2 * dim * len(ranges) + 1, np.int64)
    pieces, areas, keys = np.empty(room, np.int32), np.empty(room), np.empty(room, np.int64)
    patch_piece = np.zeros(len(facet), np.int32)
    extras = np.empty((n_patches + 8 * len(ranges), 3))
    n_split = n_extra = total = 0
    for r in range(len(ranges)):
        first, last = ranges[r]
        part, n_parts = _count_parts(parts[first:last])
        at = _places(cell[first], box)
        if beyond is None:  # told apart when compiled: the other walk is not
            parent, state, elements, key, good = walk_2d(
                x, facets, at, facet[first:last], image[first:last], part, n_parts, openings[r]
            )
        else:
            parent, state, elements, key, good = walk_3d(
                x, facets, at, facet[first:last], image[first:last], part, n_parts, openings[r], beyond
            )
        if not good:
            continue
        n, piece, volume = _account(elements, parent, state, part, n_parts, vectors[first:last], openings[r])
        if n == 1:
            continue
        cells[n_split], n_pieces[n_split] = cell[first], n
        for p in range(first, last):
            patch_piece[p] = piece[part[p - first]]
        for face in range(2 * dim):
            for e in range(len(elements)):
                if elements[e, 0] == face:
                    pieces[total], areas[total], keys[total] = piece[int(elements[e, 1])], elements[e, 2], key[e]
                    total += 1
            start[2 * dim * n_split + face + 1] = total
        n_split += 1
        for i in range(1, n):
            extras[n_extra, 0], extras[n_extra, 1], extras[n_extra, 2] = cell[first], i, volume[i]
            n_extra += 1
    split = Split(
        cells[:n_split],
        n_pieces[:n_split],
        start[: 2 * dim * n_split + 1],
        pieces[:total],
        areas[:total],
        keys[:total],
    )
    return split, patch_piece, extras[:n_extra]


@njit(cache=True)
def _count_parts(first_patch):
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
def _places(cell, box):
    """Return where a cell lies as each image of the surface sees it."""
    at = np.empty(box.images.shape, np.int64)
    for a in range(len(box.shape) - 1, -1, -1):
        at[:, a] = cell % box.shape[a] + box.lo[a] - box.images[:, a]
        cell //= box.shape[a]
    return at
