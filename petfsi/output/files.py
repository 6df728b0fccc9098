"""Files that change in one piece, why they cannot, and no way around: what petfsi reads and writes is never a link."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from petfsi.ranks import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

#: Marks a directory as a run: a scene and options alone may be somebody's own.
RUN_MARKER = ".petfsi-run"
_CHUNK = 1 << 24
_NO_FILE = "no plain file"


def sync_directory(path: Path) -> None:
    """Return once the names in a directory are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def part_of(path: Path) -> Path:
    """Return the name under which a file is written before it is moved into place."""
    return path.with_name(path.name + ".part")


def new_file(path: Path) -> int:
    """Return the handle of an empty file in place of whatever had the name: what a link names stays as it is."""
    path.unlink(missing_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Return the handle of a plain file.

    Raises
    ------
    OSError
        Of a link, a folder, a pipe or a device, with ``filename``, and of whatever else hinders.
    """
    # without O_NONBLOCK to open a pipe would wait for its other end
    handle = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, _NO_FILE, str(path))
    return handle


def read_plain(path: Path, limit: int | None = None) -> bytes:
    """Return what is in a plain file, or in its first ``limit`` bytes; OSError of anything else."""
    with open(open_plain(path), "rb") as file:
        return file.read() if limit is None else file.read(limit)


def read_small(path: Path, most: int) -> bytes:
    """Return what is in a plain file; OSError of anything else, and of one of more than ``most`` bytes."""
    with open(open_plain(path), "rb") as file:
        if os.fstat(file.fileno()).st_size > most:
            raise OSError(errno.EFBIG, f"has more than {megabytes(most)}", str(path))
        return file.read(most)


def name_of(path: Path) -> str:
    """Return a path from the root as a text that can be written down, whatever bytes are in it."""
    return os.path.abspath(path).encode("utf-8", "backslashreplace").decode()


def own_directory(path: Path) -> None:
    """Make a directory unless there is one; OSError where its name is a link's, for what it names is elsewhere."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "is a link; a run directory's own directories follow none", str(path))
    path.mkdir(exist_ok=True)


def digest(path: Path, length: int | None = None) -> tuple[int, str]:
    """Return how many bytes were read of a plain file (at most ``length``) and their BLAKE2b, 32 bytes in hex."""
    done, read = hashlib.blake2b(digest_size=32), 0
    with open(open_plain(path), "rb") as file:
        while chunk := file.read(_CHUNK if length is None else min(_CHUNK, length - read)):
            done.update(chunk)
            read += len(chunk)
    return read, done.hexdigest()


def digest_of(data: bytes) -> str:
    """Return the BLAKE2b of some bytes, 32 bytes in hexadecimal."""
    return hashlib.blake2b(data, digest_size=32).hexdigest()


def write_part(path: Path, text: str | bytes) -> Path:
    """Write beside ``path``, down to the disk, and return where; nothing is left behind on failure."""
    part = part_of(path)
    try:
        with open(new_file(part), "wb") as file:
            file.write(text.encode() if isinstance(text, str) else text)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        error.filename = error.filename or str(part)
        raise
    return part


def publish(part: Path, path: Path) -> None:
    """Move a part that is on the disk into place."""
    os.replace(part, path)
    sync_directory(path.parent)


def replace_text(path: Path, text: str | bytes) -> None:
    """Give a file new content; a reader, or a crash, meets the old content or the new, never a mixture."""
    publish(write_part(path, text), path)


def write_whole(handle: int, data: bytes, at: int) -> None:
    """Write all of some bytes at a place: a disk with room for a part of them takes that and refuses the rest."""
    while data:
        n = os.pwrite(handle, data, at)
        data, at = data[n:], at + n


def reason(error: OSError, needed: int = 0) -> str:
    """Return in words why a file could not be written; ``error.filename`` tells whose disk is looked at."""
    text = os.strerror(error.errno) if error.errno else str(error)
    if error.errno == errno.EINVAL and error.strerror == _NO_FILE:
        text = f"it is {_NO_FILE}"
    if error.errno == errno.ELOOP:
        text = "it is a link, and a run directory's own files and directories are none"
    if error.errno == errno.ENOSPC and error.filename:
        free = shutil.disk_usage(next(p for p in Path(os.path.abspath(error.filename)).parents if p.exists())).free
        needs = f"{megabytes(needed)} needed, " if needed else ""
        text += f" ({needs}{megabytes(free)} free)"
    return text


def agreed_reason(comm: MPI.Comm, error: OSError, needed: int = 0) -> str:
    """Return ``reason`` as rank 0 sees it: the room on the disk changes while the ranks look. Collective.

    What a run has made and does not find any more, somebody else has removed.
    """
    if error.errno == errno.ENOENT and error.filename:
        return f"{error.filename} is missing; something else has removed it"
    return on_root(comm, lambda: reason(error, needed))


def megabytes(n: int) -> str:
    """Return a number of bytes in MB."""
    return f"{n / 1e6:.3g} MB"
