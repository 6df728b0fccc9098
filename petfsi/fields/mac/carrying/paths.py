"""Along which flow, for how long and in how many sweeps quantities are carried.

A sweep reads no farther than the ghosts reach, so what crosses more cells is carried in several short ones. Few
entries need them: a jet's, and at the beginning those that its last sweep reads. All others are carried in one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.mac.carrying import advect
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid

#: Cells that the flow may cross in one sweep: with the half cell of staggering and the stencil, all within the ghosts.
MAX_COURANT = {"linear": 4.0, "cubic": 3.0}
#: Entries on either side of a point that are read.
STENCIL = {"linear": 1, "cubic": 2}
#: A flow that crosses just so many cells goes in one sweep, however the last digits are rounded.
SLACK = 1e-9
#: Times that the flow may cross the whole grid in one step; more is no flow any longer.
MAX_CROSSINGS = 10


@dataclass(frozen=True)
class Sweep:
    """One sweep along a path.

    Attributes
    ----------
    courant : tuple of float
        Its time / dx per axis.
    long : bool
        Whether it follows paths with third order, because others follow them in short steps.
    reach : int
        How many cells away it may read.
    limit : float
        Entries that come from farther away, in cells along any axis, are left to others.
    """

    courant: tuple[float, float, float]
    long: bool
    reach: int
    limit: float = np.inf


@dataclass(frozen=True)
class Path:
    """A flow that stands still for a time.

    Attributes
    ----------
    velocity : Faces
        Ghosts valid.
    span : float
        How long it carries, s.
    whole : Sweep
        Carries for all of that time what comes from near enough.
    sweeps : int
        In how many ...
    short : Sweep
        ... of these the rest is carried; of one, nothing is left.
    """

    velocity: Faces
    span: float
    whole: Sweep
    sweeps: int
    short: Sweep


def find_path(grid: MacGrid, velocity: Faces, fastest: list[np.ndarray], span: float, interpolation: str) -> Path:
    """Return the path along a velocity for ``span`` seconds. Collective: one reduction.

    Parameters
    ----------
    grid : MacGrid
    velocity : Faces
        Ghosts valid.
    fastest : list of ndarray
        The same, but of each divided face its fastest part.
    span : float
        s.
    interpolation : str
        ``cubic`` or ``linear``.

    Raises
    ------
    SolveError
        If it crosses the grid so often that it is no flow any longer.
    """
    most = max(advect.largest(v) * span / h for v, h in zip(fastest, grid.dx, strict=True))
    courant = grid.comm.allreduce(most, op=MPI.MAX)
    if not courant <= MAX_CROSSINGS * max(grid.cells):
        raise SolveError(
            f"the flow has blown up: it would cross {courant:.1e} cells, more than the whole grid "
            f"{MAX_CROSSINGS} times, in one step of {span:g} s. Take a smaller dt, or look at what drives it."
        )
    farthest, stencil = MAX_COURANT[interpolation], STENCIL[interpolation]
    sweeps = max(1, int(np.ceil(courant / farthest - SLACK)))

    reach = max(1, int(np.ceil(courant / sweeps - SLACK))) + stencil
    short = Sweep((*(span / sweeps / grid.dx), 0.0)[:3], False, reach)
    whole = short
    if sweeps > 1:
        whole = Sweep((*(span / grid.dx), 0.0)[:3], True, int(farthest) + stencil, farthest + SLACK)
    return Path(velocity, span, whole, sweeps, short)
