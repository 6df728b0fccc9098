"""What particles tell of a point: means weighted by the kernel, summed by id, the same on any ranks."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from mpi4py import MPI

from petfsi.fields.sph.cells import Pairs
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.room import Room


class Fluid(Protocol):
    """What is asked: see ``fluid.SphFluid``."""

    comm: MPI.Comm
    swarm: Swarm
    law: Law
    room: Room
    spacing: float
    pairs: Pairs


#: What has no more neighbours is spray.
FEWEST = 3


def at_point(fluid: Fluid, quantity: str, point: np.ndarray) -> float | np.ndarray:
    """Return the pressure (Pa) or velocity (m/s, shape (dim,)) at a point; zero where no particle is near. Collective.

    The pressure is that of a wall particle there,  sum W (p + rho g . (point - x)) / sum W.
    """
    swarm, law = fluid.swarm, fluid.law
    length = np.where(fluid.room.grid.periodic, fluid.room.high - fluid.room.low, np.inf)
    way = point - swarm["x"]
    way -= np.where(np.isfinite(length), np.round(way / length) * np.where(np.isfinite(length), length, 0.0), 0.0)
    distance = np.linalg.norm(way, axis=1)
    near = np.flatnonzero((distance < fluid.room.reach) & swarm.owned)
    weight, _ = law.kernel.values(distance[near])
    if quantity == "pressure":
        rho = swarm["rho"][near]
        values = (law.pressure(rho) + rho * (way[near] @ np.array(law.gravity)))[:, None]
    else:
        values = swarm["v"][near]
    rows = np.column_stack([swarm["id"][near], weight, weight[:, None] * values])
    rows = np.concatenate(fluid.comm.allgather(rows))
    total = rows[np.argsort(rows[:, 0]), 1:].sum(axis=0)
    found = total[1:] / total[0] if total[0] > 0 else np.zeros(len(total) - 1)
    return float(found[0]) if quantity == "pressure" else found


def front(fluid: Fluid) -> float:
    """Return the largest x of the liquid, half a spacing beyond its last particle, m; nan of none. Collective."""
    return _last(fluid, fluid.swarm["x"][_joined(fluid), 0]) + fluid.spacing / 2


def level(fluid: Fluid, point: np.ndarray) -> float:
    """Return how high the liquid stands over (or under) a point, against gravity, m; nan where none does. Collective.

    Half a spacing above the highest particle within a spacing of the line through the point.
    """
    x, g = fluid.swarm["x"], np.array(fluid.law.gravity)
    up = int(np.argmax(np.abs(g))) if np.any(g) else 1
    sense = 1.0 if g[up] <= 0 else -1.0
    way = np.delete(x - point, up, axis=1)
    near = _joined(fluid) & (np.linalg.norm(way, axis=1) <= fluid.spacing)
    return sense * (_last(fluid, sense * x[near, up]) + fluid.spacing / 2)


def _last(fluid: Fluid, places: np.ndarray) -> float:
    """Return the largest of all ranks' places, nan of none. Collective."""
    found = fluid.comm.allreduce(float(places.max(initial=-np.inf)), MPI.MAX)
    return found if np.isfinite(found) else np.nan


def _joined(fluid: Fluid) -> np.ndarray:
    """Return which rows are owned particles with more than ``FEWEST`` neighbours: spray is no liquid."""
    start, other = fluid.pairs
    number = np.diff(start) + np.bincount(other, minlength=len(fluid.swarm))
    return fluid.swarm.owned & (number > FEWEST)
