"""Wall particles at rest: those of the domain's sides and of obstacles.

Layers of dummies at depths (k + 1/2) dx behind a wall stand for what is solid there, as far as the kernel reaches, so
that sums over particles see no gap (S. Adami, X. Y. Hu, N. A. Adams, J. Comput. Phys. 231 (2012), 7057). What is
bounded by planes along the axes has them on a lattice. Everything else is cut into a fine lattice of points with their
distance to the nearest facet; each layer of it is divided into parts of about dx^dim, as equal and compact as can be
(a centroidal Voronoi division), and every part is one dummy with the part's volume.

Every place behind several walls belongs to one: to a side, else to the first obstacle on a lattice, else to the first.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from petfsi.fields.sph.solids import SAME, Array, Solid, build_solids
from petfsi.geometry.shapes import inside
from petfsi.scene.schema import Obstacle
from petfsi.scene.sides import InflowSide

SIDES = ("left", "right", "bottom", "top", "back", "front")
#: Cells of the fine lattice along dx, by dimension.
FINE = {2: 6, 3: 3}
#: How often parts are divided anew.
ROUNDS = 6
#: Dummies of two walls nearer than this part of dx are one.
NEAR = 0.5
#: So many points are looked at at once.
CHUNK = 1_000_000


@dataclass(frozen=True)
class Dummies:
    """Wall particles, the same and in the same order on every rank.

    Attributes
    ----------
    x : ndarray, shape (n, dim)
        m.
    volume : ndarray, shape (n,)
        What each stands for, m^3 (in 2D m^2).
    normal : ndarray, shape (n, dim)
        Unit, out of the wall into the fluid; ``x + depth normal`` is the place of the wall that it hangs on (beyond
        open sides, where obstacles go on as they end there, a place that far from the wall's end).
    depth : ndarray, shape (n,)
        Distance behind the wall, m.
    no_slip : ndarray of bool, shape (n,)
    wall : ndarray of int, shape (n,)
        Which of ``names`` it belongs to.
    names : tuple of str
        The sides, two an axis (left, right, bottom, ...), then the obstacles.
    """

    x: Array
    volume: Array
    normal: Array
    depth: Array
    no_slip: Array
    wall: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class Domain:
    """The box that holds the fluid, and what its sides are.

    Attributes
    ----------
    low, high : ndarray, shape (dim,)
        m.
    sides : tuple of pairs
        The lower and upper side of each axis: "slip", "no-slip", "open", "periodic" or an inflow's table.
    """

    low: Array
    high: Array
    sides: tuple[tuple[str | InflowSide, str | InflowSide], ...]

    @property
    def periodic(self) -> Array:
        """Which axes repeat, shape (dim,)."""
        return np.array([pair[0] == "periodic" for pair in self.sides])

    @property
    def period(self) -> Array:
        """After what length they do, m; 0 where they do not, shape (dim,)."""
        return np.where(self.periodic, self.high - self.low, 0.0)

    def spacing(self, dx: float) -> Array:
        """Return the spacing along each axis that is nearest to dx and divides the size, m, shape (dim,)."""
        size = self.high - self.low
        return size / np.maximum(1.0, np.rint(size / dx))

    def lets_out(self, axis: int, end: int) -> bool:
        """Whether something may be beyond (part of) a side."""
        return self.sides[axis][end] not in ("slip", "no-slip", "periodic")

    def is_wall(self, axis: int, end: int, points: Array) -> Array:
        """Return which points (n, dim), beyond a side, are behind a wall and not before an opening."""
        kind = self.sides[axis][end]
        if not isinstance(kind, InflowSide):
            return np.full(len(points), kind in ("slip", "no-slip"))
        if kind.inflow.region is None or kind.inflow.rest == "open":
            return np.zeros(len(points), dtype=bool)
        return ~inside(kind.inflow.region, np.clip(points, self.low, self.high))

    def beyond(self, points: Array) -> Array:
        """Return how far points lie behind walls along each axis, m; negative behind upper sides, shape (n, dim)."""
        behind = np.zeros(points.shape)
        for a in np.flatnonzero(~self.periodic):
            for end, distance in enumerate((self.low[a] - points[:, a], points[:, a] - self.high[a])):
                out = np.flatnonzero(distance > 0.0)
                out = out[self.is_wall(a, end, points[out])]
                behind[out, a] = distance[out] if end == 0 else -distance[out]
        return behind

    def clamped(self, points: Array) -> Array:
        """Return points moved to the nearest place of the domain, but not along periodic axes."""
        return np.where(self.periodic, points, np.clip(points, self.low, self.high))


def wall_dummies(
    domain: Domain,
    dx: float,
    reach: float,
    obstacles: Mapping[str, Obstacle],
    directory: Path,
    no_slip: Collection[str] = (),
) -> Dummies:
    """Return the dummies of all walls at rest. Not collective; every rank gets the same.

    Walls go on past an open side or an inflow as far as the kernel reaches; obstacles do as if they were prisms there.

    Parameters
    ----------
    domain : Domain
    dx : float
        The particles' spacing, m.
    reach : float
        The kernel's support, m: there are ceil(reach / dx) layers.
    obstacles : mapping of str to Obstacle
    directory : Path
        What mesh files are relative to.
    no_slip : collection of str
        The obstacles that are not slippery.
    """
    layers = int(np.ceil(reach / dx - SAME))
    solids = build_solids(domain, dx, obstacles, directory, layers * dx)
    dim, deep = len(domain.low), layers * dx
    names = (*SIDES[: 2 * dim], *obstacles)
    walls = [kind.inflow.rest if isinstance(kind, InflowSide) else kind for pair in domain.sides for kind in pair]
    rough = np.array([kind == "no-slip" for kind in walls] + [o in no_slip for o in obstacles])
    x, volume, normal, depth, wall = _outside_box(domain, dx, layers)
    foot = x + depth[:, None] * normal
    hidden = np.zeros(len(x), dtype=bool)
    for solid in solids:
        inner = np.maximum(solid.depth(foot, deep, solid.shape.mesh is None, whole=True)[0], 0.0)
        hidden |= inner**2 + depth**2 >= deep**2
    parts = [tuple(part[~hidden] for part in (x, volume, normal, depth, wall))]
    done: list[Solid] = []
    for solid in sorted(solids, key=lambda s: s.box is None):
        if solid.box is not None:
            found = _on_lattice(solid, domain, dx, layers)
            held = [other.depth(domain.clamped(found[0]), deep, whole=True)[0] for other in done]
            seen = np.all([d < SAME * dx for d in held], axis=0) if held else np.ones(len(found[0]), dtype=bool)
        else:
            found = _from_facets(solid, done, domain, dx, layers)
            seen = np.ones(len(found[0]), dtype=bool)
        for other in solids:
            if other is not solid:
                inner = domain.clamped(found[0])
                seen &= other.depth(inner, deep, other.shape.mesh is None, whole=True)[0] < deep
        number = np.full(len(found[0]), names.index(solid.name))
        parts.append(tuple(part[seen] for part in (*found, number)))
        done.append(solid)
    x, volume, normal, depth, wall = _apart(parts, dx)
    return Dummies(x, volume, normal, depth, rough[wall], wall, names)


def _apart(parts: list[tuple[Array, ...]], dx: float) -> list[Array]:
    """Return all walls' dummies less those too near to one of an earlier wall, which takes their volume."""
    kept = list(parts[0])
    for part in parts[1:]:
        if len(kept[0]) and len(part[0]):
            distance, nearest = cKDTree(kept[0]).query(part[0], distance_upper_bound=NEAR * dx * (1.0 - SAME))
            near = np.isfinite(distance)
            np.add.at(kept[1], nearest[near], part[1][near])
            part = tuple(p[~near] for p in part)
        kept = [np.concatenate(both) for both in zip(kept, part, strict=True)]
    return kept


# ---- on a lattice -------------------------------------------------------------------------------------------


def _rows(low: float, high: float, dx: float, before: int, after: int) -> tuple[Array, Array]:
    """Return places and widths: so many of width dx from either end, between them some of nearly that."""
    n = int(np.rint((high - low) / dx))
    if before + after >= n:  # there are too few for all
        most = max(n - 1, 0) // (2 if before and after else 1)
        before, after = min(before, most), min(after, most)
    rest = (high - low) - (before + after) * dx
    n = max(1, int(np.rint(rest / dx)))
    width = np.concatenate((np.full(before, dx), np.full(n, rest / n), np.full(after, dx)))
    k = np.arange(n) + 0.5
    place = np.concatenate((
        low + (np.arange(before) + 0.5) * dx,
        low + before * dx + k * (rest / n),
        high - (np.arange(after)[::-1] + 0.5) * dx,
    ))  # fmt: skip
    return place, width


def _product(rows: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the points of a lattice, the last axis' fastest, and their volumes."""
    x = np.stack(np.meshgrid(*(place for place, _ in rows), indexing="ij"), axis=-1).reshape(-1, len(rows))
    width = np.stack(np.meshgrid(*(w for _, w in rows), indexing="ij"), axis=-1).reshape(-1, len(rows))
    return x, width.prod(axis=1)


def _outside_box(domain: Domain, dx: float, layers: int) -> tuple[Array, ...]:
    """Return what is behind a box's sides, its edges and corners: x, volume, normal, depth and side."""
    dim, k = len(domain.low), (np.arange(layers) + 0.5) * dx
    core, outer, whole = [], [], []
    for a in range(dim):
        core.append(_rows(domain.low[a], domain.high[a], float(domain.spacing(dx)[a]), 0, 0))
        ends = np.zeros(0) if domain.periodic[a] else np.concatenate((domain.low[a] - k[::-1], domain.high[a] + k))
        outer.append((ends, np.full(len(ends), dx)))
        whole.append(tuple(np.concatenate(both) for both in zip(core[a], outer[a], strict=True)))
    # what is beyond axis a, but not beyond those before
    blocks = [_product([*core[:a], outer[a], *whole[a + 1 :]]) for a in range(dim)]
    x, volume = (np.concatenate(both) for both in zip(*blocks, strict=True))
    behind = domain.beyond(x)
    depth = np.linalg.norm(behind, axis=1)
    kept = np.flatnonzero((depth > 0.0) & (depth < layers * dx))
    # by rows, so that places next to each other stand near each other
    kept = kept[np.lexsort(np.rint(2.0 * (x[kept] - domain.low) / dx).T[::-1])]
    x, volume, behind, depth = x[kept], volume[kept], behind[kept], depth[kept]
    axis = np.argmax(np.abs(behind) > (np.abs(behind).max(axis=1, initial=0.0) - SAME * dx)[:, None], axis=1)
    wall = 2 * axis + (behind[np.arange(len(x)), axis] < 0.0)
    return x, volume, behind / depth[:, None], depth, wall


def _on_lattice(solid: Solid, domain: Domain, dx: float, layers: int) -> tuple[Array, ...]:
    """Return what is behind the faces of a box or half space along the axes: x, volume, normal, depth."""
    assert solid.box is not None
    dim, faces = len(domain.low), solid.faces()
    low, high = solid.box
    if solid.outside and solid.shape.box is not None:
        kinds = []
        for a, wet in enumerate(faces):
            lower, upper = ("slip" if face else "open" for face in wet)
            kinds.append(("periodic", "periodic") if domain.periodic[a] and not wet.any() else (lower, upper))
        x, volume, normal, depth, _ = _outside_box(Domain(low, high, tuple(kinds)), dx, layers)
    else:
        rows = []
        for a in range(dim):
            place, width = _rows(low[a], high[a], dx, *(layers * faces[a]))
            for end in range(2):
                if not faces[a, end] and domain.lets_out(a, end):
                    more = (np.arange(layers) + 0.5) * dx
                    place = np.append(place, high[a] + more if end else low[a] - more)
                    width = np.append(width, np.full(layers, dx))
            rows.append((place, width))
        x, volume = _product(rows)
        distance = np.stack((x - low, high - x), axis=2)
        distance[:, ~faces] = np.inf
        nearest = distance.reshape(len(x), -1).argmin(axis=1)
        depth = distance.reshape(len(x), -1)[np.arange(len(x)), nearest]
        normal = (np.eye(dim)[:, None] * np.array([-1.0, 1.0])[:, None]).reshape(-1, dim)[nearest]
    kept = (depth < layers * dx) & ~np.any(domain.beyond(x) != 0.0, axis=1)
    around = np.where(domain.periodic, domain.period, 1.0)
    x = np.where(domain.periodic, domain.low + np.mod(x - domain.low, around), x)
    kept &= np.all((x > domain.low - layers * dx) & (x < domain.high + layers * dx), axis=1)
    return x[kept], volume[kept], normal[kept], depth[kept]


# ---- from facets --------------------------------------------------------------------------------------------


def _from_facets(
    solid: Solid, earlier: list[Solid], domain: Domain, dx: float, layers: int
) -> tuple[Array, Array, Array, Array]:
    """Return dummies behind any surface, in layers: x, volume, normal, depth."""
    dim, deep = len(domain.low), layers * dx
    points, cell = _near(solid, domain, dx, layers)
    side = dx / FINE[dim]

    def measure(x: Array) -> tuple[Array, Array]:
        return solid.depth(domain.clamped(x), deep + dx, far=False)

    def allowed(x: Array) -> Array:
        free = np.all(domain.beyond(x) == 0.0, axis=1)
        for other in earlier:
            free &= other.depth(domain.clamped(x), SAME * dx, whole=True)[0] < 0.0
        return free

    if len(solid.corners) < len(solid.whole[0]):  # what is behind the rest may be before these
        cell = cell * (solid.depth(domain.clamped(points), deep + dx, whole=True)[0] > -0.5 * side)
    for other in earlier:
        cell = cell * np.clip(0.5 - other.depth(domain.clamped(points), side, whole=True)[0] / side, 0.0, 1.0)
    return in_layers(points, cell, dx, layers, measure, allowed)


def in_layers(
    points: Array,
    cell: Array,
    dx: float,
    layers: int,
    measure: Callable[[Array], tuple[Array, Array]],
    allowed: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Return dummies in layers behind a surface: x, volume, normal, depth.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        A fine lattice, FINE cells along dx, near the surface on both of its sides, m.
    cell : ndarray, shape (n,)
        What each stands for, m^dim.
    dx : float
        m.
    layers : int
    measure : callable
        Gives how deep places lie behind the surface, and its normal there.
    allowed : callable, optional
        Gives in which places a dummy may be.
    """
    dim, deep = points.shape[1], layers * dx
    side = dx / FINE[dim]
    depth, normal = measure(points)
    within = (depth > -0.5 * side) & (depth < deep + 0.5 * side)
    points, cell, depth, normal = (part[within] for part in (points, cell, depth, normal))
    found_x, found_volume, wanted = [np.zeros((0, dim))], [np.zeros(0)], [np.zeros(0)]
    for k in range(layers):
        # how much of a fine cell lies in the layer: its depths spread by about its side
        share = np.minimum(depth + 0.5 * side, (k + 1) * dx) - np.maximum(depth - 0.5 * side, k * dx)
        some = np.flatnonzero((share > 0.0) & (cell > 0.0))
        # in its middle, or parts would lie one behind the other
        middle = points[some] + (depth[some] - (k + 0.5) * dx)[:, None] * normal[some]
        x, volume = divided(middle, cell[some] * share[some] / side, dx**dim)
        found_x.append(x)
        found_volume.append(volume)
        wanted.append(np.full(len(x), (k + 0.5) * dx))
    x, volume, target = (np.concatenate(part) for part in (found_x, found_volume, wanted))
    depth, normal = measure(x)
    moved = x + (depth - target)[:, None] * normal
    new, new_normal = measure(moved)
    better = np.abs(new - target) < np.abs(depth - target)
    if allowed is not None:
        better &= allowed(moved)
    x[better], depth[better], normal[better] = moved[better], new[better], new_normal[better]
    kept = np.isfinite(depth) & (depth > 0.0)
    return x[kept], volume[kept], normal[kept], depth[kept]


def _near(solid: Solid, domain: Domain, dx: float, layers: int) -> tuple[Array, Array]:
    """Return a fine lattice of points near a surface, and their volumes."""
    dim, fine, deep = len(domain.low), FINE[len(domain.low)], layers * dx
    low, high = (
        solid.corners.reshape(-1, dim).min(axis=0, initial=np.inf),
        solid.corners.reshape(-1, dim).max(axis=0, initial=-np.inf),
    )
    rows = []
    for a, h in enumerate(domain.spacing(dx)):
        place, width = _rows(domain.low[a], domain.high[a], float(h), 0, 0)
        for end in range(2):
            if domain.lets_out(a, end):
                more = (np.arange(layers) + 0.5) * dx
                place = np.append(place, domain.high[a] + more if end else domain.low[a] - more)
                width = np.append(width, np.full(layers, dx))
        order = np.argsort(place)
        close = order[(place[order] > low[a] - 2 * deep) & (place[order] < high[a] + 2 * deep)]
        rows.append((place[close], width[close]))
    offset = fine_cells(dim, fine)
    per_row = max(1, int(np.prod([len(place) for place, _ in rows[1:]])))
    step = max(1, CHUNK // per_row)
    found, volume = [np.zeros((0, dim))], [np.zeros(0)]
    for begin in range(0, len(rows[0][0]), step):
        block = [tuple(part[begin : begin + step] for part in rows[0]), *rows[1:]]
        x, cell = _product(block)
        width = np.stack(np.meshgrid(*(w for _, w in block), indexing="ij"), axis=-1).reshape(-1, dim)
        close = np.abs(solid.depth(domain.clamped(x), deep + dx, far=False)[0]) < deep + dx
        inner = x[close, None] + offset * width[close, None]
        found.append(inner.reshape(-1, dim))
        volume.append(np.repeat(cell[close] / fine**dim, fine**dim))
    points, volumes = np.concatenate(found), np.concatenate(volume)
    free = np.all(domain.beyond(points) == 0.0, axis=1)
    return points[free], volumes[free]


def fine_cells(dim: int, fine: int) -> Array:
    """Return the middles of so many cells per axis of the unit cell around the origin, shape (fine^dim, dim)."""
    along = (np.arange(fine) + 0.5) / fine - 0.5
    return np.stack(np.meshgrid(*[along] * dim, indexing="ij"), axis=-1).reshape(-1, dim)


def divided(points: Array, weight: Array, size: float) -> tuple[Array, Array]:
    """Return the middles of parts into which points fall, about ``size`` each, and how large they are.

    Lloyd's method, begun with parts of equal weight from repeated bisection.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
    weight : ndarray, shape (n,)
    size : float
        The weight of one part.
    """
    count = int(np.rint(weight.sum() / size)) if len(points) else 0
    if count == 0:
        return points[:0], weight[:0]
    middle = _bisected(points, weight, count)
    for _ in range(ROUNDS):
        middle, total = _parts(points, weight, middle)
    return middle, total


def _parts(points: Array, weight: Array, middle: Array) -> tuple[Array, Array]:
    """Return the middles and weights of what is nearest to each point; what nothing is nearest to is gone."""
    part = cKDTree(middle).query(points)[1]
    total = np.bincount(part, weight, len(middle))
    some = total > 0.0
    sums = np.column_stack([np.bincount(part, weight * column, len(middle)) for column in points.T])
    return sums[some] / total[some, None], total[some]


def _bisected(points: Array, weight: Array, count: int) -> Array:
    middle = []
    stack = [(np.arange(len(points)), count)]
    while stack:
        some, n = stack.pop()
        if n == 1 or len(some) < 2:
            middle.append(weight[some] @ points[some] / weight[some].sum())
            continue
        axis = np.argmax(np.ptp(points[some], axis=0))
        some = some[np.argsort(points[some, axis], kind="stable")]
        upto = np.cumsum(weight[some])
        cut = int(np.clip(np.searchsorted(upto, upto[-1] * (n // 2) / n), 1, len(some) - 1))
        stack += [(some[cut:], n - n // 2), (some[:cut], n // 2)]
    return np.array(middle)
