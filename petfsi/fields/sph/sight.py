"""Bodies thinner than particles see: pairs across them are struck, and what goes through them is put back.

A pair is struck if the open segment between the two crosses a thin facet. Whether it does follows from exact signs;
whatever is degenerate is settled by moving all particles by the same (e0, e1, e2) with infinitesimal e0 >> e1 >> e2 > 0
against the surfaces (see ``geometry.predicates``). So there is one answer for all pairs and facets together: no segment
slips between two facets that share a corner or an edge, what lies on a facet is on one side of it for everybody, and
it matters neither which rank asks nor which other rows there are. Everything else here only finds out quickly which
pairs and facets need not be asked about.

That is done twice over. Coarse cells about as wide as particles see hold clusters of facets, each between two parallel
planes; a particle notes above or below which clusters near it is, 32 bits for each, and two that are both above or both
below all that both are near to are told by one ``&``. For the others a segment is followed through fine cells.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from petfsi.fields.sph.cells import CellGrid, Pairs
from petfsi.geometry.predicates import _exact_height, _sign_of_sum, _two_product, above, side
from petfsi.geometry.surfaces import occurrences, ridges, shells

#: Fine cells along a coarse one's side.
FINE = 3
#: There are no more fine cells than this: they grow instead.
MOST_CELLS = 4_000_000
#: Coarse cells so far apart along an axis share a bit.
BITS = {2: 5, 3: 3}
#: So many facets that hid pairs last are looked at first.
HIDING = {2: 4, 3: 4}
#: Facets are sampled at this part of the reach.
SAMPLED = 0.25
#: Places nearer than this part of a length are the same.
SAME = 1e-9
#: What hangs on a facet is looked at from this part of the way to it before it.
BEFORE = 1e-6

# bounds of the plain formulas' rounding errors, relative to products of the largest lengths
_ROUNDING_2D, _ROUNDING_3D = 8e-15, 4e-14
_HALF = np.uint64(32)


class Crossings(NamedTuple):
    """Particles that went through a thin facet, and where to put them back.

    Attributes
    ----------
    rows : ndarray of int, shape (k,)
    facets : ndarray of int, shape (k,)
    x : ndarray, shape (k, dim)
        A little before the facet at its end, on the side that they came from, m.
    v : ndarray, shape (k, dim)
        Their velocities; relative to the facet they go away from it, m/s.
    """

    rows: np.ndarray
    facets: np.ndarray
    x: np.ndarray
    v: np.ndarray


class _Cells(NamedTuple):
    """What touches the cells of a box: items ``item[start[c]:start[c + 1]]``; a third axis in 2D has one cell."""

    low: tuple[float, float, float]
    inverse: tuple[float, float, float]
    counts: tuple[int, int, int]
    start: np.ndarray
    item: np.ndarray


_NOTHING = _Cells((0.0,) * 3, (0.0,) * 3, (0,) * 3, np.zeros(1, np.int64), np.zeros(0, np.int32))


class _Clusters(NamedTuple):
    """Facets of a coarse cell together: normal, heights of the planes, box, and bit."""

    normal: np.ndarray
    slab: np.ndarray
    box: np.ndarray
    bit: np.ndarray


class Sight:
    """What thin bodies hide.

    ``place`` it whenever pairs are listed, then strike what was listed; ``crossed`` needs no ``place``. Not collective:
    each rank looks at what is near to its own rows.

    Parameters
    ----------
    facets : ndarray of int, shape (m, dim)
        Of all surfaces together, the same on every rank; normals point into the fluid.
    thin : ndarray of bool, shape (m,)
        Which of them hide something, see ``thin_facets``.
    reach : float
        Support of the kernel and skin, m: as far as lists go.
    both_sides : ndarray of bool, shape (m,), optional
        Those wet on both sides, see ``thin_facets``: through others, only the way in is refused. By default none.
    grid : CellGrid, optional
        Along its periodic axes surfaces have images.
    """

    def __init__(self, facets, thin, reach: float, both_sides=None, grid: CellGrid | None = None):
        self._which = np.flatnonzero(thin)
        self._facets = np.asarray(facets)[self._which]
        self._both = np.zeros(len(self._which), bool) if both_sides is None else np.asarray(both_sides)[self._which]
        self.reach, self.dim = float(reach), np.shape(facets)[1]
        # as ghosts are moved, bit by bit
        self._period = np.zeros(self.dim) if grid is None else np.where(grid.periodic, grid.counts * grid.side, 0.0)
        self._corners = np.zeros((0, self.dim, self.dim))

    # ---- lists ----------------------------------------------------------------------------------------------------

    def place(self, points: np.ndarray, x: np.ndarray) -> None:
        """Take the present positions of the surfaces, and sort what is near into cells.

        Parameters
        ----------
        points : ndarray, shape (n_points, dim)
            m.
        x : ndarray, shape (n, dim)
            The rank's rows, ghosts included, m.
        """
        self._corners = self._corners[:0]
        if not len(x) or not len(self._which):
            return
        # where particles are, and feet of dummies
        low, high = _extent(x) + np.array([[-2.0], [2.0]]) * self.reach
        (self._corners,), _ = self._near([points], low, high)
        if len(self._corners):
            self._fine, coarse = self._make_cells([self._corners], low, high, self.reach)
            self._gather(*coarse)

    def strike(self, pairs: Pairs, x: np.ndarray) -> Pairs:
        """Return the pairs of particles that see each other: in the same memory, so ``pairs`` is not valid any more.

        Parameters
        ----------
        pairs : Pairs
            Of fluid rows, no longer than ``reach``.
        x : ndarray, shape (n, dim)
        """
        if not len(self._corners):
            return pairs
        near = self._words(x, SAME)
        n = _STRIKE[self.dim](pairs.start, pairs.other, x, near, self._fine, self._corners)
        return Pairs(pairs.start, pairs.other[:n])

    def strike_walls(self, pairs: Pairs, x, foot, normal, one_sided) -> Pairs:
        """Return the pairs of particles and dummies that see each other: in the same memory.

        A dummy is seen at its foot, past all facets but those that the foot lies on.

        Parameters
        ----------
        pairs : Pairs
            By fluid row the wall rows near it.
        x : ndarray, shape (n, dim)
            Of the fluid.
        foot, normal : ndarray, shape (n_wall, dim)
            Where dummies hang, m, and the unit normal there: into the fluid that they are for.
        one_sided : ndarray of bool, shape (n_wall,)
            Dummies of thin facets, whose places may be in the fluid behind: only seen from before the facet.
        """
        if not len(self._corners) and not one_sided.any():
            return pairs
        if len(self._corners):
            # feet on the outermost plane of a cluster are beyond it
            words, fine = (self._words(x, SAME), self._words(foot, -SAME)), self._fine
        else:
            words = np.zeros(len(x), np.uint64), np.zeros(len(foot), np.uint64)
            fine = _NOTHING
        args = x, foot, normal, one_sided, *words, fine, self._corners
        n = _STRIKE_WALLS[self.dim](pairs.start, pairs.other, *args)
        return Pairs(pairs.start, pairs.other[:n])

    def _words(self, x, same: float) -> np.ndarray:
        """Return for each point the bits of clusters near it that it may be above, and may be below, shape (n,)."""
        return _WORDS[self.dim](x, self._around, self._clusters, self.reach, same * self.reach)

    def _near(self, places, low, high) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the corners of facets and images whose boxes, over all ``places`` of the points, meet a box."""
        spans = []
        for a, period in enumerate(self._period):
            some = [p[self._facets, a] for p in places]
            least, most = min(s.min() for s in some), max(s.max() for s in some)
            first, last = (
                (math.ceil((low[a] - most) / period), math.floor((high[a] - least) / period)) if period else (0, 0)
            )
            spans.append(range(first, last + 1))
        found: list[list[np.ndarray]] = [[np.zeros((0, self.dim, self.dim))] for _ in places]
        numbers = [np.zeros(0, np.int64)]
        for step in itertools.product(*spans):
            corners = [(p + np.array(step) * self._period)[self._facets] for p in places]
            box_low, box_high = _boxes(corners)
            meets = _meeting(box_low, box_high, low, high)
            numbers.append(meets)
            for some, c in zip(found, corners, strict=True):
                some.append(c[meets])
        return [np.concatenate(some) for some in found], np.concatenate(numbers)

    def _make_cells(self, corners, low, high, margin: float):
        """Return fine cells of facets that are at these corners one after the other, and the coarse grid.

        Coarse cells cover the facets, as far as they are in the box, and ``margin`` around.
        """
        dim, (box_low, box_high) = self.dim, _boxes(corners)
        low = np.maximum(_extent(box_low)[0], low) - margin
        length = np.minimum(_extent(box_high)[1], high) + margin - low
        # facets longer than particles see would lie in too many cells
        wide = max(self.reach, _mean_width(box_low, box_high))
        wide, counts = _fitting(length, wide, FINE)
        fine = counts.copy()
        fine[:dim] *= FINE
        return _sorted_into(low, wide / FINE, fine, box_low, box_high), (low, wide, counts)

    def _gather(self, low, wide, counts) -> None:
        """Make clusters of the facets whose first corners share a coarse cell, and note near which cells they are."""
        dim = self.dim
        middle = (self._corners[:, 0] - low) / wide
        cell = np.clip(np.floor(middle).astype(np.int64), 0, counts[:dim] - 1)
        number = np.ravel_multi_index(tuple(cell.T), tuple(counts[:dim]))
        order = np.argsort(number, kind="stable")
        _, first = np.unique(number[order], return_index=True)
        bit = cell[order[first]] % BITS[dim] @ BITS[dim] ** np.arange(dim)
        normal, slab, box = _hull(self._corners, order, np.append(first, len(order)))
        self._clusters = _Clusters(normal, slab, box, bit.astype(np.uint64))
        self._around = _sorted_into(low, wide, counts, box[:, 0] - self.reach, box[:, 1] + self.reach)

    # ---- the guard ------------------------------------------------------------------------------------------------

    def crossed(
        self, x_before, x_after, v, points_before, points_after, dt: float, gap: float, owned=None
    ) -> Crossings:
        """Return which particles went through a thin facet, or are inside a thin body, after a drift.

        Both they and the surfaces' points go along straight lines at constant speed. What has come in is put back on
        its side, at the place of the facet that it first went through, its relative normal velocity reversed.

        Parameters
        ----------
        x_before, x_after, v : ndarray, shape (n, dim)
            Places before and after, m, and velocities after, m/s.
        points_before, points_after : ndarray, shape (n_points, dim)
            m.
        dt : float
            How long it took, s.
        gap : float
            How far before the facet they are put, m; less where something else is nearer.
        owned : ndarray of bool, shape (n,), optional
            Rows to look at; by default all.
        """
        dim = self.dim
        nothing = Crossings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, dim)), np.zeros((0, dim)))
        if not len(x_before) or not len(self._which):
            return nothing
        (low, high), (also_low, also_high) = _extent(x_before), _extent(x_after)
        low, high = np.minimum(low, also_low) - self.reach, np.maximum(high, also_high) + self.reach
        (before, after), number = self._near([points_before, points_after], low, high)
        if not len(number):
            return nothing
        cells, _ = self._make_cells([before, after], low, high, gap)
        owned = np.ones(len(x_before), dtype=bool) if owned is None else owned
        rows = _touching(x_before, x_after, owned, cells)
        args = x_before[rows], x_after[rows], v[rows], before, after, self._both[number], cells, dt, gap, self.reach
        facet, x, v = _put_back(*args)
        found = np.flatnonzero(facet >= 0)
        return Crossings(rows[found], self._which[number[facet[found]]], x[found], v[found])


def _boxes(corners) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest places (k, dim) of facets that are at all these corners (k, dim, dim)."""
    low, high = _box(corners[0])
    for other in corners[1:]:
        also_low, also_high = _box(other)
        low, high = np.minimum(low, also_low), np.maximum(high, also_high)
    return low, high


@njit(cache=True)
def _box(corners):
    """Return the lowest and highest places (k, dim) of points (k, n, dim): NumPy is slow at rows of few."""
    low, high = corners[:, 0].copy(), corners[:, 0].copy()
    for k in range(corners.shape[0]):
        for i in range(1, corners.shape[1]):
            for a in range(corners.shape[2]):
                low[k, a], high[k, a] = min(low[k, a], corners[k, i, a]), max(high[k, a], corners[k, i, a])
    return low, high


@njit(cache=True)
def _meeting(box_low, box_high, low, high):
    """Return which boxes meet another one."""
    found, n = np.empty(len(box_low), np.int64), 0
    for k in range(len(box_low)):
        meets = True
        for a in range(box_low.shape[1]):
            meets &= box_low[k, a] <= high[a] and box_high[k, a] >= low[a]
        if meets:
            found[n] = k
            n += 1
    return found[:n]


@njit(cache=True)
def _mean_width(box_low, box_high):
    """Return the mean of the boxes' longest sides."""
    total = 0.0
    for k in range(len(box_low)):
        longest = 0.0
        for a in range(box_low.shape[1]):
            longest = max(longest, box_high[k, a] - box_low[k, a])
        total += longest
    return total / len(box_low)


def _extent(x) -> np.ndarray:
    """Return the lowest and the highest place of points (n, dim), shape (2, dim)."""
    low, high = _box(np.ascontiguousarray(x)[None])
    return np.concatenate((low, high))


def _fitting(length, wide: float, fine: int) -> tuple[float, np.ndarray]:
    """Return the side of a box's cells, ``wide`` unless they were too many then, and how many there are, shape (3,)."""
    counts = np.ones(3, dtype=np.int64)
    while True:
        wanted = np.ceil(np.maximum(length, SAME * wide) / wide)
        if np.prod(fine * wanted) <= MOST_CELLS:
            counts[: len(length)] = wanted
            return wide, counts
        wide *= 1.5


def _sorted_into(low, wide: float, counts, box_low, box_high) -> _Cells:
    """Return the cells of a grid with the numbers of the boxes that touch them; a cell reaches a little farther."""
    n, dim = box_low.shape
    first, last = np.zeros((n, 3), np.int64), np.zeros((n, 3), np.int64)
    for out, box, more in ((first, box_low, -SAME), (last, box_high, SAME)):
        out[:, :dim] = np.clip(np.floor((box - low) / wide + more), 0, counts[:dim] - 1)
    rest = 3 - dim
    origin, inverse = (*map(float, low), *[0.0] * rest), (*[1.0 / wide] * dim, *[1.0] * rest)
    return _Cells(origin, inverse, tuple(map(int, counts)), *_bucket(first, last, counts))  # type: ignore[arg-type]


@njit(cache=True)
def _bucket(first, last, counts):
    """Return, by cell, the boxes that reach from cell ``first`` to ``last`` (n, 3), both included."""
    start = np.zeros(counts[0] * counts[1] * counts[2] + 2, np.int64)
    item = np.empty(0, np.int32)
    for filling in range(2):
        for k in range(len(first)):
            for a in range(first[k, 0], last[k, 0] + 1):
                for b in range(first[k, 1], last[k, 1] + 1):
                    line = (a * counts[1] + b) * counts[2]
                    for c in range(line + first[k, 2], line + last[k, 2] + 1):
                        if filling:
                            item[start[c + 1]] = k
                            start[c + 1] += 1
                        else:
                            start[c + 2] += 1
        if not filling:
            start[:] = np.cumsum(start)
            item = np.empty(start[-1], np.int32)
    return start[:-1], item


@njit(cache=True)
def _normal(corner):
    """Return the normal of a facet (dim, dim) as three numbers, as long as a segment, or as twice the area."""
    e0, e1 = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1]
    if corner.shape[0] == 2:
        return e1, -e0, 0.0
    e2 = corner[1, 2] - corner[0, 2]
    f0, f1, f2 = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    return e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0


@njit(cache=True)
def _hull(corners, order, first):
    """Return normal (n, dim), heights (n, 2) and box (n, 2, dim) of clusters ``order[first[c]:first[c + 1]]``."""
    n, dim = len(first) - 1, corners.shape[1]
    normal, slab, box = np.zeros((n, dim)), np.empty((n, 2)), np.empty((n, 2, dim))
    for c in range(n):
        mine = normal[c]
        for f in order[first[c] : first[c + 1]]:
            one = _normal(corners[f])
            same = 0.0
            for a in range(dim):
                same += one[a] * mine[a]
            for a in range(dim):
                mine[a] += one[a] if same >= 0.0 else -one[a]
        # two neighbours share a bit more often to their use if their normals agree
        mine *= np.sign(mine[np.argmax(np.abs(mine))]) / max(np.sqrt(np.sum(mine**2)), 1e-300)
        slab[c], box[c, 0], box[c, 1] = (np.inf, -np.inf), np.inf, -np.inf
        for f in order[first[c] : first[c + 1]]:
            for k in range(dim):
                height = 0.0
                for a in range(dim):
                    height += mine[a] * corners[f, k, a]
                    box[c, 0, a] = min(box[c, 0, a], corners[f, k, a])
                    box[c, 1, a] = max(box[c, 1, a], corners[f, k, a])
                slab[c, 0], slab[c, 1] = min(slab[c, 0], height), max(slab[c, 1], height)
    return normal, slab, box


# ---- compiled for 2 and for 3 dimensions ----------------------------------------------------------------------------


@njit(cache=True, inline="always")
def _surely_2d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1; 2 if rounding might matter."""
    d0, d1 = q0 - p0, q1 - p1
    a0, a1, b0, b1 = corners[f, 0, 0] - p0, corners[f, 0, 1] - p1, corners[f, 1, 0] - p0, corners[f, 1, 1] - p1
    size = abs(d0) + abs(d1)
    bound = _ROUNDING_2D * (size + abs(a0) + abs(a1)) * (size + abs(b0) + abs(b1))
    # on which side of the line p q the corners are
    s, t = d0 * a1 - d1 * a0, d0 * b1 - d1 * b0
    if (s > bound and t > bound) or (s < -bound and t < -bound):
        return 0
    # on which side of the facet p and q are
    u = a0 * b1 - a1 * b0
    w = u + s - t
    if (u > bound and w > bound) or (u < -bound and w < -bound):
        return 0
    if min(abs(s), abs(t)) > bound and min(abs(u), abs(w)) > bound:
        return 1
    return 2


@njit(cache=True)
def _exactly_2d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f."""
    a0, a1, b0, b1 = corners[f, 0, 0], corners[f, 0, 1], corners[f, 1, 0], corners[f, 1, 1]
    if side(p0, p1, a0, a1, b0, b1, True) == side(q0, q1, a0, a1, b0, b1, True):
        return False
    # that p and q move by e is that the corners move by -e
    return side(-a0, -a1, -p0, -p1, -q0, -q1, True) != side(-b0, -b1, -p0, -p1, -q0, -q1, True)


@njit(cache=True, inline="always")
def _surely_3d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1; 2 if rounding might matter."""
    d0, d1, d2 = q0 - p0, q1 - p1, q2 - p2
    a0, a1, a2 = corners[f, 0, 0] - p0, corners[f, 0, 1] - p1, corners[f, 0, 2] - p2
    b0, b1, b2 = corners[f, 1, 0] - p0, corners[f, 1, 1] - p1, corners[f, 1, 2] - p2
    c0, c1, c2 = corners[f, 2, 0] - p0, corners[f, 2, 1] - p1, corners[f, 2, 2] - p2
    size = abs(d0) + abs(d1) + abs(d2)
    size += max(abs(a0) + abs(a1) + abs(a2), abs(b0) + abs(b1) + abs(b2), abs(c0) + abs(c1) + abs(c2))
    bound = _ROUNDING_3D * size * size * size
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    # on which side of each edge the line p q passes
    s = d0 * n0 + d1 * n1 + d2 * n2
    t = d0 * (c1 * a2 - c2 * a1) + d1 * (c2 * a0 - c0 * a2) + d2 * (c0 * a1 - c1 * a0)
    u = d0 * (a1 * b2 - a2 * b1) + d1 * (a2 * b0 - a0 * b2) + d2 * (a0 * b1 - a1 * b0)
    low, high = min(s, t, u), max(s, t, u)
    if low < -bound and high > bound:
        return 0
    # on which side of the facet p and q are
    v = a0 * n0 + a1 * n1 + a2 * n2
    w = v - (s + t + u)
    if (v > bound and w > bound) or (v < -bound and w < -bound):
        return 0
    if (low > bound or high < -bound) and min(abs(v), abs(w)) > bound:
        return 1
    return 2


@njit(cache=True)
def _exactly_3d(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f."""
    p, q, corner = np.array([p0, p1, p2]), np.array([q0, q1, q2]), corners[f]
    if above(p, corner) == above(q, corner):
        return False
    first = _past_edge(p, q, corner[0], corner[1])
    return first == _past_edge(p, q, corner[1], corner[2]) and first == _past_edge(p, q, corner[2], corner[0])


@njit(cache=True)
def _exactly(p0, p1, p2, q0, q1, q2, corners, f):
    """Return whether the segment from p to q crosses facet f, 0 or 1."""
    if corners.shape[1] == 2:
        return int(_exactly_2d(p0, p1, p2, q0, q1, q2, corners, f))
    return int(_exactly_3d(p0, p1, p2, q0, q1, q2, corners, f))


@njit(cache=True)
def _past_edge(p, q, a, b):
    """Return the sign of det(q - p, a - p, b - p) for moved p and q; 0 only if p q and a b are parallel."""
    rows = np.empty((3, 3))
    rows[0], rows[1], rows[2] = p, q, a
    sign = _exact_height(b, rows)
    for k in range(3):
        if sign == 0:  # the derivative: (q - p) x (b - a) along each axis in turn
            i, j = (k + 1) % 3, (k + 2) % 3
            sign = _exact_cross(p[i], q[i], a[j], b[j], p[j], q[j], a[i], b[i])
    return sign


@njit(cache=True)
def _exact_cross(p0, q0, a1, b1, p1, q1, a0, b0):
    """Return the sign of (q0 - p0) (b1 - a1) - (q1 - p1) (b0 - a0)."""
    left, right = (q0, -q0, -p0, p0, -q1, q1, p1, -p1), (b1, a1, b1, a1, b0, a0, b0, a0)
    parts = np.empty(16)
    for i in range(8):
        parts[2 * i], parts[2 * i + 1] = _two_product(left[i], right[i])
    return _sign_of_sum(parts)


@njit(cache=True, inline="always")
def _span(s, t, count):
    """Return the first and last of so many cells between s and t, in units of cells."""
    low, high = (s, t) if s < t else (t, s)
    return np.int64(np.floor(max(low, 0.0))), np.int64(np.floor(min(high, count - 0.5)))


@njit(cache=True, inline="always")
def _part(p, inverse, cell, only, begin, end):
    """Return between what t of ``begin`` to ``end`` the coordinate p + t / inverse is in a cell."""
    if only:
        return begin, end
    s, t = (cell - p) * inverse, (cell + 1 - p) * inverse
    return max(begin, min(s, t)), min(end, max(s, t))


def _compile_blocked(dim):
    @njit(cache=True, error_model="numpy")
    def blocked(p0, p1, p2, q0, q1, q2, cells, corners):
        """Return a facet that crosses the segment from p to q, of those in the cells that it goes through, else -1."""
        low, inverse, counts, start, item = cells
        x, y, z = (p0 - low[0]) * inverse[0], (p1 - low[1]) * inverse[1], (p2 - low[2]) * inverse[2]
        d, e, f = (q0 - p0) * inverse[0], (q1 - p1) * inverse[1], (q2 - p2) * inverse[2]
        # where the segment is in one cell along an axis, its inverse is not needed
        inverse_d, inverse_e = 1.0 / d, 1.0 / e
        first, last = _span(x, x + d, counts[0])
        only = np.floor(x) == np.floor(x + d)
        for a in range(first, last + 1):
            t0, t1 = _part(x, inverse_d, a, only, 0.0, 1.0)
            first_b, last_b = _span(y + t0 * e, y + t1 * e, counts[1])
            # cells along the last axis are one run
            begin, end = a * counts[1] + first_b, a * counts[1] + last_b + 1
            for b in range(first_b if dim == 3 else last_b, last_b + 1):
                if dim == 3:
                    s0, s1 = _part(y, inverse_e, b, np.floor(y) == np.floor(y + e), t0, t1)
                    first_c, last_c = _span(z + s0 * f, z + s1 * f, counts[2])
                    line = (a * counts[1] + b) * counts[2]
                    begin, end = line + first_c, line + last_c + 1
                if begin < end:
                    for k in range(start[begin], start[end]):
                        if dim == 2:
                            crosses = _surely_2d(p0, p1, p2, q0, q1, q2, corners, item[k])
                        else:
                            crosses = _surely_3d(p0, p1, p2, q0, q1, q2, corners, item[k])
                        if crosses == 2:
                            crosses = _exactly(p0, p1, p2, q0, q1, q2, corners, item[k])
                        if crosses == 1:
                            return np.int64(item[k])
        return np.int64(-1)

    return blocked


# by their names: what closes over compiled functions is not found again in Numba's cache on disk
_blocked_2d, _blocked_3d = _compile_blocked(2), _compile_blocked(3)


def _compile_words(dim):
    @njit(cache=True)
    def words(x, cells, clusters, reach, same):
        """Return the bits of where points may be: above (the lower half of a word) and below clusters."""
        low, inverse, counts, start, item = cells
        normal, slab, box, bit = clusters
        word = np.zeros(len(x), np.uint64)
        one = np.uint64(1)
        for i in range(len(x)):
            c, there = 0, True
            for a in range(dim):
                place = (x[i, a] - low[a]) * inverse[a]
                there &= 0.0 <= place < counts[a]
                c = c * counts[a] + np.int64(place if there else 0.0)
            if not there:
                continue
            for k in range(start[c], start[c + 1]):
                m = item[k]
                height = 0.0
                for a in range(dim):
                    height += normal[m, a] * x[i, a]
                near = slab[m, 0] - reach <= height <= slab[m, 1] + reach
                for a in range(dim):
                    near &= box[m, 0, a] - reach <= x[i, a] <= box[m, 1, a] + reach
                if near:
                    if height >= slab[m, 0] - same:
                        word[i] |= one << bit[m]
                    if height <= slab[m, 1] + same:
                        word[i] |= one << (bit[m] + _HALF)
        return word

    return words


_WORDS = {dim: _compile_words(dim) for dim in (2, 3)}


def _compile_strike(dim):
    z, most = dim - 1, HIDING[dim]

    @njit(cache=True)
    def strike(start, other, x, word, cells, corners):
        """Strike pairs of particles; return how many are left."""
        kept, begin = start[0], start[0]
        # what hid the last ones mostly hides the next, too
        hiding, n_hiding = np.zeros(most, np.int64), 0
        for i in range(len(start) - 1):
            end = start[i + 1]
            across = word[i] >> _HALF | word[i] << _HALF
            if across == 0:
                if kept != begin:
                    for k in range(begin, end):
                        other[kept + k - begin] = other[k]
                kept += end - begin
                begin, start[i + 1] = end, kept
                continue
            p0, p1, p2 = x[i, 0], x[i, 1], x[i, z]
            for k in range(begin, end):
                j = other[k]
                if across & word[j] != 0:
                    q0, q1, q2 = x[j, 0], x[j, 1], x[j, z]
                    h, crosses = 0, 0
                    while h < n_hiding:
                        if dim == 2:
                            crosses = _surely_2d(p0, p1, p2, q0, q1, q2, corners, hiding[h])
                        else:
                            crosses = _surely_3d(p0, p1, p2, q0, q1, q2, corners, hiding[h])
                        if crosses == 1:
                            break
                        h += 1
                    if h == n_hiding:
                        if dim == 2:
                            f = _blocked_2d(p0, p1, p2, q0, q1, q2, cells, corners)
                        else:
                            f = _blocked_3d(p0, p1, p2, q0, q1, q2, cells, corners)
                        if f < 0:
                            other[kept] = j
                            kept += 1
                            continue
                        n_hiding = min(n_hiding + 1, hiding.size)
                        h = n_hiding - 1
                    else:
                        f = hiding[h]
                    if h > 0:
                        hiding[h] = hiding[h // 2]
                        hiding[h // 2] = f
                    else:
                        hiding[0] = f
                else:
                    other[kept] = j
                    kept += 1
            begin, start[i + 1] = end, kept
        return kept

    return strike


_STRIKE = {dim: _compile_strike(dim) for dim in (2, 3)}


def _compile_strike_walls(dim):
    z = dim - 1

    @njit(cache=True)
    def strike_walls(start, other, x, foot, normal, one_sided, word, word_foot, cells, corners):
        """Strike pairs of particles and dummies; return how many are left."""
        kept, begin = start[0], start[0]
        y = np.zeros(dim)
        for i in range(len(start) - 1):
            end = start[i + 1]
            across = word[i] >> _HALF | word[i] << _HALF
            for k in range(begin, end):
                d = other[k]
                height = 0.0
                for a in range(dim):
                    height += (x[i, a] - foot[d, a]) * normal[d, a]
                seen = height > 0.0 or not one_sided[d]
                # what is seen round a bend may be farther than words tell
                if seen and (across & word_foot[d] != 0 or height <= 0.0):
                    for a in range(dim):
                        y[a] = foot[d, a] + BEFORE * (x[i, a] - foot[d, a])
                    if dim == 2:
                        seen = _blocked_2d(x[i, 0], x[i, 1], x[i, z], y[0], y[1], y[z], cells, corners) < 0
                    else:
                        seen = _blocked_3d(x[i, 0], x[i, 1], x[i, z], y[0], y[1], y[z], cells, corners) < 0
                if seen:
                    other[kept] = d
                    kept += 1
            begin, start[i + 1] = end, kept
        return kept

    return strike_walls


_STRIKE_WALLS = {dim: _compile_strike_walls(dim) for dim in (2, 3)}


# ---- the guard, compiled --------------------------------------------------------------------------------------------


@njit(cache=True)
def _minus(u, v):
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(cache=True)
def _plus(u, t, v):
    """Return u + t v."""
    return u[0] + t * v[0], u[1] + t * v[1], u[2] + t * v[2]


@njit(cache=True)
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True)
def _point(x):
    """Return three coordinates of a point, in the plane z = 0 in 2D."""
    return x[0], x[1], x[2] if x.size == 3 else 0.0


@njit(cache=True)
def _frame(corner):
    """Return a facet's first corner and the way to the others; in 2D as that of a wall along z."""
    a, b = _point(corner[0]), _point(corner[1])
    if corner.shape[0] == 2:
        return a, _minus(b, a), (0.0, 0.0, 1.0)
    return a, _minus(b, a), _minus(_point(corner[2]), a)


@njit(cache=True)
def _weights(w, e, f):
    """Return the last two barycentric coordinates of the foot of a + w on the triangle a, a + e, a + f; if inside."""
    n = _cross(e, f)
    nn = _dot(n, n)
    if nn == 0.0:
        return 0.0, 0.0, False
    s, t = _dot(_cross(w, f), n) / nn, _dot(_cross(e, w), n) / nn
    return s, t, min(s, t, 1.0 - s - t) >= -SAME


@njit(cache=True)
def _turning_points(c1, c2, c3):
    """Return where the derivative c1 + 2 c2 t + 3 c3 t^2 is zero, in order; 1 where it is not."""
    q = c2 * c2 - 3.0 * c1 * c3
    if q <= 0.0:
        return 1.0, 1.0
    q = -c2 - np.copysign(np.sqrt(q), c2)
    s = c1 / q if abs(c1) < abs(q) else 1.0
    t = q / (3.0 * c3) if abs(q) < abs(3.0 * c3) else 1.0
    return min(s, t), max(s, t)


@njit(cache=True)
def _passage(x0, x1, before, after, both):
    """Return when a particle first comes through a facet from before it, or, if ``both``, from any side.

    The height over the moving facet, times its area, is a polynomial of degree dim in time; at both ends it is taken
    from the places there, so that one drift begins as the one before ended.

    Returns
    -------
    t : float
        Part of the drift; 2 if it does not.
    from_front : bool
    s, w : float
        The last two barycentric coordinates of the place.
    """
    (a0, e0, f0), (a1, e1, f1) = _frame(before), _frame(after)
    w0, w1, n0 = _minus(x0, a0), _minus(x1, a1), _cross(e0, f0)
    at_0, at_1 = _dot(w0, n0), _dot(w1, _cross(e1, f1))
    dw, de, df = _minus(w1, w0), _minus(e1, e0), _minus(f1, f0)
    n1, n2 = _plus(_cross(de, f0), 1.0, _cross(e0, df)), _cross(de, df)
    c1, c2, c3 = _dot(w0, n1) + _dot(dw, n0), _dot(w0, n2) + _dot(dw, n1), _dot(dw, n2)
    first, second = _turning_points(c1, c2, c3)
    begin, height = 0.0, at_0
    for end in (first, second, 1.0):
        if not begin < end <= 1.0:
            continue
        next_height = at_1 if end == 1.0 else at_0 + end * (c1 + end * (c2 + end * c3))
        front = height >= 0.0
        if front != (next_height >= 0.0) and (front or both):
            t, last = begin, end
            for _ in range(52):  # between turning points there is one root
                middle = 0.5 * (t + last)
                if (at_0 + middle * (c1 + middle * (c2 + middle * c3)) >= 0.0) == front:
                    t = middle
                else:
                    last = middle
            s, w, inside = _weights(_plus(w0, t, dw), _plus(e0, t, de), _plus(f0, t, df))
            if inside:
                return t, front, s, w
        begin, height = end, next_height
    return 2.0, True, 0.0, 0.0


@njit(cache=True)
def _range(p, q, cells, dim, first, last):
    """Write from which to which cell the box around two points reaches; return whether it meets the grid."""
    for a in range(dim):
        s, t = (p[a] - cells.low[a]) * cells.inverse[a], (q[a] - cells.low[a]) * cells.inverse[a]
        if not (max(s, t) >= 0.0 and min(s, t) < cells.counts[a]):
            return False
        first[a], last[a] = _span(s, t, cells.counts[a])
    return True


@njit(cache=True)
def _facets_near(p, q, cells, dim, found, mark, query):
    """Write the facets in the cells around two points, each once; return how many they are."""
    first, last, n = np.zeros(3, np.int64), np.zeros(3, np.int64), 0
    if _range(p, q, cells, dim, first, last):
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * cells.counts[1] + b) * cells.counts[2]
                for k in range(cells.start[line + first[2]], cells.start[line + last[2] + 1]):
                    f = cells.item[k]
                    if mark[f] != query:
                        mark[f], found[n] = query, f
                        n += 1
    return n


@njit(cache=True)
def _touching(x0, x1, owned, cells):
    """Return the rows whose ways come into cells with facets."""
    rows, n, dim = np.empty(len(x0), np.int64), 0, x0.shape[1]
    low, inverse, counts, start, _ = cells
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(len(x0)):
        inside = owned[i]
        for a in range(dim):
            s, t = (x0[i, a] - low[a]) * inverse[a], (x1[i, a] - low[a]) * inverse[a]
            inside &= max(s, t) >= 0.0 and min(s, t) < counts[a]
            if not inside:
                break
            first[a], last[a] = _span(s, t, counts[a])
        if not inside:
            continue
        some = False
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * counts[1] + b) * counts[2]
                some |= start[line + first[2]] < start[line + last[2] + 1]
        if some:
            rows[n] = i
            n += 1
    return rows[:n]


@njit(cache=True)
def _nearest_behind(x, found, after, both, reach):
    """Return the facet of a closed body next to a point, and where on it; -1 if the point is before it, or none is."""
    best, least, at, before = np.int64(-1), reach, (0.0, 0.0), False
    for f in found:
        if both[f]:
            continue
        a, e, g = _frame(after[f])
        n, w = _cross(e, g), _minus(x, a)
        height, nn = _dot(w, n), _dot(n, n)
        if nn == 0.0 or height * height > least * least * nn:
            continue
        s, t, inside = _weights(w, e, g)
        if inside:
            distance = abs(height) / np.sqrt(nn)
            if distance < least or height >= 0.0 or (not before and f < best):
                best, least, at, before = np.int64(f), distance, (s, t), height >= 0.0
    return np.int64(-1) if before else best, at[0], at[1]


@njit(cache=True)
def _on_facet(before, after, s, t, dt):
    """Return where a place of a facet is at the end, a little inside of the rim, its velocity, and the unit normal."""
    (a0, e0, f0), (a1, e1, f1) = _frame(before), _frame(after)
    dim = after.shape[0]
    s = 0.99 * min(max(s, 0.0), 1.0) + 0.01 / dim
    t = 0.0 if dim == 2 else 0.99 * min(max(t, 0.0), 1.0) + 0.01 / dim
    y, start = _plus(_plus(a1, s, e1), t, f1), _plus(_plus(a0, s, e0), t, f0)
    n, u = _cross(e1, f1), _minus(y, start)
    size = np.sqrt(_dot(n, n))
    return y, (u[0] / dt, u[1] / dt, u[2] / dt), (n[0] / size, n[1] / size, n[2] / size)


@njit(cache=True)
def _first_passage(p, q, found, before, after, both):
    dim = before.shape[1]
    best, from_front, at, soonest = np.int64(-1), True, (0.0, 0.0), 2.0
    for f in found:
        apart = False
        for a in range(dim):
            low, high = before[f, 0, a], before[f, 0, a]
            for k in range(dim):
                low = min(low, before[f, k, a], after[f, k, a])
                high = max(high, before[f, k, a], after[f, k, a])
            more = SAME * (high - low)
            apart |= max(p[a], q[a]) < low - more or min(p[a], q[a]) > high + more
        if not apart:
            t, front, s, w = _passage(p, q, before[f], after[f], both[f])
            if t < soonest or (t == soonest and t < 2.0 and f < best):
                best, from_front, at, soonest = np.int64(f), front, (s, w), t
    return best, from_front, at[0], at[1]


@njit(cache=True)
def _is_inside(y, q, found, after, both):
    """Return whether the way from y crosses the surfaces of closed bodies an odd number of times."""
    odd = False
    for f in found:
        if both[f]:
            continue
        if after.shape[1] == 2:
            crosses = _surely_2d(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        else:
            crosses = _surely_3d(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        if crosses == 2:
            crosses = _exactly(y[0], y[1], y[2], q[0], q[1], q[2], after, f)
        odd ^= crosses == 1
    return odd


@njit(cache=True)
def _is_blocked(p, q, cells, corners):
    if corners.shape[1] == 2:
        return _blocked_2d(*p, *q, cells, corners) >= 0
    return _blocked_3d(*p, *q, cells, corners) >= 0


@njit(cache=True)
def _put_back(x0, x1, v, before, after, both, cells, dt, gap, reach):
    """Return the facet that each particle went through or is behind, else -1, its place, and its velocity."""
    dim = x0.shape[1]
    facet, x, v = np.full(len(x0), -1, np.int64), x1.copy(), v.copy()
    mark, found, query = np.full(len(before), -1, np.int64), np.empty(len(before), np.int64), 0
    for i in range(len(x0)):
        p, q = _point(x0[i]), _point(x1[i])
        n = _facets_near(p, q, cells, dim, found, mark, query)
        query += 1
        best, front, s, t = _first_passage(p, q, found[:n], before, after, both)
        if best < 0:
            best, s, t = _nearest_behind(q, found[:n], after, both, reach)
            if best >= 0:
                y, u, normal = _on_facet(before[best], after[best], s, t, dt)
                y = _plus(y, BEFORE * gap, normal)
                n = _facets_near(y, q, cells, dim, found, mark, query)
                query += 1
                if not _is_inside(y, q, found[:n], after, both):
                    best = -1
        if best < 0:
            continue
        y, u, normal = _on_facet(before[best], after[best], s, t, dt)
        if not front:
            normal = _minus((0.0, 0.0, 0.0), normal)
        step = gap
        near, there = _plus(y, BEFORE * gap, normal), _plus(y, gap, normal)
        while step > 1e-3 * gap and _is_blocked(near, there, cells, after):
            step *= 0.5
            there = _plus(y, step, normal)
        speed = _dot(_minus(_point(v[i]), u), normal)
        facet[i] = best
        for a in range(dim):
            x[i, a] = there[a]
            if speed < 0.0:
                v[i, a] -= 2.0 * speed * normal[a]
    return facet, x, v


# ---- which facets are thin ------------------------------------------------------------------------------------------


def thin_facets(points: np.ndarray, facets: np.ndarray, reach: float) -> np.ndarray:
    """Return which facets hide something nearer than ``reach``, shape (m,) bool.

    Those that have another facet, which faces away from them, less than ``reach`` (m) behind them, what closes the gap
    between such at a rim, and all of open shells. Sampled, so what is just as thick as ``reach`` may be either.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        At rest, m.
    facets : ndarray of int, shape (m, dim)
    reach : float
    """
    backed = _backed(points, facets, reach)
    part = np.zeros(len(points), dtype=bool)
    part[facets[backed]] = True
    return np.all(part[facets], axis=1) | _in_open_shells(points, facets)


def wet_on_both_sides(points: np.ndarray, facets: np.ndarray, reach: float) -> np.ndarray:
    """Return which facets are single sheets: in open shells, with none behind them that faces away, shape (m,) bool."""
    return _in_open_shells(points, facets) & ~_backed(points, facets, reach)


def _in_open_shells(points, facets) -> np.ndarray:
    if not len(facets):
        return np.zeros(0, dtype=bool)
    dim = facets.shape[1]
    rim = np.any(occurrences(ridges(facets).reshape(-1, dim - 1)).reshape(-1, dim) == 1, axis=1)
    label, volume = shells(points, facets)
    return np.bincount(label, rim, len(volume))[label] > 0


def _backed(points, facets, reach: float) -> np.ndarray:
    """Return which facets have another within reach that faces away, each behind the other."""
    if not len(facets):
        return np.zeros(0, dtype=bool)
    corners = points[facets]
    sample, facet = _samples(corners, SAMPLED * reach)
    low, high = _extent(sample)
    wide, counts = _fitting(high - low, reach, 1)
    # the distance between samples is longer than that of two planes, by this at most
    reach *= np.hypot(1.0, 0.5 * SAMPLED)
    return _find_backs(corners, sample, facet, _sorted_into(low, wide, counts, sample, sample), reach)


@njit(cache=True)
def _samples(corners, spacing):
    """Return points inside of facets (m, dim, dim), about so far apart, and their facets."""
    m, dim = corners.shape[:2]
    parts, n = np.empty(m, np.int64), 0
    for f in range(m):
        longest = 0.0
        for k in range(dim):
            longest = max(longest, np.sqrt(np.sum((corners[f, k] - corners[f, k - 1]) ** 2)))
        parts[f] = max(1, np.ceil(longest / spacing))
        n += parts[f] if dim == 2 else parts[f] * (parts[f] + 1) // 2
    sample, facet, n = np.empty((n, dim)), np.empty(n, np.int64), 0
    for f in range(m):
        for i in range(parts[f]):
            for j in range(1 if dim == 2 else parts[f] - i):
                s, t = (i + 1.0 / dim) / parts[f], (j + 1.0 / dim) / parts[f]
                for a in range(dim):
                    sample[n, a] = corners[f, 0, a] + s * (corners[f, 1, a] - corners[f, 0, a])
                    if dim == 3:
                        sample[n, a] += t * (corners[f, dim - 1, a] - corners[f, 0, a])
                facet[n] = f
                n += 1
    return sample, facet


@njit(cache=True)
def _find_backs(corners, sample, facet, cells, reach):
    m, dim = corners.shape[:2]
    normal, backed = np.zeros((m, 3)), np.zeros(m, np.bool_)
    for f in range(m):
        n = _normal(corners[f])
        size = max(np.sqrt(_dot(n, n)), 1e-300)
        normal[f] = n[0] / size, n[1] / size, n[2] / size
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(len(sample)):
        f, x = facet[i], _point(sample[i])
        if backed[f]:
            continue
        far = (reach, reach, reach)
        _range(_plus(x, 1.0, far), _minus(x, far), cells, dim, first, last)
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * cells.counts[1] + b) * cells.counts[2]
                for k in range(cells.start[line + first[2]], cells.start[line + last[2] + 1]):
                    j = cells.item[k]
                    g, d = facet[j], _minus(_point(sample[j]), x)
                    if _dot(normal[f], normal[g]) < -1e-6 and _dot(d, d) < reach * reach:
                        if _dot(d, normal[f]) <= BEFORE * reach and _dot(d, normal[g]) >= -BEFORE * reach:
                            backed[f] = backed[g] = True
    return backed
