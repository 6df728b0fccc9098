"""Loads that neither move nor turn: nodal forces that depend on time alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix

from petfsi.fields.solid.loads.simplices import Coordinates, Simplices
from petfsi.scene.expressions import Expression


class DeadLoads:
    """The sum of all dead loads, at a price that each asks for.

    What does not depend on time is integrated once. What depends on time but not on the place is a vector times a
    number. Only what depends on both is integrated again, by one product with a sparse matrix.

    Parameters
    ----------
    n_rows, dim : int
        Nodes and axes of the result.
    """

    def __init__(self, n_rows: int, dim: int) -> None:
        self._n, self._dim = n_rows, dim
        self._constant = np.zeros((n_rows, dim))
        self._timed: list[tuple[Expression, Coordinates, np.ndarray]] = []
        self._placed: list[tuple[Expression, Coordinates, csr_matrix, np.ndarray]] = []

    @property
    def depends_on_time(self) -> bool:
        """Whether they change."""
        return bool(self._timed or self._placed)

    @property
    def depends_on_place_and_time(self) -> bool:
        """Whether an expression has to be evaluated at this rank's own places in every step."""
        return bool(self._placed)

    def add_densities(self, on: Simplices, terms: Sequence[tuple[Expression, np.ndarray]]) -> None:
        """Add  f_a = int N_a (sum of expression times direction) dV.  Not collective.

        Parameters
        ----------
        on : Simplices
        terms : sequence of (Expression, ndarray)
            N/m^3 or N/m^2; directions of shape (dim,) or (n, q, dim).
        """
        spread, coordinates = on.spread(self._n), on.coordinates
        for expression, direction in terms:
            if not expression.names - {"t"}:
                self._add_timed(expression, coordinates, _spread(spread, np.ones(spread.shape[1]), direction))
            elif expression.depends_on_time:
                self._placed.append((expression, coordinates, spread, direction))
            else:
                self._constant += _spread(spread, expression(**coordinates), direction)

    def add_point(
        self, components: Sequence[Expression], at: Coordinates, rows: np.ndarray, weights: np.ndarray
    ) -> None:
        """Add a force (N) at ``at``, of which each of the ``rows`` takes its share. Not collective."""
        for axis, expression in enumerate(components):
            unit = np.zeros_like(self._constant)
            unit[rows, axis] = weights
            self._add_timed(expression, at, unit)

    def _add_timed(self, expression: Expression, at: Coordinates, unit: np.ndarray) -> None:
        if expression.depends_on_time:
            self._timed.append((expression, at, unit))
        else:
            # one number, or the same one at every point
            value = expression(**at) if expression.names else expression()
            self._constant += float(value.flat[0]) * unit if value.size else 0.0

    def forces(self, time: float) -> np.ndarray:
        """Return the nodal forces, shape (n_rows, dim), N; not to be changed. Not collective."""
        if not self.depends_on_time:
            return self._constant
        total = self._constant.copy()
        for expression, at, unit in self._timed:
            here = {name: value for name, value in at.items() if name in expression.names}
            total += float(expression(t=time, **here)) * unit
        for expression, coordinates, spread, direction in self._placed:
            total += _spread(spread, expression(t=time, **coordinates), direction)
        return total


def _spread(spread: csr_matrix, density: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the nodal forces of densities at all points along one direction, or each along its own."""
    if direction.ndim == 1:
        return np.outer(spread @ density.ravel(), direction)
    return spread @ (density.reshape(-1, 1) * direction.reshape(-1, direction.shape[-1]))
