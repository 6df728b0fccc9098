"""What elements of one shape share: shape functions, quadrature, masses.

Sides are straight, so that everything is a table over barycentric coordinates, times an element's volume and the
constant gradients of its barycentric coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import factorial

import numpy as np

from petfsi.geometry.quadratic import shape_forms


@dataclass(frozen=True)
class Rule:
    """Quadrature and masses of an element with n nodes and m gradients that those of its shape functions are made of.

    Attributes
    ----------
    table : ndarray, shape (Q, n, m)
        Gradient of shape function a at point q: sum over b of ``table[q, a, b]`` times gradient b.
    weights : ndarray, shape (Q,)
        Over the element's volume.
    lame, mu : ndarray, shape (Q,)
        Factors of Lame's parameters at the points: 0 where the part of the energy is integrated by other points.
    mass : ndarray, shape (n, n)
        Integrals of N_a N_b over the volume.
    lumped : ndarray, shape (n,)
        A positive diagonal with the same sum (HRZ).

    References
    ----------
    E. Hinton, T. Rock, O. C. Zienkiewicz, A note on mass lumping and related processes in the finite element method
    (1976).
    """

    table: np.ndarray
    weights: np.ndarray
    lame: np.ndarray
    mu: np.ndarray
    mass: np.ndarray
    lumped: np.ndarray


@lru_cache
def linear_rule(dim: int, reduced: bool) -> Rule:
    """Return the rule of a linear simplex; ``reduced``: patches integrate what belongs to lambda."""
    corners = dim + 1
    one = np.ones(1)
    mass = (1 + np.eye(corners)) / (corners * (corners + 1))
    return Rule(np.eye(corners)[None], one, 0 * one if reduced else one, one, mass, np.full(corners, 1 / corners))


@lru_cache
def patch_rule(nodes: int) -> Rule:
    """Return the rule of a patch: lambda's part of the energy at the patch's mean gradient, no mass."""
    one = np.ones(1)
    return Rule(np.eye(nodes)[None], one, one, 0 * one, np.zeros((nodes, nodes)), np.zeros(nodes))


@lru_cache
def quadratic_rule(dim: int, reduced: bool) -> Rule:
    """Return the rule of a quadratic simplex: points exact to degree 2, all that a straight one at rest needs.

    ``reduced``: what belongs to lambda is taken at the mean gradient, one point in the middle.
    """
    far = 2 / 3 if dim == 2 else (5 + 3 * np.sqrt(5)) / 20
    near = (1 - far) / dim
    points = near + (far - near) * np.eye(dim + 1)
    weights = np.full(dim + 1, 1 / (dim + 1))
    lame, mu = np.ones(dim + 1), np.ones(dim + 1)
    if reduced:
        points = np.concatenate((points, np.full((1, dim + 1), 1 / (dim + 1))))
        weights, mu, lame = np.append(weights, 1.0), np.append(mu, 0.0), np.append(0 * lame, 1.0)
    forms = shape_forms(dim)
    # N_a = x . Q_a x, in a form whose gradients along the barycentric coordinates may differ by a constant from
    # those of another form: the coordinates' own gradients add up to zero
    table = 2 * np.einsum("aij,qj->qai", forms, points)
    mass = np.einsum("aij,bkl,ijkl->ab", forms, forms, _fourth_moments(dim))
    diagonal = np.diag(mass)
    return Rule(table, weights, lame, mu, mass, diagonal / diagonal.sum())


def shape_functions(barycentric: np.ndarray, nodes: int) -> np.ndarray:
    """Return the values of the shape functions of a linear or quadratic simplex with so many nodes, shape (..., n)."""
    dim = barycentric.shape[-1] - 1
    if nodes == dim + 1:
        return barycentric
    return np.einsum("...i,aij,...j->...a", barycentric, shape_forms(dim), barycentric)


def shape_slopes(barycentric: np.ndarray, nodes: int) -> np.ndarray:
    """Return their slopes along the edges from the first corner to the others, shape (..., n, dim)."""
    dim = barycentric.shape[-1] - 1
    if nodes == dim + 1:
        gradients = np.broadcast_to(np.eye(dim + 1), (*barycentric.shape[:-1], dim + 1, dim + 1))
    else:
        gradients = 2 * np.einsum("aij,...j->...ai", shape_forms(dim), barycentric)
    return gradients[..., 1:] - gradients[..., :1]


def _fourth_moments(dim: int) -> np.ndarray:
    """Return the integrals of x_i x_j x_k x_l over a simplex of volume 1."""
    moments = np.empty((dim + 1,) * 4)
    for index in product(range(dim + 1), repeat=4):
        powers = np.prod([factorial(index.count(i)) for i in range(dim + 1)])
        moments[index] = factorial(dim) * powers / factorial(dim + 4)
    return moments
