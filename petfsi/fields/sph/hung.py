"""Wall particles that hang on the facets of a surface: where they are at rest, and on what.

Behind facets of thick bodies they fill the body as far as particles see, each place once, as in an obstacle, and all
particles see them. Bodies thinner than that have them behind each face by itself, in places where there may be fluid of
the other side, and they go on past rims: what sees which of them, ``rims`` says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from petfsi.fields.sph.layers import FINE, fine_cells, in_layers
from petfsi.fields.sph.rims import Rims, unit_normals
from petfsi.fields.sph.solids import SAME, nearest, pseudonormals
from petfsi.fields.sph.thin import sampled
from petfsi.geometry.slabs import area_vectors
from petfsi.geometry.surfaces import shells

#: What is as near as so many spacings to a wall particle at rest is in a wall.
TAKEN = 0.75


@dataclass(frozen=True)
class Hung:
    """Wall particles at x = sum_a lambda_a X_a + way o - depth n, with the normal n and, past a rim, its outward o.

    Attributes
    ----------
    facet : ndarray of int, shape (n,)
    weights : ndarray, shape (n, dim)
        lambda: of the facet's points.
    depth : ndarray, shape (n,)
        m.
    rim : ndarray of int, shape (n,)
        Past which they are; -1 of none.
    way : ndarray, shape (n,)
        How far past it, m.
    share, fixed : ndarray, shape (n,)
        The volume is share times the facet's area, and fixed: m, m^dim.
    sided : ndarray of bool, shape (n,)
        Whether they are seen through their own face alone.
    """

    facet: np.ndarray
    weights: np.ndarray
    depth: np.ndarray
    rim: np.ndarray
    way: np.ndarray
    share: np.ndarray
    fixed: np.ndarray
    sided: np.ndarray

    def only(self, rows: np.ndarray) -> Hung:
        """Return some of them."""
        return Hung(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})

    def __add__(self, other: Hung) -> Hung:
        both = {name: (getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__}
        return Hung(**{name: np.concatenate(parts) for name, parts in both.items()})


def hang(
    points: np.ndarray, facets: np.ndarray, thin: np.ndarray, rims: Rims, dx: float, reach: float, taken: np.ndarray
) -> Hung:
    """Return the wall particles of a surface.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        At rest, m.
    facets : ndarray of int, shape (n_facets, dim)
    thin : ndarray of bool, shape (n_facets,)
        Those of thin bodies.
    rims : Rims
        Of the same surface.
    dx, reach : float
        Of particles, m: there are ceil(reach / dx) layers.
    taken : ndarray, shape (n_taken, dim)
        Places of wall particles at rest, m: none is put past a rim into a wall.
    """
    layers = int(np.ceil(reach / dx - SAME))
    found = _behind_faces(points, facets, np.flatnonzero(thin), dx, layers)
    past = _past_rims(points, facets, rims, np.flatnonzero(thin[rims.facet]), dx, layers)
    if len(taken) and len(past.facet):
        x = np.einsum("na,nad->nd", past.weights, points[facets[past.facet]])
        x += past.way[:, None] * rims.outward(points)[past.rim]
        x -= past.depth[:, None] * unit_normals(points, facets)[past.facet]
        past = past.only(cKDTree(taken).query(x)[0] > TAKEN * dx)
    found += past
    label, _ = shells(points, facets)
    wet = _wet(points, facets, dx, taken)
    for shell in np.unique(label[~thin & wet]):
        inside = _inside(points, facets, np.flatnonzero(label == shell), wet, dx, layers)
        found += inside.only(_free(inside, points, facets, dx, taken))
    return found


def _free(hung: Hung, points, facets, dx: float, taken) -> np.ndarray:
    """Return which of these, past no rims, are in no wall at rest."""
    if not len(taken):
        return np.ones(len(hung.facet), dtype=bool)
    x = np.einsum("na,nad->nd", hung.weights, points[facets[hung.facet]])
    x -= hung.depth[:, None] * unit_normals(points, facets)[hung.facet]
    return cKDTree(taken).query(x)[0] > TAKEN * dx


def _wet(points, facets, dx: float, taken) -> np.ndarray:
    """Return before which facets there are other things than walls."""
    sample, facet = sampled(points[facets], 0.5 * dx)
    if not len(taken):
        return np.ones(len(facets), dtype=bool)
    before = sample + 0.5 * dx * unit_normals(points, facets)[facet]
    free = cKDTree(taken).query(before)[0] > TAKEN * dx
    return np.bincount(facet, free, len(facets)) > 0


def _layered(facet, weights, rim, way, share, fixed, dx: float, layers: int) -> Hung:
    """Return so many layers of these."""
    n = len(facet)
    depth = np.tile((np.arange(layers) + 0.5) * dx, n)
    parts = (np.repeat(part, layers, axis=0) for part in (facet, weights, rim, way, share, fixed))
    facet, weights, rim, way, share, fixed = parts
    return Hung(facet, weights, depth, rim, way, share, fixed, np.ones(n * layers, dtype=bool))


def _behind_faces(points, facets, which, dx: float, layers: int) -> Hung:
    area = np.linalg.norm(area_vectors(points, facets[which]), axis=1)
    facet, weights, share = _samples(facets[which], area, dx)
    none = np.zeros(len(facet))
    return _layered(which[facet], weights, np.full(len(facet), -1), none, share * dx, none, dx, layers)


def _past_rims(points, facets, rims: Rims, which, dx: float, layers: int) -> Hung:
    dim = points.shape[1]
    rim, part, way, length = rims.beside(points, which, dx, layers)
    corners, ends = facets[rims.facet[rim]], rims.ends[rim]
    weights = np.zeros((len(rim), dim))
    np.put_along_axis(weights, np.argmax(corners[:, :, None] == ends[:, None], axis=1), part, axis=1)
    return _layered(rims.facet[rim], weights, rim, way, np.zeros(len(rim)), length * dx**2, dx, layers)


def _inside(points, facets, which, wet, dx: float, layers: int) -> Hung:
    """Return what fills one body, of these facets, as far behind all of them as particles see; it hangs on wet ones."""
    deep, corners = layers * dx, points[facets]
    normals = pseudonormals(points, facets[which])

    def measure(x):
        depth, normal = nearest(x, corners[which], normals, deep + dx, dx)
        return np.where(np.isinf(depth), -np.inf, depth), normal

    own = points[np.unique(facets[which])]
    x, volume = _on_lattice(own, unit_normals(points, facets[which]), dx)
    if x is None:
        lattice, cell = _fine_lattice(own, measure, dx, layers)
        x, volume, normal, depth = in_layers(lattice, cell, dx, layers, measure)
    else:
        depth, normal = measure(x)
        kept = (depth > 0.0) & (depth < deep)
        x, volume, depth, normal = x[kept], volume[kept], depth[kept], normal[kept]
    wet = which[wet[which]]
    sample, owner = sampled(corners[wet], 0.5 * dx)
    facet = wet[owner][cKDTree(sample).query(x + depth[:, None] * normal)[1]]
    unit = unit_normals(points, facets)[facet]
    depth = -np.sum((x - corners[facet, 0]) * unit, axis=1)
    edges = np.swapaxes(corners[facet, 1:] - corners[facet, :1], 1, 2)
    rest = np.einsum("kab,kb->ka", np.linalg.pinv(edges), x - corners[facet, 0])
    weights = np.column_stack([1.0 - rest.sum(axis=1), rest])
    area = np.linalg.norm(area_vectors(points, facets), axis=1)[facet]
    none = np.zeros(len(x))
    return Hung(
        facet, weights, depth, np.full(len(x), -1), none, volume / area, none, np.zeros(len(x), dtype=bool)
    )  # fmt: skip


def _on_lattice(points, normal, dx: float):
    """Return the places and volumes of a block along the axes; of anything else nothing."""
    low, high = points.min(axis=0), points.max(axis=0)
    on_box = np.any((np.abs(points - low) < SAME * dx) | (np.abs(points - high) < SAME * dx), axis=1)
    if not on_box.all() or not np.all(np.abs(normal).max(axis=1) > 1.0 - SAME):
        return None, None
    number = np.maximum(1, np.rint((high - low) / dx)).astype(int)
    rows = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, number, strict=True)]
    x = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, len(low))
    return x, np.full(len(x), np.prod((high - low) / number))


def _fine_lattice(points, measure, dx: float, layers: int):
    """Return a fine lattice near the surface, and what its places stand for."""
    dim, fine = points.shape[1], FINE[points.shape[1]]
    low, high = points.min(axis=0), points.max(axis=0)
    number = np.maximum(1, np.rint((high - low) / dx)).astype(int)
    side = (high - low) / number
    rows = [np.arange(-1, n + 1) + 0.5 for n in number]
    x = low + side * np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, dim)
    x = x[np.abs(measure(x)[0]) < (layers + 1) * dx]
    lattice = (x[:, None] + fine_cells(dim, fine) * side).reshape(-1, dim)
    return lattice, np.full(len(lattice), side.prod() / fine**dim)


def _samples(facets: np.ndarray, area: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points about a spacing apart on facets: the facet of each, its coordinates, its share of the area."""
    dim = facets.shape[1]
    size = area if dim == 2 else np.sqrt(2 * area)
    number = np.maximum(1, np.rint(size / spacing)).astype(int)
    parts = [(np.zeros(0, dtype=np.int64), np.zeros((0, dim)))]
    for m in np.unique(number):
        weights = _lattice_2d(m) if dim == 2 else _lattice_3d(m)
        use = np.flatnonzero(number == m)
        parts.append((np.repeat(use, len(weights)), np.tile(weights, (len(use), 1))))
    facet, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(facet, kind="stable")
    share = 1.0 / number ** (dim - 1)
    return facet[order], weights[order], share[facet[order]]


def _lattice_2d(m: int) -> np.ndarray:
    """Return the middles of m equal parts of a segment, barycentric."""
    t = (np.arange(m) + 0.5) / m
    return np.column_stack([1.0 - t, t])


def _lattice_3d(m: int) -> np.ndarray:
    """Return the centroids of m^2 equal parts of a triangle, barycentric."""
    i, j = (k.ravel() for k in np.mgrid[:m, :m])
    upright = np.column_stack([i, j])[i + j < m] + 1.0 / 3.0
    upside = np.column_stack([i, j])[i + j < m - 1] + 2.0 / 3.0
    st = np.concatenate([upright, upside]) / m
    return np.column_stack([1.0 - st.sum(axis=1), st])
