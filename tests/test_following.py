"""Closed regions keep their numbers: in divided cells, while they move through the grid, on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mac_cases import reader, whole
from mpi4py import MPI

from petfsi.bench.case import only_options
from petfsi.scene.load import scene_from_dict
from petfsi.simulation import Simulation

COMM = MPI.COMM_WORLD
HELD = {"density": 1000.0, "young": 1e5, "poisson": 0.3}
EVERYWHERE = {"box": {"origin": [-9.0, -9.0], "size": [18.0, 18.0]}}


def moved(velocity):
    """A support that moves all of a solid."""
    return {"where": EVERYWHERE, "fix": ["x", "y"], "velocity": dict(zip("xy", velocity, strict=True))}


def can(origin, size, cells, **more):
    """A box with water inside: the outermost of its cells are its walls."""
    box = {"origin": origin, "size": size, "cells": cells}
    h = [s / n for s, n in zip(size, cells, strict=True)]
    cavity = {
        "origin": [o + 0.9 * d for o, d in zip(origin, h, strict=True)],
        "size": [s - 1.8 * d for s, d in zip(size, h, strict=True)],
    }
    return HELD | {"shape": {"box": box, "cavity": cavity}} | more


def room(size, cells):
    return float(np.prod([s * (n - 2) / n for s, n in zip(size, cells, strict=True)]))


def scene(cells, **more):
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": cells}
    return {"dim": 2, "time": {"end": 1.0, "dt": 0.01, "integrator": "newmark"}, "fluid": fluid} | more


def run(data, steps, each=lambda sim: None):
    """The volumes of all regions after every step."""
    with only_options(["-options_file", "monolithic-direct.opts"]):
        sim = Simulation(COMM, scene_from_dict(data))
        sim.prepare()
        rows = [sim.regions.volumes]
        for _ in range(steps):
            sim.advance()
            each(sim)
            rows.append(sim.regions.volumes)
    return np.array(rows)


#: A room of half a cell in height that sinks; most rows of cells have more water above or below it than in it.
THIN = can([0.2, 0.52], [0.5, 0.036], [26, 3], supports=[moved([0.0, -1.0])])


@pytest.mark.parallel([1, 3])
def test_a_region_of_further_pieces_alone_is_followed_through_the_grid():
    volumes = run(scene([16, 32], solids={"can": THIN}), 12)
    np.testing.assert_allclose(volumes[0], [1.0 - 0.5 * 0.036, room([0.5, 0.036], [26, 3])], rtol=1e-7)
    np.testing.assert_allclose(volumes, np.broadcast_to(volumes[0], volumes.shape), rtol=1e-7)


@pytest.mark.parallel([1, 2])
def test_two_rooms_between_sheets_that_sweep_through_cells_keep_their_names():
    solids = {}
    for name, x in (("one", 0.11), ("other", 0.53)):
        box = {"origin": [x, 0.0], "size": [0.006, 1.0], "cells": [1, 8]}
        solids[name] = HELD | {"shape": {"box": box}, "supports": [moved([1.0, 0.0])]}
    data = scene([16, 16], solids=solids)
    data["fluid"] |= {"sides": {"left": "periodic", "right": "periodic"}, "initial": {"velocity": [1.0, 0.0]}}
    volumes = run(data, 60)
    np.testing.assert_allclose(volumes, np.broadcast_to([0.574, 0.414], volumes.shape), rtol=1e-7)


@pytest.mark.parallel([1, 2, 3, 4])
def test_regions_that_begin_in_one_divided_cell_are_in_the_order_of_its_pieces():
    """A can in a can, with all their walls in the cells of the first column: three regions begin in one cell."""
    outer, inner = ([0.0101, 0.0202], [0.82, 0.072], [40, 9]), ([0.0402, 0.0402], [0.76, 0.032], [76, 4])
    data = scene([32, 8], solids={"outer": can(*outer), "inner": can(*inner)})
    data["fluid"]["size"] = [4.0, 1.0]
    volumes = run(data, 0)[0]
    between = room(*outer[1:]) - np.prod(inner[1])
    np.testing.assert_allclose(volumes, [4.0 - np.prod(outer[1]), between, room(*inner[1:])], rtol=1e-7)


@pytest.mark.parallel([1, 2])
def test_regions_of_further_pieces_are_followed_after_a_restart():
    data = scene([16, 32], solids={"can": THIN})
    with only_options(["-options_file", "monolithic-direct.opts"]):
        sim, other = (Simulation(COMM, scene_from_dict(data)) for _ in range(2))
        sim.prepare()
        other.prepare()
        for _ in range(3):
            sim.advance()
        stored = {name: {key: whole(COMM, slab) for key, slab in part.items()} for name, part in sim.state().items()}
        other.restore(sim.step, sim.time, sim.dt, lambda name: reader(stored[name]))
        for _ in range(4):
            sim.advance()
            other.advance()
            np.testing.assert_allclose(other.regions.volumes, sim.regions.volumes, rtol=1e-12)
    assert not np.isnan(sim.regions.volumes).any()
