"""The first mode of an elastic layer under a column of water: frequency and damping, against theory.

The layer's foot is held and the water's top is open, so that the water moves as one mass on the layer. With
rho_s, L_s, M the layer's density, height and P-wave modulus and rho_f, L_f the water's, the angular frequency omega is

    x tan x = rho_s L_s / (rho_f L_f),    omega = (x / L_s) sqrt(M / rho_s).

The ray transfer takes the pressure on the top from the centre of the first cell above, and so leaves half a cell of
water out of the mass that the layer carries: first order in the mesh. The table gives what is left of the error
against that shorter column, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import MONOLITHIC, Case, history, job
from petfsi.bench.report import Report, Row
from petfsi.scene.schema import Scene

YOUNG, POISSON, FLUID_DENSITY = 1.0e5, 0.3, 1000.0
SOLID_HEIGHT, FLUID_HEIGHT = 0.5, 1.5
MODULUS = theory.p_wave_modulus(YOUNG, POISSON)

RATIOS = (0.1, 1.0, 10.0)
CELLS = (16, 32, 64)
#: Steps per period: where the mesh's error is measured, and where the step's is.
FINE, COARSE = 200, (10, 20, 40, 80)
PERIODS = 3
#: Largest velocity at the start, m/s: the top moves by a millionth of a cell.
SPEED = 1e-6

LARGEST_ERROR = 0.02  # of the frequency on the finest mesh at FINE steps
THEORY_ERROR = 1e-4  # of the frequency at COARSE steps against that of the same mode at FINE ones
DAMPING_ERROR = 1e-3  # of the damping rate against Newmark's


@dataclass(frozen=True)
class Column:
    """A column of ``cells`` cells of water and layer along y, ``wide`` cells across."""

    ratio: float
    cells: int
    wide: int = 4

    @property
    def height(self) -> float:
        """Of layer and water together, m."""
        return SOLID_HEIGHT + FLUID_HEIGHT

    @property
    def wave_number(self) -> float:
        """The x of the mode shape sin(x y / L_s)."""
        return theory.first_wave_number(self.ratio * SOLID_HEIGHT / FLUID_HEIGHT)

    @property
    def omega(self) -> float:
        """The exact angular frequency, rad/s."""
        return self._frequency(FLUID_HEIGHT)

    @property
    def omega_without_half_cell(self) -> float:
        """The angular frequency under a column that lacks half a cell, rad/s."""
        return self._frequency(FLUID_HEIGHT - 0.5 * self.height / self.cells)

    def _frequency(self, fluid_height: float) -> float:
        x = theory.first_wave_number(self.ratio * SOLID_HEIGHT / fluid_height)
        return x / SOLID_HEIGHT * float(np.sqrt(MODULUS / (self.ratio * FLUID_DENSITY)))

    def scene(self, comm: MPI.Comm, dt: float) -> Scene:
        """Return the scene that starts in the first mode, water included. Collective."""
        width = self.wide * self.height / self.cells
        x = self.wave_number
        sets = {
            "gravity": [0.0, 0.0],
            "time.dt": dt,
            "time.end": 1e4 * dt,
            "fluid.density": FLUID_DENSITY,
            "fluid.size": [width, self.height],
            "fluid.cells": [self.wide, self.cells],
            "coupling.transfer": "ray",
            "time.integrator": "newmark",
            "fluid.initial.velocity": [0.0, SPEED * float(np.sin(x))],
            "solids.layer.shape.box.size": [width, SOLID_HEIGHT],
            "solids.layer.shape.box.cells": [max(1, self.wide // 2), self.cells // 8],
            "solids.layer.density": self.ratio * FLUID_DENSITY,
            "solids.layer.young": YOUNG,
            "solids.layer.poisson": POISSON,
            "solids.layer.initial.velocity": ["0.0", f"{SPEED}*sin({x / SOLID_HEIGHT!r}*y)"],
            "probes.top.at": [0.5 * width, SOLID_HEIGHT],
        }
        return job(comm, "column", sets)

    def measure(self, comm: MPI.Comm, per_period: int) -> tuple[float, float, float]:
        """Return step, angular frequency and damping rate of the top's motion. Collective."""
        dt = 2 * np.pi / self.omega / per_period
        y = history(comm, self.scene(comm, dt), MONOLITHIC, PERIODS * per_period)
        guess = theory.newmark_observed(self.omega, dt)
        return (dt, *theory.fit_damped_sinusoid(dt * np.arange(len(y)), y, *guess))


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("First angular frequency of an elastic layer under water (rad/s, damping in 1/s)")
    ratios = RATIOS[1:2] if case.quick else RATIOS
    for ratio in ratios:
        limit = _refine_mesh(case, report, ratio)
        _refine_step(case, report, ratio, limit)
    if not case.quick:
        column = Column(1.0, 64, wide=32)
        row = _row(column, "shipped width", *column.measure(case.comm, FINE))
        report.rows.append(row)
        report.demand(abs(row["error"]) < LARGEST_ERROR, row, f"error below {LARGEST_ERROR:.0%}")
    report.figure = _picture(report)
    return report


def _row(column: Column, study: str, dt: float, omega: float, damping: float) -> Row:
    """Return what was measured beside what is exact, and beside what Newmark's scheme makes of the exact mode."""
    return {
        "study": study,
        "ratio": column.ratio,
        "cells": column.cells,
        "steps/period": round(2 * np.pi / column.omega / dt),
        "dt": float(dt),
        "omega": omega,
        "exact": column.omega,
        "error": omega / column.omega - 1,
        "less half a cell": omega / column.omega_without_half_cell - 1,
        "damping": damping,
        "newmark damping": theory.newmark_observed(column.omega, dt)[1],
    }


def _refine_mesh(case: Case, report: Report, ratio: float) -> float:
    """Measure on finer and finer meshes; return the frequency on the last one at vanishing steps. Collective."""
    rows = []
    for cells in CELLS:
        column = Column(ratio, cells)
        rows.append(_row(column, "mesh", *column.measure(case.comm, FINE)))
    report.rows += rows
    seen = theory.orders([row["error"] for row in rows], [1 / row["cells"] for row in rows])
    report.notes.append(f"ratio {ratio:g}: observed orders in the mesh {np.array2string(seen, precision=2)}")
    last = rows[-1]
    report.demand(abs(last["error"]) < LARGEST_ERROR, last, f"error below {LARGEST_ERROR:.0%}")
    return theory.undo_newmark(last["omega"], last["dt"])


def _refine_step(case: Case, report: Report, ratio: float, limit: float) -> None:
    """Measure at smaller and smaller steps on the finest mesh, whose own frequency is ``limit``. Collective."""
    column = Column(ratio, CELLS[-1])
    rows = []
    for per_period in COARSE:
        row = _row(column, "step", *column.measure(case.comm, per_period))
        predicted, damping = theory.newmark_observed(limit, row["dt"])
        row |= {
            "newmark damping": damping,
            "step error": row["omega"] / limit - 1,
            "newmark": predicted / limit - 1,
        }
        rows.append(row)
        report.demand(abs(row["omega"] / predicted - 1) < THEORY_ERROR, row, "frequency of Newmark's scheme")
        report.demand(abs(row["damping"] / damping - 1) < DAMPING_ERROR, row, "damping of Newmark's scheme")
    report.rows += rows
    steps = [row["dt"] for row in rows]
    for name, column_name, order in (("frequency", "step error", 2.0), ("damping", "damping", 1.0)):
        seen = theory.orders([row[column_name] for row in rows], steps)
        report.notes.append(
            f"ratio {ratio:g}: observed orders of the {name} in the step {np.array2string(seen, precision=2)}"
        )
        report.demand(abs(seen[-1] - order) < 0.15, rows[-1], f"order {order:g} of the {name}")


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    mesh, step, damping = figure.subplots(1, 3)
    for ratio in dict.fromkeys(row["ratio"] for row in report.rows):
        rows = [row for row in report.rows if row["ratio"] == ratio]
        one = [row for row in rows if row["study"] == "mesh"]
        (line,) = mesh.loglog(
            [r["cells"] for r in one], [abs(r["error"]) for r in one], "o-", label=rf"$\rho_s/\rho_f$ = {ratio:g}"
        )
        two = [row for row in rows if row["study"] == "step"]
        x = [1 / r["steps/period"] for r in two]
        step.loglog(x, [abs(r["step error"]) for r in two], "o", color=line.get_color())
        step.loglog(x, [abs(r["newmark"]) for r in two], "-", color=line.get_color(), lw=0.8)
        period = np.array([r["dt"] * r["steps/period"] for r in two])
        damping.loglog(x, period * [r["damping"] for r in two], "o", color=line.get_color())
        damping.loglog(x, period * [r["newmark damping"] for r in two], "-", color=line.get_color(), lw=0.8)
    mesh.set(xlabel="cells along y", ylabel="relative error of the frequency", title="mesh")
    mesh.legend()
    for axes, ticks in ((mesh, CELLS), (step, [1 / n for n in COARSE]), (damping, [1 / n for n in COARSE])):
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
    step.set(xlabel="dt / period", ylabel="relative error of the frequency", title="step (lines: theory)")
    damping.set(xlabel="dt / period", ylabel="damping rate x period", title="numerical damping (lines: theory)")
    return figure
