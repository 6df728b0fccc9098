"""Beam elements of any number of bodies: from displacements to A, b, masses and energies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from petfsi.fields.beam.hermite import Hermite
from petfsi.fields.beam.timoshenko import Timoshenko
from petfsi.fields.solid.elements import State
from petfsi.fields.solid.pattern import Pattern

#: The scene's ``beam.theory`` by name.
THEORIES: dict[str, type[Timoshenko] | type[Hermite]] = {"timoshenko": Timoshenko, "euler-bernoulli": Hermite}
#: Shear coefficient of a rectangular section.
SHEAR = 5 / 6
#: Unknowns of a node: u_x, u_y, theta.
WIDTH = 3


@dataclass(frozen=True)
class Sections:
    """What beams are made of, per metre of their width; arrays have one entry per body.

    Attributes
    ----------
    stiffness : ndarray, shape (n, 3)
        EA (N/m), GA (N/m) with the shear coefficient, EI (N m).
    rho_A, rho_I : ndarray
        kg/m^2, kg.
    lumped : ndarray of bool
        Whether the mass matrix is diagonal.
    mass_damping, stiffness_damping : ndarray
        Rayleigh's factors, 1/s and s.
    """

    stiffness: np.ndarray
    rho_A: np.ndarray
    rho_I: np.ndarray
    lumped: np.ndarray
    mass_damping: np.ndarray
    stiffness_damping: np.ndarray

    @classmethod
    def rectangular(
        cls,
        thickness: np.ndarray,
        young: np.ndarray,
        poisson: np.ndarray,
        density: np.ndarray,
        lumped: np.ndarray,
        damping: np.ndarray,
    ) -> Sections:
        """Return plates of a thickness h (m) that may contract across their width (plane stress).

            EA = E h,   GA = 5/6 E h / 2(1 + nu),   EI = E h^3 / 12,   rho A = rho h,   rho I = rho h^3 / 12 .

        Parameters
        ----------
        thickness, young, poisson, density : ndarray, shape (n,)
            m, Pa, 1, kg/m^3.
        lumped : ndarray of bool, shape (n,)
        damping : ndarray, shape (n, 2)
            Of mass (1/s) and stiffness (s).
        """
        second = thickness**3 / 12
        shear = SHEAR * young / (2 * (1 + poisson)) * thickness
        stiffness = np.column_stack((young * thickness, shear, young * second))
        return cls(stiffness, density * thickness, density * second, lumped, damping[:, 0], damping[:, 1])


class BeamElements:
    """Elements of one theory, their unknowns (u_x, u_y, theta) a node; all arrays hold local nodes, (n, 3).

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Reference positions, m.
    cells : ndarray of int32, shape (ne, n_nodes)
        Start and end of each element, and its middle where the theory has one.
    body : ndarray of int32, shape (ne,)
    sections : Sections
    theory : str
        Of ``THEORIES``.
    """

    constant = False

    def __init__(self, points: np.ndarray, cells: np.ndarray, body: np.ndarray, sections: Sections, theory: str):
        self.cells, self.body, self.sections = cells, body, sections
        along = points[cells[:, 1]] - points[cells[:, 0]]
        self.length = np.linalg.norm(along, axis=1)
        self.axis = along / self.length[:, None]
        self.theory = THEORIES[theory](self.length, self.axis, sections.stiffness[body])
        rho = sections.rho_A[body], sections.rho_I[body]
        self._lumped = self.theory.lumped(*rho)
        diagonal = self._lumped[:, :, None] * np.eye(self._lumped.shape[1])
        self.mass = np.where(sections.lumped[body][:, None, None], diagonal, self.theory.mass(*rho))

    def _of_elements(self, x: np.ndarray) -> np.ndarray:
        """Return nodal values by element, shape (ne, 3 * n_nodes)."""
        return np.ascontiguousarray(x)[self.cells].reshape(len(self.cells), -1)

    def _loads(self, at: State, f: np.ndarray, K: np.ndarray) -> np.ndarray:
        inertia, shift = self._of_elements(at.inertia), self._of_elements(at.shift)
        return _times(self.mass, inertia) - _times(K, shift) - f

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
        b : ndarray, shape (n_owned, 3)
            Overwritten.
        """
        _, f, K = self.theory.respond(self._of_elements(at.displacement))
        A_M, A_K = a + self.sections.mass_damping[self.body], k + self.sections.stiffness_damping[self.body]
        A = A_M[:, None, None] * self.mass + A_K[:, None, None] * K
        values[:] = 0.0
        scatter_matrices(self.cells, A, pattern.node_ptr, pattern.slots[0], values)
        self.gather(self._loads(at, f, K), b)

    def forces(self, at: State, b: np.ndarray) -> None:
        """Fill b alone, as ``assemble`` does. Not collective."""
        shifted = bool(at.shift.any())
        _, f, K = self.theory.respond(self._of_elements(at.displacement), shifted)
        inertia = _times(self.mass, self._of_elements(at.inertia))
        self.gather(self._loads(at, f, K) if shifted else inertia - f, b)

    def gather(self, loads: np.ndarray, b: np.ndarray) -> None:
        """Fill the first nodes' b with the sums of elements' loads, shape (ne, 3 * n_nodes)."""
        b[:] = 0.0
        rows = self.cells.ravel()
        mine = rows < len(b)
        np.add.at(b, rows[mine], loads.reshape(-1, WIDTH)[mine])

    def lumped_mass(self, n: int) -> np.ndarray:
        """Return the diagonal masses of the first ``n`` nodes, shape (n, 3), kg and kg m^2; all are positive."""
        m = np.empty((n, WIDTH))
        self.gather(self._lumped, m)
        return m

    def uniform_load(self, n: int) -> np.ndarray:
        """Return M e_axis of the first ``n`` nodes for unit velocities along x and y, shape (2, n, 3)."""
        loads = np.empty((2, n, WIDTH))
        for axis in range(2):
            unit = np.tile(np.eye(WIDTH)[axis], self.cells.shape[1])
            self.gather(self.mass @ unit, loads[axis])
        return loads

    def energies(self, d: np.ndarray, u: np.ndarray, counted: np.ndarray) -> tuple[float, float]:
        """Return the kinetic and elastic energy of the counted elements, J. Not collective."""
        W, _, _ = self.theory.respond(self._of_elements(d), False)
        u = self._of_elements(u)
        return float(0.5 * np.sum((u * _times(self.mass, u))[counted])), float(W[counted].sum())

    def damping(self, d: np.ndarray, w: np.ndarray, counted: np.ndarray) -> float:
        """Return what damping takes from the counted elements, w . (a0 M + a1 K'(d)) w, W. Not collective.

        Parameters
        ----------
        d, w : ndarray, shape (n, 3)
        counted : ndarray of bool, shape (ne,)
        """
        _, _, K = self.theory.respond(self._of_elements(d))
        w = self._of_elements(w)
        a0, a1 = (x[self.body][:, None] for x in (self.sections.mass_damping, self.sections.stiffness_damping))
        return float(np.sum((w * (a0 * _times(self.mass, w) + a1 * _times(K, w)))[counted]))


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the product of each matrix with its vector."""
    return np.einsum("eij,ej->ei", matrices, vectors)


@njit(cache=True)
def scatter_matrices(cells, A, node_ptr, slots, values):
    """Add matrices of elements, shape (ne, 3 n_nodes, 3 n_nodes), to the values of a pattern."""
    for e in range(cells.shape[0]):
        for p in range(cells.shape[1]):
            row = cells[e, p]
            if slots[e, p, 0] < 0:
                continue
            begin = node_ptr[row]
            width = 3 * (node_ptr[row + 1] - begin)
            for q in range(cells.shape[1]):
                start = 3 * (3 * begin + slots[e, p, q] - begin)
                for i in range(3):
                    for j in range(3):
                        values[start + i * width + j] += A[e, 3 * p + i, 3 * q + j]
