"""How far the runs of a sweep are from their reference, from their histories alone: what ``[error]`` asks for."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from petfsi.errors import InputError
from petfsi.norms import Extrapolated, Series, error_of, extrapolate
from petfsi.output import files
from petfsi.output.history import read_history
from petfsi.registry import INTEGRATORS, find
from petfsi.sweeps.error_rule import FINEST, ErrorRule, series_of
from petfsi.sweeps.names import digest_of
from petfsi.sweeps.plan import Planned

#: An error of fewer bars of its reference is not sure, one below a single bar not known.
SURE = 3.0
#: What a row says of the size of an error.
REFERENCE, FAR_OFF, UNSURE, UNKNOWN = "is the reference", "far off", "within three bars of the reference", "not known"
#: Runs that an extrapolation looks at.
_FINEST = 3
#: Bytes of the largest table that is a reference.
_MOST = 200_000_000


@dataclass(frozen=True)
class Judged:
    """What came of a run.

    Attributes
    ----------
    error : float or None
        Relative to the reference; None where it is not known.
    bar : float or None
        How far the reference may itself be off, where that is known.
    note : str
        What is to be known of the error, or why there is none.
    """

    error: float | None = None
    bar: float | None = None
    note: str = ""

    @property
    def has_seconds(self) -> bool:
        """Whether seconds mean anything: those of a run that is far off do not."""
        return not self.note.startswith(FAR_OFF)


def judge(inputs: Path, runs: Mapping[str, Path], planned: Sequence[Planned], rule: ErrorRule) -> dict[str, Judged]:
    """Return by name what came of runs.

    Parameters
    ----------
    inputs : Path
        Where a table that is the reference lies.
    runs : mapping of str to Path
        Directories, by name, of the runs that are done: no others have an error.
    planned : sequence of Planned
        All runs of the sweep.
    rule : ErrorRule
    """
    found: dict[str, Judged] = {}
    series: dict[str, Series] = {}
    for run in planned:
        if run.name not in runs:
            continue
        try:
            series[run.name] = series_of(read_history(runs[run.name] / "history.csv"), rule.of)
        except InputError as error:
            found[run.name] = Judged(note=f"{UNKNOWN}: {error}")
    if not rule.own:
        try:
            reference = _table(inputs / rule.reference, rule.of)
        except InputError as error:
            return {name: Judged(note=f"{UNKNOWN}: {error}") for name in runs}
        return found | {name: _compared(one, reference, None, rule) for name, one in series.items()}
    orders = {run.name: rule.order or _order(run) for run in planned}
    for path, names in _families(planned, rule.along):
        order = orders.get(path[0], 0.0)
        found |= _of_family(path, [name for name in names if name in series], series, rule, order)
    return found


def _table(path: Path, of: Sequence[str]) -> Series:
    """Return the reference that a file holds; InputError if it is not the one that was planned."""
    try:
        data = files.read_small(path, _MOST)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {files.reason(error)}") from error
    if digest_of(data) not in path.name:
        raise InputError(f"{path} has been changed since it was planned")
    return series_of(read_history(path), of)


def _families(planned: Sequence[Planned], along: Mapping[str, Sequence[str]]) -> Iterator[tuple[list[str], list[str]]]:
    """Yield runs that differ along some axes alone: by name those on the path to the finest, that first; and all."""
    families: dict[tuple[object, ...], dict[tuple[int, ...], str]] = {}
    for run in planned:
        others = tuple(item for item in run.axes.items() if item[0] not in along)
        place = tuple(len(points) - 1 - points.index(run.axes[axis]) for axis, points in along.items())
        families.setdefault((others, run.repeat), {})[place] = run.name
    for family in families.values():
        steps = range(min(len(points) for points in along.values()))
        yield [family.get((n,) * len(along), "") for n in steps], list(family.values())


def _order(run: Planned) -> float:
    """Return the order of a run's scheme; KeyError if there is no such."""
    name = tomllib.loads(f"name = {run.says['time.integrator']}")["name"]
    return float(find(INTEGRATORS[name]).order)


def _of_family(
    path: list[str], names: list[str], series: Mapping[str, Series], rule: ErrorRule, order: float
) -> dict[str, Judged]:
    """Return what came of runs that have a reference of their own among them."""
    finest = path[0] if path else ""
    if finest not in series:
        return dict.fromkeys(names, Judged(note=f"{UNKNOWN}: the finest run has no result"))
    if rule.reference == FINEST:
        others = {name: _compared(series[name], series[finest], None, rule) for name in names if name != finest}
        return others | {finest: Judged(note=REFERENCE)}
    last = [name for name in path[:_FINEST] if name in series]
    if len(last) < 2 or last != path[: len(last)]:
        return dict.fromkeys(names, Judged(note=f"{UNKNOWN}: of the finest runs some have no result"))
    assert rule.factor is not None
    try:
        limit = extrapolate([series[name] for name in reversed(last)], rule.factor, order, rule.norm, rule.window)
    except InputError as error:
        return dict.fromkeys(names, Judged(note=f"{UNKNOWN}: {error}"))
    return {name: _compared(series[name], limit.limit, limit, rule) for name in names}


def _compared(run: Series, reference: Series, limit: Extrapolated | None, rule: ErrorRule) -> Judged:
    try:
        error = error_of(run, reference, rule.norm, rule.window)
    except InputError as told:
        return Judged(note=f"{UNKNOWN}: {told}")
    bar = None if limit is None else limit.bar
    notes = [] if limit is None or not limit.why else [f"its reference: {limit.why}"]
    if rule.bound is not None and error > rule.bound:
        return Judged(error, bar, "; ".join([f"{FAR_OFF}: beyond {rule.bound:g}", *notes]))
    if bar is not None and error < bar:
        return Judged(None, bar, "; ".join([f"{UNKNOWN}: below the bar of the reference", *notes]))
    if bar is not None and error < SURE * bar:
        notes.insert(0, UNSURE)
    return Judged(error, bar, "; ".join(notes))
