"""Whatever a user gets wrong, and whatever fails, ends in one clear message and the right exit code. About 90 s.

A mistake: exit code 2, and nothing written. A failure on the way: exit code 3, a summary that says so, nothing
half-written, the last good checkpoint named. No traceback, whatever happens.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import meshio
import numpy as np
import pytest
from processes import environment, launcher

from petfsi.output.history import read_history

PETFSI = Path(sys.executable).with_name("petfsi")
JOBS = Path(__file__).parents[1] / "jobs"

#: A block held by its base in a channel: 4 x 4 solid cells, 12 x 8 of fluid, ten steps.
SCENE = """
title = "A block in a channel"
dim = 2
[time]
end = 0.5
dt = 0.05
[fluid]
density = 10.0
origin = [0.0, 0.0]
size = [3.0, 2.0]
cells = [12, 8]
[fluid.sides]
left = { inflow = { speed = 0.5 } }
right = "open"
[solids.block]
shape = { box = { origin = [1.0, 0.0], size = [0.5, 1.0], cells = [4, 4] } }
density = 20.0
young = 1e4
poisson = 0.3
supports = [{ where = "bottom", fix = ["x", "y"] }]
[probes.tip]
of = "block"
at = [1.25, 1.0]
quantity = "displacement"
"""
BLOCK = "{ box = { origin = [1.0, 0.0], size = [0.5, 1.0], cells = [4, 4] } }"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "block.toml"
    path.write_text(SCENE)
    return path


def petfsi(*words, ranks=1, file_limit=None):
    """Run the real command; ``file_limit`` (bytes) makes files that grow beyond it fail, as a quota does."""
    command = [PETFSI]
    if file_limit is not None:  # set once MPI has its own files
        code = "import sys, resource; from mpi4py import MPI; from petfsi import cli; "
        code += f"resource.setrlimit(resource.RLIMIT_FSIZE, ({file_limit},) * 2); sys.exit(cli.main(sys.argv[1:]))"
        command = [sys.executable, "-c", code]
    line = [*launcher(ranks), *command, *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, env=environment(), timeout=180)


def is_clear(done, *said):
    """Check that what was said fits on a screen, has no traceback and names what it should."""
    everything = done.stdout + done.stderr
    assert "Traceback" not in everything and "defect in petfsi" not in everything, everything
    assert "PETSC ERROR" not in everything, everything
    assert len(done.stderr.splitlines()) <= 20 and len(done.stderr) < 2500, done.stderr
    assert len(re.findall(r"^(petfsi: |Usage: )", done.stderr, re.MULTILINE)) == 1, done.stderr
    for text in said:
        assert text in done.stderr


def is_refused(done, out, *said):
    is_clear(done, *said)
    assert done.returncode == 2, done.stderr
    assert not Path(out).exists()


def has_failed(done, out, *said, status="failed"):
    is_clear(done, *said)
    assert done.returncode == 3, done.stderr
    assert json.loads((Path(out) / "summary.json").read_text())["status"] == status
    assert is_tidy(out)
    assert done.stderr.count("Last good checkpoint: ") + done.stderr.count("There is no checkpoint.") <= 1


def is_tidy(out):
    return not [*Path(out).rglob("*.part"), *Path(out).rglob(".reserve")]


# ---- scenes -------------------------------------------------------------------------------------------------


def replaced(old, new):
    assert SCENE.count(old) == 1
    return SCENE.replace(old, new)


SCENES = {
    "no TOML": ("dim = = 2", ["not valid TOML", "line 1"]),
    "not text": (b"\xff\xfe\x01", ["is not UTF-8 text"]),
    "empty": ("", ["dim: is missing", "time: is missing"]),
    "missing key": (replaced("density = 20.0\n", ""), ["solids.block.density: is missing", "kg/m^3"]),
    "missing table": (replaced("[time]\nend = 0.5\ndt = 0.05\n", ""), ["time: is missing"]),
    "unknown key": (replaced("young", "yuong"), ["no setting 'yuong'; did you mean 'young' (Pa)?"]),
    "unknown table": (SCENE + "[fluids]\n", ["no setting 'fluids'; did you mean 'fluid'?"]),
    "a box in a cavity": (
        replaced(BLOCK, BLOCK[:-1] + ", cavity = { box = { origin = [1.1, 0.2], size = [0.1, 0.1] } } }"),
        ["solids.block.shape.cavity.box = ", "no setting 'box'; known here are origin, size, cells"],
    ),
    "text for a number": (replaced("end = 0.5", 'end = "soon"'), ['time.end = "soon": must be a number (s)']),
    "number for a text": (replaced('"A block in a channel"', "3"), ["title = 3: must be a text"]),
    "truth for a number": (replaced("density = 10.0", "density = true"), ["fluid.density = true: must be a number"]),
    "negative density": (replaced("density = 20.0", "density = -1"), ["solids.block.density = -1", "greater than 0"]),
    "infinite density": (replaced("density = 10.0", "density = inf"), ["fluid.density = inf", "finite"]),
    "poisson": (replaced("poisson = 0.3", "poisson = 0.5"), ["solids.block.poisson = 0.5: must be less than 0.5"]),
    "dimension": (replaced("dim = 2", "dim = 4"), ["dim = 4: must be 2 or 3"]),
    "items": (replaced("size = [3.0, 2.0]", "size = [3.0]"), ["fluid.size = [3.0]: must have 2 items, as dim = 2"]),
    "no extent": (replaced("size = [3.0, 2.0]", "size = [3.0, 0.0]"), ["fluid.size = [3.0, 0.0]: must be greater"]),
    "no cells": (replaced("cells = [12, 8]", "cells = [12, 0]"), ["fluid.cells.1 = 0", "1"]),
    "half a cell": (replaced("cells = [12, 8]", "cells = [12, 8.5]"), ["fluid.cells.1 = 8.5: must be a whole number"]),
    "unknown side": (
        replaced('right = "open"', 'right = "opne"'),
        ['right = "opne"', "'slip', 'open', 'hydrostatic' or 'periodic'"],
    ),
    "side without a name": (replaced('right = "open"', 'rihgt = "open"'), ["no setting 'rihgt'; did you mean 'right'"]),
    "one periodic side": (replaced('right = "open"', 'right = "periodic"'), ["'left' must be periodic too"]),
    "z in 2D": (replaced('right = "open"', 'back = "open"'), ["fluid.sides.back", "bounds z, which dim = 2"]),
    "support": (replaced('where = "bottom"', 'where = "botom"'), ['supports.0.where = "botom"', "bottom"]),
    "axis": (replaced('fix = ["x", "y"]', 'fix = ["x", "w"]'), ['supports.0.fix.1 = "w"', "'x', 'y', 'z' or 'angle'"]),
    "two shapes": (replaced(BLOCK, BLOCK[:-1] + ', mesh = "a.msh" }'), ["exactly one of box, ball"]),
    "a ball": (replaced(BLOCK, "{ ball = { centre = [1, 1], radius = 0.2 } }"), ["shape.ball.cells: is missing"]),
    "outside the grid": (
        replaced("origin = [1.0, 0.0]", "origin = [-0.2, 0.0]"),  # the left side is not open
        ['solids.block.shape.box = "x from -0.2 to 0.3 m"', "x must lie inside the fluid's grid, 0 to 3 m"],
    ),
    "probe": (replaced('of = "block"', 'of = "blok"'), ['probes.tip.of = "blok": must be one of fluid, block']),
    "probe far away": (
        replaced('of = "block"\nat = [1.25, 1.0]', 'of = "fluid"\nat = [9.0, 1.0]').replace("placement", "velocity"),
        ["probes.tip.at = [9.0, 1.0]", "0 to 3 m"],
    ),
    "long step": (replaced("dt = 0.05", "dt = 5.0"), ["time.dt = 5.0: must not exceed time.end = 0.5 s"]),
    "no step": (replaced("dt = 0.05", "dt = 0.0"), ["time.dt = 0.0: must be greater than 0 (s)"]),
    "too many steps": (replaced("dt = 0.05", "dt = 1e-12"), ["time.dt = 1e-12: makes 5e+11 steps", "1e+08"]),
    "no field": ("dim = 2\n[time]\nend = 1.0\ndt = 0.1\n", ["the scene needs a [fluid], or at least one [solids"]),
    "nothing ahead": (SCENE + "[checkpoint]\nkeep = 0\n", ["checkpoint.keep = 0", "1"]),
    "attribute": (
        replaced("speed = 0.5", 'speed = "x.__class__"'),
        ["fluid.sides.left.inflow.speed", "'x.__class__' is not allowed; only numbers"],
    ),
    "unknown function": (
        replaced("speed = 0.5", "speed = \"__import__('os').system('touch gotcha')\""),
        ["fluid.sides.left.inflow.speed", "not allowed"],
    ),
    "misspelt function": (
        replaced("speed = 0.5", 'speed = "sine(t)"'),
        ["unknown function 'sine'; did you mean 'sin'"],
    ),
    "unknown variable": (SCENE + '[fluid.initial]\nvelocity = ["q", 0]\n', ["fluid.initial.velocity.0", "name 'q'"]),
    "infinite constant": (SCENE + '[fluid.initial]\nvelocity = ["1/0", 0]\n', ["fluid.initial.velocity.0", "is inf"]),
    "velocity without a number": (
        SCENE + '[fluid.initial]\nvelocity = ["log(x-1)", 0]\n',
        ["fluid.initial.velocity", "log(x-1)", "it must be finite", "x = "],
    ),
    "infinite solid": (
        SCENE + '[solids.block.initial]\nvelocity = ["1/(x-1)", 0]\n',
        ["solids.block.initial.velocity", "is inf at x = 1; it must be finite"],
    ),
    "overlapping boxes": (
        SCENE + f"[solids.twin]\nshape = {BLOCK}\ndensity = 1.0\nyoung = 1.0\npoisson = 0.0\n",
        ["solids.twin.shape.box", "overlaps solids.block; bodies must lie apart"],
    ),
    "overlapping obstacle": (
        SCENE + "[obstacles.stone]\nshape = { ball = { centre = [1.25, 1.0], radius = 0.3 } }\n",
        ["solids.block.shape: overlaps obstacles.stone with", "of 32 cells"],
    ),
    "outside its container": (
        SCENE + "[obstacles.pot]\noutside = true\nshape = { box = { origin = [0, 0], size = [1.2, 2] } }\n",
        ["solids.block.shape: overlaps obstacles.pot with"],
    ),
    "nothing held": (
        replaced('where = "bottom"', "where = { ball = { centre = [0.2, 0.2], radius = 0.1 } }"),
        ["solids.block.supports.0.where: no node of the solid lies there", "[1.0, 0.0] to [1.5, 1.0] m"],
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_wrong_scene_is_refused(scene, here, name):
    text, said = SCENES[name]
    scene.write_bytes(text if isinstance(text, bytes) else text.encode())
    is_refused(here("run", scene, "--out", "out"), "out", *said)
    assert sorted(p.name for p in scene.parent.iterdir()) == ["block.toml"]


def test_all_mistakes_come_at_once(scene, here):
    scene.write_text(replaced("density = 20.0", "density = -1").replace("young", "yuong").replace('"open"', '"opne"'))
    done = here("run", scene, "--out", "out")
    is_refused(done, "out", "4 mistakes", "density = -1", "'yuong'", '"opne"', "young: is missing")


def test_a_block_clamped_into_an_obstacle_is_none_of_these(scene, here):
    scene.write_text(SCENE + "[obstacles.bed]\nshape = { halfspace = { point = [0, 0.1], normal = [0, 1] } }\n")
    assert here("check", scene).returncode == 0


# ---- meshes -------------------------------------------------------------------------------------------------

SQUARE = np.array([[1.0, 0.5], [1.5, 0.5], [1.5, 1.0], [1.0, 1.0]])
HALVES = [[0, 1, 2], [0, 2, 3]]


def write_mesh(name, points, cells, kind="triangle"):
    points = np.asarray(points, dtype=float)
    if points.shape[1] == 2:
        points = np.column_stack((points, np.zeros(len(points))))
    meshio.Mesh(points, [(kind, np.array(cells))]).write(name)


MESHES = {
    "missing": (None, ["no such file"]),
    "garbage": (b"\x00\x93NUMPY garbage \xff" * 40, ["cannot be read as a mesh"]),
    "empty": (b"", ["cannot be read as a mesh"]),
    "tetrahedra": (([*np.eye(3), [0, 0, 0]], [[0, 1, 2, 3]], "tetra"), ["holds no triangle cells", "found tetra"]),
    "lines": ((SQUARE, [[0, 1], [1, 2]], "line"), ["holds no triangle cells, which dim = 2 wants; found line"]),
    "not plane": (([[1, 1, 0], [2, 1, 0], [1, 2, 1]], [[0, 1, 2]]), ["do not lie in one plane"]),
    "folded": ((SQUARE, [[0, 1, 2], [0, 1, 3]]), ["1 facets whose two cells lie on the same side"]),
    "twice": ((SQUARE, [*HALVES, [1, 2, 0]]), ["duplicate cells"]),
    "flat": (([*SQUARE, [1.25, 0.5]], [*HALVES, [0, 1, 4]]), ["1 cells with zero volume"]),
    "no number": (([[np.nan, 0.5], *SQUARE[1:]], HALVES), ["1 points with a coordinate that is no number"]),
    "no such point": ((SQUARE, [[0, 1, 7]]), ["cells name points that the file does not hold"]),
    "torn": ((np.concatenate((SQUARE, SQUARE[:1])), [[0, 1, 2], [4, 2, 3]]), ["duplicate points"]),
    "by a corner": (([*SQUARE, [2, 1], [2, 1.5]], [*HALVES, [2, 4, 5]]), ["meets itself (non-manifold boundary)"]),
    "outside": ((SQUARE + [2.0, 0.0], HALVES), ["x from 3 to 3.5 m", "must lie inside the fluid's grid, 0 to 3 m"]),
}


@pytest.mark.parametrize("name", MESHES)
def test_a_wrong_mesh_is_refused(scene, here, name):
    content, said = MESHES[name]
    scene.write_text(replaced(BLOCK, '{ mesh = "block.vtk" }').replace("at = [1.25, 1.0]", "at = [1.0, 0.5]"))
    if isinstance(content, bytes):
        Path("block.vtk").write_bytes(content)
    elif content is not None:
        write_mesh("block.vtk", *content)
    for command in (["run", scene, "--out", "out"], ["check", scene]):
        done = here(*command)
        is_refused(done, "out", "solids.block.shape", *said)
    assert "block.vtk" in done.stderr or name == "outside"


def test_an_unknown_kind_of_file_is_refused(scene, here):
    scene.write_text(replaced(BLOCK, '{ mesh = "block.docx" }'))
    Path("block.docx").write_text("a letter")
    is_refused(here("run", scene, "--out", "out"), "out", "solids.block.shape.mesh", "block.docx", "cannot be read")


def test_points_of_no_cell_are_left_out(scene, here):
    scene.write_text(replaced(BLOCK, '{ mesh = "block.vtk" }'))
    write_mesh("block.vtk", [*SQUARE, [9.0, 9.0]], HALVES)
    done = here("check", scene)
    assert done.returncode == 0 and "block 4 nodes, 2 cells" in done.stdout


def test_meshes_must_lie_apart(scene, here):
    material = "density = 1.0\nyoung = 1.0\npoisson = 0.0\n"
    write_mesh("twin.vtk", SQUARE + 0.1, HALVES)
    scene.write_text(SCENE + f'[solids.twin]\nshape = {{ mesh = "twin.vtk" }}\n{material}')
    is_refused(here("run", scene, "--out", "out"), "out", "solids.twin.shape: overlaps solids.block (")
    write_mesh("twin.vtk", SQUARE, [[0, 1], [1, 2], [2, 3], [3, 0]], "line")
    scene.write_text(SCENE + '[obstacles.stone]\nshape = { mesh = "twin.vtk" }\n')
    is_refused(here("run", scene, "--out", "out"), "out", "solids.block.shape: overlaps obstacles.stone with")
    write_mesh("twin.vtk", SQUARE, [[0, 1], [1, 2], [2, 3]], "line")
    is_refused(here("run", scene, "--out", "out"), "out", "obstacles.stone.shape", "the surface must be closed")


# ---- the command line ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words, said",
    [
        (["--steps", "0"], ["'--steps': 0", "x>=1"]),
        (["--steps", "-3"], ["'--steps': -3", "x>=1"]),
        (["--wall-limit", "-5"], ["'--wall-limit': -5", "x>0"]),
        (["--set", "time.dt"], ["--set time.dt: must be key=value"]),
        (["--set", "time.dt.x=1"], ["--set time.dt.x=1: time.dt is 0.05, not a table"]),
        (["--out", "block.toml"], ["block.toml: there is a file of that name"]),
        (["--out", "block.toml/deep/er"], ["block.toml", "Not a directory"]),
        (["--out", "taken"], ["taken is not empty and holds no run"]),
        (["--out", "/proc/petfsi"], ["/proc/petfsi", "cannot be written"]),
    ],
    ids=lambda value: "-".join(value) if value[0].startswith("--") else "",
)
def test_a_wrong_command_is_refused(scene, here, words, said):
    Path("taken").mkdir()
    Path("taken/letter").touch()
    is_refused(here("run", scene, *words), "runs", *said)
    assert scene.read_text() == SCENE and os.listdir("taken") == ["letter"]


# ---- PETSc's options ----------------------------------------------------------------------------------------

OPTIONS = {
    "misspelt": (
        ["-fsi_ksp_rtoll", "1e-5", "-fsi_pc_typ", "lu"],
        ["-fsi_ksp_rtoll: no solver of this scene reads it; did you mean -fsi_ksp_rtol?", "did you mean -fsi_pc_type?"],
    ),
    "solver": (["-fsi_ksp_type", "bogus"], ["option -fsi_ksp_type bogus:", "Unable to find requested KSP type bogus"]),
    "inside": (["-fsi_fieldsplit_pressure_pc_type", "bogus"], ["option -fsi_fieldsplit_pressure_pc_type bogus:"]),
    "no number": (["-fsi_ksp_rtol", "abc"], ["option -fsi_ksp_rtol abc:", "no numeric value"]),
    "no whole number": (["-fsi_ksp_max_it", "1.5"], ["option -fsi_ksp_max_it 1.5:", "no integer value"]),
    "no choice": (["-fsi_ksp_pc_side", "up"], ["option -fsi_ksp_pc_side up:", "left right symmetric"]),
    "no value": (["-fsi_ksp_rtol"], ["option -fsi_ksp_rtol: wants a value behind it"]),
    "matrix": (["-fsi_mat_type", "banana"], ["option -fsi_mat_type banana: must be nest or aij"]),
    "package": (
        ["-fsi_mat_type", "aij", "-fsi_pc_type", "lu", "-fsi_pc_factor_mat_solver_type", "nosuch"],
        ["option -fsi_pc_factor_mat_solver_type nosuch:"],
    ),
    "nest": (["-fsi_pc_type", "lu"], ["matrix type nest", "-fsi_mat_type aij"]),
    "no file": (["-options_file", "nowhere.opts"], ["-options_file nowhere.opts: no such file", "'petfsi info'"]),
    "folder": (["-options_file", "."], ["-options_file .: is a folder"]),
    "no name": (["-options_file"], ["-options_file: wants the name of a file"]),
    "no option": (["-options_file", "poem.opts"], ["poem.opts, line 2: 'Shall I compare thee' is no option"]),
    "noise": (["-options_file", "noise.opts"], ["noise.opts, line 1: ", "is no option"]),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_a_wrong_option_is_refused(scene, here, name):
    words, said = OPTIONS[name]
    Path("poem.opts").write_text("# a poem\nShall I compare thee\n")
    Path("noise.opts").write_bytes(bytes(range(1, 256)) * 20)
    is_refused(here("run", scene, "--out", "out", *words), "out", *said)


@pytest.mark.parametrize("name", ["misspelt", "solver", "no option"])
def test_the_real_command_refuses_a_wrong_option(scene, name):
    words, said = OPTIONS[name]
    Path("poem.opts").write_text("# a poem\nShall I compare thee\n")
    is_refused(petfsi("run", scene, "--out", "out", *words), "out", *said)


def test_a_type_on_the_command_line_replaces_what_the_file_says_below_it(scene, here):
    done = here("run", scene, "--out", "out", "--steps", 1, "-fsi_fieldsplit_pressure_pc_type", "sor")
    assert done.returncode == 0, done.stderr
    kept = Path("out/options.opts").read_text()
    assert "-fsi_fieldsplit_pressure_pc_type sor" in kept and "boomeramg" not in kept


# ---- failures on the way ------------------------------------------------------------------------------------

#: A layer so light under its water that a split scheme must blow up.
LIGHT = ["solids.layer.density=100", "time.dt=0.005", "checkpoint.every=0.005", "fluid.cells=[8,16]"]
LIGHT += ["solids.layer.shape.box.cells=[4,2]"]
LIGHT = [word for setting in LIGHT for word in ("--set", setting)]
WEAK = ["-fsi_ksp_max_it", "1", "-fsi_fieldsplit_pressure_pc_type", "jacobi"]
WEAK += ["-fsi_fieldsplit_pressure_ksp_max_it", "2"]


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_solver_that_does_not_converge_is_named(scene, ranks):
    slowly = ["--set", "fluid.sides.left.inflow.ramp=0.2"]
    done = petfsi("run", scene, "--out", "out", *slowly, *WEAK, ranks=ranks)
    has_failed(done, "out", "step 1, t = 0.05 s: solver 'fsi_", "DIVERGED_MAX_IT", "by field: solid ", ", pressure ")
    assert "Last good checkpoint: out/checkpoint/000000.h5. Go on from there with: petfsi resume out" in done.stderr
    assert len(read_history("out/history.csv")["step"]) == 1


def test_a_start_that_is_not_found_is_named_before_anything_is_written(scene, here):
    done = here("run", scene, "--out", "out", *WEAK)
    is_clear(done, "the velocities at t = 0 cannot be made to fit each other: solver 'fsi_", "DIVERGED_MAX_IT")
    assert done.returncode == 3 and not Path("out").exists()


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_state_that_blows_up_ends_the_run_and_names_the_checkpoint(tmp_path, ranks):
    out = tmp_path / "out"
    lets_go = ["--set", "time.energy_limit=-1"]
    done = petfsi(
        "run", JOBS / "column.toml", "--out", out, "-options_file", "split.opts", *LIGHT, *lets_go, ranks=ranks
    )
    has_failed(done, out, "time splitting is unstable here", "The step failed of it: the solid has blown up")
    last = int(re.search(r"Last good checkpoint: .*/(\d+)\.h5\.", done.stderr)[1])
    history = read_history(out / "history.csv")
    assert last == history["step"][-1] == json.loads((out / "summary.json").read_text())["steps"]
    assert f"petfsi: step {last + 1}, t = " in done.stderr
    assert all(np.isfinite(column).all() for column in history.values())


@pytest.mark.parametrize(
    "setting, said",
    [
        (
            "fluid.initial.velocity=[5e4, 0.0]",
            ["step 1, t = 0.05 s: the flow has blown up", "in one step of 0.00625 s"],
        ),
        ('gravity=["log(0.2-t)", 0.0]', ["t = 0.2 s: gravity", "it must be finite"]),
        ('fluid.sides.left.inflow.speed="0*log(0.07-t)"', ["step 2, t = 0.1 s: fluid.sides.left.inflow.speed"]),
        ('solids.block.supports.0.velocity.x="0*log(0.07-t)"', ["step 2, t = 0.1 s: solids.block.supports.0"]),
        ('solids.block.supports.0.velocity.x="exp(1e4*t)"', ["step 1, t = 0.05 s: "]),
    ],
)
def test_what_goes_wrong_only_later_is_a_failed_step(scene, here, setting, said):
    done = here("run", scene, "--out", "out", "--set", setting)
    has_failed(done, "out", *said)
    told = json.loads(Path("out/summary.json").read_text())
    last = read_history("out/history.csv")["step"][-1]
    assert told["failure"]["kind"] in ("diverged", "scene") and told["failure"]["step"] == last + 1
    assert told["failure"]["checkpoint"] == f"checkpoint/{last:06d}.h5" and told["reason"] in told["failure"]["message"]
    assert told["steps"] == last and f"Last good checkpoint: out/checkpoint/{last:06d}.h5." in done.stderr
    assert all(text in told["reason"] for text in said)


#: What numbers cannot hold, where NumPy would warn before anyone judges: settings, exit code, what is said.
BEYOND_NUMBERS = {
    "speed": (['solids.block.initial.velocity=["1e200*x", 0.0]'], 3, "look at loads, supports, speeds"),
    "inflow": (['fluid.sides.left.inflow.speed="1e200*t"'], 3, "hold numbers that are not finite"),
    "gravity": (['gravity=[0.0, "-1e300*t"]'], 3, "look at loads, supports, speeds"),
    "support": (['solids.block.supports.0.displacement={ x = "1e300*t" }'], 3, "look at loads, supports, speeds"),
    "damping": (
        ["solids.block.damping={ mass = 1e300, stiffness = 1e300 }", 'solids.block.initial.velocity=["y", 0.0]'],
        2,
        "solids.block.damping.mass = 1e+300: must be at most 1e+30 in size",
    ),
    "size": (
        ["fluid.size=[3e200, 2e200]", "solids.block.shape.box.size=[1e200, 1e200]", "probes={}"],
        2,
        "fluid.size.0 = 3e+200: must be at most 1e+15 in size",
    ),
}


@pytest.mark.parametrize("name", BEYOND_NUMBERS)
def test_what_overflows_is_told_of_once_by_those_who_judge(scene, here, name):
    """Warnings are errors here: one would be taken for a defect."""
    settings, code, said = BEYOND_NUMBERS[name]
    words = [word for setting in [*settings, 'time.integrator="bdf2"'] for word in ("--set", setting)]
    done = here("run", scene, "--out", "out", *words)
    is_clear(done, said)
    assert done.returncode == code
    assert here("check", scene, *words).returncode in (0, code)


@pytest.mark.parametrize(
    "setting, said",
    [
        ('fluid.sides.right={ pressure = "log(-t)" }', "fluid.sides.right.pressure = 'log(-t)': is nan at t = 0.05"),
        ('gravity=[0.0, "sqrt(-1-t)"]', "gravity.1 = 'sqrt(-1-t)': is nan at t = 0.05"),
        (
            'solids.block.loads=[{ where = "top", traction = ["sqrt(-1-t)", 0.0] }]',
            "solids.block.loads.0.traction.0 = 'sqrt(-1-t)': is nan at t = 0.05",
        ),
        (
            'solids.block.loads=[{ where = "top", pressure = "log(-1-t)" }]',
            "solids.block.loads.0.pressure = 'log(-1-t)': is nan at t = 0.05",
        ),
    ],
)
def test_what_has_no_value_in_the_first_step_is_a_mistake(scene, here, setting, said):
    if "solids" not in setting:
        scene.write_text(SCENE[: SCENE.index("[solids.block]")])
    done = here("run", scene, "--out", "out", "--set", setting, "--set", 'time.integrator="bdf2"')
    is_refused(done, "out", said, "it must be finite")


@pytest.mark.parametrize(
    "where, limit, sets, ranks",
    [
        ("history.csv", 5000, [], 1),
        ("fields/", 9000, ["--set", "output.every=0.05"], 1),
        ("checkpoint/000002.h5", 9000, ["--set", "checkpoint.every=0.1"], 1),
        ("checkpoint/000002.h5", 9000, ["--set", "checkpoint.every=0.1"], 2),
    ],
    ids=["history", "fields", "checkpoint", "two ranks"],
)
def test_a_full_disk_is_a_failure(scene, where, limit, sets, ranks):
    sets = [*sets, "--set", "time.dt=0.004"] if where == "history.csv" else sets
    done = petfsi("run", scene, "--out", "out", *sets, ranks=ranks, file_limit=limit)
    has_failed(done, "out", f"out/{where}", "could not be written: File too large")
    history = Path("out/history.csv").read_text()
    assert history.endswith("\n") and len(history) <= limit


@pytest.mark.parametrize("ranks", [1, 2])
def test_no_room_for_a_run_directory_is_a_mistake(scene, ranks):
    done = petfsi("run", scene, "--out", "new/out", ranks=ranks, file_limit=10)
    is_refused(done, "new", "run directory new/out", "cannot be written: File too large")


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("only root can mount a small disk")
    yield disk
    subprocess.run(["umount", "-l", disk], check=True)


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_disk_that_fills_up_still_takes_the_last_words(scene, small_disk, ranks):
    sets = ["output.every=0.05", "checkpoint.every=0.1", "checkpoint.keep=9", "fluid.cells=[48,32]"]
    words = [word for setting in sets for word in ("--set", setting)]
    done = petfsi("run", scene, "--out", small_disk / "out", *words, ranks=ranks)
    has_failed(done, small_disk / "out", "No space left on device", "MB needed", "Last good checkpoint: ")
    named = Path(re.search(r"Last good checkpoint: (.*\.h5)\.", done.stderr)[1])
    assert named.is_file() and named.with_suffix(".json").is_file()


def test_a_disk_without_any_room_left(scene, small_disk):
    with suppress(OSError), open(small_disk / "rest", "wb") as rest:
        for size in (65536, 512, 1):
            while rest.write(bytes(size)) and rest.flush() is None:
                pass
    is_refused(petfsi("run", scene, "--out", small_disk / "out"), small_disk / "out", "No space left on device")
    os.truncate(small_disk / "rest", (small_disk / "rest").stat().st_size - 40960)
    done = petfsi("run", scene, "--out", small_disk / "out", "--set", "time.dt=0.0001")
    has_failed(done, small_disk / "out", "out/history.csv could not be written: No space left on device")


# ---- stopping and going on ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return a run with checkpoints at steps 4, 8 and 10, made once; copy it before use."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "block.toml").write_text(SCENE)
    out = folder / "out"
    done = petfsi("run", folder / "block.toml", "--out", out, "--set", "checkpoint.every=0.2")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in (out / "checkpoint").glob("*.h5")) == ["000004.h5", "000008.h5", "000010.h5"]
    return out


@pytest.fixture
def run(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "run"))


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(run, finished, ranks):
    cut(run / "checkpoint/000010.h5")
    done = petfsi("resume", run, ranks=ranks)
    assert done.returncode == 0, done.stderr
    assert re.search(r"warning: checkpoint .*/000010.h5 is damaged: it has \d+ bytes and should have \d+", done.stdout)
    assert "resuming at step 8" in done.stdout
    if ranks == 1:
        assert (run / "history.csv").read_bytes() == (finished / "history.csv").read_bytes()


@pytest.mark.parametrize("ranks", [1, 2])
def test_with_every_checkpoint_damaged_nothing_can_go_on(run, ranks):
    before = {p: p.stat().st_size for p in run.rglob("*") if p.name != "log.txt"}
    for n in ("000004", "000008", "000010"):
        cut(run / f"checkpoint/{n}.h5")
        before[run / f"checkpoint/{n}.h5"] //= 2
    done = petfsi("resume", run, ranks=ranks)
    is_clear(done, "no checkpoint can be read", "start again with 'petfsi run")
    assert done.returncode == 2
    assert {p: p.stat().st_size for p in run.rglob("*") if p.name != "log.txt"} == before


def test_what_cannot_be_resumed_is_refused(run, here, tmp_path):
    def refused(*words, said):
        done = here(*words)
        is_clear(done, said)
        assert done.returncode == 2

    refused("resume", tmp_path, said="is not the directory of a run")
    refused("resume", tmp_path / "nowhere", said="nowhere is not the directory of a run")
    refused(
        "resume",
        run,
        "--set",
        "fluid.density=3",
        said="--set fluid.density=3: a run that goes on may change time.end, time.dt, ",
    )
    refused("resume", run, "--set", "time.end=-1", said="time.end = -1: must be greater than 0")
    refused("run", run / "scene.toml", "--out", run, said="holds a run already; continue it with 'petfsi resume")
    refused("resume", run, "-fsi_ksp_typo", "cg", said="did you mean -fsi_ksp_type?")
    refused("run", run, "--out", tmp_path / "new", said="is a folder; a scene is a TOML file")
    scene = (run / "scene.toml").read_text()
    (run / "scene.toml").write_text(scene.replace("12", "16"))
    refused("resume", run, said="scene.toml has been changed since the checkpoint was written")
    (run / "scene.toml").unlink()
    refused("resume", run, said="scene.toml is missing: put it back")
    assert json.loads((run / "summary.json").read_text())["status"] == "done"


def test_a_damaged_history_is_named(run, here):
    lines = (run / "history.csv").read_text().splitlines()
    (run / "history.csv").write_text("\n".join([*lines[:3], "4,rubbish", *lines[4:]]) + "\n")
    done = here("resume", run, "--set", "time.end=0.6")
    is_clear(done, "history.csv, line 4: not a row of")
    assert done.returncode == 2


def wait_for(path, rows, process):
    """Return once a history has so many rows."""
    limit = time.monotonic() + 120
    while not (path.exists() and len(path.read_text().splitlines()) > rows):
        assert process.poll() is None and time.monotonic() < limit
        time.sleep(0.02)


@pytest.mark.parametrize("number, ranks", [(signal.SIGTERM, 1), (signal.SIGUSR1, 2)])
def test_a_signal_stops_the_run_and_resuming_finishes_it_alike(scene, number, ranks):
    sets = ["--set", "time.dt=0.001"]
    line = [*launcher(ranks), PETFSI, "run", str(scene), "--out", "out", *sets]
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment(), text=True
    ) as process:
        wait_for(Path("out/history.csv"), 20, process)
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 75, err
    stopped = json.loads(Path("out/summary.json").read_text())
    step = stopped["steps"]
    assert stopped["status"] == "stopped" and 20 <= step < 500 and is_tidy("out")
    assert f"stopped by {signal.Signals(number).name} after step {step}; go on with: petfsi resume out" in out
    assert Path(f"out/checkpoint/{step:06d}.h5").is_file()
    assert petfsi("resume", "out", "--steps", 10, ranks=ranks).returncode == 0
    if ranks > 1:
        return
    # the solver starts afresh at a checkpoint, so the run that nothing stops has one there, too
    steps = ["--steps", str(step + 10)]
    every = ["--set", f"checkpoint.every={0.001 * step}"]
    assert petfsi("run", scene, "--out", "straight", *sets, *steps, *every, ranks=ranks).returncode == 0
    assert Path("out/history.csv").read_bytes() == Path("straight/history.csv").read_bytes()


@pytest.mark.parametrize("ranks", [1, 2])
def test_the_wall_limit_stops_the_run_in_time(scene, ranks):
    done = petfsi("run", scene, "--out", "out", "--set", "time.dt=0.00001", "--wall-limit", "2", ranks=ranks)
    assert done.returncode == 75, done.stderr
    assert "stopped by the wall-time limit of 2 s" in done.stdout and "Traceback" not in done.stderr
    assert json.loads(Path("out/summary.json").read_text())["status"] == "stopped" and is_tidy("out")
    assert list(Path("out/checkpoint").glob("*.h5"))


# ---- on two ranks -------------------------------------------------------------------------------------------


@pytest.mark.launches
def test_ranks_that_the_grid_cannot_feed(scene):
    done = petfsi("run", scene, "--out", "out", ranks=3)
    is_refused(done, "out", "fluid.cells = [12, 8]: 3 ranks cannot share this grid", "that works is 2")


@pytest.mark.launches
@pytest.mark.parametrize(
    "text, words, said",
    [
        (SCENES["infinite solid"][0], [], "it must be finite"),
        (SCENES["overlapping obstacle"][0], [], "overlaps obstacles.stone"),
        (replaced(BLOCK, '{ mesh = "block.vtk" }'), [], "cannot be read as a mesh"),
        (SCENE, OPTIONS["misspelt"][0], "did you mean -fsi_ksp_rtol?"),
        (SCENE, ["--set", 'fluid.initial.velocity=["log(x-0.2)", 0]'], "it must be finite"),
    ],
    ids=["expression", "obstacle", "mesh", "option", "on one rank only"],
)
def test_two_ranks_refuse_with_one_voice(scene, text, words, said):
    scene.write_text(text)
    Path("block.vtk").write_bytes(b"garbage")
    is_refused(petfsi("run", scene, "--out", "out", *words, ranks=2), "out", said)


@pytest.mark.launches
def test_a_log_of_mpirun_has_no_escape_codes(scene):
    slowly = ["--set", "fluid.sides.left.inflow.ramp=0.2"]
    done = petfsi("run", scene, "--out", "out", "--steps", 2, *slowly, ranks=2)
    assert done.returncode == 0 and "\x1b" not in done.stdout
    lines = [line[:6] for line in done.stdout.splitlines() if line.startswith(("step", "stopped by"))]
    assert lines == ["step 1", "step 2", "stoppe"]


def test_a_reader_who_leaves_does_not_end_the_run(scene):
    line = f"{PETFSI} run {scene} --out out | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, env=environment(), timeout=180)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(Path("out/summary.json").read_text())["status"] == "done"
