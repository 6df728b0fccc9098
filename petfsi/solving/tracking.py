"""Which regions of fluid nothing leaves, and which of those known earlier they are, as walls move, meet and part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.slabs import Reader, State
from petfsi.fields.solids import SolidField
from petfsi.solving.lasting import TABLES, Tracked, bounded_most, meeting, pairs, read_tracked, tracked_state

if TYPE_CHECKING:
    from petfsi.couplings.enclosure import Enclosure

#: A volume that changes without its walls by more than this part of a cell, or of itself, has jumped.
JUMP, SMALL = 0.05, 0.01


class RegionTracker:
    """Finds closed regions, and follows them and their volumes from step to step.

    Parameters
    ----------
    comm : MPI.Comm
    fluid : PressureFluid
    solid : SolidField or None
        What may bound regions.
    couplings : sequence of Coupling

    Attributes
    ----------
    members : list of ndarray
        Of each present region, 1 on its unknowns and 0 elsewhere: this rank's part.
    elastic : ndarray of bool
        Which of them a solid bounds.
    walls : Enclosure or None
        What they gain when walls move, where these can be followed.
    lasting : list of int
        Their lasting numbers.
    sizes, cut_sizes, end : ndarray
        Their volumes where the step's equations are taken, for the surface as it was cut, and as measured at the end
        of the step, m^3 (m^2 in 2D).
    known : Tracked or None
        What is known of lasting regions: replaced, never changed.
    """

    def __init__(
        self, comm: MPI.Comm, fluid: PressureFluid, solid: SolidField | None, couplings: Sequence[Coupling]
    ) -> None:
        self.comm, self.fluid, self.solid, self.couplings = comm, fluid, solid, couplings
        self.known: Tracked | None = None
        self._accepted: Tracked | None = None
        self._found_for: tuple[int, ...] | None = None
        self.members: list[np.ndarray] = []
        self.elastic = np.zeros(0, dtype=bool)
        self.walls: Enclosure | None = None
        self.lasting: list[int] = []
        self.sizes = self.cut_sizes = self.end = np.zeros(0)

    @property
    def volumes(self) -> np.ndarray:
        """Of each region that was closed at first, see ``Tracked``."""
        return np.zeros(0) if self.known is None else self.known.volumes

    def rewind(self) -> None:
        """Go back to the regions of the step last accepted."""
        self.known, self._found_for = self._accepted, None

    def find(self) -> bool:
        """Find the regions of the present geometry, and which of those known they are. Collective.

        Returns whether they may be others than those found last.
        """
        fluid, couplings = self.fluid, self.couplings
        version = (fluid.geometry_version, *(coupling.n_coupled for coupling in couplings))
        if version == self._found_for:
            return False
        self._found_for = version
        touched = next((coupling.touched for coupling in couplings), None)
        regions = fluid.closed_regions(touched)
        self.members = [member for member, _ in regions]
        self.elastic = np.array([touches for _, touches in regions], dtype=bool)
        self.walls = None
        if self.members and couplings:
            self.walls = couplings[0].enclose(self.members)
        volumes = fluid.volumes()
        sizes = np.array([member @ volumes for member in self.members])
        parts = np.array([sizes, np.zeros_like(sizes), np.zeros_like(sizes)])
        if self.walls is not None and self.solid is not None:
            parts[1] = self.walls.change(self.solid.surface_positions())
            parts[2] = self.walls.change(self.solid.surface_present())
        if self.known is None:
            self._begin(parts)
        else:
            self._follow(parts)
        return True

    def _begin(self, parts: np.ndarray) -> None:
        """Give the first regions their numbers, see ``_follow``. Collective: one reduction."""
        self.cut_sizes, moved, _, inflow = self.comm.allreduce(np.array([*parts, self.inflows()]))
        self.sizes = self.end = self.cut_sizes + moved
        self.lasting = list(range(1, len(self.sizes) + 1))
        target, came = (dict(zip(self.lasting, of.tolist(), strict=True)) for of in (self.sizes, inflow))
        facets = self._facet_numbers(self._facet_labels())
        self.known = self._accepted = Tracked(self._numbers(), facets, target, target, came, {}, {}, self.sizes)

    def _numbers(self) -> np.ndarray:
        """Return the lasting region of each lasting unknown."""
        here = np.zeros(self.fluid.n_cells)
        for number, member in zip(self.lasting, self.members, strict=True):
            here += number * member[: self.fluid.n_cells]
        return here

    def _facet_labels(self) -> np.ndarray:
        """Return which of the present regions each facet bounds, counted from 1; 0 is none. Collective.

        As many facets where nothing is closed: a run that goes on reads what a checkpoint has of each.
        """
        if self.walls is None:
            return np.zeros(sum(coupling.n_enclosing for coupling in self.couplings), dtype=np.int64)
        return bounded_most(self.comm.allreduce(self.walls.parts()))

    def _facet_numbers(self, labels: np.ndarray) -> np.ndarray:
        """Return the lasting region of each facet."""
        return np.array([0, *self.lasting])[labels]

    def _follow(self, parts: np.ndarray) -> None:
        """Find which of the lasting regions the present ones are: those that meet each other alone.

        Parameters
        ----------
        parts : ndarray, shape (3, n)
            This rank's part of the volumes as they were cut, of what they are more where the step's equations are
            taken, and of what they were more at its begin. Collective.
        """
        assert self.known is not None
        known, n_new = self.known, parts.shape[1]
        old, labels = sorted(known.target), self._facet_labels()
        place = np.zeros(1 + max([*old, int(known.number.max(initial=0)), int(known.facets.max(initial=0))]), dtype=int)
        place[old] = np.arange(1, len(old) + 1)
        present = np.zeros(self.fluid.n_cells, dtype=np.int64)
        for k, member in enumerate(self.members, start=1):
            present += k * (member[: self.fluid.n_cells] > 0)
        shared = pairs(place[known.number.astype(np.int64)], present, len(old), n_new)
        total = self.comm.allreduce(np.concatenate((parts.ravel(), shared.ravel())))
        self.cut_sizes, moved, past = total[: 3 * n_new].reshape(3, n_new)
        self.sizes = self.end = self.cut_sizes + moved
        cells = total[3 * n_new :].reshape(shared.shape)
        meets = meeting(cells, pairs(place[known.facets], labels, len(old), n_new))
        same = meets & (meets.sum(axis=0) == 1) & (meets.sum(axis=1) == 1)[:, None]
        first, second = np.nonzero(same)
        self.lasting = [0] * n_new
        for i, k in zip(first, second, strict=True):
            self.lasting[k] = old[i]
        # a number that has become free may be given again
        kept: dict[str, Any] = {
            name: {k: v for k, v in getattr(known, name).items() if k in self.lasting} for name in TABLES
        }
        if self.walls is not None:
            self._allow_for_jumps(kept["target"], kept["volume"], self.cut_sizes + past)
        self._name_others()
        self.known = Tracked(
            number=self._numbers(), facets=self._facet_numbers(labels), volumes=self._reported(self.sizes), **kept
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
        for number, now in zip(self.lasting, begin, strict=True):
            jump = now - volume.get(number, now)
            if number in target and abs(jump) > min(JUMP * self.fluid.cell_volume, SMALL * abs(now)):
                target[number] += jump

    def _name_others(self) -> None:
        """Give regions that are new the lowest numbers that are free, beyond those of the first ones."""
        free = len(self.volumes) + 1
        for k, number in enumerate(self.lasting):
            if number:
                continue
            while free in self.lasting:
                free += 1
            self.lasting[k] = free

    def _reported(self, volumes: np.ndarray) -> np.ndarray:
        """Return the volumes of the first regions, given those of the present ones."""
        found = np.full(len(self.volumes), np.nan)
        for number, volume in zip(self.lasting, volumes, strict=True):
            if number <= len(found):
                found[number - 1] = volume
        return found

    def inflows(self) -> np.ndarray:
        """Return this rank's share of what comes in through sides, by region, m^3/s (m^2/s in 2D)."""
        rate = self.fluid.inflow()
        return np.array([0.0 if rate is None else float(member @ rate) for member in self.members])

    def measure(self, velocity: np.ndarray, dt: float) -> None:
        """Find the regions' volumes at the end of a step with this solution, where walls can be followed. Collective.

        Parameters
        ----------
        velocity : ndarray
            The solid's part of the solution, this rank's.
        dt : float
        """
        if self.walls is not None and self.solid is not None:
            change = self.walls.change(self.solid.surface_arrival(velocity, dt))
            self.end = self.cut_sizes + self.comm.allreduce(change)

    def swept(self, dt: float) -> np.ndarray:
        """Return this rank's share of what regions cannot take of what sides let in in a step of dt, m^3 (m^2 in 2D).

        What comes in at the step's rate, less what they gain as prescribed points go and free ones stay. Collective.
        """
        gained, solid = np.zeros(len(self.members)), self.solid
        if self.walls is not None and solid is not None:
            given = solid.fixed_velocity()[solid.layout.start : solid.layout.end]
            here = solid.surface_present()
            way = solid.surface_arrival(given, dt) - here
            way[np.diff(solid.surface().fixed_map.indptr).reshape(way.shape) == 0] = 0.0
            gained = self.walls.change(here + way) - self.walls.change(here)
        return dt * self.inflows() - gained

    def accept(self, tables: dict[str, Any]) -> None:
        """Take over the step last measured, with what is known of its regions by number, see ``TABLES``."""
        assert self.known is not None
        self.known = self._accepted = self.known._replace(volumes=self._reported(self.end), **tables)

    def keep(self) -> Callable[[], State]:
        """Return what gives, later, by cell and by facet which lasting region it lies in or bounds now.

        And what is known of that.
        """
        assert self.known is not None
        return partial(tracked_state, self.known, self.fluid, self.comm)

    def restore(self, read: Reader) -> None:
        """Take up a state. Collective."""
        assert self.known is not None
        known = read_tracked(self.known, self.fluid, read, self.comm)
        self.known, self._accepted, self._found_for = known, known, None
