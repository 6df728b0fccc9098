"""Where liquid is at the start: particles on lattices in the shapes that a scene fills, and their pressure at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from petfsi.errors import InputError
from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.dummies import NEAR
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.layers import CHUNK, divided, fine_cells
from petfsi.fields.sph.solids import SAME, Array, Region, Solid, build_solids
from petfsi.geometry.meshes import read_surface
from petfsi.scene.schema import Obstacle
from petfsi.scene.tables import Shape

#: Particles begin so far, in dx, from obstacles.
CLEARANCE = 0.5
#: Those nearer than this to uneven surfaces, in dx, are laid anew if they are to fit.
FITTED = 1.25
#: Cells of the fine lattice along dx there, by dimension.
FINE = {2: 6, 3: 4}
#: Particles nearer than this, in dx, are of one body of liquid.
LINKED = 1.5
#: Something nearer than this, in dx, to what is dx above a particle is right above it.
BLOCKED = 0.75
#: Of so many shapes it is told that they do not fit into the fluid's box.
TOLD = 6
#: What has so many times the fluid's places is laid out in the fluid's box alone; what is beyond is not counted.
FAR = 1e3
#: What is longer than so many periods is refused: it would be as many images.
PERIODS = 100


@dataclass(frozen=True)
class Fill:
    """Particles at the start, the same and in the same order on every rank.

    Attributes
    ----------
    x : ndarray, shape (n, dim)
        m; shape after shape, on the lattice of each the last axis' fastest.
    volume : ndarray, shape (n,)
        What each stands for, m^3 (in 2D m^2).
    shape : ndarray of int, shape (n,)
        The shape it comes from.
    outside, blocked, double : int
        How many were dropped: beyond the domain, in obstacles or too near to them, in an earlier shape.
    domain : Domain
    solids : list of Solid
        The obstacles.
    clearance : float
        How far particles keep off them, m.
    cut : list of str
        A line for each box that reaches beyond the domain, or is longer than a period, and for what reaches far beyond:
        what of it is filled.
    """

    x: Array
    volume: Array
    shape: Array
    outside: int
    blocked: int
    double: int
    domain: Domain
    solids: list[Solid]
    clearance: float
    cut: list[str]

    @property
    def notes(self) -> list[str]:
        """What a user should know of particles that were dropped, and of shapes of which only a part is filled."""
        told = {
            "lie outside the box": self.outside,
            "lie in obstacles or solids, or less than half a spacing before them": self.blocked,
            "lie in more than one shape, and count once": self.double,
        }
        said = [f"fluid.fill: {n} places {what}" for what, n in told.items() if n] + self.cut[:TOLD]
        more = len(self.cut) - TOLD
        if more > 0:
            said.append(f"fluid.fill: of {more} more shape{'s' * (more > 1)} only a part is filled")
        return said

    def is_solid(self, points: Array) -> Array:
        """Return at which points (n, dim) no particle may be: behind walls, in obstacles or too near to them."""
        held = np.any(self.domain.beyond(points) != 0.0, axis=1)
        for solid in self.solids:
            depth, _ = solid.depth(self.domain.clamped(points), self.clearance, whole=True)
            held |= depth > -self.clearance * (1.0 - SAME)
        return held


def liquid(
    domain: Domain,
    dx: float,
    shapes: Sequence[Shape],
    obstacles: Mapping[str, Obstacle],
    directory: Path,
    clearance: float = CLEARANCE,
    fitted: bool = False,
) -> Fill:
    """Return particles that fill shapes. Not collective; every rank gets all of them.

    They stand in the middles of cells, which along each axis are as large as the spacing nearest to dx that divides
    the domain: dx / 2 off its walls. A box whose faces do not lie between such cells has cells of its own, of the size
    nearest to dx that divides it (of a box of n dx within a part 1 / 2n of dx).

    Parameters
    ----------
    domain : Domain
    dx : float
        m.
    shapes : sequence of Shape
        Boxes, balls, cylinders, half spaces and mesh files.
    obstacles : mapping of str to Obstacle
    directory : Path
        What mesh files are relative to.
    clearance : float
        Those nearer than so many dx to an obstacle are dropped.
    fitted : bool
        Near obstacles whose faces do not lie between the cells, lay particles so that they fill what is there,
        instead of dropping some; then the sum of volumes is that of the shapes less that of the obstacles.
    """
    solids = build_solids(domain, dx, obstacles, directory, 2.0 * dx)
    dim = len(domain.low)
    lattices: list[_Lattice] = []
    found = [(np.zeros((0, dim)), np.zeros(0), np.zeros(0, dtype=np.int64))]
    dropped = np.zeros(3, dtype=np.int64)
    for number, shape in enumerate(shapes):
        lattice = _Lattice(shape, domain, dx, f"fluid.fill.{number}", directory)
        # points of one lattice are the same or apart
        others = [part[0] for part, other in zip(found[1:], lattices, strict=True) if lattice.own or other.own]
        x, volume, counts = _filled(
            lattice, lattices, np.concatenate([found[0][0], *others]), solids, clearance, fitted
        )
        dropped += counts
        lattices.append(lattice)
        found.append((x, volume, np.full(len(x), number)))
    x, volume, which = (np.concatenate(part) for part in zip(*found, strict=True))
    outside, blocked, double = dropped.tolist()
    parts = {f"fluid.fill.{number}": "; ".join(_cut(lattice)) for number, lattice in enumerate(lattices)}
    cut = [f"{key} {said}" for key, said in parts.items() if said]
    return Fill(x, volume, which, outside, blocked, double, domain, solids, clearance * dx, cut)


def _cut(lattice: _Lattice) -> Iterator[str]:
    """Say what is filled of a box, or of what reaches far, along each axis on which it is beyond the domain's."""
    domain, region = lattice.domain, lattice.region
    if region.reach is None or not (region.shape.box is not None or lattice.far):
        return
    for a, (begin, end) in enumerate(zip(*region.reach, strict=True)):
        low, high = domain.low[a], domain.high[a]
        slack, axis = SAME * (high - low), "xyz"[a]
        if domain.periodic[a]:
            if end - begin > high - low + slack:
                repeats = f"which repeats after {high - low:g} m"
                yield f"is {end - begin:g} m long along {axis}, {repeats}: that is filled once"
        elif begin < low - slack or end > high + slack:
            reach = f"{axis} from {begin:g} to {end:g} m"
            yield f"has {reach}, the fluid's box from {low:g} to {high:g} m: what lies in that is filled"


def _filled(
    lattice: _Lattice, earlier: list[_Lattice], others: Array, solids: list[Solid], clearance: float, fitted: bool
) -> tuple[Array, Array, Array]:
    """Return places and volumes in one shape, and how many were dropped: outside, blocked, double."""
    dx = lattice.dx
    uneven = [solid for solid in solids if fitted and not lattice.matches(solid)]
    even = [solid for solid in solids if solid not in uneven]
    tree = cKDTree(others) if len(others) else None
    parts, cells, dropped = [], [], np.array([lattice.outside, 0, 0])
    for rows in lattice.blocks():
        x, volume, taken, outside, double = lattice.points(rows, earlier, tree)
        free = _depths(even, x, rows, taken, clearance, dx) <= -clearance * dx * (1.0 - SAME)
        depth = _depths(uneven, x, rows, taken, FITTED, dx)
        cut = free & np.isfinite(depth)
        free &= np.isneginf(depth)
        cells.append((x[cut], volume[cut]))
        parts.append((x[free], volume[free]))
        dropped += [outside, np.count_nonzero(~free), double]
    if fitted:
        parts.append(_fit(uneven, *_joined(cells), lattice))
        dropped[1] -= len(parts[-1][0])
    return *_joined(parts), dropped


def _joined(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    return np.concatenate([x for x, _ in parts]), np.concatenate([volume for _, volume in parts])


class _Lattice:
    """The cells of one shape.

    Attributes
    ----------
    region : Region
    rows : list of ndarray
        Places along each axis, ascending, m.
    width : ndarray, shape (dim,)
        Of a cell, m.
    own : bool
        Whether these are not the domain's.
    outside : int
        How many cells of a box are beyond the domain.
    far : bool
        Whether the shape has no cells beyond the domain, as they would be too many.
    """

    def __init__(self, shape: Shape, domain: Domain, dx: float, key: str, directory: Path) -> None:
        dim = len(domain.low)
        surface = np.zeros((0, dim)), np.zeros((0, dim), dtype=np.int64)
        if shape.mesh is not None:
            surface = read_surface(shape, dim, key, directory)
        self.region, self.domain, self.dx = Region(shape, surface, domain), domain, dx
        self.rows, self.width, self.own, self.outside = [], domain.spacing(dx), False, 0
        reach, whole, inner = self.region.reach, 1.0, 1.0
        times = 1.0 if reach is None else np.prod((reach[1] - reach[0]) / (domain.high - domain.low))
        self.far = shape.box is None and bool(times > FAR)
        for a in range(dim):
            low, high, h = domain.low[a], domain.high[a], self.width[a]
            begin, end = (low, high) if reach is None else (reach[0][a], reach[1][a])
            if domain.periodic[a] and shape.box is None and end - begin > PERIODS * (high - low):
                raise InputError(
                    f"{key}: is {end - begin:g} m long along {'xyz'[a]}, which repeats after {high - low:g} m; at most "
                    f"{PERIODS} times that is filled"
                )
            if domain.periodic[a] and (shape.box is None or end - begin >= high - low):
                begin, end = low, high
            elif self.far and not domain.periodic[a]:
                begin, end = max(begin, low), min(end, high)
            first, last = (begin - low) / h, (end - low) / h
            fits = np.abs(np.rint([first, last]) - [first, last]).max() < SAME
            if shape.box is not None:
                if not domain.periodic[a]:
                    whole *= end - begin
                    begin, end = max(begin, low), min(end, high)
                    inner *= max(end - begin, 0.0)
                if not fits:
                    self.own = True
                    n = int(np.rint(max(end - begin, 0.0) / dx)) or int(end > begin)
                    self.width[a] = h = (end - begin) / max(n, 1)
                    place = begin + (np.arange(n) + 0.5) * h
                else:
                    place = low + (np.arange(np.rint((begin - low) / h), np.rint((end - low) / h)) + 0.5) * h
                if domain.periodic[a]:
                    place = np.sort(low + np.mod(place - low, high - low))
            else:
                place = low + (np.arange(np.floor(first + SAME), np.ceil(last - SAME)) + 0.5) * h
            self.rows.append(place)
        if shape.box is not None:
            held = [end - begin for begin, end in zip(*reach, strict=True)] if reach else []
            across = np.prod([w for w, p in zip(held, domain.periodic, strict=True) if p])
            self.outside = int(np.rint((whole - inner) * across / dx**dim))

    def matches(self, solid: Solid) -> bool:
        """Whether a solid's faces lie along the axes and between these cells."""
        if solid.box is None or not all(map(len, self.rows)):
            return False
        first = np.array([row[0] for row in self.rows]) - 0.5 * self.width
        places = (np.stack(solid.box, axis=1) - first[:, None]) / self.width[:, None]
        return bool(np.all(np.abs(places - np.rint(places))[solid.faces()] < SAME))

    def blocks(self) -> list[list[Array]]:
        """Return the lattice in pieces of moderate size, as places along the axes."""
        per_row = max(1, int(np.prod([len(row) for row in self.rows[1:]])))
        step = max(1, CHUNK // per_row)
        return [[self.rows[0][b : b + step], *self.rows[1:]] for b in range(0, max(len(self.rows[0]), 1), step)]

    def points(
        self, rows: list[Array], earlier: Sequence[_Lattice], tree: cKDTree | None
    ) -> tuple[Array, Array, Array, int, int]:
        """Return places and volumes of the shape's cells, which of the block's they are, and how many were dropped.

        Dropped are those outside of the domain and those in earlier shapes or near to one of theirs.
        """
        x = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, len(rows))
        kept = np.ones(len(x), dtype=bool) if self.region.shape.box is not None else self.region.holds_lattice(rows)
        around, all_of_them = self.domain, np.count_nonzero(kept)
        kept &= np.all(around.periodic | ((x > around.low) & (x < around.high)), axis=1)
        inner = np.count_nonzero(kept)
        for other in earlier:
            kept &= ~other.region.holds_lattice(rows)
        if tree is not None and kept.any():
            some = np.flatnonzero(kept)
            near = NEAR * float(self.width.min()) * (1.0 - SAME)
            kept[some[np.isfinite(tree.query(x[some], distance_upper_bound=near)[0])]] = False
        taken = np.flatnonzero(kept)
        volume = np.full(len(taken), self.width.prod())
        return x[taken], volume, taken, int(all_of_them - inner), int(inner - len(taken))


def _depths(solids: Sequence[Solid], x: Array, rows: list[Array], taken: Array, reach: float, dx: float) -> Array:
    """Return how deep points lie in obstacles, m: plus or minus infinity where no facet is within ``reach`` dx."""
    deepest = np.full(len(x), -np.inf)
    for solid in solids:
        depth, _ = solid.depth(x, reach * dx, far=False, whole=True)
        far = np.isinf(depth)
        if solid.shape.mesh is None:
            held = solid.holds(x[far])
        else:
            held = (solid.region.holds_lattice(rows) != solid.outside)[taken[far]]
        depth[far] = np.where(held, np.inf, -np.inf)
        deepest = np.maximum(deepest, depth)
    return deepest


def _fit(solids: Sequence[Solid], x: Array, volume: Array, lattice: _Lattice) -> tuple[Array, Array]:
    """Return particles in what obstacles leave of cells."""
    dim, dx = x.shape[1], lattice.dx
    fine = FINE[dim]
    points = (x[:, None] + fine_cells(dim, fine) * lattice.width).reshape(-1, dim)
    part, side = np.repeat(volume / fine**dim, fine**dim), dx / fine
    for solid in solids:
        part = part * np.clip(0.5 - solid.depth(points, 2.0 * dx, whole=True)[0] / side, 0.0, 1.0)
    return divided(points[part > 0.0], part[part > 0.0], float(lattice.width.prod()))


# ---- at rest ------------------------------------------------------------------------------------------------


def hydrostatic(
    x: Array,
    gravity: Sequence[float] | Array,
    law: Law,
    periodic: Sequence[bool] | Array | None = None,
    is_solid: Callable[[Array], Array] | None = None,
) -> Array:
    """Return the pressure of liquid at rest, Pa: p = rho_0 |g| (level - height), shape (n,).

    Along an axis every column of particles has its own level, dx / 2 above the highest that follows without a gap; what
    stands below something solid has the highest level of what it is connected with. In other directions the level is
    that of the highest particle of each connected body of liquid.

    Parameters
    ----------
    x : ndarray, shape (n, dim)
        m.
    gravity : sequence of float
        m/s^2; zero, or along a periodic axis, gives no pressure.
    law : Law
    periodic : sequence of bool, optional
    is_solid : callable, optional
        At which points (n, dim) no particle may be; see ``Fill``. Nothing keeps any out if it is left out.
    """
    g, dx = np.asarray(gravity, dtype=float), law.spacing
    size = float(np.linalg.norm(g))
    along = np.flatnonzero(np.abs(g) > 1e-9 * size)
    if size == 0.0 or not len(x) or (periodic is not None and np.any(np.asarray(periodic)[along])):
        return np.zeros(len(x))
    up = -g / size
    level = _column_levels(x, dx, int(along[0]), up, is_solid) if len(along) == 1 else _group_levels(x, dx, up)
    return law.rho0 * size * (level - x @ up)


def _column_levels(x: Array, dx: float, axis: int, up: Array, is_solid: Callable[[Array], Array] | None) -> Array:
    """Return the level that each particle stands under, measured along ``up``."""
    height = x @ up
    across = np.delete(x, axis, axis=1)
    column = np.floor((across - across.min(axis=0)) / dx + 0.25).astype(np.int64)
    order = np.lexsort((height, *column.T[::-1]))
    new = np.ones(len(x), dtype=bool)
    same = np.all(np.diff(column[order], axis=0) == 0, axis=1)
    new[1:] = ~same | (np.diff(height[order]) > LINKED * dx)
    piece = np.empty(len(x), dtype=np.int64)
    piece[order] = np.cumsum(new) - 1
    top = order[np.append(np.flatnonzero(new)[1:] - 1, len(x) - 1)]
    level = height[top] + 0.5 * dx
    # where something is right above the highest of a piece it is not its surface
    above = x[top] + dx * up
    covered = np.isfinite(cKDTree(x).query(above, distance_upper_bound=BLOCKED * dx)[0])
    if is_solid is not None:
        covered |= is_solid(above)
    return _risen(x, dx, piece, level, covered)[piece]


def _risen(x: Array, dx: float, piece: Array, level: Array, covered: Array) -> Array:
    """Return levels with those of covered pieces as high as the highest that they are connected with."""
    covered = covered & (level < level.max() - SAME * dx)
    low = np.flatnonzero(covered[piece])
    if not len(low):
        return level
    tree, near = cKDTree(x), np.zeros(len(level), dtype=bool)
    for some in np.array_split(low, len(low) * 100 // CHUNK + 1):
        near[piece[np.concatenate(tree.query_ball_point(x[some], LINKED * dx)).astype(np.int64)]] = True
    close = np.flatnonzero(near[piece])
    one, other = piece[close[cKDTree(x[close]).query_pairs(LINKED * dx, output_type="ndarray")]].T
    one, other = np.append(one, other), np.append(other, one)
    one, other = np.unique(np.stack((one, other))[:, covered[one]], axis=1)
    while True:
        risen = level.copy()
        np.maximum.at(risen, one, level[other])
        if np.array_equal(risen, level):
            return level
        level = risen


def _group_levels(x: Array, dx: float, up: Array) -> Array:
    pairs = cKDTree(x).query_pairs(LINKED * dx, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(len(x), len(x)))
    group = connected_components(graph, directed=False)[1]
    level = np.full(int(group.max()) + 1, -np.inf)
    np.maximum.at(level, group, x @ up)
    return level[group] + 0.5 * dx
