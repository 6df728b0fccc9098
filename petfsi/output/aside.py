"""An old run's files, out of the way of a new one until that is in their place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

NAME = ".old.part"


class Aside:
    """Some files of a directory, moved within it: all of them, or OSError and none.

    Parameters
    ----------
    home : Path
    names : iterable of str
        Relative to it; the folders that hold them go, too, where nothing else is in them.
    """

    def __init__(self, home: Path, names: Iterable[str]) -> None:
        self._home, self._place = home, home / NAME
        self._names: list[str] = []
        self.throw_away()  # what a crash has left
        try:
            for name in names:
                self._move(self._home, self._place, name)
                self._names.append(name)
        except OSError:
            self.put_back()
            raise
        folders = {folder for name in self._names for folder in Path(name).parents} - {Path()}
        for folder in sorted(folders, reverse=True):  # what is in a folder comes before it
            with suppress(OSError):  # somebody else's file is in it
                (home / folder).rmdir()

    def put_back(self) -> None:
        """Give every file its old place again, whatever is there now."""
        for name in reversed(self._names):
            self._move(self._place, self._home, name)
        self.throw_away()

    def throw_away(self) -> None:
        """Remove the files, as far as that can be done."""
        self._names = []
        if not self._place.is_symlink():
            shutil.rmtree(self._place, ignore_errors=True)

    @staticmethod
    def _move(start: Path, end: Path, name: str) -> None:
        (end / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(start / name, end / name)
