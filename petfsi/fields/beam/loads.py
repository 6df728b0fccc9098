"""The loads of beams: along the axis and at points of it, dead or turning with the section."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from petfsi.fields.beam.elements import WIDTH, BeamElements, scatter_matrices
from petfsi.fields.solid.elements import State
from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.pattern import Pattern
from petfsi.geometry.beams import axis_mesh
from petfsi.geometry.places import located_facets
from petfsi.ranks import agreed
from petfsi.scene.expressions import Expression
from petfsi.scene.solids import Load, Solid
from petfsi.scene.tables import Number

#: Gauss points of an element: exact to degree 5.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True)
class AxisPlace:
    """A point of an axis as a weighted sum of its element's nodes, the same on every rank.

    Attributes
    ----------
    nodes : ndarray of int, shape (n_nodes,)
        Global numbers, in the element's order.
    weights : ndarray, shape (3, 3 n_nodes)
        (u_x, u_y, theta) there from those of the nodes; transposed, the nodes' loads from a force and a moment.
    xi : float
        Where in the element it is, -1 to 1.
    """

    nodes: np.ndarray
    weights: np.ndarray
    xi: float


@dataclass(frozen=True)
class _Stations:
    """Points of this rank's elements where one load acts.

    Attributes
    ----------
    element : ndarray of int, shape (n,)
    maps : ndarray, shape (n, 3, 3 n_nodes)
        From an element's unknowns to (u_x, u_y, theta) there.
    share : ndarray, shape (n,)
        What a density is multiplied by: a length, m, or 1 for a force.
    terms : list of (Expression, ndarray of shape (n, 3))
        Their sum of products is force and moment, or their density, in directions at rest.
    coordinates : dict of str to ndarray, shape (n,)
        Where it is at rest.
    follows : bool
        Whether the force turns with the section.
    """

    element: np.ndarray
    maps: np.ndarray
    share: np.ndarray
    terms: list[tuple[Expression, np.ndarray]]
    coordinates: dict[str, np.ndarray]
    follows: bool

    @property
    def depends_on_time(self) -> bool:
        """Whether it changes even if nothing turns."""
        return any(expression.depends_on_time for expression, _ in self.terms)

    def values(self, time: float) -> np.ndarray:
        """Return force and moment of each station in directions at rest, shape (n, 3)."""
        total = np.zeros((len(self.element), WIDTH))
        for expression, direction in self.terms:
            total += np.reshape(expression(t=time, **self.coordinates), (-1, 1)) * direction
        return self.share[:, None] * total


class BeamLoads:
    """Nodal forces and moments of all loads, this rank's rows.

    A force or a density of it, q(t) for a section at rest, acts on the nodes of its element as

        f = sum N^T (R q, m),    R the rotation by theta of the section if it follows it, else 1,

    N the shape functions, so that the work is that of the continuous load. Lengths are those at rest. A body force is
    spread over the thickness, a traction is a force per length of the axis (and per metre of width), and a pressure
    acts on the face on the left of the axis, seen from start to end. Moments in the plane turn nothing by themselves.

    The tangent of followers has a symmetric part, which goes into A, and another one, which is left out because A is
    symmetric: under followers Newton converges linearly.

    Parameters
    ----------
    comm : MPI.Comm
    solids : mapping of str to Solid
    mesh : LocalMesh
    elements : BeamElements
        Of the mesh.
    pattern : Pattern
        Of the block.
    first : mapping of str to int
        The number of each body's first element in the whole mesh.
    place : callable
        Returns the place of a reference position on a body: ``place(body, at, key)``.
    """

    def __init__(
        self, comm: MPI.Comm, solids: Mapping[str, Solid], mesh: LocalMesh, elements: BeamElements, pattern: Pattern,
        first: Mapping[str, int], place: Callable[[str, list[float], str], AxisPlace],
    ) -> None:  # fmt: skip
        self.comm, self._mesh, self._elements, self._pattern = comm, mesh, elements, pattern
        self._first, self._place = first, place
        self._stations: list[_Stations] = []
        for body, (name, solid) in enumerate(solids.items()):
            self._collect(body, name, solid)
        self.follow = any(stations.follows for stations in self._stations)
        self._changes = self.follow or any(stations.depends_on_time for stations in self._stations)
        size = elements.mass.shape[1]
        self._force: np.ndarray | None = None
        self._k, self._tangent = 0.0, np.zeros((len(elements.cells), size, size))

    # ---- set-up -----------------------------------------------------------------------------------------------

    def _collect(self, body: int, name: str, solid: Solid) -> None:
        beam, key = solid.shape.beam, f"solids.{name}"
        assert beam is not None  # the scene was checked
        chosen = np.flatnonzero(self._mesh.body == body)
        if solid.body_force is not None:
            terms = _terms(solid.body_force, f"{key}.body_force")
            self._stations.append(self._along(chosen, beam.thickness, terms, False))
        for n, load in enumerate(solid.loads):
            here = f"{key}.loads.{n}"
            if load.at is not None:
                self._stations.append(self._point(name, load, here))
                continue
            assert load.where is not None
            points, cells = axis_mesh(beam)
            within = located_facets(load.where, points, cells, here, {})
            # elements are numbered body after body, as they are in the whole mesh
            number = self._mesh.cell_ids[chosen] - self._first[name]
            self._stations.append(self._spread(chosen[within[number]], load, here))

    def _spread(self, chosen: np.ndarray, load: Load, key: str) -> _Stations:
        """Return the stations of a traction or a pressure on some elements."""
        axis = np.repeat(self._elements.axis[chosen], len(_POINTS), axis=0)
        if load.traction is not None:
            return self._along(chosen, 1.0, _terms(load.traction, f"{key}.traction"), load.follows)
        assert load.pressure is not None
        # from the left: along the axis turned by -90 degrees
        against = np.column_stack((axis[:, 1], -axis[:, 0], np.zeros(len(axis))))
        return self._along(chosen, 1.0, [(Expression(load.pressure, key=f"{key}.pressure"), against)], load.follows)

    def _along(
        self, chosen: np.ndarray, share: float, terms: list[tuple[Expression, np.ndarray]], follows: bool
    ) -> _Stations:
        """Return the Gauss points of some elements."""
        element, xi = np.repeat(chosen, len(_POINTS)), np.tile(_POINTS, len(chosen))
        lengths = self._elements.length[element] * np.tile(_WEIGHTS / 2, len(chosen))
        return self._at(element, xi, share * lengths, terms, follows)

    def _point(self, name: str, load: Load, key: str) -> _Stations:
        """Return the station of a force and a moment, on the ranks that know its element."""
        assert load.at is not None
        place = self._place(name, load.at, key)
        number = self._mesh.number[self._elements.cells]
        element = np.flatnonzero((number == place.nodes).all(axis=1))
        terms = _terms(load.force or [], f"{key}.force")
        if load.moment is not None:
            terms.append((Expression(load.moment, key=f"{key}.moment"), np.eye(WIDTH)[2]))
        one = np.ones(len(element))
        stations = self._at(element, place.xi * one, one, terms, bool(load.follower))
        return replace(stations, coordinates={"z": 0.0 * one, "x": load.at[0] * one, "y": load.at[1] * one})

    def _at(
        self, element: np.ndarray, xi: np.ndarray, share: np.ndarray, terms: list[tuple[Expression, np.ndarray]],
        follows: bool,
    ) -> _Stations:  # fmt: skip
        ends = self._mesh.points[self._elements.cells[element][:, :2]]
        x = 0.5 * ((1 - xi)[:, None] * ends[:, 0] + (1 + xi)[:, None] * ends[:, 1])
        coordinates = {"x": x[:, 0], "y": x[:, 1], "z": np.zeros(len(x))}
        return _Stations(element, self._elements.theory.interpolation(element, xi), share, terms, coordinates, follows)

    # ---- the step ---------------------------------------------------------------------------------------------

    def assemble(self, time: float, at: State, k: float, values: np.ndarray | None, b: np.ndarray) -> None:
        """Add  f(d~) + f' s  to b and  -k f'  to A's values, f' the symmetric part of df/dd of followers. Collective.

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
        b : ndarray, shape (n_owned, 3)
        """
        if self._changes or self._force is None:
            self._force = agreed(self.comm, lambda: self._forces(time, at.displacement))
        self._k = k if self.follow else 0.0
        if self._k > 0:
            self._force += self._product(at.shift)
            if values is not None:
                cells, pattern = self._elements.cells, self._pattern
                scatter_matrices(cells, -k * self._tangent, pattern.node_ptr, pattern.slots[0], values)
        b += self._force

    def start(self, d: np.ndarray) -> np.ndarray:
        """Return the forces at time zero on nodes (all local ones) displaced so, at the owned ones. Collective."""
        return agreed(self.comm, lambda: self._forces(0.0, d))

    def _forces(self, time: float, d: np.ndarray) -> np.ndarray:
        """Return the forces at d, and take their tangent."""
        d = d[self._elements.cells].reshape(len(self._elements.cells), -1)
        loads = np.zeros_like(d)
        self._tangent[:] = 0.0
        for stations in self._stations:
            value = stations.values(time)
            if stations.follows:
                turning = stations.maps[:, 2]
                theta = np.sum(turning * d[stations.element], axis=1)
                value[:, :2] = _turned(value[:, :2], theta)
                # a force that turns changes at a right angle
                change = np.column_stack((-value[:, 1], value[:, 0]))
                K = np.einsum("sid,si,se->sde", stations.maps[:, :2], change, turning)
                np.add.at(self._tangent, stations.element, (K + K.transpose(0, 2, 1)) / 2)
            np.add.at(loads, stations.element, np.einsum("sid,si->sd", stations.maps, value))
        return self._gathered(loads)

    def _gathered(self, loads: np.ndarray) -> np.ndarray:
        total = np.empty((self._mesh.n_owned, WIDTH))
        self._elements.gather(loads, total)
        return total

    def _product(self, v: np.ndarray) -> np.ndarray:
        v = v[self._elements.cells].reshape(len(self._elements.cells), -1)
        return self._gathered(np.einsum("eij,ej->ei", self._tangent, v))

    def felt(self, w: np.ndarray) -> np.ndarray:
        """Return the forces of the step last assembled for its solution w, f(d~) + f' (s + k w). Not collective.

        Parameters
        ----------
        w : ndarray, shape (n_nodes, 3)
            At all local nodes.

        Returns
        -------
        ndarray, shape (n_owned, 3)
            N and N m.
        """
        assert self._force is not None
        return self._force + self._k * self._product(w) if self._k > 0 else self._force


def _terms(force: list[Number], key: str) -> list[tuple[Expression, np.ndarray]]:
    return [(Expression(source, key=f"{key}.{n}"), np.eye(WIDTH)[n]) for n, source in enumerate(force)]


def _turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack((c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]))
