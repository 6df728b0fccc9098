"""What a step of a solid costs: its assembly beside products with the assembled matrix, and its solve on finer meshes.

Three studies of an elastic cube that is held at one face and falls otherwise, solved as ``solid-large.opts`` says:

- ``assembly``: residual and tangent of 200,000 tetrahedra, into PETSc's matrix, beside ten products with that matrix,
  in turn, medians.
- ``step``: one step of 97,336 nodes, an eighth of them and eight times as many. A wave would cross the cube in less
  than a step, so that the mass helps the preconditioner little.
- ``ranks``: the same step of 97,336 nodes on one rank and on all of them, where there are several.
"""

from __future__ import annotations

import time as clock

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc
from petfsi.bench.case import Case
from petfsi.bench.report import Report, Row
from petfsi.fields.solid import SimplexSolid
from petfsi.runs.plan import LARGE_OPTIONS
from petfsi.scene.load import scene_from_dict
from petfsi.solving.option_database import only_options
from petfsi.solving.option_rules import PREFIX

DT = 0.1
#: Of 202,368 tetrahedra.
ASSEMBLED, ASSEMBLED_QUICK = (34, 32, 31), (17, 16, 16)
REPEATS, PRODUCTS = 7, 10
MATERIALS = ("green", "neohookean")
#: Cells along an edge; nodes grow about eightfold.
EDGES, EDGES_QUICK = (22, 45, 91), (10, 22)

LARGEST_RATIO = 3.0
LARGEST_GROWTH = 1.2


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"An elastic cube, {case.comm.size} ranks: seconds of the slowest")
    for material in MATERIALS:
        row = assembly(case.comm, material, ASSEMBLED_QUICK if case.quick else ASSEMBLED)
        report.rows.append(row)
        if not case.quick:  # small matrices live in a cache
            report.demand(row["ratio"] <= LARGEST_RATIO, row, f"at most {LARGEST_RATIO:g} times ten products")
    with only_options(["-options_file", LARGE_OPTIONS]):
        steps = [step(case.comm, n) for n in (EDGES_QUICK if case.quick else EDGES)]
        report.rows += steps
        for before, after in zip(steps, steps[1:], strict=False):
            growth = after["iterations"] / before["iterations"]
            report.demand(growth <= LARGEST_GROWTH, after, f"iterations grow by at most {LARGEST_GROWTH - 1:.0%}")
        if case.comm.size > 1:
            report.rows += _ranks(case, steps[1])
    report.figure = _picture(steps)
    return report


def cube(comm: MPI.Comm, cells: tuple[int, ...], material: str) -> SimplexSolid:
    """Return the cube, ready to be assembled. Collective."""
    table = {
        "shape": {"box": {"origin": [0.0, 0.0, 0.0], "size": [1.0, 1.0, 1.0], "cells": list(cells)}},
        "density": 1000.0,
        "young": 1e5,
        "poisson": 0.3,
        "material": material,
        "supports": [{"where": "left", "fix": ["x", "y", "z"]}],
    }
    scene = scene_from_dict(
        {
            "dim": 3,
            "gravity": [0.0, 0.0, -9.81],
            "time": {"end": 1.0, "dt": DT, "integrator": "bdf2"},
            "solids": {"cube": table},
        }
    )
    solid = SimplexSolid(comm, scene)
    solid.predict(0.0, DT)
    return solid


def assembly(comm: MPI.Comm, material: str, cells: tuple[int, ...]) -> Row:
    """Return the seconds of an assembly and of the products with its matrix, medians in turn. Collective."""
    solid = cube(comm, cells, material)
    x, y = solid.block.createVecs()
    seconds = []
    for _ in range(REPEATS):
        comm.Barrier()
        begin = clock.perf_counter()
        solid.assemble(0.0, DT)
        middle = clock.perf_counter()
        for _ in range(PRODUCTS):
            solid.block.mult(x, y)
        seconds.append((middle - begin, clock.perf_counter() - middle))
    assembled, products = np.median(np.max(comm.allgather(seconds), axis=0)[1:], axis=0).tolist()
    return {
        "study": "assembly",
        "material": material,
        "ranks": comm.size,
        "tets": 6 * int(np.prod(cells)),
        "nodes": solid.layout.n_global // 3,
        "assemble": assembled,
        "products": products,
        "ratio": assembled / products,
    }


def step(comm: MPI.Comm, n: int) -> Row:
    """Return seconds and iterations of one step of a cube with ``n`` cells along an edge. Collective."""
    solid = cube(comm, (n, n, n), "neohookean")
    solid.assemble(0.0, DT)  # once before, so that compilers and page faults are not in it
    seconds = [clock.perf_counter()]
    solid.assemble(0.0, DT)
    seconds.append(clock.perf_counter())
    ksp = PETSc.KSP().create(comm)
    ksp.setOptionsPrefix(PREFIX)
    ksp.setOperators(solid.block)
    ksp.setFromOptions()
    ksp.setUp()
    seconds.append(clock.perf_counter())
    x, b = solid.block.createVecs()
    b.setArray(solid.rhs)
    ksp.solve(b, x)
    seconds.append(clock.perf_counter())
    row: Row = {"study": "step", "material": "neohookean", "ranks": comm.size, "tets": 6 * n**3}
    row["nodes"] = solid.layout.n_global // 3
    slowest = np.max(comm.allgather(np.diff(seconds)), axis=0).tolist()
    row |= dict(zip(("assemble", "set up", "solve"), slowest, strict=True))
    row |= {"iterations": ksp.getIterationNumber(), "reason": petsc.reason_name(ksp)}
    ksp.destroy()
    return row


def _ranks(case: Case, together: Row) -> list[Row]:
    """Return the step on one rank, while the others wait, and how much faster all of them are. Collective."""
    edge = (EDGES_QUICK if case.quick else EDGES)[1]
    alone = case.comm.bcast(step(MPI.COMM_SELF, edge) if case.comm.rank == 0 else None)
    faster = {key: alone[key] / together[key] for key in ("assemble", "set up", "solve")}
    return [alone | {"study": "ranks"}, {"study": "speed-up", "ranks": case.comm.size, **faster}]


def _picture(steps: list[Row]) -> Figure:
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for phase, marker in (("assemble", "o"), ("set up", "s"), ("solve", "v")):
        axes.loglog([row["nodes"] for row in steps], [row[phase] for row in steps], f"{marker}-", label=phase)
    nodes = np.array([row["nodes"] for row in steps])
    axes.loglog(nodes, steps[0]["solve"] * nodes / nodes[0], "k:", lw=0.8, label="in proportion")
    for row in steps:
        axes.annotate(f"{row['iterations']} iterations", (row["nodes"], row["solve"]), rotation=30, fontsize=8)
    axes.set(xlabel="nodes", ylabel="seconds", title="One step of an elastic cube")
    axes.legend()
    return figure
