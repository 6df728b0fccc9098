"""Sweeps: from a file to runs with a result, whatever happens on the way. About 30 s."""

import csv
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from blocks import falling_block
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import environment

import petfsi
from petfsi.output.mesh_files import mesh_files
from petfsi.scene.load import load_scene
from petfsi.sweeps import launch, pool
from petfsi.sweeps.attempts import again, began, ended
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.names import LONGEST, point_text, run_name
from petfsi.sweeps.plan import plan_sweep
from petfsi.sweeps.states import look_at

ROOT = Path(__file__).parents[1]
STUB = [sys.executable, "-S", "-E", str(Path(__file__).with_name("sweep_stub.py"))]
PROBE = """
[probes.top]
of = "block"
at = [0.5, 1.0]
quantity = "displacement"
"""
SCENE = falling_block(0.2, 0.05, more=PROBE)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def sweep(place, here, monkeypatch):
    """Return a function that runs ``petfsi sweep`` in this process, with a stub in place of petfsi."""
    monkeypatch.setattr(launch, "petfsi_words", lambda: STUB)
    return lambda *words: here("sweep", *words)


def written(*names, text="", repeat=1):
    """Write a sweep of one axis with points of these names, which the stub understands."""
    points = "".join(f'{name} = {{ set = {{ title = "{name}" }} }}\n' for name in names)
    Path("s.toml").write_text(f'scene = "scene.toml"\nrepeat = {repeat}\n{text}\n[axis.how]\n{points}')
    return "s.toml"


def rows(folder="out"):
    with open(Path(folder, "runs.csv"), newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def states(folder="out"):
    return {name: row["state"] for name, row in rows(folder).items()}


def starts(folder="out"):
    path = Path(folder, "starts.txt")
    return Counter(path.read_text().splitlines()) if path.exists() else Counter()


# ---- names --------------------------------------------------------------------------------------------------

texts = st.one_of(st.text(max_size=40), st.text("ab_-r12", max_size=8))


@settings(max_examples=100)
@given(
    st.dictionaries(st.text("ab_-", min_size=1, max_size=6), st.sets(texts, min_size=1, max_size=3), max_size=3),
    st.integers(1, 3),
)
def test_names_are_unique_short_and_plain(axes, repeat):
    runs = [[]]
    for axis, points in axes.items():
        runs = [[*run, (axis, point)] for run in runs for point in sorted(points)]
    names = [run_name(run, n) for run in runs for n in range(1, repeat + 1)]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9._+-]+", name) and len(name) <= LONGEST for name in names)


def test_names_are_readable():
    assert run_name([("solver", "paper"), ("rtol", point_text(1e-6))], 2) == "solver-paper_rtol-1e-06_r2"
    assert [point_text(value) for value in (0.1 + 0.2, 16, True, [1, 2])] == [
        "0.30000000000000004",
        "16",
        "true",
        "[1, 2]",
    ]
    assert re.fullmatch(r"cells-_1_2__\w{8}", run_name([("cells", "[1, 2]")]))


# ---- the file -----------------------------------------------------------------------------------------------

WRONG = """
scene = "scene.toml"
stpes = 3
timed = true
map = {}
repeat = 0
set = { "time.edn" = 1.0, time = { end = 1.0 } }
[axis.solver]
a = { options_file = "gone.opts" }
b = { options = { fsi_ksp_tpye = "cg" } }
c = { ranks = 0, colour = 1 }
d = 3
[axis]
dt = { key = "time.dt", values = [-0.1, 0.05, 0.05] }
again = { key = "time.dt", values = { from = 1, count = 0 } }
both = { key = "a", option = "b", values = [1] }
ranks = { ranks = [1], values = [2] }
"%" = { a = {} }
young = { key = "solids.block.young", values = { from = 1e3, factor = 10, count = 2 } }
[[exclude]]
solver = "z"
[[exclude]]
colour = 1
"""
SAID = """
stpes: no such key of a sweep; did you mean 'steps'?
timed: no such key of a sweep
map: no such key of a sweep
repeat = 0: must be a whole number from 1
set.time: is a table; keys of a scene stand in quotes
axis.solver.c.ranks = 0: must be a whole number
axis.solver.c.colour: no such word of a point
axis.solver.d: must be a table
axis.dt.values: 0.05 stands there more than once
axis.again.values: must have factor or step
axis.again.values.count: must be a whole number
axis.both: must have one of key, option and ranks, and has key and option
axis.ranks.values: the values of ranks stand there
axis.%: an axis's name has
exclude.0.solver = z: the axis has no such point
exclude.1.colour: there is no such axis
time.edn = 1.0: no setting 'edn'
"""


def test_every_mistake_is_in_one_list_and_nothing_is_written(place, here):
    Path("s.toml").write_text(WRONG)
    with pytest.raises(petfsi.errors.InputError) as caught:
        plan_sweep(Path("s.toml"))
    told = str(caught.value)
    assert not [line for line in SAID.strip().splitlines() if line not in told]
    done = here("sweep", "s.toml", "--out", "out")
    assert done.returncode == 2 and "s.toml: " in done.stderr and sorted(os.listdir()) == ["s.toml", "scene.toml"]
    # what scenes and options say is looked at once there are combinations
    Path("s.toml").write_text(
        'scene = "scene.toml"\n[axis.solver]\na = { options_file = "gone.opts" }\n'
        'b = { options = { fsi_ksp_rtol = "x" } }\n[axis]\ndt = { key = "time.dt", values = [-0.1, 0.05] }\n'
        'young = { key = "solids.block.yuong", values = [1.0] }'
    )
    done = here("sweep", "s.toml", "--out", "out")
    for said in ("gone.opts: no such file", "-fsi_ksp_rtol x", "time.dt = -0.1: must be greater", "yuong"):
        assert said in done.stderr
    assert done.returncode == 2 and sorted(os.listdir()) == ["s.toml", "scene.toml"]


def test_a_plan_multiplies_axes_and_leaves_out_what_is_excluded(place):
    Path("own.opts").write_text("-options_file split.opts\n-fsi_fieldsplit_pressure_ksp_rtol 1e-5\n")
    Path("s.toml").write_text(
        'scene = "scene.toml"\nset = { "time.end" = 0.1 }\nsteps = 2\nrepeat = 2\n'
        'axis.solver = { own = { options_file = "own.opts" }, split = { options_file = "split.opts" } }\n'
        'axis.dt = { key = "time.dt", values = { from = 0.02, factor = 0.5, count = 2 } }\naxis.ranks.ranks = [1, 2]\n'
        'exclude = [{ solver = "own", dt = [0.01], ranks = 2 }]'
    )
    plan = plan_sweep(Path("s.toml"))
    assert len(plan.runs) == 2 * 7 and len({run.hash for run in plan.runs}) == 14
    run = plan.runs[1]
    assert run.name == "solver-own_dt-0.02_ranks-2" and run.ranks == 2 and plan.runs[-1].name.endswith("_r2")
    assert run.says["time.end"] == "0.1" and run.says["time.dt"] == "0.02" and run.says["-options_file"] == "own.opts"
    assert plan.files[run.options[1]] == b"-options_file split.opts\n-fsi_fieldsplit_pressure_ksp_rtol 1e-5\n"
    assert plan_sweep(Path("s.toml")).runs == plan.runs


def test_a_folder_needs_nothing_outside_itself(place):
    Path("far").mkdir()
    Path("far/block.node").write_text("points")
    Path("far/block.ele").write_text("cells")
    body = 'shape = { mesh = "far/block.node" }'
    Path("scene.toml").write_text(re.sub("shape = .*", body, SCENE))
    written("a", repeat=2)
    SweepFolder(Path("out")).make(plan_sweep(Path("s.toml")))
    for path in ("far/block.node", "far/block.ele", "scene.toml", "s.toml"):
        Path(path).unlink()
    os.rename("out", "moved")
    first, second = SweepFolder.open(Path("moved")).planned()
    assert first.scene == second.scene and first.says["solids.block.shape.mesh"].startswith('"meshes/')
    found = mesh_files(load_scene(Path("moved", first.scene)))
    assert [(one.source.name, one.source.read_text()) for one in found] == [
        ("block.node", "points"),
        ("block.ele", "cells"),
    ]


def test_words_of_a_start(place):
    written("a", text="steps = 7")
    folder, run = SweepFolder(Path("out")), plan_sweep(Path("s.toml")).runs[0]
    folder.make(plan_sweep(Path("s.toml")))
    directory = os.path.abspath("out/runs/how-a")
    begin = ["run", os.path.abspath(f"out/{run.scene}"), "--out", directory]
    assert launch.run_words(folder, run, -1) == [*begin, "--steps", "7"]
    Path(directory, ".petfsi-run").touch()
    assert launch.run_words(folder, run, -1) == [*begin, "--overwrite", "--steps", "7"]
    assert launch.run_words(folder, run, 3) == ["resume", directory, "--steps", "4"]
    assert launch.launcher(1) == [] and launch.launcher(3) == [
        "mpirun",
        "--bind-to",
        "none",
        "--oversubscribe",
        "-n",
        "3",
    ]
    env = {"OMPI_COMM_WORLD_RANK": "0", "PMIX_RANK": "0", "OMPI_MCA_btl": "self", "PETSC_OPTIONS": "-x", "HOME": "/"}
    kept = {"OMPI_MCA_btl": "self", "HOME": "/", "OMP_NUM_THREADS": "1", "OMPI_MCA_odls_base_sigkill_timeout": "1"}
    assert launch.environment(env) == kept


# ---- states -------------------------------------------------------------------------------------------------


@pytest.fixture
def made(place):
    written("a", text="steps = 4")
    plan = plan_sweep(Path("s.toml"))
    folder = SweepFolder(Path("out"))
    folder.make(plan)
    return folder.run("how-a"), plan.runs[0]


def told(path, status, steps=1, kind="", code=None, starts=1):
    for _ in range(starts):
        began(path, "run", -1, 0)
    if code is not None:
        ended(path, code, 1.0, 0, False, 0)
    if status:
        failure = {"kind": kind} if kind else None
        text = json.dumps({"status": status, "steps": steps, "reason": "why", "failure": failure})
        (path / "summary.json").write_text(text)


@pytest.mark.parametrize(
    "state, status",
    {
        ("new", ""): {"starts": 0},
        ("done", "done"): {"code": 0},
        ("done", "stopped"): {"steps": 4, "code": 0},
        ("stopped", "stopped"): {"code": 75},
        ("failed", "failed"): {"kind": "energy", "code": 3},
        ("broken", "failed"): {"kind": "disk", "code": 3},
        ("broken", "running"): {"code": -9},
        ("broken", ""): {},
        ("broken", "damaged"): {},
        ("lost", "running"): {"starts": 3, "code": -9},
        ("refused", ""): {"code": 2},
        ("failed", ""): {"code": 3},
    }.items(),
    ids=str,
)
def test_a_state_is_what_the_directory_tells(made, state, status):
    path, run = made
    told(path, state[1], **status)
    assert look_at(path, run).state == state[0]


def test_a_claim_is_running_and_three_attempts_count_from_the_last_retry(made):
    path, run = made
    told(path, "running", starts=3)
    with open(path / ".claim", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert look_at(path, run).state == "running"
    assert look_at(path, run).state == "lost"
    again(path, "lost")
    began(path, "run", -1, 0)
    assert look_at(path, run).state == "broken"
    (path / "checkpoint").mkdir()
    (path / "checkpoint" / "000002.json").touch()
    for _ in range(2):
        began(path, "resume", 1, 0)
    assert look_at(path, run).state == "broken"  # it got further


def test_a_lock_of_another_machine_is_left_alone_and_takes_no_core(sweep):
    sweep(written("fine", "other"), "--out", "out", "--only", "how=fine")
    path = Path("out/runs/how-other")
    holder = {"host": "elsewhere", "boot": "1", "pid": 7, "started": 1, "user": "me", "since": "now"}
    (path / ".lock").write_text(json.dumps(holder))
    done = sweep("out", "--status")
    assert "how-other: running: another process is at work in it: process 7 of me on elsewhere" in done.stdout
    with driver("out", "--jobs", 1) as process:
        wait_for(lambda: "process 7 of me on elsewhere" in process.stdout.readline())
        assert not starts()["how-other run"]
        (path / ".lock").unlink()
        process.communicate(timeout=30)
    assert process.returncode == 0 and starts()["how-other run"] == 1


# ---- to the end ---------------------------------------------------------------------------------------------


def test_all_get_a_result_or_a_reason_and_nothing_is_run_twice(sweep):
    done = sweep(written("fine", "fails", "killed", "dies", "refused"), "--out", "out")
    assert done.returncode == 1, done.stderr
    want = {"fine": "done", "fails": "failed", "killed": "done", "dies": "lost", "refused": "refused"}
    assert states() == {f"how-{name}": state for name, state in want.items()}
    assert rows()["how-refused"]["reason"].endswith("time.dt: no") and rows()["how-fine"]["last.top"] == "0.5"
    assert starts() == {
        "how-fine run": 1,
        "how-fails run": 1,
        "how-killed run": 1,
        "how-killed resume": 1,
        "how-dies run": 3,
        "how-refused run": 1,
    }
    before = starts()
    for target in (["out"], ["s.toml", "--out", "out"]):
        assert sweep(*target).returncode == 1 and starts() == before
    assert "3 of 5 runs: 2 done, 1 failed" in sweep("out", "--status", "--only", "how=fine,how=fails,how=killed").stdout
    os.rename("out", "moved")
    assert sweep("moved", "--collect").returncode == 0 and len(states("moved")) == 5


def test_what_is_asked_for_again_is_run_again(sweep):
    sweep(written("fine", "fails", "dies", "refused"), "--out", "out")
    before = starts()
    assert sweep("out", "--retry", "failed", "--only", "how=fails").returncode == 0
    assert starts() - before == {"how-fails run": 1} and Path("out/replaced/how-fails.1/summary.json").is_file()
    assert sweep("out", "--retry", "refused").returncode == 1 and starts()["how-refused run"] == 2
    assert sweep("out", "--retry", "lost").returncode == 1 and starts()["how-dies run"] == 6
    # another end is another run
    written("fine", "new", text='set = { "time.end" = 0.3 }')
    done = sweep("s.toml", "--out", "out")
    assert done.returncode == 2 and "how-fine: time.end was 0.2, is 0.3" in done.stderr
    done = sweep("s.toml", "--out", "out", "--retry", "changed")
    assert done.returncode == 0 and "3 in out/runs not in the plan" in done.stdout
    assert starts()["how-fine run"] == 2 and states() == {"how-fine": "done", "how-new": "done"}
    assert json.loads(Path("out/runs/how-fine/run.json").read_text())["says"]["time.end"] == "0.3"


def test_points_can_be_chosen_and_a_dry_run_writes_nothing(sweep):
    file = written("a", "b", "c", repeat=2)
    done = sweep(file, "--out", "out", "--dry-run")
    assert done.returncode == 0 and "6 new; nothing was written" in done.stdout and not Path("out").exists()
    assert sweep(file, "--out", "out", "--only", "how=b").returncode == 0
    assert starts() == {"how-b run": 1, "how-b_r2 run": 1} and Counter(states().values()) == {"done": 2, "new": 4}
    for only, said in (("who=b", "axes are how"), ("how=z", "no such point; how has a, b, c"), ("how", "axis=point")):
        done = sweep("out", "--only", only)
        assert done.returncode == 2 and said in done.stderr
    assert sweep("out").returncode == 0 and set(states().values()) == {"done"}


def test_a_full_disk_stops_all_with_one_message_and_the_sweep_goes_on(sweep, monkeypatch):
    done = sweep(written("slow1", "full", "later1", "later2", "later3"), "--out", "out", "--jobs", "2")
    assert done.returncode == 75 and done.stdout.count("are free on the disk") == 1
    assert states()["how-full"] == "broken" and states()["how-slow1"] == "stopped" and "new" in states().values()
    Path("out/room").touch()
    with monkeypatch.context() as patch:
        patch.setattr(pool, "LEAST_ROOM", 1 << 60)
        assert sweep("out").returncode == 75 and starts()["how-full resume"] == 0
    assert sweep("out").returncode == 0 and starts()["how-full resume"] == 1 and set(states().values()) == {"done"}


# ---- drivers ------------------------------------------------------------------------------------------------

DRIVER = """
import sys
from petfsi.sweeps import launch
launch.petfsi_words = lambda: {stub!r}
from petfsi import cli
sys.exit(cli.main(sys.argv[1:]))
"""


def driver(*words):
    code = DRIVER.format(stub=STUB)
    line = [sys.executable, "-c", code, "sweep", *map(str, words)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment())


def wait_for(condition):
    limit = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.01)


def checkpoints(name):
    return len(list(Path("out/runs", name, "checkpoint").glob("*.json")))


SLOW = ("slow1", "slow2", "slow3")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_runs_after_their_steps_and_the_next_call_goes_on(place, sweep, number):
    with driver(written(*SLOW), "--out", "out", "--jobs", 2) as process:
        wait_for(lambda: checkpoints("how-slow1") and checkpoints("how-slow2"))
        process.send_signal(number)
        said = process.communicate(timeout=30)[0]
    assert process.returncode == 75 and f"stopped by {signal.Signals(number).name}; go on with: " in said
    assert states() == {"how-slow1": "stopped", "how-slow2": "stopped", "how-slow3": "new"}
    assert sweep("out").returncode == 0
    assert starts() == {
        "how-slow1 run": 1,
        "how-slow1 resume": 1,
        "how-slow2 run": 1,
        "how-slow2 resume": 1,
        "how-slow3 run": 1,
    }


def test_a_second_signal_ends_runs_at_once(place, sweep):
    with driver(written("slow1"), "--out", "out") as process:
        wait_for(lambda: checkpoints("how-slow1"))
        pid = int(subprocess.check_output(["pgrep", "-P", str(process.pid), "-f", "sweep_stub"]).split()[0])
        os.kill(pid, signal.SIGSTOP)  # a step that takes for ever
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    assert process.returncode == 75 and states() == {"how-slow1": "broken"}
    assert sweep("out").returncode == 0 and states() == {"how-slow1": "done"}


def test_a_driver_that_is_killed_leaves_runs_that_the_next_one_waits_for(place, sweep):
    with driver(written(*SLOW), "--out", "out", "--jobs", 2) as process:
        wait_for(lambda: checkpoints("how-slow1") and checkpoints("how-slow2"))
        process.kill()
    done = sweep("out", "--jobs", "2")
    assert done.returncode == 0 and "how-slow1: another process has claimed it" in done.stdout
    assert starts() == {f"how-{name} run": 1 for name in SLOW} and set(states().values()) == {"done"}


def test_two_drivers_share_the_runs(place):
    names = [f"slow{n}" for n in range(4)]
    file = written(*names)
    with driver(file, "--out", "out", "--jobs", 2) as one, driver(file, "--out", "out", "--jobs", 2) as two:
        said = [process.communicate(timeout=60)[0] for process in (one, two)]
    assert (one.returncode, two.returncode) == (0, 0), said
    assert starts() == {f"how-{name} run": 1 for name in names} and set(states().values()) == {"done"}


# ---- with petfsi itself -------------------------------------------------------------------------------------

REAL = """
scene = "scene.toml"
[axis.case]
short = { set = { "time.end" = 0.1 } }
fails = { set = { "gravity" = [0.0, "log(0.12 - t)"] } }
two = { ranks = 2 }
[axis]
dt = { key = "time.dt", values = [0.05, 0.025] }
[[exclude]]
case = "two"
dt = 0.025
"""


@pytest.mark.launches
def test_real_runs_come_to_an_end_and_can_be_read(place, here):
    Path("s.toml").write_text(REAL)
    done = here("sweep", "s.toml", "--out", "runs/solvers")
    assert done.returncode == 0, done.stdout + done.stderr
    found = rows("runs/solvers")
    assert [row["state"] for row in found.values()] == ["done", "done", "failed", "failed", "done"]
    fails, two = found["case-fails_dt-0.05"], found["case-two_dt-0.05"]
    assert fails["kind"] == "scene" and fails["steps"] == "2" and "it must be finite" in fails["reason"]
    assert two["ranks"] == "2" and float(two["wall_s"]) > 0 and float(two["peak_mb"]) > 50 and two["version.petsc"]
    told = json.loads(Path("runs/solvers/runs/case-two_dt-0.05/summary.json").read_text())
    assert told["ranks"] == 2 and told["status"] == "done"
    again = here("sweep", "runs/solvers")
    assert again.returncode == 0 and "[" not in again.stdout
    # as README says it
    example = re.search(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)[1]
    names = {}
    exec(example, names)
    assert len(names["run"].history["time"]) == 3 and np.isfinite(names["run"].history["top.y"]).all()
    assert names["run"].scene.time.end == 0.1 and names["run"].summary["status"] == "done"
    with pytest.raises(petfsi.errors.InputError, match="not the folder of a sweep"):
        petfsi.open_sweep("runs")


def test_the_shipped_sweep_is_sound(place, here):
    done = here("sweep", ROOT / "jobs" / "sweeps" / "solvers.toml", "--dry-run")
    assert done.returncode == 0 and "7 runs in runs/solvers: 7 new" in done.stdout, done.stderr
