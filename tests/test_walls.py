"""Flows along and past walls, and bodies that fall, against exact ones: no wall is let through or holds back."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import walls, walls_bodies, walls_flows
from petfsi.bench.case import Case
from petfsi.bench.report import Report

SLOPES = [0.0, 0.5, 5.0, 20.0, 45.0, 70.0, 90.0]


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
@pytest.mark.parametrize("slope", SLOPES)
def test_a_stream_along_a_slanting_wall_stays_as_it_is(slope, integrator):
    v = np.array([np.cos(np.radians(slope)), np.sin(np.radians(slope))])
    normal = np.array([-v[1], v[0]])
    for point in walls_flows.POINTS:
        assert walls_flows.along(MPI.COMM_WORLD, v, normal, point, integrator, 5) < 1e-10


def test_it_does_so_for_a_second():
    v = np.array([0.9396926, 0.3420201])
    assert walls_flows.along(MPI.COMM_SELF, v, np.array([-v[1], v[0]]), (0.5, 0.4031), "midpoint", 64) < 1e-9


@pytest.mark.parallel([1, 2])
def test_a_stream_along_a_wall_of_any_direction_in_space_stays_as_it_is():
    for v, normal in walls_flows.random_walls(4):
        assert walls_flows.along(MPI.COMM_WORLD, v, normal, walls_flows.POINT, "midpoint", 3) < 1e-10


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("dim, L2, largest", [(2, 7e-4, 0.045), (3, 2e-3, 0.2)])
def test_a_stream_set_off_past_a_body_is_potential_flow_of_second_order(dim, L2, largest):
    """In L1, and of order 1.5 and 1 in L2 and max: the error is of first order in one layer of faces."""
    report = Report("walls")
    walls_flows.impulsive(Case(MPI.COMM_WORLD, True), report, dim)
    assert not report.failures
    assert report.rows[-1]["L2"] < L2 and report.rows[-1]["max"] < largest
    assert walls._picture(report) is not None


@pytest.mark.parallel([1, 2])
def test_a_disk_falls_as_fast_as_in_potential_flow():
    """And what it does not gain the fluid does not lose: energy grows nowhere."""
    seen, energy = walls_bodies.Fall(2, 8).measure(MPI.COMM_WORLD)
    assert 0.95 < seen < 1.0
    assert -0.08 < energy < 0.0


def test_a_stream_has_no_drag():
    assert abs(walls_bodies.drag(MPI.COMM_SELF, 8)) < 0.03
