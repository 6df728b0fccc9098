"""Newmark's scheme, as published."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from petfsi.integrators.base import Integrator, Motion, Stage, Turns


class Newmark(Integrator):
    """Newmark's scheme with beta = 1/2, gamma = 1, linearised once a step.

    With C = a0 M + a1 K', all of M, K' = dK/dd and K taken at d^n,

        (M/h + C + h/2 K') u^{n+1} - J p^{n+1} = (M/h - h/2 K') u^n - K(d^n) + f_e^{n+1},
        d^{n+1} = d^n + h/2 (u^n + u^{n+1}).

    Where a body turns, by ``turned``, K and K' are taken at d~, which is d^n turned as far as the body goes on to do
    in the step, and K(d^n) becomes K(d~) + K' (d^n - d~): the same equation, linearised elsewhere.

    References
    ----------
    N. Chentanez, T. G. Goktekin, B. E. Feldman, J. F. O'Brien, Simultaneous coupling of fluids and deformable
    bodies (2006), eqs. 4, 5 and 12-18.
    """

    order: ClassVar[int] = 1
    swings: ClassVar[bool] = True

    def factor(self, h: float, past_dt: float) -> float:
        """Return h."""
        return h

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return eq. 18."""
        d, u = motion.displacement, motion.velocity
        return Stage(a=1 / h, k=h / 2, inertia=u / h, tangent_at=d, shift=h / 2 * u)

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return by how much d^n turns in the step: d~ goes nowhere else."""
        return turns.in_place(motion.displacement, motion.velocity, h)

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return u^{n+1} = w and d^{n+1} of eq. 12."""
        return Motion(motion.displacement + h / 2 * (motion.velocity + w), w, (), h)
