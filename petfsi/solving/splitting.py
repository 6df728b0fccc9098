"""What tells that time splitting is unstable: the residual that its one iteration leaves, step after step."""

from __future__ import annotations

from collections.abc import Callable

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
#: Slow growth is told of after so many steps in each of which what is left has turned round and has grown at all; where
#: something else fails, fewer of them say that splitting is the cause. It does not stop a run: what a load leaves that
#: turns round in every step, and grows, does so, too.
LONG, SOME = 10, 5
#: What is left points the other way than before if the cosine between the two is below this; where the scheme is
#: unstable it is about -1. What loads leave that set in smoothly points the same way.
TURNED = -0.5
#: The largest number that is stored; the square of a larger one is none.
MOST = 1e150


class SplitWatch:
    """Watches the equations of each body, which a splitting scheme solves under the old pressure.

    What is left of them is the change of the pressure, J (p - p_old). Where more fluid moves with a body, or in a mode
    of its surface alone, than that weighs (its added mass m_a exceeds m, which it may where the whole body is much
    heavier), the pressure of a step pushes back what the last one pushed too far: what is left turns round in every
    step and grows by about m_a / m, and a step is worse than none, |b - Kx| > |b|. Every mode that grows does so by a
    negative factor, whatever its stiffness and damping. A load that sets in leaves more and more, too, at whatever
    rate, but all of it in one direction.

    Each body is judged by its own equations: beside what a heavy one bears, an unstable light one is nothing in a sum.

    Parameters
    ----------
    comm : MPI.Comm
    solid : SolidField
    stops : bool
        Whether such a run is stopped, before an element is turned inside out.

    Attributes
    ----------
    doubt : str
        What a user should know of the last step: once, that what is left has long turned round and grown.
    """

    def __init__(self, comm: MPI.Comm, solid: SolidField, stops: bool) -> None:
        self._comm, self._solid, self._stops = comm, solid, stops
        self.doubt, self._told = "", False
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        # by body what the last steps left, the last one's last, as far back as each left more than the one before it,
        # and more than its |b|; zeros before
        self._left = np.zeros((len(self._solid.names), 1 + PATIENCE))
        # by body in how many of the last steps what is left has turned round and grown
        self._turns = np.zeros(len(self._solid.names))
        self._residual = np.zeros(self._solid.layout.n_local)

    @property
    def rises(self) -> np.ndarray:
        """How many of the last steps of each body turned round and left more than the one before; at most PATIENCE."""
        return np.maximum(np.count_nonzero(self._left, axis=1) - 1, 0)

    def judge(self, system: System) -> None:
        """Look at the step just solved, before it is accepted. Collective.

        Raises
        ------
        FinalError
            On all ranks, if what is left of a body has risen often enough: shorter steps are the worst case.
        """
        rows = system.piece("solid")
        r, b, old = system.residual.array_r[rows], system.rhs.array_r[rows], self._residual
        # of each body r.r, b.b, r.old and old.old
        with np.errstate(over="ignore"):  # what blows up is told of by others
            products = [self._by_body(x) for x in (r * r, b * b, r * old, old * old)]
        sums = system.comm.allreduce(np.array(products))
        left, size, before = np.sqrt(sums[[0, 1, 3]])
        turned = sums[2] < TURNED * left * before
        last = self._left[:, -1]
        goes_on = turned & (last > 0) & (left > np.maximum(size, RISE * last))
        self._left = np.column_stack((np.where(goes_on[:, None], self._left[:, 1:], 0.0), left))
        self._turns = np.where(turned & (left > before), self._turns + 1.0, 0.0)
        self._residual = r.copy()
        if self._stops and self.rises.max() >= PATIENCE:
            raise FinalError(self.story())
        self.doubt = ""
        if not self._told and np.any((self._turns >= LONG) & (left > size)):
            self.doubt, self._told = self.story(), True

    def _by_body(self, values: np.ndarray) -> np.ndarray:
        """Return the sum over this rank's unknowns of each body."""
        return np.bincount(self._solid.owner, weights=values, minlength=len(self._solid.names))

    def story(self) -> str:
        """Return that splitting is what fails, if it is: what it left of a body has risen in the last step at least.

        Risen once may be what another body sets off that meets something, which then leaves more.
        """
        rises, left = self.rises, self._left[:, -1]
        counts = (rises > 1) | ((rises == 1) & (left == left.max())) | (self._turns >= SOME)
        if not counts.any():
            return ""
        worst = int(np.lexsort((left, self._turns, rises, counts))[-1])  # of those that rose most often what left most
        n, turns = int(rises[worst]), int(self._turns[worst])
        grown = f"has turned round in each of the last {turns} steps, and grown, to {left[worst]:.1e}"
        if n:
            first = self._left[worst, -1 - n]
            grown = f"has risen from {first:.1e} to {left[worst]:.1e} in {n} step{'s' * (n > 1)}"
        return (
            f"time splitting is unstable here: what it leaves over in the equations of solids."
            f"{self._solid.names[worst]}, |b - Kx|, {grown}. More fluid moves with the solid, or with a part of its "
            f"surface, than that weighs (added mass), and smaller steps make that worse. "
            f"Start again with -options_file monolithic.opts; split-iterated.opts holds only where the solid's "
            f"stiffness and damping in a step outweigh that fluid"
        )

    def keep(self) -> Callable[[], State]:
        """Return what gives the state of now, by which the next step is judged; that is collective."""
        residual = self._residual  # each step makes a new one
        table = np.column_stack((self._left, self._turns))
        mine = table if self._comm.rank == 0 else table[:0]
        slab = Slab(mine, (len(table) - len(mine), 0), table.shape)
        return lambda: {"left_by_body": slab, **self._solid.stored("residual", residual)}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        n, width = self._left.shape
        table = np.asarray(read("left_by_body", (0, 0), (n, width + 1)), dtype=float)
        residual = self._solid.read_stored(read, "residual")
        refuse(self._comm, [outside("left_by_body", table, 0.0, MOST), outside("residual", residual, -MOST, MOST)])
        self._left, self._turns, self._residual = table[:, :-1], table[:, -1], residual
