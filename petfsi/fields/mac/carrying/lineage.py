"""Which part of a divided face or cell was which before the surface moved.

Numbers of pieces say nothing over time: piece 0 is the largest, and a sheet that crosses the middle of a cell swaps
the two. A piece goes on as that old one of its cell which shares most of its walls, by facets; if there is none, as
that whose openings overlap most with its own or, in a cell that was whole or has become so, as the largest. A link
goes on as that between the pieces that its own go on as, or of one of them, on the same face. What goes on as nothing
begins with what its own side's surroundings say. So a sheet may go half a cell from one cut to the next; in a step
in which it goes farther, the coupling cuts the grid on its way, too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.kinds import DEAD
from petfsi.fields.mac.walls.parts import Parts, cells_beside, local_images

#: Sources of a part that none of the old ones is: the undivided face or cell, and nothing.
WHOLE, LOST = -1, -2
#: The part of a face that is more than this takes the undivided face's value, which is that of its centre.
CENTRE = 0.5


class Lineage:
    """How values go on from one division of a grid to the next. Collective, all of it.

    Parameters
    ----------
    grid : MacGrid
    old, new : Sheets
    old_kind : list of ndarray of uint8
        Kinds of the faces before.
    """

    def __init__(self, grid: MacGrid, old: Sheets, new: Sheets, old_kind: list[np.ndarray]) -> None:
        self.grid, self.old, self.new = grid, old, new
        before, after = old.table, new.table
        cells, first, piece, guessed = _matched(grid, before, after)
        self._source = _links(grid, before, after, cells, first, piece, self._flipped())
        self._known = self._with_kinds(old_kind)
        self._plain = self._healed(cells, first, piece)
        row = before.first_piece(after.cell)
        self._pieces = _of_pieces(after, cells, first, piece, row)
        zero = piece[first[:-1]] if len(cells) else np.zeros(0, np.int64)
        swapped = zero > 0
        self._swapped = cells[swapped], before.first_piece(cells[swapped]) + zero[swapped] - 1
        self._lost = cells[zero == LOST]
        self._guessed = cells[guessed & (np.diff(first) > 1)]

    def _flipped(self) -> np.ndarray:
        """Return the cells that are divided neither now nor before, but hold other water now. Collective."""
        grid, part = self.grid, self.grid.owned(None)
        place = np.argwhere(self.new.flipped[part]) + grid.lo
        return np.concatenate(grid.comm.allgather(np.ravel_multi_index(tuple(place.T), grid.cells)))

    def _with_kinds(self, old_kind: list[np.ndarray]) -> np.ndarray:
        """Return which links go on as something, of whole faces those alone that had a velocity. Collective."""
        local = self.new.local
        dead = local.at_faces([(kind == DEAD).astype(float) for kind in old_kind])
        known = np.where(self._source == WHOLE, 1.0 - dead, self._source >= 0)
        return local.gathered(known, local.link) > 0.0

    def _healed(self, cells: np.ndarray, first: np.ndarray, piece: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return by axis the local faces that are no longer divided, and the old links whose values they take.

        Where none of those was of the face's own water, this side's surroundings say: it is as if just uncovered.
        """
        before, found = self.old.table, []
        begin = before.first[:-1]
        below, above = (
            _went_on(np.where(beside >= 0, 0, -1), beside, cells, first, piece)
            for beside in (cells_beside(self.grid, before, side)[begin] for side in (True, False))
        )
        best = _widest(before.first, before.below, before.above, before.openness, below, above)
        gone = self.new.table.rows_of_faces(before.axis[begin], before.face[begin]) < 0
        for a, (flat, which) in enumerate(self.old.local.faces):
            use = gone[which]
            flat, link = flat[use], best[which[use]]
            self.new.uncover(a, flat[link < 0])
            found.append((flat, np.where(link < 0, begin[which[use]], link)))
        return found

    def faces(self, quantity: Faces) -> Faces:
        """Return a quantity on faces as the new division holds it; the old one is not changed."""
        local, source = self.new.local, self._source
        arrays = [array.copy() for array in quantity]
        for array, (flat, row) in zip(arrays, self._plain, strict=True):
            array.reshape(-1)[flat] = quantity.parts[row]
        parts = local.at_faces(arrays)
        if len(quantity.parts):
            parts = np.where(source >= 0, quantity.parts[np.maximum(source, 0)], parts)
        new = Faces(arrays, local.gathered(parts, local.link))
        if not self._known.all():
            for a, array in enumerate(arrays):
                self.grid.exchange_faces(a, array)
            self.new.guess_faces(new, self._known)
        local.mean_into(new, new.parts)
        return new

    def smoke(self, smoke: np.ndarray, extras: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoke of cells and of further pieces as the new division holds it.

        Parameters
        ----------
        smoke, extras : ndarray
            As the old one held it; not changed.
        volume : ndarray
            Cell array: the open part of each cell now.
        """
        local, source, table = self.new.local, self._pieces, self.new.table
        whole = smoke.copy()
        cells, rows = self._swapped
        flat, which = local_images(self.grid, None, cells)
        whole.reshape(-1)[flat] = extras[rows[which]]
        flat, _ = local_images(self.grid, None, self._lost)
        whole.reshape(-1)[flat] = np.nan
        # of a cell that was whole, the piece in its middle takes the value, if there is one
        flat, which = local_images(self.grid, None, self._guessed)
        others = np.array([np.searchsorted(table.cell, self._guessed, side) for side in ("left", "right")])
        total = np.concatenate(([0.0], np.cumsum(table.volume)))
        aside = volume.reshape(-1)[flat] - (total[others[1]] - total[others[0]])[which] <= CENTRE
        whole.reshape(-1)[flat[aside]] = np.nan
        whole[self.new.flipped] = np.nan
        further = np.full(len(source), np.nan)
        went = source >= 0
        further[went] = extras[source[went]]
        # what was a cell's own piece is a further one now
        own = np.flatnonzero(source[local.pieces] == WHOLE)
        further[local.pieces[own]] = smoke.reshape(-1)[local.piece_cell[own]]
        # a cell that was whole had one value for all that is in it now
        before = smoke.copy()
        flat, _ = local_images(self.grid, None, self.old.table.cell)
        before.reshape(-1)[flat] = 0.0
        return self.new.guess_smoke(whole, local.gathered(further, local.pieces), before)


def _matched(grid: MacGrid, before: Parts, after: Parts) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the cells divided before or after, and the old piece that each new one goes on as.

    Returns
    -------
    cells : ndarray of int64, shape (n,)
    first : ndarray of int64, shape (n + 1,)
        Where their pieces begin.
    piece : ndarray of int64
        Piece 0, 1, ... of each cell: an old piece or LOST.
    guessed : ndarray of bool, shape (n,)
        Whether nothing but its size speaks for the largest piece of a cell that was whole or is so now.
    """
    cells = np.union1d(before.cell, after.cell)
    counts = [1 + np.searchsorted(t.cell, cells, "right") - np.searchsorted(t.cell, cells) for t in (before, after)]
    walls = [np.stack([np.searchsorted(t.wall_cell, cells, end) for end in ("left", "right")]) for t in (before, after)]
    openings = [_openings(grid, t, cells, n) for t, n in zip((before, after), counts, strict=True)]
    first = np.concatenate(([0], np.cumsum(counts[1])))
    piece = np.full(first[-1], LOST)
    old, new = ((t.wall_piece, t.wall_facet, t.wall_area) for t in (before, after))
    guessed = np.zeros(len(cells), dtype=bool)
    _match_pieces(counts[0], counts[1], walls[0], walls[1], old, new, openings[0], openings[1], first, piece, guessed)
    return cells, first, piece, guessed


def _openings(grid: MacGrid, table: Parts, cells: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return how open the faces of cells' pieces are, shape (sum of ``count``, 2 dim)."""
    first = np.cumsum(count) - count
    out = np.zeros((int(count.sum()), 2 * grid.dim))
    if not len(cells):
        return out
    for side, piece in ((1, table.below), (0, table.above)):
        cell = cells_beside(grid, table, side == 1)
        at = np.minimum(np.searchsorted(cells, cell), len(cells) - 1)
        use = np.flatnonzero((piece >= 0) & (cells[at] == cell))
        np.add.at(out, (first[at[use]] + piece[use], 2 * table.axis[use] + side), table.openness[use])
    return out


@njit(cache=True)
def _match_pieces(n_old, n_new, old_range, new_range, old, new, old_open, new_open, first, out, guessed):
    """Fill the old piece that each new one of some cells goes on as, see ``_matched``."""
    (old_piece, old_facet, old_area), (new_piece, new_facet, new_area) = old, new
    begin = 0
    for c in range(len(n_old)):
        shared = np.zeros((n_new[c], n_old[c]))
        for p in range(new_range[0, c], new_range[1, c]):
            for q in range(old_range[0, c], old_range[1, c]):
                if new_facet[p] == old_facet[q]:
                    shared[new_piece[p], old_piece[q]] += min(new_area[p], old_area[q])
        used = np.zeros(n_old[c], np.bool_)
        _pair(shared, out[first[c] : first[c + 1]], used)
        if n_old[c] == 1 or n_new[c] == 1:
            if out[first[c]] < 0 and not used[0]:
                out[first[c]], guessed[c] = 0, True
        else:
            for i in range(n_new[c]):
                for j in range(n_old[c]):
                    shared[i, j] = np.minimum(new_open[first[c] + i], old_open[begin + j]).sum()
            _pair(shared, out[first[c] : first[c + 1]], used)
        begin += n_old[c]


@njit(cache=True)
def _pair(score, match, used):
    """Match rows with columns that are still free, the highest score first."""
    while True:
        best, row, column = 0.0, -1, -1
        for i in range(score.shape[0]):
            for j in range(score.shape[1]):
                if match[i] < 0 and not used[j] and score[i, j] > best:
                    best, row, column = score[i, j], i, j
        if row < 0:
            return
        match[row], used[column] = column, True


def _went_on(
    piece: np.ndarray, cell: np.ndarray, cells: np.ndarray, first: np.ndarray, match: np.ndarray
) -> np.ndarray:
    """Return the old pieces that new ones of any cells go on as; LOST, or -1 for -1."""
    old = np.where(piece > 0, LOST, piece)
    if len(cells):
        at = np.minimum(np.searchsorted(cells, cell), len(cells) - 1)
        both = np.flatnonzero((cells[at] == cell) & (piece >= 0))
        old[both] = match[first[at[both]] + piece[both]]
    return old


def _links(
    grid: MacGrid, before: Parts, after: Parts, cells: np.ndarray, first: np.ndarray, match: np.ndarray,
    flipped: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the old link that each new one goes on as, WHOLE or LOST."""
    beside = [cells_beside(grid, after, side) for side in (True, False)]
    below, above = (
        np.where((piece >= 0) & np.isin(cell, flipped), LOST, _went_on(piece, cell, cells, first, match))
        for piece, cell in zip((after.below, after.above), beside, strict=True)
    )
    row = before.rows_of_faces(after.axis, after.face)
    alone = np.repeat(np.diff(after.first) == 1, np.diff(after.first))
    whole = ((below == 0) | (above == 0)) & (alone | (after.openness > CENTRE))
    source = np.where(whole, WHOLE, LOST)
    ends = np.repeat(before.first[1:], np.diff(before.first))
    _find_links(row, ends, before.below, before.above, before.openness, below, above, source)
    return source


@njit(cache=True)
def _find_links(row, ends, old_below, old_above, openness, below, above, source):
    """Fill the source of the links on faces that were divided, which begin at ``row``."""
    for link, first in enumerate(row):
        if first >= 0:
            source[link] = _closest(first, ends[first], old_below, old_above, openness, below[link], above[link])


@njit(cache=True)
def _closest(begin, end, old_below, old_above, openness, below, above):
    """Return the link between two old pieces or, failing that, the widest of one of them; LOST for none."""
    best, most = LOST, 0.0
    for old in range(begin, end):
        score = 0.0
        if below >= 0 and old_below[old] == below:
            score += 2.0
        if above >= 0 and old_above[old] == above:
            score += 2.0
        if score > 0.0 and score + openness[old] > most:
            best, most = old, score + openness[old]
    return best


@njit(cache=True)
def _widest(first, below, above, openness, want_below, want_above):
    """Return for each divided face the link that it takes after if it is no more, given old pieces of its cells.

    LOST where there is none.
    """
    best = np.empty(len(first) - 1, np.int64)
    for face in range(len(best)):
        best[face] = _closest(first[face], first[face + 1], below, above, openness, want_below[face], want_above[face])
    return best


def _of_pieces(after: Parts, cells: np.ndarray, first: np.ndarray, match: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return the row of the old further piece that each new one goes on as, WHOLE or LOST."""
    old = _went_on(after.piece, after.cell, cells, first, match)
    return np.where(old > 0, row + old - 1, np.where(old == 0, WHOLE, LOST))
