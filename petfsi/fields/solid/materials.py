"""Hyperelastic materials: from displacement gradients to energy, stress and tangent.

A material is one function of arrays, ``material(H, lame, mu) -> W, P, C``, with the deformation gradient F = I + H and

    H     (n, dim, dim)             displacement gradient dd/dX: strains far below 1 would drown in F's round-off
    lame  (n,), mu (n,)             Lame parameters, Pa
    W     (n,)                      energy density, J/m^3
    P     (n, dim, dim)             first Piola-Kirchhoff stress dW/dF, Pa
    C     (n, dim, dim, dim, dim)   tangent, C[i, J, k, L] = dP[i, J] / dF[k, L], Pa

It is given a few hundred gradients at a time. In 2D strain is plane: F has no third direction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

Material = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def lame_parameters(young: float, poisson: float) -> tuple[float, float]:
    """Return Lame's (lambda, mu) of an isotropic material (plane strain in 2D), Pa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def green(H: np.ndarray, lame: np.ndarray, mu: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, stress and exact tangent of the St Venant-Kirchhoff material.

    Green's strain with a linear isotropic stress:

        E = (H + H^T + H^T H) / 2,    S = lambda tr(E) I + 2 mu E,    W = S : E / 2,    P = F S,
        C[i,J,k,L] = d_ik S_JL + lambda F_iJ F_kL + mu ((F F^T)_ik d_JL + F_iL F_kJ).

    References
    ----------
    J. F. O'Brien, J. K. Hodgins, Graphical modeling and animation of brittle fracture (1999), section 3.
    """
    return (_green_2d if H.shape[1] == 2 else _green_3d)(H, lame, mu)


def _compile_green(dim: int) -> Material:
    # dim as a constant of the closure lets the compiler unroll the loops over axes

    @njit(cache=True, error_model="numpy")
    def kernel(H, lame, mu):
        n = H.shape[0]
        W = np.empty(n)
        P = np.empty((n, dim, dim))
        C = np.empty((n, dim, dim, dim, dim))
        S = np.empty((dim, dim))
        B = np.empty((dim, dim))
        F = np.empty((dim, dim))
        for e in range(n):
            for i in range(dim):
                for j in range(dim):
                    F[i, j] = H[e, i, j] + (1.0 if i == j else 0.0)
            trace = 0.0
            for i in range(dim):
                for j in range(dim):
                    strain = H[e, i, j] + H[e, j, i]
                    B[i, j] = 0.0
                    for k in range(dim):
                        strain += H[e, k, i] * H[e, k, j]
                        B[i, j] += F[i, k] * F[j, k]
                    if i == j:
                        trace += 0.5 * strain
                    S[i, j] = mu[e] * strain
            W[e] = 0.5 * lame[e] * trace * trace
            for i in range(dim):
                for j in range(dim):
                    W[e] += 0.25 / mu[e] * S[i, j] * S[i, j]
            for i in range(dim):
                S[i, i] += lame[e] * trace
            for i in range(dim):
                for J in range(dim):
                    P[e, i, J] = 0.0
                    for k in range(dim):
                        P[e, i, J] += F[i, k] * S[k, J]
                        for L in range(dim):
                            c = lame[e] * F[i, J] * F[k, L] + mu[e] * F[i, L] * F[k, J]
                            if i == k:
                                c += S[J, L]
                            if J == L:
                                c += mu[e] * B[i, k]
                            C[e, i, J, k, L] = c
        return W, P, C

    return kernel


_green_2d = _compile_green(2)
_green_3d = _compile_green(3)

#: The scene's ``solids.*.material`` by name.
MATERIALS: dict[str, Material] = {"green": green}
