"""Particles and solids after Monaghan and Kos: the surface pushes away what comes near, along its normal.

With psi the distance of particle i from the surface, R = 2 s what it sees and q = psi/R < 1, the part of the surface
nearest to it (normal n, velocity v_I = sum_a w_a U_a of its points a; see ``fields.sph.facets``) does to it

    f = m_i n (k + g max(u, 0)),     u = (v_I - v_i).n,     gamma = (c/s) (1 - q)/sqrt(q),

    k = 0.01 c gamma,     g = gamma / (1 + h gamma),

and the opposite to its points, by the w_a. Momentum is kept to round-off pair by pair, its moment is not: the force
acts along n, and at the points. Within a step h of sound gamma may exceed 2/h; so g is what the particle itself answers
within the step (backward Euler), and nothing is thrown back faster than it came.

A body lighter than the particles that it meets would be thrown about by them; so f is linearised in its velocity, the
particle's own answer being eliminated. With u^ the velocity that the forces of the step saw, r the row sum_a w_a n of
the pair on the points' velocities, and zeta = gamma [u > 0] + 0.0025 h (c/s)^2 (q^-3/2 + q^-1/2),

    Z = m_i zeta / (1 + h zeta),     sum Z r^T r  in the solid's block, times u^ on the right,

and after the solve the particle gets Z r (u - u^) n more, and the points the opposite. An explicit solid has no such
block: its nodes must not be much lighter than the particles.

The force balances no pressure: still water stands 1.3 to 1.5 spacings away, where a fill had better begin.

References
----------
J. J. Monaghan, A. Kos, J. Waterway, Port, Coastal, Ocean Eng. 125 (1999), 145. The paper of this repository's first
issue, section 1: interface nodes and particles in pairs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from petfsi.couplings.points import THETA, PointForces
from petfsi.fields.base import Work
from petfsi.fields.solids import SolidField
from petfsi.fields.sph.facets import contacts
from petfsi.fields.sph.fluid import SphFluid
from petfsi.petsc import gather_triplets
from petfsi.scene import schema

#: The force at rest over that on what approaches with the speed of sound.
STILL = 0.01
#: Of particles that begin nearer than so many spacings users are told.
NEAR = 1.0


class RepulsionTransfer(PointForces):
    """Repulsion between particles and the surface of a solid: a part of the solid's block, none off the diagonal.

    Parameters
    ----------
    fluid : SphFluid
    solid : SolidField
    spec : schema.Coupling

    Attributes
    ----------
    last : ndarray, shape (n_points, dim)
        Force on each point at the end of the last step, N: state.
    """

    def __init__(self, fluid: SphFluid, solid: SolidField, spec: schema.Coupling) -> None:
        self.fluid, self.solid, self.comm = fluid, solid, fluid.comm
        self.blocks: dict[tuple[str, str], PETSc.Mat] = {}
        surface, points = solid.surface(), solid.surface_present()
        fluid.clear(points, surface.facets)
        self._take(surface)
        self.last = np.zeros_like(points)
        fluid.kept["repulsion_force"] = self.last
        fluid.tallied["particles_behind"] = 0.0
        self._mean = self.last.copy()
        self._taken = 0.0
        self.theta = THETA.get(fluid.scene.time.integrator, 1.0)
        self._tell_of_near(points)

    def _tell_of_near(self, points: np.ndarray) -> None:
        """Note how many particles begin where they are pushed off at once. Collective."""
        law, swarm = self.fluid.law, self.fluid.swarm
        near = contacts(swarm, points, self.surface.facets, NEAR * law.spacing, 0.0)
        number = self.comm.allreduce(len(np.unique(near.row)))
        if number:
            self.fluid.notes.append(
                f"fluid.fill: {number} particles begin less than {NEAR * law.spacing:g} m before solids, which push "
                f"them off at once: with this transfer let the fill begin {1.5 * law.spacing:g} m away"
            )

    def couple(self, time: float, dt: float) -> None:
        """Bring the surface to where its velocity takes it in the step, and find the forces there. Collective."""
        fluid = self.fluid
        points, velocity = self._arrive(dt)
        self._velocity = velocity.ravel()
        fluid.push(time, dt)
        self._pairs = _Pairs(fluid, points, velocity, self.surface.facets, dt if fluid.is_moving else 0.0)
        self._force = self._summed(self._pairs.push(self._pairs.force))
        if not self.solid.explicit:
            product = self._stiffening(self._pairs.rows, self.theta * self._pairs.weight)
            self.solid.take_mass(gather_triplets(self.comm, self.solid.layout, product.row, product.col, product.data))

    def _summed(self, part: np.ndarray) -> np.ndarray:
        """Return the sum over ranks of forces on points, shape (n_points, dim), N; add up who is behind. Collective."""
        total = np.append(part, float(self._pairs.n_behind))
        self.comm.Allreduce(MPI.IN_PLACE, total)
        self.fluid.tallied["particles_behind"] = float(total[-1])
        return total[:-1].reshape(self.last.shape)

    def assemble(self, time: float, dt: float) -> None:
        """Add the force of the step to the solid's right-hand side, at the velocity that it saw. Collective."""
        if self.fluid.is_moving:
            self._mean = (1 - self.theta) * self.last + self.theta * self._force
        else:
            self._mean = self._force
            self.last[...] = self._force
        self.solid.rhs += self._to_unknowns @ self._mean.ravel()
        if not self.solid.explicit:
            self._add_seen(self._velocity)
        self.n_assembled += 1

    def work(self) -> Work:
        """Return what supports did against the mean force on what they hold, along its way, and what pairs took.

        ``damping`` is what both sides of the pairs lost: with it what they store, which comes back.
        """
        return Work(
            boundary=-float(self.solid.moved @ (self._to_held @ self._mean.ravel())),
            damping=self._taken,
        )

    def accept(self, values: Mapping[str, np.ndarray], time: float, dt: float) -> None:
        """Give particles what the new velocity changes. Collective."""
        new = self._solved(values)
        more = 0.0 if self.solid.explicit else self._pairs.weight * (self._pairs.rows @ (new - self._velocity))
        change = self._summed(self._pairs.push(more + np.zeros_like(self._pairs.force)))
        self._mean = self._mean + self.theta * change
        self.last[...] = self._force + change
        self._taken = -dt * self._pairs.power(self._pairs.force + more, dt)
        if not self.comm.rank:
            self._taken -= dt * float(self._mean.ravel() @ ((1 - self.theta) * self._velocity + self.theta * new))


class _Pairs:
    """Particles and the facets that they meet, with the force between the two.

    Attributes
    ----------
    rows : csr_matrix, shape (k, n_points * dim)
        Of each pair, what turns velocities of points into that of the surface along its normal.
    speed : ndarray, shape (k,)
        Of the particle along the normal, m/s.
    force, weight : ndarray, shape (k,)
        The push, N, and Z, kg/s; zero if no step is under way.
    n_behind : int
        So many of this rank's particles stand behind the surface.
    """

    def __init__(self, fluid: SphFluid, points: np.ndarray, velocity: np.ndarray, facets: np.ndarray, dt: float):
        law, swarm, reach = fluid.law, fluid.swarm, fluid.room.reach
        found = contacts(swarm, points, facets, reach, fluid.room.near)
        self._swarm, self._row, self._normal, self.n_behind = swarm, found.row, found.normal, found.n_behind
        dim = fluid.dim
        columns = dim * facets[found.facet][:, :, None] + np.arange(dim)
        entries = found.weight[:, :, None] * found.normal[:, None, :]
        indptr = np.arange(len(found.row) + 1) * dim * dim
        self.rows = csr_matrix((entries.ravel(), columns.ravel(), indptr), shape=(len(found.row), points.size))
        self.speed = np.sum(swarm["v"][found.row] * found.normal, axis=1)
        approach = self.rows @ velocity.ravel() - self.speed
        m = swarm["m"][found.row]
        accelerations = repulsion(found.q, approach, found.share, law.c, law.s, dt)
        self.force, self.weight = (m * part for part in accelerations)

    def push(self, force: np.ndarray) -> np.ndarray:
        """Push the particles by these forces (k,), N; return what that does to points, flat, this rank's share."""
        a = force / self._swarm["m"][self._row]
        np.add.at(self._swarm["a"], self._row, a[:, None] * self._normal)
        return -(self.rows.T @ force)

    def power(self, force: np.ndarray, dt: float) -> float:
        """Return what these forces (k,) do to particles, with all that has been found of their acceleration, W."""
        kick = np.sum(self._swarm["a"][self._row] * self._normal, axis=1)
        return float(force @ (self.speed + dt / 2 * kick))


def repulsion(
    q: np.ndarray, approach: np.ndarray, share: np.ndarray | float, c: float, s: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the acceleration of particles by a surface (m/s^2), and how it grows with the surface's velocity (1/s).

    Parameters
    ----------
    q : ndarray, shape (k,)
        Distance over 2 s, positive, at most 1.
    approach : ndarray, shape (k,)
        u, m/s.
    share : ndarray, shape (k,), or float
        How much of each pair counts.
    c, s, dt : float
        Sound speed, m/s, smoothing length, m, and step, s; with none the second is zero.
    """
    gamma = share * c / s * (1 - q) / np.sqrt(q)
    a = STILL * c * gamma + gamma / (1 + dt * gamma) * np.maximum(approach, 0.0)
    stiffness = share * STILL / 4 * (c / s) ** 2 * (q**-1.5 + q**-0.5)
    zeta = np.where(approach > 0, gamma, 0.0) + dt * stiffness
    return a, zeta / (1 + dt * zeta) * (dt > 0)
