"""From a sweep's file to its runs: every combination is built as a scene, and its options are read, before any starts.

Knows no PETSc and no MPI, and writes nothing.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.output.mesh_files import MeshFile, mesh_files
from petfsi.scene.dump import as_toml, dump_scene
from petfsi.scene.load import apply_set, scene_from_dict
from petfsi.scene.raw import read_raw
from petfsi.solving import options
from petfsi.solving.option_rules import PREFIX
from petfsi.sweeps.error_rule import ErrorRule
from petfsi.sweeps.file import MOST_RUNS, Point, SweepFile, read_sweep_file
from petfsi.sweeps.names import DIGITS, digest_of, run_name

#: Where scenes, options files and meshes of the runs are, in a sweep's folder.
INPUTS = "inputs"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_OPTION = re.compile(r"(^|: )-")
_SCENE = re.compile(rf"{INPUTS}/scene-[0-9a-f]{{{DIGITS}}}\.toml")
#: Runs that are the same as others, of those that are told.
_TOLD = 8


@dataclass(frozen=True)
class Planned:
    """A run that is to be.

    Attributes
    ----------
    name : str
    axes : dict of str to str
        By axis its point.
    ranks, repeat : int
    steps : int or None
        How many, where not all to the scene's end.
    scene : str
        File of the resolved scene, relative to the sweep's folder.
    options : list of str
        Words of PETSc's options, as for ``petfsi run``; files are relative to ``INPUTS``.
    says : dict of str to str
        All that the run hangs on, by key, as TOML: the settings of the scene, options, ranks, repeat, steps.
    """

    name: str
    axes: dict[str, str]
    ranks: int
    repeat: int
    steps: int | None
    scene: str
    options: list[str]
    says: dict[str, str]

    @classmethod
    def of(cls, data: dict[str, Any]) -> Planned:
        """Return a run from what ``run.json`` says; whatever stands there starts nothing but a run of petfsi.

        Raises
        ------
        TypeError, ValueError
            If anything has another form than ``plan_sweep`` gives it.
        """
        run = cls(**data)
        texts = [*run.axes, *run.axes.values(), *run.says, *run.says.values(), *run.options, run.name, run.scene]
        counts = [run.ranks, run.repeat, 1 if run.steps is None else run.steps]
        words = {word.lower() for word in run.options}
        files = [after for word, after in pairwise(run.options) if word.lower() == f"-{options.FILE}"]
        if (
            not all(isinstance(text, str) for text in texts)
            or not all(type(count) is int and count > 0 for count in counts)
            or not _SCENE.fullmatch(run.scene)
            or not _NAME.fullmatch(run.name)
            or any(word.startswith("--") for word in words)  # petfsi's own, such as --out
            or any("/" in name for name in files)
        ):
            raise ValueError("no run of a sweep")
        return run

    @property
    def whole(self) -> str:
        """What tells whether any of it is another: also axes, scene and options, which ``says`` does not hold."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()

    def settings(self) -> dict[str, str]:
        """Return the settings of its scene, of all that it says."""
        others = ("ranks", "repeat", "steps")
        return {key: value for key, value in self.says.items() if key not in others and not _OPTION.search(key)}

    @property
    def hash(self) -> str:
        """What tells whether a run of the same name is the same: neither machine nor time nor folder enter."""
        return hashlib.sha256(json.dumps(self.says, sort_keys=True).encode()).hexdigest()


@dataclass
class Plan:
    """The runs of a sweep, and the files that they need.

    Attributes
    ----------
    text : bytes
        The sweep's file, as given.
    axes : dict of str to list of str
        By axis its points.
    runs : list of Planned
        In the file's order, rounds of ``repeat`` outermost.
    files : dict of str to bytes
        By name in ``INPUTS``: scenes and options files.
    meshes : dict of str to MeshFile
        By name in ``INPUTS``: mesh files, where they are now and what they were when the scene was read.
    rule : ErrorRule or None
        How its runs are judged.
    """

    text: bytes
    axes: dict[str, list[str]]
    runs: list[Planned] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    meshes: dict[str, MeshFile] = field(default_factory=dict)
    rule: ErrorRule | None = None


def plan_sweep(path: Path) -> Plan:
    """Return the runs of a sweep's file.

    Raises
    ------
    InputError
        With every mistake in the file, the scenes and the options.
    """
    mistakes: list[str] = []
    file = read_sweep_file(path, mistakes)
    planner = _Planner(file, mistakes)
    if file.scene is not None:
        planner.build(file.scene)
    if mistakes:
        told = list(dict.fromkeys(mistakes))
        count = "one mistake" if len(told) == 1 else f"{len(told)} mistakes"
        raise InputError("\n".join([f"{shown(path, 200)}: {count}", *(f"  {line}" for line in told)]))
    return planner.plan


class _Planner:
    """Builds the runs of a file; combinations of the same settings share a scene, those of the same words a file."""

    def __init__(self, file: SweepFile, mistakes: list[str]) -> None:
        self.file, self.mistakes = file, mistakes
        axes = {name: [point.text for point in points] for name, points in file.axes.items()}
        self.plan = Plan(file.text, axes, rule=file.rule)
        if file.rule is not None and file.table:
            self.plan.files[file.rule.reference] = file.table
        self._base: dict[str, Any] = {}
        self._directory = file.path.parent
        self._scenes: dict[str, tuple[str, dict[str, str]] | None] = {}
        self._options: dict[str, tuple[list[str], dict[str, str]] | None] = {}
        self._meant: dict[str, _Meant] = {}  # by an own file of options
        self._names: dict[tuple[str, tuple[_Meant, str], int, int], str] = {}
        self._twins: list[str] = []

    def build(self, scene: Path) -> None:
        """Fill the plan with runs of a scene's file."""
        file = self.file
        count = math.prod(len(points) for points in file.axes.values()) * file.repeat
        if count > MOST_RUNS:
            self.mistakes.append(f"axis: {count:,} combinations; a sweep has at most {MOST_RUNS:,} runs")
            return
        try:
            self._base, self._directory = read_raw(scene), scene.parent
        except InputError as error:
            self.mistakes.append(f"scene: {error}")
            return
        for repeat in range(1, file.repeat + 1):
            for points in _combinations(file):
                self._add(points, repeat)
        if len(self._twins) > _TOLD:
            self._twins[_TOLD:] = [f"and {len(self._twins) - _TOLD} more runs are the same as others"]
        if not self.mistakes:  # else one of them may be why runs are the same
            self.mistakes += self._twins
        if not self.plan.runs and not self.mistakes:
            self.mistakes.append("exclude: leaves no run")

    def _add(self, points: dict[str, Point], repeat: int) -> None:
        texts = {axis: point.text for axis, point in points.items()}
        name = run_name(list(texts.items()), repeat)
        scene, chosen = self._scene(points, name), self._chosen(points, name)
        if scene is None or chosen is None:
            return
        ranks = next((point.ranks for point in points.values() if point.ranks), 1)
        steps = self.file.steps
        says = {**scene[1], **chosen[1], "ranks": str(ranks), "repeat": str(repeat), "steps": str(steps or "all")}
        first = self._names.setdefault((scene[0], self._sense(chosen[0]), ranks, repeat), name)
        if first != name:
            self._twins.append(
                f"run {name}: is the same as {first}: nothing differs, or one axis undoes what another sets"
            )
        self.plan.runs.append(Planned(name, texts, ranks, repeat, steps, scene[0], chosen[0], says))

    def _scene(self, points: Mapping[str, Point], name: str) -> tuple[str, dict[str, str]] | None:
        """Return the file and the settings of a combination's scene; None if it is wrong, which is told once."""
        sets = dict(self.file.sets)
        for point in points.values():
            sets.update(point.sets)
        key = json.dumps(sets, sort_keys=True)
        if key not in self._scenes:
            try:
                self._scenes[key] = self._resolved(sets)
            except InputError as error:
                self._scenes[key] = None
                self._tell(str(error), points, name)
        return self._scenes[key]

    def _resolved(self, sets: Mapping[str, str]) -> tuple[str, dict[str, str]]:
        data = copy.deepcopy(self._base)
        for key, value in sets.items():
            apply_set(data, f"{key}={value}")
        scene = scene_from_dict(data, self._directory)
        names = self._copied(mesh_files(scene))
        text = dump_scene(scene, names)
        name = scene_name(text.encode())
        self.plan.files[name] = text.encode()
        return f"{INPUTS}/{name}", settings_of(text)

    def _copied(self, meshes: list[MeshFile]) -> dict[str, str]:
        """Return new names of mesh files by their paths; files that belong together stay in a folder of their own."""
        names = {}
        for folder, together in mesh_folders(meshes):
            for mesh in together:
                names[os.path.abspath(mesh.source)] = f"{folder}/{mesh.source.name}"
                self.plan.meshes[f"{folder}/{mesh.source.name}"] = mesh
        return names

    def _chosen(self, points: Mapping[str, Point], name: str) -> tuple[list[str], dict[str, str]] | None:
        """Return the words of a combination's options, and by ``-name`` what they are; None if they are wrong."""
        file = next((point.options_file for point in points.values() if point.options_file), "")
        given = {option: value for point in points.values() for option, value in point.options.items()}
        key = json.dumps([file, sorted(given.items())])
        if key not in self._options:
            try:
                self._options[key] = self._read_options(file, given)
            except InputError as error:
                self._options[key] = None
                self._tell(str(error), points, name)
        return self._options[key]

    def _read_options(self, file: str, given: Mapping[str, str]) -> tuple[list[str], dict[str, str]]:
        """Return the words of options, and by ``-name`` what they are; InputError if they are wrong."""
        says = {f"-{option}": value for option, value in given.items()}
        over = [word for option, value in given.items() for word in (f"-{option}", value) if word]
        if not file:
            _check_options(over)
            return over, says
        path = self._options_path(file)
        _check_options([f"-{options.FILE}", str(path), *over])
        name = says[f"-{options.FILE}"] = os.path.basename(file)  # where it is does not change a run
        if path.resolve().parent == options.options_directory().resolve():
            return [f"-{options.FILE}", path.resolve().name, *over], says
        read = options.from_file(str(path))
        says |= {f"{name}: -{option.name}": option.value for option in read}
        return [f"-{options.FILE}", self._own_file(file, read), *over], says

    def _sense(self, words: list[str]) -> tuple[_Meant, str]:
        """Return what words of options mean, whatever their order, and how their numbers and their file are spelt."""
        file = words[1] if words[:1] == [f"-{options.FILE}"] else ""
        over = _meant(options.from_words(words[2:] if file else words))
        own = self._meant.get(file, frozenset())
        given = {name for name, _ in over}
        return over | {(name, value) for name, value in own if name not in given}, "" if own else file

    def _options_path(self, file: str) -> Path:
        """Return where an options file is: beside the sweep's file, or, as a bare name that is not there, shipped."""
        beside = self.file.path.parent / file
        shipped = [path for path in options.shipped_options() if path.name == file]
        return shipped[0] if shipped and not beside.exists() else beside

    def _own_file(self, file: str, read: list[options.Option]) -> str:
        """Return the name of a copy of an options file that needs none beside it but petfsi's own."""
        lines: list[str] = []
        for option in read:
            value = f'"{option.value}"' if " " in option.value else option.value
            line = f"-{options.FILE} {option.origin}" if option.shipped else f"-{option.name} {value}".rstrip()
            if not (option.shipped and lines and lines[-1] == line):
                lines.append(line)
        text = "\n".join(lines) + "\n"
        stem = Path(file).stem
        name = f"{stem}-{digest_of(text.encode())}.opts"
        self.plan.files[name] = text.encode()
        self._meant[name] = _meant(read)
        return name

    def _tell(self, text: str, points: Mapping[str, Point], name: str) -> None:
        """Add what is wrong with a combination; what is wrong with all of them is told once."""
        first, *rest = text.split("\n")
        headed = bool(rest) and rest[0].startswith("  ")  # as of scenes; of options every line is a mistake
        for line in rest if headed else [first, *rest]:
            line = line.strip()
            if not any(line in told for told in self.mistakes):
                self.mistakes.append(f"run {name}: {line}" if points else line)


def scene_name(text: bytes) -> str:
    """Return the name of a scene's file among the inputs: another text has another."""
    return f"scene-{digest_of(text)}.toml"


def mesh_folders(meshes: list[MeshFile]) -> Iterator[tuple[str, list[MeshFile]]]:
    """Yield the folders among the inputs, each with the mesh files that belong together: others have another name."""
    folders: dict[str, list[MeshFile]] = {}
    for mesh in meshes:
        folders.setdefault(os.path.dirname(mesh.mark.file), []).append(mesh)
    for together in folders.values():
        digests = json.dumps([mesh.mark.blake2b for mesh in together])
        yield f"meshes/{digest_of(digests.encode())}", together


def settings_of(scene: str) -> dict[str, str]:
    """Return by key the settings of a scene's text, as TOML; ValueError if it is none."""
    return {".".join(key): as_toml(value) for key, value in _leaves(tomllib.loads(scene))}


#: Options by name, the value a number where it is one.
_Meant = frozenset[tuple[str, str | float]]


def _meant(given: list[options.Option]) -> _Meant:
    return frozenset({option.name: _number(option.value) for option in given}.items())


def _number(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _check_options(words: list[str]) -> None:
    """Raise InputError with every option that is refused, or that no run would read."""
    unread = options.resolve(words, {}).left_out
    if unread:
        lines = [
            f"{one.place}option -{shown(one.name)}: is read by nothing; petfsi's begin with -{PREFIX}" for one in unread
        ]
        raise InputError("\n".join(lines))


def _combinations(file: SweepFile) -> Iterator[dict[str, Point]]:
    for points in itertools.product(*file.axes.values()):
        chosen = dict(zip(file.axes, points, strict=True))
        if not file.excludes(chosen):
            yield chosen


def _leaves(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*path, name))
        else:
            yield (*path, name), value
