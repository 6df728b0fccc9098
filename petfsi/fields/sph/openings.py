"""What comes and goes through sides: inflows and open sides.

Beyond an inflow stand columns of particles (see ``inlets``). Whatever is beyond it goes at the speed of its column, and
has the pressure that the fluid inside has at the column's foot,

    p_foot = sum W (p_i + rho_i g.(x_foot - x_i)) / sum W  (0 where none is near),    p = p_foot + rho_0 g.(x - x_foot),

so it passes the side with the pressure it will have there. At the far end of a column a particle of the mass
rho(p) times its volume comes where the next one of its lattice would, with the next id. Beyond an open side particles
fall freely, without pressure; once out of sight from inside they are taken out. What is changed by hand is work done by
what lies beyond, and is kept account of.

Particles come and go only when pairs are listed anew. All ranks know all columns, so nothing depends on the ranks.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.fields.sph.cells import line_of_cells
from petfsi.fields.sph.inlets import Inlet
from petfsi.fields.sph.kernels import shape
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.room import Room
from petfsi.fields.stored import EXACT, outside


class Openings:
    """The inflows and open sides of a room.

    Parameters
    ----------
    comm : MPI.Comm
    room : Room
    law : Law
    inlets : list of Inlet
    next_id : int
        The first that no particle has.
    waiting : float
        Mass of the particles in the columns, kg.

    Attributes
    ----------
    kept : dict of str to ndarray
        State, the same on all ranks, changed in place. "columns", shape (3, n): how far each column has gone since its
        last particle came, m, its speed into the domain, m/s, and the pressure at its foot, Pa. "passed": the next id,
        the mass that came into columns and that taken out beyond open sides, kg.
    """

    def __init__(self, comm: MPI.Comm, room: Room, law: Law, inlets: list[Inlet], next_id: int, waiting: float) -> None:
        self.comm, self.room, self.law, self.inlets = comm, room, law, inlets
        n = [len(inlet.feet) for inlet in inlets]
        ends = np.cumsum([0, *n])
        self._parts = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        self._feet = np.concatenate([np.zeros((0, law.dim)), *(inlet.feet for inlet in inlets)])
        self._cells = room.grid.of(self._feet)
        self._inward = np.concatenate(
            [np.zeros((0, law.dim)), *(np.tile(inlet.inward, (len(inlet.feet), 1)) for inlet in inlets)]
        )
        self._lost, self._at_rest = 0.0, False
        self._gone = self._strip = self._column = np.zeros(0, dtype=np.int64)
        self.kept: dict[str, np.ndarray] = {}
        self._way, self._speed, self._pressure = self._columns = np.zeros((3, int(ends[-1])))
        self._passed = np.array([float(next_id), waiting, 0.0])
        if inlets or room.is_open:
            self.kept = {"columns": self._columns, "passed": self._passed}
        for inlet, part in zip(inlets, self._parts, strict=True):
            self._way[part] = 0.5 * inlet.width[inlet.axis]
            self._speed[part] = inlet.speed(0.0)

    def faults(self) -> list[str]:
        """Return what cannot be of numbers that a file holds."""
        most = 2 * max((float(inlet.width[inlet.axis]) for inlet in self.inlets), default=0.0)
        return [
            outside("passed", self._passed[:1], 0, EXACT, whole=True),
            outside("columns", self._way, -most, most),
        ]

    # ---- in a step -------------------------------------------------------------------------------------------------

    def drift(self, t: float) -> None:
        """Move the columns on for a time, s."""
        self._way += t * self._speed

    def hold(self, swarm: Swarm, rates: np.ndarray, dt: float) -> None:
        """Leave what is beyond sides its density, in the rates (n,) of the step; the work of pressure goes or comes."""
        if self._at_rest:
            return
        rows = np.flatnonzero(self.room.beyond_inflow(swarm["x"]) | self.room.beyond_open(swarm["x"]))
        mine = rows[swarm.owned[rows]]
        rho = swarm["rho"][mine]
        self._lost += dt * float(swarm["m"][mine] @ (self.law.pressure(rho) / rho**2 * rates[mine]))
        rates[rows] = 0.0

    def press(self, swarm: Swarm, p: np.ndarray, law: Law) -> None:
        """Give what is beyond sides its pressure, in p (n,), and the density to it. Collective."""
        self.law = law
        if self._at_rest:
            self._gone = self._strip = np.zeros(0, dtype=np.int64)
            return
        self._gone = np.flatnonzero(self.room.beyond_open(swarm["x"]))
        self._strip = np.flatnonzero(self.room.beyond_inflow(swarm["x"]))
        self._set(swarm, p, self._gone, np.zeros(len(self._gone)))
        if self.inlets:
            self._column = self._columns_of(swarm["x"][self._strip])
            self._ask_inside(swarm, p)
            way = swarm["x"][self._strip] - self._feet[self._column]
            self._set(swarm, p, self._strip, self._pressure[self._column] + law.rho0 * (way @ np.array(law.gravity)))

    def _set(self, swarm: Swarm, p: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
        """Give rows these pressures; what is stored in them no longer leaves, or comes."""
        rho, own = swarm["rho"], rows[swarm.owned[rows]]
        before = self.law.elastic_energy(rho[own])
        p[rows], rho[rows] = values, self.law.density(values)
        self._lost += float(swarm["m"][own] @ (before - self.law.elastic_energy(rho[own])))

    def _ask_inside(self, swarm: Swarm, p: np.ndarray) -> None:
        """Find the pressure at the feet of columns. Collective."""
        seen = np.ones(len(swarm), dtype=bool)
        seen[self._strip] = seen[self._gone] = False
        local = self._cells - swarm.corner
        here = np.flatnonzero(np.all((local > 0) & (local < swarm.counts - 1), axis=1))
        mine, law = np.zeros(len(self._feet)), self.law
        cells = self._feet[here], local[here], swarm.first, swarm.counts
        rows = swarm["x"], swarm["rho"], p, seen
        mine[here] = _at_feet(*cells, *rows, np.array(law.gravity), 1 / law.s, law.kernel.number)
        self.comm.Allreduce(mine, self._pressure)  # of one that is not zero: no rounding

    def lead(self, swarm: Swarm, gravity: np.ndarray, time: float, dt: float) -> None:
        """Have what is beyond inflows go as it must from ``time`` on, and what is beyond open sides fall.

        Forces on them from inside, known for the step of ``dt`` that ends now, are borne by what lies beyond.
        """
        if self._at_rest:
            return
        self._bear(swarm, self._gone, gravity, dt)
        self._bear(swarm, self._strip, np.zeros(self.law.dim), dt)
        for inlet, part in zip(self.inlets, self._parts, strict=True):
            self._speed[part] = inlet.speed(time)
        strip, own = self._strip, self._strip[swarm.owned[self._strip]]
        self._lost += _kinetic(swarm, own)
        swarm["v"][strip] = (self._speed[:, None] * self._inward)[self._column]
        self._lost -= _kinetic(swarm, own)

    def _bear(self, swarm: Swarm, rows: np.ndarray, gravity: np.ndarray, dt: float) -> None:
        """Leave some rows no acceleration but this one; the power of the rest leaves, or comes."""
        mine = rows[swarm.owned[rows]]
        power = np.sum((swarm["a"][mine] - gravity) * swarm["v"][mine], axis=1)
        self._lost += dt * float(swarm["m"][mine] @ power)
        swarm["a"][rows], swarm["S"][rows] = gravity, 0.0

    def _columns_of(self, x: np.ndarray) -> np.ndarray:
        """Return the column of each of these places beyond inflows."""
        column = np.zeros(len(x), dtype=np.int64)
        for inlet, part in zip(self.inlets, self._parts, strict=True):
            some = np.flatnonzero(inlet.holds(x))
            column[some] = part.start + inlet.columns(x[some])
        return column

    def look(self, swarm: Swarm) -> None:
        """See whether a particle can get beyond a side before pairs are listed again. Not collective."""
        self._at_rest = not self.inlets and not (self.kept and self.room.beyond_open(swarm["x"], self.room.wide).any())

    # ---- who comes, who goes -----------------------------------------------------------------------------------------

    def exchange(self, swarm: Swarm) -> None:
        """Take out what is no longer seen from inside, and let the next ones come. Collective; rows are sorted after.

        Between two calls a column must not move by more than a spacing.
        """
        if not self.kept:
            return
        gone = swarm.owned & self.room.has_left(swarm["x"])
        back = np.zeros(len(swarm), dtype=bool)
        for inlet in self.inlets:
            deep = inlet.holds(swarm["x"] + inlet.depth * inlet.inward)
            back |= swarm.owned & deep & self.room.beyond_inflow(swarm["x"])
        self._passed[2] += self._taken(swarm, gone)
        self._passed[1] -= self._taken(swarm, back)
        if np.any(gone | back):
            swarm.remove(gone | back)
        for inlet, part in zip(self.inlets, self._parts, strict=True):
            self._feed(swarm, inlet, part)

    def _taken(self, swarm: Swarm, rows: np.ndarray) -> float:
        """Return the mass of these rows of all ranks, kg, and note their energy as lost. Collective."""
        out = np.flatnonzero(rows)
        self._lost += _kinetic(swarm, out) + float(swarm["m"][out] @ self.law.elastic_energy(swarm["rho"][out]))
        found = np.concatenate(self.comm.allgather(np.column_stack([swarm["id"][out], swarm["m"][out]])))
        return float(found[np.argsort(found[:, 0]), 1].sum())  # in the order of ids: the same on any ranks

    def _feed(self, swarm: Swarm, inlet: Inlet, part: slice) -> None:
        """Let a particle come behind each column that has gone on by a spacing."""
        width, way = inlet.width[inlet.axis], self._way[part]
        way[way < 0.0] += width  # the last one has gone out again, backwards
        due = np.flatnonzero(way >= width)
        if not len(due):
            return
        way[due] -= width
        x = inlet.feet[due] - (inlet.depth - way[due])[:, None] * inlet.inward
        p = self._pressure[part][due] + self.law.rho0 * ((x - inlet.feet[due]) @ np.array(self.law.gravity))
        rho = self.law.density(p)
        rows = {"id": int(self._passed[0]) + np.arange(len(due)), "x": x, "origin": x, "rho": rho}
        rows |= {"m": rho * float(np.prod(inlet.width)), "v": self._speed[part][due][:, None] * inlet.inward}
        self._passed[0] += len(due)
        self._passed[1] += float(rows["m"].sum())
        if self.comm.rank == 0:  # whoever owns the place gets it
            energy = 0.5 * np.sum(rows["v"] ** 2, axis=1) + self.law.elastic_energy(rho)
            self._lost -= float(rows["m"] @ energy)
            swarm.insert(rows)

    # ---- accounts ----------------------------------------------------------------------------------------------------

    def take_lost(self) -> float:
        """Return the energy that left, less what came, since the last call, J, this rank's share."""
        lost, self._lost = self._lost, 0.0
        return lost

    def tally(self, swarm: Swarm) -> dict[str, float]:
        """Return the mass in the box, and what came and went through its sides so far, kg. Collective.

        The first is what it was at the start, plus the second, less the third.
        """
        if not self.kept:
            return {}
        mine = np.flatnonzero(swarm.owned)
        x, m = swarm["x"][mine], swarm["m"][mine]
        waiting, gone = self.room.beyond_inflow(x), self.room.beyond_open(x)
        parts = [float(m[some].sum()) for some in (waiting, gone, ~waiting & ~gone)]
        before, after, within = self.comm.allreduce(np.array(parts)).tolist()
        return {"mass": within, "mass_in": float(self._passed[1]) - before, "mass_out": float(self._passed[2]) + after}


def _kinetic(swarm: Swarm, rows: np.ndarray) -> float:
    return 0.5 * float(swarm["m"][rows] @ np.sum(swarm["v"][rows] ** 2, axis=1))


@njit(cache=True, error_model="numpy")
def _at_feet(feet, cells, first, counts, x, rho, p, seen, g, inv_s, kernel):
    """Return the mean of the pressure of the rows that are seen, continued to each foot: in the order of rows."""
    n, dim = feet.shape
    found = np.zeros(n)
    for k in range(n):
        total = weight = 0.0
        for line in range(3 ** (dim - 1)):
            a, b = (line - 1, 0) if dim == 2 else (line // 3 - 1, line % 3 - 1)
            begin, end = line_of_cells(first, counts, cells[k], a, b, dim)
            for i in range(begin, end):
                if seen[i]:
                    r2 = rise = 0.0
                    for axis in range(dim):
                        r = feet[k, axis] - x[i, axis]
                        r2 += r * r
                        rise += g[axis] * r
                    w, f = shape(kernel, np.sqrt(r2) * inv_s)
                    total += w * (p[i] + rho[i] * rise)
                    weight += w
        if weight > 0.0:
            found[k] = total / weight
    return found
