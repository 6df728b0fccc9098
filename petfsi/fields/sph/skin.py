"""Wall particles behind the surface of solids that move: hung on its facets, they go where these go.

A wall particle of facet f has barycentric coordinates lambda and a depth k dx + dx / 2,

    x_d = y - depth n,     y = sum_a lambda_a X_a,     v_d = sum_a lambda_a U_a,

and stands for its share of the facet's present area times dx. The force on it goes to the facet's points by the same
lambda, so that nothing is lost on the way. Every rank has all of them; each lists those near its own particles, and
the owner of the cell that one is in sums what it feels.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from mpi4py import MPI
from numba import njit
from scipy.sparse import csr_matrix

from petfsi.fields.sph.cells import CellGrid, PairLists, Pairs, sorted_rows
from petfsi.fields.sph.hung import hang
from petfsi.fields.sph.loops import seen_loop
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.passes import FluidRows, Met, Passes, WallRows
from petfsi.fields.sph.rims import Rims, unit_normals
from petfsi.geometry.slabs import area_vectors

#: Over so many spacings above its facet a wall particle comes into sight.
EDGE = 0.25


class Skin:
    """The wall particles of a surface.

    Parameters
    ----------
    comm : MPI.Comm
    grid : CellGrid
        The fluid's.
    spacing, reach : float
        Of the fluid's particles, m: there are ceil(reach / spacing) layers.
    points : ndarray, shape (n_points, dim)
        Of the surface at the start, m.
    facets : ndarray of int, shape (n_facets, dim)
        Normals out of the solid.
    thin : ndarray of bool, shape (n_facets,)
        Those of bodies thinner than particles see.
    no_slip : bool
    taken : ndarray, shape (n_taken, dim)
        Where wall particles at rest are, m.

    Attributes
    ----------
    points, velocity, acceleration : ndarray, shape (n_points, dim)
        Of the surface, as last placed.
    x : ndarray, shape (n, dim)
        Of all wall particles then.
    force : ndarray, shape (n, dim)
        On each of them in the last force pass, N.
    last : ndarray, shape (n_points, dim)
        On each point at the end of the last step, N: state.
    impulse : ndarray, shape (n_points, dim)
        What points got in the step from particles that were put back, kg m/s.
    solution : ndarray, shape (n_points, dim)
        The velocity that the last step was solved for, by the maps of that step, m/s.
    drag : ndarray, shape (n, dim)
        On each wall particle in the last step by viscosity, where that is solved for, N.
    """

    def __init__(
        self, comm: MPI.Comm, grid: CellGrid, spacing: float, reach: float, points: np.ndarray, facets: np.ndarray,
        thin: np.ndarray, no_slip: bool, taken: np.ndarray,
    ) -> None:  # fmt: skip
        self.comm, self.grid, self.facets, self._reach = comm, grid, facets, reach
        self._rims = Rims(points, facets)
        self._hung = hung = hang(points, facets, thin, self._rims, spacing, reach, taken)
        self.facet, self.weights, self.depth = hung.facet, hung.weights, hung.depth
        count, dim = len(self.facet), points.shape[1]
        corners = facets[self.facet]
        entries = self.weights.ravel(), (corners.ravel(), np.repeat(np.arange(count), dim))
        self._spread = csr_matrix(entries, shape=(len(points), count))
        self._no_slip = np.full(count, no_slip)
        self._inv_edge = 1.0 / (EDGE * spacing)
        self._period = np.where(grid.periodic, grid.counts * grid.side, 0.0)
        self.force, self.last, self.impulse = np.zeros((count, dim)), np.zeros_like(points), np.zeros_like(points)
        self.drag, self.solution = np.zeros((count, dim)), np.zeros_like(points)
        self._lists = PairLists()
        self._anchor = points
        self._met: Met | None = None
        still = np.zeros_like(points)
        self.place(points, still, still)
        feet = self.x + self.depth[:, None] * self.normal
        self._bounds = self._rims.bounds(points, feet, self.facet, spacing, reach)
        self._bounds[~hung.sided] = -1

    def place(self, points: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray | None = None) -> None:
        """Bring the surface to a place: all arguments of shape (n_points, dim). Not collective."""
        self.points, self.velocity = points, velocity
        if acceleration is not None:
            self.acceleration = acceleration
        area = np.linalg.norm(area_vectors(points, self.facets), axis=1)
        self.normal, self._outward = unit_normals(points, self.facets)[self.facet], self._rims.outward(points)
        self.x = self.at_feet(points) - self.depth[:, None] * self.normal
        past = np.flatnonzero(self._hung.rim >= 0)
        self.x[past] += self._hung.way[past, None] * self._outward[self._hung.rim[past]]
        self._volume = self._hung.share * area[self.facet] + self._hung.fixed
        if self._met is not None:
            self._met = self._met._replace(rows=self._wall_rows())

    @property
    def met(self) -> Met:
        """Rows and pairs of this rank, as last listed."""
        assert self._met is not None, "pairs have been listed"
        return self._met

    def at_feet(self, values: np.ndarray) -> np.ndarray:
        """Return what values of the points (n_points, dim) are where the wall particles hang, shape (n, dim)."""
        return np.einsum("na,nad->nd", self.weights, values[self.facets[self.facet]])

    def to_points(self, values: np.ndarray) -> np.ndarray:
        """Return what belongs to wall particles (n, dim) shared out among the points, shape (n_points, dim)."""
        return self._spread @ values

    def knock(self, facets: np.ndarray, x: np.ndarray, impulse: np.ndarray) -> None:
        """Take what particles lose that facets throw back, for ``impulse``. Collective.

        Parameters
        ----------
        facets : ndarray of int, shape (k,)
        x : ndarray, shape (k, dim)
            Where that is, m.
        impulse : ndarray, shape (k, dim)
            kg m/s.
        """
        corners = self.points[self.facets[facets]]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        rest = np.einsum("kab,kb->ka", np.linalg.pinv(edges), x - corners[:, 0])
        weights = np.clip(np.column_stack([1.0 - rest.sum(axis=1), rest]), 0.0, 1.0)
        weights /= weights.sum(axis=1, keepdims=True)
        mine = np.zeros_like(self.points)
        np.add.at(mine, self.facets[facets], weights[:, :, None] * impulse[:, None, :])
        self.impulse = np.empty_like(mine)
        self.comm.Allreduce(mine, self.impulse)

    def farthest(self) -> float:
        """Return how far a point has gone since pairs were listed at most, m."""
        return float(np.sqrt(np.sum((self.points - self._anchor) ** 2, axis=1).max(initial=0.0)))

    def meet(self, fluid: Swarm, reach: float) -> None:
        """List the pairs with the fluid's particles, which have just been sorted. Not collective."""
        every, x, cells = self._local(fluid)
        order, first = sorted_rows(cells - fluid.corner, fluid.counts, every)
        self.rows, self._shift = every[order], (x - self.x[every])[order]
        inner = np.all((cells > fluid.corner) & (cells < fluid.corner + fluid.counts - 1), axis=1)
        self.owned = inner[order]
        self._anchor = self.points
        rows = self._wall_rows()
        feet = rows.x + rows.depth[:, None] * rows.normal
        pairs = self._lists.wall(fluid["x"], fluid.owned, fluid.first, rows.x, self.owned, first, fluid.counts, reach)
        slack = reach - self._reach  # until pairs are listed again
        sided = self._hung.sided[self.rows]
        if not self._hung.sided.any():
            self._met = Met(rows, pairs)
            return
        pairs = Pairs(*_before(*pairs, fluid["x"], feet, rows.normal, sided, slack))
        self._met = Met(rows, pairs, seen=np.empty(len(pairs.other)))

    def look(self, x: np.ndarray) -> None:
        """Find how much fluid rows at x (n, dim) see of the wall rows near them. Not collective."""
        met, bounds = self.met, self._bounds[self.rows]
        if met.seen is None:
            return
        wall, which = met.rows, np.maximum(bounds, 0)
        if len(self._outward):
            outward = self._outward[which]
            end = self.points[self._rims.ends[which, 0]] + self._shift[:, None]
        else:
            outward = end = np.zeros((*which.shape, x.shape[1]))
        limit = np.where(bounds < 0, np.inf, np.sum(end * outward, axis=2))
        find = seen_loop(x.shape[1], bounds.shape[1])
        sided = self._hung.sided[self.rows]
        find(*met.pairs, x, wall.x, wall.normal, wall.depth, sided, outward, limit, self._inv_edge, met.seen)

    def _local(self, fluid: Swarm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which wall particles, or their images, are in this rank's cells, where, and in which cells."""
        found = []
        for shift in product(*((-1, 0, 1) if p > 0 else (0,) for p in self._period)):
            x = self.x + np.array(shift) * self._period
            cells = self.grid.of(x)
            here = np.all((cells >= fluid.corner) & (cells < fluid.corner + fluid.counts), axis=1)
            found.append((np.flatnonzero(here), x[here], cells[here]))
        every, x, cells = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return every, x, cells

    def _wall_rows(self) -> WallRows:
        rows = self.rows
        return WallRows(
            self.x[rows] + self._shift,
            self.at_feet(self.velocity)[rows],
            self.at_feet(self.acceleration)[rows],
            self._volume[rows],
            np.ascontiguousarray(self.normal[rows]),
            self.depth[rows],
            self._no_slip[rows],
        )

    def press(self, passes: Passes, fluid: FluidRows, p: np.ndarray) -> None:
        """Take the pressure from the fluid's p (n,). Collective."""
        pressure = passes.wall_pressure(fluid, p, self.met)
        pressure = self._gathered(pressure)[self.rows]
        self._met = self.met._replace(pressure=pressure, density=passes.law.density(pressure))

    def take(self, force: np.ndarray) -> None:
        """Take this rank's part of the forces of the last pass. Collective."""
        self.force = self._gathered(force)

    def take_drag(self, force: np.ndarray) -> None:
        """Take this rank's part of what viscosity adds, where it is solved for. Collective."""
        self.drag = self._gathered(force)

    @property
    def known(self) -> np.ndarray:
        """What is known of the velocities of the rows before a step is solved, shape (n, dim): nothing."""
        return np.zeros((len(self.rows), self.x.shape[1]))

    @property
    def solved(self) -> np.ndarray:
        """The velocities of the rows that a step was solved for, shape (n, dim), m/s."""
        return self.at_feet(self.solution)[self.rows]

    def _gathered(self, values: np.ndarray) -> np.ndarray:
        """Return on all ranks what the owners of wall particles have of them; zero of those in no one's cells."""
        every = np.zeros((len(self.x), *values.shape[1:]))
        every[self.rows[self.owned]] = values[self.owned]
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, every)  # of one that is not zero: no rounding
        return every


@njit(cache=True)
def _before(start, other, x, feet, normal, sided, slack):
    """Return the pairs of particles that are before the facet of the wall particle, or nearly, if it is sided."""
    kept, n = np.zeros_like(start), 0
    for i in range(x.shape[0]):
        for k in range(start[i], start[i + 1]):
            d, height = other[k], 0.0
            for axis in range(x.shape[1]):
                height += (x[i, axis] - feet[d, axis]) * normal[d, axis]
            if height > -slack or not sided[d]:
                other[n] = d
                n += 1
        kept[i + 1] = n
    return kept, other[:n]
