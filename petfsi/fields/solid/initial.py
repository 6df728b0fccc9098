"""How bodies are displaced and move at time zero."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from petfsi.scene.expressions import Expression
from petfsi.scene.solids import Solid


def initial_values(
    solids: Mapping[str, Solid], quantity: str, points: np.ndarray, node_body: np.ndarray, width: int
) -> np.ndarray:
    """Return what the scene says of a quantity at all nodes, zero where it says nothing, shape (n, width).

    Every rank evaluates all, so that all meet the same error.

    Parameters
    ----------
    solids : mapping of str to Solid
    quantity : str
        ``displacement`` or ``velocity``.
    points : ndarray, shape (n, dim)
        Of the whole mesh, at rest.
    node_body : ndarray of int, shape (n,)
    width : int
        Unknowns a node.
    """
    values = np.zeros((len(points), width))
    for body, (name, solid) in enumerate(solids.items()):
        nodes = np.flatnonzero(node_body == body)
        coordinates = {"z": 0.0, **dict(zip("xyz", points[nodes].T, strict=False))}
        for axis, source in enumerate(getattr(solid.initial, quantity) or []):
            expression = Expression(source, key=f"solids.{name}.initial.{quantity}.{axis}")
            values[nodes, axis] = expression(t=0.0, **coordinates)
    return values
