"""What benches share: reading histories, reports, options, and the command."""

import csv

import numpy as np
import pytest
from matplotlib.figure import Figure
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import bench, cli
from petfsi.bench import case, extremes, report, solid_speed, stability, theory
from petfsi.errors import InputError, SolveError


def test_the_first_wave_number_solves_its_equation_and_knows_its_limits():
    for ratio in (1e-3, 0.3, 1.0, 1e3):
        x = theory.first_wave_number(ratio)
        assert x * np.tan(x) == pytest.approx(ratio, rel=1e-9)
    assert theory.first_wave_number(1e-6) == pytest.approx(1e-3, rel=1e-6)  # a massless spring under the water
    assert theory.first_wave_number(1e9) == pytest.approx(np.pi / 2, rel=1e-6)  # a free end


def one_step(scheme, omega, h):
    """Return the matrix of a step of  d'' = -omega^2 d  on (d, u), for bdf2 on (d, u) of two levels."""
    q = (omega * h) ** 2
    A = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
    one = np.eye(2)
    if scheme == "midpoint":
        return np.linalg.solve(one - h / 2 * A, one + h / 2 * A)
    if scheme == "bdf2":
        new = np.linalg.solve(3 * one - 2 * h * A, np.hstack((4 * one, -one)))
        return np.vstack((new, np.hstack((one, 0 * one))))
    u = np.array([-(omega**2) * h, 1 - q / 2]) / (1 + q / 2)
    return np.array([[1 + h / 2 * u[0], h / 2 * (1 + u[1])], u])


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "midpoint"])
def test_the_root_is_that_of_an_oscillator_stepped_by_hand(scheme):
    omega, h = 3.0, 0.2
    stepped = np.linalg.eigvals(one_step(scheme, omega, h))
    assert np.abs(stepped - theory.root(scheme, omega, h)).min() < 1e-12
    assert theory.undo(scheme, theory.observed(scheme, omega, h)[0], h) == pytest.approx(omega, rel=1e-12)


@pytest.mark.parametrize(
    "scheme, lag, damping", [("newmark", 0.1146, 0.01 / 4), ("bdf2", 1 / 3, 1e-6 / 4), ("midpoint", 1 / 12, 0.0)]
)
def test_what_a_step_does_to_a_mode_is_as_stated(scheme, lag, damping):
    seen = theory.observed(scheme, 1.0, 0.01)
    assert seen[1] == pytest.approx(damping, rel=1e-3, abs=1e-12)
    assert 1 - seen[0] == pytest.approx(lag * 1e-4, rel=1e-3)


@pytest.mark.parallel([1, 2])
def test_a_cube_is_assembled_and_solved_for_the_stopwatch():
    done = solid_speed.assembly(MPI.COMM_WORLD, "neohookean", (2, 2, 2))
    assert (done["tets"], done["nodes"]) == (48, 27) and done["ratio"] > 0
    with case.only_options(["-options_file", "solid-large.opts"]):
        row = solid_speed.step(MPI.COMM_WORLD, 6)
    assert row["reason"] == "CONVERGED_RTOL" and 5 < row["iterations"] < 40


def test_a_scheme_without_theory_is_told():
    with pytest.raises(ValueError, match="no theory of the scheme 'euler'"):
        theory.root("euler", 1.0, 0.1)


def test_a_damped_sinusoid_is_read_back():
    t = np.linspace(0.0, 3.0, 60)
    y = 1e-8 * np.exp(-0.4 * t) * np.cos(5.0 * t + 0.3)
    assert theory.fit_damped_sinusoid(t, y, 4.8, 0.3) == pytest.approx((5.0, 0.4), rel=1e-8)


@pytest.mark.parametrize("roots", [[-3.0, 0.5], [0.9, -0.95, 0.2], [1.2 * np.exp(0.4j), 1.2 * np.exp(-0.4j), 0.3]])
def test_prony_finds_the_largest_root_of_a_sequence_beyond_floating_point(roots):
    n = np.arange(14)
    values = np.real(sum(np.array(r) ** n for r in roots))
    logs = 5000.0 + n * np.log(2.0)
    assert theory.prony_growth(values, logs, len(roots)) == pytest.approx(2 * max(map(abs, roots)), rel=1e-6)


def test_the_split_step_of_a_chain_of_one_element_is_the_single_modes():
    M, K = theory.chain(1, 1200.0, 2e5, 0.5)
    assert (M.item(), K.item()) == pytest.approx((1200.0 * 0.5 / 3, 2e5 / 0.5))
    assert theory.split_growth(M, K, 500.0, 0.01, 2.0) == theory.split_growth(M.item(), K.item(), 500.0, 0.01, 2.0)


def test_a_mode_that_the_fluid_does_not_feel_is_left_out():
    M, K, added = np.eye(2), np.diag([1.0, 1e4]), np.diag([0.0, 0.2])
    alone = theory.split_growth(1.0, 1e4, 0.2, 0.1)
    assert theory.split_growth(M, K, added, 0.1) == pytest.approx(alone, rel=1e-12)


# ---- scenes and options -------------------------------------------------------------------------------------


def test_a_job_is_changed_where_it_is_told_and_nowhere_else():
    plain = case.job(MPI.COMM_SELF, "column", {})
    changed = case.job(MPI.COMM_SELF, "column", {"time.dt": 0.02, "solids.layer.supports.0.fix": ["y"]})
    assert changed.time.dt == 0.02 and changed.solids["layer"].supports[0].fix == ["y"]
    assert changed.fluid == plain.fluid and changed.solids["layer"].supports[1] == plain.solids["layer"].supports[1]


def test_a_job_that_is_not_there_is_told():
    with pytest.raises(InputError, match=r"nothing\.toml: no such file"):
        case.job(MPI.COMM_SELF, "nothing", {})


def test_options_of_one_simulation_do_not_reach_the_next():
    options = PETSc.Options()
    options["other"] = "1"
    with case.only_options(["-options_file", case.SPLIT]):
        assert options.getAll()["fsi_ksp_type"] == "richardson"
    with pytest.raises(KeyError), case.only_options(["-options_file", case.MONOLITHIC]):
        assert "fsi_ksp_convergence_test" not in options.getAll()
        raise KeyError
    assert options.getAll().pop("other") == "1"
    assert not [name for name in options.getAll() if name.startswith("fsi_")]
    options.delValue("other")


# ---- the bar ------------------------------------------------------------------------------------------------


TINY = {"fluid.cells": [16, 12, 12], "solids.bar.shape.box.cells": [1, 8, 2], "time.end": 0.2}


def test_a_bar_that_stays_and_one_that_does_not():
    scene = case.job(MPI.COMM_SELF, "bar", {**TINY, "solids.bar.density": 100.0})
    row = stability.judge(MPI.COMM_SELF, scene, case.MONOLITHIC)
    assert row["stable"] and row["failed at step"] == "" and 0 < row["largest displacement"] < 1.1
    light = {"solids.bar.density": 0.1, "solids.bar.damping.stiffness": 0.0, "time.dt": 1 / 960, "time.end": 0.1}
    row = stability.judge(MPI.COMM_SELF, case.job(MPI.COMM_SELF, "bar", {**TINY, **light}), case.SPLIT)
    assert not row["stable"] and 1 < row["failed at step"] < 96 and row["why"]


# ---- the report and the command -----------------------------------------------------------------------------


def fake(failing):
    def run(case):
        made = report.Report("Fake", figure=Figure())
        made.rows = [{"n": 1, "x": 0.123456789}, {"n": 2, "y": "text"}]
        made.demand(not failing, made.rows[1], "y is a number")
        return made

    return run


@pytest.fixture
def fake_bench(monkeypatch):
    def put(failing):
        monkeypatch.setattr("petfsi.bench.phases.run", fake(failing))

    import petfsi.bench.phases  # noqa: F401  so that its name can be replaced

    return put


def test_a_bench_writes_its_table_and_picture_and_says_that_all_is_well(tmp_path, fake_bench, capsys):
    fake_bench(failing=False)
    assert cli.main(["bench", "phases", "--out", str(tmp_path / "new")]) == 0
    with open(tmp_path / "new" / "phases.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"n": "1", "x": "0.123456789", "y": ""}, {"n": "2", "x": "", "y": "text"}]
    assert (tmp_path / "new" / "phases.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr()
    assert "n        x     y\n1  0.12346\n2           text\n" in said.out and "all bounds hold" in said.out
    assert not said.err


def test_a_row_out_of_bounds_ends_in_exit_code_1_and_is_named(tmp_path, fake_bench, capsys):
    fake_bench(failing=True)
    assert cli.main(["bench", "phases", "--out", str(tmp_path)]) == 1
    assert "out of bounds: y is a number: n 2, y text" in capsys.readouterr().err


def test_without_a_name_the_benches_are_listed(capsys):
    assert cli.main(["bench"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed and b.about in listed and b.whole in listed for name, b in bench.BENCHES.items())


def test_a_bench_that_is_not_there_is_told(capsys):
    assert cli.main(["bench", "columm"]) == 2
    assert "columm: no such bench; there are " + ", ".join(bench.BENCHES) in capsys.readouterr().err


# ---- extremes -----------------------------------------------------------------------------------------------


def test_a_run_at_an_extreme_is_right_wrong_or_stopped():
    def entered(measure):
        made = report.Report("")
        extremes._enter(made, {"part": "rest"}, measure, MPI.COMM_SELF)
        return made.rows[0]["verdict"], made.rows[0]["why"], len(made.failures)

    def stops(*_):
        raise SolveError("it has blown up: so much")

    assert entered(lambda *_: {"speed": (-0.1, 0.2), "created": (0.0, 0.0)}) == ("right", "", 0)
    assert entered(lambda *_: {"speed": (-0.3, 0.2), "created": (np.nan, 1.0)}) == ("wrong", "speed, created", 1)
    assert entered(stops) == ("stopped", "it has blown up", 0)


def test_a_light_rigid_disk_keeps_its_share_of_the_speed():
    row = {"rho": 1e-2, "E": 1e12, "cells a step": 1.0, "scheme": "newmark", "transfer": "cutcell"}
    found = extremes._set_off(MPI.COMM_WORLD, row)
    assert all(abs(value) <= bound for value, bound in found.values()) and "speed or frequency" in found
