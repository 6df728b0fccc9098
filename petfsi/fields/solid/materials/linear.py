"""Hooke's law for small strains."""

from __future__ import annotations

import numpy as np

from petfsi.compiled import compiled_for


def linear(
    H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, stress and the constant tangent of linear elasticity.

        e = (H + H^T) / 2,    P = lambda tr(e) I + 2 mu e,    W = P : e / 2,
        C[i,J,k,L] = lambda d_iJ d_kL + mu (d_ik d_JL + d_iL d_kJ).

    Good for small strains and small rotations only: a rotation by an angle a costs strain of a^2/2.

    References
    ----------
    T. J. R. Hughes, The Finite Element Method (2000), section 2.7.
    """
    return _KERNELS[H.shape[1]](H, lame, mu, tangent)


def _compile(dim):
    # dim as a constant of the closure lets the compiler unroll the loops over axes

    @compiled_for(dim, error_model="numpy")
    def kernel(H, lame, mu, tangent):
        n = H.shape[0]
        W = np.empty(n)
        P = np.empty((n, dim, dim))
        C = np.zeros((n if tangent else 0, dim, dim, dim, dim))
        for e in range(n):
            trace = square = 0.0
            for i in range(dim):
                trace += H[e, i, i]
            for i in range(dim):
                for J in range(dim):
                    strain = 0.5 * (H[e, i, J] + H[e, J, i])
                    square += strain * strain
                    P[e, i, J] = 2 * mu[e] * strain + (lame[e] * trace if i == J else 0.0)
            W[e] = 0.5 * lame[e] * trace * trace + mu[e] * square
            if not tangent:
                continue
            for i in range(dim):
                for J in range(dim):
                    C[e, i, i, J, J] += lame[e]
                    C[e, i, J, i, J] += mu[e]
                    C[e, i, J, J, i] += mu[e]
        return W, P, C

    return kernel


_KERNELS = {2: _compile(2), 3: _compile(3)}
