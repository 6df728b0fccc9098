"""Error against seconds of solids and beams alone: every element, every integrator.

Statics, by Newton's method, on finer and finer meshes:

- ``cook``: Cook's membrane, Neo-Hookean, nearly incompressible and not, by linear and quadratic triangles, with the
  volumetric part integrated in full or by a poorer rule.
- ``csm1``, ``csm2``: the bar of Turek and Hron under gravity.
- ``elastica``, ``roll-up``: slender cantilevers under a tip load, and under the moment that closes a circle.

Small oscillations, ``frequencies``: the lowest three of cantilevers, by both kinds of beams; ``error`` is the largest.

Dynamics, one linear solve a step:

- ``csm3``: the bar let go. With steps of 5 ms for ten seconds, amplitude and frequency of its end; and the end's motion
  over a second at larger and smaller steps, by every integrator and element, against that of the midpoint rule's
  smallest steps on a finer mesh.

Seconds are those of the steps alone, after one step of each kind whose seconds nobody counts.
"""

from __future__ import annotations

import tempfile
import time as clock
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI
from scipy.linalg import eigh

from petfsi.bench import solid_cases as cases
from petfsi.bench import theory
from petfsi.bench.case import MONOLITHIC, Case, dense, simulation
from petfsi.bench.report import Report, Row
from petfsi.bench.solid_cases import Statics
from petfsi.build import build_fields
from petfsi.errors import SolveError
from petfsi.scene.schema import Scene

ELEMENTS = ("linear", "quadratic")
RULES = ("full", "reduced")
MESHES, MESHES_QUICK = (4, 8, 16, 32), (4, 8)
THICK, THICK_QUICK = (1, 2, 4, 8), (1, 2)
BEAMS, BEAMS_QUICK = (2, 4, 8, 16), (8,)
TURNS = (5, 10, 20)

#: The full swing, and the short one of every integrator.
SWING, SWING_DT = 10.0, 5e-3
SHORT, STEPS, STEPS_QUICK = 1.0, (0.02, 0.01, 0.005, 0.0025), (0.02, 0.01)
REFERENCE_DT = 6.25e-4
IMPLICIT = ("newmark", "bdf2", "midpoint")

COOK_BOUND = {0.3: 0.005, 0.4999: 0.02}
CSM_BOUND, CSM3_BOUND, BEAM_BOUND, FREQUENCY_BOUND = 0.005, 0.01, 0.001, 0.005


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Solids and beams: error against seconds, {case.comm.size} ranks")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(case.comm.bcast(name))
        _statics(case, report, folder)
        _frequencies(case, report)
        _short_swings(case, report, folder)
        if not case.quick:
            _long_swing(case, report, folder)
    report.figure = _picture(report)
    return report


# ---- statics ------------------------------------------------------------------------------------------------


def _statics(case: Case, report: Report, folder: Path) -> None:
    warm: set[str] = set()
    for one in _all_statics(case, folder):
        kind = f"{one.name} {one.about['elements']}"
        if kind not in warm:
            warm.add(kind)
            _solve(case.comm, one)  # its seconds are those of compiling and loading
        row = _solve(case.comm, one)
        report.rows.append(row)
        bound = _bound(row, one)
        if bound is not None:
            report.demand(row["error"] < bound, row, f"an error below {bound:.1%}")


def _all_statics(case: Case, folder: Path) -> Iterator[Statics]:
    comm, quick = case.comm, case.quick
    for poisson in cases.COOK:
        for elements in ELEMENTS:
            for rule in RULES:
                for n in MESHES_QUICK if quick else MESHES:
                    yield cases.cook(comm, folder, n, poisson, elements, rule)
    for name in cases.CSM_STATIC:
        for elements in ELEMENTS:
            for thick in THICK_QUICK if quick else THICK:
                yield cases.csm(comm, folder, name, thick, elements)
    for alpha in cases.ELASTICA:
        for n in BEAMS_QUICK if quick else BEAMS:
            yield cases.elastica(alpha, n)
    for n in TURNS[1:2] if quick else TURNS:
        yield cases.roll_up(n)


def _bound(row: Row, one: Statics) -> float | None:
    """Return how far a row may be off: those on fine meshes of elements that are meant for the case."""
    if one.name == "cook" and row["cells"] == MESHES[-1] and row["elements"] != "linear full":
        return COOK_BOUND[row["poisson"]] if row["elements"].startswith("quadratic") or row["poisson"] > 0.4 else None
    if one.name.startswith("csm") and row["elements"] == "quadratic" and row["cells"] >= THICK[2]:
        return CSM_BOUND
    if one.name == "elastica" and row["cells"] >= 8 or one.name == "roll-up" and row["cells"] >= 10:
        return BEAM_BOUND
    return None


def _solve(comm: MPI.Comm, one: Statics) -> Row:
    """Return where the tip ends up, by how much that is off, and the seconds it took. Collective."""
    with simulation(comm, one.scene, MONOLITHIC) as sim:
        begin = clock.perf_counter()
        newton = 0
        while not sim.finished:
            sim.advance()
            newton += sim.outcome.newton
        seconds = clock.perf_counter() - begin
        tip = np.array(sim.probe())
        unknowns = sum(sim.system.unknowns.values())
    length = 1.0 if one.name in ("elastica", "roll-up") else float(np.linalg.norm(one.exact))
    off = tip - one.exact
    # y alone for Cook's membrane, as published; beams by their length
    error = abs(off[1] / one.exact[1]) if one.name == "cook" else float(np.linalg.norm(off)) / length
    return {"case": one.name, **one.about, "integrator": "static", "unknowns": unknowns, "x": tip[0], "y": tip[1],
            "error": float(error), "newton": newton, "seconds": seconds}  # fmt: skip


# ---- small oscillations -------------------------------------------------------------------------------------


def _frequencies(case: Case, report: Report) -> None:
    for beam, exact in cases.FREQUENCIES.items():
        for n in BEAMS_QUICK if case.quick else BEAMS:
            begin = clock.perf_counter()
            found = _lowest(case.comm, beam, n)
            seconds = clock.perf_counter() - begin
            # axial modes, of which theory's list has none, stand between those of bending
            found = found[np.abs(found - np.array(exact)[:, None]).argmin(axis=1)]
            row: Row = {"case": "frequencies", "elements": beam[0], "cells": n, "slenderness": beam[1]}
            row |= {"error": float(np.abs(found / exact - 1).max()), "seconds": seconds}
            report.rows.append(row)
            if n >= 8:
                report.demand(row["error"] < FREQUENCY_BOUND, row, f"frequencies within {FREQUENCY_BOUND:.1%}")


def _lowest(comm: MPI.Comm, beam: tuple[str, float], n: int) -> np.ndarray:
    """Return a cantilever's angular frequencies over sqrt(EI / (rho A L^4)), the lowest first. Collective.

    M and K come from the blocks of newmark at two steps,  M/h + h/2 K.
    """
    steps, blocks = (1e-3, 2e-3), []
    for h in steps:
        solid = build_fields(comm, cases.cantilever(*beam, n, h))[0]
        solid.predict(0.0, h)
        solid.assemble(0.0, h)
        blocks.append(dense(solid.block))
    (h, H), (A, B) = steps, blocks
    K = 2 * (H * B - h * A) / (H * H - h * h)
    M = h * A - h * h / 2 * K
    free = np.abs(K).sum(axis=1) > np.abs(np.diag(K))  # rows of held unknowns have a diagonal alone
    return np.sqrt(eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True))


# ---- dynamics -----------------------------------------------------------------------------------------------


def _short_swings(case: Case, report: Report, folder: Path) -> None:
    """Measure every integrator and element over a second of CSM3. Collective."""
    comm, steps = case.comm, STEPS_QUICK if case.quick else STEPS
    fine = REFERENCE_DT * (4 if case.quick else 1)
    reference = _swing(comm, cases.csm3(comm, folder, 4, "quadratic", "midpoint", fine, SHORT))[0]
    grid = np.linspace(0, SHORT, len(reference))
    size = float(np.abs(reference).max())
    for elements, thick in (("linear", 8), ("quadratic", 2)):
        for integrator in (*IMPLICIT, "symplectic-euler"):
            for dt in steps if integrator in IMPLICIT else steps[-1:]:
                row: Row = {"case": "csm3", "elements": elements, "cells": thick, "integrator": integrator, "dt": dt}
                report.rows.append(row)
                try:
                    y, seconds, unknowns = _swing(
                        comm, cases.csm3(comm, folder, thick, elements, integrator, dt, SHORT)
                    )
                except SolveError as error:  # a step too long for one linearisation; its error is no number
                    row |= {"error": float("nan"), "seconds": float("nan"), "why": str(error).split(":")[0]}
                    continue
                same = np.interp(np.linspace(0, SHORT, len(y)), grid, reference)
                row |= {"unknowns": unknowns, "error": float(np.sqrt(np.mean((y - same) ** 2))) / size}
                row["seconds"] = seconds


def _long_swing(case: Case, report: Report, folder: Path) -> None:
    """Measure amplitude and frequency of CSM3 as published. Collective."""
    scene = cases.csm3(case.comm, folder, 2, "quadratic", "midpoint", SWING_DT, SWING)
    y, seconds, unknowns = _swing(case.comm, scene)
    amplitude = float(np.ptp(y)) / 2
    frequency = theory.frequency(SWING_DT * np.arange(len(y)), y)
    row: Row = {"case": "csm3", "elements": "quadratic", "cells": 2, "integrator": "midpoint", "dt": SWING_DT}
    row |= {"unknowns": unknowns, "amplitude": amplitude, "frequency": frequency, "seconds": seconds}
    row["amplitude off"] = amplitude / cases.CSM3_AMPLITUDE - 1
    row["frequency off"] = frequency / cases.CSM3_FREQUENCY - 1
    report.rows.append(row)
    report.demand(abs(row["amplitude off"]) < CSM3_BOUND, row, f"CSM3's amplitude within {CSM3_BOUND:.0%}")
    report.demand(abs(row["frequency off"]) < CSM3_BOUND, row, f"CSM3's frequency within {CSM3_BOUND:.0%}")


def _swing(comm: MPI.Comm, scene: Scene) -> tuple[np.ndarray, float, int]:
    """Return uy of the tip at the start and after each step, the seconds of the steps, and the unknowns. Collective."""
    values, seconds = [0.0], 0.0
    with simulation(comm, scene, MONOLITHIC) as sim:
        while not sim.finished:
            begin = clock.perf_counter()
            sim.advance()
            seconds += clock.perf_counter() - begin
            values.append(sim.probe()[1])
        return np.array(values), seconds, sum(sim.system.unknowns.values())


# ---- the picture --------------------------------------------------------------------------------------------


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    panels = {
        "Cook's membrane, nu = 0.3": [r for r in report.rows if r["case"] == "cook" and r["poisson"] == 0.3],
        "Cook's membrane, nu = 0.4999": [r for r in report.rows if r["case"] == "cook" and r["poisson"] != 0.3],
        "CSM1": [r for r in report.rows if r["case"] == "csm1"],
        "CSM2": [r for r in report.rows if r["case"] == "csm2"],
        "CSM3, a second": [r for r in report.rows if r["case"] == "csm3" and "error" in r],
        "beams": [r for r in report.rows if r["case"] in ("elastica", "roll-up", "frequencies")],
    }
    for axes, (title, rows) in zip(figure.subplots(2, 3).ravel(), panels.items(), strict=True):
        curves: dict[str, list[Row]] = {}
        for row in rows:
            curves.setdefault(_label(row), []).append(row)
        for label, curve in curves.items():
            seconds, errors = [row["seconds"] for row in curve], [row["error"] for row in curve]
            axes.loglog(seconds, errors, "o-", ms=4, mfc="none", label=label)
        axes.set(xlabel="seconds", ylabel="relative error", title=title)
        axes.legend(fontsize=7)
    return figure


def _label(row: Row) -> str:
    if row["case"] == "csm3":
        return f"{row['elements']}, {row['integrator']}"
    if row["case"] == "elastica":
        return f"tip load {row['load']}"
    if row["case"] == "frequencies":
        return f"frequencies, {row['elements']}"
    return row["elements"] if row["case"] != "roll-up" else "full circle"
