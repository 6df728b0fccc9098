"""Regions of fluid that nothing leaves: what they keep from the solver, and how they keep their volume."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.slabs import Reader, Slab, State
from petfsi.fields.solids import SolidField
from petfsi.fields.stored import outside, refuse
from petfsi.solving.lasting import TABLES, Tracked, bounded_most, looked_up, meeting, pairs
from petfsi.solving.system import System

if TYPE_CHECKING:
    from petfsi.couplings.enclosure import Enclosure

#: A region keeps its volume to this part of it, and to this part of a cell.
CLOSE = 1e-11
#: What sums over a surface leave of a volume, as a part of it.
ROUND_OFF = 1e-13
#: Even pressures whose squared force is this part of what they push with by themselves are not felt.
UNFELT = 1e-14
#: A volume that changes without its walls by more than this part of a cell, or of itself, has jumped.
JUMP, SMALL = 0.05, 0.01
#: Where sources swing, the next volume wanted lags behind their change by a quarter of this: they then shrink by .61
#: a step, which is nearly the fastest.
DAMPING = 0.15
#: The largest number of a lasting region; there are tables as long.
_MOST = 10_000_000


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
        self._tracked: Tracked | None = None
        self._accepted: Tracked | None = None
        self._starts = True  # at time zero, from a scene's start
        self._found_for: tuple[int, ...] | None = None
        self._attached_for: tuple[int, ...] | None = None
        self._members: list[np.ndarray] = []
        self.unfelt: list[np.ndarray] = []
        self.ways = np.zeros((0, 0))
        self._elastic = np.zeros(0, dtype=bool)
        self._walls: Enclosure | None = None
        self._lasting: list[int] = []  # number of each present region; 0 if it has none
        self._sizes = self._cut_sizes = np.zeros(0)  # V(d~), and for the vertices as they were cut
        self._end = self._kept = self._wanted = np.zeros(0)
        self._inflow = self._source = np.zeros(0)
        self._stride = 0.0

    @property
    def volumes(self) -> np.ndarray:
        """Of each region that was closed at first, see ``Tracked``."""
        return np.zeros(0) if self._tracked is None else self._tracked.volumes

    def rewind(self) -> None:
        """Go back to the regions of the step last accepted."""
        self._tracked, self._found_for = self._accepted, None

    def adopt(self, system: System) -> None:
        """Speak to another system of the same fields from now on."""
        self.system, self._attached_for = system, None

    # ---- which regions there are ------------------------------------------------------------------------------

    def find(self) -> None:
        """Find the regions of the present geometry, and which of those known they are. Collective."""
        fluid, couplings = self.fluid, self.system.couplings
        version = (fluid.geometry_version, *(coupling.n_coupled for coupling in couplings))
        if version == self._found_for:
            return
        self._found_for, self._attached_for = version, None
        touched = next((coupling.touched for coupling in couplings), None)
        regions = fluid.closed_regions(touched)
        self._members = [member for member, _ in regions]
        self._elastic = np.array([touches for _, touches in regions], dtype=bool)
        self._walls = None
        if self._members and couplings:
            self._walls = couplings[0].enclose(self._members)
        volumes = fluid.volumes()
        sizes = np.array([member @ volumes for member in self._members])
        parts = np.array([sizes, np.zeros_like(sizes), np.zeros_like(sizes)])
        if self._walls is not None and self.solid is not None:
            parts[1] = self._walls.change(self.solid.surface_positions())
            parts[2] = self._walls.change(self.solid.surface_present())
        if self._tracked is None:
            self._begin(parts)
        else:
            self._follow(parts)

    def _begin(self, parts: np.ndarray) -> None:
        """Give the first regions their numbers, see ``_follow``. Collective: one reduction."""
        self._cut_sizes, moved, _, inflow = self.system.comm.allreduce(np.array([*parts, self._inflows()]))
        self._sizes = self._end = self._cut_sizes + moved
        self._lasting = list(range(1, len(self._sizes) + 1))
        target, came = (dict(zip(self._lasting, of.tolist(), strict=True)) for of in (self._sizes, inflow))
        facets = self._facet_numbers(self._facet_labels())
        self._tracked = self._accepted = Tracked(self._numbers(), facets, target, target, came, {}, {}, self._sizes)

    def _numbers(self) -> np.ndarray:
        """Return the lasting region of each lasting unknown."""
        here = np.zeros(self.fluid.n_cells)
        for number, member in zip(self._lasting, self._members, strict=True):
            here += number * member[: self.fluid.n_cells]
        return here

    def _facet_labels(self) -> np.ndarray:
        """Return which of the present regions each facet bounds, counted from 1; 0 is none. Collective.

        As many facets where nothing is closed: a run that goes on reads what a checkpoint has of each.
        """
        if self._walls is None:
            return np.zeros(sum(coupling.n_enclosing for coupling in self.system.couplings), dtype=np.int64)
        return bounded_most(self.system.comm.allreduce(self._walls.parts()))

    def _facet_numbers(self, labels: np.ndarray) -> np.ndarray:
        """Return the lasting region of each facet."""
        return np.array([0, *self._lasting])[labels]

    def _follow(self, parts: np.ndarray) -> None:
        """Find which of the lasting regions the present ones are: those that meet each other alone.

        Parameters
        ----------
        parts : ndarray, shape (3, n)
            This rank's part of the volumes as they were cut, of what they are more where the step's equations are
            taken, and of what they were more at its begin. Collective.
        """
        assert self._tracked is not None
        known, n_new = self._tracked, parts.shape[1]
        old, labels = sorted(known.target), self._facet_labels()
        place = np.zeros(1 + max([*old, int(known.number.max(initial=0)), int(known.facets.max(initial=0))]), dtype=int)
        place[old] = np.arange(1, len(old) + 1)
        present = np.zeros(self.fluid.n_cells, dtype=np.int64)
        for k, member in enumerate(self._members, start=1):
            present += k * (member[: self.fluid.n_cells] > 0)
        shared = pairs(place[known.number.astype(np.int64)], present, len(old), n_new)
        total = self.system.comm.allreduce(np.concatenate((parts.ravel(), shared.ravel())))
        self._cut_sizes, moved, past = total[: 3 * n_new].reshape(3, n_new)
        self._sizes = self._end = self._cut_sizes + moved
        cells = total[3 * n_new :].reshape(shared.shape)
        meets = meeting(cells, pairs(place[known.facets], labels, len(old), n_new))
        same = meets & (meets.sum(axis=0) == 1) & (meets.sum(axis=1) == 1)[:, None]
        first, second = np.nonzero(same)
        self._lasting = [0] * n_new
        for i, k in zip(first, second, strict=True):
            self._lasting[k] = old[i]
        # a number that has become free may be given again
        kept: dict[str, Any] = {
            name: {k: v for k, v in getattr(known, name).items() if k in self._lasting} for name in TABLES
        }
        if self._walls is not None:
            self._allow_for_jumps(kept["target"], kept["volume"], self._cut_sizes + past)
        self._name_others()
        self._tracked = Tracked(
            number=self._numbers(), facets=self._facet_numbers(labels), volumes=self._reported(self._sizes), **kept
        )

    def _allow_for_jumps(self, target: dict[int, float], volume: dict[int, float], begin: np.ndarray) -> None:
        """Change targets by what volumes at the step's begin jumped because of how cells are counted, not of walls.

        Where walls overlap, cells count to the fluid in part or not as planes of the grid are passed; to make good for
        that would press the solids out of shape.

        Parameters
        ----------
        target, volume : dict of int to float
            By lasting region; the first is changed.
        begin : ndarray
            The present regions' volumes at the step's begin, seen from where the step's equations are taken.
        """
        for number, now in zip(self._lasting, begin, strict=True):
            jump = now - volume.get(number, now)
            if number in target and abs(jump) > min(JUMP * self.fluid.cell_volume, SMALL * abs(now)):
                target[number] += jump

    def _name_others(self) -> None:
        """Give regions that are new the lowest numbers that are free, beyond those of the first ones."""
        free = len(self.volumes) + 1
        for k, number in enumerate(self._lasting):
            if number:
                continue
            while free in self._lasting:
                free += 1
            self._lasting[k] = free

    def _reported(self, volumes: np.ndarray) -> np.ndarray:
        """Return the volumes of the first regions, given those of the present ones."""
        found = np.full(len(self.volumes), np.nan)
        for number, volume in zip(self._lasting, volumes, strict=True):
            if number <= len(found):
                found[number - 1] = volume
        return found

    def attach(self) -> None:
        """Hand the regions' null vectors to PETSc, if matrices or geometry have changed. Collective."""
        fluid, system = self.fluid, self.system
        version = (fluid.geometry_version, *(coupling.n_assembled for coupling in system.couplings))
        if version == self._attached_for:
            return
        self._attached_for = version
        self.ways = self._find_unfelt()
        self.unfelt = [np.tensordot(way, np.array(self._members), axes=1) for way in self.ways]
        _attach(fluid.block, self._members if self.decoupled else self.unfelt)
        if system.index_sets:
            whole = np.zeros((len(self.unfelt), system.solution.local_size))
            for row, values in zip(whole, self.unfelt, strict=True):
                row[system.piece(fluid.name)] = values
            _attach(system.operator, list(whole))

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

    def _find_unfelt(self) -> np.ndarray:
        """Return the pressures, even in each region, that no solid feels: an orthogonal set, shape (n, n_regions).

        Those of regions with rigid walls alone, and what rooms on two sides of a beam have in common. Collective.
        """
        n = len(self._members)
        if not np.any(self._elastic):
            return np.eye(n)
        forces = []
        for coupling in self.system.couplings:
            block = coupling.blocks[self.solid.name, self.fluid.name]  # type: ignore[union-attr]
            even, force = block.createVecs()
            for member in self._members:
                even.array = member
                block.mult(even, force)
                forces.append(force.array_r.copy())
        pushed = np.array(forces).reshape(-1, n, len(forces[0]))
        sizes = np.array([[member @ other for other in self._members] for member in self._members])
        gram, sizes = self.system.comm.allreduce(np.array([np.einsum("ckx,clx->kl", pushed, pushed), sizes]))
        scale = np.sqrt(np.where(gram.diagonal() > 0.0, gram.diagonal(), 1.0))
        # in units in which each region alone pushes as hard as the others
        felt, ways = np.linalg.eigh(gram / np.outer(scale, scale))
        kernel = ways[:, felt <= UNFELT] / scale[:, None]
        if not kernel.shape[1]:
            return np.zeros((0, n))
        # orthogonal as pressures
        root = np.sqrt(sizes.diagonal())
        basis, _ = np.linalg.qr(root[:, None] * kernel)
        return basis.T / root

    # ---- closing their volumes --------------------------------------------------------------------------------

    @property
    def _closes(self) -> bool:
        """Whether any region's volume can be closed."""
        return self._walls is not None and not self.decoupled and bool(self._elastic.any())

    def go_on(self) -> None:
        """Take the state restored for that of a run under way, whatever its time."""
        self._starts = False

    def aim(self, time: float, dt: float) -> None:
        """Give the fluid the sources that lead to the regions' volumes at the end of a step of dt. Collective."""
        self.fluid.source = None
        if not self._closes:
            return
        assert self._walls is not None and self.solid is not None and self._tracked is not None
        landing, known = self.solid.landing(dt), self._tracked
        if landing.holds:
            change = self._walls.slope(self.solid.surface_shift())
        else:
            change = self._walls.change(self.solid.surface_arrival(None, dt))
        half = self._first_half(dt) if landing.swings and time == 0.0 and self._starts else np.zeros_like(change)
        here, change, half = self.system.comm.allreduce(np.array([self._inflows(), change, half]))

        def of(table: dict[int, float]) -> np.ndarray:
            return np.array([table.get(number, 0.0) for number in self._lasting])

        self._stride, self._inflow = landing.stride, here
        self._kept = np.array([known.target.get(number, np.nan) for number in self._lasting])
        came = of(known.inflow)
        if landing.swings and time == 0.0:
            half -= dt / 2 * came
        self._kept += dt * ((came + here) / 2 if landing.holds else here) + half
        self._kept[~self._elastic] = np.nan
        self._wanted = self._kept.copy()
        if landing.swings:
            self._wanted += DAMPING * dt * (of(known.source) - of(known.before)) / 4
        self._source = np.zeros_like(here)
        missing = self._wanted - self._sizes - change - self._stride * here
        # where nothing gives way to both, as regions on two sides of a beam, round-off must not be pressed out
        missing[np.abs(missing) <= ROUND_OFF * np.maximum(self._wanted, self.fluid.cell_volume)] = 0.0
        self._spread(missing / self._stride)

    def _first_half(self, dt: float) -> np.ndarray:
        """Return this rank's share of what regions gain in dt/2 at the rate with which the scene begins. Collective.

        By differences over ways of dt and 2 dt there and back, exact as volumes are polynomials of the third degree.
        """
        assert self._walls is not None and self.solid is not None
        u = self.solid.unknown()
        # the end of a step is d + dt/2 (u + w)
        v = [self._walls.change(self.solid.surface_arrival(w * u, dt)) for w in (0, -2, 1, -3)]
        return (8 * (v[0] - v[1]) - (v[2] - v[3])) / 12

    def _inflows(self) -> np.ndarray:
        """Return this rank's share of what comes in through sides, by region, m^3/s (m^2/s in 2D)."""
        rate = self.fluid.inflow()
        return np.array([0.0 if rate is None else float(member @ rate) for member in self._members])

    def _spread(self, rates: np.ndarray) -> np.ndarray:
        """Add sources to the fluid's by region, evenly; nan is none. Return what was added to this rank's cells."""
        volumes, added = self.fluid.volumes(), np.zeros(self.fluid.layout.n_local)
        rates = np.where(np.isnan(rates) | (self._cut_sizes <= 0.0), 0.0, rates)
        self._source = self._source + rates
        for k in np.flatnonzero(rates):
            added += rates[k] / self._cut_sizes[k] * self._members[k] * volumes
        self.fluid.source = added if self.fluid.source is None else self.fluid.source + added
        return added

    def measure(self, velocity: np.ndarray, dt: float) -> None:
        """Find the regions' volumes at the end of a step with this solution, where walls can be followed. Collective.

        Parameters
        ----------
        velocity : ndarray
            The solid's part of the solution, this rank's.
        dt : float
        """
        if self._walls is not None and self.solid is not None:
            change = self._walls.change(self.solid.surface_arrival(velocity, dt))
            self._end = self._cut_sizes + self.system.comm.allreduce(change)

    def swept(self, dt: float) -> np.ndarray:
        """Return this rank's share of what regions cannot take of what sides let in in a step of dt, m^3 (m^2 in 2D).

        What comes in at the step's rate, less what they gain as prescribed points go and free ones stay. Collective.
        """
        gained, solid = np.zeros(len(self._members)), self.solid
        if self._walls is not None and solid is not None:
            given = solid.fixed_velocity()[solid.layout.start : solid.layout.end]
            here = solid.surface_present()
            way = solid.surface_arrival(given, dt) - here
            way[np.diff(solid.surface().fixed_map.indptr).reshape(way.shape) == 0] = 0.0
            gained = self._walls.change(here + way) - self._walls.change(here)
        return dt * self._inflows() - gained

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
        missing = self._wanted - self._end
        # what nothing gives way to is not to be had
        missing -= np.linalg.pinv(self.ways) @ (self.ways @ np.nan_to_num(missing))
        if not np.any(np.abs(missing) > CLOSE * np.maximum(self._wanted, self.fluid.cell_volume)):
            return False
        self.system.couplings[0].inject(self._spread(missing / self._stride))
        return True

    def settle(self) -> None:
        """Take over the step last measured: what its regions are to keep."""
        assert self._tracked is not None
        known, closes = self._tracked, self._closes
        new: tuple[dict[int, float], ...] = ({}, {}, {}, {}, {})
        for k, number in enumerate(self._lasting):
            keeps = closes and not np.isnan(self._kept[k])
            values = (
                self._kept[k] if keeps else self._end[k],
                self._end[k],
                self._inflow[k] if closes else 0.0,
                self._source[k] if closes else 0.0,
                known.source.get(number, 0.0),
            )
            for table, value in zip(new, values, strict=True):
                table[number] = float(value)
        tables: dict[str, Any] = dict(zip(TABLES, new, strict=True))
        self._tracked = self._accepted = known._replace(volumes=self._reported(self._end), **tables)

    # ---- what others read -------------------------------------------------------------------------------------

    def keep(self) -> Callable[[], State]:
        """Return what gives, later, by cell and by facet which lasting region it lies in or bounds now.

        And what is known of that: what is tracked is replaced, never changed.
        """
        assert self._tracked is not None
        return partial(self._state, self._tracked)

    def _state(self, known: Tracked) -> State:
        comm = self.system.comm
        facets = known.facets
        n, mine = len(facets), slice(*_share(len(facets), comm))
        arrays = {}
        for name in ("region", *TABLES):
            of = None if name == "region" else getattr(known, name)
            by_cell = known.number if of is None else looked_up(of, known.number)
            by_facet = facets if of is None else looked_up(of, facets)
            arrays[name] = self.fluid.cells_slab(by_cell.astype(float))
            arrays[f"facet_{name}"] = Slab(by_facet[mine].astype(float), (mine.start,), (n,))
        return arrays

    def restore(self, read: Reader) -> None:
        """Take up a state. Collective."""
        assert self._tracked is not None
        comm, n = self.system.comm, len(self._tracked.facets)
        begin, end = _share(n, comm)
        number, *by_cell = (self.fluid.read_cells(read, name) for name in ("region", *TABLES))
        facets, *by_facet = (
            np.concatenate(comm.allgather(np.asarray(read(f"facet_{name}", (begin,), (end - begin,)), dtype=float)))
            for name in ("region", *TABLES)
        )
        names = zip(("region", "facet_region"), (number, facets), strict=True)
        refuse(comm, [outside(name, values, 0, _MOST, whole=True) for name, values in names])
        tables: tuple[dict[int, float], ...] = ({}, {}, {}, {}, {})
        for labels, values in ((number, by_cell), (facets, by_facet)):
            rows, first = np.unique(labels, return_index=True)
            for regions, *columns in comm.allgather((rows, *(value[first] for value in values))):
                for table, column in zip(tables, columns, strict=True):
                    table.update((int(r), float(v)) for r, v in zip(regions, column, strict=True) if r > 0)
        named: dict[str, Any] = dict(zip(TABLES, tables, strict=True))
        known = self._tracked._replace(number=number, facets=facets.astype(np.int64), **named)
        self._tracked, self._accepted, self._found_for = known, known, None

    def volume_error(self, dt: float) -> float:
        """Return the largest relative change of a region's volume in the last step, |sum of net outflows| dt / V.

        Without what closes it. Where the pressure block was inverted by itself this is the size of the correction.
        Collective.
        """
        if not self._members:
            return 0.0
        outflow = self.system.residual.array[self.system.piece(self.fluid.name)] / self.fluid.row_scale
        sums = self.system.comm.allreduce(np.array([outflow @ member for member in self._members]))
        return float(np.max(np.abs(sums) * dt / self._cut_sizes))


def _share(n: int, comm: MPI.Comm) -> tuple[int, int]:
    """Return begin and end of this rank's share of ``n`` things."""
    return n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size


def _attach(mat: PETSc.Mat, members: list[np.ndarray]) -> None:
    space = petsc.null_space(mat.createVecRight(), members)
    mat.setNullSpace(space)
    mat.setTransposeNullSpace(space)
