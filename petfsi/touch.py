"""What must not go into what: bodies, obstacles and the walls of the fluid's box do not push each other off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from petfsi.errors import TouchError
from petfsi.fields.solids import SolidField
from petfsi.geometry.bodies import enclosed
from petfsi.geometry.collisions import Meeting, Way, any_within, crossings
from petfsi.geometry.obstacles import named_surfaces, side_walls
from petfsi.geometry.touching import (
    Turn,
    depths,
    drawn_in,
    first_on_ways,
    shortest_edges,
    stations,
    straight_parts,
    swept_boxes,
    turn_of,
)
from petfsi.ranks import on_root
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import images, periods

#: Bodies are drawn in by this part of a cell, where there is no fluid of their median edge: so deep they may go.
TOUCH = 0.01
#: No point is drawn in by more than this part of the shortest edge there: sheets are thin.
THIN = 0.25
#: What is held in, or at, something from the start, or begins in it, may go deeper by this part of its shortest edge.
ROOT = 0.5
#: Where there is no clearance it is looked for again after so many steps.
WAIT = 10
#: What is foreseen goes on by so many steps at most.
AHEAD = 10.0
#: What there is to do about it.
WHY = "Nothing pushes bodies off yet, so the run stops where they touch"


@dataclass(frozen=True)
class _Thing:
    """A closed surface: of a body, of an obstacle, or of the wall behind a side.

    Attributes
    ----------
    name : str
        As the scene calls it.
    facets : ndarray of int, shape (m, dim)
    points : ndarray, shape (n, dim)
        Where it stands; of bodies where they stand at the start, m.
    place : slice or None
        A body's points among those of all bodies.
    amount, edge : ndarray, shape (n,)
        By how much a body is drawn in, and its shortest edges, m.
    rooted : ndarray of bool, shape (n,)
        A body's points that supports hold.
    slack, radius : float
        How far a body's straight ways may be from arcs, and its largest distance from its centre, m.
    outside : bool
        Whether it is all but what the surface encloses.
    """

    name: str
    facets: np.ndarray
    points: np.ndarray
    place: slice | None = None
    amount: np.ndarray = field(default_factory=lambda: np.zeros(0))
    edge: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rooted: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    slack: float = 0.0
    radius: float = 0.0
    outside: bool = False

    def drawn(self, points: np.ndarray) -> np.ndarray:
        """Return its surface, drawn in if it is a body."""
        return points if self.place is None else drawn_in(points, self.facets, self.amount)


class _Roots(NamedTuple):
    """Points of a thing that may be in another one, moved by a shift, no deeper than limits."""

    thing: int
    other: int
    shift: np.ndarray
    points: np.ndarray
    limit: np.ndarray


def watch(comm: MPI.Comm, scene: Scene, solid: SolidField | None) -> Watch | None:
    """Return what watches the bodies of a scene at its start; None if there is nothing that could meet. Collective."""
    if solid is None or (len(scene.solids) < 2 and not scene.obstacles and not side_walls(scene)):
        return None
    return Watch(comm, scene, solid)


class Watch:
    """Stops a run when a body enters another one, an obstacle or the wall behind a side.

    Not the end of a step counts but the way: every point goes straight from where it was to where it is, of a body
    that turns in steps so short that this is as good as its arc. Every body is drawn in by ``TOUCH``, so that what
    touches at the start and slides does not enter. Facets at points that begin in something, or are held by supports
    where they touch it, are not judged by their way, but such points by how deep they are (``ROOT``).

    All that it knows it takes from the scene's start and present positions, which are the same on every rank: none
    speaks to another. A body is not compared with itself nor with its own images.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    solid : SolidField
        At the start.

    Attributes
    ----------
    notes : list of str
        What a user should know of how bodies begin.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene, solid: SolidField) -> None:
        self._period = periods(scene.fluid, scene.dim)
        self._repeats = bool(np.any(self._period > 0.0))
        self._solid = solid
        self._turns: dict[int, Turn] = {}
        self._x, self._room, self._wait = solid.surface_present(), 0.0, 0
        self._things = _bodies(scene, solid, self._x) + on_root(comm, lambda: _still(scene))
        self._n = len(scene.solids)
        bodies, others = np.triu_indices(self._n, 1, len(self._things))
        self._pairs = np.column_stack((bodies, others))
        self._first = np.array(
            [thing.place.start for thing in self._things if thing.place is not None] + [len(self._x)]
        )
        still = [thing.points for thing in self._things[self._n :]]
        self._still = [np.array([end(x, axis=0) for x in still]).reshape(-1, scene.dim) for end in (np.min, np.max)]
        self.notes: list[str] = []
        self._spared: dict[tuple[int, int], np.ndarray] = {}
        self._roots: list[_Roots] = []
        for one, other, shift in self._near(*self._boxes(self._x)):
            self._take_root(one, other, shift)
            if other < self._n:
                self._take_root(other, one, -shift)

    def resume(self, solid: SolidField) -> None:
        """Take the present positions as those of the last step. Collective."""
        self._x, self._room = solid.surface_present(), 0.0

    def judge(self, x: np.ndarray, t: float, dt: float) -> None:
        """Raise if anything meets in the step from t to t + dt that ends with points at x (n, dim). Collective.

        The step is that after the one that the solid accepted last.

        Raises
        ------
        TouchError
            On all ranks.
        """
        # no two points can have come nearer than by twice the way of the fastest, on half a turn at most
        self._room -= np.pi * np.sqrt(x.shape[1]) * float(np.abs(x - self._x).max())
        if self._room > 0.0:
            self._x = x
            return
        low, high = self._boxes(x)
        said = self._met(x, t, dt, low, high)
        if said:
            raise TouchError(f"{said}. {WHY}")
        self._x = x
        self._wait = WAIT if self._wait == 0 else self._wait - 1
        if self._wait == WAIT:
            self._room = self._clearance(x, low, high)
            # of what slides along each other there is none, and it need not be looked for in every step
            self._wait = 0 if self._room > 0.0 else WAIT

    def foresee(self, x: np.ndarray, t: float, dt: float) -> str:
        """Return what would meet, where and when, in a step as ``judge`` has it; nothing if that is no step to take.

        What only touches at the end has met here, too: the way goes on by twice what bodies are drawn in, or by
        ``AHEAD``. Farther than all is wide only what has blown up goes. Collective.
        """
        way, ends = float(np.abs(x - self._x).max()), np.concatenate((self._x, *self._still))
        if not 0.0 < way < np.ptp(ends, axis=0).max():
            return ""
        drawn = max(float(thing.amount.max()) for thing in self._things[: self._n])
        beyond = min(AHEAD, 2.0 * drawn / way)
        x = x + beyond * (x - self._x)
        return self._met(x, t, dt, *self._boxes(x), beyond)

    def _met(
        self, x: np.ndarray, t: float, dt: float, low: np.ndarray, high: np.ndarray, beyond: float = 0.0
    ) -> str:  # fmt: skip
        """Return what meets first on the way to x, where and when, or what has gone too deep; nothing if none has.

        The way may go on beyond the end of the step, by so many times it; what meets there does so at that end.
        """
        first, said = 2.0, ""
        parts: dict[tuple[int, int], list[Way]] = {}
        self._turns = {}
        for one, other, shift in self._near(low, high):
            b = self._things[other]
            if b.place is None and not any_within(b.points, b.facets, low[one] + shift, high[one] + shift):
                continue
            found = self._meeting(one, other, shift, x, parts)
            if found is not None and found.part < first:
                first, place = found
                when = t + min(first * (1.0 + beyond), 1.0) * dt
                said = f"{self._verb(one, other)} at {_place(place)}, t = {when:.6g} s"
        if not said:
            said = self._too_deep(x, t + dt)
        return f"{said}, in the step from {t:.6g} s to {t + dt:.6g} s" if said else ""

    def _verb(self, one: int, other: int) -> str:
        a, b = self._things[one].name, self._things[other].name
        return f"{a} leaves the fluid's box through {b}" if b.startswith("fluid.") else f"{a} enters {b}"

    # ---- which are near -----------------------------------------------------------------------------------------

    def _near(self, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield pairs of things, and by how much the first is moved, whose boxes meet."""
        one, other = self._pairs.T
        apart = (low[one] > high[other]) | (low[other] > high[one])
        if not self._repeats:
            for a, b in self._pairs[~apart.any(axis=1)].tolist():
                yield a, b, self._period
            return
        for a, b in self._pairs[~(apart & (self._period == 0.0)).any(axis=1)].tolist():
            for shift in images(self._period, (low[a], high[a]), (low[b], high[b])):
                yield a, b, shift

    def _boxes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box in which each thing stays on the way to x, shape (n_things, dim).

        Points on arcs about a body's centre leave their chord by less than half of it, up to a half turn, and so does
        that centre: by 1/2 tan(a/4) of its way, where the angle a is less than pi/2 times a point's chord over its
        radius.
        """
        low, high, self._turned, self._way = swept_boxes(self._x, x, self._first)
        angles = self._turned / np.array([thing.radius for thing in self._things[: self._n]])
        bulge = (0.5 * self._turned + 0.5 * self._way * np.minimum(0.5 * angles, 1.0))[:, None]
        return np.concatenate((low - bulge, self._still[0])), np.concatenate((high + bulge, self._still[1]))

    def _clearance(self, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
        """Return how much nearer two points may come, at least, before anything meets or goes too deep, m.

        Parameters
        ----------
        x : ndarray, shape (n, dim)
            Present positions.
        low, high : ndarray, shape (n_things, dim)
            Boxes in which things are.
        """
        if self._repeats or any(root.other < self._n for root in self._roots):
            return 0.0
        one, other = self._pairs.T
        gaps = np.maximum(low[other] - high[one], low[one] - high[other]).max(axis=1)
        room = float(gaps[gaps > 0.0].min(initial=np.inf))
        for a, b in self._pairs[gaps <= 0.0].tolist():
            begin, end = self._judged_box(a, b, x)
            begin_b, end_b = self._judged_box(b, a, x)
            room = min(room, float(np.maximum(begin_b - end, begin - end_b).max()))
            if room <= 0.0:
                return 0.0
        for root in self._roots:
            a = self._things[root.thing]
            way = np.linalg.norm(x[a.place][root.points] - a.points[root.points], axis=1)
            room = min(room, float((ROOT * a.edge[root.points] - way).min()))
        return room

    def _judged_box(self, thing: int, other: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box of what of a thing must not cross another, shape (dim,)."""
        a = self._things[thing]
        if a.place is None:
            return self._still[0][thing - self._n], self._still[1][thing - self._n]
        points = x[a.place][self._judged(thing, other)].reshape(-1, x.shape[1])
        return points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)

    # ---- whether they meet --------------------------------------------------------------------------------------

    def _meeting(
        self, one: int, other: int, shift: np.ndarray, x: np.ndarray, known: dict[tuple[int, int], list[Way]]
    ) -> Meeting | None:
        """Return where two things meet first on the way to x, or None."""
        n = max(self._parts(one, x), self._parts(other, x))
        ways = [self._ways(thing, n, x, known) for thing in (one, other)]
        pair = (one, other), (other, one)
        facets = [self._judged(*this) for this in pair]
        moved = [Way(way.start + shift, way.end + shift, facets[0]) for way in ways[0]]
        return first_on_ways(moved, [way._replace(facets=facets[1]) for way in ways[1]])

    def _judged(self, thing: int, other: int) -> np.ndarray:
        """Return the facets of a thing that must not cross the other."""
        facets, spared = self._things[thing].facets, self._spared.get((thing, other))
        return facets if spared is None else facets[~spared]

    def _parts(self, number: int, x: np.ndarray) -> int:
        """Return how many straight ways a thing needs."""
        thing = self._things[number]
        if thing.place is None:
            return 1
        turned, way = self._turned[number], self._way[number]
        if turned * (turned + way) <= 8.0 * thing.slack * thing.radius:
            return 1
        return straight_parts(self._x[thing.place], self._turn(number, x), thing.slack)

    def _turn(self, number: int, x: np.ndarray) -> Turn:
        """Return how a body turns on its way to x. Collective, the first time."""
        if number not in self._turns:
            place = self._things[number].place
            velocity = self._solid.surface_speed()[place].mean(axis=0)
            self._turns[number] = turn_of(self._x[place], x[place], velocity)
        return self._turns[number]

    def _ways(self, number: int, n: int, x: np.ndarray, known: dict[tuple[int, int], list[Way]]) -> list[Way]:
        """Return the n straight ways of a thing to x, drawn in."""
        thing = self._things[number]
        if thing.place is None:
            return [Way(thing.points, thing.points, thing.facets)] * n
        if (number, n) not in known:
            start, end = self._x[thing.place], x[thing.place]
            passed = [start, end] if n == 1 else stations(start, end, self._turn(number, x), n)
            places = [thing.drawn(y) for y in passed]
            known[number, n] = [Way(a, b, thing.facets) for a, b in zip(places[:-1], places[1:], strict=True)]
        return known[number, n]

    # ---- what was there from the start --------------------------------------------------------------------------

    def _take_root(self, one: int, other: int, shift: np.ndarray) -> None:
        """Note what of a body begins in another thing, or is held where it touches it."""
        a, b = self._things[one], self._things[other]
        drawn, against = a.drawn(a.points) + shift, b.drawn(b.points)
        crossing, _ = crossings(Way(drawn, drawn, a.facets), Way(against, against, b.facets))
        begins = _within(drawn, a.facets, crossing, against, b)
        near = np.flatnonzero(a.rooted & ~begins & _in_box(a.points + shift, b.points, a.amount))
        roots = begins.copy()
        roots[near[np.abs(depths(a.points[near] + shift, b.points, b.facets)) <= a.amount[near]]] = True
        points = np.flatnonzero(roots)
        if not len(points):
            return
        depth = depths(a.points[points] + shift, b.points, b.facets, b.outside)
        self._roots.append(_Roots(one, other, shift, points, np.maximum(depth, 0.0) + ROOT * a.edge[points]))
        spared = roots[a.facets].any(axis=1)
        self._spared[one, other] = self._spared.get((one, other), False) | spared
        if np.any(begins & ~a.rooted):
            self.notes.append(f"{a.name} begins with a part of it in {b.name}; the run stops if that goes deeper")

    def _too_deep(self, x: np.ndarray, t: float) -> str:
        """Return what has gone deeper than at the start, and where; nothing if none has."""
        for one, other, shift, points, limit in self._roots:
            a, b = self._things[one], self._things[other]
            at = x[a.place][points]
            if b.place is None and np.all(np.linalg.norm(at - a.points[points], axis=1) <= ROOT * a.edge[points]):
                continue
            depth = depths(at + shift, b.points if b.place is None else x[b.place], b.facets, b.outside)
            worst = int(np.argmax(depth - limit))
            if depth[worst] > limit[worst]:
                where = f"{_place(at[worst] + shift)}, t = {t:.6g} s"
                return f"{a.name} goes deeper into {b.name} than it began, {depth[worst]:.3g} m, at {where}"
        return ""


def _bodies(scene: Scene, solid: SolidField, x: np.ndarray) -> list[_Thing]:
    """Return the bodies of a scene where they are, x (n, dim)."""
    facets, owner, rooted = solid.surface().facets, solid.surface_bodies(), solid.surface_rooted()
    cell = scene.fluid.resolution if scene.fluid is not None else None
    edge = shortest_edges(x, facets)
    names, found = list(scene.solids), []
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(x)), strict=True):
        place = slice(int(begin), int(end))
        own = facets[owner[facets[:, 0]] == owner[begin]] - begin
        amount = np.minimum(TOUCH * (cell or np.median(edge[place])), THIN * edge[place])
        radius = float(np.linalg.norm(x[place] - x[place].mean(axis=0), axis=1).max())
        about = place, amount, edge[place], rooted[place], float(np.median(amount)), radius
        found.append(_Thing(f"solids.{names[owner[begin]]}", own, x[place].copy(), *about))
    return found


def _still(scene: Scene) -> list[_Thing]:
    """Return the obstacles of a scene, and the walls behind its sides."""
    if scene.fluid is None:
        return []
    found = []
    for name, (points, facets) in named_surfaces(scene).items():
        found.append(_Thing(f"obstacles.{name}", facets, points, outside=scene.obstacles[name].outside))
    walls = side_walls(scene).items()
    return found + [_Thing(f"fluid.sides.{side}", facets, points) for side, (points, facets) in walls]


def _within(x: np.ndarray, facets: np.ndarray, crossing: np.ndarray, points: np.ndarray, thing: _Thing) -> np.ndarray:
    """Return which points of a surface are in a thing whose own are at ``points``, or on facets that cross it.

    Of those that facets join which do not cross it, all are in it or none is.
    """
    joined = facets[~crossing][:, [*range(1, x.shape[1]), 0]].ravel(), facets[~crossing].ravel()
    graph = coo_matrix((np.ones(len(joined[0]), dtype=np.int8), joined), shape=(len(x), len(x)))
    _, first, label = np.unique(connected_components(graph, directed=False)[1], return_index=True, return_inverse=True)
    within = (enclosed(points, thing.facets, x[first]) != thing.outside)[label.ravel()]
    within[facets[crossing]] = True
    return within


def _in_box(at: np.ndarray, points: np.ndarray, margin: np.ndarray) -> np.ndarray:
    """Return which places (n, dim) are in the box of other points, or nearer to it than margins (n,)."""
    gap = np.maximum(points.min(axis=0) - at, at - points.max(axis=0)).max(axis=1)
    return gap <= margin


def _place(x: np.ndarray) -> str:
    return f"({', '.join(f'{c:.4g}' for c in np.round(x, 12) + 0.0)}) m"
