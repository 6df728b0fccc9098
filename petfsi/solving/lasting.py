"""Regions that last: what is known of them, and which of those known earlier the present ones are."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from petfsi.fields.fluids import PressureFluid
from petfsi.fields.slabs import Reader, Slab, State
from petfsi.fields.stored import outside, refuse

#: A facet bounds a region if at least so much of it does.
LEAST_PART = 1e-6
#: The largest number of a lasting region; there are tables as long.
_MOST = 10_000_000


class Tracked(NamedTuple):
    """What is known of lasting regions, numbered from 1.

    Attributes
    ----------
    number : ndarray, shape (n_cells,)
        The lasting region of each lasting unknown of the fluid on this rank; 0 is none.
    facets : ndarray of int, shape (n_facets,)
        Of each facet of the surface, on every rank: the one of which it bounds most.
    target, volume, inflow, source, before : dict of int to float
        Of each: the volume that it is to have and the one that it has, m^3 (m^2 in 2D), what came in through sides at
        the end of the last step, m^3/s, and its source in that step and in the one before.
    volumes : ndarray
        Of each region that was closed at first, m^3 (m^2 in 2D), at the end of the step, or where the walls cannot be
        followed exactly for the geometry at which it was taken; nan from when it was opened, divided, joined with
        another or filled.
    """

    number: np.ndarray
    facets: np.ndarray
    target: dict[int, float]
    volume: dict[int, float]
    inflow: dict[int, float]
    source: dict[int, float]
    before: dict[int, float]
    volumes: np.ndarray


#: What a checkpoint holds of each lasting region besides where it is.
TABLES = ("target", "volume", "inflow", "source", "before")


def bounded_most(parts: np.ndarray) -> np.ndarray:
    """Return which region each facet bounds most, counted from 1; 0 is none.

    Parameters
    ----------
    parts : ndarray, shape (n_regions, n_facets)
        Which part of each facet bounds which region.
    """
    return np.where(parts.max(axis=0) > LEAST_PART, 1 + parts.argmax(axis=0), 0)


def _looked_up(table: dict[int, float], numbers: np.ndarray) -> np.ndarray:
    """Return the values of numbers, 0 of those that the table does not have."""
    values = np.zeros(1 + max([0, *table, int(numbers.max(initial=0))]))
    values[list(table)] = list(table.values())
    return values[numbers.astype(np.int64)]


def pairs(old: np.ndarray, new: np.ndarray, n_old: int, n_new: int) -> np.ndarray:
    """Return how many things have which old and which new label, 0 among them, shape (n_old + 1, n_new + 1)."""
    count = np.bincount(old * (n_new + 1) + new, minlength=(n_old + 1) * (n_new + 1))
    return count.reshape(n_old + 1, n_new + 1)


def meeting(cells: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return which old and new regions have something in common, shape (n_old, n_new).

    The lasting unknown of a cell that a thin wall divides may go over from one side to the other, and a facet may slip
    from one region into another: it takes cells and facets, where both regions have both.

    Parameters
    ----------
    cells, facets : ndarray of int, shape (n_old + 1, n_new + 1)
        Their numbers in common; old and new regions begin at 1.
    """
    by_cells, by_facets = cells[1:, 1:] > 0, facets[1:, 1:] > 0
    walls = np.any(facets[1:] > 0, axis=1)[:, None] & np.any(facets[:, 1:] > 0, axis=0)
    meets = by_cells & (by_facets | ~walls)
    alone = ~by_cells.any(axis=1)[:, None] | ~by_cells.any(axis=0)
    return meets | (alone & by_facets)


# ---- checkpoints --------------------------------------------------------------------------------------------


def tracked_state(known: Tracked, fluid: PressureFluid, comm: MPI.Comm) -> State:
    """Return by cell and by facet which lasting region it lies in or bounds, and what is known of that. Collective."""
    n, mine = len(known.facets), slice(*_share(len(known.facets), comm))
    arrays = {}
    for name in ("region", *TABLES):
        of = None if name == "region" else getattr(known, name)
        by_cell = known.number if of is None else _looked_up(of, known.number)
        by_facet = known.facets if of is None else _looked_up(of, known.facets)
        arrays[name] = fluid.cells_slab(by_cell.astype(float))
        arrays[f"facet_{name}"] = Slab(by_facet[mine].astype(float), (mine.start,), (n,))
    return arrays


def read_tracked(known: Tracked, fluid: PressureFluid, read: Reader, comm: MPI.Comm) -> Tracked:
    """Return what a checkpoint knows, of as many cells and facets as are known now. Collective.

    Raises
    ------
    ValueError
        On all ranks, if it cannot be.
    """
    begin, end = _share(len(known.facets), comm)
    number, *by_cell = (fluid.read_cells(read, name) for name in ("region", *TABLES))
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
    return known._replace(number=number, facets=facets.astype(np.int64), **named)


def _share(n: int, comm: MPI.Comm) -> tuple[int, int]:
    """Return begin and end of this rank's share of ``n`` things."""
    return n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size
