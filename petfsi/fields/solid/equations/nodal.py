"""The equation  A w = b  of a step of nodal solids, see ``integrators``: block, right-hand side and residual."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.equations.damping import RayleighDamping
from petfsi.fields.solid.equations.gravity import Gravity
from petfsi.fields.solid.equations.lumped import LumpedEquation
from petfsi.fields.solid.equations.mass import AddedRows, Rows
from petfsi.fields.solid.exchange import NodalExchange
from petfsi.fields.solid.libraries import ElementLibrary, LoadLibrary
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.supports import Supports
from petfsi.fields.solids import Forces
from petfsi.integrators.base import Integrator, Motion, Stage
from petfsi.petsc import Layout, new_block, set_csr
from petfsi.scene.expressions import ExpressionError


@dataclass(frozen=True)
class Constituents:
    """What a step's equation is made of.

    Attributes
    ----------
    layout : Layout
        Of the unknowns.
    """

    exchange: NodalExchange
    layout: Layout
    elements: ElementLibrary
    loads: LoadLibrary | None
    gravity: Gravity
    supports: Supports
    damping: RayleighDamping
    integrator: Integrator


class NodalEquation(ABC):
    """A step's equation, and what can be said of forces once it is solved.

    Parameters
    ----------
    parts : Constituents
    rows : Pattern or LumpedEquation
        Whatever has the pattern of A.

    Attributes
    ----------
    width : int
        Unknowns a node.
    block : PETSc.Mat
        A.
    rhs : ndarray, shape (layout.n_local,)
        b.
    is_linear : bool
        Whether its tangent never changes.
    is_held : ndarray of bool, shape (n, width)
        Which unknowns of local nodes supports hold.
    prescribed : ndarray
        w of all of them in the step last assembled, in the order of ``supports.unknowns``.
    damps, reacts : bool
        Whether damping takes work, and whether supports can do any.
    n_assembled, pattern_version : int
        See ``Field``.
    """

    def __init__(self, parts: Constituents, rows: Pattern | LumpedEquation) -> None:
        exchange, layout, supports = parts.exchange, parts.layout, parts.supports
        elements, loads, integrator = parts.elements, parts.loads, parts.integrator
        self._exchange, self._layout, self._integrator = exchange, layout, integrator
        self._elements, self._loads, self._gravity = elements, loads, parts.gravity
        self._supports, self._damping = supports, parts.damping
        mesh = exchange.mesh
        self.width = layout.n_global // mesh.nodes.n_global
        self.is_linear = elements.constant and not (loads is not None and loads.follow)
        self.damps = parts.damping.anywhere
        # without inertia the first step is the way there from the initial displacement, and has its work
        self.reacts = supports.move or (not integrator.inertia and len(supports.placed) > 0)
        local = self.width * mesh.number.astype(np.int64)[:, None] + np.arange(self.width)
        self.is_held = np.isin(local, supports.unknowns)
        self.prescribed = np.zeros(len(supports.unknowns))
        self.rhs = np.zeros(layout.n_local)
        self.block = new_block(exchange.comm, layout, layout, block_size=self.width)
        self._pattern = rows.indptr, rows.indices
        self._values = np.zeros(len(rows.indices))
        set_csr(self.block, *self._pattern, self._values, new_pattern=True)
        self._added = AddedRows(exchange.comm)
        self._assembled_for = 0.0, 0.0, 0.0, 0.0, 0  # a, k, dt, the mass in row_scale, and what was added
        self._loaded: tuple[Stage, State, np.ndarray] | None = None
        self.n_assembled = self.pattern_version = 0

    @property
    def rows(self) -> Rows:
        """Where this rank's rows of A as last assembled begin, their global columns and values, SI."""
        return *self._pattern, self._values

    @property
    def held_here(self) -> np.ndarray:
        """Which of this rank's own unknowns supports hold, flat."""
        return self.is_held[: self._exchange.mesh.n_owned].ravel()

    @property
    def acting(self) -> tuple[str, ...]:
        """The names in ``forces``."""
        acts = {"gravity": self._gravity.acts, "loads": self._loads is not None, "boundary": self.reacts}
        return tuple(name for name, does in acts.items() if does)

    @abstractmethod
    def assemble(self, stage: Stage, motion: Motion, time: float, dt: float, mass: float) -> None:
        """Refresh A (only if it changes) and b for the step from ``time`` to ``time + dt``. Collective.

        Parameters
        ----------
        stage : Stage
            Of the step.
        motion : Motion
            At its begin.
        time, dt : float
        mass : float
            What rows are measured against, kg.
        """

    def take_mass(self, rows: Rows | None) -> None:
        """Add these rows to A from now on."""
        self._added.take(rows)

    def fixed_velocity(self) -> np.ndarray:
        """Return w of the step last assembled at prescribed unknowns, zero at free ones."""
        g = np.zeros(self._layout.n_global)
        g[self._supports.unknowns] = self.prescribed
        return g

    def _fill(self) -> None:
        """Fill the block with A's values and what was added. Collective."""
        self.pattern_version += self._added.fill(self.block, self.rows)
        self.n_assembled += 1

    def _prescribe(self, stage: Stage, motion: Motion, time: float, dt: float) -> None:
        """Ask the supports for what they prescribe in a step. Collective."""
        first, *others = self._integrator.instants(dt)
        supports = self._supports
        self.prescribed = supports.velocities(time + first).copy()
        if others:
            every = [self.prescribed, *(supports.velocities(time + t).copy() for t in others)]
            self.prescribed = np.mean(every, axis=0)
        if len(supports.placed):
            there = self._exchange.comm, self._layout, self._integrator, motion
            self.prescribed[supports.placed] = supports.reaching(*there, stage, time, dt)

    # ---- what acted, once it is solved ------------------------------------------------------------------------

    def forces(self, solved: np.ndarray) -> Forces:
        """Return gravity, loads and reactions of the step last assembled for its solution. Collective.

        A reaction is the residual of a held unknown's equation, without other fields' forces.

        Parameters
        ----------
        solved : ndarray, shape (n_owned, width)
            w.
        """
        assert self._loaded is not None  # a step was assembled
        stage, state, gravity = self._loaded
        shares = self._loads is not None or self.reacts
        w = self._exchange.with_shared(solved) if shares else np.zeros(0)
        found: Forces = {}
        if self._gravity.acts:
            found["gravity"] = self._gravity.force(gravity)
        if self._loads is not None:
            found["loads"] = self._loads.felt(w).ravel()
        if self.reacts:
            found["boundary"] = self._reaction(stage, state, w, found)
        return found

    @abstractmethod
    def _reaction(self, stage: Stage, state: State, w: np.ndarray, given: Forces) -> np.ndarray:
        """Return what holds held unknowns, zero at free ones, flat. Collective.

        Parameters
        ----------
        stage : Stage
        state : State
            Where the step's forces were taken.
        w : ndarray, shape (n, width)
            At all local nodes.
        given : dict of str to ndarray
            What else acts.
        """

    def starting_forces(self, displacement: np.ndarray) -> Forces:
        """Return the same at time zero, reactions in statics alone: it is at rest. Collective.

        Nothing where an expression has no value yet.

        Parameters
        ----------
        displacement : ndarray, shape (n_owned, width)
        """
        d = self._exchange.with_shared(displacement)
        found: Forces = {}
        try:
            if self._gravity.acts:
                found["gravity"] = self._gravity.force(self._gravity.at(0.0))
            if self._loads is not None:
                found["loads"] = self._loads.start(d).ravel()
        except ExpressionError:  # on all ranks
            return {}
        if self.reacts and not self._integrator.inertia:
            rest = np.zeros_like(d)
            found["boundary"] = self._holding(State(d, rest, rest), found)
        return found

    def _holding(self, state: State, given: Forces) -> np.ndarray:
        """Return what holds held unknowns against a state's forces and what else is given, zero at free ones, flat."""
        pulled = np.empty((self._exchange.mesh.n_owned, self.width))
        self._elements.forces(state, pulled)
        total = pulled.ravel() + sum(given.values())
        return np.where(self.held_here, -total, 0.0)

    def dissipation(self, solved: np.ndarray) -> float:
        """Return this rank's share of w . C w of the step last assembled, given its w, W. Collective."""
        if self._loaded is None or not self.damps:
            return 0.0
        w = self._exchange.with_shared(solved)
        return self._elements.damping(self._loaded[1].displacement, w, self._exchange.mesh.counted)
