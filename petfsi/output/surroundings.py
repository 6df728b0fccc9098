"""What stands still around a fluid, for pictures: the sides of its domain, the obstacles in it, and what is empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from petfsi.errors import InputError
from petfsi.geometry.obstacles import obstacle_surface
from petfsi.output.slices import Plane
from petfsi.scene.load import load_scene
from petfsi.scene.schema import Obstacle, Scene

#: The sides of each axis, lower and upper.
_SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))
#: How sides are drawn that are no walls; walls are drawn through, and those with an inflow dash-dotted.
_NO_WALL = {"open": "dashed", "hydrostatic": "dashed", "periodic": "dotted"}
#: The colours of lines and of what is rigid, which is hatched: some scale of colours has every grey.
LINE, GREY, HATCH = "#4a3b2c", "#8c8c8c", "#737373"
#: Round obstacles are drawn by facets of at most these parts of the longest and of the shortest side of the domain.
_FINE = {2: (1 / 400, 1 / 40), 3: (1 / 60, 1 / 20)}


@dataclass(frozen=True)
class Rigid:
    """An obstacle's closed surface, as ``obstacle_surface`` gives it; a container is solid outside of it."""

    points: np.ndarray
    facets: np.ndarray
    outside: bool


@dataclass(frozen=True)
class Surroundings:
    """The domain of a fluid.

    Attributes
    ----------
    low, high : ndarray, shape (dim,)
        Its corners, m.
    spacing : float
        The particles', or the grid's finest, m.
    styles : tuple of pairs of str
        How the lower and upper side of each axis are drawn, as Matplotlib calls it.
    periodic : tuple of bool
        The axes along which it repeats.
    obstacles : tuple of Rigid
    void : tuple of int
        The solids, as numbered in the scene, whose closed cavities are empty.
    """

    low: np.ndarray
    high: np.ndarray
    spacing: float
    styles: tuple[tuple[str, str], ...]
    periodic: tuple[bool, ...]
    obstacles: tuple[Rigid, ...]
    void: tuple[int, ...] = ()

    def images(self, points: np.ndarray) -> list[np.ndarray]:
        """Return points moved so that what they enclose is seen wherever it is in the domain.

        That is once, where they are, unless the domain repeats.
        """
        size = self.high - self.low
        # how often they may be moved back and forth until they no longer meet the domain
        first = np.ceil((self.low - points.max(axis=0)) / size).astype(int) * self.periodic
        last = np.floor((self.high - points.min(axis=0)) / size).astype(int) * self.periodic
        return [points + size * (first + turn) for turn in np.ndindex(*np.maximum(last - first + 1, 0))]


def scene_of(directory: Path) -> Scene | None:
    """Return a run's scene; None of a directory without one."""
    path = Path(directory) / "scene.toml"
    return load_scene(path) if path.exists() else None


def read_surroundings(directory: Path) -> Surroundings | None:
    """Return the surroundings in a run's scene; None of a directory without one, or of a scene without a fluid."""
    scene = scene_of(directory)
    return None if scene is None or scene.fluid is None else surroundings_of(scene)


def surroundings_of(scene: Any) -> Surroundings:
    """Return the surroundings in a scene whose fluid has ``origin``, ``size``, ``resolution`` and ``sides``."""
    fluid, dim = scene.fluid, scene.dim
    low = np.array(fluid.origin, dtype=float)
    high = low + np.array(fluid.size, dtype=float)
    sides = [[getattr(fluid.sides, side, "slip") for side in pair] for pair in _SIDES[:dim]]
    periodic = tuple(lower == "periodic" for lower, _ in sides)
    obstacles = []
    for name, obstacle in scene.obstacles.items():
        where = (f"obstacles.{name}.shape", scene.directory)
        surface = _surface(obstacle, fluid.resolution, low, high, *where, periodic)
        obstacles.append(Rigid(*surface, obstacle.outside))
    styles = tuple((_style(lower), _style(upper)) for lower, upper in sides)
    void = tuple(number for number, solid in enumerate(scene.solids.values()) if solid.interior == "void")
    return Surroundings(low, high, fluid.resolution, styles, periodic, tuple(obstacles), void)


def _surface(
    obstacle: Obstacle, spacing: float, low: np.ndarray, high: np.ndarray, key: str, directory: Path,
    periodic: Sequence[bool],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return an obstacle's surface: finer than the fluid's cells have it where these are coarse for a picture."""
    extent, parts = high - low, _FINE[len(low)]
    fine = float(min(parts[0] * extent.max(), parts[1] * extent.min()))
    try:
        return obstacle_surface(obstacle, len(low), fine, low, high, key, directory, periodic)
    except InputError:  # too large for facets that fine; the run has taken it with its own
        return obstacle_surface(obstacle, len(low), spacing, low, high, key, directory, periodic)


def _style(side: Any) -> str:
    if isinstance(side, str):
        return _NO_WALL.get(side, "solid")
    return "dashed" if hasattr(side, "pressure") or hasattr(side, "hydrostatic") else "dashdot"


def draw_obstacles(ax: Axes, around: Surroundings, plane: Plane) -> None:
    """Fill, hatched in grey, what is rigid in a plane."""
    frame = Outline(_frame(around, plane))
    for obstacle in around.obstacles:
        images = around.images(obstacle.points)
        loops = [loop for points in images for loop in plane.cut(points, obstacle.facets)]
        if obstacle.outside:
            loops = [np.asarray(frame.vertices), *_turned(loops, clockwise=True)]
        if loops:
            style = {"facecolor": GREY, "edgecolor": HATCH, "hatch": "////", "lw": 0.8}
            patch = PathPatch(filled(loops), zorder=0.8, **style)
            patch.set_clip_path(frame, ax.transData)  # some reach beyond the domain
            ax.add_patch(patch)


def filled(loops: Sequence[np.ndarray]) -> Outline:
    """Return the outline of what closed lines enclose, those that go the other way being holes."""
    closed = (Outline(np.vstack((loop, loop[:1])), closed=True) for loop in loops)
    return Outline.make_compound_path(*closed)


def draw_sides(ax: Axes, around: Surroundings, plane: Plane) -> None:
    """Draw the sides of the domain: walls drawn through, open sides dashed, periodic dotted, inflows dash-dotted."""
    corner = _frame(around, plane)  # from the lower left on, anticlockwise
    first, second = (around.styles[a] for a in plane.across)
    styles = (second[0], first[1], second[1], first[0])
    lines = [corner[[n, (n + 1) % 4]] for n in range(4)]
    ax.add_collection(LineCollection(lines, colors=LINE, lw=1.4, linestyles=styles, zorder=3))


def _frame(around: Surroundings, plane: Plane) -> np.ndarray:
    a, b = plane.across
    x, y = (around.low[a], around.high[a]), (around.low[b], around.high[b])
    return np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _turned(loops: list[np.ndarray], clockwise: bool) -> list[np.ndarray]:
    """Return loops all reversed if those that enclose the most go the other way."""
    area = sum(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) for x, y in (loop.T for loop in loops))
    return [loop[::-1] for loop in loops] if (area > 0) == clockwise else loops
