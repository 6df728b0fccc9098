"""What happens to a run directory when it is taken away, copied, named oddly, or holds what it should not."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from blocks import falling_block
from mpi4py import MPI
from processes import environment

from petfsi.output import aside, files, rundir
from petfsi.output.history import read_history
from petfsi.runs.origin import Origin
from petfsi.scene.load import load_scene
from petfsi.simulation import Simulation
from petfsi.solving.option_database import load_options

EVERY = "[output]\nevery = 0.2\n[checkpoint]\nevery = 0.2"
BLOCK = falling_block(0.6, 0.1, shape='{ mesh = "square.vtu" }', more=EVERY)
CHANNEL = """
dim = 2
[time]
end = 1.0
dt = 0.02
[fluid]
density = 1000.0
origin = [0.0, 0.0]
size = [1.0, 1.0]
cells = [12, 12]
[fluid.sides]
top = "open"
left = { inflow = { speed = 0.3, region = { box = { origin = [-0.1, 0.5], size = [0.2, 0.25] } } } }
[solids.flap]
shape = { box = { origin = [0.45, 0.0], size = [0.06, 0.6], cells = [2, 8] } }
density = 900.0
young = 5e4
poisson = 0.4
supports = [{ where = "bottom", fix = ["x", "y"] }]
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
size = [1.0, 1.0]
spacing = 0.1
sound_speed = 30.0
fill = [{{ mesh = "{mesh}" }}]
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    import meshio

    monkeypatch.chdir(tmp_path)
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    meshio.Mesh(np.array(points, float), [("triangle", [[0, 1, 2], [0, 2, 3]])]).write("square.vtu")
    Path("block.toml").write_text(BLOCK)
    return "block.toml"


def everything(directory):
    return {str(p): p.read_bytes() for p in sorted(Path(directory).rglob("*")) if p.is_file()}


def failing(call, at):
    """Return a function that does as another but the call of a number, which finds the disk full."""
    count = iter(range(1, 1000))

    def run(*words):
        if next(count) == at:
            raise OSError(28, "No space left on device", str(words[0]))
        return call(*words)

    return run


@pytest.mark.parametrize("place, at", [("moves", 1), ("moves", 5), ("writes", 1), ("writes", 2), ("writes", 3)])
def test_a_run_that_cannot_be_replaced_stays(scene, here, monkeypatch, place, at):
    assert here("run", scene, "--out", "run").returncode == 0
    before = everything("run")
    with monkeypatch.context() as patched:
        if place == "moves":
            patched.setattr(aside.os, "replace", failing(os.replace, at))
        else:
            patched.setattr(rundir.files, "replace_text", failing(files.replace_text, at))
        done = here("run", scene, "--out", "run", "--overwrite", "--steps", 1)
    assert done.returncode == 2 and "No space left" in done.stderr, done.stderr
    assert everything("run") == before
    assert here("resume", "run", "--set", "time.end=0.8").returncode == 0
    assert here("run", scene, "--out", "run", "--overwrite", "--steps", 1).returncode == 0
    assert sorted(everything("run").keys() & {f"run/fields/{n:06d}.h5" for n in (2, 4, 6, 8)}) == []


def test_files_that_petfsi_has_not_written_outlive_it(scene, here):
    assert here("run", scene, "--out", "run").returncode == 0
    mine = [Path("run/meshes/1/notes.txt"), Path("run/meshes/7/run.vtu"), Path("run/log.txt.part/x"), Path("run/x")]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious")
    done = here("run", scene, "--out", "run", "--overwrite", "--steps", 1)
    assert done.returncode == 2 and "Directory not empty" in done.stderr
    for path in mine[:2]:
        path.unlink()
    Path("run/meshes/7").rmdir()
    assert here("run", scene, "--out", "run", "--overwrite", "--steps", 1).returncode == 0
    assert [path.read_text() for path in mine[2:]] == ["precious"] * 2


def test_a_run_among_the_meshes_of_another_is_left(scene, here):
    plain = ("--set", "solids.block.shape={box={origin=[0,0],size=[1,1],cells=[2,2]}}")
    assert here("run", scene, "--out", "run", "--steps", 1, *plain).returncode == 0
    assert here("run", scene, "--out", "run/meshes/1", "--steps", 1).returncode == 0
    inner = everything("run/meshes/1")
    assert here("run", scene, "--out", "run", "--overwrite", "--steps", 1, *plain).returncode == 0
    assert everything("run/meshes/1") == inner


@pytest.mark.parametrize("kind", ["pipe", "deep", "huge", "folder"])
def test_a_summary_may_be_anything(scene, here, kind):
    assert here("run", scene, "--out", "run").returncode == 0
    path = Path("run/summary.json")
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "deep":
        path.write_text("[" * 100000)
    elif kind == "huge":
        with open(path, "wb") as file:
            file.truncate(300 << 30)
    else:
        path.mkdir()
    done = here("resume", "run")
    if kind == "folder":
        assert done.returncode == 3 and "summary.json" in done.stderr
    else:
        assert done.returncode == 0 and json.loads(path.read_text())["status"] == "done"


@pytest.mark.parametrize("name", ["scene.toml", "options.opts", "history.csv"])
def test_a_file_that_is_none_or_too_large_is_named(scene, here, name):
    assert here("run", scene, "--out", "run", "--steps", 3).returncode == 0
    path, text = Path("run", name), Path("run", name).read_bytes()
    path.unlink()
    os.mkfifo(path)
    done = here("resume", "run")
    assert done.returncode == 2 and f"{name}" in done.stderr and "no plain file" in done.stderr
    path.unlink()
    with open(path, "wb") as file:
        file.write(text)
        file.truncate(300 << 30)
    done = here("resume", "run", "--steps", 1)
    if name == "history.csv":  # what is behind the known rows is dropped
        assert done.returncode == 0 and len(read_history(path)["step"]) == 5
    else:
        assert done.returncode == 2 and f"{name}: File too large" in done.stderr


def test_a_name_may_be_any_bytes(scene, here):
    for name in (os.fsdecode(b"d\xff"), "é日本", "line\n\x1b[31m"):
        done = here("run", scene, "--out", name, "--steps", 3)
        assert done.returncode == 0 and "\x1b" not in done.stdout, done.stderr
        assert here("resume", name, "--steps", 1).returncode == 0
        assert len((Path(name) / "log.txt").read_bytes().decode().splitlines()) > 4
        done = here("run", scene, "--from", name, "--out", "new", "--overwrite", "--steps", 1)
        assert done.returncode == 0, done.stderr


def test_names_and_texts_that_cannot_be_are_refused(scene, here):
    long = "x" * 300
    for words in (["run", scene, "--out", long], ["resume", long], ["run", scene, "--from", long, "--out", "q"]):
        done = here(*words)
        assert done.returncode == 2 and "File name too long" in done.stderr
    done = here("run", scene, "--out", "q", "--set", os.fsdecode(b"title=a\xffb"))
    assert done.returncode == 2 and "UTF-8" in done.stderr
    done = here("run", scene, "--out", "q", "--wall-limit", "nan")
    assert done.returncode == 2 and "nan" in done.stderr
    assert not Path("q").exists()


def test_a_terminal_without_the_characters_of_a_title_still_hears(scene):
    Path(scene).write_text('title = "日本é"\n' + BLOCK)
    line = [str(Path(sys.executable).with_name("petfsi")), "run", scene, "--out", "yé", "--steps", "2"]
    done = subprocess.run(line, capture_output=True, timeout=300, env=environment(PYTHONIOENCODING="ascii"))
    lines = done.stdout.decode("ascii").splitlines()
    assert done.returncode == 0 and "\\u65e5" in lines[0] and "resume y\\xe9" in lines[-1]
    assert "日本é" in Path("yé/log.txt").read_text(encoding="utf-8")


def test_a_setting_changed_back_is_told_too(scene, here):
    assert here("run", scene, "--out", "run", "--steps", 4).returncode == 0
    assert here("resume", "run", "--set", "time.end=0.4").returncode == 0
    assert here("resume", "run", "--set", "time.end=0.6").returncode == 0
    log = Path("run/log.txt").read_text()
    assert "time.end: 0.6 -> 0.4" in log and "time.end: 0.4 -> 0.6" in log


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "newmark"])
def test_the_books_of_a_run_from_another_go_on_where_that_was(scene, here, integrator):
    Path(scene).write_text(CHANNEL)
    sets = ("--set", f"time.integrator={integrator}")
    assert here("run", scene, "--out", "straight", "--steps", 9, *sets).returncode == 0
    assert here("run", scene, "--out", "old", "--steps", 5, *sets).returncode == 0
    assert here("run", scene, "--from", "old", "--out", "new", "--steps", 4, *sets).returncode == 0
    want, got = (read_history(Path(name) / "history.csv") for name in ("straight", "new"))
    for name in ("boundary_work", "elastic"):
        work = want[name][5:] - want[name][5]
        np.testing.assert_allclose(got[name] - got[name][0], work, rtol=0, atol=1e-6 * np.abs(want[name]).max())


def test_a_checkpoint_that_a_run_at_work_replaces_is_looked_for_again(scene, here):
    comm = MPI.COMM_WORLD
    assert here("run", scene, "--out", "old").returncode == 0
    origin = Origin.find(Path("old"), Path("new"), comm)
    assert origin.found.step == 6
    for path in Path("old/checkpoint").glob("000006.*"):
        path.unlink()
    options = load_options([], base="monolithic.opts")
    assert options.chosen
    simulation = Simulation(comm, load_scene(scene))
    origin.begin(simulation)
    assert origin.found.step == 4


def test_a_run_killed_before_it_made_room_has_no_checkpoint_too_many_in_the_end(scene, here):
    every = ("--set", "checkpoint.every=0.1", "--set", "checkpoint.keep=2")
    assert here("run", scene, "--out", "run", *every, "--steps", 3).returncode == 0
    shutil.copytree("run/checkpoint", "aside")
    assert here("resume", "run").returncode == 0
    end = everything("run/checkpoint")
    shutil.copytree("aside", "run/checkpoint", dirs_exist_ok=True)
    Path("run/summary.json").unlink()  # it comes last
    assert len(everything("run/checkpoint")) > len(end) == 4
    done = here("resume", "run")
    assert done.returncode == 0 and everything("run/checkpoint") == end


@pytest.mark.parametrize("ending", ["msh", "xdmf", "inp", "bdf"])
@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
def test_a_mesh_that_is_no_file_is_named_wherever_it_stands(scene, here, make, ending):
    make(f"thing.{ending}")
    Path("dam.toml").write_text(DAM.format(mesh=f"thing.{ending}"))
    for name, words in (("block", ["--set", f'solids.block.shape.mesh="thing.{ending}"']), ("dam", [])):
        done = here("run", f"{name}.toml", "--out", "run", *words)
        key = {"block": "solids.block.shape.mesh", "dam": "fluid.fill.0.mesh"}[name]
        assert done.returncode == 2 and f"{key}: is no file but a " in done.stderr, done.stderr
        assert f"thing.{ending}" in done.stderr and not Path("run").exists()
