"""What both transfers between a grid and a solid's surface have: moving walls that let fluid through by points."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from petfsi.couplings.base import Coupling
from petfsi.fields.solids import SolidField
from petfsi.geometry.surfaces import Surface


class WallCoupling(Coupling):
    """Joins a fluid on a grid with the surface of a solid.

    Attributes
    ----------
    solid : SolidField
    surface : Surface
    dim : int
    """

    solid: SolidField
    surface: Surface
    dim: int
    #: What velocities of the surface's points, flat, let out of this rank's unknowns of the fluid.
    _point_flux: csr_matrix
    #: Velocities of the surface's points as far as they are prescribed, flat, m/s.
    _held: np.ndarray

    def outflow(self) -> np.ndarray:
        """Return what the walls let out of this rank's unknowns at their present velocity. Collective."""
        return self._point_flux @ self.solid.surface_velocity().ravel()

    def held_outflow(self, chosen: np.ndarray | None = None) -> np.ndarray | None:
        """Return by unknown of the fluid what prescribed points let out, of all or of some of them."""
        if not self.surface.fixed_map.nnz:
            return None
        held = self._held if chosen is None else np.where(np.repeat(chosen, self.dim), self._held, 0.0)
        return self._point_flux @ held
