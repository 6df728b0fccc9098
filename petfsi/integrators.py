"""Time integrators of solids: what turns M, C, K, K' and history into A and b."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np


@dataclass(frozen=True)
class Coefficients:
    """The factors of one step, per body or scalar:  A = A_M M + A_K K',  b = b_M M u - b_K K' u - K(d) + f_e.

    Attributes
    ----------
    A_M, b_M : ndarray or float
        1/s.
    A_K, b_K : ndarray or float
        s.
    """

    A_M: np.ndarray | float
    A_K: np.ndarray | float
    b_M: np.ndarray | float
    b_K: np.ndarray | float


class Integrator(Protocol):
    """What a scheme offers."""

    @property
    def order(self) -> int:
        """The order of accuracy in the time step that it keeps."""
        ...

    def coefficients(self, dt: float, mass_damping: np.ndarray, stiffness_damping: np.ndarray) -> Coefficients:
        """Return the factors of a step of length ``dt`` with damping C = mass_damping M + stiffness_damping K'."""
        ...

    def displacement(self, d: np.ndarray, u0: np.ndarray, u1: np.ndarray, dt: float) -> np.ndarray:
        """Return the new displacement from the old one and the old and new velocity."""
        ...


@dataclass(frozen=True)
class Newmark:
    """Newmark's scheme with beta = 1/2, gamma = 1, linearised once a step.

    With C = a0 M + a1 K', all of M, K' = dK/dd and K taken at d^n,

        (M/h + C + h/2 K') u^{n+1} - J p^{n+1} = (M/h - h/2 K') u^n - K(d^n) + f_e^{n+1},
        d^{n+1} = d^n + h/2 (u^n + u^{n+1}).

    References
    ----------
    N. Chentanez, T. G. Goktekin, B. E. Feldman, J. F. O'Brien, Simultaneous coupling of fluids and deformable
    bodies (2006), eqs. 4, 5 and 12-18.
    """

    order: ClassVar[int] = 1

    def coefficients(self, dt: float, mass_damping: np.ndarray, stiffness_damping: np.ndarray) -> Coefficients:
        """Return the factors of eq. 18."""
        return Coefficients(A_M=1 / dt + mass_damping, A_K=dt / 2 + stiffness_damping, b_M=1 / dt, b_K=dt / 2)

    def displacement(self, d: np.ndarray, u0: np.ndarray, u1: np.ndarray, dt: float) -> np.ndarray:
        """Return d^{n+1} of eq. 12."""
        return d + dt / 2 * (u0 + u1)


#: The scene's ``time.integrator`` by name.
INTEGRATORS: dict[str, type[Integrator]] = {"newmark": Newmark}
