"""Gravity's force on nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from petfsi.scene.expressions import Expression
from petfsi.scene.tables import Number


class Gravity:
    """The force  g(t) M e  summed over the axes e.

    Parameters
    ----------
    given : sequence of Number
        The scene's; empty if there is none.
    uniform : ndarray, shape (dim, n_owned, width)
        M e of a unit acceleration along each axis, kg.
    """

    def __init__(self, given: Sequence[Number], uniform: np.ndarray) -> None:
        self._expressions = [Expression(g, ("t",), f"gravity.{n}") for n, g in enumerate(given)]
        self._uniform = uniform

    @property
    def acts(self) -> bool:
        """Whether the scene has any."""
        return bool(self._expressions)

    def add(self, time: float, b: np.ndarray) -> np.ndarray:
        """Add the force at a time to b, shape (n_owned, width), and return g, m/s^2."""
        gravity = np.zeros(len(self._uniform))
        for axis, g in enumerate(self._expressions):
            gravity[axis] = float(g(t=time))
            if gravity[axis]:
                b += gravity[axis] * self._uniform[axis]
        return gravity

    def at(self, time: float) -> np.ndarray:
        """Return g at a time, m/s^2."""
        return np.array([float(g(t=time)) for g in self._expressions])

    def force(self, gravity: np.ndarray) -> np.ndarray:
        """Return the force of g, flat, N."""
        return gravity @ self._uniform.reshape(len(self._uniform), -1)
