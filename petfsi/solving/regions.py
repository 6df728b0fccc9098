"""Regions of fluid that nothing leaves: what they keep from the solver, and how they keep their volume."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from petfsi.fields.fluids import PressureFluid
from petfsi.fields.slabs import Reader, State
from petfsi.fields.solids import SolidField
from petfsi.solving.lasting import TABLES
from petfsi.solving.nullspace import attach_null_space, unfelt_pressures
from petfsi.solving.system import System
from petfsi.solving.tracking import RegionTracker

#: A region keeps its volume to this part of it, and to this part of a cell.
CLOSE = 1e-11
#: What sums over a surface leave of a volume, as a part of it.
ROUND_OFF = 1e-13
#: Where sources swing, the next volume wanted lags behind their change by a quarter of this: they then shrink by .61
#: a step, which is nearly the fastest.
DAMPING = 0.15


class ClosedRegions:
    """Tells PETSc which uniform pressures no equation sees, and closes each region's volume.

    A region closed by rigid walls leaves its mean pressure free. One that an elastic wall closes does not, except
    to a pressure block that is inverted by itself: there PETSc makes the right-hand side compatible by spreading
    the region's net flux evenly over its cells.

    The system keeps volumes by the velocities of walls at one instant; what the walls enclose then drifts with the
    square of the step. So a region with elastic walls has a volume V0 that it keeps: its rows get the source

        s = (V0 - V(d~) - m . J^T (D0 - d~)) / k,       D0 + k w  being the end of the step

    in all, spread by volume: Newton's step towards V = V0 there (where w holds in the middle of the step,
    (V0 - V^n) / h). What is left after the solve, which is of second order, asks for another, with the same matrix.
    With Newmark's rule, d^{n+1} = d^n + h/2 (u^n + w), each source asks for its negative in the next step and swings
    undamped about what is wanted; so there V^{n+1} - V0 = .15 h (s^n - s^{n-1}) / 4, and V0 is what the first half of
    a step with the velocities at the start makes of it. Sides let in the mean of their flows at a step's begin and end;
    where those velocities make room for what comes in at the start, that counts once.

    Parameters
    ----------
    system : System
        The system that has the fluid's block.
    fluid : PressureFluid
        The fluid.
    solid : SolidField or None
        What may bound regions.
    decoupled : bool
        Whether the pressure block is inverted by itself: then no source can close a volume.

    Attributes
    ----------
    unfelt : list of ndarray
        Pressures, even in each region, that no solid feels, as ``attach`` found them: this rank's part.
    ways : ndarray, shape (n_unfelt, n_regions)
        What they are in each region.
    """

    def __init__(self, system: System, fluid: PressureFluid, solid: SolidField | None, decoupled: bool) -> None:
        self.system, self.fluid, self.solid = system, fluid, solid
        self.decoupled = decoupled
        self._tracker = RegionTracker(system.comm, fluid, solid, system.couplings)
        self._attached_for: tuple[int, ...] | None = None
        self.unfelt: list[np.ndarray] = []
        self.ways = np.zeros((0, 0))
        self._starts = True  # at time zero, from a scene's start
        # by present region: the volumes to keep and to aim at now, and what comes in through sides and from sources
        self._kept = self._wanted = self._inflow = self._source = np.zeros(0)
        self._stride = 0.0

    @property
    def members(self) -> list[np.ndarray]:
        """Of each present region, 1 on its unknowns and 0 elsewhere: this rank's part."""
        return self._tracker.members

    @property
    def elastic(self) -> np.ndarray:
        """Which of these a solid bounds."""
        return self._tracker.elastic

    @property
    def volumes(self) -> np.ndarray:
        """Of each region that was closed at first, see ``Tracked``."""
        return self._tracker.volumes

    def rewind(self) -> None:
        """Go back to the regions of the step last accepted."""
        self._tracker.rewind()

    def adopt(self, system: System) -> None:
        """Speak to another system of the same fields from now on."""
        self.system, self._attached_for = system, None

    def find(self) -> None:
        """Find the regions of the present geometry, and which of those known they are. Collective."""
        if self._tracker.find():
            self._attached_for = None

    # ---- what PETSc is told -----------------------------------------------------------------------------------

    def attach(self) -> None:
        """Hand the regions' null vectors to PETSc, if matrices or geometry have changed. Collective."""
        fluid, system = self.fluid, self.system
        version = (fluid.geometry_version, *(coupling.n_assembled for coupling in system.couplings))
        if version == self._attached_for:
            return
        self._attached_for = version
        members = self._tracker.members
        self.ways = unfelt_pressures(system, fluid, self.solid, members, self._tracker.elastic)
        self.unfelt = [np.tensordot(way, np.array(members), axes=1) for way in self.ways]
        attach_null_space(fluid.block, members if self.decoupled else self.unfelt)
        if system.index_sets:
            whole = np.zeros((len(self.unfelt), system.solution.local_size))
            for row, values in zip(whole, self.unfelt, strict=True):
                row[system.piece(fluid.name)] = values
            attach_null_space(system.operator, list(whole))

    @contextmanager
    def coupled(self) -> Iterator[None]:
        """Have solid and pressure solved at once inside, not the pressure by itself. Collective."""
        decoupled, self.decoupled, self._attached_for = self.decoupled, False, None
        self.attach()
        try:
            yield
        finally:
            self.decoupled, self._attached_for = decoupled, None
            self.attach()

    # ---- closing their volumes --------------------------------------------------------------------------------

    @property
    def _closes(self) -> bool:
        """Whether any region's volume can be closed."""
        return self._tracker.walls is not None and not self.decoupled and bool(self._tracker.elastic.any())

    def go_on(self) -> None:
        """Take the state restored for that of a run under way, whatever its time."""
        self._starts = False

    def aim(self, time: float, dt: float) -> None:
        """Give the fluid the sources that lead to the regions' volumes at the end of a step of dt. Collective."""
        self.fluid.source = None
        if not self._closes:
            return
        tracker, walls, known = self._tracker, self._tracker.walls, self._tracker.known
        assert walls is not None and self.solid is not None and known is not None
        landing = self.solid.landing(dt)
        if landing.holds:
            change = walls.slope(self.solid.surface_shift())
        else:
            change = walls.change(self.solid.surface_arrival(None, dt))
        half = self._first_half(dt) if landing.swings and time == 0.0 and self._starts else np.zeros_like(change)
        here, change, half = self.system.comm.allreduce(np.array([tracker.inflows(), change, half]))

        def of(table: dict[int, float]) -> np.ndarray:
            return np.array([table.get(number, 0.0) for number in tracker.lasting])

        self._stride, self._inflow = landing.stride, here
        self._kept = np.array([known.target.get(number, np.nan) for number in tracker.lasting])
        came = of(known.inflow)
        if landing.swings and time == 0.0:
            half -= dt / 2 * came
        self._kept += dt * ((came + here) / 2 if landing.holds else here) + half
        self._kept[~tracker.elastic] = np.nan
        self._wanted = self._kept.copy()
        if landing.swings:
            self._wanted += DAMPING * dt * (of(known.source) - of(known.before)) / 4
        self._source = np.zeros_like(here)
        missing = self._wanted - tracker.sizes - change - self._stride * here
        # where nothing gives way to both, as regions on two sides of a beam, round-off must not be pressed out
        missing[np.abs(missing) <= ROUND_OFF * np.maximum(self._wanted, self.fluid.cell_volume)] = 0.0
        self._spread(missing / self._stride)

    def _first_half(self, dt: float) -> np.ndarray:
        """Return this rank's share of what regions gain in dt/2 at the rate with which the scene begins. Collective.

        By differences over ways of dt and 2 dt there and back, exact as volumes are polynomials of the third degree.
        """
        walls, solid = self._tracker.walls, self.solid
        assert walls is not None and solid is not None
        u = solid.unknown()
        # the end of a step is d + dt/2 (u + w)
        v = [walls.change(solid.surface_arrival(w * u, dt)) for w in (0, -2, 1, -3)]
        return (8 * (v[0] - v[1]) - (v[2] - v[3])) / 12

    def _spread(self, rates: np.ndarray) -> np.ndarray:
        """Add sources to the fluid's by region, evenly; nan is none. Return what was added to this rank's cells."""
        members, sizes = self._tracker.members, self._tracker.cut_sizes
        volumes, added = self.fluid.volumes(), np.zeros(self.fluid.layout.n_local)
        rates = np.where(np.isnan(rates) | (sizes <= 0.0), 0.0, rates)
        self._source = self._source + rates
        for k in np.flatnonzero(rates):
            added += rates[k] / sizes[k] * members[k] * volumes
        self.fluid.source = added if self.fluid.source is None else self.fluid.source + added
        return added

    def measure(self, velocity: np.ndarray, dt: float) -> None:
        """Find the regions' volumes at the end of a step with this solution of the solid's. Collective."""
        self._tracker.measure(velocity, dt)

    def swept(self, dt: float) -> np.ndarray:
        """Return this rank's share of what regions cannot take of what sides let in in a step of dt. Collective."""
        return self._tracker.swept(dt)

    def inject(self, source: np.ndarray) -> None:
        """Let what comes into cells from nowhere come into the step assembled, too. Collective."""
        self.fluid.source = source if self.fluid.source is None else self.fluid.source + source
        if self.system.couplings:
            self.system.couplings[0].inject(source)
        else:
            self.fluid.rhs += source

    def improve(self) -> bool:
        """Add sources to the right-hand side if a region was measured to have another volume; say so."""
        if not self._closes:
            return False
        missing = self._wanted - self._tracker.end
        # what nothing gives way to is not to be had
        missing -= np.linalg.pinv(self.ways) @ (self.ways @ np.nan_to_num(missing))
        if not np.any(np.abs(missing) > CLOSE * np.maximum(self._wanted, self.fluid.cell_volume)):
            return False
        self.system.couplings[0].inject(self._spread(missing / self._stride))
        return True

    def settle(self) -> None:
        """Take over the step last measured: what its regions are to keep."""
        tracker, closes = self._tracker, self._closes
        assert tracker.known is not None
        new: tuple[dict[int, float], ...] = ({}, {}, {}, {}, {})
        for k, number in enumerate(tracker.lasting):
            keeps = closes and not np.isnan(self._kept[k])
            values = (
                self._kept[k] if keeps else tracker.end[k],
                tracker.end[k],
                self._inflow[k] if closes else 0.0,
                self._source[k] if closes else 0.0,
                tracker.known.source.get(number, 0.0),
            )
            for table, value in zip(new, values, strict=True):
                table[number] = float(value)
        tables: dict[str, Any] = dict(zip(TABLES, new, strict=True))
        tracker.accept(tables)

    # ---- what others read -------------------------------------------------------------------------------------

    def keep(self) -> Callable[[], State]:
        """Return what gives, later, which lasting region cells and facets lie in or bound now.

        And what is known of that.
        """
        return self._tracker.keep()

    def restore(self, read: Reader) -> None:
        """Take up a state. Collective."""
        self._tracker.restore(read)

    def volume_error(self, dt: float) -> float:
        """Return the largest relative change of a region's volume in the last step, |sum of net outflows| dt / V.

        Without what closes it. Where the pressure block was inverted by itself this is the size of the correction.
        Collective.
        """
        members = self._tracker.members
        if not members:
            return 0.0
        outflow = self.system.residual.array[self.system.piece(self.fluid.name)] / self.fluid.row_scale
        sums = self.system.comm.allreduce(np.array([outflow @ member for member in members]))
        return float(np.max(np.abs(sums) * dt / self._tracker.cut_sizes))
