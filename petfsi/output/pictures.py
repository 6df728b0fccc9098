"""Pictures of a run: its history, and the scene at every output time."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import LightSource, ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.ndimage import distance_transform_edt

from petfsi.errors import InputError
from petfsi.fields.mac.grid.kinds import FLUID, OBSTACLE, OUTSIDE, SOLID
from petfsi.geometry.surfaces import boundary_facets
from petfsi.output import files
from petfsi.output.fields import field_files
from petfsi.output.history import read_history
from petfsi.output.history_figure import history_figure
from petfsi.output.slices import cut_tetrahedra
from petfsi.output.stage import SHOWN, Frame, Stage, look_through, quantity, read_frame
from petfsi.output.surroundings import GREY, LINE, draw_obstacles, draw_sides, scene_of

#: The colours of bodies, in turn.
BODIES = ("#f3dcbd", "#c7dff0", "#d5ecc9", "#f2cdd6", "#e0d3ee")
#: More edges than this are a dark stain, not a mesh.
_MANY_EDGES = 6000
#: Arrows along the longer side of a plane.
_ARROWS = 30
_DPI = 130
#: What reading and drawing a file of ``fields/`` raise that petfsi has not written.
UNDRAWABLE = (OSError, KeyError, ValueError, TypeError, IndexError, RuntimeError, AttributeError)


def plot_run(directory: Path, every: int = 1, colour: str | None = None) -> list[Path]:
    """Draw ``pictures/history.png`` and ``pictures/NNNNNN.png`` for every K-th output time, and return them.

    Colours and frames mean the same in all of them. Not collective.

    Parameters
    ----------
    directory : Path
        The run's.
    every : int
        Draw every so many output times.
    colour : str, optional
        What is coloured: smoke, speed, pressure or displacement; by default the first of these that varies.

    Raises
    ------
    InputError
        When there is nothing to draw, or a file is damaged.
    """
    directory = Path(directory)
    history, frames = directory / "history.csv", field_files(directory)[::every]
    if not history.exists() and not frames:
        raise InputError(f"{directory} has neither history.csv nor fields, so there is nothing to draw")
    pictures = own_pictures(directory)
    drawn = []
    if history.exists():
        drawn.append(_save(history_figure(read_history(history), scene_of(directory)), pictures / "history.png"))
    if frames:
        try:
            stage = look_through(directory, frames, colour)
            for frame in map(read_frame, frames):
                drawn.append(_save(scene_figure(stage, frame), pictures / f"{frame.step:06d}.png"))
        except UNDRAWABLE as error:
            raise InputError(f"{directory / 'fields'} cannot be drawn: {error}") from error
    return drawn


def own_pictures(directory: Path) -> Path:
    """Return a run's folder of pictures, and make it; InputError where it, or that of its fields, is a link."""
    fields, pictures = directory / "fields", directory / "pictures"
    if fields.is_symlink():
        raise InputError(
            f"{fields} is a link, and petfsi follows none in a run directory; put what it names in its place"
        )
    try:
        files.own_directory(pictures)
    except OSError as error:
        raise InputError(f"{pictures} cannot be written: {files.reason(error)}") from error
    return pictures


def _save(figure: Figure, path: Path) -> Path:
    with open(files.new_file(path), "wb") as file:
        figure.savefig(file, dpi=_DPI, format="png")
    return path


# ---- drawing ------------------------------------------------------------------------------------------------


def scene_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of one output time."""
    return _plane_figure(stage, frame) if stage.dim == 2 else _space_figure(stage, frame)


def _plane_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of a 2D scene."""
    extent = stage.high - stage.low
    scale = min(9.0 / extent[0], 7.5 / extent[1])
    figure = Figure(
        figsize=(max(3.6, extent[0] * scale + 1.9), max(2.6, extent[1] * scale + 1.0)), layout="constrained"
    )
    ax = figure.subplots()
    mappable = _draw_fluid(ax, stage, frame, (0, 1), None)
    if frame.points is not None:
        if mappable:
            many = len(stage.cells) * 3 >= _MANY_EDGES
            _draw_polygons(ax, list(frame.points[stage.cells]), _body_colours(stage), many)
        else:
            style: dict[str, Any] = {"shading": "gouraud", "cmap": SHOWN[stage.shown][1], "norm": deepcopy(stage.norm)}
            x, y = frame.points.T
            mappable = ax.tripcolor(x, y, np.asarray(quantity(frame, stage.shown)), triangles=stage.cells, **style)
        border = boundary_facets(frame.points, stage.cells)
        ax.add_collection(LineCollection(list(frame.points[border]), colors=LINE, lw=1.1))
    _finish(ax, stage, (0, 1))
    ax.set_title(f"t = {frame.time:.4g} s", fontsize="medium")
    if mappable:
        bar: dict[str, Any] = {"label": SHOWN[stage.shown][0], "extend": stage.extend}
        figure.colorbar(mappable, ax=ax, aspect=30, shrink=0.9, **bar)
    return figure


def _space_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of a 3D scene: two slices through the middle of the solids or the fluid, and a view."""
    extent = stage.high - stage.low
    middle = stage.middle
    if frame.points is not None:
        middle = np.clip(frame.points.mean(axis=0), stage.low, stage.high)
    n_panels = 2 if frame.points is None else 3
    height = np.clip(4.4 * max(extent[1], extent[2]) / extent[0], 3.0, 7.0)
    figure = Figure(figsize=(5.0 * n_panels, height + 1.6), layout="constrained")
    places = figure.add_gridspec(1, n_panels)
    mappable, panels = None, []
    for place, across, axis in ((places[0, 0], (0, 1), 2), (places[0, 1], (0, 2), 1)):
        ax = figure.add_subplot(place)
        panels.append(ax)
        mappable = _draw_fluid(ax, stage, frame, across, middle[axis])
        if frame.points is not None:
            polygons, owners = cut_tetrahedra(frame.points, stage.cells, axis, middle[axis])
            _draw_polygons(ax, polygons, _body_colours(stage)[owners], len(polygons) * 3 >= _MANY_EDGES)
        _finish(ax, stage, across)
        ax.set_title(f"t = {frame.time:.4g} s, {'xyz'[axis]} = {middle[axis]:.3g} m", fontsize="medium")
    if frame.points is not None:
        _draw_surface(figure.add_subplot(places[0, 2], projection="3d"), stage, frame.points)
    if mappable:
        bar: dict[str, Any] = {"label": SHOWN[stage.shown][0], "extend": stage.extend}
        figure.colorbar(mappable, ax=panels, shrink=0.6, location="bottom", aspect=50, **bar)
    return figure


def _draw_fluid(
    ax: Axes, stage: Stage, frame: Frame, across: tuple[int, int], at: float | None
) -> ScalarMappable | None:
    """Draw the grid or the particles, and what is rigid, in the plane at ``at``; return what a colour bar needs."""
    if stage.grid:
        return _draw_cells(ax, stage, frame, across, at)
    if stage.around:
        draw_obstacles(ax, stage.around, across, at)
        draw_sides(ax, stage.around, across)
    return _draw_particles(ax, stage, frame, across, at) if frame.particles else None


def _draw_particles(
    ax: Axes, stage: Stage, frame: Frame, across: tuple[int, int], at: float | None
) -> ScalarMappable | None:
    """Draw the particles as disks as wide as they are apart; of space those less than that away from the plane."""
    x, colours = frame.particles["points"], quantity(frame, stage.shown)
    if colours is None:
        return None
    if at is not None:
        distance = np.abs(x[:, 3 - sum(across)] - at)
        near = np.argsort(-distance, kind="stable")  # the nearest on top
        near = near[distance[near] <= stage.spacing]
        x, colours = x[near], colours[near]
    # a norm of its own: those who watch one are miscounted where pictures that share it are collected
    style: dict[str, Any] = {"cmap": SHOWN[stage.shown][1], "norm": deepcopy(stage.norm), "linewidths": 0.0}
    size = [stage.spacing]
    places: dict[str, Any] = {"units": "xy", "offsets": x[:, list(across)], "offset_transform": ax.transData}
    disks = EllipseCollection(size, size, [0.0], array=colours, **places, **style)
    ax.add_collection(disks, autolim=False)
    return disks


def _draw_cells(
    ax: Axes, stage: Stage, frame: Frame, across: tuple[int, int], at: float | None
) -> ScalarMappable | None:
    """Draw the cells of the plane at ``at``, rigid things in grey; return what a colour bar needs."""
    values, kind, flow = quantity(frame, stage.shown), frame.fluid.get("kind"), frame.fluid.get("velocity")
    if at is not None and stage.grid:
        axis = 3 - sum(across)
        index = int(np.clip((at - stage.low[axis]) / stage.grid.spacing[axis], 0, stage.grid.cells[axis] - 1))
        values, kind, flow = (None if a is None else np.take(a, index, axis=axis) for a in (values, kind, flow))
    if values is None:
        return None
    if kind is not None and np.any(kind == SOLID) and np.any(np.isfinite(values)):
        # the solid is drawn over these with its true outline; colour goes on beneath it instead of leaving stairs
        nearest = distance_transform_edt(~np.isfinite(values), return_distances=False, return_indices=True)
        values = np.where(kind == SOLID, values[tuple(nearest)], values)
    a, b = across
    extent = (stage.low[a], stage.high[a], stage.low[b], stage.high[b])
    style: dict[str, Any] = {"origin": "lower", "extent": extent, "aspect": "equal", "interpolation": "nearest"}
    image = ax.imshow(values.T, cmap=SHOWN[stage.shown][1], norm=deepcopy(stage.norm), **style)
    if kind is not None:
        rigid = np.where((kind == OBSTACLE) | (kind == OUTSIDE), 1.0, np.nan)
        ax.imshow(rigid.T, cmap=ListedColormap([GREY]), **style)
        if flow is not None and stage.shown == "speed":
            _draw_arrows(ax, stage, np.where((kind == FLUID)[..., None], flow, np.nan)[..., list(across)], across)
    return image


def _draw_arrows(ax: Axes, stage: Stage, flow: np.ndarray, across: tuple[int, int]) -> None:
    """Draw the velocity in a plane by some arrows, as long as their spacing where the flow is fastest."""
    every = max(1, max(flow.shape[:2]) // _ARROWS)
    sides = [
        np.linspace(stage.low[a], stage.high[a], 2 * flow.shape[n] + 1)[1::2][every // 2 :: every]
        for n, a in enumerate(across)
    ]
    some = flow[every // 2 :: every, every // 2 :: every]
    gap = every * (stage.high[across[0]] - stage.low[across[0]]) / flow.shape[0]
    style: dict[str, Any] = {
        "color": "white",
        "alpha": 0.6,
        "width": 0.0018,
        "angles": "xy",
        "scale_units": "xy",
        "pivot": "mid",
    }
    ax.quiver(*sides, some[..., 0].T, some[..., 1].T, scale=stage.norm.vmax / (1.3 * gap), **style)


def _draw_polygons(ax: Axes, polygons: list[np.ndarray], colours: np.ndarray, many: bool) -> None:
    # an edge in the colour of the face closes the hairlines between neighbours
    ax.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=colours if many else LINE, lw=0.3))


def _draw_surface(ax: Axes3D, stage: Stage, points: np.ndarray) -> None:
    """Draw the solids' surface, shaded, in the box of the grid; y points up, as gravity does in most scenes."""
    body_of_node = np.zeros(len(points), dtype=np.int64)
    body_of_node[stage.cells] = stage.body[:, None]
    facets = boundary_facets(points, stage.cells)
    colours = _palette(body_of_node[facets[:, 0]])
    light = LightSource(azdeg=27, altdeg=34)  # from (0.4, 0.8, 0.6)
    style: dict[str, Any] = {
        "facecolors": colours,
        "edgecolors": colours,
        "lw": 0.2,
        "shade": True,
        "lightsource": light,
    }
    ax.add_collection3d(Poly3DCollection(points[facets], **style))
    ax.set(xlim=(stage.low[0], stage.high[0]), ylim=(stage.low[1], stage.high[1]), zlim=(stage.low[2], stage.high[2]))
    ax.view_init(elev=20, azim=30, vertical_axis="y")
    ax.set_box_aspect(stage.high - stage.low)  # after view_init, which decides what it means
    ax.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_major_locator(MaxNLocator(4))


def _body_colours(stage: Stage) -> np.ndarray:
    return _palette(stage.body)


def _palette(body: np.ndarray) -> np.ndarray:
    return np.array([to_rgb(colour) for colour in BODIES])[body % len(BODIES)]


def _finish(ax: Axes, stage: Stage, across: tuple[int, int]) -> None:
    a, b = across
    ax.set(xlim=(stage.low[a], stage.high[a]), ylim=(stage.low[b], stage.high[b]), aspect="equal")
    ax.set(xlabel=f"{'xyz'[a]}, m", ylabel=f"{'xyz'[b]}, m")
