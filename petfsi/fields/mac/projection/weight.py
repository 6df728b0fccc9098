"""Gravity without spurious currents: the pressure of a fluid at rest is split off and integrated exactly.

With x_0 the upper corner of the grid, p = p' + rho g . (x - x_0). Gravity then drives nothing inside the fluid; it
acts through open sides, where p means p' = p - rho g . (x - x_0) (p itself is what ``open_sides`` adds), and through
walls, where the force of the second part is an exact integral over facets. A fluid at rest has p' constant, whatever
cuts the grid, and buoyancy is that of the volume which the surface encloses.
"""

from __future__ import annotations

import numpy as np

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.scene.expressions import Expression


class Weight:
    """The pressure of a fluid at rest.

    Parameters
    ----------
    grid : MacGrid
    density : float
        kg/m^3.
    gravity : list of Expression
        m/s^2 by axis, of t.

    Attributes
    ----------
    gradient : ndarray, shape (dim,)
        rho g of the step, Pa/m.
    origin : ndarray, shape (dim,)
        x_0, m.
    """

    def __init__(self, grid: MacGrid, density: float, gravity: list[Expression]) -> None:
        self.grid, self.density, self._gravity = grid, density, gravity
        self.origin = grid.origin + grid.size
        self.gradient = np.zeros(grid.dim)

    def at(self, time: float) -> None:
        """Take gravity at a time; nothing bears it along a periodic axis, where it stays a force on the fluid."""
        borne = ~np.array(self.grid.periodic[: self.grid.dim])
        self.gradient = self.density * np.array([float(g(t=time)) for g in self._gravity]) * borne

    def pressure(self) -> np.ndarray:
        """Return rho g . (x - x_0) in all local cells, Pa."""
        return self.on(self.grid.coordinates(None))

    def on(self, coordinates: list[np.ndarray]) -> np.ndarray:
        """Return rho g . (x - x_0) at points by their x, y, z, which broadcast, Pa."""
        total = np.zeros(np.broadcast_shapes(*(x.shape for x in coordinates)))
        for a in range(self.grid.dim):
            total = total + self.gradient[a] * (coordinates[a] - self.origin[a])
        return total

    def push_open_sides(self, star: list[np.ndarray], duration: float) -> None:
        """Accelerate the velocity at open sides by p' there, for ``duration`` seconds, as ``OpenSides.push`` does."""
        grid = self.grid
        for a in range(grid.dim):
            for upper in (False, True):
                plane = grid.ghost[a] - grid.lo[a] + (grid.cells[a] if upper else 0)
                if grid.periodic[a] or not 0 <= plane < grid.shape(a)[a]:
                    continue
                part = tuple(slice(plane, plane + 1) if b == a else slice(None) for b in range(3))
                lines = [x[s] for x, s in zip(grid.lines(a), part, strict=True)]
                p = -self.on(list(np.meshgrid(*lines, indexing="ij", sparse=True)))
                push = (-2.0 if upper else 2.0) * duration / (self.density * grid.dx[a])
                star[a][part] += push * p
