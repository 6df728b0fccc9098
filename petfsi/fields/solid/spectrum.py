"""The largest eigenvalue of M^-1 K', which limits explicit steps: a bound from elements, and an estimate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from numba import njit

#: The estimate is taken when its residual is this fraction, or after so many products.
TOLERANCE, PRODUCTS = 0.02, 40


@njit(cache=True)
def add_row_sums(cells, K, total):
    """Add to each node the largest row sum of |K| that an element has there.

    ``cells`` has shape (ne, n), ``K`` (ne, n * width, n * width); ``total``, one number a node, is changed.
    """
    for e in range(cells.shape[0]):
        for a in range(cells.shape[1]):
            total[cells[e, a]] += _row_sum(K[e], a, cells.shape[1])


@njit(cache=True)
def _row_sum(K, a, nodes):
    width, most = K.shape[0] // nodes, 0.0
    for i in range(a * width, (a + 1) * width):
        s = 0.0
        for j in range(K.shape[0]):
            s += abs(K[i, j])
        most = max(most, s)
    return most


@njit(cache=True)
def pencil_bound(cells, K, total, mass):
    """Return no less than the largest eigenvalue of any element's pencil (K_e, M_e).

    M_e is the part of each node's lumped mass that the element's row sum has in the node's ``total``. Since these
    parts add up to the whole mass, no eigenvalue of (sum K_e, M) is larger than the largest of the elements'. Of an
    element, with A = M_e^-1/2 K_e M_e^-1/2, the Frobenius norm of A^8 is at least the 8th power of A's largest.

    Parameters
    ----------
    cells : ndarray of int, shape (ne, n)
    K : ndarray, shape (ne, n * width, n * width)
        Overwritten.
    total : ndarray, shape (n_nodes,)
        Of all elements at each node.
    mass : ndarray, shape (n_nodes, width)
    """
    size, nodes, most = K.shape[1], cells.shape[1], 0.0
    width = size // nodes
    scale, A = np.empty(size), np.empty((size, size))
    for e in range(cells.shape[0]):
        largest = 0.0
        for a in range(nodes):
            own = _row_sum(K[e], a, nodes)
            share = own / total[cells[e, a]] if own > 0 else 0.0
            for i in range(width):
                scale[a * width + i] = 1 / np.sqrt(mass[cells[e, a], i] * share) if share > 0 else 0.0
        for i in range(size):
            for j in range(size):
                A[i, j] = K[e, i, j] * scale[i] * scale[j]
                largest = max(largest, abs(A[i, j]))
        if not largest > 0:
            if largest == 0:
                continue
            return np.nan
        A /= largest
        for _ in range(3):
            A = A @ A
        norm = largest * np.sqrt(np.sum(A * A)) ** 0.125
        if not norm <= most:
            most = norm
    return most


def largest_eigenvalue(
    comm: MPI.Comm, apply: Callable[[np.ndarray], np.ndarray], mass: np.ndarray, start: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the largest eigenvalue of M^-1 K and its vector, to ``TOLERANCE``, by Lanczos's method. Collective.

    The largest Ritz value is taken once the norm of its residual, within which an eigenvalue lies, is a fraction
    ``TOLERANCE`` of it, and raised by that: a Ritz value is never above the largest eigenvalue, and what comes back
    should not be below it.

    Parameters
    ----------
    comm : MPI.Comm
    apply : callable
        The product with the symmetric K; this rank's rows, of the shape of ``mass``.
    mass : ndarray
        M's diagonal.
    start : ndarray
        Any vector that is not orthogonal to the one wanted; the vector of an earlier call saves products.

    References
    ----------
    B. N. Parlett, The symmetric eigenvalue problem (1980), chapters 4 and 13.
    """
    root = np.sqrt(mass)

    def dot(u: np.ndarray, v: np.ndarray) -> float:
        return float(comm.allreduce(float(np.vdot(u, v))))

    q = root * start
    q = q / np.sqrt(dot(q, q))
    basis = [q]
    diagonal: list[float] = []
    beside: list[float] = []
    while True:
        r = apply(q / root) / root
        diagonal.append(dot(q, r))
        for _ in range(2):  # twice is enough to stay orthogonal
            for other in basis:
                r -= dot(other, r) * other
        norm = np.sqrt(dot(r, r))
        if not np.isfinite(norm):
            return np.nan, start
        values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1))
        value, residual = float(values[-1]), norm * abs(float(vectors[-1, -1]))
        if residual <= TOLERANCE * abs(value) or len(basis) == PRODUCTS:
            ritz = sum(weight * other for weight, other in zip(vectors[:, -1], basis, strict=True))
            return value + max(residual, TOLERANCE * abs(value)), ritz / root
        beside.append(norm)
        q = r / norm
        basis.append(q)
