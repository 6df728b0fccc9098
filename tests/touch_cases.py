"""Bodies led on exact ways past and into what may stop them: what the tests of touching share."""

import re

import numpy as np
from mpi4py import MPI
from step_cases import prepared

from petfsi.errors import TouchError
from petfsi.scene.load import scene_from_dict

#: Speeds in cells a step.
SPEEDS = (0.01, 0.1, 1.0, 10.0)
CELL = 0.05
LU = ("-options_file", "monolithic-direct.opts")
SOLID = {"density": 1200.0, "young": 1e6, "poisson": 0.3}


def solid(shape, **more):
    return SOLID | {"shape": shape} | more


def box(origin, size, cells=None):
    return {"box": {"origin": list(origin), "size": list(size)} | ({"cells": list(cells)} if cells else {})}


def ball(centre, radius, cells=None):
    return {"ball": {"centre": list(centre), "radius": radius} | ({"cells": cells} if cells else {})}


def beam(start, end, thickness, elements=4, **more):
    return {"beam": {"start": list(start), "end": list(end), "thickness": thickness, "elements": elements} | more}


def scene(solids, dim=2, obstacles=None, sides=None, wet=True, integrator="bdf2", end=1.0, dt=0.01, **time):
    """Return a scene in a box of 20 cells along each axis (8 in depth), or without a fluid."""
    cells = [20, 20, 8][:dim]
    fluid = {"density": 1000.0, "origin": [0.0] * dim, "size": [CELL * n for n in cells], "cells": cells}
    time = {"end": end, "dt": dt, "integrator": integrator} | time
    table = {"dim": dim, "time": time, "solids": solids}
    if wet:
        table |= {"fluid": fluid | {"sides": sides or {"top": "open"}}}
    return scene_from_dict(table | ({"obstacles": obstacles} if obstacles else {}))


def led(scene, way, step, steps, comm=MPI.COMM_SELF):
    """Lead the first body: ``way(x, s)`` is where its points x at rest are at time s; return what was said, and when.

    Times run from 0 in ``steps`` steps; nothing is solved.
    """
    with prepared(scene, *LU, comm=comm) as sim:
        x0 = sim.solid.surface_present()
        mine = (sim.solid.surface_bodies() == 0)[:, None]
        notes = sim.watch.notes if sim.watch else []
        for n in range(steps if sim.watch else 0):
            try:
                sim.watch.judge(np.where(mine, way(x0, (n + 1) * step), x0), n * step, step)
            except TouchError as error:
                return said(error), notes
    return (None, None), notes


def said(error):
    """Return what a body went into and when, s."""
    found = re.match(
        r"solids\.\w+ (?:enters|leaves the fluid's box through|goes deeper into) (\S+).*, t = (\S+) s,", str(error)
    )
    return found[1], float(found[2])


def moving(*velocity):
    return lambda x, s: x + s * np.array(velocity)


def turning(centre, rate):
    def way(x, s):
        c, d = np.cos(rate * s), np.sin(rate * s)
        y = x[:, :2] - centre
        turned = np.column_stack((c * y[:, 0] - d * y[:, 1], d * y[:, 0] + c * y[:, 1])) + centre
        return np.column_stack((turned, x[:, 2:]))

    return way


# ---- whole runs: every kind of body into every kind of thing, at every speed ----------------------------------

#: A tenth of a metre a cell in 3D.
DT = 0.01
KINDS = {
    "triangles": (solid(ball([0.5, 0.5], 0.1, 4)), 2),
    "quadratic triangles": (solid(ball([0.5, 0.5], 0.1, 4), elements="quadratic"), 2),
    "beam": (solid(beam([0.5, 0.4], [0.5, 0.6], 0.02, 2)), 2),
    "straight beam": (solid(beam([0.4, 0.40929], [0.6, 0.48929], 0.02, 2, theory="euler-bernoulli")), 2),
    "tetrahedra": (solid(ball([0.5, 0.5, 0.5], 0.1, 2)), 3),
    "quadratic tetrahedra": (solid(box([0.4, 0.4, 0.4], [0.2, 0.2, 0.2], [1, 1, 1]), elements="quadratic"), 3),
}
THINGS = ("obstacle", "plate", "body", "wall", "open", "periodic", "image")
WAYS = ("held", "thrown")


def run_scene(kind, thing, how, speed, wet):
    """Return a scene in which a body goes down into something, or out, and by how far it may go, m.

    Its lowest point is at y = .4 or above; one step brings it ``speed`` cells on, in a fluid that hardly slows it.
    """
    body, dim = KINDS[kind]
    cell = CELL if dim == 2 else 0.1
    gap = min(3.7 * speed * cell, 0.313)
    v, axes = speed * cell / DT, ["x", "y", "z"][:dim]
    held = [{"where": "all", "fix": [*axes, *(["angle"] if "beam" in kind else [])], "velocity": {"y": -v}}]
    down = {"supports": held} if how == "held" else {"initial": {"velocity": [0.0, -v, 0.0][:dim]}, "density": 1e7}
    top = 0.4 - gap if thing != "image" else 0.4 - gap + 1.0
    thick = min(0.05, 0.8 * (0.4 - gap)) if thing != "plate" else 0.04 * cell
    shape = box([0.3, top - thick, 0.3][:dim], [0.4, thick, 0.4][:dim])
    solids, obstacles = {"d": body | down}, {}
    if thing in ("obstacle", "plate", "image"):
        obstacles = {"post": {"shape": shape}}
    if thing == "body":
        shape["box"]["cells"] = [4, 1, 4][:dim]
        solids["other"] = solid(shape, supports=[{"where": "all", "fix": axes}])
    sides = {"top": "open", "left": "open"} | ({"bottom": "open"} if thing == "open" else {})
    if thing in ("periodic", "image"):
        sides |= {"top": "periodic", "bottom": "periodic"}
    low = [0.0, 0.4 - gap if thing in ("wall", "open", "periodic") else 0.0, 0.0][:dim]
    fluid = {"density": 1.0, "origin": low, "size": [1.0] * dim, "cells": [round(1.0 / cell)] * dim, "sides": sides}
    end = (gap + (0.3 if speed >= 1.0 else 3 * speed * cell)) / v
    table = {"dim": dim, "time": {"end": max(end, DT), "dt": DT, "integrator": "bdf2"}, "solids": solids}
    return scene_from_dict(table | ({"fluid": fluid, "obstacles": obstacles} if wet else {})), gap, v


def run(kind, thing, how, speed, wet):
    """Return what a whole run went into (or None), how deep by then, and where it was, in cells."""
    scene, gap, v = run_scene(kind, thing, how, speed, wet)
    cell = CELL if scene.dim == 2 else 0.1
    with prepared(scene, *LU, comm=MPI.COMM_SELF) as sim:
        lowest = sim.solid.surface_present()[sim.solid.surface_bodies() == 0][:, 1].min()
        try:
            while not sim.finished:
                sim.advance()
        except TouchError as error:
            what, when = said(error)
            return what, (v * when - gap - lowest + 0.4) / cell
        went = lowest - sim.solid.surface_present()[sim.solid.surface_bodies() == 0][:, 1].min()
    return None, went / cell
