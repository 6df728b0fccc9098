"""What a time integrator offers: M, C, K, K' and history make one linear system a step, for solids and fluids alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
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


class Integrator(ABC):
    """A scheme; ``h`` is the length of the coming step, ``past_dt`` that of the last one (0: none).

    Attributes
    ----------
    order : int
        The order of accuracy in the time step that it keeps.
    past : tuple of str
        The names of the arrays in ``Motion.past``.
    explicit : bool
        Whether k = 0, and the mass lumped, so that A is diagonal and a step beyond the stable one grows.
    inertia : bool
        Whether anything resists being accelerated.
    damps : bool
        Whether it damps what is too fast for the step.
    swings : bool
        Whether a step's end depends on the last w as on the next, so that w may swing about what leads there.
    """

    order: ClassVar[int]
    past: ClassVar[tuple[str, ...]] = ()
    explicit: ClassVar[bool] = False
    inertia: ClassVar[bool] = True
    damps: ClassVar[bool] = True
    swings: ClassVar[bool] = False

    @abstractmethod
    def factor(self, h: float, past_dt: float) -> float:
        """Return 1/a, s: an acceleration acts so long on w, and the pressure's gradient on the fluid's velocity."""

    @abstractmethod
    def stage(self, motion: Motion, h: float) -> Stage:
        """Return the equation of the coming step."""

    @abstractmethod
    def finish(self, motion: Motion, stage: Stage, w: np.ndarray, h: float) -> Motion:
        """Return the motion at the end of the step from the solution of its equation."""

    # of a scheme whose w is the velocity at the end of the step, where its equations hold

    def moment(self, h: float) -> float:
        """Return how long after the step's begin its equations hold, s."""
        return h

    def instants(self, h: float) -> tuple[float, ...]:
        """Return the times after the step's begin (s) over which w of a prescribed velocity is the mean."""
        return (h,)

    def stride(self, stage: Stage, h: float) -> float:
        """Return how far w moves the nodes until the end of the step, s: k where w holds at the end."""
        return stage.k

    def solved(self, motion: Motion) -> np.ndarray:
        """Return w of the last step; before the first the velocity."""
        return motion.velocity

    def turned(self, motion: Motion, h: float, turns: Turns) -> np.ndarray | None:
        """Return what turning adds to the first components of the d~ of ``stage``, m; None is nothing.

        A straight way swells a body that turns by the square of the angle, and its stiffness makes that a force.
        """
        return None

    def stable_step(self, eigenvalue: float, stiffness_damping: float) -> float:
        """Return the longest stable step of an explicit scheme, s.

        Parameters
        ----------
        eigenvalue : float
            The largest of M^-1 K', 1/s^2; inf if it is not known.
        stiffness_damping : float
            a1 of C = a0 M + a1 K', s.
        """
        return np.inf


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


def integrator(name: str) -> Integrator:
    """Return the scheme that a scene's ``time.integrator`` names."""
    return find(INTEGRATORS[name])()
