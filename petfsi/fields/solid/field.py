"""Solids whose unknowns sit on nodes: the step, the supports and the state that all of them share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.base import Stock, Work
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.solid.conflicts import conflicts
from petfsi.fields.solid.edges import Edges
from petfsi.fields.solid.equations.consistent import ConsistentEquation
from petfsi.fields.solid.equations.damping import RayleighDamping
from petfsi.fields.solid.equations.explicit import ExplicitEquation
from petfsi.fields.solid.equations.gravity import Gravity
from petfsi.fields.solid.equations.mass import Rows
from petfsi.fields.solid.equations.nodal import Constituents
from petfsi.fields.solid.exchange import NodalExchange
from petfsi.fields.solid.initial import initial_values, set_off
from petfsi.fields.solid.libraries import ElementLibrary, LoadLibrary
from petfsi.fields.solid.loose import loose_motions, refusal, without_equilibrium
from petfsi.fields.solid.partition import distribute
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.shrinkage import Shrinkage
from petfsi.fields.solid.supports import Supports
from petfsi.fields.solid.turning import Turning, bodies_of
from petfsi.fields.solids import FAR, Forces, Landing, SolidField
from petfsi.fields.stored import outside, refuse, step_fault
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.places import tags_of_bodies
from petfsi.integrators.base import Motion, Stage, moved, relinearised
from petfsi.petsc import Layout, set_near_null_space
from petfsi.ranks import on_root
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid
from petfsi.scene.stepping import Stepping

#: The least mass that rows can be measured against, kg; of the greatest the inverse.
LIGHTEST = 1e-150


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
    owner : ndarray of int, shape (layout.n_local,)
        Which of them each unknown of this rank belongs to.
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
        self._exchange = NodalExchange(comm, self._mesh, self._number)
        self.layout = Layout.of(comm, self.width * n_owned)
        self.owner = np.repeat(self._node_body[self._mesh.natural[:n_owned]], self.width)
        self._elements = self._make_elements(solids)
        self._uniform = self._elements.uniform_load(n_owned)
        gravity = Gravity(scene.gravity or [], self._uniform)
        self.set_scale(comm.allreduce(float(self._uniform[0, :, 0].sum())) / len(mesh.points))

        self._tags = on_root(comm, lambda: tags_of_bodies(solids, mesh, scene.directory))
        self._supports = Supports(solids, mesh.points, self._node_body, self._number, components, self._tags)
        self.warnings = conflicts(self._supports.overlaps, scene.time.end)
        self._damping = RayleighDamping(solids, self._node_body[self._mesh.natural])
        self._loads = self._make_loads(mesh, solids)
        self._equation = self._make_equation(gravity)
        self.block, self.rhs, self.is_linear = self._equation.block, self._equation.rhs, self._equation.is_linear
        self.acting = self._equation.acting
        set_near_null_space(self.block, self.near_null_space())
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
        self._turning = Turning(
            self.comm, self._mesh, parts, bodies_of(mesh)[mine], still, mass, self._exchange.with_shared
        )

    def _stiffens(self, body: int) -> bool:
        """Return whether loads that do not follow it may hold a body in its place as it turns."""
        return False

    @abstractmethod
    def near_null_space(self) -> list[np.ndarray]:
        """Return the rigid motions about the origin of coordinates: translations, then rotations."""

    # ---- set-up -----------------------------------------------------------------------------------------------

    def _set_motion(self, mesh: SimplexMesh, solids: Mapping[str, Solid], dt: float) -> None:
        """Set off as the scene says, and as supports do."""
        there = mesh.points, self._node_body, self.width
        displacement = initial_values(solids, "displacement", *there)
        velocity = initial_values(solids, "velocity", *there)
        mine = self._mesh.natural[: self._mesh.n_owned]
        on = self._supports, self.layout, self._number, mine
        start = set_off(*on, displacement, velocity, self._has_inertia, dt)
        self.displacement, self.velocity = start.displacement, start.velocity
        self._equation.prescribed, self._jump = start.prescribed, start.jump
        self.moved = np.zeros(self.layout.n_local)
        self._stage: Stage | None = None
        self._geometry: np.ndarray | None = None
        self._past = tuple(np.zeros_like(self.velocity) for _ in self._integrator.past)
        self._past_dt = 0.0
        self._measured = self.displacement.copy()

    @cached_property
    def _pattern(self) -> Pattern:
        return Pattern.of(self._mesh, self.width)

    def _make_equation(self, gravity: Gravity) -> ConsistentEquation | ExplicitEquation:
        """Return the equation of steps. Collective."""
        parts = Constituents(
            self._exchange, self.layout, self._elements, self._loads, gravity, self._supports, self._damping,
            self._integrator,
        )  # fmt: skip
        return ExplicitEquation(parts) if self.explicit else ConsistentEquation(parts, self._pattern)

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where this rank's rows of A as last assembled begin, their global columns and values, SI."""
        return self._equation.rows

    # ---- the step ---------------------------------------------------------------------------------------------

    def unknown(self) -> np.ndarray:
        """Return w of the step last accepted, flat."""
        return self._solved().ravel().copy()

    def foreseen(self) -> np.ndarray:
        """Return w of the step last assembled as supports give it, elsewhere that of the last step, flat."""
        given = self.fixed_velocity()[self.layout.start : self.layout.end]
        return np.where(self._equation.held_here, given, self.unknown())

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
        stage = self._stage or self._rehearsed(dt)
        self._equation.assemble(stage, self._motion(), time, dt, self._reference_mass)
        self.n_assembled, self.pattern_version = self._equation.n_assembled, self._equation.pattern_version
        self.row_scale = dt / self._reference_mass

    def _rehearsed(self, dt: float) -> Stage:
        """Return the coming step's equation, linearised where the bodies are: no velocity has been predicted with."""
        stage = self._integrator.stage(self._motion(), dt)
        return stage if self.explicit else moved(stage, self.displacement - stage.tangent_at)

    def take_mass(self, rows: Rows | None) -> None:
        """Add these rows to A from now on."""
        self._equation.take_mass(rows)

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
        if isinstance(self._equation, ConsistentEquation):
            self._equation.awaits_stress = False
        return True

    def jolt(self) -> np.ndarray | None:
        """Return -A[:, F] g for the jump g that supports' velocities make at the start; None if they make none."""
        if not isinstance(self._equation, ConsistentEquation) or not self._has_inertia or not self._jump.any():
            return None
        return self._equation.jolt(self._jump)

    def push(self, change: np.ndarray) -> None:
        """Change the present velocities by this much."""
        self.velocity = self.velocity + change.reshape(-1, self.width)

    def rewind(self) -> None:
        """Forget the step begun."""
        self._stage = self._geometry = None

    def unheld(self) -> list[str]:
        """Return what is wrong with bodies that nothing holds in statics, where the step is assembled. Collective."""
        if self._whole is None or not isinstance(self._equation, ConsistentEquation):
            return []
        mesh, held = self._whole, np.zeros(self.layout.n_global, dtype=bool)
        held[self._supports.unknowns] = True
        held = held.reshape(-1, self.width)[self._number]
        d, force = (
            np.concatenate(self.comm.allgather(owned))[self._number]
            for owned in (self.displacement[:, : self.dim], self.rhs.reshape(-1, self.width))
        )
        force[held] = 0.0
        motions = loose_motions(mesh, mesh.points + d, held)
        follows = self._loads is not None and self._loads.follow
        wrong = without_equilibrium(motions, force, follows, self._stiffens)
        self._equation.awaits_stress = bool(motions) and not wrong
        return [refusal(self.names[body], found, self.dim) for body, found in wrong.items()]

    def stable_step(self) -> float:
        """Return the longest stable step of an explicit scheme at the present displacement, s. Collective."""
        if not isinstance(self._equation, ExplicitEquation):
            return np.inf
        self._measured = self.displacement.copy()
        eigenvalue = self._equation.largest_eigenvalue(self._measured)
        return self._integrator.stable_step(eigenvalue, self._damping.most_stiffness)

    def stretch(self) -> float:
        """Return the largest change of an edge over its length since the last ``stable_step``. Collective."""
        return self._edges.stretch(self._exchange.with_shared(self.displacement - self._measured))

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
        both = self._exchange.with_shared(np.concatenate((self.displacement, self.velocity), axis=1))
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

    def _solved(self) -> np.ndarray:
        """Return w of the step last accepted, shape (n_owned, width)."""
        return self._integrator.solved(self._motion())

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

    def _still_nodes(self) -> np.ndarray:
        """Return which nodes, in the scene's own order, supports hold where they are, along all axes."""
        axes = self.width * self._number.astype(np.int64)[:, None] + np.arange(self.dim)
        return np.isin(axes, self._supports.still).all(axis=1)

    def along_axes(self, x: np.ndarray) -> np.ndarray:
        """Return the velocities along the axes, shape (n_owned, dim); a beam's rotations are none."""
        return x.reshape(-1, self.width)[:, : self.dim]

    def fixed_velocity(self) -> np.ndarray:
        """Return w of the step last assembled at prescribed unknowns, zero at free ones."""
        return self._equation.fixed_velocity()

    # ---- what others read -------------------------------------------------------------------------------------

    def stock(self) -> Stock:
        """Return this rank's share of momentum, kinetic and elastic energy."""
        both = self._exchange.with_shared(np.concatenate((self.displacement, self.velocity), axis=1))
        d, u = both[:, : self.width], both[:, self.width :]
        kinetic, elastic = self._elements.energies(d, u, self._mesh.counted)
        return Stock(self._uniform.reshape(self.dim, -1) @ self.velocity.ravel(), kinetic, elastic)

    def forces(self) -> Forces:
        """Return gravity, loads and reactions of the step last accepted, where the integrator took them. Collective.

        A reaction is the residual of a held unknown's equation, without other fields' forces.
        """
        return self._equation.forces(self._solved())

    def starting_forces(self) -> Forces:
        """Return the same of the present state at time zero, reactions in statics alone: it is at rest. Collective.

        Nothing where an expression has no value yet.
        """
        return self._equation.starting_forces(self.displacement)

    def work(self, dt: float) -> Work:
        """Return what damping took in an explicit step, whose w is the velocity in its middle. Collective."""
        return Work(damping=dt * self._equation.dissipation(self._solved())) if self.explicit else Work()

    def power(self) -> Work:
        """Return what damping took where the integrator took the forces, W. Collective."""
        return Work() if self.explicit else Work(damping=self._equation.dissipation(self._solved()))

    def energies(self) -> dict[str, float]:
        """Return the kinetic and elastic energy of all bodies, J (per metre in 2D). Collective."""
        d, u = self._exchange.with_shared(self.displacement), self._exchange.with_shared(self.velocity)
        total = np.empty(2)
        self.comm.Allreduce(np.array(self._elements.energies(d, u, self._mesh.counted)), total)
        return {"kinetic": float(total[0]), "elastic": float(total[1])}

    def state(self) -> dict[str, Slab]:
        """Return displacement, velocity and what the integrator remembers, in the mesh's own order. Collective.

        Of an explicit scheme also where its stable step was found.
        """
        exchange = self._exchange
        past = dict(zip(self._integrator.past, map(exchange.stored, self._past), strict=True))
        if past:
            past["past_dt"] = scalar_slab(self.comm, self._past_dt)
        if self.explicit:
            past["displacement_measured"] = exchange.stored(self._measured)
        return self._present() | past

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""

        def nodes(name: str) -> np.ndarray:
            return self._exchange.read(read, name, self.width)

        self.displacement, self.velocity = nodes("displacement"), nodes("velocity")
        self._past = tuple(nodes(name) for name in self._integrator.past)
        places = {"displacement": self.displacement}
        places |= {n: x for n, x in zip(self._integrator.past, self._past, strict=True) if n.startswith("displacement")}
        if self._past:
            self._past_dt = float(read("past_dt", (0,), (1,))[0])
        if self.explicit:
            self._measured = places["displacement_measured"] = nodes("displacement_measured")
        most = FAR * self.extent
        faults = [outside(name, x[:, : self.dim], -most, most) for name, x in places.items()]
        refuse(self.comm, [*faults, step_fault(self._past_dt)])
        self._stage = self._geometry = None

    def stored(self, name: str, x: np.ndarray) -> dict[str, Slab]:
        """Return a value per unknown on this rank in the mesh's own order. Collective."""
        return {name: self._exchange.stored(x.reshape(-1, self.width))}

    def read_stored(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``stored`` gave, flat. Collective."""
        return self._exchange.read(read, name, self.width).ravel()

    def _present(self) -> dict[str, Slab]:
        present = {"displacement": self.displacement, "velocity": self.velocity}
        return {name: self._exchange.stored(values) for name, values in present.items()}
