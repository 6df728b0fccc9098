"""What solids offer besides: a surface that fluids meet, and what the loop judges a step by."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from petfsi.fields.base import Field
from petfsi.fields.slabs import Reader, Slab
from petfsi.geometry.surfaces import Surface

#: How far from the origin solids may begin, and go, over their extent: round-off leaves seven digits of it.
FAR = 1e9


@dataclass(frozen=True)
class Landing:
    """How a solid's step brings its nodes to where they are at its end.

    Attributes
    ----------
    holds : bool
        Whether the step's equations hold there.
    stride : float
        How far the solution w moves the nodes, s.
    swings : bool
        See ``integrators.Integrator``.
    """

    holds: bool
    stride: float
    swings: bool


#: Forces on a solid's unknowns on this rank, flat, N, by the name of what they do in ``Work``.
Forces = dict[str, np.ndarray]


class SolidField(Field):
    """A solid: its unknowns are velocities, and its surface is where a fluid meets it.

    Attributes
    ----------
    names : list of str
        The bodies, in the order of the scene.
    owner : ndarray of int, shape (layout.n_local,)
        Which of them each unknown of this rank belongs to.
    extent : float
        Largest side of its bounding box at rest, m.
    moved : ndarray, shape (layout.n_local,)
        By how much this rank's nodes moved in the step last accepted, m.
    is_linear : bool
        Whether its tangent never changes, and neither does the stable step.
    acting : tuple of str
        The names in ``forces``, the same in every step and on every rank.
    warnings : sequence of str
        What a user should look at before it begins, the same on every rank.
    """

    elastic = True
    names: list[str]
    owner: np.ndarray
    extent: float
    moved: np.ndarray
    acting: tuple[str, ...] = ()
    warnings: Sequence[str] = ()
    is_linear: bool = False

    @property
    @abstractmethod
    def finest(self) -> float:
        """Length of its shortest edge at rest, m. Collective at first."""

    def judge(self, x: np.ndarray, dt: float) -> None:
        """Raise unless the solution x (SI) of a step of dt can be accepted. Collective.

        Raises
        ------
        SolveError
            On all ranks.
        """
        return

    def inside_out(self) -> str:
        """Return which body has an element inside out where equations were last taken that it does not stand.

        Nothing if none has. Collective.
        """
        return ""

    def volume_ratios(self) -> dict[str, float]:
        """Return by body how many times its volume at rest it encloses; without bodies that keep theirs. Collective."""
        return {}

    def remark(self, dt: float) -> str | None:
        """Return what a user should know of the step of dt last accepted, each thing once. Collective."""
        return None

    @abstractmethod
    def foreseen(self) -> np.ndarray:
        """Return the solution (SI) of the step last assembled as supports give it, elsewhere that of the last step."""

    @abstractmethod
    def predicted(self) -> float:
        """Return how far off the farthest of this rank's nodes is where the step's equations are taken, m.

        Between ``predict`` and ``accept``; along an axis.
        """

    @abstractmethod
    def unheld(self) -> list[str]:
        """Return what is wrong with bodies that nothing holds in statics, where the step is assembled. Collective."""

    @abstractmethod
    def stretch(self) -> float:
        """Return the largest change of an edge over its length since the last ``stable_step``. Collective."""

    @abstractmethod
    def along_axes(self, x: np.ndarray) -> np.ndarray:
        """Return the velocities along the axes of this rank's nodes from unknowns x (SI), shape (n, dim)."""

    @abstractmethod
    def take_mass(self, rows: tuple[np.ndarray, np.ndarray, np.ndarray] | None) -> None:
        """Add these rows (indptr, global columns, values, SI) to every block assembled from now on; None is nothing.

        They are what a surface moves besides the solid. Not collective; all ranks call it.
        """

    @abstractmethod
    def set_scale(self, reference_mass: float) -> None:
        """Measure rows against this mass, kg: that of a fluid cell."""

    @abstractmethod
    def light_motions(self, degree: int, density: float, most: int) -> np.ndarray:
        """Return polynomial motions of each body no denser than ``density`` (kg/m^3), shape (n, layout.n_local).

        Of the given degree, or of a smaller one so that there are at most ``most`` of them; else none.
        """

    @abstractmethod
    def surface(self) -> Surface:
        """Return the wet surface, the same on every rank; another object where its maps have changed. Collective."""

    @abstractmethod
    def surface_bodies(self) -> np.ndarray:
        """Return the body of each of its points as numbered in the scene, ascending in each part. Not collective."""

    @abstractmethod
    def surface_rooted(self) -> np.ndarray:
        """Return which of its points supports hold where they are, along all axes. Not collective."""

    @abstractmethod
    def surface_positions(self) -> np.ndarray:
        """Return the positions of its points, shape (n_points, dim), on every rank. Collective.

        Between ``predict`` and ``accept`` those at which the step's equations are taken, otherwise the present ones.
        """

    @abstractmethod
    def surface_present(self) -> np.ndarray:
        """Return the present positions of its points, shape (n_points, dim), on every rank. Collective."""

    @abstractmethod
    def surface_speed(self) -> np.ndarray:
        """Return w of the step last accepted, at first the velocity at the start, at the points of ``surface_present``.

        Shape (n_points, dim), m/s, on every rank. Collective.
        """

    @abstractmethod
    def surface_shift(self) -> np.ndarray:
        """Return how far its points are moved from ``surface_positions`` to where w = 0 leads. Collective.

        To first order, by the surface's maps, shape (n_points, dim), m; between ``predict`` and ``accept``.
        """

    @abstractmethod
    def surface_arrival(self, x: np.ndarray | None, dt: float) -> np.ndarray:
        """Return where its points are after a step of dt with the solution x (SI; None: zero). Collective.

        Shape (n_points, dim), on every rank.
        """

    @abstractmethod
    def jolt(self) -> np.ndarray | None:
        """Return what supports do to free unknowns that set off otherwise than the velocities given at the start.

        A right-hand side (SI, zero at held unknowns) to the step as assembled before it began, whose solution is what
        that changes at once; None, on all ranks, where supports and velocities agree, or where the step is explicit
        or has no inertia.
        """

    @abstractmethod
    def push(self, change: np.ndarray) -> None:
        """Change the present velocities by this much (SI, by unknown)."""

    @abstractmethod
    def landing(self, dt: float) -> Landing:
        """Return how a step of dt brings nodes to its end."""

    @abstractmethod
    def surface_velocity(self) -> np.ndarray:
        """Return the solution of the step last accepted at its points, shape (n_points, dim), on every rank.

        It is the velocity where the integrator takes the forces: at the end of the step, or in its middle. Collective.
        """

    @abstractmethod
    def fixed_velocity(self) -> np.ndarray:
        """Return what the step prescribes of its solution by unknown, zero where free, on every rank."""

    @abstractmethod
    def forces(self) -> Forces:
        """Return what acted from outside in the step last accepted, where the integrator took it. Collective.

        Gravity, loads, and the reactions of supports without what other fields do to them.
        """

    @abstractmethod
    def starting_forces(self) -> Forces:
        """Return the same of the present state at time zero, as far as it is known. Collective."""

    @abstractmethod
    def stored(self, name: str, x: np.ndarray) -> dict[str, Slab]:
        """Return a value per unknown on this rank as pieces of global arrays. Collective."""

    @abstractmethod
    def read_stored(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``stored`` gave, on any number of ranks. Collective."""

    @abstractmethod
    def probe(self, body: str, at: list[float], quantity: str) -> np.ndarray:
        """Return a quantity of the material point that was ``at`` at rest, the same on all ranks. Collective."""
