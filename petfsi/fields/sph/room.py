"""The box that holds the particles, its sides, and what becomes of those that leave it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.sph.cells import CellGrid, cell_grid
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.scene import fluids
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import OPPOSITE

#: The grid of cells goes so many reaches beyond the box: wall particles and those that leave must have a cell.
MARGIN = 2.0
#: Lists of pairs of particles reach so much farther than particles see, over that; cells, and lists of pairs with
#: walls, so much, by dimension: they last longer if that is more, and cost more. Beside solids, where a list holds only
#: while no particle has gone far, and where a period has no room for more, all are ``NARROW``.
NEAR, WIDE, NARROW = 0.1, {2: 0.25, 3: 0.1}, 0.05


@dataclass
class Room:
    """The box of a scene's fluid.

    Attributes
    ----------
    low, high : ndarray, shape (dim,)
        Its corners, m.
    sides : list of (str, str)
        What it has along each axis.
    grid : CellGrid
    reach, near, wide : float
        How far particles see, and how much farther lists of pairs reach: of particles, and of these with walls, m.
    spacing : float
        m.
    shifting : bool
    """

    low: np.ndarray
    high: np.ndarray
    sides: list[tuple[str, str]]
    grid: CellGrid
    reach: float
    near: float
    wide: float
    spacing: float
    law: Law
    shifting: bool
    _lost: float = field(default=0.0)
    n_lost: int = 0

    @classmethod
    def of(cls, scene: Scene, law: Law) -> Room:
        """Return the room of a scene."""
        fluid = scene.fluid
        assert isinstance(fluid, fluids.SphFluid)
        low = np.array(fluid.origin, dtype=float)
        high = low + fluid.size
        sides = [(getattr(fluid.sides, a), getattr(fluid.sides, b)) for a, b in OPPOSITE[: scene.dim]]
        periodic = np.array([pair == ("periodic", "periodic") for pair in sides])
        reach = 2.0 * law.s
        margin = np.where(periodic, 0.0, MARGIN * reach)
        wide = WIDE[scene.dim] * reach
        fits = not np.any((high - low)[periodic] < reach + wide)
        near, wide = (NEAR * reach, wide) if fits and not scene.solids else (NARROW * reach, NARROW * reach)
        grid = cell_grid(low - margin, high + margin, reach + wide, periodic)
        return cls(low, high, sides, grid, reach, near, wide, fluid.spacing, law, fluid.shifting)

    def _beyond(self, x: np.ndarray, kind: str, by: float) -> np.ndarray:
        """Return which places are farther than ``by`` beyond a side of a kind ("open", or any wall)."""
        out = np.zeros(len(x), dtype=bool)
        for axis, pair in enumerate(self.sides):
            for side, outward, plane in zip(pair, (-1.0, 1.0), (self.low[axis], self.high[axis]), strict=True):
                if (side == "open") == (kind == "open") and side != "periodic":
                    out |= outward * (x[:, axis] - plane) > by
        return out

    @property
    def is_open(self) -> bool:
        """Whether a side is open."""
        return any("open" in pair for pair in self.sides)

    def let_go(self, swarm: Swarm, gravity: np.ndarray, dt: float) -> None:
        """Let those beyond open sides fall freely, without pressure; what others do to them leaves through the side."""
        if self.is_open:
            gone = np.flatnonzero(self._beyond(swarm["x"], "open", 0.0))
            mine = gone[swarm.owned[gone]]
            m = swarm["m"][mine]
            power = np.sum((swarm["a"][mine] - gravity) * swarm["v"][mine], axis=1)
            self._lost += float(m @ (self.law.elastic_energy(swarm["rho"][mine]) + dt * power))
            swarm["a"][gone] = gravity
            swarm["rho"][gone] = self.law.rho0

    def release(self, swarm: Swarm) -> None:
        """Take out those that are no longer seen from inside: a reach beyond an open side."""
        if self.is_open:
            gone = self._beyond(swarm["x"], "open", self.reach) & swarm.owned
            if np.any(gone):
                m, v = swarm["m"][gone], swarm["v"][gone]
                energy = 0.5 * np.sum(v**2, axis=1) + self.law.elastic_energy(swarm["rho"][gone])
                self._lost += float(m @ energy)
                self.n_lost += int(np.count_nonzero(gone))
                swarm.remove(gone)

    def take_lost(self) -> float:
        """Return the energy of those that went since the last call, J, this rank's share."""
        lost, self._lost = self._lost, 0.0
        return lost

    def check(self, comm: MPI.Comm, swarm: Swarm) -> None:
        """Raise if a particle is a spacing or more behind a wall of the box. Collective.

        Raises
        ------
        SolveError
            On all ranks.
        """
        x = swarm["x"]
        with np.errstate(invalid="ignore"):
            # what has left through an open side may be anywhere
            out = self._beyond(x, "wall", self.spacing) & ~self._beyond(x, "open", 0.0) & swarm.owned
        worst = int(swarm["id"][out].min(initial=np.iinfo(np.int64).max))
        first = comm.allreduce(worst, MPI.MIN)
        if first == np.iinfo(np.int64).max:
            return
        places = comm.allgather(x[out & (swarm["id"] == first)])
        at = ", ".join(f"{c:g}" for c in np.concatenate(places)[0])
        raise SolveError(
            f"particle {first} has gone through a wall: it is at ({at}), a spacing or more outside of the box; a "
            f"shorter time.dt, a larger fluid.sound_speed or a smaller fluid.spacing may help"
        )
