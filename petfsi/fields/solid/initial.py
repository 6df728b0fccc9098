"""How bodies are displaced and move at time zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from petfsi.fields.solid.supports import Supports
from petfsi.petsc import Layout
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


@dataclass(frozen=True)
class Start:
    """How this rank's nodes set off.

    Attributes
    ----------
    displacement, velocity : ndarray, shape (n_owned, width)
        m and m/s.
    prescribed, jump : ndarray
        Of all held unknowns the velocity at time zero, and what it differs by from the one given, m/s.
    """

    displacement: np.ndarray
    velocity: np.ndarray
    prescribed: np.ndarray
    jump: np.ndarray


def set_off(
    supports: Supports, layout: Layout, number: np.ndarray, mine: np.ndarray, displacement: np.ndarray,
    velocity: np.ndarray, has_inertia: bool, dt: float,
) -> Start:  # fmt: skip
    """Return how nodes set off from where they are given to be, with what supports prescribe. Not collective.

    Without inertia the first step is the way there from the given displacement.

    Parameters
    ----------
    supports : Supports
    layout : Layout
        Of the unknowns.
    number : ndarray of int, shape (n,)
        Global number of each node of the whole mesh.
    mine : ndarray of int, shape (n_owned,)
        Those of this rank.
    displacement, velocity : ndarray, shape (n, width)
    has_inertia : bool
    dt : float
        Of the first step, s.
    """
    own_d, own_v = displacement[mine], velocity[mine]
    prescribed = supports.initial_velocities(dt)
    held, placed = supports.unknowns, supports.placed
    given = np.empty_like(velocity)
    given[number] = velocity
    jump = supports.jumps(given.ravel()[held], dt)
    here = (held >= layout.start) & (held < layout.end)
    if has_inertia:
        own_v.reshape(-1)[held[here] - layout.start] = prescribed[here]
        here = here[placed]
        where = held[placed][here] - layout.start
        own_d.reshape(-1)[where] = supports.displacements(0.0)[here]
    return Start(own_d, own_v, prescribed, jump)
