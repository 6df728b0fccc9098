"""How a fluid's velocity and smoke are carried along: one scheme for each integrator.

Every scheme gives the velocity v* of which the pressure makes the step's solution, with c = 1/a of the integrator,

    v_w = v* - (c/rho) G p,     v* = (what is carried to the faces) + c g,

and v_w is the velocity at the instant where the integrator takes the forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.mac import advect, kinds
from petfsi.fields.mac.faces import Faces, each
from petfsi.fields.mac.grid import MacGrid, three
from petfsi.fields.mac.sheets import Sheets
from petfsi.fields.mac.sides import Surroundings
from petfsi.integrators import Bdf2, Midpoint, Newmark

#: Cells that the flow may cross in one sweep: with the half cell of staggering and the stencil, all within the ghosts.
MAX_COURANT = {"linear": 4.0, "cubic": 3.0}
#: Times that it may cross the whole grid in one step; more is no flow any longer.
MAX_CROSSINGS = 10

#: Fills ghosts, and faces without a velocity of their own; returns what is to be read of the arrays. Collective.
Extend = Callable[[Faces], Faces]


@dataclass(frozen=True)
class Path:
    """A flow that stands still for a time, in sweeps that are short enough.

    Attributes
    ----------
    velocity : Faces
        Ghosts valid.
    span : float
        How long it carries, s.
    sweeps : int
    crossed : int
        Cells that no sweep goes beyond.
    """

    velocity: Faces
    span: float
    sweeps: int
    crossed: int


class Advection:
    """Carries arrays along paths; what differs between the schemes is where and how long.

    Parameters
    ----------
    grid : MacGrid
    surroundings : Surroundings
        Know what smoke comes in.
    interpolation : str
        ``cubic`` or ``linear``.

    Attributes
    ----------
    sheets : Sheets or None
        Carry what lies near sheets; None where nothing cuts cells.
    """

    def __init__(self, grid: MacGrid, surroundings: Surroundings, interpolation: str) -> None:
        self.grid, self.surroundings = grid, surroundings
        self.sheets: Sheets | None = None
        self.cubic = interpolation == "cubic"
        self.reach = MAX_COURANT[interpolation]
        place = list(zip(grid.periodic, grid.ghost, grid.lo, grid.cells, grid.shape(None), strict=True))
        # a departure point in a ghost cell of another rank or a periodic axis is as good as any
        self._low = tuple(0.0 if p else float(max(0, g - m)) for p, g, m, _, _ in place)
        self._high = tuple(float(s) if p else float(min(s, g - m + c)) for p, g, m, c, s in place)

    def path(self, velocity: Faces, span: float) -> Path:
        """Return the path along a velocity for ``span`` seconds. Collective: one reduction.

        Raises
        ------
        SolveError
            If it crosses the grid so often that it is no flow any longer.
        """
        grid = self.grid
        most = max(advect.largest(v) * span / h for v, h in zip(velocity, grid.dx, strict=True))
        most = max(most, advect.largest(velocity.parts) * span / float(grid.dx.min()))
        courant = grid.comm.allreduce(most, op=MPI.MAX)
        if not courant <= MAX_CROSSINGS * max(grid.cells):
            raise SolveError(
                f"the flow has blown up: it would cross {courant:.1e} cells, more than the whole grid "
                f"{MAX_CROSSINGS} times, in one step of {span:g} s. Take a smaller dt, or look at what drives it."
            )
        sweeps = max(1, int(np.ceil(courant / self.reach)))
        return Path(velocity, span, sweeps, max(1, int(np.ceil(courant / sweeps))))

    def carry_faces(
        self, q: Faces, path: Path, moved: list[np.ndarray], out: Faces, own: Faces | None = None
    ) -> list[np.ndarray] | None:
        """Carry what is on faces into the owned part of ``out``. Collective.

        Parameters
        ----------
        q : Faces
            Ghosts valid.
        path : Path
        moved : list of ndarray of bool
            Where; elsewhere ``out`` is q.
        out : Faces
        own : Faces, optional
            What faces have themselves, which those near sheets are to keep as ``keep_own`` says.

        Returns
        -------
        list of ndarray of bool or None
            Which faces did; None where there are no sheets.
        """
        kept = None
        if path.sweeps > 1:
            own = None  # it has all flowed on
        for left in reversed(range(path.sweeps)):
            target = Faces(np.empty_like(v) for v in q) if left else out
            for axis, v in enumerate(q):
                self._sweep(v, path, moved[axis], axis, 0.0, target[axis])
            if self.sheets is not None:
                kept = self.sheets.carry_faces(q, path.velocity, moved, *self._limits(path), self.cubic, own, target)
            if left:
                for axis, v in enumerate(target):
                    self.grid.exchange_faces(axis, v)
                    self.grid.fill_sides(v, axis)
                q = target
        return kept

    def carry_smoke(
        self, smoke: np.ndarray, extras: np.ndarray, path: Path, moved: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return smoke carried to the owned cells and to the further pieces of divided ones. Collective.

        Parameters
        ----------
        smoke, extras : ndarray
            Cell array, ghosts valid, and values of further pieces.
        path : Path
        moved : ndarray of bool
            Where; elsewhere smoke stays.
        """
        # it comes in from behind the sides, where the ghosts know what a jet carries
        beyond = 0.5
        for left in reversed(range(path.sweeps)):
            target = np.empty_like(smoke)
            self._sweep(smoke, path, moved, None, beyond, target)
            if self.sheets is not None:
                extras = self.sheets.carry_smoke(
                    smoke, extras, path.velocity, *self._limits(path), beyond, self.cubic, target
                )
            if left:
                self.grid.exchange_cells(target)
                self.surroundings.fill_smoke(target)
            smoke = target
        return smoke, extras

    def _limits(self, path: Path) -> tuple[tuple, int, tuple, tuple]:
        """Return how a sweep goes: dt / dx, how many cells away it may read, and the ends of the domain."""
        courant = (*(path.span / path.sweeps / self.grid.dx), 0.0)[:3]
        return courant, path.crossed + (2 if self.cubic else 1), self._low, self._high

    def _sweep(
        self, q: np.ndarray, path: Path, moved: np.ndarray, axis: int | None, beyond: float, out: np.ndarray
    ) -> None:
        """Carry the faces of an axis (cells: None) for one sweep as if nothing divided them."""
        offset = tuple(0.0 if b == axis else 0.5 for b in range(3))
        part = tuple((s.start, s.stop) for s in self.grid.owned(axis))
        courant, _, low, high = self._limits(path)
        bounded = axis is None
        advect.sweep(
            q, out, moved, *three(path.velocity), offset, part, courant, low, high, beyond, self.cubic, bounded
        )  # fmt: skip

    def keep_own(self, own: np.ndarray, read: np.ndarray, path: Path, axis: int, out: np.ndarray) -> None:
        """Add to faces carried from ``read`` what they have beyond it, as far as it has not flowed on."""
        offset = tuple(0.0 if b == axis else 0.5 for b in range(3))
        part = tuple((s.start, s.stop) for s in self.grid.owned(axis))
        advect.keep_own(out, own, read, *three(path.velocity), offset, part, (*(path.span / self.grid.dx), 0.0)[:3])


class Transport:
    """First order, for Newmark's and the symplectic scheme:  v*(x) = v^n(x_d), where x_d comes to x along v^n.

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

    def __init__(self, advection: Advection) -> None:
        self.integrator: Newmark | Bdf2 | Midpoint = Newmark()
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

    def __init__(self, advection: Advection) -> None:
        super().__init__(advection)
        self.scheme = self.integrator = Bdf2()

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

    def __init__(self, advection: Advection) -> None:
        super().__init__(advection)
        self.scheme = self.integrator = Midpoint()
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
            read = v if kept is None else np.where(kept[axis], own[axis], v)
            self.advection.keep_own(own[axis], read, path, axis, star[axis])
        self._start = each(np.copy, star)

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


#: The scene's ``time.integrator`` by name.
TRANSPORTS: dict[str, type[Transport]] = {
    "newmark": Transport,
    "bdf2": Bdf2Transport,
    "midpoint": MidpointTransport,
    "symplectic-euler": Transport,
}
