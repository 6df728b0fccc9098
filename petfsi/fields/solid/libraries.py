"""What the elements and the loads of a nodal solid offer."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from petfsi.fields.solid.elements import State
from petfsi.fields.solid.pattern import Pattern


class ElementLibrary(Protocol):
    """What a solid's elements offer; arrays are over all local nodes, shape (n, width), but for ``b`` (owned ones)."""

    @property
    def constant(self) -> bool:
        """Whether K' never changes."""
        ...

    def assemble(self, at: State, a: float, k: float, pattern: Pattern, values: np.ndarray, b: np.ndarray) -> None:
        """Fill A's values and b with  (a + a0) M + (k + a1) K'(d)  and  M V - K'(d) s - K(d). Not collective."""
        ...

    def forces(self, at: State, b: np.ndarray) -> None:
        """Fill b alone, without a matrix. Not collective."""
        ...

    def lumped_mass(self, n: int) -> np.ndarray:
        """Return the diagonal of the lumped mass at the first ``n`` nodes, shape (n, width), kg."""
        ...

    def uniform_load(self, n: int) -> np.ndarray:
        """Return M e for a unit acceleration e along each axis, at the first ``n`` nodes, shape (dim, n, width), kg."""
        ...

    def energies(self, d: np.ndarray, u: np.ndarray, counted: np.ndarray) -> tuple[float, float]:
        """Return the kinetic and elastic energy of the counted elements, J. Not collective."""
        ...

    def damping(self, d: np.ndarray, w: np.ndarray, counted: np.ndarray) -> float:
        """Return what damping takes, w . C w, W. Not collective."""
        ...


class LoadLibrary(Protocol):
    """What a solid's loads offer; arrays as of ``ElementLibrary``."""

    @property
    def follow(self) -> bool:
        """Whether any of them depends on the displacement."""
        ...

    def assemble(self, time: float, at: State, k: float, values: np.ndarray | None, b: np.ndarray) -> None:
        """Add  f(d~) + f' s  to b and  -k f'  to A's values, where forces depend on d. Collective."""
        ...

    def start(self, d: np.ndarray) -> np.ndarray:
        """Return the forces at time zero on nodes that are displaced so, at the owned ones, N. Collective."""
        ...

    def felt(self, w: np.ndarray) -> np.ndarray:
        """Return the forces of the step last assembled for its solution, at the owned nodes, N. Not collective."""
        ...
