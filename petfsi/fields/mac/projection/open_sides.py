"""Sides that fluid passes through both ways, and the pressure on them.

On an open side p = P(x, t), or P + rho g . (x - x_s) up to a level at x_s: the pressure of a fluid at rest beyond. It
drives the velocity v into the grid at each face, half a cell from the centre of the cell inside, with c of the
integrator:

    v = v* + (2 c / rho dx) (p - p_cell) .

Where the total pressure of what comes in is given, p = P - rho v^2 / 2 as soon as v > 0. Newton's linearisation about
the velocity v^n with which the step begins,

    v^2 = 2 v^n v - (v^n)^2,     (1 + 2 c v^n / dx) v = v* + (2 c / rho dx) (P + rho (v^n)^2 / 2 - p_cell),

is of second order in the step, damps at any step, and only adds to the diagonal mass of the face: L stays symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.kinds import OPEN
from petfsi.fields.mac.grid.sides import NAMES, wrapped_points
from petfsi.fields.mac.walls.parts import Parts
from petfsi.ranks import agreed
from petfsi.scene.expressions import Expression, evaluate_at
from petfsi.scene.sides import GridInflowSide, OpenSide, Sides, open_side


@dataclass
class Given:
    """A side with a given pressure, as far as this rank sees it; arrays span the plane of its local faces.

    Attributes
    ----------
    plane : tuple of slice
        Where it is in face arrays, ghosts beyond other sides included.
    pressure : ndarray
        That at the instant last evaluated, of fluid at rest, Pa; zero beyond other sides.
    inward : ndarray
        The velocity v^n > 0 of what comes in, if its total pressure is given; else zero.
    yields : ndarray
        1 / (1 + 2 c v^n / dx).
    """

    spec: OpenSide
    key: str
    axis: int
    upper: bool
    plane: tuple[slice, ...]
    inside: tuple[slice, ...]
    points: np.ndarray
    pressure: np.ndarray
    inward: np.ndarray = field(init=False)
    yields: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Start with fluid at rest."""
        self.inward, self.yields = np.zeros_like(self.pressure), np.ones_like(self.pressure)
        self._expression = Expression(self.spec.pressure, key=self.key)

    @property
    def sign(self) -> float:
        """That of a velocity along the axis that goes into the grid."""
        return -1.0 if self.upper else 1.0

    def at(self, time: float) -> np.ndarray:
        """Return what the scene gives at a time, Pa, shape (n,)."""
        return evaluate_at(self._expression, self.points, time)

    def evaluate(self, time: float, weight: np.ndarray, corners: np.ndarray) -> None:
        """Set the pressure for a time, with rho g of that and the corners of the grid."""
        p = self.at(time)
        if self.spec.hydrostatic:
            level = self.spec.level
            top = -float((corners @ weight).min()) if level is None else level * float(np.linalg.norm(weight))
            p = p + top + self.points @ weight
        self.pressure[self.inside] = p.reshape(self.pressure[self.inside].shape)

    def acting(self, velocity: np.ndarray, density: float) -> np.ndarray:
        """Return the pressure that has acted on faces of the plane, given their velocity along the axis, Pa."""
        return self.pressure + density * self.inward * (0.5 * self.inward - self.sign * velocity)


class OpenSides:
    """All sides with a given pressure.

    Parameters
    ----------
    grid : MacGrid
    density : float
        kg/m^3.
    sides : Sides

    Attributes
    ----------
    given : list of Given
        Those that this rank sees.
    any : bool
        Whether any rank sees any.
    total : bool
        Whether the total pressure is given of what comes in through any side, of any rank.
    link_inward, link_yields : ndarray, shape (n_links,)
        What ``Given`` says of faces, of the links of divided ones on all ranks.
    """

    def __init__(self, grid: MacGrid, density: float, sides: Sides) -> None:
        self.grid, self.density = grid, density
        low, high = grid.origin, grid.origin + grid.size
        self._corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, grid.dim)
        self.given: list[Given] = []
        self.any, self._total_sides = False, list[tuple[int, bool]]()
        for axis in range(grid.dim):
            for upper, name in enumerate(NAMES[axis]):
                side = getattr(sides, name)
                spec = open_side(side)
                if spec is None or spec == OpenSide():
                    continue
                self.any = True
                if spec.total:
                    self._total_sides.append((axis, bool(upper)))
                inner = ".inflow.rest" if isinstance(side, GridInflowSide) else ""
                self._add(spec, f"fluid.sides.{name}{inner}.pressure", axis, bool(upper))
        self.total = bool(self._total_sides)
        self.link_inward = self.link_yields = np.zeros(0)

    def _add(self, spec: OpenSide, key: str, axis: int, upper: bool) -> None:
        grid = self.grid
        at = grid.ghost[axis] - grid.lo[axis] + (grid.cells[axis] if upper else 0)
        if not 0 <= at < grid.shape(axis)[axis]:
            return
        plane = tuple(slice(at, at + 1) if b == axis else slice(None) for b in range(3))
        inside = tuple(slice(0, 1) if b == axis else s for b, s in enumerate(grid.inside(axis)))
        lines = [np.arange(at, at + 1) if b == axis else np.arange(s.start, s.stop) for b, s in enumerate(inside)]
        points = wrapped_points(grid, axis, tuple(i.ravel() for i in np.meshgrid(*lines, indexing="ij")))
        shape = tuple(1 if b == axis else n for b, n in enumerate(grid.shape(axis)))
        self.given.append(Given(spec, key, axis, upper, plane, inside, points, np.zeros(shape)))

    def evaluate(self, time: float, gravity: np.ndarray) -> None:
        """Set the pressures for a time, with gravity then; along periodic axes nothing bears it. Collective."""
        if self.any:
            weight = self.density * gravity * ~np.array(self.grid.periodic[: self.grid.dim])
            agreed(self.grid.comm, lambda: self._evaluate_here(time, weight))

    def _evaluate_here(self, time: float, weight: np.ndarray) -> None:
        for side in self.given:
            side.evaluate(time, weight, self._corners)

    def check(self, time: float) -> None:
        """Raise if a given pressure has no value at a time. Collective.

        Raises
        ------
        InputError
            On all ranks.
        """
        if self.any:
            agreed(self.grid.comm, lambda: [side.at(time) for side in self.given])

    def on(self, axis: int, upper: bool) -> Given | None:
        """Return one of them."""
        return next((side for side in self.given if (side.axis, side.upper) == (axis, upper)), None)

    def on_links(
        self, axis: int, upper: np.ndarray, face: tuple[np.ndarray, ...], row: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the pressure that has acted on links of divided faces on the sides of an axis, Pa.

        Parameters
        ----------
        axis : int
        upper : ndarray of bool, shape (n,)
        face : tuple of ndarray
            Their local indices.
        row : ndarray of int, shape (n,)
            Which links.
        velocity : ndarray, shape (n,)
            Of the links along the axis.
        """
        p = np.zeros(len(row))
        at = tuple(np.zeros_like(i) if b == axis else i for b, i in enumerate(face))
        for side in self.given:
            if side.axis == axis:
                p = np.where(upper == side.upper, side.pressure[at], p)
        if not self.total:
            return p
        inward, sign = self.link_inward[row], np.where(upper, -1.0, 1.0)
        return p + self.density * inward * (0.5 * inward - sign * velocity)

    def push(self, star: list[np.ndarray], duration: float) -> None:
        """Accelerate the velocity at the sides by their pressure for ``duration`` seconds.

        On all faces, because a body may yet uncover some in this step: what is given elsewhere is not asked for v*.
        """
        for side in self.given:
            factor = 2.0 * side.sign * duration / (self.density * self.grid.dx[side.axis])
            star[side.axis][side.plane] += factor * side.pressure

    # ---- the total pressure of what comes in ------------------------------------------------------------------

    def weigh(
        self, velocity: Faces, star: Faces, face_kind: list[np.ndarray], duration: float, table: Parts | None
    ) -> None:
        """Take v^n where the total pressure of what comes in is given, and its part of a step's push of v*.

        Parameters
        ----------
        velocity, star : Faces
            v^n, and v* after all other pushes, of ``duration`` seconds; ghosts valid.
        face_kind : list of ndarray
        duration : float
        table : Parts or None
            The links of divided faces.
        """
        for side in self.given:
            if side.spec.total:
                v, share = side.sign * velocity[side.axis][side.plane], duration / self.grid.dx[side.axis]
                side.inward = np.where(face_kind[side.axis][side.plane] == OPEN, np.maximum(v, 0.0), 0.0)
                side.yields = 1.0 / (1.0 + 2.0 * share * side.inward)
                old = star[side.axis][side.plane]
                old[...] = side.yields * (old + side.sign * share * side.inward**2)
        n_links = 0 if table is None else len(table)
        self.link_inward, self.link_yields = np.zeros(n_links), np.ones(n_links)
        if table is None or n_links == 0:
            return
        for axis, upper in self._total_sides:
            here = np.flatnonzero((table.axis == axis) & ((table.above if upper else table.below) < 0))
            sign, share = -1.0 if upper else 1.0, duration / self.grid.dx[axis]
            w = np.maximum(sign * velocity.parts[here], 0.0)
            self.link_inward[here], self.link_yields[here] = w, 1.0 / (1.0 + 2.0 * share * w)
            star.parts[here] = self.link_yields[here] * (star.parts[here] + sign * share * w**2)

    def relax(self, solved: Faces, star: Faces, face_kind: list[np.ndarray]) -> None:
        """Take what the pressure has done to v* of whole faces, as if nothing were added, by what it does to these."""
        for side in self.given:
            new, old = solved[side.axis][side.plane], star[side.axis][side.plane]
            heavy = (face_kind[side.axis][side.plane] == OPEN) & (side.yields < 1.0)
            np.copyto(new, old + side.yields * (new - old), where=heavy)

    def conducting(self, openness: list[np.ndarray]) -> list[np.ndarray]:
        """Return how open faces are, with less where v^n adds to their mass."""
        if not self.total:
            return openness
        less = [alpha.copy() for alpha in openness]
        for side in self.given:
            less[side.axis][side.plane] *= side.yields
        return less
