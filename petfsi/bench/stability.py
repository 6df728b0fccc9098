"""Which schemes keep an elastic bar in a jet bounded, at which steps and dampings.

Figure 6 of Chentanez et al. (2006): time splitting was unstable at a step of 1/30 s and stable at 1/120 s, the
simultaneous solve stable at 1/30 s. Their bar's material is not published. Linear theory (``theory.split_growth``)
has it the other way: damping moves the border of splitting by about h c / 2, so that the smallest steps are the worst.
"""

from __future__ import annotations

import time as clock

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi.bench.case import MONOLITHIC, SPLIT, Case, job, simulation
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError
from petfsi.scene.schema import Scene

LIGHT = {"solids.bar.damping": {"mass": 0.0, "stiffness": 0.001}}
HEAVY = {"solids.bar.damping": {"mass": 0.0, "stiffness": 0.01}}
DAMPINGS = {"light": LIGHT, "heavy": HEAVY}
SCHEMES = (MONOLITHIC, SPLIT)
STEPS_PER_SECOND = (30, 60, 120, 240)
#: Settings of both sizes of the scene.
WHOLE: dict[str, object] = {}
QUICK = {"fluid.cells": [32, 24, 24], "solids.bar.shape.box.cells": [2, 18, 5], "time.end": 1.5}


def run(case: Case) -> Report:
    """Measure; see the module. Only the monolithic solve is bound to be stable. Collective."""
    report = Report("Stability of the bar in a jet")
    for damping, settings in DAMPINGS.items():
        for options in SCHEMES:
            for rate in STEPS_PER_SECOND:
                scene = job(case.comm, "bar", {**(QUICK if case.quick else WHOLE), **settings, **_steps(rate)})
                row: Row = {"damping": damping, "scheme": options.removesuffix(".opts"), "dt": f"1/{rate}"}
                row |= judge(case.comm, scene, options)
                report.rows.append(row)
                if options == MONOLITHIC:
                    report.demand(row["stable"], row, "the monolithic solve is stable")
    report.figure = _picture(report)
    return report


def judge(comm: MPI.Comm, scene: Scene, options: str) -> Row:
    """Run a scene of one bar to its end, or until it fails or the tip is farther away than the bar is long. Collective.

    Returns
    -------
    dict
        Whether it is stable, the step it failed at, and the tip's largest displacement until then, m.
    """
    start = clock.perf_counter()
    box = scene.solids["bar"].shape.box
    assert box is not None
    length, largest, why = max(box.size), 0.0, ""
    with simulation(comm, scene, options) as sim:
        tip = [n for n, name in enumerate(sim.probe_columns()) if name.startswith("tip.")]
        try:
            while not sim.finished and not why:
                sim.advance()
                largest = max(largest, float(np.linalg.norm(np.array(sim.probe())[tip])))
                if not largest < length:
                    why = "out of bounds"
        except SolveError as error:
            why = str(error).split(":")[0].split(" after")[0]
        failed: int | str = sim.step + 1 if why else ""
    seconds = comm.bcast(clock.perf_counter() - start)
    return {
        "stable": not why,
        "steps": sim.step,
        "failed at step": failed,
        "largest displacement": largest,
        "seconds": seconds,
        "why": why,
    }


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(8, 2.6), layout="constrained")
    for axes, damping in zip(figure.subplots(1, len(DAMPINGS), squeeze=False)[0], DAMPINGS, strict=True):
        rows = [row for row in report.rows if row["damping"] == damping]
        schemes, steps = (list(dict.fromkeys(row[name] for row in rows)) for name in ("scheme", "dt"))
        stable = np.array([row["stable"] for row in rows]).reshape(len(schemes), len(steps))
        axes.imshow(stable, cmap=ListedColormap(["#d9705f", "#7fb77e"]), vmin=0, vmax=1, aspect="auto")
        for n, row in enumerate(rows):
            text = f"{row['largest displacement']:.2f} m" if row["stable"] else f"failed at {row['failed at step']}"
            axes.text(n % len(steps), n // len(steps), text, ha="center", va="center", fontsize=8)
        axes.set_xticks(range(len(steps)), steps)
        axes.set_yticks(range(len(schemes)), schemes)
        axes.set(xlabel="dt, s", title=f"{damping} damping")
    return figure


def _steps(rate: int) -> dict[str, object]:
    """Return the settings of so many steps a second, none of which is taken again in halves."""
    return {"time.dt": 1 / rate, "time.retries": 0, "time.integrator": "bdf2", "time.energy_limit": -1}
