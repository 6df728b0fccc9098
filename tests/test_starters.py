"""``petfsi new``: scenes to begin with."""

import re
import tomllib
from pathlib import Path

import pytest

from petfsi import cli
from petfsi.scene import starters
from petfsi.scene.load import load_scene
from petfsi.scene.reference import explain

FOLDER = Path(starters.__file__).parent
UNITS = {"s", "m", "Pa", "kg/m^3", "m/s", "m/s^2", "1/s"}
#: A setting of a table of its own, and what is said beside it.
LINE = re.compile(r"^(?:# )?(\w+) = [^#]*(?:#(.*))?$")


@pytest.fixture(autouse=True)
def there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_each_kind_has_a_file_and_the_command_knows_it():
    choices = next(option.type.choices for option in cli.new.params if option.name == "kind")
    assert list(choices) == list(starters.STARTERS) == sorted(path.stem for path in FOLDER.glob("*.toml"))


@pytest.mark.parametrize("kind", starters.STARTERS)
def test_a_starter_is_sound_and_steps(kind, here, there):
    done = here("new", f"{kind}.toml", "--kind", kind)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{kind}.toml: {starters.STARTERS[kind]}\n")
    assert (there / f"{kind}.toml").read_text() == (FOLDER / f"{kind}.toml").read_text()
    for command in re.findall(r"petfsi (check .*|run .*)", done.stdout):
        again = here(*command.split(), *(["--steps", 2] if command.startswith("run") else []))
        assert again.returncode == 0, again.stderr
    assert len((there / "runs" / kind / "history.csv").read_text().splitlines()) == 1 + 3
    assert f"petfsi plot runs/{kind}\n" in done.stdout


@pytest.mark.parametrize("kind", starters.STARTERS)
def test_a_starter_says_beside_every_key_what_it_is_and_its_unit(kind):
    text = (FOLDER / f"{kind}.toml").read_text()
    table, seen = "", 0
    for line in text.splitlines():
        assert len(line) <= 120
        if line.startswith("["):
            table = re.match(r"\[([^]]+)\]", line)[1] + "."
        elif found := LINE.match(line):
            name, comment = found.groups()
            assert comment and comment.strip(), line
            unit = re.search(r"^[^=]*= .*? \(([^\s;,)]+)", explain(f"{table}{name}"))
            assert not unit or unit[1] not in UNITS or unit[1] in re.split(r"[\s,;]+", comment), line
            seen += 1
    assert seen > 20


@pytest.mark.parametrize("kind", starters.STARTERS)
def test_a_starter_has_a_body_a_probe_output_and_checkpoints(kind):
    scene = load_scene(FOLDER / f"{kind}.toml")
    assert len(scene.solids) == 1 and scene.probes and scene.output.every and scene.checkpoint.every
    assert (scene.fluid.kind if scene.fluid else None) == {"grid": "mac", "particles": "sph", "solid": None}[kind]
    assert set(tomllib.loads((FOLDER / f"{kind}.toml").read_text())) >= {"title", "dim", "time"}


def test_the_default_is_a_grid_in_scene_toml(here, there):
    assert here("new").returncode == 0
    assert (there / "scene.toml").read_text() == (FOLDER / "grid.toml").read_text()


@pytest.mark.parametrize(
    "path, said",
    [
        ("there.toml", "there.toml: is there already, and stays as it is"),
        ("dangling.toml", "is there already"),
        (".", "is there already"),
        ("no/such/scene.toml", "there is no folder no/such; make it first"),
        ("there.toml/scene.toml", "Not a directory"),
        ("x" * 300, "File name too long"),
    ],
)
def test_nothing_is_replaced_and_no_folder_is_made(path, said, here, there):
    (there / "there.toml").write_text("mine")
    (there / "dangling.toml").symlink_to(there / "nowhere")
    before = sorted(there.iterdir())
    done = here("new", path)
    assert done.returncode == 2 and said in done.stderr and done.stdout == ""
    assert sorted(there.iterdir()) == before and (there / "there.toml").read_text() == "mine"


def test_one_rank_writes(here, there, monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "1")
    done = here("new")
    assert (done.returncode, done.stdout, list(there.iterdir())) == (0, "", [])
