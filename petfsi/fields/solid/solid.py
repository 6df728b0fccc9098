"""Deformable solids of linear triangles and tetrahedra, all bodies of a scene as one field."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix

from petfsi.errors import InputError, SolveError
from petfsi.fields.slabs import Slab
from petfsi.fields.solid.elements import Bodies, Elements
from petfsi.fields.solid.field import NodalSolid
from petfsi.fields.solid.loads import Body, Loads
from petfsi.fields.solid.materials import Material, lame_parameters, named, projected
from petfsi.fields.solid.partition import slab
from petfsi.fields.solid.patches import grid_patches, grouped_mesh, grown_patches
from petfsi.fields.solid.probes import Place, locate
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.quadratic import Curved, beyond_middles, facet_parts, facets_with_middles, with_middles
from petfsi.geometry.surfaces import Surface, boundary_facets, shells, signed_volumes
from petfsi.petsc import IntType
from petfsi.ranks import on_root
from petfsi.registry import INVERTIBLE
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid


class SimplexSolid(NodalSolid):
    """Bodies meshed by triangles or tetrahedra; a node's unknowns are its velocity along the axes."""

    _elements: Elements

    def __init__(self, comm: MPI.Comm, scene: Scene):
        mesh = on_root(comm, lambda: _union(scene))
        super().__init__(comm, scene, scene.solids, mesh, ("x", "y", "z")[: scene.dim])
        first, last = slab(len(mesh.cells), comm.rank, comm.size)
        begin, end, n = self._exchange.slab
        self._static = {
            "points": Slab(mesh.points[begin:end], (begin, 0), (n, self.dim)),
            "cells": Slab(mesh.cells[first:last], (first, 0), mesh.cells.shape),
            "body": Slab(mesh.body[first:last], (first,), mesh.body.shape),
        }
        self._surface = self._make_surface(mesh, scene.solids)
        self._places: dict[tuple[str, tuple[float, ...]], Place] = {}
        self._must_not_invert = np.array([solid.material not in INVERTIBLE for solid in scene.solids.values()])

    def _make_elements(self, solids: Mapping[str, Solid]) -> Elements:
        self._turns = np.array([solid.material != "linear" for solid in solids.values()])
        return Elements(self._mesh, _bodies(solids))

    def _stiffens(self, body: int) -> bool:
        """Return whether its material knows of turning."""
        return bool(self._turns[body])

    def _turning_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cells of bodies whose material does not mind being turned, and 2 (lambda + mu)."""
        use = self._turns[self._mesh.body]
        bodies = self._elements.bodies
        return self._mesh.cells[use], self._mesh.body[use], 2 * (bodies.lame + bodies.mu)

    def _make_loads(self, mesh: SimplexMesh, solids: Mapping[str, Solid]) -> Loads | None:
        if not any(solid.loads or solid.body_force for solid in solids.values()):
            return None
        bodies, places = {}, {}
        for index, (name, solid) in enumerate(solids.items()):
            nodes = np.flatnonzero(self._node_body == index)
            elements = np.searchsorted(nodes, mesh.elements(index))
            bodies[name] = Body(nodes, mesh.points[nodes], elements, self._mesh.elements(index), self._tags[name])
            for n, load in enumerate(solid.loads):
                if load.at is not None:
                    at, key = np.array(load.at), f"solids.{name}.loads.{n}: the force"
                    places[name, n] = locate(self.comm, self._mesh, index, at, key)
        return Loads(self.comm, solids, bodies, self._mesh, None if self.explicit else self._pattern, places)

    def _make_surface(self, mesh: SimplexMesh, solids: Mapping[str, Solid]) -> Surface:
        number, node_body = self._number, self._node_body
        facets, curved = _boundary(mesh)
        shell, volume = shells(mesh.points, facets)
        cavity = volume[shell] < 0
        hollow = np.array([solid.interior == "void" for solid in solids.values()])
        nodes, facets = np.unique(facets, return_inverse=True)
        facets = facets.reshape(-1, self.dim)
        self._surface_nodes = nodes
        if curved is not None:
            curved = curved._replace(nodes=np.searchsorted(nodes, curved.nodes))
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
            curved=curved,
        )

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

    # ---- the surface ------------------------------------------------------------------------------------------

    def surface(self) -> Surface:
        """Return the boundary of all bodies, the same on every rank."""
        return self._surface

    def surface_bodies(self) -> np.ndarray:
        """Return the body of each of its points."""
        return self._node_body[self._surface_nodes]

    def surface_rooted(self) -> np.ndarray:
        """Return which of its points supports hold where they are, along all axes."""
        return self._still_nodes()[self._surface_nodes]

    def surface_positions(self) -> np.ndarray:
        """Return the positions of the surface's points, shape (n_points, dim). Collective.

        From ``predict`` to ``accept`` those where the step's tangent is taken, otherwise the present ones.
        """
        displacement = self.displacement if self._geometry is None else self._geometry
        return self._vertices(self.reference[self._wet] + displacement[self._wet])

    def surface_velocity(self) -> np.ndarray:
        """Return w of the step last accepted at the surface's points, shape (n_points, dim). Collective."""
        return self._gather_surface(self._solved()[self._wet])

    def _vertices(self, wet: np.ndarray) -> np.ndarray:
        """Return where the surface's points are if this rank's nodes on it are at ``wet``. Collective."""
        nodes = self._gather_surface(wet)
        return nodes if self._surface.curved is None else self._surface.curved.vertices(nodes)

    def surface_present(self) -> np.ndarray:
        """Return the present positions of its points, shape (n_points, dim). Collective."""
        return self._vertices(self.reference[self._wet] + self.displacement[self._wet])

    def surface_speed(self) -> np.ndarray:
        """Return w of the step last accepted at the points of ``surface_present``. Collective."""
        return self._vertices(self._solved()[self._wet])

    def surface_shift(self) -> np.ndarray:
        """Return how far its points are moved from ``surface_positions`` to where w = 0 leads. Collective."""
        return self._gather_surface(self._shift()[self._wet])

    def surface_arrival(self, x: np.ndarray | None, dt: float) -> np.ndarray:
        """Return where its points are after a step of dt with the solution x (None: zero). Collective."""
        return self._vertices(self.reference[self._wet] + self._destination(x, dt)[self._wet])

    def _gather_surface(self, wet: np.ndarray) -> np.ndarray:
        gathered = np.empty((self._surface.n_points, self.dim))
        self.comm.Allgatherv(np.ascontiguousarray(wet), [gathered, self._wet_counts])
        values = np.empty_like(gathered)
        values[self._gathered] = gathered
        return values

    # ---- what others read -------------------------------------------------------------------------------------

    def quality(self) -> float:
        """Return the smallest det F: 1 at rest, 0 or less where an element is inverted. Collective."""
        return float(self._smallest_ratios(self.displacement).min())

    def judge(self, x: np.ndarray, dt: float) -> None:
        """Raise if an element of a material that is not made for it turns inside out. Collective.

        Explicit steps are not judged: what they do to an element takes many of them, and shows in the stable step.
        """
        if self._may_be_refused:
            said = self._inverted(self._arrival(x, dt).displacement)
            if said:
                raise SolveError(said)

    def inside_out(self) -> str:
        """Return which body has an element inside out where equations were last taken. Collective."""
        if not self._may_be_refused:
            return ""
        return self._inverted(self.displacement if self._stage is None else self._stage.tangent_at)

    @property
    def _may_be_refused(self) -> bool:
        return not self.explicit and bool(np.any(self._must_not_invert))

    def _inverted(self, displacement: np.ndarray) -> str:
        """Return which body has an element inside out there, of a material not made for it. Collective."""
        least = np.where(self._must_not_invert, self._smallest_ratios(displacement), np.inf)
        if not np.min(least) <= 0:
            return ""
        name = self.names[int(np.argmin(least))]
        damping = ", more damping," if self._has_inertia else ""
        return (
            f"solids.{name} has turned an element inside out: det F = {np.min(least):.1e}. What comes of that is "
            f'no motion of its material; smaller steps{damping} or material = "stable-neohookean" may help'
        )

    def _smallest_ratios(self, displacement: np.ndarray) -> np.ndarray:
        """Return the smallest det F of each body on any rank. Collective."""
        least = self._elements.smallest_ratios(self._exchange.with_shared(displacement))
        self.comm.Allreduce(MPI.IN_PLACE, least, MPI.MIN)
        return least

    def volumes(self) -> dict[str, float]:
        """Return the volume that each body's surface encloses, m^3 (m^2 in 2D). Collective."""
        return self._enclosed(self._mesh.points + self._exchange.with_shared(self.displacement))

    def volume_ratios(self) -> dict[str, float]:
        """Return by body how many times its volume at rest it encloses. Collective."""
        rest = self._enclosed(self._mesh.points)
        return {name: volume / rest[name] for name, volume in self.volumes().items()}

    def _enclosed(self, x: np.ndarray) -> dict[str, float]:
        """Return the volume of each body whose nodes are at x. Collective."""
        mesh = self._mesh
        for group in mesh.groups:
            if group.gradients is None and group.nodes.shape[1] > self.dim + 1:
                x = beyond_middles(x, group.nodes, self.dim)
        present = signed_volumes(x, mesh.cells)
        own = np.where(mesh.counted_cells, present, 0.0)
        total = np.empty(len(self.names))
        self.comm.Allreduce(np.bincount(mesh.body, weights=own, minlength=len(self.names)), total)
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
            self._places[key] = locate(self.comm, self._mesh, index, x, f"a probe of solids.{body}")
        return self._places[key].value(self.comm, self._mesh, getattr(self, quantity))

    def output(self) -> dict[str, Slab]:
        """Return points, cells and body, which never change, and displacement and velocity. Collective."""
        return self._static | self._present()


def _powers(dim: int, degree: int) -> list[tuple[int, ...]]:
    """Return the exponents of all monomials up to a degree."""
    return [p for p in np.ndindex(*(degree + 1,) * dim) if sum(p) <= degree]


def _union(scene: Scene) -> SimplexMesh:
    """Return the mesh of all bodies, quadratic ones with the middles of their edges, reduced linear ones in patches."""
    bodies = []
    for (points, cells), solid in zip(build_bodies(scene).values(), scene.solids.values(), strict=True):
        patch = None
        if solid.elements == "quadratic":
            points, cells = with_middles(points, cells)
        elif solid.volumetric == "reduced":
            patch = (grid_patches if solid.shape.box is not None else grown_patches)(cells, scene.dim)
        bodies.append((points, cells, patch))
    return grouped_mesh(bodies)


def _boundary(mesh: SimplexMesh) -> tuple[np.ndarray, Curved | None]:
    """Return the facets of all bodies, by nodes of the mesh, and how those of quadratic ones move."""
    dim = mesh.points.shape[1]
    bodies = []
    for body in range(int(mesh.body.max()) + 1):
        elements = mesh.elements(body)
        facets = boundary_facets(mesh.points, elements[:, : dim + 1])
        bodies.append(facet_parts(facets_with_middles(facets, elements), dim))
    return np.concatenate([facets for facets, _ in bodies]), Curved.joined(bodies)


def _bodies(solids: Mapping[str, Solid]) -> Bodies:
    lame = np.array([lame_parameters(solid.young, solid.poisson) for solid in solids.values()])
    return Bodies(
        density=np.array([solid.density for solid in solids.values()]),
        lame=lame[:, 0],
        mu=lame[:, 1],
        material=[_material(solid) for solid in solids.values()],
        lumped=np.array([solid.mass == "lumped" for solid in solids.values()]),
        reduced=np.array([solid.volumetric == "reduced" for solid in solids.values()]),
        mass_damping=np.array([solid.damping.mass for solid in solids.values()]),
        stiffness_damping=np.array([solid.damping.stiffness for solid in solids.values()]),
    )


def _material(solid: Solid) -> Material:
    material = named(solid.material)
    return projected(material) if solid.tangent == "projected" else material


def _selection(unknowns: np.ndarray, chosen: np.ndarray, n_unknowns: int) -> csr_matrix:
    """Return the 0/1 map with a one in column ``unknowns[row]`` of every chosen row."""
    indptr = np.concatenate(([0], np.cumsum(chosen))).astype(IntType)
    return csr_matrix(
        (np.ones(indptr[-1]), unknowns[chosen].astype(IntType), indptr), shape=(len(unknowns), n_unknowns)
    )
