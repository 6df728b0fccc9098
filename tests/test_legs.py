"""A run that goes on with other settings, or begins with another one's state, is the run that had them from there.

Commands in this process, on blocks of a few elements. About 15 s.
"""

import contextlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import environment, launcher
from step_cases import block, prepared, stored

from petfsi.output import files
from petfsi.output.history import read_history
from petfsi.output.manifest import read_manifest
from petfsi.scene.changes import RESUMABLE

BLOCK = """
dim = 2
gravity = [0.0, -1.0]
[time]
end = 1.0
dt = 0.1
integrator = "bdf2"
[solids.b]
shape = { box = { origin = [0.0, 0.0], size = [1.0, 1.0], cells = [2, 2] } }
density = 1.3
young = 50.0
poisson = 0.3
material = "neohookean"
supports = [{ where = "left", fix = ["x", "y"] }]
body_force = [0.1, 0.0]
loads = [{ where = "right", traction = [1.0, 0.5] }]
[probes.tip]
of = "b"
at = [1.0, 0.5]
quantity = "displacement"
[checkpoint]
every = 0.5
"""
WATER = """
[fluid]
density = 1.0
origin = [-0.5, -1.0]
size = [2.5, 3.0]
cells = [10, 12]
[fluid.sides]
top = "open"
"""
DAM = """
dim = 2
gravity = [0.0, -9.81]
[time]
end = 1.0
dt = "auto"
[fluid]
kind = "sph"
density = 1000.0
origin = [0.0, 0.0]
size = [0.6, 0.6]
spacing = 0.04
sound_speed = 25.0
fill = [{ box = { origin = [0.0, 0.0], size = [0.2, 0.3] } }]
[fluid.sides]
top = "open"
[probes.front]
of = "fluid"
quantity = "front"
"""
#: What changes after step 5, at t = 0.5, and the setting of a scene in which that is so from the start.
CHANGED = {
    "dt": ("time.dt=0.05", 'time.dt="where(t < 0.45, 0.1, 0.05)"'),
    "dt as an expression": ('time.dt="0.02*(1 + t)"', 'time.dt="where(t < 0.45, 0.1, 0.02*(1 + t))"'),
    "gravity": ("gravity=[0.5, -2.0]", 'gravity=["where(t < 0.55, 0, 0.5)", "where(t < 0.55, -1, -2)"]'),
    "body_force": ("solids.b.body_force=[0.4, 0.2]", 'solids.b.body_force=["where(t < 0.55, 0.1, 0.4)", '
                   '"where(t < 0.55, 0, 0.2)"]'),
    "load": ("solids.b.loads.0.traction=[3, -1]", 'solids.b.loads.0.traction=["where(t < 0.55, 1, 3)", '
             '"where(t < 0.55, 0.5, -1)"]'),
    "no load": ("solids.b.loads=[]", 'solids.b.loads.0.traction=["where(t < 0.55, 1, 0)", "where(t < 0.55, 0.5, 0)"]'),
}  # fmt: skip
#: What differs by round-off: the time, and what is made of it.
LOOSE = {"time", "dt"}


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(BLOCK)
    return "scene.toml"


@pytest.fixture
def command(here):
    """Return a function that runs a command that must succeed, and gives what it said."""

    def run(*words, code=0):
        done = here(*words)
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr and "defect" not in done.stderr
        return done.stdout + done.stderr

    return run


def same(one, other, loose=LOOSE, rtol=1e-13):
    """See that two histories have the same rows: bit for bit, but for some columns."""
    one, other = (read_history(Path(directory) / "history.csv") for directory in (one, other))
    assert one.keys() == other.keys()
    for name in one:
        if name in loose:
            np.testing.assert_allclose(one[name], other[name], rtol=rtol, atol=1e-15, err_msg=name)
        else:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
    return one


def newest(directory):
    """Return the newest manifest of a run."""
    return read_manifest(sorted(Path(directory, "checkpoint").glob("*.json"))[-1].read_bytes())


# ---- resume --set ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("water", [False, True], ids=["solid", "solid in a fluid"])
@pytest.mark.parametrize("name", CHANGED)
def test_another_setting_is_that_of_a_run_that_had_it_from_there(scene, command, name, water):
    here, there = CHANGED[name]
    if water:
        Path(scene).write_text(BLOCK + WATER)
    command("run", scene, "--out", "whole", "--set", there)
    command("run", scene, "--out", "parts", "--steps", 5)
    command("resume", "parts", "--set", here)
    known = same("whole", "parts", LOOSE | ({"load_work"} if name == "no load" else set()))
    assert known["time"][-1] == pytest.approx(1.0) and len(known["time"]) >= 11


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_another_damping_is_that_of_a_simulation_that_had_it_from_there(scene, command, integrator):
    command("run", scene, "--out", "parts", "--steps", 5, "--set", f"time.integrator={integrator}")
    command("resume", "parts", "--set", "solids.b.damping.mass=2", "--set", "solids.b.damping.stiffness=0.05")
    rows = read_history(Path("parts/history.csv"))
    load = [{"where": "right", "traction": [1.0, 0.5]}]
    with prepared(
        block(
            (2, 2), time={"integrator": integrator}, gravity=[0.0, -1.0], young=50.0, body_force=[0.1, 0.0], loads=load
        )
    ) as sim:
        for step in range(1, 11):
            if step == 6:
                sim.forget()
                bodies = sim.solid._elements.bodies
                bodies.mass_damping[:], bodies.stiffness_damping[:] = 2.0, 0.05
                sim.solid._equation.damps = True
            sim.advance()
            tip = sim.solid.probe("block", [1.0, 0.5], "displacement")
            assert tip.tolist() == [rows["tip.x"][step], rows["tip.y"][step]], step
            assert sim.accounts.values["kinetic"] == rows["kinetic"][step]


def test_another_solver_finds_the_same(scene, command):
    Path(scene).write_text(BLOCK + WATER)
    command("run", scene, "--out", "whole", "-options_file", "monolithic-direct.opts")
    command("run", scene, "--out", "parts", "--steps", 5, "-fsi_ksp_rtol", "1e-13")
    said = command("resume", "parts", "--steps", 2, "-options_file", "monolithic-direct.opts")
    assert "changed after step 5, t = 0.5 s: -fsi_pc_type: " in said
    command("resume", "parts")  # remembers it
    one, other = (read_history(Path(run, "history.csv")) for run in ("whole", "parts"))
    np.testing.assert_allclose(one["tip.y"], other["tip.y"], rtol=1e-9)
    assert (other["iterations"][1:6] > 2).all() and (other["iterations"][6:] <= 2).all()
    assert newest("parts").run.settings["-fsi_pc_type"] == "lu"


def test_newtons_method_may_come_and_go(scene, command):
    command("run", scene, "--out", "parts", "--steps", 4)
    said = command("resume", "parts", "--steps", 3, "-fsi_snes_type", "newtonls")
    assert "history.csv keeps its columns: newton will not be in it" in said
    said = command("resume", "parts", "-fsi_snes_type", "ksponly")
    assert "-fsi_snes_type: newtonls -> ksponly" in said
    command("run", scene, "--out", "newton", "--steps", 4, "-fsi_snes_type", "newtonls")
    command("resume", "newton", "-fsi_snes_type", "ksponly")
    assert (read_history(Path("newton/history.csv"))["newton"][5:] <= 1).all()
    assert len(read_history(Path("parts/history.csv"))["time"]) == 11


def test_changes_are_remembered_kept_and_told(scene, command):
    command("run", scene, "--out", "run", "--steps", 3)
    said = command("resume", "run", "--steps", 2, "--set", "time.dt=0.05", "--set", "solids.b.damping.mass=1")
    assert "changed after step 3, t = 0.3 s: time.dt: 0.1 -> 0.05" in said
    command("resume", "run", "--steps", 1)
    command("resume", "run", "--steps", 1, "--set", "time.end=0.6", "-fsi_ksp_rtol", "1e-11")
    changes = [(leg.step, *((c.key, c.old, c.new) for c in leg.changes)) for leg in newest("run").run.legs]
    assert changes == [
        (0,),
        (3, ("time.dt", "0.1", "0.05"), ("solids.b.damping.mass", "0.0", "1.0")),
        (5,),
        (6, ("time.end", "1.0", "0.6"), *changes[3][2:]),
    ]
    assert changes[3][2][0] == "-fsi_ksp_rtol" and changes[3][2][2] == "1e-11"
    log = Path("run/log.txt").read_text()
    assert log.count("changed after step") == 4 and "t = 0.45 s: -fsi_ksp_rtol: " in log
    np.testing.assert_allclose(read_history(Path("run/history.csv"))["time"][3:], [0.3, 0.35, 0.4, 0.45, 0.5])


class Killed(BaseException):
    """What ends a process at any moment."""


@pytest.mark.parametrize("moment", range(4))
def test_a_kill_while_settings_change_leaves_a_run_that_goes_on(scene, command, here, monkeypatch, moment):
    command("run", scene, "--out", "run", "--steps", 3)
    command("run", scene, "--out", "whole", "--steps", 3)
    command("resume", "whole", "--set", "time.dt=0.05", "-fsi_ksp_rtol", "1e-11")
    replace, count = files.replace_text, []

    def killed(path, text):
        count.append(path)
        if len(count) == moment + 1:
            raise Killed
        return replace(path, text)

    with monkeypatch.context() as patch:
        patch.setattr(files, "replace_text", killed)
        with contextlib.suppress(Killed):
            here("resume", "run", "--set", "time.dt=0.05", "-fsi_ksp_rtol", "1e-11")
    assert len(count) > moment
    copied = shutil.copytree("run", "again")
    command("resume", copied)  # whatever it has of the change
    command("resume", "run", "--set", "time.dt=0.05", "-fsi_ksp_rtol", "1e-11")
    same("run", "whole", loose=())
    legs = newest("run").run.legs
    assert [{c.key for c in leg.changes} for leg in legs if leg.changes] == [{"time.dt", "-fsi_ksp_rtol"}]
    assert Path("run/scene.toml").read_bytes() == Path("whole/scene.toml").read_bytes()


@pytest.mark.parametrize("key", ["time.integrator", "solids.b.young", "solids.b.shape.box.cells", "probes.tip.at",
                                 "output.accounts", "solids.b", "time", "dim", "solids.b.supports"])  # fmt: skip
def test_what_the_state_hangs_on_is_refused_by_name(scene, command, here, key):
    command("run", scene, "--out", "run", "--steps", 1)
    before = {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}
    said = command("resume", "run", "--set", f"{key}=1", code=2)
    assert f"--set {key}=1: a run that goes on may change {', '.join(RESUMABLE)} and PETSc options" in said
    assert before == {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "setting, said",
    [
        ("time.end=0.15", "--set time.end=0.15: the run has reached t = 0.2 s already"),
        ("time.dt=-1", "time.dt = -1"),
        ('time.dt="0.1 - t"', "time.dt = '0.1 - t': is -0.1 at t = 0.2"),
        ('time.dt="auto"', "time.dt"),
        ("solids.c.loads=[]", "solids.c"),
        ("solids.b.loads.1.traction=[1, 1]", "its items are numbered 0 to 0"),
    ],
)
def test_what_is_wrong_is_refused_and_changes_nothing(scene, command, setting, said):
    command("run", scene, "--out", "run", "--steps", 2)
    before = {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}
    assert said in command("resume", "run", "--set", setting, code=2)
    assert before == {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}


def test_steps_of_an_explicit_scheme_may_become_free(scene, command):
    sets = ["--set", "time.integrator=symplectic-euler", "--set", "time.dt=0.01", "--set", "time.end=0.2"]
    command("run", scene, "--out", "run", "--steps", 3, *sets)
    said = command("resume", "run", "--set", "time.dt=10", code=2)
    assert "time.dt = 10 must not exceed time.end" in said or "must not exceed" in said
    assert "the stable step of symplectic-euler is" in command("resume", "run", "--set", "time.dt=0.2", code=2)
    command("resume", "run", "--steps", 2, "--set", "time.dt=auto")
    command("resume", "run", "--set", "time.dt=0.02", "--set", "time.above_limit=subcycle", "--set", "time.end=0.5")
    dt = np.diff(read_history(Path("run/history.csv"))["time"])
    assert np.allclose(dt[:3], 0.01) and 0.01 < dt[3] == pytest.approx(dt[4], rel=0.1) and np.allclose(dt[5:-2], 0.02)
    assert dt[-1] == pytest.approx(dt[-2]) and 0.01 < dt[-1] < 0.02 and sum(dt) == pytest.approx(0.5, rel=1e-14)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_second_order_over_a_change_of_the_step(integrator):
    """Half the way with a step, then with one of 0.4 times or 2.5 times its length."""

    def end(dt, factor):
        scenes = [
            block((1, 1), time={"integrator": integrator, "dt": h, "end": 2.0}, young=30.0, material="linear",
                  initial={"velocity": ["0.5*x", "1.5*x"]}, damping={"mass": 0.1})
            for h in (dt, factor * dt)
        ]  # fmt: skip
        with prepared(scenes[0]) as first, prepared(scenes[1]) as second:
            while first.time < 0.5 - 1e-9:
                first.advance()
            arrays = stored(first)
            second.restore(first.step, first.time, first.dt, lambda group: lambda name, *_: arrays[group][name])
            while second.time < 1.0 - 1e-9:
                second.advance()
            assert second.time == pytest.approx(1.0)
            return np.append(second.solid.displacement, second.solid.velocity / 5.0)

    for factor in (0.4, 2.5):
        ends = [end(0.5 / n, factor) for n in (40, 80, 160)]
        order = np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max())
        assert order == pytest.approx(2.0, abs=0.25), factor


# ---- run --from -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("water", [False, True], ids=["solid", "solid in a fluid"])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_a_run_from_another_goes_on_as_that_does(scene, command, integrator, water):
    if water:
        Path(scene).write_text(BLOCK + WATER)
    choice = ["--set", f"time.integrator={integrator}"]
    command("run", scene, "--out", "old", "--steps", 5, *choice)
    said = command("run", scene, "--out", "new", "--from", "old", "--steps", 5, *choice)
    fields = "solid and pressure" if water else "solid"
    assert f"begins at t = 0 with the state of {fields} in old/checkpoint/000005.h5, step 5, t = 0.5 s" in said
    assert "begins anew, with" not in said
    command("resume", "old")
    old, new = (read_history(Path(run, "history.csv")) for run in ("old", "new"))
    for name in ("tip.x", "tip.y", "kinetic", "elastic"):
        np.testing.assert_array_equal(old[name][6:], new[name][1:], err_msg=name)
    for name in ("tip.x", "tip.y", "elastic") if water else ("tip.x", "tip.y", "kinetic", "elastic"):
        assert old[name][5] == new[name][0]  # a fluid moves in the cells of its last step, or of its next
    np.testing.assert_allclose(new["time"], 0.1 * np.arange(6))
    assert new["energy_residual"][0] == new["load_work"][0] == 0.0
    mark = newest("new").run.legs[0].origin
    assert mark.file.endswith("old/checkpoint/000005.h5") and (mark.step, mark.time) == (5, 0.5)


def test_particles_go_on_and_begin_anew(scene, command):
    Path(scene).write_text(DAM)
    command("run", scene, "--out", "old", "--steps", 8)
    command("run", scene, "--out", "new", "--from", "old", "--steps", 4)
    said = command("run", scene, "--out", "other", "--from", "old", "--set", "fluid.spacing=0.02", code=2)
    assert "the state of particles there is of another layout:\n  fluid.spacing = 0.02, and was 0.04" in said
    shutil.copytree("old", "heavy")
    command("resume", "old", "--steps", 4)
    old, new = (read_history(Path(run, "history.csv")) for run in ("old", "new"))
    for name in ("front", "kinetic", "dt"):
        np.testing.assert_allclose(old[name][9:], new[name][1:], rtol=1e-13, err_msg=name)
    command("resume", "heavy", "--steps", 4, "--set", "gravity=[2.0, -9.81]", "--set", "time.dt=0.0005")
    heavy = read_history(Path("heavy/history.csv"))
    np.testing.assert_allclose(np.diff(heavy["time"])[8:], 0.0005)
    assert heavy["momentum.x"][-1] > old["momentum.x"][-1]


def test_gravity_that_gives_particles_their_sound_stays(scene, command):
    Path(scene).write_text(DAM.replace("sound_speed = 25.0", ""))
    command("run", scene, "--out", "old", "--steps", 1)
    assert "sound_speed" in command("resume", "old", "--set", "gravity=[0, -5]", code=2)
    said = command("run", scene, "--from", "old", "--out", "new", "--set", "gravity=[0, -5]", code=2)
    assert "gravity = [0.0, -5.0], and was [0.0, -9.81]" in said


def test_a_body_at_rest_under_its_load_is_put_into_water(scene, command):
    command("run", scene, "--out", "dry", "--set", "time.integrator=static", "--steps", 1)
    Path(scene).write_text(BLOCK + WATER + '[solids.b.initial]\nvelocity = [0.0, "x"]\n')
    said = command("run", scene, "--out", "wet", "--from", "dry", "--steps", 3)
    assert "pressure: not in that checkpoint, begins as the scene says" in said
    assert "the integrator begins anew, with a first step of first order" in said
    assert "not used, for the state is that of the checkpoint: solids.b.initial" in said
    dry, wet = (read_history(Path(run, "history.csv")) for run in ("dry", "wet"))
    assert (wet["tip.x"][0], wet["tip.y"][0]) == (dry["tip.x"][-1], dry["tip.y"][-1]) and abs(wet["tip.y"][0]) > 1e-3
    assert wet["elastic"][0] == pytest.approx(dry["elastic"][-1], rel=1e-12) and wet["kinetic"][0] == 0.0


def test_what_a_new_run_leaves_of_the_old_one_is_told(scene, command):
    Path(scene).write_text(BLOCK + WATER)
    command("run", scene, "--out", "wet", "--steps", 2)
    Path(scene).write_text(BLOCK)
    said = command("run", scene, "--out", "dry", "--from", "wet", "--steps", 1, "--set", "time.integrator=midpoint")
    assert "not used of that checkpoint: pressure, regions, solid/displacement_before, solid/past_dt" in said


@pytest.mark.parametrize(
    "sets, said",
    [
        (["solids.b.shape.box.cells=[3, 2]"], "cells = [3, 2] } }, and was { box ="),
        (["solids.b.elements=quadratic"], 'solids.b.elements = "quadratic", and was "linear"'),
        (["fluid.cells=[16, 12]"], "fluid.cells = [16, 12], and was [10, 12]"),
        (["fluid.sides.left=open"], 'fluid.sides.left = "open", and was "slip"'),
        (["obstacles.o.shape.ball={centre=[1.5, 1.5], radius=0.2}"], "obstacles.o = { shape = { ball ="),
        (["time.integrator=midpoint"], 'time.integrator = "midpoint", and was "bdf2"'),
        (["fluid.smoke={}"], "has no array 'pressure/smoke'"),
    ],
)  # fmt: skip
def test_another_layout_is_refused_by_name(scene, command, sets, said):
    Path(scene).write_text(BLOCK + WATER)
    command("run", scene, "--out", "old", "--steps", 1)
    words = [word for setting in sets for word in ("--set", setting)]
    assert said in command("run", scene, "--out", "new", "--from", "old", *words, code=2)
    assert not Path("new").exists()


def test_another_place_is_refused(scene, command):
    command("run", scene, "--out", "old", "--steps", 1)
    assert "needs another directory" in command("run", scene, "--from", "old", "--out", "old", "--overwrite", code=2)
    assert "is not the directory of a run" in command("run", scene, "--from", ".", "--out", "new", code=2)
    scene_file = Path("old/scene.toml")
    scene_file.write_text(scene_file.read_text().replace("cells = [2, 2]", "cells = [2, 3]"))
    assert "is not that of its checkpoint" in command("run", scene, "--from", "old", "--out", "new", code=2)
    for path in Path("old/checkpoint").iterdir():
        path.write_bytes(b"")
    assert "no checkpoint can be read" in command("run", scene, "--from", "old", "--out", "new", code=2)


def petfsi(*words, ranks):
    line = [*launcher(ranks), str(Path(sys.executable).with_name("petfsi")), *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, env=environment())
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.launches
def test_ranks_may_be_others(scene, command):
    """What two ranks began, four take up, and one goes on with."""
    Path(scene).write_text(BLOCK + WATER.replace("[10, 12]", "[12, 24]"))
    start = ("run", scene, "--steps", 3, "-fsi_ksp_rtol", "1e-12", "--out")
    begin = ("run", scene, "--steps", 2, "-fsi_ksp_rtol", "1e-12", "--out")
    go_on = ("--steps", 2, "--set", "time.dt=0.05", "--set", "solids.b.damping.mass=1")
    petfsi(*start, "many-old", ranks=2)
    petfsi(*begin, "many", "--from", "many-old", ranks=4)
    command("resume", "many", *go_on)
    command(*start, "one-old")
    command(*begin, "one", "--from", "one-old")
    command("resume", "one", *go_on)
    many, one = (read_history(Path(run, "history.csv")) for run in ("many", "one"))
    np.testing.assert_allclose(many["time"], [0, 0.1, 0.2, 0.25, 0.3])
    for name in ("tip.x", "tip.y", "kinetic", "energy_residual"):
        np.testing.assert_allclose(many[name], one[name], rtol=1e-7, atol=1e-10, err_msg=name)
    assert json.loads(Path("many/summary.json").read_text())["ranks"] == 1
    assert re.search(r"changed after step 2, t = 0.2 s: time.dt", Path("many/log.txt").read_text())
    assert [change.key for change in newest("many").run.legs[-1].changes] == ["time.dt", "solids.b.damping.mass"]
