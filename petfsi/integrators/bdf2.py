"""The second backward differentiation formula."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from petfsi.integrators.base import Integrator, Motion, Stage, Turns


class Bdf2(Integrator):
    """The second backward differentiation formula for steps of any length, linearised once a step.

    With r = h_n / h_{n-1} and c = h (1 + r)/(1 + 2 r), the derivative of a quantity q at the end of the step is

        (q^{n+1} - b q^n + b' q^{n-1}) / c,     b = (1 + r)^2 / (1 + 2 r),  b' = r^2 / (1 + 2 r),

    for equal steps (3 q^{n+1} - 4 q^n + q^{n-1}) / 2h. Forces are linearised at d~ = d^n + r (d^n - d^{n-1}), which
    is within h^2 of the end, and so is what the linearisation leaves out within h^4. The first step is backward
    Euler's, about d~ = d^n + h u^n. Damps what is too fast for the step (L-stable).

    References
    ----------
    E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993), section III.5.
    """

    order: ClassVar[int] = 2
    past: ClassVar[tuple[str, ...]] = ("displacement_before", "velocity_before")

    def factor(self, h: float, past_dt: float) -> float:
        """Return c; 2h/3 for equal steps, h in the first one."""
        return h if past_dt == 0.0 else h * ((past_dt + h) / (past_dt + 2 * h))

    def weights(self, h: float, past_dt: float) -> tuple[float, float]:
        """Return b and b'; 4/3 and 1/3 for equal steps, 1 and 0 in the first one."""
        if past_dt == 0.0:
            return 1.0, 0.0
        r = h / past_dt
        return (1 + r) ** 2 / (1 + 2 * r), r**2 / (1 + 2 * r)

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation at the end of the step."""
        d, u = motion.displacement, motion.velocity
        c = self.factor(h, motion.past_dt)
        if motion.past_dt == 0.0:
            return Stage(a=1 / c, k=c, inertia=u / c, tangent_at=d + h * u, shift=-h * u)
        (before_d, before_u), (b, b_past) = motion.past, self.weights(h, motion.past_dt)
        ahead = d + h / motion.past_dt * (d - before_d)
        return Stage(
            a=1 / c,
            k=c,
            inertia=(b * u - b_past * before_u) / c,
            tangent_at=ahead,
            shift=b * d - b_past * before_d - ahead,
        )

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return what d~ lacks of where the body turns to."""
        if motion.past_dt == 0.0:
            return turns.setting_out(motion.displacement, motion.velocity, h)
        return turns.onward(motion.displacement, motion.past[0], h / motion.past_dt)

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return u^{n+1} = w and the d^{n+1} whose derivative it is."""
        d = stage.tangent_at + stage.shift + stage.k * w
        return Motion(d, w, (motion.displacement, motion.velocity), h)
