"""The law of a weakly compressible fluid of particles: Tait's equation of state and the constants of its pairs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from petfsi.fields.sph.kernels import Kernel


@dataclass(frozen=True)
class Law:
    """What all pairs of particles share.

    Attributes
    ----------
    dim : int
        2 or 3; in the plane, kg are kg per metre of depth.
    rho0 : float
        Density at no pressure, kg/m^3.
    c : float
        Sound speed at no pressure, m/s.
    s, spacing : float
        Smoothing length and spacing dx of particles, m.
    kernel_name : str
        "wendland", "quadratic" or "cubic".
    gravity : tuple of float
        What pressure balances, m/s^2, ``dim`` numbers.
    alpha, nu, delta : float
        Artificial viscosity (1), kinematic viscosity (m^2/s), diffusion of density (1); 0 leaves the term out.
    suction : bool
        Whether walls hold back what is drawn away from them; else they answer no pressure below zero.
    """

    dim: int
    rho0: float
    c: float
    s: float
    spacing: float
    kernel_name: str = "wendland"
    gravity: tuple[float, ...] = (0.0, 0.0)
    alpha: float = 0.0
    nu: float = 0.0
    delta: float = 0.0
    suction: bool = True

    def __post_init__(self):
        if len(self.gravity) != self.dim:
            raise ValueError(f"gravity has {len(self.gravity)} components in {self.dim} dimensions")

    @cached_property
    def kernel(self) -> Kernel:
        """The kernel with its factors."""
        return Kernel(self.kernel_name, self.dim, self.s)

    @property
    def B(self) -> float:
        """Tait's modulus c^2 rho_0/7, Pa."""
        return self.c**2 * self.rho0 / 7

    def pressure(self, rho: np.ndarray) -> np.ndarray:
        """Return p = B((rho/rho_0)^7 - 1), Pa."""
        return _tait(np.ascontiguousarray(rho, dtype=float), self.rho0, self.B)

    def density(self, p: np.ndarray) -> np.ndarray:
        """Return the density (kg/m^3) at pressures above -B."""
        return self.rho0 * np.exp(np.log1p(np.asarray(p, dtype=float) / self.B) / 7)

    def elastic_energy(self, rho: np.ndarray) -> np.ndarray:
        """Return e = (B/rho_0)(y^6/6 + 1/y - 7/6), y = rho/rho_0, the work of compression from rho_0, J/kg."""
        return _energy(np.ascontiguousarray(rho, dtype=float), self.rho0, self.B)


@njit(cache=True)
def _tait(rho, rho0, B):
    """Return B(y^7 - 1) with its factor y - 1 apart, which keeps small pressures exact."""
    p = np.empty_like(rho)
    for i in range(rho.size):
        y = rho[i] / rho0
        tail = 1.0 + y * (1.0 + y * (1.0 + y * (1.0 + y * (1.0 + y * (1.0 + y)))))
        p[i] = B * ((rho[i] - rho0) / rho0) * tail
    return p


@njit(cache=True)
def _energy(rho, rho0, B):
    """Return (B/rho_0)(y - 1)^2 (y^5 + 2 y^4 + 3 y^3 + 4 y^2 + 5 y + 6)/(6 y), which is the same sum."""
    e = np.empty_like(rho)
    for i in range(rho.size):
        y, d = rho[i] / rho0, (rho[i] - rho0) / rho0
        tail = 6.0 + y * (5.0 + y * (4.0 + y * (3.0 + y * (2.0 + y))))
        e[i] = B / rho0 * d * d * tail / (6.0 * y)
    return e
