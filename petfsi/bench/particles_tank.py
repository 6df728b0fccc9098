"""Water at rest under its weight for ``petfsi bench particles``."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.bench.case import Case
from petfsi.bench.particles_runs import DENSITY, G, box, owned, particles, prepared, total, watched
from petfsi.bench.report import Report, Row

#: Edge of the square of water, m; sound over the speed of what falls through it.
DEPTH, MACHS = 1.0, (10.0, 15.0)
TANK_CELLS, QUICK_TANK_CELLS, TANK_END, QUICK_TANK_END = (20, 40), (20,), 10.0, 2.0
#: Of the pressure at the bottom, over the second half; of the kinetic energy over the weight times the height.
BOTTOM_ERROR, KINETIC = 0.01, 1e-6
#: At so large a sound speed at least.
BOTTOM_MACH = 15.0
LEVEL_ERROR = 0.2  # dx
#: Where the pressure at the bottom is looked at, m.
PLACES = np.linspace(0.1, 0.9, 5)


def tank(comm: MPI.Comm, n: int, mach: float, end: float, **fluid: Any) -> Row:
    """Return what is wrong with still water ``n`` particles deep. Collective.

    ``bottom``, mean over the second half and over places, and ``swing``, its standard deviation, are over rho g H; so
    is ``rms``, of all particles' pressure at the end; ``kinetic`` over m g H; ``level`` is the surface's, over H.
    """
    scale = DENSITY * G * DEPTH
    table = {"spacing": DEPTH / n, "sound_speed": mach * np.sqrt(2 * G * DEPTH), "fill": box([DEPTH, DEPTH])}
    sim = prepared(comm, end, [DEPTH, 1.2 * DEPTH], [0.0, -G], **table | fluid)
    water = particles(sim)

    def look() -> list[float]:
        return [float(np.mean(np.array([water.probe("pressure", [x, 0.0]) for x in PLACES]))) / scale]

    seen = watched(sim, 0.02, look)
    late = seen[seen[:, 0] > 0.5 * end, 1]
    wrong = water.law.pressure(owned(sim, "rho")) / scale - (1 - owned(sim, "x")[:, 1] / DEPTH)
    level = water.probe("level", [0.5 * DEPTH, 0.0])
    return {
        "bottom": float(late.mean()),
        "swing": float(late.std()),
        "rms": float(np.sqrt(total(sim, wrong**2) / total(sim, np.ones_like(wrong)))),
        "kinetic": sim.accounts.values["kinetic"] / (scale * DEPTH),
        "level": float(level) / DEPTH,
        "residual": sim.accounts.values["energy_residual"] / (scale * DEPTH),
    }


def still(case: Case, report: Report) -> None:
    """Measure still water over resolutions and sound speeds. Collective."""
    for n in QUICK_TANK_CELLS if case.quick else TANK_CELLS:
        for mach in MACHS[-1:] if case.quick else MACHS:
            end = QUICK_TANK_END if case.quick else TANK_END
            row: Row = {"part": "still water", "at": n, "c/v": mach} | tank(case.comm, n, mach, end)
            report.rows.append(row)
            if mach >= BOTTOM_MACH:
                error = abs(row["bottom"] - 1)
                report.demand(error <= BOTTOM_ERROR, row, f"bottom pressure within {BOTTOM_ERROR:g}")
            report.demand(abs(row["level"] - 1) <= LEVEL_ERROR / n, row, f"level within {LEVEL_ERROR:g} dx")
            if not case.quick:
                report.demand(row["kinetic"] <= KINETIC, row, f"kinetic energy below {KINETIC:g} m g H")
