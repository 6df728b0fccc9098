"""A run directory from somebody else: arrays that cannot be, with a right checksum, and links in what is drawn.

What is in range may be any state, and is computed with; what is not is refused by name before anything is computed.
"""

import shutil
import warnings
from pathlib import Path

import h5py
import pytest

from petfsi import cli
from petfsi.output import files
from petfsi.output.manifest import Mark, read_manifest
from petfsi.runs.running import Run

SHEET = """
dim = 2
[time]
end = 1.0
dt = 0.002
integrator = "bdf2"
[fluid]
density = 1000.0
origin = [0.0, 0.0]
size = [1.0, 0.5]
cells = [12, 6]
[fluid.smoke]
[fluid.sides]
left = { inflow = { speed = 0.3, smoke = 1.0 } }
right = "open"
[solids.sheet]
shape = { box = { origin = [0.503, 0.0], size = [0.006, 0.4], cells = [1, 4] } }
density = 1100.0
young = 1e7
poisson = 0.3
supports = [{ where = "bottom", fix = ["x", "y"] }]
[output]
every = 0.002
"""
TANK = """
dim = 2
[time]
end = 1.0
dt = 1e-4
[fluid]
kind = "sph"
density = 1000.0
origin = [0.0, 0.0]
size = [0.6, 0.6]
spacing = 0.05
sound_speed = 10.0
fill = [{ box = { origin = [0.0, 0.0], size = [0.2, 0.4] } }]
[fluid.sides]
right = { inflow = { speed = 1.0, region = { box = { origin = [0.5, 0.0], size = [0.2, 0.15] } } } }
[solids.block]
shape = { box = { origin = [0.3, 0.0], size = [0.1, 0.2], cells = [1, 2] } }
density = 1100.0
young = 1e6
poisson = 0.3
"""
SCENES = {"sheet": SHEET, "tank": TANK}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    for name, text in SCENES.items():
        (folder / f"{name}.toml").write_text(text)
        assert cli.main(["run", str(folder / f"{name}.toml"), "--out", str(folder / name), "--steps", "2"]) == 0
    return folder


@pytest.fixture
def copied(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda name: Path(shutil.copytree(made / name, tmp_path / name))


def craft(run, array, change):
    """Change an array of the newest checkpoint, whose manifest then vouches for it."""
    path = max((run / "checkpoint").glob("*.h5"))
    with warnings.catch_warnings(), h5py.File(path, "r+") as file:
        warnings.simplefilter("ignore", DeprecationWarning)  # h5py's, of NumPy
        values = file[array][...]
        changed = change(values)
        file[array][...] = values if changed is None else changed
    size, digest = files.digest(path)
    sidecar = path.with_suffix(".json")
    found = read_manifest(sidecar.read_bytes())
    sidecar.write_text(found.model_copy(update={"data": Mark(bytes=size, blake2b=digest)}).text())
    return path


def at(place, value):
    """Put a value at a place of an array."""
    return lambda values: values.reshape(-1).__setitem__(place, value)


def exchanged(values):
    values[[1, 2]] = values[[2, 1]]


CRAFTED = [
    ("sheet", "solid/displacement", at(3, 1e12), "displacement"),
    ("sheet", "solid/velocity_before", at(3, 1e200), "solid/velocity_before"),
    ("sheet", "solid/past_dt", at(0, -1.0), "past_dt"),
    ("sheet", "pressure/past_dt", at(0, 1e-300), "past_dt"),
    ("sheet", "pressure/cell_kind", at(5, 9), "cell_kind"),
    ("sheet", "pressure/face_kind_y", at(5, 200), "face_kind_y"),
    ("sheet", "pressure/cut_at", at(5, 1e6), "cut_at"),
    ("sheet", "pressure/cut_at", at(0, -1), "cut_at"),
    ("sheet", "pressure/parts_cell", at(1, 1e9), "parts_cell"),
    ("sheet", "pressure/parts_cell", at(0, 1e9), "parts_cell"),
    ("sheet", "pressure/parts_piece", at(1, 2), "parts_piece"),
    ("sheet", "pressure/parts_axis", at(-1, 2), "parts_axis"),
    ("sheet", "pressure/parts_face", at(-1, 1e7), "parts_face"),
    ("sheet", "pressure/parts_face", at(-1, -1), "parts_face"),
    ("sheet", "pressure/parts_face", exchanged, "parts_axis"),
    ("sheet", "pressure/parts_below", at(1, 7), "parts_below"),
    ("sheet", "pressure/parts_above", at(1, -1), "parts_above"),
    ("sheet", "pressure/parts_wall_piece", at(1, 7), "parts_wall_piece"),
    ("sheet", "pressure/parts_openness", at(1, -1e12), "parts_openness"),
    ("sheet", "regions/region", at(1, 1e12), "region"),
    ("sheet", "regions/facet_region", at(1, -3), "facet_region"),
    ("sheet", "guard/weight", at(0, -1.0), "weight"),
    ("tank", "particles/count", at(0, -4), "count"),
    ("tank", "particles/id", at(1, -1), "id"),
    ("tank", "particles/id", at(1, 0), "id"),
    ("tank", "particles/x", at(3, -1e12), "'x'"),
    ("tank", "particles/rho", at(3, 0.0), "rho"),
    ("tank", "particles/m", at(3, -1.0), "'m'"),
    ("tank", "particles/passed", at(1, -5.5), "passed"),
    ("tank", "particles/columns", at(1, 1e9), "columns"),
    ("tank", "stable/way", at(0, -1.0), "way"),
]


@pytest.mark.parametrize("name, array, change, said", CRAFTED, ids=[f"{c[1]}-{n}" for n, c in enumerate(CRAFTED)])
def test_what_cannot_be_is_refused_by_name_and_nothing_is_written(copied, capfd, name, array, change, said):
    run = copied(name)
    path = craft(run, array, change)
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert cli.main(["resume", str(run)]) == 2
    told = capfd.readouterr().err
    assert str(path) in told and said in told and "defect" not in told
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before


def test_so_is_what_another_run_begins_with(copied, made, capfd):
    run = copied("sheet")
    path = craft(run, "pressure/parts_cell", at(1, 1e9))
    assert cli.main(["run", str(made / "sheet.toml"), "--from", str(run), "--out", "new"]) == 2
    told = capfd.readouterr().err
    assert str(path) in told and "parts_cell" in told and not Path("new").exists()


# ---- pictures ---------------------------------------------------------------------------------------------------


def outside(run, name):
    """Put a link in place of a run's own file or folder."""
    place = Path("outside")
    if (run / name).exists():
        shutil.move(run / name, place)
    else:
        place.mkdir()
    (run / name).symlink_to(place.absolute())


@pytest.mark.parametrize(
    "name, words", [("pictures", []), ("pictures", ["--film"]), ("fields", []), ("fields/000001.h5", [])]
)
def test_links_in_a_run_are_not_followed_when_it_is_drawn(copied, capfd, name, words):
    run = copied("sheet")
    outside(run, name)
    assert cli.main(["plot", str(run), *words]) == 2
    assert str(run / name) in capfd.readouterr().err.replace("\n", "")
    assert not Path("outside").is_dir() or not list(Path("outside").glob("*.[pg][ni][gf]"))


def test_nor_are_links_in_its_files(copied, capfd):
    run = copied("sheet")
    with h5py.File(run / "fields" / "000001.h5", "r+") as file:
        del file["solid/displacement"]
        file["solid/displacement"] = h5py.ExternalLink("other.h5", "x")
    assert cli.main(["plot", str(run)]) == 2
    assert "'solid/displacement' of it lies elsewhere" in " ".join(capfd.readouterr().err.split())


def test_a_picture_replaces_a_link(copied):
    run = copied("sheet")
    (run / "pictures").mkdir()
    Path("precious").write_text("precious")
    for name in ("history.png", "000001.png"):
        (run / "pictures" / name).symlink_to(Path("precious").absolute())
    assert cli.main(["plot", str(run)]) == 0
    assert Path("precious").read_text() == "precious" and not (run / "pictures" / "000001.png").is_symlink()


@pytest.mark.parametrize("name", ["history.csv", "fields.xdmf", "fields/outputs.csv"])
def test_what_somebody_removes_while_a_run_is_at_work_is_named(copied, capfd, monkeypatch, name):
    run = copied("sheet")
    take = Run.take_step
    monkeypatch.setattr(Run, "take_step", lambda *given: ((run / name).unlink(), take(*given)))
    assert cli.main(["resume", str(run)]) == 3
    assert f"{run / name} is missing; something else has removed it" in capfd.readouterr().err
