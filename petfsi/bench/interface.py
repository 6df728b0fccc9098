"""Error against seconds of the ways to couple fluid and solid, on three scenes, each refined along its own path.

The published way is the transfer ``ray`` with ``newmark``, solved at once by BiCGStab (``monolithic-paper.opts``),
split, or split and iterated; beside it stands the transfer ``cutcell`` with each integrator and the default solver.
The published transfer and integrator with the default solver tell what the solver does from what they do.

- ``column``: the layer under water of ``petfsi bench column``, as dense as the water, through two periods; error: rms
  of the top's displacement against the exact one, relative to its rms.
- ``added-mass-disk``: a stiff disk let go in a round container; error: rms over the grid's places of the first
  acceleration against potential theory. The step plays no part in it.
- ``bar``: the clamped bar of ``jobs/bar.toml`` in the plane, in a jet with a smooth profile (of a jet with an edge, the
  grid decides which faces belong to it), until it is bent most of the way; error: rms of the tip's displacement
  against a run of cutcell and midpoint on a finer grid at smaller steps. Such runs, of midpoint and bdf2 on grids of
  32, 48 and 64 cells to half a metre, differ by 0.05% to 0.7% until then and by up to 1.3% at half a second, probably
  because the vortex sheets that an inviscid fluid sheds at edges are as thin as the grid allows: errors much below 1%
  say little here. The bar's own mesh is the same in all runs.

Grid and step are refined together along the path that is cheapest for the scheme: on the column as theory tells, on the
bar the best of all pairs. Seconds at 1% are interpolated along it. Seconds are the wall time of the steps, one run
after the other in one process; set-up and a first run of each kind, in which code is compiled, are left out.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from mpi4py import MPI
from scipy.interpolate import CubicSpline

from petfsi.bench import added_mass
from petfsi.bench.case import ITERATED, MONOLITHIC, SPLIT, Case, job, simulation
from petfsi.bench.column import Column
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError
from petfsi.scene.schema import Scene

PAPER = "monolithic-paper.opts"


@dataclass(frozen=True)
class Scheme:
    """A transfer, an integrator and a solver."""

    transfer: str
    integrator: str
    options: str

    @property
    def name(self) -> str:
        """As the table calls it."""
        solver = "" if self.options == MONOLITHIC else f", {self.options.removesuffix('.opts')}"
        return f"{self.transfer} {self.integrator}{solver}"


DEFAULT = Scheme("cutcell", "bdf2", MONOLITHIC)
MIDPOINT = Scheme("cutcell", "midpoint", MONOLITHIC)
NEWMARK = Scheme("cutcell", "newmark", MONOLITHIC)
PUBLISHED = Scheme("ray", "newmark", PAPER)
RESOLVED = Scheme("ray", "newmark", MONOLITHIC)
PUBLISHED_SPLIT = Scheme("ray", "newmark", SPLIT)
PUBLISHED_ITERATED = Scheme("ray", "newmark", ITERATED)
SCHEMES = (DEFAULT, MIDPOINT, NEWMARK, RESOLVED, PUBLISHED, PUBLISHED_SPLIT, PUBLISHED_ITERATED)
BASELINES = (PUBLISHED, PUBLISHED_SPLIT, PUBLISHED_ITERATED)

WANTED = 0.01
#: What the default may need at that error, in parts of each baseline's seconds, where it is bound to.
PART, BOUND_SCENES = 0.1, ("column", "bar")
#: An error beyond which a run says nothing but that it failed.
LOST = 0.5

#: A grid and a number of steps (per period, per second, or at all).
Path = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class Trial:
    """What a scene needs to be measured: the paths, and a function from a point on one to error and seconds."""

    scene: str
    paths: dict[Scheme, Path]
    measure: Callable[[Scheme, int, int], tuple[float, float, float]]


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Error against seconds of the steps, {case.comm.size} ranks")
    for trial in (_column(case), _disk(case), _bar(case)):
        for scheme in SCHEMES:
            _attempt(trial, scheme, *trial.paths[scheme][0])
            rows = [_row(trial, scheme, *point) for point in trial.paths[scheme]]
            report.rows += rows
        _compare(report, trial.scene)
    report.figure = _picture(report)
    return report


def _row(trial: Trial, scheme: Scheme, cells: int, rate: int) -> Row:
    row: Row = {"scene": trial.scene, "scheme": scheme.name, "cells": cells}
    return row | _attempt(trial, scheme, cells, rate)


def _attempt(trial: Trial, scheme: Scheme, cells: int, rate: int) -> Row:
    """Return step, error and seconds, or why there are none. Collective."""
    try:
        dt, error, seconds = trial.measure(scheme, cells, rate)
    except SolveError as failed:
        why = next((word for word in str(failed).split() if word.startswith("DIVERGED")), "blew up")
        return {"dt": "", "error": "", "seconds": "", "why": why}
    if not error < LOST:
        return {"dt": dt, "error": "", "seconds": "", "why": "far off"}
    return {"dt": dt, "error": error, "seconds": seconds, "why": ""}


def timed(comm: MPI.Comm, scene: Scene, options: str, steps: int, column: str) -> tuple[np.ndarray, float]:
    """Return a probe's value at the start and after each step, and the seconds of all steps. Collective.

    No step is taken again in halves: a scheme that fails at a step has failed.
    """
    once = scene.model_copy(update={"time": scene.time.model_copy(update={"retries": 0})})
    with simulation(comm, once, options) as sim:
        wanted = sim.probe_columns().index(column)
        values, seconds = [sim.probe()[wanted]], 0.0
        for _ in range(steps):
            start = clock.perf_counter()
            sim.advance()
            seconds += clock.perf_counter() - start
            values.append(sim.probe()[wanted])
    return np.array(values), comm.allreduce(seconds, MPI.MAX)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# ---- the scenes ---------------------------------------------------------------------------------------------

PERIODS = 2
#: (cells, steps per period). ``theory.root`` gives the step's share; a ray's error is 2.2 / cells here.
COLUMN_PATHS: dict[Scheme, Path] = {
    DEFAULT: ((8, 40), (16, 80), (32, 160)),
    MIDPOINT: ((8, 20), (16, 40), (32, 80)),
    NEWMARK: ((8, 125), (8, 500), (16, 2000)),
    RESOLVED: ((32, 200), (96, 600), (320, 2000)),
    PUBLISHED: ((32, 200), (96, 600), (320, 2000)),
    PUBLISHED_SPLIT: ((32, 200), (96, 600)),
    PUBLISHED_ITERATED: ((32, 200), (96, 600)),
}


def _column(case: Case) -> Trial:
    def measure(scheme: Scheme, cells: int, rate: int) -> tuple[float, float, float]:
        column = Column(1.0, cells, transfer=scheme.transfer, integrator=scheme.integrator)
        dt = column.period / rate
        y, seconds = timed(case.comm, column.scene(case.comm, dt), scheme.options, PERIODS * rate, "top.y")
        exact = column.exact(dt * np.arange(len(y)))
        return dt, _rms(y - exact) / _rms(exact), seconds

    paths = COLUMN_PATHS
    if case.quick:
        paths = {scheme: [(cells, rate) for cells, rate in path if rate <= 600] for scheme, path in paths.items()}
    return Trial("column", paths, measure)


DISK_PLACES, DISK_STEPS = 6, 3
DISK_CELLS = {"cutcell": (16, 32, 64), "ray": (32, 64, 128, 256)}


def _disk(case: Case) -> Trial:
    """Return the trial of the first acceleration at several places of the grid; its seconds are those of a step."""

    def measure(scheme: Scheme, cells: int, _: int) -> tuple[float, float, float]:
        errors, seconds = [], 0.0
        for offset in added_mass.offsets(DISK_PLACES, 2):
            sets = {
                "time.integrator": scheme.integrator,
                "coupling.transfer": scheme.transfer,
                "fluid.cells": [cells] * 2,
                "fluid.origin": list(-0.5 * added_mass.SIZE + offset * added_mass.SIZE / cells),
                "solids.disk.shape.ball.cells": 2 * round(added_mass.ELEMENTS_PER_CELL[2] * min(cells, 128) / 2),
            }
            scene = job(case.comm, "added-mass-disk", sets)
            dt = float(scene.time.dt)
            v, spent = timed(case.comm, scene, scheme.options, DISK_STEPS, "centre.y")
            errors.append(v[1] / dt / first_acceleration(scene) - 1)
            seconds += spent / DISK_STEPS / DISK_PLACES
        return dt, _rms(np.array(errors)), seconds

    meshes = {kind: cells[: len(cells) - 1] if case.quick else cells for kind, cells in DISK_CELLS.items()}
    return Trial("added-mass-disk", {s: [(n, 1) for n in meshes[s.transfer]] for s in SCHEMES}, measure)


def first_acceleration(scene: Scene) -> float:
    """Return (m_s - m_f) g / (m_s + m_a) of the shipped disk, m/s^2."""
    body = scene.solids["disk"]
    fluid, solid = (density * math.pi * added_mass.RADIUS**2 for density in (added_mass.DENSITY, body.density))
    assert scene.gravity is not None
    return (solid - fluid) * float(scene.gravity[1]) / (solid + added_mass.theoretical(2))


BAR_END = 0.3
BAR = {
    "dim": 2,
    "time.end": BAR_END,
    "fluid.origin": [0.0, 0.0],
    "fluid.size": [2.0, 1.5],
    "fluid.sides": {
        "left": {"inflow": {"speed": "2*exp(-((y - 0.8)/0.2)**2)", "ramp": 0.2, "smoke": 1.0}},
        "right": "open",
        "bottom": "slip",
        "top": "slip",
    },
    "solids.bar.shape": {"box": {"origin": [0.705, 0.0], "size": [0.12, 1.1], "cells": [4, 36]}},
    "solids.bar.density": 20.0,
    "solids.bar.young": 3.0e4,
    "solids.bar.supports": [{"where": "bottom", "fix": ["x", "y"]}],
    "probes.tip.at": [0.765, 1.1],
}
#: (cells to half a metre, steps per second).
BAR_REFERENCE, QUICK_BAR_REFERENCE = (48, 360), (24, 120)
#: No theory tells the best path here: every grid at every step, of which ``front`` keeps what pays.
BAR_CELLS, SECOND_ORDER_RATES, FIRST_ORDER_RATES = (8, 16, 32), (30, 60, 120), (60, 120, 240)
BAR_PATHS: dict[Scheme, Path] = {
    scheme: tuple(product(BAR_CELLS, FIRST_ORDER_RATES if scheme.integrator == "newmark" else SECOND_ORDER_RATES))
    for scheme in SCHEMES
}


def _bar(case: Case) -> Trial:
    def swing(scheme: Scheme, cells: int, rate: int) -> tuple[np.ndarray, np.ndarray, float]:
        sets = {
            **BAR,
            "time.dt": 1 / rate,
            "time.integrator": scheme.integrator,
            "coupling.transfer": scheme.transfer,
            "fluid.cells": [4 * cells, 3 * cells],
        }
        x, seconds = timed(case.comm, job(case.comm, "bar", sets), scheme.options, round(BAR_END * rate), "tip.x")
        return np.arange(len(x)) / rate, x, seconds

    cells, rate = QUICK_BAR_REFERENCE if case.quick else BAR_REFERENCE
    t, x, _ = swing(MIDPOINT, cells, rate)
    reference = CubicSpline(t, x)

    def measure(scheme: Scheme, cells: int, rate: int) -> tuple[float, float, float]:
        t, x, seconds = swing(scheme, cells, rate)
        return 1 / rate, _rms(x - reference(t)) / _rms(reference(t)), seconds

    paths = BAR_PATHS
    if case.quick:
        paths = {
            scheme: [point for point in path if max(point) <= 120 and point[0] < 32] for scheme, path in paths.items()
        }
    return Trial("bar", paths, measure)


# ---- what it comes to ---------------------------------------------------------------------------------------


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points (error, seconds) whose error is below that of all that are cheaper, cheapest first."""
    kept: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda point: point[1]):
        if not kept or point[0] < kept[-1][0]:
            kept.append(point)
    return kept


def seconds_at(error: float, points: Sequence[tuple[float, float]]) -> float | None:
    """Return the seconds that an error costs on the front of some points (error, seconds), or None if none gets there.

    Interpolated between neighbours, in logarithms; a front that begins with a smaller error costs its first point.
    """
    before: tuple[float, float] | None = None
    for point in front(points):
        if point[0] <= error:
            if before is None:
                return point[1]
            part = math.log(before[0] / error) / math.log(before[0] / point[0])
            return before[1] * (point[1] / before[1]) ** part
        before = point
    return None


def _compare(report: Report, scene: str) -> None:
    """Note what each scheme needs for the wanted error, and hold the default against the published ones."""
    rows = [row for row in report.rows if row["scene"] == scene]
    needs = {}
    for scheme in SCHEMES:
        own = [(row["error"], row["seconds"]) for row in rows if row["scheme"] == scheme.name and not row["why"]]
        needs[scheme] = seconds_at(WANTED, own)
    default = needs[DEFAULT]
    for scheme, needed in needs.items():
        if needed is None:
            report.notes.append(f"{scene}: {scheme.name} does not get to {WANTED:.0%}")
            continue
        times = f", {needed / default:.2g} times the default" if default and scheme != DEFAULT else ""
        report.notes.append(f"{scene}: {scheme.name} needs {needed:.3g} s for {WANTED:.0%}{times}")
        if scheme in BASELINES and scene in BOUND_SCENES:
            row: Row = {"scene": scene, "scheme": scheme.name, "seconds": needed, "default": default}
            report.demand(default is not None and default <= PART * needed, row, f"the default needs {PART:.0%} of it")
    report.demand(default is not None, {"scene": scene}, f"the default gets to {WANTED:.0%}")


def _picture(report: Report) -> Figure:
    """Draw a panel for each scene; what failed everywhere is named above it."""
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    scenes = list(dict.fromkeys(row["scene"] for row in report.rows))
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        lost = []
        for n, scheme in enumerate(SCHEMES):
            rows = [row for row in report.rows if (row["scene"], row["scheme"]) == (scene, scheme.name)]
            done = [row for row in rows if not row["why"]]
            line = ("o-", "s-", "v-", "D--", "^--", "<:", ">-.")[n]
            axes.loglog([r["seconds"] for r in done], [r["error"] for r in done], line[0], color=f"C{n}", mfc="none")
            best = front([(r["error"], r["seconds"]) for r in done])
            axes.loglog([p[1] for p in best], [p[0] for p in best], line, color=f"C{n}", mfc="none", label=scheme.name)
            lost += [f"{scheme.name}: {rows[0]['why']}"] if rows and not done else []
        axes.axhline(WANTED, color="k", lw=0.6)
        axes.set_title("\n".join([scene, *lost]), fontsize=8)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(xlabel="seconds of the steps", ylabel="relative error")
        axes.grid(alpha=0.3, which="both", lw=0.4)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure
