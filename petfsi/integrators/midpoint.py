"""The implicit midpoint rule."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from petfsi.integrators.base import Integrator, Motion, Stage


class Midpoint(Integrator):
    """The implicit midpoint rule, linearised once a step; w is the velocity half-way.

        M 2 (w - u^n)/h + C w + K(d~) + K'(d~) (d^n + h/2 w - d~) = f(t^n + h/2),
        u^{n+1} = 2 w - u^n,   d^{n+1} = d^n + h w.

    Without damping it keeps a quadratic energy, and damps nothing else either. d~ = d^n + h/2 w~ takes w~ on the
    line through the last two w, because u^n swings about it where a mode is too fast for the step.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), sections II.1 and IV.2.
    """

    order: ClassVar[int] = 2
    damps: ClassVar[bool] = False
    past: ClassVar[tuple[str, ...]] = ("velocity_middle", "velocity_ahead")

    def factor(self, h: float, past_dt: float) -> float:
        """Return h/2."""
        return h / 2

    def moment(self, h: float) -> float:
        """Return h/2: the middle of the step."""
        return h / 2

    def instants(self, h: float) -> tuple[float, ...]:
        """Return both ends: their mean as w brings a prescribed node to its velocity at the end exactly."""
        return (0.0, h)

    def ahead(self, w: np.ndarray, w_before: np.ndarray, h: float, past_dt: float) -> np.ndarray:
        """Return the velocity at the step's end, on the line through those at the middles of it and the step before.

        Before the first step the earlier one is that at its begin.
        """
        return w + h / (h + past_dt) * (w - w_before)

    def later(self, ahead: np.ndarray, w: np.ndarray, span: float, past_dt: float) -> np.ndarray:
        """Return the velocity a time ``span`` after the end of the last step, on the line from its middle to its end.

        Parameters
        ----------
        ahead, w : ndarray
            At the last step's end and in its middle.
        span, past_dt : float
            s; the second is the last step's length, zero before the first.
        """
        return ahead if past_dt == 0.0 or span == 0.0 else ahead + 2 * span / past_dt * (ahead - w)

    def stride(self, stage: Stage, h: float) -> float:
        """Return h."""
        return h

    def solved(self, motion: Motion) -> np.ndarray:
        """Return the velocity in the middle of the last step."""
        return motion.past[0] if motion.past_dt else motion.velocity

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation in the middle of the step."""
        d, u = motion.displacement, motion.velocity
        w, ahead = motion.past if motion.past_dt else (u, u)
        step = h / 2 * self.later(ahead, w, h / 2, motion.past_dt)
        return Stage(a=2 / h, k=h / 2, inertia=2 / h * u, tangent_at=d + step, shift=-step)

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the end of the step."""
        ahead = self.ahead(w, self.solved(motion), h, motion.past_dt)
        return Motion(motion.displacement + h * w, 2 * w - motion.velocity, (w, ahead), h)
