"""Whose a run is: whoever starts it claims it first, and the claim is its process's, too, as long as that lives.

The claim is ``flock`` on a file, and the process that runs inherits it: the system gives it back when the last of them
has ended, however that was. Once a run is under way its directory has a lock besides, which other machines see.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from pathlib import Path

from petfsi.errors import InputError
from petfsi.output import files
from petfsi.output.lock import MAX_BYTES, Holder, refuse_if_held
from petfsi.output.lock import NAME as LOCK

NAME = ".claim"
#: How often a claim is tried: who only looks whether there is one holds it for a moment.
_TRIES = 5


def claim(path: Path) -> int | None:
    """Return the handle of a run's claim; None where it is another's, or a process is at work in it.

    None, too, where its directory is just being put aside, or has gone. Where the file system knows no ``flock`` the
    directory's lock alone keeps two processes apart.
    """
    try:
        handle = files.open_plain(path / NAME, os.O_RDWR | os.O_CREAT)
    except FileNotFoundError:
        return None
    try:
        if _is_ours(path, handle):
            return handle
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return None


def _is_ours(path: Path, handle: int) -> bool:
    for _ in range(_TRIES):
        if _flock(handle, fcntl.LOCK_EX) is not False:
            break
        time.sleep(0.005)
    else:
        return False
    try:  # a run that is put aside has taken its claim along
        same = os.path.samestat(os.fstat(handle), os.stat(path / NAME))
    except FileNotFoundError:
        return False
    return same and not at_work(path)


def _flock(handle: int, kind: int) -> bool | None:
    """Return whether this process now holds the file; None where the file system cannot tell."""
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EACCES, errno.EAGAIN) else None
    return True


def give_back(handle: int) -> None:
    """Give a claim back, also for those who have inherited it: MPI's daemon outlives its process by a moment."""
    _flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def is_busy(path: Path) -> bool:
    """Return whether a run is claimed, or a process is at work in it."""
    try:
        handle = files.open_plain(path / NAME)
    except OSError:
        return bool(at_work(path))
    claimed = _flock(handle, fcntl.LOCK_SH) is False
    os.close(handle)
    return claimed or bool(at_work(path))


def is_elsewhere(path: Path) -> bool:
    """Return whether the lock of a run's directory is that of a process on another machine."""
    try:
        holder = Holder.read(files.read_plain(path / LOCK, MAX_BYTES))
    except OSError:
        return False
    return holder is not None and not holder.here


def at_work(path: Path) -> str:
    """Return which process holds the lock of a run's directory, in words; nothing if none does."""
    try:
        refuse_if_held(path)
    except InputError as error:
        return str(error).partition(": ")[2]
    return ""
