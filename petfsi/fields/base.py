"""What every field offers: unknowns, its diagonal block and right-hand side, and its state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.geometry.surfaces import Surface
from petfsi.petsc import Layout

#: How far from the origin solids may begin, and go, over their extent: round-off leaves seven digits of it.
FAR = 1e9


@dataclass(frozen=True)
class Slab:
    """One rank's contiguous piece of a global array that does not depend on the number of ranks.

    Attributes
    ----------
    data : ndarray
        The piece; ``data.ndim == len(shape)``.
    start : tuple of int
        Where it begins in the global array.
    shape : tuple of int
        The shape of the global array: cells or faces as ``(nx, ny[, nz])``, nodes as ``(n, dim)``.
    """

    data: np.ndarray
    start: tuple[int, ...]
    shape: tuple[int, ...]


#: By name the arrays of a state.
State = dict[str, Slab]


def held(state: State) -> Callable[[], State]:
    """Return what gives a state as it is now, whatever becomes of the arrays it was made of."""
    copy = {name: replace(slab, data=slab.data.copy()) for name, slab in state.items()}
    return lambda: copy


def scalar_slab(comm: MPI.Comm, value: float) -> Slab:
    """Return a number, the same on all ranks, as a global array of one entry that rank 0 owns."""
    mine = comm.rank == 0
    return Slab(np.array([value] if mine else []), (0 if mine else 1,), (1,))


@dataclass(frozen=True)
class Stock:
    """What a field holds, this rank's share.

    Attributes
    ----------
    momentum : ndarray, shape (dim,)
        kg m/s.
    kinetic, elastic : float
        J.
    """

    momentum: np.ndarray
    kinetic: float
    elastic: float = 0.0


@dataclass(frozen=True)
class Work:
    """What the last step's forces did, this rank's share, J; or do in a second, W.

    Attributes
    ----------
    gravity : float
        Done by gravity.
    damping : float
        Taken by damping.
    boundary : float
        Done, and brought along, by all that lies beyond: supports, inflows, open sides.
    loads : float
        Done by body forces and loads.
    """

    gravity: float = 0.0
    damping: float = 0.0
    boundary: float = 0.0
    loads: float = 0.0


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

#: Reads the piece ``[start, start + count)`` of the stored array of that name: ``read(name, start, count)``.
Reader = Callable[[str, tuple[int, ...], tuple[int, ...]], np.ndarray]


class Field(ABC):
    """Unknowns of one physical part, with their block of the coupled system.

    Attributes
    ----------
    name : str
        Index in the nest, options prefix and checkpoint group.
    has_block : bool
        Whether it has unknowns; without, it is left out of the system, and nothing that is said of unknowns holds.
    explicit, elastic : bool
        Whether its step is limited, see ``stable_step``; whether it stores energy.
    layout : Layout
        How its unknowns lie on the ranks; ``assemble`` may change it, and couplings and the system follow.
    diagonal : bool
        Whether the block has no entry off its diagonal.
    block : PETSc.Mat
        The diagonal block, AIJ, SI units; another object only where the layout has changed.
    rhs : ndarray, shape (layout.n_local,)
        Right-hand side, SI units; couplings may add to it between ``assemble`` and the solve.
    row_scale, col_scale : float
        The solver sees ``row_scale * block * col_scale`` and unknowns divided by ``col_scale``, so that all
        rows and unknowns are comparable numbers.
    is_linear : bool
        Whether its equations are linear in its unknowns.
    n_assembled : int
        How often the block was assembled.
    pattern_version : int
        Grows whenever the pattern of the block changes; the same on all ranks.
    """

    name: str
    has_block: bool = True
    explicit: bool = False
    elastic: bool = False
    diagonal: bool = False
    layout: Layout
    block: PETSc.Mat
    rhs: np.ndarray
    row_scale: float = 1.0
    col_scale: float = 1.0
    is_linear: bool = True
    n_assembled: int = 0
    pattern_version: int = 0

    @property
    def matrices(self) -> list[PETSc.Mat]:
        """What the solver scales: the block, and what stands for a part of it in preconditioners."""
        return [self.block]

    def unknown(self) -> np.ndarray:
        """Return the present values of the unknowns on this rank, SI: the first guess of the solve."""
        return np.zeros(0)

    @abstractmethod
    def predict(self, time: float, dt: float) -> None:
        """Do the explicit part of the step from ``time`` to ``time + dt``."""

    @abstractmethod
    def assemble(self, time: float, dt: float) -> None:
        """Refresh ``block`` (only if it changed), ``rhs`` and the scales for the step that begins at ``time``."""

    @abstractmethod
    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the solution (SI) of the step from ``time`` to ``time + dt`` and move all that moves with it."""

    def stable_step(self) -> float:
        """Return the longest stable step of an explicit scheme at the present state, s. Collective."""
        return math.inf

    def rewind(self) -> None:
        """Forget the step that ``predict`` began and that will not be accepted, as if it had not been tried."""
        return

    def linearised_at(self) -> np.ndarray:
        """Return the values (SI) at which ``block`` is the derivative: where Newton's method begins."""
        return self.unknown()

    def forget(self) -> None:  # noqa: B027 - most fields know nothing else
        """Forget what a resumed run could not know. Collective."""

    def round_off(self, x: np.ndarray) -> float:
        """Return what ``block @ x - rhs`` cannot fall below, eps ||block|| ||x||, in the solver's units. Collective.

        Parameters
        ----------
        x : ndarray, shape (layout.n_local,)
            SI.
        """
        comm = self.block.comm.tompi4py()
        length = float(np.sqrt(comm.allreduce(float(x @ x)))) / self.col_scale
        return float(np.finfo(float).eps) * self.block.norm(PETSc.NormType.NORM_INFINITY) * length

    def rhs_round_off(self) -> float:
        """Return the norm of the rounding in ``rhs``, in the solver's units, where its terms may cancel. Collective."""
        return 0.0

    def relinearise(self, x: np.ndarray) -> bool:
        """Let ``assemble`` linearise about these values (SI) until ``accept``; return whether that changes anything.

        ``block @ x - rhs`` is then the residual of the nonlinear equation at x. Interfaces stay where they are.
        """
        return False

    @abstractmethod
    def stock(self) -> Stock:
        """Return this rank's share of momentum and energy. Collective, without a reduction."""

    def work(self, dt: float) -> Work:
        """Return this rank's share of what was done in the whole step last accepted. Collective, without a reduction.

        Without that of ``power`` and of ``SolidField.forces``, of which who keeps the books makes work.
        """
        return Work()

    def power(self) -> Work:
        """Return this rank's share of the power where the integrator took the forces of the step last accepted, W.

        Collective, without a reduction.
        """
        return Work()

    @abstractmethod
    def output(self) -> dict[str, Slab]:
        """Return what pictures and other programs want to see."""

    @abstractmethod
    def state(self) -> State:
        """Return all that the next step reads. Collective."""

    def keep(self) -> Callable[[], State]:
        """Return what gives ``state`` of now, whatever steps are tried since. Collective, and so is what it returns."""
        return held(self.state())

    @abstractmethod
    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks."""


class FluidField(Field):
    """A fluid of whatever kind.

    Attributes
    ----------
    comm : MPI.Comm
        The ranks it lies on.
    density : float
        kg/m^3.
    cell_volume : float
        Volume of a typical cell, or of a particle at rest, m^3 (m^2 in 2D).
    extent : float
        The longest side of the box that it may fill, m.
    """

    comm: MPI.Comm
    density: float
    cell_volume: float
    extent: float

    @abstractmethod
    def probe(self, quantity: str, at: list[float]) -> float | np.ndarray:
        """Return a quantity at a point, the same on all ranks. Collective."""

    def force_on(self, wall: str) -> np.ndarray:
        """Return the force on a side or an obstacle, shape (dim,), N, the same on all ranks. Collective."""
        raise NotImplementedError

    def tally(self) -> dict[str, float]:
        """Return what of itself history.csv should say, always under the same names. Collective."""
        return {}

    @property
    def notes(self) -> list[str]:
        """What a user should know of how it begins."""
        return []

    def remark(self) -> str | None:
        """Return what a user should know of the step just taken, the same on all ranks; each is told once."""
        return None


class PressureFluid(FluidField):
    """A fluid whose unknown is the pressure, and whose row of the system is the net outflow of a cell.

    Attributes
    ----------
    geometry_version : int
        Grows whenever cells or faces change their kind; the same on all ranks.
    n_cells : int
        So many of this rank's unknowns, the first ones, are there for the whole run; the others come and go.
    fluxes : PETSc.Mat
        What the block consists of for the most part, with a pattern that seldom changes: what preconditioners are made
        of. May be the block itself. ``pattern_version`` is its.
    source : ndarray or None
        By unknown, what comes into cells from nowhere, m^3/s (m^2/s in 2D): ``assemble`` adds it to ``rhs``.
    """

    dim: int
    n_cells: int
    fluxes: PETSc.Mat
    geometry_version: int = 0
    source: np.ndarray | None = None

    @property
    def matrices(self) -> list[PETSc.Mat]:
        """The block and the fluxes, if they are not the same."""
        return [self.block] if self.fluxes is self.block else [self.block, self.fluxes]

    @abstractmethod
    def closed_regions(self, touched: np.ndarray | None) -> list[tuple[np.ndarray, bool]]:
        """Return each connected region without an open face, and whether it has any of the ``touched`` unknowns.

        A region is given by 1 on its unknowns and 0 elsewhere, this rank's part of a pressure vector. Collective.
        """

    @abstractmethod
    def volumes(self) -> np.ndarray:
        """Return the volume of fluid that belongs to each of this rank's unknowns, m^3 (m^2 in 2D)."""

    @abstractmethod
    def inflow(self) -> np.ndarray | None:
        """Return by unknown what the step lets in through sides with a given velocity; None if there are none."""

    @abstractmethod
    def net_outflow(self) -> np.ndarray:
        """Return by unknown what leaves it at the present velocity but through solids' walls, m^3/s (m^2/s in 2D)."""

    @abstractmethod
    def push(self, x: np.ndarray, dt: float) -> None:
        """Change the present velocity as the pressure x (SI) would in a first step of dt. Collective."""

    @abstractmethod
    def inflows(self) -> dict[str, np.ndarray]:
        """Return what ``inflow`` does by the key of each side that lets anything in. Not collective."""

    @abstractmethod
    def rehearse(self, time: float, dt: float) -> None:
        """Give sides the velocities of a step of dt from ``time``, of none (0) those at that time. Collective."""

    @abstractmethod
    def place(self, member: np.ndarray) -> str:
        """Return where some of the unknowns are, for people; they are those that are not zero here. Collective."""

    @abstractmethod
    def cells_slab(self, values: np.ndarray) -> Slab:
        """Return a value per lasting unknown, shape (n_cells,), as a piece of a global array."""

    @abstractmethod
    def read_cells(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``cells_slab`` stored, shape (n_cells,), on any number of ranks."""


class SolidField(Field):
    """A solid: its unknowns are velocities, and its surface is where a fluid meets it.

    Attributes
    ----------
    names : list of str
        The bodies, in the order of the scene.
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
