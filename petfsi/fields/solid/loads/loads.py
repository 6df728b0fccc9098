"""The loads of a scene's solids: body forces, tractions, pressures and forces at points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.loads.dead import DeadLoads
from petfsi.fields.solid.loads.followers import FollowerPressure, FollowerTraction
from petfsi.fields.solid.loads.simplices import Coordinates, Simplices
from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.probes import Place
from petfsi.geometry.places import Tags, located_facets
from petfsi.geometry.quadratic import facets_with_middles
from petfsi.geometry.surfaces import boundary_facets
from petfsi.ranks import agreed
from petfsi.scene.expressions import Expression
from petfsi.scene.solids import Load, Solid
from petfsi.scene.tables import Number

#: Gauss points along an axis of a facet: exact to degree 5.
FACET_POINTS = 3


@dataclass(frozen=True)
class Body:
    """What loads need to know of a body; all but ``local`` is of the whole mesh and the same on every rank.

    Attributes
    ----------
    nodes : ndarray of int, shape (n,)
        Its nodes in the whole mesh, ascending, as its own mesh numbers them.
    points : ndarray, shape (n, dim)
        Where they are at rest, m.
    elements : ndarray of int, shape (ne, m)
        Its elements, corners first, in its own numbering.
    local : ndarray of int, shape (count, m)
        Those of this rank, in the rank's numbering.
    tags : Tags
        Groups of facets, in its own numbering.
    """

    nodes: np.ndarray
    points: np.ndarray
    elements: np.ndarray
    local: np.ndarray
    tags: Tags


class Loads:
    """Nodal forces of all loads, this rank's rows.

    Parameters
    ----------
    comm : MPI.Comm
    solids : mapping of str to Solid
    bodies : mapping of str to Body
    mesh : LocalMesh
    pattern : Pattern or None
        Of the block; all nodes of a facet must be neighbours in it. None for explicit steps, which have no tangent.
    places : mapping of (str, int) to Place
        Of every force at a point: the body and the index of the load.

    Attributes
    ----------
    follow : bool
        Whether any of them depends on the displacement.
    """

    def __init__(
        self, comm: MPI.Comm, solids: Mapping[str, Solid], bodies: Mapping[str, Body], mesh: LocalMesh,
        pattern: Pattern | None, places: Mapping[tuple[str, int], Place],
    ) -> None:  # fmt: skip
        self.comm, self._mesh = comm, mesh
        self.dim = mesh.points.shape[1]
        self._dead = DeadLoads(mesh.n_owned, self.dim)
        self._pressures: list[FollowerPressure] = []
        self._tractions: list[FollowerTraction] = []
        agreed(comm, lambda: self._collect(solids, bodies, places))
        self.follow = bool(self._pressures or self._tractions)
        self._tangents = [_Tangent(p.facets, mesh, pattern) for p in self._pressures] if pattern is not None else []
        self._force, self._k = np.zeros((mesh.n_owned, self.dim)), 0.0

    # ---- set-up -----------------------------------------------------------------------------------------------

    def _collect(
        self, solids: Mapping[str, Solid], bodies: Mapping[str, Body], places: Mapping[tuple[str, int], Place]
    ) -> None:
        for name, solid in solids.items():
            key, body = f"solids.{name}", bodies[name]
            if solid.body_force is not None:
                self._add_body_force(f"{key}.body_force", solid.body_force, body)
            skin = boundary_facets(body.points, body.elements[:, : self.dim + 1]) if solid.loads else None
            for n, load in enumerate(solid.loads):
                if load.force is not None:
                    self._add_point(f"{key}.loads.{n}", load, places[name, n])
                else:
                    self._add_facets(f"{key}.loads.{n}", load, body, skin)

    def _add_body_force(self, key: str, force: list[Number], body: Body) -> None:
        order = 1 if body.local.shape[1] == self.dim + 1 else 2
        on = Simplices(self._mesh.points, body.local, self.dim + 1, order + 1)
        self._dead.add_densities(on, list(zip(_expressions(force, key), np.eye(self.dim), strict=True)))

    def _add_point(self, key: str, load: Load, place: Place) -> None:
        assert load.force is not None and load.at is not None
        rows = place.nodes - self._mesh.nodes.start
        mine = (rows >= 0) & (rows < self._mesh.n_owned)
        at: Coordinates = {"z": 0.0, **dict(zip("xyz", load.at, strict=False))}
        self._dead.add_point(_expressions(load.force, f"{key}.force"), at, rows[mine], place.weights[mine])

    def _add_facets(self, key: str, load: Load, body: Body, skin: np.ndarray | None) -> None:
        assert load.where is not None and skin is not None
        chosen = skin[located_facets(load.where, body.points, skin, key, body.tags)]
        facets = facets_with_middles(chosen, body.elements)
        on = Simplices(self._mesh.points, self._local(body.nodes[facets]), self.dim, FACET_POINTS)
        if load.pressure is not None:
            pressure = Expression(load.pressure, key=f"{key}.pressure")
            if load.follows:
                self._pressures.append(FollowerPressure(on, pressure))
            else:
                self._dead.add_densities(on, [(pressure, -on.reference_normals())])
            return
        assert load.traction is not None
        components = _expressions(load.traction, f"{key}.traction")
        if load.follows:
            self._tractions.append(FollowerTraction(on, components))
        else:
            self._dead.add_densities(on, list(zip(components, np.eye(self.dim), strict=True)))

    def _local(self, nodes: np.ndarray) -> np.ndarray:
        """Return those rows of node numbers of the whole mesh that touch an own node, in this rank's numbering."""
        order = np.argsort(self._mesh.natural)
        place = np.searchsorted(self._mesh.natural, nodes, sorter=order)
        found = order[np.minimum(place, len(order) - 1)] if len(order) else np.zeros_like(place)
        owned = (found < self._mesh.n_owned) & (self._mesh.natural[found] == nodes) if len(order) else found > 0
        return found[owned.any(axis=1)]

    # ---- the step ---------------------------------------------------------------------------------------------

    def assemble(self, time: float, at: State, k: float, values: np.ndarray | None, b: np.ndarray) -> None:
        """Add the loads to b and the tangent of follower pressures to A. Collective where they depend on the place.

        With f' the symmetric part of df/dd, the step's equation has f(d) = f(d~) + f' (s + k w):

            A -= k f',    b += f(d~) + f' s .

        Parameters
        ----------
        time : float
            Of the step's equation, s.
        at : State
            d~ and s at all local nodes.
        k : float
            d = d~ + s + k w, s; zero in an explicit step, which has no use for f'.
        values : ndarray or None
            A's values; None: b alone.
        b : ndarray, shape (n_owned, dim)
        """
        if self.follow or self._dead.depends_on_place_and_time:
            self._force = agreed(self.comm, lambda: self._forces(time, at.displacement))
        else:
            self._force = self._dead.forces(time)
        self._k = k
        if self._pressures and k > 0:
            x = self._mesh.points + at.displacement
            for pressure, tangent in zip(self._pressures, self._tangents, strict=True):
                tangent.take(pressure.tangents(x, time))
                self._force += tangent.product(at.shift)
                if values is not None:
                    tangent.add(values, -k)
        b += self._force

    def start(self, d: np.ndarray) -> np.ndarray:
        """Return the forces at time zero on nodes that are displaced so, at the owned ones, N. Collective.

        Parameters
        ----------
        d : ndarray, shape (n_nodes, dim)
            At all local nodes, m.
        """
        return agreed(self.comm, lambda: self._forces(0.0, d))

    def _forces(self, time: float, d: np.ndarray) -> np.ndarray:
        total = self._dead.forces(time)
        if not self.follow:
            return total
        total, x = total.copy(), self._mesh.points + d
        followers: list[FollowerPressure | FollowerTraction] = [*self._pressures, *self._tractions]
        for load in followers:
            total += load.facets.gather(load.forces(x, time), len(total))
        return total

    def felt(self, w: np.ndarray) -> np.ndarray:
        """Return the forces of the step last assembled for its solution w, f(d~) + f' (s + k w). Not collective.

        Parameters
        ----------
        w : ndarray, shape (n_nodes, dim)
            At all local nodes, m/s.

        Returns
        -------
        ndarray, shape (n_owned, dim)
            N.
        """
        if not self._pressures or self._k == 0:
            return self._force
        return self._force + self._k * sum(tangent.product(w) for tangent in self._tangents)


class _Tangent:
    """The tangents of facets, and where they stand in A's values."""

    def __init__(self, facets: Simplices, mesh: LocalMesh, pattern: Pattern) -> None:
        self._facets, self._n, dim = facets, mesh.n_owned, facets.dim
        nodes = facets.nodes
        unknowns = dim * mesh.number[nodes].astype(np.int64)[:, :, None] + np.arange(dim)
        unknowns = unknowns.reshape(len(nodes), dim * nodes.shape[1])
        row = np.repeat(unknowns - dim * mesh.nodes.start, unknowns.shape[1], axis=1).ravel()
        column = np.tile(unknowns, (1, unknowns.shape[1])).ravel()
        self._chosen = np.repeat(np.repeat(nodes < self._n, dim, axis=1), unknowns.shape[1], axis=1).ravel()
        # entries are numbered from 1, as a sparse matrix's zero is no entry
        number = np.arange(1, len(pattern.indices) + 1)
        shape = (len(pattern.indptr) - 1, dim * mesh.nodes.n_global)
        table = csr_matrix((number, pattern.indices, pattern.indptr), shape=shape)
        chosen = row[self._chosen], column[self._chosen]
        self._slot = np.asarray(table[chosen]).ravel() - 1 if len(chosen[0]) else np.zeros(0, dtype=np.int64)
        self._K = np.zeros((len(nodes), nodes.shape[1], dim, nodes.shape[1], dim))

    def take(self, K: np.ndarray) -> None:
        """Take the tangents of the present step."""
        self._K = K

    def add(self, values: np.ndarray, factor: float) -> None:
        """Add a multiple of them to A's values."""
        np.add.at(values, self._slot, factor * self._K.ravel()[self._chosen])

    def product(self, v: np.ndarray) -> np.ndarray:
        """Return their product with a vector at all local nodes, at the owned ones, shape (n_owned, dim)."""
        forces = np.einsum("eaibj,ebj->eai", self._K, v[self._facets.nodes])
        return self._facets.gather(forces, self._n)


def _expressions(sources: list[Number], key: str) -> list[Expression]:
    return [Expression(source, key=f"{key}.{n}") for n, source in enumerate(sources)]
