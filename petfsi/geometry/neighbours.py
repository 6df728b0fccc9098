"""Which facets lie beside each other, across seams, too, and the connected parts of a surface in each cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.seams import Seams
from petfsi.geometry.union_find import find, join
from petfsi.geometry.walks import patch_of


class Neighbours(NamedTuple):
    """What lies beyond the edges of facets (corners in 2D).

    Attributes
    ----------
    facet : ndarray of int32, shape (m, dim)
        That which has the edge in the other sense; edge i runs from corner i to the next; -1 where nothing is.
    step : ndarray of int8, shape (m, dim)
        Where it lies: by how many periods along each axis its image is further than that of the facet itself, plus
        one, as digits to the base 3, the first axis' first.
    periods : ndarray of int64, shape (dim,)
        In cells.
    shell : ndarray of int64, shape (m,)
        The connected part of the surface that each facet belongs to; 0 where that is not known.
    """

    facet: np.ndarray
    step: np.ndarray
    periods: np.ndarray
    shell: np.ndarray

    def images(self, images: np.ndarray) -> np.ndarray:
        """Return the number of the image at each step from every image, -1 where there is none, shape (k, 3^dim)."""
        dim = images.shape[1]
        steps = np.array(np.unravel_index(np.arange(3**dim), (3,) * dim))[::-1].T - 1
        wanted = images[:, None, :] + steps * self.periods
        there = np.full(wanted.shape[:2], -1, dtype=np.int64)
        for number, image in enumerate(images):
            there[np.all(wanted == image, axis=2)] = number
        return there


def neighbours(facets: np.ndarray, n_points: int, seams: Seams | None, cells: np.ndarray) -> Neighbours:
    """Return what lies beyond the edges of a surface's walls.

    Parameters
    ----------
    facets : ndarray of int, shape (m, dim)
    n_points : int
    seams : Seams or None
        What is one place for points; walls are neighbours across seams.
    cells : ndarray of int, shape (dim,)
        Of the grid.
    """
    dim = facets.shape[1]
    place, level = facets, np.zeros(facets.shape, dtype=np.int64)
    if seams is not None:
        place, level = seams.place[facets], seams.level[facets] @ 3 ** np.arange(dim)
    if len(facets) == 0:
        facet = corner = np.zeros(facets.shape, dtype=np.int32)
    elif dim == 2:
        at = np.full((2, n_points), -1, dtype=np.int32)
        for i in range(2):
            at[i, place[:, i]] = np.arange(len(facets))
        facet = np.column_stack((at[1, place[:, 0]], at[0, place[:, 1]]))
        corner = np.broadcast_to(np.array([1, 0]), facet.shape)
    else:
        begin = np.concatenate(([0], np.cumsum(np.bincount(place.ravel(), minlength=n_points))))
        facet, corner = _beyond_edges(place, level, begin)
    step = np.full(facet.shape, 3**dim // 2, dtype=np.int8)
    if level.any():
        end = level if dim == 2 else np.roll(level, -1, axis=1)
        step += (end - level[facet, corner]).astype(np.int8)
    shell = np.zeros(len(facets), dtype=np.int64) if seams is None else seams.shell[facets[:, 0]]
    return Neighbours(facet, step, np.asarray(cells, dtype=np.int64), shell)


@njit(cache=True)
def _beyond_edges(facets, level, begin):
    """Return the neighbours of triangles, and which of their corners is the end of the edge.

    Edges that leave place i stand in begin[i]:begin[i + 1]; ``level`` tells points of one place apart.
    """
    room, filled = np.empty(begin[-1], np.int32), begin[:-1].copy()
    for f in range(len(facets)):
        for i in range(3):
            room[filled[facets[f, i]]] = f
            filled[facets[f, i]] += 1
    beyond, corner = np.full(facets.shape, -1, np.int32), np.zeros(facets.shape, np.int32)
    for f in range(len(facets)):
        for i in range(3):
            here, there = facets[f, i], facets[f, (i + 1) % 3]
            rise = level[f, (i + 1) % 3] - level[f, i]
            for g in room[begin[there] : begin[there + 1]]:
                for k in range(3):
                    last = (k + 1) % 3
                    found = facets[g, k] == there and facets[g, last] == here
                    if found and beyond[f, i] < 0 and level[g, k] - level[g, last] == rise:
                        beyond[f, i], corner[f, i] = g, k
    return beyond, corner


@njit(cache=True)
def connected_parts(facet, image, cell, edges, beyond, step, there):
    """Return the first patch of the connected part of the surface in its cell that each patch belongs to.

    Parameters
    ----------
    facet, image, cell : ndarray of int, shape (n,)
        The patches, sorted by cell, image and facet.
    edges : ndarray of int, shape (n,)
        Bit i says that the patch has something of edge (corner) i of its facet.
    beyond, step : ndarray of int, shape (m, dim)
        See ``Neighbours``.
    there : ndarray of int, shape (k, 3^dim)
        As ``Neighbours.images`` returns it.
    """
    n = len(facet)
    parent = np.arange(n)
    here = there.shape[1] // 2
    first = 0
    while first < n:
        last = first + 1
        while last < n and cell[last] == cell[first]:
            last += 1
        for p in range(first, last):
            for i in range(beyond.shape[1]):
                across = step[facet[p], i] != here
                if edges[p] >> i & 1 and (across or beyond[facet[p], i] > facet[p]):
                    to = there[image[p], step[facet[p], i]]
                    q = patch_of(facet[first:last], image[first:last], beyond[facet[p], i], to)
                    if q >= 0:
                        join(parent, p, first + q)
        first = last
    for p in range(n):
        parent[p] = find(parent, p)
    return parent
