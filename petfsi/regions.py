"""Regions of fluid that nothing leaves: what they keep from the solver, and how well they keep their volume."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from petfsi import petsc
from petfsi.fields.base import FluidField
from petfsi.system import System


class ClosedRegions:
    """Tells PETSc which uniform pressures no equation sees, and accounts for each region's volume.

    A region closed by rigid walls leaves its mean pressure free. One that an elastic wall closes does not, except
    to a pressure block that is inverted by itself: there PETSc makes the right-hand side compatible by spreading
    the region's net flux evenly over its cells.

    Parameters
    ----------
    system : System
        The system that has the fluid's block.
    fluid : FluidField
        The fluid.
    decoupled : bool
        Whether the pressure block is inverted by itself.
    """

    def __init__(self, system: System, fluid: FluidField, decoupled: bool) -> None:
        self.system = system
        self.fluid = fluid
        self.decoupled = decoupled
        self._members: list[np.ndarray] = []
        self._volumes = np.zeros(0)
        self._found_for: tuple[int, ...] | None = None

    def adopt(self, system: System) -> None:
        """Speak to another system of the same fields from now on."""
        self.system, self._found_for = system, None

    def refresh(self) -> None:
        """Find the regions and hand their null vectors to PETSc, if the geometry changed. Collective."""
        fluid, system = self.fluid, self.system
        version = (fluid.geometry_version, *(coupling.n_assembled for coupling in system.couplings))
        if version == self._found_for:
            return
        self._found_for = version
        touched = next((coupling.touched for coupling in system.couplings), None)
        regions = fluid.closed_regions(touched)
        self._members = [member for member, _ in regions]
        volumes = fluid.volumes()
        self._volumes = system.comm.allreduce(np.array([member @ volumes for member in self._members]))
        rigid = [member for member, touches_solid in regions if not touches_solid]
        _attach(fluid.block, self._members if self.decoupled else rigid)
        if system.index_sets:
            whole = np.zeros((len(rigid), system.solution.local_size))
            for row, member in zip(whole, rigid, strict=True):
                row[system.piece(fluid.name)] = member
            _attach(system.operator, list(whole))

    def volume_error(self, dt: float) -> float:
        """Return the largest relative change of a region's volume in the last step, |sum of net outflows| dt / V.

        Where the pressure block was inverted by itself this is the size of the correction. Collective.
        """
        if not self._members:
            return 0.0
        outflow = self.system.residual.array[self.system.piece(self.fluid.name)] / self.fluid.row_scale
        sums = self.system.comm.allreduce(np.array([outflow @ member for member in self._members]))
        return float(np.max(np.abs(sums) * dt / self._volumes))


def _attach(mat: PETSc.Mat, members: list[np.ndarray]) -> None:
    space = petsc.null_space(mat.createVecRight(), members)
    mat.setNullSpace(space)
    mat.setTransposeNullSpace(space)
