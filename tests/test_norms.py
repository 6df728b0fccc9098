"""Errors of histories: norms by hand on unequal steps, and extrapolation of made sequences."""

import numpy as np
import pytest

from petfsi.errors import InputError
from petfsi.norms import Series, error_of, extrapolate


def series(times, *values):
    return Series(np.asarray(times, float), np.column_stack(values).astype(float))


def dense(value, end=2.0, n=400):
    t = np.linspace(0.0, end, n + 1)
    return series(t, value(t))


@pytest.mark.parametrize("shift", [0.3, -2.0, 1e-9])
def test_l2_over_unequal_steps_is_the_integral(shift):
    rng = np.random.default_rng(3)
    t = np.unique(np.concatenate((rng.uniform(0.0, 2.0, 3000), [0.0, 2.0])))
    # over a whole period the mean of sin^2 is a half; of a shifted sine the difference is 2 sin(shift/2) cos(...)
    run, wanted = series(t, np.sin(np.pi * t + shift)), dense(lambda t: np.sin(np.pi * t))
    assert error_of(run, wanted, "l2") == pytest.approx(2 * abs(np.sin(shift / 2)), rel=1e-3, abs=1e-9)


def test_components_are_judged_together_and_zero_is_judged_absolutely():
    t = np.linspace(0.0, 1.0, 11)
    wanted = series(t, 3.0 + 0 * t, 4.0 + 0 * t)
    assert error_of(series(t, 3.0 + 0 * t, 4.5 + 0 * t), wanted, "l2") == pytest.approx(0.1)
    assert error_of(series(t, 3.0 + 0 * t, 4.0 + t), wanted, "max") == pytest.approx(0.2)
    assert error_of(series(t, 3.0 + 0 * t, 4.0 + t), wanted, "final", (0.0, 0.5)) == pytest.approx(0.1)
    assert error_of(series(t, 0.25 + 0 * t), series(t, 0 * t), "l2") == pytest.approx(0.25)


def test_a_reference_of_three_quarters_of_the_step_adds_nothing_to_see():
    t = np.linspace(0.0, 4.0, 81)  # 20 steps a period
    coarse, fine = (dense(lambda t: np.cos(2 * np.pi * t), 4.0, n) for n in (80, 107))
    assert len(coarse.times) == len(t)
    assert error_of(coarse, fine, "l2") < 1e-4
    linear = np.interp(coarse.times, fine.times, fine.values[:, 0])
    assert np.abs(linear - coarse.values[:, 0]).max() > 5e-3


def test_nothing_is_extrapolated_in_time():
    with pytest.raises(InputError, match=r"known from 0 to 1 s, .* from 0 to 2 s; give a window"):
        error_of(dense(np.sin, 2.0), dense(np.sin, 1.0), "l2")
    assert error_of(dense(np.sin, 2.0), dense(np.sin, 1.0), "l2", (0.0, 1.0)) < 1e-9
    with pytest.raises(InputError, match="no step in the window"):
        error_of(dense(np.sin, 2.0), dense(np.sin, 1.0), "l2", (5.0, 6.0))
    with pytest.raises(InputError, match="the reference has 3 times; a cubic between them wants 4"):
        error_of(dense(np.sin, 1.0), dense(np.sin, 1.0, 2), "l2")
    assert error_of(series([0.0, 1.0], [0.0, 1.1]), series([0.0, 1.0], [0.0, 1.0]), "final") == pytest.approx(0.1)


def made(order, steps, error=0.1, own=np.cos):
    return [
        series(t, own(t) * (1.0 + error * h**order)) for h in steps for t in [np.linspace(0.0, 2.0, round(2 / h) + 1)]
    ]


@pytest.mark.parametrize("order", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("factor", [2.0, 1.5])
def test_a_clean_sequence_is_extrapolated_to_its_limit(order, factor):
    runs = made(order, [0.2 / factor**n for n in range(3)])
    found = extrapolate(runs, factor, order, "l2")
    truth = series(found.limit.times, np.cos(found.limit.times))
    assert found.order == pytest.approx(order, abs=0.05) and not found.why
    error = error_of(found.limit, truth, "l2")
    assert error < 0.05 * error_of(runs[-1], truth, "l2") and error < found.bar


def test_a_bar_is_wider_where_the_order_is_not_the_schemes():
    clean, slow = (extrapolate(made(p, [0.2, 0.1, 0.05]), 2.0, 2.0, "l2") for p in (2.0, 1.0))
    assert not clean.why and "order 1.0" in slow.why and "2 expected" in slow.why
    growing = [series(t, np.cos(t) * (1.0 + e)) for t in [np.linspace(0.0, 2.0, 41)] for e in (0.01, 0.02, 0.06)]
    grown = extrapolate(growing, 2.0, 2.0, "l2")
    assert grown.why == "differences grow"
    assert grown.bar == pytest.approx(3 * 1.25 * 0.04 / (2**0.5 - 1.0) / abs(1.06 + 0.04 / (2**0.5 - 1.0)), rel=1e-6)
    two = extrapolate(made(2.0, [0.1, 0.05]), 2.0, 2.0, "l2")
    assert two.order is None and "two runs" in two.why
    truth = series(two.limit.times, np.cos(two.limit.times))
    assert error_of(two.limit, truth, "l2") < two.bar


def test_a_window_without_steps_is_told_of_an_extrapolation_too():
    with pytest.raises(InputError, match="no step in the window"):
        extrapolate(made(2.0, [0.2, 0.1, 0.05]), 2.0, 2.0, "l2", (5.0, 6.0))


def test_runs_that_agree_to_the_last_digit_have_no_bar():
    t = np.linspace(0.0, 2.0, 41)
    found = extrapolate([series(t, np.cos(t))] * 3, 2.0, 2.0, "l2")
    assert found.bar < 1e-13 and found.order == 2.0 and not found.why
