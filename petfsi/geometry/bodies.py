"""The solids of a scene as meshes, and where they may stand."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from petfsi.errors import InputError
from petfsi.geometry.beams import axis_mesh
from petfsi.geometry.meshes import build_mesh, read_surface
from petfsi.geometry.places import Tags, located, located_facets, read_tags
from petfsi.geometry.shapes import bounds, inside
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.checks import check_inside_grid
from petfsi.scene.schema import Obstacle, Scene
from petfsi.scene.shape_checks import images, may_meet, periods
from petfsi.scene.solids import Solid

Mesh = tuple[np.ndarray, np.ndarray]

#: Segments cross if they do so by more than this part of their length.
TOUCH = 1e-9


def build_bodies(scene: Scene) -> dict[str, Mesh]:
    """Return points and cells of every solid. Not collective.

    Raises
    ------
    InputError
        With every mesh that is not fit for a computation, and every body that starts outside the fluid's grid, in
        an obstacle or in another body.
    """
    meshes: dict[str, Mesh] = {}
    clamped: dict[str, np.ndarray] = {}
    mistakes: list[str] = []
    for name, solid in scene.solids.items():
        key = f"solids.{name}"
        try:
            mesh = build_mesh(solid, scene.dim, key, scene.directory)
            check_inside_grid(scene, f"{key}.shape", mesh[0])
            tags = read_tags(solid, scene.dim, key, scene.directory)
            nowhere = _places(solid, mesh, key, tags)
            mistakes += nowhere
            if not nowhere:
                clamped[name] = _clamped(solid, mesh[0], tags)
                meshes[name] = mesh
        except InputError as error:
            mistakes.append(str(error))
    mistakes += _in_obstacles(scene, meshes, clamped)
    mistakes += _in_each_other(meshes, periods(scene.fluid, scene.dim))
    if mistakes:
        raise InputError("\n".join(mistakes))
    return meshes


def read_files(scene: Scene) -> tuple[dict[str, Mesh], list[str]]:
    """Return the meshes of solids from files, and what a user should know of how files are read. Not collective.

    Those of obstacles are read for the latter.
    """
    meshes: dict[str, Mesh] = {}
    notes: list[str] = []
    for name, solid in scene.solids.items():
        if solid.shape.mesh is not None:
            meshes[name] = build_mesh(solid, scene.dim, f"solids.{name}", scene.directory, notes)
    for name, obstacle in scene.obstacles.items():
        if obstacle.shape.mesh is not None:
            read_surface(obstacle.shape, scene.dim, f"obstacles.{name}.shape", scene.directory, notes)
    return meshes, notes


def _places(solid: Solid, mesh: Mesh, key: str, tags: Tags) -> list[str]:
    """Return a sentence for every support and every load that finds nothing to act on."""
    points, facets = _held_points(solid, mesh[0]), mesh[1][:0, :-1]
    if solid.shape.beam is not None:
        facets = axis_mesh(solid.shape.beam)[1]
    elif solid.loads:
        facets = boundary_facets(*mesh)
    mistakes = []
    for n, support in enumerate(solid.supports):
        try:
            located(support.where, points, f"{key}.supports.{n}", tags)
        except InputError as error:
            mistakes.append(str(error))
    for n, load in enumerate(solid.loads):
        try:
            if load.where is not None:
                located_facets(load.where, points, facets, f"{key}.loads.{n}", tags)
            if load.at is not None:
                _check_near(np.array(load.at), mesh, f"{key}.loads.{n}")
        except InputError as error:
            mistakes.append(str(error))
    return mistakes


def far_probes(scene: Scene) -> list[str]:
    """Return a sentence for every probe of a solid that lies far outside it. Not collective; builds what is probed."""
    found, meshes = [], {}
    for name, probe in scene.probes.items():
        solid = scene.solids.get(probe.of)
        if solid is None or probe.at is None or solid.shape.beam is not None:
            continue
        if probe.of not in meshes:
            meshes[probe.of] = build_mesh(solid, scene.dim, f"solids.{probe.of}", scene.directory)
        try:
            _check_near(np.array(probe.at), meshes[probe.of], f"probes.{name}")
        except InputError as error:
            found.append(str(error))
    return found


def _check_near(at: np.ndarray, mesh: Mesh, key: str) -> None:
    """Raise if a point is farther from every node than the longest edge: then it is in no element either."""
    points, cells = mesh
    edges = np.linalg.norm(points[cells] - points[np.roll(cells, 1, axis=1)], axis=-1)
    distance = float(np.linalg.norm(points - at, axis=1).min())
    if distance > edges.max():
        raise InputError(f"{key}.at = {at.tolist()}: lies {distance:g} m away from the solid's nearest node")


def _held_points(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Return what supports hold: the points of a mesh, of a beam those of its axis."""
    return points if solid.shape.beam is None else axis_mesh(solid.shape.beam)[0]


# ---- apart from each other ----------------------------------------------------------------------------------


def _in_obstacles(scene: Scene, meshes: dict[str, Mesh], clamped: dict[str, np.ndarray]) -> list[str]:
    """Return a sentence for every body in an obstacle; it is tested where the cells have their centres.

    Cells at ``clamped`` nodes may reach in.
    """
    found = []
    for obstacle_name, obstacle in scene.obstacles.items():
        try:
            for name, (points, cells) in meshes.items():
                free = cells[~clamped[name][cells].any(axis=1)]
                centres = points[free].mean(axis=1)
                key = f"obstacles.{obstacle_name}.shape"
                count = np.count_nonzero(_covers(obstacle, centres, scene, key))
                if count:
                    found.append(
                        f"solids.{name}.shape: overlaps obstacles.{obstacle_name} with {count} of {len(cells)} cells; "
                        "a solid must lie beside obstacles (cells at nodes that are held on all axes may reach in)"
                    )
        except InputError as error:
            found.append(str(error))
    return found


def _clamped(solid: Solid, points: np.ndarray, tags: Tags) -> np.ndarray:
    """Return which points are held on all axes (of a beam those at nodes that do not turn either), as in a wall."""
    components = "xyz"[: points.shape[1]] if solid.shape.beam is None else ("x", "y", "angle")
    nodes = _held_points(solid, points)
    held = np.zeros((len(nodes), len(components)), dtype=bool)
    for support in solid.supports:
        where = located(support.where, nodes, "supports", tags)
        for component in support.fix:
            held[where, components.index(component)] = True
    return np.repeat(held.all(axis=1), len(points) // len(nodes))


def _covers(obstacle: Obstacle, points: np.ndarray, scene: Scene, key: str) -> np.ndarray:
    covered = np.zeros(len(points), dtype=bool)
    if not len(points):
        return covered
    surface, reach = None, bounds(obstacle.shape)
    if obstacle.shape.mesh is not None:
        surface = read_surface(obstacle.shape, scene.dim, key, scene.directory)
        reach = surface[0].min(axis=0), surface[0].max(axis=0)
    shifts = [np.zeros(scene.dim)]
    if reach is not None:
        shifts = images(periods(scene.fluid, scene.dim), reach, (points.min(axis=0), points.max(axis=0)))
    for shift in shifts:
        at = points - shift
        covered |= inside(obstacle.shape, at) if surface is None else enclosed(*surface, at)
    return covered != obstacle.outside


def _in_each_other(meshes: dict[str, Mesh], period: np.ndarray) -> list[str]:
    """Return a sentence for every pair of bodies that share material, or whose images do."""
    found = []
    names = list(meshes)
    lows = np.array([points.min(axis=0) for points, _ in meshes.values()]).reshape(-1, len(period))
    highs = np.array([points.max(axis=0) for points, _ in meshes.values()]).reshape(-1, len(period))
    for i, j in may_meet(lows, highs, period):
        first, second = names[i], names[j]
        (points, cells), other = meshes[first], meshes[second]
        reach, other_reach = (lows[i], highs[i]), (lows[j], highs[j])
        pairs = [((points + shift, cells), other) for shift in images(period, reach, other_reach)]
        count = sum(_covered_cells(*pair) + _covered_cells(*reversed(pair)) for pair in pairs)
        if count or any(_cross(*pair) for pair in pairs):
            how = f"{count} cells" if count else "their outlines cross"
            found.append(f"solids.{second}.shape: overlaps solids.{first} ({how}); bodies must lie apart")
    return found


def _covered_cells(one: Mesh, other: Mesh) -> int:
    """Return how many cells of a body have their centres in another one."""
    centres = one[0][one[1]].mean(axis=1)
    if _apart(centres, other[0]):
        return 0
    return int(np.count_nonzero(enclosed(other[0], boundary_facets(*other), centres)))


def _cross(one: Mesh, other: Mesh) -> bool:
    """Whether the outlines of two bodies in the plane cross: no centre of slender ones need be in the other."""
    if one[0].shape[1] != 2 or _apart(one[0], other[0]):
        return False
    segments = [
        np.ascontiguousarray(points[boundary_facets(points, cells)], dtype=float) for points, cells in (one, other)
    ]
    return bool(_any_crossing(*segments))


def _apart(points: np.ndarray, others: np.ndarray) -> bool:
    below, above = points.max(axis=0) < others.min(axis=0), points.min(axis=0) > others.max(axis=0)
    return bool(np.any(below | above))


def enclosed(points: np.ndarray, facets: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return which of the points ``at`` a closed, oriented surface winds around. Not collective."""
    corners = np.ascontiguousarray(points[facets], dtype=float)
    near = np.all((at >= points.min(axis=0)) & (at <= points.max(axis=0)), axis=1)
    result = np.zeros(len(at), dtype=bool)
    result[near] = np.abs(_windings(corners, np.ascontiguousarray(at[near], dtype=float))) > 0.5
    return result


@njit(cache=True)
def _any_crossing(one, other):
    """Whether any segment of one crosses one of the other by more than round-off; touching is none."""
    for a in one:
        for b in other:
            if _astride(a, b) and _astride(b, a):
                return True
    return False


@njit(cache=True)
def _astride(a, b):
    """Whether the ends of segment b lie on either side of the line through a."""
    tx, ty = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1]
    first = tx * (b[0, 1] - a[0, 1]) - ty * (b[0, 0] - a[0, 0])
    last = tx * (b[1, 1] - a[0, 1]) - ty * (b[1, 0] - a[0, 0])
    least = TOUCH * (tx * tx + ty * ty + (b[1, 0] - b[0, 0]) ** 2 + (b[1, 1] - b[0, 1]) ** 2)
    return (first > least and last < -least) or (first < -least and last > least)


@njit(cache=True)
def _windings(corners, at):
    """Return how often the surface winds around each point: the angle it fills, over that of a full turn."""
    total = np.zeros(len(at))
    two = corners.shape[2] == 2
    for n in range(len(at)):
        for f in range(len(corners)):
            a, b = corners[f, 0] - at[n], corners[f, 1] - at[n]
            if two:
                total[n] += math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
                continue
            c = corners[f, 2] - at[n]
            la, lb, lc = math.sqrt(np.sum(a * a)), math.sqrt(np.sum(b * b)), math.sqrt(np.sum(c * c))
            volume = (
                a[0] * (b[1] * c[2] - b[2] * c[1])
                - a[1] * (b[0] * c[2] - b[2] * c[0])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
            )
            ab, bc, ca = np.sum(a * b), np.sum(b * c), np.sum(c * a)
            total[n] += 2.0 * math.atan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return total / (2.0 * math.pi if two else 4.0 * math.pi)
