"""Whole runs through the command: schemes and ranks against each other, killed and resumed, and what is skipped."""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from processes import environment, launcher

from petfsi.bench.case import job, simulation
from petfsi.output.history import read_history
from petfsi.solving.options import shipped_options

SCENES = Path(__file__).parent / "scenes"
BAR = SCENES / "bar2d.toml"
PETFSI = Path(sys.executable).with_name("petfsi")


def command(*words, ranks=1):
    return [*map(str, (*launcher(ranks), PETFSI, *words))]


def petfsi(*words, ranks=1):
    done = subprocess.run(command(*words, ranks=ranks), capture_output=True, text=True, timeout=300, env=environment())
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def summary(directory):
    return json.loads((directory / "summary.json").read_text())


def last_output(directory):
    """Every dataset of the last output and the last checkpoint, by name."""
    arrays = {}
    for folder in ("fields", "checkpoint"):
        path = sorted((directory / folder).glob("[0-9]*.h5"))[-1]
        with h5py.File(path) as file:
            file.visititems(
                lambda name, item, folder=folder: (
                    arrays.update({f"{folder}/{name}": item[()]}) if isinstance(item, h5py.Dataset) else None
                )
            )
    return arrays


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Run the bar to its end, never interrupted; by rank count and kept for the module."""
    runs = {}

    def run(ranks):
        if ranks not in runs:
            runs[ranks] = tmp_path_factory.mktemp("straight") / str(ranks)
            petfsi("run", BAR, "--out", runs[ranks], ranks=ranks)
        return runs[ranks]

    return run


def children(parent):
    """Return the processes whose parent this one is (as /proc says)."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
    return found


def run_until_killed(directory, step, ranks):
    """Start the bar and kill every process of it once that step is in the history."""
    process = subprocess.Popen(
        command("run", BAR, "--out", directory, ranks=ranks),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
    )
    history = directory / "history.csv"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if history.exists() and history.read_text().count("\n") > step + 1:
            break
        time.sleep(0.005)
    # mpirun gives its ranks process groups of their own
    for pid in (process.pid, *children(process.pid)):
        os.kill(pid, signal.SIGKILL)
    process.wait()
    assert summary(directory)["status"] == "running", "the run ended before it was killed"


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_killed_run_resumes_bit_for_bit(ranks, straight, tmp_path):
    step = int(np.random.default_rng().integers(7, 25))
    run_until_killed(tmp_path / "run", step, ranks)
    petfsi("resume", tmp_path / "run", ranks=ranks)
    want, got = last_output(straight(ranks)), last_output(tmp_path / "run")
    assert want.keys() == got.keys()
    different = [name for name in want if not np.array_equal(want[name], got[name])]
    assert not different, f"killed after step {step}"
    assert (straight(ranks) / "history.csv").read_bytes() == (tmp_path / "run" / "history.csv").read_bytes()


@pytest.mark.parametrize(
    "ranks, integrator, options", [(1, "midpoint", ("-fsi_snes_type", "newtonls")), (2, "bdf2", ())]
)
def test_a_stopped_run_goes_on_bit_for_bit(ranks, integrator, options, tmp_path):
    """Of so light a bar, whose preconditioner is made in every step; all others stop as in ``test_restart``."""
    dt = "(1 + 0.4*sin(20*t))/30"
    sets = (*options, "--set", f"time.integrator={integrator}", "--set", f"time.dt='{dt}'", "--set", "time.end=0.3")
    sets = (*sets, "--set", "checkpoint.every=0.11")
    for name, steps in (("straight", ()), ("stopped", ("--steps", 6))):
        petfsi("run", BAR, "--out", tmp_path / name, *sets, *steps, ranks=ranks)
    petfsi("resume", tmp_path / "stopped", ranks=ranks)
    want, got = last_output(tmp_path / "straight"), last_output(tmp_path / "stopped")
    assert want.keys() == got.keys() and len(want) > 10
    different = [name for name in want if not np.array_equal(want[name], got[name])]
    assert not different
    histories = [(tmp_path / name / "history.csv").read_bytes() for name in ("straight", "stopped")]
    assert histories[0] == histories[1]
    history = read_history(tmp_path / "straight" / "history.csv")
    np.testing.assert_allclose(np.cumsum(history["dt"][1:]), history["time"][1:], rtol=1e-14)
    assert history["time"][-1] == 0.3 and np.ptp(history["dt"][1:]) > 0.005


@pytest.mark.parametrize("ranks, integrator", [(2, "static"), (1, "symplectic-euler")])
def test_a_stopped_run_of_a_solid_alone_goes_on_bit_for_bit(integrator, ranks, tmp_path):
    """In statics under a growing load; explicitly in sub-steps whose number changes."""
    texts = {
        "static": ("gravity=[0, '-2*t']", "time.dt='(1 + t)/20'", "time.end=0.8", "checkpoint.every=0.3"),
        "symplectic-euler": (
            "time.dt='(1 + 20*t)/1000'",
            "time.above_limit=subcycle",
            "time.end=0.03",
            "checkpoint.every=0.01",
        ),
    }[integrator]
    words = [f"time.integrator={integrator}", "solids.strip.material=neohookean", *texts]
    words.append("solids.strip.shape.box.cells=[12, 2]")
    sets = [word for text in words for word in ("--set", text)]
    for name, steps in (("straight", ()), ("stopped", ("--steps", 7))):
        petfsi("run", SCENES / "beam.toml", "--out", tmp_path / name, *sets, *steps, ranks=ranks)
    petfsi("resume", tmp_path / "stopped", ranks=ranks)
    histories = [(tmp_path / name / "history.csv").read_bytes() for name in ("straight", "stopped")]
    assert histories[0] == histories[1]
    history = read_history(tmp_path / "straight" / "history.csv")
    column = {"static": "newton", "symplectic-euler": "substeps"}[integrator]
    assert len(history["step"]) > 12 and history[column].max() > 1 and abs(history["tip.y"][-1]) > 1e-3


@pytest.mark.parametrize("ranks", [2])
def test_divided_cells_go_on_bit_for_bit(ranks, tmp_path):
    for name, steps in (("straight", ()), ("stopped", ("--steps", 9))):
        petfsi("run", SCENES / "sheet.toml", "--out", tmp_path / name, *steps, ranks=ranks)
    petfsi("resume", tmp_path / "stopped", ranks=ranks)
    want, got = last_output(tmp_path / "straight"), last_output(tmp_path / "stopped")
    assert want.keys() == got.keys()
    assert not [name for name in want if not np.array_equal(want[name], got[name])]
    histories = [(tmp_path / name / "history.csv").read_bytes() for name in ("straight", "stopped")]
    assert histories[0] == histories[1]


def test_a_step_that_is_not_positive_ends_the_run_with_its_time(tmp_path):
    done = subprocess.run(
        command("run", SCENES / "beam.toml", "--out", tmp_path / "run", "--set", "time.dt='0.02 - t/4'"),
        capture_output=True, text=True, timeout=300, env=environment(),
    )  # fmt: skip
    assert done.returncode == 3
    assert "time.dt = '0.02 - t/4'" in done.stderr and "at t = 0.0" in done.stderr
    assert "must be greater than" in done.stderr and summary(tmp_path / "run")["status"] == "failed"


@pytest.mark.launches
@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_two_ranks_and_then_three_equal_one_with_any_integrator(integrator, tmp_path):
    sets = ("--set", f"time.integrator={integrator}", "--set", "output={}", "--set", "time.end=0.4")
    options = ("-options_file", "monolithic-direct.opts")
    petfsi("run", BAR, "--out", tmp_path / "one", *sets, *options)
    petfsi("run", BAR, "--out", tmp_path / "two", *sets, *options, "--steps", 5, ranks=2)
    petfsi("resume", tmp_path / "two", ranks=3)
    one, two = (read_history(tmp_path / name / "history.csv") for name in ("one", "two"))
    for name in ("tip.x", "tip.y"):
        np.testing.assert_allclose(two[name], one[name], rtol=0, atol=1e-8 * np.abs(one[name]).max())


@pytest.mark.launches
def test_two_ranks_go_on_as_three(straight, tmp_path):
    petfsi("run", BAR, "--out", tmp_path / "run", "--steps", 13, ranks=2)
    petfsi("resume", tmp_path / "run", ranks=3)
    want, got = last_output(straight(2)), last_output(tmp_path / "run")
    for name in want:
        np.testing.assert_allclose(got[name], want[name], rtol=0, atol=1e-8 * np.abs(want[name]).max(initial=1.0))


@pytest.mark.launches
def test_any_number_of_ranks_gives_the_same_history(tmp_path):
    histories = []
    for ranks in (1, 2, 3, 4):
        options = ("-options_file", "monolithic-direct.opts", "--set", "output={}", "--steps", 12)
        petfsi("run", BAR, "--out", tmp_path / str(ranks), *options, ranks=ranks)
        histories.append(read_history(tmp_path / str(ranks) / "history.csv"))
    for other in histories[1:]:
        for name in ("tip.x", "tip.y"):
            scale = np.abs(histories[0][name]).max()
            np.testing.assert_allclose(other[name], histories[0][name], rtol=0, atol=1e-8 * scale)


@pytest.mark.parametrize("options", shipped_options(), ids=lambda path: path.stem)
@pytest.mark.parametrize("ranks", [1, 2])
def test_every_option_of_a_shipped_file_is_read_and_converged_schemes_agree(options, ranks, tmp_path):
    # an option of one's own file that nothing reads ends the run; so heavy a bar lets the iterated splitting converge
    options = shutil.copy(options, tmp_path / f"own-{options.name}")
    heavy = ("--set", "solids.bar.density=5000", "--set", "output={}", "--steps", 3)
    if "solid-large" in options.name:  # of solids alone
        petfsi(
            "run", SCENES / "beam.toml", "--out", tmp_path / "run", "--steps", 3, "-options_file", options, ranks=ranks
        )
        return
    petfsi("run", BAR, "--out", tmp_path / "run", *heavy, "-options_file", options, ranks=ranks)
    if options.name == "own-split.opts":
        return  # its answer is another one: see test_splitting
    petfsi("run", BAR, "--out", tmp_path / "direct", *heavy, "-options_file", "monolithic-direct.opts")
    got, want = (read_history(tmp_path / name / "history.csv")["tip.x"][-1] for name in ("run", "direct"))
    assert got == pytest.approx(want, rel=1e-6)


def test_a_tank_without_solids_has_no_nest_and_assembles_once(tmp_path):
    code = "import sys; from petfsi.cli import main; status = main(sys.argv[1:]); print(*sys.modules); sys.exit(status)"
    words = ("run", SCENES / "tank.toml", "--out", tmp_path / "run")
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True, timeout=300, env=environment()
    )
    assert done.returncode == 0, done.stderr
    modules = done.stdout.splitlines()[-1].split()
    assert "petfsi.fields.mac.fluid" in modules
    assert not [m for m in modules if m.startswith(("petfsi.fields.solid.", "petfsi.couplings.ray", "matplotlib"))]
    told = summary(tmp_path / "run")
    assert told["assemblies"] == {"pressure": 1}
    assert told["unknowns"] == {"pressure": 1024}
    assert any("no [solids]" in line for line in told["skipped"])
    assert read_history(tmp_path / "run" / "history.csv")["divergence"][1:].max() < 1e-8


def test_a_solid_alone_has_no_fluid(tmp_path):
    petfsi("run", SCENES / "beam.toml", "--out", tmp_path / "run")
    told = summary(tmp_path / "run")
    accounts = ["momentum.x", "momentum.y", "kinetic", "elastic", "potential", "dissipated", "boundary_work"]
    assert list(told["conservation"]) == ["volume_error", *accounts, "energy_residual"]
    history = read_history(tmp_path / "run" / "history.csv")
    assert list(history)[-8:] == [*accounts, "energy_residual"]
    assert history["energy_residual"][-1] == told["conservation"]["energy_residual"]
    assert told["unknowns"].keys() == {"solid"}
    assert any("no [fluid]" in line for line in told["skipped"])


def test_a_run_without_accounts_has_no_columns_for_them(tmp_path):
    petfsi("run", SCENES / "tank.toml", "--out", tmp_path / "run", "--steps", 2, "--set", "output.accounts=false")
    petfsi("resume", tmp_path / "run", "--steps", 1)
    assert list(read_history(tmp_path / "run" / "history.csv"))[-2:] == ["volume_error", "divergence"]
    assert list(summary(tmp_path / "run")["conservation"]) == ["volume_error"]


def test_a_solid_that_cannot_move_is_coupled_once(tmp_path):
    hold = "solids.bar.supports=[{where='all', fix=['x', 'y']}]"
    petfsi("run", BAR, "--out", tmp_path / "run", "--set", hold, "--steps", 5)
    told = summary(tmp_path / "run")
    assert told["assemblies"]["pressure"] == 1
    assert told["assemblies"]["pressure-solid"] == 1


def test_a_closed_cavity_keeps_its_volume(tmp_path):
    scene = Path(__file__).parents[1] / "jobs" / "cavity.toml"
    coarse = ("--set", "fluid.cells=[48, 40]", "--set", "solids.box.shape.box.cells=[24, 24]", "--set", "output={}")
    petfsi("run", scene, "--out", tmp_path / "run", *coarse, "--steps", 20)
    history = read_history(tmp_path / "run" / "history.csv")
    assert np.abs(history["lid.x"]).max() > 5e-3  # it does move
    assert history["volume_error"][1:].max() < 1e-9
    # of the geometry itself: what is left is the step's error of second order
    np.testing.assert_allclose(history["region_volume.1"], 0.25, rtol=5e-4)


def test_memory_does_not_grow_with_the_steps():
    def used():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    scene = job(MPI.COMM_SELF, "cavity", {"fluid.cells": [24, 20], "solids.box.shape.box.cells": [12, 12]})
    with simulation(MPI.COMM_SELF, scene, "monolithic.opts") as sim:
        for _ in range(50):
            sim.advance()
        before = used()
        for _ in range(150):
            sim.advance()
    # what a step makes and drops is about 50 kB here
    assert used() - before < 2e6


@pytest.mark.parametrize("scene, name", [(BAR, "bar"), (SCENES / "beam.toml", "strip")], ids=["coupled", "alone"])
@pytest.mark.parametrize("material", ["neohookean", "stable-neohookean"])
def test_a_second_process_compiles_nothing(scene, name, material, tmp_path, monkeypatch):
    """Compiled loops are kept on disk; a closure over another compiled function would be compiled anew every time."""
    monkeypatch.setenv("NUMBA_DEBUG_CACHE", "1")
    for _ in range(2):
        words = ("--steps", 2, "--set", f"solids.{name}.material={material}")
        said = petfsi("run", scene, "--out", tmp_path / "out", "--overwrite", *words)
    assert "[cache] data loaded" in said and "[cache] data saved" not in said
