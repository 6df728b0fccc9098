"""The static surroundings of the fluid: sides of the grid, jets through them, and obstacles."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.mac import kinds
from petfsi.fields.mac.grid import MacGrid
from petfsi.geometry.shapes import bounds, inside
from petfsi.ranks import agreed, on_root
from petfsi.scene.expressions import Expression, evaluate_at, ramp
from petfsi.scene.fluids import GridInflow, GridInflowSide, Side, Sides
from petfsi.scene.schema import Obstacle
from petfsi.scene.shape_checks import images
from petfsi.scene.tables import Shape

T = TypeVar("T")

#: The names of the lower and upper side per axis.
NAMES = (("left", "right"), ("bottom", "top"), ("back", "front"))


def periodic_axes(sides: Sides, dim: int) -> tuple[bool, ...]:
    """Return which axes are periodic; a periodic side without its opposite is an ``InputError``."""
    answer = []
    for axis in range(dim):
        pair = [getattr(sides, name) == "periodic" for name in NAMES[axis]]
        if pair[0] != pair[1]:
            one, other = NAMES[axis] if pair[0] else NAMES[axis][::-1]
            raise InputError(f'fluid.sides.{one} = "periodic": the opposite side, {other}, must be "periodic", too')
        answer.append(pair[0])
    return tuple(answer)


def wrapped_points(grid: MacGrid, axis: int | None, index: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return the points (n, dim) of local faces of ``axis`` (cells: None); ghosts of periodic axes wrapped back."""
    points = np.empty((len(index[0]), grid.dim))
    for b in range(grid.dim):
        i = index[b] + (grid.lo[b] - grid.ghost[b])
        if grid.periodic[b]:
            i = i % grid.cells[b]
        points[:, b] = grid.origin[b] + (i + (0.0 if b == axis else 0.5)) * grid.dx[b]
    return points


@dataclass
class Jet:
    """The local faces, ghosts included, through which an inflow comes.

    Attributes
    ----------
    faces : tuple of ndarray
        Their local indices i, j, k.
    points : ndarray, shape (n, dim)
    value : ndarray, shape (n,)
        Velocity along the axis at the time last evaluated, m/s.
    """

    spec: GridInflow
    key: str
    axis: int
    upper: bool
    faces: tuple[np.ndarray, ...]
    points: np.ndarray
    value: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Start with the jet closed."""
        self.value = np.zeros(len(self.points))
        self._speed = Expression(self.spec.speed, key=f"{self.key}.speed")

    def evaluate(self, time: float) -> None:
        """Set ``value`` for a time."""
        speed = evaluate_at(self._speed, self.points, time)
        self.value[:] = (-1.0 if self.upper else 1.0) * ramp(time, self.spec.ramp) * speed

    def fill_behind(self, cells: np.ndarray, value: float | bool) -> None:
        """Give the ghosts behind the jet a value."""
        view = np.moveaxis(cells, self.axis, 0)
        across = tuple(f for b, f in enumerate(self.faces) if b != self.axis)
        if len(across[0]):
            first = self.faces[self.axis][0]
            view[(slice(first, None) if self.upper else slice(0, first), *across)] = value


class Surroundings:
    """What never moves: which cells are obstacles or outside, and what each face on a side does.

    Attributes
    ----------
    cell_kind : ndarray of uint8
        Cell array of FLUID, OBSTACLE and OUTSIDE, valid in all ghosts.
    side_kind : list of ndarray of uint8
        Face arrays: OPEN or WALL for faces on the sides.
    jets : list of Jet
        Those that this rank sees.
    jet_keys : list of str
        Of the sides with any, on every rank.
    has_jets : bool
        Whether any rank sees any.
    behind_jets : ndarray of bool
        Cell array: ghosts that hold the smoke that a jet carries in.
    """

    def __init__(self, grid: MacGrid, sides: Sides):
        self.grid = grid
        self.cell_kind = np.full(grid.shape(None), kinds.OUTSIDE, dtype=np.uint8)
        self.cell_kind[grid.inside(None)] = kinds.FLUID
        self.side_kind = [np.full(grid.shape(axis), kinds.WALL, dtype=np.uint8) for axis in range(grid.dim)]
        self.jets: list[Jet] = []
        self.jet_keys = [
            f"fluid.sides.{name}.inflow"
            for p in NAMES
            for name in p
            if isinstance(getattr(sides, name), GridInflowSide)
        ]
        self.has_jets = bool(self.jet_keys)
        for axis in range(grid.dim):
            for upper, name in enumerate(NAMES[axis]):
                if not grid.periodic[axis]:
                    self._set_side(getattr(sides, name), name, axis, bool(upper))
        self.behind_jets = np.zeros(grid.shape(None), dtype=bool)
        for jet in self.jets:
            jet.fill_behind(self.behind_jets, True)

    def _set_side(self, side: Side, name: str, axis: int, upper: bool) -> None:
        """Enter one side; ranks that do not see it enter nothing."""
        grid = self.grid
        plane = grid.ghost[axis] - grid.lo[axis] + (grid.cells[axis] if upper else 0)
        if not 0 <= plane < grid.shape(axis)[axis]:
            return
        part = list(grid.inside(axis))
        part[axis] = slice(plane, plane + 1)
        jet = side.inflow if isinstance(side, GridInflowSide) else None
        if side == "open" or (jet is not None and jet.rest == "open"):
            self.side_kind[axis][tuple(part)] = kinds.OPEN
        if jet is None:
            return
        lines = [np.arange(p.start, p.stop) for p in part]
        faces = tuple(i.ravel() for i in np.meshgrid(*lines, indexing="ij"))
        points = wrapped_points(grid, axis, faces)
        if jet.region is not None:
            here = inside(jet.region, points)
            faces, points = tuple(i[here] for i in faces), points[here]
        self.side_kind[axis][faces] = kinds.WALL
        self.jets.append(Jet(jet, f"fluid.sides.{name}.inflow", axis, upper, faces, points))

    def add_obstacle(self, obstacle: Obstacle, key: str, directory: Path) -> None:
        """Turn the cells whose centres the obstacle covers into OBSTACLE. Collective."""
        part = self.grid.owned(None)
        covered = _covered_cells(self.grid, obstacle.shape, f"{key}.shape", directory) != obstacle.outside
        self.cell_kind[part][covered] = kinds.OBSTACLE
        self.grid.exchange_cells(self.cell_kind)

    def evaluate(self, time: float) -> None:
        """Evaluate all jets at a time. Collective."""
        if self.has_jets:
            agreed(self.grid.comm, lambda: self._evaluate_here(time))

    def _evaluate_here(self, time: float) -> None:
        for jet in self.jets:
            jet.evaluate(time)

    def prescribe(self, face_kind: list[np.ndarray], boundary_velocity: list[np.ndarray]) -> None:
        """Write the velocity of every WALL face: that of a jet, else zero."""
        for kind, velocity in zip(face_kind, boundary_velocity, strict=True):
            velocity[kind == kinds.WALL] = 0.0
        self.prescribe_jets(face_kind, boundary_velocity)

    def prescribe_jets(
        self, face_kind: list[np.ndarray], boundary_velocity: list[np.ndarray], key: str | None = None
    ) -> None:
        """Write the velocities of jets, or of those with a key, where their faces are WALL (not covered by a solid)."""
        for jet in self.jets:
            if key not in (None, jet.key):
                continue
            wall = face_kind[jet.axis][jet.faces] == kinds.WALL
            boundary_velocity[jet.axis][tuple(i[wall] for i in jet.faces)] = jet.value[wall]

    def fill_smoke(self, smoke: np.ndarray) -> None:
        """Fill the ghosts beyond the sides: as inside, but behind a jet what it carries."""
        self.grid.fill_sides(smoke, None)
        for jet in self.jets:
            jet.fill_behind(smoke, jet.spec.smoke)


def _covered_cells(grid: MacGrid, shape: Shape, key: str, directory: Path) -> np.ndarray:
    """Return which of this rank's own cells have their centres inside a shape. Collective."""
    period = grid.size * np.array(grid.periodic[: grid.dim])
    grid_reach = grid.origin, grid.origin + grid.size
    covered = np.zeros(grid.owned_shape, dtype=bool)
    if shape.mesh is None:
        reach = bounds(shape)
        points = wrapped_points(grid, None, tuple(i.ravel() for i in np.mgrid[grid.owned(None)]))
        for shift in [np.zeros(grid.dim)] if reach is None else images(period, reach, grid_reach):
            covered |= inside(shape, points - shift).reshape(grid.owned_shape)
        return covered
    from petfsi.geometry import meshes, rays

    points, facets = on_root(grid.comm, lambda: meshes.read_surface(shape, grid.dim, key, directory))
    lines = [grid.cell_centres(b)[part] for b, part in enumerate(grid.owned(None))]
    for shift in images(period, (points.min(axis=0), points.max(axis=0)), grid_reach):
        covered |= rays.inside_mask(points + shift, facets, lines).astype(bool)
    return covered
