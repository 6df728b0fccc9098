"""Sheets thinner than a cell: what is on one side of them is not felt on the other."""

import pytest
from mpi4py import MPI

from petfsi.bench import walls_sheets


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
