"""What sweeps do when things go wrong beside them: signals, full disks, other calls, readers who leave. About 5 s."""

import errno
import fcntl
import os
import re
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest
from test_sweeps import SCENE, STUB, driver, starts, states, written

from petfsi.errors import InputError
from petfsi.sweeps import attempts, command, launch, pool
from petfsi.sweeps.claim import claim, give_back
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.plan import plan_sweep
from petfsi.sweeps.states import Look, last_words, look_at, said_so_far


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(launch, "petfsi_words", lambda: STUB)
    Path("scene.toml").write_text(SCENE)


@pytest.fixture
def sweep(place, here):
    return lambda *words: here("sweep", *words)


def made(*names, **more):
    """Return folder and plan of a sweep that has been written and not begun."""
    folder, plan = SweepFolder(Path("out")), plan_sweep(Path(written(*names, **more)))
    folder.make(plan)
    return folder, plan


def ending(*words):
    """Return what may stand for ``start``: a process that does this."""

    def start(folder, run, claimed, *given):
        return subprocess.Popen(words, start_new_session=True)

    return start


CHANGED = 'set = { "time.end" = 0.3 }'


# ---- signals ------------------------------------------------------------------------------------------------


def test_a_run_that_ends_before_it_is_told_to_stop_holds_nothing_up(place, monkeypatch):
    folder, plan = made("a")
    monkeypatch.setattr(pool, "start", ending("sleep", "0.05"))

    class Late(pool.Pool):
        def _heed(self):
            if self.children and not self.why:
                os.waitid(os.P_PID, self.children[0].process.pid, os.WEXITED | os.WNOWAIT)
                self._signals.append(signal.SIGINT)
            super()._heed()

    monkeypatch.setattr(pool.os, "wait4", limited(os.wait4))
    assert Late(folder, plan.runs, 1, print).work() == "SIGINT"


def limited(function):
    """Return a function that gives up after a second: what waits for ever is to fail."""
    limit = time.monotonic() + 1

    def call(*words):
        if time.monotonic() > limit:
            pytest.fail("waits for ever")
        return function(*words)

    return call


def test_a_process_that_another_has_reaped_has_ended(place, monkeypatch):
    folder, plan = made("a")
    monkeypatch.setattr(pool, "start", ending("true"))

    class Robbed(pool.Pool):
        def _reap(self):
            for child in self.children:
                with suppress(ChildProcessError):
                    os.waitpid(child.process.pid, 0)
            super()._reap()

    said = []
    monkeypatch.setattr(pool.os, "wait4", limited(os.wait4))
    assert Robbed(folder, plan.runs, 1, said.append).work() == "" and "lost" in said[-1]


def test_an_error_lets_runs_end_after_their_steps(place):
    folder, plan = made("fine", "slow1")
    wait = Path("out/runs/how-slow1/summary.json")

    def say(text):
        while not wait.exists():
            time.sleep(0.01)
        raise OSError(errno.EIO, "the terminal has gone")

    with pytest.raises(OSError, match="terminal"):
        pool.Pool(folder, plan.runs, 2, say).work()
    assert look_at(wait.parent, plan.runs[1]).state == "stopped"


def test_a_reader_who_leaves_ends_nothing(place):
    with driver(written("fine", "slow1"), "--out", "out", "--jobs", 1) as process:
        process.stdout.close()
    assert process.returncode == 0 and set(states().values()) == {"done"}


# ---- runs that are replaced ---------------------------------------------------------------------------------


def test_a_run_that_another_call_has_replaced_is_left_to_that(place, sweep):
    folder, old = made("a")
    new = plan_sweep(Path(written("a", text=CHANGED)))
    command._make(folder, new, command.Wanted(Path("s.toml"), retry="changed"), print)
    said = []
    assert pool.Pool(folder, old.runs, 1, said.append).work() == "" and not starts()
    assert said == ["how-a: was replaced by another call, and is left to that"]
    assert sweep("out").returncode == 0 and starts() == {"how-a run": 1}


def test_all_runs_are_replaced_or_none(sweep):
    folder, old = made("a", "b")
    handle = claim(folder.run("how-b"))
    done = sweep(written("a", "b", text=CHANGED), "--out", "out", "--retry", "changed")
    assert done.returncode == 2 and "how-b: a process is at work in it" in done.stderr
    assert folder.planned() == old.runs and not Path("out/replaced").exists()
    give_back(handle)
    # cut short: the plan is there, and a run is not yet the new one
    new = plan_sweep(Path("s.toml"))
    folder.make(new)
    folder.set_aside(new.runs[0])
    with pytest.raises(InputError, match=r"how-b has other settings than .*--retry changed"):
        folder.planned()
    assert sweep("s.toml", "--out", "out", "--retry", "changed").returncode == 0 and folder.planned() == new.runs
    Path("out/runs/how-a/run.json").write_text(Path("out/runs/how-b/run.json").read_text().replace("0.3", "0.4"))
    with pytest.raises(InputError, match=r"how-a/run.json cannot be read"):
        folder.planned()


def test_a_run_of_unknown_settings_is_not_given_the_present_ones(place):
    folder, plan = made("a")
    path = folder.run("how-a") / "run.json"
    path.write_text("{")
    folder.make(plan)
    assert folder.planned() == plan.runs  # nothing had begun
    (path.parent / ".petfsi-run").touch()
    path.write_text("{")
    with pytest.raises(InputError, match=r"run.json cannot be read, and there are results"):
        folder.make(plan)
    assert path.read_text() == "{"


def test_a_mesh_that_changes_meanwhile_is_not_copied_under_the_name_of_the_old_one(place):
    Path("block.node").write_text("points")
    Path("block.ele").write_text("cells")
    Path("scene.toml").write_text(re.sub("shape = .*", 'shape = { mesh = "block.node" }', SCENE))
    plan = plan_sweep(Path(written("a")))
    Path("block.ele").write_text("other")
    with pytest.raises(InputError, match=r"block.ele has changed while"):
        SweepFolder(Path("out")).make(plan)
    assert not list(Path("out").rglob("block.ele*")) and not Path("out/plan.csv").exists()


# ---- claims -------------------------------------------------------------------------------------------------


def handles():
    return len(os.listdir("/proc/self/fd"))


def test_a_run_that_is_put_aside_while_it_is_claimed_is_not_mine(tmp_path, monkeypatch):
    run, before = tmp_path / "run", handles()
    assert claim(run) is None  # between its going and its coming
    run.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", lambda *_: run.rename(tmp_path / "aside").joinpath("../run").mkdir())
        assert claim(run) is None
    assert handles() == before


def test_a_file_system_without_locks_has_sweeps(sweep, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOSYS, "no locks here")

    file = written("fine")
    monkeypatch.setattr(fcntl, "flock", flock)
    assert sweep(file, "--out", "out").returncode == 0 and states() == {"how-fine": "done"}


def test_a_disk_without_room_for_a_claim_stops_the_sweep(place, monkeypatch):
    def full(path):
        raise OSError(errno.ENOSPC, "full")

    folder, plan = made("a")
    monkeypatch.setattr(pool, "claim", full)
    assert "are free on the disk" in pool.Pool(folder, plan.runs, 1, print).work()


def test_a_run_whose_directory_has_gone_is_not_waited_for(place):
    folder, plan = made("a")
    shutil.rmtree(folder.run("how-a"))
    said = []
    assert pool.Pool(folder, plan.runs, 1, said.append).work() == "" and said[-1] == "how-a: its directory has gone"


# ---- attempts and states ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "code, told, state",
    [(75, False, "stopped"), (-9, True, "stopped"), (-9, False, "broken"), (1, False, "broken"), (3, False, "broken")],
)
def test_a_run_is_stopped_by_its_last_attempt_alone(tmp_path, place, code, told, state):
    folder, plan = made("a")
    path = folder.run("how-a")
    (path / "summary.json").write_text('{"status": "stopped", "steps": 1, "reason": "SIGINT"}')
    for _ in range(3):
        attempts.began(path, "resume", 1, 0)
        assert look_at(path, plan.runs[0]).state in ("stopped", state)
        attempts.ended(path, code, 1.0, 0, told, 0)
    assert look_at(path, plan.runs[0]).state == ("lost" if state == "broken" else state)


@pytest.mark.parametrize("code", [-signal.SIGUSR1, 128 + signal.SIGUSR1])
def test_a_run_that_is_stopped_while_it_starts_is_stopped(place, code):
    folder, plan = made("a")
    path = folder.run("how-a")
    attempts.began(path, "run", -1, 0)
    attempts.ended(path, code, 0.1, 0, True, 0)
    look = look_at(path, plan.runs[0])
    assert (look.state, look.reason) == ("stopped", "told to stop")


FRAME = "-" * 74
MPIRUN = (
    f"{FRAME}\nPrimary job  terminated normally, but 1 process returned\n{FRAME}\n{FRAME}\nmpirun detected\n{FRAME}\n"
)


def test_the_last_words_are_those_of_the_last_attempt_and_of_petfsi(tmp_path):
    (tmp_path / "output.txt").write_text("petfsi: the first\n")
    attempts.began(tmp_path, "run", -1, said_so_far(tmp_path))
    with open(tmp_path / "output.txt", "a") as file:
        file.write("Killed\n")
    assert last_words(tmp_path, attempts.read_attempts(tmp_path)) == "Killed"
    with open(tmp_path / "output.txt", "a") as file:
        file.write(f"petfsi: scene.toml: one mistake\n  time.dt: no\n{MPIRUN}")
    assert last_words(tmp_path, attempts.read_attempts(tmp_path)) == "scene.toml: one mistake; time.dt: no"
    (tmp_path / "output.txt").write_text(f"{FRAME}\nmpirun noticed that a process exited on signal 9\n{FRAME}\n")
    assert last_words(tmp_path, []) == "mpirun noticed that a process exited on signal 9"


def test_a_torn_line_swallows_no_other(tmp_path):
    attempts.began(tmp_path, "run", -1, 0)
    with open(tmp_path / "attempts.jsonl", "a") as file:
        file.write('{"time": "20')
    attempts.ended(tmp_path, 75, 1.0, 0, True, 0)
    assert [attempt.exit for attempt in attempts.read_attempts(tmp_path)] == [75]


def test_an_attempt_is_noted_as_what_it_is(place):
    folder, plan = made("fine", text="steps = 5")
    path = folder.run("how-fine")
    (path / "checkpoint").mkdir()
    (path / "checkpoint" / "000005.json").touch()  # all steps, and no summary: it begins anew
    pool.Pool(folder, plan.runs, 1, print).work()
    assert [attempt.how for attempt in attempts.read_attempts(path)] == ["run"] and starts() == {"how-fine run": 1}


# ---- order, and what is said --------------------------------------------------------------------------------


def test_a_round_of_repeat_is_not_overtaken_by_a_later_one(place, monkeypatch):
    file = Path(written("l", "m", "n", repeat=3))
    file.write_text(file.read_text() + "big = { ranks = 2 }\n")
    folder, plan = SweepFolder(Path("out")), plan_sweep(file)
    folder.make(plan)
    order = []

    def start(folder, run, *given):
        order.append(run)
        (folder.run(run.name) / "summary.json").write_text('{"status": "done"}')
        return subprocess.Popen(["sleep", f"{0.02 * (1 + len(order) % 3)}"], start_new_session=True)

    monkeypatch.setattr(pool, "start", start)
    pool.Pool(folder, plan.runs, 2, print).work()
    assert len(order) == 12 and [run.repeat for run in order] == sorted(run.repeat for run in order)


def test_a_dry_run_says_what_is_run_again_and_words_without_effect_are_refused(sweep):
    sweep(written("fine", "fails"), "--out", "out")
    done = sweep("out", "--dry-run", "--retry", "failed")
    assert "how-fails  failed, to be run again, 1 rank\n" in done.stdout and "how-fine  done, 1 rank\n" in done.stdout
    done = sweep(written("fine", text=CHANGED), "--out", "out", "--dry-run", "--retry", "changed")
    assert "how-fine  done, to be run again, 1 rank\n" in done.stdout
    for words in (
        ("--status", "--collect"),
        ("--dry-run", "--status"),
        ("--status", "--retry", "lost"),
        ("--collect", "--only", "how=fine"),
        ("--collect", "--jobs", "2"),
    ):
        done = sweep("out", *words)
        assert done.returncode == 2 and "do not go together" in done.stderr, words


def test_what_starts_nothing_needs_no_mpirun(sweep, monkeypatch):
    folder, _ = made("fine", text="axis.ranks.ranks = [2]")
    monkeypatch.setattr(command.shutil, "which", lambda name: None)
    assert [
        sweep(*words).returncode for words in (["s.toml", "--dry-run"], ["out", "--status"], ["out", "--collect"])
    ] == [
        0,
        0,
        0,
    ]
    done = sweep("out")
    assert done.returncode == 2 and "there is no mpirun" in done.stderr


def test_the_time_left_counts_ranks_and_cores():
    looks = {"a": Look("done", "", 1, summary={"wall_s": 10.0}), "b": Look("new", "", -1), "c": Look("new", "", -1)}
    for ranks, cores, seconds in ((1, 1, 20), (1, 2, 10), (1, 8, 10), (2, 2, 20), (4, 2, 20)):
        left = command._time_left(looks, {"a": 1, "b": ranks, "c": ranks}, cores)
        assert left.startswith(f"; about {seconds} s left here"), (ranks, cores, left)


def test_the_time_left_counts_the_start_of_a_process(tmp_path):
    for seconds in (4.0, 6.0):
        attempts.began(tmp_path, "run", -1, 0)
        attempts.ended(tmp_path, 0, seconds, 1, False, 0)
    done = Look("done", "", 1, summary={"wall_s": 1.0}, attempts=attempts.read_attempts(tmp_path))
    looks = {"a": done, "b": Look("new", "", -1)}
    assert command._time_left(looks, {"a": 1, "b": 1}, 1).startswith("; about 10 s left")
    done.attempts[0].seconds = None  # whoever started it was killed
    assert command._time_left(looks, {"a": 1, "b": 1}, 1).startswith("; about 1 s left")
