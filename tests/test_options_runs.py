"""Options as runs meet them: nothing reaches in from outside, sweeps, and what PETSc refuses. About a minute."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import environment, launcher

from petfsi import cli
from petfsi.output import files
from petfsi.output.checkpoint import change_records

SCENE = Path(__file__).parent / "scenes" / "sweep.toml"
PRESSURE = "-fsi_fieldsplit_pressure_"


@pytest.fixture
def run(tmp_path, monkeypatch, capfd):
    """Return a function that runs a command in this process, in an empty folder: its exit code and what it said."""
    monkeypatch.chdir(tmp_path)

    def call(*words, out="out", command=("run", str(SCENE), "--steps", "1")):
        before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)}
        capfd.readouterr()
        target = ("--out", out) if command[0] == "run" else (out,)
        code = cli.main([*command, *target, *words])
        for number, handler in before.items():
            signal.signal(number, handler)
        said, told = capfd.readouterr()
        assert "Traceback" not in told and "defect" not in told and "PETSC ERROR" not in told, told
        assert sum(1 + len(line) // 120 for line in told.splitlines()) <= 24, told
        if code == 2 and command[0] == "run":
            assert not Path(out).exists()
        return code, said + told

    return call


# ---- from outside -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ranks", [1, 2])
def test_no_petscrc_is_read(ranks, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    for name in (tmp_path / ".petscrc", tmp_path / "petscrc", home / ".petscrc"):
        name.write_text("-fsi_ksp_type bogus\n-log_view :evil.txt\n-info evil\n")
    words = [*launcher(ranks), sys.executable, "-m", "petfsi.cli", "run", SCENE, "--out", "out", "--steps", 1]
    given = environment(HOME=str(home), PETSC_OPTIONS="-fsi_ksp_rtol 1e-8", PETSC_OPTIONS_YAML="fsi_ksp_type: bogus")
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, env=given, cwd=tmp_path, timeout=180)
    assert done.returncode == 0, done.stderr
    assert (
        "option -fsi_ksp_rtol 1e-8 (PETSC_OPTIONS), not 1e-9 (monolithic.opts)"
        in (tmp_path / "out/log.txt").read_text()
    )
    assert "-fsi_ksp_rtol 1e-8  # PETSC_OPTIONS\n" in (tmp_path / "out/options.opts").read_text()
    assert sorted(os.listdir(tmp_path)) == [".petscrc", "home", "out", "petscrc"]


def test_the_environment_loses_to_the_command_line_and_is_checked_as_it_is(run, monkeypatch):
    monkeypatch.setenv("PETSC_OPTIONS", "-fsi_ksp_rtol 1e-4 -log_view :evil.txt")
    code, said = run()
    assert code == 2 and "PETSC_OPTIONS: option -log_view :evil.txt: wants no value" in said
    monkeypatch.setenv("PETSC_OPTIONS", "-fsi_ksp_rtol 1e-4 -fsi_ksp_rtoll 1 -ksp_rtol 1")
    code, said = run()
    assert code == 2 and "PETSC_OPTIONS: option -fsi_ksp_rtoll: no solver of this scene reads it; did you mean" in said
    monkeypatch.setenv("PETSC_OPTIONS", "-fsi_ksp_rtol 1e-4 -ksp_rtol 1")
    code, said = run("-fsi_ksp_rtol", "1e-7")
    assert code == 0 and "-fsi_ksp_rtol 1e-7 (command line), not 1e-4 (PETSC_OPTIONS)" in said
    assert "warning: option -ksp_rtol was read by nothing" in said
    assert os.environ["PETSC_OPTIONS"] == "-fsi_ksp_rtol 1e-4 -ksp_rtol 1"


@pytest.mark.parametrize(
    "line",
    [
        "-fsi_pc_python_type evil.Thing",
        "-fsi_ksp_view :../evil.txt",
        "-fsi_ksp_monitor ascii:evil.txt",
        "-dll_append ./evil.so",
        "-options_file ../evil.opts",
        "-fsi_ksp_rtol 1e-9 -fsi_ksp_view :evil",
    ],
)
def test_a_crafted_run_directory_neither_runs_code_nor_writes(line, run, tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text("from pathlib import Path\nPath('ran').touch()\nclass Thing: pass\n")
    (tmp_path / "evil.opts").write_text("-history evil\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run()[0] == 0
    options = Path("out/options.opts")
    options.write_text(options.read_text() + line + "\n")
    assert "options.opts has been changed since the checkpoint was written" in run(command=("resume",))[1]
    crafted = files.digest(options)[1]
    change_records(Path("out/checkpoint"), lambda known: known.model_copy(update={"options": (crafted,)}))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    code, said = run(command=("resume",))
    assert code == 2 and re.search(r"(options|evil)\.opts, line \d+: ", said), said
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before


def test_paths_with_blanks_are_paths(run):
    Path("a folder").mkdir()
    Path("a folder/my # options.opts").write_text("-options_file monolithic-direct.opts\n-fsi_ksp_view\n")
    code, said = run("-options_file", "a folder/my # options.opts", out="a folder/out")
    assert code == 0 and "KSP Object: (fsi_)" in said
    assert "-fsi_ksp_view  # a folder/my # options.opts\n" in Path("a folder/out/options.opts").read_text()


# ---- sweeps -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        "-fsi_ksp_type preonly -fsi_pc_type lu -fsi_mat_type aij",
        "-fsi_pc_fieldsplit_type multiplicative",
        f"{PRESSURE}ksp_type preonly",
        f"{PRESSURE}ksp_type fgmres",
        f"{PRESSURE}mg_levels_ksp_type richardson {PRESSURE}mg_levels_pc_type jacobi",
        "-fsi_ksp_type fgmres -fsi_fieldsplit_solid_pc_type gamg",
        "-options_file split.opts -fsi_ksp_type gmres -fsi_ksp_rtol 1e-8",
        "-options_file monolithic-direct.opts -fsi_pc_factor_mat_solver_type petsc",
        "-options_file monolithic-paper.opts -fsi_ksp_type gmres -fsi_sub_pc_type lu",
    ],
)
def test_a_type_is_swept_without_what_hung_on_the_default(words, run):
    code, said = run(*words.split())
    assert code == 0, said
    assert float(re.search(r" res (\d\S+)", said)[1]) < 1e-7
    assert re.search(r"option -\S+_type \S+ \(command line\), not ", Path("out/log.txt").read_text())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"-fsi_pc_type lu -fsi_mat_type aij {PRESSURE}ksp_rtol 1e-3",
         f"{PRESSURE}ksp_rtol: no solver of this scene reads it; it needs -fsi_pc_type fieldsplit, which is lu"),
        (f"{PRESSURE}ksp_type preonly {PRESSURE}ksp_rtol 1e-3", f"; {PRESSURE}ksp_type preonly (command line) does"),
        ("-fsi_pc_fieldsplit_type additive -fsi_pc_fieldsplit_schur_fact_type full", "needs -fsi_pc_fieldsplit_type"),
        ("-fsi_snes_rtol 1e-3", "it needs -fsi_snes_type newtonls, which is not given"),
        (f"{PRESSURE}pc_hypre_type euclid", f"it needs {PRESSURE}pc_type hypre, which is mg (monolithic.opts)"),
        ("-fsi_fieldsplit_liquid_ksp_type cg", "the fields of this scene are solid, pressure"),
        ("-fsi_ksp_rtol -1", "option -fsi_ksp_rtol -1: is out of range; wanted a number from 0 to 0.999"),
        ("-fsi_mat_type aij", "option -fsi_mat_type aij: PETSc cannot set this solver up: petfsi's"),
        ("-fsi_fieldsplit_solid_pc_type python", "option -fsi_fieldsplit_solid_pc_type python: PETSc cannot"),
        ("-fsi_ksp_type preonly -fsi_ksp_initial_guess_nonzero", "doesn't make sense with nonzero initial guess"),
        ("-fsi_snes_type newtonls -fsi_snes_linesearch_type bogus", "option -fsi_snes_linesearch_type bogus"),
        ("-fsi_fieldsplit_solid_redundant_pc_factor_mat_solver_type bogus", "mat_solver_type bogus: PETSc cannot"),
    ],
    ids=lambda text: text[:60],
)  # fmt: skip
def test_a_refusal_names_what_the_user_gave(words, said, run):
    code, told = run(*words.split())
    assert code == 2 and said in told, told
    assert len(told.splitlines()) == 1, told


def test_a_solver_that_cannot_be_freed_either_leaves_no_traceback(tmp_path):
    """hypre refuses to be set up, and to be taken down: PETSc says so once more when the process ends."""
    given = "-fsi_pc_type hypre -fsi_mat_type aij -fsi_pc_hypre_boomeramg_strong_threshold 3".split()
    command = [sys.executable, "-m", "petfsi.cli", "run", str(SCENE), "--out", "away", *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment(), cwd=tmp_path)
    assert done.returncode == 2 and "Error in HYPRE_BoomerAMGSetStrongThreshold" in done.stderr
    assert "Traceback" not in done.stderr and len(done.stderr.splitlines()) <= 2, done.stderr
