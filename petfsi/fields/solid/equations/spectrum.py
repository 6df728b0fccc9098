"""The largest eigenvalue of M^-1 K', which limits explicit steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

#: The estimate is taken when its residual is this fraction, or after so many products.
TOLERANCE, PRODUCTS = 0.02, 40


def largest_eigenvalue(
    comm: MPI.Comm, apply: Callable[[np.ndarray], np.ndarray], mass: np.ndarray, start: np.ndarray
) -> float:
    """Return the largest eigenvalue of M^-1 K, to ``TOLERANCE``, by Lanczos's method. Collective.

    The largest Ritz value is taken once the norm of its residual, within which an eigenvalue lies, is a fraction
    ``TOLERANCE`` of it, and raised by that: a Ritz value is never above the largest eigenvalue, and what comes back
    should not be below it. The largest eigenvalue of an element's own pencil, which is a bound, would be as much as
    three times too large for linear tetrahedra and patches.

    Parameters
    ----------
    comm : MPI.Comm
    apply : callable
        The product with the symmetric K; this rank's rows, of the shape of ``mass``.
    mass : ndarray
        M's diagonal.
    start : ndarray
        Any vector that is not orthogonal to the one wanted.

    Returns
    -------
    float
        Zero for a ``start`` of zeros, not a number where the product is none.

    References
    ----------
    B. N. Parlett, The symmetric eigenvalue problem (1980), chapters 4 and 13.
    """
    root = np.sqrt(mass)

    def dot(u: np.ndarray, v: np.ndarray) -> float:
        return float(comm.allreduce(float(np.vdot(u, v))))

    q = root * start
    length = np.sqrt(dot(q, q))
    if length == 0:
        return 0.0
    q = q / length
    basis: list[np.ndarray] = [q]
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
            return np.nan
        values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1))
        value, residual = float(values[-1]), norm * abs(float(vectors[-1, -1]))
        if residual <= TOLERANCE * abs(value) or len(basis) == PRODUCTS:
            return value + max(residual, TOLERANCE * abs(value))
        beside.append(norm)
        q = r / norm
        basis.append(q)
