"""What a monolithic step costs beside a split one, phase by phase, on the bar in a jet.

Both simulations advance in turn, a step each, so that whatever else the machine does meets both. Published ratio of a
step's seconds: 1.37 (Chentanez et al. 2006). Both stop at the same residual: the split scheme's pressure, whose
tolerance is relative to what the solid's velocity leaves of the right-hand side, is given that of the whole.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from petfsi.bench.case import MONOLITHIC, SPLIT, Case, job
from petfsi.bench.report import Report, Row
from petfsi.simulation import PHASES, Simulation
from petfsi.solving.option_database import only_options
from petfsi.solving.pressure import SHARE

SCHEMES = (MONOLITHIC, SPLIT)
WARM_UP, STEPS = 2, 12
#: Heavy enough for splitting to be stable: a scheme that blows up has no cost.
SETS = {"solids.bar.density": 100.0, "time.dt": 1 / 120, "time.integrator": "bdf2", "coupling": {"transfer": "cutcell"}}
QUICK = {"fluid.cells": [32, 24, 24], "solids.bar.shape.box.cells": [2, 18, 5]}
PUBLISHED_RATIO = 1.37
#: Of monolithic.opts.
TOLERANCE = 1e-9


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Seconds per step: medians of {STEPS} steps, schemes in turn, {case.comm.size} ranks")
    seconds, iterations = _measure(case)
    medians = {scheme: np.median(seconds[scheme], axis=0) for scheme in SCHEMES}
    totals = {scheme: float(np.median(seconds[scheme].sum(axis=1))) for scheme in SCHEMES}
    names = [scheme.removesuffix(".opts") for scheme in SCHEMES]
    for n, phase in enumerate(PHASES[:-1]):
        row: Row = {"phase": phase, **{name: float(medians[s][n]) for name, s in zip(names, SCHEMES, strict=True)}}
        report.rows.append(row | {"ratio": row[names[0]] / row[names[1]]})
    total: Row = {"phase": "step", **{name: totals[s] for name, s in zip(names, SCHEMES, strict=True)}}
    total["ratio"] = total[names[0]] / total[names[1]]
    report.rows += [
        total,
        {"phase": "iterations", **{name: float(iterations[s]) for name, s in zip(names, SCHEMES, strict=True)}},
    ]
    report.demand(total["ratio"] <= PUBLISHED_RATIO, total, f"a ratio of at most {PUBLISHED_RATIO}, as published")
    report.figure = _picture(report, names)
    return report


def _measure(case: Case) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return the seconds of each step and phase of the slowest rank, and mean iterations, by scheme. Collective."""
    scene = job(case.comm, "bar", {**SETS, **(QUICK if case.quick else {})})
    running: dict[str, Simulation] = {}
    for scheme in SCHEMES:
        with only_options(["-options_file", scheme]):
            running[scheme] = Simulation(case.comm, scene)
            running[scheme].prepare()
    seconds: dict[str, list[list[float]]] = {scheme: [] for scheme in SCHEMES}
    iterations: dict[str, list[int]] = {scheme: [] for scheme in SCHEMES}
    for step in range(WARM_UP + STEPS):
        for scheme in SCHEMES if step % 2 else SCHEMES[::-1]:
            sim = running[scheme]
            before = np.array([sim.phases[name] for name in PHASES[:-1]])
            with only_options(["-options_file", scheme]):
                if scheme == SPLIT:
                    _aim(sim)
                sim.advance()
            seconds[scheme].append(list(np.array([sim.phases[name] for name in PHASES[:-1]]) - before))
            iterations[scheme].append(sim.outcome.iterations)
    slowest = {scheme: np.max(case.comm.allgather(seconds[scheme]), axis=0)[WARM_UP:] for scheme in SCHEMES}
    return slowest, {scheme: float(np.mean(iterations[scheme][WARM_UP:])) for scheme in SCHEMES}


def _aim(sim: Simulation) -> None:
    """Have the split scheme's pressure stop where the monolithic one does, by the last right-hand side. Collective."""
    solver = sim.solver.solver_of("pressure")
    assert solver is not None
    solver.setTolerances(rtol=1e-14, atol=SHARE * TOLERANCE * sim.system.rhs.norm())


def _picture(report: Report, names: list[str]) -> Figure:
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    bottom = np.zeros(len(names))
    for row in report.rows[: len(PHASES) - 1]:
        height = np.array([row[name] for name in names])
        axes.bar(names, height, bottom=bottom, width=0.5, label=row["phase"])
        bottom += height
    total = report.rows[len(PHASES) - 1]
    axes.set(
        ylabel="seconds per step", title=f"monolithic : split = {total['ratio']:.2f} (published: {PUBLISHED_RATIO})"
    )
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
