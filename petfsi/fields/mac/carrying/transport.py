"""How a fluid's velocity and smoke are carried along: one scheme for each integrator.

Every scheme gives the velocity v* of which the pressure makes the step's solution, with c = 1/a of the integrator,

    v_w = v* - (c/rho) G p,     v* = (what is carried to the faces) + c g,

and v_w is the velocity at the instant where the integrator takes the forces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from petfsi.fields.mac.carrying.advection import Advection
from petfsi.fields.mac.carrying.paths import Path
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces, each
from petfsi.integrators.base import Integrator
from petfsi.integrators.bdf2 import Bdf2
from petfsi.integrators.midpoint import Midpoint
from petfsi.integrators.newmark import Newmark

#: Fills ghosts, and faces without a velocity of their own; returns what is to be read of the arrays. Collective.
Extend = Callable[[Faces], Faces]


class Transport:
    """First order, for every scheme that has none of its own:  v*(x) = v^n(x_d), where x_d comes to x along v^n.

    Parameters
    ----------
    advection : Advection
    integrator : Integrator

    Attributes
    ----------
    carried : list of ndarray
        The velocity at the step's begin as it is read here, ghosts valid: extrapolated, where it cannot be known well,
        from where it can.
    past : dict of str to list of ndarray
        Face arrays alike that the next step reads besides; not read while ``past_dt`` is zero.
    past_dt : float
        Length of the last step, s; zero before the first.
    """

    names: tuple[str, ...] = ()

    def __init__(self, advection: Advection, integrator: Integrator) -> None:
        self.integrator = integrator
        self.advection = advection
        self.grid = advection.grid
        self.carried = Faces([])
        self.past: dict[str, Faces] = {
            name: Faces(self.grid.zeros_faces(axis) for axis in range(self.grid.dim)) for name in self.names
        }
        self.past_dt = 0.0
        self._before = self.carried, self.past
        self._whole: Path | None = None  # of the step being predicted, where it was needed

    def factor(self, dt: float) -> float:
        """Return c, s."""
        return self.integrator.factor(dt, self.past_dt)

    def moment(self, dt: float) -> float:
        """Return how long after the step's begin v_w holds, s."""
        return self.integrator.moment(dt)

    def instants(self, time: float, dt: float) -> list[float]:
        """Return the times, s, over which v_w of a prescribed velocity is the mean: the same as of solids' supports."""
        return [time + later for later in self.integrator.instants(dt)]

    def solved(self, velocity: Faces) -> Faces:
        """Return v_w of the step last accepted, which has no divergence, given the velocity at its end."""
        return velocity

    def kicked(self, velocity: Faces) -> Faces:
        """Return what that step's forces left, whose energy they changed, given the velocity at its end."""
        return velocity

    def half_way(self, dt: float) -> Faces:
        """Return the flow that carries from the step's begin to its end."""
        return self.carried

    def predict(self, moved: list[np.ndarray], dt: float, star: Faces, extend: Extend) -> None:
        """Write what is carried to the owned faces into ``star``. Collective."""
        self._whole = self.advection.path(self.half_way(dt), dt)
        self.advection.carry_faces(self.carried, self._whole, moved, star)

    def carry_smoke(
        self, smoke: np.ndarray, extras: np.ndarray, moved: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoke at the end of the step that was predicted, see ``Advection.carry_smoke``. Collective."""
        path = self._whole or self.advection.path(self.half_way(dt), dt)
        return self.advection.carry_smoke(smoke, extras, path, moved)

    def read(self) -> list[Faces]:
        """Return all that the coming step reads."""
        return [self.carried, *self.past.values()]

    def remember(self) -> None:
        """Keep what ``rewind`` puts back."""
        self._before = self.carried, dict(self.past)

    def rewind(self) -> None:
        """Put all that this step has read back, as if it had not been tried."""
        self.carried, self.past = self._before

    def change(self, change: Callable[[Faces], Faces]) -> None:
        """Replace all that the next step reads."""
        self.carried = change(self.carried)
        self.past = {name: change(faces) for name, faces in self.past.items()}

    def accept(self, solved: Faces, kind: list[np.ndarray], dt: float, extend: Extend) -> Faces:
        """Return the velocity at the step's end, and remember what the next one reads. Collective.

        Parameters
        ----------
        solved : list of ndarray
            v_w on owned faces; ghosts, and faces without a velocity of their own, are filled.
        kind : list of ndarray of uint8
            Of the faces.
        dt : float
            s.
        extend : callable
        """
        self.carried, self.past_dt = extend(solved), dt
        return solved


class Bdf2Transport(Transport):
    """Second order, for BDF2:  v*(x) = b v^n(x_d) - b' v^{n-1}(x_dd) + c g  with b, b' and c of ``Bdf2``.

    For equal steps (4 v^n(x_d) - v^{n-1}(x_dd))/3. Both points come to x in straight time, from t^n and from
    t^{n-1}, along the velocity on the line through v^{n-1} and v^n at the middle of either span. The first step is
    of first order.

    References
    ----------
    D. Xiu, G. E. Karniadakis, A semi-Lagrangian high-order method for Navier-Stokes equations (2001), section 2.
    """

    names = ("velocity_before",)

    def __init__(self, advection: Advection, integrator: Bdf2) -> None:
        super().__init__(advection, integrator)
        self.scheme = integrator

    def half_way(self, dt: float) -> Faces:
        """Return the velocity at t^n + dt/2."""
        return self._at(dt / 2)

    def _at(self, later: float) -> Faces:
        """Return the velocity a time after t^n, on the line through v^{n-1} and v^n."""
        if self.past_dt == 0.0 or later == 0.0:
            return self.carried
        s = later / self.past_dt
        return each(lambda v, before: v + s * (v - before), self.carried, self.past["velocity_before"])

    def predict(self, moved: list[np.ndarray], dt: float, star: Faces, extend: Extend) -> None:
        """Write b v^n(x_d) - b' v^{n-1}(x_dd) into the owned part of ``star``. Collective."""
        super().predict(moved, dt, star, extend)
        if self.past_dt == 0.0:
            return
        b, b_past = self.scheme.weights(dt, self.past_dt)
        far = self.advection.path(self._at((dt - self.past_dt) / 2), dt + self.past_dt)
        carried = Faces(np.empty_like(v) for v in star)
        self.advection.carry_faces(self.past["velocity_before"], far, moved, carried)
        for axis, v in enumerate(star):
            own = self.grid.owned(axis)
            v[own] = b * v[own] - b_past * carried[axis][own]
        star.parts = b * star.parts - b_past * carried.parts

    def accept(self, solved: Faces, kind: list[np.ndarray], dt: float, extend: Extend) -> Faces:
        """Return v_w; the old velocity becomes the one before."""
        self.past["velocity_before"] = self.carried
        return super().accept(solved, kind, dt, extend)


class MidpointTransport(Transport):
    """Second order, for the midpoint rule: half a step of transport, a whole kick, half a step of transport.

    Two halves with no kick between them are one, from the middle of a step, where v'' is what the last kick left, to
    that of the next:

        v'(x) = v''(x_d),    v_w = v' + (h/2)(g - G p / rho),    v'' = 2 v_w - v' .

    Paths, and the velocity that others see at the ends of steps, lie on the line through the last two v_w. Where a
    face has its velocity given, v'' is the one at the step's end. Faces that others do not read keep their own v'' as
    far as it has not flowed on, or transport would take energy where nothing moves.

    References
    ----------
    G. Strang, On the construction and comparison of difference schemes (1968).
    """

    names = ("velocity_middle", "velocity_kicked")

    def __init__(self, advection: Advection, integrator: Midpoint) -> None:
        super().__init__(advection, integrator)
        self.scheme = integrator
        self._start = Faces([])
        self._read: Faces | None = None  # v'' as others read it
        self._last: tuple[Faces, Faces] | None = None

    def solved(self, velocity: Faces) -> Faces:
        """Return the velocity in the middle of the step last accepted."""
        return velocity if self._last is None else self._last[0]

    def kicked(self, velocity: Faces) -> Faces:
        """Return v'' of the step last accepted."""
        return velocity if self._last is None else self._last[1]

    def half_way(self, dt: float) -> Faces:
        """Return the velocity in the middle of the coming step."""
        return self._at(dt / 2)

    def _at(self, later: float) -> Faces:
        """Return the velocity a time after t^n, on the line through that and the middle of the last step."""
        return each(
            lambda v, w: self.scheme.later(v, w, later, self.past_dt), self.carried, self.past["velocity_middle"]
        )

    def predict(self, moved: list[np.ndarray], dt: float, star: Faces, extend: Extend) -> None:
        """Write v' into the owned part of ``star``, and keep it for the kick. Collective."""
        between = (self.past_dt + dt) / 2
        path = self.advection.path(self._at((dt - self.past_dt) / 4), between)
        own = self.past["velocity_kicked"] if self.past_dt else self.carried
        if self._read is None:  # a run that is resumed
            self._read = extend(each(np.copy, own)) if self.past_dt else own
        kept = self.advection.carry_faces(self._read, path, moved, star, own)
        for axis, v in enumerate(self._read):
            read = np.where(kept[axis], own[axis], v)
            self.advection.keep_own(own[axis], read, path, axis, star[axis])
        self._start = each(np.copy, star)

    def read(self) -> list[Faces]:
        """Return all that the coming step reads."""
        return super().read() if self._read is None else [*super().read(), self._read]

    def change(self, change: Callable[[Faces], Faces]) -> None:
        """Replace all that the next step reads, and what this one has begun with."""
        super().change(change)
        if self._start:
            self._start = change(self._start)

    def accept(self, solved: Faces, kind: list[np.ndarray], dt: float, extend: Extend) -> Faces:
        """Return the velocity at the step's end. Collective."""
        before = self.past["velocity_middle"] if self.past_dt else self.carried
        middle = extend(solved)
        ahead = each(lambda w, b: self.scheme.ahead(w, b, dt, self.past_dt), solved, before)
        self.carried = extend(ahead)
        kicked = each(lambda w, start: 2 * w - start, solved, self._start)
        for v, end, k in zip(kicked, ahead, kind, strict=True):
            np.copyto(v, end, where=(k == kinds.WALL) | (k == kinds.SOLID_FACE))
        self._read = extend(kicked)
        self.past = {"velocity_middle": middle, "velocity_kicked": kicked}
        self.past_dt, self._start, self._last = dt, Faces([]), (solved, kicked)
        return ahead


def transport(integrator: Integrator, advection: Advection) -> Transport:
    """Return what carries a fluid for a scheme, or one made of it."""
    if isinstance(integrator, Bdf2):
        return Bdf2Transport(advection, integrator)
    if isinstance(integrator, Midpoint):
        return MidpointTransport(advection, integrator)
    # a fluid is never explicit: its pressure holds at the step's end
    return Transport(advection, Newmark() if integrator.explicit else integrator)
