"""The folder of a sweep: its file, its plan, what its runs need, and their run directories. It can be moved."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import petfsi
from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.output import files
from petfsi.output.mesh_files import copy_mesh, mesh_files
from petfsi.scene.load import load_scene
from petfsi.sweeps.attempts import NAME as ATTEMPTS
from petfsi.sweeps.claim import NAME as CLAIM
from petfsi.sweeps.error_rule import ErrorRule
from petfsi.sweeps.names import digest_of
from petfsi.sweeps.plan import INPUTS, Plan, Planned, mesh_folders

#: Marks a folder as a sweep's.
MARKER, FORMAT = ".petfsi-sweep", 1
#: Locked while the sweep's own files are written.
WRITING = ".writing"
#: In a run's directory: which run of a sweep it is, and what it printed.
RUN, OUTPUT = "run.json", "output.txt"
RUNS, REPLACED = "runs", "replaced"
#: Bytes of the largest ``run.json``.
_MOST = 16_000_000
#: Runs, and keys of each, that a message names.
_TOLD, _KEYS = 8, 6
_MESH = re.compile(r'"(meshes/[^"]+)"')
#: At the end of the name of an input, what its content is.
_DIGEST = re.compile(r"-([0-9a-f]{12})\.(?:toml|opts)$")


@dataclass(frozen=True)
class SweepFolder:
    """The paths of a sweep."""

    path: Path

    @property
    def plan(self) -> Path:
        """A row for every run that the sweep's file asks for."""
        return self.path / "plan.csv"

    @property
    def table(self) -> Path:
        """A row for every run, with what came out."""
        return self.path / "runs.csv"

    @property
    def rule(self) -> Path:
        """How its runs are judged; none where they are not."""
        return self.path / "error.json"

    @property
    def inputs(self) -> Path:
        """Scenes, options files and meshes."""
        return self.path / INPUTS

    def run(self, name: str) -> Path:
        """Return the directory of a run."""
        return self.path / RUNS / name

    @classmethod
    def open(cls, path: Path) -> SweepFolder:
        """Return an existing sweep; InputError if it is none."""
        folder = cls(Path(path))
        if not folder.is_sweep():
            raise InputError(f"{shown(path, 200)} is not the folder of a sweep: it has no {MARKER}")
        try:
            number = json.loads(files.read_plain(folder.path / MARKER, _MOST)).get("format")
        except (OSError, ValueError, AttributeError):
            raise InputError(f"{folder.path / MARKER} cannot be read") from None
        if number != FORMAT:
            raise InputError(f"{shown(path, 200)} is a sweep of format {shown(number)}; this petfsi reads {FORMAT}")
        return folder

    def is_sweep(self) -> bool:
        """Return whether there is one."""
        return (self.path / MARKER).is_file()

    def check_place(self) -> None:
        """Raise InputError unless a sweep is here, or can be; writes nothing."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"sweep folder {self.path}: there is a file of that name")
        there = [path.name for path in self.path.iterdir()] if self.path.is_dir() else []
        # another call may be making one: its marker comes before all else
        if any(name != WRITING and not name.startswith(MARKER) for name in there) and not self.is_sweep():
            raise InputError(f"sweep folder {self.path} is not empty and holds no sweep; name another with --out")

    # ---- what is to be ------------------------------------------------------------------------------------------

    def planned(self) -> list[Planned]:
        """Return the runs of the plan, in its order.

        Raises
        ------
        InputError
            If it was not written whole, a run's ``run.json`` has gone, or a run is not the one of the plan.
        """
        if not self.plan.is_file():
            raise InputError(f"{self.path} was not made whole; once more: petfsi sweep SWEEP.toml --out {self.path}")
        again = f"petfsi sweep SWEEP.toml --out {self.path}"
        try:
            with open(files.open_plain(self.plan), encoding="utf-8", newline="") as file:
                hashes = {row["name"]: row["hash"] for row in csv.DictReader(file)}
        except (OSError, ValueError, KeyError, csv.Error):
            raise InputError(f"{self.plan} cannot be read; it is written anew by: {again}") from None
        found = []
        for name, wanted in hashes.items():
            run = self.read_run(name)
            if run is None:
                raise InputError(f"{self.run(name) / RUN} cannot be read; it is written anew by: {again}")
            if run.hash != wanted:
                raise InputError(
                    f"{self.run(name)} has other settings than {self.plan} says: a call that was to replace runs was "
                    f"cut short, or is at work; once it has gone: {again} --retry changed"
                )
            found.append(run)
        return found

    def read_rule(self) -> ErrorRule | None:
        """Return how runs are judged; InputError if that cannot be read."""
        try:
            return ErrorRule.read(files.read_small(self.rule, _MOST))
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            again = f"petfsi sweep SWEEP.toml --out {self.path}"
            raise InputError(f"{self.rule} cannot be read; it is written anew by: {again}") from None

    def read_run(self, name: str) -> Planned | None:
        """Return what a run's directory says that it is; None if it does not, or its hash is another's."""
        try:
            data = json.loads(files.read_small(self.run(name) / RUN, _MOST))
            told, whole = data.pop("hash"), data.pop("whole", None)
            run = Planned.of(data)
            right = (run.hash, run.name) == (told, name) and whole in (None, run.whole)  # older ones have none
            return run if right else None
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None

    def changed(self, plan: Plan) -> dict[str, list[str]]:
        """Return by name the runs that are here with other settings, and in words what differs."""
        found = {}
        for run in plan.runs:
            old = self.read_run(run.name)
            if old is not None and old.hash != run.hash:
                keys = dict.fromkeys([*old.says, *run.says])
                found[run.name] = [
                    f"{key} was {shown(old.says.get(key, 'none'))}, is {shown(run.says.get(key, 'none'))}"
                    for key in keys
                    if old.says.get(key) != run.says.get(key)
                ]
        return found

    def left_over(self, runs: Sequence[Planned]) -> list[str]:
        """Return the names of runs that are here, and are not in the plan any more."""
        known = {run.name for run in runs}
        there = [path.name for path in (self.path / RUNS).glob("*") if path.is_dir()]
        return sorted(name for name in there if name not in known)

    def check_ours(self, runs: Sequence[Planned]) -> None:
        """Raise InputError, by name, of links where a sweep writes: what they name is elsewhere."""
        meshes = [f"{INPUTS}/meshes", *(f"{INPUTS}/meshes/{path.name}" for path in self.inputs.glob("meshes/*"))]
        folders = [INPUTS, *meshes, RUNS, REPLACED, *(f"{RUNS}/{run.name}" for run in runs)]
        own = [WRITING, *(f"{RUNS}/{run.name}/{name}" for run in runs for name in (RUN, OUTPUT, ATTEMPTS, CLAIM))]
        for names, is_ours, what in ((folders, stat.S_ISDIR, "folder"), (own, stat.S_ISREG, "plain file")):
            for name in names:
                try:
                    mode = os.lstat(self.path / name).st_mode
                except (FileNotFoundError, NotADirectoryError):
                    continue
                except OSError as error:
                    raise InputError(f"{self.path / name}: {files.reason(error)}") from error
                if not is_ours(mode):
                    kind = "a link" if stat.S_ISLNK(mode) else f"no {what}"
                    raise InputError(f"{self.path / name} is {kind}; a sweep writes there: put a {what} in its place")

    def check_inputs(self, runs: Sequence[Planned]) -> None:
        """Raise InputError, by name, of a scene, an options file or a mesh that is not what its name says."""
        names = [name for run in runs for name in (Path(run.scene).name, *run.options)]
        for name in dict.fromkeys(names):
            digest = _DIGEST.search(name)
            if digest is None:
                continue
            try:
                fits = digest_of(files.read_small(self.inputs / name, _MOST)) == digest[1]
                why = "" if fits else "has been changed since it was planned; put it back"
            except OSError as error:
                why = f"cannot be read: {files.reason(error)}"
            if why:
                raise self._unfit(self.inputs / name, why)
        self._check_meshes(runs)

    def _check_meshes(self, runs: Sequence[Planned]) -> None:
        """Raise InputError of a mesh that has changed; one that several scenes have is looked at once."""
        seen: set[str] = set()
        for run in runs:
            named = {mesh for value in run.settings().values() for mesh in _MESH.findall(value)}
            if named <= seen:
                continue
            seen |= named
            for folder, together in mesh_folders(mesh_files(load_scene(self.path / run.scene))):
                place = together[0].source.parent
                if place.name != Path(folder).name:
                    raise self._unfit(place, "holds another mesh than when it was planned; put it back")

    def _unfit(self, path: Path, why: str) -> InputError:
        return InputError(
            f"{path} {why}, or remove it, and it is written anew by: petfsi sweep SWEEP.toml --out {self.path}"
        )

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other calls from writing what is the sweep's own while this one does."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            file = open(files.open_plain(self.path / WRITING, os.O_RDWR | os.O_CREAT), "wb")  # noqa: SIM115 - closed below
        except OSError as error:
            place = Path(error.filename or self.path).name
            where = f": {place}" * (place != self.path.name)
            raise InputError(f"sweep folder {self.path} cannot be written{where}: {files.reason(error)}") from error
        with file:
            with suppress(OSError):  # where the file system knows no locks there is one call at a time, it is hoped
                fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def make(self, plan: Plan) -> None:
        """Write all that runs start from; what is here stays. The plan is last: what was cut short has none."""
        with self.alone():
            self._make(plan)

    def _make(self, plan: Plan) -> None:
        unknown = [run for run in plan.runs if self.read_run(run.name) is None]
        for run in unknown:
            if (self.run(run.name) / files.RUN_MARKER).exists():  # of other settings, it may be
                raise InputError(
                    f"{self.run(run.name) / RUN} cannot be read, and there are results beside it, whose settings it "
                    f"told; put it back, or move {self.run(run.name)} away"
                )
        marker = {"petfsi": petfsi.__version__, "format": FORMAT}
        if not self.is_sweep():
            files.replace_text(self.path / MARKER, json.dumps(marker) + "\n")
        self.inputs.mkdir(exist_ok=True)
        for name, mesh in plan.meshes.items():
            if not (self.inputs / name).exists():
                copy_mesh(mesh, self.inputs / name)
        for name, data in plan.files.items():
            if not (self.inputs / name).exists():
                _replace(self.inputs / name, data)
        for run in unknown:
            self.prepare(run)
        files.replace_text(self.path / "sweep.toml", plan.text)
        if plan.rule is not None:
            files.replace_text(self.rule, plan.rule.text())
        else:
            self.rule.unlink(missing_ok=True)
        files.replace_text(self.plan, _plan_text(plan))

    def prepare(self, run: Planned) -> None:
        """Write a run's directory, empty but for what it is."""
        self.run(run.name).mkdir(parents=True, exist_ok=True)
        about = {**asdict(run), "hash": run.hash, "whole": run.whole}
        _replace(self.run(run.name) / RUN, (json.dumps(about, indent=1) + "\n").encode())

    def set_aside(self, run: Planned) -> Path:
        """Move a run's directory to where replaced ones are, and make a new one; return where it is now."""
        numbers = (self.path / REPLACED / f"{run.name}.{n}" for n in range(1, 1 << 20))
        aside = next(path for path in numbers if not os.path.lexists(path))
        aside.parent.mkdir(exist_ok=True)
        os.rename(self.run(run.name), aside)
        self.prepare(run)
        return aside


def axes_of(runs: Sequence[Planned]) -> dict[str, list[str]]:
    """Return by axis the points that runs have."""
    found: dict[str, list[str]] = {}
    for run in runs:
        for axis, point in run.axes.items():
            points = found.setdefault(axis, [])
            if point not in points:
                points.append(point)
    return found


def describe_changed(changed: dict[str, list[str]]) -> Iterator[str]:
    """Return lines about runs that are not what they were."""
    for name, keys in list(changed.items())[:_TOLD]:
        more = f"; and {len(keys) - _KEYS} more" if len(keys) > _KEYS else ""
        yield f"{name}: {'; '.join(keys[:_KEYS])}{more}"
    if len(changed) > _TOLD:
        yield f"and {len(changed) - _TOLD} more runs"


def _plan_text(plan: Plan) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    # an axis may have the name of another column
    writer.writerow(["name", *(f"axis.{axis}" for axis in plan.axes), "ranks", "repeat", "hash"])
    for run in plan.runs:
        writer.writerow([run.name, *run.axes.values(), run.ranks, run.repeat, run.hash])
    return out.getvalue()


def _replace(path: Path, data: bytes) -> None:
    """Give a file its content in one piece; of thousands none is waited for until it is on the disk."""
    part = files.part_of(path)
    try:
        with open(files.new_file(part), "wb") as file:
            file.write(data)
        os.replace(part, path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise
