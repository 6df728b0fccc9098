"""The first mode of a layer under water: its frequency, its energy, and what the step does to it."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import history
from petfsi.bench.column import MONOLITHIC, SCHEMES, Column

COMM = MPI.COMM_SELF


def mode_error(column, per_period=40):
    """Return the relative error of the mode, the step's own taken out."""
    dt, omega, _ = column.measure(COMM, per_period)
    return theory.undo(column.integrator, omega, dt) / column.omega - 1


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_by_rays_a_layer_swings_as_if_half_a_cell_of_water_were_missing(ratio):
    column = Column(ratio, 32, 2, "ray", "newmark")
    error = mode_error(column, 60)
    # 1 % here, and nearly all of the error of a light layer
    assert 0 < error < 0.012
    assert column.omega * (1 + error) == pytest.approx(column.omega_without_half_cell, rel=2.5e-3)


@pytest.mark.parametrize("ratio, accuracy", [(0.1, 1e-5), (1.0, 1e-4), (10.0, 2.5e-3)])
@pytest.mark.parametrize("cells", [32, 33])
def test_by_cut_cells_what_is_left_is_the_layers_own_error(ratio, accuracy, cells):
    """The water under a plane surface is exact; 4 elements are not enough for a heavy layer."""
    assert abs(mode_error(Column(ratio, cells, 1))) < accuracy


@pytest.mark.parametrize(
    "transfer, integrator, meshes, order",
    [
        ("ray", "newmark", (16, 32, 64), 1),
        ("cutcell", "bdf2", (16, 32, 64), 2),
        ("cutcell", "midpoint", (17, 33, 65), 2),
    ],
)
def test_the_mesh_costs_first_order_by_rays_and_second_by_cut_cells(transfer, integrator, meshes, order):
    errors = [mode_error(Column(1.0, cells, 1, transfer, integrator)) for cells in meshes]
    assert theory.orders(errors, [4, 2, 1]) == pytest.approx([order, order], abs=0.15)


@pytest.mark.parametrize("transfer, integrator", SCHEMES)
def test_the_step_costs_what_theory_says(transfer, integrator):
    column = Column(1.0, 32, 1, transfer, integrator)
    dt, omega, damping = np.array([column.measure(COMM, n) for n in (10, 20, 40)]).T
    mode = theory.undo(integrator, omega[-1], dt[-1])
    predicted, rate = np.array([theory.observed(integrator, mode, h) for h in dt]).T
    assert omega == pytest.approx(predicted, rel=1e-4)
    assert damping == pytest.approx(rate, rel=1e-3, abs=1e-4 / column.period)
    assert theory.orders(omega - mode, dt)[-1] == pytest.approx(2.0, abs=0.15)
    if integrator != "midpoint":
        assert theory.orders(damping, dt)[-1] == pytest.approx({"newmark": 1.0, "bdf2": 3.0}[integrator], abs=0.25)


def test_the_midpoint_rule_keeps_the_energy_and_bdf2_does_not():
    change = {}
    for scheme in ("midpoint", "bdf2"):
        energy = Column(1.0, 33, 2, integrator=scheme).energies(COMM, 20, 60)
        change[scheme] = np.abs(energy / energy[0] - 1).max()
    assert change["midpoint"] < 2e-8 and change["bdf2"] > 1e-2


# ---- the coupled system's order in time ---------------------------------------------------------------------


def top(transfer, integrator, per_period, periods=2):
    """Return the motion of the layer's top."""
    column = Column(1.0, 16, 1, transfer, integrator)
    scene = column.scene(COMM, column.period / per_period)
    return history(COMM, scene, MONOLITHIC, periods * per_period)


@pytest.fixture(scope="module", params=["ray", "cutcell"])
def tiny_steps(request):
    """The transfer, and the motion at 640 steps a period."""
    return request.param, top(request.param, "midpoint", 640)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_layer_and_water_together_keep_order_two(integrator, tiny_steps):
    transfer, reference = tiny_steps
    errors = [np.abs(top(transfer, integrator, n) - reference[:: 640 // n]).max() for n in (40, 80)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1), errors
    assert errors[1] < 0.03 * np.abs(reference).max()
