"""A film of a run: a picture of every output time, drawn one by one, so that memory does not grow with the run."""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from PIL import Image
from PIL.GifImagePlugin import getdata

from petfsi.errors import InputError, PetfsiError
from petfsi.output import files
from petfsi.output.frames import Wanted, read_frame, time_of, wanted_files
from petfsi.output.pictures import own_pictures, reading, refuse_links, refuse_no_directory, scene_figure
from petfsi.output.plane import BODIES, WATER
from petfsi.output.stage import Stage, look_through
from petfsi.output.surroundings import GREY, HATCH, LINE

#: Frames per second that a film has by itself: those of real time, within these bounds.
SLOWEST, FASTEST = 5.0, 30.0
#: The most that can be asked for: browsers take a GIF's delay of 0.01 s for one of 0.1 s.
MOST = 50.0
_DPI = 100
#: The number of a GIF's colour that leaves a pixel as it is, and the last of the others.
_AS_BEFORE, _LAST = 255, 254

#: Pictures as (height, width, 3), a byte each.
Pictures = Iterator[np.ndarray]


def film_run(
    directory: Path,
    file: Path | None = None,
    wanted: Wanted | None = None,
    fps: float | None = None,
) -> tuple[Path, int, float]:
    """Draw a film of a run, and return its file, the number of its frames and how many are shown per second.

    Colours and frames mean the same all the time. Not collective.

    Parameters
    ----------
    directory : Path
        The run's.
    file : Path, optional
        What to write, or replace: a GIF, or by ffmpeg an MP4, as the ending says; ``pictures/film.gif`` of the run
        by default.
    wanted : Wanted, optional
        Which times, and what is coloured; by default all, and the first quantity that varies.
    fps : float, optional
        Frames per second; by default as many as make the film last as long as what it shows, but at least ``SLOWEST``
        and at most ``FASTEST``.

    Raises
    ------
    InputError
        When there is nothing to show, or nothing of what is wanted, a file is damaged, or the film cannot be of that
        kind, that speed or there.
    """
    directory, wanted = Path(directory), wanted or Wanted()
    file = Path(file) if file else directory / "pictures" / "film.gif"
    write = _writer(file)
    if fps is not None and not 0.0 < fps <= MOST:
        raise InputError(f"--fps {fps:g}: must be greater than 0 and at most {MOST:g} frames per second")
    refuse_no_directory(directory)
    refuse_links(directory)
    with reading(directory):
        paths = wanted_files(directory, wanted)
    if not paths:
        raise InputError(f"{directory} has no fields, so there is nothing to film (the scene's output.every sets them)")
    with reading(directory):
        stage = look_through(directory, paths, wanted.quantity)
        fps = fps or _real_time(paths)
    if file.parent == directory / "pictures":
        own_pictures(directory)
    if not file.parent.is_dir():
        raise InputError(f"{file}: there is no folder {file.parent}")
    part = files.part_of(file)
    try:
        part.unlink(missing_ok=True)  # a link would be followed
        write(part, _pictures(directory, stage, paths), fps, stage)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return file, len(paths), fps


def _writer(file: Path) -> Callable[[Path, Pictures, float, Stage], None]:
    """Return what writes a film of the kind that a file's ending says."""
    if file.suffix == ".gif":
        return _write_gif
    if file.suffix != ".mp4":
        raise InputError(f"{file}: the name of a film ends in .gif, or in .mp4 where ffmpeg is installed")
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        raise InputError(f"{file}: an MP4 needs the program ffmpeg, which is not on the PATH; a .gif needs nothing")
    return partial(_write_mp4, ffmpeg)


def _real_time(paths: Sequence[Path]) -> float:
    """Return how many frames a second show a run as fast as it went, within bounds."""
    lasts = time_of(paths[-1]) - time_of(paths[0])
    return float(np.clip((len(paths) - 1) / lasts, SLOWEST, FASTEST)) if lasts > 0.0 else SLOWEST


def _pictures(directory: Path, stage: Stage, paths: Sequence[Path]) -> Pictures:
    for path in paths:
        with reading(directory):
            frame = read_frame(path)
        figure = scene_figure(stage, frame)
        figure.set_dpi(_DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()  # without what else the canvas holds


# ---- GIF ----------------------------------------------------------------------------------------------------


def _write_gif(part: Path, pictures: Pictures, fps: float, stage: Stage) -> None:
    """Write an animated GIF that repeats for ever; Pillow's own would hold all frames until the last.

    All frames share one palette, so that a colour does not change with what else a frame shows, and each holds only
    what has changed.
    """
    colours = _palette(stage)
    table = Image.new("P", (1, 1))
    table.putpalette(colours.tobytes())
    before, shown = None, 0
    with open(part, "wb") as file:
        for number, picture in enumerate(pictures, start=1):
            image = Image.fromarray(picture).quantize(palette=table, dither=Image.Dither.NONE)
            now = np.minimum(np.asarray(image), _LAST)
            if before is None:
                file.write(_gif_head(now.shape, colours))
            corner, piece = _change(before, now)
            until = round(100 * number / fps)  # in hundredths of a second; rounded so that the sum is right
            about = {"duration": 10 * min(until - shown, 65535), "transparency": _AS_BEFORE}
            file.writelines(getdata(Image.fromarray(piece), offset=corner, **about))
            before, shown = now, until
        file.write(b";")


def _gif_head(shape: tuple[int, ...], colours: np.ndarray) -> bytes:
    """Return the head of a GIF with 256 colours, with the extension that has it repeated for ever."""
    head = b"GIF89a" + struct.pack("<HHBBB", shape[1], shape[0], 0xF7, 0, 0)
    return head + colours.tobytes() + b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _change(before: np.ndarray | None, now: np.ndarray) -> tuple[tuple[int, int], np.ndarray]:
    """Return the upper left corner and the pixels of the rectangle that holds all changes."""
    if before is None:
        return (0, 0), now
    differs = now != before
    rows, columns = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return (0, 0), np.full((1, 1), _AS_BEFORE, dtype=np.uint8)
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return (int(columns[0]), int(rows[0])), np.where(differs[window], now[window], np.uint8(_AS_BEFORE))


def _palette(stage: Stage) -> np.ndarray:
    """Return the 256 colours of all frames: the scale's, those under arrows, of bodies in the light, and of lines."""
    scale = matplotlib.colormaps[stage.look.colours](np.linspace(0.0, 1.0, 140))[:, :3]
    lit = scale[::34] if stage.of_solids else np.array([to_rgb(colour) for colour in BODIES])
    parts = [
        scale,
        0.4 * scale[::5] + 0.6,
        (np.linspace(0.3, 1.0, 8)[:, None, None] * lit).reshape(-1, 3),
        np.linspace(0.0, 1.0, 24)[:, None] * np.ones(3),
        1.0 - np.linspace(0.2, 1.0, 8)[:, None] * (1.0 - np.array(to_rgb(LINE))),
        [to_rgb(colour) for colour in (GREY, HATCH, WATER)],
    ]
    colours = np.ones((256, 3))
    given = np.concatenate(parts)
    colours[: len(given)] = given
    return np.round(255.0 * colours).astype(np.uint8)


# ---- MP4 ----------------------------------------------------------------------------------------------------


def _write_mp4(ffmpeg: str, part: Path, pictures: Pictures, fps: float, stage: Stage) -> None:
    """Have ffmpeg write an MP4 that every browser plays, which takes an even number of pixels both ways."""
    first = next(pictures)
    height, width = (n - n % 2 for n in first.shape[:2])
    words = ["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    words += ["-r", f"{fps:g}", "-i", "-", "-pix_fmt", "yuv420p", "-f", "mp4", str(part)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([ffmpeg, *words], stdin=subprocess.PIPE, stdout=said, stderr=said)
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # it has given up, and said why
                for picture in chain([first], pictures):
                    process.stdin.write(picture[:height, :width].tobytes())
        except BaseException:
            process.kill()
            raise
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()
            code = process.wait()
        if code != 0 or not part.exists():
            said.seek(0)
            why = " ".join(said.read().decode(errors="replace").split())[-300:]
            raise PetfsiError(f"ffmpeg wrote no film (exit code {code}): {why or 'it did not say why'}")
