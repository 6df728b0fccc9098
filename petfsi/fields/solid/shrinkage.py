"""How much the middle of a rotation shrinks a body, and when that makes the midpoint rule gain energy."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.rotations import Gradients

#: Above this part of the kinetic energy the midpoint rule gains more than some percent of energy a turn. Of a disk
#: (E from 1e3 to 1e7 Pa, 0.01 to 0.25 rad a step): 0.6% at 1e-3, 1 to 2% at 3e-3 to 5e-3, 7 to 20% at 1e-2; beyond 3e-2
#: it blows up.
MOST = 2e-3


class Shrinkage:
    """Measures what energy the straight way through a rotation would store in bodies, against their kinetic energy.

    Half-way on a straight line, what turns by theta is smaller by cos(theta/2), 1 - theta^2/8: the midpoint rule takes
    the stress there, and a body that is stiff against it does work that no motion of it should. Of an element that is
    2 (lambda + mu) (theta^2/8)^2 V, of a segment of a beam EA/2 (theta^2/8)^2 L.

    References
    ----------
    J. C. Simo, N. Tarnow, The discrete energy-momentum method, ZAMP 43 (1992).

    Parameters
    ----------
    comm : MPI.Comm
    mesh : LocalMesh
    parts : ndarray of int, shape (ne, n)
        Local nodes of the simplices, or segments, that turn.
    body : ndarray of int, shape (ne,)
    modulus : ndarray, shape (n_bodies,)
        2 (lambda + mu), Pa; of beams EA/2, N.
    mass : ndarray, shape (n_owned, dim)
        kg.
    node_body : ndarray of int, shape (n_owned,)
    """

    def __init__(
        self, comm: MPI.Comm, mesh: LocalMesh, parts: np.ndarray, body: np.ndarray, modulus: np.ndarray,
        mass: np.ndarray, node_body: np.ndarray,
    ) -> None:  # fmt: skip
        self._comm, self._mass, self._node_body = comm, mass, node_body
        self._gradients, self._body, self._n = Gradients(mesh.points, parts), body, len(modulus)
        # a part is counted where its first node is at home
        counted = parts[:, 0] < mesh.n_owned
        self._stiffness = np.where(counted, modulus[body] * self._gradients.size, 0.0)
        self._told: set[str] = set()

    @property
    def watches(self) -> bool:
        """Whether there is a body that was not remarked on yet."""
        return len(self._told) < self._n

    def remark(self, names: list[str], d: np.ndarray, u: np.ndarray, dt: float) -> str | None:
        """Return which bodies turn too far in a step, each once; arguments as of ``measure``. Collective."""
        found = []
        for name, ratio, angle in zip(names, *self.measure(d, u, dt), strict=True):
            if ratio > MOST and name not in self._told:
                self._told.add(name)
                found.append(
                    f"solids.{name} turns by {angle:.2g} rad a step, too far for midpoint and so stiff a body: "
                    f"half-way it is smaller by {angle**2 / 8:.1e}, worth {ratio:.1g} of its kinetic energy (more than "
                    f"{MOST:g}), and its energy may grow without bound; a smaller dt or bdf2 does better"
                )
        return "; ".join(found) or None

    def measure(self, d: np.ndarray, u: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return of each body that energy over the kinetic one about its centre, and the angle of a step. Collective.

        Parameters
        ----------
        d, u : ndarray, shape (n, dim)
            At all local nodes, m and m/s.
        dt : float

        Returns
        -------
        ratio, angle : ndarray, shape (n_bodies,)
            The second is that of a step, the largest of any part, rad.
        """
        angles = dt * self._gradients.speeds(d, u)
        stored = np.bincount(self._body, self._stiffness * (angles**2 / 8) ** 2, minlength=self._n)
        largest = np.zeros(self._n)
        np.maximum.at(largest, self._body, angles)
        own, dim = u[: len(self._mass)], u.shape[1]
        sums = [stored]
        for a in range(dim):
            for power in range(3):
                sums.append(np.bincount(self._node_body, self._mass[:, a] * own[:, a] ** power, minlength=self._n))
        total = np.empty((len(sums), self._n))
        self._comm.Allreduce(np.array(sums), total)
        self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        mass, momentum, square = total[1::3], total[2::3], total[3::3]
        kinetic = 0.5 * np.sum(square - momentum**2 / mass, axis=0)
        return np.where(kinetic > 0.0, total[0] / np.where(kinetic > 0.0, kinetic, 1.0), 0.0), largest
