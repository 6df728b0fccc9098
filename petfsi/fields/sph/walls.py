"""Wall particles at work: where they are on the ranks, whom they meet, what they feel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from petfsi.fields.sph.balance import Boxes
from petfsi.fields.sph.cells import CellGrid, PairLists
from petfsi.fields.sph.dummies import Dummies
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.passes import FluidRows, Met, Passes, WallRows
from petfsi.fields.sph.plates import Plate


class Walls:
    """Wall particles of sides and obstacles, in their places for ever, on the ranks of a fluid's particles.

    Parameters
    ----------
    comm : MPI.Comm
    grid : CellGrid
        The fluid's.
    boxes : Boxes
        The fluid's at present.
    dummies : Dummies
        The same on every rank.
    plates : sequence of Plate
        Sides that move in their own plane: their particles have its velocity and stay where they are.

    Attributes
    ----------
    met : Met
        The rows, by fluid row those near it, and their pressure and density, complete after ``press``.
    force : ndarray, shape (n, dim)
        Of the last force pass, N; complete on owned rows.
    """

    def __init__(
        self, comm: MPI.Comm, grid: CellGrid, boxes: Boxes, dummies: Dummies, plates: Sequence[Plate] = ()
    ) -> None:
        dim = dummies.x.shape[1]
        columns: dict[str, tuple[int | tuple[()], type]] = {
            "volume": ((), np.float64),
            "normal": (dim, np.float64),
            "depth": ((), np.float64),
            "no_slip": ((), np.int64),
            "wall": ((), np.int64),
            "p": ((), np.float64),
            "rho": ((), np.float64),
        }
        self.names = dummies.names
        self._swarm = Swarm(comm, grid, columns, boxes)
        mine = slice(comm.rank, None, comm.size)
        rows = {name: getattr(dummies, name)[mine] for name in ("x", "volume", "normal", "depth", "no_slip", "wall")}
        self._swarm.insert(rows | {"id": np.arange(len(dummies.x))[mine]})
        self._lists = PairLists()
        sides = dummies.wall < 2 * dim
        of = [np.flatnonzero(sides & plate.holds(dummies.x)) for plate in plates]
        self._plates = [(plate, some, plate.feet(dummies.x[some])) for plate, some in zip(plates, of, strict=True)]
        self._velocity, self._time = np.zeros_like(dummies.x), np.nan
        self._make_rows()

    def _make_rows(self) -> None:
        self._swarm.rebuild()
        rows = {name: self._swarm[name] for name in ("x", "volume", "normal", "depth")}
        v, still = self._velocity[self._swarm["id"]], np.zeros_like(rows["x"])
        self.rows = WallRows(v=v, a=still, no_slip=self._swarm["no_slip"].astype(bool), **rows)
        self.force = np.zeros_like(still)

    def slide(self, time: float) -> None:
        """Let sides move as they do at this time. Not collective: every rank finds the same."""
        known = not np.isnan(self._time)
        for plate, some, feet in self._plates:
            if not (known and plate.is_steady):
                self._velocity[some] = plate.velocity(feet, time)
        if self._plates and time != self._time:
            self._time = time
            self.rows.v[...] = self._velocity[self._swarm["id"]]

    def power(self) -> float:
        """Return what sides that move do to the fluid, this rank's share, W."""
        owned = self._swarm.owned
        return -float(np.sum(self.force[owned] * self.rows.v[owned])) if self._plates else 0.0

    def farthest(self) -> float:
        """Return how far they have gone since pairs were listed: nowhere."""
        return 0.0

    def meet(self, fluid: Swarm, reach: float) -> None:
        """List the pairs with the fluid's particles, which have just been sorted. Collective."""
        if fluid.boxes is not self._swarm.boxes:
            self._swarm.rebuild(fluid.boxes)
            self._make_rows()
        walls = self._swarm
        pairs = self._lists.wall(
            fluid["x"], fluid.owned, fluid.first, walls["x"], walls.owned, walls.first, fluid.counts, reach
        )
        self.met = Met(self.rows, pairs, walls["p"], walls["rho"])

    def press(self, passes: Passes, fluid: FluidRows, p: np.ndarray) -> None:
        """Take the pressure from the fluid's p (n,). Collective."""
        self._swarm["p"] = passes.wall_pressure(fluid, p, self.met)
        self._swarm.exchange("p")
        self._swarm["rho"] = passes.law.density(self._swarm["p"])

    def take(self, force: np.ndarray) -> None:
        """Take the forces of the last pass."""
        self.force = force

    def take_drag(self, force: np.ndarray) -> None:
        """Take what viscosity adds, where it is solved for."""
        self.force = self.force + force

    @property
    def known(self) -> np.ndarray:
        """What is known of the velocities of the rows before a step is solved, shape (n, dim), m/s: all."""
        return self.met.rows.v

    @property
    def solved(self) -> np.ndarray:
        """The velocities of the rows that a step was solved for, shape (n, dim), m/s."""
        return self.met.rows.v

    def push(self) -> np.ndarray:
        """Return this rank's share of the force on each wall, shape (n_walls, dim), N."""
        owned, n = self._swarm.owned, len(self.names)
        wall, force = self._swarm["wall"][owned], self.force[owned]
        return np.stack([np.bincount(wall, force[:, a], n) for a in range(force.shape[1])], axis=1)
