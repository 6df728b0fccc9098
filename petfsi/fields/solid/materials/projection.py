"""The positive semi-definite part of tangents."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.solid.materials.kinematics import Material
from petfsi.fields.solid.materials.linear import linear

#: Parts of a tangent's trace: negative eigenvalues up to the first are round-off and stay; so do entries off the
#: diagonal, which are as good as none, up to the second.
ROUND_OFF, NOTHING = 1e-14, 1e-16


def project(C: np.ndarray, H: np.ndarray) -> None:
    """Set the negative eigenvalues of each tangent to zero, in place.

    The tangent is a symmetric matrix of (dim^2, dim^2); what is positive semi-definite already, as a Cholesky
    factorisation shows, stays to the bit. Since elements' matrices are sums of B^T C B, they and the whole stiffness
    matrix become positive semi-definite too. What is not a number stays.

    Eigenvectors are found by Jacobi's rotations, any tangent's. In 3D they start from the basis l_a r_b^T of F's
    singular vectors, in which the tangents of isotropic materials fall into one block of three and three of two:
    little is left to turn.

    Parameters
    ----------
    C : ndarray, shape (n, dim, dim, dim, dim)
        Contiguous, with C[e, i, J, k, L] = C[e, k, L, i, J]. Overwritten.
    H : ndarray, shape (n, dim, dim)
        F - I. Decides nothing but the work.

    References
    ----------
    J. Teran, E. Sifakis, G. Irving, R. Fedkiw, Robust quasistatic finite elements and flesh simulation (2005),
    section 7.
    """
    size = C.shape[1] * C.shape[2]
    _project(C.reshape(len(C), size, size), H)


def projected(material: Material) -> Material:
    """Return the material with its tangents projected; ``linear``, which has no other ones, as it is."""
    if material is linear:
        return material

    def semidefinite(
        H: np.ndarray, lame: np.ndarray, mu: np.ndarray, tangent: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        W, P, C = material(H, lame, mu, tangent)
        if tangent:
            project(C, H)
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
    """Make A diagonal by turns of the axes, V's columns."""
    n = A.shape[0]
    for _ in range(30):
        turned = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                if abs(A[p, q]) > tolerance:
                    _rotate(A, V, p, q)
                    turned = True
        if not turned:
            return


@njit(cache=True)
def _normal(a, b, c):
    """Set c to the unit vector of what a has across b; return whether that is much of it."""
    along = square = before = 0.0
    for i in range(3):
        along += a[i] * b[i]
    for i in range(3):
        before += a[i] * a[i]
        c[i] = a[i] - along * b[i]
        square += c[i] * c[i]
    for i in range(3):
        c[i] /= np.sqrt(square) if square > 0 else 1.0
    return square > 0.01 * before


@njit(cache=True)
def _left_vectors(F, right, left):
    """Set left's rows to the left singular vectors, the last to a normal of the others; right's fall in stretch."""
    moved = np.dot(right, F.T)
    none = np.zeros(3)
    if not _normal(moved[0], none, left[0]):
        left[0, 0] = 1.0
    if not _normal(moved[1], left[0], left[1]):
        axis = np.zeros(3)
        axis[np.argmin(np.abs(left[0]))] = 1.0
        _normal(axis, left[0], left[1])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        left[2, i] = left[0, j] * left[1, k] - left[0, k] * left[1, j]


@njit(cache=True)
def _singular_basis(H, V):
    """Set V's columns to the products l_a r_b^T of the left and right singular vectors of F = I + H, in 3D."""
    F, axes, left = np.eye(3) + H, np.eye(3), np.zeros((3, 3))
    stretch = np.dot(F.T, F)
    _diagonalise(stretch, axes, NOTHING * np.trace(stretch))
    right = axes.T[np.argsort(-np.diag(stretch))]
    _left_vectors(F, right, left)
    for i in range(3):
        for J in range(3):
            for a in range(3):
                for b in range(3):
                    V[3 * i + J, 3 * a + b] = left[a, i] * right[b, J]


@njit(cache=True)
def _start(A, H, work, V):
    """Set V to the axes to start from and work to V^T A V; four axes are quickly turned from anywhere."""
    if A.shape[0] == 9:
        _singular_basis(H, V)
        work[:] = np.dot(V.T, np.dot(A, V))
    else:
        work[:] = A
        V[:] = 0.0
        for i in range(A.shape[0]):
            V[i, i] = 1.0


@njit(cache=True)
def _project(C, H):
    n = C.shape[1]
    work, V = np.zeros((n, n)), np.empty((n, n))
    for e in range(C.shape[0]):
        A, trace = C[e], 0.0
        for i in range(n):
            trace += abs(A[i, i])
        if not np.isfinite(trace) or _is_semidefinite(A, ROUND_OFF * trace, work):
            continue
        _start(A, H[e], work, V)
        _diagonalise(work, V, NOTHING * trace)
        for m in range(n):
            if work[m, m] >= 0:
                continue
            for i in range(n):
                for j in range(n):
                    # the product of the vectors first: the same number for (i, j) and (j, i)
                    A[i, j] -= work[m, m] * (V[i, m] * V[j, m])
