"""One process per run directory: a lock that says who is at work there.

The lock is a file that gets its name by a hard link, which is atomic on NFS, too. While its holder lives it also holds
``flock`` on it, where the file system knows that: the system lets go of it whatever ends the process. A lock that is
left is taken over when its process is known to be gone: on this machine by its number and the time it began, on
another one never; there its age tells, as the holder touches it while it steps.
"""

from __future__ import annotations

import errno
import fcntl
import getpass
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from petfsi.errors import InputError
from petfsi.output import files
from petfsi.ranks import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

#: The lock's name in a run directory.
NAME = ".lock"
#: Stands for a moment beside it while the lock of a process that is gone is taken over.
TAKING = f"{NAME}.taking"
#: Seconds between two touches of a lock that is held.
BEAT = 10.0
_TRIES = 20
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
#: Of a lock.
MAX_BYTES = 4096


@dataclass(frozen=True)
class Holder:
    """A process: its machine, the machine's start, its number, its start (clock ticks), its user, since when."""

    host: str
    boot: str
    pid: int
    started: int
    user: str
    since: str

    @classmethod
    def present(cls) -> Holder:
        """Return this process."""
        try:
            user = getpass.getuser()
        except (KeyError, OSError):  # a container's number without a name
            user = str(os.getuid())
        now = time.strftime("%Y-%m-%d %H:%M:%S %Z")
        return cls(socket.gethostname(), _boot(), os.getpid(), _started(os.getpid()) or 0, user, now)

    @classmethod
    def read(cls, data: bytes) -> Holder | None:
        """Return whom a lock names; None where it names nobody."""
        try:
            holder = cls(**json.loads(data))
            kinds = (str, str, int, int, str, str)
            right = all(type(v) is k for v, k in zip(asdict(holder).values(), kinds, strict=True))
        except (ValueError, TypeError, RecursionError):
            return None
        return holder if right and 0 < holder.pid < 1 << 31 else None

    @property
    def here(self) -> bool:
        """Whether it is or was of this machine."""
        return self.host == socket.gethostname()

    def gone(self) -> bool:
        """Return whether a process of this machine has ended."""
        if self.boot != _boot():
            return True
        return _started(self.pid) != self.started

    def __str__(self) -> str:
        said = (self.user, self.host, self.since)
        user, host, since = ("".join(c if c.isprintable() else "?" for c in text)[:64] for text in said)
        return f"process {self.pid} of {user} on {host}, since {since}"


class Lock:
    """A lock that this process holds; rank 0 alone has one."""

    def __init__(self, path: Path, handle: int) -> None:
        self._path, self._handle = path, handle
        self._touched = time.monotonic()

    def touch(self) -> None:
        """Show that the holder lives, at most every ``BEAT`` seconds."""
        if time.monotonic() - self._touched > BEAT:
            self._touched = time.monotonic()
            with suppress(OSError):
                os.utime(self._handle)

    def release(self) -> None:
        """Let others in; a lock that has become another's stays."""
        with suppress(OSError):
            if _same(self._path, self._handle):
                self._path.unlink()
        os.close(self._handle)


@contextmanager
def held(directory: Path, comm: MPI.Comm, make: bool = False) -> Iterator[Lock | None]:
    """Hold a run directory's lock; rank 0 gets it, the others None. Collective.

    Parameters
    ----------
    directory : Path
    comm : MPI.Comm
    make : bool
        Whether the directory is made where there is none, and goes again if nothing has come into it.

    Raises
    ------
    InputError
        On all ranks, when another process holds it, or it cannot be written.
    """
    kept: list[Lock] = []
    made: list[Path] = []

    def take() -> None:
        if make:
            made.extend(p for p in (directory, *directory.parents) if not p.exists())
            directory.mkdir(parents=True, exist_ok=True)
        kept.append(acquire(directory))

    try:
        try:
            on_root(comm, take)
        except OSError as error:
            where = error.filename or directory
            why = files.agreed_reason(comm, error)
            raise InputError(f"run directory {directory}: {where} cannot be written: {why}") from error
        yield kept[0] if kept else None
    finally:
        for lock in kept:
            lock.release()
        with suppress(OSError):
            for path in made:  # those that are empty
                path.rmdir()


def acquire(directory: Path) -> Lock:
    """Return the lock of a directory. Not collective.

    Raises
    ------
    InputError
        When another process holds it: who, since when, and what to do if it is gone.
    OSError
        When it cannot be written.
    """
    path = Path(directory) / NAME
    for _ in range(_TRIES):
        lock = _make(path) or _take_over(path)
        if lock is not None:
            return lock
        time.sleep(0.05)
    taking = path.with_name(TAKING)
    raise InputError(f"run directory {directory}: another process takes its lock; if none does, remove {taking}")


def _make(path: Path) -> Lock | None:
    """Return a new lock; None where there is one."""
    own, handle = _written(path)
    try:
        os.link(own, path)
    except FileExistsError:
        os.close(handle)
        return None
    except OSError as error:
        os.close(handle)
        if error.errno not in _NO_LINKS:
            raise
        return _make_plainly(path)
    finally:
        own.unlink(missing_ok=True)
    return Lock(path, handle)


def _make_plainly(path: Path) -> Lock | None:
    """Do the same where the file system knows no hard links."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        return None
    os.write(handle, json.dumps(asdict(Holder.present())).encode())
    _flock(handle)
    return Lock(path, handle)


def _written(path: Path) -> tuple[Path, int]:
    """Return a file of this process's own that says who it is, and its handle, which holds ``flock``."""
    own = path.with_name(f"{NAME}.{socket.gethostname()[:64]}.{os.getpid()}")
    handle = files.new_file(own)
    try:
        os.write(handle, json.dumps(asdict(Holder.present())).encode() + b"\n")
        os.fsync(handle)
        _flock(handle)
    except OSError as error:
        os.close(handle)
        own.unlink(missing_ok=True)
        error.filename = error.filename or str(own)
        raise
    return own, handle


def refuse_if_held(directory: Path) -> None:
    """Raise InputError when another process is at work in a directory. Not collective; writes nothing."""
    old = _open_old(Path(directory) / NAME)
    if old is not None:
        try:
            _judge(Path(directory) / NAME, old)
        finally:
            os.close(old)


def _take_over(path: Path) -> Lock | None:
    """Return the lock that a process left which is gone; None where it has changed while this one looked."""
    old = _open_old(path)
    if old is None:
        return None
    taking = path.with_name(TAKING)
    try:
        _judge(path, old)
        # of several that come to this, one at a time looks again and takes it
        guard = _make_plainly(taking)
        if guard is None:
            _clear(taking)
            return None
        try:
            if not _same(path, old):
                return None
            own, handle = _written(path)
            os.replace(own, path)
            return Lock(path, handle)
        finally:
            guard.release()
    finally:
        os.close(old)


def _clear(taking: Path) -> None:
    """Remove what a process left that was ended while it took a lock over, where ``flock`` lets one alone do so."""
    old = _open_old(taking)
    if old is None:
        return
    try:
        free = _flock(old)
        holder = Holder.read(os.pread(old, MAX_BYTES, 0))
        if free and holder is not None and holder.here and holder.gone() and _same(taking, old):
            taking.unlink()
    finally:
        os.close(old)


def _open_old(path: Path) -> int | None:
    """Return the handle of a lock that is there, or None."""
    try:
        return files.open_plain(path, os.O_RDWR)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        if not os.path.lexists(path):
            return None
        raise InputError(f"{path} is no lock of petfsi, or cannot be opened; remove it if no run is at work") from None


def _judge(path: Path, old: int) -> None:
    """Raise InputError unless the process that a lock names is gone, or the lock is; takes ``flock`` on it."""
    free = _flock(old)
    holder = Holder.read(os.pread(old, MAX_BYTES, 0))
    if free is False or holder is None or not (holder.here and holder.gone()):
        if _same(path, old):
            raise InputError(_at_work(path, holder, os.fstat(old).st_mtime, free))


def _at_work(path: Path, holder: Holder | None, beat: float, free: bool | None) -> str:
    whose = str(holder) if holder else "a process that it does not name"
    text = f"run directory {path.parent}: another process is at work in it: {whose}"
    if holder is not None and (holder.here or free is False):
        return f"{text}; wait for it, or stop it (kill {holder.pid})" if holder.here else f"{text}; wait for it"
    age = max(0, int(time.time() - beat))
    when = f"{age} s" if age < 120 else f"{age // 60} min" if age < 7200 else f"{age // 3600} h"
    gone = f"; a process that lives touches it every {BEAT:g} s, or after each step"
    return f"{text}; it was last seen {when} ago{gone}. If it is known to be gone, remove {path}"


def _flock(handle: int) -> bool | None:
    """Return whether this process now holds the file; None where the file system cannot tell."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        return False if error.errno in (errno.EACCES, errno.EAGAIN) else None
    return True


def _same(path: Path, handle: int) -> bool:
    """Return whether a name is still that of an open file."""
    try:
        return os.path.samestat(os.lstat(path), os.fstat(handle))
    except FileNotFoundError:
        return False


def _boot() -> str:
    """Return what tells one start of this machine from the next."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return ""


def _started(pid: int) -> int | None:
    """Return when a process of this machine began, in clock ticks since the machine did; None if there is none."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    except OSError:
        return 0
    return None if words[0] in "ZX" else int(words[19])
