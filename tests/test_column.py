"""The first mode of a layer under water: its frequency, and what the step does to it."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.column import Column

COMM = MPI.COMM_SELF


@pytest.fixture(scope="module")
def coarse_steps():
    """dt, frequency and damping rate at 10, 20 and 40 steps a period; the mode is the same at all of them."""
    column = Column(1.0, 32, wide=1)
    return np.array([column.measure(COMM, n) for n in (10, 20, 40)]).T


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_a_layer_swings_at_the_frequency_of_theory(ratio):
    column = Column(ratio, 32, wide=2)
    dt, omega, _ = column.measure(COMM, 60)
    mode = theory.undo_newmark(omega, dt)
    # the transfer leaves half a cell of water out: 1 % here, and nearly all of the error of a light layer
    assert mode == pytest.approx(column.omega, rel=0.012)
    assert mode > column.omega
    assert mode == pytest.approx(column.omega_without_half_cell, rel=2.5e-3)


def test_the_mesh_costs_first_order():
    errors = []
    for cells in (16, 32, 64):
        column = Column(1.0, cells, wide=1)
        dt, omega, _ = column.measure(COMM, 40)
        errors.append(theory.undo_newmark(omega, dt) / column.omega - 1)
    assert theory.orders(errors, [4, 2, 1]) == pytest.approx([1.0, 1.0], abs=0.1)


def test_frequency_and_damping_are_those_of_the_scheme(coarse_steps):
    dt, omega, damping = coarse_steps
    mode = theory.undo_newmark(omega[-1], dt[-1])
    predicted = np.array([theory.newmark_observed(mode, h) for h in dt]).T
    assert omega == pytest.approx(predicted[0], rel=1e-4)
    assert damping == pytest.approx(predicted[1], rel=1e-3)


def test_the_step_costs_second_order_in_frequency_and_first_in_damping(coarse_steps):
    dt, omega, damping = coarse_steps
    mode = theory.undo_newmark(omega[-1], dt[-1])
    assert theory.orders(omega - mode, dt)[-1] == pytest.approx(2.0, abs=0.1)
    assert theory.orders(damping, dt)[-1] == pytest.approx(1.0, abs=0.1)
