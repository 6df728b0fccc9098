"""How parts of a body turn: rotations and spins that fit gradients best, and what straight predictions lack of them."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

#: What ``missing`` adds to: F + r (F - F0) of two gradients, F + h F' of a gradient and its rate, or F itself.
ONWARD, SETTING_OUT, IN_PLACE = range(3)
#: Rotations are found to round-off in so many of Newton's iterations, or are none.
_ITERATIONS = 20


class Gradients:
    """Derivatives in simplices, or along segments.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
    parts : ndarray of int, shape (ne, m + 1)

    Attributes
    ----------
    matrix : csr_matrix, shape (ne * m, n)
        From values at nodes to derivatives along the m axes of every part.
    rest : ndarray, shape (ne, m, dim)
        Those of the points.
    size : ndarray, shape (ne,)
        m^m.
    m : int
    """

    def __init__(self, points: np.ndarray, parts: np.ndarray) -> None:
        gradients, self.size = _gradients(points[parts])
        ne, self.m = gradients.shape[:2]
        rows = np.repeat(np.arange(ne * self.m), parts.shape[1])
        columns = np.repeat(parts, self.m, axis=0).ravel()
        self.matrix = csr_matrix((gradients.ravel(), (rows, columns)), shape=(ne * self.m, len(points)))
        self.rest = self(points)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of values at the nodes, (n, dim), shape (ne, m, dim)."""
        return (self.matrix @ values).reshape(-1, self.m, values.shape[1])

    def speeds(self, d: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return how fast every part turns, displaced by d and with the velocities u at the nodes, rad/s."""
        speeds = np.empty(len(self.size))
        _speeds(self.rest + self(d), self(u), speeds)
        return speeds


def _gradients(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape functions' gradients of simplices, and their sizes.

    Parameters
    ----------
    corners : ndarray, shape (ne, m + 1, dim)
        m = dim, or m = 1 of segments: then along them.

    Returns
    -------
    gradients : ndarray, shape (ne, m, m + 1)
    size : ndarray, shape (ne,)
        m^m: length, area or volume.
    """
    edges = corners[:, 1:] - corners[:, :1]
    m = edges.shape[1]
    if m == 1:
        length = np.linalg.norm(edges[:, 0], axis=1)
        return np.stack((-1 / length, 1 / length), axis=1)[:, None], length
    inverse = np.linalg.inv(edges)
    size = np.abs(np.linalg.det(edges)) / (2.0 if m == 2 else 6.0)
    return np.concatenate((-inverse.sum(axis=2, keepdims=True), inverse), axis=2), size


@njit(cache=True)
def missing(now, past, h, kind, out):
    """Write what the gradients of straight predictions lack.

    Parameters
    ----------
    now, out : ndarray, shape (ne, m, dim)
        [e, a, b]: d x_b / d X_a.
    past : ndarray, shape (ne, m, dim)
        Of the positions a step ago, or of the velocities.
    h : float
        The steps' ratio, or the step.
    kind : int
    """
    ne, m, dim = now.shape
    turn, other, v = np.zeros(3), np.zeros(3), np.zeros(3)
    w, first = np.zeros(3), np.zeros(3)
    for e in range(ne):
        if kind == ONWARD:
            _rotation(past[e], now[e], turn)
            for b in range(3):
                other[b] = h * turn[b]
        else:
            _spin(now[e], past[e], turn)
            speed = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
            angle = 2.0 * np.arctan(0.5 * h * speed)
            for b in range(3):
                other[b] = angle * turn[b] / speed if speed > 0.0 else 0.0
        for a in range(m):
            for b in range(dim):
                v[b] = now[e, a, b]
            if kind == ONWARD:
                # (R' - 1)(F + r (F - R F0)) - r (R - 1) F0
                for b in range(dim):
                    v[b] = past[e, a, b]
                _turned_by(turn, v, first)
                for b in range(dim):
                    v[b] = now[e, a, b] + h * (now[e, a, b] - past[e, a, b] - first[b])
                _turned_by(other, v, w)
                for b in range(dim):
                    out[e, a, b] = w[b] - h * first[b]
            elif kind == SETTING_OUT:
                # (R - 1)(F + h (F' - w x F)) - h w x F
                first[0] = turn[1] * v[2] - turn[2] * v[1]
                first[1] = turn[2] * v[0] - turn[0] * v[2]
                first[2] = turn[0] * v[1] - turn[1] * v[0]
                for b in range(dim):
                    v[b] += h * (past[e, a, b] - first[b])
                _turned_by(other, v, w)
                for b in range(dim):
                    out[e, a, b] = w[b] - h * first[b]
            else:
                _turned_by(other, v, w)
                for b in range(dim):
                    out[e, a, b] = w[b]


@njit(cache=True)
def _turned_by(turn, v, out):
    """Write (R - 1) v of the rotation by a vector, without cancellation: 2 s c k x v + 2 s^2 k x (k x v)."""
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    for b in range(3):
        out[b] = 0.0
    if angle == 0.0:
        return
    s, c = np.sin(0.5 * angle), np.cos(0.5 * angle)
    k0, k1, k2 = turn[0] / angle, turn[1] / angle, turn[2] / angle
    a0, a1, a2 = k1 * v[2] - k2 * v[1], k2 * v[0] - k0 * v[2], k0 * v[1] - k1 * v[0]
    out[0] = 2 * s * (c * a0 + s * (k1 * a2 - k2 * a1))
    out[1] = 2 * s * (c * a1 + s * (k2 * a0 - k0 * a2))
    out[2] = 2 * s * (c * a2 + s * (k0 * a1 - k1 * a0))


@njit(cache=True)
def _spin(now, rate, out):
    """Write the angular velocity w that makes sum_a |rate_a - w x now_a|^2 least."""
    m, dim = now.shape
    moment, inertia = np.zeros(3), np.zeros((3, 3))
    unused = np.zeros(3)
    for a in range(m):
        _add_moments(now[a], rate[a], dim, moment, np.zeros((3, 3)))
        _add_moments(now[a], now[a], dim, unused, inertia)
    _solve(inertia, moment, dim, out)


@njit(cache=True)
def _speeds(now, rate, out):
    """Write the angular speed of every part."""
    w = np.zeros(3)
    for e in range(len(now)):
        _spin(now[e], rate[e], w)
        out[e] = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)


@njit(cache=True)
def _add_moments(x, y, dim, moment, inertia):
    """Add x cross y and (x . y) 1 - sym(x y^T)."""
    if dim == 2:
        moment[2] += x[0] * y[1] - x[1] * y[0]
        inertia[2, 2] += x[0] * y[0] + x[1] * y[1]
        return
    moment[0] += x[1] * y[2] - x[2] * y[1]
    moment[1] += x[2] * y[0] - x[0] * y[2]
    moment[2] += x[0] * y[1] - x[1] * y[0]
    dot = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    for i in range(3):
        inertia[i, i] += dot
        for j in range(3):
            inertia[i, j] -= 0.5 * (x[i] * y[j] + x[j] * y[i])


@njit(cache=True)
def _solve(inertia, moment, dim, out):
    """Solve inertia w = moment; return whether that has a meaning: zero is written else."""
    for b in range(3):
        out[b] = 0.0
    if dim == 2:
        if inertia[2, 2] > 0.0:
            out[2] = moment[2] / inertia[2, 2]
        return inertia[2, 2] > 0.0
    a, b, c = inertia[0, 0], inertia[1, 1], inertia[2, 2]
    d, e, f = inertia[1, 2], inertia[0, 2], inertia[0, 1]
    c0, c1, c2 = b * c - d * d, e * d - f * c, f * d - e * b
    determinant = a * c0 + f * c1 + e * c2
    trace = a + b + c
    if not (trace > 0.0 and determinant > 1e-12 * trace**3):
        return False
    out[0] = (c0 * moment[0] + c1 * moment[1] + c2 * moment[2]) / determinant
    out[1] = (c1 * moment[0] + (a * c - e * e) * moment[1] + (e * f - a * d) * moment[2]) / determinant
    out[2] = (c2 * moment[0] + (e * f - a * d) * moment[1] + (a * b - f * f) * moment[2]) / determinant
    return True


@njit(cache=True)
def _rotation(before, now, out):
    """Write the vector of the rotation R that makes sum_a |now_a - R before_a|^2 least; zero if there is none."""
    m, dim = now.shape
    moment, inertia, delta = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for b in range(3):
        out[b] = 0.0
    if dim == 2:
        for a in range(m):
            _add_moments(before[a], now[a], dim, moment, inertia)
        out[2] = np.arctan2(moment[2], inertia[2, 2])
        return
    x, back = np.empty((m, 3)), np.empty(3)
    q, p = np.array([1.0, 0.0, 0.0, 0.0]), np.empty(4)
    for _ in range(_ITERATIONS):
        for a in range(m):
            _turned_by(out, before[a], back)
            for b in range(3):
                x[a, b] = before[a, b] + back[b]
        moment[:] = 0.0
        inertia[:] = 0.0
        for a in range(m):
            _add_moments(x[a], now[a], dim, moment, inertia)
        if not _solve(inertia, moment, dim, delta):
            break
        size = np.sqrt(delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2)
        if size < 1e-15:
            return
        s = np.sin(0.5 * size) / size
        p[0], p[1], p[2], p[3] = np.cos(0.5 * size), s * delta[0], s * delta[1], s * delta[2]
        _multiply(p, q)
        sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        angle = 2.0 * np.arctan2(sine, q[0])
        for b in range(3):
            out[b] = angle * q[1 + b] / sine if sine > 0.0 else 0.0
        if size < 1e-9:  # it converges quadratically
            return
    for b in range(3):
        out[b] = 0.0


@njit(cache=True)
def _multiply(p, q):
    """Replace the quaternion q by p q."""
    w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    x = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    y = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    z = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    q[0], q[1], q[2], q[3] = w, x, y, z
