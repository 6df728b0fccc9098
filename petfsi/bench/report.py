"""What a bench hands back, and how it reaches the reader."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
from matplotlib.figure import Figure

Row = dict[str, Any]


@dataclass
class Report:
    """Rows of a table, the bounds they broke, remarks, and a picture.

    Rows may have different columns; a missing value stays empty.
    """

    title: str
    rows: list[Row] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    figure: Figure | None = None

    def demand(self, holds: bool, row: Row, bound: str) -> None:
        """Note a row that breaks a bound; also one whose value is not a number."""
        if not holds:
            self.failures.append(f"{bound}: {', '.join(f'{k} {shown(v)}' for k, v in row.items())}")

    @property
    def columns(self) -> list[str]:
        """All columns, in the order in which they first appear."""
        return list(dict.fromkeys(name for row in self.rows for name in row))


def shown(value: Any) -> str:
    """Return a value as the table shows it."""
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def table(report: Report) -> str:
    """Return the rows as text, columns aligned."""
    cells = [report.columns, *([shown(row.get(name, "")) for name in report.columns] for row in report.rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in cells
    )


def publish(report: Report, out: Path, name: str) -> None:
    """Write the table and the picture, and print the table with its verdict. For one rank only."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, report.columns)
        writer.writeheader()
        writer.writerows(report.rows)
    click.echo(f"{report.title}\n\n{table(report)}\n")
    for note in report.notes:
        click.echo(note)
    if report.figure is not None:
        report.figure.savefig(out / f"{name}.png", dpi=130)
    for failure in report.failures:
        click.echo(f"out of bounds: {failure}", err=True)
    verdict = "all bounds hold" if not report.failures else f"{len(report.failures)} rows out of bounds"
    click.echo(f"{verdict}; table and picture: {out / name}.csv, .png")
