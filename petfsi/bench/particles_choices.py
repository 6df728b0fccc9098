"""What the defaults of particles are chosen against, for ``petfsi bench particles``: each in three flows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.bench.case import Case
from petfsi.bench.particles_dam import column, front_row
from petfsi.bench.particles_flows import vortices
from petfsi.bench.particles_tank import tank
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError

#: Smoothing lengths and kernels, all with all; and what else may be chosen, beside the default.
KERNELS, SMOOTHINGS = ("wendland", "quadratic", "cubic"), (1.3, 1.5, 2.0)
OTHERS: dict[str, dict[str, Any]] = {
    "no diffusion": {"density_diffusion": 0.0},
    "no shifting": {"shifting": False},
    "alpha 0": {"artificial_viscosity": 0.0},
    "alpha 0.1": {"artificial_viscosity": 0.1},
    "alpha 0.3": {"artificial_viscosity": 0.3},
}
DEFAULT, QUICK = "wendland 1.5", ("wendland 1.5", "quadratic 1.5", "no shifting")
#: Particles across; of the tank also sound over the speed of what falls, and the end, s.
VORTICES, FINE_VORTICES, TANK, COLUMN, COLUMN_END = 50, 100, (20, 15.0, 4.0), 20, 2.5
#: The default's error of the velocity may be so many times that of the best.
WORSE = 1.5


def settings() -> dict[str, dict[str, Any]]:
    """Return all that is tried, by name."""
    kernels = {f"{k} {s:g}": {"kernel": k, "smoothing": s} for k in KERNELS for s in SMOOTHINGS}
    return kernels | OTHERS


def choose(case: Case, report: Report) -> None:
    """Measure what else might be chosen, in vortices, still water and a dam that breaks. Collective."""
    rows: list[Row] = []
    for name, fluid in settings().items():
        if not case.quick or name in QUICK:
            row: Row = {"part": "choice", "at": name}
            rows.append(row | _measured(case.comm, fluid, case.quick))
    report.rows += rows
    errors = {row["at"]: _mean_error(row) for row in rows if "error" in row}
    own, best = errors[DEFAULT], min(errors, key=lambda name: errors[name])
    bound = f"mean error of vortices at most {WORSE:g} times that of {best}, {errors[best]:.3g}"
    report.demand(own <= WORSE * errors[best], {"at": DEFAULT, "mean error": own}, bound)


def _mean_error(row: Row) -> float:
    """Return the geometric mean over resolutions of the velocity's error in the vortices."""
    return float(np.exp(np.mean(np.log([row[key] for key in ("error", "error fine") if key in row]))))


def _measured(comm: MPI.Comm, fluid: dict[str, Any], quick: bool) -> Row:
    found: Row = {}
    laminar = {name: value for name, value in fluid.items() if name != "artificial_viscosity"}
    if laminar or not fluid:
        found |= _attempted(lambda: _some(vortices(comm, VORTICES, **laminar), {"error": "error", "energy": "energy"}))
        if not quick:
            fine = {"error": "error fine", "energy": "energy fine"}
            found |= _attempted(lambda: _some(vortices(comm, FINE_VORTICES, **laminar), fine))
    if not quick:
        found |= _attempted(lambda: _some(tank(comm, *TANK, **fluid), dict.fromkeys(("bottom", "rms", "kinetic"), "")))
    wanted = dict.fromkeys(("front rms", "shift", "shifted", "height rms", "residual", "Z(2)"), "")
    return found | _attempted(lambda: _some(front_row(*column(comm, COLUMN, COLUMN_END, **fluid)), wanted))


def _some(row: Row, names: dict[str, str]) -> Row:
    """Return some of a row, under these names where they have one."""
    return {new or old: row[old] for old, new in names.items()}


def _attempted(measure: Callable[[], Row]) -> Row:
    """Return what is measured, or why it is not."""
    try:
        return measure()
    except SolveError as failed:
        return {"why": str(failed).split(":")[0]}
