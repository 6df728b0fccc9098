"""The positive semi-definite part of tangents."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.solid.materials.kinematics import Material
from petfsi.fields.solid.materials.linear import linear

#: Negative eigenvalues no larger than this part of a tangent's trace are round-off and stay.
ROUND_OFF = 1e-14


def project(C: np.ndarray) -> None:
    """Set the negative eigenvalues of each tangent to zero, in place.

    The tangent is a symmetric matrix of (dim^2, dim^2); what is positive semi-definite already, as a Cholesky
    factorisation shows, stays to the bit. Since elements' matrices are sums of B^T C B, they and the whole stiffness
    matrix become positive semi-definite too. What is not a number stays.

    Parameters
    ----------
    C : ndarray, shape (n, dim, dim, dim, dim)
        Contiguous, with C[e, i, J, k, L] = C[e, k, L, i, J]. Overwritten.

    References
    ----------
    J. Teran, E. Sifakis, G. Irving, R. Fedkiw, Robust quasistatic finite elements and flesh simulation (2005),
    section 7.
    """
    size = C.shape[1] * C.shape[2]
    _project(C.reshape(len(C), size, size))


def projected(material: Material) -> Material:
    """Return the material with its tangents projected; ``linear``, which has no other ones, as it is."""
    if material is linear:
        return material

    def semidefinite(
        H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        W, P, C = material(H, lame, mu, tangent)
        project(C)
        return W, P, C

    return semidefinite


@njit(cache=True)
def _is_semidefinite(A, shift, L):
    """Return whether A + shift I has a Cholesky factorisation, written into L."""
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = s / L[j, j]
            elif s + shift > 0:
                L[i, i] = np.sqrt(s + shift)
            else:
                return False
    return True


@njit(cache=True)
def _rotate(A, V, p, q):
    """Turn axes p and q of the symmetric A, and of the columns of V, so that A[p, q] vanishes (Jacobi)."""
    n = A.shape[0]
    theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
    t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
    if theta < 0:
        t = -t
    c = 1 / np.sqrt(t * t + 1)
    s = t * c
    for k in range(n):
        A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
    for k in range(n):
        A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
        V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]


@njit(cache=True)
def _diagonalise(A, V, tolerance):
    """Make A diagonal by Jacobi's rotations, V's columns its eigenvectors."""
    n = A.shape[0]
    V[:] = 0.0
    for i in range(n):
        V[i, i] = 1.0
    for _ in range(30):
        largest = 0.0
        for p in range(n - 1):
            for q in range(p + 1, n):
                largest = max(largest, abs(A[p, q]))
                if abs(A[p, q]) > tolerance:
                    _rotate(A, V, p, q)
        if largest <= tolerance:
            return


@njit(cache=True)
def _project(C):
    n = C.shape[1]
    work, V = np.zeros((n, n)), np.empty((n, n))
    for e in range(C.shape[0]):
        A, trace = C[e], 0.0
        for i in range(n):
            trace += abs(A[i, i])
        if not np.isfinite(trace) or _is_semidefinite(A, ROUND_OFF * trace, work):
            continue
        work[:] = A
        _diagonalise(work, V, 1e-17 * trace)
        for m in range(n):
            if work[m, m] >= 0:
                continue
            for i in range(n):
                for j in range(n):
                    # the product of the vectors first: the same number for (i, j) and (j, i)
                    A[i, j] -= work[m, m] * (V[i, m] * V[j, m])
