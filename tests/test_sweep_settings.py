"""Whether a sweep's tables tell of what was planned: runs of other settings, inputs that were edited, twins."""

import json
import os
import re
import shutil
from pathlib import Path

import meshio
import numpy as np
import pytest
from test_sweep_pool import made, place, sweep  # noqa: F401 - fixtures
from test_sweeps import SCENE, rows, starts, states, written

from petfsi.errors import InputError
from petfsi.solving import options
from petfsi.sweeps import pool
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.plan import plan_sweep
from petfsi.sweeps.states import look_at


def planned():
    """Return the directory and the plan of a run that has been run as it was planned."""
    Path("own.opts").write_text("-options_file split.opts\n-fsi_ksp_rtol 1e-5\n")
    file = Path(written("a", text="steps = 4"))
    point = 'set = { title = "a" }, options_file = "own.opts", options = { fsi_ksp_max_it = 7 }'
    file.write_text(file.read_text().replace('set = { title = "a" }', point))
    folder, plan = SweepFolder(Path("out")), plan_sweep(file)
    folder.make(plan)
    path, run = folder.run("how-a"), plan.runs[0]
    (path / "scene.toml").write_bytes(plan.files[Path(run.scene).name])
    chosen = options.resolve([run.options[0], str(folder.inputs / run.options[1]), *run.options[2:]], {})
    (path / "options.opts").write_text(chosen.dump())
    (path / "summary.json").write_text('{"status": "done", "steps": 4, "ranks": 1}')
    return path, run


@pytest.mark.parametrize(
    "name, old, new, said",
    [
        ("scene.toml", "end = 0.2", "end = 0.3", "time.end is 0.3, not 0.2"),
        ("scene.toml", "dim = 2", "dim = 2\ngravity = [0.0, -100.0]", "damaged"),
        ("scene.toml", "-1.0]", "-100.0]", "gravity is [0.0, -100.0], not [0.0, -1.0]"),
        ("scene.toml", "[solids", "[", "damaged"),
        ("scene.toml", "[time]", '[time]\nmore = "x"', 'time.more is "x", not none'),
        ("options.opts", "max_it 7", "max_it 8", "-fsi_ksp_max_it is 8, not 7"),
        ("options.opts", "rtol 1e-5", "rtol 1e-6", "-fsi_ksp_rtol is 1e-6, not 1e-5"),
        ("options.opts", "# split.opts", "# monolithic.opts", "options of monolithic.opts"),
        ("options.opts", "-fsi", "-fsi_new 1  # command line\n-fsi", "-fsi_new is 1, not none"),
        ("summary.json", '"ranks": 1', '"ranks": 3', "ranks is 3, not 1"),
        ("summary.json", '"steps": 4', '"steps": 9', "steps is 9, not 4"),
        ("summary.json", "done", "running", None),
        ("scene.toml", "# nothing", "", ""),
    ],
)
def test_a_run_of_other_settings_than_planned_is_changed_and_has_no_figures(place, name, old, new, said):  # noqa: F811
    path, run = planned()
    text = (path / name).read_text()
    assert old in text or said == ""
    (path / name).write_text(text.replace(old, new, 1))
    look = look_at(path, run)
    if said:
        assert look.state == "changed" and said in look.reason and not look.summary
    else:
        assert look.state == ("done" if said == "" else "broken")


def test_a_changed_run_counts_as_no_result_until_it_is_replaced(sweep):  # noqa: F811
    sweep(written("fine", "other"), "--out", "out")
    done = sweep("out", "--retry", "changed")
    assert done.returncode == 2 and "no run here is other than planned" in done.stderr
    other = Path("out/runs/how-other/scene.toml")
    text = Path("out", json.loads(other.with_name("run.json").read_text())["scene"]).read_text()
    other.write_text(text.replace("end = 0.2", "end = 0.3"))
    for words in (["out"], ["s.toml", "--out", "out"]):
        done = sweep(*words)
        assert done.returncode == 1 and "how-other: changed, step 5: not as planned: time.end is 0.3" in done.stdout
    row = rows()["how-other"]
    assert starts()["how-other run"] == 1 and row["steps"] == row["last.top"] == ""
    assert "how-other  changed, to be run again" in sweep("out", "--retry", "changed", "--dry-run").stdout
    assert sweep("out", "--retry", "changed").returncode == 0 and set(states().values()) == {"done"}
    assert Path("out/replaced/how-other.1/scene.toml").exists()


@pytest.mark.parametrize("name", ["scene", "own"])
def test_an_edited_input_is_refused_by_name(sweep, name):  # noqa: F811
    planned()
    path = next(Path("out/inputs").glob(f"{name}-*"))
    path.write_text(path.read_text() + "# more\n")
    for words in (["out"], ["s.toml", "--out", "out"]):
        done = sweep(*words)
        assert done.returncode == 2 and f"{path} has been changed since it was planned" in done.stderr
    path.unlink()
    assert sweep("out").returncode == 2 and sweep("s.toml", "--out", "out").returncode == 0


def test_an_edited_mesh_is_refused_by_name(sweep):  # noqa: F811
    for name in ("block.node", "block.ele"):
        Path(name).write_text(name)
    Path("scene.toml").write_text(re.sub("shape = .*", 'shape = { mesh = "block.node" }', SCENE))
    folder, plan = made("a", "b")
    folder.check_inputs(plan.runs)
    path = next(Path("out/inputs/meshes").glob("*/block.ele"))
    path.write_text("other")
    done = sweep("out")
    assert done.returncode == 2 and f"{path.parent} holds another mesh than when it was planned" in done.stderr
    shutil.rmtree(path.parent)
    assert sweep("s.toml", "--out", "out").returncode == 0


@pytest.mark.parametrize("key, value", [("axes", {"how": "b"}), ("options", ["-fsi_ksp_max_it", "3"]), ("steps", 3)])
def test_what_is_edited_in_a_run_is_seen(place, key, value):  # noqa: F811
    folder, _ = made("a")
    path = folder.run("how-a") / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(InputError, match=r"how-a/run.json cannot be read"):
        folder.planned()


def test_a_directory_that_is_not_in_the_plan_is_named(sweep):  # noqa: F811
    sweep(written("a", "b"), "--out", "out")
    plan = Path("out/plan.csv")
    plan.write_text("".join(line for line in plan.read_text().splitlines(True) if "how-b" not in line))
    for words in ([], ["--status"], ["--collect"]):
        assert "1 in out/runs not in the plan, in no table, and left as they are: how-b" in sweep("out", *words).stdout


# ---- links and pipes ----------------------------------------------------------------------------------------


FILES, FOLDERS = ("output.txt", "attempts.jsonl", ".claim", "../../.writing"), ("../how-a", "..", "../../replaced")


@pytest.mark.parametrize(
    "name, kind",
    [
        *((name, kind) for name in FILES for kind in ("link", "pipe", "folder")),
        *((name, kind) for name in FOLDERS for kind in ("link", "pipe")),
    ],
)
def test_nothing_is_written_through_what_is_none_of_a_sweeps_own(sweep, name, kind):  # noqa: F811
    folder, _ = made("a")
    victim, own = Path("victim"), Path(os.path.normpath(folder.run("how-a") / name))
    if own.is_dir():
        own.rename(victim)
    elif name in FOLDERS:
        victim.mkdir()
    else:
        own.unlink(missing_ok=True)
        victim.write_text("thesis")
    if kind == "link":
        own.symlink_to(victim.absolute())
    else:
        os.mkfifo(own) if kind == "pipe" else own.mkdir()
    before = [victim, *victim.rglob("*")]
    done = sweep("s.toml", "--out", "out")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and f"{own} is " in done.stderr
    assert before == [victim, *victim.rglob("*")] and (victim.is_dir() or victim.read_text() == "thesis")
    if name == "../../.writing":
        assert sweep("out", "--collect").returncode == 2


def test_a_link_that_comes_meanwhile_is_bad_input(place, monkeypatch):  # noqa: F811
    folder, plan = made("a")
    Path("victim").write_text("thesis")
    (folder.run("how-a") / "output.txt").symlink_to(Path("victim").absolute())
    with pytest.raises(InputError, match=r"how-a/output.txt cannot be written: it is a link"):
        pool.Pool(folder, plan.runs, 1, print).work()
    assert Path("victim").read_text() == "thesis"


# ---- summaries ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        '{"status": "done", "wall_s": "abc"}',
        '{"status": "done", "wall_s": 1e999}',
        '{"status": "done", "time": [1]}',
        '{"status": "done", "steps": 1.5}',
        '{"status": "done", "unknowns": {"a": "x"}}',
        '{"status": "done", "phases": 3}',
        "[" * 100_000,
        "\xff",
    ],
)
def test_a_crafted_summary_is_damaged(sweep, text):  # noqa: F811
    made("a", "b")
    Path("out/runs/how-a/summary.json").write_text(text, encoding="latin-1")
    for words in ("--status", "--collect"):
        done = sweep("out", words)
        assert done.returncode == 0 and not done.stderr
    assert re.search(r"how-a: broken: .*summary.json is", sweep("out", "--status").stdout)


def test_a_summary_of_no_text_is_in_the_table(sweep):  # noqa: F811
    made("a")
    text = '{"status": "done", "steps": 1, "versions": {"a": "\\ud800"}}'
    Path("out/runs/how-a/summary.json").write_text(text)
    assert sweep("out", "--collect").returncode == 0 and rows()["how-a"]["version.a"] == "\\ud800"


def test_a_summary_that_cannot_be_written_is_no_result(sweep):  # noqa: F811
    made("fails")
    Path("out/runs/how-fails/summary.json").mkdir()
    done = sweep("out")
    assert done.returncode == 1 and "summary.json cannot be read: it is no plain file" in done.stdout
    assert states() == {"how-fails": "lost"}


# ---- options ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "points, twins",
    [
        ('{ options = { fsi_ksp_rtol = 0.0001 } }, { options = { fsi_ksp_rtol = "1.0e-4" } }', True),
        ('{ options = { fsi_ksp_rtol = 0.0001 } }, { options = { fsi_ksp_rtol = "1.1e-4" } }', False),
        ('{ options_file = "a.opts" }, { options_file = "b.opts" }', True),
        ('{ options_file = "a.opts" }, { options_file = "c.opts" }', False),
        ('{ options_file = "a.opts", options = { fsi_ksp_max_it = 3 } }, { options_file = "c.opts" }', False),
        ('{ options_file = "split.opts" }, { options_file = "monolithic.opts" }', False),
    ],
)
def test_two_spellings_of_a_number_are_one_run(place, points, twins):  # noqa: F811
    for name, text in (("a", "1e-4"), ("b", "0.1E-3"), ("c", "1e-5")):
        Path(f"{name}.opts").write_text(f"-fsi_ksp_rtol {text}\n")
    one, two = points.split(" }, ")
    Path("s.toml").write_text(f'scene = "scene.toml"\n[axis.how]\na = {one} }}\nb = {two}\n')
    if twins:
        with pytest.raises(InputError, match="run how-b: is the same as how-a"):
            plan_sweep(Path("s.toml"))
    else:
        assert len(plan_sweep(Path("s.toml")).runs) == 2


# ---- with petfsi itself -------------------------------------------------------------------------------------

REAL = """
scene = "scene.toml"
[axis.how]
plain = {}
mesh = { options_file = "own.opts", options = { fsi_ksp_max_it = 77 } }
"""


@pytest.mark.launches
def test_real_runs_are_what_was_planned_until_somebody_changes_them(tmp_path, monkeypatch, here):
    monkeypatch.chdir(tmp_path)
    points, cells = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], [[0, 1, 2], [0, 2, 3]]
    meshio.write_points_cells("block.vtu", np.array(points), [("triangle", np.array(cells))], binary=False)
    Path("own.opts").write_text("-options_file monolithic.opts\n-fsi_ksp_rtol 1e-8\n")
    Path("scene.toml").write_text(re.sub("shape = .*", 'shape = { mesh = "block.vtu" }', SCENE))
    Path("s.toml").write_text(REAL)
    done = here("sweep", "s.toml", "--out", "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert here("sweep", "out").returncode == 0 and set(states().values()) == {"done"}
    assert here("resume", "out/runs/how-plain", "--set", "time.end=0.25").returncode == 0
    assert here("resume", "out/runs/how-mesh", "--set", "time.end=0.25", "-fsi_ksp_rtol", "1e-7").returncode == 0
    done = here("sweep", "out")
    assert (
        done.returncode == 1 and "how-plain: changed, step 5: not as planned: time.end is 0.25, not 0.2" in done.stdout
    )
    assert re.search(
        r"how-mesh: changed, .*: time.end is 0.25, not 0.2; -fsi_ksp_rtol is 1e-7, not 1e-8$", done.stdout, re.MULTILINE
    )
    mesh = Path("out/runs/how-plain/meshes/1/block.vtu")
    mesh.write_text(mesh.read_text() + "\n")
    assert "mesh is another mesh" in here("sweep", "out", "--status").stdout
