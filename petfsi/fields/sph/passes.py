"""Passes over pairs of particles: rates of density, wall pressures, forces.

With r = x_i - x_j, v_ij = v_i - v_j, V = m/rho, F = W'(r)/r and L(p, rho) = p/rho^2, sums over j or wall rows d,

    D_i  = rho_i sum V_j F v_ij.r  -  2 delta s c sum_fluid V_j F (rho_j - rho_i - rho_0 g.(x_j - x_i)/c^2)
    f_ij = -m_i m_j (L_i + L_j + Pi_ij) F r - c_ij v_ij                     force on i, N; its opposite is on j
    Pi_ij = -alpha c s min(0, v_ij.r) / (rho_mean (r^2 + 0.01 s^2))         between fluid particles only
    c_ij = -4 nu m_i m_j F/(rho_i + rho_j) >= 0                             fluid, and walls without slip
    S_i  = sum V_j F r (1 + 0.2 (W/W(dx))^4)                                walls included
    full = -sum V_j F r^2 / dim                                             walls included; 1 inside
    p_d  = sum W (p_f + rho_f (g - a_d).(x_d - x_f)) / sum W                0 where no fluid is seen; where walls have
                                                                            no suction, p_f counts as 0 below that

Each pair is visited once and adds to both of its rows, in the order of rows. Ghost rows in between change neither the
order nor the pairs that an owned row takes part in, and the loops keep to IEEE arithmetic as written (no fastmath), so
results of owned rows do not depend on the ranks in the last bit; those of ghost rows are incomplete. Particles are
packed in rows of eight doubles, a cache line, because rows j come from all over the list.

References
----------
J. J. Monaghan, Annu. Rev. Astron. Astrophys. 30 (1992), 543: pairs, Pi. J. P. Morris, P. J. Fox, Y. Zhu, J. Comput.
Phys. 136 (1997), 214: viscosity, walls without slip. G. Fourtakas et al., Comput. Fluids 190 (2019), 346: diffusion.
S. Adami, X. Y. Hu, N. A. Adams, J. Comput. Phys. 231 (2012), 7057: wall pressure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from petfsi.fields.sph import loops
from petfsi.fields.sph.cells import Pairs
from petfsi.fields.sph.law import Law

#: Nearer than so many spacings to a wall particle, which none is that flows along a wall, a particle is pushed away at
#: least as by so much of rho c^2: spray, whose pressure may be far below zero, would be drawn through the wall.
NEAR, STOP = 0.9, 0.2


class FluidRows(NamedTuple):
    """Fluid rows: x (n, dim) m, v (n, dim) m/s, rho (n,) kg/m^dim, m (n,) kg."""

    x: np.ndarray
    v: np.ndarray
    rho: np.ndarray
    m: np.ndarray


class WallRows(NamedTuple):
    """Wall rows: x (m), v (m/s), a (m/s^2), normal (unit, into the fluid): (n_d, dim); the rest (n_d,).

    ``volume`` (m^dim); ``depth``, the distance behind the wall (m); ``no_slip``, whether the wall holds the fluid.
    """

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    volume: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    no_slip: np.ndarray


class Met(NamedTuple):
    """A set of wall rows, the pairs of fluid rows with them, and, once known, their pressure (Pa) and density.

    ``seen``, of as many entries as there are pairs, is how much of the wall row the fluid row sees, 0 to 1; without it
    all.
    """

    rows: WallRows
    pairs: Pairs
    pressure: np.ndarray | None = None
    density: np.ndarray | None = None
    seen: np.ndarray | None = None

    def parts(self) -> np.ndarray:
        """Return ``seen``, or an array of nothing, as loops take it."""
        return np.empty(0) if self.seen is None else self.seen


class Rates(NamedTuple):
    """Rates of density (n,), kg/m^dim/s: all of D, and the part of it that is diffusion."""

    total: np.ndarray
    diffusive: np.ndarray


class Forces(NamedTuple):
    """What the force pass gives: incomplete in ghost rows.

    Attributes
    ----------
    f : ndarray, shape (n, dim)
        Force on each fluid row without gravity, N.
    S : ndarray, shape (n, dim)
        For shifting; s |S| is 0.74 in the first row of a plane free surface; 1/m.
    full : ndarray, shape (n,)
        How much of what a particle sees is full: 1 inside, less near free surfaces and in spray.
    dissipated : ndarray, shape (n,)
        Power lost to Pi and c, W: all of a fluid pair's at the first of its two rows, of a wall pair's at the fluid's,
        so that the sum over owned rows of all ranks counts each pair once.
    f_walls : list of ndarray, shape (n_d, dim)
        Force on each wall row of each set, N.
    """

    f: np.ndarray
    S: np.ndarray
    full: np.ndarray
    dissipated: np.ndarray
    f_walls: list[np.ndarray]


class Passes:
    """The passes for one law, compiled for its kernel and dimension, with memory that they share.

    What they return is in memory of its own. Not collective.
    """

    def __init__(self, law: Law):
        self.law = law
        which = law.dim, law.kernel.number
        self._density = loops.density_loop(*which, law.delta > 0)
        self._which = which
        self._force = loops.force_loop(*which, law.alpha > 0, law.nu > 0)
        self._rows, self._sums, self._scaled = np.empty((0, 8)), np.empty((0, 8)), np.empty(0)

    def density_rates(self, fluid: FluidRows, pairs: Pairs, *walls: Met) -> Rates:
        """Return D (n,), from the fluid's pairs and those with walls."""
        law = self.law
        n = self._pack(fluid)
        rates = Rates(np.zeros(n), np.zeros(n))
        rows = self._rows
        g = np.array([*law.gravity, 0.0][:3]) * (law.rho0 / law.c**2)
        diffusion = -2 * law.delta * law.s * law.c
        self._density(*_unsigned(pairs), rows, 1 / law.s, law.kernel.f_scale, diffusion, g, loops.LANES, *rates)
        for met in walls:
            wall = met.rows
            args = (rows, wall.x, wall.v, wall.volume, met.parts())
            add = loops.wall_density_loop(*self._which, met.seen is not None)
            add(*_unsigned(met.pairs), *args, 1 / law.s, law.kernel.f_scale, rates.total)
        return rates

    def wall_pressure(self, fluid: FluidRows, p: np.ndarray, met: Met) -> np.ndarray:
        """Return the pressure (n_d,) Pa of wall rows, from the pressure p (n,) of the fluid; not complete in ghosts."""
        law, walls = self.law, met.rows
        pressure, weight = np.zeros(walls.x.shape[0]), np.zeros(walls.x.shape[0])
        average = loops.wall_pressure_loop(*self._which, met.seen is not None)
        p = p if law.suction else np.maximum(p, 0.0)
        args = (fluid.x, fluid.rho, p, walls.x, walls.a, met.parts(), np.array(law.gravity), 1 / law.s)
        average(*_unsigned(met.pairs), *args, pressure, weight)
        return pressure

    def forces(self, fluid: FluidRows, p: np.ndarray, pairs: Pairs, *walls: Met) -> Forces:
        """Return forces, S and dissipation for pressures p (n,) of the fluid, and walls with theirs."""
        law, kernel = self.law, self.law.kernel
        n = self._pack(fluid)
        rows, sums, scaled = self._rows, self._sums, self._scaled[:n]
        loops.start_forces(p, fluid.rho, scaled, sums)
        # the fourth power of the last one's W is 0.2 (W/W(dx))^4
        constants = (1 / law.s, kernel.f_scale, 0.2**0.25 * kernel.w_scale / kernel.at(law.spacing))
        viscous = (2 * law.alpha * law.c * law.s, 0.01 * law.s**2, 4 * law.nu)
        self._force(*_unsigned(pairs), rows, scaled, *constants, *viscous, loops.LANES, sums)
        f_walls = []
        for met in walls:
            assert met.pressure is not None and met.density is not None, "walls come with their pressure and density"
            wall, f_wall = met.rows, np.zeros_like(met.rows.x)
            state = (met.pressure / met.density**2, met.density, wall.volume)
            place = (wall.x, wall.v, wall.normal, wall.depth, met.parts(), wall.no_slip)
            add = loops.wall_force_loop(*self._which, met.seen is not None)
            stop = NEAR * law.spacing, STOP * law.c**2 / law.rho0
            add(*_unsigned(met.pairs), rows, scaled, *place, *state, *constants, 4 * law.nu, *stop, sums, f_wall)
            f_walls.append(f_wall)
        f, S, dissipated, full = np.empty((n, law.dim)), np.empty((n, law.dim)), np.empty(n), np.empty(n)
        loops.unpack(sums, f, S, dissipated, full)
        return Forces(f, S, full, dissipated, f_walls)

    def _pack(self, fluid):
        """Fill the packed rows, in more memory if need be; return the number of rows."""
        n = fluid.x.shape[0]
        if self._scaled.size < n:
            more = n + n // 8
            self._rows, self._sums, self._scaled = np.empty((more, 8)), np.empty((more, 8)), np.empty(more)
        loops.pack(fluid.x, fluid.v, fluid.rho, fluid.m, self._rows)
        return n


def _unsigned(pairs):
    """Return the arrays of the list with unsigned rows, which Numba reads without a test of sign."""
    return pairs.start.view(np.uint64), pairs.other.view(np.uint32)
