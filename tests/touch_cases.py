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
