"""The directory of a run: what is in it, and whose it is."""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

import petfsi
from petfsi.errors import InputError
from petfsi.output import files
from petfsi.ranks import on_root

#: Marks a directory as a run: a scene and options alone may be somebody's own.
MARKER = ".petfsi-run"
#: Set aside while a run is under way, so that a full disk still takes its last words (bytes).
RESERVE, RESERVE_BYTES = ".reserve", 16384
_FILES = ".reserve scene.toml options.opts history.csv summary.json log.txt".split()
_FILES += "fields.xdmf solid.xdmf fluid.xdmf particles.xdmf".split()
_DIRECTORIES = {
    "fields": re.compile(r"(\d{6,}|mesh)\.h5(\.part)?"),
    "checkpoint": re.compile(r"\d{6,}\.(h5|json)(\.part)?"),
    "pictures": re.compile(r"(\d{6,}|history)\.png|film\.gif(\.part)?"),
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
    def create(cls, path: Path, scene_text: str, options_text: str, overwrite: bool, comm: MPI.Comm) -> RunDirectory:
        """Make the directory of a new run. Collective.

        With ``overwrite`` an earlier run in it is removed: the files that petfsi wrote, nothing else.

        Raises
        ------
        InputError
            On all ranks, when the place is taken by a run (without ``overwrite``) or by anything else, or cannot
            be written.
        """
        run = cls(Path(path))
        try:
            on_root(comm, lambda: run._create(scene_text, options_text, overwrite))
        except OSError as error:
            where = error.filename or path
            why = files.agreed_reason(comm, error)
            raise InputError(f"run directory {path}: {where} cannot be written: {why}") from error
        return run

    @classmethod
    def open(cls, path: Path, comm: MPI.Comm) -> RunDirectory:
        """Return an existing run. Collective; InputError on all ranks if it is none."""
        run = cls(Path(path))
        if not on_root(comm, run._is_run):
            raise InputError(f"{path} is not the directory of a run: it has no {MARKER}")
        return run

    def keep_reserve(self) -> None:
        """Set a little room aside, where there is some. Rank 0 alone."""
        with suppress(OSError):
            (self.path / RESERVE).write_bytes(bytes(RESERVE_BYTES))

    def free_reserve(self) -> None:
        """Give that room back. Rank 0 alone."""
        with suppress(OSError):
            (self.path / RESERVE).unlink(missing_ok=True)

    def _is_run(self) -> bool:
        return (self.path / MARKER).is_file()

    def _create(self, scene_text: str, options_text: str, overwrite: bool) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"run directory {self.path}: there is a file of that name")
        if self.path.is_dir() and any(self.path.iterdir()):
            if not self._is_run():
                raise InputError(f"run directory {self.path} is not empty and holds no run; name another")
            if not overwrite:
                raise InputError(
                    f"run directory {self.path} holds a run already; continue it with 'petfsi resume {self.path}', "
                    "replace it with --overwrite, or name another"
                )
            self._clear()
        made = [p for p in (self.path, *self.path.parents) if not p.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            # first of all, so that what a crash leaves is still known to be ours
            files.replace_text(self.path / MARKER, json.dumps({"petfsi": petfsi.__version__}) + "\n")
            files.replace_text(self.scene, scene_text)
            files.replace_text(self.options, options_text)
        except OSError:
            with suppress(OSError):
                self._clear()
                (self.path / MARKER).unlink(missing_ok=True)
                for directory in made:
                    directory.rmdir()
            raise

    def _clear(self) -> None:
        """Remove what petfsi writes into a run, and nothing else; the marker stays."""
        for name in [*_FILES, *(name + ".part" for name in [*_FILES, MARKER])]:
            (self.path / name).unlink(missing_ok=True)
        for name, ours in _DIRECTORIES.items():
            directory = self.path / name
            if not directory.is_dir():
                continue
            for entry in sorted(os.listdir(directory)):
                if ours.fullmatch(entry):
                    (directory / entry).unlink()
            with suppress(OSError):  # somebody else's file is in it
                directory.rmdir()
