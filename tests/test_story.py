"""How a run's log begins and ends."""

import re
from pathlib import Path

import pytest

SCENE = """
title = "A block is pulled"
dim = 2
[time]
end = 1.0
dt = 0.1
[solids.b]
shape = { box = { origin = [0, 0], size = [1, 1], cells = [2, 2] } }
density = 1.0
young = 50.0
poisson = 0.3
supports = [{ where = "left", fix = ["x", "y"] }]
loads = [{ where = "right", traction = [1.0, 0.0] }]
[output]
every = 0.5
"""
BEGINS = [
    r"petfsi \S+: A block is pulled; unknowns: solid 18; ranks: 1",
    r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d [+-]\d{4} on \S+, in /.*",
    r"command: \S+",
    r"versions: petfsi \S+, Python 3\.\S+, PETSc 3\.\S+, NumPy \S+, \S+",
    r"options: \d+ of monolithic.opts, 1 of command line; they are in out/options.opts",
]
SHARES = r"seconds of steps: (\w+ \S+ s \(\d+%\)(, )?)+; iterations: \S+ a step, \d+ at most"


@pytest.fixture
def log(here, tmp_path, monkeypatch):
    """Return a function that runs a command and gives its exit code and the log's lines."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)

    def run(*words):
        code = here(*words).returncode
        return code, Path("out/log.txt").read_text().splitlines()

    return run


def test_a_log_says_who_ran_what_with_what_and_what_it_took_and_where_things_are(log):
    code, lines = log("run", "scene.toml", "--out", "out", "--steps", "4", "-fsi_ksp_rtol", "1e-9")
    assert code == 0
    for pattern, line in zip(BEGINS, lines, strict=False):
        assert re.match(pattern, line), line
    assert re.fullmatch(r"stopped: 4 steps, t = 0.4 s, in \S+ s", lines[-4])
    assert re.fullmatch(SHARES, lines[-3]), lines[-3]
    assert lines[-2].startswith("in out: history.csv, summary.json, fields.xdmf, solid.xdmf, checkpoint/000004.h5; ")
    assert lines[-2].endswith("petfsi plot out") and lines[-1].startswith("stopped by --steps 4")
    code, lines = log("resume", "out")
    assert code == 0
    assert re.fullmatch(r"done: 10 steps, t = 1 s, in \S+ s, \S+ s with its earlier parts", lines[-3]), lines[-3]
    assert sum(line.startswith("command: ") for line in lines) == 2


def test_the_log_of_a_run_that_failed_ends_so_too(log):
    push = 'solids.b.loads.0.traction=["1e7*t", 0.0]'
    code, lines = log("run", "scene.toml", "--out", "out", "--set", push, "-fsi_ksp_rtol", "1e-9")
    assert code == 3
    end = next(n for n, line in enumerate(lines) if line.startswith("failed: step "))
    assert re.fullmatch(r"failed: \d+ steps?, t = \S+ s, in \S+ s", lines[end + 2]), lines[end:]
    assert lines[-1].startswith("in out: history.csv, summary.json, ")
