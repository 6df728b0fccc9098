"""Thirty runs at the ends of what scenes may say: each is right by a check that it states, or stops and says why.

Densities over that of water are 1e-4 to 1e4, moduli 1e-2 to 1e12 Pa, steps .001 to 10 cells of the body's way, with
three integrators and both transfers.

- ``column``: a layer under water swings in its first mode, 40 steps a period on 16 cells. Its frequency is theory's.
- ``set off``: a disk in a round container of water is given 1 m/s, and takes thirty steps, or as many as lead over half
  a radius. Where it and the water with it are rigid within a step, h^2 E > 64 R^2 times the larger density, it keeps
  m/(m + m_a) of that, see ``added_mass``, until it has gone a fifth of the gap; where sound has not come to its middle
  that goes on at 1 m/s. In between the energy alone is looked at.
- ``rest``: a disk as dense as the water hangs in a closed box under gravity. It stays there: no more moves than the
  pressure can squeeze, (rho g H)^2 V / E.

No more energy comes out of nothing than ``CREATED`` of what there was, and no cell's net outflow is beyond the solver's
tolerance, which is relative to the momentum of the denser. A row that is neither right nor stopped is out of bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle, islice
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi.bench import added_mass, theory
from petfsi.bench.case import MONOLITHIC, Case, job, simulation
from petfsi.bench.column import Column
from petfsi.bench.report import Report, Row
from petfsi.errors import InputError, SolveError
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

SCHEMES, TRANSFERS = ("newmark", "bdf2", "midpoint"), ("cutcell", "ray")
#: Density ratio, modulus in Pa, cells a step: every decade of one meets far ones of the others.
SET_OFF = [
    (1e-4, 1e-2, 1e-3), (1e-4, 1e4, 10.0), (1e-4, 1e12, 0.1), (1e-4, 1e8, 1e-2),
    (1e-2, 1.0, 1.0), (1e-2, 1e6, 1e-3), (1e-2, 1e12, 1.0), (1e-2, 1e3, 0.1),
    (1.0, 1e-2, 0.1), (1.0, 1e5, 1e-2), (1.0, 1e9, 10.0), (1.0, 1e12, 1e-3),
    (1e2, 1e-2, 0.3), (1e2, 1e7, 0.1), (1e2, 1e12, 1e-2), (1e4, 1e-2, 1e-2), (1e4, 1e5, 1.0), (1e4, 1e12, 0.3),
]  # fmt: skip
COLUMNS = (1e-4, 1e-2, 1.0, 1e2, 1e4, 1.0)
#: Modulus in Pa and step in s.
REST = ((1e8, 1.0), (1e7, 1e-4), (1e10, 0.1), (1e12, 1e-3), (1e12, 1.0), (1e9, 1e-2))
QUICK = 4  # every so many

CREATED, OUTFLOW = 0.05, 1e-8
FREQUENCY, CELLS, PER_PERIOD, PERIODS = 0.05, 16, 40, 2
RIGID_SPEED, SOFT_SPEED = {"cutcell": 0.02, "ray": 0.15}, 0.01
DISK_CELLS, STEPS = 24, 30
#: Quantities with what they may be.
Bounded = dict[str, tuple[float, float]]
#: Kinetic energy at rest, over the weight times the height of the box; ray's buoyancy is that of whole cells.
AT_REST = {"cutcell": 1e-12, "ray": 1e-2}


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("Runs at extremes: right by a stated check, or stopped by name")
    pairs = cycle([(scheme, transfer) for transfer in TRANSFERS for scheme in SCHEMES])
    every = QUICK if case.quick else 1
    for ratio, (scheme, transfer) in islice(zip(COLUMNS, pairs, strict=False), 0, None, every):
        _enter(report, {"part": "column", "rho": ratio, "scheme": scheme, "transfer": transfer}, _column, case.comm)
    for numbers, (scheme, transfer) in islice(zip(SET_OFF, pairs, strict=False), 0, None, every):
        row: Row = {"part": "set off", **dict(zip(("rho", "E", "cells a step"), numbers, strict=True))}
        _enter(report, row | {"scheme": scheme, "transfer": transfer}, _set_off, case.comm)
    for (young, dt), (scheme, transfer) in islice(zip(REST, pairs, strict=False), 0, None, every):
        row = {"part": "rest", "rho": 1.0, "E": young, "dt": dt, "scheme": scheme, "transfer": transfer}
        _enter(report, row, _rest, case.comm)
    verdicts = [row["verdict"] for row in report.rows]
    report.notes.append(", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts)))
    report.figure = _picture(report)
    return report


def _enter(report: Report, row: Row, measure: Callable[[MPI.Comm, Row], Bounded], comm: MPI.Comm) -> None:
    """Measure a row, and judge it. Collective."""
    try:
        # what overflows is found by those who judge the solve
        with np.errstate(all="ignore"):
            found = measure(comm, row)
    except (SolveError, InputError) as error:
        row |= {"verdict": "stopped", "why": str(error).split(": ")[0][:70]}
    else:
        wrong = [name for name, (value, bound) in found.items() if not abs(value) <= bound]
        row |= {name: value for name, (value, _) in found.items()} | {"verdict": "wrong" if wrong else "right"}
        row["why"] = ", ".join(wrong)
    report.rows.append(row)
    report.demand(row["verdict"] != "wrong", row, "right, or stopped by name")


def _column(comm: MPI.Comm, row: Row) -> Bounded:
    """Return each quantity of a column with its bound. Collective."""
    column = Column(row["rho"], CELLS, 2, row["transfer"], row["scheme"])
    dt = column.period / PER_PERIOD
    with simulation(comm, column.scene(comm, dt), MONOLITHIC) as sim:
        top, created = sim.probe_columns().index("top.y"), 0.0
        y = [sim.probe()[top]]
        for _ in range(PERIODS * PER_PERIOD):
            sim.advance()
            y.append(sim.probe()[top])
            created = max(created, _created(sim))
    omega, damping = theory.observed(row["scheme"], column.omega, dt)
    seen, _ = theory.fit_damped_sinusoid(dt * np.arange(len(y)), np.array(y), omega, damping)
    return {"speed or frequency": (seen / omega - 1, FREQUENCY), "created": (created, CREATED)}


def _set_off(comm: MPI.Comm, row: Row) -> Bounded:
    """Return the same of a disk that is set off. Collective."""
    radius, cell = added_mass.RADIUS, added_mass.SIZE / DISK_CELLS
    dt, density = row["cells a step"] * cell, row["rho"] * added_mass.DENSITY
    steps = max(1, min(STEPS, int(radius / 2 / dt)))
    sets = {
        "gravity": [0.0, 0.0],
        "time.dt": dt,
        "time.end": STEPS * dt,
        "time.integrator": row["scheme"],
        "fluid.cells": [DISK_CELLS] * 2,
        "coupling.transfer": row["transfer"],
        "solids.disk.density": density,
        "solids.disk.young": row["E"],
        "solids.disk.shape.ball.cells": DISK_CELLS // 2,
        "solids.disk.initial.velocity": [0.0, 1.0],
    }
    with simulation(comm, job(comm, "added-mass-disk", sets), MONOLITHIC) as sim:
        created, outflow = 0.0, 0.0
        for _ in range(steps):
            sim.advance()
            created, outflow = max(created, _created(sim)), max(outflow, sim.divergence())
        found = {"created": (created, CREATED), "outflow": (outflow, OUTFLOW * max(1.0, row["rho"]))}
        mass, middle, sound = _mass(sim, density), _middle(sim, radius), float(np.sqrt(row["E"] / density))
        kept = mass / (mass + added_mass.theoretical(2))
        rigid = row["E"] * dt**2 > (8 * radius) ** 2 * max(density, added_mass.DENSITY)
        if rigid and steps * dt * kept < 0.2 * (added_mass.CONTAINER - radius):
            found["speed or frequency"] = (middle / kept - 1, RIGID_SPEED[row["transfer"]])
        elif sound * (steps + 1) * dt < radius / 4:
            found["speed or frequency"] = (middle - 1, SOFT_SPEED)
    return found


def _rest(comm: MPI.Comm, row: Row) -> Bounded:
    """Return the same of a disk that hangs in water. Collective."""
    shape = {"ball": {"centre": [0.5, 0.5], "radius": 0.2, "cells": 8}}
    disk = {"shape": shape, "density": 1000.0, "young": row["E"], "poisson": 0.3}
    with simulation(comm, _box(row["dt"], row["scheme"], row["transfer"], disk), MONOLITHIC) as sim:
        moving = 0.0
        for _ in range(STEPS):
            sim.advance()
            moving = max(moving, sim.accounts.values["kinetic"])
    pressure, volume = 1000.0 * 9.81 * 1.0, np.pi * 0.2**2
    scale, squeezed = pressure * volume, pressure**2 * volume / row["E"]
    return {"kinetic at rest": (moving / scale, AT_REST[row["transfer"]] + squeezed / scale)}


def _box(dt: float, scheme: str, transfer: str, disk: dict[str, Any]) -> Scene:
    water = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16]}
    time = {"end": STEPS * dt, "dt": dt, "integrator": scheme}
    scene = {"dim": 2, "gravity": [0.0, -9.81], "time": time, "fluid": water, "solids": {"disk": disk}}
    return scene_from_dict(scene | {"coupling": {"transfer": transfer}})


def _created(sim: Simulation) -> float:
    """Return the energy out of nothing so far over all that was exchanged, or nothing if it is less than nothing."""
    return max(0.0, sim.accounts.values["energy_residual"]) / max(sim.accounts.exchanged, float(np.finfo(float).tiny))


def _mass(sim: Simulation, density: float) -> float:
    """Return the disk's mass, kg/m."""
    solid: Any = sim.solid
    return float(density * solid.volumes()["disk"])


def _middle(sim: Simulation, radius: float) -> float:
    """Return the mean speed upwards of the disk's inner half, m/s. Collective."""
    solid: Any = sim.solid
    inner = np.linalg.norm(solid.reference, axis=1) < radius / 2
    total = sim.comm.allreduce(np.array([solid.velocity[inner, 1].sum(), inner.sum()]))
    return float(total[0] / total[1])


def _picture(report: Report) -> Figure:
    """Draw where each run lies, and what became of it."""
    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    rows = [row for row in report.rows if row["part"] == "set off"]
    for verdict, marker in (("right", "o"), ("stopped", "s"), ("wrong", "x")):
        some = [row for row in rows if row["verdict"] == verdict]
        axes.scatter([row["E"] for row in some], [row["rho"] for row in some], marker=marker, label=verdict)
    for row in rows:
        axes.annotate(f" {row['cells a step']:g}", (row["E"], row["rho"]), fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="E, Pa (numbers: cells a step)", ylabel="density over water's")
    axes.legend(fontsize=8)
    return figure
