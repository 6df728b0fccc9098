"""The runs of a sweep on the cores of this machine: as many ranks at a time as there are."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType

from petfsi.errors import InputError
from petfsi.output import files
from petfsi.runs.failure import NO_ROOM
from petfsi.sweeps import attempts
from petfsi.sweeps.claim import at_work, claim, give_back, is_busy, is_elsewhere
from petfsi.sweeps.folder import SweepFolder
from petfsi.sweeps.launch import run_words, start
from petfsi.sweeps.plan import Planned
from petfsi.sweeps.states import LEFT_ALONE, RESULTS, Look, look_at, said_so_far

#: Bytes that must be free on the disk for a run to start.
LEAST_ROOM = 100_000_000
#: Seconds between two looks at processes of one's own, and at runs at which others are.
POLL, LOOK = 0.01, 0.5
#: What the system says of a link, or of what is no plain file, in the place of one.
_NOT_OURS = (errno.ELOOP, errno.EINVAL, errno.EISDIR, errno.ENXIO)
#: Seconds that ranks have to end once mpirun is told to end them.
PATIENCE = 5.0
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass
class _Child:
    run: Planned
    process: subprocess.Popen[bytes]
    claim: int
    step: int
    began: float
    told: bool = False

    def send(self, number: int) -> None:
        """Send it a signal; its number is its own until it is reaped, which ``Popen.send_signal`` would do first."""
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, number)

    def kill(self) -> None:
        """End it and what it has started at once."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


class Pool:
    """Runs what has no result yet. ``work`` returns why it stopped before all had one, or nothing.

    Runs are taken in rounds of ``repeat``, those of many ranks first; while one waits for cores, smaller ones of its
    round alone go before it. What another process is at is waited for, and what it leaves is taken over; its ranks
    count among those at work.

    Parameters
    ----------
    folder : SweepFolder
    runs : sequence of Planned
    cores : int
        Ranks at a time; a run of more has the machine to itself.
    say : callable
    """

    def __init__(self, folder: SweepFolder, runs: Sequence[Planned], cores: int, say: Callable[[str], None]) -> None:
        self.folder, self.cores, self.say = folder, cores, say
        self.waiting = sorted(runs, key=lambda run: (run.repeat, -run.ranks))
        self.total, self.ended = len(runs), 0
        self.children: list[_Child] = []
        self.others: list[Planned] = []
        self.why = ""
        self._signals: list[int] = []
        self._heeded = 0
        self._looked = 0.0

    def work(self) -> str:
        """Run until nothing is left to be run, or until told to stop."""
        with self._hearing():
            try:
                self._loop()
            except BaseException:
                self._wind_down()
                raise
        if self.others and self.why:
            names = ", ".join(run.name for run in self.others[:5])
            self.say(f"at work already, and not stopped by this: {names}{' ...' * (len(self.others) > 5)}")
        return self.why

    def _loop(self) -> None:
        while True:
            self._reap()
            self._heed()
            if not self.why:
                self._look_at_others()
                self._start()
            if not self.children and (self.why or not (self.waiting or self.others)):
                return
            time.sleep(POLL)

    def _wind_down(self) -> None:
        """Let what is at work end after its present step, whatever else cannot be done any more."""
        with suppress(Exception):
            self._stop("an error")
        while self.children:
            with suppress(Exception):  # of each that ends, once
                self._reap()
                self._heed()
            time.sleep(POLL)

    # ---- starting -----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """Start what there are cores for, in order."""
        others = sum(run.ranks for run in self.others if not is_elsewhere(self.folder.run(run.name)))
        free = self.cores - sum(child.run.ranks for child in self.children) - others
        left: list[Planned] = []
        for n, run in enumerate(self.waiting):
            if self.why or free < 1:
                left += self.waiting[n:]
                break
            if left and run.repeat > min(one.repeat for one in left):  # smaller ones overtake within their round
                left.append(run)
            elif run.ranks > free and free < self.cores:  # one of more ranks than cores waits until nothing is at work
                left.append(run)
            else:
                free -= self._take(run)
        self.waiting = left

    def _take(self, run: Planned) -> int:
        """Start a run if it has no result and nobody is at it; return how many cores that takes."""
        path = self.folder.run(run.name)
        with self._room():  # the claim's file is one more
            handle = claim(path)
            if handle is None:
                self.say(f"{run.name}: {at_work(path) or 'another process has claimed it'}")
                self.others.append(run)
                return 0 if is_elsewhere(path) else run.ranks
            child = None
            try:
                child = self._begin(run, handle)
            finally:
                if child is None:
                    give_back(handle)
            return 0 if child is None else run.ranks
        return 0

    def _begin(self, run: Planned, handle: int) -> _Child | None:
        """Start a run that is claimed; None if there is nothing to run, or no room."""
        path = self.folder.run(run.name)
        now = self.folder.read_run(run.name)
        if now is None or now.hash != run.hash:  # while it waited; what is here is that call's
            self.say(f"{run.name}: was replaced by another call, and is left to that")
            self.ended += 1
            return None
        look = look_at(path, run, busy=False)
        if look.state in (*RESULTS, *LEFT_ALONE):
            self.ended += 1
            return None
        if shutil.disk_usage(path).free < LEAST_ROOM:
            self._stop(self._no_room())
            return None
        words = run_words(self.folder, run, look.step)
        attempts.began(path, words[0], look.step, said_so_far(path))
        process = start(self.folder, run, words, handle)
        self.children.append(_Child(run, process, handle, look.step, time.monotonic()))
        return self.children[-1]

    def _look_at_others(self) -> None:
        """Take back what others have left."""
        if not self.others or time.monotonic() - self._looked < LOOK:
            return
        self._looked = time.monotonic()
        left = [run for run in self.others if not is_busy(self.folder.run(run.name))]
        self.others = [run for run in self.others if run not in left]
        for run in [run for run in left if not self.folder.run(run.name).is_dir()]:
            left.remove(run)
            self.ended += 1
            self.say(f"{run.name}: its directory has gone")
        self.waiting = [*left, *self.waiting]

    # ---- ending -------------------------------------------------------------------------------------------------

    def _reap(self) -> None:
        """Note which processes have ended, and how."""
        for child in list(self.children):
            try:
                pid, status, usage = os.wait4(child.process.pid, os.WNOHANG)
            except ChildProcessError:  # where SIGCHLD is ignored the system keeps no exit code
                code, peak_kb = 1, 0
            else:
                if pid == 0:
                    continue
                code, peak_kb = os.waitstatus_to_exitcode(status), usage.ru_maxrss
            child.process.returncode = code
            self.children.remove(child)
            try:
                with self._room():
                    self._note(child, code, peak_kb)
            finally:
                give_back(child.claim)

    def _note(self, child: _Child, code: int, peak_kb: int) -> None:
        path, seconds = self.folder.run(child.run.name), time.monotonic() - child.began
        look = look_at(path, child.run, busy=False)
        full = look.state == "broken" and look.kind == "disk"
        gained = max(0, look.step) - max(0, child.step)
        attempts.ended(path, code, seconds, gained, child.told or full, peak_kb)
        look = look_at(path, child.run, busy=False)  # with what is now known of its end
        if full:
            self._stop(f"{child.run.name}: {look.reason}; {self._no_room()}")
        if look.state == "broken" and not self.why:
            self.waiting.insert(0, child.run)
        else:
            self.ended += 1
        self.say(f"[{self.ended}/{self.total}] {child.run.name}: {_story(look, seconds)}")

    def _heed(self) -> None:
        """Do what signals ask for: the first stops all runs after their present step, the second ends them."""
        if self._signals and not self.why:
            self._stop(signal.Signals(self._signals[0]).name)
        elif len(self._signals) > self._heeded:
            self._end()

    def _stop(self, why: str) -> None:
        """Let every run end after its present step, and start no other."""
        self.why, self._heeded = self.why or why, len(self._signals)
        for child in self.children:
            if not child.told:
                child.told = True
                child.send(signal.SIGUSR1)
        if self.children:
            another = "a second signal" if self._signals else "a signal"
            self.say(f"{len(self.children)} at work stop after their present steps; {another} ends them at once")

    def _end(self) -> None:
        """End every process: mpirun is told to, as its ranks are not in its group."""
        for child in self.children:
            child.told = True
            if child.run.ranks > 1:
                child.send(signal.SIGTERM)
            else:
                child.kill()
        limit = time.monotonic() + PATIENCE
        while self.children and time.monotonic() < limit:
            with suppress(OSError):
                self._reap()
            time.sleep(POLL)
        for child in self.children:
            child.kill()
        while self.children:
            with suppress(OSError):
                self._reap()
            time.sleep(POLL)

    @contextmanager
    def _room(self) -> Iterator[None]:
        """Stop, instead of failing, when what is done inside finds the disk full."""
        try:
            yield
        except OSError as error:
            if error.errno in _NOT_OURS and error.filename:
                raise InputError(f"{error.filename} cannot be written: {files.reason(error)}") from error
            if error.errno not in NO_ROOM:
                raise
            self._stop(self._no_room())

    def _no_room(self) -> str:
        free = shutil.disk_usage(self.folder.path).free
        return (
            f"{free / 1e6:,.0f} MB are free on the disk of {self.folder.path}, and the sweep goes on once there is more"
        )

    @contextmanager
    def _hearing(self) -> Iterator[None]:
        """Hear signals; one that was ignored before, as by nohup, stays so."""

        def hear(number: int, _frame: FrameType | None) -> None:
            self._signals.append(number)

        before = {number: signal.getsignal(number) for number in SIGNALS}
        for number, handler in before.items():
            if handler != signal.SIG_IGN:
                signal.signal(number, hear)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _story(look: Look, seconds: float) -> str:
    steps = look.summary.get("steps")
    took = f", {steps} steps" if isinstance(steps, int) else ""
    reason = f": {look.reason}" if look.reason else ""
    return f"{look.state}{took}, {seconds:.3g} s{reason}"
