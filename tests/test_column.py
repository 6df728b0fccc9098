"""The first mode of a layer under water: its frequency, and what the step does to it."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import history
from petfsi.bench.column import MONOLITHIC, Column

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


# ---- the coupled system's order in time ---------------------------------------------------------------------


def top(integrator, per_period, periods=2, transfer="ray"):
    """Return the step and the motion of the layer's top."""
    column = Column(1.0, 16, wide=1)
    dt = 2 * np.pi / column.omega / per_period
    scene = column.scene(COMM, dt)
    time = scene.time.model_copy(update={"integrator": integrator})
    coupling = scene.coupling.model_copy(update={"transfer": transfer})
    scene = scene.model_copy(update={"time": time, "coupling": coupling})
    return dt, np.array(history(COMM, scene, MONOLITHIC, periods * per_period))


@pytest.fixture(scope="module", params=["ray", "cutcell"])
def tiny_steps(request):
    """The transfer, and the motion at 640 steps a period."""
    return request.param, top("midpoint", 640, transfer=request.param)[1]


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_layer_and_water_together_keep_order_two(integrator, tiny_steps):
    transfer, tiny_steps = tiny_steps
    errors = []
    for n in (40, 80):
        _, y = top(integrator, n, transfer=transfer)
        errors.append(np.abs(y - tiny_steps[:: 640 // n]).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1), errors
    assert errors[1] < 0.03 * np.abs(tiny_steps).max()


def test_midpoint_shifts_the_frequency_as_theory_says_and_does_not_damp():
    """tan(omega' h/2) = omega h/2 for the observed frequency omega'."""
    column = Column(1.0, 16, wide=1)
    modes = []
    for n in (10, 20, 40):
        dt, y = top("midpoint", n, periods=4)
        observed, damping = theory.fit_damped_sinusoid(dt * np.arange(len(y)), y, column.omega, 0.0)
        modes.append(2 / dt * np.tan(observed * dt / 2))
        assert abs(damping) < 1e-4 * column.omega
    assert modes == pytest.approx([modes[-1]] * 3, rel=2e-4)


def test_bdf2_shifts_and_damps_the_mode_as_theory_says():
    """A mode exp(z t) with (3 - 4 e^-q + e^-2q)/2 = i omega h, q = z h."""
    column = Column(1.0, 16, wide=1)
    modes = []
    for n in (20, 40, 80):
        dt, y = top("bdf2", n, periods=4)
        later = slice(n // 2, None)  # the first step is another scheme's, which leaves a trace for a while
        t = dt * np.arange(len(y))
        observed, damping = theory.fit_damped_sinusoid(t[later], y[later], column.omega, 0.0)
        step = np.exp(-(1j * observed - damping) * dt)
        modes.append((3 - 4 * step + step**2) / (2j * dt))
    assert np.real(modes) == pytest.approx([modes[-1].real] * 3, rel=5e-4)
    assert np.abs(np.imag(modes)).max() < 5e-4 * column.omega
