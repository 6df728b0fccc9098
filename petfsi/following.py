"""Which of the regions of fluid that are closed now were which before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI


@dataclass(frozen=True)
class Marks:
    """Where numbered regions are; 0 is none of them.

    Attributes
    ----------
    cells : ndarray of int, shape (n_cells,)
        The region of each of this rank's lasting unknowns.
    facets : ndarray of int, shape (n_facets,)
        The region that each facet bounds; 0, too, where it bounds several. The same on all ranks.
    """

    cells: np.ndarray
    facets: np.ndarray

    @classmethod
    def of(
        cls, comm: MPI.Comm, members: list[np.ndarray], n_cells: int, bounds: tuple[np.ndarray, np.ndarray, int] | None
    ) -> Marks:
        """Return the marks of regions, counted from 1. Collective where there are ``bounds``.

        Parameters
        ----------
        comm : MPI.Comm
        members : list of ndarray
            Per region 1 on its unknowns on this rank.
        n_cells : int
            How many of these last.
        bounds : tuple of (ndarray, ndarray, int), or None
            Facets, the unknowns of this rank that they bound, and how many facets there are.
        """
        number = np.zeros(len(members[0]) if members else n_cells, dtype=np.int64)
        for k, member in enumerate(members, start=1):
            number[member > 0] = k
        if bounds is None or not members:
            return cls(number[:n_cells], np.zeros(0 if bounds is None else bounds[2], dtype=np.int64))
        facet, unknown, n_facets = bounds
        here = number[unknown]
        none = len(members) + 1
        # per facet: the last of its regions, and the first, counted backwards
        ends = np.zeros((2, n_facets), dtype=np.int64)
        np.maximum.at(ends[0], facet, here)
        np.maximum.at(ends[1], facet, np.where(here > 0, none - here, 0))
        comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return cls(number[:n_cells], np.where(ends[0] == none - ends[1], ends[0], 0))

    def renumbered(self, numbers: np.ndarray) -> Marks:
        """Return the marks with ``numbers[k]`` in place of k."""
        return Marks(numbers[self.cells], numbers[self.facets])


def follow(comm: MPI.Comm, before: Marks, now: Marks, n_before: int, n_now: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the regions, counted from 0, that have stayed one: their numbers before and now. Collective.

    Two regions are the same if they share facets with each other alone: what a facet bounds cannot change, however
    far it moves, unless regions join, part, open or are filled. Regions that no facet bounds share cells.
    """
    shape = (n_before + 1, n_now + 1)
    shared = np.bincount(before.cells * shape[1] + now.cells, minlength=shape[0] * shape[1])
    cells = comm.allreduce(shared).reshape(shape)[1:, 1:] > 0
    facets = np.zeros(shape, dtype=bool)
    facets[before.facets, now.facets] = True
    bounded_before = np.isin(np.arange(1, n_before + 1), before.facets)
    bounded_now = np.isin(np.arange(1, n_now + 1), now.facets)
    meets = facets[1:, 1:] | (cells & ~(bounded_before[:, None] & bounded_now))
    alone = (meets.sum(axis=0) == 1) & (meets.sum(axis=1) == 1)[:, None]
    old, new = np.nonzero(meets & alone)
    return old, new
