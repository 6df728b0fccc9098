"""Viscous flows without free surfaces for ``petfsi bench particles``: vortices that decay, channels that start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import Case
from petfsi.bench.particles_runs import box, largest, owned, particles, prepared, total, watched
from petfsi.bench.report import Report, Row
from petfsi.simulation import Simulation
from petfsi.solving.option_database import only_options

# ---- vortices that decay ----------------------------------------------------------------------------------------

VORTEX_CELLS, QUICK_VORTEX_CELLS = (25, 50, 100, 200), (25, 50)
REYNOLDS, VORTEX_SOUND = 100.0, 10.0
#: Largest error of the velocity at so many particles across, and least order from the first to there.
VORTEX_ERROR, VORTEX_ERROR_AT, VORTEX_ORDER = 0.02, 100, 1.0


def vortices(comm: MPI.Comm, n: int, **fluid: Any) -> Row:
    """Return what is wrong after a second with vortices of 1 m/s in a periodic box of 1 m. Collective.

    ``error`` of the velocity in L2 and ``energy`` are relative to the exact flow at that time; ``rate`` is that of the
    kinetic energy's decay, a straight line through its logarithm, over the exact one.
    """
    nu = 1.0 / REYNOLDS
    sides = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")
    table = {"spacing": 1.0 / n, "sound_speed": VORTEX_SOUND, "viscosity": 1000.0 * nu, "fill": box([1.0, 1.0])}
    start = {"velocity": ["-cos(2*pi*x)*sin(2*pi*y)", "sin(2*pi*x)*cos(2*pi*y)"]}
    sim = prepared(comm, 1.0, [1.0, 1.0], [0.0, 0.0], sides=sides, initial=start, **table | fluid)
    seen = watched(sim, 0.01, lambda: [sim.accounts.values["kinetic"]])
    x, v = 2 * np.pi * owned(sim, "x"), owned(sim, "v")
    exact = np.stack([-np.cos(x[:, 0]) * np.sin(x[:, 1]), np.sin(x[:, 0]) * np.cos(x[:, 1])], axis=1)
    exact *= np.exp(-8 * np.pi**2 * nu * sim.time)
    off, wanted, has = (total(sim, np.square(a)) for a in (v - exact, exact, v))
    slope = np.polyfit(seen[:, 0], np.log(seen[:, 1]), 1)[0]
    residual = sim.accounts.values["energy_residual"] / seen[0, 1]
    return {
        "error": float(np.sqrt(off / wanted)),
        "energy": has / wanted - 1,
        "rate": float(-slope / (16 * np.pi**2 * nu)),
        "residual": residual,
    }


def decay(case: Case, report: Report) -> None:
    """Measure the vortices' error over resolutions. Collective."""
    numbers = QUICK_VORTEX_CELLS if case.quick else VORTEX_CELLS
    rows: list[Row] = [{"part": "vortices", "at": n} | vortices(case.comm, n) for n in numbers]
    report.rows += rows
    for row in rows:
        if row["at"] == VORTEX_ERROR_AT:
            report.demand(row["error"] <= VORTEX_ERROR, row, f"error at most {VORTEX_ERROR:g}")
    _orders(report, rows, "error", "vortices", VORTEX_ORDER, VORTEX_ERROR_AT)


def _orders(report: Report, rows: list[Row], key: str, name: str, least: float, finest: float = np.inf) -> None:
    """Note the orders of a column from resolution to resolution, and demand one over those up to the finest."""
    steps = [1 / row["at"] for row in rows]
    seen = theory.orders([row[key] for row in rows], steps)
    last = [row for row in rows if row["at"] <= finest][-1]
    whole = np.log(rows[0][key] / last[key]) / np.log(last["at"] / rows[0]["at"])
    report.notes.append(f"{name}: orders {', '.join(f'{o:.2f}' for o in seen)}; to {last['at']}: {whole:.2f}")
    report.demand(whole >= least, last, f"order at least {least:g} (seen {whole:.2f})")


# ---- channels that start ----------------------------------------------------------------------------------------

#: As Morris, Fox and Zhu (1997): m, m^2/s, m/s^2; and the speed that the force makes at last, m/s.
WIDTH, NU, FORCE = 1e-3, 1e-6, 1e-4
SPEED = FORCE * WIDTH**2 / (8 * NU)
CHANNEL_CELLS, QUICK_CHANNEL_CELLS, CHANNEL_LENGTH = (20, 40, 80), (20, 40), 10
TIMES, END = (0.0225, 0.045, 0.1125, 0.225, 0.5), 0.5
CHANNEL_ERROR, CHANNEL_ERROR_AT, CHANNEL_ORDER = 0.01, 80, 0.8
SPREAD, SEED = 0.2, 20261129
#: Where viscosity is solved for: the midpoint rule with steps of so many seconds, 80 explicit ones at 80 across.
SOLVED = {"integrator": "midpoint", "dt": TIMES[0] / 4}
#: What is drawn.
PROFILE_AT = 20
#: Ten times as fast as ten times the flow: viscosity limits the step by far, so that sound costs nothing, m/s.
SOUND = 100 * SPEED
TERMS = np.arange(200)


def poiseuille(y: np.ndarray, t: float) -> np.ndarray:
    """Return the velocity between plates at rest at y = 0 and ``WIDTH`` of what a force has moved for a time, m/s."""
    odd = np.pi * (2 * TERMS + 1)
    modes = 4 * FORCE * WIDTH**2 / (NU * odd**3) * np.exp(-(odd**2) * NU * t / WIDTH**2)
    return FORCE / (2 * NU) * y * (WIDTH - y) - np.sin(np.outer(y / WIDTH, odd)) @ modes


def couette(y: np.ndarray, t: float) -> np.ndarray:
    """Return the velocity of what a plate at ``WIDTH`` has drawn along for a time, m/s."""
    n = np.pi * (1 + TERMS)
    modes = 2 * SPEED / n * np.cos(n) * np.exp(-(n**2) * NU * t / WIDTH**2)
    return SPEED * y / WIDTH + np.sin(np.outer(y / WIDTH, n)) @ modes


def stopped(y: np.ndarray, t: float) -> np.ndarray:
    """Return the velocity of what moved at ``SPEED`` until both plates were stopped, a time ago, m/s."""
    odd = np.pi * (2 * TERMS + 1)
    return np.sin(np.outer(y / WIDTH, odd)) @ (4 * SPEED / odd * np.exp(-(odd**2) * NU * t / WIDTH**2))


Exact = Callable[[np.ndarray, float], np.ndarray]

CHANNELS: dict[str, Exact] = {
    "poiseuille": poiseuille,
    "couette": couette,
    "stopped": stopped,
}


def channel(comm: MPI.Comm, name: str, n: int, spread: float = 0.0, **fluid: Any) -> Simulation:
    """Return the start of a flow between plates without slip, periodic along x. Collective.

    So slow a flow leaves particles on the lattice on which they begin, where sums are exact as nowhere else: ``spread``
    is by how much of their distance they are strewn at random, along each axis. Viscosity is explicit by default.
    """
    sides: dict[str, Any] = {"left": "periodic", "right": "periodic", "bottom": "no-slip", "top": "no-slip"}
    if name == "couette":
        sides["top"] = {"no-slip": {"velocity": [SPEED, 0.0]}}
    dx = WIDTH / n
    size = [CHANNEL_LENGTH * dx, WIDTH]
    table = {"spacing": dx, "sound_speed": SOUND, "viscosity": 1000 * NU, "sides": sides, "fill": box(size)}
    table["viscosity_solve"] = "explicit"
    if name == "stopped":
        table["initial"] = {"velocity": [SPEED, 0.0]}
    gravity = [FORCE if name == "poiseuille" else 0.0, 0.0]
    sim = prepared(comm, END, size, gravity, **table | fluid)
    if spread:
        swarm = particles(sim).swarm
        dice = np.random.default_rng(SEED).uniform(-1.0, 1.0, (int(particles(sim).tally()["particles"]), 2))
        swarm["x"] += spread * dx * dice[swarm["id"]]
        particles(sim).forget()
    return sim


def channel_errors(sim: Simulation, exact: Exact) -> tuple[list[float], list[tuple[np.ndarray, np.ndarray]]]:
    """Return the error, and y and u of the particles of the first column, at ``TIMES``. Collective."""
    errors, lines = [], []
    for time in TIMES:
        while sim.time < time and not sim.finished:
            sim.advance()
        errors.append(channel_error(sim, exact))
        first = owned(sim, "id") < round(WIDTH / particles(sim).spacing)
        line = np.column_stack([owned(sim, "x")[first, 1], owned(sim, "v")[first, 0]])
        y, u = np.concatenate(sim.comm.allgather(line)).T
        lines.append((y, u))
    return errors, lines


def channel_error(sim: Simulation, exact: Exact) -> float:
    """Return the largest error of the velocity over the largest speed, of ``stopped`` that at first. Collective."""
    y = np.linspace(0.0, WIDTH, 201)
    most = SPEED if exact is stopped else exact(y, sim.time).max()
    v = owned(sim, "v")
    wrong = v - np.stack([exact(owned(sim, "x")[:, 1], sim.time), np.zeros(len(v))], axis=1)
    return largest(sim, np.linalg.norm(wrong, axis=1)) / float(most)


Profiles = dict[str, list[tuple[np.ndarray, np.ndarray]]]


def channels(case: Case, report: Report) -> Profiles:
    """Measure the flows between plates; return y and u of a line of particles by name and time. Collective."""
    profiles: Profiles = {}
    numbers = QUICK_CHANNEL_CELLS if case.quick else CHANNEL_CELLS
    for name, exact in CHANNELS.items():
        rows: list[Row] = []
        for n, spread in [*((n, 0.0) for n in numbers), (numbers[-1], SPREAD)]:
            errors, lines = channel_errors(channel(case.comm, name, n, spread), exact)
            if n == PROFILE_AT:
                profiles.setdefault(name, lines)
            rows.append(_channel_row(report, name + (" strewn" if spread else ""), n, errors))
        _orders(report, rows[:-1], "error", name, CHANNEL_ORDER)
    for n, spread in [*((n, 0.0) for n in numbers), (numbers[-1], SPREAD)]:
        with only_options([]):
            sim = channel(case.comm, "poiseuille", n, spread, time=SOLVED, viscosity_solve="implicit")
            errors, _ = channel_errors(sim, poiseuille)
        _channel_row(report, "poiseuille solved" + (" strewn" if spread else ""), n, errors)
    return profiles


def _channel_row(report: Report, part: str, n: int, errors: list[float]) -> Row:
    """Note the errors at ``TIMES``, and demand what they must keep unless particles were strewn."""
    row: Row = {"part": part, "at": n, "error": max(errors)}
    row |= {f"t={t:g}": error for t, error in zip(TIMES, errors, strict=True)}
    report.rows.append(row)
    if n == CHANNEL_ERROR_AT and "strewn" not in part:
        report.demand(row["error"] <= CHANNEL_ERROR, row, f"error at most {CHANNEL_ERROR:g} of the maximum")
    return row
