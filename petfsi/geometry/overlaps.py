"""Cells in which solids overlap, resolved one by one, see ``unions``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.links import Split
from petfsi.geometry.patches import Frame, Patches, measure_polygon, measure_segment
from petfsi.geometry.piece_accounts import CLOSED, Box, account, count_parts, enter_elements, places
from petfsi.geometry.unions import union_2d
from petfsi.geometry.unions_3d import union_3d


class Rest(NamedTuple):
    """What is left of the patches of cells in which solids overlap.

    Attributes
    ----------
    gone : ndarray of int64
        The patches that it stands for.
    patch : ndarray of int64, shape (n,)
        Which of them each part belongs to.
    piece : ndarray of int32, shape (n,)
    integrals, vectors : ndarray
        As in ``Patches``.
    polygons : ndarray, shape (n, 2, 4) or (n, 4, 6)
        The corners about the cell's centre: coordinates, and weights of the facet's corners.
    """

    gone: np.ndarray
    patch: np.ndarray
    piece: np.ndarray
    integrals: np.ndarray
    vectors: np.ndarray
    polygons: np.ndarray


def split_overlapping(
    x: np.ndarray, facets: np.ndarray, beyond: tuple[np.ndarray, ...] | None, box: Box, patches: Patches,
    parts: np.ndarray, ranges: np.ndarray, openings: np.ndarray, frame: Frame,
) -> tuple[Split, Rest, np.ndarray, np.ndarray]:  # fmt: skip
    """Return what ``split_cells`` does of cells in which solids overlap, what is left of their patches, their openings.

    A cell that cannot be resolved is shut, so that it lets nothing through that it should not; but if no face is
    covered twice and all that is wrong are a few digits it stays as it is.
    """
    arrays, rest, extras, opened, done = _split_overlapping(
        x, facets, beyond, box, patches.facet, patches.image, patches.cell, parts, ranges, openings, frame
    )
    ranges = ranges[done]
    length = ranges[:, 1] - ranges[:, 0]
    gone = np.repeat(ranges[:, 0] - np.cumsum(length) + length, length) + np.arange(length.sum())
    return Split(*arrays), Rest(gone, *rest), extras, opened


def joined(one: Split, other: Split) -> Split:
    """Return the split cells of two lists as one, in order."""
    cell = np.concatenate((one.cell, other.cell))
    order = np.argsort(cell, kind="stable")
    faces = (len(one.start) - 1) // max(len(one.cell), 1) or (len(other.start) - 1) // max(len(other.cell), 1)
    if not faces or not len(other.cell):
        return one
    count = np.concatenate((np.diff(one.start), np.diff(other.start))).reshape(-1, faces)
    begin = np.concatenate((one.start[:-1], other.start[:-1] + one.start[-1])).reshape(-1, faces)
    count, begin = count[order].ravel(), begin[order].ravel()
    start = np.concatenate(([0], np.cumsum(count)))
    take = np.repeat(begin - start[:-1], count) + np.arange(start[-1])
    columns = (np.concatenate(pair)[take] for pair in zip(one[3:], other[3:], strict=True))
    return Split(cell[order], np.concatenate((one.n_pieces, other.n_pieces))[order], start, *columns)


@njit(cache=True)
def _split_overlapping(x, facets, beyond, box, facet, image, cell, parts, ranges, openings, frame):
    """Return ``split_overlapping``'s answer, but which cells are done in place of what is gone."""
    dim = facets.shape[1]
    room = 64
    cells, n_pieces = np.empty(len(ranges), np.int64), np.empty(len(ranges), np.int64)
    start = np.zeros(2 * dim * len(ranges) + 1, np.int64)
    pieces, areas, keys = np.empty(room, np.int32), np.empty(room), np.empty(room, np.int64)
    rest_patch, rest_piece = np.empty(room, np.int64), np.empty(room, np.int32)
    integrals, vectors = np.empty((room, dim * (dim + 1))), np.empty((room, dim + 1))
    extras, opened = np.empty((room, 3)), np.maximum(openings, 0.0)
    polygons = np.empty((room, 2 * (dim - 1), 2 * dim))
    done = np.ones(len(ranges), np.bool_)
    n_split = n_extra = total = n_rest = 0
    for r in range(len(ranges)):
        first, last = ranges[r]
        part, _ = count_parts(parts[first:last])
        here = (x, facets, places(cell[first], box), facet[first:last], image[first:last], part, 1.0 - openings[r])
        if beyond is None:
            parent, kept, patch, elements, key, shown, good = union_2d(*here)
        else:
            parent, kept, patch, elements, key, shown, good = union_3d(*here, beyond)
        m = len(kept)
        while n_rest + m > len(rest_patch):
            rest_patch, rest_piece = _doubled(rest_patch), _doubled(rest_piece)
            integrals, vectors, polygons = _doubled(integrals), _doubled(vectors), _doubled(polygons)
        while total + len(elements) > len(pieces):
            pieces, areas, keys = _doubled(pieces), _doubled(areas), _doubled(keys)
        state = np.zeros(len(parent) - m, np.int64)
        for e in range(len(elements)):
            state[int(elements[e, 1]) - m] = 1
        measured = integrals[n_rest : n_rest + m], vectors[n_rest : n_rest + m]
        _measure(beyond, kept, facet[first:last][patch], frame, *measured)
        n, volume, piece = 0, np.zeros(0), np.zeros(0, np.int64)
        if good and len(parent) > 0:
            n, piece, volume = account(elements, parent, state, np.arange(m), m, vectors[n_rest : n_rest + m], shown)
        if n == 0 and not (good and len(parent) == 0):
            # not solids that overlap, but a few digits, if nothing is covered twice
            done[r] = not good or openings[r].min() < -CLOSED or np.abs(shown - openings[r]).max() > CLOSED
            if done[r]:
                opened[r] = 0.0
            continue
        opened[r] = shown
        for k in range(m):
            rest_patch[n_rest + k], rest_piece[n_rest + k] = first + patch[k], piece[k]
            polygons[n_rest + k] = kept[k]
        n_rest += m
        if n <= 1:
            continue
        cells[n_split], n_pieces[n_split] = cell[first], n
        of_faces = start[2 * dim * n_split : 2 * dim * (n_split + 1) + 1]
        enter_elements(elements, key, piece, of_faces, pieces, areas, keys)
        n_split, total = n_split + 1, of_faces[-1]
        while n_extra + n > len(extras):
            extras = _doubled(extras)
        for i in range(1, n):
            extras[n_extra, 0], extras[n_extra, 1], extras[n_extra, 2] = cell[first], i, volume[i]
            n_extra += 1
    split = (
        cells[:n_split], n_pieces[:n_split], start[: 2 * dim * n_split + 1], pieces[:total], areas[:total], keys[:total]
    )  # fmt: skip
    rest = (rest_patch[:n_rest], rest_piece[:n_rest], integrals[:n_rest], vectors[:n_rest], polygons[:n_rest])
    return split, rest, extras[:n_extra], opened, done


@njit(cache=True)
def _measure(beyond, kept, facet, frame, integrals, vectors):
    """Write the integrals and area vectors of what is left of some patches, each of its ``facet``."""
    centre = np.full(len(frame.dx), -0.5)
    for k in range(len(kept)):
        normal = frame.normals[facet[k]]
        if beyond is None:
            measure_segment(kept[k], centre, frame.dx, normal, integrals[k], vectors[k])
        else:
            measure_polygon(kept[k], 4, centre, frame.dx, normal, integrals[k], vectors[k])


@njit(cache=True)
def _doubled(array):
    """Return twice the room, with what is in it."""
    return np.concatenate((array, np.empty_like(array)))
