"""What a fluid on a grid is at time zero."""

from __future__ import annotations

import numpy as np

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.sides import wrapped_points
from petfsi.ranks import agreed
from petfsi.scene.expressions import Expression, evaluate_at
from petfsi.scene.tables import Number


def set_initial(grid: MacGrid, text: Number, key: str, array: np.ndarray, axis: int | None) -> None:
    """Fill the owned part of a local array of faces (cells: None) with the values of an expression. Collective."""
    part = grid.owned(axis)
    index = tuple(i.ravel() for i in np.mgrid[part])
    expression, points = Expression(text, key=key), wrapped_points(grid, axis, index)
    values = agreed(grid.comm, lambda: evaluate_at(expression, points, 0.0))
    array[part] = values.reshape(array[part].shape)
