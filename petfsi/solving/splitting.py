"""What tells that time splitting is unstable: the residual that its one iteration leaves, step after step."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import FinalError
from petfsi.fields.slabs import Reader, Slab, State
from petfsi.fields.solids import SolidField
from petfsi.fields.stored import outside, refuse
from petfsi.solving.system import System

#: A step leaves more than the last one if by this factor; slow growth stays below it.
RISE = 1.5
#: In so many steps running.
PATIENCE = 3
#: What is left points the other way than before if the cosine between the two is below this; where the scheme is
#: unstable it is about -1. What loads leave that set in smoothly points the same way.
TURNED = -0.5
#: The largest number that is stored; the square of a larger one is none.
MOST = 1e150


class SplitWatch:
    """Watches the equations of the solid, which a splitting scheme solves under the old pressure.

    What is left of them is the change of the pressure, J (p - p_old). Where the fluid that moves with the solid
    outweighs it (its added mass m_a exceeds m), the pressure of a step pushes back what the last one pushed too far:
    what is left turns round in every step and grows by about m_a / m, and a step is worse than none, |b - Kx| > |b|.
    A load that sets in leaves more and more, too, at whatever rate, but all of it in one direction.

    Parameters
    ----------
    comm : MPI.Comm
    solid : SolidField
    stops : bool
        Whether such a run is stopped, before an element is turned inside out.
    """

    def __init__(self, comm: MPI.Comm, solid: SolidField, stops: bool) -> None:
        self._comm, self._solid, self._stops = comm, solid, stops
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        # what the last steps left, as far back as each left more than the one before it, and more than its |b|
        self._left: list[float] = []
        self._residual = np.zeros(self._solid.layout.n_local)

    @property
    def rises(self) -> int:
        """How many of the last steps turned round and left more than the one before; ``PATIENCE`` at most."""
        return max(len(self._left) - 1, 0)

    def judge(self, system: System) -> None:
        """Look at the step just solved, before it is accepted. Collective.

        Raises
        ------
        FinalError
            On all ranks, if what is left has risen often enough: shorter steps are the worst case.
        """
        rows = system.piece("solid")
        r, b, old = system.residual.array_r[rows], system.rhs.array_r[rows], self._residual
        sums = system.comm.allreduce(np.array([r @ r, b @ b, r @ old, old @ old]))
        left, size, before = np.sqrt(sums[[0, 1, 3]]).tolist()
        turned = float(sums[2]) < TURNED * left * before
        if self._left and not (turned and left > max(size, RISE * self._left[-1])):
            self._left = []
        self._left = [*self._left[-PATIENCE:], left] if left > 0 else []
        self._residual = r.copy()
        if self._stops and self.rises >= PATIENCE:
            raise FinalError(self.story())

    def story(self) -> str:
        """Return that splitting is what fails, if it is: what it left has risen in the last step at least."""
        if not self.rises:
            return ""
        return (
            f"time splitting is unstable here: what it leaves over in the solid's equations, |b - Kx|, has risen from "
            f"{self._left[0]:.1e} to {self._left[-1]:.1e} in {self.rises} step{'s' * (self.rises > 1)}. The fluid that "
            f"moves with the solid outweighs it (added mass), and smaller steps make that worse. Start again with "
            f"-options_file monolithic.opts; split-iterated.opts holds only where the solid's stiffness and damping in "
            f"a step outweigh that fluid"
        )

    def state(self) -> State:
        """Return what the next step is judged by. Collective."""
        left = [*self._left, *[0.0] * (1 + PATIENCE - len(self._left))]
        first = self._comm.rank == 0
        sizes = Slab(np.array(left if first else []), (0 if first else len(left),), (len(left),))
        return {"left": sizes, **self._solid.stored("residual", self._residual)}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        left = np.asarray(read("left", (0,), (1 + PATIENCE,)), dtype=float)
        residual = self._solid.read_stored(read, "residual")
        refuse(self._comm, [outside("left", left, 0.0, MOST), outside("residual", residual, -MOST, MOST)])
        self._left, self._residual = [float(value) for value in left if value], residual
