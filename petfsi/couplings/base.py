"""What every coupling offers: the blocks between two fields, and what each step does with them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from petfsi.fields.base import Work
from petfsi.fields.solids import Forces

if TYPE_CHECKING:
    from petfsi.couplings.enclosure import Enclosure


class Coupling(ABC):
    """Joins two fields; neither of them knows of it.

    Attributes
    ----------
    blocks : dict
        Off-diagonal blocks by (name of the row's field, name of the column's field), AIJ, SI units; the same
        matrix objects for the whole run.
    pattern_version : int
        Grows whenever the pattern of a block changes; the same on all ranks.
    touched : ndarray of bool or None
        This rank's unknowns of the fluid that the coupling acts on; None is none.
    pushed : ndarray or None
        T, by this rank's unknowns of the fluid, where the coupling adds J T J^T to the solid's block, kg/(m^4 s)
        (kg/(m^3 s) in 2D).
    push : (ndarray, ndarray, ndarray) or None
        T^(1/2) J^T of those with T > 0, one row each in their order.
    symmetric : bool
        Whether D1 H = J^T, so that iterations for symmetric systems may be used.
    n_coupled, n_assembled : int
        How often the transfer operators were made and the blocks filled; a step that changes nothing adds nothing.
    """

    blocks: dict[tuple[str, str], PETSc.Mat]
    touched: np.ndarray | None = None
    pushed: np.ndarray | None = None
    push: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    symmetric: bool = False
    pattern_version: int = 0
    n_coupled: int = 0
    n_assembled: int = 0

    @abstractmethod
    def couple(self, time: float, dt: float) -> None:
        """Refresh the transfer operators for the present geometry. Collective."""

    @abstractmethod
    def assemble(self, time: float, dt: float) -> None:
        """Fill the blocks (only if they changed) and add what is known to the fields' ``rhs``. Collective.

        To be called after the fields have assembled the step from ``time`` to ``time + dt``.
        """

    def enclose(self, members: list[np.ndarray]) -> Enclosure | None:
        """Return what bounds regions of the fluid, each 1 on its unknowns and 0 elsewhere; None if that is not exact.

        For the geometry that ``couple`` saw last.
        """
        return None

    @property
    def n_enclosing(self) -> int:
        """How many facets ``enclose`` tells of, at any time."""
        return 0

    def outflow(self) -> np.ndarray:
        """Return what solids' walls let out of this rank's unknowns of the fluid at their present velocity. Collective.

        In m^3/s (m^2/s in 2D), through the walls that ``couple`` saw last.
        """
        raise NotImplementedError

    def held_outflow(self, chosen: np.ndarray | None = None) -> np.ndarray | None:
        """Return by unknown of the fluid what prescribed points let out in the step assembled, m^3/s (m^2/s in 2D).

        None where there are no such points, on all ranks alike.

        Parameters
        ----------
        chosen : ndarray of bool, shape (n_points,), optional
            Of some of the surface's points only.
        """
        return None

    @abstractmethod
    def inject(self, volume: np.ndarray) -> None:
        """Add what comes into cells from nowhere, m^3/s (m^2/s in 2D), to the right sides that are assembled."""

    @abstractmethod
    def rewind(self) -> None:
        """Forget for which positions the operators are: the fields forget the step that was tried."""

    def restored(self) -> None:  # noqa: B027 - most have nothing to tell
        """Tell fields of each other what they need after ``restore``. Collective."""

    def work(self) -> Work:
        """Return this rank's share of what was done in the whole step last accepted, see ``power`` and ``forces``."""
        return Work()

    def power(self, pressure: np.ndarray) -> Work:
        """Return this rank's share of the power of the coupling's own forces where the integrator took them, W.

        Supports bear the pressure on prescribed points, and the fluid's weight there: minus that is their power. What
        comes into cells from nowhere (``PressureFluid.source``) brings its volume times the pressure.

        Parameters
        ----------
        pressure : ndarray
            The step's solution, Pa.
        """
        return Work()

    def forces(self) -> Forces:
        """Return what the coupling's own forces did to the solid's unknowns in the step last accepted.

        Under names that are among the solid's own.
        """
        return {}

    @abstractmethod
    def accept(self, values: Mapping[str, np.ndarray], time: float, dt: float) -> None:
        """Hand over what the second field needs of the first, after the first one has accepted. Collective.

        Parameters
        ----------
        values : mapping of str to ndarray
            The step's solution by field, SI, this rank's.
        time, dt : float
        """
