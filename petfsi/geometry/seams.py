"""Surfaces that reach around a periodic axis: where their two ends meet there is no wall.

Of two ends that coincide up to one period neither bounds fluid. Both are left out of the surface's walls; the lower
ones stay known as caps, because what is open along the axis is counted from far below, where they begin. The points
in which ends meet are one place: they stay so, and walls are neighbours across it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from petfsi.errors import SolveError
from petfsi.geometry.slabs import area_vectors
from petfsi.geometry.surfaces import occurrences, ridges

#: Ends meet within this part of the period.
MEET = 1e-9
#: Bodies nearer than about twice this part of a cell have nothing between them.
TOUCH = 2e-9
#: Whose bounding boxes are as near as this may touch, cells.
MARGIN = 1e-6
#: Spreads numbers over the unit interval.
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
#: Ends that come apart, or overlap, by more than this part of a cell are no longer taken as one.
APART = 0.02


@dataclass(frozen=True)
class Seams:
    """Which facets are walls, and what joins them around periodic axes.

    Attributes
    ----------
    walls : ndarray of int64, shape (n_walls,)
        The facets that are walls, ascending.
    caps : tuple of ndarray of int64
        Per axis the facets of the lower ends.
    place : ndarray of int64, shape (n_points,)
        The same for points in the same place up to whole periods: the first of them.
    level : ndarray of int64, shape (n_points, dim)
        How many periods a point lies above the lowest of its place.
    shell : ndarray of int64, shape (n_points,)
        The connected part of the surface that a point belongs to.
    """

    walls: np.ndarray
    caps: tuple[np.ndarray, ...]
    place: np.ndarray
    level: np.ndarray
    shell: np.ndarray

    @classmethod
    def nothing(cls, dim: int) -> Seams:
        """Return those of no surface."""
        no = np.zeros(0, dtype=np.int64)
        return cls(no, (no,) * dim, no, np.zeros((0, dim), dtype=np.int64), no)

    def closed(self, points: np.ndarray, period: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Return points with those of one place moved to their mean.

        Parameters
        ----------
        points : ndarray, shape (n_points, dim)
            m.
        period, dx : ndarray, shape (dim,)
            Of the grid, m.

        Raises
        ------
        SolveError
            If ends have come apart.
        """
        shared = np.flatnonzero(np.bincount(self.place, minlength=len(points))[self.place] > 1)
        if not len(shared):
            return points
        base = points[shared] - self.level[shared] * period
        _, first, number, count = np.unique(
            self.place[shared], return_index=True, return_inverse=True, return_counts=True
        )
        number = number.ravel()
        # about one of them, so that points that agree stay as they are to the last bit
        offset = base - base[first[number]]
        mean = np.column_stack([np.bincount(number, weights=column) for column in offset.T]) / count[:, None]
        gap = 2.0 * np.abs(offset - mean[number])
        if (gap / dx).max() > APART:
            raise SolveError(
                f"the two ends of a solid that meet at a periodic side have come apart by {gap.max():.2e} m, "
                f"{(gap / dx).max():.2g} cells: no force joins them. Supports that hold both alike do."
            )
        moved = points.copy()
        moved[shared] = (base[first] + mean)[number] + self.level[shared] * period
        return moved


def find_seams(points: np.ndarray, facets: np.ndarray, period: np.ndarray, periodic: np.ndarray) -> Seams:
    """Return where a surface meets itself around periodic axes.

    Ends are facets that lie in one plane across the axis, or of which each has its like, one period beyond. Those in
    planes may be divided differently, if their rims are alike.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        m.
    facets : ndarray of int, shape (m, dim)
        With normals out of the solid.
    period : ndarray, shape (dim,)
        m.
    periodic : ndarray of bool, shape (dim,)
    """
    dim = points.shape[1]
    if len(facets) == 0:
        return Seams.nothing(dim)
    is_wall = np.ones(len(facets), dtype=bool)
    none = np.zeros(0, dtype=np.int64)
    level, caps, pairs = np.zeros((len(points), dim), dtype=np.int64), [none] * dim, [np.zeros((2, 0), dtype=np.int64)]
    area = area_vectors(points, facets)
    used = np.unique(facets)
    for a in np.flatnonzero(periodic):
        low, high = _twins(points, used, a, period[a])
        if not len(low):
            continue
        twin = np.full(len(points), -1, dtype=np.int64)
        twin[low] = high
        lower, upper = _like_ends(facets, area, twin, a, is_wall)
        more = _flat_ends(points, facets, area, twin, a, period[a], is_wall & ~_marked(len(facets), lower, upper))
        lower, upper = np.concatenate((lower, more[0])), np.concatenate((upper, more[1]))
        is_wall[lower] = is_wall[upper] = False
        caps[a] = np.sort(lower)
        met = np.intersect1d(low, facets[lower])
        level[twin[met], a] = 1
        pairs.append(np.stack((met, twin[met])))
    place = _first_of(len(points), *np.concatenate(pairs, axis=1))
    edges = place[facets[:, [*range(1, dim), 0]]].ravel()
    shell = _first_of(len(points), np.append(place[facets].ravel(), place), np.append(edges, np.arange(len(points))))
    return Seams(np.flatnonzero(is_wall), tuple(caps), place, level, np.unique(shell, return_inverse=True)[1].ravel())


def _first_of(n: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return for n things the first of those that pairs connect with each."""
    graph = coo_matrix((np.ones(len(one), dtype=np.int8), (one, other)), shape=(n, n))
    _, first, group = np.unique(connected_components(graph, directed=False)[1], return_index=True, return_inverse=True)
    return first[group.ravel()]


def _twins(points: np.ndarray, used: np.ndarray, axis: int, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of points one period apart along an axis."""
    if len(used) == 0 or np.ptp(points[used, axis]) < period * (1.0 - MEET):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    beyond = points[used].copy()
    beyond[:, axis] += period
    distance, nearest = cKDTree(points[used]).query(beyond)
    met = np.flatnonzero(distance < MEET * period)
    return used[met], used[nearest[met]]


def _marked(n: int, *which: np.ndarray) -> np.ndarray:
    mask = np.zeros(n, dtype=bool)
    for part in which:
        mask[part] = True
    return mask


def _like_ends(
    facets: np.ndarray, area: np.ndarray, twin: np.ndarray, axis: int, is_wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the facets whose like, turned the other way, lies one period beyond, and those."""
    lower = np.flatnonzero(is_wall & np.all(twin[facets] >= 0, axis=1))
    wanted = np.sort(twin[facets[lower]], axis=1)
    upper = np.flatnonzero(is_wall & np.all(np.isin(facets, wanted), axis=1)) if len(lower) else lower
    rows, number = np.unique(np.concatenate((wanted, np.sort(facets[upper], axis=1))), axis=0, return_inverse=True)
    at = np.full(len(rows), -1, dtype=np.int64)
    at[number.ravel()[len(lower) :]] = upper
    other = at[number.ravel()[: len(lower)]]
    size = np.linalg.norm(area[lower], axis=1)
    met = (other >= 0) & (np.linalg.norm(area[lower] + area[other], axis=1) < 1e-6 * size)
    return lower[met], other[met]


def _flat_ends(
    points: np.ndarray, facets: np.ndarray, area: np.ndarray, twin: np.ndarray, axis: int, period: float,
    is_wall: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the facets of ends in planes across an axis whose rims are alike one period apart."""
    slack = MEET * period
    along = points[facets, axis]
    flat = is_wall & (np.ptp(along, axis=1) < slack) & (area[:, axis] != 0.0)
    lower, upper = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for sign in (1.0, -1.0):  # of solids, and of containers
        down, up = (np.flatnonzero(flat & (side * sign * area[:, axis] > 0.0)) for side in (-1.0, 1.0))
        while len(down):
            plane = along[down[0], 0]
            here = np.abs(along[down, 0] - plane) < slack
            there = np.abs(along[up, 0] - plane - period) < slack
            if _same_rim(facets[down[here]], facets[up[there]], twin):
                lower.append(down[here])
                upper.append(up[there])
            down = down[~here]
    return np.concatenate(lower), np.concatenate(upper)


def _same_rim(lower: np.ndarray, upper: np.ndarray, twin: np.ndarray) -> bool:
    """Return whether the edges (corners in 2D) of facets that lie between two of them leave the same rim."""
    rims = []
    for facets in (lower, upper):
        edges = ridges(facets).reshape(-1, facets.shape[1] - 1)
        rims.append(np.sort(edges[occurrences(edges) == 1], axis=1))
    if len(rims[0]) == 0 or rims[0].shape != rims[1].shape or np.any(twin[rims[0]] < 0):
        return False
    both = (np.unique(np.sort(rim, axis=1), axis=0) for rim in (twin[rims[0]], rims[1]))
    return np.array_equal(*both)


def together(first: Seams, second: Seams, n_points: int, n_facets: int) -> Seams:
    """Return the seams of two surfaces, one after the other; the first has so many points and facets."""
    return Seams(
        np.concatenate((first.walls, second.walls + n_facets)),
        tuple(np.concatenate((a, b + n_facets)) for a, b in zip(first.caps, second.caps, strict=True)),
        np.concatenate((first.place, second.place + n_points)),
        np.concatenate((first.level, second.level)),
        np.concatenate((first.shell, second.shell + (first.shell.max(initial=-1) + 1))),
    )


def overlapped(x: np.ndarray, facets: np.ndarray, seams: Seams, period: np.ndarray) -> np.ndarray:
    """Return points at which bodies that touch overlap a little, so that nothing is left between them.

    Where the bounding boxes of two shells' facets meet, their points move outward by next to nothing: each shell's by
    another amount, so that none of their faces can coincide.

    Parameters
    ----------
    x : ndarray, shape (n_points, dim)
        In units of cells.
    facets : ndarray of int, shape (m, dim)
        The walls.
    seams : Seams
    period : ndarray, shape (dim,)
        In cells; 0 along axes that do not repeat.
    """
    if not len(facets):
        return x
    low, high = x[facets].min(axis=1) - MARGIN, x[facets].max(axis=1) + MARGIN
    shell = seams.shell[facets[:, 0]]
    begin, end, shifts = _meeting(low, high, shell, period)
    near = np.flatnonzero(np.all((low <= end[shell]) & (high >= begin[shell]), axis=1))
    if not len(near):
        return x
    touches = np.zeros(len(near), dtype=bool)
    for shift in shifts:
        boxes = np.concatenate((low[near], low[near] + shift)), np.concatenate((high[near], high[near] + shift))
        _sweep(*boxes, shell[near], np.argsort(boxes[0][:, 0], kind="stable"), touches)
    # all points of one place move, or none
    moves = np.zeros(len(x), dtype=bool)
    moves[seams.place[facets[near[touches]]]] = True
    moving = np.flatnonzero(moves[seams.place])
    area = area_vectors(x, facets)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    unit = area / np.where(size > 0.0, size, 1.0)
    corners, dim = seams.place[facets].ravel(), x.shape[1]
    normal = np.column_stack([np.bincount(corners, np.repeat(n, dim), len(x)) for n in unit.T])[seams.place[moving]]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    amount = TOUCH * (1.0 + np.modf(GOLDEN * seams.shell[moving])[0])
    moved = x.copy()
    moved[moving] += amount[:, None] * normal / np.where(length > 0.0, length, 1.0)
    return moved


def _meeting(
    low: np.ndarray, high: np.ndarray, shell: np.ndarray, period: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return the box in which each shell, or one of its images, may meet others; low > high where it meets none.

    And by how much images are moved that meet any. A shell does not meet its own images: it is no longer than a period,
    and if it is as long it has no ends.
    """
    n, dim = int(shell.max()) + 1, low.shape[1]
    lows, highs = np.full((n, dim), np.inf), np.full((n, dim), -np.inf)
    np.minimum.at(lows, shell, low)
    np.maximum.at(highs, shell, high)
    begin, end, shifts = np.full((n, dim), np.inf), np.full((n, dim), -np.inf), []
    length = np.where(period > 0.0, period, 1.0)
    first = np.where(period > 0.0, np.ceil((low.min(axis=0) - high.max(axis=0)) / length), 0.0)
    for steps in itertools.product(*(np.arange(f, 1.0 - f) for f in first)):
        shift = np.array(steps) * period
        both_low = np.maximum(lows[:, None], lows + shift)
        both_high = np.minimum(highs[:, None], highs + shift)
        meets = np.all(both_low <= both_high, axis=2)
        np.fill_diagonal(meets, False)
        if meets.any():
            shifts.append(shift)
        np.minimum(begin, np.where(meets[:, :, None], both_low, np.inf).min(axis=1), out=begin)
        np.maximum(end, np.where(meets[:, :, None], both_high, -np.inf).max(axis=1), out=end)
    return begin, end, shifts


@njit(cache=True)
def _sweep(low, high, shell, order, touches):
    """Mark boxes of the first half that meet one of another shell in the second, and those."""
    n = len(shell)
    for a in range(len(order)):
        i = order[a]
        for b in range(a + 1, len(order)):
            j = order[b]
            if low[j, 0] > high[i, 0]:
                break
            if (i < n) == (j < n) or shell[i % n] == shell[j % n] or (touches[i % n] and touches[j % n]):
                continue
            meets = True
            for c in range(1, low.shape[1]):
                meets = meets and low[j, c] <= high[i, c] and low[i, c] <= high[j, c]
            if meets:
                touches[i % n] = touches[j % n] = True
