"""What every field offers: unknowns, its diagonal block and right-hand side, and its state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from petfsi.petsc import Layout


@dataclass(frozen=True)
class Slab:
    """One rank's contiguous piece of a global array that does not depend on the number of ranks.

    Attributes
    ----------
    data : ndarray
        The piece; ``data.ndim == len(shape)``.
    start : tuple of int
        Where it begins in the global array.
    shape : tuple of int
        The shape of the global array: cells or faces as ``(nx, ny[, nz])``, nodes as ``(n, dim)``.
    """

    data: np.ndarray
    start: tuple[int, ...]
    shape: tuple[int, ...]


#: Reads the piece ``[start, start + count)`` of the stored array of that name: ``read(name, start, count)``.
Reader = Callable[[str, tuple[int, ...], tuple[int, ...]], np.ndarray]


class Field(ABC):
    """Unknowns of one physical part, with their block of the coupled system.

    Attributes
    ----------
    name : str
        Index in the nest, options prefix and checkpoint group.
    layout : Layout
        How its unknowns lie on the ranks.
    block : PETSc.Mat
        The diagonal block, AIJ; the same object for the whole run, SI units.
    rhs : ndarray, shape (layout.n_local,)
        Right-hand side, SI units; couplings may add to it between ``assemble`` and the solve.
    row_scale, col_scale : float
        The solver sees ``row_scale * block * col_scale`` and unknowns divided by ``col_scale``, so that all
        rows and unknowns are comparable numbers.
    n_assembled : int
        How often the block was assembled.
    """

    name: str
    layout: Layout
    block: PETSc.Mat
    rhs: np.ndarray
    row_scale: float = 1.0
    col_scale: float = 1.0
    n_assembled: int = 0

    @abstractmethod
    def unknown(self) -> np.ndarray:
        """Return the present values of the unknowns on this rank, SI: the first guess of the solve."""

    @abstractmethod
    def predict(self, time: float, dt: float) -> None:
        """Do the explicit part of the step from ``time`` to ``time + dt``."""

    @abstractmethod
    def assemble(self, time: float, dt: float) -> None:
        """Refresh ``block`` (only if it changed), ``rhs`` and the scales for the step from ``time`` to ``time + dt``."""

    @abstractmethod
    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the new unknowns (SI) at ``time + dt`` and move everything that moves with them."""

    @abstractmethod
    def state(self) -> dict[str, Slab]:
        """Return all that the next step reads."""

    @abstractmethod
    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks."""

    def near_null_space(self) -> list[np.ndarray]:
        """Return vectors (local parts) that the block nearly annihilates, for algebraic multigrid."""
        return []
