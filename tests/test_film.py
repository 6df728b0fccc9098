"""Films of runs of every kind: what is in them, how fast they are, and what is refused. About 4 s."""

import os
import stat
import subprocess
import sys

import numpy as np
import pytest
from mpi4py import MPI
from output_cases import SCENE, grid, output
from PIL import Image, ImageSequence
from processes import environment
from test_point_clouds import groups

from petfsi import cli
from petfsi.errors import InputError
from petfsi.output import film
from petfsi.output.fields import FieldWriter, field_files
from petfsi.output.film import film_run
from petfsi.output.frames import Wanted
from petfsi.output.rundir import RunDirectory

KINDS = ["grid", "solid", "particles"]
STEPS = [0, 5, 10]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Films in a test need few pixels."""
    monkeypatch.setattr(film, "_DPI", 40)


def write(directory, kind, steps=STEPS, dt=0.1):
    writer = FieldWriter(directory, MPI.COMM_SELF, grid(2) if kind == "grid" else None)
    for step in steps:
        fields = groups(2, step, MPI.COMM_SELF, False) if kind == "particles" else output(2, step * dt, MPI.COMM_SELF)
        writer.write(step, step * dt, {"solid": fields["solid"]} if kind == "solid" else fields)


def frames(path):
    """Return the pictures of a GIF as a browser composes them, and how long each is shown, ms."""
    with Image.open(path) as image:
        assert image.info["loop"] == 0, "for ever"
        each = [(np.asarray(f.convert("RGB")).astype(int), f.info["duration"]) for f in ImageSequence.Iterator(image)]
    return [f for f, _ in each], [d for _, d in each]


@pytest.mark.parametrize("kind", KINDS)
def test_a_film_shows_every_output_time(tmp_path, capsys, kind):
    write(tmp_path, kind)
    assert cli.main(["plot", str(tmp_path), "--film"]) == 0
    file = tmp_path / "pictures" / "film.gif"
    assert capsys.readouterr().out == f"{file}: 3 frames, 5 per second\n"
    assert [path.name for path in file.parent.iterdir()] == ["film.gif"]
    shown, durations = frames(file)
    assert len(shown) == 3 and durations == [200, 200, 200]
    paths = field_files(tmp_path)
    (last,) = film._pictures(tmp_path, film.look_through(tmp_path, paths), paths[-1:])
    off = [np.mean(np.abs(picture - last)) for picture in shown]
    assert off[2] < 1.5 and off[2] < 0.3 * min(off[:2]), (
        "over the frame before, in few colours, it is the whole picture"
    )


def test_colours_mean_the_same_in_all_frames(tmp_path):
    write(tmp_path, "particles")
    file, n, _ = film_run(tmp_path, tmp_path / "p.gif", Wanted(quantity="pressure"))
    shown, _ = frames(file)
    assert n == 3
    bar = np.s_[:, int(0.88 * shown[0].shape[1]) :]
    for picture in shown[1:]:
        assert np.array_equal(picture[bar], shown[0][bar])


def test_the_speed_is_real_time_within_bounds_or_as_asked(tmp_path):
    (tmp_path / "fast").mkdir()
    write(tmp_path, "solid", range(11))
    paths = field_files(tmp_path)
    assert film._real_time(paths) == pytest.approx(10.0)
    assert film._real_time(paths[::5]) == film._real_time(paths[:1]) == 5.0
    assert film_run(tmp_path, tmp_path / "a.gif", Wanted(every=4), fps=30.0)[1:] == (3, 30.0)
    shown, durations = frames(tmp_path / "a.gif")
    assert durations == [30, 40, 30], "in hundredths of a second, the right sum"
    write(tmp_path / "fast", "solid", range(3), dt=0.01)
    assert film._real_time(field_files(tmp_path / "fast")) == 30.0


def test_a_frame_may_be_as_the_one_before():
    before = np.zeros((4, 5), dtype=np.uint8)
    assert film._change(before, before)[1].tolist() == [[255]]
    now = before.copy()
    now[1, 2], now[2, 4] = 7, 8
    corner, piece = film._change(before, now)
    assert corner == (2, 1) and piece.tolist() == [[7, 255, 255], [255, 255, 8]]


FFMPEG = """#!{python}
import sys
given = sys.stdin.buffer.read({read})
if {fails}:
    sys.exit("no room for" + chr(10) + "a film")
with open(sys.argv[-1], "w") as file:
    print(*sys.argv[1:-1], len(given), file=file)
"""


def fake_ffmpeg(tmp_path, monkeypatch, read=-1, fails=False):
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "ffmpeg"
    program.write_text(FFMPEG.format(python=sys.executable, read=read, fails=fails))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)


def test_ffmpeg_is_given_every_frame(tmp_path, monkeypatch):
    write(tmp_path, "solid")
    fake_ffmpeg(tmp_path, monkeypatch)
    file, n, fps = film_run(tmp_path, tmp_path / "a.mp4", fps=12.5)
    words = file.read_text().split()
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert width % 2 == height % 2 == 0
    assert words[words.index("-r") + 1] == "12.5" and n == 3
    assert int(words[-1]) == 3 * 3 * width * height


def test_ffmpeg_may_fail_early_and_says_why(tmp_path, monkeypatch):
    write(tmp_path, "solid", [0])
    fake_ffmpeg(tmp_path, monkeypatch, read=10, fails=True)
    (tmp_path / "a.mp4").write_text("an older film")
    # a process of its own: PETSc, as pytest's has it, ends one that writes to a reader that has left
    words = [sys.executable, "-m", "petfsi.cli", "plot", str(tmp_path), "--film", str(tmp_path / "a.mp4")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=180, env=environment())
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "petfsi: ffmpeg wrote no film (exit code 1): no room for a film\n"
    assert sorted(path.name for path in tmp_path.glob("a.*")) == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_text() == "an older film"


@pytest.mark.parametrize(
    "words, said",
    [
        (["--film", "a.avi"], "a.avi: the name of a film ends in .gif, or in .mp4 where ffmpeg is installed"),
        (["--film", "a.mp4"], "a.mp4: an MP4 needs the program ffmpeg, which is not on the PATH"),
        (["--film", "nowhere/a.gif"], "nowhere/a.gif: there is no folder nowhere"),
        (["--film", "--fps", "0"], "--fps 0: must be greater than 0 and at most 50"),
        (["--film", "--fps", "-3"], "--fps -3: must be"),
        (["--film", "--fps", "nan"], "--fps nan: must be"),
        (["--film", "--fps", "60"], "--fps 60: must be"),
        (["--film", "--fps", "fast"], "Invalid value for '--fps'"),
        (["--fps", "3"], "--fps is the speed of a film: give --film, too"),
        (["--film", "--quantity", "smoke"], "--quantity smoke: the fields in"),
        (["--film", "--from", "2"], "--from 2: no output time of"),
    ],
)
def test_a_film_that_cannot_be_is_refused(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    write(tmp_path, "solid", [0])
    assert cli.main(["plot", str(tmp_path), *words]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fields", "fields.xdmf", "solid.xdmf"]


def test_a_run_without_fields_has_no_film(tmp_path, capsys):
    with pytest.raises(InputError, match="has no fields, so there is nothing to film"):
        film_run(tmp_path)
    write(tmp_path, "solid", [0, 5])
    (tmp_path / "fields" / "000005.h5").write_bytes(b"damaged")
    assert cli.main(["plot", str(tmp_path), "--film", str(tmp_path / "a.gif")]) == 2
    assert "fields cannot be drawn" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.gif*"))


def test_a_new_run_takes_the_place_of_an_old_one_and_its_film(tmp_path):
    path = tmp_path / "run"
    RunDirectory.create(path, SCENE, "", overwrite=False, comm=MPI.COMM_SELF)
    write(path, "solid", [0])
    (path / "particles.xdmf").write_text("the first run's")
    film_run(path)
    film_run(path, path / "pictures" / "mine.gif")
    RunDirectory.create(path, "second", "", overwrite=True, comm=MPI.COMM_SELF)
    left = sorted(p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file())
    assert left == [".petfsi-run", "options.opts", "pictures/mine.gif", "scene.toml"]
