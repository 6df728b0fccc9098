"""The equation of an explicit step: a diagonal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.equations.lumped import LumpedEquation
from petfsi.fields.solid.equations.nodal import Constituents, NodalEquation
from petfsi.fields.solid.equations.spectrum import largest_eigenvalue
from petfsi.fields.solids import Forces
from petfsi.integrators.base import Motion, Stage


class ExplicitEquation(NodalEquation):
    """(a + a0) M w = b  with a lumped mass.

    Parameters
    ----------
    parts : Constituents

    Attributes
    ----------
    lumped : LumpedEquation
        Its left side.
    """

    def __init__(self, parts: Constituents) -> None:
        n, damping = parts.exchange.mesh.n_owned, parts.damping
        mass, held = parts.elements.lumped_mass(n), parts.supports.unknowns
        self.lumped = LumpedEquation(parts.layout, mass, damping.mass[:n], damping.stiffness[:n], held)
        super().__init__(parts, self.lumped)

    def assemble(self, stage: Stage, motion: Motion, time: float, dt: float, mass: float) -> None:
        """Refresh the diagonal A only if the step's length has changed, and b. Collective."""
        lumped = self.lumped
        # on all ranks or none, whichever bodies they have nodes of
        lag = lumped.lag(motion.velocity) if self._damping.most_stiffness else None
        if lag is not None:
            stage = replace(stage, shift=lag)
        # most explicit steps send one array only
        sent = stage.tangent_at if lag is None else np.concatenate((stage.tangent_at, stage.shift), axis=1)
        local = self._exchange.with_shared(sent)
        rest = np.zeros((len(local), self.width))
        state = State(local[:, : self.width], rest, rest if lag is None else local[:, self.width :])
        b = self.rhs.reshape(-1, self.width)
        self._elements.forces(state, b)
        b += lumped.mass * stage.inertia
        then = time + self._integrator.moment(dt)
        self._loaded = stage, state, self._gravity.add(then, b)
        if self._loads is not None:
            self._loads.assemble(then, state, 0.0, None, b)
        if self.reacts:
            self._pull = b.copy()
        self._prescribe(stage, motion, time, dt)
        lumped.prescribe(self.rhs, stage.a, mass, self.prescribed)
        made_for = stage.a, 0.0, dt, mass, self._added.version
        if self._assembled_for != made_for:
            self._assembled_for = made_for
            self._values[:] = lumped.diagonal(stage.a, mass)
            self._fill()

    def _reaction(self, stage: Stage, state: State, w: np.ndarray, given: Forces) -> np.ndarray:
        """Return what holds held unknowns: what their inertia takes beyond what pulls at them."""
        n = self._exchange.mesh.n_owned
        pulled = self.lumped.inertia(stage.a, w[:n]) - self._pull
        return np.where(self.is_held[:n], pulled, 0.0).ravel()

    def largest_eigenvalue(self, displacement: np.ndarray) -> float:
        """Return that of the free unknowns' M^-1 K' at a displacement, shape (n_owned, width), 1/s^2. Collective."""
        exchange, mesh = self._exchange, self._exchange.mesh
        d = exchange.with_shared(displacement)
        rest, free = np.zeros_like(d), ~self.is_held[: mesh.n_owned]
        here, there = np.empty_like(displacement), np.empty_like(displacement)
        self._elements.forces(State(d, rest, rest), here)

        def stiffness(v: np.ndarray) -> np.ndarray:
            self._elements.forces(State(d, rest, exchange.with_shared(v)), there)
            return np.where(free, here - there, 0.0)

        # the same on any number of ranks, and in a run resumed
        start = np.sin(1.0 + np.arange(self._layout.n_global) ** 2).reshape(-1, self.width)
        start = np.where(free, start[mesh.natural[: mesh.n_owned]], 0.0)
        return largest_eigenvalue(exchange.comm, stiffness, self.lumped.mass, start)
