"""Surfaces that move past each other: drawn in by a tolerance, on the arcs they turn on, and how deep places lie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

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
    """Return the corners of the box of each body's straight way, how far its points turn, and how far it goes itself.

    Parameters
    ----------
    start, end : ndarray, shape (n, dim)
        m.
    first : ndarray of int, shape (n_bodies + 1,)
        Where each body's points begin.

    Returns
    -------
    low, high : ndarray, shape (n_bodies, dim)
    turned, way : ndarray, shape (n_bodies,)
        The most that points move besides their mean, and that, m.
    """
    n, dim = len(first) - 1, start.shape[1]
    low, high = np.full((n, dim), np.inf), np.full((n, dim), -np.inf)
    turned, way = np.zeros(n), np.zeros(n)
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
            turned[body] = max(turned[body], np.sqrt(square))
        way[body] = np.sqrt(np.sum(mean**2))
    return low, high, turned, way


class Turn(NamedTuple):
    """How a body gets from one place to another: about its centre, and that with it.

    Attributes
    ----------
    vector : ndarray, shape (3,)
        Axis times angle of the rotation that fits best.
    arm : ndarray, shape (dim,)
        From the point that this rotation alone leaves in its place to the centre, before; zero where the centre does
        not turn about it but goes straight, m.
    """

    vector: np.ndarray
    arm: np.ndarray

    @property
    def angle(self) -> float:
        """Its angle."""
        return float(np.linalg.norm(self.vector))


def turn_of(start: np.ndarray, end: np.ndarray, velocity: np.ndarray) -> Turn:
    """Return how a body turns whose points go from start to end, shape (n, dim) each.

    Two places do not tell a body that flies and spins from one that turns about a pivot. The direction in which its
    centre sets out does: that of its way, or in 2D half the angle from it. Between the two a part of the arc is taken,
    beyond them all or nothing.

    Parameters
    ----------
    start, end : ndarray, shape (n, dim)
        m.
    velocity : ndarray, shape (dim,)
        Of its centre when it sets out, whatever its length.
    """
    dim = start.shape[1]
    vector = _rotation_vector(start - start.mean(axis=0), end - end.mean(axis=0))
    angle = float(np.linalg.norm(vector))
    way, sets_out = np.zeros((2, 3))
    way[:dim], sets_out[:dim] = end.mean(axis=0) - start.mean(axis=0), velocity
    straight = Turn(vector, np.zeros(dim))
    if angle == 0.0:
        return straight
    axis = vector / angle
    way, sets_out = (v - (v @ axis) * axis for v in (way, sets_out))
    lengths = float(np.linalg.norm(way) * np.linalg.norm(sets_out))
    if lengths == 0.0:
        return straight
    across = np.cross(axis, way)
    before = float(sets_out @ -across) / lengths / math.sin(angle / 2.0)
    arm = -0.5 * way - 0.5 / math.tan(angle / 2.0) * across
    return Turn(vector, min(max(before, 0.0), 1.0) * arm[:dim])


def straight_parts(start: np.ndarray, turn: Turn, slack: float) -> int:
    """Return into how many straight ways that of a body must be divided, so that none is ``slack`` (m) off an arc.

    An angle a leaves its chord by r a^2/8 at the distance r from what it is about.
    """
    radius = float(np.linalg.norm(start - start.mean(axis=0), axis=1).max()) + float(np.linalg.norm(turn.arm))
    return max(1, math.ceil(turn.angle * math.sqrt(radius / (8.0 * slack))))


def stations(start: np.ndarray, end: np.ndarray, turn: Turn, n: int) -> list[np.ndarray]:
    """Return where the points of a body are at n + 1 equal times, from start to end, shape (n_points, dim) each.

    The body turns about its centre by the rotation that fits best, evenly, and what it changes in shape in that time
    it changes evenly, as seen by who turns with it. Its centre leaves its straight way as far as it turns, too.
    """
    from_centre, to_centre = start.mean(axis=0), end.mean(axis=0)
    y0, y1 = start - from_centre, end - to_centre
    dim = start.shape[1]
    whole = _turned_by(turn.vector)[:dim, :dim]
    back = y1 + y1 @ whole
    between = []
    for part in np.arange(1, n) / n:
        change = _turned_by(part * turn.vector)[:dim, :dim]
        y = (1.0 - part) * y0 + part * back
        y += y @ change.T
        off = (change - part * whole) @ turn.arm
        between.append((1.0 - part) * from_centre + part * to_centre + off + y)
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
    """Return the rotation about an axis, given times its angle, less the identity (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / angle if angle > 0.0 else turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.sin(angle) * cross + 2.0 * np.sin(0.5 * angle) ** 2 * cross @ cross


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
