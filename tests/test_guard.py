"""A run whose energy grows out of nothing stops by name."""

from pathlib import Path

import pytest
from load_cases import COMM
from step_cases import loaded, prepared, stored
from test_restart import reader

from petfsi.bench.case import only_options
from petfsi.errors import SolveError
from petfsi.runs.plan import skipped
from petfsi.runs.run import run_scene
from petfsi.scene.load import scene_from_dict

JOBS = Path(__file__).parents[1] / "jobs"
SPLIT = ("-options_file", "split.opts")


def spinning(**time):
    """A stiff disk that turns by .13 rad a step: the midpoint rule shrinks it half-way, and its energy grows."""
    shape = {"ball": {"centre": [0.0, 0.0], "radius": 0.2, "cells": 6}}
    solid = {"shape": shape, "density": 1000.0, "young": 1e7, "poisson": 0.3}
    solid["initial"] = {"velocity": ["-13*y", "13*x"]}
    steps = {"end": 1.0, "dt": 0.01, "integrator": "midpoint", "retries": 0}
    return scene_from_dict({"dim": 2, "time": steps | time, "solids": {"disk": solid}})


def until_it_stops(sim, most=200):
    """Return after how many more steps a simulation stops, and why."""
    for n in range(most):
        try:
            sim.advance()
        except SolveError as error:
            return n, str(error)
    return most, ""


@pytest.mark.parallel([1, 2, 3])
def test_a_stop_says_what_has_grown_and_by_how_much():
    with prepared(spinning(), comm=COMM) as sim:
        first = sim.accounts.values["kinetic"]
        n, why = until_it_stops(sim)
        values = sim.accounts.values
    assert 0 < n < 50
    assert values["energy_residual"] == pytest.approx(values["kinetic"] + values["elastic"] - first, rel=1e-9)
    assert first < values["energy_residual"] < 50 * first
    assert why.startswith("energy has come out of nothing, most of it ")
    assert f"come to {first:.3g} J." in why and "Try a smaller dt, -fsi_snes_type newtonls" in why


@pytest.mark.parallel([1, 2])
def test_a_run_that_goes_on_stops_as_one_that_never_stopped():
    """What was exchanged, and how many steps had too much, is in the checkpoint."""
    scene = loaded(JOBS / "column.toml", "fluid.cells=[8, 16]", "gravity=[0, 0]", "solids.layer.density=900")
    with prepared(scene, *SPLIT, comm=COMM) as straight, prepared(scene, *SPLIT, comm=COMM) as again:
        straight.accounts.exchanged, straight.guard.weight, straight.guard.beyond = 1e-3, 2.0, 2
        straight.advance()
        straight.guard.beyond = 1
        arrays = stored(straight)
        straight.forget()
        again.restore(straight.step, straight.time, straight.dt, lambda group: reader(arrays[group]))
        assert again.accounts.exchanged == straight.accounts.exchanged > 1e-3
        assert (again.guard.weight, again.guard.beyond) == (2.0, 1)
        assert until_it_stops(straight) == until_it_stops(again)


def test_a_run_that_ends_with_too_much_says_so(tmp_path, capfd):
    """Three steps must have too much for a stop; the last one or two are told of."""
    with prepared(spinning(), comm=COMM) as sim:
        n, _ = until_it_stops(sim)
    with only_options([]):
        for steps, told in ((n, True), (3, False)):
            assert run_scene(spinning(), tmp_path / str(steps), steps, [], None, overwrite=False) == 0
            assert ("warning: in the last step energy has come out of nothing" in capfd.readouterr().out) == told


def test_a_splitting_scheme_is_told_what_to_try():
    with prepared(loaded(JOBS / "column.toml"), *SPLIT) as sim:
        n, why = until_it_stops(sim)
    assert n == 2 and "out of nothing" in why and "Time splitting is unstable here" in why
    assert "Start again with -options_file monolithic.opts" in why


def test_a_run_that_nothing_watches_ends_otherwise():
    scene = loaded(JOBS / "column.toml", "fluid.cells=[8, 16]", "time.energy_limit=-1")
    with prepared(scene, *SPLIT) as sim:
        n, why = until_it_stops(sim)
    assert n > 5 and "out of nothing" not in why


def test_without_accounts_energy_is_not_judged_and_that_is_told():
    scene = loaded(JOBS / "column.toml", "fluid.cells=[8, 16]", "output.accounts=false")
    assert "time.energy_limit: output.accounts is false" in skipped(scene)
    with prepared(scene, *SPLIT) as sim:
        assert sim.guard.notes == []  # nobody asked for more
        n, why = until_it_stops(sim)
    assert n < 5 and why.startswith("time splitting is unstable here")


@pytest.mark.parametrize(("limit", "told"), [("0.5", 1), ("-1", 0)])
def test_the_log_says_that_a_limit_which_a_scene_sets_judges_nothing_without_accounts(tmp_path, limit, told):
    scene = loaded(JOBS / "column.toml", "fluid.cells=[8, 16]", "output.accounts=false", f"time.energy_limit={limit}")
    with only_options([]):
        assert run_scene(scene, tmp_path / "out", 1, [], None, overwrite=False) == 0
    log = (tmp_path / "out" / "log.txt").read_text()
    assert log.count("time.energy_limit: output.accounts is false") == told


@pytest.mark.parametrize("gravity", [-9.81, "-9.81", "-9.81*heaviside(0.035-t)"])
def test_water_that_rests_around_a_body_alarms_nobody(gravity):
    """Round-off moves it, and there is nothing else to compare that with."""
    solid = {"shape": {"ball": {"centre": [0.5, 0.5], "radius": 0.2, "cells": 8}}, "density": 1000.0, "young": 1e6}
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16]}
    time = {"end": 1.0, "dt": 0.01, "integrator": "midpoint"}
    solids = {"disk": solid | {"poisson": 0.3}}
    scene = scene_from_dict({"dim": 2, "gravity": [0.0, gravity], "time": time, "fluid": fluid, "solids": solids})
    with prepared(scene) as sim:
        assert until_it_stops(sim, 10) == (10, "")
        assert sim.guard.beyond == 0


def test_a_wall_that_leaves_a_plane_of_the_grid_makes_no_energy():
    """It grazes a cell that its corner stood on: what flows through that cell is no motion of the wall."""
    shape = {"box": {"origin": [1.0, 0.0], "size": [0.15, 0.5], "cells": [2, 6]}}
    plate = {"shape": shape, "density": 1200.0, "young": 1e5, "poisson": 0.3}
    plate["supports"] = [{"where": "bottom", "fix": ["x", "y"]}]
    plate["loads"] = [{"where": "left", "traction": ["300*sin(9*t)", 0.0]}]
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [2.0, 1.0], "cells": [24, 12], "sides": {"top": "open"}}
    time = {"end": 1.0, "dt": 0.02, "integrator": "midpoint"}
    with prepared(scene_from_dict({"dim": 2, "time": time, "fluid": fluid, "solids": {"plate": plate}})) as sim:
        for _ in range(8):
            sim.advance()
        values = sim.accounts.values
    assert values["load_work"] > 0.1 and abs(values["energy_residual"]) < 0.01 * values["load_work"]


def box_of_water(**fluid):
    return {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [8, 8]} | fluid


HYDROSTATIC = dict.fromkeys(("left", "right", "bottom", "top"), "hydrostatic")


@pytest.mark.parametrize(
    ("gravity", "sides"),
    [
        (["9*sin(2*t)", "-4*cos(3*t)"], HYDROSTATIC),
        (["0", "-9.81"], {}),
        (None, {"left": {"pressure": 1e5}, "right": {"pressure": 1e5}, "top": {"pressure": 1e5}}),
    ],
)
def test_water_at_rest_alarms_nobody_whatever_holds_it(gravity, sides):
    """It is moved by round-off, and so is what it is given."""
    time = {"end": 1.0, "dt": 0.05, "integrator": "midpoint"}
    scene = {"dim": 2, "gravity": gravity, "time": time, "fluid": box_of_water(sides=sides)}
    with prepared(scene_from_dict(scene)) as sim:
        for _ in range(20):
            sim.advance()
            assert sim.guard.beyond == 0
        assert sim.accounts.values["kinetic"] < 1e-12


@pytest.mark.parametrize("course", ["sin(8*t)", "heaviside(t-0.02)", "min(t/0.02,1)"])
def test_particles_may_begin_without_gravity(course):
    water = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [0.3, 0.2], "spacing": 0.025}
    water |= {"sound_speed": 20.0, "pressure": "none", "fill": [{"box": {"origin": [0.0, 0.0], "size": [0.3, 0.1]}}]}
    scene = {"dim": 2, "gravity": [f"3*{course}", "0"], "time": {"end": 0.1, "dt": "auto"}, "fluid": water}
    with prepared(scene_from_dict(scene)) as sim:
        while sim.time < 0.04:
            sim.advance()
            assert sim.guard.beyond < 2  # of what begins in a step it may be that one
        assert sim.accounts.values["kinetic"] > 1e-3


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_gravity_may_jump(integrator):
    """The energy after a jump within a step is half or twice its work, all of it of that step: no more comes later."""
    solid = {"shape": {"box": {"origin": [0.0, 0.0], "size": [1.0, 0.5], "cells": [2, 1]}}, "density": 1000.0}
    time = {"end": 0.3, "dt": 0.01, "integrator": integrator}
    for gravity in ("-9.81*heaviside(t-0.1)", "-9.81*heaviside(t-0.095)*heaviside(0.105-t)"):
        solids = {"block": solid | {"young": 1e6, "poisson": 0.0}}
        with prepared(scene_from_dict({"dim": 2, "gravity": [0.0, gravity], "time": time, "solids": solids})) as sim:
            for _ in range(25):
                sim.advance()
                assert sim.guard.beyond == 0
            assert sim.accounts.values["kinetic"] > 0.5


def test_a_residual_that_pays_for_what_left_is_no_energy():
    """Water is sucked out through a hole: it streams as before, and first order in the mesh adds up."""
    hole = {"inflow": {"speed": -1.0, "region": {"box": {"origin": [-1.0, 0.3], "size": [2.0, 0.3]}}}}
    water = box_of_water(cells=[16, 16], sides={"left": hole, "right": "open", "top": "open"})
    scene = {"dim": 2, "time": {"end": 3.0, "dt": 0.04, "integrator": "midpoint"}, "fluid": water}
    with prepared(scene_from_dict(scene)) as sim:
        first = sim.accounts.values["kinetic"]
        for _ in range(40):
            sim.advance()
            assert sim.guard.beyond == 0
        values = sim.accounts.values
    assert values["kinetic"] < 1.5 * first and values["energy_residual"] > 2 * values["kinetic"]


@pytest.mark.parametrize("young", [1e5, 1e12])
def test_where_nothing_pulls_and_nothing_moves_round_off_alarms_nobody(young):
    """A body with a face in a plane of the grid, in a closed box without gravity: strains of eps are no energy."""
    shape = {"box": {"origin": [0.3, 0.3], "size": [0.4, 0.2], "cells": [4, 2]}}
    water = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [12, 12]}
    data = {
        "dim": 2, "time": {"end": 1.0, "dt": 0.05, "integrator": "midpoint"}, "fluid": water,
        "solids": {"b": {"shape": shape, "density": 1000.0, "young": young, "poisson": 0.3}},
    }  # fmt: skip
    with prepared(scene_from_dict(data), "-options_file", "monolithic.opts") as sim:
        for _ in range(4):
            sim.advance()
        assert sim.accounts.values["kinetic"] < 1e-25
