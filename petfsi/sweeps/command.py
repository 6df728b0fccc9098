"""What ``petfsi sweep`` does: from a sweep's file or folder to runs with a result."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.output import files
from petfsi.sweeps import attempts
from petfsi.sweeps.claim import claim, give_back, is_busy
from petfsi.sweeps.folder import RUNS, SweepFolder, describe_changed
from petfsi.sweeps.plan import Plan, Planned, plan_sweep
from petfsi.sweeps.pool import Pool
from petfsi.sweeps.selection import select
from petfsi.sweeps.states import LEFT_ALONE, RESULTS, STATES, Look, look_at
from petfsi.sweeps.table import collect

DONE, LEFT, INTERRUPTED = 0, 1, 75
#: Runs that are named in what is said at the end.
_TOLD = 10


@dataclass(frozen=True)
class Wanted:
    """What a call of ``petfsi sweep`` is to do.

    Attributes
    ----------
    target : Path
        A sweep's file, or its folder.
    out : Path or None
        Of a file the folder; ``runs/<its name>`` by default.
    jobs : int or None
        Ranks at a time; by default as many as there are cores for this process.
    only : str
        ``axis=point,...``, or names of runs; empty for all.
    retry : str or None
        ``failed``, ``lost``, ``refused`` or ``changed``.
    anew : bool
        Runs that ``retry`` names begin from their start, whatever there is to go on from.
    dry_run, status, collect : bool
        To do nothing but say what would be done, what is, or write the table.
    """

    target: Path
    out: Path | None = None
    jobs: int | None = None
    only: str = ""
    retry: str | None = None
    anew: bool = False
    dry_run: bool = False
    status: bool = False
    collect: bool = False


def sweep(wanted: Wanted, say: Callable[[str], None]) -> int:
    """Do it; return the exit status: 0 every run has a result, 1 some are lost or refused, 75 some are still to run.

    Raises
    ------
    InputError
        With every mistake in the file, or what of the folder does not fit it; nothing has been written then.
    """
    _check_words(wanted)
    folder, plan = _open(wanted)
    runs = folder.planned() if plan is None else plan.runs
    chosen = _chosen(wanted, runs)
    cores = wanted.jobs or len(os.sched_getaffinity(0))
    if wanted.dry_run:
        _say_plan(folder, chosen, _renewed(folder, plan, chosen, wanted.retry), say)
        return DONE
    if wanted.status:
        return _say_states(folder, runs, chosen, cores, say, whole=True)
    if not wanted.collect:
        _check_launcher(chosen)
        folder.check_ours(runs)
    if plan is not None:
        _make(folder, plan, wanted, say)
    if wanted.collect:
        rows = collect(folder, runs)
        say(f"{folder.table}: {len(rows)} runs")
        _say_errors(folder, rows, say)
        _say_left_over(folder, runs, say)
        return DONE
    folder.check_inputs(chosen)
    folder.read_rule()
    if wanted.retry:
        if wanted.retry == "changed" and plan is None and not _renewed(folder, plan, chosen, wanted.retry):
            raise InputError("no run here is other than planned; what the sweep's file changes needs that file")
        _retry(folder, chosen, wanted.retry, wanted.anew, say)
    return _work(folder, runs, chosen, cores, say)


def _work(
    folder: SweepFolder, runs: Sequence[Planned], chosen: Sequence[Planned], cores: int, say: Callable[[str], None]
) -> int:
    """Run what has no result, say how it ended and write the table; return the exit status."""
    if os.environ.get("PETSC_OPTIONS"):
        say("PETSC_OPTIONS is set, and not read: what a run hangs on stands in the sweep's file")
    why = Pool(folder, chosen, cores, say).work()
    _say_states(folder, runs, chosen, cores, say)
    try:
        rows = collect(folder, runs)
        _say_errors(folder, rows, say)
        say(f"{folder.table}: a row for each; again with: petfsi sweep {folder.path} --collect")
    except OSError as error:
        say(f"{folder.table} could not be written: {files.reason(error)}")
    if why:
        say(f"stopped by {why}; go on with: petfsi sweep {folder.path}")
        return INTERRUPTED
    return _code(folder, chosen)


def _check_words(wanted: Wanted) -> None:
    """Raise InputError of words that would be without effect beside each other."""
    if wanted.anew and wanted.retry not in ("lost", "refused"):
        raise InputError("--anew goes with --retry lost or --retry refused; what failed or changed begins anew anyway")
    only = [name for name in ("dry_run", "status", "collect") if getattr(wanted, name)]
    unheard = {"status": ["retry"], "collect": ["retry", "only", "jobs"]}
    for name in only[:1]:
        for other in only[1:] or [word for word in unheard.get(name, []) if getattr(wanted, word)]:
            raise InputError(f"--{name.replace('_', '-')} and --{other} do not go together; give one of them")


def _open(wanted: Wanted) -> tuple[SweepFolder, Plan | None]:
    """Return the folder, and of a file its plan; nothing is written."""
    if wanted.target.is_dir():
        if wanted.out is not None:
            raise InputError("--out is for a sweep's file: a folder stays where it is, and can be moved as a whole")
        return SweepFolder.open(wanted.target), None
    plan = plan_sweep(wanted.target)
    folder = SweepFolder(wanted.out or Path("runs") / wanted.target.stem)
    folder.check_place()
    if folder.is_sweep():
        SweepFolder.open(folder.path)
    elif wanted.status or wanted.collect or wanted.retry:
        raise InputError(f"{shown(folder.path, 200)}: there is no sweep yet")
    changed = folder.changed(plan)
    if changed and wanted.retry != "changed":
        raise InputError(
            "\n".join(
                [
                    f"{folder.path}: {len(changed)} run{'s' * (len(changed) > 1)} of the same name had other settings",
                    *(f"  {line}" for line in describe_changed(changed)),
                    "  give the sweep another folder with --out, or replace these runs with --retry changed",
                ]
            )
        )
    return folder, plan


def _make(folder: SweepFolder, plan: Plan, wanted: Wanted, say: Callable[[str], None]) -> None:
    """Write what runs start from, and put aside those that are to be replaced."""
    changed = folder.changed(plan) if wanted.retry == "changed" else {}
    chosen = {run.name for run in _chosen(wanted, plan.runs)}
    if kept := [name for name in changed if name not in chosen]:
        raise InputError(f"{kept[0]} has changed, too: --retry changed takes no --only that leaves such runs out")
    # before anything is written; one that another call begins from here on is told by the plan, which differs from it
    for name in changed:
        if is_busy(folder.run(name)):
            raise InputError(_at_work(folder, name))
    folder.make(plan)
    for run in plan.runs:
        if run.name in changed:
            _set_aside(folder, run, say)


def _set_aside(folder: SweepFolder, run: Planned, say: Callable[[str], None]) -> None:
    handle = claim(folder.run(run.name))
    if handle is None:
        raise InputError(_at_work(folder, run.name))
    try:
        say(f"{run.name} begins anew; what was there is in {folder.set_aside(run)}")
    finally:
        give_back(handle)


def _at_work(folder: SweepFolder, name: str) -> str:
    return f"{folder.run(name)}: a process is at work in it; wait for it, or stop it"


def _retry(folder: SweepFolder, chosen: Sequence[Planned], state: str, anew: bool, say: Callable[[str], None]) -> None:
    """Let runs of a state be tried again: failed and changed ones from their start, others go on, unless anew."""
    for run in chosen:
        path = folder.run(run.name)
        if look_at(path, run).state != state:
            continue
        if state in ("failed", "changed") or anew:
            _set_aside(folder, run, say)
        else:
            attempts.again(path, state)


def _renewed(folder: SweepFolder, plan: Plan | None, chosen: Sequence[Planned], retry: str | None) -> set[str]:
    """Return the names of runs that ``--retry`` lets begin again."""
    others = set(folder.changed(plan)) if retry == "changed" and plan is not None else set()
    return others | {run.name for run in chosen if retry and look_at(folder.run(run.name), run).state == retry}


def _chosen(wanted: Wanted, runs: Sequence[Planned]) -> list[Planned]:
    """Return the runs that ``--only`` names."""
    return select(wanted.only, runs) if wanted.only else list(runs)


def _check_launcher(runs: Sequence[Planned]) -> None:
    several = [run.name for run in runs if run.ranks > 1]
    if several and shutil.which("mpirun") is None:
        raise InputError(f"{several[0]} has several ranks, and there is no mpirun on this machine")


def _code(folder: SweepFolder, chosen: Sequence[Planned]) -> int:
    states = {look_at(folder.run(run.name), run).state for run in chosen}
    if states & set(LEFT_ALONE):
        return LEFT
    return DONE if states <= set(RESULTS) else INTERRUPTED


# ---- what is said -------------------------------------------------------------------------------------------


def _say_plan(folder: SweepFolder, chosen: Sequence[Planned], renewed: set[str], say: Callable[[str], None]) -> None:
    """Say what would be run, without making anything."""
    states: Counter[str] = Counter()
    for run in chosen:
        state = look_at(folder.run(run.name), run).state if folder.run(run.name).is_dir() else "new"
        states[state] += 1
        anew = ", to be run again" * (run.name in renewed)
        say(f"{run.name}  {state}{anew}, {run.ranks} rank{'s' * (run.ranks > 1)}")
    say(f"{len(chosen)} runs in {folder.path}: {_counts(states)}; nothing was written")


def _say_left_over(folder: SweepFolder, runs: Sequence[Planned], say: Callable[[str], None]) -> None:
    """Name the directories of runs that no table tells of."""
    if left := folder.left_over(runs):
        names = ", ".join(shown(name) for name in left[:_TOLD]) + " ..." * (len(left) > _TOLD)
        say(f"{len(left)} in {folder.path / RUNS} not in the plan, in no table, and left as they are: {names}")


def _say_states(
    folder: SweepFolder,
    runs: Sequence[Planned],
    chosen: Sequence[Planned],
    cores: int,
    say: Callable[[str], None],
    whole: bool = False,
) -> int:
    """Say how many runs are in which state, and of those that are not done why; return 0."""
    looks = {run.name: look_at(folder.run(run.name), run) for run in chosen}
    for state in STATES[1:]:
        named = [(name, look) for name, look in looks.items() if look.state == state]
        most = len(named) if whole else _TOLD
        for name, look in named[:most]:
            reason = f": {shown(look.reason, 300)}" if look.reason else ""
            steps = f", step {look.step}" if look.step >= 0 else ""
            if whole or state not in ("new", "running"):
                say(f"{name}: {state}{steps}{reason}")
        if len(named) > most and state not in ("new", "running"):
            say(f"and {len(named) - most} more {state}")
    counts = Counter(look.state for look in looks.values())
    ranks = {run.name: run.ranks for run in chosen}
    rest = "" if len(chosen) == len(runs) else f" of {len(runs)}"
    _say_left_over(folder, runs, say)
    say(f"{len(chosen)}{rest} runs: {_counts(counts)}{_time_left(looks, ranks, cores)}")
    return DONE


def _say_errors(folder: SweepFolder, rows: Sequence[dict[str, Any]], say: Callable[[str], None]) -> None:
    """Say how many runs have an error, between what, and why the others of those that are done have none."""
    rule = folder.read_rule()
    if rule is None:
        return
    known = [row["error"] for row in rows if row["error"] is not None]
    spread = f", {min(known):.2g} to {max(known):.2g}" if known else ""
    of, against = ", ".join(rule.of), rule.source or f"{rule.reference} along {', '.join(rule.along)}"
    say(f"error of {of} ({rule.norm}) against {against}: {len(known)} of {len(rows)} runs{spread}")
    notes = Counter(row["error_note"] for row in rows if row["error_note"])
    for note, count in notes.most_common(_TOLD):
        say(f"  {count}: {note}")


def _counts(states: Counter[str]) -> str:
    return ", ".join(f"{states[state]} {state}" for state in STATES if states[state]) or "none"


def _time_left(looks: dict[str, Look], ranks: dict[str, int], cores: int) -> str:
    """Return how long what is left may take on so many cores, if it is like what has ended."""
    taken = [_seconds(look) for look in looks.values() if look.state == "done"]
    known = [seconds for seconds in taken if seconds is not None]
    unfinished = [name for name, look in looks.items() if look.state not in (*RESULTS, *LEFT_ALONE)]
    left = sum(min(ranks[name], cores) for name in unfinished)  # one of more ranks than cores has all of these
    if not known or not left:
        return ""
    each = sum(known) / len(known)
    spread = f"{min(known):.3g} to {max(known):.3g} s a run"
    return f"; about {each * max(1, left / cores):.3g} s left here ({spread})"


def _seconds(look: Look) -> float | None:
    """Return how long a run has taken: of its processes from their starts to their ends, where all of that is known."""
    taken = [attempt.seconds for attempt in look.attempts]
    if taken and None not in taken:
        return sum(one for one in taken if one is not None)
    wall = look.summary.get("wall_s")
    return None if wall is None else float(wall)
