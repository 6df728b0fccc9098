"""Euler's symplectic scheme, and how long its steps may be."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from petfsi.integrators.base import Integrator, Motion, Stage


class SymplecticEuler(Integrator):
    """Euler's symplectic scheme with a lumped mass: explicit, A is diagonal.

    With C = a0 M + a1 K', the force taken at the begin of the step and a0 implicit,

        ((1/h + a0) M) u^{n+1} = M u^n / h - K(d^n) - a1 K'(d^n) u^n + f(t^n),     d^{n+1} = d^n + h u^{n+1} .

    Stable for  omega h <= 2  without damping, else see ``stable_step``; there the energy stays within a bound that
    shrinks with h, for as long as one likes. Of first order: u^n is the velocity of t^n - h/2 to second order.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), sections I.1 and VI.3.
    """

    order: ClassVar[int] = 1
    explicit: ClassVar[bool] = True

    def factor(self, h: float, past_dt: float) -> float:
        """Return h."""
        return h

    def moment(self, h: float) -> float:
        """Return 0: the begin of the step."""
        return 0.0

    def instants(self, h: float) -> tuple[float, ...]:
        """Return both ends: w is the velocity in the middle of the step."""
        return (0.0, h)

    def stride(self, stage: Stage, h: float) -> float:
        """Return h."""
        return h

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation without damping, which who knows a1 adds by ``shift`` = a1 u^n."""
        u = motion.velocity
        return Stage(a=1 / h, k=0.0, inertia=u / h, tangent_at=motion.displacement, shift=np.zeros_like(u))

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return u^{n+1} = w and d^{n+1}."""
        return Motion(motion.displacement + h * w, w, (), h)

    def stable_step(self, eigenvalue: float, stiffness_damping: float) -> float:
        """Return 2/omega without damping.

        A mode of M^-1 K' = omega^2 with damping a1 K', whose explicit treatment costs some of the step, is stable while

            h^2 omega^2 + 2 h a1 omega^2 <= 4,    h = sqrt(a1^2 + 4/omega^2) - a1 .

        Implicit mass damping only helps.
        """
        if not eigenvalue > 0:
            return np.inf if eigenvalue <= 0 else 0.0
        span = 4 / eigenvalue
        # the difference of the two without cancellation
        return float(span / (stiffness_damping + np.sqrt(stiffness_damping**2 + span)))
