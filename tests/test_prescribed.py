"""Nodes whose displacement is prescribed."""

import numpy as np
import pytest
from load_cases import COMM
from mac_cases import reader
from mpi4py import MPI
from solid_cases import body, field, gathered, step

from petfsi.registry import INTEGRATORS

WAY = {"x": "0.05*sin(4*t + y)", "y": "0.02*t*x"}


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_a_prescribed_displacement_is_met_at_the_end_of_every_step(integrator, dim):
    push = [{"where": "right", "fix": ["x", "y"], "displacement": WAY}, {"where": "left", "fix": ["x"]}]
    solid = field(dim, COMM, integrator=integrator, b=body(dim, supports=push))
    points = gathered(solid, "points")
    right, left = np.isclose(points[:, 0], 1.5), np.isclose(points[:, 0], 0.0)

    def wanted(t):
        x, y = points[right, 0], points[right, 1]
        return np.column_stack((0.05 * np.sin(4 * t + y), 0.02 * t * x))

    def check(t):
        d = gathered(solid, "displacement")
        np.testing.assert_allclose(d[right, :2], wanted(t), atol=1e-15)
        np.testing.assert_allclose(d[left, 0], 0.0, atol=1e-15)

    u = gathered(solid, "velocity")[right, :2]
    y = points[right, 1]
    if integrator == "static":  # the first step goes there
        assert not np.any(gathered(solid, "displacement")) and not np.any(u)
    else:
        check(0.0)
        np.testing.assert_allclose(u, np.column_stack((0.2 * np.cos(y), 0.03 + 0 * y)), atol=1e-7)
    t = 0.0
    for h in (0.1, 0.1, 0.07, 0.13):
        step(solid, t, h)
        t += h
        check(t)


def test_the_later_support_decides_between_velocity_and_displacement():
    both = [
        {"where": "all", "fix": ["x", "y"], "velocity": {"x": 1.0}},
        {"where": "right", "fix": ["x"], "displacement": {"x": "t*t"}},
    ]
    solid = field(2, MPI.COMM_SELF, integrator="bdf2", b=body(2, supports=both))
    for n in range(3):
        step(solid, 0.1 * n, 0.1)
    d, x = gathered(solid, "displacement"), gathered(solid, "points")
    right = np.isclose(x[:, 0], 1.5)
    np.testing.assert_allclose(d[right, 0], 0.09, atol=1e-15)
    np.testing.assert_allclose(d[~right, 0], 0.3, rtol=1e-12)


def test_an_unknown_follows_the_prescribed_displacement_at_second_order():
    """The end of a bar whose other end is moved, with the same way prescribed as velocity: both orders are 2."""

    def tip(supports, n):
        solid = field(2, MPI.COMM_SELF, integrator="bdf2", b=body(2, (4, 1), size=(1.5, 0.3), supports=supports))
        for k in range(n):
            step(solid, 0.4 / n * k, 0.4 / n)
        x = gathered(solid, "points")
        return gathered(solid, "displacement")[np.isclose(x[:, 0], 1.5), 0].mean()

    rails = {"where": "bottom", "fix": ["y"]}
    way = [{"where": "left", "fix": ["x"], "displacement": {"x": "0.02*sin(3*t)**2"}}, rails]
    speed = [{"where": "left", "fix": ["x"], "velocity": {"x": "0.06*sin(6*t)"}}, rails]
    exact = tip(way, 640)
    for supports in (way, speed):
        error = [abs(tip(supports, n) - exact) for n in (20, 40)]
        assert np.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.25), (supports, error)


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_a_restored_state_goes_on_bit_for_bit_under_loads(integrator):
    held = {"where": "left", "fix": ["x", "y"], "displacement": {"x": "0.01*sin(3*t)"}}
    loads = [{"where": "all", "pressure": "0.3*t + x"}, {"where": "top", "traction": ["t", 0.1], "follower": True}]

    def fresh():
        return field(2, integrator=integrator, b=body(2, supports=[held], loads=loads, body_force=["x*t", 0.2]))

    straight, again = fresh(), fresh()
    for n in range(3):
        step(straight, 0.01 * n, 0.01)
    again.restore(reader({name: slab.data for name, slab in straight.state().items()}))
    for n in range(3, 6):
        step(straight, 0.01 * n, 0.01)
        step(again, 0.01 * n, 0.01)
    for name in ("displacement", "velocity"):
        np.testing.assert_array_equal(getattr(straight, name), getattr(again, name))
    assert np.abs(straight.displacement).max() > 1e-3
