"""Hyperelastic materials: from displacement gradients to energy, stress and tangent.

A material is one function of arrays, ``material(H, lame, mu, tangent=True) -> W, P, C``, with the deformation
gradient F = I + H and

    H     (n, dim, dim)             displacement gradient dd/dX: strains far below 1 would drown in F's round-off
    lame  (n,), mu (n,)             Lame parameters, Pa
    W     (n,)                      energy density, J/m^3; zero at rest
    P     (n, dim, dim)             first Piola-Kirchhoff stress dW/dF, Pa
    C     (n, dim, dim, dim, dim)   tangent, C[i, J, k, L] = dP[i, J] / dF[k, L], Pa; without ``tangent`` n is 0

It is given a few hundred gradients at a time. In 2D strain is plane: the third direction keeps its length. Every one
linearises to Hooke's law at rest, and is linear in the Lame parameters, W(H; lame, mu) = W(H; lame, 0) + W(H; 0, mu),
so that the two parts can be integrated by different rules. Where a material breaks down (neo-Hookean, det F <= 0)
energy is infinite and stress and tangent are not numbers, without a warning: whoever solves sees a residual that is
none.

A new material is a file beside these and a line in ``petfsi.registry``.
"""

from __future__ import annotations

from petfsi import registry
from petfsi.fields.solid.materials.kinematics import Material
from petfsi.fields.solid.materials.projection import project, projected

__all__ = ["Material", "lame_parameters", "named", "project", "projected"]


def named(name: str) -> Material:
    """Return the material that a scene's ``solids.*.material`` names."""
    material: Material = registry.find(registry.MATERIALS[name])
    return material


def lame_parameters(young: float, poisson: float) -> tuple[float, float]:
    """Return Lame's (lambda, mu) of an isotropic material (plane strain in 2D), Pa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
