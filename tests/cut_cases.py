"""Shapes to cut, and what must hold of every cut."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import ConvexHull

from petfsi.geometry.clipping import Lattice


def grid(cells, lo=None, hi=None, periodic=False, dx=1.0):
    """A lattice with corner 0; the box is all of it unless said otherwise."""
    cells = np.asarray(cells)
    n = len(cells)
    low = np.zeros(n, dtype=int) if lo is None else np.asarray(lo)
    high = cells if hi is None else np.asarray(hi)
    sides = np.broadcast_to(np.asarray(periodic, dtype=bool), (n,))
    return Lattice(np.zeros(n), np.broadcast_to(np.asarray(dx, dtype=float), (n,)), cells, sides, low, high)


def polygon(corners):
    """A closed curve through corners in counterclockwise order."""
    i = np.arange(len(corners))
    return np.asarray(corners, dtype=float), np.column_stack((i, (i + 1) % len(i)))


def box(low, high):
    """A rectangle of 4 segments or a cuboid of 12 triangles."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    if len(low) == 2:
        return polygon([low, [high[0], low[1]], high, [low[0], high[1]]])
    points = low + np.array(list(itertools.product((0, 1), repeat=3))) * (high - low)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, np.array([q for a, b, c, d in quads for q in ((a, b, c), (a, c, d))])


def star(rng, n, centre, low, high):
    """A random star-shaped polygon or polyhedron of n corners at distances from low to high."""
    dim = len(centre)
    if dim == 2:
        angle = np.sort(rng.uniform(0, 2 * np.pi / n, n) + 2 * np.pi * np.arange(n) / n)
        unit = np.column_stack((np.cos(angle), np.sin(angle)))
        facets = polygon(unit)[1]
    else:
        unit = np.concatenate((np.eye(3), -np.eye(3))) @ rotation(rng, 3)
        unit = np.concatenate((unit, rng.normal(size=(n - 6, 3)))) if n > 6 else unit  # the centre is inside
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        facets = ConvexHull(unit).simplices
        corner = unit[facets]
        wrong = np.linalg.det(corner) < 0
        facets[wrong] = facets[wrong, ::-1]
    return np.asarray(centre) + rng.uniform(low, high, (len(unit), 1)) * unit, facets


def rotation(rng, dim):
    """A random rotation."""
    q = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    q[:, 0] *= np.sign(np.linalg.det(q))
    return q


def together(*surfaces):
    """Several surfaces as one."""
    points = np.concatenate([p for p, _ in surfaces])
    start = np.cumsum([0] + [len(p) for p, _ in surfaces])
    return points, np.concatenate([f + s for (_, f), s in zip(surfaces, start, strict=False)])


def enclosed_volume(points, facets):
    corner = points[facets]
    return np.linalg.det(corner).sum() / (2.0 if points.shape[1] == 2 else 6.0)


def patch_vectors(cuts, lattice):
    """The patches' area vectors, as fractions of the faces."""
    normal = cuts.normals[cuts.facet] * cuts.integrals.sum(axis=1)[:, None]
    return normal * np.asarray(lattice.dx) / np.prod(lattice.dx)


def piece_residuals(cuts, lattice):
    """For every piece: its faces' openings plus the walls, which must add up to nothing, shape (n, dim)."""
    shape, dim = lattice.shape, len(lattice.shape)
    n = int(np.prod(shape))
    number = np.zeros((n, 1 + max(cuts.extra_piece, default=0)), dtype=int)
    number[:, 0] = np.arange(n)
    number[cuts.extra_cell, cuts.extra_piece] = n + np.arange(len(cuts.extra_cell))
    residual = np.zeros((n + len(cuts.extra_cell), dim))
    vectors = patch_vectors(cuts, lattice)
    np.subtract.at(residual, number[cuts.cell, cuts.piece], vectors)
    split = np.zeros(n, dtype=bool)
    split[cuts.extra_cell] = True
    for a in range(dim):
        opening = cuts.open[a]
        linked = np.zeros(opening.size)
        mine = cuts.link_axis == a
        np.add.at(linked, cuts.link_face[mine], cuts.link_open[mine])
        cells = np.arange(n).reshape(shape)
        faces = np.arange(opening.size).reshape(opening.shape)
        for side in (0, 1):
            face = np.take(faces, range(side, side + shape[a]), axis=a).ravel()
            sign = 2 * side - 1
            whole = ~split
            residual[cells.ravel()[whole], a] += sign * opening.ravel()[face[whole]]
            assert np.abs(linked[face[split]] - opening.ravel()[face[split]]).max(initial=0.0) < 1e-12
            of_face = np.full(opening.size, -1)
            of_face[face] = cells.ravel()
            cell = of_face[cuts.link_face[mine]]
            piece = (cuts.link_above, cuts.link_below)[side][mine]
            inside = cell >= 0
            assert np.all(piece[inside] >= 0)
            assert np.all(piece[~inside] == -1)
            inside[inside] &= split[cell[inside]]
            np.add.at(residual[:, a], number[cell[inside], piece[inside]], sign * cuts.link_open[mine][inside])
            assert np.all(piece[~inside] <= 0)
    return residual


def check(points, facets, cuts, lattice, within=None):
    """Everything that holds of any cut of solids that do not overlap; ``within``: the volume they fill in the box."""
    assert all(np.all((part >= 0.0) & (part <= 1.0)) for part in cuts.open)
    assert np.all((cuts.volume >= 0.0) & (cuts.volume <= 1.0))
    assert np.all(np.diff(cuts.cell) >= 0)
    assert np.all(cuts.integrals > -1e-15)
    assert np.abs(piece_residuals(cuts, lattice)).max() < 1e-12
    cell = np.prod(lattice.dx)
    extra = np.bincount(cuts.extra_cell, weights=cuts.extra_volume, minlength=cuts.volume.size)
    assert np.all(extra <= cuts.volume.ravel() + 1e-12)
    assert np.all(cuts.extra_volume >= -1e-12)
    if within is not None:
        solid = (1.0 - cuts.volume).sum() * cell
        size = np.prod(lattice.shape) * cell
        assert abs(solid - within) < 1e-7 * max(size, 1e-300), (solid, within)
