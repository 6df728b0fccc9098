"""The grid around sheets that water has on both sides: which faces are divided, and what is seen from where."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from mpi4py import MPI

from petfsi.fields.mac.carrying import charts, sided, thin
from petfsi.fields.mac.carrying.paths import Sweep
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.marks import beside, spread
from petfsi.fields.mac.walls.local_parts import LocalParts, ranges
from petfsi.fields.mac.walls.parts import Parts

#: Cells that an extrapolation looks at on either side.
AROUND = 3


class Sheets:
    """What carries water and smoke along sheets, each side by itself, for the grid as it is cut at the moment.

    Parameters
    ----------
    grid : MacGrid
    table : Parts
    face_kind, narrow : list of ndarray
        Face arrays, valid in all ghosts.
    cell_kind : ndarray
        Cell array, the same.
    given : ndarray of bool
        Cell array: beyond the sides, where a jet says what smoke comes in.

    Attributes
    ----------
    table : Parts
    local : LocalParts
    divided : ndarray of bool
        Cell array: cells that hold several pieces.
    near : ndarray of bool
        Cell array: cells that are divided or lie at thin walls, see ``thin``.
    """

    def __init__(
        self, grid: MacGrid, table: Parts, face_kind: list[np.ndarray], narrow: list[np.ndarray],
        cell_kind: np.ndarray, given: np.ndarray,
    ) -> None:  # fmt: skip
        self.grid, self.table = grid, table
        self.local = LocalParts(grid, table)
        inside = grid.inside(None)
        self._low, self._high = (np.array([getattr(s, end) for s in inside]) for end in ("start", "stop"))
        self._fluid, self._kind, self._narrow, self._given = cell_kind == kinds.FLUID, face_kind, narrow, given
        near = thin.thin_walls(three(face_kind), self._fluid, self._low, self._high, grid.dim)
        self.divided = self.local.extra >= 0
        if len(table):
            near[self._dividing()] = True
        grid.exchange_cells(near)
        self.near = near
        #: Whether there is any sheet near this rank, and near any rank.
        self.any = bool(near.any() or self.divided.any())
        self.anywhere = bool(grid.comm.allreduce(self.any, op=MPI.LOR))
        #: What walls have just uncovered: faces by axis, and cells, also those that were other water's.
        self.fresh = [np.zeros(kind.shape, dtype=bool) for kind in face_kind]
        self.flipped = np.zeros(cell_kind.shape, dtype=bool)
        self.from_below = self._ends()
        self._known = np.ones(len(table), dtype=bool)
        self._around: dict[int, np.ndarray] = {}
        self._targets: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _dividing(self) -> tuple[np.ndarray, ...]:
        """Return this rank's own divided cells, but those whose further pieces are slight and joined with the first."""
        local, table = self.local, self.table
        cells = np.column_stack(np.unravel_index(local.piece_cell, self.grid.shape(None))).reshape(-1, 3)
        around = sided.lead_around(self.cut, cells.astype(np.int64), table.piece[local.pieces], thin.AROUND[0])
        slight = around & (table.volume[local.pieces] < thin.SLIGHT)
        return tuple(cells[~slight].T)

    @cached_property
    def cut(self) -> charts.Cut:
        """What kernels read."""
        table, local = self.table, self.local
        return charts.Cut(
            three(self._kind), three(self._narrow), three(local.first), _flat(self._kind), _flat(local.first),
            local.extra, self._fluid, self._given, table.first[1:][local.number], table.below, table.above,
            table.openness, self._low, self._high, self.grid.dim,
        )  # fmt: skip

    def _ends(self) -> np.ndarray:
        """Return whether each link sees what its piece below sees: where that above has several links, or is none."""
        table, face = self.table, self.local.number
        several = []
        for piece in (table.below, table.above):
            _, which, count = np.unique(np.column_stack((face, piece)), axis=0, return_inverse=True, return_counts=True)
            several.append(count[which.ravel()] > 1)
        return (table.above < 0) | (several[1] & ~several[0] & (table.below >= 0))

    def around(self, reach: int) -> np.ndarray:
        """Return the cells that lie so near a sheet."""
        if reach not in self._around:
            near = self.near
            for b in range(self.grid.dim):
                near = spread(near, b, reach)
            self._around[reach] = near | self.divided
        return self._around[reach]

    def holds(self, extras: np.ndarray) -> np.ndarray:
        """Return the cells of which a further piece has a value that is not zero; ghosts valid."""
        found = np.zeros(self.divided.shape, dtype=bool)
        found.reshape(-1)[self.local.piece_cell[extras[self.local.pieces] != 0.0]] = True
        self.grid.exchange_cells(found)
        return found

    def _pieces(self, reach: int) -> tuple[np.ndarray, np.ndarray]:
        """Return this rank's pieces that lie so near a sheet: local cells (n, 3) and numbers."""
        if reach not in self._targets:
            part = self.grid.owned(None)
            cells = np.argwhere(self.around(reach)[part] & self._fluid[part]) + [s.start for s in part]
            local = self.local
            others = np.column_stack(np.unravel_index(local.piece_cell, self.grid.shape(None))).reshape(-1, 3)
            pieces = np.concatenate((np.zeros(len(cells), np.int64), self.table.piece[local.pieces]))
            self._targets[reach] = np.concatenate((cells, others)).astype(np.int64), pieces
        return self._targets[reach]

    @cached_property
    def _counts(self) -> tuple[np.ndarray, np.ndarray]:
        """How many cells before each are odd, and near a sheet."""
        odd = thin.odd_cells(self._kind, self._narrow, self.divided, self._fluid, self._low, self._high)
        return thin.count_before(odd), thin.count_before(self.near)

    def _in_need(
        self, sweep: Sweep, where: np.ndarray, faces: bool, path: Faces, low: tuple, high: tuple, beyond: float,
        cubic: bool,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return those of some cells whose paths meet sheets, each with one of its pieces, see ``thin``."""
        cells, pieces = self._pieces(sweep.reach)
        there = where[tuple(cells.T)]
        cells, pieces = cells[there], pieces[there]
        divided, (odd, near) = self.divided[tuple(cells.T)], self._counts
        need = thin.in_need(
            odd, near, cells, divided, faces, self._high, three(path), sweep.courant, sweep.long, low, high, beyond,
            cubic, self.grid.dim,
        )  # fmt: skip
        return cells[need], pieces[need]

    # ---- transport --------------------------------------------------------------------------------------------

    def fastest(self, velocity: Faces) -> list[np.ndarray]:
        """Return face arrays with the magnitude of its fastest part on each divided face."""
        if not len(self.table):
            return velocity
        fastest = [v.copy() for v in velocity]
        most = np.maximum.reduceat(np.abs(velocity.parts), self.table.first[:-1])
        for array, (flat, which) in zip(fastest, self.local.faces, strict=True):
            array.reshape(-1)[flat] = most[which]
        return fastest

    def carry_faces(
        self, faces: Faces, path: Faces, moved: list[np.ndarray], sweep: Sweep, where: list[np.ndarray] | None,
        low: tuple, high: tuple, cubic: bool, own: Faces | None, out: Faces, left: list[np.ndarray],
        kept: list[np.ndarray],
    ) -> None:  # fmt: skip
        """Carry what is on faces along a path, near sheets; see ``sided.carry_faces``. Collective.

        Those that come from too far are marked as ``left``, by axis in the cells above or, where divided, to whose
        pieces they belong; faces that have kept what they have of their ``own`` as ``kept``.
        """
        assert len(path.parts) == len(faces.parts) == len(self.table), "kernels would read beyond the parts' end"
        done = np.zeros(len(self.table), dtype=bool)
        if self.any:
            masks = [np.ones(self._fluid.shape, dtype=bool)] * len(left) if where is None else where
            some = np.logical_or.reduce(masks)
            targets = self._in_need(sweep, some, True, path, low, high, 0.0, cubic)
            sided.carry_faces(
                self.cut, *targets, sweep.reach, faces is path, three(path), path.parts, three(faces), faces.parts,
                self._known, self.from_below, three(moved), three(masks), sweep.courant, sweep.long, low, high, cubic,
                own is not None, three(faces if own is None else own), sweep.limit, three(out), out.parts, done,
                three(left), three(kept),
            )  # fmt: skip
        out.parts = self.local.gathered(out.parts, np.flatnonzero(done))
        self.local.mean_into(out, out.parts)

    def carry_smoke(
        self, smoke: np.ndarray, extras: np.ndarray, path: Faces, sweep: Sweep, where: np.ndarray, low: tuple,
        high: tuple, beyond: float, cubic: bool, out: np.ndarray, out_extras: np.ndarray, left: np.ndarray,
    ) -> None:  # fmt: skip
        """Carry smoke along a path, near sheets, to cells and to further pieces. Collective."""
        done = np.zeros(len(extras), dtype=bool)
        if self.any:
            targets = self._in_need(sweep, where, False, path, low, high, beyond, cubic)
            sided.carry_cells(
                self.cut, *targets, sweep.reach, three(path), path.parts, self._known, smoke, extras, sweep.courant,
                sweep.long, low, high, beyond, cubic, sweep.limit, out, out_extras, done, left,
            )  # fmt: skip
        out_extras[...] = self.local.gathered(out_extras, np.flatnonzero(done))

    # ---- new parts --------------------------------------------------------------------------------------------

    def guess_faces(self, faces: Faces, known: np.ndarray) -> None:
        """Extrapolate the links that are not ``known`` from their own sides; all ghosts are valid. Collective."""
        if known.all():
            return
        grid, table, cut = self.grid, self.table, self._without(self.fresh)
        out, mine = faces.parts.copy(), []
        for a in range(grid.dim):
            flat, which = self.local.faces[a]
            count = np.diff(table.first)[which]
            rows = ranges(table.first[which], count)
            cell = np.column_stack(np.unravel_index(np.repeat(flat, count), grid.shape(a))).reshape(-1, 3)
            up = self.from_below[rows]
            cell[:, a] -= up
            part = grid.owned(None)
            use = ~known[rows]
            for b, s in enumerate(part):
                use &= (cell[:, b] >= s.start) & (cell[:, b] < s.stop)
            rows, cell, up = rows[use], cell[use].astype(np.int64), up[use].astype(np.int64)
            pieces = np.where(up == 1, table.below[rows], table.above[rows])
            axis = np.full(len(rows), a)
            sided.guess_links(
                cut, rows, axis, cell, pieces, up, AROUND, three(faces), faces.parts, known, out
            )  # fmt: skip
            mine.append(rows)
        faces.parts = self.local.gathered(out, np.concatenate(mine))

    def guess_smoke(
        self, smoke: np.ndarray, extras: np.ndarray, otherwise: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return smoke with what is not a number replaced by what is known around on its own side. Collective.

        Parameters
        ----------
        smoke : ndarray
            Cell array, ghosts valid.
        extras : ndarray
            Of further pieces.
        otherwise : ndarray, optional
            Cell array: what to take where nothing is known around, as in a film between two sheets; zero by default.
        """
        grid, local = self.grid, self.local
        unknown = np.isnan(smoke)
        if not grid.comm.allreduce(bool(unknown.any() or np.isnan(extras).any()), op=MPI.LOR):
            return smoke, extras
        part = grid.owned(None)
        cells = np.argwhere(unknown[part]) + [s.start for s in part]
        use = np.isnan(extras[local.pieces])
        rows = local.pieces[use]
        others = np.column_stack(np.unravel_index(local.piece_cell[use], grid.shape(None))).reshape(-1, 3)
        pieces = np.concatenate((np.zeros(len(cells), np.int64), self.table.piece[rows]))
        where = np.concatenate((cells, others)).astype(np.int64)
        guess = sided.guess_cells(self.cut, where, pieces, AROUND, smoke, extras)
        rest = np.isnan(guess)
        guess[rest] = 0.0 if otherwise is None else otherwise[tuple(where[rest].T)]
        smoke, extras = smoke.copy(), extras.copy()
        smoke[tuple(cells.T)] = guess[: len(cells)]
        grid.exchange_cells(smoke)
        extras[rows] = guess[len(cells) :]
        return smoke, local.gathered(extras, rows)

    @cached_property
    def slim(self) -> list[np.ndarray]:
        """Face arrays: which are narrow and lie beside cells near sheets."""
        found = []
        for a, (narrow, kind) in enumerate(zip(self._narrow, self._kind, strict=True)):
            faces = beside(self.near, a)
            found.append(faces & narrow & ((kind == kinds.PRESSURE) | (kind == kinds.OPEN)))
        return found

    def renew_faces(self, faces: Faces, fresh: list[np.ndarray]) -> Faces:
        """Return faces with those that walls have just uncovered extrapolated from their own side's water. Collective.

        Parameters
        ----------
        faces : Faces
        fresh : list of ndarray of bool
            Face arrays.
        """
        assert len(faces.parts) == len(self.table), "kernels would read beyond the parts' end"
        grid, cut = self.grid, self._without(fresh)
        new = Faces([array.copy() for array in faces], faces.parts)
        for a, array in enumerate(new):
            grid.exchange_faces(a, array)
            grid.fill_sides(array, a)
        for a, array in enumerate(new):
            part = grid.owned(a)
            place = np.argwhere(fresh[a][part]) + [s.start for s in part]
            cell = place.astype(np.int64)
            up = (~self._fluid[tuple(cell.T)]).astype(np.int64)
            cell[:, a] -= up
            at = tuple(place.T)
            values = array[at]
            n = len(place)
            sided.guess_links(
                cut, np.arange(n), np.full(n, a), cell, np.zeros(n, np.int64), up, AROUND, three(new),
                new.parts, self._known, values,
            )  # fmt: skip
            array[at] = values
            grid.exchange_faces(a, array)
            grid.fill_sides(array, a)
        return new

    def renew_smoke(self, smoke: np.ndarray, extras: np.ndarray, fresh: np.ndarray) -> np.ndarray:
        """Return smoke with the cells that walls have just uncovered given the mean of their own side. Collective."""
        part = self.grid.owned(None)
        cells = (np.argwhere(fresh[part]) + [s.start for s in part]).astype(np.int64)
        known = np.where(fresh, np.nan, smoke)
        guess = sided.guess_cells(self.cut, cells, np.zeros(len(cells), np.int64), AROUND, known, extras)
        new, use = smoke.copy(), ~np.isnan(guess)
        new[tuple(cells[use].T)] = guess[use]
        self.grid.exchange_cells(new)
        return new

    @cached_property
    def close(self) -> np.ndarray:
        """Cell array: cells near sheets and those next to them."""
        close = self.near
        for b in range(self.grid.dim):
            close = spread(close, b, 1)
        return close

    def mark_uncovered(self, old: Sheets, old_kind: list[np.ndarray], other: np.ndarray) -> None:
        """Mark what thin walls have just uncovered: nothing may be read from there.

        Parameters
        ----------
        old : Sheets
        old_kind : list of ndarray of uint8
            Kinds of the faces before.
        other : ndarray of bool
            Cell array: which were no fluid before, or that on the other side of a wall.
        """
        if not self.anywhere:
            return
        self.flipped = self.close & other & self._fluid & ~self.divided & ~old.divided
        for a, (before, now) in enumerate(zip(old_kind, self._kind, strict=True)):
            fresh = (before == kinds.DEAD) | beside(self.flipped, a)
            self.fresh[a][...] = beside(self.close, a) & fresh & ((now == kinds.PRESSURE) | (now == kinds.OPEN))

    def uncover(self, axis: int, faces: np.ndarray) -> None:
        """Mark local faces, by flat index, whose values were those of other water: none may be read from there."""
        kind = self._kind[axis].reshape(-1)[faces]
        open_ones = (kind == kinds.PRESSURE) | (kind == kinds.OPEN)
        self.fresh[axis].reshape(-1)[faces[open_ones]] = True

    def _without(self, fresh: list[np.ndarray]) -> charts.Cut:
        """Return what kernels read, without some faces."""
        return self.cut._replace(narrow=three([n | f for n, f in zip(self._narrow, fresh, strict=True)]))


def _flat(arrays: list[np.ndarray]) -> np.ndarray:
    """Return the entries of arrays one after the other."""
    return np.concatenate([array.reshape(-1) for array in arrays])
