"""Loads that turn with the facets they act on."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.solid.loads.simplices import Simplices
from petfsi.scene.expressions import Expression


class FollowerPressure:
    """A pressure on the present surface.

    With nodes at x, xi the coordinates on the unit facet and N_a the shape functions,

        f_a = - int p N_a n da,    n da = x,1 x x,2 dxi   (2D: x,1 turned by -90 degrees).

    Parameters
    ----------
    facets : Simplices
    pressure : Expression
        Pa; of the reference position and time.

    References
    ----------
    J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), section 8.5.
    """

    def __init__(self, facets: Simplices, pressure: Expression) -> None:
        self.facets = facets
        self._pressure, self._coordinates = pressure, facets.coordinates

    def forces(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return f for nodes at ``x`` (n_nodes, dim), shape (n, m, dim), N. Not collective."""
        f = self.facets
        p = self._pressure(t=time, **self._coordinates)
        return -np.einsum("q,eq,qa,eqi->eai", f.rule, p, f.values, f.area_vectors(x), optimize=True)

    def tangents(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return the symmetric part of df/dx of each facet, shape (n, m, dim, m, dim), N/m. Not collective.

        On a closed surface under the same pressure everywhere the rest adds up to nothing.
        """
        f = self.facets
        p = f.rule * self._pressure(t=time, **self._coordinates)
        n, m = f.nodes.shape
        K = np.zeros((n, m, f.dim, m, f.dim))
        if f.dim == 2:
            _tangents_2d(p, f.values, f.slopes, K)
        else:
            _tangents_3d(f.nodes, x, p, f.values, f.slopes, K)
        return K


class FollowerTraction:
    """A traction per area at rest, T, whose components turn with the facet.

        f_a = int N_a R T dA,

    R the rotation that takes the facet at rest to the present one: of the polar decomposition of its deformation, with
    the normal going to the normal. Its tangent is left out, so that Newton converges linearly under it.

    Parameters
    ----------
    facets : Simplices
    components : list of Expression
        N/m^2, along the axes; of the reference position and time.
    """

    def __init__(self, facets: Simplices, components: list[Expression]) -> None:
        self.facets = facets
        self._components, self._coordinates = components, facets.coordinates
        self._frame = _orthonormal(facets.tangents(facets._reference))

    def forces(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return f for nodes at ``x`` (n_nodes, dim), shape (n, m, dim), N. Not collective."""
        f = self.facets
        T = np.stack([c(t=time, **self._coordinates) for c in self._components], axis=-1)
        local = np.einsum("eqik,eqi->eqk", self._frame, T)
        turned = np.einsum("eqik,eqk->eqi", self._present_frame(x), local)
        return np.einsum("eq,qa,eqi->eai", f.weights, f.values, turned, optimize=True)

    def _present_frame(self, x: np.ndarray) -> np.ndarray:
        """Return R times the frame at rest, shape (n, q, dim, dim)."""
        now = self.facets.tangents(x)
        if self.facets.dim == 2:
            return _orthonormal(now)
        # components of the deformation along the frame's two tangents: F = dx/dxi (dX/dxi)^-1
        rest = self.facets.tangents(self.facets._reference)
        F = now @ np.linalg.inv(np.swapaxes(self._frame[..., :2], -1, -2) @ rest)
        C = np.swapaxes(F, -1, -2) @ F
        # the root of a 2 x 2 matrix: U = (C + sqrt(det C)) / sqrt(tr C + 2 sqrt(det C))
        area = np.sqrt(np.linalg.det(C))[..., None, None]
        trace = np.trace(C, axis1=-2, axis2=-1)[..., None, None]
        U = (C + area * np.eye(2)) / np.sqrt(trace + 2 * area)
        R = F @ np.linalg.inv(U)
        return np.concatenate((R, np.cross(R[..., 0], R[..., 1])[..., None]), axis=-1)


@njit(cache=True)
def _tangents_2d(p, values, slopes, K):
    """Add half of -p N_a N_b,1 Q, Q the turn by -90 degrees, and half of its transpose."""
    for e in range(p.shape[0]):
        for q in range(p.shape[1]):
            for a in range(values.shape[1]):
                for b in range(values.shape[1]):
                    half = 0.5 * p[e, q] * values[q, a] * slopes[q, b, 0]
                    K[e, a, 0, b, 1] -= half
                    K[e, a, 1, b, 0] += half
                    K[e, b, 1, a, 0] -= half
                    K[e, b, 0, a, 1] += half


@njit(cache=True)
def _tangents_3d(nodes, x, p, values, slopes, K):
    """Add half of -p N_a (L_b x), L_b = N_b,1 x,2 - N_b,2 x,1 and (L x)_ij = eps_ijk L_k, and half of its transpose."""
    n = values.shape[1]
    t, L, arm = np.empty((2, 3)), np.empty((n, 3)), np.empty((n, n, 3))
    for e in range(p.shape[0]):
        arm[:] = 0.0
        for q in range(p.shape[1]):
            t[:] = 0.0
            for a in range(n):
                for i in range(3):
                    t[0, i] += slopes[q, a, 0] * x[nodes[e, a], i]
                    t[1, i] += slopes[q, a, 1] * x[nodes[e, a], i]
            for b in range(n):
                for i in range(3):
                    L[b, i] = slopes[q, b, 0] * t[1, i] - slopes[q, b, 1] * t[0, i]
            for a in range(n):
                for b in range(n):
                    for i in range(3):
                        arm[a, b, i] += 0.5 * p[e, q] * values[q, a] * L[b, i]
        for a in range(n):
            for b in range(n):
                for k in range(3):
                    i, j = (k + 1) % 3, (k + 2) % 3
                    # of the pair of rows a, b and its mirror image
                    difference = arm[a, b, k] - arm[b, a, k]
                    K[e, a, i, b, j] -= difference
                    K[e, a, j, b, i] += difference


def _orthonormal(tangents: np.ndarray) -> np.ndarray:
    """Return frames of a facet's unit tangents and its normal behind them, shape (..., dim, dim)."""
    first = tangents[..., 0] / np.linalg.norm(tangents[..., 0], axis=-1, keepdims=True)
    if tangents.shape[-1] == 1:
        return np.stack((first, np.stack((first[..., 1], -first[..., 0]), axis=-1)), axis=-1)
    normal = np.cross(tangents[..., 0], tangents[..., 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack((first, np.cross(normal, first), normal), axis=-1)
