"""Obstacles as closed surfaces of segments or triangles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.balls import unit_ball
from petfsi.geometry.meshes import read_surface
from petfsi.geometry.seams import MEET, Seams, find_seams
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.schema import Obstacle, Scene
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import InflowSide, MovingSide
from petfsi.scene.tables import Ball, Box, Cylinder, Halfspace

#: The most facets that one round obstacle is made of.
MAX_FACETS = 4_000_000
#: A round surface has at least this many facets around.
FEWEST = 8
#: How far a half space reaches beyond what it must cover, as a fraction of the diagonal.
MARGIN = 0.1

SurfaceMesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class ObstacleSurfaces:
    """The surfaces of all obstacles of a scene.

    Attributes
    ----------
    points : ndarray, shape (n, dim)
        m.
    facets : ndarray of int, shape (m, dim)
        Normals point out of what is solid; of a container into its room.
    base : int
        The number of containers: how many solids cover a place far away from all surfaces.
    seams : Seams
        Where they reach around periodic axes.
    """

    points: np.ndarray
    facets: np.ndarray
    base: int
    seams: Seams


def obstacle_surfaces(scene: Scene) -> ObstacleSurfaces:
    """Return the surfaces of a scene's obstacles, one after the other. Not collective; reads mesh files.

    Round ones have facets about as large as the fluid's cells.

    Raises
    ------
    InputError
        With everything that is wrong with mesh files and sizes.
    """
    fluid = scene.fluid
    assert fluid is not None, "only a fluid feels obstacles"
    points, facets, count = [np.zeros((0, scene.dim))], [np.zeros((0, scene.dim), dtype=np.int64)], 0
    for x, f in named_surfaces(scene).values():
        points.append(x)
        facets.append(f + count)
        count += len(x)
    base = sum(obstacle.outside for obstacle in scene.obstacles.values())
    every = np.concatenate(points), np.concatenate(facets)
    return ObstacleSurfaces(*every, base, find_seams(*every, np.array(fluid.size), np.array(_periodic(scene))))


def named_surfaces(scene: Scene) -> dict[str, SurfaceMesh]:
    """Return the surface of each obstacle of a scene with a fluid. Not collective; raises as ``obstacle_surfaces``."""
    fluid = scene.fluid
    assert fluid is not None, "only a fluid feels obstacles"
    low, size, periodic = np.array(fluid.origin), np.array(fluid.size), _periodic(scene)
    found, mistakes = {}, []
    for name, obstacle in scene.obstacles.items():
        where = (f"obstacles.{name}.shape", scene.directory)
        try:
            found[name] = obstacle_surface(obstacle, scene.dim, fluid.resolution, low, low + size, *where, periodic)
            _check_length(found[name][0], size, periodic, where[0])
        except InputError as error:
            mistakes.append(str(error))
    if mistakes:
        raise InputError("\n".join(mistakes))
    return found


def _periodic(scene: Scene) -> list[bool]:
    sides = scene.fluid.sides if scene.fluid is not None else None
    return [getattr(sides, side, None) == "periodic" for side in ("left", "bottom", "back")[: scene.dim]]


def side_walls(scene: Scene) -> dict[str, SurfaceMesh]:
    """Return what stands behind the sides of the fluid's box that are walls: blocks as thick as the box is long.

    They fill the corners between them; beyond an open side there are none. An inflow is a wall unless the rest of its
    side is open.
    """
    fluid = scene.fluid
    if fluid is None:
        return {}
    low, found = np.array(fluid.origin, dtype=float), {}
    high = low + fluid.size
    thick = float(np.linalg.norm(high - low))
    walls = [[_is_wall(getattr(fluid.sides, side)) for side in pair] for pair in OPPOSITE[: scene.dim]]
    begin, end = low - thick * np.array(walls)[:, 0], high + thick * np.array(walls)[:, 1]
    for axis, pair in enumerate(OPPOSITE[: scene.dim]):
        for side, which in zip(pair, (0, 1), strict=True):
            if walls[axis][which]:
                corners = begin.copy(), end.copy()
                corners[1 - which][axis] = (low, high)[which][axis]
                found[side] = _block(corners[0], np.diag(corners[1] - corners[0]))
    return found


def _is_wall(side: str | InflowSide | MovingSide) -> bool:
    if isinstance(side, InflowSide):
        return side.inflow.region is None or side.inflow.rest != "open"
    return side not in ("open", "periodic")


def _check_length(points: np.ndarray, size: np.ndarray, periodic: Sequence[bool], key: str) -> None:
    """Raise if an obstacle would overlap its own images around a periodic axis."""
    length = np.ptp(points, axis=0)
    for axis, longer in zip("xyz", np.array(periodic) & (length > size * (1.0 + MEET)), strict=False):
        if longer:
            a = "xyz".index(axis)
            raise InputError(
                f"{key}: is {length[a]:g} m long along {axis}, which repeats after {size[a]:g} m; what reaches around "
                "a periodic axis must be just so long, or a box, half space or cylinder along it"
            )


def obstacle_surface(
    obstacle: Obstacle,
    dim: int,
    spacing: float,
    low: np.ndarray,
    high: np.ndarray,
    key: str,
    directory: Path,
    periodic: Sequence[bool] | None = None,
) -> SurfaceMesh:
    """Return the closed surface of an obstacle. Not collective.

    Boxes and files are exact. Balls and cylinders have facets with edges of about ``spacing`` and enclose exactly
    the volume (in 2D the area) of the round shape, so their corners lie slightly outside it. A half space is a box
    behind its plane that reaches beyond ``low`` and ``high``.

    Parameters
    ----------
    obstacle : Obstacle
    dim : int
        2 for segments, 3 for triangles.
    spacing : float
        m.
    low, high : ndarray, shape (dim,)
        The corners of the fluid's grid, m.
    key : str
        Where the shape stands in the scene, for messages: ``"obstacles.hull.shape"``.
    directory : Path
        What a mesh file's path is relative to.
    periodic : sequence of bool, optional
        The axes along which the grid, and the obstacle with it, repeats. A box, half space or cylinder that reaches
        through the whole grid along such an axis is as long as the grid: its ends meet.

    Returns
    -------
    points : ndarray, shape (n, dim)
        m.
    facets : ndarray of int, shape (m, dim)
        Normals point out of the obstacle's material: with ``outside``, into the room.
    """
    shape = obstacle.shape
    through = np.zeros(dim, dtype=bool) if periodic is None else np.array(periodic, dtype=bool)
    if shape.box is not None:
        points, facets = _box(shape.box, low, high, through)
    elif shape.ball is not None:
        points, facets = _ball(shape.ball, dim, spacing, f"{key}.ball.radius")
    elif shape.cylinder is not None:
        points, facets = _cylinder(shape.cylinder, low, high, through, spacing, f"{key}.cylinder.radius")
    elif shape.halfspace is not None:
        points, facets = _halfspace(shape.halfspace, low, high, through)
    else:
        points, facets = read_surface(shape, dim, key, directory)
    return points, facets[:, ::-1] if obstacle.outside else facets


# ---- flat ---------------------------------------------------------------------------------------------------


def _box(box: Box, low: np.ndarray, high: np.ndarray, periodic: np.ndarray) -> SurfaceMesh:
    origin, size = np.array(box.origin, dtype=float), np.array(box.size, dtype=float)
    endless = periodic & (size >= (high - low) * (1.0 - MEET))
    origin, size = np.where(endless, low, origin), np.where(endless, high - low, size)
    return _block(origin, np.diag(size))


def _halfspace(halfspace: Halfspace, low: np.ndarray, high: np.ndarray, periodic: np.ndarray) -> SurfaceMesh:
    """Return a box behind the plane, which along periodic axes parallel to the plane is as long as the grid."""
    dim = len(low)
    normal = np.array(halfspace.normal, dtype=float)
    axes = _frame(normal / np.linalg.norm(normal))
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(dim, -1).T
    along = (corners - np.array(halfspace.point)) @ axes.T
    margin = MARGIN * float(np.linalg.norm(high - low))
    start, end = along.min(axis=0) - margin, along.max(axis=0) + margin
    start[0], end[0] = min(start[0], -margin), 0.0
    repeats = (np.abs(axes) > 1.0 - 1e-12) & periodic
    repeats[0] = False
    points, facets = _block(np.array(halfspace.point) + start @ axes, axes * (end - start)[:, None])
    middle = 0.5 * (low + high)
    return np.where(repeats.any(axis=0), np.where(points < middle, low, high), points), facets


def _frame(normal: np.ndarray) -> np.ndarray:
    """Return a right-handed frame, in rows, that begins with a unit vector; the rest lie along axes if they can."""
    if len(normal) == 2:
        return np.array([normal, [-normal[1], normal[0]]])
    first = np.eye(3)[np.argmin(np.abs(normal))]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    return np.array([normal, first, np.cross(normal, first)])


def _block(origin: np.ndarray, edges: np.ndarray) -> SurfaceMesh:
    """Return the surface of the parallelepiped with these (right-handed) edges."""
    dim = len(origin)
    corner = np.array(np.meshgrid(*[[0, 1]] * dim, indexing="ij")).reshape(dim, -1).T
    if dim == 2:
        facets = np.array([[0, 2], [2, 3], [3, 1], [1, 0]])
    else:
        # the sides x = 0, x = 1, y = 0, ... of a cube whose corners are numbered 4 x + 2 y + z
        sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        facets = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in sides]).reshape(-1, 3)
    return origin + corner @ edges, facets


# ---- round --------------------------------------------------------------------------------------------------


def _ball(ball: Ball, dim: int, spacing: float, key: str) -> SurfaceMesh:
    if dim == 2:
        n = _around(ball.radius, spacing)
        _refuse_many(n, ball.radius, key)
        angle = 2.0 * np.pi * np.arange(n) / n
        points = np.column_stack((np.cos(angle), np.sin(angle)))
        facets = np.column_stack((np.arange(n), np.roll(np.arange(n), -1)))
        volume = np.pi
    else:
        # an edge of the icosahedron is 1 / sin(2 pi / 5) times its radius
        n = max(2, math.ceil(ball.radius / (math.sin(0.4 * math.pi) * spacing)))
        _refuse_many(20 * n**2, ball.radius, key)
        points, facets = _icosphere(n)
        volume = 4.0 / 3.0 * np.pi
    factor = (volume / _enclosed_volume(points, facets)) ** (1.0 / dim)
    return np.array(ball.centre) + ball.radius * factor * points, facets


def _around(radius: float, spacing: float) -> int:
    """Return how many facets go around a circle; a multiple of four, so that it looks the same from all sides."""
    return max(FEWEST, 4 * math.ceil(0.5 * math.pi * radius / spacing))


def _refuse_many(count: int, radius: float, key: str) -> None:
    if count > MAX_FACETS:
        raise InputError(
            f"{key} = {radius:g}: its surface needs {count:.2g} facets of the size of the grid's cells, and at most "
            f"{MAX_FACETS:.2g} may be; a half space or a mesh file can stand for so large a shape"
        )


def _enclosed_volume(points: np.ndarray, facets: np.ndarray) -> float:
    dim = points.shape[1]
    return float(np.linalg.det(points[facets]).sum()) / math.factorial(dim)


def _icosphere(n: int) -> SurfaceMesh:
    """Return the icosahedron with every edge cut into n parts and all points moved to the unit sphere."""
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    base = np.array([[0.0, a, b] for a in (-1.0, 1.0) for b in (-golden, golden)])
    corners = np.concatenate([np.roll(base, shift, axis=1) for shift in range(3)])
    triples = np.array([(a, b, c) for c in range(12) for b in range(c) for a in range(b)])
    sides = np.linalg.norm(corners[triples] - corners[np.roll(triples, 1, axis=1)], axis=2)
    faces = triples[np.all(np.isclose(sides, 2.0), axis=1)]
    inward = np.linalg.det(corners[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    i, j = (index.ravel() for index in np.mgrid[: n + 1, : n + 1])
    i, j = i[i + j <= n], j[i + j <= n]
    weights = np.column_stack((n - i - j, i, j))
    points = np.einsum("pc,fca->fpa", weights, corners[faces]).reshape(-1, 3)
    # points on an edge or corner come from several faces: the same corners in the same shares
    share = np.where(weights > 0, faces[:, None, :] * (n + 1) + weights, 0)
    share.sort(axis=2)
    code = np.ravel_multi_index(tuple(share.reshape(-1, 3).T), [12 * (n + 1)] * 3)
    _, first, number = np.unique(code, return_index=True, return_inverse=True)
    points = points[first] / np.linalg.norm(points[first], axis=1, keepdims=True)
    return points, number.ravel()[_within_faces(n, i, j, len(faces))]


def _within_faces(n: int, i: np.ndarray, j: np.ndarray, n_faces: int) -> np.ndarray:
    """Return the small triangles of all faces as places in the list of the faces' points."""
    place = np.full((n + 2, n + 2), -1)
    place[i, j] = np.arange(len(i))
    a, b, c, d = place[i, j], place[i + 1, j], place[i, j + 1], place[i + 1, j + 1]
    upright, turned = np.column_stack((a, b, c)), np.column_stack((b, d, c))
    one = np.concatenate((upright[(b >= 0) & (c >= 0)], turned[d >= 0]))
    return (one + len(i) * np.arange(n_faces)[:, None, None]).reshape(-1, 3)


def _cylinder(
    cylinder: Cylinder, low: np.ndarray, high: np.ndarray, periodic: np.ndarray, spacing: float, key: str
) -> SurfaceMesh:
    """Return caps like meshed disks, and between them rows of triangles."""
    start, end = np.array(cylinder.start, dtype=float), np.array(cylinder.end, dtype=float)
    along = np.abs(end - start)
    endless = periodic & (along >= (high - low) * (1.0 - MEET)) & (along > (1.0 - 1e-12) * np.linalg.norm(along))
    start, end = (np.where(endless, np.where(e > o, low, high), e) for e, o in ((start, end), (end, start)))
    length = float(np.linalg.norm(end - start))
    across = 2 * math.ceil(_around(cylinder.radius, spacing) / 8)
    rows = max(1, math.ceil(length / spacing))
    _refuse_many(4 * across**2 + 8 * across * rows, cylinder.radius, key)
    disk, cells = unit_ball(2, across)
    disk = disk * (cylinder.radius * math.sqrt(np.pi / _enclosed_volume(disk, boundary_facets(disk, cells))))
    axes = _frame((end - start) / length)
    rim = boundary_facets(disk, cells)
    rim = rim[np.argsort(np.arctan2(*disk[rim[:, 0]].T[::-1])), 0]
    # cap, rings, cap: the rings' first and last are the caps' rims
    height = np.linspace(0.0, 1.0, rows + 1)
    rings = disk[rim] @ axes[1:] + (start + height[1:-1, None, None] * (end - start))
    caps = [disk @ axes[1:] + start, disk @ axes[1:] + end]
    points = np.concatenate([caps[0], rings.reshape(-1, 3), caps[1]])
    last = len(points) - len(disk)
    ring = np.concatenate([rim[None], len(disk) + np.arange(rings.size // 3).reshape(-1, len(rim)), last + rim[None]])
    a, b = ring[:-1], np.roll(ring, -1, axis=1)[:-1]
    d, c = ring[1:], np.roll(ring, -1, axis=1)[1:]
    wall = np.concatenate([np.stack((a, b, c), axis=-1).reshape(-1, 3), np.stack((a, c, d), axis=-1).reshape(-1, 3)])
    return points, np.concatenate([cells[:, ::-1], wall, cells + last])
