"""What both transfers between a grid and a solid's surface have: moving walls that let fluid through by points."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix

from petfsi.couplings.base import Coupling
from petfsi.couplings.blocks import Rows, TransferBlocks
from petfsi.fields.solids import SolidField
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import IntType

if TYPE_CHECKING:
    from petfsi.fields.mac.fluid import MacFluid


class WallCoupling(Coupling):
    """Joins a fluid on a grid with the surface of a solid.

    Parameters
    ----------
    fluid : MacFluid
    solid : SolidField

    Attributes
    ----------
    surface : Surface
    dim : int
    """

    #: What velocities of the surface's points, flat, let out of this rank's unknowns of the fluid.
    _point_flux: csr_matrix
    #: Velocities of the surface's points as far as they are prescribed, flat, m/s.
    _held: np.ndarray

    def __init__(self, fluid: MacFluid, solid: SolidField) -> None:
        self.fluid, self.solid, self.comm, self.dim = fluid, solid, fluid.comm, fluid.dim
        self._take(solid.surface())
        self._new_blocks()
        self._positions: np.ndarray | None = None
        self._stale, self._dt = False, 0.0
        self._held_outflow = np.zeros(0)

    def _take(self, surface: Surface) -> None:
        self.surface = surface
        # the surface's own unknowns alone, so that no product runs over all of the solid's
        self._free = np.unique(surface.point_map.indices)
        self._free_map = surface.point_map[:, self._free]

    def _new_blocks(self) -> None:
        self._transfer = TransferBlocks(self.comm, self.fluid, self.solid)
        self.flux_block, self.force_block = self._transfer.flux, self._transfer.force
        self.blocks = self._transfer.by_name

    def _flux_rows(self) -> Rows:
        """Return this rank's rows of D1 H, as they are by points."""
        flux = (self._point_flux @ self._free_map).tocsr()
        flux.sort_indices()
        return flux.indptr.astype(IntType), self._free[flux.indices].astype(IntType), flux.data

    @abstractmethod
    def _transfer_rows(self) -> tuple[Rows, Rows]:
        """Return this rank's rows of D1 H and -J. Collective."""

    def assemble(self, time: float, dt: float) -> None:
        """Fill the blocks if the geometry changed, and take what prescribed points let through to the right side."""
        # whoever solves may scale the blocks in place, by amounts that depend on dt
        if self._stale or dt != self._dt:
            self.pattern_version += self._transfer.fill(*self._transfer_rows())
            self.n_assembled += 1
            self._stale, self._dt = False, dt
        if self.surface.fixed_map.nnz:
            self._held = self.surface.fixed_map @ self.solid.fixed_velocity()
            self._held_outflow = self._point_flux @ self._held
            self.fluid.rhs -= self._held_outflow

    def rewind(self) -> None:
        """Make the operators anew, and the fluid's cells with them, in the next step."""
        self._positions = None

    def outflow(self) -> np.ndarray:
        """Return what the walls let out of this rank's unknowns at their present velocity. Collective."""
        return self._point_flux @ self.solid.surface_velocity().ravel()

    def held_outflow(self, chosen: np.ndarray | None = None) -> np.ndarray | None:
        """Return by unknown of the fluid what prescribed points let out, of all or of some of them."""
        if not self.surface.fixed_map.nnz:
            return None
        held = self._held if chosen is None else np.where(np.repeat(chosen, self.dim), self._held, 0.0)
        return self._point_flux @ held
