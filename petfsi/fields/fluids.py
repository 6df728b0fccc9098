"""What fluids offer besides: to the loop, to couplings, and to who closes volumes."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.fields.base import Field
from petfsi.fields.slabs import Reader, Slab


class FluidField(Field):
    """A fluid of whatever kind.

    Attributes
    ----------
    comm : MPI.Comm
        The ranks it lies on.
    density : float
        kg/m^3.
    cell_volume : float
        Volume of a typical cell, or of a particle at rest, m^3 (m^2 in 2D).
    extent : float
        The longest side of the box that it may fill, m.
    """

    comm: MPI.Comm
    density: float
    cell_volume: float
    extent: float

    @abstractmethod
    def probe(self, quantity: str, at: list[float]) -> float | np.ndarray:
        """Return a quantity at a point, the same on all ranks. Collective."""

    def force_on(self, wall: str) -> np.ndarray:
        """Return the force on a side or an obstacle, shape (dim,), N, the same on all ranks. Collective."""
        raise NotImplementedError

    def tally(self) -> dict[str, float]:
        """Return what of itself history.csv should say, always under the same names. Collective."""
        return {}

    @property
    def notes(self) -> list[str]:
        """What a user should know of how it begins."""
        return []

    def remark(self) -> str | None:
        """Return what a user should know of the step just taken, the same on all ranks; each is told once."""
        return None


class PressureFluid(FluidField):
    """A fluid whose unknown is the pressure, and whose row of the system is the net outflow of a cell.

    Attributes
    ----------
    geometry_version : int
        Grows whenever cells or faces change their kind; the same on all ranks.
    n_cells : int
        So many of this rank's unknowns, the first ones, are there for the whole run; the others come and go.
    fluxes : PETSc.Mat
        What the block consists of for the most part, with a pattern that seldom changes: what preconditioners are made
        of. May be the block itself. ``pattern_version`` is its.
    source : ndarray or None
        By unknown, what comes into cells from nowhere, m^3/s (m^2/s in 2D): ``assemble`` adds it to ``rhs``.
    """

    dim: int
    n_cells: int
    fluxes: PETSc.Mat
    geometry_version: int = 0
    source: np.ndarray | None = None

    @property
    def matrices(self) -> list[PETSc.Mat]:
        """The block and the fluxes, if they are not the same."""
        return [self.block] if self.fluxes is self.block else [self.block, self.fluxes]

    @abstractmethod
    def closed_regions(self, touched: np.ndarray | None) -> list[tuple[np.ndarray, bool]]:
        """Return each connected region without an open face, and whether it has any of the ``touched`` unknowns.

        A region is given by 1 on its unknowns and 0 elsewhere, this rank's part of a pressure vector. Collective.
        """

    @abstractmethod
    def volumes(self) -> np.ndarray:
        """Return the volume of fluid that belongs to each of this rank's unknowns, m^3 (m^2 in 2D)."""

    @abstractmethod
    def inflow(self) -> np.ndarray | None:
        """Return by unknown what the step lets in through sides with a given velocity; None if there are none."""

    @abstractmethod
    def net_outflow(self) -> np.ndarray:
        """Return by unknown what leaves it at the present velocity but through solids' walls, m^3/s (m^2/s in 2D)."""

    @abstractmethod
    def push(self, x: np.ndarray, dt: float) -> None:
        """Change the present velocity as the pressure x (SI) would in a first step of dt. Collective."""

    @abstractmethod
    def inflows(self) -> dict[str, np.ndarray]:
        """Return what ``inflow`` does by the key of each side that lets anything in. Not collective."""

    @abstractmethod
    def rehearse(self, time: float, dt: float) -> None:
        """Give sides the velocities of a step of dt from ``time``, of none (0) those at that time. Collective."""

    @abstractmethod
    def place(self, member: np.ndarray) -> str:
        """Return where some of the unknowns are, for people; they are those that are not zero here. Collective."""

    @abstractmethod
    def cells_slab(self, values: np.ndarray) -> Slab:
        """Return a value per lasting unknown, shape (n_cells,), as a piece of a global array."""

    @abstractmethod
    def read_cells(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``cells_slab`` stored, shape (n_cells,), on any number of ranks."""
