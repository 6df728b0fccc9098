"""Particles that bend solids, beside what others measured and computed: a gate, and an obstacle in a dam break.

- ``gate``: jobs/elastic-gate.toml, Antoci's rubber gate; ``plane strain`` with E/(1 - nu^2), ``strip`` with E alone, as
  a narrow one has it, ``soft`` with 7.8e6/(1 - .47^2) Pa, from E and nu of SPHinXsys' example of this gate. Three codes
  open it by 39.0 to 42.7 mm after .115 to .120 s; 46.4 mm after .161 s were measured.
- ``obstacle``: jobs/dambreak.toml with the default artificial viscosity; as the scene's ``beam``, or as ``quadratic``
  triangles; and, not judged, with walls that hold water back (``suction``) or sound twice as fast (``2 c``). Six
  published codes bend it by 41 to 49 mm; nobody measured it.

Displacements are those of the middle of the end, mm: ``peak`` to the side and ``at`` which time (s), ``up`` the highest
(gate) or ``down`` the lowest (obstacle); ``arrival`` is when the obstacle first is 2 mm away. Of the obstacle only what
is before .28 s counts: later the water falls back on it. ``apart`` is the rms distance, mm, from the mean of the codes,
as far as all go. ``residual`` is the largest energy that is not accounted for, over the water's potential energy at the
start.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi.bench import bodies_data as data
from petfsi.bench.case import Case, job, simulation
from petfsi.bench.particles_runs import rms, watched
from petfsi.bench.report import Report, Row

Curves = dict[str, np.ndarray]

#: Modulus of the gate's bending, Pa.
MODULI = {"plane strain": 1.424e7, "strip": 1.196e7, "soft": 1.0e7}
#: The obstacle as triangles.
TRIANGLES = {
    "shape": {"box": {"origin": [0.292, 0.0], "size": [0.012, 0.08], "cells": [2, 14]}},
    "elements": "quadratic",
    "density": 2500.0,
    "young": 1e6,
    "poisson": 0.0,
    "supports": [{"where": "bottom", "fix": ["x", "y"]}],
}
OBSTACLES: dict[str, dict[str, Any]] = {"beam": {}, "quadratic": {"solids.beam": TRIANGLES}}
#: What else the obstacle is bent with, at the first spacing: shown, and not judged. Sound is twice the default's.
OTHERS: dict[str, dict[str, Any]] = {"suction": {"fluid.suction": True}, "2 c": {"fluid.sound_speed": 47.9}}
#: Spacings, m; and ends, s.
GATE_SPACINGS, QUICK_GATE_SPACINGS, GATE_END, QUICK_GATE_END = (0.0025, 0.00125), (0.0025,), 0.36, 0.15
OBSTACLE_SPACINGS, QUICK_OBSTACLE_SPACINGS = {"beam": (0.003, 0.002, 0.0015), "quadratic": (0.003, 0.002)}, (0.003,)
OBSTACLE_END, QUICK_OBSTACLE_END = 0.3, 0.28
#: mm, s: from the least of the codes to what was measured; the least and the largest of the codes; and what is arrival.
GATE_PEAK, GATE_AT = (39.0, 46.4), (0.115, 0.161)
OBSTACLE_PEAK, OBSTACLE_AT, ARRIVAL, ARRIVED = (41.0, 49.0), (0.217, 0.260), (0.145, 0.160), 2.0
#: Potential energy of the water at the start, J/m: rho g times width times half the square of the height.
GATE_STORED, OBSTACLE_STORED = 9810 * 0.1 * 0.14**2 / 2, 9810 * 0.146 * 0.292**2 / 2
#: Of the energy that is not accounted for.
RESIDUAL = 0.02


def bend(comm: MPI.Comm, name: str, spacing: float, end: float, sets: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return times (s) and displacements x, y (mm) of the solid's end in a scene of ``jobs/``. Collective.

    And the largest energy that is not accounted for, J/m. The scene's probe is called ``tip``.
    """
    scene = job(comm, name, {"fluid.spacing": spacing, "time.end": end} | sets)
    with simulation(comm, scene, "monolithic-direct.opts") as sim:
        columns = sim.probe_columns()
        x, y = columns.index("tip.x"), columns.index("tip.y")

        def look() -> list[float]:
            values = sim.probe()
            return [1e3 * values[x], 1e3 * values[y], sim.accounts.values["energy_residual"]]

        seen = watched(sim, 1e-3, look)
    return seen[:, :3], float(np.abs(seen[:, 3]).max())


def peak(seen: np.ndarray) -> tuple[float, float]:
    """Return the largest displacement to the side, mm, and its time, s."""
    k = int(np.argmax(seen[:, 1]))
    return float(seen[k, 1]), float(seen[k, 0])


def arrival(seen: np.ndarray) -> float:
    """Return when the displacement first exceeds ``ARRIVED``, s; not a number if it never does."""
    later = seen[:, 1] > ARRIVED
    if not later.any():
        return float("nan")
    k = int(np.argmax(later))
    if k == 0:
        return float(seen[0, 0])
    (t0, x0), (t1, x1) = seen[k - 1, :2], seen[k, :2]
    return float(t0 + (t1 - t0) * (ARRIVED - x0) / (x1 - x0))


def apart(seen: np.ndarray, published: list[data.Series], end: float) -> float:
    """Return the rms distance of a displacement to the side from the mean of published ones, mm, until ``end`` (s)."""
    end = min([end, seen[-1, 0], *(series[-1][0] for series in published)])
    t = np.linspace(max(series[0][0] for series in published), end, 201)
    mean = np.mean([np.interp(t, *np.transpose(series)) for series in published], axis=0)
    return rms(np.interp(t, seen[:, 0], seen[:, 1]) - mean)


def within(value: float, bounds: tuple[float, float]) -> bool:
    """Return whether a value lies between two."""
    return bounds[0] <= value <= bounds[1]


def gates(case: Case, report: Report) -> Curves:
    """Open the gate over moduli and spacings; return the histories by name. Collective."""
    curves: Curves = {}
    spacings, end = (QUICK_GATE_SPACINGS, QUICK_GATE_END) if case.quick else (GATE_SPACINGS, GATE_END)
    codes = [series for name, series in data.GATE_X.items() if name != "Antoci"]
    for name, young in MODULI.items():
        for spacing in spacings:
            seen, wrong = bend(case.comm, "elastic-gate", spacing, end, {"solids.gate.young": young})
            x, at = peak(seen)
            row: Row = {"part": f"gate, {name}", "spacing": 1e3 * spacing, "peak": x, "at": at}
            row |= {"up": float(seen[:, 2].max()), "apart": apart(seen, codes, end), "residual": wrong / GATE_STORED}
            report.rows.append(row)
            curves[f"{name}, {1e3 * spacing:g} mm"] = seen
            report.demand(within(x, GATE_PEAK), row, f"opens by {GATE_PEAK[0]:g} to {GATE_PEAK[1]:g} mm")
            report.demand(within(at, GATE_AT), row, f"is widest after {GATE_AT[0]:g} to {GATE_AT[1]:g} s")
            report.demand(row["residual"] <= RESIDUAL, row, f"energy accounted for to {RESIDUAL:g}")
    return curves


def obstacles(case: Case, report: Report) -> Curves:
    """Let the dam break against the obstacle; return the histories by name. Collective."""
    curves: Curves = {}
    end = QUICK_OBSTACLE_END if case.quick else OBSTACLE_END
    for name, sets in OBSTACLES.items():
        for spacing in QUICK_OBSTACLE_SPACINGS if case.quick else OBSTACLE_SPACINGS[name]:
            row, curves[f"{name}, {1e3 * spacing:g} mm"] = _obstacle(case, name, spacing, end, sets)
            report.rows.append(row)
            report.demand(within(row["peak"], OBSTACLE_PEAK), row, "bends by {:g} to {:g} mm".format(*OBSTACLE_PEAK))
            report.demand(within(row["at"], OBSTACLE_AT), row, "is bent most after {:g} to {:g} s".format(*OBSTACLE_AT))
            report.demand(within(row["arrival"], ARRIVAL), row, "is reached after {:g} to {:g} s".format(*ARRIVAL))
            report.demand(row["residual"] <= RESIDUAL, row, f"energy accounted for to {RESIDUAL:g}")
    for name, sets in ({} if case.quick else OTHERS).items():
        row, _ = _obstacle(case, name, QUICK_OBSTACLE_SPACINGS[0], QUICK_OBSTACLE_END, sets)
        report.rows.append(row)
    return curves


def _obstacle(case: Case, name: str, spacing: float, end: float, sets: dict[str, Any]) -> tuple[Row, np.ndarray]:
    """Return the numbers of an obstacle, and its history."""
    seen, wrong = bend(case.comm, "dambreak", spacing, end, {"fluid.artificial_viscosity": 0.05} | sets)
    first = seen[seen[:, 0] <= QUICK_OBSTACLE_END]
    x, at = peak(first)
    row: Row = {"part": f"obstacle, {name}", "spacing": 1e3 * spacing, "peak": x, "at": at}
    row |= {"down": float(first[:, 2].min()), "apart": apart(first, list(data.OBSTACLE.values()), QUICK_OBSTACLE_END)}
    return row | {"arrival": arrival(seen), "residual": wrong / OBSTACLE_STORED}, seen


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("Particles that bend solids (mm, s), against experiments and codes")
    opened, bent = gates(case, report), obstacles(case, report)
    if case.comm.rank == 0:
        report.figure = _picture(opened, bent)
    return report


def _picture(opened: Curves, bent: Curves) -> Figure:
    figure = Figure(figsize=(16, 5), layout="constrained")
    side, up, top = figure.subplots(1, 3)
    _draw(side, data.GATE_X, opened, 1)
    _draw(up, data.GATE_Y, opened, 2)
    _draw(top, data.OBSTACLE, bent, 1)
    side.set(xlabel="t, s", ylabel="mm", title="end of the gate, to the side")
    up.set(xlabel="t, s", ylabel="mm", title="end of the gate, up")
    top.set(xlabel="t, s", ylabel="mm", title="top of the obstacle, to the side")
    return figure


def _draw(axes: Axes, published: dict[str, data.Series], curves: Curves, column: int) -> None:
    for (name, series), marker in zip(published.items(), "os^vDx", strict=False):
        measured = name == "Antoci"
        t, x = np.array(series).T
        label, colour = (f"{name}, measured", "k") if measured else (name, "0.6")
        axes.plot(t, x, marker, color=colour, ms=5 if measured else 3, mfc="none", label=label)
    for name, seen in curves.items():
        axes.plot(seen[:, 0], seen[:, column], lw=1, label=name)
    axes.legend(fontsize=7)
