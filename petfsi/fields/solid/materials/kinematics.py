"""What materials compute of a displacement gradient H, without losing small strains or rotations to round-off."""

from __future__ import annotations

from math import log1p
from typing import Protocol

import numpy as np
from numba import njit


class Material(Protocol):
    """What a material is called with; the package says what the arrays are."""

    def __call__(
        self, H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return W, P and C."""
        ...


@njit(cache=True, inline="always")
def twice_green_strain(H, B):
    """Set B = F^T F - I = H + H^T + H^T H, twice Green's strain: small as H, and round-off for a rotation."""
    dim = H.shape[0]
    for i in range(dim):
        for j in range(dim):
            b = H[i, j] + H[j, i]
            for k in range(dim):
                b += H[k, i] * H[k, j]
            B[i, j] = b


@njit(cache=True)
def cofactor_2d(F, cof):
    """Set cof = det(F) F^-T."""
    cof[0, 0], cof[0, 1] = F[1, 1], -F[1, 0]
    cof[1, 0], cof[1, 1] = -F[0, 1], F[0, 0]


@njit(cache=True)
def cofactor_3d(F, cof):
    """Set cof = det(F) F^-T."""
    for i in range(3):
        for J in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (J + 1) % 3, (J + 2) % 3
            cof[i, J] = F[a, c] * F[b, d] - F[a, d] * F[b, c]


@njit(cache=True)
def higher_invariants_2d(B):
    """Return det(I + B) - 1 - tr(B)."""
    return B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]


@njit(cache=True)
def higher_invariants_3d(B):
    """Return det(I + B) - 1 - tr(B)."""
    second = third = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        second += B[i, i] * B[j, j] - B[i, j] * B[j, i]
        third += B[0, i] * (B[1, j] * B[2, k] - B[1, k] * B[2, j])
    return second + third


@njit(cache=True)
def log_excess(x):
    """Return x - ln(1 + x) to round-off also for small x, where it is x^2/2.

    With y = x / (2 + x), ln(1 + x) is 2 artanh(y) and x - 2 y is x y.
    """
    if abs(x) > 0.2:
        return x - log1p(x)
    y = x / (2 + x)
    z = y * y
    tail = 0.0
    for n in range(8, 0, -1):
        tail = z * (tail + 1 / (2 * n + 1))
    return x * y - 2 * y * tail


@njit(cache=True, inline="always")
def cofactor(F, cof, dim):
    """Set cof = det(F) F^-T; a function of ``dim``, as a closure that holds compiled ones is not cached on disk."""
    if dim == 2:
        cofactor_2d(F, cof)
    else:
        cofactor_3d(F, cof)


@njit(cache=True, inline="always")
def higher_invariants(B, dim):
    """Return det(I + B) - 1 - tr(B)."""
    return higher_invariants_2d(B) if dim == 2 else higher_invariants_3d(B)
