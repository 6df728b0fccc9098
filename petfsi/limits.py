"""How far off and how fast a body may be: beyond, nothing is left of its shape, or of its step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError, SolveError
from petfsi.fields.solids import FAR, SolidField


def refuse_far_start(solid: SolidField) -> None:
    """Raise an InputError if positions are so far off that nothing is left of the body's shape there. Collective."""
    way = float(np.abs(solid.surface_present()).max(initial=0.0))
    if not way < FAR * solid.extent:
        raise InputError(
            f"solids: a point begins {way:.3g} m from the origin, more than {FAR:g} times the largest side of the "
            f"solids ({solid.extent:g} m): their shape is lost in the round-off of that"
        )


def largest_speed(comm: MPI.Comm, fastest: float, dt: float, extent: float, advice: Callable[[], str]) -> float:
    """Return the largest speed of all ranks; raise if a node would cross the whole scene in one step. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    fastest : float
        This rank's, m/s.
    dt : float
        s.
    extent : float
        Of the scene, m.
    advice : callable
        Returns what may help.

    Raises
    ------
    SolveError
        On all ranks.
    """
    # of what is no number the largest may be anything
    fastest = comm.allreduce(fastest if np.isfinite(fastest) else np.inf, MPI.MAX)
    if not fastest * dt < extent:
        raise SolveError(
            f"the solid has blown up: a node at {fastest:.2e} m/s would cross the whole scene ({extent:g} m) "
            f"in one step of {dt:g} s. {advice()}"
        )
    return fastest
