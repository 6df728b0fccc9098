"""When a run stops early: because it is told to, or because its time is up."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time as clock
from types import FrameType

import numpy as np
from mpi4py import MPI

#: What stops a run after its present step.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP)
_SA_RESETHAND = 0x80000000


class Stop:
    """Whether the run should stop early: a signal, or the wall-time limit.

    ``SIGNALS`` on any rank stop all ranks at the same step; one that was ignored when petfsi began, as by nohup, stays
    ignored. A second SIGINT ends the process at once, in whatever it is.

    Parameters
    ----------
    comm : MPI.Comm
    wall_limit : float or None
        Seconds since the process began, imports and set-up included.
    """

    def __init__(self, comm: MPI.Comm, wall_limit: float | None) -> None:
        self.comm = comm
        self.limit = wall_limit
        self.start = clock.monotonic() - process_age()
        self._signal = 0
        for number in SIGNALS:  # after PETSc has put its own in
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._hear)
        _hear_once(signal.SIGINT)

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        self._signal = number
        if number == signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)

    def asked(self, needed: float) -> str:
        """Return why to stop, or nothing. Collective: one reduction.

        Parameters
        ----------
        needed : float
            Seconds that one more step may take, and a checkpoint after it: both must fit under the limit.
        """
        late = self.limit is not None and clock.monotonic() - self.start + needed > self.limit
        everyone = np.array([self._signal, int(late)])
        self.comm.Allreduce(MPI.IN_PLACE, everyone, MPI.MAX)
        number, late = everyone.tolist()
        if number:
            return signal.Signals(number).name
        return f"the wall-time limit of {self.limit:g} s" if late else ""


class _Sigaction(ctypes.Structure):
    """As glibc has it on Linux with 64 bits."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ubyte * 128),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


def _hear_once(number: int) -> None:
    """Let the next signal of this number, if it is heard at all, be the last one that is.

    Python itself sees signals between two of its own instructions. In a long solve the second one would wait for its
    end with the first; so the system puts the default back as soon as the first one comes.
    """
    if not sys.platform.startswith("linux") or sys.maxsize < 2**32:
        return
    libc, action = ctypes.CDLL(None), _Sigaction()
    if callable(signal.getsignal(number)) and libc.sigaction(number, None, ctypes.byref(action)) == 0:
        action.flags |= ctypes.c_int(_SA_RESETHAND).value
        libc.sigaction(number, ctypes.byref(action), None)


def process_age() -> float:
    """Return for how many seconds this process has been running; 0 where the system does not tell."""
    try:
        with open("/proc/self/stat", "rb") as file:
            # what follows the name, which may hold blanks and brackets, begins with the third field
            ticks = int(file.read().rsplit(b")", 1)[1].split()[22 - 3])
        return max(0.0, clock.clock_gettime(clock.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, AttributeError, ValueError, IndexError):
        return 0.0
