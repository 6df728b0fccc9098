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
    """Equations of bodies with two unknowns each of which so much is left over, as far as the watch looks."""

    comm = COMM

    def __init__(self, left=(0.0,), size=0.0, angle=0.0):
        left = np.atleast_1d(left)
        self.names, self.owner = [f"b{n}" for n in range(len(left))], np.repeat(np.arange(len(left)), 2)
        self.layout = SimpleNamespace(n_local=2 * len(left))
        way = np.column_stack(np.broadcast_arrays(np.cos(angle), np.sin(angle)))
        self.residual = SimpleNamespace(array_r=(left[:, None] * way).ravel())
        sizes = np.broadcast_to(size, left.shape)
        self.rhs = SimpleNamespace(array_r=np.column_stack((sizes, 0 * sizes)).ravel())

    def piece(self, name):
        return slice(None)


def steps_watched(lefts, size=0.0, turn=np.pi):
    """Return after how many steps, each turned by so much, the watch stops, None if it does not, and what it says.

    What is left is of one body, shape (n,), or of several, shape (n, n_bodies), each with its own size and turn.
    """
    watch = SplitWatch(COMM, Left(lefts[0]), stops=True)
    for n, left in enumerate(lefts):
        try:
            watch.judge(Left(left, size, np.asarray(turn) * n))
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
    assert "More fluid moves with the solid, or with a part of its surface, than that weighs" in said


@pytest.mark.parametrize(
    ("lefts", "size"),
    [(1.4 ** np.arange(99), 0.0), (2.0 ** np.arange(99), 2.0**99), (np.zeros(9), 0.0), ([0, 1, 2, 0, 1, 2, 4], 0.0)],
    ids=["slow", "below the load", "nothing", "twice"],
)
def test_what_grows_slowly_or_by_less_than_its_load_goes_on(lefts, size):
    assert steps_watched(lefts, size)[0] is None


def test_a_body_is_judged_beside_another_that_hides_it_in_any_sum():
    light = 2.0 ** np.arange(9)
    for heavy, size, turn in ((np.full(9, 1e3), 1e6, 0.0), (1e3 * light, 1e9, 0.0), (np.full(9, 1e3), 0.0, np.pi)):
        lefts, way = np.column_stack((heavy, light)), (turn, np.pi)
        assert steps_watched(lefts.sum(axis=1), size, turn)[0] is None
        n, said = steps_watched(lefts, (size, 0.0), way)
        assert n == 3 and "in the equations of solids.b1, |b - Kx|, has risen from 1.0e+00 to 8.0e+00" in said


@pytest.mark.parametrize(
    ("lefts", "named"),
    [
        ([[1.0, 1.0], [2.0, 9.0]], "b1"),
        ([[9.0, 1.0], [9.0, 2.0]], ""),
        ([[9.0, 1.0], [9.0, 2.0], [9.0, 4.0]], "b1"),
        ([[1.0, 1.0, 9.0], [2.0, 2.0, 9.0], [4.0, 5.0, 9.0]], "b1"),
        ([[1.0, 5.0], [2.0, 10.0], [4.0, 1.0]], "b0"),
    ],
    ids=["once and most", "once beside one that leaves more", "twice", "that of two which leaves more", "most often"],
)
def test_a_failure_is_named_by_the_body_that_rose(lefts, named):
    _, said = steps_watched(lefts)
    assert f"the equations of solids.{named}," in said if named else said == ""


def largest_root(scheme, added, stiffness, damping):
    """Return by which factor a step multiplies one mode of the split scheme, of those the one that grows most.

    With D u the scheme's derivative times h, (m + m_a/z) D^2 u + c h D u + k h^2 u = 0; over m.
    """
    shifted = np.array([1.0, added])
    if scheme == "newmark":  # the position moves by the mean of two velocities
        D = np.array([1.0, -1.0])
        stiff = stiffness / 2 * np.array([1.0, 1.0, 0.0, 0.0])
        damped = damping * np.append(D, [0.0, 0.0])
    else:
        D = np.array([1.5, -2.0, 0.5])
        stiff = stiffness * np.append(1.0, np.zeros(5))
        damped = damping * np.append(D, [0.0, 0.0, 0.0])
    roots = np.roots(np.polyadd(np.polyadd(np.polymul(shifted, np.polymul(D, D)), damped), stiff))
    return roots[np.argmax(np.abs(roots))]


@pytest.mark.parametrize("scheme", ["newmark", "bdf2"])
def test_every_mode_that_grows_turns_round(scheme):
    """Which is why growth in one direction is no instability, at whatever stiffness and damping."""
    sizes = np.concatenate(([0.0], np.geomspace(1e-4, 1e4, 9)))
    cases = [(a, s, c) for a in np.geomspace(0.3, 1000.0, 12) for s in sizes for c in sizes]
    roots = np.array([largest_root(scheme, *case) for case in cases])
    growing = roots[np.abs(roots) > 1.001]
    assert len(growing) > 400 and np.abs(growing / -np.abs(growing) - 1).max() < 1e-6


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


def slider(mass_ratio, **more):
    """A block of 0.2 m that slides between 2 x 1 m of water; its rigid motion moves so many times its mass of fluid."""
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 2.2], "cells": [4, 22]}
    fluid["sides"] = dict.fromkeys(("top", "bottom"), "open")
    body = {"shape": {"box": {"origin": [0.0, 1.0], "size": [1.0, 0.2], "cells": [2, 2]}}, "density": 1e4 / mass_ratio}
    body |= {"young": 1e7, "poisson": 0.0, "body_force": [0.0, 1.0], "supports": [{"where": "all", "fix": ["x"]}]}
    body["damping"] = {"mass": 0.0}
    time = {"end": 2.0, "dt": 0.01} | more
    return Scene.model_validate({"dim": 2, "time": time, "fluid": fluid, "solids": {"s": body}})


@pytest.mark.parametrize("integrator", ["bdf2", "newmark", "midpoint"])
def test_slow_growth_is_named_as_that_of_splitting(integrator):
    """Below 1.5 a step; energy comes out of nothing before what is left exceeds |b|, or not much later."""
    with prepared(slider(0.9, integrator=integrator), *SPLITS, comm=COMM) as sim:
        n, said = until_it_stops(sim, 100)
    assert n < 100 and "plitting is unstable here" in said and "in the equations of solids.s, |b - Kx|, has" in said
    with prepared(slider(0.1, integrator=integrator), *SPLITS, comm=COMM) as sim:
        assert until_it_stops(sim, 60) == (60, "")


def box(x, density, low=0.3, **more):
    """Return a square of 0.4 m."""
    shape = {"box": {"origin": [x, low], "size": [0.4, 0.4], "cells": [4, 4]}}
    return {"shape": shape, "density": density, "young": 1e8, "poisson": 0.3} | more


def two_in_a_tank(heavy, light, gravity=None):
    """Return a scene of two bodies far apart under a free side."""
    fluid = {"origin": [0.0, 0.0], "size": [4.0, 1.0], "cells": [40, 10], "density": 1000.0, "sides": {"top": "open"}}
    made = {"dim": 2, "time": {"end": 1.0, "dt": 0.01}, "fluid": fluid, "solids": {"heavy": heavy, "light": light}}
    return Scene.model_validate(made | ({"gravity": gravity} if gravity else {}))


LIGHT = box(0.8, 50.0, young=1e6, initial={"velocity": [0.0, 1e-3]})
STRIP = {"shape": {"beam": {"start": [0.8, 0.5], "end": [1.3, 0.5], "thickness": 0.05, "elements": 6}}, "young": 1e7,
         "density": 100.0, "poisson": 0.3, "initial": {"velocity": [0.0, 1e-3]}}  # fmt: skip
CLAMPED = {"supports": [{"where": "bottom", "fix": ["x", "y"]}], "low": 0.0}
HIDDEN = {
    "weight": ((1e5, {}), LIGHT, [0.0, -9.81]),
    "a force": ((1e5, {"body_force": [0.0, -1e6]}), LIGHT, None),
    "a load on a clamped block": ((1e5, {"body_force": [0.0, -1e7], **CLAMPED}), LIGHT, None),
    "a load that sets in": ((1e4, {"body_force": ["1e9*t**3", 0.0]}), LIGHT, None),
    "a load that swings": ((1e4, {"body_force": ["1e6*sin(60*t)", 0.0]}), LIGHT, None),
    "another kind of solid": ((1e5, {"body_force": [0.0, -1e6]}), STRIP, None),
}


@pytest.mark.parametrize(("heavy", "light", "gravity"), HIDDEN.values(), ids=HIDDEN)
def test_a_light_body_is_named_beside_a_heavy_one_under_its_load(heavy, light, gravity):
    with prepared(two_in_a_tank(box(2.8, heavy[0], **heavy[1]), light, gravity), *SPLITS, comm=COMM) as sim:
        n, said = until_it_stops(sim, 10)
    assert n < 8 and "in the equations of solids.light, |b - Kx|, has risen" in said


CALM = {
    "one turns": {"initial": {"velocity": ["-10*(y-0.5)", "10*(x-3.0)"]}},
    "one is pushed at once": {"body_force": ["3e5*(t>0.05)", 0.0]},
    "one is shaken at every step": {"body_force": ["1e6*cos(100*pi*t)*exp(20*t)", 0.0]},
    "one falls": {"body_force": [0.0, -1e5]},
}


@pytest.mark.parametrize("moved", CALM.values(), ids=CALM)
def test_a_heavy_body_that_another_sets_in_motion_goes_on(moved):
    with prepared(two_in_a_tank(box(2.8, 3e4, **moved), box(0.8, 3e4)), *SPLITS, comm=COMM) as sim:
        assert until_it_stops(sim, 15) == (15, "")


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("light", [LIGHT, STRIP], ids=["blocks", "a block and a beam"])
def test_bodies_are_judged_alike_on_any_number_of_ranks_and_go_on_so(light):
    scene = two_in_a_tank(box(2.8, 1e5, body_force=[0.0, -1e6]), light)
    with prepared(scene, *SPLITS) as straight, prepared(scene, *SPLITS) as again:
        for _ in range(2):
            straight.advance()
        arrays = stored(straight)
        with prepared(scene, *SPLITS, comm=COMM) as alone:
            for _ in range(2):
                alone.advance()
        assert arrays["splitting"]["left_by_body"] == pytest.approx(alone.splitting.keep()()["left_by_body"].data, 1e-4)
        straight.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        ends = [until_it_stops(sim, 10) for sim in (straight, again)]
        assert ends[0] == ends[1] and ends[0][0] < 6 and "of solids.light, |b - Kx|, has risen" in ends[0][1]
        for name, kept in stored(straight)["splitting"].items():
            assert np.array_equal(kept, stored(again)["splitting"][name])


@pytest.mark.parallel([1, 2])
def test_what_is_known_of_a_splitting_goes_on_with_a_run():
    scene = loaded(Path(__file__).parents[1] / "jobs/column.toml", COARSE, "solids.layer.density=2e4")
    with prepared(scene, *SPLITS) as straight, prepared(scene, *SPLITS) as again:
        for _ in range(4):
            straight.advance()
        arrays = stored(straight)
        straight.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        assert again.splitting.rises.tolist() == straight.splitting.rises.tolist() > [0]
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
