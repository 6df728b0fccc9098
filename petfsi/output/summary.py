"""``summary.json``: what a run was and how it ended, in one small file."""

from __future__ import annotations

import json
import math
import os
import socket
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from petfsi.errors import InputError, SolveError
from petfsi.output import files
from petfsi.ranks import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

#: Bytes of the largest summary.
MOST = 16_000_000


@dataclass
class Summary:
    """The keys of ``summary.json``. A run that was resumed has one part for each time that it was.

    Attributes
    ----------
    status : str
        ``running`` (or killed: then nothing holds the directory's lock), ``done``, ``stopped`` (resumable) or
        ``failed``.
    reason : str
        Why it stopped or failed.
    steps : int
        Steps finished since time zero, over all resumed parts.
    time : float
        Time reached, s.
    ranks : int
        How many processes ran it.
    unknowns : dict
        By field.
    wall_s : float
        Wall time of all parts, s; not of those that were killed, which leave no summary.
    phases : dict
        Wall time of predict, couple, assemble, solve, accept and observe, s; of all parts.
    iterations : dict
        ``mean`` and ``max`` over the steps of all parts.
    assemblies : dict
        How often each field's block and each coupling's blocks were assembled, in all parts.
    conservation : dict
        Volume error, energies, ...
    probes : dict
        The last value of each.
    skipped : list of str
        What this scene had no need of, and why.
    versions : dict
        Of petfsi and the libraries that decide its numbers.
    host : str
        The machine of rank 0.
    pid : int
        Its process there.
    failure : dict or None
        Of a run that failed: ``kind`` (see ``runs/failure.py``), ``step``, ``time``, ``message`` and ``checkpoint``.
    """

    status: Literal["running", "done", "stopped", "failed"]
    steps: int
    time: float
    reason: str = ""
    ranks: int = 1
    unknowns: dict[str, int] = field(default_factory=dict)
    wall_s: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    iterations: dict[str, float] = field(default_factory=dict)
    assemblies: dict[str, int] = field(default_factory=dict)
    conservation: dict[str, float] = field(default_factory=dict)
    probes: dict[str, Any] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)
    failure: dict[str, Any] | None = None


def write_summary(path: Path, summary: Summary, comm: MPI.Comm) -> None:
    """Write the summary, replacing an earlier one in one piece. Collective."""

    def write() -> None:
        from petfsi.output.hdf5 import plain  # HDF5 starts MPI, which those who only read a summary do not

        # through JSON once to be rid of NumPy's types, then of the numbers that JSON has no name for
        content = json.loads(json.dumps(asdict(summary), default=plain))
        files.replace_text(Path(path), json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")

    try:
        on_root(comm, write)
    except OSError as error:
        raise SolveError(f"{path} could not be written: {files.agreed_reason(comm, error)}") from error


def read_summary(path: Path) -> dict[str, Any]:
    """Return a summary as a dictionary. Not collective."""
    try:
        found = json.loads(files.read_small(Path(path), MOST))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {files.reason(error)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a summary: {error}") from error
    if not isinstance(found, dict):
        raise InputError(f"{path} is not a summary: it is no JSON object")
    return found


def _finite(value: Any) -> Any:
    """Replace NaN and infinities by null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
