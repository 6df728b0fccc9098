"""Files that grow by a piece at a time, and know at any moment how much of them is final: tables, and XML.

Nothing here is collective: rank 0 alone has such files.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from petfsi.output import files
from petfsi.output.manifest import Mark, Rows

_CHUNK = 1 << 24
#: So many bytes behind the known rows of a table are looked at.
_BEHIND = 1 << 26


class Changed(Exception):
    """A file is not what it was: its text says how."""


def _known_part(path: Path, mark: Mark) -> tuple[hashlib.blake2b, int]:
    """Return the running digest of a file's known first bytes and their lines; ``Changed`` if they are others."""
    done, left, lines = hashlib.blake2b(digest_size=32), mark.bytes, 0
    try:
        with open(files.open_plain(path), "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size < mark.bytes:
                raise Changed(f"it has {size} bytes and should have {mark.bytes} or more")
            while left and (chunk := file.read(min(left, _CHUNK))):
                done.update(chunk)
                left -= len(chunk)
                lines += chunk.count(b"\n")
    except FileNotFoundError:
        raise Changed("it is missing") from None
    except OSError as error:
        raise Changed(files.reason(error)) from None
    if left or done.hexdigest() != mark.blake2b:
        raise Changed("its content has been changed")
    return done, lines


class Table:
    """Lines that are appended, each in one call to the system, so that a kill tears at most the last one."""

    def __init__(self, path: Path, digest: hashlib.blake2b, size: int, rows: int) -> None:
        self.path = path
        self._digest, self._size, self._rows = digest, size, rows
        self._before = digest.copy(), size, rows

    @classmethod
    def begun(cls, path: Path, header: str) -> Table:
        """Return a new table, in place of what there was."""
        data = f"{header}\n".encode()
        files.replace_text(path, data)
        return cls(path, hashlib.blake2b(data, digest_size=32), len(data), 0)

    @classmethod
    def known(cls, path: Path, rows: Rows) -> tuple[Table, bytes]:
        """Return a table whose first rows are known and what comes after them, which ``cut`` removes.

        Raises
        ------
        Changed
            If those rows are not what they were.
        """
        digest, lines = _known_part(path, rows)
        if lines != rows.rows + 1:  # the header's
            raise Changed(f"its first {rows.bytes} bytes are {lines} lines")
        with open(files.open_plain(path), "rb") as file:
            file.seek(rows.bytes)
            return cls(path, digest, rows.bytes, rows.rows), file.read(_BEHIND)

    def cut(self) -> None:
        """Drop all behind the known rows."""
        stat = os.lstat(self.path)
        if stat.st_size != self._size or stat.st_nlink > 1:  # a file with two names is somebody's copy, too
            files.replace_text(self.path, files.read_plain(self.path, self._size))

    def append(self, line: str) -> None:
        """Write a line and hand it to the system, so that it outlives the process; on OSError nothing is added."""
        data = f"{line}\n".encode()
        handle = files.open_plain(self.path, os.O_WRONLY)
        try:
            files.write_whole(handle, data, self._size)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(handle, self._size)
            error.filename = str(self.path)
            raise
        finally:
            os.close(handle)
        self._before = self._digest.copy(), self._size, self._rows
        self._digest.update(data)
        self._size += len(data)
        self._rows += 1

    def drop_last(self) -> None:
        """Take the last line that was appended back, once."""
        self._digest, self._size, self._rows = self._before
        self.cut()

    def on_disk(self) -> Rows:
        """Return how much there is, once it is on the disk."""
        handle = files.open_plain(self.path)
        try:
            os.fsync(handle)
            size = os.fstat(handle).st_size
        finally:
            os.close(handle)
        if size != self._size:
            raise OSError("another process has changed it")
        return Rows(bytes=self._size, blake2b=self._digest.hexdigest(), rows=self._rows)


class GrowingXml:
    """An XML document to which elements are added at the end, valid whenever a reader or a kill comes.

    Its root is closed by ``END``, which opens a processing instruction that fills the rest of the file with blanks.
    What is added is written into those, ``END`` behind it; then the old ``END`` gives way to blanks, in one write
    within a page. When there is no room left, the file is written anew with twice of it.

    Parameters
    ----------
    path : Path
    begin, end : str
        What opens and closes the elements that hold all others.
    """

    _PAGE = 4096
    _LAST = b"?>\n"

    def __init__(self, path: Path, begin: str, end: str) -> None:
        self.path = path
        self._begin, self._end = begin.encode(), end.encode() + b"<?room "
        self._blank = b" " * (len(self._end) - 1) + b"\n"
        self._digest = hashlib.blake2b(digest_size=32)
        self._final = self._size = 0

    def go_on(self, mark: Mark) -> None:
        """Take up a file and drop all behind what is known of it; ``Changed`` if that is not what it was."""
        self._digest, self._final = _known_part(self.path, mark)[0], mark.bytes
        self._rewrite(files.read_plain(self.path, mark.bytes))

    def append(self, text: str) -> None:
        """Add elements; text must not hold '?>'."""
        first = not self._size
        data = (self._begin if first else self._blank) + text.encode()
        place = (self._final + len(data)) % self._PAGE
        if place + len(self._end) > self._PAGE:
            data += b" " * (self._PAGE - place)
        if first or self._final + len(data) + len(self._end + self._LAST) > self._size:
            kept = b"" if first else files.read_plain(self.path, self._final)
            self._final += len(data)
            self._rewrite(kept + data)
        else:
            self._insert(data)
            self._final += len(data)
        self._digest.update(data)

    def on_disk(self) -> Mark:
        """Return how much is final, once it is on the disk."""
        handle = files.open_plain(self.path)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
        return Mark(bytes=self._final, blake2b=self._digest.hexdigest())

    def _rewrite(self, final: bytes) -> None:
        needed = len(final + self._end + self._LAST)
        self._size = max(self._PAGE, 1 << (needed - 1).bit_length())
        files.replace_text(self.path, final + self._end + b" " * (self._size - needed) + self._LAST)

    def _insert(self, data: bytes) -> None:
        handle = files.open_plain(self.path, os.O_WRONLY)
        n = len(self._end)
        try:
            files.write_whole(handle, data[n:] + self._end, self._final + n)
            os.fsync(handle)
            files.write_whole(handle, data[:n], self._final)
        except OSError as error:
            error.filename = str(self.path)
            raise
        finally:
            os.close(handle)
