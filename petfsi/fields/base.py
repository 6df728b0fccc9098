"""What every field offers: unknowns, its diagonal block and right-hand side, and its state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from petfsi.fields.slabs import Reader, Slab, State, held
from petfsi.petsc import Layout


@dataclass(frozen=True)
class Stock:
    """What a field holds, this rank's share.

    Attributes
    ----------
    momentum : ndarray, shape (dim,)
        kg m/s.
    kinetic, elastic : float
        J.
    """

    momentum: np.ndarray
    kinetic: float
    elastic: float = 0.0


@dataclass(frozen=True)
class Work:
    """What the last step's forces did, this rank's share, J; or do in a second, W.

    Attributes
    ----------
    gravity : float
        Done by gravity.
    damping : float
        Taken by damping.
    boundary : float
        Done, and brought along, by all that lies beyond: supports, inflows, open sides.
    loads : float
        Done by body forces and loads.
    """

    gravity: float = 0.0
    damping: float = 0.0
    boundary: float = 0.0
    loads: float = 0.0


class Field(ABC):
    """Unknowns of one physical part, with their block of the coupled system.

    Attributes
    ----------
    name : str
        Index in the nest, options prefix and checkpoint group.
    has_block : bool
        Whether it has unknowns; without, it is left out of the system, and nothing that is said of unknowns holds.
    explicit, elastic : bool
        Whether its step is limited, see ``stable_step``; whether it stores energy.
    layout : Layout
        How its unknowns lie on the ranks; ``assemble`` may change it, and couplings and the system follow.
    diagonal : bool
        Whether the block has no entry off its diagonal.
    block : PETSc.Mat
        The diagonal block, AIJ, SI units; another object only where the layout has changed.
    rhs : ndarray, shape (layout.n_local,)
        Right-hand side, SI units; couplings may add to it between ``assemble`` and the solve.
    row_scale, col_scale : float
        The solver sees ``row_scale * block * col_scale`` and unknowns divided by ``col_scale``, so that all
        rows and unknowns are comparable numbers.
    is_linear : bool
        Whether its equations are linear in its unknowns.
    n_assembled : int
        How often the block was assembled.
    pattern_version : int
        Grows whenever the pattern of the block changes; the same on all ranks.
    """

    name: str
    has_block: bool = True
    explicit: bool = False
    elastic: bool = False
    diagonal: bool = False
    layout: Layout
    block: PETSc.Mat
    rhs: np.ndarray
    row_scale: float = 1.0
    col_scale: float = 1.0
    is_linear: bool = True
    n_assembled: int = 0
    pattern_version: int = 0

    @property
    def matrices(self) -> list[PETSc.Mat]:
        """What the solver scales: the block, and what stands for a part of it in preconditioners."""
        return [self.block]

    def unknown(self) -> np.ndarray:
        """Return the present values of the unknowns on this rank, SI: the first guess of the solve."""
        return np.zeros(0)

    @abstractmethod
    def predict(self, time: float, dt: float) -> None:
        """Do the explicit part of the step from ``time`` to ``time + dt``."""

    @abstractmethod
    def assemble(self, time: float, dt: float) -> None:
        """Refresh ``block`` (only if it changed), ``rhs`` and the scales for the step that begins at ``time``."""

    @abstractmethod
    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the solution (SI) of the step from ``time`` to ``time + dt`` and move all that moves with it."""

    def stable_step(self) -> float:
        """Return the longest stable step of an explicit scheme at the present state, s. Collective."""
        return math.inf

    def rewind(self) -> None:
        """Forget the step that ``predict`` began and that will not be accepted, as if it had not been tried."""
        return

    def linearised_at(self) -> np.ndarray:
        """Return the values (SI) at which ``block`` is the derivative: where Newton's method begins."""
        return self.unknown()

    def forget(self) -> None:  # noqa: B027 - most fields know nothing else
        """Forget what a resumed run could not know. Collective."""

    def round_off(self, x: np.ndarray) -> float:
        """Return what ``block @ x - rhs`` cannot fall below, eps ||block|| ||x||, in the solver's units. Collective.

        Parameters
        ----------
        x : ndarray, shape (layout.n_local,)
            SI.
        """
        comm = self.block.comm.tompi4py()
        length = float(np.sqrt(comm.allreduce(float(x @ x)))) / self.col_scale
        return float(np.finfo(float).eps) * self.block.norm(PETSc.NormType.NORM_INFINITY) * length

    def rhs_round_off(self) -> float:
        """Return the norm of the rounding in ``rhs``, in the solver's units, where its terms may cancel. Collective."""
        return 0.0

    def relinearise(self, x: np.ndarray) -> bool:
        """Let ``assemble`` linearise about these values (SI) until ``accept``; return whether that changes anything.

        ``block @ x - rhs`` is then the residual of the nonlinear equation at x. Interfaces stay where they are.
        """
        return False

    @abstractmethod
    def stock(self) -> Stock:
        """Return this rank's share of momentum and energy. Collective, without a reduction."""

    def work(self, dt: float) -> Work:
        """Return this rank's share of what was done in the whole step last accepted. Collective, without a reduction.

        Without that of ``power`` and of ``SolidField.forces``, of which who keeps the books makes work.
        """
        return Work()

    def power(self) -> Work:
        """Return this rank's share of the power where the integrator took the forces of the step last accepted, W.

        Collective, without a reduction.
        """
        return Work()

    @abstractmethod
    def output(self) -> dict[str, Slab]:
        """Return what pictures and other programs want to see."""

    @abstractmethod
    def state(self) -> State:
        """Return all that the next step reads. Collective."""

    def keep(self) -> Callable[[], State]:
        """Return what gives ``state`` of now, whatever steps are tried since. Collective, and so is what it returns."""
        return held(self.state())

    @abstractmethod
    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks."""
