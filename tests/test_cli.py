import io
import re
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from mpi4py import MPI
from processes import environment, launcher

from petfsi import __version__, cli
from petfsi.errors import InputError, SolveError
from petfsi.fields.solid import SimplexSolid
from petfsi.runs.console import LAUNCHERS, Console
from petfsi.runs.plan import DEFAULT_OPTIONS, default_options, describe_plan, skipped
from petfsi.scene.load import scene_from_dict

SCENE = """
title = "A sheet in a duct"
dim = 2
[time]
end = 1.0
dt = 0.1
[fluid]
density = 1000.0
origin = [0.0, 0.0]
size = [2.0, 1.0]
cells = [8, 4]
[solids.sheet]
shape = { box = { origin = [0.5, 0.0], size = [0.25, 0.5], cells = [2, 4] } }
density = 1200.0
young = 1.0e5
poisson = 0.3
[output]
every = 0.3
"""


JOBS = Path(__file__).parents[1] / "jobs"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "sheet.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def calls(monkeypatch):
    """Stand in for the solver; return what it was called with."""
    seen: list = []
    module = types.ModuleType("petfsi.runs.run")
    module.run_scene = lambda *args: seen.append(args) or 0
    module.resume_run = lambda *args: seen.append(args) or 75
    monkeypatch.setitem(sys.modules, "petfsi.runs.run", module)
    monkeypatch.setattr(cli, "_start_petsc", lambda words, comm: None)
    return seen


def fail_with(monkeypatch, error):
    def work(*_args):
        raise error

    sys.modules["petfsi.runs.run"].run_scene = work


def petfsi(*args, ranks=0, code=None, **variables):
    """Run petfsi, or a piece of Python, as a user does: in a process of its own."""
    what = ["-c", code] if code else ["-m", "petfsi.cli"]
    command = [*launcher(ranks), sys.executable, *what, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(**variables), timeout=180)


# ---- what is passed on --------------------------------------------------------------------------------------


def test_run_passes_everything_on(scene, calls):
    status = cli.main(
        ["run", str(scene), "--set", "time.dt=0.05", "-fsi_ksp_rtol", "1e-6", "--out", "somewhere", "-log_view"]
        + ["--steps=7", "-shift", "-1.5", "--overwrite", "--wall-limit", "60", "-options_file", "split.opts"]
        + ["--set", "solids.sheet.young=2e5", "--from", "runs/old"]
    )
    assert status == 0
    (loaded, out, steps, petsc, wall_limit, overwrite, sets, source) = calls[0]
    assert loaded.time.dt == 0.05 and loaded.solids["sheet"].young == 2e5
    assert (out, steps, wall_limit, overwrite) == (Path("somewhere"), 7, 60.0, True)
    assert (sets, source) == (("time.dt=0.05", "solids.sheet.young=2e5"), Path("runs/old"))
    assert petsc == ["-fsi_ksp_rtol", "1e-6", "-log_view", "-shift", "-1.5", "-options_file", "split.opts"]


def test_run_has_defaults(scene, calls):
    assert cli.main(["run", str(scene)]) == 0
    assert calls[0][1:] == (Path("runs/sheet"), None, [], None, False, (), None)


def test_resume_passes_everything_on(calls):
    assert cli.main(["resume", "runs/a", "--set", "time.end=2", "--steps", "3", "-fsi_pc_type", "lu"]) == 75
    assert calls == [(Path("runs/a"), 3, ["-fsi_pc_type", "lu"], None, ["time.end=2"])]


def test_plot_names_its_pictures(monkeypatch, capsys):
    module = types.ModuleType("petfsi.output.pictures")
    module.plot_run = lambda directory, wanted, kind: [directory / f"{wanted}.{kind}"]
    monkeypatch.setitem(sys.modules, "petfsi.output.pictures", module)
    assert cli.main(["plot", "runs/a", "--every", "5"]) == 0
    assert capsys.readouterr().out == "runs/a/Wanted(every=5, begin=None, end=None, quantity=None).png\n"
    words = ["--quantity", "speed", "--from", "0", "--to", "2.5", "--format", "svg"]
    assert cli.main(["plot", "runs/a", *words]) == 0
    assert capsys.readouterr().out == "runs/a/Wanted(every=1, begin=0.0, end=2.5, quantity='speed').svg\n"


# ---- what is refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "args, said",
    [
        (["run", "SCENE", "--stesp", "3"], "--steps"),
        (["run", "SCENE", "--fsi_ksp_type", "cg"], "No such option"),
        (["run", "SCENE", "-steps", "3"], "'-steps': petfsi's own options have two dashes: --steps"),
        (["run", "SCENE", "-out", "x"], "two dashes: --out"),
        (["run", "SCENE", "--steps", "0"], "Invalid value for '--steps'"),
        (["run", "SCENE", "--steps", "many"], "Invalid value for '--steps'"),
        (["run", "SCENE", "--wall-limit", "0"], "Invalid value for '--wall-limit'"),
        (["run", "SCENE", "--out"], "requires an argument"),
        (["run", "SCENE", "stray"], "unexpected extra argument (stray)"),
        (["run"], "Missing argument 'SCENE'"),
        (["run", "-log_view", "SCENE"], "Give it before the PETSc options"),
        (["runn"], "No such command 'runn'"),
        (["resume"], "Missing argument 'DIR'"),
        (["resume", "runs/a", "--overwrite"], "No such option"),
        (["plot", "runs/a", "--every", "0"], "Invalid value for '--every'"),
        (["plot", "runs/a", "--from", "nan"], "Invalid value for '--from': 'nan' is no number"),
        (["plot", "runs/a", "--format", "gif"], "Invalid value for '--format'"),
        (["plot", "runs/a", "--film", "--format", "pdf"], "--format is that of pictures"),
        (["plot", "runs/a", "-fsi_pc_type"], "No such option"),
        (["run", "SCENE", "--set", "time.dt"], "must be key=value"),
        (["run", "SCENE", "--set", "time.dtt=1"], "did you mean 'dt' (s)?"),
        (["check", "SCENE", "--set", "fluid.density=-1"], "must be greater than 0 (kg/m^3)"),
        (["run", "missing.toml"], "missing.toml: no such file"),
        (["check", "."], "is a folder"),
    ],
)
def test_a_mistake_on_the_command_line_ends_in_2(scene, calls, capsys, args, said):
    assert cli.main([str(scene) if a == "SCENE" else a for a in args]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.out == "" and "Traceback" not in captured.err
    assert calls == []


def test_click_tells_the_same_exit_code(scene, calls):
    runner = CliRunner()
    assert runner.invoke(cli.cli, ["run", str(scene)]).exit_code == 0
    assert runner.invoke(cli.cli, ["run", str(scene), "--stesp", "3"]).exit_code == 2
    assert runner.invoke(cli.cli, ["resume", "runs/a"]).exit_code == 75
    assert runner.invoke(cli.cli, ["--version"]).output == f"petfsi {__version__}\n"


# ---- how commands end ---------------------------------------------------------------------------------------


class NoMemoryInPetsc(RuntimeError):
    """As PETSc's own error says that it could not allocate."""

    ierr = 55


@pytest.mark.parametrize(
    "error, code, said",
    [
        (InputError("solids.a.density = -1: must be greater than 0"), 2, "petfsi: solids.a.density = -1: must be"),
        (SolveError("step 3: DIVERGED"), 3, "petfsi: step 3: DIVERGED\n"),
        (KeyboardInterrupt(), 130, "petfsi: interrupted\n"),
        (MemoryError(), 1, "'petfsi check' estimates what a scene needs"),
        (NoMemoryInPetsc(), 1, "'petfsi check' estimates what a scene needs"),
        (OSError(28, "No space left on device", "history.csv"), 1, "petfsi: history.csv: No space left on device\n"),
        (ZeroDivisionError("division\nby zero"), 1, "ZeroDivisionError: division by zero (at petfsi/cli.py:"),
        (RuntimeError("x" * 1000), 1, "this is a defect in petfsi; set PETFSI_TRACEBACK=1"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_each_error_has_its_exit_code_and_no_traceback(scene, calls, monkeypatch, capsys, error, code, said):
    fail_with(monkeypatch, error)
    assert cli.main(["run", str(scene)]) == code
    captured = capsys.readouterr()
    assert said in captured.err and captured.out == "" and "Traceback" not in captured.err
    assert len(captured.err.splitlines()) == 1 and len(captured.err) < 600


def test_a_traceback_comes_when_it_is_asked_for(scene, calls, monkeypatch, capsys):
    fail_with(monkeypatch, ZeroDivisionError("here"))
    monkeypatch.setenv("PETFSI_TRACEBACK", "1")
    assert cli.main(["run", str(scene)]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


def test_help_costs_no_heavy_import():
    code = "import sys; from petfsi import cli; cli.main(['run', '--help']); print(sorted(sys.modules))"
    modules = petfsi(code=code).stdout.splitlines()[-1]
    for name in ("'petsc4py'", "'mpi4py'", "'numba'", "'matplotlib'", "'numpy'", "'pydantic'"):
        assert name not in modules


def test_a_mistake_is_told_before_petsc_and_mpi_start(scene):
    words = ["check", str(scene), "--set", "time.dt=fast"]
    code = f"import sys; from petfsi import cli; cli.main({words!r}); print(sorted(sys.modules))"
    modules = petfsi(code=code).stdout.splitlines()[-1]
    assert "'pydantic'" in modules
    for name in ("'petsc4py.PETSc'", "'mpi4py.MPI'", "'numba'", "'matplotlib'"):
        assert name not in modules


def test_a_shell_sees_the_exit_code(scene):
    done = petfsi("check", scene)
    assert (done.returncode, done.stderr) == (0, "") and "A sheet in a duct" in done.stdout
    done = petfsi("check", scene, "--set", "time.dt=fast")
    assert done.returncode == 2 and done.stdout == ""
    assert (
        done.stderr == f"petfsi: {scene}: one mistake\n  time.dt = \"fast\": unknown name 'fast'; known are t, pi, e\n"
    )
    assert petfsi("--version").stdout == f"petfsi {__version__}\n"


TOGETHER = """
import sys
from petfsi.errors import InputError, SolveError
from petfsi.fields.solid import SimplexSolid
from petfsi.runs import ending
ending.AGREE_SECONDS = {patience}
def work(comm):
    {body}
sys.exit(ending.together(work))
"""


@pytest.mark.launches
def test_ranks_that_fail_together_speak_once():
    done = petfsi(ranks=2, code=TOGETHER.format(patience=20, body="raise SolveError('step 7: DIVERGED')"))
    assert done.returncode == 3
    assert done.stderr.count("step 7: DIVERGED") == 1


def test_a_rank_that_fails_alone_ends_the_others():
    body = "comm.Barrier() if comm.rank == 0 else [][1]"
    done = petfsi(ranks=2, code=TOGETHER.format(patience=0.5, body=body))
    assert done.returncode == 1
    assert "rank 1 of 2 failed alone: IndexError: list index out of range" in done.stderr


@pytest.mark.launches
def test_ranks_with_different_stories_tell_them_all():
    body = "raise InputError(f'rank {comm.rank} saw a mistake')"
    done = petfsi(ranks=2, code=TOGETHER.format(patience=20, body=body))
    assert done.returncode == 2
    assert "rank 0 saw a mistake" in done.stderr and "rank 1 saw a mistake" in done.stderr


@pytest.mark.launches
def test_a_broken_scene_is_reported_once_under_mpirun(scene):
    done = petfsi("run", scene, "--set", "time.dt=-1", ranks=2)
    assert done.returncode == 2
    assert done.stderr.count("time.dt = -1: must be greater than 0 (s)") == 1
    done = petfsi("run", scene, "--stesp", "1", ranks=2)
    assert done.returncode == 2 and done.stderr.count("Error: ") == 1


# ---- the plan -----------------------------------------------------------------------------------------------


def plan_scene(**changes):
    return scene_from_dict(tomllib.loads(SCENE) | changes)


def test_the_plan_counts_what_is_solved():
    plan = dict(line.split(":", 1) for line in describe_plan(plan_scene()).splitlines() if ":" in line)
    assert plan["pressure"].strip() == "32 unknowns, one per cell of 8 x 4"
    assert plan["solid"].strip() == "30 unknowns (sheet 15 nodes, 16 cells)"
    assert plan["in all"].strip() == "62 unknowns"
    assert plan["steps"].strip() == "10 of 0.1 s to 1 s, bdf2"
    assert plan["outputs"].strip().startswith("5, every 0.3 s")
    assert plan["options"].strip() == f"{DEFAULT_OPTIONS} (the default)"


def test_the_plan_says_how_long_steps_of_auto_are():
    """Of particles 0.9 of the step at the start, of which as many are counted; of others that they are not known."""
    water = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [0.6, 0.6], "spacing": 0.02,
             "sound_speed": 30.0, "fill": [{"box": {"origin": [0.0, 0.0], "size": [0.2, 0.4]}}]}  # fmt: skip
    table = {"dim": 2, "time": {"end": 0.4, "dt": "auto"}, "fluid": water}
    plan = dict(line.split(":", 1) for line in describe_plan(scene_from_dict(table)).splitlines() if ":" in line)
    step = 0.9 * float(plan["sound"].split("sound ")[1].split(" s")[0])
    number, begin = re.fullmatch(
        r" *about (\d+) to 0\.4 s: (\S+) s at the start, then nine tenths of the stable step each "
        r'\(time\.dt = "auto"\), bdf2',
        plan["steps"],
    ).groups()
    assert float(begin) == pytest.approx(step, rel=0.01) and int(number) == pytest.approx(0.4 / step, rel=0.01)
    table = tomllib.loads(SCENE) | {"time": {"end": 1.0, "dt": "auto", "integrator": "symplectic-euler"}}
    table = {key: value for key, value in table.items() if key not in ("fluid", "probes", "coupling")}
    plan = dict(line.split(":", 1) for line in describe_plan(scene_from_dict(table)).splitlines() if ":" in line)
    assert plan["steps"].strip().startswith("as many as it takes to 1 s: nine tenths of the stable step each (time.dt")


def test_the_plan_says_which_options_apply():
    text = describe_plan(plan_scene(), ["-fsi_ksp_rtol", "1e-6", "-options_file", "split.opts", "-log_view"])
    assert "options:     split.opts; over it -fsi_ksp_rtol 1e-6 -log_view\n" in text


def test_a_check_imports_nothing_of_outputs_and_leaves_its_imports_alone():
    scene = Path(__file__).parents[1] / "jobs" / "bar.toml"
    words = ["check", str(scene), "--set", "fluid.cells=[12, 8, 8]"]
    code = (
        f"import gc, sys; from petfsi import cli; cli.main({words!r}); print(gc.get_freeze_count(), gc.isenabled()); "
    )
    frozen, modules = petfsi(code=f"{code}print(sorted(sys.modules))").stdout.splitlines()[-2:]
    assert int(frozen.split()[0]) > 10_000 and frozen.split()[1] == "True"
    for name in ("'h5py'", "'petfsi.output.checkpoint'", "'petfsi.fields.sph'", "'petfsi.fields.beam'", "'matplotlib'"):
        assert name not in modules


@pytest.mark.parametrize("given, seen", [({}, "ob1"), ({"OMPI_MCA_pml": "cm"}, "cm"), ({"PMIX_RANK": "0"}, "None")])
def test_a_process_alone_looks_for_no_network_unless_it_is_told_to(given, seen, monkeypatch):
    for name in ("OMPI_MCA_pml", *LAUNCHERS):
        monkeypatch.delenv(name, raising=False)
    code = """
import os, sys
class Seen:
    def find_spec(self, name, path=None, target=None):
        if name == "mpi4py.MPI":
            print(os.environ.get("OMPI_MCA_pml"))
            raise ImportError
from petfsi.runs.ending import start_mpi
sys.meta_path.insert(0, Seen())
try:
    start_mpi()
except ImportError:
    print(os.environ.get("OMPI_MCA_pml"))
"""
    before = given.get("OMPI_MCA_pml", "None")
    assert petfsi(code=code, **given).stdout.split() == [seen, before]


def test_help_tells_no_range_that_has_no_ends(here):
    told = " ".join(here("plot", "--help").stdout.split())
    assert "--from T Draw outputs from this time on, s. --to T Draw outputs up to this time, s. --every K" in told
    assert "None" not in told


def test_a_quick_check_prints_the_plan_and_takes_no_heavy_import():
    scene = Path(__file__).parents[1] / "jobs" / "column.toml"
    words = ["check", "--quick", str(scene)]
    code = f"import sys; from petfsi import cli; cli.main({words!r}); print(sorted(sys.modules))"
    plan, modules = petfsi(code=code).stdout.rsplit("\n", 2)[:2]
    assert "first step:  not made ready here: run judges it before it writes anything\n" in plan
    for name in ("'petsc4py'", "'mpi4py'", "'numba'", "'matplotlib'", "'scipy'"):
        assert name not in modules


@pytest.mark.parametrize("where", ["left", {"box": {"origin": [-1.0] * 3, "size": [1.1, 9.0, 9.0]}}])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_plan_counts_the_middle_nodes_of_quadratic_elements(dim, where):
    """Counted from the box, and from the mesh that a place in it needs."""
    box = {"origin": [0.0] * dim, "size": [1.0] * dim, "cells": [2, 3, 1][:dim]}
    if isinstance(where, dict):
        where = {"box": {key: value[:dim] for key, value in where["box"].items()}}
    block = {"shape": {"box": box}, "density": 1.0, "young": 1.0, "poisson": 0.0, "elements": "quadratic"}
    block["supports"] = [{"where": where, "fix": ["x"]}]
    scene = scene_from_dict({"dim": dim, "time": {"end": 1.0, "dt": 0.1}, "solids": {"block": block}})
    nodes = SimplexSolid(MPI.COMM_SELF, scene).layout.n_global // dim
    assert f"block {nodes} nodes" in describe_plan(scene) and nodes == [35, 105][dim - 2]


def test_the_plan_finds_loads_that_are_nowhere():
    box = {"origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [2, 3]}
    block = {"shape": {"box": box}, "density": 1.0, "young": 1.0, "poisson": 0.0}
    block["loads"] = [{"at": [3.0, 0.0], "force": [1.0, 0.0]}, {"at": [1.0, 0.1], "force": [1.0, 0.0]}]
    scene = scene_from_dict({"dim": 2, "time": {"end": 1.0, "dt": 0.1}, "solids": {"block": block}})
    with pytest.raises(InputError, match=r"solids.block.loads.0.at = \[3.0, 0.0\]: lies 2 m away") as told:
        describe_plan(scene)
    assert len(str(told.value).splitlines()) == 1


@pytest.mark.parametrize("cells, named", [(24, "monolithic.opts"), (26, "solid-large.opts")])
def test_a_large_solid_alone_is_solved_by_multigrid(cells, named):
    box = {"origin": [0.0, 0.0, 0.0], "size": [1.0, 1.0, 1.0], "cells": [cells] * 3}
    block = {"shape": {"box": box}, "density": 1.0, "young": 1.0, "poisson": 0.0}
    scene = scene_from_dict({"dim": 3, "time": {"end": 1.0, "dt": 0.1}, "solids": {"block": block}})
    assert default_options(scene) == named
    assert f"options:     {named} (the default)" in describe_plan(scene)


def test_the_plan_counts_the_nodes_of_meshes_as_they_are_built(tmp_path):
    meshio = pytest.importorskip("meshio")
    points = [[0.5, 0.0], [1.0, 0.0], [1.0, 0.5], [0.5, 0.5]]
    meshio.Mesh(points, [("triangle", [[0, 1, 2], [0, 2, 3]])]).write(tmp_path / "square.vtk")
    solid = {"shape": {"mesh": "square.vtk"}, "density": 1.0, "young": 1.0, "poisson": 0.0}
    scene = scene_from_dict({**plan_scene().model_dump(exclude={"fluid", "solids"}), "solids": {"a": solid}}, tmp_path)
    assert "8 unknowns (a 4 nodes, 2 cells)" in describe_plan(scene)
    solid["shape"]["translate"] = [0.0, 2.0]
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [2.0, 1.0], "cells": [4, 2]}
    wet = {**plan_scene().model_dump(exclude={"fluid", "solids"}), "solids": {"a": solid}, "fluid": fluid}
    with pytest.raises(InputError, match="solids.a.shape = .*y must lie inside the fluid's grid"):
        describe_plan(scene_from_dict(wet, tmp_path))


@pytest.mark.parametrize("job", sorted(JOBS.glob("*.toml")), ids=lambda path: path.stem)
def test_a_shipped_scene_passes_its_check(job):
    done = petfsi("check", job)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "setting, said",
    [
        ("solids.disk.shape.ball.cells=7", "solids.disk.shape.ball.cells = 7: must be a multiple of 2"),
        ("solids.disk.shape.ball.radius=1.05", "solids.disk.shape: overlaps obstacles.container with"),
        ("obstacles.container.shape.ball.cells=8", "obstacles.container.shape.ball.cells = 8: only a solid's ball"),
        ("coupling.transfer=rays", "coupling.transfer = \"rays\": must be 'cutcell', 'ray', 'pressure' or 'repulsion'"),
    ],
)
def test_a_mistake_in_a_round_shape_is_named_with_exit_code_2(setting, said):
    done = petfsi("check", JOBS / "added-mass-disk.toml", "--set", setting)
    assert done.returncode == 2 and said in done.stderr


def test_the_plan_counts_the_nodes_of_a_ball():
    shape = {"ball": {"centre": [0.5, 0.5], "radius": 0.25, "cells": 6}}
    solid = {"shape": shape, "density": 1200.0, "young": 1.0e5, "poisson": 0.3}
    assert "98 unknowns (b 49 nodes, 72 cells)" in describe_plan(plan_scene(solids={"b": solid}))


@pytest.mark.parametrize("transfer", ["ray", "cutcell"])
def test_the_check_reads_the_surfaces_of_obstacles(tmp_path, transfer):
    (tmp_path / "bad.stl").write_text("no mesh")
    obstacles = {"hull": {"shape": {"mesh": "bad.stl"}}}
    data = tomllib.loads(SCENE) | {"obstacles": obstacles, "coupling": {"transfer": transfer}}
    with pytest.raises(InputError) as error:
        describe_plan(scene_from_dict(data, tmp_path))
    (line,) = str(error.value).splitlines()
    assert line.startswith("obstacles.hull.shape.mesh = ") and "cannot be read as a mesh" in line


def test_what_is_skipped_has_a_reason():
    dry = skipped(plan_scene(fluid=None))
    assert any(line.startswith("fluid, nest and coupling: the scene has no [fluid]") for line in dry)
    still = skipped(plan_scene(solids={}))
    assert any(line.startswith("solid, nest and coupling") for line in still)
    both = skipped(plan_scene())
    assert any(line.startswith("smoke") for line in both) and not any("nest" in line for line in both)


def test_info_lists_versions_prefixes_and_options_files():
    from petfsi.runs.plan import describe_info
    from petfsi.solving import options

    text = describe_info()
    assert f"petfsi:     {__version__}" in text and "PETSc:" in text and "h5py:" in text
    for prefix in ("-fsi_ ", "-fsi_fieldsplit_solid_ ", "-fsi_fieldsplit_pressure_ "):
        assert prefix in text
    assert DEFAULT_OPTIONS in text
    for path in options.shipped_options():
        line = next(line for line in text.splitlines() if line.split()[:1] == [path.name])
        assert line.endswith((".", ":")), f"{path} has no opening sentence"


# ---- the console --------------------------------------------------------------------------------------------


def test_a_batch_log_has_a_line_a_step_and_so_has_the_log_file(tmp_path, capsys):
    log = tmp_path / "log.txt"
    log.write_text("before\n")
    with Console(0, log, total=200) as console:
        console.note("petfsi: unknowns: pressure 32")
        console.step(118, 0.236, 0.002, 23, 4.1e-9, 0.814)
        console.warn("option -x was read by nothing")
    lines = [
        "petfsi: unknowns: pressure 32",
        "step 118  t 0.2360  dt 0.002  its 23  res 4.1e-09  0.81 s",
        "warning: option -x was read by nothing",
    ]
    assert capsys.readouterr().out.splitlines() == lines
    assert log.read_text().splitlines() == ["before", *lines]


def test_other_ranks_are_silent(tmp_path, capsys):
    with Console(1, tmp_path / "log.txt") as console:
        console.note("a")
        console.step(1, 0.1, 0.1, 1, 0.0, 0.0)
    assert capsys.readouterr().out == "" and not (tmp_path / "log.txt").exists()


def test_a_terminal_shows_a_bar_and_the_log_file_every_step(tmp_path, monkeypatch):
    screen = io.StringIO()
    screen.isatty = lambda: True
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    with Console(0, tmp_path / "log.txt", total=2) as console:
        console.note("[not] markup")
        for step in (1, 2):
            console.step(step, 0.1 * step, 0.1, 5, 1e-9, 0.01)
    assert "[not] markup" in screen.getvalue() and "its 5" in screen.getvalue()
    log = (tmp_path / "log.txt").read_text().splitlines()
    assert [line[:6] for line in log] == ["[not] ", "step 1", "step 2"]


def test_every_option_is_explained():
    for command in cli.cli.commands.values():
        for parameter in command.params:
            assert isinstance(parameter, click.Argument) or parameter.help
