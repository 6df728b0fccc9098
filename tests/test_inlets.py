"""Streams that come in, and go out, through faces of a side that a sheet or a prism divides."""

import numpy as np
import pytest
from mpi4py import MPI
from test_cutcell import DIRECT
from test_two_sides import own_part

from petfsi.bench.case import simulation
from petfsi.fields.mac.grid import kinds
from petfsi.scene.schema import Scene

N = 12
ENDS = [("left", "right"), ("bottom", "top"), ("back", "front")]
OPEN_KINDS = (kinds.PRESSURE, kinds.OPEN, kinds.SPLIT)


def stream(dim, boxes, axis=0, out="given", integrator="bdf2", speed="1", obstacles=True, along=N):
    """Return a stream along an axis through a box that bars along it, given by two corners across, divide."""
    sides = {ENDS[axis][0]: {"inflow": {"speed": speed, "smoke": 1.0}}}
    sides[ENDS[axis][1]] = "open" if out == "open" else {"inflow": {"speed": f"-({speed})"}}
    velocity = [float(a == axis) for a in range(dim)]
    fluid = {"density": 2.0, "origin": [0.0] * dim, "size": [1.0] * dim, "sides": sides}
    fluid["cells"] = [along if a == axis else N for a in range(dim)]
    fluid |= {"initial": {"velocity": velocity}, "smoke": {"initial": 0.0}}
    scene = {"dim": dim, "time": {"end": 10.0, "dt": 0.5 / N, "integrator": integrator}, "fluid": fluid}
    shapes = [{"shape": bar(dim, axis, *box)} for box in boxes]
    if obstacles:
        return Scene.model_validate(scene | {"obstacles": {f"part{i}": shape for i, shape in enumerate(shapes)}})
    for shape in shapes:  # solids end at the sides
        low, high = np.array(shape["shape"]["box"]["origin"]), np.array(shape["shape"]["box"]["size"])
        high = np.minimum(low + high, 1.0)
        low = np.maximum(low, 0.0)
        shape["shape"]["box"] = {"origin": low.tolist(), "size": (high - low).tolist(), "cells": [2] * dim}
        shape |= {"density": 1.0, "young": 1.0e3, "poisson": 0.3}
        shape["supports"] = [{"where": "all", "fix": ["x", "y", "z"][:dim]}]
    return Scene.model_validate(scene | {"solids": {f"part{i}": shape for i, shape in enumerate(shapes)}})


def bar(dim, axis, low, high):
    """Return a box along an axis beyond both ends, between two corners across it."""
    origin, size = list(low), [h - m for m, h in zip(low, high, strict=True)]
    origin.insert(axis, -1.0)
    size.insert(axis, 3.0)
    return {"box": {"origin": origin[:dim], "size": size[:dim]}}


#: Bars: sheets in a cell's middle, off it, in a plane of the grid, two in a cell.
SHEETS = {
    "middle": [((5.5 / N - 0.001, -1.0), (5.5 / N + 0.001, 2.0))],
    "off": [((5.8 / N - 0.001, -1.0), (5.8 / N + 0.001, 2.0))],
    "plane": [((5 / N - 0.001, -1.0), (5 / N + 0.001, 2.0))],
    "two": [((5.2 / N, -1.0), (5.4 / N, 2.0)), ((5.6 / N, -1.0), (5.9 / N, 2.0))],
}
#: In 3D: a sheet that ends in a cell, prisms that cross.
PRISMS = {
    "ends": [((5.6 / N, -1.0), (5.7 / N, 6.45 / N))],
    "cross": [((4.3 / N, 4.4 / N), (6.8 / N, 4.7 / N)), ((5.1 / N, 4.2 / N), (5.3 / N, 8.4 / N))],
}


def run(comm, scene, steps=12):
    """Return the simulation's fluid and accounts after some steps, and the largest error of a stream of speed 1."""
    axis = next(a for a, pair in enumerate(ENDS) if not isinstance(getattr(scene.fluid.sides, pair[0]), str))
    with simulation(comm, scene, DIRECT) as sim:
        for _ in range(steps):
            sim.advance()
        fluid = sim.fluid
        worst = np.abs(fluid.velocity.parts - (fluid.sheets.table.axis == axis)).max(initial=0.0)
        for a in range(fluid.dim):
            flows = np.isin(fluid.face_kind[a][fluid.grid.owned(a)], OPEN_KINDS)
            v, _ = own_part(fluid, fluid.velocity[a], a)
            worst = max(worst, np.abs(v[flows] - (a == axis)).max(initial=0.0))
        return fluid, sim.accounts.values, comm.allreduce(worst, op=MPI.MAX)


def see_it_stay(comm, scene, tolerance=1e-12):
    fluid, _, worst = run(comm, scene)
    assert worst < tolerance
    # it has gone through half of the box: further pieces have the jet's smoke as others do
    table = fluid.sheets.table
    axis = int(np.argmax(scene.fluid.initial.velocity))
    along = np.array(np.unravel_index(table.cell, fluid.grid.cells)).reshape(3, -1)[axis]
    assert np.abs(fluid.smoke_parts[along < 3] - 1.0).max(initial=0.0) < 1e-2
    return len(table.cell)


@pytest.mark.parametrize("out", ["given", "open"])
@pytest.mark.parametrize("name", SHEETS)
def test_a_stream_along_a_sheet_through_both_ends_stays_as_it_is(name, out):
    pieces = [see_it_stay(MPI.COMM_SELF, stream(2, SHEETS[name], axis, out)) for axis in (0, 1)]
    further = {"plane": 0, "two": 2 * N}.get(name, N)
    assert pieces == [further, further]


@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_it_does_so_beside_a_solid_with_any_integrator(integrator):
    see_it_stay(MPI.COMM_SELF, stream(2, SHEETS["off"], 0, "given", integrator, obstacles=False))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_does_so_along_prisms(axis):
    for out in ("open", "given"):
        see_it_stay(MPI.COMM_SELF, stream(3, PRISMS["ends"], axis, out))
    # bodies that touch overlap by some 1e-9 of a cell
    see_it_stay(MPI.COMM_SELF, stream(3, PRISMS["cross"], axis, "open"), 1e-9)


@pytest.mark.parallel([2, 3, 4])
def test_it_does_so_on_any_number_of_ranks():
    for axis in (0, 1):
        see_it_stay(MPI.COMM_WORLD, stream(2, SHEETS["off"], axis, along=18))


@pytest.mark.parametrize("out", ["given", "open"])
def test_the_work_at_divided_ends_is_that_at_whole_ones(out):
    scenes = [stream(2, SHEETS[name], out=out, speed="1+t", integrator="midpoint") for name in ("plane", "off")]
    whole, divided = (run(MPI.COMM_SELF, scene)[1] for scene in scenes)
    assert abs(whole["boundary_work"]) > 1.0
    assert divided["boundary_work"] == pytest.approx(whole["boundary_work"], rel=1e-9)
    assert abs(whole["energy_residual"]) < 0.01 * abs(whole["boundary_work"])
