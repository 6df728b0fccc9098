"""The bench of particles: what it compares with, and its parts at a few particles. About 20 s."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import (
    bodies_data,
    particle_bodies,
    particles,
    particles_choices,
    particles_dam,
    particles_data,
    particles_flows,
    particles_tank,
)
from petfsi.bench.case import Case
from petfsi.bench.report import Report

WORLD = MPI.COMM_WORLD


def test_measured_series_are_whole():
    assert len(particles_data.FRONT_T) == len(particles_data.FRONT_Z) == 15
    assert len(particles_data.HEIGHT_TAU) == len(particles_data.HEIGHT_H) == 17
    assert np.all(np.diff(particles_data.FRONT_T) > 0) and np.all(np.diff(particles_data.HEIGHT_H) < 0)
    assert len(particles_data.BUCHNER_T) == len(particles_data.BUCHNER_P)
    assert all(len(series) == len(particles_data.COURCY_T) for series in particles_data.COURCY.values())
    assert max(particles_data.BUCHNER_P) == 0.887


def test_published_bends_have_the_bounds_that_the_bench_asks_for():
    largest = {name: max(x for _, x in series) for name, series in bodies_data.GATE_X.items()}
    assert largest.pop("Antoci") == particle_bodies.GATE_PEAK[1]
    assert min(largest.values()) == particle_bodies.GATE_PEAK[0]
    assert set(bodies_data.GATE_Y) == set(bodies_data.GATE_X)
    bent = [max(x for _, x in series) for series in bodies_data.OBSTACLE.values()]
    assert (min(bent), np.floor(max(bent))) == particle_bodies.OBSTACLE_PEAK
    for table in (bodies_data.GATE_X, bodies_data.GATE_Y, bodies_data.OBSTACLE):
        for series in table.values():
            assert np.all(np.diff([t for t, _ in series]) > 0)


def test_peaks_and_arrivals_are_read_from_histories():
    t = np.linspace(0.0, 1.0, 101)
    seen = np.column_stack([t, 10 * np.sin(np.pi * t), 0 * t])
    assert particle_bodies.peak(seen) == pytest.approx((10.0, 0.5))
    assert particle_bodies.arrival(seen) == pytest.approx(np.arcsin(0.2) / np.pi, abs=1e-4)
    assert np.isnan(particle_bodies.arrival(seen * [1.0, 0.1, 1.0]))
    lines = [((0.0, 0.0), (1.0, 1.0)), ((0.0, 2.0), (0.9, 2.9))]
    assert particle_bodies.apart(np.column_stack([t, t + 1, t]), lines, 2.0) == pytest.approx(0.0, abs=1e-12)
    assert particle_bodies.apart(np.column_stack([t, t + 4, t]), lines, 2.0) == pytest.approx(3.0)


def test_exact_channel_flows_begin_and_end_as_they_must():
    """Morris' values in the middle of the channel (design's reference), and the plates."""
    middle = np.array([0.5 * particles_flows.WIDTH])
    for t, u in ((0.0225, 2.232737507e-06), (0.225, 1.109980166e-05), (9.0, 1.25e-05)):
        assert particles_flows.poiseuille(middle, t)[0] == pytest.approx(u, rel=1e-8)
    assert particles_flows.couette(middle, 0.1125)[0] == pytest.approx(3.628440987e-06, rel=1e-8)
    plates = np.array([0.0, particles_flows.WIDTH])
    np.testing.assert_allclose(particles_flows.couette(plates, 0.1), [0.0, particles_flows.SPEED], atol=1e-17)
    assert particles_flows.stopped(middle, 0.1)[0] == pytest.approx(
        4 / np.pi * particles_flows.SPEED * np.exp(-(np.pi**2) * 0.1), rel=1e-3
    )


def test_the_mean_over_a_disc_and_the_filter_are_exact_for_straight_lines():
    heights, weights = particles_dam.disc(0.16)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ heights == pytest.approx(0.16)
    assert weights @ (heights - 0.16) ** 2 == pytest.approx(particles_dam.DISC_WIDTH**2 / 16)
    T = np.linspace(0.0, 1.0, 201)
    np.testing.assert_allclose(particles_dam.filtered(T, 3 * T)[20:-20], 3 * T[20:-20], rtol=1e-12)


def test_a_clock_that_began_too_early_is_found():
    T = np.linspace(0.0, 4.0, 400)
    Z = np.interp(T + 0.2, particles_data.FRONT_T, particles_data.FRONT_Z)
    seen = np.column_stack([T, Z, T])
    assert particles_dam.best_shift(seen) == pytest.approx(0.2, abs=0.01)
    assert particles_dam.against_front(seen, 0.2) < 0.01


@pytest.mark.parallel([1, 2])
def test_each_part_runs_at_a_few_particles():
    assert particles_flows.vortices(WORLD, 25)["error"] < 0.07
    for name, exact in particles_flows.CHANNELS.items():
        errors, lines = particles_flows.channel_errors(particles_flows.channel(WORLD, name, 10), exact)
        assert max(errors) < 0.1
        assert [len(y) for y, _ in lines] == [10] * len(particles_flows.TIMES)
    assert particles_tank.tank(WORLD, 10, 10.0, 0.5)["bottom"] == pytest.approx(1.0, abs=0.05)
    seen, residual = particles_dam.column(WORLD, 10, 1.5)
    row = particles_dam.front_row(seen, residual)
    assert row["height rms"] < 0.05 and 0.1 < row["shift"] < 0.5 and residual < 0.03
    seen, names, _ = particles_dam.blow(WORLD, 16, 2.6)
    assert names[0] == "disc" and seen.shape[1] == 1 + len(names)
    assert seen[:, 1 + names.index("P1")].max() > 0.5


def test_what_is_measured_is_drawn():
    report = Report("particles")
    profiles = dict.fromkeys(particles_flows.CHANNELS, [(np.array([5e-4]), np.array([1e-5]))])
    report.rows = [{"part": part, "at": n, "error": 1 / n} for part in ("vortices", *profiles) for n in (20, 40)]
    seen = np.linspace(0.0, 3.0, 30)[:, None] * [1.0, 1.2, -0.2] + [0.0, 1.0, 1.0]
    figure = particles._picture(report, profiles, {"2D, 20": seen}, {"disc, 40": seen[:, :2], "P1, 40": seen[:, :2]})
    assert len(figure.axes) == 6


def test_the_quick_bench_measures_some_of_the_choices():
    assert set(particles_choices.QUICK) <= set(particles_choices.settings())
    assert particles_choices.settings()[particles_choices.DEFAULT] == {"kernel": "wendland", "smoothing": 1.5}
    assert Case(WORLD, True).quick


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("name", particle_bodies.OBSTACLES)
def test_solids_that_water_bends_are_looked_at(name):
    """Before the water comes the obstacle leans back by nothing but what its own weight does: nothing."""
    sets = {"fluid.artificial_viscosity": 0.05} | particle_bodies.OBSTACLES[name]
    seen, wrong = particle_bodies.bend(WORLD, "dambreak", 0.0146, 0.02, sets)
    assert np.abs(seen[:, 1]).max() < 0.05 and len(seen) > 10
    assert wrong < 0.02 * particle_bodies.OBSTACLE_STORED
    if name == "beam":
        opened, _ = particle_bodies.bend(WORLD, "elastic-gate", 0.0025, 0.02, {})
        assert 2.0 < opened[-1, 1] < 6.0  # the codes have 4.4 to 5.3
