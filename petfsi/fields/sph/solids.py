"""Obstacles as particles see them: how deep a place lies behind the nearest wet facet, and which way is out.

The side of the surface on which a point lies follows from the normal of the nearest face, edge or corner: means of the
faces' normals weighted with their angles (J. A. Baerentzen, H. Aanaes, IEEE TVCG 11 (2005), 243).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numba import njit

from petfsi.geometry.bodies import enclosed
from petfsi.geometry.obstacles import obstacle_surface
from petfsi.geometry.rays import inside_mask
from petfsi.geometry.seams import find_seams
from petfsi.geometry.shapes import bounds, inside
from petfsi.geometry.surfaces import ridges
from petfsi.scene.schema import Obstacle
from petfsi.scene.shape_checks import images
from petfsi.scene.tables import Shape

#: Places nearer than this part of dx are the same.
SAME = 1e-6
#: What lies as near as this part of dx before a facet decides whether it is wet.
BEFORE = 1e-3

Array = np.ndarray


class Bounds(Protocol):
    """What is asked of the fluid's domain: its corners, which axes repeat, and after what length (else 0), m."""

    @property
    def low(self) -> Array: ...  # noqa: D102
    @property
    def high(self) -> Array: ...  # noqa: D102
    @property
    def periodic(self) -> Array: ...  # noqa: D102
    @property
    def period(self) -> Array: ...  # noqa: D102


class Region:
    """What a shape of the scene takes in, with its images around periodic axes; a mesh file's surface is read.

    Parameters
    ----------
    shape : Shape
    surface : (points, facets)
        Closed.
    domain : Bounds
    """

    def __init__(self, shape: Shape, surface: tuple[Array, Array], domain: Bounds) -> None:
        self.shape, self.surface, self.domain = shape, surface, domain
        reach = bounds(shape)
        self.reach = (surface[0].min(axis=0), surface[0].max(axis=0)) if shape.mesh is not None else reach

    def shifts(self, low: Array, high: Array) -> list[Array]:
        """Return by how much the images are moved that may meet a box, m."""
        if self.reach is None:
            return [np.zeros(len(low))]
        return images(self.domain.period, self.reach, (low, high))

    def holds(self, points: Array) -> Array:
        """Return which points (n, dim) lie in it, boundary included; slow for meshes of many facets."""
        held = np.zeros(len(points), dtype=bool)
        for shift in self.shifts(points.min(axis=0), points.max(axis=0)) if len(points) else ():
            at = points - shift
            held |= inside(self.shape, at) if self.shape.mesh is None else enclosed(*self.surface, at)
        return held

    def holds_lattice(self, coords: Sequence[Array]) -> Array:
        """Return which points of a lattice lie in it, flat, the last axis' fastest."""
        shape = [len(c) for c in coords]
        held = np.zeros(math.prod(shape), dtype=bool)
        if not held.size:
            return held
        if self.shape.mesh is None:
            return self.holds(np.stack(np.meshgrid(*coords, indexing="ij"), axis=-1).reshape(-1, len(shape)))
        for shift in self.shifts(np.array([c[0] for c in coords]), np.array([c[-1] for c in coords])):
            held |= inside_mask(*self.surface, [c - s for c, s in zip(coords, shift, strict=True)]).astype(bool).ravel()
        return held


class Solid:
    """The wet surface of an obstacle.

    Attributes
    ----------
    name : str
    region : Region
        What its shape takes in; with ``outside`` that is the room.
    outside : bool
    corners : ndarray, shape (m, dim, dim)
        Of the wet facets, images around periodic axes included, m.
    normals : ndarray, shape (m, 1 + n, dim)
        Out of the solid: of each facet's face, corners and (3D) edges.
    whole : (corners, normals)
        With those facets that lie in other obstacles, but not those on the domain's sides.
    box : (low, high) or None
        Of a box or half space along the axes: where it lies in the domain, m.
    """

    def __init__(self, name: str, obstacle: Obstacle, domain: Bounds, dx: float, directory: Path) -> None:
        dim, size = len(domain.low), domain.high - domain.low
        key = f"obstacles.{name}.shape"
        points, facets = obstacle_surface(
            obstacle, dim, dx, domain.low, domain.high, key, directory, list(domain.periodic)
        )
        self.name, self.outside, self.dx = name, obstacle.outside, dx
        self.region = Region(obstacle.shape, (points, facets), domain)
        normals = pseudonormals(points, facets)
        wet = np.zeros(len(facets), dtype=bool)
        wet[find_seams(points, facets, size, domain.periodic).walls] = True
        if obstacle.shape.halfspace is not None:  # the rest of its box is not there
            up = np.array(obstacle.shape.halfspace.normal, dtype=float)
            wet &= np.abs(normals[:, 0] @ up) > (1.0 - 1e-9) * np.linalg.norm(up)
            height = (points - np.array(obstacle.shape.halfspace.point)) @ up
            wet &= np.all(height[facets] > -SAME * dx * np.linalg.norm(up), axis=1)
        for a in np.flatnonzero(~domain.periodic):
            along = points[facets, a]
            wet &= ~np.all(along <= domain.low[a] + SAME * dx, axis=1)
            wet &= ~np.all(along >= domain.high[a] - SAME * dx, axis=1)
        self.box = _block(obstacle, points, domain)
        self.corners, self.normals = self.whole = points[facets[wet]], normals[wet]

    @property
    def shape(self) -> Shape:
        """Of the scene."""
        return self.region.shape

    def faces(self) -> Array:
        """Return which lower and upper faces of its box are wet, shape (dim, 2)."""
        room = self.outside and self.shape.box is not None
        along = self.normals[:, 0] * (-1.0 if room else 1.0)
        return np.column_stack([np.any(sign * along > 0.5, axis=0) for sign in (-1.0, 1.0)])

    def holds(self, points: Array) -> Array:
        """Return which points (n, dim) are solid; slow for meshes of many facets."""
        return self.region.holds(points) != self.outside

    def settle(self, wet: Array, reach: float) -> None:
        """Leave out facets that are not wet; add images around periodic axes within reach of the domain."""
        self.corners, self.normals = self._with_images(self.whole[0][wet], self.whole[1][wet], reach)
        self.whole = self._with_images(*self.whole, reach)

    def _with_images(self, corners: Array, normals: Array, reach: float) -> tuple[Array, Array]:
        domain, low, high = self.region.domain, corners.min(axis=1), corners.max(axis=1)
        if not len(low) or not domain.periodic.any():
            return corners, normals
        around = domain.low - reach, domain.high + reach
        found = []
        for shift in images(domain.period, (low.min(axis=0), high.max(axis=0)), around):
            near = np.all((low + shift < around[1]) & (high + shift > around[0]), axis=1)
            found.append((corners[near] + shift, normals[near]))
        both = [np.concatenate(parts) for parts in zip(*found, strict=True)]
        return both[0], both[1]

    def depth(self, points: Array, reach: float, far: bool = True, whole: bool = False) -> tuple[Array, Array]:
        """Return how deep points lie behind the nearest wet facet, and the unit vector out of the wall there.

        Parameters
        ----------
        points : ndarray, shape (n, dim)
            m.
        reach : float
            m; no facet is looked for beyond it.
        far : bool
            Whether to tell what lies beyond it: infinite where solid. Without, all of it is minus infinity.
        whole : bool
            Whether facets in other obstacles count, too.

        Returns
        -------
        depth : ndarray, shape (n,)
            m; negative outside.
        normal : ndarray, shape (n, dim)
            Zero beyond the reach.
        """
        depth, normal = nearest(points, *(self.whole if whole else (self.corners, self.normals)), reach, self.dx)
        beyond = np.flatnonzero(np.isinf(depth))
        depth[beyond] = -np.inf
        if far and len(beyond):
            depth[beyond] = np.where(self.holds(points[beyond]), np.inf, -np.inf)
        return depth, normal


def build_solids(
    domain: Bounds, dx: float, obstacles: Mapping[str, Obstacle], directory: Path, reach: float
) -> list[Solid]:
    """Return the obstacles of a scene; facets that lie in another one or on the domain's sides are not wet.

    Not collective; reads mesh files.

    Parameters
    ----------
    domain : Bounds
    dx : float
        How large the facets of round ones are, m.
    obstacles : mapping of str to Obstacle
    directory : Path
        What mesh files are relative to.
    reach : float
        How far behind surfaces depths will be asked for, m.
    """
    solids = [Solid(name, obstacle, domain, dx, directory) for name, obstacle in obstacles.items()]
    wet = [~_covered(solid, solids) for solid in solids]
    for solid, kept in zip(solids, wet, strict=True):
        solid.settle(kept, reach + dx)
    return solids


def _covered(solid: Solid, solids: list[Solid]) -> Array:
    """Return which of its facets lie in another solid."""
    corners = np.concatenate((solid.corners, solid.corners.mean(axis=1, keepdims=True)), axis=1)
    before = corners + BEFORE * solid.dx * solid.normals[:, :1]
    covered = np.zeros(len(before), dtype=bool)
    for other in solids:
        if other is not solid:
            covered |= other.holds(before.reshape(-1, before.shape[2])).reshape(before.shape[:2]).all(axis=1)
    return covered


def _block(obstacle: Obstacle, points: Array, domain: Bounds) -> tuple[Array, Array] | None:
    """Return the corners of what is a block along the axes."""
    shape, low, high = obstacle.shape, points.min(axis=0), points.max(axis=0)
    if shape.halfspace is not None:
        along = np.flatnonzero(np.abs(shape.halfspace.normal) > 1e-12 * np.linalg.norm(shape.halfspace.normal))
        if len(along) != 1:
            return None
        a = along[0]
        low, high = domain.low.copy(), domain.high.copy()
        end = high if (shape.halfspace.normal[a] > 0) != obstacle.outside else low
        end[a] = shape.halfspace.point[a]
    elif shape.box is None:
        return None
    ends = domain.periodic
    return np.where(ends, low, np.maximum(low, domain.low)), np.where(ends, high, np.minimum(high, domain.high))


# ---- the nearest facet --------------------------------------------------------------------------------------


def pseudonormals(points: Array, facets: Array) -> Array:
    """Return the normals of each facet's face, corners and (3D) edges i, i + 1, shape (m, 3 or 7, dim).

    Only faces' have unit length.
    """
    dim = points.shape[1]
    x = points[facets]
    if dim == 2:
        along = x[:, 1] - x[:, 0]
        face = np.column_stack((along[:, 1], -along[:, 0]))
        angle = np.ones((len(facets), 2))
    else:
        face = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        to, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
        angle = np.arctan2(np.linalg.norm(np.cross(to, back), axis=2), np.einsum("fci,fci->fc", to, back))
    face = face / np.linalg.norm(face, axis=1, keepdims=True)
    corner = np.zeros(points.shape)
    np.add.at(corner, facets, angle[:, :, None] * face[:, None])
    parts = [face[:, None], corner[facets]]
    if dim == 3:
        edges = np.sort(ridges(facets).reshape(-1, 2), axis=1)
        _, number = np.unique(edges, axis=0, return_inverse=True)
        number = number.reshape(-1, 3)
        edge = np.zeros((int(number.max(initial=-1)) + 1, 3))
        np.add.at(edge, number, face[:, None])
        parts.append(edge[number])
    return np.concatenate(parts, axis=1)


def nearest(points: Array, corners: Array, normals: Array, reach: float, bucket: float) -> tuple[Array, Array]:
    """Return how deep points lie behind the nearest of oriented facets, and the unit vector out there.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
    corners : ndarray, shape (m, dim, dim)
    normals : ndarray, shape (m, 3 or 7, dim)
        See ``pseudonormals``.
    reach : float
        m; farther away the depth is infinite, the normal zero.
    bucket : float
        m; facets are tried with whole cubes of points so large. It changes the cost only.
    """
    n, dim = points.shape
    depth, normal = np.full(n, np.inf), np.zeros((n, dim))
    if n == 0 or len(corners) == 0:
        return depth, normal
    low = points.min(axis=0)
    counts = np.floor((points.max(axis=0) - low) / bucket).astype(np.int64) + 1
    number = np.ravel_multi_index(tuple(np.floor((points - low) / bucket).astype(np.int64).T), tuple(counts))
    order = np.argsort(number, kind="stable")
    begin = np.searchsorted(number[order], np.arange(counts.prod() + 1))
    padded = np.zeros((len(corners), dim, 3)), np.zeros((len(normals), normals.shape[1], 3)), np.zeros((n, 3))
    for whole, part in zip(padded, (corners, normals, points[order]), strict=True):
        whole[..., :dim] = part
    found, out = np.full(n, np.inf), np.zeros((n, 3))
    grid = np.ones(3, dtype=np.int64), np.zeros(3)
    grid[0][:dim], grid[1][:dim] = counts, low
    _nearest(*padded, begin, *grid, bucket, reach, dim, found, out)
    depth[order], normal[order] = found, out[:, :dim]
    return depth, normal


@njit(cache=True)
def _nearest(corners, normals, points, begin, counts, low, bucket, reach, dim, depth, out):
    """Fill in depths and normals; points are sorted by bucket."""
    best = np.full(len(points), reach)
    foot = np.zeros(3)
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for f in range(len(corners)):
        middle = np.zeros(3)
        for c in range(dim):
            middle += corners[f, c] / dim
        radius = 0.0
        for c in range(dim):
            radius = max(radius, math.sqrt(np.sum((corners[f, c] - middle) ** 2)) * (1.0 + 1e-12))
        for a in range(dim):
            below, above = corners[f, :, a].min() - reach, corners[f, :, a].max() + reach
            first[a] = max(0, int(math.floor((below - low[a]) / bucket)))
            last[a] = min(counts[a] - 1, int(math.floor((above - low[a]) / bucket)))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                row = (i * counts[1] + j) * counts[2]
                if last[2] < first[2]:
                    continue
                for n in range(begin[row + first[2]], begin[row + last[2] + 1]):
                    px, py, pz = points[n, 0], points[n, 1], points[n, 2]
                    away = (px - middle[0]) ** 2 + (py - middle[1]) ** 2 + (pz - middle[2]) ** 2
                    if away > (best[n] + radius) ** 2:
                        continue
                    if dim == 2:
                        part = _closest_2d(corners[f], px, py, foot)
                    else:
                        part = _closest_3d(corners[f], px, py, pz, foot)
                    dx, dy, dz = px - foot[0], py - foot[1], pz - foot[2]
                    square = dx * dx + dy * dy + dz * dz
                    length = math.sqrt(square)
                    if length < best[n]:
                        best[n] = length
                        up = normals[f, part, 0] * dx + normals[f, part, 1] * dy + normals[f, part, 2] * dz
                        sign = 1.0 if up > 0.0 else -1.0
                        depth[n] = -sign * length
                        if length > 1e-9 * bucket:
                            out[n, 0], out[n, 1], out[n, 2] = sign * dx / length, sign * dy / length, sign * dz / length
                        else:
                            out[n] = normals[f, 0]


@njit(cache=True)
def _closest_2d(corner, px, py, foot):
    """Put the nearest point of a segment into foot; return 0 if it is between the ends, 1 or 2 if it is one."""
    tx, ty = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1]
    share = ((px - corner[0, 0]) * tx + (py - corner[0, 1]) * ty) / (tx * tx + ty * ty)
    part = 0
    if share <= 0.0:
        share, part = 0.0, 1
    elif share >= 1.0:
        share, part = 1.0, 2
    foot[0], foot[1] = corner[0, 0] + share * tx, corner[0, 1] + share * ty
    return part


@njit(cache=True)
def _closest_3d(corner, px, py, pz, foot):
    """Put the nearest point of a triangle into foot; return 0 for its face, 1 to 3 for a corner, 4 to 6 for an edge.

    C. Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    x, y, z = px - corner[0, 0], py - corner[0, 1], pz - corner[0, 2]
    bx, by, bz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    cx, cy, cz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    d1, d2 = bx * x + by * y + bz * z, cx * x + cy * y + cz * z
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        part, b, c = 1, 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        part, b, c = 2, 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        part, b, c = 4, d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        part, b, c = 3, 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        part, b, c = 6, 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        share = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        part, b, c = 5, 1.0 - share, share
    else:
        part, b, c = 0, vb / (va + vb + vc), vc / (va + vb + vc)
    foot[0] = corner[0, 0] + b * bx + c * cx
    foot[1] = corner[0, 1] + b * by + c * cy
    foot[2] = corner[0, 2] + b * bz + c * cz
    return part
