"""Particles and solids: wall particles hang on the surface, and what they feel goes to the solid's nodes.

The force on a wall particle is minus what it does to the fluid's, pair by pair, and goes to the points of its facet and
on to the unknowns by the transpose of the maps that give their velocities: momentum is kept to round-off, and the
surface's forces do no work that the fluid does not lose.

An explicit fluid answers a wall's velocity with the impedance of sound: coupled explicitly, a wall lighter than half
the mass that sound reaches in a step blows up. So the force is linearised in the wall's velocity. With u^ the velocity
that the densities of the step saw and E_i = sum_d m_d F r_id lambda_d the row of particle i,

    delta p_i = -h c_i^2 E_i (u - u^),        K_w = 2 h sum_i (m_i c_i^2 / rho_i^2) E_i^T E_i,

With ``bdf2`` and the mean forces m of steps, r the ratio of their lengths, the solid gets

    F = (1 + 2 r)/(1 + r) m^{n+1} - r/(1 + r) m^n,

which gives it h m in each, as particles get: that, too, keeps momentum to round-off.

K_w u stands in the solid's block and K_w u^ on the right, and after the solve the particles take their share of the
same pairs: delta rho_i = delta p_i / c_i^2 and the force that goes with it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from petfsi.couplings.drag import Drag
from petfsi.couplings.points import THETA, PointForces
from petfsi.fields.base import Work
from petfsi.fields.solids import SolidField
from petfsi.fields.sph.fluid import SphFluid
from petfsi.petsc import gather_triplets
from petfsi.scene import schema


class PressureTransfer(PointForces):
    """Pressure (and drag) of wall particles on a solid: K_w in its block, and off the diagonal what ``drag`` says.

    Parameters
    ----------
    fluid : SphFluid
    solid : SolidField
    spec : schema.Coupling
    """

    def __init__(self, fluid: SphFluid, solid: SolidField, spec: schema.Coupling) -> None:
        self.fluid, self.solid, self.comm = fluid, solid, fluid.comm
        surface = solid.surface()
        self.skin = fluid.immerse(solid.surface_present(), surface.facets)
        self.drag = Drag(fluid, solid, fluid.viscous) if fluid.viscous is not None else None
        self.blocks: dict[tuple[str, str], PETSc.Mat] = {} if self.drag is None else self.drag.blocks
        self._take(surface)
        self._mean = self.skin.last
        self.theta = MEAN.get(fluid.scene.time.integrator, 1.0)
        self._is_bdf2 = fluid.scene.time.integrator == "bdf2"
        # the last step's length, and the mean force in it
        self._before = np.zeros(1 + self.skin.last.size)
        if self._is_bdf2:
            fluid.kept["mean_force"] = self._before
        self._lead, self._lag = 1.0, np.zeros_like(self.skin.last)

    def couple(self, time: float, dt: float) -> None:
        """Bring the surface to where its velocity takes it in the step, and find the forces there. Collective."""
        self.skin.place(*self._arrive(dt))
        self.fluid.push(time, dt)
        # an explicit solid's block is diagonal: its step is short, and it goes without
        self._lead, self._lag = 1.0, np.zeros_like(self.skin.last)
        if self._is_bdf2 and self.fluid.is_moving and self._before[0] > 0.0:
            ratio = dt / self._before[0]
            self._lead = (1 + 2 * ratio) / (1 + ratio)
            self._lag = ratio / (1 + ratio) * self._before[1:].reshape(self._lag.shape)
        answers = self.fluid.is_moving and not self.solid.explicit
        self._answer = _Answer(self.fluid, dt if answers else 0.0)
        self.solid.take_mass(None if self.solid.explicit else self._added())

    def _added(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return this rank's rows of K_w, as far as it counts in this step, and of the drag's. Collective."""
        product = self._stiffening(self._answer.rows, self._lead * self.theta * self._answer.weight)
        i, j, values = product.row, product.col, product.data
        if self.drag is not None:
            parts = zip((i, j, values), self.drag.weigh(self.surface), strict=True)
            i, j, values = (np.concatenate(part) for part in parts)
        return gather_triplets(self.comm, self.solid.layout, i, j, values)

    def assemble(self, time: float, dt: float) -> None:
        """Add the force of the step to the solid's right-hand side, at the velocity that densities saw. Collective."""
        force = self.skin.to_points(self.skin.force)
        if self.fluid.is_moving:
            self._mean = (1 - self.theta) * self.skin.last + self.theta * force + self.skin.impulse / dt
        else:
            self._mean = self.skin.last = force
        self.solid.rhs += self._to_unknowns @ (self._lead * self._mean - self._lag).ravel()
        self.n_assembled += 1
        if self.solid.explicit:
            return
        self._add_seen(self.skin.velocity.ravel())
        if self.drag is not None:
            self.pattern_version += self.drag.assemble()
            self.blocks = self.drag.blocks

    def work(self) -> Work:
        """Return what supports did against the mean force on what they hold, along its way."""
        if not self.surface.fixed_map.nnz:
            return Work()
        force = self._mean + self.skin.to_points(self.skin.drag)
        return Work(boundary=-float(self.solid.moved @ (self._to_held @ force.ravel())))

    def accept(self, values: Mapping[str, np.ndarray], time: float, dt: float) -> None:
        """Give particles what the new velocity changes, and tell the fluid where the surface is. Collective."""
        new = self._solved(values)
        change = self._answer.give_back(new - self.skin.velocity.ravel())
        total = np.empty_like(change)
        self.comm.Allreduce(change, total)
        total = total.reshape(-1, self.fluid.dim)
        self._mean = self._mean + self.theta * total
        self._before[0], self._before[1:] = dt, self._mean.ravel()
        self.skin.solution = new.reshape(-1, self.fluid.dim)
        self.skin.last = self.skin.to_points(self.skin.force) + total
        self.restored()

    def restored(self) -> None:
        """Tell the fluid where the surface is, and how it moves."""
        self.skin.place(self.solid.surface_present(), self.solid.surface_velocity())


#: Here bdf2 has halves, too: its force is put together from the means of two steps, as its momentum is from three.
MEAN = THETA | {"bdf2": 0.5}


class _Answer:
    """What the pressure of the particles near a surface answers to its velocity.

    Attributes
    ----------
    rows : csr_matrix, shape (n, n_points * dim)
        E_i of this rank's particles near it, kg/m^2 (by point and axis).
    weight : ndarray, shape (n,)
        2 h m_i c_i^2 / rho_i^2.
    """

    def __init__(self, fluid: SphFluid, dt: float) -> None:
        self.fluid, skin, swarm, law = fluid, fluid.skin, fluid.swarm, fluid.law
        assert skin is not None
        start, other = skin.met.pairs
        here = np.flatnonzero((np.diff(start) > 0) & swarm.owned)
        wall, density = skin.met.rows, skin.met.density
        assert density is not None
        number = np.diff(start)[here]
        first = np.concatenate(([0], np.cumsum(number)))
        use = np.arange(first[-1]) - np.repeat(first[:-1], number) + np.repeat(start[here], number)
        d, i = other[use], np.repeat(here, number)
        r = swarm["x"][i] - wall.x[d]
        _, slope = law.kernel.values(np.sqrt(np.sum(r**2, axis=1)))
        seen = np.ones(len(use)) if skin.met.seen is None else skin.met.seen[use]
        pull = (density[d] * wall.volume[d] * slope * seen)[:, None] * r
        self.here, self._sum = here, np.add.reduceat(pull, first[:-1]) if len(here) else np.zeros((0, fluid.dim))
        corners, weights = skin.facets[skin.facet[skin.rows[d]]], skin.weights[skin.rows[d]]
        dim = fluid.dim
        columns = dim * corners[:, :, None] + np.arange(dim)
        values = weights[:, :, None] * pull[:, None, :]
        indptr = first * dim * dim
        shape = len(here), skin.points.size
        self.rows = csr_matrix((values.ravel(), columns.ravel(), indptr), shape=shape)
        self.rows.sum_duplicates()
        rho, m = swarm["rho"][here], swarm["m"][here]
        self._square = law.c**2 * (rho / law.rho0) ** 6
        self.weight = 2 * dt * m * self._square / rho**2
        self._dt = dt

    def give_back(self, change: np.ndarray) -> np.ndarray:
        """Let particles feel that the points' velocity is another; return what their forces on the points are more.

        Parameters
        ----------
        change : ndarray, shape (n_points * dim,)
            m/s.

        Returns
        -------
        ndarray, shape (n_points * dim,)
            This rank's share, N.
        """
        swarm, here = self.fluid.swarm, self.here
        rise = -self._dt * self._square * (self.rows @ change)
        rho, m = swarm["rho"][here], swarm["m"][here]
        swarm["a"][here] -= (2 * rise / rho**2)[:, None] * self._sum
        part = self.rows.T @ (2 * m * rise / rho**2)
        swarm["rho"][here] += rise / self._square
        return part
