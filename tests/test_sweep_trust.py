"""What a sweep's folder may be when it comes from elsewhere: nothing in it starts more than runs of petfsi in it."""

import dataclasses
import json
from pathlib import Path

import pytest
from blocks import falling_block
from test_sweep_pool import made, place, sweep  # noqa: F401 - fixtures
from test_sweeps import written

import petfsi
from petfsi.errors import InputError
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.plan import Planned, plan_sweep


def edited(folder, old, changes):
    """Give a run other contents, its hash and name in the plan included, as whoever crafts a folder would."""
    about = dataclasses.asdict(old) | changes
    run = Planned(**about)
    folder.run(run.name).mkdir(exist_ok=True)
    (folder.run(run.name) / "run.json").write_text(json.dumps(about | {"hash": run.hash}))
    folder.plan.write_text(folder.plan.read_text().replace(old.hash, run.hash).replace(old.name, run.name))


@pytest.mark.parametrize(
    "changes",
    [
        {"options": ["--out", "../../elsewhere", "--overwrite"]},
        {"options": ["-options_file", "../../mine.opts"]},
        {"options": ["-Options_File", "../../mine.opts"]},
        {"options": [1]},
        {"scene": "../scene.toml"},
        {"scene": "inputs/../../scene.toml"},
        {"ranks": "2"},
        {"ranks": True},
        {"steps": -1},
        {"axes": {"how": 1}},
        {"name": "../b"},
    ],
    ids=str,
)
def test_a_crafted_run_is_none(place, changes):  # noqa: F811
    folder, plan = made("a")
    edited(folder, plan.runs[0], changes)
    with pytest.raises(InputError, match="cannot be read; it is written anew by"):
        SweepFolder.open(Path("out")).planned()


@pytest.mark.parametrize("data", [b"", b"nothing\n1\n", b"\xff\xfe\x00", b"name\na\n"])
def test_a_damaged_plan_is_named(place, data):  # noqa: F811
    folder, _ = made("a")
    folder.plan.write_bytes(data)
    if data:
        with pytest.raises(InputError, match=r"plan.csv cannot be read; it is written anew by"):
            petfsi.open_sweep("out")
    folder.make(plan_sweep(Path(written("a"))))
    assert petfsi.open_sweep("out").names == ["how-a"]


def test_a_place_where_nothing_can_be_written_is_bad_input(sweep):  # noqa: F811
    done = sweep(written("fine"), "--out", "/proc/none/of/this")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1) and "cannot be written" in done.stderr


def test_a_refused_run_begins_anew_where_that_is_asked_for(sweep):  # noqa: F811
    sweep(written("refused"), "--out", "out")
    Path("out/runs/how-refused/.petfsi-run").touch()
    assert "how-refused begins anew" not in sweep("out", "--retry", "refused").stdout
    assert "how-refused begins anew" in sweep("out", "--retry", "refused", "--anew").stdout
    assert Path("out/replaced/how-refused.1/.petfsi-run").exists()
    assert sweep("out", "--anew").returncode == sweep("out", "--retry", "failed", "--anew").returncode == 2


@pytest.mark.parametrize("name, data", [("summary", b"[1]"), ("history", b""), ("history", b"\x00\x01")])
def test_what_is_no_summary_or_history_is_told(tmp_path, name, data):
    (tmp_path / ".petfsi-run").touch()
    (tmp_path / {"summary": "summary.json", "history": "history.csv"}[name]).write_bytes(data)
    with pytest.raises(InputError, match=f"is not a {name}"):
        getattr(petfsi.open_run(tmp_path), name)


def test_a_run_is_read_back(tmp_path, monkeypatch, here):
    monkeypatch.chdir(tmp_path)
    Path("s.toml").write_text(falling_block(0.2, 0.05))
    assert here("run", "s.toml", "--out", "out").returncode == 0
    run = petfsi.open_run("out")
    assert run.summary["status"] == "done" and len(run.history["time"]) == 5 and run.scene.time.dt == 0.05
