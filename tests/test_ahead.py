"""What is said before a large scene is made ready."""

from pathlib import Path

import pytest

from petfsi.runs.ahead import ahead
from petfsi.scene.load import load_scene

JOBS = Path(__file__).parents[1] / "jobs"
FINE = [
    ("column.toml", ["fluid.cells=[3200, 3200]"], True, "making ready: 10,240,000 cells, 306 unknowns of solids ..."),
    ("bar.toml", ["solids.bar.shape.box.cells=[40, 360, 100]"], True, "4,484,703 unknowns of solids ..."),
    ("dambreak.toml", ["fluid.spacing=0.0002"], True, "making ready: up to 1,065,800 particles ..."),
    ("dambreak.toml", ["fluid.spacing=0.0001"], False, "counting: up to 4,263,200 particles ..."),
]


@pytest.mark.parametrize("scene, sets, ready, said", FINE)
def test_a_large_scene_says_how_much_is_made_ready(scene, sets, ready, said):
    assert said in ahead(load_scene(JOBS / scene, sets), ready=ready)


@pytest.mark.parametrize("path", sorted(JOBS.glob("*.toml")), ids=lambda path: path.stem)
def test_a_scene_of_moderate_size_says_nothing(path):
    scene = load_scene(path, [])
    assert not ahead(scene) and not ahead(scene, ready=False)


def test_ranks_share_the_work():
    scene = load_scene(JOBS / "column.toml", ["fluid.cells=[1000, 1000]"])
    assert ahead(scene, ranks=2) and not ahead(scene, ranks=3)


@pytest.mark.parametrize("patience", [2.0, 0.0])
def test_run_and_check_say_it_first_and_the_log_has_it(patience, here, tmp_path, monkeypatch):
    monkeypatch.setattr("petfsi.runs.ahead.PATIENCE", patience)
    line = "making ready: 2,048 cells, 306 unknowns of solids ..."
    out = tmp_path / "out"
    said = [
        here("check", JOBS / "column.toml").stdout.splitlines(),
        here("run", JOBS / "column.toml", "--steps", "1", "--out", out).stdout.splitlines(),
        (out / "log.txt").read_text().splitlines(),
        here("resume", out, "--steps", "1").stdout.splitlines(),
    ]
    for lines in said:
        assert (lines[0] == line) == (patience == 0.0)
        assert lines.count(line) == (patience == 0.0)
