"""The directory of a run: what is in it, and whose it is."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

import petfsi
from petfsi.errors import InputError
from petfsi.output import files
from petfsi.output.aside import Aside
from petfsi.output.checkpoint import change_records
from petfsi.output.files import RUN_MARKER
from petfsi.output.history import known_rows
from petfsi.output.lock import NAME as LOCK
from petfsi.output.manifest import FORMAT, Leg, Record
from petfsi.output.mesh_files import DIRECTORY, MeshFile, changed_meshes, copy_meshes
from petfsi.ranks import on_root
from petfsi.scene.changes import settings

#: Set aside while a run is under way, so that a full disk still takes its last words (bytes).
RESERVE, RESERVE_BYTES = ".reserve", 16384
#: What a sweep puts into the directory of a run before that begins.
PREPARED = ("run.json", "attempts.jsonl", "output.txt", ".claim")
#: Where a new run's meshes are while an old one is removed.
STAGED = "meshes.part"
#: Scene and options may be so long (bytes).
MOST_TEXT = 16_000_000
#: A marker may be so long (bytes): it names the run's copies of mesh files.
MOST = 1 << 20
_MESH = re.compile(DIRECTORY + r"/\d+/(?!\.\.?$)[^/\0]+")
_FILES = ".reserve scene.toml options.opts history.csv summary.json log.txt".split()
_FILES += "fields.xdmf solid.xdmf fluid.xdmf particles.xdmf".split()
_DIRECTORIES = {
    "fields": re.compile(r"(\d{6,}|mesh)\.h5(\.part)?|outputs\.csv(\.part)?"),
    "checkpoint": re.compile(r"\d{6,}\.(h5|json)(\.part)?"),
    "pictures": re.compile(r"(\d{6,}|history)\.(png|pdf|svg)|film\.gif(\.part)?"),
}


@dataclass(frozen=True)
class RunDirectory:
    """The paths of a run; ``create`` makes a new one, ``open`` takes an existing one."""

    path: Path

    @property
    def scene(self) -> Path:
        """The scene as it was resolved."""
        return self.path / "scene.toml"

    @property
    def options(self) -> Path:
        """The PETSc options in force."""
        return self.path / "options.opts"

    @property
    def history(self) -> Path:
        """A row for every step."""
        return self.path / "history.csv"

    @property
    def summary(self) -> Path:
        """How the run ended."""
        return self.path / "summary.json"

    @property
    def log(self) -> Path:
        """What the run said."""
        return self.path / "log.txt"

    @property
    def checkpoints(self) -> Path:
        """The directory of the checkpoints."""
        return self.path / "checkpoint"

    @classmethod
    def create(
        cls,
        path: Path,
        scene_text: str,
        options_text: str,
        overwrite: bool,
        comm: MPI.Comm,
        meshes: Sequence[MeshFile] = (),
    ) -> RunDirectory:
        """Make the directory of a new run; its lock is held. Collective.

        With ``overwrite`` an earlier run in it is removed: the files that petfsi wrote, nothing else.

        Raises
        ------
        InputError
            On all ranks, when the place is taken by a run (without ``overwrite``) or by anything else, or cannot
            be written.
        """
        run = cls(Path(path))
        try:
            on_root(comm, lambda: run._create(scene_text, options_text, overwrite, list(meshes)))
        except OSError as error:
            where = error.filename or path
            why = files.agreed_reason(comm, error)
            raise InputError(f"run directory {path}: {where} cannot be written: {why}") from error
        return run

    @classmethod
    def open(cls, path: Path, comm: MPI.Comm) -> RunDirectory:
        """Return an existing run. Collective; InputError on all ranks if it is none, or one that cannot go on."""
        run = cls(Path(path))
        on_root(comm, run._check_run)
        return run

    @classmethod
    def check_place(cls, path: Path, overwrite: bool) -> None:
        """Raise InputError unless a run can be made here. Not collective; writes nothing."""
        cls(Path(path))._check_place(overwrite)

    def keep_reserve(self) -> None:
        """Set a little room aside, where there is some. Rank 0 alone."""
        with suppress(OSError), open(files.new_file(self.path / RESERVE), "wb") as file:
            file.write(bytes(RESERVE_BYTES))

    def free_reserve(self) -> None:
        """Give that room back. Rank 0 alone."""
        with suppress(OSError):
            (self.path / RESERVE).unlink(missing_ok=True)

    def first_record(self, meshes: Sequence[MeshFile], leg: Leg) -> Record:
        """Return what the first checkpoint says of a run that has just been made. Not collective."""
        scene, options = (files.digest_of(files.read_plain(path)) for path in (self.scene, self.options))
        marks = tuple(mesh.mark for mesh in meshes)
        return Record(scene=(scene,), options=(options,), settings=self.settings(), meshes=marks, legs=(leg,))

    def settings(self) -> dict[str, str]:
        """Return what may change of the scene and options that are there. Not collective."""
        return settings(*(files.read_plain(path).decode() for path in (self.scene, self.options)))

    def misfits(self, known: Record) -> list[str]:
        """Return what of the run is not what a checkpoint of it vouches for, and what can be done. Not collective."""
        remedy = {
            self.scene: "put it back; 'petfsi resume --set' changes what may change",
            self.options: "put it back; other PETSc options may stand behind 'petfsi resume DIR'",
        }
        wrong = []
        for path, digests in ((self.scene, known.scene), (self.options, known.options)):
            try:
                if files.digest_of(files.read_small(path, MOST_TEXT)) not in digests:
                    wrong.append(f"{path} has been changed since the checkpoint was written: {remedy[path]}")
            except FileNotFoundError:
                wrong.append(f"{path} is missing: put it back")
            except OSError as error:
                wrong.append(f"{path}: {files.reason(error)}")
        wrong += changed_meshes(known.meshes, self.path)
        if known.history is None:
            return [*wrong, f"{self.history}: the checkpoint counts no rows of it"]
        try:
            known_rows(self.history, known.history)
        except InputError as error:
            wrong.append(str(error))
        return wrong

    def change(self, known: Record, scene_text: str, options_text: str, leg: Leg) -> Record:
        """Give a run another scene or other options from here on, and note who goes on; return the new record.

        First all checkpoints learn that the new ones are right, too, then the files are replaced: whatever is
        interrupted, the run can go on, from any of its checkpoints. Rank 0 alone.
        """
        scene, options = files.digest_of(scene_text.encode()), files.digest_of(options_text.encode())

        def change(run: Record) -> Record:
            scenes, choices = _with_last(run.scene, scene), _with_last(run.options, options)
            return run.model_copy(update={"scene": scenes, "options": choices})

        present = [files.digest(path)[1] for path in (self.scene, self.options)]
        if present != [scene, options]:
            change_records(self.checkpoints, change)
            files.replace_text(self.scene, scene_text)
            files.replace_text(self.options, options_text)
        legs = (*(old for old in known.legs if old.step <= leg.step), leg)
        now = settings(scene_text, options_text)
        return known.model_copy(update={"scene": (scene,), "options": (options,), "settings": now, "legs": legs})

    def _is_run(self) -> bool:
        return (self.path / RUN_MARKER).is_file()

    def _check_run(self) -> None:
        if not self._is_run():
            raise InputError(f"{self.path} is not the directory of a run: it has no {RUN_MARKER}")
        try:
            about = json.loads(files.read_plain(self.path / RUN_MARKER, MOST))
            number, version = about.get("format", 3), str(about.get("petfsi"))[:40]
        except (OSError, ValueError, AttributeError, RecursionError):
            raise InputError(f"{self.path / RUN_MARKER} cannot be read") from None
        if number != FORMAT:
            raise InputError(
                f"run directory {self.path} is of format {str(number)[:20]}, by petfsi {version}; this petfsi goes on "
                f"with format {FORMAT} alone: use that version, or start a new run"
            )
        self._check_links()

    def _check_links(self) -> None:
        """Raise if one of the run's own directories is a link: what would be written there would be elsewhere."""
        for name in (*_DIRECTORIES, DIRECTORY):
            if (self.path / name).is_symlink():
                raise InputError(
                    f"{self.path / name} is a link, and petfsi follows none in a run directory; put what it names in "
                    "its place"
                )

    def _check_place(self, overwrite: bool) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"run directory {self.path}: there is a file of that name")
        there = [entry.name for entry in self.path.iterdir()] if self.path.is_dir() else []
        if all(name.startswith(LOCK) or name in PREPARED for name in there):
            return
        if not self._is_run():
            raise InputError(f"run directory {self.path} is not empty and holds no run; name another")
        if not overwrite:
            raise InputError(
                f"run directory {self.path} holds a run already; continue it with 'petfsi resume {self.path}', "
                "replace it with --overwrite, or name another"
            )
        self._check_links()

    def _create(self, scene_text: str, options_text: str, overwrite: bool, meshes: list[MeshFile]) -> None:
        self._check_place(overwrite)
        made = [p for p in (self.path, *self.path.parents) if not p.exists()]
        staged, aside, old = self.path / STAGED, None, b""
        try:
            if self._is_run():
                old = files.read_plain(self.path / RUN_MARKER, MOST)
            self.path.mkdir(parents=True, exist_ok=True)
            if not old:  # first of all, so that what a crash leaves is still known to be ours
                self._mark(meshes)
            _remove_meshes(staged)
            if meshes:
                files.own_directory(staged)
                copy_meshes(meshes, staged)  # before the old run goes: they may be its own
            aside = Aside(self.path, list(self._written()))
            self._mark(meshes)
            if meshes:
                os.replace(staged, self.path / DIRECTORY)
            files.replace_text(self.scene, scene_text)
            files.replace_text(self.options, options_text)
        except (OSError, InputError, UnicodeError):
            with suppress(OSError):
                _remove_meshes(staged)
            if aside is not None:
                _remove_meshes(self.path / DIRECTORY, {mesh.mark.file for mesh in meshes})
                for path in (self.scene, self.options):
                    with suppress(OSError):
                        path.unlink()
                aside.put_back()
            with suppress(OSError):
                if old:
                    files.replace_text(self.path / RUN_MARKER, old)
                else:
                    (self.path / RUN_MARKER).unlink(missing_ok=True)
                for directory in made:
                    directory.rmdir()
            raise
        aside.throw_away()

    def _mark(self, meshes: Sequence[MeshFile]) -> None:
        about = {"petfsi": petfsi.__version__, "format": FORMAT, "meshes": [mesh.mark.file for mesh in meshes]}
        files.replace_text(self.path / RUN_MARKER, json.dumps(about) + "\n")

    def _written(self) -> Iterator[str]:
        """Return the names of what petfsi has written into a run, and of nothing else; the lock is not among them."""
        for name in [*_FILES, *(name + ".part" for name in [*_FILES, RUN_MARKER])]:
            if os.path.lexists(self.path / name) and not _is_folder(self.path / name):
                yield name
        for name, ours in _DIRECTORIES.items():
            if _is_folder(self.path / name):
                for entry in sorted(os.listdir(self.path / name)):
                    if ours.fullmatch(entry) and not _is_folder(self.path / name / entry):
                        yield f"{name}/{entry}"
        if _is_folder(self.path / DIRECTORY):
            for name in self._own_meshes():
                folder = (self.path / name).parent
                if _is_folder(folder) and os.path.lexists(self.path / name) and not _is_folder(self.path / name):
                    yield name

    def _own_meshes(self) -> list[str]:
        """Return the names of the mesh files that the run has copied."""
        try:
            names = json.loads(files.read_plain(self.path / RUN_MARKER, MOST)).get("meshes", [])
            return [name for name in names if _MESH.fullmatch(name)]
        except (OSError, ValueError, AttributeError, TypeError, RecursionError):
            return []


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _with_last(digests: tuple[str, ...], last: str) -> tuple[str, ...]:
    return (*(digest for digest in digests if digest != last), last)


def _remove_meshes(directory: Path, names: Collection[str] | None = None) -> None:
    """Remove a run's copies of mesh files, of all or of these names; a link and what it names stay."""
    if not _is_folder(directory):
        return
    for folder in directory.iterdir():
        if folder.name.isdecimal() and _is_folder(folder):
            for path in folder.iterdir():
                if names is None or f"{DIRECTORY}/{folder.name}/{path.name}" in names:
                    path.unlink()
            with suppress(OSError):
                folder.rmdir()
    with suppress(OSError):  # somebody else's file is in it
        directory.rmdir()
