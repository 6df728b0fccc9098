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

from petfsi.fields.sph.cells import CellGrid, Pairs
from petfsi.fields.sph.sight_cells import (
    SAME,
    Clusters,
    boxes_of,
    extent,
    fitting,
    hull,
    mean_width,
    meeting,
    sorted_into,
)
from petfsi.fields.sph.sight_guard import put_back, touching
from petfsi.fields.sph.sight_lists import STRIKE, WORDS

#: Coarse cells so far apart along an axis share a bit.
BITS = {2: 5, 3: 3}
#: Fine cells along a coarse one's side.
FINE = 3


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
        low, high = extent(x) + np.array([[-2.0], [2.0]]) * self.reach
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
        n = STRIKE[self.dim](pairs.start, pairs.other, x, near, self._fine, self._corners)
        return Pairs(pairs.start, pairs.other[:n])

    def _words(self, x, same: float) -> np.ndarray:
        """Return for each point the bits of clusters near it that it may be above, and may be below, shape (n,)."""
        return WORDS[self.dim](x, self._around, self._clusters, self.reach, same * self.reach)

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
            box_low, box_high = boxes_of(corners)
            meets = meeting(box_low, box_high, low, high)
            numbers.append(meets)
            for some, c in zip(found, corners, strict=True):
                some.append(c[meets])
        return [np.concatenate(some) for some in found], np.concatenate(numbers)

    def _make_cells(self, corners, low, high, margin: float):
        """Return fine cells of facets that are at these corners one after the other, and the coarse grid.

        Coarse cells cover the facets, as far as they are in the box, and ``margin`` around.
        """
        dim, (box_low, box_high) = self.dim, boxes_of(corners)
        low = np.maximum(extent(box_low)[0], low) - margin
        length = np.minimum(extent(box_high)[1], high) + margin - low
        # facets longer than particles see would lie in too many cells
        wide = max(self.reach, mean_width(box_low, box_high))
        wide, counts = fitting(length, wide, FINE)
        fine = counts.copy()
        fine[:dim] *= FINE
        return sorted_into(low, wide / FINE, fine, box_low, box_high), (low, wide, counts)

    def _gather(self, low, wide, counts) -> None:
        """Make clusters of the facets whose first corners share a coarse cell, and note near which cells they are."""
        dim = self.dim
        middle = (self._corners[:, 0] - low) / wide
        cell = np.clip(np.floor(middle).astype(np.int64), 0, counts[:dim] - 1)
        number = np.ravel_multi_index(tuple(cell.T), tuple(counts[:dim]))
        order = np.argsort(number, kind="stable")
        _, first = np.unique(number[order], return_index=True)
        bit = cell[order[first]] % BITS[dim] @ BITS[dim] ** np.arange(dim)
        normal, slab, box = hull(self._corners, order, np.append(first, len(order)))
        self._clusters = Clusters(normal, slab, box, bit.astype(np.uint64))
        self._around = sorted_into(low, wide, counts, box[:, 0] - self.reach, box[:, 1] + self.reach)

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
        (low, high), (also_low, also_high) = extent(x_before), extent(x_after)
        low, high = np.minimum(low, also_low) - self.reach, np.maximum(high, also_high) + self.reach
        (before, after), number = self._near([points_before, points_after], low, high)
        if not len(number):
            return nothing
        cells, _ = self._make_cells([before, after], low, high, gap)
        owned = np.ones(len(x_before), dtype=bool) if owned is None else owned
        rows = touching(x_before, x_after, owned, cells)
        args = x_before[rows], x_after[rows], v[rows], before, after, self._both[number], cells, dt, gap, self.reach
        facet, x, v = put_back(*args)
        found = np.flatnonzero(facet >= 0)
        return Crossings(rows[found], self._which[number[facet[found]]], x[found], v[found])
