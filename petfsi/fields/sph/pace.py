"""How fast particles are, how long a step may be for them, and whether sound is fast enough."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.sph import moves
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.start import limits

#: Speeds above this part of that of sound, and densities off by more than this part, are remarked on.
FAST, DENSE = 0.2, 0.05


class Pace:
    """The largest speed, acceleration and deviation of density, as last measured."""

    def __init__(self) -> None:
        self._warned = False

    def measure(self, comm: MPI.Comm, swarm: Swarm, law: Law) -> None:
        """Find them. Collective.

        Raises
        ------
        SolveError
            On all ranks, where a velocity or an acceleration is not finite.
        """
        v2, a2, low, high = moves.extremes(swarm["v"], swarm["a"], swarm["rho"], swarm.owned)
        found = np.array([np.sqrt(v2), np.sqrt(a2), max(high / law.rho0 - 1.0, 1.0 - low / law.rho0, 0.0)])
        found[np.isnan(found)] = np.inf
        comm.Allreduce(MPI.IN_PLACE, found, MPI.MAX)
        self._fastest, self._strongest, self._dense = found.tolist()
        if not np.isfinite(self._fastest + self._strongest):
            raise SolveError(
                "the particles have blown up: a velocity or an acceleration is not a finite number; a shorter time.dt "
                "or a larger fluid.sound_speed may help"
            )

    def stable_step(self, law: Law) -> float:
        """Return the smallest of the limits on the step, s."""
        return min(limits(law, self._fastest, self._strongest).values())

    def remark(self, law: Law) -> str | None:
        """Return that particles are too fast for the sound, or too dense, when they first are."""
        if self._warned:
            return None
        what = None
        if self._fastest > FAST * law.c:
            what = f"particles move at {self._fastest:.3g} m/s"
        elif self._dense > DENSE:
            what = f"the density of a particle is off by {100 * self._dense:.2g}%"
        self._warned = what is not None
        slow = f"fluid.sound_speed = {law.c:.3g} m/s is too low for that, and more makes the water stiffer"
        return f"{what}: {slow}" if what else None
