"""How fast particles are: steps per second, where the seconds go, and the memory of a particle.

Water that turns over at a tenth of the speed of sound, so that lists of pairs do not last:

- ``2D``, ``3D``: a column in one corner of a tank, those of PySPH's examples dam_break_2d and dam_break_3d (without the
  latter's obstacle).
- ``beam``: the tank and beam of jobs/dambreak.toml, with water as far as the beam.

``steps/s`` is how many particles of the fluid, those of walls not among them, a second of the processor moves a step
on; on several ranks a second of the clock. Density and forces are found once each in a step. ``lists`` is how often in
a step pairs are listed. Phases are shares of a few more steps under Python's profiler, as rank 0 sees them. ``bytes``
is what the process holds more for each of its particles than before it had any.
"""

from __future__ import annotations

import cProfile
import ctypes
import gc
import os
import pstats
import time as clock
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi.bench.case import Case, job
from petfsi.bench.particles_runs import box, particles, prepared
from petfsi.bench.report import Report, Row
from petfsi.simulation import Simulation
from petfsi.solving.option_database import only_options

SIZES, QUICK_SIZES = (10_000, 100_000, 1_000_000), (10_000,)
#: Columns of 1 x 2 m in the plane, and of 1.228 x 0.55 x 1 m in space; of the beam's, so far and as high as the dam's.
COLUMNS = {"2D": [1.0, 2.0], "3D": [1.228, 0.55, 1.0], "beam": [0.292, 0.146]}
TANKS = {"2D": [4.0, 4.0], "3D": [3.22, 1.0, 1.0]}
#: Largest speed over that of sound.
MACH = 0.1
#: So many particles are moved on a step in all, but at least and at most so many steps are taken; some before.
MOVED, FEWEST, MOST, WARM_UP, PROFILED = 2_000_000, 6, 100, 6, 4
#: A particle may take so much longer among ten times as many, from this number on.
GROWTH, GROWTH_FROM = 1.1, 100_000

#: Where the functions of each phase are: the end of the file's name, and the function, or any.
PHASES = {
    "sort": [("sph/particles.py", ""), ("sph/balance.py", ""), ("sph/cells.py", "_sort"), ("sph/cells.py", "_cells")],
    "walls": [("sph/cells.py", "wall"), ("sph/walls.py", ""), ("sph/loops.py", "wall_")],
    "list": [("sph/cells.py", ""), ("sph/moves.py", "spread")],
    "density": [("sph/loops.py", "density")],
    "forces": [("sph/loops.py", ""), ("sph/passes.py", "")],
    "moves": [("sph/moves.py", ""), ("sph/fluid.py", ""), ("sph/law.py", ""), ("sph/room.py", "")],
    "exchange": [("sph/transport.py", ""), ("", "reduce' of 'mpi4py"), ("", "Waitall")],
    "coupling": [(part, "") for part in (
        "sph/skin", "sph/sight", "couplings/", "fields/solid/", "fields/beam/", "petfsi/system", "petfsi/solve",
        "petfsi/petsc", "geometry/", "scipy/sparse",
    )] + [("", "petsc4py")],
}  # fmt: skip


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Speed of particles, {case.comm.size} ranks: seconds a step")
    for name in COLUMNS:
        measure(case.comm, name, 1000, 2)  # so that everything is compiled
        for n in QUICK_SIZES if case.quick else SIZES:
            report.rows.append(measure(case.comm, name, n))
    for before, after in zip(report.rows[:-1], report.rows[1:], strict=True):
        if before["case"] == after["case"] and GROWTH_FROM <= before["particles"] < after["particles"]:
            growth = before["steps/s"] / after["steps/s"]
            report.demand(growth <= GROWTH, after, f"seconds of a particle grow by at most {GROWTH - 1:.0%}")
    report.figure = _picture(report.rows)
    return report


def measure(comm: MPI.Comm, name: str, n: int, steps: int = 0) -> Row:
    """Return what about n particles cost, in so many steps, or as many as it takes. Collective."""
    before = _memory()
    sim = scene(comm, name, n)
    stir(sim)
    water = particles(sim)
    number = comm.allreduce(water.swarm.n_owned)
    for _ in range(WARM_UP if not steps else 1):
        sim.advance()
    steps = steps or int(np.clip(MOVED // number, FEWEST, MOST))
    lists = water.n_lists
    comm.Barrier()
    begin = clock.perf_counter(), clock.process_time()
    for _ in range(steps):
        sim.advance()
    seconds = (clock.perf_counter() - begin[0], clock.process_time() - begin[1])[comm.size == 1] / steps
    seconds = comm.allreduce(seconds, MPI.MAX)
    lists = water.n_lists - lists
    held = comm.allreduce(_memory() - before)
    row: Row = {"case": name, "ranks": comm.size, "particles": number, "steps/s": number / seconds}
    row |= {"step": seconds, "lists": lists / steps, "bytes": held / number, "pairs": _pairs(sim)}
    return row | {phase: share * seconds for phase, share in _shares(sim).items()}


def scene(comm: MPI.Comm, name: str, n: int) -> Simulation:
    """Return a simulation of about n particles at its start. Collective."""
    size = COLUMNS[name]
    spacing = (float(np.prod(size)) / n) ** (1 / len(size))
    if name != "beam":
        gravity = [0.0, -9.81, 0.0][: len(size)]
        fluid = {"spacing": spacing, "artificial_viscosity": 0.1, "sides": {"top": "open"}, "fill": box(size)}
        return prepared(comm, 1e3, TANKS[name], gravity, **fluid)
    sets = {"fluid.spacing": spacing, "fluid.fill": box(size), "time.end": 1e3}
    with only_options([]):
        sim = Simulation(comm, job(comm, "dambreak", sets))
        sim.prepare()
    return sim


def stir(sim: Simulation) -> None:
    """Let the column turn over: an eddy that goes along all its sides. Collective."""
    water = particles(sim)
    x, v = water.swarm["x"], water.swarm["v"]
    length = x[:, :2].max(axis=0, initial=0.0) + water.spacing / 2
    sim.comm.Allreduce(MPI.IN_PLACE, length, MPI.MAX)
    a, b = (np.pi * x[:, :2] / length).T
    speed = MACH * water.law.c / max(1.0, length[1] / length[0])
    v[:, 0] = speed * np.sin(a) * np.cos(b)
    v[:, 1] = -speed * length[1] / length[0] * np.cos(a) * np.sin(b)
    if sim.accounts.columns:
        sim.accounts.start()


def _pairs(sim: Simulation) -> float:
    """Return the number of listed pairs of particles over that of this rank's rows."""
    water = particles(sim)
    return len(water.pairs.other) / max(1, len(water.swarm))


def _memory() -> int:
    """Return the bytes that this process holds, without those that are free; 0 where the system does not tell."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if told.exists() else 0


def _shares(sim: Simulation) -> dict[str, float]:
    """Return which part of a step each phase takes, as rank 0 sees it. Collective."""
    profile = cProfile.Profile(clock.process_time)
    profile.enable()
    for _ in range(PROFILED):
        sim.advance()
    profile.disable()
    found = dict.fromkeys([*PHASES, "rest"], 0.0)
    for function, (_, _, own, _, callers) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        phase = _phase(function)
        if phase == "rest" and function[0] == "~":  # what is built in belongs to who called it
            for caller, (_, _, part, _) in callers.items():
                found[_phase(caller)] += part
        else:
            found[phase] += own
    total = sum(found.values())
    return sim.comm.bcast({phase: own / total for phase, own in found.items()})


def _phase(function: tuple[str, int, str]) -> str:
    file, _, name = function
    for phase, places in PHASES.items():
        if any(part in file and (key in name if not part else name.startswith(key)) for part, key in places):
            return phase
    return "rest"


def _picture(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(7, 3.8), layout="constrained")
    axes = figure.subplots()
    at, bottom = np.arange(len(rows)), np.zeros(len(rows))
    for phase in [*PHASES, "rest"]:
        height = np.array([1e9 * row[phase] / row["particles"] for row in rows])
        axes.bar(at, height, bottom=bottom, label=phase)
        bottom += height
    names = [f"{row['case']}\n{row['particles']:.0e}\n{row['ranks']} ranks" for row in rows]
    axes.set_xticks(at, names, fontsize=7)
    axes.set(ylabel="ns a particle and step")
    axes.legend(fontsize=7)
    return figure
