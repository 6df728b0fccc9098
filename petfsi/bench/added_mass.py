"""The added mass of a disk and a ball in a round container, on grids anywhere between the cells, against theory.

A body of radius R at the centre of a container of radius B, both full of or surrounded by a fluid of density rho:

    m_a = rho pi R^2 (B^2 + R^2) / (B^2 - R^2)  in 2D,      rho (2/3) pi R^3 (B^3 + 2 R^3) / (B^3 - R^3)  in 3D.

One step of Newmark's scheme from rest in the geometry gives a rigid body exactly  (m_s + m_a) u = I  with the impulse

    I = m_s u_0                 a body as heavy as the fluid or heavier, set off at u_0 in fluid at rest,
    I = h (m_s - m_f) g         a lighter one, let go under gravity,

and so m_a = I/u - m_s whatever h is; m_s and m_f are those of the body's mesh. (A kick alone would do for all, but
leaves a light body's motion to round-off.) That the body is not quite rigid, h^2 E / (rho R^2) = 6e3, costs 1e-4.

The grid is put at 20 places between the cells; the table gives the root of the mean square of the error, its mean and
its worst. The transfer ``ray`` is first order and has a bias; under gravity it also misses some of the buoyancy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from mpi4py import MPI

from petfsi.bench.case import MONOLITHIC, Case, job, simulation
from petfsi.bench.report import Report, Row
from petfsi.fields.solid import SimplexSolid
from petfsi.scene.schema import Scene

TRANSFERS = ("cutcell", "ray")
RATIOS = (0.01, 1.0, 100.0)
CELLS, OFFSETS = (16, 32, 64, 128), 20
QUICK_CELLS, QUICK_OFFSETS = (16, 32, 64), 6
BALL_CELLS, QUICK_BALL_CELLS, BALL_OFFSETS = (24, 48), (24,), 2

DENSITY, RADIUS, CONTAINER, SIZE = 1000.0, 0.4, 1.0, 2.2
DT, SPEED, YOUNG = 0.1, 1e-3, 1e8
#: Elements across the body per cell of the grid's axis.
ELEMENTS_PER_CELL = {2: 0.5, 3: 0.25}

#: Bounds on the exact transfer.
DISK_ERROR, DISK_ERROR_AT = 0.002, 64
DISK_ORDER = 1.6
BALL_ERROR, BALL_ERROR_AT = 0.013, 48


def theoretical(dim: int) -> float:
    """Return m_a of the disk (kg/m) or the ball (kg)."""
    d, R, B = dim, RADIUS, CONTAINER
    volume = {2: math.pi * R**2, 3: 4 / 3 * math.pi * R**3}[d]
    return DENSITY * volume / (d - 1) * (B**d + (d - 1) * R**d) / (B**d - R**d)


def offsets(n: int, dim: int) -> np.ndarray:
    """Return ``n`` points spread evenly over a cell about 0, shape (n, dim), in units of its edge.

    References
    ----------
    M. Roberts, The unreasonable effectiveness of quasirandom sequences (2018): multiples of the generalised golden
    ratio's powers.
    """
    ratio = {2: 1.32471795724474602596, 3: 1.22074408460575947536}[dim]
    return np.mod(0.5 + np.outer(np.arange(1, n + 1), ratio ** -np.arange(1.0, dim + 1)), 1.0) - 0.5


@dataclass(frozen=True)
class Body:
    """A disk or a ball ``ratio`` times as dense as the fluid, on a grid of ``cells`` to an edge."""

    dim: int
    ratio: float
    cells: int
    transfer: str = "cutcell"

    @property
    def name(self) -> str:
        """As the scene calls it."""
        return {2: "disk", 3: "ball"}[self.dim]

    def scene(self, comm: MPI.Comm, offset: np.ndarray) -> Scene:
        """Return the scene on a grid that lies ``offset`` cells off. Collective."""
        name, dim = self.name, self.dim
        kicked, rest = np.zeros(dim), np.zeros(dim)
        (kicked if self.ratio >= 1 else rest)[1] = -SPEED
        origin = -0.5 * SIZE + offset * SIZE / self.cells
        sets = {
            "gravity": list(rest / DT),
            "time.dt": DT,
            "time.end": 10 * DT,
            "time.integrator": "newmark",
            "fluid.density": DENSITY,
            "fluid.origin": list(origin),
            "fluid.cells": [self.cells] * dim,
            "coupling.transfer": self.transfer,
            f"solids.{name}.density": self.ratio * DENSITY,
            f"solids.{name}.young": YOUNG * max(1.0, self.ratio),  # as rigid beside its own inertia
            f"solids.{name}.shape.ball.cells": 2 * round(ELEMENTS_PER_CELL[dim] * self.cells / 2),
            f"solids.{name}.initial.velocity": list(kicked),
        }
        return job(comm, f"added-mass-{name}", sets)

    def measure(self, comm: MPI.Comm, offset: np.ndarray) -> float:
        """Return the measured m_a over theory's, less 1. Collective."""
        with simulation(comm, self.scene(comm, offset), MONOLITHIC) as sim:
            assert isinstance(sim.solid, SimplexSolid)
            volume = sim.solid.volumes()[self.name]
            sim.advance()
            u = sim.probe()[sim.probe_columns().index("centre.y")]
        heavy = self.ratio * DENSITY * volume
        driven = heavy if self.ratio >= 1 else heavy - DENSITY * volume
        return (-driven * SPEED / u - heavy) / theoretical(self.dim) - 1


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("Error of the added mass over the grid's places (rms, mean, worst; relative)")
    meshes, n = (QUICK_CELLS, QUICK_OFFSETS) if case.quick else (CELLS, OFFSETS)
    for transfer in TRANSFERS:
        for ratio in RATIOS:
            rows = [_row(case.comm, Body(2, ratio, cells, transfer), n) for cells in meshes]
            report.rows += rows
            _judge_disk(report, rows)
    for transfer in TRANSFERS:
        for ratio in RATIOS[1:2] if case.quick else RATIOS:
            for cells in QUICK_BALL_CELLS if case.quick else BALL_CELLS:
                row = _row(case.comm, Body(3, ratio, cells, transfer), BALL_OFFSETS)
                report.rows.append(row)
                if transfer == "cutcell" and cells >= BALL_ERROR_AT:
                    report.demand(row["rms"] < BALL_ERROR, row, f"rms below {BALL_ERROR:.1%}")
    report.figure = _picture(report)
    return report


def _row(comm: MPI.Comm, body: Body, n: int) -> Row:
    errors = np.array([body.measure(comm, offset) for offset in offsets(n, body.dim)])
    return {
        "body": body.name,
        "transfer": body.transfer,
        "ratio": body.ratio,
        "cells": body.cells,
        "places": n,
        "rms": float(np.sqrt(np.mean(errors**2))),
        "mean": float(errors.mean()),
        "worst": float(np.abs(errors).max()),
    }


def _judge_disk(report: Report, rows: list[Row]) -> None:
    first, last = rows[0], rows[-1]
    slope, _ = np.polyfit(np.log([row["cells"] for row in rows]), np.log([row["rms"] for row in rows]), 1)
    name = f"disk, {first['transfer']}, ratio {first['ratio']:g}"
    report.notes.append(f"{name}: fitted order of the rms {-slope:.2f} over {first['cells']} to {last['cells']} cells")
    if first["transfer"] != "cutcell":
        return
    report.demand(-slope >= DISK_ORDER, last, f"fitted order of at least {DISK_ORDER}")
    for row in rows:
        if row["cells"] >= DISK_ERROR_AT:
            report.demand(row["rms"] < DISK_ERROR, row, f"rms below {DISK_ERROR:.2%}")


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    for axes, body in zip(figure.subplots(1, 2, sharey=True), ("disk", "ball"), strict=True):
        rows = [row for row in report.rows if row["body"] == body]
        for colour, transfer in enumerate(TRANSFERS):
            for ratio, marker in zip(RATIOS, "osv", strict=True):
                one = [row for row in rows if (row["transfer"], row["ratio"]) == (transfer, ratio)]
                label = rf"{transfer}, $\rho_s/\rho_f$ = {ratio:g}"
                style = {"color": f"C{colour}", "mfc": "none", "label": label}
                if one:
                    axes.loglog([r["cells"] for r in one], [r["rms"] for r in one], marker + "-", **style)
        cells = list(dict.fromkeys(row["cells"] for row in rows))
        best = min(row["rms"] for row in rows)
        axes.loglog(cells, 0.7 * best * (max(cells) / np.array(cells)) ** 2, "k--", lw=0.8, label="second order")
        axes.set_xticks(cells, [f"{n}" for n in cells])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set(xlabel="cells along an axis", ylabel="rms error of the added mass", title=body)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure
