"""Euler-Bernoulli beams with Hermite's cubics: energies, forces, tangents and masses."""

from __future__ import annotations

import numpy as np

#: Where u, w and theta of start and end stand among (u, w, theta, u, w, theta): those of the axis, those of bending.
_ALONG, _ACROSS = np.array([0, 3]), np.array([1, 2, 4, 5])
#: Whether an unknown of bending is a rotation, and so comes with a length.
_ROTATES = np.array([0, 1, 0, 1])

#: ∫ of N N, N' N' and N'' N'' over an element of unit length, from the polynomials of ``cubics``.
_MASS = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420
_SLOPE = np.array([[36, 3, -36, 3], [3, 4, -3, -1], [-36, -3, 36, -3], [3, -1, -3, 4]]) / 30
_CURVATURE = np.array([[12.0, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])


def cubics(xi: np.ndarray, length: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape functions of (w, theta) at start and end, and their derivatives along the beam, (..., 4).

    phi_1 = (1 - xi)^2 (2 + xi)/4,      phi_2 = l (1 - xi)^2 (1 + xi)/8,
    phi_3 = (1 + xi)^2 (2 - xi)/4,      phi_4 = l (1 + xi)^2 (xi - 1)/8.
    """
    N = [(1 - xi) ** 2 * (2 + xi) / 4, length * (1 - xi) ** 2 * (1 + xi) / 8,
         (1 + xi) ** 2 * (2 - xi) / 4, length * (1 + xi) ** 2 * (xi - 1) / 8]  # fmt: skip
    slope = [1.5 * (xi**2 - 1) / length, (xi - 1) * (3 * xi + 1) / 4,
             1.5 * (1 - xi**2) / length, (xi + 1) * (3 * xi - 1) / 4]  # fmt: skip
    return np.stack(N, axis=-1), np.stack(slope, axis=-1)


class Hermite:
    """Two-node elements in axes fixed along each element at rest: u linear, w cubic, theta = w'.

    The energy of an element of length l is

        EA l e^2 / 2 + ∫ EI w''^2 / 2 ds,    e = mean of (u' + w'^2/2),

    so that the axial force N = EA e adds N dw' w' to the virtual work, as in Z. Li's equation 10, and N itself comes
    from the displacement. With the mean, an element that bends without stretching has no axial force (no membrane
    locking). For moderate rotations only: turning the whole by alpha, with theta = sin alpha, strains it by
    e = -alpha^4/8. Beyond some tenths take Timoshenko's.

    The notes turn only w into the plane's axes (their T has cos phi for it); here u and w turn together, so that
    elements may stand at any angle.

    Parameters
    ----------
    length, axis, stiffness
        As for ``Timoshenko``; GA is not read.

    References
    ----------
    Z. Li, coupling of SPH and FEM (notes), section 2.6, eq. 10 and the shape functions phi_1 to phi_4.
    J. S. Przemieniecki, Theory of Matrix Structural Analysis (1968), chapters 5, 11 and 15.
    """

    n_nodes = 2

    def __init__(self, length: np.ndarray, axis: np.ndarray, stiffness: np.ndarray):
        self.length, self.axis, self.stiffness = length, axis, stiffness
        self.turn = np.zeros((len(length), 6, 6))
        for k in (0, 3):
            self.turn[:, k, k : k + 2] = axis
            self.turn[:, k + 1, k : k + 2] = np.column_stack((-axis[:, 1], axis[:, 0]))
            self.turn[:, k + 2, k + 2] = 1.0
        self._slope = self._scaled(_SLOPE, length**-1.0)
        self._bending = self._scaled(_CURVATURE, stiffness[:, 2] * length**-3.0)
        self._stretch = np.zeros((len(length), 6))
        self._stretch[:, _ALONG] = np.array([-1.0, 1.0]) / length[:, None]

    def _scaled(self, matrix: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Return a matrix of bending for every element, its rotations measured by length, shape (ne, 6, 6)."""
        lengths = self.length[:, None] ** _ROTATES
        result = np.zeros((len(self.length), 6, 6))
        result[:, _ACROSS[:, None], _ACROSS] = factor[:, None, None] * lengths[:, :, None] * matrix * lengths[:, None]
        return result

    def _turned(self, local: np.ndarray) -> np.ndarray:
        return self.turn.transpose(0, 2, 1) @ local @ self.turn

    def respond(self, d: np.ndarray, tangent: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy, its gradient and its Hessian, of shapes (ne,), (ne, 6) and (ne, 6, 6).

        Without ``tangent`` the Hessian has the shape (0, 6, 6).

        Parameters
        ----------
        d : ndarray, shape (ne, 6)
            u_x, u_y (m, along the axes of the plane) and theta (rad) of start and end.
        """
        q = np.einsum("eij,ej->ei", self.turn, d)
        bent, tilted = (np.einsum("eij,ej->ei", matrix, q) for matrix in (self._bending, self._slope))
        e = np.sum(q * (self._stretch + 0.5 * tilted / self.length[:, None]), axis=1)
        EA_l = self.stiffness[:, 0] * self.length
        de = self._stretch + tilted / self.length[:, None]
        W = 0.5 * (EA_l * e**2 + np.sum(q * bent, axis=1))
        f = (EA_l * e)[:, None] * de + bent
        f = np.einsum("eji,ej->ei", self.turn, f)
        if not tangent:
            return W, f, np.zeros((0, 6, 6))
        K = EA_l[:, None, None] * de[:, :, None] * de[:, None, :] + self._bending
        K += (self.stiffness[:, 0] * e)[:, None, None] * self._slope
        return W, f, self._turned(K)

    def mass(self, rho_A: np.ndarray, rho_I: np.ndarray) -> np.ndarray:
        """Return the consistent mass matrices, shape (ne, 6, 6), with the rotary inertia ∫ rho I w' w' ds."""
        M = self._scaled(_MASS, rho_A * self.length) + self._scaled(_SLOPE, rho_I / self.length)
        pair = rho_A[:, None, None] * self.length[:, None, None] / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        M[:, _ALONG[:, None], _ALONG] += pair
        return self._turned(M)

    def lumped(self, rho_A: np.ndarray, rho_I: np.ndarray) -> np.ndarray:
        """Return diagonal masses, shape (ne, 6): half an element each, and its rotations scaled like the diagonal.

        E. Hinton, T. Rock, O. C. Zienkiewicz, A note on mass lumping, Earthquake Eng. Struct. Dyn. 4 (1976).
        """
        half = rho_A * self.length / 2
        turning = half * self.length**2 * (_MASS[1, 1] / _MASS[0, 0]) + rho_I * self.length / 2
        return np.tile(np.column_stack((half, half, turning)), (1, 2))

    def interpolation(self, e: np.ndarray, xi: np.ndarray) -> np.ndarray:
        """Return what makes (u_x, u_y, theta) at ``xi`` in [-1, 1] of each element ``e`` out of its d, (n, 3, 6)."""
        local = np.zeros((len(e), 3, 6))
        local[:, 0, _ALONG] = np.column_stack((1 - xi, 1 + xi)) / 2
        local[:, 1, _ACROSS], local[:, 2, _ACROSS] = cubics(xi, self.length[e])
        turn = self.turn[e]
        return turn[:, :3, :3].transpose(0, 2, 1) @ local @ turn
