"""The beams of a scene as a field: their sections' kinematics, which make a surface for fluids."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix

from petfsi.errors import InputError
from petfsi.fields.beam.elements import THEORIES, WIDTH, BeamElements, Sections
from petfsi.fields.beam.loads import AxisPlace, BeamLoads
from petfsi.fields.slabs import Slab
from petfsi.fields.solid.field import NodalSolid
from petfsi.fields.solid.partition import slab
from petfsi.geometry.beams import (
    axis_mesh,
    direction,
    face_offsets,
    face_slopes,
    strip_facets,
    strip_mesh,
)
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.meshes import SimplexMesh
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import IntType
from petfsi.ranks import on_root
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Beam

#: What a node's unknowns are called in the scene.
COMPONENTS = ("x", "y", "angle")
#: Where the tip of a cantilever under a force has turned so far (rad), Euler-Bernoulli bends it 4% too far.
MODERATE = 0.3


class BeamSolid(NodalSolid):
    """Beams in the plane, all of one theory; a node's unknowns are the rates of u_x, u_y and the section's angle.

    The section of thickness h at a node stays straight: with phi its angle to the x axis plus 90 degrees, the points
    z from the axis are at x + z n, n = (-sin phi, cos phi), and move with x' - z phi' (cos phi, sin phi). The surface
    is the outline of the strip: both faces, z = -h/2 and h/2, with a point at every node, and both ends.
    """

    _elements: BeamElements

    def __init__(self, comm: MPI.Comm, scene: Scene):
        on_root(comm, lambda: build_bodies(scene) and None)
        self._beams = {name: _beam(solid) for name, solid in scene.solids.items()}
        axes = [axis_mesh(beam) for beam in self._beams.values()]
        counts = [len(points) for points, _ in axes]
        self._first = np.concatenate(([0], np.cumsum(counts)))
        # of all nodes, in the scene's own order
        self._rest_angle = np.repeat([np.arctan2(*direction(b)[::-1]) for b in self._beams.values()], counts)
        self._thickness = np.repeat([beam.thickness for beam in self._beams.values()], counts)
        mesh = SimplexMesh.union(axes)
        self._axis = mesh.points
        super().__init__(comm, scene, scene.solids, mesh, COMPONENTS)
        outlines = [strip_facets(n) + 2 * first for n, first in zip(counts, self._first[:-1], strict=True)]
        self._facets = np.concatenate(outlines)
        held = np.zeros(self.layout.n_global, dtype=bool)
        held[self._supports.unknowns] = True
        columns = WIDTH * self._number.astype(np.int64)[:, None] + np.array([[0, 2], [1, 2]]).reshape(1, -1)
        self._columns = np.repeat(columns.reshape(-1, 1, 2, 2), 2, axis=1).reshape(-1, 2).astype(IntType)
        self._held_columns = held[self._columns]
        self._counts = np.array(comm.allgather(self.layout.n_local))
        self._seen: tuple[np.ndarray, np.ndarray] | None = None
        self._slopes = np.zeros((0, 1))
        self._surface: Surface | None = None
        self._places: dict[tuple[str, tuple[float, ...]], AxisPlace] = {}
        self._turned: set[int] = set()
        self._static = self._strips()

    def _make_elements(self, solids: Mapping[str, Solid]) -> BeamElements:
        theory = next(iter(self._beams.values())).theory
        return BeamElements(self._mesh.points, self._mesh.cells, self._mesh.body, self._sections(solids), theory)

    def _stiffens(self, body: int) -> bool:
        """Return whether its theory knows of turning."""
        return self._mesh.cells.shape[1] > 2

    def _turning_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the axis' segments between nodes, of beams that may turn as far as they like, and EA/2.

        What the angles do is straight in time as it is.
        """
        cells, body, modulus = self._mesh.cells, self._mesh.body, self._elements.sections.stiffness[:, 0] / 2
        if cells.shape[1] == 2:
            return cells[:0], body[:0], modulus
        return np.concatenate((cells[:, [0, 2]], cells[:, [2, 1]])), np.concatenate((body, body)), modulus

    def _make_loads(self, mesh: SimplexMesh, solids: Mapping[str, Solid]) -> BeamLoads | None:
        if not any(solid.loads or solid.body_force for solid in solids.values()):
            return None
        counts = np.cumsum([0, *(beam.elements for beam in self._beams.values())])
        first = dict(zip(self.names, counts.tolist(), strict=False))
        return BeamLoads(self.comm, solids, self._mesh, self._elements, self._pattern, first, self.place)

    def _sections(self, solids: Mapping[str, Solid]) -> Sections:
        def of(name: str) -> np.ndarray:
            return np.array([getattr(solid, name) for solid in solids.values()])

        return Sections.rectangular(
            np.array([beam.thickness for beam in self._beams.values()]),
            of("young"),
            of("poisson"),
            of("density"),
            of("mass") == "lumped",
            np.array([(solid.damping.mass, solid.damping.stiffness) for solid in solids.values()]),
        )

    def _strips(self) -> dict[str, Slab]:
        """Return what never changes of the output: the strips at rest."""
        mesh = SimplexMesh.union([strip_mesh(beam) for beam in self._beams.values()])
        begin, end, n = self._exchange.slab
        first, last = slab(len(mesh.cells), self.comm.rank, self.comm.size)
        return {
            "points": Slab(mesh.points[2 * begin : 2 * end], (2 * begin, 0), (2 * n, self.dim)),
            "cells": Slab(mesh.cells[first:last], (first, 0), mesh.cells.shape),
            "body": Slab(mesh.body[first:last], (first,), mesh.body.shape),
        }

    def near_null_space(self) -> list[np.ndarray]:
        """Return the rigid motions about the origin of coordinates: translations, then the rotation."""
        x = self.reference
        one, zero = np.ones(len(x)), np.zeros(len(x))
        modes = [(one, zero, zero), (zero, one, zero), (-x[:, 1], x[:, 0], one)]
        return [np.column_stack(mode).ravel() for mode in modes]

    def light_motions(self, degree: int, density: float, most: int) -> np.ndarray:
        """Return polynomial motions of each body no denser than ``density``, shape (n, layout.n_local). Collective.

        Sections stay normal to the axis: with x the direction of a motion p(X) and t, n those of the beam, theta is
        (x . n) dp/dt.
        """
        light = [k for k, rho in enumerate(self._densities) if rho <= density]
        while degree >= 0 and len(light) * 2 * (degree + 1) > most:
            degree -= 1
        if degree < 0 or not light:
            return np.zeros((0, self.layout.n_local))
        mine = self._mesh.natural[: self._mesh.n_owned]
        motions = []
        for body in light:
            beam = list(self._beams.values())[body]
            t = direction(beam)
            inside = self._node_body[mine] == body
            s = (self.reference - np.array(beam.start)) @ t / self.extent
            for power in range(degree + 1):
                p = np.where(inside, s**power, 0.0)
                slope = np.where(inside, power * s ** max(power - 1, 0) / self.extent, 0.0)
                motions.append(np.column_stack((p, 0 * p, -t[1] * slope)).ravel())
                motions.append(np.column_stack((0 * p, p, t[0] * slope)).ravel())
        return np.array(motions)

    @property
    def _densities(self) -> np.ndarray:
        return self._elements.sections.rho_A / [beam.thickness for beam in self._beams.values()]

    def remark(self, dt: float) -> str | None:
        """Return besides which beams have turned farther than their theory knows, each once. Collective."""
        return "; ".join(filter(None, (super().remark(dt), self._turned_far()))) or None

    def _turned_far(self) -> str:
        moderate = [k for k in range(len(self.names)) if not self._stiffens(k) and k not in self._turned]
        if not moderate:
            return ""
        most = np.zeros(len(self.names))
        mine = self._mesh.natural[: self._mesh.n_owned]
        np.maximum.at(most, self._node_body[mine], np.abs(self.displacement[:, 2]))
        self.comm.Allreduce(MPI.IN_PLACE, most, MPI.MAX)
        found = [k for k in moderate if most[k] > MODERATE]
        self._turned.update(found)
        return "; ".join(
            f"solids.{self.names[k]} has turned by {most[k]:.2g} rad, and euler-bernoulli is for moderate rotations: "
            f'beyond {MODERATE:g} rad its bending is off by 4% and more; theory = "timoshenko" is right for any'
            for k in found
        )

    # ---- the surface ------------------------------------------------------------------------------------------

    def _everywhere(self, owned: np.ndarray) -> np.ndarray:
        """Return the values of all nodes, in the scene's own order, on every rank. Collective."""
        whole = np.empty((len(self._number), WIDTH))
        self.comm.Allgatherv(np.ascontiguousarray(owned), [whole, self._counts])
        return whole[self._number]

    def _present_geometry(self) -> np.ndarray:
        """Return d of all nodes where fluids meet the beam; gathered when it has changed. Collective."""
        d = self.displacement if self._geometry is None else self._geometry
        if self._seen is None or self._seen[0] is not d:
            self._seen = d, self._everywhere(d)
        return self._seen[1]

    def surface(self) -> Surface:
        """Return the outlines, the same on every rank; another object when a section has turned. Collective."""
        angle = self._rest_angle + self._present_geometry()[:, 2]
        slopes = face_slopes(angle, self._thickness).reshape(-1, 1)
        if self._surface is None or not np.array_equal(slopes, self._slopes):
            self._slopes = slopes
            nothing = np.zeros(len(self._facets), dtype=bool)
            self._surface = Surface(self._facets, nothing, nothing, self._map(False), self._map(True))
        return self._surface

    def _map(self, held: bool) -> csr_matrix:
        """Return the velocities of points by unknowns that are held, or free: a point's are x' and slope theta'."""
        chosen = self._held_columns == held
        values = np.column_stack((np.ones(len(self._slopes)), self._slopes))
        indptr = np.concatenate(([0], np.cumsum(chosen.sum(axis=1)))).astype(IntType)
        return csr_matrix((values[chosen], self._columns[chosen], indptr), shape=(len(chosen), self.layout.n_global))

    def surface_bodies(self) -> np.ndarray:
        """Return the body of each of its points."""
        return np.repeat(self._node_body, 2)

    def surface_rooted(self) -> np.ndarray:
        """Return which of its points are at nodes that supports hold where they are, whether these turn or not."""
        return np.repeat(self._still_nodes(), 2)

    def surface_positions(self) -> np.ndarray:
        """Return the positions of the surface's points, shape (n_points, 2). Collective.

        From ``predict`` to ``accept`` those where the step's tangent is taken, otherwise the present ones.
        """
        return self._outline(self._present_geometry())

    def _outline(self, d: np.ndarray) -> np.ndarray:
        """Return the positions of the surface's points by the displacement of all nodes."""
        offsets = face_offsets(self._rest_angle + d[:, 2], self._thickness)
        return ((self._axis + d[:, :2])[:, None] + offsets).reshape(-1, 2)

    def surface_arrival(self, x: np.ndarray | None, dt: float) -> np.ndarray:
        """Return where its points are after a step of dt with the solution x (None: zero). Collective."""
        return self._outline(self._everywhere(self._destination(x, dt)))

    def surface_present(self) -> np.ndarray:
        """Return the present positions of its points, shape (n_points, 2). Collective."""
        return self._outline(self._everywhere(self.displacement))

    def surface_speed(self) -> np.ndarray:
        """Return w of the step last accepted at the points of ``surface_present``. Collective."""
        return self._at_points(self._solved())

    def surface_shift(self) -> np.ndarray:
        """Return how far its points are moved from ``surface_positions`` to where w = 0 leads. Collective."""
        return self._at_points(self._shift())

    def surface_velocity(self) -> np.ndarray:
        """Return w of the step last accepted at the surface's points, shape (n_points, 2). Collective."""
        return self._at_points(self._solved())

    def _at_points(self, rates: np.ndarray) -> np.ndarray:
        """Return by the present sections how points move if this rank's nodes move so. Collective."""
        self.surface()
        w = self._everywhere(rates)
        slopes = self._slopes.reshape(-1, 2, 2)
        return (w[:, None, :2] + slopes * w[:, 2, None, None]).reshape(-1, 2)

    # ---- what others read -------------------------------------------------------------------------------------

    def place(self, body: str, at: tuple[float, ...] | list[float], key: str) -> AxisPlace:
        """Return where on a beam's axis a reference position is: the nearest point. Not collective.

        Raises
        ------
        InputError
            If it is farther away than the thickness; the message begins with ``key``.
        """
        beam = self._beams[body]
        points, cells = axis_mesh(beam)
        t, x = direction(beam), np.asarray(at, dtype=float)
        whole = np.linalg.norm(points[-1] - points[0])
        s = float(np.clip((x - points[0]) @ t, 0.0, whole))
        away = float(np.linalg.norm(x - points[0] - s * t))
        if away > beam.thickness * (1 + 1e-9):
            where = ", ".join(f"{c:g}" for c in x)
            raise InputError(
                f"{key}: [{where}] lies {away:g} m from the axis of solids.{body}, more than its thickness "
                f"({beam.thickness:g} m)"
            )
        length = whole / len(cells)
        e = min(int(s / length), len(cells) - 1)
        one = THEORIES[beam.theory](np.array([length]), t[None], np.zeros((1, 3)))
        xi = float(np.clip(2 * (s / length - e) - 1, -1.0, 1.0))
        (weights,) = one.interpolation(np.array([0]), np.array([xi]))
        first = self._first[self.names.index(body)]
        return AxisPlace(self._number[first + cells[e]], weights, xi)

    def probe(self, body: str, at: tuple[float, ...] | list[float], quantity: str) -> np.ndarray:
        """Return ``displacement``, ``velocity`` or ``angle`` of the point of the axis next to ``at``. Collective."""
        if body not in self.names or len(at) != self.dim:
            raise InputError(f"a probe of {body!r} at {list(at)}: known solids are {', '.join(self.names)}, in 2D")
        if quantity not in ("displacement", "velocity", "angle"):
            known = "displacement, velocity and angle are"
            raise InputError(f"a probe of solids.{body}: {quantity!r} is not known; {known}")
        key = body, tuple(at)
        if key not in self._places:
            self._places[key] = self.place(body, at, "a probe")
        place, owned = self._places[key], self.velocity if quantity == "velocity" else self.displacement
        local = place.nodes - self._mesh.nodes.start
        mine = (local >= 0) & (local < self._mesh.n_owned)
        value = np.empty(WIDTH)
        weights = place.weights.reshape(WIDTH, -1, WIDTH)[:, mine]
        self.comm.Allreduce(np.einsum("inj,nj->i", weights, owned[local[mine]]), value)
        return value[2:] if quantity == "angle" else value[:2]

    def output(self) -> dict[str, Slab]:
        """Return points, cells and body of the strips, and displacement and velocity of their points. Collective."""
        begin, end, n = self._exchange.slab
        d, u = self._exchange.to_natural(self.displacement), self._exchange.to_natural(self.velocity)
        rest, thickness = self._rest_angle[begin:end], self._thickness[begin:end]
        moved = face_offsets(rest + d[:, 2], thickness) - face_offsets(rest, thickness) + d[:, None, :2]
        turning = face_slopes(rest + d[:, 2], thickness) * u[:, 2, None, None] + u[:, None, :2]
        values = {"displacement": moved, "velocity": turning}
        return self._static | {
            name: Slab(value.reshape(-1, 2), (2 * begin, 0), (2 * n, 2)) for name, value in values.items()
        }


def _beam(solid: Solid) -> Beam:
    assert solid.shape.beam is not None  # the scene was checked
    return solid.shape.beam
