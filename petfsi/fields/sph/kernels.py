"""Smoothing kernels of particles, all of support 2s, where s is the smoothing length.

A kernel is W(r) = alpha/s^dim w(q) with q = r/s, and what the sums over pairs need of its gradient is

    grad_i W(|r|) = F r,   F = W'(r)/r = alpha/s^(dim + 2) f(q),   f(q) = w'(q)/q <= 0,   r = x_i - x_j .

``shape`` gives w and f alone, for compiled passes to inline with the kernel's number known when they are compiled;
``Kernel`` holds the factors. Both are 0 for q >= 2. Left to LLVM the small functions stay calls, so Numba inlines them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numba import njit

WENDLAND, QUADRATIC, CUBIC = 0, 1, 2

NUMBERS = {"wendland": WENDLAND, "quadratic": QUADRATIC, "cubic": CUBIC}
ALPHA = {
    "wendland": {2: 7 / (4 * pi), 3: 21 / (16 * pi)},
    "quadratic": {2: 2 / pi, 3: 5 / (4 * pi)},
    "cubic": {2: 10 / (7 * pi), 3: 1 / pi},
}


@njit(cache=True, inline="always")
def shape(kernel, q):
    """Return w(q) and f(q) = w'(q)/q of the kernel with this number, for q >= 0.

    The quadratic kernel's f has a pole at q = 0, where the direction of its gradient is undefined: below q = 1e-6 it is
    kept constant, so that two particles in one place do not push each other.
    """
    if kernel == WENDLAND:
        t = max(1.0 - 0.5 * q, 0.0)
        cube = t * t * t
        w, f = cube * t * (2.0 * q + 1.0), -5.0 * cube
    elif kernel == QUADRATIC:
        t = max(2.0 - q, 0.0)
        w, f = 0.1875 * t * t, -0.375 * t / max(q, 1e-6)
    elif q < 1.0:
        w, f = 1.0 + q * q * (0.75 * q - 1.5), 2.25 * q - 3.0
    else:
        t = max(2.0 - q, 0.0)
        w, f = 0.25 * t * t * t, -0.75 * t * t / q
    return w, f


@dataclass(frozen=True)
class Kernel:
    """A kernel in space: "wendland" (C2), "quadratic" or "cubic" (spline), with smoothing length s (m).

    References
    ----------
    H. Wendland, Adv. Comput. Math. 4 (1995), 389: C2. J. J. Monaghan, J. C. Lattanzio, Astron. Astrophys. 149 (1985),
    135: cubic spline. G. R. Johnson, S. R. Beissel, Int. J. Numer. Meth. Engng 39 (1996), 2725: quadratic.
    """

    name: str
    dim: int
    s: float

    def __post_init__(self):
        if self.name not in NUMBERS:
            raise ValueError(f"no kernel {self.name!r}; there are {', '.join(NUMBERS)}")
        if self.dim not in (2, 3):
            raise ValueError(f"kernels are for 2 or 3 dimensions, not {self.dim}")
        if not self.s > 0:
            raise ValueError(f"smoothing length is {self.s:g} m; it must be positive")

    @property
    def number(self) -> int:
        """What ``shape`` knows this kernel by."""
        return NUMBERS[self.name]

    @property
    def support(self) -> float:
        """Distance from which W is 0, m."""
        return 2.0 * self.s

    @property
    def w_scale(self) -> float:
        """Return W/w, 1/m^dim."""
        return ALPHA[self.name][self.dim] / self.s**self.dim

    @property
    def f_scale(self) -> float:
        """Return F/f, 1/m^(dim + 2)."""
        return self.w_scale / self.s**2

    def values(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return W (1/m^dim) and F (1/m^(dim + 2)) at distances r (n,), m."""
        w, f = _shapes(self.number, np.ascontiguousarray(r, dtype=float) / self.s)
        return self.w_scale * w, self.f_scale * f

    def at(self, r: float) -> float:
        """Return W at one distance, 1/m^dim."""
        return float(self.values(np.array([r]))[0][0])


@njit(cache=True)
def _shapes(kernel, q):
    w, f = np.empty_like(q), np.empty_like(q)
    for i in range(q.size):
        w[i], f[i] = shape(kernel, q[i])
    return w, f
