"""A plane of a scene, drawn: the fluid in it, what is rigid, and the solids."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.patches import PathPatch
from scipy.ndimage import distance_transform_edt

from petfsi.fields.mac.grid.kinds import FLUID, OBSTACLE, OUTSIDE, SOLID
from petfsi.output.frames import Frame
from petfsi.output.slices import Plane, cut_tetrahedra
from petfsi.output.stage import Stage, images
from petfsi.output.surroundings import GREY, LINE, draw_obstacles, draw_sides, filled

#: The colours of bodies, in turn, and of a fluid that is not coloured.
BODIES = ("#f3dcbd", "#c7dff0", "#d5ecc9", "#f2cdd6", "#e0d3ee")
WATER = "#dfe8f1"
#: More edges than this are a dark stain, not a mesh.
_MANY_EDGES = 6000
#: Arrows along the longer side of a plane.
_ARROWS = 30


def draw_plane(ax: Axes, stage: Stage, frame: Frame, plane: Plane) -> ScalarMappable | None:
    """Draw what lies in a plane, and label it; return what a colour bar needs, None where nothing is coloured."""
    fluid = _draw_cells(ax, stage, frame, plane) if stage.grid else _draw_particles(ax, stage, frame, plane)
    if stage.around:
        draw_obstacles(ax, stage.around, plane)
        if not stage.grid:
            draw_sides(ax, stage.around, plane)
    solid = None
    for points in images(frame.points, stage.around):
        solid = _draw_solids(ax, stage, frame, points, plane)
    _finish(ax, stage, plane)
    return solid if stage.of_solids else fluid


def palette(body: np.ndarray) -> np.ndarray:
    """Return the colours of bodies by their numbers."""
    return np.array([to_rgb(colour) for colour in BODIES])[body % len(BODIES)]


def scale_of(stage: Stage) -> dict[str, Any]:
    """Return the scale of colours as Matplotlib's artists want it.

    With a norm of its own: those who watch one are miscounted where pictures that share it are collected.
    """
    return {"cmap": stage.look.colours, "norm": deepcopy(stage.norm)}


# ---- fluid --------------------------------------------------------------------------------------------------


def _draw_particles(ax: Axes, stage: Stage, frame: Frame, plane: Plane) -> ScalarMappable | None:
    """Draw the particles as disks as wide as they are apart; of space those less than that away from the plane."""
    if not frame.particles:
        return None
    x, values = frame.particles["points"], stage.fluid_values(frame)
    if plane.at is not None:
        distance = np.abs(x[:, plane.axis] - plane.at)
        near = np.argsort(-distance, kind="stable")  # the nearest on top
        near = near[distance[near] <= stage.spacing]
        x, values = x[near], None if values is None else values[near]
    style: dict[str, Any] = {"facecolors": WATER} if values is None else {"array": values, **scale_of(stage)}
    size = [stage.spacing]
    places: dict[str, Any] = {"units": "xy", "offsets": x[:, list(plane.across)], "offset_transform": ax.transData}
    disks = EllipseCollection(size, size, [0.0], linewidths=0.0, **places, **style)
    ax.add_collection(disks, autolim=False)
    return disks


def _draw_cells(ax: Axes, stage: Stage, frame: Frame, plane: Plane) -> ScalarMappable | None:
    """Draw the cells of a plane; return what a colour bar needs."""
    values, kind, flow = stage.fluid_values(frame), frame.fluid.get("kind"), frame.fluid.get("velocity")
    if plane.at is not None and stage.grid:
        axis = 3 - sum(plane.across)
        index = int(np.clip((plane.at - stage.low[axis]) / stage.grid.spacing[axis], 0, stage.grid.cells[axis] - 1))
        values, kind, flow = (None if a is None else np.take(a, index, axis=axis) for a in (values, kind, flow))
    if values is None:
        ax.set_facecolor(WATER)
        return None
    a, b = plane.across
    extent = (stage.low[a], stage.high[a], stage.low[b], stage.high[b])
    style: dict[str, Any] = {"origin": "lower", "extent": extent, "aspect": "auto", "interpolation": "nearest"}
    image = ax.imshow(_beneath(values, kind, stage).T, **scale_of(stage), **style)
    if kind is not None:
        if not stage.around:  # nobody knows the true shape of what is rigid
            rigid = np.where((kind == OBSTACLE) | (kind == OUTSIDE), 1.0, np.nan)
            ax.imshow(rigid.T, cmap=ListedColormap([GREY]), **style)
        if flow is not None and stage.shown == "speed":
            wet = np.where((kind == FLUID)[..., None], flow, np.nan)
            _draw_arrows(ax, stage, wet[..., list(plane.across)], plane)
    return image


def _beneath(values: np.ndarray, kind: np.ndarray | None, stage: Stage) -> np.ndarray:
    """Return values that go on beneath what is drawn over them with its true outline, instead of leaving stairs."""
    if kind is None or not np.any(np.isfinite(values)):
        return values
    covered = (kind == SOLID) | (kind == FLUID) | ((kind == OBSTACLE) if stage.around else False)
    nearest = distance_transform_edt(~np.isfinite(values), return_distances=False, return_indices=True)
    return np.where(covered, values[tuple(nearest)], values)


def _draw_arrows(ax: Axes, stage: Stage, flow: np.ndarray, plane: Plane) -> None:
    """Draw the velocity in a plane by some arrows, as long as their spacing where the flow is fastest."""
    a, b = plane.across
    extent = (stage.high - stage.low)[[a, b]]
    gap = float(np.max(extent * stage.stretch[[a, b]])) / _ARROWS
    places = []
    for n, axis in enumerate((a, b)):
        count = flow.shape[n]
        every = max(1, round(gap / stage.stretch[axis] * count / extent[n]))
        places.append(np.arange((every - 1) // 2 if every < count else count // 2, count, every))
    some = flow[np.ix_(*places)]
    sides = [stage.low[axis] + extent[n] * (places[n] + 0.5) / flow.shape[n] for n, axis in enumerate((a, b))]
    style: dict[str, Any] = {
        "color": "white",
        "alpha": 0.6,
        "width": 0.0018,
        "angles": "xy",
        "scale_units": "x",
        "pivot": "mid",
        "zorder": 0.5,
    }
    scale = stage.norm.vmax * stage.stretch[a] / (1.3 * gap)
    ax.quiver(*sides, some[..., 0].T, some[..., 1].T, scale=scale, **style)


# ---- solids -------------------------------------------------------------------------------------------------


def _draw_solids(ax: Axes, stage: Stage, frame: Frame, points: np.ndarray, plane: Plane) -> ScalarMappable | None:
    """Draw the solids' elements, their outline, and nothing in cavities that are empty."""
    solids = stage.solids
    if len(solids.hollow):
        empty = filled(plane.cut(points, solids.hollow))
        ax.add_patch(PathPatch(empty, facecolor="white", edgecolor="none", zorder=0.7))
    values = stage.solid_values(frame)
    if plane.at is None:
        polygons, owners = list(points[solids.cells]), np.arange(len(solids.cells))
        if values is not None:
            shading: Any = {"shading": "gouraud", **scale_of(stage)}
            x, y = points.T
            drawn = ax.tripcolor(x, y, values, triangles=solids.cells, **shading)
            ax.add_collection(LineCollection(list(points[solids.border]), colors=LINE, lw=1.1))
            return drawn
    else:
        polygons, owners = cut_tetrahedra(points, solids.cells, 3 - sum(plane.across), plane.at)
    style: dict[str, Any] = {"lw": 0.3}
    if values is None:
        colours = palette(solids.body)[owners]
        style |= {"facecolors": colours, "edgecolors": colours if 3 * len(polygons) >= _MANY_EDGES else LINE}
    else:
        # an edge in the colour of the face closes the hairlines between neighbours
        style |= {"array": values[solids.cells].mean(axis=1)[owners], "edgecolors": "face", **scale_of(stage)}
    drawn = ax.add_collection(PolyCollection(polygons, **style))
    outline = [np.vstack((loop, loop[:1])) for loop in plane.cut(points, solids.border)]
    ax.add_collection(LineCollection(outline, colors=LINE, lw=1.1))
    return drawn if values is not None else None


def _finish(ax: Axes, stage: Stage, plane: Plane) -> None:
    a, b = plane.across
    ax.set(xlim=(stage.low[a], stage.high[a]), ylim=(stage.low[b], stage.high[b]))
    ax.set_aspect(stage.stretch[b] / stage.stretch[a])
    ax.set(xlabel=f"{'xyz'[a]}, m", ylabel=f"{'xyz'[b]}, m")
