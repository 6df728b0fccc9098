"""The box that holds a fluid of particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petfsi.geometry.shapes import inside
from petfsi.scene.sides import InflowSide

Array = np.ndarray


@dataclass(frozen=True)
class Domain:
    """The box that holds the fluid, and what its sides are.

    Attributes
    ----------
    low, high : ndarray, shape (dim,)
        m.
    sides : tuple of pairs
        The lower and upper side of each axis: "slip", "no-slip", "open", "periodic" or an inflow's table.
    """

    low: Array
    high: Array
    sides: tuple[tuple[str | InflowSide, str | InflowSide], ...]

    @property
    def periodic(self) -> Array:
        """Which axes repeat, shape (dim,)."""
        return np.array([pair[0] == "periodic" for pair in self.sides])

    @property
    def period(self) -> Array:
        """After what length they do, m; 0 where they do not, shape (dim,)."""
        return np.where(self.periodic, self.high - self.low, 0.0)

    def spacing(self, dx: float) -> Array:
        """Return the spacing along each axis that is nearest to dx and divides the size, m, shape (dim,)."""
        size = self.high - self.low
        return size / np.maximum(1.0, np.rint(size / dx))

    def lets_out(self, axis: int, end: int) -> bool:
        """Whether something may be beyond (part of) a side."""
        return self.sides[axis][end] not in ("slip", "no-slip", "periodic")

    def is_wall(self, axis: int, end: int, points: Array) -> Array:
        """Return which points (n, dim), beyond a side, are behind a wall and not before an opening."""
        kind = self.sides[axis][end]
        if not isinstance(kind, InflowSide):
            return np.full(len(points), kind in ("slip", "no-slip"))
        if kind.inflow.region is None or kind.inflow.rest == "open":
            return np.zeros(len(points), dtype=bool)
        return ~inside(kind.inflow.region, np.clip(points, self.low, self.high))

    def beyond(self, points: Array) -> Array:
        """Return how far points lie behind walls along each axis, m; negative behind upper sides, shape (n, dim)."""
        behind = np.zeros(points.shape)
        for a in np.flatnonzero(~self.periodic):
            for end, distance in enumerate((self.low[a] - points[:, a], points[:, a] - self.high[a])):
                out = np.flatnonzero(distance > 0.0)
                out = out[self.is_wall(a, end, points[out])]
                behind[out, a] = distance[out] if end == 0 else -distance[out]
        return behind

    def clamped(self, points: Array) -> Array:
        """Return points moved to the nearest place of the domain, but not along periodic axes."""
        return np.where(self.periodic, points, np.clip(points, self.low, self.high))
