"""What is the same in all pictures of a run: what is seen, what is coloured, and by which scale."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize
from scipy.spatial import KDTree

from petfsi.errors import InputError
from petfsi.geometry.surfaces import boundary_facets, shells
from petfsi.output import hdf5
from petfsi.output.frames import Frame, read_frame
from petfsi.output.quantities import (
    QUANTITIES,
    Quantity,
    cell_values,
    of_solids,
    offered,
    particle_values,
    shown_as,
    solid_values,
)
from petfsi.output.surroundings import Surroundings, read_surroundings
from petfsi.output.xdmf import GridInfo

#: The share of an output time's particles, in per cent, whose colour may lie off either end of the scale: the
#: pressure of a few that meet a wall would leave the rest in one colour. So would the vorticity at a body's corners.
_STRAYS = 1.0
#: Around the domain or the bodies, as a part of the longest side.
_MARGIN, _DOMAIN_MARGIN = 0.06, 0.02
#: And around a domain at most this part of each side.
_THIN = 0.1
#: What is seen is drawn at most so many times as long as wide: beyond that its short sides are stretched.
_LONGEST = 10.0


@dataclass(frozen=True)
class Solids:
    """What never changes of the solids.

    Attributes
    ----------
    cells, body : ndarray of int
        Their elements and whose they are.
    border : ndarray of int, shape (n_facets, dim)
        Their surface.
    hollow : ndarray of int, shape (m, dim)
        Of it what bounds closed cavities that hold nothing.
    """

    cells: np.ndarray
    body: np.ndarray
    border: np.ndarray
    hollow: np.ndarray


@dataclass(frozen=True)
class Stage:
    """What is the same in all pictures.

    Attributes
    ----------
    grid : GridInfo or None
        The fluid's.
    solids : Solids
    low, high : ndarray, shape (dim,)
        The corners of what is seen, m.
    middle : ndarray, shape (dim,)
        Where space is cut when there is no solid: the middle of what is seen, or of particles their mean place, m.
    shown : str
        What is coloured, of ``QUANTITIES``.
    of_solids : bool
        Whether it is the solids that are, rather than the fluid.
    norm : Normalize
        The scale of colours.
    extend : str
        At which ends of the scale there is more, as Matplotlib calls it.
    spacing : float
        The diameter of the particles, m.
    around : Surroundings or None
        What stands still around the fluid.
    """

    grid: GridInfo | None
    solids: Solids
    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray
    shown: str
    of_solids: bool
    norm: Normalize
    extend: str = "neither"
    spacing: float = 0.0
    around: Surroundings | None = None

    @property
    def dim(self) -> int:
        """Of space."""
        return len(self.low)

    @property
    def look(self) -> Quantity:
        """How what is coloured is shown."""
        return shown_as(self.shown, self.dim)

    @property
    def stretch(self) -> np.ndarray:
        """How many times as large as the longest side every axis is drawn."""
        extent = self.high - self.low
        return np.maximum(1.0, extent.max() / (_LONGEST * extent))

    def fluid_values(self, frame: Frame) -> np.ndarray | None:
        """Return what is coloured of every cell or particle; None if that is no fluid."""
        return None if self.of_solids else _fluid_values(frame, self.shown, self.grid, self.solids, self.around)

    def solid_values(self, frame: Frame) -> np.ndarray | None:
        """Return what is coloured of every node of the solids; None if these are not."""
        return solid_values(frame, self.shown) if self.of_solids else None


def images(points: np.ndarray | None, around: Surroundings | None) -> list[np.ndarray]:
    """Return the solids' points wherever they are seen; none where there are no solids."""
    if points is None:
        return []
    return around.images(points) if around else [points]


def _fluid_values(
    frame: Frame, name: str, grid: GridInfo | None, solids: Solids, around: Surroundings | None
) -> np.ndarray | None:
    if frame.particles:
        return particle_values(frame, name)
    if grid is None:
        return None
    periodic = around.periodic if around else (False,) * len(grid.cells)
    walls = [(points, solids.border) for points in images(frame.points, around)]
    for obstacle in around.obstacles if around else ():
        walls += [(points, obstacle.facets) for points in around.images(obstacle.points)] if around else []
    return cell_values(frame, name, grid, periodic, walls)


def look_through(directory: Path, paths: Sequence[Path], quantity: str | None = None) -> Stage:
    """Look through all files once, so that colours and frames mean the same in all pictures.

    Parameters
    ----------
    directory : Path
        The run's.
    paths : sequence of Path
        Files of its ``fields/``.
    quantity : str, optional
        What to colour; by default the first of ``QUANTITIES`` that varies.

    Raises
    ------
    InputError
        When the run has no such thing, or nothing that can be seen.
    """
    with hdf5.reading(directory / "fields" / "mesh.h5") as file:
        grid = (
            GridInfo(*(json.loads(file.attrs[k]) for k in ("origin", "spacing", "cells"))) if "grid" in file else None
        )
        stored = {name: file[f"solid/{name}"][()] for name in ("reference", "cells", "body") if "solid" in file}
    around = read_surroundings(directory)
    none = np.zeros((0, 2), dtype=np.int32)
    solids = _solids(**stored, void=around.void if around else ()) if stored else Solids(none, none[:, 0], none, none)
    seen = _Seen(grid, solids, around, quantity)
    for frame in map(read_frame, paths):
        seen.add(frame)
    if quantity is not None and quantity not in seen.offered:
        has = " and ".join(name for name in QUANTITIES if name in seen.offered) or "nothing"
        raise InputError(f"--quantity {quantity}: the fields in {directory} have {has} to show")
    low, high = _view(grid, around, seen, directory)
    shown, norm = _choose(seen.ranges, quantity, len(low))
    of_solids = seen.offered.get(shown, False)
    extend = "neither"
    if not of_solids and (seen.particles or shown == "vorticity"):
        extend = "both" if norm.vmin else "max"
    spacing = around.spacing if around else seen.spacing
    middle = np.mean(seen.means, axis=0) if seen.means else 0.5 * (low + high)
    return Stage(grid, solids, low, high, middle, shown, of_solids, norm, extend, spacing, around)


def _solids(reference: np.ndarray, cells: np.ndarray, body: np.ndarray, void: Sequence[int]) -> Solids:
    border = boundary_facets(reference, cells)
    of_point = np.zeros(len(reference), dtype=np.int64)
    of_point[cells] = body[:, None]
    own = border[np.isin(of_point[border[:, 0]], void)]
    label, volume = shells(reference, own)
    return Solids(cells, body, border, own[volume[label] < 0.0])


class _Seen:
    """What has been seen of the output times so far."""

    def __init__(
        self, grid: GridInfo | None, solids: Solids, around: Surroundings | None, quantity: str | None
    ) -> None:
        self.scenery, self.quantity = (grid, solids, around), quantity
        #: What there is to be shown, and whether of solids.
        self.offered: dict[str, bool] = {}
        self.ranges: dict[str, list[tuple[float, float]]] = {}
        self.boxes: list[tuple[np.ndarray, np.ndarray]] = []
        self.means: list[np.ndarray] = []
        self.particles = False
        self.spacing = 0.0

    def add(self, frame: Frame) -> None:
        found = {name: of_solids(name, frame) for name in offered(frame)}
        self.offered |= found
        # others than these are shown to those who ask
        usual = ("displacement",) if all(found.values()) else ("smoke", "speed", "pressure")
        for name in usual if self.quantity is None else (self.quantity,):
            if name in found:
                self._add_range(name, frame, found[name])
        if frame.points is not None:
            self.boxes.append((frame.points.min(axis=0), frame.points.max(axis=0)))
        if frame.particles:
            self._add_particles(frame.particles["points"])

    def _add_range(self, name: str, frame: Frame, solids: bool) -> None:
        values = solid_values(frame, name) if solids else _fluid_values(frame, name, *self.scenery)
        if values is None or not np.isfinite(values).any():
            return
        low, high = np.nanmin(values), np.nanmax(values)
        if not solids and (frame.particles or name == "vorticity"):
            most = np.nanpercentile(values, (_STRAYS, 100.0 - _STRAYS))
            low, high = most if most[1] > most[0] else (low, high)
        self.ranges.setdefault(name, []).append((float(low), float(high)))

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
    margin = np.minimum(part * np.max(high - low), _THIN * (high - low) if around else np.inf)
    return low - margin, high + margin


def _choose(ranges: dict[str, list[tuple[float, float]]], wanted: str | None, dim: int) -> tuple[str, Normalize]:
    """Return what was asked for, or the first quantity that varies, in space or time, and its colour scale."""
    shown, low, high = wanted or "pressure", 0.0, 0.0
    for name, extremes in sorted(ranges.items(), key=lambda item: list(QUANTITIES).index(item[0])):
        if wanted not in (None, name):
            continue
        shown, low, high = name, min(e[0] for e in extremes), max(e[1] for e in extremes)
        if high - low > max(QUANTITIES[name].least, 1e-9 * abs(high)):
            break
    if shown_as(shown, dim).signed:
        top = max(-low, high) or 1.0
        return shown, Normalize(-top, top)
    if shown != "pressure":
        low = min(low, 0.0)
    return shown, Normalize(low, high if high > low else low + 1.0)
