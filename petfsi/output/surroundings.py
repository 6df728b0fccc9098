"""What stands still around particles, for pictures: the sides of their domain and the obstacles in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from petfsi.geometry.obstacles import obstacle_surface
from petfsi.output.slices import section
from petfsi.scene.load import load_scene
from petfsi.scene.schema import Scene

#: The sides of each axis, lower and upper.
_SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))
#: How sides are drawn that are no walls; walls are drawn through, and those with an inflow dash-dotted.
_NO_WALL = {"open": "dashed", "periodic": "dotted"}
#: The colours of lines and of what is rigid.
LINE, GREY = "#4a3b2c", "#8c8c8c"


@dataclass(frozen=True)
class Rigid:
    """An obstacle's closed surface, as ``obstacle_surface`` gives it; a container is solid outside of it."""

    points: np.ndarray
    facets: np.ndarray
    outside: bool


@dataclass(frozen=True)
class Surroundings:
    """A domain of particles.

    Attributes
    ----------
    low, high : ndarray, shape (dim,)
        Its corners, m.
    spacing : float
        The particles', m.
    styles : tuple of pairs of str
        How the lower and upper side of each axis are drawn, as Matplotlib calls it.
    obstacles : tuple of Rigid
    """

    low: np.ndarray
    high: np.ndarray
    spacing: float
    styles: tuple[tuple[str, str], ...]
    obstacles: tuple[Rigid, ...]


def scene_of(directory: Path) -> Scene | None:
    """Return a run's scene; None of a directory without one."""
    path = Path(directory) / "scene.toml"
    return load_scene(path) if path.exists() else None


def read_surroundings(directory: Path) -> Surroundings | None:
    """Return the surroundings in a run's scene; None of a directory without one."""
    scene = scene_of(directory)
    return None if scene is None else surroundings_of(scene)


def surroundings_of(scene: Any) -> Surroundings:
    """Return the surroundings in a scene whose fluid has ``origin``, ``size``, ``spacing`` and ``sides``."""
    fluid, dim = scene.fluid, scene.dim
    low = np.array(fluid.origin, dtype=float)
    high = low + np.array(fluid.size, dtype=float)
    sides = [[getattr(fluid.sides, side, "slip") for side in pair] for pair in _SIDES[:dim]]
    periodic = [lower == "periodic" for lower, _ in sides]
    obstacles = []
    for name, obstacle in scene.obstacles.items():
        where = (f"obstacles.{name}.shape", scene.directory)
        surface = obstacle_surface(obstacle, dim, fluid.spacing, low, high, *where, periodic)
        obstacles.append(Rigid(*surface, obstacle.outside))
    styles = tuple((_style(lower), _style(upper)) for lower, upper in sides)
    return Surroundings(low, high, fluid.spacing, styles, tuple(obstacles))


def _style(side: Any) -> str:
    return _NO_WALL.get(side, "solid") if isinstance(side, str) else "dashdot"


def draw_obstacles(ax: Axes, around: Surroundings, across: tuple[int, int], at: float | None) -> None:
    """Fill in grey what is rigid in a plane: the scene's own, or the one at ``at`` of the axis that is not across."""
    axis = None if at is None else 3 - sum(across)
    for obstacle in around.obstacles:
        loops = section(obstacle.points, obstacle.facets, axis, at or 0.0)
        if obstacle.outside:
            loops = [_frame(around, across), *_turned(loops, clockwise=True)]
        if loops:
            closed = (Outline(np.vstack((loop, loop[:1])), closed=True) for loop in loops)
            patch = PathPatch(Outline.make_compound_path(*closed), facecolor=GREY, edgecolor="none")
            patch.set_clip_path(Outline(_frame(around, across)), ax.transData)  # some reach beyond the domain
            ax.add_patch(patch)


def draw_sides(ax: Axes, around: Surroundings, across: tuple[int, int]) -> None:
    """Draw the sides of the domain: walls drawn through, open sides dashed, periodic dotted, inflows dash-dotted."""
    corner = _frame(around, across)  # from the lower left on, anticlockwise
    first, second = (around.styles[a] for a in across)
    styles = (second[0], first[1], second[1], first[0])
    lines = [corner[[n, (n + 1) % 4]] for n in range(4)]
    ax.add_collection(LineCollection(lines, colors=LINE, lw=1.4, linestyles=styles, zorder=3))


def _frame(around: Surroundings, across: tuple[int, int]) -> np.ndarray:
    a, b = across
    x, y = (around.low[a], around.high[a]), (around.low[b], around.high[b])
    return np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _turned(loops: list[np.ndarray], clockwise: bool) -> list[np.ndarray]:
    """Return loops all reversed if those that enclose the most go the other way."""
    area = sum(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) for x, y in (loop.T for loop in loops))
    return [loop[::-1] for loop in loops] if (area > 0) == clockwise else loops
