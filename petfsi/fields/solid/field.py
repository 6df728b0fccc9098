"""Solids whose unknowns sit on nodes: the step, the supports and the state that all of them share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.fields.base import Stock, Work
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.solid.conflicts import conflicts
from petfsi.fields.solid.edges import Edges
from petfsi.fields.solid.elements import State
from petfsi.fields.solid.libraries import ElementLibrary, LoadLibrary
from petfsi.fields.solid.loose import RigidMotion, loose_motions, refusal
from petfsi.fields.solid.lumped import LumpedEquation
from petfsi.fields.solid.mass import AddedRows, Rows
from petfsi.fields.solid.partition import Fetch, distribute, slab
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.shrinkage import Shrinkage
from petfsi.fields.solid.spectrum import largest_eigenvalue
from petfsi.fields.solid.supports import Elimination, Supports
from petfsi.fields.solid.turning import Turning, bodies_of
from petfsi.fields.solids import FAR, Forces, Landing, SolidField
from petfsi.fields.stored import outside, refuse, step_fault
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.places import Tags, read_tags, with_middles
from petfsi.integrators.base import Motion, Stage, moved, relinearised
from petfsi.petsc import Layout, new_block, set_csr
from petfsi.ranks import on_root
from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid
from petfsi.scene.stepping import Stepping
from petfsi.scene.tables import Number

#: The least mass that rows can be measured against, kg; of the greatest the inverse.
LIGHTEST = 1e-150
#: What is left of forces that cancel, as a part of them.
UNPUSHED = 1e-9
#: By how much of itself the diagonal grows where stress that has yet to come will hold a body in statics.
FIRMER = 1e-8


class NodalSolid(SolidField):
    """The solids of a scene; the unknown is the velocity w of every node where the integrator takes the forces.

    A step solves  A w = b + J p  (see ``integrators``) and moves the nodes by the integrator's rule. Unknown
    ``width * node + component`` in the partition's numbering; the first ``dim`` components are along the axes.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    solids : dict of str to Solid
        The bodies of this field.
    mesh : SimplexMesh
        All of them, the same on every rank.
    components : tuple of str
        What a node's unknowns are called in the scene.

    Attributes
    ----------
    names : list of str
        The bodies, in the order of the scene.
    width : int
        Unknowns a node.
    extent : float
        Largest side of the bounding box of all bodies at rest, m.
    reference : ndarray, shape (n_owned, dim)
        Positions of this rank's nodes at rest, m.
    displacement, velocity : ndarray, shape (n_owned, width)
        Of this rank's nodes, m and m/s.
    """

    name = "solid"

    def __init__(
        self, comm: MPI.Comm, scene: Scene, solids: Mapping[str, Solid], mesh: SimplexMesh, components: tuple[str, ...]
    ):
        self.comm = comm
        self.dim: int = scene.dim
        self.width = len(components)
        self.names = list(solids)
        self.extent = float(np.ptp(mesh.points, axis=0).max())
        self._integrator = scene.time.scheme
        self.explicit = self.diagonal = self._integrator.explicit
        self._has_inertia = self._integrator.inertia
        if self.explicit:
            solids = {name: solid.model_copy(update={"mass": "lumped"}) for name, solid in solids.items()}
        self._node_body = np.empty(len(mesh.points), dtype=np.int32)
        self._node_body[mesh.cells] = mesh.body[:, None]
        self._mesh, self._number = distribute(comm, mesh)
        n_owned = self._mesh.n_owned
        self.reference = self._mesh.points[:n_owned]
        self.layout = Layout.of(comm, self.width * n_owned)
        self._elements = self._make_elements(solids)
        self._gravity = [Expression(g, ("t",), f"gravity.{n}") for n, g in enumerate(scene.gravity or [])]
        self._uniform = self._elements.uniform_load(n_owned)
        self.set_scale(comm.allreduce(float(self._uniform[0, :, 0].sum())) / len(mesh.points))

        self._tags = on_root(comm, lambda: _tags(scene, solids, mesh))
        self._supports = Supports(solids, mesh.points, self._node_body, self._number, components, self._tags)
        self.warnings = conflicts(self._supports.overlaps, scene.time.end)
        self._damping = np.array([[solid.damping.mass, solid.damping.stiffness] for solid in solids.values()])
        self._lumped = self._lump() if self.explicit else None
        self._set_pattern()
        self._loads = self._make_loads(mesh, solids)
        self.is_linear = self._elements.constant and not (self._loads is not None and self._loads.follow)
        self._set_exchange(mesh)
        # where there is no inertia, what nothing holds is looked for
        self._whole = None if self._has_inertia else mesh
        self._set_motion(mesh, solids, Stepping(scene.time).length(0.0))
        self._set_turning(mesh)

    @abstractmethod
    def _make_elements(self, solids: Mapping[str, Solid]) -> ElementLibrary:
        """Return the elements of ``self._mesh``."""

    def _make_loads(self, mesh: SimplexMesh, solids: Mapping[str, Solid]) -> LoadLibrary | None:
        """Return the loads of ``self._mesh``, or None if there are none. Collective."""
        return None

    def _turning_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the simplices or segments of ``self._mesh`` that can turn without a force, and what resists shrinking.

        Returns
        -------
        parts : ndarray of int, shape (ne, n)
        body : ndarray of int, shape (ne,)
        modulus : ndarray, shape (n_bodies,)
            See ``Shrinkage``.
        """
        return np.zeros((0, 2), dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(len(self.names))

    def _set_turning(self, mesh: SimplexMesh) -> None:
        """Make what has predictions turn, or watches what the middle of a rotation does. Collective."""
        self._turning: Turning | None = None
        self._shrinkage: Shrinkage | None = None
        parts, body, modulus = self._turning_parts()
        if self.explicit or not self._has_inertia or not self.comm.allreduce(len(parts)):
            return
        mine = self._mesh.natural[: self._mesh.n_owned]
        mass = np.stack([self._uniform[a][:, a] for a in range(self.dim)], axis=1)
        if self._integrator.moment(1.0) < 1.0:
            owner = self._node_body[mine]
            self._shrinkage = Shrinkage(self.comm, self._mesh, parts, body, modulus, mass, owner)
            return
        held = np.zeros(self.layout.n_global, dtype=bool)
        held[self._supports.still] = True
        still = held[self.layout.start : self.layout.end].reshape(-1, self.width)[:, : self.dim]
        self._turning = Turning(self.comm, self._mesh, parts, bodies_of(mesh)[mine], still, mass, self._with_shared)

    def _stiffens(self, body: int) -> bool:
        """Return whether loads that do not follow it may hold a body in its place as it turns."""
        return False

    @abstractmethod
    def near_null_space(self) -> list[np.ndarray]:
        """Return the rigid motions about the origin of coordinates: translations, then rotations."""

    # ---- set-up -----------------------------------------------------------------------------------------------

    def _set_motion(self, mesh: SimplexMesh, solids: Mapping[str, Solid], dt: float) -> None:
        initial = {name: solid.initial for name, solid in solids.items()}
        mine = self._mesh.natural[: self._mesh.n_owned]
        moved = {name: ("displacement", start.displacement) for name, start in initial.items()}
        thrown = {name: ("velocity", start.velocity) for name, start in initial.items()}
        self.displacement = _evaluate(moved, mesh.points, self._node_body, self.width)[mine]
        velocity = _evaluate(thrown, mesh.points, self._node_body, self.width)
        self.velocity = velocity[mine]
        self.moved = np.zeros(self.layout.n_local)
        self._stage: Stage | None = None
        self._geometry: np.ndarray | None = None
        self._loaded: tuple[Stage, State, np.ndarray] | None = None
        self._past = tuple(np.zeros_like(self.velocity) for _ in self._integrator.past)
        self._past_dt = 0.0
        self._prescribed = self._supports.initial_velocities(dt)
        held = self._supports.unknowns
        given = np.empty_like(velocity)
        given[self._number] = velocity
        self._jump = self._supports.jumps(given.ravel()[held], dt)
        here = (held >= self.layout.start) & (held < self.layout.end)
        local = self.width * self._mesh.number.astype(np.int64)[:, None] + np.arange(self.width)
        self._is_held = np.isin(local, held)
        placed = self._supports.placed
        self._damps = bool(np.any(self._damping))
        self._reacts = self._supports.move
        if self._has_inertia:
            self.velocity.reshape(-1)[held[here] - self.layout.start] = self._prescribed[here]
            here = here[placed]
            where = held[placed][here] - self.layout.start
            self.displacement.reshape(-1)[where] = self._supports.displacements(0.0)[here]
        else:  # the first step is the way there from the initial displacement, and has its work
            self._reacts |= len(placed) > 0
        acts = {"gravity": bool(self._gravity), "loads": self._loads is not None, "boundary": self._reacts}
        self.acting = tuple(name for name, does in acts.items() if does)
        self._measured = self.displacement.copy()

    @cached_property
    def _pattern(self) -> Pattern:
        return Pattern.of(self._mesh, self.width)

    def _lump(self) -> LumpedEquation:
        damping = self._damping[self._node_body[self._mesh.natural[: self._mesh.n_owned]]]
        mass = self._elements.lumped_mass(self._mesh.n_owned)
        return LumpedEquation(self.layout, mass, damping[:, 0], damping[:, 1], self._supports.unknowns)

    def _set_pattern(self) -> None:
        self.rhs = np.zeros(self.layout.n_local)
        self.block = new_block(self.comm, self.layout, self.layout, block_size=self.width)
        rows: Pattern | LumpedEquation
        if self._lumped is None:
            rows = self._pattern
            self._elimination = Elimination(self._pattern, self.layout, self._supports.unknowns)
        else:
            rows = self._lumped
        self._values = np.zeros(len(rows.indices))
        set_csr(self.block, rows.indptr, rows.indices, self._values, new_pattern=True)
        vectors = []
        for mode in self.near_null_space():
            vector = self.block.createVecRight()
            vector.setArray(mode)
            vectors.append(vector)
        self.block.setNearNullSpace(PETSc.NullSpace().create(vectors=vectors, comm=self.comm))
        self._diagonal = (0.0, 0.0), 1.0
        self._awaits_stress = False
        self._assembled_for = 0.0, 0.0, 0.0, 0.0, 0  # a, k, dt, the mass in row_scale, and what was added
        self._added = AddedRows(self.comm)

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where this rank's rows of A as last assembled begin, their global columns and values, SI."""
        rows = self._pattern if self._lumped is None else self._lumped
        return rows.indptr, rows.indices, self._values

    def _set_exchange(self, mesh: SimplexMesh) -> None:
        """Prepare the messages between owned, shared and naturally ordered nodes."""
        comm, nodes = self.comm, self._mesh.nodes
        begin, end = slab(len(self._number), comm.rank, comm.size)
        self._share = Fetch(comm, nodes, self._mesh.number[nodes.n_local :])
        self._to_natural = Fetch(comm, nodes, self._number[begin:end])
        self._from_natural = Fetch(comm, Layout.of(comm, end - begin), self._mesh.natural[: nodes.n_local])
        self._slab = begin, end, len(self._number)

    # ---- the step ---------------------------------------------------------------------------------------------

    def unknown(self) -> np.ndarray:
        """Return w of the step last accepted, flat."""
        return self._integrator.solved(self._motion()).ravel().copy()

    def foreseen(self) -> np.ndarray:
        """Return w of the step last assembled as supports give it, elsewhere that of the last step, flat."""
        given = self.fixed_velocity()[self.layout.start : self.layout.end]
        return np.where(self._is_held[: self._mesh.n_owned].ravel(), given, self.unknown())

    def predict(self, time: float, dt: float) -> None:
        """Take the geometry of the step: from here until ``accept`` the surface is where the tangent is taken."""
        motion = self._motion()
        self._stage = self._integrator.stage(motion, dt)
        added = None if self._turning is None else self._integrator.turned(motion, dt, self._turning)
        if added is not None:
            self._stage = moved(self._stage, added)
        self._geometry = self._stage.tangent_at

    def predicted(self) -> float:
        """Return how far off the farthest of this rank's nodes is where the step's equations are taken, m."""
        there = self.displacement if self._geometry is None else self._geometry
        return float(np.abs(self.along_axes(there - self.displacement)).max(initial=0.0))

    def assemble(self, time: float, dt: float) -> None:
        """Refresh A (only if it changes) and b for the step from ``time`` to ``time + dt``. Collective."""
        if self._lumped is not None:
            self._assemble_lumped(self._lumped, time, dt)
            return
        stage = self._stage or self._rehearsed(dt)
        b = self.rhs.reshape(-1, self.width)
        local = self._with_shared(np.concatenate((stage.tangent_at, stage.inertia, stage.shift), axis=1))
        state = State(*(local[:, n * self.width : (n + 1) * self.width] for n in range(3)))
        made_for = stage.a, stage.k, dt, self._reference_mass, self._added.version
        values = None if self.is_linear and made_for == self._assembled_for else self._values
        if values is None:  # A is still the same
            self._elements.forces(state, b)
        else:
            diagonal = self._mean_diagonal(stage)
            self._elements.assemble(state, stage.a, stage.k, self._pattern, values, b)
        self._loaded = stage, state, self._add_weight(time, dt)
        if self._loads is not None:
            self._loads.assemble(time + self._integrator.moment(dt), state, stage.k, values, b)
        self._prescribe(stage, time, dt)
        if values is not None:
            if self._awaits_stress:  # A alone is singular: round-off would say how far the body turns
                values[self._on_diagonal()] *= 1.0 + FIRMER
            self._elimination.empty(values, diagonal)
            self._fill(self._pattern.indptr, self._pattern.indices)
            self._assembled_for = made_for
        self._elimination.prescribe(self.rhs, self._prescribed)
        self.row_scale = dt / self._reference_mass

    def _rehearsed(self, dt: float) -> Stage:
        """Return the coming step's equation, linearised where the bodies are: no velocity has been predicted with."""
        stage = self._integrator.stage(self._motion(), dt)
        return moved(stage, self.displacement - stage.tangent_at)

    def _assemble_lumped(self, lumped: LumpedEquation, time: float, dt: float) -> None:
        """Refresh the diagonal A only if the step's length has changed, and b. Collective."""
        stage, mean = self._stage or self._integrator.stage(self._motion(), dt), self._reference_mass
        # on all ranks or none, whichever bodies they have nodes of
        lag = lumped.lag(self.velocity) if self._damping[:, 1].any() else None
        if lag is not None:
            stage = replace(stage, shift=lag)
        # most explicit steps send one array only
        sent = stage.tangent_at if lag is None else np.concatenate((stage.tangent_at, stage.shift), axis=1)
        local = self._with_shared(sent)
        rest = np.zeros((len(local), self.width))
        state = State(local[:, : self.width], rest, rest if lag is None else local[:, self.width :])
        b = self.rhs.reshape(-1, self.width)
        self._elements.forces(state, b)
        b += lumped.mass * stage.inertia
        self._loaded = stage, state, self._add_weight(time, dt)
        if self._loads is not None:
            self._loads.assemble(time + self._integrator.moment(dt), state, 0.0, None, b)
        if self._reacts:
            self._pull = b.copy()
        self._prescribe(stage, time, dt)
        lumped.prescribe(self.rhs, stage.a, mean, self._prescribed)
        made_for = stage.a, 0.0, dt, mean, self._added.version
        if self._assembled_for != made_for:
            self._assembled_for = made_for
            self._values[:] = lumped.diagonal(stage.a, mean)
            self._fill(lumped.indptr, lumped.indices)
        self.row_scale = dt / mean

    def _fill(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        """Fill the block with A's values and what was added. Collective."""
        self.pattern_version += self._added.fill(self.block, (indptr, indices, self._values))
        self.n_assembled += 1

    def take_mass(self, rows: Rows | None) -> None:
        """Add these rows to A from now on."""
        self._added.take(rows)

    def _add_weight(self, time: float, dt: float) -> np.ndarray:
        """Add gravity's force to b and return it, m/s^2."""
        b, gravity = self.rhs.reshape(-1, self.width), np.zeros(self.dim)
        for axis, g in enumerate(self._gravity):
            gravity[axis] = float(g(t=time + self._integrator.moment(dt)))
            if gravity[axis]:
                b += gravity[axis] * self._uniform[axis]
        return gravity

    def linearised_at(self) -> np.ndarray:
        """Return the w with  D0 + k w = d~."""
        stage = self._stage
        return self.unknown() if stage is None or stage.k == 0 else (-stage.shift / stage.k).ravel()

    def round_off(self, x: np.ndarray) -> float:
        """Return eps ||A|| (||w|| + ||d~|| / k): forces come from positions that were rounded, too. Collective."""
        stage = self._stage
        if stage is None or stage.k == 0:
            return super().round_off(x)
        return super().round_off(np.concatenate((x, stage.tangent_at.ravel() / stage.k)))

    def relinearise(self, x: np.ndarray) -> bool:
        """Take K and K' where w brings the nodes; nothing if the step has no K' or K' is always the same."""
        stage = self._stage
        if stage is None or stage.k == 0 or self.is_linear:
            return False
        self._stage = relinearised(stage, x.reshape(-1, self.width))
        self._awaits_stress = False
        return True

    def jolt(self) -> np.ndarray | None:
        """Return -A[:, F] g for the jump g that supports' velocities make at the start; None if they make none."""
        if self.explicit or not self._has_inertia or not self._jump.any():
            return None
        pull = np.zeros(self.layout.n_local)
        self._elimination.prescribe(pull, self._jump)
        pull[self._is_held[: self._mesh.n_owned].ravel()] = 0.0  # these have jumped
        return pull

    def push(self, change: np.ndarray) -> None:
        """Change the present velocities by this much."""
        self.velocity = self.velocity + change.reshape(-1, self.width)

    def rewind(self) -> None:
        """Forget the step begun."""
        self._stage = self._geometry = None

    def unheld(self) -> list[str]:
        """Return what is wrong with bodies that nothing holds in statics, where the step is assembled. Collective."""
        if self._whole is None:
            return []
        mesh, held = self._whole, np.zeros(self.layout.n_global, dtype=bool)
        held[self._supports.unknowns] = True
        held = held.reshape(-1, self.width)[self._number]
        d, force = (
            np.concatenate(self.comm.allgather(owned))[self._number]
            for owned in (self.displacement[:, : self.dim], self.rhs.reshape(-1, self.width))
        )
        force[held] = 0.0
        found: dict[int, list[tuple[RigidMotion, float]]] = {}
        wrong = []
        for motion in loose_motions(mesh, mesh.points + d, held):
            push, steadies = self._pushed(motion, force[motion.nodes])
            found.setdefault(motion.body, []).append((motion, push))
            if push or not steadies:
                wrong.append(motion.body)
        self._awaits_stress = bool(found) and not wrong
        return [refusal(self.names[body], found[body], self.dim) for body in dict.fromkeys(wrong)]

    def _pushed(self, motion: RigidMotion, force: np.ndarray) -> tuple[float, bool]:
        """Return the work of nodal forces (n, width) along a motion, and whether they hold the body as it turns."""
        works, curved = force * motion.values, force[:, : self.dim] * motion.centripetal
        push = float(works.sum())
        follow = self._loads is not None and self._loads.follow
        steadies = bool(np.any(curved)) and (follow or self._stiffens(motion.body))
        steadies = steadies and (follow or abs(float(curved.sum())) > UNPUSHED * float(np.abs(curved).sum()))
        return (push if abs(push) > UNPUSHED * float(np.abs(works).sum()) else 0.0), steadies

    def stable_step(self) -> float:
        """Return the longest stable step of an explicit scheme at the present displacement, s. Collective."""
        if self._lumped is None:
            return np.inf
        self._measured = self.displacement.copy()
        d = self._with_shared(self._measured)
        rest, free = np.zeros_like(d), ~self._is_held[: self._mesh.n_owned]
        here, there = np.empty_like(self.displacement), np.empty_like(self.displacement)
        self._elements.forces(State(d, rest, rest), here)

        def stiffness(v: np.ndarray) -> np.ndarray:
            self._elements.forces(State(d, rest, self._with_shared(v)), there)
            return np.where(free, here - there, 0.0)

        # the same on any number of ranks, and in a run resumed
        start = np.sin(1.0 + np.arange(len(self._number) * self.width) ** 2).reshape(-1, self.width)
        start = np.where(free, start[self._mesh.natural[: self._mesh.n_owned]], 0.0)
        eigenvalue = largest_eigenvalue(self.comm, stiffness, self._lumped.mass, start)
        return self._integrator.stable_step(eigenvalue, float(self._damping[:, 1].max()))

    def stretch(self) -> float:
        """Return the largest change of an edge over its length since the last ``stable_step``. Collective."""
        return self._edges.stretch(self._with_shared(self.displacement - self._measured))

    @cached_property
    def _edges(self) -> Edges:
        return Edges(self.comm, self._mesh)

    @property
    def finest(self) -> float:
        """Length of the shortest edge at rest, m. Collective at first."""
        return self._edges.shortest

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the velocities w and move the nodes."""
        motion = self._arrival(x, dt)
        self.moved = (motion.displacement - self.displacement).ravel()
        self.displacement, self.velocity = motion.displacement, motion.velocity
        self._past, self._past_dt = motion.past, motion.past_dt
        self._stage = self._geometry = None

    def _arrival(self, x: np.ndarray, dt: float) -> Motion:
        """Return the motion at the end of the step with the velocities w."""
        motion = self._motion()
        stage = self._stage or self._integrator.stage(motion, dt)
        return self._integrator.finish(motion, stage, x.reshape(-1, self.width).copy(), dt)

    def remark(self, dt: float) -> str | None:
        """Return which bodies turn too far in a step for the midpoint rule, each once. Collective."""
        if self._shrinkage is None or not self._shrinkage.watches:
            return None
        both = self._with_shared(np.concatenate((self.displacement, self.velocity), axis=1))
        d, u = both[:, : self.dim], both[:, self.width : self.width + self.dim]
        return self._shrinkage.remark(self.names, d, u, dt)

    def landing(self, dt: float) -> Landing:
        """Return how a step of dt brings nodes to its end."""
        scheme, stage = self._integrator, self._stage or self._integrator.stage(self._motion(), dt)
        return Landing(scheme.moment(dt) == dt, scheme.stride(stage, dt), scheme.swings)

    def _shift(self) -> np.ndarray:
        """Return how far nodes are from where the fluid meets them to where w = 0 leads, shape (n_owned, width)."""
        stage, met = self._stage, self._geometry
        return np.zeros_like(self.velocity) if stage is None else stage.tangent_at + stage.shift - met

    def _destination(self, x: np.ndarray | None, dt: float) -> np.ndarray:
        """Return the displacement after a step of dt with the solution x (None: zero)."""
        return self._arrival(np.zeros(self.layout.n_local) if x is None else x, dt).displacement

    def _motion(self) -> Motion:
        return Motion(self.displacement, self.velocity, self._past, self._past_dt)

    @property
    def mean_mass(self) -> float:
        """What rows are measured against: unless told otherwise the mean nodal mass, kg."""
        return self._reference_mass

    def set_scale(self, reference_mass: float) -> None:
        """Measure rows against this mass (kg) rather than the mean nodal mass: ``row_scale = dt / mass``.

        Raises
        ------
        InputError
            If numbers cannot hold it, or what is divided by it.
        """
        if not LIGHTEST < reference_mass < 1 / LIGHTEST:
            raise InputError(
                f"a node or cell of {reference_mass:g} kg is too light or too heavy; look at densities, and at the "
                f"sizes of cells"
            )
        self._reference_mass = reference_mass

    def _on_diagonal(self) -> np.ndarray:
        """Return which of A's entries on this rank are on its diagonal."""
        rows = np.repeat(np.arange(self.layout.n_local), np.diff(self._pattern.indptr))
        return self._pattern.indices == rows + self.layout.start

    def _mean_diagonal(self, stage: Stage) -> float:
        """Return what stands in rows of prescribed unknowns: inertia, in statics the mean of A's diagonal. Collective.

        Stiffness would make |b|, which tolerances are relative to, larger than all that is solved for.
        """
        if stage.a > 0:
            return stage.a * self._reference_mass
        factors, diagonal = self._diagonal
        if factors != (stage.a, stage.k):
            rest = np.zeros((len(self._mesh.points), self.width))
            state, b = State(rest, rest, rest), np.empty((self._mesh.n_owned, self.width))
            self._elements.assemble(state, stage.a, stage.k, self._pattern, self._values, b)
            total = self._values[self._on_diagonal()].sum()
            diagonal = self.comm.allreduce(float(total)) / self.layout.n_global
            self._diagonal = (stage.a, stage.k), diagonal
        return diagonal

    def _prescribe(self, stage: Stage, time: float, dt: float) -> None:
        first, *others = self._integrator.instants(dt)
        placed = self._supports.placed
        self._prescribed = self._supports.velocities(time + first).copy()
        if others:
            every = [self._prescribed, *(self._supports.velocities(time + t).copy() for t in others)]
            self._prescribed = np.mean(every, axis=0)
        if len(placed):
            there = self.comm, self.layout, self._integrator, self._motion()
            self._prescribed[placed] = self._supports.reaching(*there, stage, time, dt)

    def _still_nodes(self) -> np.ndarray:
        """Return which nodes, in the scene's own order, supports hold where they are, along all axes."""
        axes = self.width * self._number.astype(np.int64)[:, None] + np.arange(self.dim)
        return np.isin(axes, self._supports.still).all(axis=1)

    def along_axes(self, x: np.ndarray) -> np.ndarray:
        """Return the velocities along the axes, shape (n_owned, dim); a beam's rotations are none."""
        return x.reshape(-1, self.width)[:, : self.dim]

    def _with_shared(self, owned: np.ndarray) -> np.ndarray:
        """Return values at all nodes of this rank's elements. Collective."""
        return np.concatenate((owned, self._share(owned)))

    def fixed_velocity(self) -> np.ndarray:
        """Return w of the step last assembled at prescribed unknowns, zero at free ones."""
        g = np.zeros(self.layout.n_global)
        g[self._supports.unknowns] = self._prescribed
        return g

    # ---- what others read -------------------------------------------------------------------------------------

    def stock(self) -> Stock:
        """Return this rank's share of momentum, kinetic and elastic energy."""
        both = self._with_shared(np.concatenate((self.displacement, self.velocity), axis=1))
        d, u = both[:, : self.width], both[:, self.width :]
        kinetic, elastic = self._elements.energies(d, u, self._mesh.counted)
        return Stock(self._uniform.reshape(self.dim, -1) @ self.velocity.ravel(), kinetic, elastic)

    def forces(self) -> Forces:
        """Return gravity, loads and reactions of the step last accepted, where the integrator took them. Collective.

        A reaction is the residual of a held unknown's equation, without other fields' forces.
        """
        assert self._loaded is not None  # a step was assembled
        stage, state, gravity = self._loaded
        shares = self._loads is not None or self._reacts
        w = self._with_shared(self._integrator.solved(self._motion())) if shares else np.zeros(0)
        found: Forces = {}
        if self._gravity:
            found["gravity"] = gravity @ self._uniform.reshape(self.dim, -1)
        if self._loads is not None:
            found["loads"] = self._loads.felt(w).ravel()
        if self._reacts and self._lumped is not None:
            n = self._mesh.n_owned
            pulled = self._lumped.inertia(stage.a, w[:n]) - self._pull
            found["boundary"] = np.where(self._is_held[:n], pulled, 0.0).ravel()
        elif self._reacts:
            a0, a1 = self._damping[self._node_body[self._mesh.natural]].T[:, :, None]
            # the residual as what forces give for what is left of the step's equation
            inertia, shift = state.inertia - (stage.a + a0) * w, state.shift + (stage.k + a1) * w
            found["boundary"] = self._reaction(State(state.displacement, inertia, shift), found)
        return found

    def starting_forces(self) -> Forces:
        """Return the same of the present state at time zero, reactions in statics alone: it is at rest. Collective.

        Nothing where an expression has no value yet.
        """
        d = self._with_shared(self.displacement)
        found: Forces = {}
        try:
            if self._gravity:
                gravity = np.array([float(g(t=0.0)) for g in self._gravity])
                found["gravity"] = gravity @ self._uniform.reshape(self.dim, -1)
            if self._loads is not None:
                found["loads"] = self._loads.start(d).ravel()
        except ExpressionError:  # on all ranks
            return {}
        if self._reacts and not self._has_inertia:
            rest = np.zeros_like(d)
            found["boundary"] = self._reaction(State(d, rest, rest), found)
        return found

    def _reaction(self, state: State, given: Forces) -> np.ndarray:
        """Return what holds held unknowns against a state's forces and what else is given, zero at free ones, flat."""
        pulled = np.empty_like(self.velocity)
        self._elements.forces(state, pulled)
        total = pulled.ravel() + sum(given.values())
        return np.where(self._is_held[: self._mesh.n_owned].ravel(), -total, 0.0)

    def work(self, dt: float) -> Work:
        """Return what damping took in an explicit step, whose w is the velocity in its middle. Collective."""
        return Work(damping=dt * self._lost()) if self.explicit else Work()

    def power(self) -> Work:
        """Return what damping took where the integrator took the forces, W. Collective."""
        return Work() if self.explicit else Work(damping=self._lost())

    def _lost(self) -> float:
        """Return this rank's share of w . C w of the step last accepted, W. Collective."""
        if self._loaded is None or not self._damps:
            return 0.0
        w = self._with_shared(self._integrator.solved(self._motion()))
        return self._elements.damping(self._loaded[1].displacement, w, self._mesh.counted)

    def energies(self) -> dict[str, float]:
        """Return the kinetic and elastic energy of all bodies, J (per metre in 2D). Collective."""
        d, u = self._with_shared(self.displacement), self._with_shared(self.velocity)
        total = np.empty(2)
        self.comm.Allreduce(np.array(self._elements.energies(d, u, self._mesh.counted)), total)
        return {"kinetic": float(total[0]), "elastic": float(total[1])}

    def state(self) -> dict[str, Slab]:
        """Return displacement, velocity and what the integrator remembers, in the mesh's own order. Collective.

        Of an explicit scheme also where its stable step was found.
        """
        past = dict(zip(self._integrator.past, map(self._natural_rows, self._past), strict=True))
        if past:
            past["past_dt"] = scalar_slab(self.comm, self._past_dt)
        if self._lumped is not None:
            past["displacement_measured"] = self._natural_rows(self._measured)
        return self._present() | past

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""

        def nodes(name: str) -> np.ndarray:
            return self.read_stored(read, name).reshape(-1, self.width)

        self.displacement, self.velocity = nodes("displacement"), nodes("velocity")
        self._past = tuple(nodes(name) for name in self._integrator.past)
        places = {"displacement": self.displacement}
        places |= {n: x for n, x in zip(self._integrator.past, self._past, strict=True) if n.startswith("displacement")}
        if self._past:
            self._past_dt = float(read("past_dt", (0,), (1,))[0])
        if self._lumped is not None:
            self._measured = places["displacement_measured"] = nodes("displacement_measured")
        most = FAR * self.extent
        faults = [outside(name, x[:, : self.dim], -most, most) for name, x in places.items()]
        refuse(self.comm, [*faults, step_fault(self._past_dt)])
        self._stage = self._geometry = None

    def stored(self, name: str, x: np.ndarray) -> dict[str, Slab]:
        """Return a value per unknown on this rank in the mesh's own order. Collective."""
        return {name: self._natural_rows(x.reshape(-1, self.width))}

    def read_stored(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``stored`` gave, flat. Collective."""
        begin, end, _ = self._slab
        return self._from_natural(np.asarray(read(name, (begin, 0), (end - begin, self.width)), dtype=float)).ravel()

    def _present(self) -> dict[str, Slab]:
        return {"displacement": self._natural_rows(self.displacement), "velocity": self._natural_rows(self.velocity)}

    def _natural_rows(self, owned: np.ndarray) -> Slab:
        begin, _, n = self._slab
        return Slab(self._to_natural(owned), (begin, 0), (n, owned.shape[1]))


def _tags(scene: Scene, solids: Mapping[str, Solid], mesh: SimplexMesh) -> dict[str, Tags]:
    """Return the groups of facets that the scene names, by body; numbers are those of the body's own nodes."""
    found = {}
    for body, (name, solid) in enumerate(solids.items()):
        tags = read_tags(solid, scene.dim, f"solids.{name}", scene.directory)
        elements = mesh.elements(body)
        found[name] = with_middles(tags, elements - elements.min()) if tags else tags
    return found


def _evaluate(
    given: dict[str, tuple[str, list[Number] | None]], points: np.ndarray, node_body: np.ndarray, width: int
) -> np.ndarray:
    """Return the initial values at all nodes; every rank evaluates all, so that all meet the same error."""
    values = np.zeros((len(points), width))
    for body, (name, (quantity, components)) in enumerate(given.items()):
        nodes = np.flatnonzero(node_body == body)
        coordinates = {"z": 0.0, **dict(zip("xyz", points[nodes].T, strict=False))}
        for axis, source in enumerate(components or []):
            expression = Expression(source, key=f"solids.{name}.initial.{quantity}.{axis}")
            values[nodes, axis] = expression(t=0.0, **coordinates)
    return values
