"""Pictures of a run: its history, and the scene at every output time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from petfsi.errors import InputError
from petfsi.output import files
from petfsi.output.frames import Frame, Wanted, read_frame, wanted_files, wanted_rows
from petfsi.output.history import read_history
from petfsi.output.history_figure import history_figure
from petfsi.output.plane import draw_plane
from petfsi.output.slices import Plane
from petfsi.output.space import draw_space
from petfsi.output.stage import Stage, look_through
from petfsi.output.surroundings import scene_of

#: What pictures may be stored as.
FORMATS = ("png", "pdf", "svg")
_DPI = 130
#: The largest a plane is drawn, and the room for its labels and a colour bar at its right or below, inches.
_PLANE, _SMALLEST, _RIGHT, _BELOW = np.array([9.0, 7.5]), (3.6, 2.6), (1.9, 1.0), (1.0, 1.9)
#: Planes that are so many times as long as high have the colour bar below.
_FLAT = 3.0
#: Numbers of a colour bar from 10^-3 to 10^4 are written out.
_PLAIN = (-3, 4)
#: Of two slices, a gap, for no layout knows of labels in space, and the view.
_WIDTHS = (1.0, 1.0, 0.12, 1.1)
#: How wide a colour bar may be beside a plane, inches.
_BAR = 0.25
#: What is nearer to zero than this part of a side is called zero.
_ROUND = 1e-9
#: What reading and drawing a file of ``fields/`` raise that petfsi has not written.
UNDRAWABLE = (OSError, KeyError, ValueError, TypeError, IndexError, RuntimeError, AttributeError)


def plot_run(directory: Path, wanted: Wanted | None = None, kind: str = "png") -> list[Path]:
    """Draw ``pictures/history.png`` and ``pictures/NNNNNN.png`` for the output times wanted, and return them.

    Colours and frames mean the same in all of them. Not collective.

    Parameters
    ----------
    directory : Path
        The run's.
    wanted : Wanted, optional
        Which times, and what is coloured; by default all, and the first quantity that varies.
    kind : str
        What they are stored as, of ``FORMATS``.

    Raises
    ------
    InputError
        When there is nothing to draw, or nothing of what is wanted, or a file is damaged.
    """
    directory, wanted = Path(directory), wanted or Wanted()
    refuse_no_directory(directory)
    refuse_links(directory)
    with reading(directory):
        frames = wanted_files(directory, wanted)
    history = directory / "history.csv"
    if not frames and not history.exists():
        raise InputError(f"{directory} has neither history.csv nor fields, so there is nothing to draw")
    if not frames and wanted.quantity is not None:
        raise InputError(f"--quantity {wanted.quantity}: {directory} has no fields, so nothing can be coloured")
    with reading(directory):
        stage = look_through(directory, frames, wanted.quantity) if frames else None
    panels = _history(directory, history, wanted, bool(frames))
    pictures = own_pictures(directory)
    drawn = [] if panels is None else [_save(panels, pictures / f"history.{kind}")]
    if stage is not None:
        with reading(directory):
            for frame in map(read_frame, frames):
                drawn.append(_save(scene_figure(stage, frame), pictures / f"{frame.step:06d}.{kind}"))
    return drawn


def _history(directory: Path, path: Path, wanted: Wanted, others: bool) -> Figure | None:
    """Return the figure of a history; None where it has nothing to show of those times, but the fields have."""
    if not path.exists():
        return None
    table = read_history(path)
    if others and "time" in table and not wanted.holds(table["time"]).any():
        return None
    return history_figure(wanted_rows(table, wanted), scene_of(directory))


@contextmanager
def reading(directory: Path) -> Iterator[None]:
    """Say of which run it is that a file cannot be drawn."""
    try:
        yield
    except UNDRAWABLE as error:
        raise InputError(f"{directory / 'fields'} cannot be drawn: {error}") from error


def refuse_no_directory(directory: Path) -> None:
    """Raise InputError where there is nothing to draw because there is no such directory."""
    if not directory.is_dir():
        raise InputError(f"{directory} is no directory" if directory.exists() else f"there is no directory {directory}")


def refuse_links(directory: Path) -> None:
    """Raise InputError where a run's folder of fields is a link."""
    fields = directory / "fields"
    if fields.is_symlink():
        raise InputError(
            f"{fields} is a link, and petfsi follows none in a run directory; put what it names in its place"
        )


def own_pictures(directory: Path) -> Path:
    """Return a run's folder of pictures, and make it; InputError where it is a link."""
    pictures = directory / "pictures"
    try:
        files.own_directory(pictures)
    except OSError as error:
        raise InputError(f"{pictures} cannot be written: {files.reason(error)}") from error
    return pictures


def _save(figure: Figure, path: Path) -> Path:
    with open(files.new_file(path), "wb") as file:
        figure.savefig(file, dpi=_DPI, format=path.suffix[1:])
    return path


# ---- a scene ------------------------------------------------------------------------------------------------


def scene_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of one output time."""
    return _plane_figure(stage, frame) if stage.dim == 2 else _space_figure(stage, frame)


def _plane_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of a 2D scene."""
    extent = (stage.high - stage.low) * stage.stretch
    size = extent * np.min(_PLANE / extent)
    flat = size[0] > _FLAT * size[1]
    width, height = np.maximum(_SMALLEST, size + (_BELOW if flat else _RIGHT))
    figure = Figure(figsize=(width, height), layout="compressed")
    ax = figure.subplots()
    coloured = draw_plane(ax, stage, frame, Plane())
    ax.set_title(_title(stage, frame, Plane()), fontsize="medium")
    if coloured:
        place: dict[str, Any] = {"location": "bottom"} if flat else {}
        room = float(np.clip(_BAR / size[int(flat)], 0.1, 0.5))
        place |= {"aspect": 30, "shrink": 0.9, "fraction": room}
        _add_bar(figure, coloured, [ax], stage, place)
    return figure


def _space_figure(stage: Stage, frame: Frame) -> Figure:
    """Return the picture of a 3D scene: two slices through the middle of the solids or the fluid, and a view."""
    extent = (stage.high - stage.low) * stage.stretch
    middle = stage.middle
    if frame.points is not None:
        middle = np.clip(frame.points.mean(axis=0), stage.low, stage.high)
    middle = np.where(np.abs(middle) < _ROUND * (stage.high - stage.low), 0.0, middle)
    rigid = stage.around is not None and bool(stage.around.obstacles)
    seen = rigid or frame.points is not None or bool(frame.particles)
    height = np.clip(4.4 * max(extent[1], extent[2]) / extent[0], 2.4, 7.0)
    figure = Figure(figsize=(15.5 if seen else 10.0, height + 1.6), layout="constrained")
    places = figure.add_gridspec(1, 4 if seen else 2, width_ratios=_WIDTHS if seen else None)
    coloured, panels = None, []
    for n, (across, axis) in enumerate((((0, 1), 2), ((0, 2), 1))):
        ax = figure.add_subplot(places[0, n])
        panels.append(ax)
        plane = Plane(across, float(middle[axis]))
        coloured = draw_plane(ax, stage, frame, plane) or coloured
        ax.set_title(_title(stage, frame, plane), fontsize="medium")
    if seen:
        draw_space(figure.add_subplot(places[0, 3], projection="3d"), stage, frame)
    if coloured:
        _add_bar(figure, coloured, panels, stage, {"location": "bottom", "shrink": 0.6, "aspect": 50})
    return figure


def _title(stage: Stage, frame: Frame, plane: Plane) -> str:
    """Return the time, where the plane is, and along which axis it is drawn larger than along the other."""
    text = f"t = {frame.time:.4g} s"
    if plane.axis is not None:
        text += f", {'xyz'[plane.axis]} = {plane.at:.3g} m"
    stretch = stage.stretch[list(plane.across)]
    if stretch.max() > stretch.min():
        text += f"\n{'xyz'[plane.across[int(stretch.argmax())]]} stretched {stretch.max() / stretch.min():.3g} times"
    return text


def _add_bar(figure: Figure, coloured: ScalarMappable, panels: list[Axes], stage: Stage, place: dict[str, Any]) -> None:
    numbers = ScalarFormatter()
    numbers.set_powerlimits(_PLAIN)
    figure.colorbar(coloured, ax=panels, label=stage.look.label, extend=stage.extend, format=numbers, **place)
