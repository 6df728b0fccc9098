"""The compressible neo-Hookean material with the square of a logarithm."""

from __future__ import annotations

from math import log, log1p

import numpy as np

from petfsi.compiled import compiled_for
from petfsi.fields.solid.materials.kinematics import cofactor, higher_invariants, log_excess, twice_green_strain


def neohookean(
    H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, stress and exact tangent of the neo-Hookean material.

    With J = det F, I1 = F : F and G = F^-T,

        W = mu/2 (I1 - dim) - mu ln J + lambda/2 (ln J)^2,    P = mu F + (lambda ln J - mu) G,
        C[i,J,k,L] = mu d_ik d_JL + (mu - lambda ln J) G_iL G_kJ + lambda G_iJ G_kL;

    plane strain adds 1 to I1 and to what is taken off it. ln(I3)/2 of the source is ln J. Computed from
    B = F^T F - I, so that a strain of 1e-9 keeps its digits and a rotation costs none:

        I1 - dim - 2 ln J = tr B - ln det(I + B),     P = G (mu B + lambda ln J I).

    Where J <= 0, W is infinite and P and C are not numbers.

    References
    ----------
    E. Sifakis, J. Barbic, FEM simulation of 3D deformable solids (2012), part I, section 3.4.
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
        B, F, G = np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim))
        for e in range(n):
            twice_green_strain(H[e], B)
            trace = 0.0
            for i in range(dim):
                trace += B[i, i]
                for j in range(dim):
                    F[i, j] = H[e, i, j] + (1.0 if i == j else 0.0)
            cofactor(F, G, dim)
            J = 0.0
            for j in range(dim):
                J += F[0, j] * G[0, j]
            if not J > 0:
                W[e] = np.inf
                P[e] = np.nan
                if tangent:
                    C[e] = np.nan
                continue
            higher = higher_invariants(B, dim)
            change = trace + higher  # J^2 - 1
            if change > -0.5:
                log_J = 0.5 * log1p(change)
                shape = log_excess(change) - higher
            else:  # a flat element: J^2 would be all round-off
                log_J = log(J)
                shape = trace - 2 * log_J
            W[e] = 0.5 * (mu[e] * shape + lame[e] * log_J * log_J)
            for i in range(dim):
                for j in range(dim):
                    G[i, j] /= J
            for i in range(dim):
                for j in range(dim):
                    p = lame[e] * log_J * G[i, j]
                    for k in range(dim):
                        p += mu[e] * G[i, k] * B[k, j]
                    P[e, i, j] = p
            if not tangent:
                continue
            plain, crossed, volumetric = mu[e], mu[e] - lame[e] * log_J, lame[e]
            for i in range(dim):
                for j in range(dim):
                    own = volumetric * G[i, j]
                    for k in range(dim):
                        other = crossed * G[k, j]
                        for L in range(dim):
                            C[e, i, j, k, L] = other * G[i, L] + own * G[k, L]
                    C[e, i, j, i, j] += plain
        return W, P, C

    return kernel


_KERNELS = {2: _compile(2), 3: _compile(3)}
