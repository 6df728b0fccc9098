"""Sides without slip that move in their own plane."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.solids import Array
from petfsi.scene.expressions import Expression, evaluate_at
from petfsi.scene.fluids import SphFluid
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import MovingSide

#: The largest speed is looked for at so many times, and at so many points along each axis.
TIMES, POINTS = 101, 33


class Plate:
    """The velocity of one side of a domain. Not collective."""

    def __init__(self, domain: Domain, side: str, form: MovingSide, until: float) -> None:
        self._domain, self._side, self._end = domain, side, until
        self._axis, self._upper = next((a, pair.index(side)) for a, pair in enumerate(OPPOSITE) if side in pair)
        key = f"fluid.sides.{side}.no-slip.velocity"
        self._velocity = [Expression(v, key=f"{key}.{n}") for n, v in enumerate(form.no_slip.velocity)]

    def __str__(self) -> str:
        """Say how it moves, as ``petfsi check`` does."""
        return f"{self._side}: moves along itself at up to {self.fastest:.3g} m/s"

    @property
    def is_steady(self) -> bool:
        """Whether it does not change with time."""
        return not any(v.depends_on_time for v in self._velocity)

    def velocity(self, points: Array, time: float) -> Array:
        """Return the velocity at points of the side, shape (n, dim), m/s."""
        return np.stack([evaluate_at(v, points, time) for v in self._velocity], axis=1)

    def holds(self, x: Array) -> Array:
        """Return which places (n, dim) lie behind the side, those in corners too.

        What is along a plate then sees it as far to one side as to the other; else corners would fill or empty.
        """
        x = x[:, self._axis]
        return x > self._domain.high[self._axis] if self._upper else x < self._domain.low[self._axis]

    def feet(self, x: Array) -> Array:
        """Return the nearest place of the side to each of these, shape (n, dim)."""
        return self._domain.clamped(x)

    @cached_property
    def fastest(self) -> float:
        """About the largest speed in a run, m/s."""
        low, high = self._domain.low, self._domain.high
        rows = [np.linspace(a, b, POINTS) for a, b in zip(low, high, strict=True)]
        rows[self._axis] = np.array([(low, high)[self._upper][self._axis]])
        points = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, len(rows))
        times = [0.0] if self.is_steady else np.linspace(0.0, self._end, TIMES)
        return max(float(np.linalg.norm(self.velocity(points, t), axis=1).max()) for t in times)


def plates(domain: Domain, fluid: SphFluid, until: float) -> list[Plate]:
    """Return the sides that move, in a run until a time (s)."""
    return [Plate(domain, side, form, until) for side, form in fluid.sides if isinstance(form, MovingSide)]
