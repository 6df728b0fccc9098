"""The diagonal equation of an explicit step."""

from __future__ import annotations

import numpy as np

from petfsi.petsc import IntType, Layout


class LumpedEquation:
    """A of an explicit step,  (a + a0) M  with a lumped M, and what supports make of it.

    Rows of prescribed unknowns have the mean of the others' diagonal.

    Parameters
    ----------
    layout : Layout
        Of the unknowns.
    mass : ndarray, shape (n_owned, width)
        Lumped, kg.
    mass_damping, stiffness_damping : ndarray, shape (n_owned,)
        a0 (1/s) and a1 (s) of each node's body.
    held : ndarray of int
        Global numbers of all prescribed unknowns, ascending.

    Attributes
    ----------
    indptr, indices : ndarray of IntType
        The pattern of this rank's rows.
    """

    def __init__(
        self, layout: Layout, mass: np.ndarray, mass_damping: np.ndarray, stiffness_damping: np.ndarray,
        held: np.ndarray,
    ) -> None:  # fmt: skip
        self.mass = mass
        self._mass_damping, self._stiffness_damping = mass_damping[:, None], stiffness_damping[:, None]
        self._chosen = np.flatnonzero((held >= layout.start) & (held < layout.end))
        self._held = held[self._chosen] - layout.start
        self.indptr = np.arange(layout.n_local + 1, dtype=IntType)
        self.indices = np.arange(layout.start, layout.end, dtype=IntType)

    def diagonal(self, a: float, mean: float) -> np.ndarray:
        """Return A's diagonal, flat, for a factor a (1/s) and the mean nodal mass (kg)."""
        values = ((a + self._mass_damping) * self.mass).ravel()
        values[self._held] = a * mean
        return values

    def inertia(self, a: float, w: np.ndarray) -> np.ndarray:
        """Return (a + a0) M w, shape (n_owned, width), N."""
        return (a + self._mass_damping) * self.mass * w

    def lag(self, velocity: np.ndarray) -> np.ndarray:
        """Return s = a1 u^n, of which K' s is the force of stiffness damping."""
        return self._stiffness_damping * velocity

    def prescribe(self, b: np.ndarray, a: float, mean: float, g: np.ndarray) -> None:
        """Put the prescribed values g of all held unknowns into this rank's right-hand side."""
        b[self._held] = a * mean * g[self._chosen]
