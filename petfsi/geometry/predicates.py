"""Which side of a line or plane a point lies on, never zero and never wrong.

The sign is exact (a floating-point filter, then expansions), and points that lie on it are moved to one side by
simulation of simplicity: every query point p stands for p + (e₀, e₁, e₂) with infinitesimal e₀ ≫ e₁ ≫ e₂ > 0. All
tests about one point then agree with each other, whatever is degenerate.

References
----------
J. R. Shewchuk, Discrete Comput. Geom. 18 (1997) 305; H. Edelsbrunner, E. Mücke, ACM Trans. Graph. 9 (1990) 66.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# the bounds of the plain formulas' rounding errors, relative to the sum of their terms' magnitudes (Shewchuk)
_FILTER_2D = 3.3306690738754716e-16
_FILTER_3D = 7.7715611723761027e-16
_SPLITTER = 134217729.0  # 2^27 + 1


@njit(cache=True)
def _two_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum and its exact error."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


@njit(cache=True)
def _two_product(a: float, b: float) -> tuple[float, float]:
    """Return the rounded product and its exact error."""
    p = a * b
    t = _SPLITTER * a
    a_hi = t - (t - a)
    a_lo = a - a_hi
    t = _SPLITTER * b
    b_hi = t - (t - b)
    b_lo = b - b_hi
    return p, a_lo * b_lo - (((p - a_hi * b_hi) - a_lo * b_hi) - a_hi * b_lo)


@njit(cache=True)
def _sign_of_sum(parts: np.ndarray) -> int:
    """Return the sign of a sum, taken without any rounding; overwrites the parts."""
    for n in range(len(parts)):
        carry = parts[n]
        for k in range(n):
            carry, parts[k] = _two_sum(carry, parts[k])
        parts[n] = carry
    for k in range(len(parts) - 1, -1, -1):
        if parts[k] != 0.0:
            return 1 if parts[k] > 0.0 else -1
    return 0


@njit(cache=True)
def _exact_turn(px: float, py: float, ux: float, uy: float, vx: float, vy: float) -> int:
    """Return the sign of (u - p) x (v - p)."""
    left = (ux, -ux, -px, -uy, uy, py)
    right = (vy, py, vy, vx, px, vx)
    parts = np.empty(12)
    for i in range(6):
        parts[2 * i], parts[2 * i + 1] = _two_product(left[i], right[i])
    return _sign_of_sum(parts)


@njit(cache=True)
def _turn(px: float, py: float, ux: float, uy: float, vx: float, vy: float) -> int:
    """Return the sign of (u - p) x (v - p), 0 on the line."""
    a = (ux - px) * (vy - py)
    b = (uy - py) * (vx - px)
    if abs(a - b) > _FILTER_2D * (abs(a) + abs(b)):
        return 1 if a > b else -1
    return _exact_turn(px, py, ux, uy, vx, vy)


@njit(cache=True)
def side(px: float, py: float, ux: float, uy: float, vx: float, vy: float, x_first: bool) -> int:
    """Return +1 if the moved point p lies left of the line from u to v, -1 if right, 0 only where u equals v.

    ``x_first`` says whether the infinitesimal of x outweighs that of y.
    """
    turn = _turn(px, py, ux, uy, vx, vy)
    if turn != 0:
        return turn
    # the derivatives of (u - p) x (v - p) with p
    by_x, by_y = np.sign(uy - vy), np.sign(vx - ux)
    first, second = (by_x, by_y) if x_first else (by_y, by_x)
    return int(first) if first != 0.0 else int(second)


@njit(cache=True)
def _exact_height(p: np.ndarray, q: np.ndarray) -> int:
    """Return the sign of det(q₁ - q₀, q₂ - q₀, p - q₀), expanded into products of coordinates."""
    corners = np.empty((4, 3))
    corners[:3], corners[3] = q, p
    parts = np.empty(96)
    n = 0
    for left_out in range(4):  # [q₁ q₂ p] - [q₀ q₂ p] + [q₀ q₁ p] - [q₀ q₁ q₂]
        u = corners[1 if left_out == 0 else 0]
        v = corners[1 if left_out > 1 else 2]
        w = corners[2 if left_out == 3 else 3]
        sign = -1.0 if left_out % 2 else 1.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for one, other, flip in ((j, k, sign), (k, j, -sign)):
                high, low = _two_product(v[one], w[other])
                parts[n], parts[n + 1] = _two_product(flip * u[i], high)
                parts[n + 2], parts[n + 3] = _two_product(flip * u[i], low)
                n += 4
    return _sign_of_sum(parts)


@njit(cache=True)
def above(p: np.ndarray, q: np.ndarray) -> int:
    """Return +1 if the moved point p lies on the normal's side of the plane of a triangle q, -1 if on the other.

    0 only where the triangle has no area.
    """
    ax, ay, az = q[0, 0] - p[0], q[0, 1] - p[1], q[0, 2] - p[2]
    bx, by, bz = q[1, 0] - p[0], q[1, 1] - p[1], q[1, 2] - p[2]
    cx, cy, cz = q[2, 0] - p[0], q[2, 1] - p[1], q[2, 2] - p[2]
    det = ax * (by * cz - bz * cy) + bx * (cy * az - cz * ay) + cx * (ay * bz - az * by)
    size = abs(ax) * (abs(by * cz) + abs(bz * cy))
    size += abs(bx) * (abs(cy * az) + abs(cz * ay)) + abs(cx) * (abs(ay * bz) + abs(az * by))
    if abs(det) > _FILTER_3D * size:
        return -1 if det > 0.0 else 1
    sign = _exact_height(p, q)
    for a in range(3):
        if sign == 0:  # the normal's component along each axis in turn
            b, c = (a + 1) % 3, (a + 2) % 3
            sign = _turn(q[0, b], q[0, c], q[1, b], q[1, c], q[2, b], q[2, c])
    return sign
