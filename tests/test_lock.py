"""One process per run directory: who is at work is told, and what a dead one left is taken over. About 15 s."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path

import pytest
from processes import environment

from petfsi.errors import InputError
from petfsi.output import lock
from petfsi.output.lock import NAME, Holder, acquire, refuse_if_held

PETFSI = Path(sys.executable).with_name("petfsi")
SCENES = Path(__file__).parent / "scenes"


def left(directory, **changes):
    """Leave the lock of a process that is gone, but for the changes."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    holder = replace(Holder.present(), **({"pid": child.pid} | changes))
    (directory / NAME).write_text(json.dumps(asdict(holder)))
    return holder


def test_one_holder_at_a_time(tmp_path):
    first = acquire(tmp_path)
    text = (tmp_path / NAME).read_text()
    said = rf"another process is at work in it: process {os.getpid()} of .* on .*, since .*; wait for it, or stop it"
    for attempt in (acquire, refuse_if_held):
        with pytest.raises(InputError, match=said):
            attempt(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [NAME] and (tmp_path / NAME).read_text() == text
    first.release()
    assert not list(tmp_path.iterdir())
    refuse_if_held(tmp_path)
    acquire(tmp_path).release()


@pytest.mark.parametrize(
    "changes",
    [{}, {"pid": os.getpid(), "started": 1}, {"pid": os.getpid(), "boot": "another start"}],
    ids=["no name", "another process", "another start"],
)
def test_what_a_dead_process_left_is_taken_over(tmp_path, changes):
    """Its number may be another's by now: then the two began at other times, or the machine did."""
    left(tmp_path, **changes)
    refuse_if_held(tmp_path)
    mine = acquire(tmp_path)
    assert Holder.read((tmp_path / NAME).read_bytes()).pid == os.getpid()
    with pytest.raises(InputError, match="another process is at work"):
        acquire(tmp_path)
    mine.release()
    assert not list(tmp_path.iterdir())


def test_of_another_machine_only_its_age_is_known(tmp_path):
    left(tmp_path, host="node17", user="ann\x1b[2J", since="Monday")
    os.utime(tmp_path / NAME, (0, time.time() - 1000))
    with pytest.raises(InputError) as refusal:
        acquire(tmp_path)
    said = str(refusal.value)
    assert "of ann?[2J on node17, since Monday; it was last seen 16 min ago" in said
    assert said.endswith(f"If it is known to be gone, remove {tmp_path / NAME}")
    with open(tmp_path / NAME) as theirs:  # as far as this file system knows it lives
        fcntl.flock(theirs, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="since Monday; wait for it$"):
            acquire(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"pid": 1}', "[" * 100000, "\0" * 50],
    ids=["empty", "list", "table", "pid", "deep", "null"],
)
def test_a_lock_that_names_nobody_is_left(tmp_path, text):
    (tmp_path / NAME).write_text(text)
    with pytest.raises(InputError, match=r"a process that it does not name; it was last seen .* remove"):
        acquire(tmp_path)
    assert (tmp_path / NAME).read_text() == text


def test_what_is_no_plain_file_is_no_lock(tmp_path):
    (tmp_path / "victim").write_text(json.dumps(asdict(left(tmp_path))))
    (tmp_path / NAME).unlink()
    for make in (lambda p: p.symlink_to(tmp_path / "victim"), lambda p: os.mkfifo(p), lambda p: p.mkdir()):
        make(tmp_path / NAME)
        with pytest.raises(InputError, match=r"\.lock is no lock of petfsi"):
            acquire(tmp_path)
        (tmp_path / NAME).rmdir() if (tmp_path / NAME).is_dir() else (tmp_path / NAME).unlink()


@pytest.mark.parametrize("knows", [True, False], ids=["flock", "no flock"])
def test_of_many_that_come_at_once_one_gets_it(tmp_path, knows):
    left(tmp_path)
    with get_context("fork").Pool(8) as pool:
        got = pool.starmap(_try, [(tmp_path, knows)] * 8, chunksize=1)
    assert got.count("mine") == 1, got


def _try(directory, knows):
    if not knows:
        lock._flock = lambda handle: None
    try:
        acquire(directory)
        time.sleep(1.5)
        return "mine"
    except InputError as error:
        return str(error)


def test_a_lock_is_touched_while_its_holder_steps(tmp_path, monkeypatch):
    mine = acquire(tmp_path)
    os.utime(tmp_path / NAME, (0, 0))
    mine.touch()
    assert (tmp_path / NAME).stat().st_mtime == 0
    monkeypatch.setattr(lock, "BEAT", -1.0)
    mine.touch()
    assert time.time() - (tmp_path / NAME).stat().st_mtime < 60
    mine.release()


def test_a_file_system_without_hard_links_will_do(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    mine = acquire(tmp_path)
    with pytest.raises(InputError, match="another process is at work"):
        acquire(tmp_path)
    mine.release()
    assert not list(tmp_path.iterdir())


def test_a_run_at_work_is_told_of_and_left_alone(tmp_path, here, monkeypatch):
    """The second one says who is at work; a killed one is taken over; the rows are those of a run never disturbed."""
    monkeypatch.chdir(tmp_path)
    scene, short = str(SCENES / "flap.toml"), ["--set", "time.end=0.4"]
    assert here("run", scene, "--out", "straight", *short).returncode == 0
    line = [PETFSI, "run", scene, "--out", "run", *short]
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, env=environment()) as process:
        deadline = time.monotonic() + 120
        while not list(Path("run").glob("checkpoint/*.json")) and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGSTOP)  # so that it is at work all the time
        try:
            before = {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()}
            for words in (["resume", "run"], ["run", scene, "--out", "run", "--overwrite"]):
                done = here(*words)
                assert done.returncode == 2
                assert f"another process is at work in it: process {process.pid} of " in done.stderr
            assert {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()} == before
        finally:
            process.kill()
    assert Path("run/.lock").exists()
    shutil.copytree("run", "copy")
    with suppress(FileNotFoundError):
        Path("copy/.lock").unlink()
    for name in ("run", "copy"):
        assert here("resume", name).returncode == 0
        assert Path(name, "history.csv").read_bytes() == Path("straight/history.csv").read_bytes()
        assert not list(Path(name).glob(".lock*"))


def test_overwrite_takes_the_old_run_away_only_for_one_that_passes(tmp_path, here, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = str(SCENES / "flap.toml")
    assert here("run", scene, "--out", "run", "--steps", 1).returncode == 0
    before = {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()}
    wrong = [
        ["--set", "time.dt=-1"],
        ["--set", "probes={ far = { of = 'flap', at = [9.0, 9.0], quantity = 'displacement' } }"],
        ["-fsi_ksp_typo", "cg"],
        ["-options_file", "none.opts"],
        ["--set", "obstacles={ o = { shape = { mesh = 'none.stl' } } }"],
    ]
    for words in wrong:
        assert here("run", scene, "--out", "run", "--overwrite", *words).returncode == 2
        assert {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()} == before, words
    assert here("run", scene, "--out", "run", "--overwrite", "--steps", 1).returncode == 0


@pytest.mark.parametrize("times", [1, 3])
def test_a_take_over_that_was_killed_is_no_obstacle(tmp_path, times):
    """Its file names a process that is gone: of several that come to this one removes it, and one gets the lock."""
    left(tmp_path)
    (tmp_path / lock.TAKING).write_bytes((tmp_path / lock.NAME).read_bytes())
    held = []
    for _ in range(times):
        try:
            held.append(acquire(tmp_path))
        except InputError as error:
            assert "another process is at work in it" in str(error)
    assert len(held) == 1 and not (tmp_path / lock.TAKING).exists()
    held[0].release()


def test_a_take_over_whose_process_is_not_known_to_be_gone_is_named(tmp_path, monkeypatch):
    left(tmp_path)
    (tmp_path / lock.TAKING).write_text("")
    monkeypatch.setattr(lock, "_TRIES", 2)
    with pytest.raises(InputError, match=rf"if none does, remove {tmp_path / lock.TAKING}"):
        acquire(tmp_path)
