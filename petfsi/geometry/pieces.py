"""Cells whose fluid a surface cuts into pieces that do not touch, and how the pieces of neighbouring cells join."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.links import Split, link_pieces
from petfsi.geometry.neighbours import Neighbours, connected_parts
from petfsi.geometry.overlaps import Rest, joined, split_overlapping
from petfsi.geometry.patches import Frame, Patches
from petfsi.geometry.piece_accounts import CLOSED, Box, account, count_parts, enter_elements, places
from petfsi.geometry.planes import overlap_3d, polygons_of
from petfsi.geometry.unions import ends_2d, overlap_2d
from petfsi.geometry.walks import walk_2d
from petfsi.geometry.walks_3d import walk_3d


class Pieces(NamedTuple):
    """Pieces and links as in ``clipping.CutCells``, but cells are numbered in ``Box`` with its margin.

    ``link_cell`` is the cell above the face, which may lie in the margin. ``rest`` is None if no solids overlap.
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
    rest: Rest | None


def find_pieces(
    x: np.ndarray,
    facets: np.ndarray,
    beyond: Neighbours,
    box: Box,
    patches: Patches,
    inner: np.ndarray,
    opening: list[np.ndarray],
    frame: Frame,
) -> Pieces:
    """Return the pieces of the box's cells.

    Parameters
    ----------
    x : ndarray, shape (n_points, dim)
        In units of cells.
    facets : ndarray of int32, shape (m, dim)
    beyond : Neighbours
    box : Box
    patches : Patches
        Sorted by cell, image and facet.
    inner : ndarray of bool, shape (n,)
        Which of them are in the box, not in its margin.
    opening : list of ndarray
        The open fractions of the box's faces normal to each axis, less than 0 where a face is covered more than once.
        Where solids overlap they are set right.
    frame : Frame
    """
    dim = x.shape[1]
    there = beyond.images(box.images)
    parts = connected_parts(patches.facet, patches.image, patches.cell, patches.edges, beyond.facet, beyond.step, there)
    overcovered = _overcovered(patches.cell, inner, opening, box.shape)
    ranges = cells_in_doubt(patches.cell, parts, inner, overcovered)
    faces, openings = _openings(patches.cell[ranges[:, 0]], opening, box.shape)
    around = (beyond.facet, beyond.step, there) if dim == 3 else None
    where = (patches.facet, patches.image, patches.cell, parts, patches.vectors)
    split, patch_piece, extras, overlapping = split_cells(
        x, facets, around, beyond.shell, box, *where, ranges, openings
    )
    rest = None
    if overlapping.any():
        at = np.flatnonzero(overlapping)
        more, rest, more_extras, opened = split_overlapping(
            x, facets, around, box, patches, parts, ranges[at], openings[at], frame
        )
        for face in range(2 * dim):
            opening[face // 2].reshape(-1)[faces[at, face]] = opened[:, face]
        split, extras = joined(split, more), np.concatenate((extras, more_extras))
        extras = extras[np.lexsort((extras[:, 1], extras[:, 0]))]
    place = np.column_stack(np.unravel_index(split.cell, box.shape)).reshape(-1, dim) + box.lo
    stride = np.append(np.cumprod(box.shape[:0:-1])[::-1], 1)
    links, link_open = link_pieces(split, stride, place == box.box_lo, place == box.box_hi - 1)
    if rest is not None:
        links, link_open = _through_open_faces(links, link_open, opening, box.shape)
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
        rest,
    )


def _through_open_faces(
    links: np.ndarray, link_open: np.ndarray, opening: list[np.ndarray], shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return links without those to cells that were shut."""
    keep = np.ones(len(links), dtype=bool)
    for a, part in enumerate(opening):
        at = np.flatnonzero(links[:, 0] == a)
        index = np.array(np.unravel_index(links[at, 1], shape)).reshape(len(shape), -1) - 1
        keep[at] = part[tuple(index)] > 0.0
    return links[keep], link_open[keep]


def _overcovered(cell: np.ndarray, inner: np.ndarray, opening: list[np.ndarray], shape: np.ndarray) -> np.ndarray:
    """Return which patches lie in cells with a face that is covered more than once."""
    over = np.zeros(len(cell), dtype=bool)
    if any(part.size and part.min() < -CLOSED for part in opening):
        mine = np.flatnonzero(inner)
        over[mine] = _openings(cell[mine], opening, shape)[1].min(axis=1, initial=1.0) < -CLOSED
    return over


def _openings(cell: np.ndarray, opening: list[np.ndarray], shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of cells, flat in the arrays of ``opening``, and what is open of them, (n, 2 dim)."""
    dim = len(shape)
    faces, openings = np.empty((len(cell), 2 * dim), dtype=np.int64), np.empty((len(cell), 2 * dim))
    index = np.array(np.unravel_index(cell, shape)).reshape(dim, -1) - 1
    for face in range(2 * dim):
        side, part = (np.arange(dim) == face // 2) * (face % 2), opening[face // 2]
        faces[:, face] = np.ravel_multi_index(tuple(index + side[:, None]), part.shape) if part.size else 0
        openings[:, face] = part.reshape(-1)[faces[:, face]]
    return faces, openings


@njit(cache=True)
def cells_in_doubt(cell, parts, inner, overcovered):
    """Return the ranges of patches of the box's cells in which the surface has several connected parts.

    Of those, too, in which patches are ``overcovered``.
    """
    n = len(cell)
    ranges = np.empty((n, 2), np.int64)
    count = first = 0
    while first < n:
        last, several = first + 1, overcovered[first]
        while last < n and cell[last] == cell[first]:
            several = several or parts[last] != first
            last += 1
        if several and inner[first]:
            ranges[count, 0], ranges[count, 1] = first, last
            count += 1
        first = last
    return ranges[:count].copy()


@njit(cache=True)
def _overlap(beyond, x, facets, at, facet, image, part):
    """Return whether patches of several parts of the surface cross in a cell; ``beyond`` as for ``split_cells``."""
    if beyond is None:  # told apart when compiled: the others are not
        return overlap_2d(ends_2d(x, facets, at, facet, image)[0], part)
    return overlap_3d(polygons_of(x, facets, at, facet, image), part)


@njit(cache=True)
def _walk(beyond, n_parts, opening, x, facets, at, facet, image, part):
    """Return what bounds a cell's fluid as ``walk_2d`` and ``walk_3d`` do."""
    if beyond is None:
        return walk_2d(x, facets, at, facet, image, part, n_parts, opening)
    return walk_3d(x, facets, at, facet, image, part, n_parts, opening, beyond)


@njit(cache=True)
def split_cells(x, facets, beyond, shell, box, facet, image, cell, parts, vectors, ranges, openings):
    """Return the split cells, the piece of each patch, the extra pieces, and the cells in which solids overlap.

    Parameters
    ----------
    beyond : tuple of ndarray of int
        ``facet`` and ``step`` of ``Neighbours`` and what its ``images`` returns; None in 2D.
    shell : ndarray of int, shape (m,)
        As in ``Neighbours``.
    parts : ndarray of int, shape (n,)
        As ``connected_parts`` returns them.
    ranges : ndarray of int, shape (k, 2)
        As ``cells_in_doubt`` returns them.
    openings : ndarray, shape (k, 2 dim)
        The open fractions of those cells' faces, less than 0 where a face is covered more than once.

    Returns
    -------
    split : Split
        Without the cells in which solids overlap.
    patch_piece : ndarray of int32, shape (n,)
    extras : ndarray, shape (m, 3)
        Cells, numbers and volumes of extra pieces.
    overlapping : ndarray of bool, shape (k,)
    """
    dim = facets.shape[1]
    n_patches = (ranges[:, 1] - ranges[:, 0]).sum()
    room = 18 * n_patches + 24 * len(ranges)
    cells, n_pieces = np.empty(len(ranges), np.int64), np.empty(len(ranges), np.int64)
    start = np.zeros(2 * dim * len(ranges) + 1, np.int64)
    pieces, areas, keys = np.empty(room, np.int32), np.empty(room), np.empty(room, np.int64)
    patch_piece = np.zeros(len(facet), np.int32)
    extras = np.empty((n_patches + 8 * len(ranges), 3))
    overlapping = np.zeros(len(ranges), np.bool_)
    n_split = n_extra = total = 0
    for r in range(len(ranges)):
        first, last = ranges[r]
        part, n_parts = count_parts(parts[first:last])
        at = places(cell[first], box)
        overlapping[r] = openings[r].min() < -CLOSED
        several = False
        for p in range(first + 1, last):
            several = several or image[p] != image[first] or shell[facet[p]] != shell[facet[first]]
        here = (x, facets, at, facet[first:last], image[first:last], part)
        overlapping[r] = overlapping[r] or (several and _overlap(beyond, *here))
        if overlapping[r]:
            continue
        parent, state, elements, key, good = _walk(beyond, n_parts, openings[r], *here)
        n = 0
        if good:
            n, piece, volume = account(elements, parent, state, part, n_parts, vectors[first:last], openings[r])
        overlapping[r] = n == 0
        if n <= 1:
            continue
        cells[n_split], n_pieces[n_split] = cell[first], n
        for p in range(first, last):
            patch_piece[p] = piece[part[p - first]]
        of_faces = start[2 * dim * n_split : 2 * dim * (n_split + 1) + 1]
        enter_elements(elements, key, piece, of_faces, pieces, areas, keys)
        n_split, total = n_split + 1, of_faces[-1]
        for i in range(1, n):
            extras[n_extra, 0], extras[n_extra, 1], extras[n_extra, 2] = cell[first], i, volume[i]
            n_extra += 1
    split = Split(
        cells[:n_split], n_pieces[:n_split], start[: 2 * dim * n_split + 1], pieces[:total], areas[:total], keys[:total]
    )  # fmt: skip
    return split, patch_piece, extras[:n_extra], overlapping
