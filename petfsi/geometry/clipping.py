"""Closed surfaces clipped exactly against the cells of a regular grid: patches, open faces, volumes.

How much of a face is covered follows from the divergence theorem in the row of cells along the face's own axis:

    covered = base - sum over the patches below the face of their area vector's component,

as a fraction of the face. So the open faces and the patches of a cell close by construction, whatever the surface,
and nothing has to decide what is inside. Nothing here communicates.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.geometry.pieces import Box, find_pieces
from petfsi.geometry.slabs import (
    MOST,
    PLANE,
    area_vectors,
    clip_polygon,
    clip_segment,
    load_facet,
    slab_range,
    to_lattice,
)

#: Open fractions of faces nearer than this to 0 or 1 are 0 or 1: what rounding leaves of sums over a row.
TINY = 1e-13


@dataclass(frozen=True)
class Lattice:
    """A regular grid and the box of its cells that is wanted.

    Attributes
    ----------
    origin, dx : ndarray, shape (dim,)
        The lower corner of cell (0, ...) and the cells' size, m.
    cells : ndarray of int, shape (dim,)
        The grid's number of cells along each axis.
    periodic : ndarray of bool, shape (dim,)
        Axes along which the grid repeats itself.
    lo, hi : ndarray of int, shape (dim,)
        The box: lo <= i < hi. On periodic axes it may reach beyond 0 and ``cells``: cell i stands for i mod cells and
        gets the patches of every periodic image of the surface. On others 0 <= lo < hi <= cells.
    """

    origin: np.ndarray
    dx: np.ndarray
    cells: np.ndarray
    periodic: np.ndarray
    lo: np.ndarray
    hi: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """The box's number of cells along each axis."""
        return tuple(int(n) for n in np.asarray(self.hi) - np.asarray(self.lo))


@dataclass(frozen=True)
class CutCells:
    """A surface cut by a lattice: patches are the parts of facets in cells of the box, sorted by cell.

    A cell's fluid may consist of several pieces that do not touch: piece 0, the largest, and extra ones. A face of
    such a cell has links: parts of its opening, each between a piece below and a piece above.

    Attributes
    ----------
    facet : ndarray of int32, shape (n,)
    cell : ndarray of int64, shape (n,)
        Flat index (C order) in the box.
    piece : ndarray of int32, shape (n,)
        The piece of fluid that the patch bounds.
    integrals : ndarray, shape (n, dim)
        int N_i dA over the patch, m^2 (m in 2D), i the facet's corners.
    moments : ndarray, shape (n, dim, dim)
        int N_i (x_a - centre_a) dA, [patch, i, a], m^3 (m^2), about the centre of the cell (of the image it lies in).
    normals : ndarray, shape (n_facets, dim)
        The facets' unit normals as they were cut (vertices in planes are moved a little); ``integrals`` times these
        close the cells. Zero where a facet has no area.
    open : list of ndarray
        The open fraction of the box's faces normal to each axis: the box's shape with one more along that axis.
        Exactly 0 or 1 where no surface is near.
    volume : ndarray
        The open fraction of each cell, of the box's shape.
    extra_cell, extra_piece, extra_volume : ndarray, shape (k,)
        The pieces 1, 2, ... of split cells by falling volume (fraction of the cell's), sorted by cell.
    link_axis, link_face, link_below, link_above, link_open : ndarray, shape (l,)
        For every face of a split cell: its axis and flat index in ``open[axis]``, the pieces below and above (-1 in a
        cell that lies outside the box or the grid), the part of the face that is open between them. A face's links
        add up to its open fraction.
    """

    facet: np.ndarray
    cell: np.ndarray
    piece: np.ndarray
    integrals: np.ndarray
    moments: np.ndarray
    normals: np.ndarray
    open: list[np.ndarray]
    volume: np.ndarray
    extra_cell: np.ndarray
    extra_piece: np.ndarray
    extra_volume: np.ndarray
    link_axis: np.ndarray
    link_face: np.ndarray
    link_below: np.ndarray
    link_above: np.ndarray
    link_open: np.ndarray


class Frame(NamedTuple):
    """The box as the kernels see it, with a margin of one cell.

    Attributes
    ----------
    lo, hi : ndarray of int64, shape (dim,)
        The box and its margin in whole coordinates.
    dx : ndarray, shape (dim,)
    normals : ndarray, shape (m, dim)
        The facets' unit normals.
    """

    lo: np.ndarray
    hi: np.ndarray
    dx: np.ndarray
    normals: np.ndarray


class Patches(NamedTuple):
    """What the kernels keep of each patch, in the order in which they are found or sorted by cell.

    Attributes
    ----------
    facet, image : ndarray of int32, shape (n,)
        ``image`` counts the periodic images of the surface.
    cell : ndarray of int64, shape (n,)
        Flat index in the box with its margin.
    edges : ndarray of int8, shape (n,)
        Bit i says that the patch has something of the facet's edge i (corner i in 2D).
    values : ndarray, shape (n, dim + dim * dim + dim + 1)
        Integrals, moments, the area vector over the cell's faces, and int x_a dA_a for the last axis a, in units of
        cells about the cell's centre.
    """

    facet: np.ndarray
    image: np.ndarray
    cell: np.ndarray
    edges: np.ndarray
    values: np.ndarray


def cut(points: np.ndarray, facets: np.ndarray, lattice: Lattice, base: int = 0) -> CutCells:
    """Return a closed surface cut by the cells of a lattice.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        m.
    facets : ndarray of int, shape (m, dim)
        Segments (2D) or triangles (3D) whose normals point into the fluid, as in ``surfaces.Surface``. They may form
        any number of closed shells; what several solids cover at once need only be finite.
    lattice : Lattice
    base : int
        How many of the solids reach to infinity (containers).
    """
    dim = points.shape[1]
    dx = np.asarray(lattice.dx, dtype=float)
    x = to_lattice(np.asarray(points, dtype=float), facets, np.asarray(lattice.origin, dtype=float), dx)
    area = area_vectors(x * dx, facets)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    lo, hi = (np.asarray(end, dtype=np.int64) for end in (lattice.lo, lattice.hi))
    frame = Frame(lo - 1, hi + 1, dx, area / np.where(size > 0.0, size, 1.0))
    facets = np.ascontiguousarray(facets, dtype=np.int32)
    images = _images(x, facets, lattice, frame)
    patches, sums = _find_patches(x, facets, frame, images)
    shape = frame.hi - frame.lo
    count = np.bincount(patches.cell, minlength=int(np.prod(shape)))
    order = _order(patches.cell, count)
    patches = Patches(*(part[order] for part in patches))
    opening = _open_faces(sums, count.reshape(shape) > 0, base)
    inner, cell = _box_cells(patches.cell, shape)
    box = Box(frame.lo, shape, images)
    pieces = find_pieces(x, facets, box, patches, inner, opening)
    some = inner & (np.abs(patches.values[:, :dim]).sum(axis=1) > 0.0)
    cell, values = cell[some], patches.values[some]
    return CutCells(
        facet=patches.facet[some],
        cell=cell,
        piece=pieces.patch_piece[some],
        integrals=np.ascontiguousarray(values[:, :dim]),
        moments=values[:, dim : dim + dim * dim].reshape(-1, dim, dim),
        normals=frame.normals,
        open=opening,
        volume=_volumes(cell, values[:, -1], opening[-1]),
        extra_cell=_box_cells(pieces.extra_cell, shape)[1],
        extra_piece=pieces.extra_piece,
        extra_volume=pieces.extra_volume,
        link_axis=pieces.link_axis,
        link_face=_box_faces(pieces.link_cell, pieces.link_axis, shape),
        link_below=pieces.link_below,
        link_above=pieces.link_above,
        link_open=pieces.link_open,
    )


def _images(x: np.ndarray, facets: np.ndarray, lattice: Lattice, frame: Frame) -> np.ndarray:
    """Return the periodic images of the surface that reach into or below the box, as shifts in cells (k, dim).

    Below the box those count that also reach into it or beyond; what lies wholly below covers nothing.
    """
    dim = x.shape[1]
    if len(facets) == 0:
        return np.zeros((0, dim), dtype=np.int64)
    used = x[facets.ravel()]
    low, high = used.min(axis=0), used.max(axis=0)
    shifts = []
    for a in range(dim):
        if not lattice.periodic[a]:
            shifts.append([0])
            continue
        n = int(lattice.cells[a])
        first = math.ceil((frame.lo[a] - high[a]) / n)
        last = math.floor((frame.hi[a] - low[a]) / n)
        shifts.append([n * s for s in range(first, last + 1)])
    return np.array(list(itertools.product(*shifts)), dtype=np.int64).reshape(-1, dim)


def _find_patches(
    x: np.ndarray, facets: np.ndarray, frame: Frame, images: np.ndarray
) -> tuple[Patches, list[np.ndarray]]:
    """Return the patches in the box and its margin, and per axis the sums of area in front of each face.

    The sums have one more entry along the axis than cells: the first is what lies below the box.
    """
    dim = x.shape[1]
    shape = frame.hi - frame.lo
    sums = [np.zeros(shape + (np.arange(dim) == a)) for a in range(dim)]
    kernel = _clip_2d if dim == 2 else _clip_3d
    found = []
    for number, shift in enumerate(images):
        # it is the box that is moved, not the surface: an image's patches are the original's to the last bit
        moved = Frame(frame.lo - shift, frame.hi - shift, frame.dx, frame.normals)
        facet, cell, edges, values = kernel(x, facets, moved, *sums)
        found.append(Patches(facet, np.full(len(facet), number, dtype=np.int32), cell, edges, values))
    if not found:
        none = np.zeros(0, dtype=np.int32)
        return Patches(
            none, none, none.astype(np.int64), none.astype(np.int8), np.zeros((0, dim * (dim + 2) + 1))
        ), sums
    return (
        found[0] if len(found) == 1 else Patches(*(np.concatenate(part) for part in zip(*found, strict=True)))
    ), sums


def _open_faces(sums: list[np.ndarray], touched: np.ndarray, base: int) -> list[np.ndarray]:
    """Return the open fractions of the box's faces along each axis, the margin left out."""
    opening = []
    dim = touched.ndim
    for a, part in enumerate(sums):
        within = tuple(slice(1, -1) for _ in range(dim))
        covered = np.cumsum(part, axis=a)[within]
        fraction = np.clip(1.0 - base + covered, 0.0, 1.0)
        other = tuple(slice(None) if b == a else slice(1, -1) for b in range(dim))
        seen = touched[other]
        near = np.take(seen, range(seen.shape[a] - 1), axis=a) | np.take(seen, range(1, seen.shape[a]), axis=a)
        whole = np.rint(fraction)
        opening.append(np.where(near & (np.abs(fraction - whole) > TINY), fraction, whole))
    return opening


def _volumes(cell: np.ndarray, flux: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """Return the open fraction of the box's cells by the divergence theorem along the last axis.

    ``flux`` is int x_a dA_a of each patch, ``opening`` the open fraction of the faces normal to that axis.
    """
    low, high = opening[..., :-1], opening[..., 1:]
    inside = np.bincount(cell, weights=flux, minlength=low.size).reshape(low.shape)
    return np.clip(0.5 * (low + high) - inside, 0.0, 1.0)


def _box_cells(cell: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells of the box with its margin are the box's, and their flat index in it (else nonsense)."""
    index = np.array(np.unravel_index(cell, shape)).reshape(len(shape), -1) - 1
    inner = np.all((index >= 0) & (index < shape[:, None] - 2), axis=0)
    return inner, np.ravel_multi_index(tuple(index), tuple(shape - 2), mode="clip").astype(np.int64)


def _box_faces(above: np.ndarray, axis: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the flat index of faces among the box's faces of their axis; ``above`` are cells of box and margin."""
    index = np.array(np.unravel_index(above, shape)).reshape(len(shape), -1) - 1
    face = np.zeros(len(above), dtype=np.int64)
    for a in range(len(shape)):
        mine = axis == a
        face[mine] = np.ravel_multi_index(tuple(index[:, mine]), tuple(shape - 2 + (np.arange(len(shape)) == a)))
    return face


@njit(cache=True)
def _order(cell, count):
    """Return the order of patches by cell, those of one cell as they are; ``count`` is how many each cell has."""
    position = np.cumsum(count) - count
    order = np.empty(len(cell), np.int64)
    for i in range(len(cell)):
        order[position[cell[i]]] = i
        position[cell[i]] += 1
    return order


@njit(cache=True)
def _room(n, width):
    """Return facet, cell, edges and values for n patches."""
    return np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int8), np.empty((n, width))


@njit(cache=True)
def _grown(facet, cell, edges, values):
    """Return twice the room."""
    n = len(facet)
    more = _room(2 * n, values.shape[1])
    more[0][:n], more[1][:n], more[2][:n], more[3][:n] = facet, cell, edges, values
    return more


@njit(cache=True)
def _own_edges(tags, n):
    """Return one bit for each of the facet's edges that is among the tags."""
    bits = 0
    for i in range(n):
        if tags[i] < PLANE:
            bits |= 1 << tags[i]
    return bits


@njit(cache=True)
def _clip_3d(x, facets, frame, sums0, sums1, sums2):
    """Return facet, cell, edges and values of the patches of triangles; add their area vectors to the sums."""
    lo, hi = frame.lo, frame.hi
    ny, nz = hi[1] - lo[1], hi[2] - lo[2]
    facet, cell, edges, values = _room(3 * len(facets) + 64, 16)
    part, tags = np.empty((4, MOST, 6)), np.empty((4, MOST), np.int64)
    at, value = np.empty(3, np.int64), np.empty(16)
    count = 0
    for f in range(len(facets)):
        load_facet(x, facets[f], part[0], tags[0])
        if not _near(part[0], 3, lo, hi):
            continue
        i0, i1 = slab_range(part[0], 3, 0, lo[0], hi[0])
        for i in range(i0, i1):
            n = clip_polygon(part[0], tags[0], 3, 0, _low(i, lo[0]), i + 1.0, part[1], tags[1])
            if n == 0:
                continue
            j0, j1 = slab_range(part[1], n, 1, lo[1], hi[1])
            for j in range(max(j0, lo[1]) if i < lo[0] else j0, j1):
                m = clip_polygon(part[1], tags[1], n, 1, _low(j, lo[1]), j + 1.0, part[2], tags[2])
                if m == 0:
                    continue
                k0, k1 = slab_range(part[2], m, 2, lo[2], hi[2])
                for k in range(max(k0, lo[2]) if i < lo[0] or j < lo[1] else k0, k1):
                    o = clip_polygon(part[2], tags[2], m, 2, _low(k, lo[2]), k + 1.0, part[3], tags[3])
                    if o < 3:
                        continue
                    at[0], at[1], at[2] = i, j, k
                    _measure_polygon(part[3], o, at, frame.dx, frame.normals[f], value)
                    # what lies below the box has its area added to the first entry of its row
                    i_, j_, k_ = i - lo[0], j - lo[1], k - lo[2]
                    if j_ >= 0 and k_ >= 0:
                        sums0[i_ + 1, j_, k_] += value[12]
                    if i_ >= 0 and k_ >= 0:
                        sums1[i_, j_ + 1, k_] += value[13]
                    if i_ >= 0 and j_ >= 0:
                        sums2[i_, j_, k_ + 1] += value[14]
                    if i_ < 0 or j_ < 0 or k_ < 0:
                        continue
                    if count == len(facet):
                        facet, cell, edges, values = _grown(facet, cell, edges, values)
                    facet[count], cell[count] = f, (i_ * ny + j_) * nz + k_
                    edges[count], values[count] = _own_edges(tags[3], o), value
                    count += 1
    return facet[:count].copy(), cell[:count].copy(), edges[:count].copy(), values[:count].copy()


@njit(cache=True)
def _clip_2d(x, facets, frame, sums0, sums1):
    """Return facet, cell, edges and values of the patches of segments; add their area vectors to the sums."""
    lo, hi = frame.lo, frame.hi
    facet, cell, edges, values = _room(3 * len(facets) + 64, 9)
    part, tags = np.empty((3, 2, 4)), np.empty((3, 2), np.int64)
    at, value = np.empty(2, np.int64), np.empty(9)
    count = 0
    for f in range(len(facets)):
        load_facet(x, facets[f], part[0], tags[0])
        if not _near(part[0], 2, lo, hi):
            continue
        i0, i1 = slab_range(part[0], 2, 0, lo[0], hi[0])
        for i in range(i0, i1):
            if clip_segment(part[0], tags[0], 0, _low(i, lo[0]), i + 1.0, part[1], tags[1]) == 0:
                continue
            j0, j1 = slab_range(part[1], 2, 1, lo[1], hi[1])
            for j in range(max(j0, lo[1]) if i < lo[0] else j0, j1):
                if clip_segment(part[1], tags[1], 1, _low(j, lo[1]), j + 1.0, part[2], tags[2]) == 0:
                    continue
                at[0], at[1] = i, j
                _measure_segment(part[2], at, frame.dx, frame.normals[f], value)
                i_, j_ = i - lo[0], j - lo[1]
                if j_ >= 0:
                    sums0[i_ + 1, j_] += value[6]
                if i_ >= 0:
                    sums1[i_, j_ + 1] += value[7]
                if i_ < 0 or j_ < 0:
                    continue
                if count == len(facet):
                    facet, cell, edges, values = _grown(facet, cell, edges, values)
                facet[count], cell[count] = f, i_ * (hi[1] - lo[1]) + j_
                edges[count], values[count] = _own_edges(tags[2], 2), value
                count += 1
    return facet[:count].copy(), cell[:count].copy(), edges[:count].copy(), values[:count].copy()


@njit(cache=True)
def _low(i, lo):
    """Return the lower plane of slab i; the slab lo - 1 is all that lies below the box."""
    return float(i) if i >= lo else -np.inf


@njit(cache=True)
def _near(points, n, lo, hi):
    """Return whether a facet may reach into the box or into the rows below it."""
    below = 0
    for a in range(len(lo)):
        low = high = points[0, a]
        for i in range(1, n):
            low, high = min(low, points[i, a]), max(high, points[i, a])
        if low >= hi[a]:
            return False
        below += high < lo[a]
    return below < 2


@njit(cache=True)
def _measure_polygon(points, n, at, dx, normal, value):
    """Set the values of a patch (see ``Patches``), by a fan of triangles; exact for what is integrated."""
    value[:] = 0.0
    b, c = np.empty(3), np.empty(3)
    area = np.empty(3)
    for i in range(1, n - 1):
        for a in range(3):
            b[a], c[a] = points[i, a] - points[0, a], points[i + 1, a] - points[0, a]
        whole = 0.0
        for a in range(3):
            e, g = (a + 1) % 3, (a + 2) % 3
            area[a] = 0.5 * (b[e] * c[g] - b[g] * c[e])
            value[12 + a] += area[a]
            whole += area[a] * dx[e] * dx[g] * normal[a]
        value[15] += area[2] * ((points[0, 2] + points[i, 2] + points[i + 1, 2]) / 3.0 - at[2] - 0.5)
        for s in range(3):
            w0, w1, w2 = points[0, 3 + s], points[i, 3 + s], points[i + 1, 3 + s]
            total = w0 + w1 + w2
            value[s] += whole * total / 3.0
            for a in range(3):
                centre = at[a] + 0.5
                x0, x1, x2 = points[0, a] - centre, points[i, a] - centre, points[i + 1, a] - centre
                product = w0 * x0 + w1 * x1 + w2 * x2 + total * (x0 + x1 + x2)
                value[3 + 3 * s + a] += whole * product * dx[a] / 12.0


@njit(cache=True)
def _measure_segment(points, at, dx, normal, value):
    """Set the values of a patch (see ``Patches``)."""
    value[6] = points[1, 1] - points[0, 1]
    value[7] = points[0, 0] - points[1, 0]
    value[8] = value[7] * (0.5 * (points[0, 1] + points[1, 1]) - at[1] - 0.5)
    whole = value[6] * dx[1] * normal[0] + value[7] * dx[0] * normal[1]
    for s in range(2):
        w0, w1 = points[0, 2 + s], points[1, 2 + s]
        value[s] = 0.5 * whole * (w0 + w1)
        for a in range(2):
            x0, x1 = points[0, a] - at[a] - 0.5, points[1, a] - at[a] - 0.5
            value[2 + 2 * s + a] = whole * dx[a] * (w0 * x0 + w1 * x1 + (w0 + w1) * (x0 + x1)) / 6.0
