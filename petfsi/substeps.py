"""How long an explicit step may be, and into how many a step of the scene is divided."""

from __future__ import annotations

import math

from petfsi.errors import InputError, SolveError
from petfsi.fields.base import SolidField
from petfsi.scene.schema import Time

#: The stable step is found anew after so many steps at most,
EVERY = 100
#: and as soon as nodes may have moved by this part of the shortest edge.
TRAVEL = 0.02
#: Sub-steps are this part of the stable step at most: it may shrink until it is found anew.
MARGIN = 0.9
#: A step that must be divided more often has blown up.
MOST = 100_000


class StableStep:
    """Keeps a step below the stable one, as ``time.above_limit`` says.

    Finding the stable step costs about as much as a step, so it is found before the first step, every ``EVERY``
    steps, whenever the fastest node may have come ``TRAVEL`` of the shortest edge farther, and after ``forget``.
    Once is enough where it never changes.

    Parameters
    ----------
    solid : SolidField or None
    time : Time
        Of the scene.

    Attributes
    ----------
    limited : bool
        Whether there is a stable step at all.
    limit : float
        The one last found, s; inf at first.
    """

    def __init__(self, solid: SolidField | None, time: Time) -> None:
        self._solid = solid
        self.limited = solid is not None and solid.explicit
        self._subcycles = time.above_limit == "subcycle"
        self.limit = math.inf
        self._steps, self._travelled = EVERY, 0.0

    @property
    def divides(self) -> bool:
        """Whether a step may be divided."""
        return self.limited and self._subcycles

    def forget(self) -> None:
        """Find the stable step anew before the next step."""
        self._steps = EVERY

    def count(self, t: float, dt: float) -> int:
        """Return into how many equal steps one of length dt that begins at t must be divided. Collective.

        Raises
        ------
        InputError
            At time zero, if it exceeds the stable step and the scene refuses that.
        SolveError
            Later.
        """
        if not self.limited:
            return 1
        self._find()
        if self._subcycles:
            if not dt < MOST * self.limit:
                raise SolveError(f"the solid has blown up: its stable step is {self.limit:.4g} s at t = {t:g} s")
            return max(1, math.ceil(dt / (MARGIN * self.limit)))
        if dt > self.limit:
            kind = InputError if t == 0 else SolveError
            raise kind(
                f"time.dt = {dt:g}: the stable step of symplectic-euler is {self.limit:.4g} s at t = {t:g} s; set "
                f'time.dt below it, or time.above_limit = "subcycle"'
            )
        return 1

    def _find(self) -> None:
        solid = self._solid
        assert solid is not None
        if self._steps >= EVERY or self._travelled > TRAVEL * solid.finest:
            self.limit = solid.stable_step()
            self._steps, self._travelled = 0, 0.0

    def moved(self, way: float) -> None:
        """Count a step in which no node moved farther than ``way``, m."""
        assert self._solid is not None
        if not self._solid.is_linear:
            self._steps, self._travelled = self._steps + 1, self._travelled + way
