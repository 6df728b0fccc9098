"""A weakly compressible fluid of particles: smoothed particle hydrodynamics, stepped by kick, drift, kick.

With the law of ``passes`` (D the rate of density, f the forces), h the step and a the acceleration of the step before,

    v' = v + h/2 a        x' = x + h/2 v'        rho += h D(x', v', rho)
    x = x' + h/2 v' - shift        a = f(x, v', rho)/m + g        v = v' + h/2 a

so each pair is visited twice a step. It is of second order and, without viscosity, diffusion and shifting, symplectic.
The equations have no unknowns that must be solved for, and the field has no block, unless viscosity is solved for: then
f is without it, and the last kick holds what ``viscosity`` says of the whole step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.base import Stock, Work
from petfsi.fields.fluids import FluidField
from petfsi.fields.replicated import read_whole, whole_slab
from petfsi.fields.slabs import Reader, Slab, State, held
from petfsi.fields.sph import moves, probes
from petfsi.fields.sph.balance import bisect
from petfsi.fields.sph.bodies import Bodies
from petfsi.fields.sph.cells import PairLists, Pairs
from petfsi.fields.sph.openings import Openings
from petfsi.fields.sph.pace import Pace
from petfsi.fields.sph.particles import StrayError, Swarm
from petfsi.fields.sph.passes import FluidRows, Passes
from petfsi.fields.sph.room import Room
from petfsi.fields.sph.skin import Skin
from petfsi.fields.sph.start import Start
from petfsi.fields.sph.viscosity import THETA, ImplicitViscosity
from petfsi.fields.sph.walls import Walls
from petfsi.fields.stored import outside, refuse
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Scene

#: What a checkpoint holds besides "id" and "x".
STORED = ("v", "rho", "m", "a", "S")
#: Densities and masses are more.
_LEAST = float(np.finfo(float).tiny)


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
    bodies : Bodies
        The surfaces of solids, if a coupling has put any in.
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
        assert scene.fluid is not None
        self.cell_volume, self.extent = self.spacing**self.dim, max(scene.fluid.size)
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
        self.bodies, self._pace = Bodies(comm, self.room, dummies, self.law.nu > 0), Pace()
        self.n_lists = 0
        self.kept: dict[str, np.ndarray] = dict(self.openings.kept)
        self.tallied: dict[str, float] = {}
        self.bodies.notes = start.notes
        self.viscous: ImplicitViscosity | None = None
        if start.implicit:
            self.viscous = ImplicitViscosity(comm, self.swarm, THETA.get(scene.time.integrator, 1.0))
            self.has_block = True
            self._take_block()
        self.swarm["a"][:] = self.gravity(0.0)
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
        return self.bodies.immerse(points, facets)

    def clear(self, points: np.ndarray, facets: np.ndarray) -> None:
        """Take particles out that are inside of a surface, or next to nothing before it, and tell. Collective."""
        self.bodies.clear(self.swarm, points, facets)
        self._listed = False

    @property
    def skin(self) -> Skin | None:
        """The wall particles of solids, if a coupling has put any in."""
        return self.bodies.skin

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
        self.bodies.begin(swarm)
        moves.advance(swarm["v"], swarm["a"], half)
        moves.advance(swarm["x"], swarm["v"], half)
        self.openings.drift(half)
        if self.skin is not None:
            self.skin.place(self.skin.points + half * self.skin.velocity, self.skin.velocity)
        self._refresh("x", "v", "rho")
        swarm = self.swarm
        self._condense(time + half, dt)
        moves.advance(swarm["x"], swarm["v"], half)
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
            self.bodies.guard(self.swarm, dt)
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

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Kick for the second half of the step, by viscosity for all of it if that is solved for. Collective."""
        moves.advance(self.swarm["v"], self.swarm["a"], dt / 2)
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
        swarm["anchor"][:] = swarm["x"]
        pairs = self._lists.fluid(swarm["x"], swarm.owned, swarm.first, swarm.counts, reach)
        self.pairs: Pairs = self.bodies.strike(pairs, swarm["x"])
        for walls in self._sets():
            walls.meet(swarm, self.room.reach + self.room.wide)
        self.openings.look(swarm)
        self._listed, self.n_lists = True, self.n_lists + 1

    # ---- how long a step may be -----------------------------------------------------------------------------------

    def _measure_speeds(self) -> None:
        self._pace.measure(self.comm, self.swarm, self.law)

    def remark(self) -> str | None:
        """Return that particles are too fast for the sound, or too dense, when they first are."""
        return self._pace.remark(self.law)

    def stable_step(self) -> float:
        """Return the smallest of the limits on the step, s."""
        return self._pace.stable_step(self.passes.law)

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
        return self.bodies.notes

    def tally(self) -> dict[str, float]:
        """Return the number of particles, what went through sides, and how many thin bodies threw back. Collective."""
        put_back = {"put_back": float(self.bodies.n_put_back)} if self.bodies.hide else {}
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

    def state(self) -> State:
        """Return all that the next step reads, by id. Collective."""
        return self.keep()()

    def keep(self) -> Callable[[], State]:
        """Return what gives ``state`` of now later: to sort particles by id costs as much as a good part of a step."""
        rows, others = self.swarm.keep(STORED), held(self._others())
        return lambda: rows() | others()

    def _others(self) -> State:
        skin = {} if self.skin is None else {"skin_force": whole_slab(self.comm.rank, self.skin.last.ravel())}
        kept = {name: whole_slab(self.comm.rank, values.ravel()) for name, values in self.kept.items()}
        return skin | kept

    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks. Collective."""
        try:
            self.swarm.restore(read, STORED)
        except StrayError as error:
            raise ValueError(f"'x': {error}") from error
        matter = {name: self.swarm[name] for name in ("rho", "m")}
        refuse(self.comm, [outside(name, values, _LEAST, np.inf) for name, values in matter.items()])
        if self.skin is not None:
            last = self.skin.last
            self.skin.last = read_whole(read, "skin_force", last.size).reshape(last.shape)
        for name, values in self.kept.items():
            values[...] = read_whole(read, name, values.size).reshape(values.shape)
        refuse(self.comm, self.openings.faults())
        self._forget_step()
        self._pushed = True  # a is that of the forces
        self._measure_speeds()
