"""The static surroundings of the fluid: sides of the grid, jets through them, and obstacles."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.geometry.openings import check_jets, jet_parts
from petfsi.geometry.shapes import bounds, inside
from petfsi.ranks import agreed, on_root
from petfsi.scene.expressions import Expression, evaluate_at, ramp
from petfsi.scene.fluids import MacFluid
from petfsi.scene.schema import Obstacle
from petfsi.scene.shape_checks import images
from petfsi.scene.sides import GridInflow, GridInflowSide, Side, Sides, open_side
from petfsi.scene.tables import Shape

T = TypeVar("T")

#: Less than this part of a jet's area is lost to round-off.
ROUND_OFF = 1e-9
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
        Centroids of the parts of the faces that it comes through.
    part : ndarray, shape (n,)
        These parts: fractions of the faces.
    mean : ndarray, shape (n,)
        What part of that which is open of a face it comes through: ``part`` where nothing cuts faces.
    squares : ndarray, shape (n,)
        The squared speed of what comes in, without what it has along the side unless that is given, m^2/s^2.
    """

    spec: GridInflow
    key: str
    axis: int
    upper: bool
    faces: tuple[np.ndarray, ...]
    points: np.ndarray
    part: np.ndarray
    mean: np.ndarray = field(init=False)
    squares: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Start with the jet closed."""
        self.mean = self.part.copy()
        self._rate, self.squares = np.zeros(len(self.points)), np.zeros(len(self.points))
        self._speed = Expression(self.spec.speed, key=f"{self.key}.speed")
        self._along = [Expression(v, key=f"{self.key}.along") for v in self.spec.along or ()]
        self._beside: list[tuple[int, tuple[np.ndarray, ...], np.ndarray]] = []

    @classmethod
    def through(
        cls, grid: MacGrid, fluid: MacFluid, spec: GridInflow, key: str, axis: int, upper: bool,
        side: tuple[slice, ...],
    ) -> Jet:  # fmt: skip
        """Return the jet through the faces of a side, which ``side`` has in the local array."""
        lines = [np.arange(p.start, p.stop) for p in side]
        faces = tuple(i.ravel() for i in np.meshgrid(*lines, indexing="ij"))
        points = wrapped_points(grid, axis, faces)
        at = float(grid.origin[axis] + (grid.size[axis] if upper else 0.0))
        part, points = jet_parts(fluid, spec.region, axis, at, points - grid.dx / 2, points + grid.dx / 2)
        here = part > 0.0
        jet = cls(spec, key, axis, upper, tuple(i[here] for i in faces), points[here], part[here])
        if spec.along is not None:
            jet._beside = [(b, *jet._faces_beside(grid, b, at)) for b in range(grid.dim) if b != axis]
        return jet

    def _faces_beside(self, grid: MacGrid, b: int, at: float) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Return the faces of an axis along the side that bound cells behind the jet, and where they meet the side."""
        above = tuple(i + (c == b) for c, i in enumerate(self.faces))
        every = np.concatenate((np.stack(self.faces, axis=1), np.stack(above, axis=1)))
        index = tuple(np.unique(every, axis=0).T)
        points = wrapped_points(grid, b, index)
        points[:, self.axis] = at
        return index, points

    @property
    def value(self) -> np.ndarray:
        """Velocity along the axis as last evaluated, the mean over what is open of each face, m/s, shape (n,)."""
        return self.mean * self._rate

    @property
    def divides(self) -> bool:
        """Whether it comes through a part of any face here."""
        return bool(np.any(self.part < 1.0))

    def evaluate(self, *times: float) -> None:
        """Set ``value`` to the mean over some times, and ``squares`` to what belongs to that."""
        speeds = [ramp(t, self.spec.ramp) * evaluate_at(self._speed, self.points, t) for t in times]
        speed: np.ndarray = np.mean(speeds, axis=0)
        self._rate[:] = (-1.0 if self.upper else 1.0) * speed
        self.squares[:] = speed**2
        for along in self._along:
            self.squares += evaluate_at(along, self.points, float(np.mean(times))) ** 2

    def open_fully(self) -> None:
        """Set ``value`` to what a speed of 1 m/s everywhere would make it."""
        self._rate[:] = -1.0 if self.upper else 1.0

    def area(self, grid: MacGrid) -> float:
        """Return the area of its parts of faces beside this rank's own cells, m^2 (m in 2D)."""
        cells = [i - self.upper if b == self.axis else i for b, i in enumerate(self.faces)]
        own = [(i >= s.start) & (i < s.stop) for i, s in zip(cells, grid.owned(None), strict=True)]
        return float(self.part[np.all(own, axis=0)].sum() * grid.face_area(self.axis))

    def fill_behind(self, cells: np.ndarray, value: float | bool) -> None:
        """Give the ghosts behind the jet a value."""
        across = tuple(f for b, f in enumerate(self.faces) if b != self.axis)
        if len(across[0]):
            np.moveaxis(cells, self.axis, 0)[(self._behind(), *across)] = value

    def fill_along(self, velocity: list[np.ndarray], time: float) -> None:
        """Give the ghosts behind the jet the velocity along the side that it carries in."""
        for b, index, points in self._beside:
            across = tuple(f for c, f in enumerate(index) if c != self.axis)
            if len(points):
                values = evaluate_at(self._along[b], points, time)
                np.moveaxis(velocity[b], self.axis, 0)[(self._behind(), *across)] = values

    def _behind(self) -> slice:
        """Return the ghosts beyond the side along the jet's axis."""
        first = self.faces[self.axis][0]
        return slice(first, None) if self.upper else slice(0, first)


class Surroundings:
    """What never moves: which cells are obstacles or outside, and what each face on a side does.

    Attributes
    ----------
    fluid : MacFluid
        The table of the scene.
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
    carries_along : bool
        Whether any jet says what velocity along its side comes in.
    behind_jets : ndarray of bool
        Cell array: ghosts that hold the smoke that a jet carries in.
    """

    def __init__(self, grid: MacGrid, fluid: MacFluid):
        check_jets(fluid, grid.dim)
        self.grid, self.fluid, sides = grid, fluid, fluid.sides
        self.cell_kind = np.full(grid.shape(None), kinds.OUTSIDE, dtype=np.uint8)
        self.cell_kind[grid.inside(None)] = kinds.FLUID
        self.side_kind = [np.full(grid.shape(axis), kinds.WALL, dtype=np.uint8) for axis in range(grid.dim)]
        self.jets: list[Jet] = []
        every = {name: getattr(sides, name) for pair in NAMES[: grid.dim] for name in pair}
        inflows = {name: side.inflow for name, side in every.items() if isinstance(side, GridInflowSide)}
        self.jet_keys = [f"fluid.sides.{name}.inflow" for name in inflows]
        self.has_jets, self.carries_along = bool(inflows), any(jet.along is not None for jet in inflows.values())
        self.time = 0.0
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
        if open_side(side) is not None:
            self.side_kind[axis][tuple(part)] = kinds.OPEN
        if isinstance(side, GridInflowSide):
            # a face that a jet takes a part of is closed for the rest
            key = f"fluid.sides.{name}.inflow"
            jet = Jet.through(grid, self.fluid, side.inflow, key, axis, upper, tuple(part))
            self.side_kind[axis][jet.faces] = kinds.WALL
            self.jets.append(jet)

    def carry_ends(
        self, axis: int, low: tuple[float, ...], high: tuple[float, ...]
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return how far faces of an axis may come from: ends of the domain, half a cell on behind jets along it."""
        ends = [list(low), list(high)]
        for jet in self.jets:
            if jet.spec.along is not None and jet.axis != axis:
                ends[jet.upper][jet.axis] = (high[jet.axis] + 0.5) if jet.upper else (low[jet.axis] - 0.5)
        return tuple(ends[0]), tuple(ends[1])

    def add_obstacle(self, obstacle: Obstacle, key: str, directory: Path) -> None:
        """Turn the cells whose centres the obstacle covers into OBSTACLE. Collective."""
        part = self.grid.owned(None)
        covered = _covered_cells(self.grid, obstacle.shape, f"{key}.shape", directory) != obstacle.outside
        self.cell_kind[part][covered] = kinds.OBSTACLE
        self.grid.exchange_cells(self.cell_kind)

    def evaluate(self, *times: float) -> None:
        """Evaluate all jets: their mean over some times. Collective."""
        if self.has_jets:
            agreed(self.grid.comm, lambda: self._evaluate_here(*times))

    def _evaluate_here(self, *times: float) -> None:
        self.time = float(np.mean(times))
        for jet in self.jets:
            jet.evaluate(*times)

    def notes_on_covered(self, opened: dict[str, float]) -> list[str]:
        """Refuse jets that obstacles cover altogether; return notes of those that they cover in part. Collective.

        Parameters
        ----------
        opened : dict of str to float
            By the jets' keys what of their areas this rank's obstacles leave.
        """
        grid = self.grid
        whole = [sum(jet.area(grid) for jet in self.jets if jet.key == key) for key in opened]
        areas = grid.comm.allreduce(np.array([list(opened.values()), whole]))
        notes, unit = [], "m^2" if grid.dim == 3 else "m"
        for key, (left, area) in zip(opened, areas.T, strict=True):
            side = getattr(self.fluid.sides, key.split(".")[2])
            if left <= ROUND_OFF * area and side.inflow.region is not None:
                raise InputError(f"{key}: obstacles cover all of it, and nothing comes in; move them, or its region")
            if left < (1.0 - ROUND_OFF) * area:
                so_much = f"{left:.4g} of its {area:.4g} {unit}"
                notes.append(f"{key}: obstacles leave {so_much} open; what comes in is as much less")
        return notes

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

    def not_read(self, narrow: list[np.ndarray]) -> list[np.ndarray]:
        """Return which faces water near sheets does not read: narrow ones, and those with a jet on a part of them.

        If such a face is divided, its sides have velocities of their own, and it has one alone.
        """
        for jet in self.jets:
            if jet.divides:
                mixed = jet.part < 1.0
                narrow = [faces.copy() if a == jet.axis else faces for a, faces in enumerate(narrow)]
                narrow[jet.axis][tuple(i[mixed] for i in jet.faces)] = True
        return narrow

    def squares(
        self, axis: int, upper: bool, across: np.ndarray, along: np.ndarray, at: tuple[slice, ...]
    ) -> np.ndarray:
        """Return the squared speed of what comes in through a side's faces with a given velocity, m^2/s^2.

        Parameters
        ----------
        axis, upper : int, bool
        across, along : ndarray
            Those of the faces' own velocity and of the cells inside, where nothing else is given.
        at : tuple of slice
            Which faces, of the local array.
        """
        jet = next((jet for jet in self.jets if (jet.axis, jet.upper) == (axis, upper)), None)
        if jet is None:
            return across + along
        plane = np.zeros(tuple(1 if b == axis else n for b, n in enumerate(self.grid.shape(axis))))
        has = np.zeros(plane.shape, dtype=bool)
        place = tuple(np.zeros_like(i) if b == axis else i for b, i in enumerate(jet.faces))
        plane[place], has[place] = jet.squares, True
        part = tuple(slice(0, 1) if b == axis else s for b, s in enumerate(at))
        beside = along if jet.spec.along is None else 0.0
        return np.where(has[part], plane[part] + beside, across + along)

    def fill_along(self, velocity: list[np.ndarray]) -> None:
        """Give the ghosts behind jets the velocity along their sides amid the times last evaluated. Collective."""
        agreed(self.grid.comm, lambda: self._fill_along_here(velocity))

    def _fill_along_here(self, velocity: list[np.ndarray]) -> None:
        for jet in self.jets:
            jet.fill_along(velocity, self.time)
            if jet.spec.along is not None:
                for b, array in enumerate(velocity):
                    if b != jet.axis:
                        self._fill_corners(array, b, jet)

    def _fill_corners(self, array: np.ndarray, axis: int, jet: Jet) -> None:
        """Copy the outermost of what lies behind a side to beyond the sides next to it."""
        part = self.grid.inside(axis)
        behind = part[jet.axis]
        slab = np.moveaxis(array, jet.axis, 0)[slice(behind.stop, None) if jet.upper else slice(0, behind.start)]
        for b, inner in enumerate(s for c, s in enumerate(part) if c != jet.axis):
            view = np.moveaxis(slab, b + 1, 0)
            view[: inner.start] = view[inner.start]
            view[inner.stop :] = view[inner.stop - 1]

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
