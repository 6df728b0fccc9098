"""Bodies in a fluid of particles: what they take the place of, hide and throw back."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.sph.cells import Pairs
from petfsi.fields.sph.dummies import Dummies
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.room import Room
from petfsi.fields.sph.sight import Sight
from petfsi.fields.sph.skin import Skin
from petfsi.fields.sph.start import depth_behind
from petfsi.fields.sph.thin import thin_shells, wet_on_both_sides
from petfsi.geometry.bodies import enclosed

#: Particles that went through a thin body are put back so far before it, in spacings; if more than a few, and more than
#: one in so many of all, did in one step, the run stops.
GAP, FEW, MOST = 0.1, 10, 1000
#: Particles begin so far, in spacings, before solids.
CLEARANCE = 0.25
#: Bodies thinner than so many spacings for the most part hide one side from the other, and have two sets of wall
#: particles; if so large a part of the others' surface is as thin, that is told.
THIN, PARTLY = 1.75, 0.3


class Bodies:
    """The surface of all solids among the particles.

    Parameters
    ----------
    comm : MPI.Comm
    room : Room
    walls : Dummies
        Of sides and obstacles.
    no_slip : bool
        Whether surfaces hold the fluid.

    Attributes
    ----------
    skin : Skin or None
        Their wall particles, once they are there.
    notes : list of str
        What a user should know of how they begin.
    hide : bool
        Whether some are so thin that they hide particles from others.
    n_put_back : int
        How many particles they have thrown back, on all ranks.
    """

    def __init__(self, comm: MPI.Comm, room: Room, walls: Dummies, no_slip: bool) -> None:
        self.comm, self.room, self._no_slip = comm, room, no_slip
        self._walls = walls.x
        self.skin: Skin | None = None
        self._sight: Sight | None = None
        self.notes: list[str] = []
        self.n_put_back = 0

    @property
    def hide(self) -> bool:  # noqa: D102
        return self._sight is not None

    def immerse(self, points: np.ndarray, facets: np.ndarray) -> Skin:
        """Take a surface with these points (n, dim) and facets; return its wall particles. Not collective."""
        room = self.room
        thin, part = thin_shells(points, facets, THIN * room.spacing)
        if part > PARTLY:
            self.notes.append(
                f"{100 * part:.2g}% of the solids' surface is of parts thinner than {THIN * room.spacing:g} m: water "
                "on both sides of these feels that on the other; a smaller fluid.spacing may help"
            )
        about = thin, self._no_slip, self._walls
        self.skin = Skin(self.comm, room.grid, room.spacing, room.reach, points, facets, *about)
        if np.any(thin):
            reach = room.reach + room.near
            self._sight = Sight(facets, thin, reach, wet_on_both_sides(points, facets, reach), room.grid)
        return self.skin

    def clear(self, swarm: Swarm, points: np.ndarray, facets: np.ndarray) -> None:
        """Take particles out that are inside of a surface, or next to nothing before it, and tell. Collective."""
        near = CLEARANCE * self.room.spacing
        depth = depth_behind(swarm["x"], points, facets, self.room.reach)
        inside = swarm.owned & (depth > -near)
        far = np.flatnonzero(swarm.owned & np.isneginf(depth))
        inside[far] = enclosed(points, facets, swarm["x"][far])
        dropped = self.comm.allreduce(int(np.count_nonzero(inside)))
        if dropped:
            swarm.remove(inside)
            swarm.rebuild()
            self.notes.append(f"fluid.fill: {dropped} places lie in solids, or less than {near:g} m before them")

    # ---- what thin ones hide, and throw back ------------------------------------------------------------------------

    def begin(self, swarm: Swarm) -> None:
        """Note where particles and surfaces are at the begin of a step."""
        if self._sight is not None and self.skin is not None:
            swarm["origin"], self._begin = swarm["x"], self.skin.points

    def strike(self, pairs: Pairs, x: np.ndarray) -> Pairs:
        """Return the pairs of particles that see each other, in the same memory. Not collective."""
        if self._sight is None or self.skin is None:
            return pairs
        self._sight.place(self.skin.points, x)
        return self._sight.strike(pairs, x)

    def guard(self, swarm: Swarm, dt: float) -> None:
        """Put back what has gone through a thin body in the step. Collective.

        Raises
        ------
        SolveError
            On all ranks, if that is more than one in ``MOST`` of all particles.
        """
        if self._sight is None or self.skin is None:
            return
        size = self.room.high - self.room.low
        way = swarm["x"] - swarm["origin"]
        before = swarm["x"] - (way - self.room.grid.periodic * np.round(way / size) * size)
        places = self._begin, self.skin.points
        gap = GAP * self.room.spacing
        found = self._sight.crossed(before, swarm["x"], swarm["v"], *places, dt, gap, swarm.owned)
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
