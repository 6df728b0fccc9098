"""What README says of scenes is so."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"^```toml\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)


@pytest.fixture
def example(tmp_path):
    path = tmp_path / "example.toml"
    path.write_text(BLOCKS[0])
    return path


def test_the_example_scene_is_sound_and_steps(example, here):
    done = here("check", example)
    assert done.returncode == 0, done.stderr
    run = here("run", example, "--out", example.parent / "run", "--steps", 2)
    assert run.returncode == 0, run.stderr
    history = (example.parent / "run" / "history.csv").read_text().splitlines()
    assert {"top.x", "top.y"} <= set(history[0].split(",")) and len(history) == 1 + 3
