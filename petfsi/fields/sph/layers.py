"""Dummies behind any surface: layers of a fine lattice, divided into parts that are equal and compact.

Each layer's parts are a centroidal Voronoi division.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.lattices import product, spaced
from petfsi.fields.sph.solids import SAME, Array, Solid

#: Cells of the fine lattice along dx, by dimension.
FINE = {2: 6, 3: 3}
#: How often parts are divided anew.
ROUNDS = 6
#: So many points are looked at at once.
CHUNK = 1_000_000


def from_facets(
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
        place, width = spaced(domain.low[a], domain.high[a], float(h), 0, 0)
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
        x, cell = product(block)
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
