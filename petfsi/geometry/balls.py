"""Disks and balls as meshes: a square or cube of cells, mapped to the round shape."""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations

import numpy as np

from petfsi.scene.tables import Ball

#: How large the undistorted square in the middle is, and how far directions are spread evenly over the sphere
#: rather than over the cube (0 to 1). Of the maps tried these give about the best-shaped worst simplex.
CORE, EVEN = 0.95, 0.5


def ball_mesh(ball: Ball, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of a meshed disk or ball; the simplices of one grid cell follow each other.

    The points of the boundary lie on the circle or sphere, those of the axes on the axes. The mesh is its own
    image under all reflections and exchanges of axes. Not collective.

    Parameters
    ----------
    ball : Ball
        With ``cells``, the even number of cells along each axis.
    dim : int

    Returns
    -------
    points : ndarray, shape ((cells + 1)^dim, dim)
        m, x slowest.
    cells : ndarray of int, shape (dim! cells^dim, dim + 1)
        Positively oriented.
    """
    assert ball.cells is not None
    points, cells = unit_ball(dim, ball.cells)
    return np.array(ball.centre) + ball.radius * points, cells.copy()


@lru_cache(maxsize=2)
def unit_ball(dim: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of the ball of radius 1 around the origin, ``n`` cells along each axis.

    They are kept for the next one, many bodies being alike: neither may be changed.
    """
    line = (2.0 * np.arange(n + 1) - n) / n
    cube = np.stack(np.meshgrid(*[line] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    points, cells = _rounded(cube), _cells(dim, n)
    for array in (points, cells):
        array.flags.writeable = False
    return points, cells


def _rounded(cube: np.ndarray) -> np.ndarray:
    """Return the points of the ball that belong to points of the cube [-1, 1]^dim.

    With m the largest coordinate in size, so that e = x / m lies on the cube's surface, a point goes to

        m ((1 - m) CORE e + m w / norm(w)),    w = (1 - EVEN) e + EVEN tan(pi/4 e):

    from a scaled cube in the middle to the sphere at m = 1.
    """
    m = np.abs(cube).max(axis=1, keepdims=True)
    e = cube / np.where(m > 0, m, 1.0)
    w = (1.0 - EVEN) * e + EVEN * np.tan(0.25 * np.pi * e)
    length = np.linalg.norm(w, axis=1, keepdims=True)
    return m * ((1.0 - m) * CORE * e + m * w / np.where(length > 0, length, 1.0))


def _cells(dim: int, n: int) -> np.ndarray:
    """Return the simplices of a cube of n cells per axis, n even.

    Every cell falls into the simplices around the diagonal that leads away from the middle (Kuhn). Where the map
    opens a corner or an edge of the cube to 180 degrees, a diagonal halves the angle.
    """
    stride = (n + 1) ** np.arange(dim)[::-1]
    grid = np.stack(np.meshgrid(*[np.arange(n)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    outward = np.where(2 * grid >= n, 1, -1)
    corner = (grid + (outward < 0)) @ stride
    simplices = []
    for path in permutations(range(dim)):
        axes = list(path)
        steps = np.cumsum((outward * stride)[:, axes], axis=1)
        simplex = corner[:, None] + np.column_stack((np.zeros(len(grid), dtype=np.int64), steps))
        left_handed = np.linalg.det(np.eye(dim)[axes]) * outward.prod(axis=1) < 0
        simplex[left_handed, :2] = simplex[left_handed, 1::-1]
        simplices.append(simplex)
    return np.stack(simplices, axis=1).reshape(-1, dim + 1)
