"""St Venant-Kirchhoff: Green's strain with a linear isotropic stress."""

from __future__ import annotations

import numpy as np

from petfsi.compiled import compiled_for
from petfsi.fields.solid.materials.kinematics import twice_green_strain


def green(
    H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, stress and exact tangent of the St Venant-Kirchhoff material.

    Green's strain with a linear isotropic stress:

        E = (H + H^T + H^T H) / 2,    S = lambda tr(E) I + 2 mu E,    W = S : E / 2,    P = F S,
        C[i,J,k,L] = d_ik S_JL + lambda F_iJ F_kL + mu ((F F^T)_ik d_JL + F_iL F_kJ).

    Softens in compression: a bar's stiffness is gone at 0.58 of its length.

    References
    ----------
    J. F. O'Brien, J. K. Hodgins, Graphical modeling and animation of brittle fracture (1999), section 3.
    """
    return _KERNELS[H.shape[1]](H, lame, mu, tangent)


def _compile(dim):
    # dim as a constant of the closure lets the compiler unroll the loops over axes

    @compiled_for(dim, error_model="numpy")
    def kernel(H, lame, mu, tangent):
        n = H.shape[0]
        W = np.empty(n)
        P = np.empty((n, dim, dim))
        C = np.empty((n if tangent else 0, dim, dim, dim, dim))
        S, B, F, strain = np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim))
        for e in range(n):
            twice_green_strain(H[e], strain)
            trace = square = 0.0
            for i in range(dim):
                trace += 0.5 * strain[i, i]
                for j in range(dim):
                    F[i, j] = H[e, i, j] + (1.0 if i == j else 0.0)
                    square += 0.25 * strain[i, j] * strain[i, j]
                    S[i, j] = mu[e] * strain[i, j]
            W[e] = 0.5 * lame[e] * trace * trace + mu[e] * square
            for i in range(dim):
                S[i, i] += lame[e] * trace
            for i in range(dim):
                for j in range(dim):
                    P[e, i, j] = B[i, j] = 0.0
                    for k in range(dim):
                        P[e, i, j] += F[i, k] * S[k, j]
                        B[i, j] += F[i, k] * F[j, k]
            if not tangent:
                continue
            shear = mu[e]
            for i in range(dim):
                for J in range(dim):
                    own = lame[e] * F[i, J]
                    for k in range(dim):
                        crossed = shear * F[k, J]
                        for L in range(dim):
                            C[e, i, J, k, L] = own * F[k, L] + crossed * F[i, L]
                        C[e, i, J, k, J] += shear * B[i, k]
                    for L in range(dim):
                        C[e, i, J, i, L] += S[J, L]
        return W, P, C

    return kernel


_KERNELS = {2: _compile(2), 3: _compile(3)}
