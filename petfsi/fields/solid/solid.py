"""Deformable solids of linear triangles and tetrahedra, all bodies of a scene as one field."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from petfsi.errors import InputError
from petfsi.fields.base import Reader, Slab, SolidField, Stock, Work, scalar_slab
from petfsi.fields.solid.elements import Bodies, Elements, State
from petfsi.fields.solid.materials import MATERIALS, lame_parameters
from petfsi.fields.solid.partition import Fetch, distribute, slab
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.probes import Place, locate
from petfsi.fields.solid.supports import Elimination, Supports
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.surfaces import Surface, boundary_facets, shells
from petfsi.integrators import INTEGRATORS, Integrator, Motion, Stage
from petfsi.petsc import IntType, Layout, new_block, set_csr
from petfsi.ranks import on_root
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Number, Scene, Solid


class SimplexSolid(SolidField):
    """The solids of a scene; the unknown is the velocity w of every node where the integrator takes the forces.

    A step solves  A w = b + J p  (see ``integrators``) and moves the nodes by the integrator's rule. Unknown
    ``dim * node + axis`` in the partition's numbering.

    Attributes
    ----------
    names : list of str
        The bodies, in the order of the scene.
    extent : float
        Largest side of the bounding box of all bodies at rest, m.
    reference, displacement, velocity : ndarray, shape (n_owned, dim)
        This rank's nodes: position at rest (m), displacement (m), velocity (m/s).
    """

    name = "solid"

    def __init__(self, comm: MPI.Comm, scene: Scene):
        self.comm = comm
        self.dim: int = scene.dim
        self.names = list(scene.solids)
        mesh = on_root(comm, lambda: _union(scene))
        self.extent = float(np.ptp(mesh.points, axis=0).max())
        node_body = np.empty(len(mesh.points), dtype=np.int32)
        node_body[mesh.cells] = mesh.body[:, None]
        self._mesh, number = distribute(comm, mesh)
        n_owned = self._mesh.n_owned
        self.reference = self._mesh.points[:n_owned]
        self.layout = Layout.of(comm, self.dim * n_owned)
        self._elements = Elements(self._mesh.points, self._mesh.cells, self._mesh.body, _bodies(scene.solids))
        self._integrator: Integrator = INTEGRATORS[scene.time.integrator]()
        self._gravity = [Expression(g, ("t",), f"gravity.{n}") for n, g in enumerate(scene.gravity or [])]
        self._nodal_mass = self._elements.nodal_mass(n_owned)
        self._reference_mass = comm.allreduce(float(self._nodal_mass.sum())) / len(mesh.points)

        self._supports = Supports(scene.solids, mesh.points, node_body, number)
        self._set_pattern()
        self._set_exchange(mesh, number)
        self._surface = self._make_surface(mesh, number, node_body, scene.solids)
        self._places: dict[tuple[str, tuple[float, ...]], Place] = {}

        initial = {name: solid.initial for name, solid in scene.solids.items()}
        mine = self._mesh.natural[:n_owned]
        moved = {name: ("displacement", start.displacement) for name, start in initial.items()}
        thrown = {name: ("velocity", start.velocity) for name, start in initial.items()}
        self.displacement = _evaluate(moved, mesh.points, node_body)[mine]
        self.velocity = _evaluate(thrown, mesh.points, node_body)[mine]
        self.moved = np.zeros(self.layout.n_local)
        self._stage: Stage | None = None
        self._loaded: tuple[Stage, State, np.ndarray] | None = None
        self._past = tuple(np.zeros_like(self.velocity) for _ in self._integrator.past)
        self._past_dt = 0.0
        self._prescribed = self._supports.velocities(0.0).copy()
        held = self._supports.unknowns
        here = (held >= self.layout.start) & (held < self.layout.end)
        local = self.dim * self._mesh.number.astype(np.int64)[:, None] + np.arange(self.dim)
        self._is_held = np.isin(local, held)
        damping = [(solid.damping.mass, solid.damping.stiffness) for solid in scene.solids.values()]
        self._loses = self._supports.move or bool(np.any(damping))
        self.velocity.reshape(-1)[held[here] - self.layout.start] = self._prescribed[here]

    # ---- set-up -----------------------------------------------------------------------------------------------

    def _set_pattern(self) -> None:
        self._pattern = Pattern.of(self._mesh)
        self._elimination = Elimination(self._pattern, self.layout, self._supports.unknowns)
        self._values = np.zeros(len(self._pattern.indices))
        self.rhs = np.zeros(self.layout.n_local)
        self.block = new_block(self.comm, self.layout, self.layout, block_size=self.dim)
        set_csr(self.block, self._pattern.indptr, self._pattern.indices, self._values, new_pattern=True)
        vectors = []
        for mode in self.near_null_space():
            vector = self.block.createVecRight()
            vector.setArray(mode)
            vectors.append(vector)
        self.block.setNearNullSpace(PETSc.NullSpace().create(vectors=vectors, comm=self.comm))
        self._diagonal = (0.0, 0.0), 1.0

    def _set_exchange(self, mesh: SimplexMesh, number: np.ndarray) -> None:
        """Prepare the messages between owned, shared and naturally ordered nodes, and the static output."""
        comm, nodes = self.comm, self._mesh.nodes
        begin, end = slab(len(number), comm.rank, comm.size)
        first, last = slab(len(mesh.cells), comm.rank, comm.size)
        self._share = Fetch(comm, nodes, self._mesh.number[nodes.n_local :])
        self._to_natural = Fetch(comm, nodes, number[begin:end])
        self._from_natural = Fetch(comm, Layout.of(comm, end - begin), self._mesh.natural[: nodes.n_local])
        self._slab = begin, end, len(number)
        self._static = {
            "points": self._rows(mesh.points[begin:end]),
            "cells": Slab(mesh.cells[first:last], (first, 0), mesh.cells.shape),
            "body": Slab(mesh.body[first:last], (first,), mesh.body.shape),
        }

    def _make_surface(
        self, mesh: SimplexMesh, number: np.ndarray, node_body: np.ndarray, solids: dict[str, Solid]
    ) -> Surface:
        facets = boundary_facets(mesh.points, mesh.cells)
        shell, volume = shells(mesh.points, facets)
        cavity = volume[shell] < 0
        hollow = np.array([solid.interior == "void" for solid in solids.values()])
        nodes, facets = np.unique(facets, return_inverse=True)
        facets = facets.reshape(-1, self.dim)
        unknowns = (self.dim * number[nodes].astype(np.int64)[:, None] + np.arange(self.dim)).ravel()
        fixed = np.isin(unknowns, self._supports.unknowns)
        # the surface's points are gathered rank after rank; this is where each belongs
        self._gathered = np.argsort(number[nodes])
        self._wet = number[nodes][self._gathered] - self._mesh.nodes.start
        self._wet = self._wet[(self._wet >= 0) & (self._wet < self._mesh.n_owned)]
        self._wet_counts = np.array(self.comm.allgather(len(self._wet) * self.dim))
        return Surface(
            facets=facets,
            cavity=cavity,
            void=cavity & hollow[node_body[nodes[facets[:, 0]]]],
            point_map=_selection(unknowns, ~fixed, self.layout.n_global),
            fixed_map=_selection(unknowns, fixed, self.layout.n_global),
        )

    # ---- the step ---------------------------------------------------------------------------------------------

    def unknown(self) -> np.ndarray:
        """Return w of the step last accepted, flat."""
        return self._integrator.solved(self._motion()).ravel().copy()

    def predict(self, time: float, dt: float) -> None:
        """Take the geometry of the step: from here until ``accept`` the surface is where the tangent is taken."""
        self._stage = self._integrator.stage(self._motion(), dt)

    def assemble(self, time: float, dt: float) -> None:
        """Refresh A and b for the step from ``time`` to ``time + dt``. Collective."""
        stage = self._stage or self._integrator.stage(self._motion(), dt)
        b = self.rhs.reshape(-1, self.dim)
        diagonal = self._mean_diagonal(stage)
        local = self._with_shared(np.concatenate((stage.tangent_at, stage.inertia, stage.shift), axis=1))
        state = State(*(local[:, n * self.dim : (n + 1) * self.dim] for n in range(3)))
        self._elements.assemble(state, stage.a, stage.k, self._pattern, self._values, b)
        gravity = np.zeros(self.dim)
        for axis, g in enumerate(self._gravity):
            gravity[axis] = float(g(t=time + self._integrator.moment(dt)))
            b[:, axis] += self._nodal_mass * gravity[axis]
        self._loaded = stage, state, gravity
        self._prescribe(time, dt)
        self._elimination.apply(self._values, self.rhs, self._prescribed, diagonal)
        set_csr(self.block, self._pattern.indptr, self._pattern.indices, self._values, new_pattern=False)
        self.row_scale = dt / self._reference_mass
        self.n_assembled += 1

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the velocities w and move the nodes."""
        w, motion = x.reshape(-1, self.dim).copy(), self._motion()
        stage = self._stage or self._integrator.stage(motion, dt)
        motion = self._integrator.finish(motion, stage, w, dt)
        self.moved = (motion.displacement - self.displacement).ravel()
        self.displacement, self.velocity = motion.displacement, motion.velocity
        self._past, self._past_dt = motion.past, motion.past_dt
        self._stage = None

    def _motion(self) -> Motion:
        return Motion(self.displacement, self.velocity, self._past, self._past_dt)

    def set_scale(self, reference_mass: float) -> None:
        """Measure rows against this mass (kg) rather than the mean nodal mass: ``row_scale = dt / mass``."""
        self._reference_mass = reference_mass

    def light_motions(self, degree: int, density: float, most: int) -> np.ndarray:
        """Return polynomial motions of each body no denser than ``density``, shape (n, layout.n_local). Collective."""
        light = np.flatnonzero(self._elements.bodies.density <= density)
        while degree >= 0 and len(light) * self.dim * len(_powers(self.dim, degree)) > most:
            degree -= 1
        if degree < 0 or not len(light):
            return np.zeros((0, self.layout.n_local))
        node_body = np.zeros(len(self._mesh.points), dtype=np.int64)
        node_body[self._mesh.cells] = self._mesh.body[:, None]
        x = self.reference / self.extent
        x = x - self.comm.allreduce(x.sum(axis=0)) / (self.layout.n_global // self.dim)
        motions = []
        for body in light:
            for powers in _powers(self.dim, degree):
                shape = np.where(node_body[: len(x)] == body, np.prod(x**powers, axis=1), 0.0)
                motions += [np.outer(shape, axis).ravel() for axis in np.eye(self.dim)]
        return np.array(motions)

    def near_null_space(self) -> list[np.ndarray]:
        """Return the rigid motions about the origin of coordinates: translations, then rotations."""
        x, dim = self.reference, self.dim
        modes = [np.tile(axis, (len(x), 1)) for axis in np.eye(dim)]
        for a, b in [(0, 1), (1, 2), (2, 0)][: 1 if dim == 2 else 3]:
            turn = np.zeros_like(x)
            turn[:, a], turn[:, b] = -x[:, b], x[:, a]
            modes.append(turn)
        return [mode.ravel() for mode in modes]

    def _mean_diagonal(self, stage: Stage) -> float:
        """Return the mean of A's diagonal at rest: what stands in the rows of prescribed unknowns. Collective."""
        factors, diagonal = self._diagonal
        if factors != (stage.a, stage.k):
            rest, b = np.zeros_like(self._mesh.points), np.empty_like(self.reference)
            state = State(rest, rest, rest)
            self._elements.assemble(state, stage.a, stage.k, self._pattern, self._values, b)
            rows = np.repeat(np.arange(self.layout.n_local), np.diff(self._pattern.indptr))
            total = self._values[self._pattern.indices == rows + self.layout.start].sum()
            diagonal = self.comm.allreduce(float(total)) / self.layout.n_global
            self._diagonal = (stage.a, stage.k), diagonal
        return diagonal

    def _prescribe(self, time: float, dt: float) -> None:
        instants = self._integrator.instants(dt)
        self._prescribed = np.mean([self._supports.velocities(time + t).copy() for t in instants], axis=0)

    def _with_shared(self, owned: np.ndarray) -> np.ndarray:
        """Return values at all nodes of this rank's elements. Collective."""
        return np.concatenate((owned, self._share(owned)))

    # ---- the surface ------------------------------------------------------------------------------------------

    def surface(self) -> Surface:
        """Return the boundary of all bodies, the same on every rank."""
        return self._surface

    def surface_positions(self) -> np.ndarray:
        """Return the positions of the surface's points, shape (n_points, dim). Collective.

        From ``predict`` to ``accept`` those where the step's tangent is taken, otherwise the present ones.
        """
        displacement = self._stage.tangent_at if self._stage else self.displacement
        return self._gather_surface(self.reference[self._wet] + displacement[self._wet])

    def surface_velocity(self) -> np.ndarray:
        """Return w of the step last accepted at the surface's points, shape (n_points, dim). Collective."""
        return self._gather_surface(self._integrator.solved(self._motion())[self._wet])

    def fixed_velocity(self) -> np.ndarray:
        """Return w of the step last assembled at prescribed unknowns, zero at free ones."""
        g = np.zeros(self.layout.n_global)
        g[self._supports.unknowns] = self._prescribed
        return g

    def _gather_surface(self, wet: np.ndarray) -> np.ndarray:
        gathered = np.empty((self._surface.n_points, self.dim))
        self.comm.Allgatherv(np.ascontiguousarray(wet), [gathered, self._wet_counts])
        values = np.empty_like(gathered)
        values[self._gathered] = gathered
        return values

    # ---- what others read -------------------------------------------------------------------------------------

    def stock(self) -> Stock:
        """Return this rank's share of momentum, kinetic and elastic energy."""
        d, u = np.split(self._with_shared(np.concatenate((self.displacement, self.velocity), axis=1)), 2, axis=1)
        kinetic, elastic = self._elements.energies(d, u, self._mesh.counted)
        return Stock(self._nodal_mass @ self.velocity, kinetic, elastic)

    def work(self, dt: float) -> Work:
        """Return this rank's share of what was done in the step last accepted.

        Gravity acts along the way that nodes moved; damping (w . C w) and supports, with the reaction that is the
        residual of their equations without other fields' forces, act at w for dt.
        """
        if self._loaded is None:
            return Work()
        stage, state, gravity = self._loaded
        fallen = float(self._nodal_mass @ self.moved.reshape(-1, self.dim) @ gravity)
        if not self._loses:
            return Work(gravity=fallen)
        w = self._with_shared(self._integrator.solved(self._motion()))
        g = np.where(self._is_held, w, 0.0)
        damping, power = self._elements.powers(state, stage.a, stage.k, w, g, self._mesh.counted)
        power -= float(self._nodal_mass @ g[: self._mesh.n_owned] @ gravity)
        return Work(fallen, dt * damping, dt * power)

    def energies(self) -> dict[str, float]:
        """Return the kinetic and elastic energy of all bodies, J (per metre in 2D). Collective."""
        d, u = self._with_shared(self.displacement), self._with_shared(self.velocity)
        total = np.empty(2)
        self.comm.Allreduce(np.array(self._elements.energies(d, u, self._mesh.counted)), total)
        return {"kinetic": float(total[0]), "elastic": float(total[1])}

    def _volume_ratios(self) -> np.ndarray:
        """Return det F of this rank's elements. Collective."""
        H = self._elements.displacement_gradients(self._with_shared(self.displacement))
        return np.linalg.det(np.eye(self.dim) + H)

    def quality(self) -> float:
        """Return the smallest det F: 1 at rest, 0 or less where an element is inverted. Collective."""
        J = self._volume_ratios()
        return self.comm.allreduce(float(J.min(initial=np.inf)), MPI.MIN)

    def volumes(self) -> dict[str, float]:
        """Return the present volume of each body, m^3 (m^2 in 2D). Collective."""
        J = self._volume_ratios()
        own = np.where(self._mesh.counted, J * self._elements.volume, 0.0)
        total = np.empty(len(self.names))
        self.comm.Allreduce(np.bincount(self._mesh.body, weights=own, minlength=len(self.names)), total)
        return dict(zip(self.names, total.tolist(), strict=True))

    def probe(self, body: str, at: tuple[float, ...] | list[float], quantity: str) -> np.ndarray:
        """Return ``displacement`` or ``velocity`` where ``at`` lies in the reference mesh, shape (dim,). Collective."""
        if body not in self.names or len(at) != self.dim:
            raise InputError(
                f"a probe of {body!r} at {list(at)}: known solids are {', '.join(self.names)}, in {self.dim}D"
            )
        if quantity not in ("displacement", "velocity"):
            raise InputError(f"a probe of solids.{body}: {quantity!r} is not known; displacement and velocity are")
        key = body, tuple(at)
        if key not in self._places:
            index, x = self.names.index(body), np.asarray(at, dtype=float)
            self._places[key] = locate(self.comm, self._mesh, self._elements.gradients, index, x, f"solids.{body}")
        return self._places[key].value(self.comm, self._mesh, getattr(self, quantity))

    def state(self) -> dict[str, Slab]:
        """Return displacement, velocity and what the integrator remembers, in the mesh's own order. Collective."""
        past = dict(zip(self._integrator.past, map(self._natural_rows, self._past), strict=True))
        return self._present() | past | ({"past_dt": scalar_slab(self.comm, self._past_dt)} if past else {})

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        begin, end, _ = self._slab

        def nodes(name: str) -> np.ndarray:
            return self._from_natural(np.asarray(read(name, (begin, 0), (end - begin, self.dim)), dtype=float))

        self.displacement, self.velocity = nodes("displacement"), nodes("velocity")
        self._past = tuple(nodes(name) for name in self._integrator.past)
        if self._past:
            self._past_dt = float(read("past_dt", (0,), (1,))[0])
        self._stage = None

    def output(self) -> dict[str, Slab]:
        """Return points, cells and body, which never change, and displacement and velocity. Collective."""
        return self._static | self._present()

    def _present(self) -> dict[str, Slab]:
        return {"displacement": self._natural_rows(self.displacement), "velocity": self._natural_rows(self.velocity)}

    def _natural_rows(self, owned: np.ndarray) -> Slab:
        return self._rows(self._to_natural(owned))

    def _rows(self, rows: np.ndarray) -> Slab:
        begin, _, n = self._slab
        return Slab(rows, (begin, 0), (n, self.dim))


def _powers(dim: int, degree: int) -> list[tuple[int, ...]]:
    """Return the exponents of all monomials up to a degree."""
    return [p for p in np.ndindex(*(degree + 1,) * dim) if sum(p) <= degree]


def _union(scene: Scene) -> SimplexMesh:
    return SimplexMesh.union(list(build_bodies(scene).values()))


def _bodies(solids: dict[str, Solid]) -> Bodies:
    lame = np.array([lame_parameters(solid.young, solid.poisson) for solid in solids.values()])
    return Bodies(
        density=np.array([solid.density for solid in solids.values()]),
        lame=lame[:, 0],
        mu=lame[:, 1],
        material=[MATERIALS[solid.material] for solid in solids.values()],
        lumped=np.array([solid.mass == "lumped" for solid in solids.values()]),
        mass_damping=np.array([solid.damping.mass for solid in solids.values()]),
        stiffness_damping=np.array([solid.damping.stiffness for solid in solids.values()]),
    )


def _evaluate(
    given: dict[str, tuple[str, list[Number] | None]], points: np.ndarray, node_body: np.ndarray
) -> np.ndarray:
    """Return the initial values at all nodes; every rank evaluates all, so that all meet the same error."""
    values = np.zeros_like(points)
    for body, (name, (quantity, components)) in enumerate(given.items()):
        nodes = np.flatnonzero(node_body == body)
        coordinates = {"z": 0.0, **dict(zip("xyz", points[nodes].T, strict=False))}
        for axis, source in enumerate(components or []):
            expression = Expression(source, key=f"solids.{name}.initial.{quantity}.{axis}")
            values[nodes, axis] = expression(t=0.0, **coordinates)
    return values


def _selection(unknowns: np.ndarray, chosen: np.ndarray, n_unknowns: int) -> csr_matrix:
    """Return the 0/1 map with a one in column ``unknowns[row]`` of every chosen row."""
    indptr = np.concatenate(([0], np.cumsum(chosen))).astype(IntType)
    return csr_matrix(
        (np.ones(indptr[-1]), unknowns[chosen].astype(IntType), indptr), shape=(len(unknowns), n_unknowns)
    )
