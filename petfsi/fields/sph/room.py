"""The box that holds the particles and its sides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.sph.cells import CellGrid, cell_grid
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.geometry.shapes import inside
from petfsi.scene import fluids
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import InflowSide, at_rest

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
    sides : list of pairs of str or InflowSide
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
    sides: list[tuple[str | InflowSide, str | InflowSide]]
    grid: CellGrid
    reach: float
    near: float
    wide: float
    spacing: float
    shifting: bool

    @classmethod
    def of(cls, scene: Scene, law: Law) -> Room:
        """Return the room of a scene."""
        fluid = scene.fluid
        assert isinstance(fluid, fluids.SphFluid)
        low = np.array(fluid.origin, dtype=float)
        high = low + fluid.size
        forms = [[at_rest(getattr(fluid.sides, side)) for side in pair] for pair in OPPOSITE[: scene.dim]]
        sides = [(lower, upper) for lower, upper in forms]
        periodic = np.array([pair == ("periodic", "periodic") for pair in sides])
        reach = 2.0 * law.s
        margin = np.where(periodic, 0.0, MARGIN * reach)
        wide = WIDE[scene.dim] * reach
        fits = not np.any((high - low)[periodic] < reach + wide)
        settled = not scene.solids and not any(isinstance(side, InflowSide) for pair in sides for side in pair)
        near, wide = (NEAR * reach, wide) if fits and settled else (NARROW * reach, NARROW * reach)
        grid = cell_grid(low - margin, high + margin, reach + wide, periodic)
        return cls(low, high, sides, grid, reach, near, wide, fluid.spacing, fluid.shifting)

    @property
    def is_open(self) -> bool:
        """Whether something may leave through a side."""
        return any("open" in (side, _rest(side)) for pair in self.sides for side in pair)

    def beyond_open(self, x: np.ndarray, before: float = 0.0) -> np.ndarray:
        """Return which places x (n, dim) are beyond an open side, or less than ``before`` (m) before it."""
        return self._beyond(x, ("open",), -before)

    def beyond_inflow(self, x: np.ndarray) -> np.ndarray:
        """Return which places x (n, dim) are beyond an inflow, and beyond no open side."""
        out = self._beyond(x, ("inflow",), 0.0)
        return out & ~self.beyond_open(x) if self.is_open and out.any() else out

    def has_left(self, x: np.ndarray) -> np.ndarray:
        """Return which places x (n, dim) are beyond an open side, and not seen from inside or beyond the rim of a wall.

        What falls past a rim would else be behind the wall.
        """
        out = self.beyond_open(x)
        way = np.where(self.grid.periodic, 0.0, x - np.clip(x, self.low, self.high))
        return out & ((np.sum(way**2, axis=1) > self.reach**2) | self._beyond(x, ("slip", "no-slip"), 0.0))

    def _beyond(self, x: np.ndarray, kinds: tuple[str, ...], by: float) -> np.ndarray:
        out = np.zeros(len(x), dtype=bool)
        for axis, outward, plane, side in self._planes():
            if not isinstance(side, InflowSide):
                if side in kinds:
                    out |= outward * (x[:, axis] - plane) > by
                continue
            past = np.flatnonzero(outward * (x[:, axis] - plane) > by)
            let_in = np.ones(len(past), dtype=bool)
            if side.inflow.region is not None:
                let_in = inside(side.inflow.region, np.clip(x[past], self.low, self.high))
            out[past] |= np.where(let_in, "inflow" in kinds, side.inflow.rest in kinds)
        return out

    def _planes(self) -> Iterator[tuple[int, float, float, str | InflowSide]]:
        """Yield the axis, the sense of the way out, the coordinate and the form of each side."""
        for axis, pair in enumerate(self.sides):
            yield axis, -1.0, self.low[axis], pair[0]
            yield axis, 1.0, self.high[axis], pair[1]

    def behind_wall(self, x: np.ndarray, by: float) -> np.ndarray:
        """Return which places x (n, dim) are farther than ``by`` (m) behind a wall of the box."""
        # what has left through an open side may be anywhere
        return self._beyond(x, ("slip", "no-slip"), by) & ~self.beyond_open(x)

    def check(self, comm: MPI.Comm, swarm: Swarm) -> None:
        """Raise if a particle is a spacing or more behind a wall of the box. Collective.

        Raises
        ------
        SolveError
            On all ranks.
        """
        x = swarm["x"]
        with np.errstate(invalid="ignore"):
            out = self.behind_wall(x, self.spacing) & swarm.owned
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


def _rest(side: str | InflowSide) -> str | None:
    return side.inflow.rest if isinstance(side, InflowSide) else None
