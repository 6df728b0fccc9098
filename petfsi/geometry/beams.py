"""Straight beams in the plane as nodes along an axis, and the strip that they fill."""

from __future__ import annotations

import numpy as np

from petfsi.scene.tables import Beam

#: Nodes of an element along the axis, in the order start, end, middle.
_ELEMENT = {"timoshenko": np.array([0, 2, 1]), "euler-bernoulli": np.array([0, 1])}


def axis_mesh(beam: Beam) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes from start to end, equally spaced, and the nodes of each element.

    Returns
    -------
    points : ndarray, shape (n, 2)
        m.
    cells : ndarray of int, shape (elements, 3) or (elements, 2)
        Start, end and, if the theory has one, middle.
    """
    element = _ELEMENT[beam.theory]
    step = len(element) - 1
    s = np.arange(step * beam.elements + 1) / (step * beam.elements)
    points = (1 - s)[:, None] * np.array(beam.start) + s[:, None] * np.array(beam.end)
    return points, step * np.arange(beam.elements)[:, None] + element


def direction(beam: Beam) -> np.ndarray:
    """Return the unit vector from start to end."""
    along = np.array(beam.end) - np.array(beam.start)
    return along / np.linalg.norm(along)


def strip_mesh(beam: Beam) -> tuple[np.ndarray, np.ndarray]:
    """Return the strip between the faces at rest as points and positively oriented triangles.

    Points ``2 n`` and ``2 n + 1`` are on the right and on the left of node ``n``, seen along the axis.
    """
    points, _ = axis_mesh(beam)
    angle = np.full(len(points), np.arctan2(*direction(beam)[::-1]))
    offsets = face_offsets(angle, np.full(len(points), beam.thickness))
    return (points[:, None] + offsets).reshape(-1, 2), strip_cells(len(points))


def strip_cells(n: int) -> np.ndarray:
    """Return two triangles between each of ``n`` nodes and the next, shape (2 n - 2, 3)."""
    quad = 2 * np.arange(n - 1)[:, None] + np.array([0, 2, 3, 1])
    return quad[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def strip_facets(n: int) -> np.ndarray:
    """Return the strip's outline as segments with the strip on their left, shape (2 n, 2)."""
    right, left = 2 * np.arange(n), 2 * np.arange(n)[::-1] + 1
    around = np.concatenate((right, left))
    return np.column_stack((around, np.roll(around, -1)))


def face_offsets(angle: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Return z n at z = -h/2 and h/2 with n = (-sin, cos) of the section's angle, shape (n, 2, 2): node, face, axis."""
    z = np.array([-0.5, 0.5]) * thickness[:, None]
    return z[:, :, None] * np.column_stack((-np.sin(angle), np.cos(angle)))[:, None, :]


def face_slopes(angle: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Return d/d(angle) of ``face_offsets``, in the same shape."""
    z = np.array([-0.5, 0.5]) * thickness[:, None]
    return z[:, :, None] * np.column_stack((-np.cos(angle), -np.sin(angle)))[:, None, :]
