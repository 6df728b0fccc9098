"""A weakly compressible fluid of particles: smoothed particle hydrodynamics, stepped by kick, drift, kick.

With the law of ``passes`` (D the rate of density, f the forces), h the step and a the acceleration of the step before,

    v' = v + h/2 a        x' = x + h/2 v'        rho += h D(x', v', rho)
    x = x' + h/2 v' - shift        a = f(x, v', rho)/m + g        v = v' + h/2 a

so each pair is visited twice a step. It is of second order and, without viscosity, diffusion and shifting, symplectic.
The equations have no unknowns that must be solved for, and the field has no block, unless viscosity is solved for: then
f is without it, and the last kick holds what ``viscosity`` says of the whole step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from petfsi.errors import SolveError
from petfsi.fields.base import FluidField, Reader, Slab, Stock, Work
from petfsi.fields.replicated import read_whole, whole_slab
from petfsi.fields.sph import moves, probes
from petfsi.fields.sph.balance import bisect
from petfsi.fields.sph.cells import PairLists, Pairs
from petfsi.fields.sph.openings import Openings
from petfsi.fields.sph.particles import StrayError, Swarm
from petfsi.fields.sph.passes import FluidRows, Passes
from petfsi.fields.sph.room import Room
from petfsi.fields.sph.sight import Sight
from petfsi.fields.sph.skin import Skin
from petfsi.fields.sph.start import Start, depth_behind, limits
from petfsi.fields.sph.thin import thin_shells, wet_on_both_sides
from petfsi.fields.sph.viscosity import THETA, ImplicitViscosity
from petfsi.fields.sph.walls import Walls
from petfsi.geometry.bodies import enclosed
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Scene

#: Particles that went through a thin body are put back so far before it, in spacings; if more than a few, and more than
#: one in so many of all, did in one step, the run stops.
GAP, FEW, MOST = 0.1, 10, 1000
#: Particles begin so far, in spacings, before solids.
CLEARANCE = 0.25
#: Bodies thinner than so many spacings for the most part hide one side from the other, and have two sets of wall
#: particles; if so large a part of the others' surface is as thin, that is told.
THIN, PARTLY = 1.75, 0.3
#: A point nearer than so many spacings to a wall particle that is a spacing or more inside is there, too.
SUNK = 0.6
#: Speeds above this part of that of sound, and densities off by more than this part, are remarked on.
FAST, DENSE = 0.2, 0.05
#: What a checkpoint holds besides "id" and "x".
STORED = ("v", "rho", "m", "a", "S")


class SphFluid(FluidField):
    """Particles with their walls.

    Attributes
    ----------
    swarm : Swarm
        Columns x, v, rho, m, a (acceleration), S (see ``passes``), anchor and origin (where it was when pairs were
        listed, and when the step began).
    passes : Passes
        With the law.
    walls : Walls or None
        Those at rest; None where no side and no obstacle holds the fluid.
    skin : Skin or None
        Those of solids, if a coupling has put any in.
    sight : Sight or None
        What bodies thinner than particles see hide.
    kept, tallied : dict
        What a coupling wants to find again after a restart, arrays that every rank has; and to say in history.csv.
    pairs : Pairs
        Of particles, as last listed.
    room : Room
        The box, its sides, and the grid of cells.
    openings : Openings
        What comes and goes through the sides.
    viscous : ImplicitViscosity or None
        The block, if viscosity is solved for.
    """

    name = "particles"
    has_block = False
    explicit = True
    elastic = True

    def __init__(self, comm: MPI.Comm, scene: Scene):
        start = Start(scene)
        self.comm, self.scene, self.dim = comm, scene, scene.dim
        self.law, self.room = start.law, Room.of(scene, start.law)
        self.density, self.spacing = start.law.rho0, start.law.spacing
        self.cell_volume = self.spacing**self.dim
        self._gravity = [Expression(g, ("t",), f"gravity.{n}") for n, g in enumerate(scene.gravity or [])]
        constant = not any(g.depends_on_time for g in self._gravity)
        self._constant_gravity = self._gravity_at(0.0) if constant else None
        self.passes, self._lists = Passes(start.explicit_law), PairLists()
        vector, number = (self.dim, np.float64), ((), np.float64)
        columns: dict[str, tuple[int | tuple[()], type]] = {"v": vector, "rho": number, "m": number}
        columns |= dict.fromkeys(("a", "S", "anchor", "origin"), vector)
        if start.implicit:
            columns |= {"w": vector, "number": ((), np.int64)}
        self.swarm = Swarm(comm, self.room.grid, columns)
        rows = start.rows(slice(comm.rank, None, comm.size))
        boxes = bisect(comm, self.room.grid, self.room.grid.of(rows["x"]))
        self.swarm.insert(rows)
        self.swarm.rebuild(boxes)
        self.openings = Openings(comm, self.room, self.law, start.inlets, len(start.x), start.waiting)
        dummies = start.dummies()
        self.walls = Walls(comm, self.room.grid, boxes, dummies, start.plates) if len(dummies.x) else None
        self.skin: Skin | None = None
        self.sight: Sight | None = None
        self.n_put_back = self.n_lists = 0
        self.kept: dict[str, np.ndarray] = dict(self.openings.kept)
        self.tallied: dict[str, float] = {}
        self._notes, self._taken = start.notes, dummies.x
        self._deep = cKDTree(dummies.x[dummies.depth > self.spacing])
        self.viscous: ImplicitViscosity | None = None
        if start.implicit:
            self.viscous = ImplicitViscosity(comm, self.swarm, THETA.get(scene.time.integrator, 1.0))
            self.has_block = True
            self._take_block()
        self.swarm["a"][:] = self.gravity(0.0)
        self._warned = False
        self._forget_step()
        self._measure_speeds()

    def _forget_step(self) -> None:
        """Know nothing of a step under way, and of no pairs."""
        self._listed = self._pushed = self._moving = False
        self._way, self._diffused, self._dissipated = np.zeros(self.dim), 0.0, 0.0

    def immerse(self, points: np.ndarray, facets: np.ndarray) -> Skin:
        """Put a surface with these points (n, dim) and facets into the fluid, and return what stands for it there.

        Particles in thin bodies, or next to nothing before a surface, are taken out. Collective.
        """
        self.clear(points, facets)
        reach = self.room.reach + self.room.near
        thin, part = thin_shells(points, facets, THIN * self.spacing)
        if part > PARTLY:
            self._notes.append(
                f"{100 * part:.2g}% of the solids' surface is of parts thinner than {THIN * self.spacing:g} m: water "
                "on both sides of these feels that on the other; a smaller fluid.spacing may help"
            )
        about = thin, self.law.nu > 0, self._taken
        self.skin = Skin(self.comm, self.room.grid, self.spacing, self.room.reach, points, facets, *about)
        if np.any(thin):
            both = wet_on_both_sides(points, facets, reach)
            self.sight = Sight(facets, thin, reach, both, self.room.grid)
        self._rooted = self._sunk()
        self._listed = False
        return self.skin

    def clear(self, points: np.ndarray, facets: np.ndarray) -> None:
        """Take particles out that are inside of a surface, or next to nothing before it, and tell. Collective."""
        near = CLEARANCE * self.spacing
        depth = depth_behind(self.swarm["x"], points, facets, self.room.reach)
        inside = self.swarm.owned & (depth > -near)
        far = np.flatnonzero(self.swarm.owned & np.isneginf(depth))
        inside[far] = enclosed(points, facets, self.swarm["x"][far])
        dropped = self.comm.allreduce(int(np.count_nonzero(inside)))
        if dropped:
            self.swarm.remove(inside)
            self.swarm.rebuild()
            self._notes.append(f"fluid.fill: {dropped} places lie in solids, or less than {near:g} m before them")
        self._listed = False

    @property
    def is_moving(self) -> bool:
        """Whether a step is under way: predicted and not accepted."""
        return self._moving

    def _sets(self) -> list[Walls | Skin]:
        return [walls for walls in (self.walls, self.skin) if walls is not None]

    def gravity(self, t: float) -> np.ndarray:
        """Return the acceleration of gravity at a time, shape (dim,), m/s^2."""
        return self._gravity_at(t) if self._constant_gravity is None else self._constant_gravity

    def _gravity_at(self, t: float) -> np.ndarray:
        return np.array([float(g(t=t)) for g in self._gravity]) if self._gravity else np.zeros(self.dim)

    # ---- the step -------------------------------------------------------------------------------------------------

    def predict(self, time: float, dt: float) -> None:
        """Kick, drift, take the new density, drift, shift: all but the forces at the end. Collective."""
        swarm, half = self.swarm, dt / 2
        self._way, self._diffused, self._pushed, self._moving = np.zeros(self.dim), 0.0, False, True
        if self.sight is not None and self.skin is not None:
            swarm["origin"], self._begin = swarm["x"], self.skin.points
        moves.kick(swarm["v"], swarm["a"], half)
        moves.drift(swarm["x"], swarm["v"], half)
        self.openings.drift(half)
        if self.skin is not None:
            self.skin.place(self.skin.points + half * self.skin.velocity, self.skin.velocity)
        self._refresh("x", "v", "rho")
        swarm = self.swarm
        self._condense(time + half, dt)
        moves.drift(swarm["x"], swarm["v"], half)
        self.openings.drift(half)
        self._way += dt * moves.momentum(swarm["m"], swarm["v"], swarm.owned)
        if self.room.shifting:
            columns = swarm["x"], swarm["v"], swarm["S"], swarm["m"], swarm.owned
            shifted = np.zeros(self.dim)
            moves.shift(*columns, dt, self.law.s, moves.SLOW * self.law.c, shifted)
            self._diffused += float(shifted @ self.gravity(time + half))
            self._way += shifted

    def _condense(self, time: float, dt: float) -> None:
        """Take the density to the end of the step. Collective."""
        swarm = self.swarm
        self._weigh(time)
        if self.skin is not None:
            self.skin.look(self.swarm["x"])
        rates = self.passes.density_rates(self._rows(), self.pairs, *(walls.met for walls in self._sets()))
        p = self.law.pressure(swarm["rho"])
        self._diffused -= dt * moves.compression(swarm["m"], p, swarm["rho"], rates.diffusive, swarm.owned)
        self.openings.hold(swarm, rates.total, dt)
        swarm["rho"] += dt * rates.total

    def assemble(self, time: float, dt: float) -> None:
        """Find the forces, unless a coupling has asked for them already, and the block of viscosity. Collective."""
        self.push(time, dt)
        if self.viscous is not None:
            walls = [(walls.met, walls.known) for walls in self._sets()]
            self.viscous.assemble(self.swarm, dt, self._half(dt), walls)
            self._take_block()
            self.row_scale = self.viscous.theta * dt / (self.density * self.cell_volume)
            self.n_assembled += 1

    def _half(self, dt: float) -> float:
        """Return for how long a kick is, s."""
        return dt / 2 if self._moving else 0.0

    def _take_block(self) -> None:
        assert self.viscous is not None
        self.layout, self.block, self.rhs = self.viscous.layout, self.viscous.block, self.viscous.rhs

    def unknown(self) -> np.ndarray:
        """Return the velocities at the begin of the step, if viscosity is solved for."""
        return super().unknown() if self.viscous is None else self.viscous.guess

    def push(self, time: float, dt: float) -> None:
        """Find the forces where the step has brought the particles and walls. Collective; once a step."""
        if self._pushed:
            return
        end = time + dt if self._moving else time
        if self._moving:
            self._guard(dt)
        self._refresh("x", "rho")
        self._weigh(end)
        fluid, sets = self._rows(), self._sets()
        p = self.law.pressure(fluid.rho)
        if self.skin is not None:
            self.skin.look(fluid.x)
        self.openings.press(self.swarm, p, self.law)
        for walls in sets:
            walls.press(self.passes, fluid, p)
        forces = self.passes.forces(fluid, p, self.pairs, *(walls.met for walls in sets))
        for walls, force in zip(sets, forces.f_walls, strict=True):
            walls.take(force)
        self._dissipated = dt * float(forces.dissipated[self.swarm.owned].sum())
        moves.fade(forces.S, forces.full, self.swarm["S"])
        if self.viscous is not None:
            self.viscous.weigh(self.swarm, self.law, self.pairs, [walls.met for walls in sets], self._half(dt))
        moves.accelerate(forces.f, fluid.m, self.gravity(end), self.swarm["a"])
        self.openings.lead(self.swarm, self.gravity(end), end, dt)
        if not self._moving:
            self.openings.take_lost()  # nothing is done outside of steps
        self._pushed = True

    def _guard(self, dt: float) -> None:
        """Put back what has gone through a thin body in the step. Collective.

        Raises
        ------
        SolveError
            On all ranks, if that is more than one in ``MOST`` of all particles.
        """
        if self.sight is None or self.skin is None:
            return
        swarm, size = self.swarm, self.room.high - self.room.low
        way = swarm["x"] - swarm["origin"]
        before = swarm["x"] - (way - self.room.grid.periodic * np.round(way / size) * size)
        points = self._begin, self.skin.points
        gap = GAP * self.spacing
        found = self.sight.crossed(before, swarm["x"], swarm["v"], *points, dt, gap, swarm.owned)
        number, most = self.comm.allreduce(len(found.rows)), self.comm.allreduce(swarm.n_owned) / MOST
        if number > max(FEW, most):
            raise SolveError(
                f"{number} particles went through thin bodies in a step, more than 1 in {MOST}; a shorter time.dt, a "
                "larger fluid.sound_speed or a smaller fluid.spacing may help"
            )
        lost = swarm["m"][found.rows][:, None] * (swarm["v"][found.rows] - found.v)
        swarm["x"][found.rows], swarm["v"][found.rows] = found.x, found.v
        self.skin.knock(found.facets, found.x, lost)
        self.n_put_back += number

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Kick for the second half of the step, by viscosity for all of it if that is solved for. Collective."""
        moves.kick(self.swarm["v"], self.swarm["a"], dt / 2)
        if self.viscous is not None:
            sets = self._sets()
            forces, lost = self.viscous.kick(self.swarm, x, [(walls.met, walls.solved) for walls in sets], dt)
            for walls, force in zip(sets, forces, strict=True):
                walls.take_drag(force)
            self._dissipated += lost
        self._moving = False
        self._measure_speeds()

    def _rows(self) -> FluidRows:
        swarm = self.swarm
        return FluidRows(swarm["x"], swarm["v"], swarm["rho"], swarm["m"])

    def _weigh(self, time: float) -> None:
        """Let pressures balance the gravity of this time, and sides move as they do then."""
        if self.walls is not None:
            self.walls.slide(time)
        g = tuple(self.gravity(time).tolist())
        if g != self.law.gravity:
            self.law, self.passes.law = replace(self.law, gravity=g), replace(self.passes.law, gravity=g)

    def _refresh(self, *names: str) -> None:
        """Give ghosts these columns, x among them, anew; list pairs again where a list does not hold. Collective.

        Raises
        ------
        SolveError
            On all ranks, where a particle is nowhere, or where none can be.
        """
        swarm, room = self.swarm, self.room
        way = moves.farthest(swarm["x"], swarm["anchor"], swarm.owned) if self._listed else np.inf
        way = max([np.inf if np.isnan(way) else way, *(walls.farthest() for walls in self._sets())])
        way = self.comm.allreduce(way, MPI.MAX)
        if way < max(room.near / 2, room.wide):
            swarm.exchange(*names)
        if not (2 * way < room.near or (way < room.wide and self._stays_together())):
            self._list_pairs()

    def _stays_together(self) -> bool:
        """Whether particles go so much the same way that none came near that is not listed. Collective.

        Those two cells apart or less are compared. Others stay apart, as none has gone farther than cells are wider
        than particles see.
        """
        swarm = self.swarm
        # what solids hide, and where they meet particles, changes as these pass by; columns feed in at every list
        if len(self.scene.solids) or self.openings.inlets:
            return False
        spread = moves.spread(swarm["x"], swarm["anchor"], swarm.first, swarm.counts)
        return self.comm.allreduce(spread, MPI.MAX) < self.room.near

    def _list_pairs(self) -> None:
        """Sort the particles and list their pairs. Collective."""
        swarm, reach = self.swarm, self.room.reach + self.room.near
        self.openings.exchange(swarm)
        self.room.check(self.comm, swarm)
        try:
            swarm.rebuild(swarm.balanced())
        except StrayError as error:
            raise SolveError(f"the particles have blown up: {error}") from None
        if self.skin is not None:
            self._refuse_sunk()
        swarm["anchor"][:] = swarm["x"]
        self.pairs: Pairs = self._lists.fluid(swarm["x"], swarm.owned, swarm.first, swarm.counts, reach)
        if self.sight is not None and self.skin is not None:
            self.sight.place(self.skin.points, swarm["x"])
            self.pairs = self.sight.strike(self.pairs, swarm["x"])
        for walls in self._sets():
            walls.meet(swarm, self.room.reach + self.room.wide)
        self._listed, self.n_lists = True, self.n_lists + 1

    def _sunk(self) -> np.ndarray:
        """Return which points of the surface are a spacing or more inside of walls, or beyond."""
        assert self.skin is not None
        x, room = self.skin.points, self.room
        return room.behind_wall(x, self.spacing) | (self._deep.query(x)[0] < SUNK * self.spacing)

    def _refuse_sunk(self) -> None:
        """See that no solid has gone into a wall. Not collective; all ranks know the same.

        Raises
        ------
        SolveError
        """
        assert self.skin is not None
        sunk = np.flatnonzero(self._sunk() & ~self._rooted)
        if len(sunk):
            at = ", ".join(f"{c:g}" for c in self.skin.points[sunk[0]])
            raise SolveError(
                f"a solid has gone into a wall: a point of it is at ({at}), a spacing or more behind a side's or an "
                "obstacle's face; solids do not feel walls"
            )

    # ---- how long a step may be -----------------------------------------------------------------------------------

    def _measure_speeds(self) -> None:
        """Find the largest speed and acceleration. Collective."""
        swarm = self.swarm
        found = np.array([*(moves.fastest(swarm[name], swarm.owned) for name in ("v", "a")), self._densest()])
        found[np.isnan(found)] = np.inf
        self.comm.Allreduce(MPI.IN_PLACE, found, MPI.MAX)
        self._fastest, self._strongest, self._dense = found.tolist()
        if not np.isfinite(self._fastest + self._strongest):
            raise SolveError(
                "the particles have blown up: a velocity or an acceleration is not a finite number; a shorter time.dt "
                "or a larger fluid.sound_speed may help"
            )

    def _densest(self) -> float:
        """Return how far a density is from that at no pressure at most, over that; of this rank."""
        rho = self.swarm["rho"][self.swarm.owned]
        return float(np.abs(rho / self.law.rho0 - 1.0).max(initial=0.0))

    def remark(self) -> str | None:
        """Return that particles are too fast for the sound, or too dense, when they first are."""
        slow = f"fluid.sound_speed = {self.law.c:.3g} m/s is too low for that, and more makes the water stiffer"
        if self._fastest > FAST * self.law.c and not self._warned:
            self._warned = True
            return f"particles move at {self._fastest:.3g} m/s: {slow}"
        if self._dense > DENSE and not self._warned:
            self._warned = True
            return f"the density of a particle is off by {100 * self._dense:.2g}%: {slow}"
        return None

    def stable_step(self) -> float:
        """Return the smallest of the limits on the step, s."""
        return min(limits(self.passes.law, self._fastest, self._strongest).values())

    # ---- accounts -------------------------------------------------------------------------------------------------

    def stock(self) -> Stock:
        """Return this rank's share of momentum and energy."""
        swarm = self.swarm
        m, v, mine = swarm["m"], swarm["v"], swarm.owned
        elastic = moves.total(m, self.law.elastic_energy(swarm["rho"]), mine)
        return Stock(moves.momentum(m, v, mine), moves.kinetic(m, v, mine), elastic)

    def work(self, dt: float) -> Work:
        """Return this rank's share of what was done in the step last accepted.

        ``damping`` holds what viscosity and diffusion took, and shifting, as far as it moved weight down.
        """
        gravity = float(self._way @ np.array(self.law.gravity))
        boundary = -self.openings.take_lost()
        if self.walls is not None:
            boundary += dt * self.walls.power()
        return Work(gravity=gravity, damping=self._dissipated + self._diffused, boundary=boundary)

    # ---- what others see ------------------------------------------------------------------------------------------

    @property
    def notes(self) -> list[str]:
        """What was dropped of the fill, and what of the table is unwise."""
        return self._notes

    def tally(self) -> dict[str, float]:
        """Return the number of particles, what went through sides, and how many thin bodies threw back. Collective."""
        put_back = {} if self.sight is None else {"put_back": float(self.n_put_back)}
        through = self.openings.tally(self.swarm)
        return {"particles": float(self.comm.allreduce(self.swarm.n_owned))} | through | put_back | self.tallied

    def probe(self, quantity: str, at: list[float]) -> float | np.ndarray:
        """Return ``pressure`` or ``velocity`` at a point, ``level`` there, or ``front`` of all. Collective."""
        if quantity == "front":
            return probes.front(self)
        if quantity == "level":
            return probes.level(self, np.array(at))
        return probes.at_point(self, quantity, np.array(at))

    def force_on(self, wall: str) -> np.ndarray:
        """Return the force on a side or an obstacle at the end of the step, shape (dim,), N. Collective."""
        if self.walls is None or wall not in self.walls.names:
            return np.zeros(self.dim)
        total = self.comm.allreduce(self.walls.push())
        return total[self.walls.names.index(wall)]

    def output(self) -> dict[str, Slab]:
        """Return places, velocity, pressure and density of all particles, by id. Collective."""
        slabs = self.swarm.slabs(["v", "rho"])
        rho = slabs["rho"]
        pressure = Slab(self.law.pressure(rho.data), rho.start, rho.shape)
        return {
            "points": slabs["x"],
            "velocity": slabs["v"],
            "pressure": pressure,
            "density": rho,
            "id": slabs["id"],
        }

    def forget(self) -> None:
        """List pairs anew before the next pass, as a run that goes on must. Collective."""
        self._listed = False

    def state(self) -> dict[str, Slab]:
        """Return all that the next step reads, by id. Collective."""
        skin = {} if self.skin is None else {"skin_force": whole_slab(self.comm.rank, self.skin.last.ravel())}
        kept = {name: whole_slab(self.comm.rank, values.ravel()) for name, values in self.kept.items()}
        return self.swarm.slabs(STORED) | skin | kept

    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks. Collective."""
        self.swarm.restore(read, STORED)
        if self.skin is not None:
            self.skin.last = read_whole(read, "skin_force").reshape(-1, self.dim)
        for name, values in self.kept.items():
            values[...] = read_whole(read, name).reshape(values.shape)
        self._forget_step()
        self._pushed = True  # a is that of the forces
        self._measure_speeds()
