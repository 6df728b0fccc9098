"""Largest stable step of particles beside an elastic body, over density ratio and stiffness, by solve and scheme.

A free box of 0.3 x 0.2 m flies and turns through a fluid at rest in a periodic square of 1 m, 20 particles across, in
motions so small that all is linear: nothing comes in, so what is held (kinetic and elastic energy of both) must not
exceed what there was, nor the momentum change. Its mass is ``ratio`` times that of as much fluid.

- ``no-slip``: viscosity so large that explicit steps would be a ninetieth of sound's, solved for with the body:
  simultaneously, split (one pass) and split until converged. ``syrup``: ten times as much, for a tenth of the time.
- ``slip``: no viscosity. Only the solid has unknowns, with the answer of pressure (K_w) in its block, so that all
  options solve the same system: one solve, over integrators instead. ``symplectic-euler`` solves for nothing and
  goes without K_w; its steps must also keep the solid's own limit.

Steps are c h/s = 0.9 / 2^k: petfsi refuses longer ones, as particles are explicit in sound. ``step`` is the largest
(over the longest) at which the energy stays within ``SLACK`` of its bound for 50 of the longest steps, ``energy`` its
largest value then over that at the start, ``momentum`` its largest change, over the start's. ``settles`` is the largest
at which the energy may pass its bound at first but grows no more: bounded all the same. ``longest`` is what becomes of
the longest step: how large the energy gets, or why there is none.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi.bench.case import ITERATED, MONOLITHIC, SPLIT, Case, simulation
from petfsi.bench.report import Report, Row
from petfsi.errors import InputError, SolveError
from petfsi.ranks import on_root
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Scene

RATIOS, STIFFNESSES, QUICK_STIFFNESSES = (10.0, 1.0, 0.1), tuple(10.0**n for n in range(2, 9)), (1e2, 1e5, 1e8)
SYRUP = (1e2, 1e5, 1e8)
SOLVES, SCHEMES, EXPLICIT = (MONOLITHIC, ITERATED, SPLIT), ("newmark", "bdf2", "midpoint"), "symplectic-euler"
DENSITY, SOUND, SPACING, VISCOSITY, SPEED = 1000.0, 10.0, 0.05, 15000.0, 1e-3
#: The longest step, s: particles may move at a hundredth of the speed of sound.
LONGEST = 0.9 * 1.5 * SPACING / (1.01 * SOUND)
#: A run lasts so many of the longest steps, and takes at most so many; steps are halved so often at most.
STEPS, QUICK_STEPS, MOST, HALVINGS = 50, 20, 1600, 12
#: The energy may be so much more than its bound; a run that has so many times as much is over.
SLACK, OVER = 0.05, 1e3
#: Momentum that is kept changes by no more than this part: the solver's tolerance, many times.
KEPT = 1e-9


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Largest stable step of particles beside an elastic body, over the longest, {LONGEST:.3g} s")
    steps = QUICK_STEPS if case.quick else STEPS
    every = QUICK_STIFFNESSES if case.quick else STIFFNESSES
    runs = [("no-slip", VISCOSITY, "newmark", options, steps, every) for options in SOLVES]
    runs += [("syrup", 10 * VISCOSITY, "newmark", options, steps // 10, SYRUP) for options in SOLVES]
    runs += [("slip", 0.0, scheme, MONOLITHIC, steps, every) for scheme in (*SCHEMES, EXPLICIT)]
    for part, viscosity, scheme, options, number, stiffnesses in runs:
        name = options.removesuffix(".opts") if viscosity else scheme
        for ratio in RATIOS:
            for young in stiffnesses:
                row: Row = {"part": part, "solve": name, "ratio": ratio, "young": young}
                row |= largest(case.comm, ratio, young, viscosity, scheme, options, number)
                report.rows.append(row)
                _demand(report, row)
    names = dict.fromkeys((row["part"], row["solve"]) for row in report.rows)
    report.notes += [line for name in names for line in _map(report, *name)]
    report.figure = _picture(report)
    return report


def _demand(report: Report, row: Row) -> None:
    if row["solve"] == "monolithic":
        report.demand(row["step"] == 1.0, row, "stable at the longest step")
    if row["solve"] in SCHEMES:
        report.demand(row["settles"] == 1.0, row, "bounded at the longest step")
    if row["solve"] in ("monolithic", "newmark", "bdf2"):  # others do not keep momentum while a motion sets in
        report.demand(row["momentum"] < KEPT, row, f"momentum kept to {KEPT:g}")


def scene(ratio: float, young: float, viscosity: float, scheme: str, dt: float, end: float) -> dict[str, Any]:
    """Return the box in the fluid."""
    fluid: dict[str, Any] = {"kind": "sph", "density": DENSITY, "origin": [0.0, 0.0], "size": [1.0, 1.0]}
    fluid |= {"spacing": SPACING, "sound_speed": SOUND, "viscosity": viscosity}
    fluid |= {"fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, 1.0]}}]}
    fluid["sides"] = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")
    if viscosity:
        fluid["viscosity_solve"] = "implicit"
    body: dict[str, Any] = {"density": ratio * DENSITY, "young": young, "poisson": 0.3}
    body["shape"] = {"box": {"origin": [0.35, 0.4], "size": [0.3, 0.2], "cells": [6, 4]}}
    body["initial"] = {"velocity": [f"{SPEED}*(1 - 3*(y - 0.5))", f"{3 * SPEED}*(x - 0.5)"]}
    time = {"end": end, "dt": dt, "integrator": scheme, "energy_limit": -1}
    return {"dim": 2, "time": time, "fluid": fluid, "solids": {"body": body}}


def largest(comm: MPI.Comm, ratio: float, young: float, viscosity: float, scheme: str, options: str, steps: int) -> Row:
    """Return the largest stable step, over the longest, and what is seen at it and at the longest. Collective."""
    longest, settles = "", 0.0
    for k in range(HALVINGS + 1):
        dt = LONGEST / 2**k
        end = min(steps * LONGEST, MOST * dt)
        data = scene(ratio, young, viscosity, scheme, dt, end)
        found = judged(comm, on_root(comm, partial(scene_from_dict, data)), options)
        longest = longest or found["why"] or f"{found['energy']:.3g}"
        settles = settles or (0.5**k if found["settles"] else 0.0)
        if found["stable"]:
            break
    row: Row = {"step": 0.5**k if found["stable"] else 0.0, "settles": settles}
    return row | {"energy": found["energy"], "momentum": found["momentum"], "longest": longest}


def judged(comm: MPI.Comm, made: Scene, options: str) -> Row:
    """Run a scene to its end, or until it fails. Collective.

    Returns
    -------
    dict
        Whether it is ``stable``; whether it ``settles``, its energy being no larger in the last half of the run than
        before, nor ever ``OVER`` times the start's; the largest ``energy`` over that at the start, less what came in;
        the largest change of ``momentum`` over that at the start; and ``why`` there is no more.
    """
    energy, momentum, why = [1.0], [0.0], ""
    try:
        with simulation(comm, made, options) as sim:
            first, start = _held(sim.accounts.values)
            while not sim.finished and energy[-1] < OVER:
                sim.advance()
                now, p = _held(sim.accounts.values)
                energy.append(now / first)
                momentum.append(float(np.linalg.norm(p - start) / np.linalg.norm(start)))
    except (SolveError, InputError) as error:
        why = "beyond the solid's limit" if "stable step" in str(error) else str(error).split(":")[0].split(" after")[0]
    top, half = max(energy), len(energy) // 2
    settles = not why and top < OVER and max(energy[half:]) <= max(energy[:half])
    found: Row = {"stable": settles and top <= 1 + SLACK, "settles": settles, "energy": top}
    return found | {"momentum": max(momentum), "why": why}


def _held(values: dict[str, float]) -> tuple[float, np.ndarray]:
    """Return the energy that is held, less what came in, J, and the momentum, kg m/s."""
    energy = values["kinetic"] + values["elastic"] - values["boundary_work"]
    return energy, np.array([values["momentum.x"], values["momentum.y"]])


def _of(report: Report, part: str, name: str) -> tuple[list[float], list[list[Row]]]:
    """Return Young's moduli, and the rows of a solve by density ratio and modulus."""
    rows = [row for row in report.rows if (row["part"], row["solve"]) == (part, name)]
    young = [row["young"] for row in rows if row["ratio"] == RATIOS[0]]
    return young, [[row for row in rows if row["ratio"] == ratio] for ratio in RATIOS]


def _map(report: Report, part: str, name: str) -> list[str]:
    """Return the map of a solve in lines of text."""
    young, lines = _of(report, part, name)
    head = f"{part:>8}, {name:<16} E =" + "".join(f"{E:>13.0e}" for E in young)
    names = [f"ratio {ratio:g}" for ratio in RATIOS]
    body = [f"{n:>29}" + "".join(f"{_step(row):>13}" for row in line) for n, line in zip(names, lines, strict=True)]
    return [head, *body]


def _step(row: Row) -> str:
    """Return the largest stable step, and in brackets the largest bounded one if that is another."""
    step, settles = ("none" if h == 0 else "1" if h == 1 else f"1/{1 / h:.0f}" for h in (row["step"], row["settles"]))
    return step if step == settles else f"{step} ({settles})"


def _picture(report: Report) -> Figure:
    names = dict.fromkeys((row["part"], row["solve"]) for row in report.rows)
    figure = Figure(figsize=(15, 8), layout="constrained")
    panels = figure.subplots(3, 4)
    for part, line in zip(("no-slip", "syrup", "slip"), panels, strict=True):
        here = [name for name in names if name[0] == part]
        for axes, name in zip(line[: len(here)], here, strict=True):
            _draw(axes, report, *name)
    panels[1, 3].set_axis_off()
    young, lines = _of(report, "no-slip", "split")
    for line in lines:
        panels[0, 3].loglog(young, [row["momentum"] for row in line], "o-", label=f"ratio {line[0]['ratio']:g}")
    panels[0, 3].set(xlabel="E, Pa", title="split: change of momentum at that step")
    panels[0, 3].legend(fontsize=7)
    return figure


def _draw(axes: Axes, report: Report, part: str, name: str) -> None:
    young, lines = _of(report, part, name)
    step = np.array([[row["step"] for row in line] for line in lines])
    axes.imshow(np.log2(np.maximum(step, 0.5**HALVINGS)), cmap="RdYlGn", vmin=-10, vmax=0, aspect="auto")
    for i, line in enumerate(lines):
        for j, row in enumerate(line):
            axes.text(j, i, _step(row).replace(" ", "\n"), ha="center", va="center", fontsize=7)
    axes.set_xticks(range(len(young)), [f"{np.log10(E):.0f}" for E in young])
    axes.set_yticks(range(len(RATIOS)), [f"{ratio:g}" for ratio in RATIOS])
    axes.set(xlabel="lg E/Pa", ylabel="density ratio", title=f"{part}: {name}")
