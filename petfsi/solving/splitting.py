"""What tells that time splitting is unstable: the residual that its one iteration leaves, step after step."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import FinalError
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.stored import EXACT
from petfsi.solving.system import System

#: A step leaves more than the last one if by this factor; flows that begin, and slow growth, stay below it.
RISE = 1.5
#: In so many steps running.
PATIENCE = 3


class SplitWatch:
    """Watches the equations of the solid, which a splitting scheme solves under the old pressure.

    What is left of them is the change of the pressure, J (p - p_old). Where the fluid that moves with the solid
    outweighs it (its added mass m_a exceeds m), that grows by about m_a / m in every step, and a step is worse than
    none, |b - Kx| > |b|. In a stable run that is so for a step or two at most: at the start, or after a jump.

    Parameters
    ----------
    stops : bool
        Whether such a run is stopped, before an element is turned inside out.

    Attributes
    ----------
    rises : int
        How many of the last steps left more than the one before, and more than |b|.
    """

    def __init__(self, stops: bool) -> None:
        self._stops = stops
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.rises, self._first, self._last = 0, 0.0, 0.0

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
        rises = self._last > 0.0 and left > max(size, RISE * self._last)
        self._first = self._first if rises else left
        self.rises, self._last = self.rises + 1 if rises else 0, left
        if self._stops and self.rises >= PATIENCE:
            raise FinalError(self.story())

    def story(self) -> str:
        """Return that splitting is what fails, if it is: what it left has risen in the last step at least."""
        if not self.rises:
            return ""
        return (
            f"time splitting is unstable here: what it leaves over in the solid's equations, |b - Kx|, has risen from "
            f"{self._first:.1e} to {self._last:.1e} in {self.rises} step{'s' * (self.rises > 1)}. The fluid that "
            f"moves with the solid outweighs it (added mass), and smaller steps make that worse. Start again with "
            f"-options_file monolithic.opts; split-iterated.opts holds only where the solid's stiffness and damping in "
            f"a step outweigh that fluid"
        )

    def state(self, comm: MPI.Comm) -> dict[str, Slab]:
        """Return what the next step is judged by."""
        numbers = {"rises": float(self.rises), "first": self._first, "last": self._last}
        return {name: scalar_slab(comm, value) for name, value in numbers.items()}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        rises, first, last = (float(read(name, (0,), (1,))[0]) for name in ("rises", "first", "last"))
        if not (min(rises, first, last) >= 0 and max(first, last) < np.inf and rises <= EXACT):
            raise ValueError(f"'rises', 'first' or 'last' of the splitting are {rises:g}, {first:g} and {last:g}")
        self.rises, self._first, self._last = int(rises), first, last
