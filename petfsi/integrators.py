"""Time integrators: what turns M, C, K, K' and history into one linear system a step, for solids and fluids alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from petfsi.registry import INTEGRATORS, find


@dataclass(frozen=True)
class Motion:
    """Where a solid's nodes are, how fast they move, and what a scheme remembers of earlier steps.

    Attributes
    ----------
    displacement, velocity : ndarray, shape (n, dim)
        m, m/s.
    past : tuple of ndarray, shape (n, dim)
        By the scheme's ``past``; not read while ``past_dt`` is zero.
    past_dt : float
        Length of the last step, s; zero before the first.
    """

    displacement: np.ndarray
    velocity: np.ndarray
    past: tuple[np.ndarray, ...] = ()
    past_dt: float = 0.0


@dataclass(frozen=True)
class Stage:
    """The equation of one step for w, a velocity at the instant where the forces are taken.

        M (a w - V0) + C w + K(d~) + K'(d~) (D0 + k w - d~) = f

    Attributes
    ----------
    a, k : float
        1/s, s.
    inertia : ndarray, shape (n, dim)
        V0, m/s^2.
    tangent_at : ndarray, shape (n, dim)
        d~, the displacement at which forces are linearised and fluid and solid meet, m.
    shift : ndarray, shape (n, dim)
        D0 - d~, m.
    """

    a: float
    k: float
    inertia: np.ndarray
    tangent_at: np.ndarray
    shift: np.ndarray


class Turns(Protocol):
    """What knows how a body turns, see ``fields.solid.turning``: by how much its first unknowns, or all, move."""

    def onward(self, d: np.ndarray, before: np.ndarray, ratio: float) -> np.ndarray:
        """Return what the prediction d + ratio (d - before) lacks, m."""
        ...

    def setting_out(self, d: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        """Return what the prediction d + h u lacks, m."""
        ...

    def in_place(self, d: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        """Return by how much d turns in h, m, without what else it does."""
        ...


class Integrator(Protocol):
    """What a scheme offers; ``h`` is the length of the coming step, ``past_dt`` that of the last one (0: none)."""

    @property
    def order(self) -> int:
        """The order of accuracy in the time step that it keeps."""
        ...

    @property
    def past(self) -> tuple[str, ...]:
        """The names of the arrays in ``Motion.past``."""
        ...

    @property
    def explicit(self) -> bool:
        """Whether k = 0, and the mass lumped, so that A is diagonal and a step beyond the stable one grows."""
        ...

    @property
    def swings(self) -> bool:
        """Whether a step's end depends on the last w as on the next, so that w may swing about what leads there."""
        ...

    def factor(self, h: float, past_dt: float) -> float:
        """Return 1/a, s: an acceleration acts so long on w, and the pressure's gradient on the fluid's velocity."""
        ...

    def moment(self, h: float) -> float:
        """Return how long after the step's begin its equations hold, s."""
        ...

    def instants(self, h: float) -> tuple[float, ...]:
        """Return the times after the step's begin (s) over which w of a prescribed velocity is the mean."""
        ...

    def stride(self, stage: Stage, h: float) -> float:
        """Return how far w moves the nodes until the end of the step, s: k where w holds at the end."""
        ...

    def solved(self, motion: Motion) -> np.ndarray:
        """Return w of the last step; before the first the velocity."""
        ...

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation of the coming step."""
        ...

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return what turning adds to the first components of the d~ of ``stage``, m; None is nothing.

        A straight way swells a body that turns by the square of the angle, and its stiffness makes that a force.
        """
        ...

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the motion at the end of the step from the solution of its equation."""
        ...


@dataclass(frozen=True)
class Newmark:
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
    past: ClassVar[tuple[str, ...]] = ()
    explicit: ClassVar[bool] = False
    swings: ClassVar[bool] = True

    def factor(self, h: float, past_dt: float) -> float:
        """Return h."""
        return h

    def moment(self, h: float) -> float:
        """Return h: the end of the step."""
        return h

    def instants(self, h: float) -> tuple[float, ...]:
        """Return the end of the step."""
        return (h,)

    def stride(self, stage: Stage, h: float) -> float:
        """Return k."""
        return stage.k

    def solved(self, motion: Motion) -> np.ndarray:
        """Return u^n."""
        return motion.velocity

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


@dataclass(frozen=True)
class Bdf2:
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
    explicit: ClassVar[bool] = False
    swings: ClassVar[bool] = False

    def factor(self, h: float, past_dt: float) -> float:
        """Return c; 2h/3 for equal steps, h in the first one."""
        return h if past_dt == 0.0 else h * ((past_dt + h) / (past_dt + 2 * h))

    def weights(self, h: float, past_dt: float) -> tuple[float, float]:
        """Return b and b'; 4/3 and 1/3 for equal steps, 1 and 0 in the first one."""
        if past_dt == 0.0:
            return 1.0, 0.0
        r = h / past_dt
        return (1 + r) ** 2 / (1 + 2 * r), r**2 / (1 + 2 * r)

    def moment(self, h: float) -> float:
        """Return h: the end of the step."""
        return h

    def instants(self, h: float) -> tuple[float, ...]:
        """Return the end of the step."""
        return (h,)

    def stride(self, stage: Stage, h: float) -> float:
        """Return k."""
        return stage.k

    def solved(self, motion: Motion) -> np.ndarray:
        """Return u^n."""
        return motion.velocity

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


@dataclass(frozen=True)
class Midpoint:
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
    past: ClassVar[tuple[str, ...]] = ("velocity_middle", "velocity_ahead")
    explicit: ClassVar[bool] = False
    swings: ClassVar[bool] = False

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

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return None: the middle of the way is within h^3 of where a turning body's nodes are taken to be."""
        return None

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the end of the step."""
        ahead = self.ahead(w, self.solved(motion), h, motion.past_dt)
        return Motion(motion.displacement + h * w, 2 * w - motion.velocity, (w, ahead), h)


@dataclass(frozen=True)
class SymplecticEuler:
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
    past: ClassVar[tuple[str, ...]] = ()
    explicit: ClassVar[bool] = True
    swings: ClassVar[bool] = False

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

    def solved(self, motion: Motion) -> np.ndarray:
        """Return u^n."""
        return motion.velocity

    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation without damping, which who knows a1 adds by ``shift`` = a1 u^n."""
        u = motion.velocity
        return Stage(a=1 / h, k=0.0, inertia=u / h, tangent_at=motion.displacement, shift=np.zeros_like(u))

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return None: forces are taken where the body is."""
        return None

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return u^{n+1} = w and d^{n+1}."""
        return Motion(motion.displacement + h * w, w, (), h)


def stable_step(eigenvalue: float, stiffness_damping: float) -> float:
    """Return the longest stable step of ``SymplecticEuler``, s.

    A mode of M^-1 K' = omega^2 with damping a1 K', whose explicit treatment costs some of the step, is stable while

        h^2 omega^2 + 2 h a1 omega^2 <= 4,    h = sqrt(a1^2 + 4/omega^2) - a1 .

    Implicit mass damping only helps.

    Parameters
    ----------
    eigenvalue : float
        The largest omega^2, 1/s^2; inf if nothing is pulled.
    stiffness_damping : float
        a1, s.
    """
    if not eigenvalue > 0:
        return np.inf if eigenvalue <= 0 else 0.0
    span = 4 / eigenvalue
    # the difference of the two without cancellation
    return float(span / (stiffness_damping + np.sqrt(stiffness_damping**2 + span)))


@dataclass(frozen=True)
class Static:
    """Equilibrium at the end of each step: no inertia; time is the parameter of the loads.

        K(d~) + K'(d~) (d^n + h w - d~) = f(t^n + h),     d^{n+1} = d^n + h w,     u = 0,

    linearised about d~ = d^n unless Newton's method goes on from there. w is the rate of the equilibrium.
    """

    order: ClassVar[int] = 1
    past: ClassVar[tuple[str, ...]] = ("rate",)
    explicit: ClassVar[bool] = False
    swings: ClassVar[bool] = False

    def factor(self, h: float, past_dt: float) -> float:
        """Return infinity: nothing resists being accelerated."""
        return np.inf

    def moment(self, h: float) -> float:
        """Return h: the end of the step."""
        return h

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

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return None: nothing turns by itself."""
        return None

    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the new equilibrium, at rest."""
        return Motion(motion.displacement + h * w, np.zeros_like(w), (w,), h)


def relinearised(stage: Stage, w: np.ndarray) -> Stage:
    """Return the same equation, linearised where the solution w brings the nodes: Newton's iterate.

    d~ = D0 + k w and D0 - d~ = -k w, so that  A w - b  is the residual of the nonlinear equation at w.
    """
    move = stage.k * w
    return Stage(stage.a, stage.k, stage.inertia, stage.tangent_at + stage.shift + move, -move)


def moved(stage: Stage, by: np.ndarray) -> Stage:
    """Return the same equation, linearised elsewhere: the first components of d~ are moved by so much."""
    way = np.zeros_like(stage.tangent_at)
    way[:, : by.shape[1]] = by
    return replace(stage, tangent_at=stage.tangent_at + way, shift=stage.shift - way)


def named(name: str) -> Integrator:
    """Return the scheme that the scene's ``time.integrator`` names."""
    scheme: Integrator = find(INTEGRATORS[name])()
    return scheme
