"""Sheets thinner than a cell: what is on one side of them is not felt on the other."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import walls_sheets
from petfsi.bench.case import MONOLITHIC, simulation
from petfsi.fields.mac.carrying.paths import find_path
from petfsi.scene.schema import Scene


@pytest.mark.parallel([1, 2, 3])
def test_water_under_a_sheet_stays_at_rest_while_it_turns_above():
    thin, thick = (walls_sheets.shear(MPI.COMM_WORLD, 32, t) for t in (walls_sheets.THIN, walls_sheets.THICK))
    assert thin["velocity"] < 1e-9 and thin["smoke"] < 1e-9
    assert abs(thin["energy"] - thick["energy"]) < 0.01


def test_a_beam_inside_a_cell_swings_at_second_order_without_damping():
    errors = []
    for cells in (16, 32):
        error, damping = walls_sheets.Strip(cells, 0.4).measure(MPI.COMM_SELF)
        assert abs(damping) < 1e-4
        errors.append(abs(error))
    assert errors[1] < max(errors[0] / 3.2, 3e-4)


def test_divided_faces_cross_cells_along_their_axis():
    sides = {"left": "periodic", "right": "periodic"}
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [20.0, 1.0], "cells": [8, 8], "sides": sides}
    sheet = {"shape": {"box": {"origin": [-1.0, 0.55], "size": [22.0, walls_sheets.THIN]}}}
    scene = {"dim": 2, "time": {"end": 1.0, "dt": 0.1, "integrator": "bdf2"}, "obstacles": {"sheet": sheet}}
    scene |= {"coupling": {"transfer": "cutcell"}, "fluid": fluid | {"initial": {"velocity": [3.0, 0.0]}}}
    with simulation(MPI.COMM_SELF, Scene.model_validate(scene), MONOLITHIC) as sim:
        assert np.abs(sim.fluid.velocity.parts).max() == 3.0
        # 0.48 cells along x; along y it would be 9.6, of which a sweep goes three
        fastest = sim.fluid.sheets.fastest(sim.fluid.velocity)
        assert find_path(sim.fluid.grid, sim.fluid.velocity, fastest, 0.4, "cubic").sweeps == 1


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("angle", [0.3, 0.7, 1.2])
def test_what_is_at_rest_is_carried_at_rest_from_the_first_step(angle, tmp_path_factory):
    comm = MPI.COMM_WORLD
    path = comm.bcast(str(tmp_path_factory.mktemp("mesh") / "sheets.vtk") if comm.rank == 0 else None)
    if comm.rank == 0:
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        boxes = [((-0.3, 0.3), (-0.4, -0.1)), ((-0.1, -0.096), (-0.2, 0.35)), ((-0.3, 0.35), (0.113, 0.117))]
        corners = np.array([(x, y) for across, up in boxes for x in across for y in up])
        lines = np.array([(n, n + 2, n + 2, n + 3, n + 3, n + 1, n + 1, n) for n in (0, 4, 8)]).reshape(-1, 2)
        meshio.Mesh(np.pad(corners @ turn.T, ((0, 0), (0, 1))), [("line", lines)]).write(path)
    comm.barrier()
    fluid = {"density": 1.0, "origin": [-0.5, -0.5], "size": [1.0, 1.0], "cells": [16, 16]}
    scene = {"dim": 2, "time": {"end": 1.0, "dt": 0.1}, "gravity": [0.0, -1.0], "fluid": fluid}
    scene["obstacles"] = {"sheets": {"shape": {"mesh": path}}}
    with simulation(comm, Scene.model_validate(scene), MONOLITHIC) as sim:
        for read in sim.fluid._transport.read():
            assert len(read.parts) in (0, len(sim.fluid.sheets.table)), "links without values are read beyond the end"
            assert not any(np.any(v) for v in (*read, read.parts))
        assert len(sim.fluid.sheets.table) == len(sim.fluid.velocity.parts) > 0
        assert any(slim.any() for slim in sim.fluid.sheets.slim) or comm.size > 1
