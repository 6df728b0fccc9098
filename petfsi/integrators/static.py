"""No inertia: a run through equilibria."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from petfsi.integrators.base import Integrator, Motion, Stage


class Static(Integrator):
    """Equilibrium at the end of each step: no inertia; time is the parameter of the loads.

        K(d~) + K'(d~) (d^n + h w - d~) = f(t^n + h),     d^{n+1} = d^n + h w,     u = 0,

    linearised about d~ = d^n unless Newton's method goes on from there. w is the rate of the equilibrium.
    """

    order: ClassVar[int] = 1
    past: ClassVar[tuple[str, ...]] = ("rate",)
    inertia: ClassVar[bool] = False

    def factor(self, h: float, past_dt: float) -> float:
        """Return infinity: nothing resists being accelerated."""
        return np.inf

    def instants(self, h: float) -> tuple[float, ...]:
        """Return both ends: the mean brings a prescribed node to within the trapezoidal rule of its place."""
        return (0.0, h)

    def stride(self, stage: Stage, h: float) -> float:
        """Return h."""
        return h

    def solved(self, motion: Motion) -> np.ndarray:
        """Return the rate of the last step."""
        return motion.past[0] if motion.past_dt else np.zeros_like(motion.velocity)

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equilibrium at the end of the step."""
        d = motion.displacement
        return Stage(a=0.0, k=h, inertia=np.zeros_like(d), tangent_at=d, shift=np.zeros_like(d))

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the new equilibrium, at rest."""
        return Motion(motion.displacement + h * w, np.zeros_like(w), (w,), h)
