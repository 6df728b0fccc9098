"""What tells that time splitting is unstable: the residual that its one iteration leaves, step after step."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import FinalError
from petfsi.fields.slabs import Reader, Slab
from petfsi.solving.system import System

#: A step leaves more than the last one if by this factor; slow growth stays below it.
RISE = 1.5
#: In so many steps running.
PATIENCE = 3
#: What is unstable grows by about the same factor in each of them; a load that sets in as t^n leaves k^n - (k-1)^n of
#: it in step k, which grows by factors that fall: for n = 2 by 3, 5/3, 7/5, and soon below this power of the first.
STEADY = 0.9


class SplitWatch:
    """Watches the equations of the solid, which a splitting scheme solves under the old pressure.

    What is left of them is the change of the pressure, J (p - p_old). Where the fluid that moves with the solid
    outweighs it (its added mass m_a exceeds m), that grows by about m_a / m in every step, and a step is worse than
    none, |b - Kx| > |b|. In a stable run that is so for a step or two, at the start or after a jump; or, by factors
    that fall, for as long as a load sets in smoothly.

    Parameters
    ----------
    stops : bool
        Whether such a run is stopped, before an element is turned inside out.
    """

    def __init__(self, stops: bool) -> None:
        self._stops = stops
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        # what the last steps left, as far back as each left more than the one before it, and more than its |b|
        self._left: list[float] = []

    @property
    def rises(self) -> int:
        """How many of the last steps left more than the one before, and more than |b|; ``PATIENCE`` at most."""
        return max(len(self._left) - 1, 0)

    def judge(self, system: System) -> None:
        """Look at the step just solved, before it is accepted. Collective.

        Raises
        ------
        FinalError
            On all ranks, if what is left has risen often enough: shorter steps are the worst case.
        """
        rows = system.piece("solid")
        r, b = system.residual.array_r[rows], system.rhs.array_r[rows]
        left, size = np.sqrt(system.comm.allreduce(np.array([r @ r, b @ b]))).tolist()
        if self._left and not left > max(size, RISE * self._left[-1]):
            self._left = []
        self._left = [*self._left[-PATIENCE:], left] if left > 0 else []
        if self._stops and self.rises >= PATIENCE:
            story = self.story()
            if story:
                raise FinalError(story)

    def story(self) -> str:
        """Return that splitting is what fails, if it is: what it left has risen, and in many steps not by less each."""
        left = self._left
        if not self.rises or (self.rises >= PATIENCE and left[-1] / left[-2] < (left[1] / left[0]) ** STEADY):
            return ""
        return (
            f"time splitting is unstable here: what it leaves over in the solid's equations, |b - Kx|, has risen from "
            f"{left[0]:.1e} to {left[-1]:.1e} in {self.rises} step{'s' * (self.rises > 1)}. The fluid that "
            f"moves with the solid outweighs it (added mass), and smaller steps make that worse. Start again with "
            f"-options_file monolithic.opts; split-iterated.opts holds only where the solid's stiffness and damping in "
            f"a step outweigh that fluid"
        )

    def state(self, comm: MPI.Comm) -> dict[str, Slab]:
        """Return what the next step is judged by."""
        left = [*self._left, *[0.0] * (1 + PATIENCE - len(self._left))]
        return {
            "left": Slab(np.array(left if comm.rank == 0 else []), (0 if comm.rank == 0 else len(left),), (len(left),))
        }

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        left = read("left", (0,), (1 + PATIENCE,))
        kept = left[: np.count_nonzero(left)]
        if not (np.isfinite(left).all() and (kept > 0).all()):
            raise ValueError(f"'left' of the splitting is {left.tolist()}")
        self._left = kept.tolist()
