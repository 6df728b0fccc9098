"""What sweeps do when things go wrong beside them: signals, full disks, other calls, readers who leave. About 15 s."""

import errno
import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest
from test_sweeps import SCENE, STUB, driver, starts, states, written

from petfsi.errors import InputError
from petfsi.sweeps import command, launch, pool
from petfsi.sweeps.claim import claim, give_back
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.plan import plan_sweep


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
    assert pool.look_at(wait.parent, plan.runs[1]).state == "stopped"


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
