"""``runs.csv``: a row for every run, with what came out of it, from the summaries alone."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

from petfsi.output import files
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.judge import Judged, judge
from petfsi.sweeps.plan import Planned
from petfsi.sweeps.states import Look, look_at

#: Columns that every table has; an axis of such a name, or with a dot as in ``last.PROBE``, is ``axis.NAME``.
FIXED = ["name", "state", "kind", "reason", "steps", "time", "ranks", "repeat", "unknowns"]
FIXED += ["error", "error_bar", "error_note"]
FIXED += ["iterations_mean", "iterations_max", "wall_s", "peak_mb", "attempts"]


def collect(folder: SweepFolder, runs: Sequence[Planned]) -> list[dict[str, Any]]:
    """Write ``runs.csv``, and return its rows."""
    rows = rows_of(folder, runs)
    with folder.alone():
        # what a summary says may be no text
        files.replace_text(folder.table, table_text(rows).encode("utf-8", "backslashreplace"))
    return rows


def rows_of(folder: SweepFolder, runs: Sequence[Planned]) -> list[dict[str, Any]]:
    """Return the rows of runs, with their errors where the sweep judges them; InputError if its rule cannot be read."""
    looks = {run.name: look_at(folder.run(run.name), run) for run in runs}
    rule = folder.read_rule()
    if rule is None:
        return [row_of(run, looks[run.name]) for run in runs]
    done = {name: folder.run(name) for name, look in looks.items() if look.state == "done"}
    judged = judge(folder.inputs, done, runs, rule)
    rows = []
    for run in runs:
        came, row = judged.get(run.name, Judged(note="")), row_of(run, looks[run.name])
        if not came.has_seconds:
            row |= {key: None for key in row if key == "wall_s" or key.startswith("seconds.")}
        rows.append(row | {"error": came.error, "error_bar": came.bar, "error_note": came.note})
    return rows


def row_of(run: Planned, look: Look) -> dict[str, Any]:
    """Return the row of a run; what it has not come to is None."""
    told = look.summary
    iterations = _table(told, "iterations")
    unknowns = _table(told, "unknowns")
    peak = max((attempt.peak_kb for attempt in look.attempts), default=0)
    row: dict[str, Any] = {"name": run.name}
    row |= {(f"axis.{axis}" if axis in FIXED or "." in axis else axis): point for axis, point in run.axes.items()}
    row |= {
        "state": look.state,
        "kind": look.kind if look.state == "failed" else "",
        "reason": look.reason,
        "steps": told.get("steps"),
        "time": told.get("time"),
        "ranks": run.ranks,
        "repeat": run.repeat,
        "unknowns": sum(unknowns.values()) if unknowns else None,
        "iterations_mean": iterations.get("mean"),
        "iterations_max": iterations.get("max"),
        "wall_s": told.get("wall_s"),
        "peak_mb": round(peak * 1024 / 1e6, 1) if peak else None,
        "attempts": len(look.attempts),
    }
    row |= {f"seconds.{phase}": value for phase, value in _table(told, "phases").items()}
    row |= {f"last.{probe}": value for probe, value in _table(told, "probes").items()}
    return row | {f"version.{name}": number for name, number in _table(told, "versions").items()}


def table_text(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows as CSV, with the columns of all of them."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(row.get(column)) for column in columns])
    return out.getvalue()


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return json.dumps(value) if isinstance(value, dict | list) else repr(value) if isinstance(value, float) else value


def _table(summary: dict[str, Any], key: str) -> dict[str, Any]:
    value = summary.get(key)
    return value if isinstance(value, dict) else {}
