"""The solve of one step over density ratio, stiffness, step and grid: iterations, seconds and true residual.

A free elastic bar at rest, turned against the grid, in a closed box of moving fluid: all of the right-hand side asks
for pressure. With rho = rho_s / rho_f and r = dt^2 E / (rho_s dx^2), the square of the cells that an elastic wave
crosses in a step, each case is solved from nothing to a relative residual of 1e-8 of the whole system: by the default,
by a split step to the same tolerance (same factorisation of A, one pressure solve with L), by the published solver,
and the pressure alone on the same grid without a solid. Seconds contain the set-up of the solver, as when everything
moves. They are the best of a few solves, made in turn so that whatever else the machine does meets all. Columns:

    over split      seconds of the default over those of the split step
    over bare       what the default spends on the pressure (all but the factorisation of A) over the bare solve

The table is rho x r at 64^3; the step, for one material (so that r goes with dt^2), at 64^3; and the grids for the
hardest and for ordinary materials.
"""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from petfsi import petsc
from petfsi.bench.case import DIRECT, MONOLITHIC, SPLIT, Case, job
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation
from petfsi.solving.option_database import only_options

PAPER = "monolithic-paper.opts"
TOLERANCE = 1e-8
#: Iterations allowed from this density ratio on, and below it.
HEAVY, MOST, MOST_LIGHT = 0.1, 25, 40
FLUID_DENSITY, LENGTH, ANGLE, STEP = 1.2, 2.0, 0.6, 1e-2
RATIOS, STIFFNESSES = (1e-3, 1e-2, 1e-1, 1.0, 1e3), (1.0, 1e2, 1e4, 1e6, 1e8)
STEPS, GRIDS = (1e-4, 1e-3, 1e-1, 1.0), (32, 96)
REPEATS, MOST_PAPER = 3, 500


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"One solve to {TOLERANCE:g} of the whole system, {case.comm.size} ranks")
    for n, ratio, stiffness, dt in _cases(case.quick):
        made, empty = scene(case, n, ratio, stiffness, dt), scene(case, n, ratio, stiffness, dt, solid=False)
        default, split, bare = solves(case, [(made, MONOLITHIC), (made, SPLIT), (empty, SPLIT)], REPEATS)
        (paper,) = solves(case, [(made, PAPER)], 1)
        row: Row = {"cells": n, "rho": ratio, "r": stiffness, "dt": dt}
        row |= {name: default[name] for name in ("outcome", "iterations", "seconds", "residual")}
        row["over split"] = default["seconds"] / split["seconds"]
        row["over bare"] = (default["seconds"] - default["factorisation"]) / bare["seconds"]
        row["bare iterations"] = bare["iterations"]
        row |= {f"paper {name}": paper[name] for name in ("outcome", "iterations", "seconds", "residual")}
        report.rows.append(row)
        most = MOST if ratio >= HEAVY else MOST_LIGHT
        report.demand(row["residual"] <= TOLERANCE, row, f"a residual of {TOLERANCE:g}")
        report.demand(row["iterations"] <= most, row, f"at most {most} iterations")
    heavy = [row for row in report.rows if row["rho"] >= HEAVY]
    for column in ("over split", "over bare"):
        report.notes.append(f"{column}, median for rho >= {HEAVY:g}: {np.median([row[column] for row in heavy]):.2f}")
    report.notes.append(
        f"published solver: {sum(row['paper outcome'] != 'converged' for row in report.rows)} of {len(report.rows)} "
        f"cases not solved in {MOST_PAPER} iterations"
    )
    report.figure = _picture(report)
    return report


def _cases(quick: bool) -> list[tuple[int, float, float, float]]:
    """Return cells along the box, rho, r and dt of each case."""
    if quick:
        return [(32, ratio, r, STEP) for ratio in RATIOS[::2] for r in STIFFNESSES[::2]] + [(32, 1e-3, 1e2, STEP)]
    table = [(64, ratio, r, STEP) for ratio in RATIOS for r in STIFFNESSES]
    table += [(64, 1.0, 1e2 * (dt / STEP) ** 2, dt) for dt in STEPS]
    return table + [(n, ratio, r, STEP) for n in GRIDS for ratio, r in ((1e-3, 1e2), (1.0, 1e2), (1.0, 1e6))]


def scene(case: Case, n: int, ratio: float, stiffness: float, dt: float, solid: bool = True) -> Scene:
    """Return the bar of the given rho and r in a box of n cells along each side. Collective."""
    density, dx = ratio * FLUID_DENSITY, LENGTH / n
    c, s = np.cos(ANGLE) - 1, np.sin(ANGLE)
    speed = 0.1 * dx / dt
    sets: dict[str, Any] = {
        "time.dt": dt,
        "time.integrator": "bdf2",
        "time.end": 10 * dt,
        "gravity": [0.0, 0.0, 0.0],
        "fluid.size": [LENGTH] * 3,
        "fluid.cells": [n] * 3,
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
    """Return outcome, iterations and true residual of one solve. Collective."""
    return solves(case, [(made, options)], 1)[0]


def solves(case: Case, contestants: list[tuple[Scene, str]], repeats: int) -> list[Row]:
    """Return outcome, iterations, residual and best seconds of the first solve of each, made in turn. Collective."""
    rows, ready = [], []
    for made, options in contestants:
        with only_options(_words(options)):
            sim = Simulation(case.comm, made)
            _start(sim)
            ready.append((sim, sim.system.solution.copy()))
        rows.append({"outcome": "converged", "seconds": np.inf, "factorisation": 0.0})
    for _ in range(repeats):
        for (sim, guess), (_, options), row in zip(ready, contestants, rows, strict=True):
            with only_options(_words(options)):
                guess.copy(sim.system.solution)
                _solve_once(case, sim, row)
                if options == MONOLITHIC:
                    row["factorisation"] = _factorisation(case, sim)
    for sim, _ in ready:
        sim.close()
    del ready, sim
    petsc.collect_garbage()  # or the next case's matrices come on top
    return rows


def _start(sim: Simulation) -> None:
    """Assemble the first step of a bar that exerts no force. Collective."""
    sim.prepare(resumes_at=0.0)  # else most of the first solve would have been done at the start
    for field in sim.fields:
        field.predict(sim.time, sim.dt)
    for coupling in sim.couplings:
        coupling.couple(sim.time, sim.dt)
    sim.equations.assemble(sim.time, sim.dt)
    if sim.solid is not None:  # nothing but round-off, yet of a stiff bar more than the flow
        sim.system.rhs.array[sim.system.piece("solid")] = 0.0


def _solve_once(case: Case, sim: Simulation, row: Row) -> None:
    _touch(sim)
    case.comm.Barrier()
    begin = clock.perf_counter()
    try:
        outcome = sim.solver.solve(changed=True)
    except SolveError as error:
        reasons = [word for word in str(error).split() if word.startswith(("DIVERGED", "CONVERGED"))]
        why = reasons[0] if reasons else "broke down"
        row |= {"outcome": why.replace("CONVERGED", "false CONVERGED"), "iterations": -1, "residual": np.nan}
    else:
        row |= {"iterations": outcome.iterations, "residual": outcome.residual}
    row["seconds"] = min(row["seconds"], case.comm.allreduce(clock.perf_counter() - begin) / case.comm.size)


def _factorisation(case: Case, sim: Simulation) -> float:
    """Return the seconds of a factorisation of A as the solver makes it. Collective."""
    solid = sim.solver.solver_of("solid")
    if solid is None:
        return 0.0
    sim.fields[0].block.assemble()
    case.comm.Barrier()
    begin = clock.perf_counter()
    solid.setUp()
    return case.comm.allreduce(clock.perf_counter() - begin) / case.comm.size


def _touch(sim: Simulation) -> None:
    """Have PETSc take the same operator for a new one. Collective."""
    for field in sim.fields:
        field.block.assemble()
    if sim.system.index_sets:
        sim.system.operator.assemble()


def _words(options: str) -> list[str]:
    """Return PETSc's command line for a shipped options file, and options behind it, at the bench's tolerance."""
    words = ["-options_file", *options.split()]
    if options == DIRECT:
        return words
    if options == SPLIT:
        return [*words, "-fsi_fieldsplit_pressure_ksp_rtol", f"{TOLERANCE:g}"]
    words += ["-fsi_ksp_rtol", f"{TOLERANCE:g}"]
    if options.startswith(MONOLITHIC):  # its set-up counts, too
        return [*words, "-fsi_fieldsplit_pressure_lag_change", "0"]
    return [*words, "-fsi_ksp_max_it", str(MOST_PAPER)]


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    n = report.rows[0]["cells"]
    for ratio in RATIOS:
        rows = [row for row in report.rows if row["cells"] == n and row["rho"] == ratio and row["dt"] == STEP]
        r = [row["r"] for row in rows]
        (line,) = left.loglog(r, [row["iterations"] for row in rows], "o-", label=f"rho {ratio:g}")
        right.loglog(r, [row["seconds"] for row in rows], "o-", color=line.get_color())
        solved = [row["paper seconds"] if row["paper outcome"] == "converged" else np.nan for row in rows]
        right.loglog(r, solved, "x:", color=line.get_color())
    left.set(xlabel="r", ylabel="iterations", title=f"default, {n} cells")
    right.set(xlabel="r", ylabel="seconds", title="default (o) and published solver (x)")
    left.legend(fontsize=8)
    return figure
