"""Inflows: columns of particles behind a side that go in at a given speed.

A column stands over its foot, a point of the side: particles a spacing apart, some deeper than the kernel reaches. All
of a column have the speed of its foot, so that what crosses the side in a time t is the volume that it should be.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from petfsi.errors import InputError
from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.solids import SAME, Array
from petfsi.geometry.shapes import inside
from petfsi.scene.expressions import Expression, evaluate_at, ramp
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import Inflow, InflowSide

#: At so many times the speed is asked for to find the fastest.
SAMPLES = 101


class Inlet:
    """The columns of one side. Not collective: every rank has all.

    Parameters
    ----------
    domain : Domain
    axis, end : int
        The side: 0 is the lower end.
    spec : Inflow
    dx, reach : float
        The particles' spacing and how far they see, m.
    is_solid : callable
        At which points (n, dim) no particle may be.
    until : float
        When the run ends, s.

    Attributes
    ----------
    side : str
    feet : ndarray, shape (n, dim)
        Of the columns, m.
    width : ndarray, shape (dim,)
        The particles' spacing here along each axis, m.
    inward : ndarray, shape (dim,)
        Unit.
    layers : int
        How many particles a column has.

    Raises
    ------
    InputError
        If there is no column.
    """

    def __init__(
        self, domain: Domain, axis: int, end: int, spec: Inflow, dx: float, reach: float,
        is_solid: Callable[[Array], Array], until: float,
    ) -> None:  # fmt: skip
        self.side = OPPOSITE[axis][end]
        key = f"fluid.sides.{self.side}.inflow"
        self.axis, self._spec, self._end = axis, spec, until
        self._speed = Expression(spec.speed, key=f"{key}.speed")
        dim = len(domain.low)
        self.inward = np.zeros(dim)
        self.inward[axis] = 1.0 - 2.0 * end
        self.width = domain.spacing(dx)
        rows, self._first, self._counts = [], np.zeros(dim), np.ones(dim, dtype=np.int64)
        for a in range(dim):
            low, high = _reach(domain, spec, a) if a != axis else (0.0, 0.0)
            if a != axis:
                n = max(1, int(np.rint((high - low) / self.width[a])))
                self._first[a], self._counts[a], self.width[a] = low, n, (high - low) / n
            rows.append(low + (np.arange(self._counts[a]) + 0.5) * self.width[a])
        rows[axis] = np.array([(domain.low, domain.high)[end][axis]])
        every = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, dim)
        kept = np.ones(len(every), dtype=bool) if spec.region is None else inside(spec.region, every)
        kept &= ~is_solid(every + SAME * dx * self.inward)
        self.feet = every[kept]
        if not len(self.feet) or np.any(self.width <= 0):
            where = key if spec.region is None else f"{key}.region"
            raise InputError(f"{where}: no particle has room there; is it on the side, and free of obstacles?")
        self._column = cKDTree(self.feet).query(every)[1].astype(np.int64)
        self.layers = int(np.ceil(reach / self.width[axis] - SAME)) + 1

    @property
    def depth(self) -> float:
        """How far columns go behind the side, m."""
        return float(self.layers * self.width[self.axis])

    @property
    def area(self) -> float:
        """What all columns together are wide, m^2 (m in 2D)."""
        return float(len(self.feet) * np.prod(self.width) / self.width[self.axis])

    def __str__(self) -> str:
        """Say what comes in, as ``petfsi check`` does."""
        unit = "m^2" if len(self.inward) == 3 else "m"
        flow = f"{self.area:.4g} {unit} at up to {self.fastest:.3g} m/s"
        waiting = len(self.feet) * self.layers
        return f"{self.side}: inflow through {flow}; {waiting:,} particles wait behind it, {self.depth:.3g} m deep"

    def speed(self, time: float) -> Array:
        """Return the speed of each column into the domain, m/s."""
        return ramp(time, self._spec.ramp) * evaluate_at(self._speed, self.feet, time)

    @cached_property
    def fastest(self) -> float:
        """About the largest speed in a run, m/s."""
        times = np.linspace(0.0, self._end, SAMPLES) if self._speed.depends_on_time else [0.0]
        return max(float(np.abs(evaluate_at(self._speed, self.feet, t)).max()) for t in times)

    def columns(self, x: Array) -> Array:
        """Return which column stands nearest to each of these places (n, dim)."""
        place = np.floor((x - self._first) / self.width).astype(np.int64)
        place[:, self.axis] = 0
        place = np.clip(place, 0, self._counts - 1)
        return self._column[np.ravel_multi_index(tuple(place.T), tuple(self._counts))]

    def holds(self, x: Array) -> Array:
        """Return which places (n, dim) are beyond the side's plane."""
        return (x - self.feet[0]) @ self.inward < 0.0

    def filled(self) -> tuple[Array, Array]:
        """Return the places of all columns' particles at the start, column by column, and the column of each."""
        heights = (np.arange(self.layers) + 0.5) * self.width[self.axis]
        x = self.feet[:, None] - heights[:, None] * self.inward
        return x.reshape(-1, len(self.inward)), np.repeat(np.arange(len(self.feet)), self.layers)

    def pressure_in(self, x: Array, p: Array, law: Law, reach: float) -> Array:
        """Return the pressure at each foot that fluid at rest at x (n, dim) with p (n,) has, Pa; 0 far from any."""
        distance, nearest = cKDTree(x).query(self.feet, distance_upper_bound=reach)
        seen = np.isfinite(distance)
        found = np.zeros(len(self.feet))
        found[seen] = p[nearest[seen]] + law.rho0 * ((self.feet[seen] - x[nearest[seen]]) @ np.array(law.gravity))
        return found


def inlets(domain: Domain, dx: float, reach: float, is_solid: Callable[[Array], Array], until: float) -> list[Inlet]:
    """Return the inflows of a domain, side by side; parameters as for ``Inlet``."""
    return [
        Inlet(domain, axis, end, side.inflow, dx, reach, is_solid, until)
        for axis, pair in enumerate(domain.sides)
        for end, side in enumerate(pair)
        if isinstance(side, InflowSide)
    ]


def _reach(domain: Domain, spec: Inflow, axis: int) -> tuple[float, float]:
    """Return from where to where columns stand along an axis: as wide as a box, else on the domain's lattice."""
    low, high = float(domain.low[axis]), float(domain.high[axis])
    box = None if spec.region is None else spec.region.box
    if box is None:
        return low, high
    return max(low, box.origin[axis]), min(high, box.origin[axis] + box.size[axis])
