"""The solve of one step over density ratio, stiffness, step and grid: iterations, seconds and true residual.

A free elastic bar, turned against the grid, falls through a closed box of fluid. With rho = rho_s / rho_f and
r = h^2 E / (rho_s dx^2), the square of the cells that an elastic wave crosses in a step, each case is solved from
nothing to a relative residual of 1e-8 of the whole system: by the default, by a split step to the same tolerance
(same factorisation of A, one pressure solve with L), by the published solver, and, for the last column, the pressure
alone on the same grid without a solid. Seconds contain the set-up of the solver, as when everything moves.
"""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from petfsi.bench.case import MONOLITHIC, SPLIT, Case, job, only_options
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

PAPER = "monolithic-paper.opts"
TOLERANCE = 1e-8
#: Iterations allowed from this density ratio on, and below it.
HEAVY, MOST, MOST_LIGHT = 0.1, 25, 40
FLUID_DENSITY, LENGTH, ANGLE = 1.2, 2.0, 0.6
RATIOS, STIFFNESSES = (1e-3, 1e-2, 1e-1, 1.0, 1e3), (1.0, 1e2, 1e4, 1e6, 1e8)
STEPS, GRIDS = (1e-4, 1e-2, 1.0), (32, 64, 96)
REPEATS = 3


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"One solve to {TOLERANCE:g} of the whole system, {case.comm.size} ranks")
    bare: dict[int, float] = {}
    for n, ratio, stiffness, dt in _cases(case.quick):
        if n not in bare:
            bare[n] = first_solve(case, scene(case, n, 1.0, 1.0, 0.01, solid=False), SPLIT)["seconds"]
        made = scene(case, n, ratio, stiffness, dt)
        row: Row = {"cells": n, "rho": ratio, "r": stiffness, "dt": dt, **first_solve(case, made, MONOLITHIC)}
        split = first_solve(case, made, SPLIT)["seconds"]
        row |= {"over split": row["seconds"] / split, "split over bare": split / bare[n]}
        paper = first_solve(case, made, PAPER)
        row |= {f"paper {name}": value for name, value in paper.items()}
        report.rows.append(row)
        most = MOST if ratio >= HEAVY else MOST_LIGHT
        report.demand(row["residual"] <= TOLERANCE, row, f"a residual of {TOLERANCE:g}")
        report.demand(row["iterations"] <= most, row, f"at most {most} iterations")
    heavy = [row["over split"] for row in report.rows if row["rho"] >= HEAVY]
    report.notes.append(f"monolithic over split, median for rho >= {HEAVY:g}: {np.median(heavy):.2f}")
    report.figure = _picture(report)
    return report


def _cases(quick: bool) -> list[tuple[int, float, float, float]]:
    """Return cells along the box, rho, r and dt of each case."""
    if quick:
        return [(32, ratio, r, 1e-2) for ratio in RATIOS for r in STIFFNESSES[::2]]
    table = [(64, ratio, r, 1e-2) for ratio in RATIOS for r in STIFFNESSES]
    return table + [(n, 1.0, 1e2, dt) for n in GRIDS for dt in STEPS if (n, dt) != (64, 1e-2)]


def scene(case: Case, n: int, ratio: float, stiffness: float, dt: float, solid: bool = True) -> Scene:
    """Return the bar of the given rho and r in a box of n cells along its length. Collective."""
    density, dx = ratio * FLUID_DENSITY, LENGTH / n
    c, s = np.cos(ANGLE) - 1, np.sin(ANGLE)
    speed = 0.1 * dx / dt
    sets: dict[str, Any] = {
        "time.dt": dt,
        "time.end": 10 * dt,
        "gravity": [0.0, 0.0, 0.0],
        "fluid.cells": [n, 3 * n // 4, 3 * n // 4],
        "fluid.sides": dict.fromkeys(("left", "right", "bottom", "top", "back", "front"), "slip"),
        "coupling": {"transfer": "cutcell"},
        "fluid.initial.velocity": [f"{speed}*sin(4*x+3*y)", f"{speed}*sin(5*y+2*z)", f"{speed}*cos(6*z+x)"],
        "probes": {},
    }
    if not solid:
        return job(case.comm, "bar", sets | {"solids": {}})
    sets |= {
        "solids.bar.shape.box": {
            "origin": [0.93, 0.21, 0.6],
            "size": [0.12, 1.1, 0.3],
            "cells": [max(1, n // 16), 9 * n // 16, 5 * n // 32],
        },
        "solids.bar.density": density,
        "solids.bar.young": stiffness * density * dx**2 / dt**2,
        "solids.bar.damping": {"mass": 0.0, "stiffness": 0.0},
        "solids.bar.supports": [],
        "solids.bar.initial": {
            "displacement": [f"{c}*(x-0.99) - {s}*(y-0.76)", f"{s}*(x-0.99) + {c}*(y-0.76)", "0.0"],
        },
    }
    return job(case.comm, "bar", sets)


def first_solve(case: Case, made: Scene, options: str) -> Row:
    """Return iterations, seconds (the best of a few) and true residual of one solve. Collective."""
    with only_options(["-options_file", options, *_tolerance(options)]):
        sim = Simulation(case.comm, made)
        try:
            sim.prepare()
            for field in sim.fields:
                field.predict(sim.time, sim.dt)
            sim._assemble(sim.time, sim.dt)
            guess = sim.system.solution.copy()
            seconds = []
            for _ in range(1 if options == PAPER else REPEATS):
                guess.copy(sim.system.solution)
                _touch(sim)
                case.comm.Barrier()
                begin = clock.perf_counter()
                outcome = sim.solver.solve(changed=True)
                seconds.append(case.comm.allreduce(clock.perf_counter() - begin) / case.comm.size)
        except SolveError:
            return {"iterations": -1, "seconds": np.nan, "residual": np.nan}
        finally:
            sim.solver.reset()
    return {"iterations": outcome.iterations, "seconds": min(seconds), "residual": outcome.residual}


def _touch(sim: Simulation) -> None:
    """Have PETSc take the same operator for a new one. Collective."""
    for field in sim.fields:
        field.block.assemble()
    if sim.system.index_sets:
        sim.system.operator.assemble()


def _tolerance(options: str) -> list[str]:
    if options == SPLIT:
        return ["-fsi_fieldsplit_pressure_ksp_rtol", f"{TOLERANCE:g}"]
    if options == MONOLITHIC:  # its set-up counts, too
        return ["-fsi_ksp_rtol", f"{TOLERANCE:g}", "-fsi_fieldsplit_pressure_lag_change", "0"]
    return ["-fsi_ksp_rtol", f"{TOLERANCE:g}", *(["-fsi_ksp_max_it", "1000"] if options == PAPER else [])]


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    n = report.rows[0]["cells"]
    for ratio in RATIOS:
        rows = [row for row in report.rows if row["cells"] == n and row["rho"] == ratio and row["dt"] == 1e-2]
        r = [row["r"] for row in rows]
        (line,) = left.loglog(r, [row["iterations"] for row in rows], "o-", label=f"rho {ratio:g}")
        right.loglog(r, [row["seconds"] for row in rows], "o-", color=line.get_color())
        right.loglog(r, [row["paper seconds"] for row in rows], "x:", color=line.get_color())
    left.set(xlabel="r", ylabel="iterations", title=f"default, {n} cells")
    right.set(xlabel="r", ylabel="seconds", title="default (o) and published solver (x)")
    left.legend(fontsize=8)
    return figure
