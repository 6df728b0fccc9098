"""Time splitting, in PETSc options alone: it grows and decays as linear theory says, and iterated it is monolithic."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from step_cases import loaded, prepared, stored
from test_guard import until_it_stops
from test_restart import reader

from petfsi.bench import theory
from petfsi.bench.case import ITERATED, MONOLITHIC, SPLIT, history
from petfsi.bench.splitting import DT, Layer, growth_of_own_matrices, measure_growth
from petfsi.errors import FinalError, SolveError
from petfsi.scene.schema import Scene
from petfsi.solving.splitting import SplitWatch

COMM = MPI.COMM_SELF
CELLS = 64


@pytest.mark.parametrize(
    ("mass_ratio", "stiffness", "damping", "grows"),
    [
        (1.5, 0.01, (0.0, 0.0), True),
        (3.0, 4.0, (0.5, 0.0), True),
        (1.5, 4.0, (0.0, 0.5), False),
    ],
)
def test_one_mode_grows_as_theory_says(tmp_path, mass_ratio, stiffness, damping, grows):
    layer = Layer.one_mode(mass_ratio, stiffness, damping, CELLS)
    growth = measure_growth(COMM, layer.scene(COMM, tmp_path), steps=12, order=3)
    assert growth == pytest.approx(layer.growth(), rel=0.03)
    assert (growth > 1) == grows


def test_a_soft_mode_grows_by_the_ratio_of_masses_at_any_step():
    for stiffness in (1e-4, 1e-2):
        assert theory.split_growth(1.0, stiffness / DT**2, 3.0, DT) == pytest.approx(3.0, rel=0.005)
    assert theory.split_growth(1.0, 1e-4 / DT**2, 0.9, DT) < 1


def test_the_same_recurrence_holds_of_the_programs_own_matrices(tmp_path):
    """Four elements through the layer, where triangles and one-dimensional elements differ."""
    layer = Layer(density=9000.0, modulus=4e7, stiffness_damping=0.002, elements=4, cells=16)
    scene = layer.scene(COMM, tmp_path)
    assert measure_growth(COMM, scene, steps=100, order=6) == pytest.approx(growth_of_own_matrices(scene), rel=1e-5)


@pytest.mark.parametrize("factor", [0.3, 0.7])
def test_iterated_splitting_is_the_monolithic_solve(tmp_path, factor):
    layer = Layer.one_mode(factor * 1.25, 0.5, (0.0, 0.0), CELLS)
    scene = layer.scene(COMM, tmp_path)
    reference = history(COMM, scene, MONOLITHIC, 10)
    iterated = history(COMM, scene, ITERATED, 10)
    assert np.abs(iterated - reference).max() < 1e-7 * np.abs(reference).max()


def test_iterated_splitting_that_expands_is_an_error(tmp_path):
    layer = Layer.one_mode(2.0 * 1.25, 0.5, (0.0, 0.0), CELLS)
    assert theory.contraction(layer.mass, layer.stiffness, layer.added_mass, DT) == pytest.approx(2.0)
    with pytest.raises(SolveError, match="DIVERGED_DTOL.* Iterated splitting .* go on with -options_file monolithic"):
        history(COMM, layer.scene(COMM, tmp_path), ITERATED, 3)


# ---- what is said of it -------------------------------------------------------------------------------------

SPLITS = ("-options_file", "split.opts")
COARSE = "fluid.cells=[8, 16]"
UNSTABLE = {
    "a layer": ("jobs/column.toml", COARSE),
    "a heavy layer": ("jobs/column.toml", COARSE, "solids.layer.density=2e4"),
    "without accounts": ("jobs/column.toml", COARSE, "output.accounts=false"),
    "a flap": ("tests/scenes/flap.toml",),
    "a light bar": ("tests/scenes/bar2d.toml", "solids.bar.density=1.0"),
    "a ball in a stream": ("tests/scenes/sweep.toml",),
}
STABLE = {
    "a stiff layer": ("jobs/column.toml", COARSE, "solids.layer.density=2e4", "solids.layer.young=1e9"),
    "a disk": ("jobs/added-mass-disk.toml", "time.end=1", "fluid.cells=[32, 32]"),
    "a heavy gate": ("jobs/gate.toml", "fluid.cells=[60, 20]", "solids.gate.density=1e5"),
}


def until_it_fails(name, steps, *options):
    """Return after how many steps a scene fails, and of what."""
    path, *sets = name
    with prepared(loaded(Path(__file__).parents[1] / path, *sets), *options, comm=COMM) as sim:
        for n in range(steps):
            try:
                sim.advance()
            except SolveError as error:
                return n, error
    return steps, None


@pytest.mark.parametrize("name", UNSTABLE.values(), ids=UNSTABLE)
def test_an_unstable_splitting_is_named_before_it_turns_anything_inside_out(name):
    n, error = until_it_fails(name, 12, *SPLITS)
    assert n < 8 and "ime splitting is unstable here" in str(error) and "inside out" not in str(error)
    assert "Start again with -options_file monolithic.opts" in str(error)
    assert until_it_fails(name, n + 3, "-options_file", "monolithic.opts") == (n + 3, None)


@pytest.mark.parametrize("name", STABLE.values(), ids=STABLE)
def test_a_stable_splitting_is_left_alone(name):
    assert until_it_fails(name, 12, *SPLITS) == (12, None)


class Left:
    """A solid's equations of which so much is left over, as far as the watch looks."""

    comm = COMM
    layout = SimpleNamespace(n_local=2)

    def __init__(self, left=0.0, size=0.0, angle=0.0):
        self.residual = SimpleNamespace(array_r=left * np.array([np.cos(angle), np.sin(angle)]))
        self.rhs = SimpleNamespace(array_r=np.array([size, 0.0]))

    def piece(self, name):
        return slice(None)


def steps_watched(lefts, size=0.0, turn=np.pi):
    """Return after how many steps, each turned by so much, the watch stops, None if it does not, and what it says."""
    watch = SplitWatch(COMM, Left(), stops=True)
    for n, left in enumerate(lefts):
        try:
            watch.judge(Left(left, size, turn * n))
        except FinalError as error:
            return n, str(error)
    return None, watch.story()


@pytest.mark.parametrize("turn", [0.0, 0.5, -1.0, 2.0])
@pytest.mark.parametrize("grows", [1.6, 2.0, 10.0, "n**9", "exp(n**2/9)", "exp(-(99 - n)**2)"])
def test_what_grows_in_one_direction_is_a_load_that_sets_in(grows, turn):
    n = np.arange(20.0)
    lefts = eval(grows, {"n": n, "exp": np.exp}) if isinstance(grows, str) else grows**n
    assert steps_watched(1e-9 * lefts, turn=turn)[0] is None


@pytest.mark.parametrize("turn", [np.pi, 2.5])
@pytest.mark.parametrize("factor", [1.6, 2.0, 10.0])
def test_what_grows_and_turns_round_is_stopped_and_says_from_where(factor, turn):
    n, said = steps_watched(factor ** np.arange(9.0), turn=turn)
    assert n == 3 and f"has risen from 1.0e+00 to {factor**3:.1e} in 3 steps" in said


@pytest.mark.parametrize(
    ("lefts", "size"),
    [(1.4 ** np.arange(99), 0.0), (2.0 ** np.arange(99), 2.0**99), (np.zeros(9), 0.0), ([0, 1, 2, 0, 1, 2, 4], 0.0)],
    ids=["slow", "below the load", "nothing", "twice"],
)
def test_what_grows_slowly_or_by_less_than_its_load_goes_on(lefts, size):
    assert steps_watched(lefts, size)[0] is None


SETS_IN = {
    "as t^3": ({"left": {"pressure": "1e6*t**3"}}, 5e4),
    "as a pulse": ({"left": {"inflow": {"speed": "0.5*exp(-((t-0.4)/0.08)**2)"}}}, 8e4),
    "as a step that is smooth": ({"left": {"inflow": {"speed": "0.5*(1+tanh((t-0.3)/0.03))"}}}, 8e4),
    "without end": ({"left": {"inflow": {"speed": "1e-8*exp(60*t)"}}}, 8e4),
}


@pytest.mark.parametrize(("sides", "density"), SETS_IN.values(), ids=SETS_IN)
def test_a_heavy_body_in_a_stream_that_sets_in_smoothly_goes_on(sides, density):
    fluid = {
        "origin": [0.0, 0.0], "size": [2.0, 1.0], "cells": [20, 10], "density": 1000.0,
        "sides": {"right": "open", **sides},
    }  # fmt: skip
    box = {"origin": [0.8, 0.3], "size": [0.4, 0.4], "cells": [4, 4]}
    body = {"shape": {"box": box}, "density": density, "young": 1e8, "poisson": 0.3}
    made = {"dim": 2, "time": {"end": 0.4, "dt": 0.01}, "fluid": fluid, "solids": {"body": body}}
    with prepared(Scene.model_validate(made), *SPLITS, comm=COMM) as sim:
        for _ in range(20):
            sim.advance()


@pytest.mark.parallel([1, 2])
def test_what_is_known_of_a_splitting_goes_on_with_a_run():
    scene = loaded(Path(__file__).parents[1] / "jobs/column.toml", COARSE, "solids.layer.density=2e4")
    with prepared(scene, *SPLITS) as straight, prepared(scene, *SPLITS) as again:
        for _ in range(4):
            straight.advance()
        arrays = stored(straight)
        straight.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        assert again.splitting.rises == straight.splitting.rises > 0
        assert until_it_stops(straight) == until_it_stops(again) and straight.step == again.step < 8


FAILURES = {
    "no fluid": ("jobs/rollup.toml", ["time.dt=1.0"], ["-fsi_snes_max_it", "2"]),
    "monolithic": ("jobs/column.toml", [COARSE, "solids.layer.initial.velocity=[0, -400]"], []),
    "a multiplicative preconditioner": (
        "jobs/column.toml", [COARSE, "solids.layer.initial.velocity=[0, -400]"],
        ["-options_file", "split-iterated.opts", "-fsi_ksp_type", "fgmres", "-fsi_ksp_rtol", "1e-8"],
    ),
    "split, but inverted by its load": (
        "jobs/column.toml", [COARSE, "solids.layer.density=1e5", "solids.layer.body_force=[0, -1e12]"],
        ["-options_file", "split.opts"],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("path", "sets", "options"), FAILURES.values(), ids=FAILURES)
def test_what_fails_of_something_else_does_not_speak_of_splitting(path, sets, options):
    _, error = until_it_fails((path, "time.retries=0", *sets), 5, *options)
    assert error is not None and "splitting" not in str(error).lower().replace("tells splitting from", ""), error


def test_iterated_splitting_helps_where_stiffness_outweighs_the_fluid(tmp_path):
    layer = Layer.one_mode(3.0, 4.0, (0.5, 0.0), CELLS)
    scene = layer.scene(COMM, tmp_path)
    limited = scene.model_copy(update={"time": scene.time.model_copy(update={"energy_limit": 1.0})})
    with pytest.raises(FinalError, match=r"split-iterated\.opts holds only where the solid's stiffness"):
        history(COMM, limited, SPLIT, 40)
    assert np.isfinite(history(COMM, limited, ITERATED, 10)).all()
