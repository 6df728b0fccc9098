"""How far elements are from turning inside out."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def smallest_volume_ratio(H: np.ndarray) -> float:
    """Return the smallest det(I + H), infinite if there is none.

    Parameters
    ----------
    H : ndarray, shape (n, dim, dim)
        Displacement gradients, dim 2 or 3.
    """
    least = np.inf
    for e in range(H.shape[0]):
        a, b, c, d = 1 + H[e, 0, 0], H[e, 0, 1], H[e, 1, 0], 1 + H[e, 1, 1]
        J = a * d - b * c
        if H.shape[1] == 3:
            x, y, z = H[e, 2, 0], H[e, 2, 1], 1 + H[e, 2, 2]
            J = J * z - (a * H[e, 1, 2] - c * H[e, 0, 2]) * y + (b * H[e, 1, 2] - d * H[e, 0, 2]) * x
        least = min(least, J)
    return least
