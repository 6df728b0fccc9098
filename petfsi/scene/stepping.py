"""The steps of a run: how long each one is, and when there are enough."""

from __future__ import annotations

import math
from decimal import Decimal

from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.schema import Time

#: What may be missing to the run's end, in steps.
SLACK = 1e-6
#: The shortest step, over the run's length: shorter ones would be lost in the round-off of the time.
SHORTEST = 1e-12
#: The value of ``time.dt`` that leaves the length to the stable step,
AUTO = "auto"
#: of which a step is this part: it may shrink meanwhile.
PART = 0.9
#: While the stable step is not known: this part of the run.
UNKNOWN = 1e-6


class Stepping:
    """The scene's ``time`` at work.

    Steps are taken until the end is reached, but for ``SLACK`` of the last one. Where whole steps would pass it, the
    last two share what is left: none is shorter than half of what the scene says.

    Attributes
    ----------
    constant, auto : bool
        Whether all steps have the same length; whether the stable step gives it.
    """

    def __init__(self, time: Time) -> None:
        self.end = time.end
        self.auto = time.dt == AUTO
        self._dt = Expression(UNKNOWN * time.end if self.auto else time.dt, ("t",), key="time.dt")
        self.constant = self._dt.is_constant and not self.auto
        self._length: float | None = None  # of all steps, once it is known
        self._origin = 0, 0.0  # the step and time from which equal steps are counted

    def go_on(self, step: int, t: float, stored: tuple[float, int, float]) -> None:
        """Take up a run at a step and its time: its equal steps are counted on, others begin there.

        Parameters
        ----------
        step : int
        t : float
        stored : tuple of float, int, float
            What ``stored`` was then.

        Raises
        ------
        ValueError
            If that does not lead to t.
        """
        length, begin, start = stored
        if not (self.constant and length == self.wanted(t)):
            self._origin = step, t
        elif abs(start + (step - begin) * length - t) <= SLACK * length:
            self._origin = begin, start
        else:
            raise ValueError(f"its clock does not lead to t = {t:g} s in {step} steps")

    @property
    def stored(self) -> tuple[float, int, float]:
        """The length of equal steps (s) and from which step and time (s) they are counted; zeros of other steps."""
        return (self.wanted(self._origin[1]), *self._origin) if self.constant else (0.0, 0, 0.0)

    def length(self, t: float, stable: float | None = None) -> float:
        """Return the length of the step that begins at t, s.

        Parameters
        ----------
        t : float
        stable : float, optional
            The stable step then, s, if it is wanted and known.

        Raises
        ------
        ExpressionError
            If it is not finite, zero, negative, or no more than round-off.
        """
        if self.auto and stable is not None:
            return self._free_length(t, PART * stable)
        return self._ending(t, self.wanted(t))

    def wanted(self, t: float) -> float:
        """Return what the scene says of the length of a step that begins at t, s; raises what ``length`` does."""
        if self._length is not None:
            return self._length
        dt = float(self._dt(t=t))
        if dt > (0.0 if self.constant else SHORTEST * self.end):
            self._length = dt if self.constant else None
            return dt
        at = "" if self.constant else f"is {dt:g} at t = {t:g}; "
        wanted = f"must be greater than {SHORTEST:g} of time.end" if dt > 0 else "must be greater than 0 (s)"
        raise ExpressionError(f"time.dt = {self._dt.source!r}", at + wanted)

    def _free_length(self, t: float, longest: float) -> float:
        """Return the length of a step that may be as long as ``longest``: the last two share what is left."""
        if not longest > SHORTEST * self.end:
            at = f"the stable step is {longest / PART:.3g} s at t = {t:g}; nine tenths of it "
            raise ExpressionError(f'time.dt = "{AUTO}"', f"{at}must be greater than {SHORTEST:g} of time.end")
        return self._ending(t, longest)

    def _ending(self, t: float, dt: float) -> float:
        """Return dt, or what lets the run end at its end where that is nearer than two of them."""
        left = self.end - t
        if left <= 0 or left >= (2 - SLACK) * dt or abs(left - dt) <= SLACK * dt and not self.auto:
            return dt  # beyond the end a run is done, and the next step is that of one that goes on
        return left if left <= dt else left / 2

    def after(self, step: int, t: float, dt: float) -> float:
        """Return the time after a step of length dt that began at t and ends as number ``step``, s."""
        begin, start = self._origin
        if self.constant and dt == self._length:
            end = multiple(start, step - begin, dt)
            return self.end if abs(end - self.end) <= SLACK * dt else end
        end = self._sum(t, dt)
        if self.constant:  # the steps of a run that is given a later end are counted from here
            self._origin = step, end
        return end

    def _sum(self, t: float, dt: float) -> float:
        return self.end if abs(t + dt - self.end) <= SLACK * dt else t + dt

    def finished(self, t: float, dt: float) -> bool:
        """Say whether t, reached by a step of length dt, is the end."""
        return t >= self.end - SLACK * dt

    def count(self, most: int) -> int | None:
        """Return the last step's number; None if they differ and are more than ``most``, or one is impossible."""
        step, t = begin, start = self._origin
        if self.auto:
            return None
        try:
            if self.constant:
                dt = self.wanted(t)
                return begin + max(1, math.ceil((self.end - start) / dt - SLACK))
            dt = self.length(t)
            while step == begin or not self.finished(t, dt):
                if step == begin + most:
                    return None
                dt = self.length(t)
                step, t = step + 1, self._sum(t, dt)
        except ExpressionError:
            return None
        return step


def multiple(start: float, number: int, dt: float) -> float:
    """Return start + number dt as it is on paper: 3 times 0.1 s are 0.3 s, which no sum of binary numbers is."""
    return float(Decimal(repr(float(start))) + number * Decimal(repr(float(dt))))
