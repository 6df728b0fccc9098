"""``[error]`` of a sweep: what is compared with what, from made histories whose error is known."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from blocks import falling_block

from petfsi import open_sweep
from petfsi.errors import InputError
from petfsi.sweeps.command import Wanted, sweep
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.plan import plan_sweep

AXES = """
[axis]
dt = { key = "time.dt", values = { from = 0.1, factor = 0.5, count = 4 } }
stiff = { key = "solids.block.young", values = [1e5, 1e6] }
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(falling_block(0.2, 0.05))


def refused(error, axes=AXES):
    Path("s.toml").write_text(f'scene = "scene.toml"\n{axes}\n[error]\n{error}')
    with pytest.raises(InputError) as caught:
        plan_sweep(Path("s.toml"))
    return str(caught.value).splitlines()[1:]


def write_history(path, dt, value, end=2.0):
    """Write cos(t) times 1 + value."""
    times = np.linspace(0.0, end, round(end / dt) + 1)
    with open(path, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["step", "time", "top.y", "top.x"])
        rows.writerows([n, repr(t), repr(float(np.cos(t)) * (1.0 + value)), 0.0] for n, t in enumerate(times.tolist()))


def made(error, slip=lambda dt, stiff: 0.1 * dt**2, without=(), axes=AXES):
    """Return the rows of a sweep whose runs have errors that are known."""
    Path("s.toml").write_text(f'scene = "scene.toml"\n{axes}\n[error]\n{error}')
    folder = SweepFolder(Path("runs/s"))
    plan = plan_sweep(Path("s.toml"))
    folder.make(plan)
    for run in plan.runs:
        if run.name in without:
            continue
        dt, stiff = float(run.axes["dt"]), float(run.axes.get("stiff", 0.0))
        write_history(folder.run(run.name) / "history.csv", dt, slip(dt, stiff))
        told = {"status": "done", "steps": 20, "wall_s": 3.0, "phases": {"solve": 2.0}, "ranks": 1}
        (folder.run(run.name) / "summary.json").write_text(json.dumps(told))
    return {row["name"]: row for row in open_sweep("runs/s").rows()}


def test_runs_are_judged_against_what_the_finest_tend_to():
    rows = made('of = "top.y"\nalong = "dt"')
    assert len(rows) == 8
    for row in rows.values():
        truth = 0.1 * float(row["dt"]) ** 2
        if row["dt"] == "0.0125":  # is as far off as what it is judged by may be
            assert row["error"] is None and row["error_note"] == "not known: below the bar of the reference"
            assert truth < row["error_bar"] < 2 * truth
        else:
            assert row["error"] == pytest.approx(truth, rel=1e-4) and row["error_note"] == "" and row["wall_s"] == 3.0


def test_each_family_has_its_own_finest_run():
    rows = made('of = "top.y"\nreference = "finest"\nalong = ["dt"]', lambda dt, stiff: dt * stiff * 1e-6)
    for name, row in rows.items():
        dt, stiff = float(row["dt"]), float(row["stiff"])
        if dt == 0.0125:
            assert row["error"] is None and row["error_note"] == "is the reference"
        else:
            truth = (dt - 0.0125) * stiff * 1e-6
            assert row["error"] == pytest.approx(truth / (1.0 + 0.0125 * stiff * 1e-6), rel=1e-6), name


def test_a_run_that_is_far_off_has_no_seconds():
    rows = made('of = "top.y"\nreference = "finest"\nalong = "dt"\nbound = 0.05', lambda dt, stiff: dt)
    far = rows["dt-0.1_stiff-100000"]
    assert far["error"] > 0.05 and far["error_note"] == "far off: beyond 0.05"
    assert far["wall_s"] is None and far["seconds.solve"] is None
    near = [row for row in rows.values() if row["dt"] == "0.05"]
    assert all(row["wall_s"] == 3.0 and row["seconds.solve"] == 2.0 and row["error_note"] == "" for row in near)


def test_a_table_with_its_source_is_copied_and_watched():
    Path("known").mkdir()
    write_history(Path("known/x.csv"), 0.01, 0.0)
    reference = 'reference = { file = "known/x.csv", source = "a made one" }'
    rows = made(f'of = ["top.y", "top.x"]\n{reference}\nwindow = [0.5, 1.5]\nnorm = "max"')
    assert all(row["error"] == pytest.approx(0.1 * float(row["dt"]) ** 2, rel=1e-4) for row in rows.values())
    Path("known/x.csv").unlink()
    said = []
    assert sweep(Wanted(Path("runs/s"), collect=True), said.append) == 0
    assert any("against a made one: 8 of 8 runs, 1.6e-05 to 0.001" in line for line in said)
    copy = next(Path("runs/s/inputs").glob("reference-*.csv"))
    copy.write_text(copy.read_text().replace("0.0", "0.1", 1))
    notes = {row["error_note"] for row in open_sweep("runs/s").rows()}
    assert len(notes) == 1 and "has been changed since it was planned" in notes.pop()


def test_what_is_missing_leaves_errors_unknown():
    rows = made('of = "top.y"\nalong = "dt"', without=["dt-0.0125_stiff-100000"])
    weak = [row for row in rows.values() if float(row["stiff"]) == 1e5]
    assert all(row["error"] is None for row in weak)
    assert {row["error_note"] for row in weak} == {"", "not known: the finest run has no result"}
    rows = made('of = "top.z"\nreference = "finest"\nalong = "dt"')
    assert all("has no column top.z; it has top.y, top.x" in row["error_note"] for row in rows.values())
    rows = made('of = "top.y"\nreference = "finest"\nalong = "dt"\nwindow = [0.0, 3.0]', without=())
    assert all(row["error"] is not None for row in rows.values() if row["dt"] != "0.0125")


def test_two_axes_are_refined_together():
    cells = '[axis]\ndt = { key = "time.dt", values = [0.1, 0.05, 0.025] }\n[axis.cells]\n'
    cells += "\n".join(f'{n} = {{ set = {{ "solids.block.shape.box.cells" = [{n}, {n}] }} }}' for n in (2, 4, 8))
    rows = made('of = "top.y"\nalong = ["dt", "cells"]', axes=cells, slip=lambda dt, stiff: dt**2)
    assert len(rows) == 9
    for row in rows.values():
        truth = float(row["dt"]) ** 2
        assert row["error"] == pytest.approx(truth, rel=0.01) or (row["dt"] == "0.025" and row["error"] is None)


def test_every_mistake_is_told_at_once():
    lines = refused('of = 3\nnorm = "l1"\nwindow = [1.0, 0.5]\nalong = "cells"\nbound = -1\norder = true\nmore = 1')
    wanted = [
        "error.more: no such key; known here are of, norm, window, reference, along, factor, order, bound",
        'error.of: must name a column of history.csv, or several: "top.y"',
        "error.norm = l1: must be one of l2, max, final",
        "error.window = [1.0, 0.5]: must be two times, from and to, in seconds",
        "error.along: there is no axis cells; there are dt, stiff",
        "error.order = True: must be a number above 0 and below 8",
        "error.bound = -1: must be a number above 0",
    ]
    assert [line.strip() for line in lines] == wanted
    assert "error.along: richardson wants the axes" in refused('of = "top.y"')[0]
    uneven = AXES.replace("{ from = 0.1, factor = 0.5, count = 4 }", "[0.1, 0.04, 0.03]")
    assert "error.factor: must say by how much" in refused('of = "top.y"\nalong = "dt"', uneven)[0]
    rising = AXES.replace("from = 0.1, factor = 0.5", "from = 0.0125, factor = 2")
    assert (
        "error.along: dt goes from 0.0125 to 0.1, from fine to coarse"
        in refused('of = "top.y"\nalong = "dt"', rising)[0]
    )
    assert "error.reference.source: must say where" in refused('of = "top.y"\nreference = { file = "x.csv" }')[0]
    assert "x.csv" in refused('of = "top.y"\nreference = { file = "x.csv", source = "a" }')[0]


def test_a_rule_that_is_no_more_judges_no_more():
    assert any(row["error"] is not None for row in made('of = "top.y"\nalong = "dt"').values())
    Path("s.toml").write_text(f'scene = "scene.toml"\n{AXES}')
    SweepFolder(Path("runs/s")).make(plan_sweep(Path("s.toml")))
    assert all("error" not in row for row in open_sweep("runs/s").rows())
    Path("runs/s/error.json").write_text("{}")
    with pytest.raises(InputError, match=r"error.json cannot be read; it is written anew by"):
        open_sweep("runs/s").rows()
