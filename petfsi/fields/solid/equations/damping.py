"""Rayleigh damping, by body and by node."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from petfsi.scene.solids import Solid


class RayleighDamping:
    """The factors of  C = a0 M + a1 K'(d).

    Parameters
    ----------
    solids : mapping of str to Solid
    body : ndarray of int, shape (n,)
        Of each local node.

    Attributes
    ----------
    mass, stiffness : ndarray, shape (n,)
        a0 (1/s) and a1 (s) at each local node.
    most_stiffness : float
        The largest a1 of any body; the same on every rank, as is ``anywhere``.
    anywhere : bool
        Whether any body has one of them.
    """

    def __init__(self, solids: Mapping[str, Solid], body: np.ndarray) -> None:
        factors = np.array([[solid.damping.mass, solid.damping.stiffness] for solid in solids.values()])
        self.mass, self.stiffness = factors[body].T
        self.most_stiffness = float(factors[:, 1].max())
        self.anywhere = bool(np.any(factors))
