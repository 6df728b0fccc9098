"""Files that change in one piece, and why they cannot."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from mpi4py import MPI

from petfsi.ranks import on_root


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


def write_part(path: Path, text: str) -> Path:
    """Write text beside ``path``, down to the disk, and return where; nothing is left behind on failure."""
    part = part_of(path)
    try:
        with open(part, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        part.unlink(missing_ok=True)
        raise
    return part


def publish(part: Path, path: Path) -> None:
    """Move a part that is on the disk into place."""
    os.replace(part, path)
    sync_directory(path.parent)


def replace_text(path: Path, text: str) -> None:
    """Give a file new content; a reader, or a crash, meets the old content or the new, never a mixture."""
    publish(write_part(path, text), path)


def reason(error: OSError, needed: int = 0) -> str:
    """Return in words why a file could not be written; ``error.filename`` tells whose disk is looked at."""
    text = os.strerror(error.errno) if error.errno else str(error)
    if error.errno == errno.ENOSPC and error.filename:
        free = shutil.disk_usage(Path(error.filename).parent).free
        needs = f"{megabytes(needed)} needed, " if needed else ""
        text += f" ({needs}{megabytes(free)} free)"
    return text


def agreed_reason(comm: MPI.Comm, error: OSError, needed: int = 0) -> str:
    """Return ``reason`` as rank 0 sees it: the room on the disk changes while the ranks look. Collective."""
    return on_root(comm, lambda: reason(error, needed))


def megabytes(n: int) -> str:
    """Return a number of bytes in MB."""
    return f"{n / 1e6:.3g} MB"
