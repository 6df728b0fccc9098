"""Walls: flows along and past them, bodies that stay, fall and swing, sheets thinner than a cell, against exact flows.

The exact flows are those of potential theory and owe nothing to the program's own numerics:

- ``along a wall``: a stream along the plane side of a half space, at 0 to 90 degrees in 2D and in random directions in
  3D, is a solution for ever. Largest error of the velocity over the faces that the pressure acts on, after five steps.
- ``past a disk``, ``past a ball``: a stream set off at once, in a box through whose sides the exact flow passes: the
  first step's pressure must make the flow of potential theory. The bodies' facets are much finer than the cells; an
  obstacle's own, as large as cells, would add errors of the same order. Means are over the open parts of faces, and
  over the grid's places between the cells. An error of the order of a cell in one layer of faces gives orders 2, 1.5
  and 1 in L1, L2 and max.
- ``drag of a disk``: a heavy disk in an even stream, over one diameter of flow; the exact drag is zero.
- ``falling disk``, ``falling ball``: let go in a channel; the mean acceleration over that of potential flow, and the
  energy residual over the kinetic energy.
- ``below a sheet``: water at rest under a sheet thinner than a cell, over which water turns.
- ``beam``: one that divides the cells of a box of water; frequency and damping, without what the step does to a mode.
"""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from petfsi.bench import walls_bodies, walls_flows, walls_sheets
from petfsi.bench.case import Case
from petfsi.bench.report import Report, Row

FLOWS, BODIES = ("past a disk", "past a ball"), ("drag of a disk", "falling disk", "falling ball")


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("Walls against exact flows")
    walls_flows.uniform(case, report)
    for dim in (2, 3):
        walls_flows.impulsive(case, report, dim)
    walls_bodies.resist(case, report)
    for dim in (2, 3):
        walls_bodies.fall(case, report, dim)
    walls_sheets.shield(case, report)
    walls_sheets.swing(case, report)
    report.figure = _picture(report)
    return report


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    flow, bodies, beams = figure.subplots(1, 3)
    for part, marker in zip(FLOWS, "os", strict=True):
        for colour, norm in enumerate(walls_flows.ORDERS):
            style = {"color": f"C{colour}", "mfc": "none", "label": f"{part}, {norm}"}
            _curve(flow, [row for row in report.rows if row["part"] == part], norm, marker, style)
    for colour, part in enumerate(BODIES):
        rows = [row | {"value": abs(row["value"] - (part != "drag of a disk"))}
                for row in report.rows if row["part"] == part]  # fmt: skip
        _curve(bodies, rows, "value", "o", {"color": f"C{colour}", "mfc": "none", "label": part})
    for colour, place in enumerate(walls_sheets.PLACES):
        name = f"at {place:g} of a cell"
        rows = [row for row in report.rows if row["part"] == "beam" and row["scheme"] == name]
        _curve(beams, rows, "value", "o", {"color": f"C{colour}", "mfc": "none", "label": name})
    for axes, parts in ((flow, FLOWS), (bodies, BODIES), (beams, ("beam",))):
        _ticks(axes, parts, report.rows)
    flow.set(xlabel="cells", title="past bodies: error of velocity / stream")
    bodies.set(xlabel="cells to radius or diameter", title="drag coefficient, error of acceleration")
    beams.set(xlabel="cells", title="beam: error of the frequency")
    return figure


def _curve(axes: Axes, rows: list[Row], key: str, marker: str, style: dict) -> None:
    """Draw a number over the cells that the column ``at`` names."""
    if rows:
        axes.loglog([_cells(row) for row in rows], [abs(row[key]) for row in rows], marker + "-", **style)
        axes.legend(fontsize=8)


def _cells(row: Row) -> int:
    return int("".join(filter(str.isdigit, row["at"])))


def _ticks(axes: Axes, parts: tuple[str, ...], rows: list[Row]) -> None:
    """Mark the cells of some parts of the bench."""
    cells = sorted({_cells(row) for row in rows if row["part"] in parts})
    axes.set_xticks(cells, [f"{n}" for n in cells])
    axes.xaxis.set_minor_locator(NullLocator())
