"""The picture of a history: a panel for every quantity of probes and accounts, with its unit."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from petfsi.scene.schema import Scene

#: The units of what probes and accounts measure; in the plane those behind the bar, being per metre of thickness.
_UNITS = {
    "displacement": "m",
    "velocity": "m/s",
    "angle": "rad",
    "pressure": "Pa",
    "smoke": "1",
    "front": "m",
    "level": "m",
    "force": "N|N/m",
    "energy": "J|J/m",
    "energy residual": "J|J/m",
    "momentum": "N s|N s/m",
    "region volume": "m$^3$|m$^2$",
    "volume error": "1",
    "divergence": "m/s",
    "mass": "kg|kg/m",
    "particles": "1",
    "put back": "1",
    "particles behind": "1",
    "iterations": "1",
    "newton": "1",
    "substeps": "1",
    "residual": "1",
}
#: Which columns share a panel of another name than their own.
_TOGETHER = {
    "energy": ("kinetic", "elastic", "potential", "dissipated", "load_work", "boundary_work"),
    "mass": ("mass", "mass_in", "mass_out"),
}
_NO_PANEL = ("step", "time", "dt")
#: What says how a step was solved stands last.
_SOLVER = ("iterations", "newton", "substeps", "residual")
#: Counts, which jump, and what is seen by its order of magnitude.
_STEPS, _LOGARITHMIC = ("iterations", "newton", "substeps", "particles", "put back", "particles behind"), ("residual",)
#: So many curves share a panel, so many panels a column, and up to so many columns there are.
_CURVES, _PANELS, _COLUMNS = 6, 6, 3
#: Inches: a column, a panel without its legend, and a line of that.
_WIDTH, _HEIGHT, _LINE = 6.8, 1.75, 0.19
#: Characters of a line of a legend, and of a name in it.
_ACROSS, _NAME = 26, 72
#: What changes by no more than this part of itself stands still.
_STILL = 1e-9
_DASHES = {"x": "solid", "y": (0, (5, 1.5)), "z": (0, (1.2, 1.2))}


@dataclass(frozen=True)
class Panel:
    """What shares a pair of axes.

    Attributes
    ----------
    title : str
        The quantity.
    unit : str
        Empty where nobody knows.
    columns : tuple of str
        Of history.csv.
    """

    title: str
    unit: str
    columns: tuple[str, ...]


def history_panels(table: Mapping[str, np.ndarray], scene: Scene | None) -> list[Panel]:
    """Return the panels of a history: those of probes first, then those of accounts; none of what is zero throughout.

    Parameters
    ----------
    table : mapping of str to ndarray
        The columns.
    scene : Scene or None
        Says what probes measure; without it those of one name share a panel without a unit.
    """
    quantities = {name: probe.quantity for name, probe in scene.probes.items()} if scene else {}
    space = scene.dim == 3 if scene else "momentum.z" in table
    probes: dict[str, dict[str, list[str]]] = {}
    others: dict[str, list[str]] = {}
    for column in table:
        stem, _, part = column.rpartition(".")
        name = column if column in quantities or part not in _DASHES else stem
        if name in quantities:
            probes.setdefault(quantities[name], {}).setdefault(name, []).append(column)
        elif column not in _NO_PANEL:
            others.setdefault(_shared(column), []).append(column)
    groups = [(title, columns) for title, named in probes.items() for columns in _shares(list(named.values()))]
    last = sorted(others, key=lambda title: title in _SOLVER)
    groups += [(title, tuple(others[title])) for title in last]
    return [
        Panel(title, _unit(title, space), columns)
        for title, columns in groups
        if any(np.any(table[column] != 0) for column in columns)
    ]


def _shared(column: str) -> str:
    """Return the title of the panel that a column of accounts belongs to, or one of a probe that nobody knows."""
    for title, columns in _TOGETHER.items():
        if column in columns:
            return title
    stem = column.rpartition(".")[0] or column
    spoken = stem.replace("_", " ")
    return spoken if spoken in _UNITS else stem


def _shares(columns: Sequence[list[str]]) -> Iterator[tuple[str, ...]]:
    """Return the columns of probes that share panels, in equal numbers as far as that goes."""
    width = max(len(own) for own in columns)
    most = max(1, _CURVES // width)
    each = -(-len(columns) // -(-len(columns) // most))
    rest = iter(columns)
    while some := list(islice(rest, each)):
        yield tuple(column for own in some for column in own)


def _unit(title: str, space: bool) -> str:
    in_space, _, in_plane = _UNITS.get(title, "").partition("|")
    return in_space if space or not in_plane else in_plane


def history_figure(table: Mapping[str, np.ndarray], scene: Scene | None = None) -> Figure:
    """Return the panels of a history over time, in columns.

    Parameters
    ----------
    table : mapping of str to ndarray
        Its columns.
    scene : Scene, optional
        The run's.
    """
    panels = history_panels(table, scene)
    if not panels:
        return _nothing(table)
    names = list(scene.probes) if scene else []
    labels = {column: _label(column, names) for panel in panels for column in panel.columns}
    n_columns = min(_COLUMNS, -(-len(panels) // _PANELS))
    n_rows = -(-len(panels) // n_columns)
    heights = np.full(n_columns * n_rows, _HEIGHT)
    heights[: len(panels)] = [
        max(_HEIGHT, _LINE * sum(labels[c].count("\n") + 1 for c in panel.columns) + 0.25) for panel in panels
    ]
    rows = heights.reshape(n_rows, n_columns).max(axis=1)
    figure = Figure(figsize=(_WIDTH * n_columns + 1.2, rows.sum() + 0.5), layout="constrained")
    places = figure.add_gridspec(n_rows, n_columns, height_ratios=rows)
    for number, panel in enumerate(panels):
        row, column = divmod(number, n_columns)
        ax = figure.add_subplot(places[row, column])
        _draw(ax, panel, table, labels)
        if number + n_columns >= len(panels):
            ax.set_xlabel("time, s")
        else:
            ax.tick_params(labelbottom=False)
    figure.align_ylabels()
    return figure


def _nothing(table: Mapping[str, np.ndarray]) -> Figure:
    figure = Figure(figsize=(5.0, 1.2))
    rows = len(next(iter(table.values()), ()))
    text = f"all columns of history.csv are zero in all of {rows} rows" if rows else "history.csv has no rows"
    figure.text(0.5, 0.5, text, ha="center", va="center")
    return figure


def _draw(ax: Axes, panel: Panel, table: Mapping[str, np.ndarray], labels: Mapping[str, str]) -> None:
    """Draw a panel: a colour for every probe, or for every column of accounts, and dashes by component."""
    of = [column.rpartition(".") for column in panel.columns]
    vectors = all(stem and part in _DASHES for stem, _, part in of)
    colours = {stem: f"C{n}" for n, stem in enumerate(dict.fromkeys(stem for stem, _, _ in of))}
    alone = len(colours) == 1 or not vectors
    for number, (column, (stem, _, part)) in enumerate(zip(panel.columns, of, strict=True)):
        ax.plot(
            table["time"],
            table[column],
            lw=1.3,
            label=labels[column],
            color=f"C{number}" if alone else colours[stem],
            linestyle="solid" if alone else _DASHES[part],
            drawstyle="steps-post" if panel.title in _STEPS else None,
        )
    values = np.concatenate([table[column] for column in panel.columns])
    values = values[np.isfinite(values)]
    if panel.title in _LOGARITHMIC and np.any(values > 0):
        ax.set_yscale("log")
    elif len(values) and np.ptp(values) <= _STILL * np.abs(values).max():
        ax.set_ylim(*np.sort(values.mean() * np.array((0.9, 1.1))))  # round-off is no story
    ax.set_ylabel(f"{panel.title}, {panel.unit}" if panel.unit else _label(panel.title, ()))
    if len(panel.columns) > 1 or panel.columns[0].replace("_", " ") != panel.title:
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.03), frameon=False, fontsize="small")
    ax.grid(alpha=0.3)
    ax.margins(x=0)


def _label(column: str, probes: Sequence[str]) -> str:
    """Return a column's name in lines short enough for a legend; of one cut short with its probe's number."""
    if len(column) > _NAME:
        stem = column if column in probes else column.rpartition(".")[0]
        number = f"{probes.index(stem) + 1}: " if stem in probes else ""
        half = (_NAME - len(number)) // 2 - 1
        column = f"{number}{column[:half]}\N{HORIZONTAL ELLIPSIS}{column[-half:]}"
    lines = [""]
    for word in re.split(r"(?<=[_.: ])", column):
        if lines[-1] and len(lines[-1]) + len(word) > _ACROSS:
            lines.append("")
        for begin in range(0, len(word), _ACROSS):
            lines += [""] if begin else []
            lines[-1] += word[begin : begin + _ACROSS]
    return "\n".join(lines)
