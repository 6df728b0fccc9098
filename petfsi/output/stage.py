"""What pictures show: one output time, and what is the same at all of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize
from scipy.spatial import KDTree

from petfsi.errors import InputError
from petfsi.fields.mac.grid.kinds import FLUID
from petfsi.output import hdf5
from petfsi.output.surroundings import Surroundings, read_surroundings
from petfsi.output.xdmf import GridInfo

#: What may be shown, the first that varies by more than so much: label, colours, and that much.
SHOWN = {
    "smoke": ("smoke", "magma", 1e-6),
    "speed": ("speed, m/s", "viridis", 1e-6),
    "pressure": ("pressure, Pa", "cividis", 1e-9),
    "displacement": ("displacement, m", "viridis", 0.0),
}
#: The share of an output time's particles, in per cent, whose colour may lie off either end of the scale: the
#: pressure of a few that meet a wall would leave the rest in one colour.
_STRAYS = 1.0
#: Around the domain or the bodies, as a part of the longest side.
_MARGIN, _DOMAIN_MARGIN = 0.06, 0.02


@dataclass(frozen=True)
class Frame:
    """What one output file holds; cell data as (nx, ny[, nz])."""

    step: int
    time: float
    fluid: dict[str, np.ndarray]
    points: np.ndarray | None = None
    displacement: np.ndarray | None = None
    particles: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """What is the same in all pictures.

    Attributes
    ----------
    grid : GridInfo or None
        The fluid's.
    cells, body : ndarray of int
        The solids' elements and whose they are.
    low, high : ndarray, shape (dim,)
        The corners of what is seen, m.
    middle : ndarray, shape (dim,)
        Where space is cut when there is no solid: the middle of what is seen, or of particles their mean place, m.
    shown : str
        What is coloured, of ``SHOWN``.
    norm : Normalize
        The scale of colours.
    extend : str
        At which ends of the scale there is more, as Matplotlib calls it.
    spacing : float
        The diameter of the particles, m.
    around : Surroundings or None
        Of particles.
    """

    grid: GridInfo | None
    cells: np.ndarray
    body: np.ndarray
    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray
    shown: str
    norm: Normalize
    extend: str = "neither"
    spacing: float = 0.0
    around: Surroundings | None = None

    @property
    def dim(self) -> int:
        """Of space."""
        return len(self.low)


def read_frame(path: Path) -> Frame:
    """Return what a file of ``fields/`` holds."""
    with hdf5.reading(path) as file:
        fluid = {}
        for name, array in file.get("fluid", {}).items():
            data = array[()]
            dim = data.ndim - (name == "velocity")
            fluid[name] = data.transpose([*reversed(range(dim)), *range(dim, data.ndim)])
        solid = file.get("solid")
        points = solid["points"][()] if solid else None
        displacement = solid["displacement"][()] if solid else None
        cloud = file.get("particles", {})
        particles = {name: cloud[name][()] for name in ("points", "velocity", "pressure") if name in cloud}
        return Frame(int(file.attrs["step"]), float(file.attrs["time"]), fluid, points, displacement, particles)


def look_through(directory: Path, paths: Sequence[Path], colour: str | None = None) -> Stage:
    """Look through all files once, so that colours and frames mean the same in all pictures.

    Parameters
    ----------
    directory : Path
        The run's.
    paths : sequence of Path
        Files of its ``fields/``.
    colour : str, optional
        What to show; by default the first of ``SHOWN`` that varies.

    Raises
    ------
    InputError
        When the run has no such thing, or nothing that can be seen.
    """
    with hdf5.reading(directory / "fields" / "mesh.h5") as file:
        grid = (
            GridInfo(*(json.loads(file.attrs[k]) for k in ("origin", "spacing", "cells"))) if "grid" in file else None
        )
        cells = file["solid/cells"][()] if "solid" in file else np.empty((0, 3), dtype=np.int32)
        body = file["solid/body"][()] if "solid" in file else np.empty(0, dtype=np.int32)
    seen = _Seen()
    for frame in map(read_frame, paths):
        seen.add(frame)
    names = ["speed", "pressure"] if seen.particles else ["displacement"]
    if grid:
        names = [name for name in ("smoke", "speed", "pressure") if name in seen.ranges]
    if colour is not None and colour not in names:
        raise InputError(f"--color {colour}: the fields in {directory} have {' and '.join(names) or 'nothing'} to show")
    shown, norm = _choose({name: seen.ranges[name] for name in names if name in seen.ranges}, colour)
    around = read_surroundings(directory) if seen.particles else None
    spacing = around.spacing if around else seen.spacing
    extend = ("both" if norm.vmin else "max") if seen.particles else "neither"
    low, high = _view(grid, around, seen, directory)
    middle = np.mean(seen.means, axis=0) if seen.means else 0.5 * (low + high)
    return Stage(grid, cells, body, low, high, middle, shown, norm, extend, spacing, around)


class _Seen:
    """What has been seen of the output times so far."""

    def __init__(self) -> None:
        self.ranges: dict[str, list[tuple[float, float]]] = {}
        self.boxes: list[tuple[np.ndarray, np.ndarray]] = []
        self.means: list[np.ndarray] = []
        self.particles = False
        self.spacing = 0.0

    def add(self, frame: Frame) -> None:
        for name in SHOWN:
            found = quantity(frame, name)
            if found is not None and np.isfinite(found).any():
                low, high = np.nanmin(found), np.nanmax(found)
                if frame.particles and name != "displacement":
                    low, high = np.nanpercentile(found, (_STRAYS, 100.0 - _STRAYS))
                self.ranges.setdefault(name, []).append((float(low), float(high)))
        if frame.points is not None:
            self.boxes.append((frame.points.min(axis=0), frame.points.max(axis=0)))
        if frame.particles:
            self._add_particles(frame.particles["points"])

    def _add_particles(self, points: np.ndarray) -> None:
        self.particles = True
        if len(points):
            self.boxes.append((points.min(axis=0), points.max(axis=0)))
            self.means.append(points.mean(axis=0))
        if self.spacing == 0.0 and len(points) > 1:
            distance, _ = KDTree(points).query(points, k=2)
            self.spacing = float(np.median(distance[:, 1]))


def _view(
    grid: GridInfo | None, around: Surroundings | None, seen: _Seen, directory: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what is seen."""
    if grid:
        low = np.array(grid.origin)
        return low, low + np.array(grid.spacing) * grid.cells
    if around:
        low, high, part = around.low, around.high, _DOMAIN_MARGIN
    elif seen.boxes:
        low, high = np.min([b[0] for b in seen.boxes], axis=0), np.max([b[1] for b in seen.boxes], axis=0)
        part = _MARGIN
    else:
        raise InputError(f"{directory / 'fields'} has neither a grid nor a solid nor particles, so nothing can be seen")
    margin = part * np.max(high - low)
    return low - margin, high + margin


def _choose(ranges: dict[str, list[tuple[float, float]]], colour: str | None) -> tuple[str, Normalize]:
    """Return what was asked for, or the first quantity that varies, in space or time, and its colour scale."""
    shown, low, high = colour or "pressure", 0.0, 0.0
    for name, extremes in sorted(ranges.items(), key=lambda item: list(SHOWN).index(item[0])):
        if colour not in (None, name):
            continue
        shown, low, high = name, min(e[0] for e in extremes), max(e[1] for e in extremes)
        if high - low > max(SHOWN[name][2], 1e-9 * abs(high)):
            break
    if shown != "pressure":
        low = min(low, 0.0)
    return shown, Normalize(low, high if high > low else low + 1.0)


def quantity(frame: Frame, name: str) -> np.ndarray | None:
    """Return a quantity: NaN where a cell holds no fluid, None where there is no such thing."""
    if name == "displacement":
        return None if frame.displacement is None else np.linalg.norm(frame.displacement, axis=1)
    source = frame.particles or frame.fluid
    if name == "speed":
        found = np.linalg.norm(source["velocity"], axis=-1) if "velocity" in source else None
    else:
        found = source.get(name)
    if found is None or frame.particles:
        return found
    kind = frame.fluid.get("kind", np.zeros(found.shape, dtype=np.uint8))
    return np.where(kind == FLUID, found, np.nan)
