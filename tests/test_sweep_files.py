"""A sweep's file: what axes decide, which options and points are meant, what is refused before any run. About 2 s."""

import re
from pathlib import Path

import pytest
from blocks import falling_block

from petfsi.errors import InputError
from petfsi.sweeps.plan import plan_sweep
from petfsi.sweeps.selection import select
from petfsi.sweeps.states import Look
from petfsi.sweeps.table import row_of


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(falling_block(0.2, 0.05))
    return tmp_path


def planned(text, path="s.toml"):
    Path(path).write_text(f'scene = "scene.toml"\n{text}')
    return plan_sweep(Path(path))


# ---- points -------------------------------------------------------------------------------------------------

LISTS = """
exclude = [{ w = [[0, 1]], dt = 0.05 }]
[axis]
w = { key = "gravity", values = [[0.0, -1.0], [0.0, 1.0]] }
dt = { key = "time.dt", values = [0.1, 0.05] }
"""


@pytest.mark.parametrize(
    "only, numbers",
    {
        "w=[0.0, -1.0]": [0, 1],
        "w=[0,-1],dt=0.05": [1],
        "dt=1e-1, w=[0,1],w=[0, -1]": [0, 2],
        "NAME2": [2],
        "NAME2,NAME0": [0, 2],
        "NAME2 , dt=0.05": [1, 2],
    }.items(),
)
def test_only_takes_lists_and_names_of_runs(only, numbers):
    runs = planned(LISTS).runs
    assert len(runs) == 3
    text = re.sub(r"NAME(\d)", lambda match: runs[int(match[1])].name, only)
    assert select(text, runs) == [runs[n] for n in numbers]


@pytest.mark.parametrize(
    "only, said",
    [
        ("w", "must be axis=point, or the name of a run; axes are w, dt"),
        ("w=[0,-2]", "no such point; w has [0.0, -1.0], [0.0, 1.0]"),
        ("w=[0,-1],", "must be axis=point"),
        ("w=[0,-1", "no such point"),
        ("w=[0,1],dt=0.05", "they are excluded"),
    ],
)
def test_only_says_what_is_wrong(only, said):
    with pytest.raises(InputError, match=re.escape(said)):
        select(only, planned(LISTS).runs)


def test_a_figure_does_not_take_the_place_of_an_axis():
    run = planned("""[axis]
    "last.top.y" = { key = "gravity.0", values = [1.0] }
    state = { key = "gravity.1", values = [2.0] }
    dt = { key = "time.dt", values = [0.1] }
    """).runs[0]
    row = row_of(run, Look("done", "", 2, summary={"probes": {"top.y": 0.5}}))
    assert (row["axis.last.top.y"], row["last.top.y"], row["axis.state"], row["dt"]) == ("1", 0.5, "2", "0.1")
