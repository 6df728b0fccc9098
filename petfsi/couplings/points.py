"""What both transfers between particles and a solid's surface have: forces on its points, linearised in their velocity.

Where rows E_k turn the velocities of points into what a pair or a particle sees, w_k is how its force grows with that
and u^ what the forces of the step saw,

    sum_k w_k E_k^T E_k

stands in the solid's block, and times u^ on the right.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_matrix, csr_matrix

from petfsi.couplings.base import Coupling
from petfsi.fields.solids import SolidField
from petfsi.fields.sph.fluid import SphFluid
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import gather_sums

#: Part of the force at the end of a step in what the solid gets in it, by integrator; the rest is that at its start.
#: Particles get half of each: with that momentum is kept to round-off where the scheme gives a force's impulse at once.
#: Others get that at the end: midpoint blows up with halves.
THETA = {"newmark": 0.5, "symplectic-euler": 0.5}


class PointForces(Coupling):
    """Joins particles with the surface of a solid, by forces on its points."""

    fluid: SphFluid
    solid: SolidField
    comm: MPI.Comm
    surface: Surface

    def _take(self, surface: Surface) -> None:
        """Take the surface's maps, and their transposes for this rank's unknowns."""
        layout = self.solid.layout
        self.surface = surface
        self._to_unknowns = surface.point_map[:, layout.start : layout.end].T.tocsr()
        self._to_held = surface.fixed_map[:, layout.start : layout.end].T.tocsr()

    def _arrive(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the velocity of the surface's points takes them in the step, and that. Collective."""
        surface = self.solid.surface()
        if surface is not self.surface:
            self._take(surface)
        points, velocity = self.solid.surface_present(), self.solid.surface_velocity()
        return (points + dt * velocity if self.fluid.is_moving else points), velocity

    def _stiffening(self, rows: csr_matrix, weight: np.ndarray) -> coo_matrix:
        """Return this rank's part of what stands in the solid's block, by unknown."""
        self._rows, self._weight = rows, weight
        self._unknown_rows = (rows @ self.surface.point_map).tocsr()
        weighted = self._unknown_rows.multiply(weight[:, None]).tocsr()
        return (self._unknown_rows.T @ weighted).tocoo()

    def _add_seen(self, velocity: np.ndarray) -> None:
        """Add that times the velocity (of points, flat) that the forces saw to the solid's right side. Collective."""
        seen = velocity - self.surface.fixed_map @ self.solid.fixed_velocity()
        part = self._unknown_rows.T @ (self._weight * (self._rows @ seen))
        here = np.flatnonzero(part)
        self.solid.rhs += gather_sums(self.comm, self.solid.layout, here, part[here])

    def _solved(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the velocity of points, flat, of a step's solution. Collective."""
        u = np.concatenate(self.comm.allgather(values[self.solid.name]))
        return self.surface.point_map @ u + self.surface.fixed_map @ u

    def inject(self, volume: np.ndarray) -> None:
        """Do nothing: particles fill no cells."""

    def rewind(self) -> None:
        """Forget nothing: where the surface is, is asked for in each step."""
