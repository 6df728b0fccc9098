"""The bench of particles beside an elastic body: its judgement, its search and its map. About 5 s."""

from itertools import product

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import particle_coupling as bench
from petfsi.bench.case import MONOLITHIC, SPLIT
from petfsi.bench.report import Report

WORLD = MPI.COMM_WORLD


def largest(ratio, young, viscosity, scheme, options, steps=5):
    return bench.largest(WORLD, ratio, young, viscosity, scheme, options, steps)


def test_the_simultaneous_solve_keeps_energy_and_momentum_at_the_longest_step():
    found = largest(0.1, 1e2, bench.VISCOSITY, "newmark", MONOLITHIC)
    assert found["step"] == found["settles"] == 1.0 and found["longest"] == "1"
    assert found["momentum"] < bench.KEPT


def test_splitting_makes_momentum_and_for_a_light_body_energy():
    found = largest(0.1, 1e2, bench.VISCOSITY, "newmark", SPLIT, 20)
    assert found["step"] == 0.5
    assert float(found["longest"]) == pytest.approx(1.58, abs=0.05)
    assert found["momentum"] > 1.0


def test_an_explicit_body_needs_shorter_steps_than_its_own_limit():
    """Its own limit and sound's allow the longest; coupled to particles it is less, unless it is heavy."""
    assert largest(10.0, 1e2, 0.0, "symplectic-euler", MONOLITHIC)["step"] == 1.0
    found = largest(1.0, 1e2, 0.0, "symplectic-euler", MONOLITHIC, 20)
    assert found["step"] == found["settles"] == 0.5 and float(found["longest"]) > 2
    assert largest(1.0, 1e6, 0.0, "symplectic-euler", MONOLITHIC)["longest"] == "beyond the solid's limit"


def test_the_map_shows_both_steps_where_they_differ():
    report = Report("map")
    for part, names in (("no-slip", ("monolithic", "split-iterated", "split")), ("syrup", ("split",)),
                        ("slip", ("newmark",))):  # fmt: skip
        for name, ratio, young in product(names, bench.RATIOS, (1e2, 1e5)):
            row = {"part": part, "solve": name, "ratio": ratio, "young": young, "momentum": 0.1}
            report.rows.append(row | {"step": 0.25 if ratio < 1 else 0.0, "settles": 1.0 if young > 1e3 else 0.0})
    head, *lines = bench._map(report, "slip", "newmark")
    assert head.split() == ["slip,", "newmark", "E", "=", "1e+02", "1e+05"]
    assert [line[29:].split() for line in lines] == [["none", "none", "(1)"]] * 2 + [["1/4", "(none)", "1/4", "(1)"]]
    assert len(bench._picture(report).axes) == 12
    assert np.isfinite(bench.LONGEST)
