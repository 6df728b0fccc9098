"""What a fluid on a staggered grid holds, and what forces and sides do to it: momentum and energy by faces.

A face that the pressure acts on has the mass m_f = rho alpha_f A_f dx; at an open side, where p is given half a cell
away, it has half of that. With it a step's kick, v_w = v* - (c/rho) G p, does exactly the work of the pressure on all
walls:

    sum_f m_f v_w (v_w - v*) / c = - sum_c p_c (outflow of c through walls) - sum_open p_f (outflow) .
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from petfsi.fields.base import Stock
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.kinds import OPEN, PRESSURE, STEP, WALL
from petfsi.fields.mac.grid.sides import Surroundings
from petfsi.fields.mac.projection.extras import Extras
from petfsi.fields.mac.projection.open_sides import OpenSides
from petfsi.fields.mac.projection.weight import Weight


@dataclass(frozen=True)
class Forces:
    """What accelerates the fluid besides the pressure: ``plain + lift * smoke`` by axis, m/s^2.

    Attributes
    ----------
    plain, lift : ndarray, shape (dim,)
    smoke : ndarray or None
        Cell array; None if there is no lift.
    link_smoke : ndarray or None
        That at the links of divided faces.
    """

    plain: np.ndarray
    lift: np.ndarray
    smoke: np.ndarray | None
    link_smoke: np.ndarray | None

    @classmethod
    def of(
        cls, gravity: np.ndarray, heavy: list[bool], buoyancy: float, smoke: np.ndarray | None,
        link_smoke: np.ndarray | None,
    ) -> Forces | None:  # fmt: skip
        """Return gravity (along axes where the fluid is ``heavy``) and buoyancy, or None if there is neither."""
        plain, lift = np.where(heavy[: len(gravity)], gravity, 0.0), -buoyancy * gravity
        if not np.any(plain) and not np.any(lift):
            return None
        return cls(plain, lift, smoke, link_smoke) if np.any(lift) else cls(plain, lift, None, None)

    def on_links(self, axis: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the acceleration of some links of divided faces, given their axes and rows, m/s^2."""
        plain = self.plain[axis]
        return plain if self.link_smoke is None else plain + self.lift[axis] * self.link_smoke[row]


def stock(
    grid: MacGrid, density: float, velocity: Faces, kind: list[np.ndarray], openness: list[np.ndarray],
    extras: Extras | None,
) -> Stock:  # fmt: skip
    """Return this rank's share of momentum and kinetic energy. Not collective."""
    mass = density * grid.cell_volume
    momentum, squares = np.zeros(grid.dim), 0.0
    for a, v in enumerate(velocity):
        first, second = _moments(kind[a], openness[a], v, grid.owned_ranges(a))
        momentum[a] = mass * first
        squares += second
    if extras is not None:
        v, part = velocity.parts[extras.row], _shares(extras)
        momentum += mass * np.bincount(extras.axis, part * v, minlength=grid.dim)
        squares += float(part @ v**2)
    return Stock(momentum, 0.5 * mass * squares)


def power(
    grid: MacGrid, density: float, velocity: Faces, kind: list[np.ndarray], openness: list[np.ndarray],
    extras: Extras | None, forces: Forces,
) -> float:  # fmt: skip
    """Return this rank's share of the power of forces, W. Not collective."""
    total = 0.0
    for a, v in enumerate(velocity):
        if forces.plain[a] != 0.0:
            total += forces.plain[a] * _moments(kind[a], openness[a], v, grid.owned_ranges(a))[0]
        if forces.smoke is not None and forces.lift[a] != 0.0:
            total += forces.lift[a] * _carried(kind[a], openness[a], v, forces.smoke, STEP[a], grid.owned_ranges(a))
    if extras is not None:
        total += float((_shares(extras) * velocity.parts[extras.row]) @ forces.on_links(extras.axis, extras.row))
    return density * grid.cell_volume * total


def inflow(
    grid: MacGrid, density: float, velocity: Faces, kind: list[np.ndarray], openness: list[np.ndarray],
    pressure: np.ndarray, active: np.ndarray, weight: Weight | None, jets: Surroundings, pressed: OpenSides,
    extras: Extras | None, further: np.ndarray,
) -> float:  # fmt: skip
    """Return this rank's share of the power that comes through the sides, W. Not collective.

    Through jets and open sides,  sum_f q_f (p_f + rho |v|^2 / 2)  with the volume q_f that comes in a second. The
    velocity across an open face is its own, that along it the one of the cell inside; of a jet it is what the jet has,
    which comes through a part of a face at more than the face's own velocity. Where the pressure of the fluid at rest
    is split off (``weight``), p is without it: this adds the potential energy of what comes and goes. Of divided
    cells, ``further`` are the pressures of the further pieces.
    """
    total = 0.0
    if extras is not None:
        total = _inflow_of_parts(grid, density, velocity, pressure, weight, pressed, extras, further)
    for a in range(grid.dim):
        for upper in (False, True):
            edge = (grid.hi[a] == grid.cells[a]) if upper else (grid.lo[a] == 0)
            if grid.periodic[a] or not edge:
                continue
            face, inner = list(grid.owned(a)), list(grid.owned(None))
            plane = grid.owned(None)[a].stop if upper else grid.owned(None)[a].start
            face[a] = slice(plane, plane + 1)
            inner[a] = slice(plane - 1, plane) if upper else face[a]
            at, cell = tuple(face), tuple(inner)
            is_open, is_wall = kind[a][at] == OPEN, (kind[a][at] == WALL) & active[cell]
            v = velocity[a][at]
            given = pressed.on(a, upper)
            if given is None and not np.any(is_open | (is_wall & (v != 0.0))):
                continue
            p, along = np.where(is_wall, pressure[cell], 0.0), _along(velocity, cell, a)
            if given is not None:
                p = np.where(is_open, given.acting(velocity[a][given.plane], density)[_in_plane(at, a)], p)
            if weight is not None:
                p = p - np.where(is_open, _rest(grid, weight, a, at), _rest(grid, weight, None, cell))
            flow = np.where(is_open | is_wall, (-v if upper else v) * openness[a][at], 0.0) * grid.face_area(a)
            squares = np.where(is_wall, jets.squares(a, upper, v**2, along, at), v**2 + along)
            total += float(np.sum(flow * (p + 0.5 * density * squares)))
    return total


def _in_plane(at: tuple[slice, ...], axis: int) -> tuple[slice, ...]:
    """Return where a part of a plane of faces is in an array of the plane alone."""
    return tuple(slice(0, 1) if b == axis else s for b, s in enumerate(at))


def _inflow_of_parts(
    grid: MacGrid, density: float, velocity: Faces, pressure: np.ndarray, weight: Weight | None, pressed: OpenSides,
    extras: Extras, further: np.ndarray,
) -> float:  # fmt: skip
    """Return what divided faces of open sides let in, and those with a given flow beyond what whole ones would, W."""
    area = np.array([grid.face_area(a) for a in range(grid.dim)])
    given = extras.inlets
    excess = further[given.piece - grid.layout.n_local] - grid.to_vec(pressure)[given.cell]
    total = float(given.flow(velocity, area) @ excess)
    links = np.flatnonzero(extras.owned & ((extras.below < 0) | (extras.above < 0)))
    for a in range(grid.dim):
        row = links[extras.axis[links] == a]
        if not len(row):
            continue
        face, upper = np.array(np.unravel_index(extras.face[row], grid.shape(a))), extras.above[row] < 0
        v = velocity.parts[extras.row[row]]
        flow = np.where(upper, -v, v) * extras.openness[row] * area[a]
        p = pressed.on_links(a, upper, tuple(face), extras.row[row], v)
        if weight is not None:
            p = p - weight.on([line.reshape(-1)[i] for line, i in zip(grid.lines(a), face, strict=True)])
        along = np.zeros(len(row))
        cell = face - upper * (np.arange(3) == a)[:, None]
        for b in range(grid.dim):
            if b != a:
                above = cell + (np.arange(3) == b)[:, None]
                along += 0.5 * (velocity[b][tuple(cell)] ** 2 + velocity[b][tuple(above)] ** 2)
        total += float(flow @ (p + 0.5 * density * (v**2 + along)))
    return total


def _rest(grid: MacGrid, weight: Weight, axis: int | None, part: tuple[slice, ...]) -> np.ndarray:
    """Return the pressure of the fluid at rest on a part of the faces of an axis (None: cells)."""
    lines = [x[s] for x, s in zip(grid.lines(axis), part, strict=True)]
    return weight.on(list(np.meshgrid(*lines, indexing="ij", sparse=True)))


def _along(velocity: Faces, cell: tuple[slice, ...], axis: int) -> np.ndarray:
    """Return the squared speed of cells across an axis: means over their two faces."""
    total = np.zeros([s.stop - s.start for s in cell])
    for b, v in enumerate(velocity):
        if b != axis:
            above = tuple(slice(s.start + (c == b), s.stop + (c == b)) for c, s in enumerate(cell))
            total += 0.5 * (v[cell] ** 2 + v[above] ** 2)
    return total


def _shares(extras: Extras) -> np.ndarray:
    """Return the part of a whole cell's mass that each link of this rank's own faces has; zero for others."""
    share = np.where((extras.below < 0) | (extras.above < 0), 0.5, 1.0) * extras.openness
    return np.where(extras.owned, share, 0.0)


@njit(cache=True)
def _share(kind, openness):
    """Return the part of a whole cell's mass that a face has; split faces are not looked at."""
    if kind == PRESSURE:
        return openness
    if kind == OPEN:
        return 0.5 * openness
    return 0.0


@njit(cache=True)
def _moments(kind, openness, v, part):
    """Return the sums of v and v^2 over the owned faces of an axis, by their share of a cell."""
    (b0, e0), (b1, e1), (b2, e2) = part
    first = second = 0.0
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                share = _share(kind[i, j, k], openness[i, j, k])
                first += share * v[i, j, k]
                second += share * v[i, j, k] ** 2
    return first, second


@njit(cache=True)
def _carried(kind, openness, v, smoke, step, part):
    """Return the sum of v times the smoke at the face over the owned faces of an axis."""
    (b0, e0), (b1, e1), (b2, e2) = part
    di, dj, dk = step
    total = 0.0
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                mean = 0.5 * (smoke[i, j, k] + smoke[i - di, j - dj, k - dk])
                total += _share(kind[i, j, k], openness[i, j, k]) * v[i, j, k] * mean
    return total
