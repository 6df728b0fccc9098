"""Scenes of particles for ``petfsi bench particles``, and how they are run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.fields.sph.fluid import SphFluid
from petfsi.ranks import on_root
from petfsi.scene.load import scene_from_dict
from petfsi.simulation import Simulation
from petfsi.solving.option_database import only_options

G, DENSITY = 9.81, 1000.0


def box(size: list[float]) -> list[dict]:
    """Return a fill that is one box from the origin."""
    return [{"box": {"origin": [0.0] * len(size), "size": size}}]


def prepared(comm: MPI.Comm, end: float, size: list[float], gravity: list[float], **fluid: Any) -> Simulation:
    """Return a simulation of particles in a box that begins at the origin, at its start. Collective.

    Where viscosity is solved for, petfsi's options must be in force while it runs (``case.only_options``).

    Parameters
    ----------
    comm : MPI.Comm
    end : float
        s.
    size : list of float
        Of the box, m.
    gravity : list of float
        m/s^2.
    **fluid
        The rest of the scene's table; density ``DENSITY`` if it says nothing of it. Of ``time``, what the
        scene says of that besides the end; by default steps are as long as they may be.
    """
    table: dict[str, Any] = {"kind": "sph", "density": DENSITY, "origin": [0.0] * len(size), "size": size} | fluid
    data = {"dim": len(size), "gravity": gravity, "fluid": table}
    data["time"] = {"end": end, "dt": "auto"} | table.pop("time", {})
    scene = on_root(comm, lambda: scene_from_dict(data))
    with only_options([]):
        sim = Simulation(comm, scene)
        sim.prepare()
    return sim


def particles(sim: Simulation) -> SphFluid:
    """Return the simulation's fluid."""
    assert isinstance(sim.fluid, SphFluid)
    return sim.fluid


def owned(sim: Simulation, name: str) -> np.ndarray:
    """Return a column of this rank's particles."""
    swarm = particles(sim).swarm
    return swarm[name][swarm.owned]


def total(sim: Simulation, values: np.ndarray) -> float:
    """Return the sum of what the ranks hold. Collective."""
    return float(sim.comm.allreduce(float(np.sum(values))))


def largest(sim: Simulation, values: np.ndarray) -> float:
    """Return the largest modulus of what the ranks hold. Collective."""
    return float(sim.comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX))


def watched(sim: Simulation, every: float, look: Callable[[], list[float]]) -> np.ndarray:
    """Run to the end; return time and what ``look`` sees at the start and, about so often (s), later. Collective."""
    rows, due = [[sim.time, *look()]], every
    while not sim.finished:
        sim.advance()
        if sim.time >= due or sim.finished:
            rows.append([sim.time, *look()])
            due = every * (np.floor(sim.time / every) + 1)
    return np.array(rows)


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
