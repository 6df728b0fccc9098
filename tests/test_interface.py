"""Error against seconds: how paths are read, and what the schemes come to on their coarsest grids."""

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import added_mass, interface
from petfsi.bench.case import Case
from petfsi.bench.report import Report
from petfsi.errors import SolveError

CASE = Case(MPI.COMM_SELF, quick=True)


def test_the_seconds_at_an_error_lie_on_the_line_between_two_points_in_logarithms():
    path = [(0.1, 1.0), (0.025, 4.0), (0.001, 100.0)]  # one over the error
    assert interface.seconds_at(0.05, path) == pytest.approx(2.0)
    assert interface.seconds_at(0.025, path) == pytest.approx(4.0)
    assert interface.seconds_at(0.1, path) == 1.0
    assert interface.seconds_at(0.5, path) == 1.0
    assert interface.seconds_at(1e-4, path) is None
    assert interface.seconds_at(0.01, []) is None


def test_only_what_pays_counts():
    points = [(0.1, 1.0), (0.02, 20.0), (0.001, 10.0), (0.3, 2.0), (0.0005, 40.0)]
    assert interface.front(points) == [(0.1, 1.0), (0.001, 10.0), (0.0005, 40.0)]
    assert interface.seconds_at(0.01, points) == pytest.approx(10**0.5)


def trial(error, failing=()):
    """Return a trial whose schemes need ``error(scheme, cells)`` and as many seconds as cells."""

    def measure(scheme, cells, rate):
        if scheme in failing:
            raise SolveError("solver 'fsi_' stopped with DIVERGED_DTOL after 3 iterations")
        return 0.1, error(scheme, cells), float(cells)

    paths = {scheme: ((1, 1), (2000, 1)) for scheme in interface.SCHEMES}
    return interface.Trial("column", paths, measure)


def judged(made):
    report = Report("Fake")
    for scheme in interface.SCHEMES:
        report.rows += [interface._row(made, scheme, *point) for point in made.paths[scheme]]
    interface._compare(report, made.scene)
    return report


def test_the_default_is_held_to_a_tenth_of_every_baseline_that_gets_there():
    def error(scheme, cells):
        return 0.1 / cells ** (2 if scheme == interface.DEFAULT else 0.5)

    report = judged(trial(error, failing=[interface.PUBLISHED_SPLIT]))
    assert not report.failures
    row = next(row for row in report.rows if row["scheme"] == interface.PUBLISHED_SPLIT.name)
    assert (row["error"], row["seconds"], row["why"]) == ("", "", "DIVERGED_DTOL")
    assert "column: ray newmark, split does not get to 1%" in report.notes
    equal = judged(trial(lambda scheme, cells: 0.1 / cells))
    assert len(equal.failures) == len(interface.BASELINES)
    lost = judged(trial(lambda scheme, cells: 0.3))
    assert len(lost.failures) == 1 and "the default gets to 1%" in lost.failures[0]


def test_a_run_that_is_far_off_has_no_seconds():
    row = interface._row(trial(lambda scheme, cells: np.nan), interface.DEFAULT, 8, 40)
    assert (row["error"], row["seconds"], row["why"]) == ("", "", "far off")


@pytest.mark.parametrize("scheme, low, high", [(interface.DEFAULT, 0.01, 0.02), (interface.PUBLISHED, 0.08, 0.12)])
def test_the_columns_error_is_that_of_theory(scheme, low, high):
    """The phase of bdf2 lags by 4 pi (omega h)^2 / 3 at the end; newmark loses a tenth of the amplitude."""
    cells, rate = {interface.DEFAULT: (16, 80), interface.PUBLISHED: (32, 200)}[scheme]
    dt, error, seconds = interface._column(CASE).measure(scheme, cells, rate)
    assert low < error < high and seconds > 0 and dt > 0


def test_time_splitting_fails_on_the_column_and_says_so():
    row = interface._row(interface._column(CASE), interface.PUBLISHED_SPLIT, 32, 200)
    assert row["why"] in ("blew up", "far off") and row["seconds"] == ""


# ---- the added mass -----------------------------------------------------------------------------------------


def test_the_places_of_the_grid_fill_the_cell_evenly():
    for dim in (2, 3):
        places = added_mass.offsets(200, dim)
        assert places.shape == (200, dim) and np.abs(places).max() <= 0.5
        assert np.abs(places.mean(axis=0)).max() < 0.02
        assert places.std(axis=0) == pytest.approx(np.full(dim, 12**-0.5), rel=0.02)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("ratio", [0.01, 1.0, 100.0])
def test_the_added_mass_is_that_of_theory_wherever_the_grid_lies(ratio):
    body = added_mass.Body(2, ratio, 64)
    errors = [body.measure(MPI.COMM_WORLD, place) for place in added_mass.offsets(2, 2)]
    assert np.abs(errors).max() < 0.0025
    ray = dataclasses.replace(body, transfer="ray")
    assert abs(ray.measure(MPI.COMM_WORLD, added_mass.offsets(1, 2)[0])) < 0.1


def test_the_ball_is_within_its_bound():
    errors = [added_mass.Body(3, 1.0, n).measure(MPI.COMM_SELF, np.array([0.1, 0.2, 0.3])) for n in (16, 32)]
    assert abs(errors[1]) < 0.04 and abs(errors[1]) < 0.5 * abs(errors[0])
