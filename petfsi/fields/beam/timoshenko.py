"""Geometrically exact Timoshenko beams in the plane (Simo and Reissner): energies, forces, tangents and masses."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Points of the reduced rule, each of weight 1: exact for cubics, one degree short of the elements' mass.
_REDUCED = np.array([-1.0, 1.0]) / math.sqrt(3.0)
#: The full rule of the mass, with its weights.
_FULL = np.array([-1.0, 0.0, 1.0]) * math.sqrt(0.6)
_FULL_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 9.0


def shapes(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape functions of start, end and middle, and their derivatives, each of shape (..., 3)."""
    xi = np.asarray(xi, dtype=float)
    N = np.stack((xi * (xi - 1) / 2, xi * (xi + 1) / 2, 1 - xi**2), axis=-1)
    return N, np.stack((xi - 0.5, xi + 0.5, -2 * xi), axis=-1)


class Timoshenko:
    """Three-node elements, straight at rest, with displacement (u, w) and rotation theta all quadratic.

    With x' the derivative of the axis along its length at rest, t1 the section's normal at rest turned by theta and
    t2 the section's own direction, the strains are Reissner's, exact for any displacement and rotation,

        eps = x' . t1 - 1 = (1 + u') cos theta + w' sin theta - 1,
        gamma = x' . t2 = w' cos theta - (1 + u') sin theta,    kappa = theta',

    (the right-hand sides in axes along the element at rest), and the energy of an element is

        ∫ (EA eps^2 + GA gamma^2 + EI kappa^2) / 2 ds

    by two Gauss points, which leaves no shear or membrane locking. Forces and tangent are its first and second
    derivatives, so the tangent is symmetric and complete. A rigid motion of any size strains nothing.

    Z. Li's notes start from Green's strain of the same kinematics, E_xx = u' + (u'^2 + w'^2)/2 + z^2 theta'^2/2
    - z theta' R_es and 2 E_xz = R_en, where R_es = 1 + eps and R_en = gamma, and then take strains to be small. The
    differences to what is used here:

    - the axial strain: u' + (u'^2 + w'^2)/2 = eps + (eps^2 + gamma^2)/2 instead of eps; its variation (7a) is along
      the axis, Reissner's is along t1 with gamma dtheta added;
    - the bending strain: theta' R_es instead of theta'. The notes vary it as dtheta' alone (7c), which is Reissner's;
    - z^2 theta'^2/2 couples bending to the axial force; the notes ignore it, Reissner's beam does not have it;
    - the variation of gamma (7b) has cos gamma for 1 + eps, as if the axis could not stretch (|r| = 1);
    - their Newton iteration leaves out N d(d eps) + Q d(d gamma) as not symmetric. Those terms are symmetric, being
      second derivatives, and they are kept: without them convergence is no more than linear.

    All of these are of second order in eps and gamma, so that the two agree for thin beams.

    Parameters
    ----------
    length : ndarray, shape (ne,)
        m.
    axis : ndarray, shape (ne, 2)
        Unit vectors along the elements at rest.
    stiffness : ndarray, shape (ne, 3)
        EA (N), GA (N, with the shear coefficient) and EI (N m^2).

    References
    ----------
    E. Reissner, On one-dimensional finite-strain beam theory: the plane problem, ZAMP 23 (1972), eqs. 14-16.
    J. C. Simo, L. Vu-Quoc, On the dynamics of flexible beams under large overall motions, J. Appl. Mech. 53 (1986).
    Z. Li, coupling of SPH and FEM (notes), sections 2.1-2.6, eqs. 2-9 and the three-node shape functions.
    """

    n_nodes = 3

    def __init__(self, length: np.ndarray, axis: np.ndarray, stiffness: np.ndarray):
        self.length, self.axis, self.stiffness = length, axis, stiffness

    def respond(self, d: np.ndarray, tangent: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy, its gradient and its Hessian, of shapes (ne,), (ne, 9) and (ne, 9, 9).

        Without ``tangent`` the Hessian has the shape (0, 9, 9).

        Parameters
        ----------
        d : ndarray, shape (ne, 9)
            u_x, u_y (m, along the axes of the plane) and theta (rad) of start, end and middle.
        """
        return _respond(d, self.length, self.axis, self.stiffness, *_AT_REDUCED, tangent)

    def mass(self, rho_A: np.ndarray, rho_I: np.ndarray) -> np.ndarray:
        """Return the consistent mass matrices, shape (ne, 9, 9): rho A (kg/m) moves, rho I (kg m) turns."""
        N, _ = shapes(_FULL)
        overlap = np.einsum("g,ga,gb->ab", _FULL_WEIGHTS / 2, N, N)
        kinds = np.zeros((3, len(self.length), 3))
        kinds[0, :, 0] = kinds[1, :, 1] = rho_A * self.length
        kinds[2, :, 2] = rho_I * self.length
        blocks = np.einsum("ab,iej->eaibj", overlap, kinds)
        return blocks.reshape(-1, 9, 9)

    def lumped(self, rho_A: np.ndarray, rho_I: np.ndarray) -> np.ndarray:
        """Return the row sums of the mass matrices, shape (ne, 9); all are positive."""
        share = np.array([1.0, 1.0, 4.0]) / 6
        each = np.stack((rho_A, rho_A, rho_I), axis=-1) * self.length[:, None]
        return (share[None, :, None] * each[:, None, :]).reshape(-1, 9)

    def interpolation(self, e: np.ndarray, xi: np.ndarray) -> np.ndarray:
        """Return what makes (u_x, u_y, theta) at ``xi`` in [-1, 1] of each element ``e`` out of its d, (n, 3, 9)."""
        N, _ = shapes(xi)
        return np.einsum("na,ij->niaj", N, np.eye(3)).reshape(-1, 3, 9)


_AT_REDUCED = shapes(_REDUCED)


@njit(cache=True)
def _respond(d, length, axis, stiffness, N, slope, tangent):
    n = d.shape[0]
    W, f, K = np.zeros(n), np.zeros((n, 9)), np.zeros((n if tangent else 0, 9, 9))
    B = np.zeros((3, 9))
    for e in range(n):
        weight, per_length = length[e] / 2, 2 / length[e]
        for g in range(N.shape[0]):
            theta = kappa = v_x = v_y = 0.0
            for a in range(3):
                dN = slope[g, a] * per_length
                v_x += dN * d[e, 3 * a]
                v_y += dN * d[e, 3 * a + 1]
                theta += N[g, a] * d[e, 3 * a + 2]
                kappa += dN * d[e, 3 * a + 2]
            c, s = math.cos(theta), math.sin(theta)
            t_x, t_y = c * axis[e, 0] - s * axis[e, 1], s * axis[e, 0] + c * axis[e, 1]
            # of the derivative of u alone: small strains would drown in the round-off of an axis of length 1
            half = math.sin(0.5 * theta)
            eps, gamma = v_x * t_x + v_y * t_y - 2.0 * half * half, v_y * t_x - v_x * t_y - s
            stretch = 1.0 + eps
            EA, GA, EI = weight * stiffness[e, 0], weight * stiffness[e, 1], weight * stiffness[e, 2]
            force, shear, moment = EA * eps, GA * gamma, EI * kappa
            W[e] += 0.5 * (force * eps + shear * gamma + moment * kappa)
            for a in range(3):
                dN = slope[g, a] * per_length
                B[0, 3 * a], B[0, 3 * a + 1], B[0, 3 * a + 2] = dN * t_x, dN * t_y, N[g, a] * gamma
                B[1, 3 * a], B[1, 3 * a + 1], B[1, 3 * a + 2] = -dN * t_y, dN * t_x, -N[g, a] * stretch
                B[2, 3 * a + 2] = dN
            for i in range(9):
                f[e, i] += force * B[0, i] + shear * B[1, i] + moment * B[2, i]
            if not tangent:
                continue
            for i in range(9):
                for j in range(9):
                    K[e, i, j] += EA * B[0, i] * B[0, j] + GA * B[1, i] * B[1, j] + EI * B[2, i] * B[2, j]
            # the second variations: of x' and theta, and of theta twice
            mixed_x, mixed_y = -force * t_y - shear * t_x, force * t_x - shear * t_y
            turned = -(force * stretch + shear * gamma)
            for a in range(3):
                dN = slope[g, a] * per_length
                for b in range(3):
                    K[e, 3 * a, 3 * b + 2] += dN * mixed_x * N[g, b]
                    K[e, 3 * a + 1, 3 * b + 2] += dN * mixed_y * N[g, b]
                    K[e, 3 * b + 2, 3 * a] += dN * mixed_x * N[g, b]
                    K[e, 3 * b + 2, 3 * a + 1] += dN * mixed_y * N[g, b]
                    K[e, 3 * a + 2, 3 * b + 2] += turned * N[g, a] * N[g, b]
    return W, f, K
