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

import numpy as np
from numba import njit

from petfsi.geometry.neighbours import neighbours
from petfsi.geometry.node_moments import node_integrals
from petfsi.geometry.overlaps import Rest
from petfsi.geometry.patches import Frame, Patches, find_patches
from petfsi.geometry.piece_accounts import Box
from petfsi.geometry.pieces import find_pieces
from petfsi.geometry.seams import Seams, overlapped
from petfsi.geometry.slabs import area_vectors, off_planes

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
    integrals : ndarray, shape (n, width)
        int N_i dA over the patch, m^2 (m in 2D), i the facet's corners, or its nodes if some facets are parts of
        quadratic ones (see ``quadratic.Curved``).
    moments : ndarray, shape (n, width, dim)
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
    points : ndarray, shape (n, dim)
        Where the surface was cut: its points, moved a little from planes of the grid and where bodies touch, m.
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
    points: np.ndarray


def cut(
    points: np.ndarray,
    facets: np.ndarray,
    lattice: Lattice,
    base: int = 0,
    part: np.ndarray | None = None,
    seams: Seams | None = None,
) -> CutCells:
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
    part : ndarray of int8, shape (m,), or None
        Which part of a quadratic facet each facet is, as in ``quadratic.Curved``; None if none is.
    seams : Seams, optional
        Where surfaces reach around periodic axes; their points must be ``closed``. The answer knows the walls alone.
    """
    dim, every = points.shape[1], facets
    dx = np.asarray(lattice.dx, dtype=float)
    x, facets, ends = _placed(points, facets, lattice, seams)
    area = area_vectors(x * dx, facets)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    lo, hi = (np.asarray(end, dtype=np.int64) for end in (lattice.lo, lattice.hi))
    facets = np.ascontiguousarray(facets, dtype=np.int32)
    images, near_lo, near_hi = _reach(x, every, lattice, lo, hi, ends)
    frame = Frame(near_lo - 1, near_hi + 1, dx, area / np.where(size > 0.0, size, 1.0))
    patches, sums = find_patches(x, facets, frame, images)
    _begin(x, ends, frame, images, sums)
    shape = frame.hi - frame.lo
    count = np.bincount(patches.cell, minlength=int(np.prod(shape)))
    order = _order(patches.cell, count)
    integrals = patches.integrals
    patches = Patches(*(part[order] for part in patches._replace(integrals=integrals[:, :0])))
    opening = _open_faces(sums, count.reshape(shape), base)
    inner, cell = _box_cells(patches.cell, frame, lo, hi)
    box, beyond = Box(frame.lo, shape, images, lo, hi), neighbours(facets, len(x), seams, lattice.cells)
    pieces = find_pieces(x, facets, beyond, box, patches, inner, opening, frame)
    for fraction in opening:
        np.maximum(fraction, 0.0, out=fraction)
    patch_piece = pieces.patch_piece
    if pieces.rest is not None:
        patches, integrals, patch_piece, remnant = _replaced(patches, integrals[order], patch_piece, pieces.rest)
        order = np.arange(len(integrals))
        inner, cell = _box_cells(patches.cell, frame, lo, hi)
    volume = _volumes(patches, frame, opening[-1])
    some = np.flatnonzero(inner & np.any(patches.vectors != 0.0, axis=1))
    integrals = integrals[order[some]]
    integrals, moments = integrals[:, :dim], integrals[:, dim:].reshape(-1, dim, dim)
    if part is not None:
        part = part if seams is None else part[seams.walls]
        place = np.column_stack(np.unravel_index(patches.cell[some], shape)) + frame.lo - images[patches.image[some]]
        of = (frame, patches.facet[some], place)
        shapes = (np.full(len(some), -1), np.zeros((0, 2, 2 * dim)))
        if pieces.rest is not None:
            shapes = remnant[some], pieces.rest.polygons
        integrals, moments = node_integrals(x, facets, part, *of, integrals, moments, shapes)
    return CutCells(
        facet=patches.facet[some],
        cell=cell[some],
        piece=patch_piece[some],
        integrals=integrals,
        moments=moments,
        normals=frame.normals,
        open=[_embedded(part, near_lo - lo, hi - lo + (np.arange(dim) == a), base) for a, part in enumerate(opening)],
        volume=_embedded(volume, near_lo - lo, hi - lo, base),
        extra_cell=_box_cells(pieces.extra_cell, frame, lo, hi)[1],
        extra_piece=pieces.extra_piece,
        extra_volume=pieces.extra_volume,
        link_axis=pieces.link_axis,
        link_face=_box_faces(pieces.link_cell, pieces.link_axis, frame, lo, hi),
        link_below=pieces.link_below,
        link_above=pieces.link_above,
        link_open=pieces.link_open,
        points=np.asarray(lattice.origin) + dx * x,
    )


def _placed(
    points: np.ndarray, facets: np.ndarray, lattice: Lattice, seams: Seams | None
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return where a surface is cut, in cells from the lattice's origin, its walls, and its lower ends along each axis.

    Points are moved a little from planes of the lattice. A surface that reaches around no periodic axis has no ends.
    """
    x = (np.asarray(points, dtype=float) - np.asarray(lattice.origin)) / np.asarray(lattice.dx, dtype=float)
    ends, place = [facets[:0]] * points.shape[1], None
    if seams is not None:
        ends, facets = [facets[cap].astype(np.int32) for cap in seams.caps], facets[seams.walls]
        x, place = overlapped(x, facets, seams, np.asarray(lattice.cells) * lattice.periodic), seams.place
    return off_planes(x, facets, place), facets, ends


def _reach(
    x: np.ndarray, facets: np.ndarray, lattice: Lattice, lo: np.ndarray, hi: np.ndarray, ends: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the periodic images of the surface that matter to the box, and the part of the box that they reach.

    An image matters if it reaches into the box or its margin; what lies wholly below covers nothing in the end. The
    first images along an axis around which surfaces reach are those whose lower ends lie below the box.

    Returns
    -------
    images : ndarray of int64, shape (k, dim)
        How far each is moved, in cells.
    near_lo, near_hi : ndarray of int64, shape (dim,)
    """
    dim = x.shape[1]
    if len(facets) == 0:
        return np.zeros((0, dim), dtype=np.int64), lo, lo
    used = x if len(x) <= facets.size else x[facets.ravel()]
    low, high = used.min(axis=0), used.max(axis=0)
    shifts = []
    near_lo, near_hi = lo.copy(), lo.copy()
    for a in range(dim):
        n = int(lattice.cells[a]) if lattice.periodic[a] else 0
        first = math.ceil((lo[a] - 1 - high[a]) / n) if n else 0
        last = math.floor((hi[a] + 1 - low[a]) / n) if n else 0
        near_lo[a] = np.clip(math.floor(low[a]) + n * first, lo[a], hi[a])
        near_hi[a] = np.clip(math.floor(high[a]) + 1 + n * last, near_lo[a], hi[a])
        if len(ends[a]):
            first = min(first, math.floor((lo[a] - 2 - x[ends[a], a].max()) / n))
        shifts.append([n * s for s in range(first, last + 1)])
    return np.array(list(itertools.product(*shifts)), dtype=np.int64).reshape(-1, dim), near_lo, near_hi


def _begin(x: np.ndarray, ends: list[np.ndarray], frame: Frame, images: np.ndarray, sums: list[np.ndarray]) -> None:
    """Add the lower ends of surfaces that reach around periodic axes: what their first images cover below the box."""
    for a, facets in enumerate(ends):
        if len(facets):
            normals = np.zeros(facets.shape)
            find_patches(x, facets, frame._replace(normals=normals), images[images[:, a] == images[:, a].min()], sums)


def _open_faces(sums: list[np.ndarray], count: np.ndarray, base: int) -> list[np.ndarray]:
    """Return the open fractions of the box's faces along each axis, the margin left out; below 0 where solids overlap.

    Parameters
    ----------
    sums : list of ndarray
        As ``find_patches`` returns them; used up.
    count : ndarray of int
        How many patches each cell has, of the shape of the box with its margin.
    base : int
        As for ``cut``.
    """
    opening = []
    for a, part in enumerate(sums):
        before, after = int(np.prod(count.shape[:a])), int(np.prod(count.shape[a + 1 :]))
        _open_along(part.reshape(before, -1, after), count.reshape(before, -1, after), base)
        opening.append(np.ascontiguousarray(part[tuple(slice(1, -1) for _ in range(count.ndim))]))
    return opening


@njit(cache=True)
def _open_along(sums, count, base):
    """Turn sums along the second axis, one for each face between cells, into the open fractions of the faces."""
    for i in range(sums.shape[0]):
        for j in range(1, sums.shape[1] - 1):
            for k in range(sums.shape[2]):
                sums[i, j, k] += sums[i, j - 1, k]
        for j in range(1, sums.shape[1] - 1):
            for k in range(sums.shape[2]):
                # below 0 where solids overlap
                fraction = min(1.0 - base + sums[i, j, k], 1.0)
                whole = np.rint(fraction)
                near = count[i, j - 1, k] > 0 or count[i, j, k] > 0
                sums[i, j, k] = fraction if near and abs(fraction - whole) > TINY else whole


def _replaced(
    patches: Patches, integrals: np.ndarray, piece: np.ndarray, rest: Rest
) -> tuple[Patches, np.ndarray, np.ndarray, np.ndarray]:
    """Return patches, integrals and pieces with what is left of those that solids overlap in their place.

    And which of the remnants each is, -1 for none.
    """
    keep = np.ones(len(patches.cell), dtype=bool)
    keep[rest.gone] = False
    take = np.concatenate((np.flatnonzero(keep), rest.patch))
    order = np.argsort(patches.cell[take], kind="stable")
    vectors = np.concatenate((patches.vectors[keep], rest.vectors))[order]
    found = patches._replace(facet=patches.facet[take][order], image=patches.image[take][order])
    found = found._replace(cell=patches.cell[take][order], edges=patches.edges[take][order], vectors=vectors)
    both = np.concatenate((integrals[keep], rest.integrals))[order]
    remnant = np.concatenate((np.full(keep.sum(), -1), np.arange(len(rest.patch))))
    return found, both, np.concatenate((piece[keep], rest.piece))[order], remnant[order]


def _volumes(patches: Patches, frame: Frame, opening: np.ndarray) -> np.ndarray:
    """Return the open fraction of the frame's cells by the divergence theorem along the last axis.

    ``opening`` is that of the faces normal to it, the margin left out, as in what is returned.
    """
    low, high = opening[..., :-1], opening[..., 1:]
    inner, cell = _box_cells(patches.cell, frame, frame.lo + 1, frame.hi - 1)
    flux = np.bincount(cell[inner], weights=patches.vectors[inner, -1], minlength=low.size)
    return np.clip(0.5 * (low + high) - flux.reshape(low.shape), 0.0, 1.0)


def _embedded(part: np.ndarray, place: np.ndarray, shape: np.ndarray, base: int) -> np.ndarray:
    """Return what is open of a whole box, of which a part begins at a place and the rest is far from surfaces."""
    whole = np.full(tuple(shape), 1.0 if base == 0 else 0.0)
    whole[tuple(slice(p, p + n) for p, n in zip(place, part.shape, strict=True))] = part
    return whole


def _box_cells(cell: np.ndarray, frame: Frame, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells of the frame do not belong to its margin, and their flat index in a box that holds them."""
    shape = frame.hi - frame.lo
    index = np.array(np.unravel_index(cell, shape)).reshape(len(shape), -1)
    inner = np.all((index > 0) & (index < shape[:, None] - 1), axis=0)
    inside = tuple(index + (frame.lo - lo)[:, None])
    return inner, np.ravel_multi_index(inside, tuple(np.maximum(hi - lo, 1)), mode="clip").astype(np.int64)


def _box_faces(above: np.ndarray, axis: np.ndarray, frame: Frame, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return the flat index of faces among the box's faces of their axis; ``above`` are cells of the frame."""
    dim = len(lo)
    index = np.array(np.unravel_index(above, frame.hi - frame.lo)).reshape(dim, -1) + (frame.lo - lo)[:, None]
    face = np.zeros(len(above), dtype=np.int64)
    for a in range(dim):
        mine = axis == a
        face[mine] = np.ravel_multi_index(tuple(index[:, mine]), tuple(hi - lo + (np.arange(dim) == a)))
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
