"""Surfaces that move past each other: drawn in by a tolerance, on the arcs they turn on, and how deep places lie."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from petfsi.geometry.bodies import enclosed
from petfsi.geometry.collisions import Meeting, Way, first_meeting
from petfsi.geometry.rays import nearest_on_facets
from petfsi.geometry.surfaces import ridges


def shortest_edges(points: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return the length of the shortest edge at each point of a surface, m, shape (n,); infinite without one."""
    dim = points.shape[1]
    edges = facets if dim == 2 else ridges(facets).reshape(-1, 2)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    np.minimum.at(shortest, edges, length[:, None])
    return shortest


def drawn_in(points: np.ndarray, facets: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Return points moved into the body by amounts (n,), m: against the mean of the normals of their facets."""
    return _drawn_in(np.ascontiguousarray(points, dtype=float), facets, amount)


@njit(cache=True)
def _drawn_in(points, facets, amount):
    dim = points.shape[1]
    mean, normal = np.zeros(points.shape), np.zeros(dim)
    for f in facets:
        a, b = points[f[0]], points[f[1]]
        if dim == 2:
            normal[0], normal[1] = b[1] - a[1], a[0] - b[0]
        else:
            c = points[f[2]]
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                normal[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
        length = np.sqrt(np.sum(normal**2))
        if length > 0.0:
            for i in f:
                for k in range(dim):
                    mean[i, k] += normal[k] / length
    moved = points.copy()
    for i in range(len(points)):
        length = np.sqrt(np.sum(mean[i] ** 2))
        if length > 0.0:
            moved[i] -= amount[i] / length * mean[i]
    return moved


@njit(cache=True)
def swept_boxes(start, end, first):
    """Return the corners of the box of each body's straight way, and the largest square of how far points turn, m^2.

    Parameters
    ----------
    start, end : ndarray, shape (n, dim)
        m.
    first : ndarray of int, shape (n_bodies + 1,)
        Where each body's points begin.

    Returns
    -------
    low, high : ndarray, shape (n_bodies, dim)
    turned : ndarray, shape (n_bodies,)
        What points move besides their mean.
    """
    n, dim = len(first) - 1, start.shape[1]
    low, high, turned = np.full((n, dim), np.inf), np.full((n, dim), -np.inf), np.zeros(n)
    mean = np.zeros(dim)
    for body in range(n):
        mean[:] = 0.0
        for i in range(first[body], first[body + 1]):
            for a in range(dim):
                low[body, a] = min(low[body, a], min(start[i, a], end[i, a]))
                high[body, a] = max(high[body, a], max(start[i, a], end[i, a]))
                mean[a] += (end[i, a] - start[i, a]) / (first[body + 1] - first[body])
        for i in range(first[body], first[body + 1]):
            square = 0.0
            for a in range(dim):
                square += (end[i, a] - start[i, a] - mean[a]) ** 2
            turned[body] = max(turned[body], square)
    return low, high, turned


def straight_parts(start: np.ndarray, end: np.ndarray, slack: float) -> int:
    """Return into how many straight ways that of a body must be divided, so that none is ``slack`` (m) off an arc.

    An angle a leaves its chord by r a^2/8 at the distance r from the centre.

    Parameters
    ----------
    start, end : ndarray, shape (n, dim)
        Where its points are, m.
    """
    y0, y1 = start - start.mean(axis=0), end - end.mean(axis=0)
    radius = float(np.sqrt(np.max(np.sum(y0**2, axis=1))))
    angle = float(np.linalg.norm(_rotation_vector(y0, y1)))
    return max(1, math.ceil(angle * math.sqrt(radius / (8.0 * slack))))


def stations(start: np.ndarray, end: np.ndarray, n: int) -> list[np.ndarray]:
    """Return where the points of a body are at n + 1 equal times, from start to end, shape (n_points, dim) each.

    The body turns about its centre by the rotation that fits best, evenly, and what it changes in shape in that time
    it changes evenly, as seen by who turns with it.
    """
    if n == 1:
        return [start, end]
    from_centre, to_centre = start.mean(axis=0), end.mean(axis=0)
    y0, y1 = start - from_centre, end - to_centre
    dim, turn = start.shape[1], _rotation_vector(y0, y1)
    back = y1 @ _turned_by(turn)[:dim, :dim]
    between = []
    for part in np.arange(1, n) / n:
        y = ((1.0 - part) * y0 + part * back) @ _turned_by(part * turn)[:dim, :dim].T
        between.append((1.0 - part) * from_centre + part * to_centre + y)
    return [start, *between, end]


def _rotation_vector(y0: np.ndarray, y1: np.ndarray) -> np.ndarray:
    """Return the axis times the angle of the rotation that best takes y0 to y1, shape (3,)."""
    correlation = np.zeros((3, 3))
    dim = y0.shape[1]
    correlation[:dim, :dim] = y1.T @ y0
    u, size, v = np.linalg.svd(correlation)
    u[:, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))
    rotation = u @ v
    axis = 0.5 * np.array([rotation[a, b] - rotation[b, a] for a, b in ((2, 1), (0, 2), (1, 0))])
    sine, cosine = float(np.linalg.norm(axis)), 0.5 * (float(np.trace(rotation)) - 1.0)
    return axis * (np.arctan2(sine, cosine) / sine if sine > 0.0 else 0.0)


def _turned_by(turn: np.ndarray) -> np.ndarray:
    """Return the rotation about an axis, given times its angle (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / angle if angle > 0.0 else turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def first_on_ways(one: Sequence[Way], other: Sequence[Way]) -> Meeting | None:
    """Return where two surfaces meet first, each on its straight ways one after the other, in equal times."""
    for k, ways in enumerate(zip(one, other, strict=True)):
        found = first_meeting(*ways)
        if found is not None:
            return Meeting((k + found.part) / len(one), found.place)
    return None


def depths(at: np.ndarray, points: np.ndarray, facets: np.ndarray, outside: bool = False) -> np.ndarray:
    """Return how deep places (n, dim) lie behind a closed surface, m; negative before it.

    Every facet is looked at for every place. With ``outside`` the surface is that of a room.
    """
    if not len(at):
        return np.zeros(0)
    facet, weights = nearest_on_facets(points, facets, at)
    distance = np.linalg.norm(np.einsum("ni,nia->na", weights, points[facets[facet]]) - at, axis=1)
    within = enclosed(points, facets, at) != outside
    return np.where(within, distance, -distance)
