"""How runs stop early, and what a failed or stopped one leaves to go on from. About 20 s."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from blocks import falling_block
from mpi4py import MPI
from processes import environment

from petfsi import cli
from petfsi.errors import EnergyError, FinalError, InputError, NoSolutionError, SolveError, TouchError
from petfsi.output.history import read_history
from petfsi.runs.failure import kind_of
from petfsi.runs.kept import Kept
from petfsi.runs.running import Run
from petfsi.runs.stop import SIGNALS, Stop, process_age

PETFSI = Path(sys.executable).with_name("petfsi")

#: Twelve steps.
SCENE = falling_block(0.6, 0.05, '[0.0, "-1 - t"]', more="[checkpoint]\nevery = 0.2")


@pytest.fixture
def handlers():
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def here(tmp_path, monkeypatch, capfd, handlers):
    """Return a function that runs a command in this process and returns its exit code and all that it said."""
    monkeypatch.chdir(tmp_path)
    Path("block.toml").write_text(SCENE)

    def run(*words):
        capfd.readouterr()
        code = cli.main([str(word) for word in words])
        options = sys.modules["petsc4py.PETSc"].Options()
        for name in options.getAll():
            options.delValue(name)
        return code, "".join(capfd.readouterr())

    return run


def summary(directory="out"):
    return json.loads(Path(directory, "summary.json").read_text())


def arrays(path):
    found = {}
    with h5py.File(path, driver="mpio", comm=MPI.COMM_SELF) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


# ---- signals and time ---------------------------------------------------------------------------------------


def test_signals_are_heard_unless_they_were_ignored(handlers):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for number in set(SIGNALS) - {signal.SIGHUP}:
        signal.signal(number, signal.default_int_handler)
        stop = Stop(MPI.COMM_SELF, None)
        assert stop.asked(1e9) == ""
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), number)
        assert stop.asked(0.0) == signal.Signals(number).name


#: Takes signals while it is in one call of C, in which Python sees none.
IN_C = """
import ctypes, time
from mpi4py import MPI
from petfsi.runs.stop import Stop
stop = Stop(MPI.COMM_SELF, None)
print("ready", flush=True)
ctypes.PyDLL(None).sleep(1)
end = time.monotonic() + 20
while time.monotonic() < end:
    ctypes.PyDLL(None).usleep(int(1e6 * (end - time.monotonic())))
"""


def test_the_second_interrupt_ends_a_process_in_whatever_it_is():
    with subprocess.Popen([sys.executable, "-c", IN_C], env=environment(), stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == -signal.SIGINT  # a shell calls that 130
        assert time.monotonic() - begin < 15


def test_the_wall_limit_counts_from_the_start_of_the_process(handlers):
    code = "import time; time.sleep(0.5); from petfsi.runs.stop import process_age; print(process_age())"
    done = subprocess.run([sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=True)
    assert float(done.stdout) >= 0.5
    stop = Stop(MPI.COMM_SELF, process_age() + 100.0)
    assert stop.asked(50.0) == "" and stop.asked(101.0).startswith("the wall-time limit of ")


def test_a_limit_that_set_up_takes_up_stops_before_the_first_step(here):
    code, said = here("run", "block.toml", "--out", "out", "--wall-limit", "0.001")
    assert code == 75 and "stopped by the wall-time limit of 0.001 s after step 0" in said
    assert here("resume", "out", "--steps", "1")[0] == 0 and summary()["steps"] == 1


# ---- what is left -------------------------------------------------------------------------------------------


def test_steps_end_in_a_run_that_goes_on_and_its_summary_counts_all_parts(here):
    code, said = here("run", "block.toml", "--out", "out", "--steps", "5")
    first = summary()
    assert code == 0 and "stopped by --steps 5 after step 5; go on with: petfsi resume out" in said
    assert (first["status"], first["reason"], first["steps"]) == ("stopped", "--steps 5", 5)
    assert here("resume", "out")[0] == 0
    second = summary()
    assert (second["status"], second["reason"], second["steps"]) == ("done", "", 12)
    iterations = read_history(Path("out/history.csv"))["iterations"][1:]
    assert second["iterations"] == {"mean": pytest.approx(iterations.mean()), "max": iterations.max()}
    assert second["wall_s"] > first["wall_s"] and second["assemblies"]["solid"] >= 12
    assert all(second["phases"][name] > first["phases"][name] for name in ("assemble", "solve"))


@pytest.mark.parametrize("content", ["", "[]", '{"wall_s": "x"}', '{"wall_s": NaN, "phases": {}}', "[" * 5000, None])
def test_a_damaged_summary_is_told_and_loses_nothing_else(here, content):
    here("run", "block.toml", "--out", "out", "--steps", "5")
    Path("out/summary.json").unlink() if content is None else Path("out/summary.json").write_text(content)
    code, said = here("resume", "out")
    told = "there is no summary.json: " if content is None else "summary.json is damaged: "
    assert code == 0 and told + "seconds and assemblies of earlier parts are not counted" in said
    assert summary()["steps"] == 12 and len(read_history(Path("out/history.csv"))["step"]) == 13


def test_resuming_a_finished_run_says_so_and_changes_nothing(here):
    here("run", "block.toml", "--out", "out")
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in Path("out").rglob("*") if p.is_file()}
    code, said = here("resume", "out")
    assert code == 0 and "this run is done, at step 12, t = 0.6 s; nothing was changed" in said
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in Path("out").rglob("*") if p.is_file()} == before
    assert here("resume", "out", "--set", "time.end=0.7")[0] == 0 and summary()["steps"] == 14


@pytest.mark.parametrize("end, last", [("0.27", 5), ("0.22", 4)], ids=["newer", "none newer"])
def test_a_failed_step_leaves_the_state_before_it(here, end, last):
    wrong = ["--set", f'gravity=["0*log({end} - t)", "-1 - t"]']
    code, said = here("run", "block.toml", "--out", "out", *wrong)
    path = f"out/checkpoint/{last:06d}.h5"
    assert code == 3 and f"Last good checkpoint: {path}. Go on from there with: petfsi resume out" in said
    assert summary()["status"] == "failed" and f"step {last + 1}, t = " in summary()["reason"]
    assert here("resume", "out")[0] == 3  # as it would again, from there
    here("run", "block.toml", "--out", "good", "--steps", str(last), *wrong)
    want, got = arrays(f"good/checkpoint/{last:06d}.h5"), arrays(path)
    assert want.keys() == got.keys() and all(np.array_equal(want[name], got[name]) for name in want)


def test_a_state_that_is_no_number_is_not_left(here, monkeypatch):
    monkeypatch.setattr(Kept, "is_finite", lambda self: False)
    code, said = here("run", "block.toml", "--out", "out", "--set", 'gravity=["0*log(0.12 - t)", "-1"]')
    assert code == 3 and "There is no checkpoint." in said and not list(Path("out/checkpoint").glob("*"))


# ---- nobody listens -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">/dev/full"])
def test_a_run_that_nobody_can_hear_goes_on(here, closed):
    line = f"exec {PETFSI} run block.toml --out out {closed}"
    assert subprocess.run(["bash", "-c", line], env=environment(), timeout=180).returncode == 0
    assert Path("out/log.txt").read_text().count("\nstep ") == 12
    assert summary()["status"] == "done"


# ---- what the summary says of it ----------------------------------------------------------------------------


def raised(error, *causes):
    for one, cause in zip([error, *causes], causes, strict=False):
        one.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "kind, error",
    {
        "interrupted": KeyboardInterrupt(),
        "memory": raised(SolveError("a solve"), MemoryError()),
        "disk": raised(SolveError("a row"), SolveError("history.csv"), OSError(28, "full")),
        "touch": raised(SolveError("step 3"), TouchError("they meet"), SolveError("a solve")),
        "no-solution": raised(SolveError("step 3"), NoSolutionError("none")),
        "energy": raised(SolveError("step 3"), FinalError("splitting"), EnergyError("out of nothing")),
        "scene": raised(SolveError("step 3"), InputError("gravity")),
        "diverged": raised(SolveError("step 3"), SolveError("solver")),
        "defect": ZeroDivisionError(),
    }.items(),
)
def test_a_failure_has_a_kind(kind, error):
    assert kind_of(error) == kind


def test_a_summary_says_that_a_run_is_running_from_its_first_moment_on(here, monkeypatch):
    seen = []
    monkeypatch.setattr(Run, "loop", lambda run, *args, loop=Run.loop: seen.append(summary()) or loop(run, *args))
    assert here("run", "block.toml", "--out", "out", "--steps", "4")[0] == 0
    assert here("resume", "out", "--steps", "4")[0] == 0
    told = [(one["status"], one["steps"], one["pid"]) for one in seen]
    assert told == [("running", 0, os.getpid()), ("running", 4, os.getpid())]
    # of a part that is killed, what was before it stays known
    assert seen[1]["wall_s"] > 0 and seen[1]["iterations"]["mean"] == 1


def test_an_interrupted_run_and_a_defect_say_so(here, monkeypatch):
    for error, kind in ((KeyboardInterrupt(), "interrupted"), (ZeroDivisionError("0"), "defect")):

        def fail(run, error=error):
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(Run, "advance", fail)
            here("run", "block.toml", "--out", kind)
        assert summary(kind)["status"] == "failed" and summary(kind)["failure"]["kind"] == kind
        assert here("resume", kind)[0] == (0 if list(Path(kind, "checkpoint").glob("*.h5")) else 2)
