"""Regions of fluid that nothing leaves: what they keep from the solver, and how well they keep their volume."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from petfsi import petsc
from petfsi.fields.base import FluidField, Reader, Slab
from petfsi.following import Marks, follow
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

    Attributes
    ----------
    volumes : ndarray
        Of each region that was closed at the first ``refresh``, m^3 (m^2 in 2D), for the geometry of the last one; nan
        from when it was opened, divided, joined with another or filled.
    """

    def __init__(self, system: System, fluid: FluidField, decoupled: bool) -> None:
        self.system = system
        self.fluid = fluid
        self.decoupled = decoupled
        self._members: list[np.ndarray] = []
        self._volumes = np.zeros(0)
        self.volumes = np.zeros(0)
        self._marks: Marks | None = None
        self._found_for: tuple[int, ...] | None = None
        self._before = self._tracked()

    def _tracked(self) -> tuple[Marks | None, np.ndarray]:
        return self._marks, self.volumes

    def rewind(self) -> None:
        """Go back to the regions of before the last ``refresh`` that found any changed."""
        (self._marks, self.volumes), self._found_for = self._before, None

    def adopt(self, system: System) -> None:
        """Speak to another system of the same fields from now on."""
        self.system, self._found_for = system, None

    def refresh(self) -> None:
        """Find the regions and hand their null vectors to PETSc, if the geometry changed. Collective."""
        fluid, system = self.fluid, self.system
        version = (fluid.geometry_version, *(coupling.n_assembled for coupling in system.couplings))
        if version == self._found_for:
            return
        self._found_for, self._before = version, self._tracked()
        touched = next((coupling.touched for coupling in system.couplings), None)
        regions = fluid.closed_regions(touched)
        self._members = [member for member, _ in regions]
        volumes = fluid.volumes()
        sizes = np.array([member @ volumes for member in self._members])
        self._volumes = system.comm.allreduce(sizes)
        marks = Marks.of(system.comm, self._members, fluid.n_cells, fluid.bounds)
        if self._marks is None:
            self._marks, self.volumes = marks, self._volumes
        else:
            self._follow(self._marks, marks)
        rigid = [member for member, touches_solid in regions if not touches_solid]
        _attach(fluid.block, self._members if self.decoupled else rigid)
        if system.index_sets:
            whole = np.zeros((len(rigid), system.solution.local_size))
            for row, member in zip(whole, rigid, strict=True):
                row[system.piece(fluid.name)] = member
            _attach(system.operator, list(whole))

    def _follow(self, before: Marks, now: Marks) -> None:
        """Find which of the first regions the present ones are. Collective."""
        n_old, n_new = len(self.volumes), len(self._volumes)
        old, new = follow(self.system.comm, before, now, n_old, n_new)
        self.volumes = np.full(n_old, np.nan)
        self.volumes[old] = self._volumes[new]
        numbers = np.zeros(n_new + 1, dtype=np.int64)
        numbers[new + 1] = old + 1
        self._marks = now.renumbered(numbers)

    def state(self) -> dict[str, Slab]:
        """Return where the first regions are now."""
        marks = self._marks
        assert marks is not None
        arrays = {"region": self.fluid.cells_slab(marks.cells.astype(float))}
        n, first = len(marks.facets), self.system.comm.rank == 0
        if n:
            arrays["region_facet"] = Slab(marks.facets[: n * first].astype(float), (0 if first else n,), (n,))
        return arrays

    def restore(self, read: Reader) -> None:
        """Take up a state. Collective."""
        assert self._marks is not None
        cells = self.fluid.read_cells(read, "region").astype(np.int64)
        facets = self._marks.facets
        if len(facets):
            facets = read("region_facet", (0,), facets.shape).astype(np.int64)
        self._marks, self._found_for = Marks(cells, facets), None

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
