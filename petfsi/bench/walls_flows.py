"""Flows without solids for ``petfsi bench walls``: streams along a plane wall, and set off past a disk or a ball."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import meshio
import numpy as np
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import MONOLITHIC, Case, simulation
from petfsi.bench.potential import Round, sides
from petfsi.bench.report import Report, Row
from petfsi.errors import SolveError
from petfsi.fields.mac.fluid import MacFluid
from petfsi.fields.mac.grid.kinds import OPEN, PRESSURE, SPLIT
from petfsi.fields.mac.grid.sides import wrapped_points
from petfsi.geometry.obstacles import obstacle_surface
from petfsi.geometry.splitting import SIMPLEX
from petfsi.ranks import on_root
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Obstacle, Scene

ANGLES = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0, 90.0)
#: Points of the wall in 2D; in 3D one.
POINTS, POINT = ((0.5, 0.4031), (0.5, 0.5277)), (0.5, 0.4531, 0.4777)
WALL_CELLS, WALL_STEPS, WALL_DT = {2: 32, 3: 16}, 5, 1 / 64
NORMALS, QUICK_NORMALS, SEED = 10, 3, 20261128
INTEGRATORS, QUICK_INTEGRATORS = ("newmark", "bdf2", "midpoint"), ("midpoint",)
#: What the solver leaves of a velocity of 1 m/s.
ALONG_ERROR = 1e-9

DISK_CELLS, QUICK_DISK_CELLS = (32, 64, 128, 256, 512), (32, 64, 128)
BALL_CELLS, QUICK_BALL_CELLS = (32, 48, 64, 96), (32, 48)
#: The grid is put at so many places between the cells.
PLACES, QUICK_PLACES = {2: 4, 3: 1}, {2: 2, 3: 1}
#: Edge of the box, m, so that cells have edges of few digits; the radius is a quarter of it.
SIZE = {2: 1.0, 3: 0.96}
STREAM = {2: (0.8, 0.6), 3: (0.48, 0.6, 0.64)}
#: Facets of the round bodies to an edge of a cell, so that their own error does not show.
FINER = {2: 16.0, 3: 4.0}
#: So short that nothing is carried anywhere.
INSTANT = 1e-9

ORDERS = {"L1": 1.8, "L2": 1.4, "max": 0.9}
L2_ERROR, MAX_ERROR, ERRORS_AT = 2e-4, 0.02, 256


def box(
    dim: int, cells: int, size: float, origin: list[float], velocity: list[Any], side: dict[str, Any], **time: Any
) -> dict:
    """Return a scene of a box of fluid with equal edges, as a dictionary."""
    return {
        "dim": dim,
        "time": {"end": 1e4 * time["dt"], "retries": 0} | time,
        "fluid": {
            "density": 1.0,
            "origin": origin,
            "size": [size] * dim,
            "cells": [cells] * dim,
            "initial": {"velocity": velocity},
            "sides": side,
        },
        "output": {"accounts": False},
    }


def made(comm: MPI.Comm, data: dict) -> Scene:
    """Return the scene that a dictionary says. Collective."""
    return on_root(comm, lambda: scene_from_dict(data))


def face_errors(fluid: MacFluid, exact: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
    """Return the velocity's error at the centres of all faces that the pressure acts on. Collective.

    Means of its modulus (``L1``) and square (``L2``) are taken over the faces' open parts, as in the kinetic energy;
    ``max`` and the ``plain L2`` count a face that is all but shut as much as a whole one.
    """
    total, largest = np.zeros(5), 0.0
    for axis in range(fluid.dim):
        here = np.isin(fluid.face_kind[axis], (PRESSURE, OPEN, SPLIT))
        own = np.zeros_like(here)
        own[fluid.grid.owned(axis)] = True
        index = np.nonzero(here & own)
        wrong = np.abs(fluid.velocity[axis][index] - exact(wrapped_points(fluid.grid, axis, index))[:, axis])
        part = np.minimum(fluid.openness[axis][index], 1.0)
        total += part.sum(), part @ wrong, part @ wrong**2, len(wrong), wrong @ wrong
        largest = max(largest, wrong.max(initial=0.0))
    opened, first, second, n, plain = fluid.comm.allreduce(total)
    largest = fluid.comm.allreduce(largest, MPI.MAX)
    roots = {"L2": float(np.sqrt(second / opened)), "plain L2": float(np.sqrt(plain / n))}
    return {"L1": float(first / opened), **roots, "max": largest}


# ---- along a plane ------------------------------------------------------------------------------------------


def along(
    comm: MPI.Comm, velocity: np.ndarray, normal: np.ndarray, point: tuple[float, ...], integrator: str, steps: int
) -> float:
    """Return the largest error of a stream along a half space after some steps; nan if a solve fails. Collective."""
    dim = len(velocity)
    names = ("left", "right"), ("bottom", "top"), ("back", "front")
    side = {name: {"inflow": {"speed": s * v}} for v, pair in zip(velocity.tolist(), names, strict=False)
            for s, name in zip((1.0, -1.0), pair, strict=True)}  # fmt: skip
    data = box(dim, WALL_CELLS[dim], 1.0, [0.0] * dim, velocity.tolist(), side, dt=WALL_DT, integrator=integrator)
    data["obstacles"] = {"wall": {"shape": {"halfspace": {"point": list(point), "normal": normal.tolist()}}}}
    with simulation(comm, made(comm, data), MONOLITHIC) as sim:
        try:
            for _ in range(steps):
                sim.advance()
        except SolveError:
            return float("nan")
        assert isinstance(sim.fluid, MacFluid)
        return face_errors(sim.fluid, lambda points: np.broadcast_to(velocity, points.shape))["max"]


def random_walls(n: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return velocities of 1 m/s, and normals across them, in all directions."""
    rng = np.random.default_rng(SEED)
    frames = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(n)]
    return [(frame[:, 0], frame[:, 1]) for frame in frames]


def uniform(case: Case, report: Report) -> None:
    """Measure the streams along planes. Collective."""
    for integrator in QUICK_INTEGRATORS if case.quick else INTEGRATORS:
        for angle in ANGLES:
            v = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            normal = np.array([-v[1], v[0]])
            worst = max(along(case.comm, v, normal, point, integrator, WALL_STEPS) for point in POINTS)
            _enter(report, {"part": "along a wall", "scheme": integrator, "at": f"{angle:g} deg", "max": worst})
        for number, (v, normal) in enumerate(random_walls(QUICK_NORMALS if case.quick else NORMALS), start=1):
            worst = along(case.comm, v, normal, POINT, integrator, WALL_STEPS)
            _enter(report, {"part": "along a wall", "scheme": integrator, "at": f"3D normal {number}", "max": worst})


def _enter(report: Report, row: Row) -> None:
    report.rows.append(row)
    report.demand(row["max"] <= ALONG_ERROR, row, f"largest error at most {ALONG_ERROR:g} of the stream")


# ---- past a body --------------------------------------------------------------------------------------------


def past(comm: MPI.Comm, dim: int, cells: int, place: np.ndarray, finer: float | None = None) -> dict[str, float]:
    """Return the errors of the flow past a body set off at once, on a grid ``place`` cells off. Collective.

    The fluid starts with the velocity of the stream; the first step's pressure makes of it the flow that passes the
    body and has the exact flow through the sides.
    """
    size = SIZE[dim]
    origin = [round(float(x) * size / cells, 6) for x in place]
    flow = Round((size / 2,) * dim, size / 4, STREAM[dim])
    side = sides(flow, origin, [size] * dim, [cells] * dim)
    data = box(dim, cells, size, origin, list(flow.stream), side, dt=INSTANT)
    with TemporaryDirectory() as folder:
        mesh = comm.bcast(str(Path(folder) / "body.vtk"))
        data["obstacles"] = {"body": {"shape": {"mesh": mesh}}}
        ball = {"centre": list(flow.centre), "radius": flow.radius}
        on_root(comm, lambda: _write(mesh, ball, size / cells / (finer or FINER[dim])))
        with simulation(comm, made(comm, data), MONOLITHIC) as sim:
            sim.advance()
            assert isinstance(sim.fluid, MacFluid)
            return face_errors(sim.fluid, flow.velocity)


def _write(path: str, ball: dict[str, Any], spacing: float) -> None:
    """Write the surface of a ball, with facets of that size, to a file."""
    dim = len(ball["centre"])
    body = Obstacle.model_validate({"shape": {"ball": ball}})
    points, facets = obstacle_surface(body, dim, spacing, np.zeros(dim), np.ones(dim), "body", Path())
    points = np.column_stack((points, np.zeros((len(points), 3 - dim))))
    meshio.Mesh(points, [(SIMPLEX[dim - 1], facets)]).write(path, binary=True)


def impulsive(case: Case, report: Report, dim: int) -> None:
    """Measure the flow past a disk or a ball set off at once, over grids. Collective."""
    from petfsi.bench.added_mass import offsets

    meshes = {2: (DISK_CELLS, QUICK_DISK_CELLS), 3: (BALL_CELLS, QUICK_BALL_CELLS)}[dim][case.quick]
    places = offsets((QUICK_PLACES if case.quick else PLACES)[dim], dim)
    name = {2: "disk", 3: "ball"}[dim]
    rows: list[Row] = []
    for cells in meshes:
        every = [past(case.comm, dim, cells, place) for place in places]
        means = {norm: float(np.sqrt(np.mean([one[norm] ** 2 for one in every]))) for norm in every[0]}
        means["max"] = max(one["max"] for one in every)
        rows.append({"part": f"past a {name}", "scheme": "first step", "at": f"{cells} cells", **means})
    report.rows += rows
    for norm, wanted in ORDERS.items():
        slope = np.polyfit(np.log(meshes), np.log([row[norm] for row in rows]), 1)[0]
        steps = theory.orders([row[norm] for row in rows], [1 / n for n in meshes])
        report.notes.append(f"past a {name}: order of {norm} {-slope:.2f}, from grid to grid {np.round(steps, 2)}")
        report.demand(-slope >= wanted, rows[-1], f"order of {norm} at least {wanted} (seen {-slope:.2f})")
    for cells, row in zip(meshes, rows, strict=True):
        if dim == 2 and cells == ERRORS_AT:
            report.demand(row["L2"] <= L2_ERROR, row, f"L2 at most {L2_ERROR:g}")
            report.demand(row["max"] <= MAX_ERROR, row, f"max at most {MAX_ERROR:g}")
