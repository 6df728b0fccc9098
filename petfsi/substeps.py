"""How long an explicit step may be, and into how many a step of the scene is divided."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from mpi4py import MPI

from petfsi.errors import InputError, SolveError
from petfsi.fields.base import Field
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.solids import SolidField
from petfsi.fields.stored import EXACT
from petfsi.scene.schema import Time

#: The stable step is found anew after so many steps at most,
EVERY = 100
#: and when an edge has changed by half this part of its length, so that none ever does by more than this.
STRETCH = 0.05
#: Sub-steps are this part of the stable step at most: it may shrink until it is found anew.
MARGIN = 0.9
#: Parts of a step are too long if it is by more than rounding.
SLACK = 1e-9
#: A step is divided into so many at most: one that asks for more would seem to hang, or has blown up.
MOST = 10_000
#: A step of so many is told of.
MANY = 100


class StableStep:
    """Keeps a step below the stable one, as ``time.above_limit`` says.

    Finding a solid's stable step costs some 30 steps. It is found before the first step, every ``EVERY`` steps, and
    when the body may have changed too much since: the ends of an edge can have moved apart by twice the way of the
    fastest node, and once that may be ``STRETCH`` of the shortest edge the edges are looked at. Once is enough where it
    never changes. A run that goes on knows the one last found: else it might divide its steps otherwise. That of other
    fields costs little and is found before each step, or part of one. The smallest counts.

    Parameters
    ----------
    fields : sequence of Field
    time : Time
        Of the scene.

    Attributes
    ----------
    limited : bool
        Whether there is a stable step at all.
    limit : float
        A solid's, the one last found, s; inf at first.
    """

    def __init__(self, fields: Sequence[Field], time: Time) -> None:
        explicit = [field for field in fields if field.explicit]
        self._solid = next((field for field in explicit if isinstance(field, SolidField)), None)
        self._others = [field for field in explicit if not isinstance(field, SolidField)]
        self._scheme = time.integrator
        self.limited = bool(explicit)
        self._subcycles = time.above_limit == "subcycle"
        self.limit = math.inf
        self._steps, self._way, self._stretch = EVERY, 0.0, 0.0

    @property
    def divides(self) -> bool:
        """Whether a step may be divided."""
        return self.limited and self._subcycles

    def present(self) -> tuple[float, str]:
        """Return the stable step now, s, and whose it is. Collective."""
        found = [(field.stable_step(), f"the {field.name}") for field in self._others]
        if self._solid is not None:
            self._find()
            found.append((self.limit, self._scheme))
        return min(found)

    def count(self, t: float, dt: float) -> int:
        """Return into how many equal steps one of length dt that begins at t must be divided. Collective.

        Raises
        ------
        InputError
            At time zero, if it exceeds the stable step and the scene refuses that, or ``MOST`` of them.
        SolveError
            Later.
        """
        if not self.limited:
            return 1
        limit, whose = self.present()
        parts = dt / (MARGIN * limit) if limit > 0 else math.inf
        kind, length = (InputError, f"time.dt = {dt:g}") if t == 0 else (SolveError, f"a step of {dt:g} s")
        stable = f"{length}: the stable step of {whose} is {limit:.6g} s at t = {t:g} s"
        if self._subcycles:
            if not parts <= MOST:
                # no more than that where it is rounded
                most = 0.999 * MOST * MARGIN * limit
                raise kind(
                    f"{stable}, and a step is divided into {MOST:,} at most; set time.dt to {most:.4g} or less, or to "
                    '"auto"'
                )
            return max(1, math.ceil(parts))
        if not dt <= limit:
            raise kind(f'{stable}; set time.dt below it, or to "auto", or time.above_limit = "subcycle"')
        return 1

    def notes(self, t: float, dt: float) -> list[str]:
        """Say of how many parts the first step is, if these make it long. Collective; raises what ``count`` does."""
        number = self.count(t, dt)
        if number < MANY:
            return []
        return [
            f"a step of {dt:g} s is divided into {number:,} sub-steps, as the stable one asks for: the run speaks, and "
            "stops if told to, after all of them"
        ]

    def parts(self, t: float, dt: float) -> Iterator[tuple[float, float]]:
        """Divide a step of length dt that begins at t: yield begin and length of each part, to be taken then.

        They are equal as long as they stay below the stable step; once that has been found to be shorter, so are those
        that are left. Collective; raises what ``count`` does.
        """
        n, number = self.count(t, dt), 0
        while number < n:
            yield t + number * dt / n, dt / n
            number += 1
            if number < n and dt / n > (1 + SLACK) * MARGIN * self.present()[0]:
                t, dt = t + number * dt / n, dt * (n - number) / n
                n, number = self.count(t, dt), 0

    def _find(self) -> None:
        solid = self._solid
        assert solid is not None
        due = self._steps >= EVERY
        if not due and self._stretch + 2 * self._way / solid.finest > STRETCH:
            self._stretch, self._way = solid.stretch(), 0.0
            due = not self._stretch < STRETCH / 2
        if due:
            self.limit = solid.stable_step()
            self._steps, self._way, self._stretch = 0, 0.0, 0.0

    def moved(self, way: float) -> None:
        """Count a step, or a part of one, in which no node moved farther than ``way``, m."""
        if self._solid is not None and not self._solid.is_linear:
            self._steps, self._way = self._steps + 1, self._way + way

    def state(self, comm: MPI.Comm) -> dict[str, Slab]:
        """Return what tells when the stable step is found anew; the field keeps where it was found."""
        numbers = {"limit": self.limit, "steps": self._steps, "way": self._way, "stretch": self._stretch}
        return {name: scalar_slab(comm, value) for name, value in numbers.items()}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        limit, steps, way, stretch = (float(read(name, (0,), (1,))[0]) for name in ("limit", "steps", "way", "stretch"))
        for name, value in (("limit", limit), ("steps", steps), ("way", way), ("stretch", stretch)):
            if not 0 <= value <= (EXACT if name == "steps" else math.inf):  # every rank has read the same
                raise ValueError(f"'{name}' of the stable step is {value:g}")
        self.limit, self._steps, self._way, self._stretch = limit, int(steps), way, stretch
