"""Linear and quadratic triangles and tetrahedra, total Lagrangian: from displacements to A, b and energies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from petfsi.fields.solid.kernels import kernels
from petfsi.fields.solid.materials import Material
from petfsi.fields.solid.materials.linear import linear
from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.patches import barycentric_gradients
from petfsi.fields.solid.pattern import Pattern
from petfsi.fields.solid.quality import smallest_volume_ratio
from petfsi.fields.solid.rules import Rule, linear_rule, patch_rule, quadratic_rule
from petfsi.geometry.meshes import Group

#: Quadrature points handled at a time: their tangents stay in a core's cache.
CHUNK = 512


@dataclass(frozen=True)
class Bodies:
    """What bodies are made of; arrays have one entry per body.

    Attributes
    ----------
    density : ndarray
        kg/m^3.
    lame, mu : ndarray
        Pa.
    material : list of Material
    lumped : ndarray of bool
        Whether the mass matrix is diagonal.
    reduced : ndarray of bool
        Whether lambda's part of the energy is integrated by fewer points than mu's.
    mass_damping, stiffness_damping : ndarray
        Rayleigh's factors, 1/s and s.
    """

    density: np.ndarray
    lame: np.ndarray
    mu: np.ndarray
    material: list[Material]
    lumped: np.ndarray
    reduced: np.ndarray
    mass_damping: np.ndarray
    stiffness_damping: np.ndarray


@dataclass(frozen=True)
class State:
    """What a step's right-hand side is made of, at all local nodes; each of shape (n, width).

    Attributes
    ----------
    displacement : ndarray
        d, where forces and tangent are taken, m.
    inertia : ndarray
        V, m/s^2.
    shift : ndarray
        s, m.
    """

    displacement: np.ndarray
    inertia: np.ndarray
    shift: np.ndarray


class _Batch:
    """A group of elements, ready for the kernels; ``parts`` cuts it into slices that fit a core's cache."""

    def __init__(self, points: np.ndarray, group: Group, bodies: Bodies):
        dim = points.shape[1]
        self.body = group.body
        self.cells = np.ascontiguousarray(group.nodes, dtype=np.int32)
        n = self.cells.shape[1]
        self.rule = rule = _rule(group, dim, bool(bodies.reduced[group.body]))
        if group.gradients is None or group.volume is None:
            self.basis = barycentric_gradients(points, self.cells)
            edges = points[self.cells[:, 1 : dim + 1]] - points[self.cells[:, :1]]
            self.volume = np.linalg.det(edges) / (2.0 if dim == 2 else 6.0)
        else:
            self.basis, self.volume = group.gradients, group.volume
        self.weights = self.volume[:, None] * rule.weights
        self.loops = kernels(dim, n, len(rule.weights) == 1)
        self.is_patch = not rule.mass.any()
        density = bodies.density[group.body]
        self.mass = density * (np.diag(rule.lumped) if bodies.lumped[group.body] else rule.mass)
        self.lumped = density * rule.lumped
        self.chunk = max(CHUNK // len(rule.weights), 1)
        self.lame = np.tile(bodies.lame[group.body] * rule.lame, self.chunk)
        self.mu = np.tile(bodies.mu[group.body] * rule.mu, self.chunk)
        self.material = bodies.material[group.body]

    def parts(self) -> Iterator[slice]:
        for begin in range(0, len(self.cells), self.chunk):
            yield slice(begin, min(begin + self.chunk, len(self.cells)))

    def gradients(self, field: np.ndarray, part: slice) -> np.ndarray:
        """Return the gradient of a field of all local nodes at every point, shape (count * Q, dim, dim)."""
        count, dim = part.stop - part.start, self.basis.shape[2]
        H = np.empty((count * len(self.rule.weights), dim, dim))
        self.loops.gradient(self.cells[part], self.basis[part], self.rule.table, field, H)
        return H

    def respond(self, d: np.ndarray, part: slice, tangent: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy density, stress and tangent at every point."""
        H = self.gradients(d, part)
        return self.material(H, self.lame[: len(H)], self.mu[: len(H)], tangent)

    def mass_product(self, volume: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        """Return u . M v over elements of the given volumes."""
        return 0.0 if self.is_patch else float(self.loops.kinetic(self.cells, volume, self.mass, u, v))


def _rule(group: Group, dim: int, reduced: bool) -> Rule:
    n = group.nodes.shape[1]
    if group.gradients is not None:
        return patch_rule(n)
    return linear_rule(dim, reduced) if n == dim + 1 else quadratic_rule(dim, reduced)


class Elements:
    """Elements of any number of bodies.

    With N_a the shape functions, g_a = grad N_a and F = I + sum_a d_a g_a^T at quadrature points of weight w,

        K_a[i] = sum w P[i,J] g_a[J],    K'_ab[i,k] = sum w g_a[J] C[i,J,k,L] g_b[L],    M_ab = int density N_a N_b

    or, lumped, M's diagonal scaled to its total. P and C are symmetric in what they say of pairs, and so is K', to
    the last bit.

    Parameters
    ----------
    mesh : LocalMesh
    bodies : Bodies

    Attributes
    ----------
    constant : bool
        Whether K' is the same at every displacement.
    """

    def __init__(self, mesh: LocalMesh, bodies: Bodies):
        self.dim = mesh.points.shape[1]
        self.bodies = bodies
        self.batches = [_Batch(mesh.points, group, bodies) for group in mesh.groups]
        self.constant = all(material is linear for material in bodies.material)

    def assemble(self, at: State, a: float, k: float, pattern: Pattern, values: np.ndarray, b: np.ndarray) -> None:
        """Fill A's values and b with  (a + a0) M + (k + a1) K'(d)  and  M V - K'(d) s - K(d). Not collective.

        a0 and a1 are the bodies' damping, C = a0 M + a1 K'.

        Parameters
        ----------
        at : State
        a, k : float
            1/s, s.
        pattern : Pattern
        values : ndarray, shape (len(pattern.indices),)
            Overwritten.
        b : ndarray, shape (n_owned, dim)
            Overwritten.
        """
        values[:] = 0.0
        b[:] = 0.0
        shifted = bool(at.shift.any())
        for batch, slots in zip(self.batches, pattern.slots, strict=True):
            A_M = a + self.bodies.mass_damping[batch.body]
            A_K = k + self.bodies.stiffness_damping[batch.body]
            for part in batch.parts():
                C = self._add_forces(batch, part, at, shifted, True, b)
                batch.loops.tangent(
                    batch.cells[part], batch.basis[part], batch.rule.table, batch.weights[part], C,
                    batch.volume[part], batch.mass, A_M, A_K, pattern.node_ptr, slots[part], values,
                )  # fmt: skip

    def forces(self, at: State, b: np.ndarray) -> None:
        """Fill b with  M V - K'(d) s - K(d). Not collective.

        Parameters
        ----------
        at : State
            Without a shift no tangent is computed.
        b : ndarray, shape (n_owned, dim)
            Overwritten.
        """
        b[:] = 0.0
        shifted = bool(at.shift.any())
        for batch in self.batches:
            for part in batch.parts():
                self._add_forces(batch, part, at, shifted, shifted, b)

    def _add_forces(
        self, batch: _Batch, part: slice, at: State, shifted: bool, tangent: bool, b: np.ndarray
    ) -> np.ndarray:
        cells, loops = batch.cells[part], batch.loops
        _, P, C = batch.respond(at.displacement, part, tangent)
        if shifted:
            loops.contract(C, batch.gradients(at.shift, part), P)
        loops.forces(
            cells, batch.basis[part], batch.rule.table, batch.weights[part], P,
            batch.volume[part], batch.mass, at.inertia, b,
        )  # fmt: skip
        return C

    # ---- masses -----------------------------------------------------------------------------------------------

    def lumped_mass(self, n: int) -> np.ndarray:
        """Return a positive diagonal mass of the first ``n`` nodes, shape (n, dim), kg."""
        return np.repeat(self._scattered([batch.lumped for batch in self.batches], n)[:, None], self.dim, axis=1)

    def uniform_load(self, n: int) -> np.ndarray:
        """Return M e for a unit acceleration e along each axis, at the first ``n`` nodes, shape (dim, n, dim), kg."""
        weight = self._scattered([batch.mass.sum(axis=1) for batch in self.batches], n)
        return np.eye(self.dim)[:, None, :] * weight[None, :, None]

    def _scattered(self, tables: list[np.ndarray], n: int) -> np.ndarray:
        total = np.zeros(n)
        for batch, table in zip(self.batches, tables, strict=True):
            share = np.outer(batch.volume, table).ravel()
            total += np.bincount(batch.cells.ravel(), weights=share, minlength=n)[:n]
        return total

    # ---- energies ---------------------------------------------------------------------------------------------

    def _counted(self, counted: np.ndarray) -> list[tuple[_Batch, np.ndarray]]:
        """Return each batch with the volumes of its elements, zero where they are not counted."""
        ends = np.cumsum([len(batch.cells) for batch in self.batches])
        each = np.split(counted, ends[:-1])
        return [(b, np.where(chosen, b.volume, 0.0)) for b, chosen in zip(self.batches, each, strict=True)]

    def energies(self, d: np.ndarray, u: np.ndarray, counted: np.ndarray) -> tuple[float, float]:
        """Return the kinetic and elastic energy of the counted elements, J. Not collective."""
        kinetic = elastic = 0.0
        for batch, volume in self._counted(counted):
            for part in batch.parts():
                W = batch.respond(d, part, tangent=False)[0].reshape(-1, len(batch.rule.weights))
                chosen = volume[part] > 0
                elastic += float(volume[part][chosen] @ (W[chosen] @ batch.rule.weights))
            kinetic += 0.5 * batch.mass_product(volume, u, u)
        return kinetic, elastic

    def damping(self, d: np.ndarray, w: np.ndarray, counted: np.ndarray) -> float:
        """Return what damping takes from the counted elements, w . (a0 M + a1 K'(d)) w, W. Not collective.

        Parameters
        ----------
        d, w : ndarray, shape (n, dim)
            Where the tangent is taken, m, and velocities, m/s, at all local nodes.
        counted : ndarray of bool, shape (n_elements,)
            Group after group.
        """
        total = 0.0
        for batch, volume in self._counted(counted):
            a0, a1 = self.bodies.mass_damping[batch.body], self.bodies.stiffness_damping[batch.body]
            if a0:
                total += a0 * batch.mass_product(volume, w, w)
            for part in batch.parts() if a1 else ():
                C = batch.respond(d, part)[2]
                weights = np.outer(volume[part], batch.rule.weights).ravel()
                rate = batch.gradients(w, part)
                stress = np.zeros_like(rate)
                batch.loops.contract(C, rate, stress)
                total += a1 * float(weights @ (stress * rate).sum(axis=(1, 2)))
        return total

    def smallest_ratios(self, d: np.ndarray) -> np.ndarray:
        """Return the smallest det F of each body at this rank's quadrature points, infinite where it has none."""
        least = np.full(len(self.bodies.density), np.inf)
        for batch in self.batches:
            for part in batch.parts():
                least[batch.body] = min(least[batch.body], smallest_volume_ratio(batch.gradients(d, part)))
        return least
