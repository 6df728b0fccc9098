"""Deformable solids of linear triangles and tetrahedra, all bodies of a scene as one field."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from petfsi.errors import InputError
from petfsi.fields.base import Reader, Slab, SolidField
from petfsi.fields.solid.elements import Bodies, Elements
from petfsi.fields.solid.materials import MATERIALS, lame_parameters
from petfsi.fields.solid.partition import Fetch, distribute, slab
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.probes import Place, locate
from petfsi.fields.solid.supports import Elimination, Supports
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.surfaces import Surface, boundary_facets, shells
from petfsi.integrators import INTEGRATORS, Coefficients, Integrator
from petfsi.petsc import IntType, Layout, new_block, set_csr
from petfsi.ranks import on_root
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Number, Scene, Solid


class SimplexSolid(SolidField):
    """The solids of a scene; the unknown is the velocity u of every node at the new time.

    A step solves  A u = b + J p  (see ``integrators``) and moves the nodes by the integrator's rule. Unknown
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
        self._prescribe(0.0)
        held = self._supports.unknowns
        here = (held >= self.layout.start) & (held < self.layout.end)
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
        self._dt = 0.0
        self._diagonal = 1.0

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
        """Return the velocities of this rank's nodes, flat."""
        return self.velocity.ravel().copy()

    def predict(self, time: float, dt: float) -> None:
        """Do nothing: all of a solid's step is implicit."""

    def assemble(self, time: float, dt: float) -> None:
        """Refresh A and b for the step from ``time`` to ``time + dt``; forces and supports at its end. Collective."""
        step = self._coefficients(dt)
        if dt != self._dt:
            self._dt, self._diagonal = dt, self._mean_diagonal(step)
        b = self.rhs.reshape(-1, self.dim)
        local = self._with_shared(np.concatenate((self.displacement, self.velocity), axis=1))
        d, u = local[:, : self.dim], local[:, self.dim :]
        self._elements.assemble(d, u, step, self._pattern, self._values, b)
        for axis, g in enumerate(self._gravity):
            b[:, axis] += self._nodal_mass * float(g(t=time + dt))
        self._prescribe(time + dt)
        self._elimination.apply(self._values, self.rhs, self._prescribed, self._diagonal)
        set_csr(self.block, self._pattern.indptr, self._pattern.indices, self._values, new_pattern=False)
        self.row_scale = dt / self._reference_mass
        self.n_assembled += 1

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the new velocities and move the nodes."""
        new = x.reshape(-1, self.dim).copy()
        self.displacement = self._integrator.displacement(self.displacement, self.velocity, new, dt)
        self.velocity = new

    def set_scale(self, reference_mass: float) -> None:
        """Measure rows against this mass (kg) rather than the mean nodal mass: ``row_scale = dt / mass``."""
        self._reference_mass = reference_mass

    def near_null_space(self) -> list[np.ndarray]:
        """Return the rigid motions about the origin of coordinates: translations, then rotations."""
        x, dim = self.reference, self.dim
        modes = [np.tile(axis, (len(x), 1)) for axis in np.eye(dim)]
        for a, b in [(0, 1), (1, 2), (2, 0)][: 1 if dim == 2 else 3]:
            turn = np.zeros_like(x)
            turn[:, a], turn[:, b] = -x[:, b], x[:, a]
            modes.append(turn)
        return [mode.ravel() for mode in modes]

    def _coefficients(self, dt: float) -> Coefficients:
        bodies = self._elements.bodies
        return self._integrator.coefficients(dt, bodies.mass_damping, bodies.stiffness_damping)

    def _mean_diagonal(self, step: Coefficients) -> float:
        """Return the mean of A's diagonal at rest: what stands in the rows of prescribed unknowns."""
        rest, b = np.zeros_like(self._mesh.points), np.empty_like(self.reference)
        self._elements.assemble(rest, rest, step, self._pattern, self._values, b)
        rows = np.repeat(np.arange(self.layout.n_local), np.diff(self._pattern.indptr))
        total = self._values[self._pattern.indices == rows + self.layout.start].sum()
        return self.comm.allreduce(float(total)) / self.layout.n_global

    def _prescribe(self, time: float) -> None:
        self._prescribed = self._supports.velocities(time)

    def _with_shared(self, owned: np.ndarray) -> np.ndarray:
        """Return values at all nodes of this rank's elements. Collective."""
        return np.concatenate((owned, self._share(owned)))

    # ---- the surface ------------------------------------------------------------------------------------------

    def surface(self) -> Surface:
        """Return the boundary of all bodies, the same on every rank."""
        return self._surface

    def surface_positions(self) -> np.ndarray:
        """Return the present positions of the surface's points, shape (n_points, dim). Collective."""
        return self._gather_surface(self.reference[self._wet] + self.displacement[self._wet])

    def surface_velocity(self) -> np.ndarray:
        """Return the present velocities of the surface's points, shape (n_points, dim). Collective."""
        return self._gather_surface(self.velocity[self._wet])

    def fixed_velocity(self) -> np.ndarray:
        """Return the prescribed velocities at the end of the step last assembled, zero at free unknowns."""
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

    def energies(self) -> dict[str, float]:
        """Return the kinetic and elastic energy of all bodies, J (per metre in 2D). Collective."""
        d, u = self._with_shared(self.displacement), self._with_shared(self.velocity)
        total = np.empty(2)
        self.comm.Allreduce(np.array(self._elements.energies(d, u, self._mesh.counted)), total)
        return {"kinetic": float(total[0]), "elastic": float(total[1])}

    def quality(self) -> float:
        """Return the smallest det F: 1 at rest, 0 or less where an element is inverted. Collective."""
        J = np.linalg.det(self._elements.deformation_gradients(self._with_shared(self.displacement)))
        return self.comm.allreduce(float(J.min(initial=np.inf)), MPI.MIN)

    def volumes(self) -> dict[str, float]:
        """Return the present volume of each body, m^3 (m^2 in 2D). Collective."""
        J = np.linalg.det(self._elements.deformation_gradients(self._with_shared(self.displacement)))
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
        """Return displacement and velocity in the mesh's own order. Collective."""
        return {
            "displacement": self._rows(self._to_natural(self.displacement)),
            "velocity": self._rows(self._to_natural(self.velocity)),
        }

    def restore(self, read: Reader) -> None:
        """Take displacement and velocity back. Collective."""
        begin, end, _ = self._slab
        for name in ("displacement", "velocity"):
            rows = np.asarray(read(name, (begin, 0), (end - begin, self.dim)), dtype=float)
            setattr(self, name, self._from_natural(rows))

    def output(self) -> dict[str, Slab]:
        """Return points, cells and body, which never change, and displacement and velocity. Collective."""
        return self._static | self.state()

    def _rows(self, rows: np.ndarray) -> Slab:
        begin, _, n = self._slab
        return Slab(rows, (begin, 0), (n, self.dim))


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
