"""A scene in space, seen from outside: its particles, its solids and what is rigid, in the box of the fluid."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LightSource, to_rgb
from matplotlib.patches import PathPatch
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection, pathpatch_2d_to_3d
from trimesh.remesh import subdivide_to_size

from petfsi.output.frames import Frame
from petfsi.output.plane import WATER, palette
from petfsi.output.slices import Plane, clip_triangles
from petfsi.output.stage import Stage, images
from petfsi.output.surroundings import GREY, filled

#: Where the viewer stands, in degrees: at the high end of every axis. y points up, as against gravity in most scenes.
_ELEVATION, _AZIMUTH = 20, 30
_VIEWER = np.array([0.4698, 0.3420, 0.8138])
_LIGHT = LightSource(azdeg=27, altdeg=34)  # from (0.4, 0.8, 0.6)
#: The brightest and the darkest that a facet is in that light, as Matplotlib has it.
_BRIGHT, _DARK = 1.0, 0.3
#: Facets have edges of at most this part of the longest side: they are drawn from the farthest to the nearest.
_EDGE = 1 / 12
#: A side shorter than this part of the longest has room for one number.
_SHORT = 0.4
#: What is rigid, before it is shaded.
_STONE = "#bdbdbd"
#: Of what is drawn for a particle; other polygons have as many, some of them in the same place.
_CORNERS = 6
#: How much is seen of a container's far side.
_FAINT = 0.3

#: A closed surface: points, facets and the colour of each.
Painted = tuple[np.ndarray, np.ndarray, np.ndarray]


def draw_space(ax: Axes3D, stage: Stage, frame: Frame) -> None:
    """Draw particles, the surfaces of solids and obstacles, and the far side of containers, in the box of the fluid."""
    ax.computed_zorder = False
    sides = (stage.high - stage.low) * stage.stretch
    surfaces = list(_surfaces(stage, frame))
    polygons, colours = _particles(stage, frame)
    for points, facets, paint in surfaces:
        triangles, of = _in_box(points[facets], stage)
        polygons = np.concatenate((polygons, np.repeat(triangles, _CORNERS // 3, axis=1)))
        colours = np.concatenate((colours, paint[of]))
    if len(polygons):
        ax.add_collection3d(_shaded(polygons, colours, zorder=2.0))
    for room in _rooms(stage):
        ax.add_collection3d(_shaded(room, np.tile((*to_rgb(GREY), _FAINT), (len(room), 1)), zorder=1.0))
    for points, facets, paint in surfaces:
        _close(ax, stage, points, facets, paint)
    ax.set(xlim=(stage.low[0], stage.high[0]), ylim=(stage.low[1], stage.high[1]), zlim=(stage.low[2], stage.high[2]))
    ax.view_init(elev=_ELEVATION, azim=_AZIMUTH, vertical_axis="y")
    # after view_init, which decides what it means
    ax.set_box_aspect(sides, zoom=1.2 - 0.25 * sides.min() / sides.max())
    ax.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    # where two axes meet one of them has no number, lest they overlap
    ends = ((ax.xaxis, "upper", 4.0), (ax.yaxis, "lower", 8.0), (ax.zaxis, "upper", 2.0))
    for (axis, end, gap), part in zip(ends, sides / sides.max(), strict=True):
        axis.set_major_locator(MaxNLocator(max(1, round(4 * part)), prune=end if part > _SHORT else "both"))
        axis.set_tick_params(labelsize="small", pad=1.0)
        axis.labelpad = gap


def _particles(stage: Stage, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return polygons that face the viewer, as wide as particles, and their colours."""
    centres = frame.particles.get("points", np.zeros((0, 3)))
    values = stage.fluid_values(frame)
    aside = np.cross((0.0, 1.0, 0.0), _VIEWER)
    basis = np.array([aside / np.linalg.norm(aside), np.cross(_VIEWER, aside) / np.linalg.norm(aside)])
    angle = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    disk = 0.5 * stage.spacing * np.column_stack((np.cos(angle), np.sin(angle))) @ basis
    if not len(centres) or values is None:
        colours = np.tile(to_rgb(WATER), (len(centres), 1))
    else:
        colours = colormaps[stage.look.colours](stage.norm(values))[:, :3]
    return centres[:, None, :] + disk / stage.stretch, colours


def _surfaces(stage: Stage, frame: Frame) -> Iterator[Painted]:
    """Return the surfaces of solids and obstacles, wherever they repeat."""
    around, solids = stage.around, stage.solids
    if frame.points is not None:
        body = np.zeros(len(frame.points), dtype=np.int64)
        body[solids.cells] = solids.body[:, None]
        values = stage.solid_values(frame)
        if values is None:
            paint = palette(body[solids.border[:, 0]])
        else:
            paint = colormaps[stage.look.colours](stage.norm(values[solids.border].mean(axis=1)))[:, :3]
        for points in images(frame.points, around):
            yield points, solids.border, paint
    if around is None:
        return
    for obstacle in around.obstacles:
        if not obstacle.outside:
            for points in around.images(obstacle.points):
                yield points, obstacle.facets, np.tile(to_rgb(_STONE), (len(obstacle.facets), 1))


def _rooms(stage: Stage) -> Iterator[np.ndarray]:
    """Return the triangles of containers that face the viewer from inside: the far sides."""
    for obstacle in stage.around.obstacles if stage.around else ():
        if obstacle.outside:
            corners = obstacle.points[obstacle.facets]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            yield _in_box(corners[normal @ _VIEWER > 0.0], stage)[0]


def _box(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the fluid's box, or of what is seen."""
    return (stage.around.low, stage.around.high) if stage.around else (stage.low, stage.high)


def _in_box(triangles: np.ndarray, stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Return what of triangles lies in the fluid's box, in small pieces, and which of them each is of."""
    of = np.arange(len(triangles))
    for axis, ends in enumerate(zip(*_box(stage), strict=True)):
        for at, sign in zip(ends, (1.0, -1.0), strict=True):
            triangles, kept = clip_triangles(triangles, axis, at, sign)
            of = of[kept]
    if not len(triangles):
        return triangles, of
    stretch = stage.stretch
    longest = float(np.max((stage.high - stage.low) * stretch)) * _EDGE
    corners = (triangles * stretch).reshape(-1, 3)
    points, facets, kept = subdivide_to_size(
        corners, np.arange(len(corners)).reshape(-1, 3), longest, return_index=True
    )
    return points[facets] / stretch, of[kept]


def _shaded(polygons: np.ndarray, colours: np.ndarray, zorder: float) -> Poly3DCollection:
    style: dict[str, Any] = {"facecolors": colours, "shade": True, "lightsource": _LIGHT, "zorder": zorder}
    if colours.shape[1] == 3:
        style |= {"edgecolors": colours, "lw": 0.2}  # an edge in the colour of the face closes the hairlines
    return Poly3DCollection(polygons, **style)


def _close(ax: Axes3D, stage: Stage, points: np.ndarray, facets: np.ndarray, paint: np.ndarray) -> None:
    """Draw the sections of a surface with those sides of the fluid's box that the viewer sees."""
    low, high = _box(stage)
    for axis in range(3):
        across = (0 if axis else 1, 1 if axis == 2 else 2)
        loops = Plane(across, float(high[axis])).cut(points, facets)
        window = Bbox([[low[a] for a in across], [high[a] for a in across]])
        outline = filled(loops).clip_to_bbox(window) if loops else filled([])
        if not np.size(outline.vertices):
            continue
        bright = _DARK + (_BRIGHT - _DARK) * 0.5 * (1.0 + _LIGHT.direction[axis])
        patch = PathPatch(outline, facecolor=bright * paint.mean(axis=0), lw=0, zorder=3)
        ax.add_patch(patch)
        pathpatch_2d_to_3d(patch, z=high[axis], zdir="xyz"[axis])
