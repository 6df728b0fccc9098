"""Fluids and deformable solids that move each other, solved with PETSc."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from petfsi.output.opened import OpenedRun
    from petfsi.sweeps.opened import OpenedSweep

__version__ = "0.1.0"


def open_run(directory: Path | str) -> OpenedRun:
    """Return a run directory to read from: ``history``, ``summary`` and ``scene``. Starts neither MPI nor PETSc."""
    from petfsi.output.opened import OpenedRun

    return OpenedRun(directory)


def open_sweep(directory: Path | str) -> OpenedSweep:
    """Return a sweep's folder to read from: ``rows()``, and by its name each run as ``open_run`` gives it."""
    from petfsi.sweeps.opened import OpenedSweep

    return OpenedSweep(directory)
