"""The schemes by themselves: what they solve exactly, what they keep and what they damp."""

import numpy as np
import pytest

from petfsi.integrators import Motion, named
from petfsi.registry import INTEGRATORS

DYNAMIC = [name for name in INTEGRATORS if name != "static"]
K = np.array([[3.0, -1.0], [-1.0, 2.0]])
M = np.array([[2.0, 0.5], [0.5, 1.0]])


def advance(scheme, motion, h, force=None, M=M, K=K):
    """Take one step of M a + K d = f with rows as unknowns."""
    stage = scheme.stage(motion, h)
    f = 0.0 if force is None else force(scheme.moment(h))
    right = M @ stage.inertia - K @ stage.tangent_at - K @ stage.shift + f
    w = np.linalg.solve(stage.a * M + stage.k * K, right)
    return scheme.finish(motion, stage, w, h)


def start(d, u):
    return Motion(np.array(d, dtype=float)[:, None], np.array(u, dtype=float)[:, None])


@pytest.mark.parametrize("name", DYNAMIC)
def test_the_factor_is_that_of_the_stage(name):
    scheme = named(name)
    motion = start([1.0, 0.0], [0.0, 1.0])
    for h in (0.1, 0.15, 0.07):
        assert scheme.factor(h, motion.past_dt) == pytest.approx(1 / scheme.stage(motion, h).a, rel=1e-15)
        motion = advance(scheme, motion, h)
        assert motion.past_dt == h and len(motion.past) == len(scheme.past)


@pytest.mark.parametrize("name", ["bdf2", "midpoint"])
def test_steps_of_any_length_solve_a_parabola_exactly(name):
    """d = t^2 / 2 under a constant force, from two exact levels on."""
    scheme = named(name)
    one = np.ones((1, 1))

    def exact(t):
        return t**2 / 2 * one, t * one

    past = {"bdf2": exact(0.3), "midpoint": (exact(0.35)[1], exact(0.4)[1])}[name]
    motion, t = Motion(*exact(0.4), past, past_dt=0.1), 0.4
    for h in (0.13, 0.21, 0.08, 0.1):
        motion = advance(scheme, motion, h, lambda _: one, M=one, K=0 * one)
        t += h
        np.testing.assert_allclose((motion.displacement, motion.velocity), exact(t), rtol=1e-14)


def test_midpoint_keeps_the_energy_of_a_swing():
    scheme, motion = named("midpoint"), start([1.0, -0.3], [0.2, 2.0])

    def energy():
        d, u = motion.displacement[:, 0], motion.velocity[:, 0]
        return 0.5 * (u @ M @ u + d @ K @ d)

    first = energy()
    for n in range(200):
        motion = advance(scheme, motion, 0.9 + 0.4 * np.sin(n))
        assert energy() == pytest.approx(first, rel=1e-12)


def test_bdf2_damps_what_is_too_fast_and_midpoint_does_not():
    left = {}
    for name in ("bdf2", "midpoint"):
        motion = start([1.0], [0.0])
        for _ in range(6):
            motion = advance(named(name), motion, 1.0, M=np.eye(1), K=1e8 * np.eye(1))
        left[name] = abs(motion.displacement[0, 0])
    assert left["bdf2"] < 1e-6
    assert left["midpoint"] == pytest.approx(1.0, abs=1e-5)


def test_where_midpoint_linearises_does_not_swing_with_a_stiff_mode():
    """u^n alternates between two large values; d~ must stay as small as d."""
    scheme, motion = named("midpoint"), start([0.0], [1.0])
    for n in range(20):
        motion = advance(scheme, motion, 1.0, M=np.eye(1), K=1e8 * np.eye(1))
        assert abs(motion.velocity[0, 0]) > 0.9
        assert n == 0 or abs(scheme.stage(motion, 1.0).tangent_at[0, 0]) < 1e-3
