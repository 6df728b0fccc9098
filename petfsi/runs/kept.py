"""The state of the last finished step, for as long as the next one may fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.fields.slabs import State
from petfsi.simulation import Simulation


@dataclass(frozen=True)
class Kept:
    """A state that steps which come after do not touch.

    Attributes
    ----------
    comm : MPI.Comm
    step, time, dt : int, float, float
        The step that was finished last, the time reached (s), the step's length (s).
    parts : dict
        As ``Simulation.keep`` gives them.
    fields : tuple of str
        Which of them are the fields'.
    """

    comm: MPI.Comm
    step: int
    time: float
    dt: float
    parts: dict[str, Callable[[], State]]
    fields: tuple[str, ...]

    @classmethod
    def of(cls, simulation: Simulation) -> Kept:
        """Return the present state of a simulation between two steps. Collective."""
        names = tuple(field.name for field in simulation.fields)
        return cls(simulation.comm, simulation.step, simulation.time, simulation.dt, simulation.keep(), names)

    def state(self) -> dict[str, State]:
        """Return all that the next step reads. Collective."""
        return {name: part() for name, part in self.parts.items()}

    def is_finite(self) -> bool:
        """Return whether the fields' values are numbers. Collective."""
        slabs = [slab for name in self.fields for slab in self.parts[name]().values()]
        return self.comm.allreduce(all(bool(np.isfinite(slab.data).all()) for slab in slabs), MPI.LAND)
