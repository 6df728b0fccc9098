"""Checkpoints: all that the next step reads, whole and checked, the last few of them.

A checkpoint is two files, ``NNNNNN.h5`` with the data and ``NNNNNN.json``, its manifest, with the data's checksum and
what the run held at that moment. The second is moved into place last: without it, or when it does not match, there is
no checkpoint.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mpi4py import MPI

import petfsi
from petfsi.errors import InputError, NotStoredError, SolveError
from petfsi.fields.slabs import Reader, Slab
from petfsi.output import files, hdf5, stored_state
from petfsi.output.manifest import FORMAT, HEAD, MAX_BYTES, Manifest, Mark, Record, read_manifest
from petfsi.ranks import on_root

#: So many entries that a file does not hold are made up, until all ranks have read what they want.
_BEYOND = 1 << 26


@dataclass(frozen=True)
class CheckpointInfo:
    """A checkpoint's file and its manifest."""

    path: Path
    manifest: Manifest

    @property
    def step(self) -> int:
        """The step that was finished last."""
        return self.manifest.step

    @property
    def time(self) -> float:
        """The time reached, s."""
        return self.manifest.time

    @property
    def ranks(self) -> int:
        """How many processes wrote it."""
        return self.manifest.ranks


def write_checkpoint(
    directory: Path,
    step: int,
    time: float,
    dt: float,
    groups: Mapping[str, Mapping[str, Slab]],
    attributes: Mapping[str, Any],
    comm: MPI.Comm,
    keep: int,
    run: Record | None = None,
) -> Path:
    """Write a checkpoint, remove the oldest ones beyond ``keep``, and return its file. Collective.

    Parameters
    ----------
    directory : Path
        Is made if need be.
    step, time, dt : int, float, float
        The step that was finished last, the time reached (s), its length (s).
    groups : mapping of str to mapping of str to Slab
        The state of every field, by the field's name.
    attributes : mapping
        Whatever else must come back; goes through JSON.
    comm : MPI.Comm
        The ranks that hold pieces.
    keep : int
        How many stay, this one included; at least 1.
    run : Record, optional
        What the checkpoint vouches for; all of that is on the disk already. Rank 0's counts.

    Raises
    ------
    SolveError
        On all ranks, when the disk does not take it. Nothing of it is left then, and earlier ones are untouched.
    """
    path = Path(directory) / f"{step:06d}.h5"
    arrays = {f"{group}/{name}": slab for group, slabs in groups.items() for name, slab in slabs.items()}
    about = {"step": step, "time": time, "dt": dt, "attributes": dict(attributes)}
    try:
        on_root(comm, lambda: _prepare(path.parent))
        hdf5.write_file(files.part_of(path), arrays, about, comm)
        on_root(comm, lambda: _commit(path, step, time, dt, comm.size, run or Record()))
    except OSError as error:
        on_root(comm, lambda: _discard(path))
        last = last_good(path.parent, comm)
        why = files.agreed_reason(comm, error, hdf5.n_bytes(arrays))
        raise SolveError(
            f"step {step}, t = {time:g} s: checkpoint {path} could not be written: {why}. {last}"
        ) from error
    prune_checkpoints(path.parent, step, keep, comm)
    return path


def prune_checkpoints(directory: Path, step: int, keep: int, comm: MPI.Comm) -> None:
    """Remove all but the last ``keep`` checkpoints up to a step, that of a good one, and those after it. Collective."""
    on_root(comm, lambda: _prune(Path(directory), step, keep))


def _prepare(directory: Path) -> None:
    directory.parent.mkdir(parents=True, exist_ok=True)
    files.own_directory(directory)
    for left in directory.glob("*.part"):
        if left.name.partition(".")[0].isdecimal():
            left.unlink()


def _commit(path: Path, step: int, time: float, dt: float, ranks: int, run: Record) -> None:
    """Turn the written part into a checkpoint."""
    part, sidecar = files.part_of(path), path.with_suffix(".json")
    size, checksum = files.digest(part)
    manifest = Manifest(
        format=FORMAT,
        petfsi=petfsi.__version__,
        file=path.name,
        step=step,
        time=float(time),
        dt=float(dt),
        ranks=ranks,
        data=Mark(bytes=size, blake2b=checksum),
        run=run,
    )
    # the text is on the disk before either file gets its name: from here on nothing needs space
    text = files.write_part(sidecar, manifest.text())
    os.replace(part, path)
    os.replace(text, sidecar)
    files.sync_directory(path.parent)


def change_records(directory: Path, change: Callable[[Record], Record]) -> None:
    """Change what the checkpoints that are there vouch for, each in one piece. Rank 0 alone."""
    for number in _numbers(directory):
        found = _inspect(directory, number, thorough=False)
        if isinstance(found, CheckpointInfo):
            manifest = found.manifest
            changed = manifest.model_copy(update={"run": change(manifest.run)})
            files.replace_text(found.path.with_suffix(".json"), changed.text())


def _discard(path: Path) -> None:
    """Remove what a failed write left; that must not hide why it failed."""
    with suppress(OSError):
        files.part_of(path).unlink(missing_ok=True)
        files.part_of(path.with_suffix(".json")).unlink(missing_ok=True)
        if not path.with_suffix(".json").exists():
            path.unlink(missing_ok=True)


def _prune(directory: Path, step: int, keep: int) -> None:
    """Remove all but the last ``keep`` up to ``step``, which is known to be good.

    Later ones belong to a future that was given up, when a damaged checkpoint made the run go back. One that is
    evidently damaged does not count among those kept. A file beyond ``step`` without a manifest stays: a run writes
    none so far ahead, and what it has not written is somebody's own.
    """
    kept = 0
    with suppress(OSError):
        for number in reversed(_numbers(directory)):
            whole = number <= step and isinstance(_inspect(directory, number, thorough=False), CheckpointInfo)
            kept += whole
            if number > step and not _is_ours(directory, number):
                continue
            if not whole or kept > keep:
                # in this order: a file without its small one is not taken for a checkpoint
                (directory / f"{number:06d}.json").unlink(missing_ok=True)
                (directory / f"{number:06d}.h5").unlink(missing_ok=True)


def _is_ours(directory: Path, number: int) -> bool:
    """Return whether there is a manifest under a number, damaged or not, that begins as petfsi's do."""
    try:
        return files.read_plain(directory / f"{number:06d}.json", len(HEAD)).startswith(HEAD)
    except OSError:
        return False


def _numbers(directory: Path) -> list[int]:
    """Return the steps of which there is either file, ascending."""
    found = {p.stem for pattern in ("*.h5", "*.json") for p in directory.glob(pattern)}
    return sorted(int(stem) for stem in found if stem.isascii() and stem.isdecimal() and f"{int(stem):06d}" == stem)


def _inspect(directory: Path, number: int, thorough: bool = True) -> CheckpointInfo | str:
    """Return what is known of a checkpoint, or in words how it is damaged."""
    path = directory / f"{number:06d}.h5"
    sidecar = path.with_suffix(".json")
    try:
        if not os.path.lexists(sidecar):
            return f"{sidecar.name} is missing; writing it was interrupted"
        found = read_manifest(files.read_plain(sidecar, MAX_BYTES))
        if isinstance(found, str):
            return f"{sidecar.name} {found}"
        if (found.file, found.step) != (path.name, number):
            return f"{sidecar.name} speaks of another file"
        size = os.lstat(path).st_size
        if size != found.data.bytes:
            return f"it has {size} bytes and should have {found.data.bytes}"
        if thorough and files.digest(path)[1] != found.data.blake2b:
            return "its checksum does not match"
        wrong = stored_state.fault(path, found) if thorough else ""
    except FileNotFoundError:
        return f"{path.name} is missing"
    except OSError as error:
        return files.reason(error)
    return wrong or CheckpointInfo(path, found)


def find_checkpoint(directory: Path, comm: MPI.Comm, report: Callable[[str], None]) -> CheckpointInfo | None:
    """Return the newest checkpoint that is whole, or None. Collective.

    ``report`` is called, on rank 0 alone, with a line about every newer one that is damaged.
    """

    def look() -> tuple[CheckpointInfo | None, list[str]]:
        damaged: list[str] = []
        for number in reversed(_numbers(Path(directory))):
            found = _inspect(Path(directory), number)
            if isinstance(found, CheckpointInfo):
                return found, damaged
            damaged.append(f"checkpoint {Path(directory) / f'{number:06d}.h5'} is damaged: {found}")
        return None, damaged

    info, damaged = on_root(comm, look)
    if comm.rank == 0:
        for line in damaged:
            report(line)
    return info


def newest_checkpoint(directory: Path) -> Path | None:
    """Return the newest checkpoint that looks whole, its data not read; None without one. Not collective."""
    every = (_inspect(Path(directory), number, thorough=False) for number in reversed(_numbers(Path(directory))))
    return next((found.path for found in every if isinstance(found, CheckpointInfo)), None)


def last_good(directory: Path, comm: MPI.Comm) -> str:
    """Return a sentence that names the newest checkpoint that is whole. Collective."""
    info = find_checkpoint(directory, comm, lambda _line: None)
    return f"Last good checkpoint: {info.path}." if info else "There is no checkpoint."


class CheckpointReader:
    """An open checkpoint; what ``read_checkpoint`` gives inside ``with``.

    Attributes
    ----------
    step, time, dt : int, float, float
        As they were written.
    attributes : dict
        As they were written, through JSON.
    """

    def __init__(self, info: CheckpointInfo, comm: MPI.Comm) -> None:
        self.comm = comm
        self.path = info.path
        self._file = hdf5.open_file(info.path, "r", comm)
        about = self._file.attrs
        self.step, self.time, self.dt = int(about["step"]), float(about["time"]), float(about["dt"])
        self.attributes: dict[str, Any] = json.loads(about["attributes"])
        self._shapes = {
            f"{group}/{name}": array.shape for group, arrays in self._file.items() for name, array in arrays.items()
        }
        self._ends: dict[str, tuple[int, ...]] = {}
        self._failure: OSError | None = None

    def __enter__(self) -> CheckpointReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if error is None:
            self._check()

    def groups(self) -> list[str]:
        """Return the names of the fields that have state here."""
        return sorted(self._file)

    def unread(self) -> list[str]:
        """Return the arrays that nothing has read, as ``group/array``, of whole groups the group. Not collective."""
        read = {name.split("/")[0] for name in self._ends}
        return sorted(
            {
                name if name.split("/")[0] in read else name.split("/")[0]
                for name in self._shapes
                if name not in self._ends
            }
        )

    def group(self, name: str) -> Reader:
        """Return the reader of one field's state.

        Each rank reads on its own. A piece that lies outside the stored array comes back as zeros there, and the
        end of the ``with`` block, which is collective, raises the error on all ranks: a rank that raised alone
        would leave the others waiting in the next collective call.
        """
        if name not in self._file:
            raise NotStoredError(
                f"checkpoint {self.path} holds no state of '{name}', only of {', '.join(self.groups())}"
            )

        def read(array: str, start: tuple[int, ...], count: tuple[int, ...]) -> np.ndarray:
            return self._read(f"{name}/{array}", tuple(start), tuple(count))

        return read

    def _read(self, name: str, start: tuple[int, ...], count: tuple[int, ...]) -> np.ndarray:
        if name not in self._shapes:
            raise NotStoredError(f"checkpoint {self.path} has no array '{name}', which the scene asks for")
        dataset = self._file[name]
        if len(dataset.shape) != len(count):
            raise InputError(
                f"checkpoint {self.path}: '{name}' has shape {dataset.shape}; the scene wants {len(count)} axes"
            )
        end = tuple(s + c for s, c in zip(start, count, strict=True))
        inside = all(e <= n for e, n in zip(end, dataset.shape, strict=True))
        self._ends[name] = tuple(map(max, end, self._ends.get(name, end)))
        if not inside and math.prod(count) > dataset.size + _BEYOND:  # a number in the file asked for it
            raise InputError(f"checkpoint {self.path}: '{name}' has shape {dataset.shape}; the scene wants {end}")
        data = np.zeros(count, dataset.dtype)
        if inside and data.size:
            try:
                hdf5.read_piece(dataset.id, start, data)
            except OSError as error:
                self._failure = OSError(error.errno or errno.EIO, str(error), str(self.path))
        return data

    def _check(self) -> None:
        """Raise on all ranks if the pieces of all ranks do not make up the stored arrays. Collective."""
        everyone = self.comm.allgather((self._ends, self._failure))
        for _ends, failure in everyone:
            if failure is not None:
                raise InputError(f"checkpoint {self.path} cannot be read: {files.reason(failure)}") from failure
        for name, shape in sorted(self._shapes.items()):
            ends = [ends[name] for ends, _failure in everyone if name in ends]
            wanted = tuple(max(along) for along in zip(*ends, strict=True))
            if ends and wanted != shape:
                raise InputError(f"checkpoint {self.path}: '{name}' has shape {shape}; the scene wants {wanted}")


@contextmanager
def taken_up(info: CheckpointInfo) -> Iterator[None]:
    """Name the checkpoint in which something is found inside ``with`` that can be no state of the scene.

    Raises
    ------
    InputError
        On the ranks, all or some, where that is found.
    """
    try:
        yield
    except (ValueError, IndexError, KeyError, TypeError, ArithmeticError, MemoryError) as error:
        what = " ".join(str(error).split())[:200]
        raise InputError(f"checkpoint {info.path} holds no state of this scene: {what}") from error


def read_checkpoint(info: CheckpointInfo, comm: MPI.Comm) -> CheckpointReader:
    """Open a checkpoint on all ranks, as a context manager whose end checks what was read. Collective.

    Raises
    ------
    InputError
        On all ranks, when an array is missing or its shape is not what the scene wants.
    """
    try:
        return CheckpointReader(info, comm)
    except (OSError, KeyError) as error:
        raise InputError(f"checkpoint {info.path} cannot be read: {error}") from error
