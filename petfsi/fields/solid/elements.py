"""Linear triangles and tetrahedra, total Lagrangian: from displacements to A, b and energies."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numba import njit

from petfsi.fields.solid.materials import Material
from petfsi.fields.solid.pattern import Pattern

#: Elements handled at a time: their tangents stay in a core's cache.
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
    mass_damping, stiffness_damping : ndarray
        Rayleigh's factors, 1/s and s.
    """

    density: np.ndarray
    lame: np.ndarray
    mu: np.ndarray
    material: list[Material]
    lumped: np.ndarray
    mass_damping: np.ndarray
    stiffness_damping: np.ndarray


@dataclass(frozen=True)
class State:
    """What a step's right-hand side is made of, at all local nodes; each of shape (n, dim).

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


class Elements:
    """Constant-strain elements of any number of bodies.

    With N_a the shape functions, g_a = grad N_a and F = I + sum_a d_a g_a^T, constant in an element of volume V,

        K_a[i] = V P[i,J] g_a[J],    K'_ab[i,k] = V g_a[J] C[i,J,k,L] g_b[L],
        M_ab = density V (1 + delta_ab) / ((dim + 1)(dim + 2))   or, lumped,   density V delta_ab / (dim + 1).

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        Reference positions, m.
    cells : ndarray of int32, shape (ne, dim + 1)
        Sorted by body.
    body : ndarray of int32, shape (ne,)
    bodies : Bodies
    """

    def __init__(self, points: np.ndarray, cells: np.ndarray, body: np.ndarray, bodies: Bodies):
        self.dim = points.shape[1]
        self.cells = cells
        self.body = body
        self.bodies = bodies
        edges = points[cells[:, 1:]] - points[cells[:, :1]]
        self.volume = np.linalg.det(edges) / (2.0 if self.dim == 2 else 6.0)
        rest = np.linalg.inv(edges).transpose(0, 2, 1)
        self.gradients = np.concatenate((-rest.sum(axis=1, keepdims=True), rest), axis=1)
        corners = self.dim + 1
        off = np.where(bodies.lumped, 0.0, 1 / (corners * (corners + 1)))
        # per body: factors of density * V on and off the diagonal of an element's mass matrix
        self.mass_factors = np.column_stack((1 / corners - off * self.dim, off))
        self._kernels = _KERNELS[self.dim]

    def chunks(self) -> list[tuple[int, int, int]]:
        """Return (begin, end, body) of runs of at most ``CHUNK`` elements of one body."""
        ends = np.searchsorted(self.body, np.arange(len(self.bodies.density) + 1))
        return [
            (k, min(k + CHUNK, int(end)), b)
            for b, (begin, end) in enumerate(zip(ends[:-1], ends[1:], strict=True))
            for k in range(int(begin), int(end), CHUNK)
        ]

    def displacement_gradients(self, d: np.ndarray, begin: int = 0, end: int | None = None) -> np.ndarray:
        """Return H = dd/dX of elements ``begin`` to ``end``, shape (count, dim, dim); ``d`` holds all local nodes."""
        return self._kernels.gradient(self.cells[begin:end], self.gradients[begin:end], d)

    def respond(self, d: np.ndarray, begin: int, end: int, body: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy density, stress and tangent of elements of one body."""
        H = self.displacement_gradients(d, begin, end)
        lame, mu = np.full(len(H), self.bodies.lame[body]), np.full(len(H), self.bodies.mu[body])
        return self.bodies.material[body](H, lame, mu)

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
        A_M, A_K = a + self.bodies.mass_damping, k + self.bodies.stiffness_damping
        for begin, end, body in self.chunks():
            _, P, C = self.respond(at.displacement, begin, end, body)
            part = slice(begin, end)
            self._kernels.scatter(
                self.cells[part], self.gradients[part], self.volume[part], P, C,
                at.inertia, at.shift, self.bodies.density[body] * self.mass_factors[body], A_M[body], A_K[body],
                pattern.node_ptr, pattern.slots[part], values, b,
            )  # fmt: skip

    def energies(self, d: np.ndarray, u: np.ndarray, counted: np.ndarray) -> tuple[float, float]:
        """Return the kinetic and elastic energy of the counted elements, J. Not collective."""
        kinetic = elastic = 0.0
        for begin, end, body in self.chunks():
            V = np.where(counted[begin:end], self.volume[begin:end], 0.0)
            elastic += float(V @ self.respond(d, begin, end, body)[0])
            mass = self.bodies.density[body] * self.mass_factors[body]
            kinetic += 0.5 * self._kernels.mass_product(self.cells[begin:end], V, mass, u, u)
        return kinetic, elastic

    def powers(
        self, at: State, a: float, k: float, w: np.ndarray, g: np.ndarray, counted: np.ndarray
    ) -> tuple[float, float]:
        """Return two powers of a step's forces, over the counted elements, W. Not collective.

        The damping's  w . C w,  and that of the residual of A w - b without loads,

            g . (M (a w - V) + C w + K(d) + K'(d) (s + k w)) .

        Parameters
        ----------
        at : State
            d, V, s at all local nodes.
        a, k : float
            1/s, s.
        w, g : ndarray, shape (n, dim)
            The solution, and any other velocity, m/s.
        counted : ndarray of bool, shape (ne,)
        """
        damping = power = 0.0
        for begin, end, body in self.chunks():
            part = slice(begin, end)
            _, P, C = self.respond(at.displacement, begin, end, body)
            lost, done = self._kernels.powers(
                self.cells[part], self.gradients[part], np.where(counted[part], self.volume[part], 0.0), P, C,
                at.inertia, at.shift, w, g, self.bodies.density[body] * self.mass_factors[body], (a, k),
                (self.bodies.mass_damping[body], self.bodies.stiffness_damping[body]),
            )  # fmt: skip
            damping, power = damping + lost, power + done
        return damping, power

    @property
    def constant(self):
        from petfsi.fields.solid.materials import MATERIALS

        return all(m is MATERIALS["linear"] for m in self.bodies.material)

    def lumped_mass(self, n):
        return np.repeat(self.uniform_load(n)[0][:, :1], self.dim, axis=1)

    def forces(self, at, b):
        f = np.zeros_like(at.displacement)
        for begin, end, body in self.chunks():
            _, P, C = self.respond(at.displacement, begin, end, body)
            if at.shift.any():
                P = P + np.einsum("eiJkL,ekL->eiJ", C, self.displacement_gradients(at.shift, begin, end))
            g = self.volume[begin:end, None, None] * np.einsum("eiJ,eaJ->eai", P, self.gradients[begin:end])
            np.subtract.at(f, self.cells[begin:end], g)
        b[:] = f[: len(b)]

    def stiffest(self, d, mass):
        most = 0.0
        nc = self.dim + 1
        for begin, end, body in self.chunks():
            _, P, C = self.respond(d, begin, end, body)
            G = self.gradients[begin:end]
            K = np.einsum("e,eaJ,eiJkL,ebL->eaibk", self.volume[begin:end], G, C, G).reshape(
                end - begin, nc * self.dim, -1
            )
            m = self.bodies.density[body] * self.volume[begin:end] / nc
            most = max(most, float((np.linalg.eigvalsh(K)[:, -1] / m).max()))
        return most

    def uniform_load(self, n: int) -> np.ndarray:
        """Return M e for a unit acceleration e along each axis, at the first ``n`` nodes, shape (dim, n, dim), kg."""
        share = np.repeat(self.bodies.density[self.body] * self.volume / (self.dim + 1), self.dim + 1)
        mass = np.bincount(self.cells.ravel(), weights=share, minlength=n)[:n]
        return np.eye(self.dim)[:, None, :] * mass[:, None]


def _compile(dim: int) -> SimpleNamespace:
    # dim as a constant of the closure lets the compiler unroll the loops over axes and corners

    @njit(cache=True)
    def gradient(cells, gradients, d):
        H = np.empty((cells.shape[0], dim, dim))
        for e in range(cells.shape[0]):
            for i in range(dim):
                for J in range(dim):
                    H[e, i, J] = 0.0
                    for a in range(dim + 1):
                        H[e, i, J] += d[cells[e, a], i] * gradients[e, a, J]
        return H

    @njit(cache=True)
    def scatter(cells, gradients, volume, P, C, inertia, shift, mass, A_M, A_K, node_ptr, slots, values, b):
        Cg = np.empty((dim, dim, dim))
        for e in range(cells.shape[0]):
            V = volume[e]
            for q in range(dim + 1):
                column = cells[e, q]
                for i in range(dim):
                    for J in range(dim):
                        for k in range(dim):
                            s = 0.0
                            for L in range(dim):
                                s += C[e, i, J, k, L] * gradients[e, q, L]
                            Cg[i, J, k] = V * s
                for a in range(dim + 1):
                    row = cells[e, a]
                    slot = slots[e, a, q]
                    if slot < 0:
                        continue
                    begin = node_ptr[row]
                    width = dim * (node_ptr[row + 1] - begin)
                    start = dim * (dim * begin + slot - begin)
                    m = V * (mass[0] if a == q else mass[1])
                    for i in range(dim):
                        for k in range(dim):
                            stiffness = 0.0
                            for J in range(dim):
                                stiffness += gradients[e, a, J] * Cg[i, J, k]
                            entry = A_K * stiffness
                            load = -stiffness * shift[column, k]
                            if i == k:
                                entry += A_M * m
                                load += m * inertia[column, k]
                            values[start + i * width + k] += entry
                            b[row, i] += load
                        if a == q:
                            for J in range(dim):
                                b[row, i] -= V * P[e, i, J] * gradients[e, a, J]

    @njit(cache=True)
    def mass_product(cells, volume, mass, u, v):
        total = 0.0
        for e in range(cells.shape[0]):
            for i in range(dim):
                same = sum_u = sum_v = 0.0
                for a in range(dim + 1):
                    same += u[cells[e, a], i] * v[cells[e, a], i]
                    sum_u += u[cells[e, a], i]
                    sum_v += v[cells[e, a], i]
                total += volume[e] * ((mass[0] - mass[1]) * same + mass[1] * sum_u * sum_v)
        return total

    @njit(cache=True)
    def powers(cells, gradients, volume, P, C, inertia, shift, w, g, mass, factors, damping):
        (a, k), (a0, a1) = factors, damping
        lost = a0 * mass_product(cells, volume, mass, w, w)
        done = (a + a0) * mass_product(cells, volume, mass, g, w) - mass_product(cells, volume, mass, g, inertia)
        slope_w, slope_s, slope_g = np.empty((dim, dim)), np.empty((dim, dim)), np.empty((dim, dim))
        for e in range(cells.shape[0]):
            for i in range(dim):
                for J in range(dim):
                    slope_w[i, J] = slope_s[i, J] = slope_g[i, J] = 0.0
                    for q in range(dim + 1):
                        slope_w[i, J] += w[cells[e, q], i] * gradients[e, q, J]
                        slope_s[i, J] += shift[cells[e, q], i] * gradients[e, q, J]
                        slope_g[i, J] += g[cells[e, q], i] * gradients[e, q, J]
            for i in range(dim):
                for J in range(dim):
                    rate = moved = 0.0
                    for m in range(dim):
                        for L in range(dim):
                            rate += C[e, i, J, m, L] * slope_w[m, L]
                            moved += C[e, i, J, m, L] * slope_s[m, L]
                    lost += volume[e] * a1 * rate * slope_w[i, J]
                    done += volume[e] * (P[e, i, J] + moved + (k + a1) * rate) * slope_g[i, J]
        return lost, done

    return SimpleNamespace(gradient=gradient, scatter=scatter, mass_product=mass_product, powers=powers)


_KERNELS = {2: _compile(2), 3: _compile(3)}
