"""The equation of an implicit step, or of statics: a matrix over all nodes that share an element."""

from __future__ import annotations

import numpy as np

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.equations.nodal import Constituents, NodalEquation
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.supports import Elimination
from petfsi.fields.solids import Forces
from petfsi.integrators.base import Motion, Stage

#: By how much of itself the diagonal grows where stress that has yet to come will hold a body in statics.
FIRMER = 1e-8


class ConsistentEquation(NodalEquation):
    """(a M + k K'(d) + C) w = b, with rows and columns of held unknowns emptied.

    Parameters
    ----------
    parts : Constituents
    pattern : Pattern

    Attributes
    ----------
    awaits_stress : bool
        Whether A alone is singular, as long as no stress holds bodies as they turn.
    """

    def __init__(self, parts: Constituents, pattern: Pattern) -> None:
        super().__init__(parts, pattern)
        self._blocks = pattern
        self._elimination = Elimination(pattern, self._layout, self._supports.unknowns)
        self._diagonal = (0.0, 0.0), 1.0
        self.awaits_stress = False

    def assemble(self, stage: Stage, motion: Motion, time: float, dt: float, mass: float) -> None:
        """Refresh A (only if it changes) and b. Collective."""
        b = self.rhs.reshape(-1, self.width)
        local = self._exchange.with_shared(np.concatenate((stage.tangent_at, stage.inertia, stage.shift), axis=1))
        state = State(*(local[:, n * self.width : (n + 1) * self.width] for n in range(3)))
        made_for = stage.a, stage.k, dt, mass, self._added.version
        values = None if self.is_linear and made_for == self._assembled_for else self._values
        if values is None:  # A is still the same
            self._elements.forces(state, b)
        else:
            diagonal = self._mean_diagonal(stage, mass)
            self._elements.assemble(state, stage.a, stage.k, self._blocks, values, b)
        then = time + self._integrator.moment(dt)
        self._loaded = stage, state, self._gravity.add(then, b)
        if self._loads is not None:
            self._loads.assemble(then, state, stage.k, values, b)
        self._prescribe(stage, motion, time, dt)
        if values is not None:
            if self.awaits_stress:  # A alone is singular: round-off would say how far the body turns
                values[self._on_diagonal()] *= 1.0 + FIRMER
            self._elimination.empty(values, diagonal)
            self._fill()
            self._assembled_for = made_for
        self._elimination.prescribe(self.rhs, self.prescribed)

    def _on_diagonal(self) -> np.ndarray:
        """Return which of A's entries on this rank are on its diagonal."""
        rows = np.repeat(np.arange(self._layout.n_local), np.diff(self._blocks.indptr))
        return self._blocks.indices == rows + self._layout.start

    def _mean_diagonal(self, stage: Stage, mass: float) -> float:
        """Return what stands in rows of prescribed unknowns: inertia, in statics the mean of A's diagonal. Collective.

        Stiffness would make |b|, which tolerances are relative to, larger than all that is solved for.
        """
        if stage.a > 0:
            return stage.a * mass
        factors, diagonal = self._diagonal
        if factors != (stage.a, stage.k):
            mesh = self._exchange.mesh
            rest = np.zeros((len(mesh.points), self.width))
            state, b = State(rest, rest, rest), np.empty((mesh.n_owned, self.width))
            self._elements.assemble(state, stage.a, stage.k, self._blocks, self._values, b)
            total = self._values[self._on_diagonal()].sum()
            diagonal = self._exchange.comm.allreduce(float(total)) / self._layout.n_global
            self._diagonal = (stage.a, stage.k), diagonal
        return diagonal

    def jolt(self, jump: np.ndarray) -> np.ndarray:
        """Return -A[:, F] g for a jump g of all held unknowns F, zero at these: they have jumped."""
        pull = np.zeros(self._layout.n_local)
        self._elimination.prescribe(pull, jump)
        pull[self.held_here] = 0.0
        return pull

    def _reaction(self, stage: Stage, state: State, w: np.ndarray, given: Forces) -> np.ndarray:
        """Return what holds held unknowns: the residual as what forces give for what is left of the equation."""
        a0, a1 = self._damping.mass[:, None], self._damping.stiffness[:, None]
        inertia, shift = state.inertia - (stage.a + a0) * w, state.shift + (stage.k + a1) * w
        return self._holding(State(state.displacement, inertia, shift), given)
