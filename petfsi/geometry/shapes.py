"""The analytic shapes of a scene: which points lie in them."""

from __future__ import annotations

import numpy as np

from petfsi.scene.tables import Shape

#: Points this far outside, as a fraction of the shape's size, still count as inside: a point on the boundary
#: must not change sides with round-off.
TOLERANCE = 1e-9


def inside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Return which points lie in a box, ball, cylinder or half space, boundary included.

    Parameters
    ----------
    shape : Shape
        The table of the scene; its ``mesh`` is not handled here.
    points : ndarray, shape (n, dim)
        In m.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    points = np.asarray(points, dtype=float)
    if shape.box is not None:
        return _in_box(points, np.array(shape.box.origin), np.array(shape.box.size))
    if shape.ball is not None:
        distance = np.linalg.norm(points - np.array(shape.ball.centre), axis=1)
        return distance <= shape.ball.radius * (1 + TOLERANCE)
    if shape.cylinder is not None:
        return _in_cylinder(points, np.array(shape.cylinder.start), np.array(shape.cylinder.end), shape.cylinder.radius)
    if shape.halfspace is not None:
        normal = np.array(shape.halfspace.normal, dtype=float)
        height = (points - np.array(shape.halfspace.point)) @ (normal / np.linalg.norm(normal))
        reach = np.abs(points).max(axis=1, initial=0.0) + np.abs(shape.halfspace.point).max()
        return height <= TOLERANCE * reach
    raise ValueError("only a box, ball, cylinder or half space has an analytic inside")


def bounds(shape: Shape) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lower and upper corner of a box, ball or cylinder; None of what has no end or is in a file."""
    if shape.box is not None:
        origin = np.array(shape.box.origin, dtype=float)
        return origin, origin + np.array(shape.box.size)
    if shape.ball is not None:
        centre = np.array(shape.ball.centre, dtype=float)
        return centre - shape.ball.radius, centre + shape.ball.radius
    if shape.cylinder is not None:
        ends = np.array([shape.cylinder.start, shape.cylinder.end], dtype=float)
        return ends.min(axis=0) - shape.cylinder.radius, ends.max(axis=0) + shape.cylinder.radius
    return None


def _in_box(points: np.ndarray, origin: np.ndarray, size: np.ndarray) -> np.ndarray:
    slack = TOLERANCE * size.max()
    return np.all((points >= origin - slack) & (points <= origin + size + slack), axis=1)


def _in_cylinder(points: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length
    along = (points - start) @ axis
    across = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
    slack = TOLERANCE * max(length, radius)
    return (along >= -slack) & (along <= length + slack) & (across <= radius + slack)
