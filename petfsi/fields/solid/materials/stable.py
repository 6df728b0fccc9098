"""Stable neo-Hookean elasticity, which survives inversion."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.compiled import compiled_for
from petfsi.fields.solid.materials.kinematics import cofactor, higher_invariants, log_excess, twice_green_strain


def stable_neohookean(
    H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, stress and exact tangent of the stable neo-Hookean material.

    Finite and smooth for every F, also flat (J = det F = 0) and inverted (J < 0). With I = F : F (plane strain adds
    the third direction's 1), m = 4/3 mu and l = lambda + 5/6 mu,

        W = m/2 (I - 3) + l/2 (J - 1)^2 - 3/4 m (J - 1) - m/2 ln((I + 1) / 4),
        P = m (1 - 1/(I + 1)) F + (l (J - 1) - 3/4 m) cof F,
        C = m (1 - 1/(I + 1)) d_ik d_JL + 2 m/(I + 1)^2 F_iJ F_kL + l cof_iJ cof_kL + (l (J - 1) - 3/4 m) dcof_iJ/dF_kL,

    the paper's eq. 14, with its constant l/2 (3 m/4 l)^2 left out: no stress at rest, and the new m and l make its
    linearisation Hooke's law with lambda and mu. The logarithm is what keeps F = 0 from being a rest state of its own
    in 3D. Computed from B = F^T F - I, so that a strain of 1e-9 keeps its digits and a rotation costs none:
    I - 3 = tr B, and I - 3 - 2 (J - 1) = (J - 1)^2 - (det(I + B) - 1 - tr B).

    References
    ----------
    B. Smith, F. de Goes, T. Kim, Stable neo-Hookean flesh simulation, ACM Trans. Graph. 37 (2018), sections 3.3-3.4.
    """
    return _KERNELS[H.shape[1]](H, lame, mu, tangent)


@njit(cache=True, inline="always")
def _add_cofactor_tangent(factor, F, C, dim):
    """Add factor dcof[i, J] / dF[k, L]: a component of F (in 2D one), with the signs of two permutations."""
    for i in range(dim):
        for k in range(dim):
            if i == k:
                continue
            for J in range(dim):
                for L in range(dim):
                    if J == L:
                        continue
                    even = ((k - i) % 3 == 1) == ((L - J) % 3 == 1)
                    c = factor if dim == 2 else factor * F[3 - i - k, 3 - J - L]
                    C[i, J, k, L] += c if even else -c


@njit(cache=True, inline="always")
def _cofactor_change(H, change, dim):
    """Set change = cof F - I."""
    if dim == 3:
        cofactor(H, change, dim)
    else:
        change[:] = 0.0
    for i in range(dim):
        for j in range(dim):
            change[i, i] += H[j, j]
            change[i, j] -= H[j, i]


def _compile(dim):
    # dim as a constant of the closure lets the compiler unroll the loops over axes

    @compiled_for(dim, error_model="numpy")
    def kernel(H, lame, mu, tangent):
        n = H.shape[0]
        W = np.empty(n)
        P = np.empty((n, dim, dim))
        C = np.empty((n if tangent else 0, dim, dim, dim, dim))
        B, F, cof, change = np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim))
        for e in range(n):
            twice_green_strain(H[e], B)
            _cofactor_change(H[e], change, dim)
            trace = 0.0  # I - 3
            for i in range(dim):
                trace += B[i, i]
                for j in range(dim):
                    one = 1.0 if i == j else 0.0
                    F[i, j], cof[i, j] = H[e, i, j] + one, change[i, j] + one
            J = 0.0
            for j in range(dim):
                J += F[0, j] * cof[0, j]
            higher = higher_invariants(B, dim)
            # (J^2 - 1) / (J + 1) keeps the digits of a small change of volume
            grown = (trace + higher) / (J + 1) if J > 0.5 else J - 1
            bulk = lame[e] + 5 / 6 * mu[e]
            W[e] = 0.5 * (mu[e] * (grown * grown - higher) + bulk * grown * grown)
            W[e] += 2 / 3 * mu[e] * log_excess(0.25 * trace)
            stretched = mu[e] * trace / (3 * (4 + trace))  # m (1 - 1/(I + 1)) - mu
            for i in range(dim):
                for j in range(dim):
                    P[e, i, j] = mu[e] * (H[e, i, j] - change[i, j]) + stretched * F[i, j] + bulk * grown * cof[i, j]
            if not tangent:
                continue
            along = 8 / 3 * mu[e] / (4 + trace) ** 2
            for i in range(dim):
                for j in range(dim):
                    for k in range(dim):
                        for L in range(dim):
                            C[e, i, j, k, L] = along * F[i, j] * F[k, L] + bulk * cof[i, j] * cof[k, L]
                    C[e, i, j, i, j] += mu[e] + stretched
            _add_cofactor_tangent(bulk * grown - mu[e], F, C[e], dim)
        return W, P, C

    return kernel


_KERNELS = {2: _compile(2), 3: _compile(3)}
