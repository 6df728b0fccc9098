"""Carrying what is on faces and in cells along paths, in as few sweeps as each entry needs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

from petfsi.fields.mac.carrying import advect
from petfsi.fields.mac.carrying.paths import STENCIL, Path, Sweep, find_path
from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.grid.faces import Faces, each
from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.marks import faces_below, spread
from petfsi.fields.mac.grid.sides import Surroundings


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
        self.interpolation, self.cubic = interpolation, interpolation == "cubic"
        place = list(zip(grid.periodic, grid.ghost, grid.lo, grid.cells, grid.shape(None), strict=True))
        # a departure point in a ghost cell of another rank or a periodic axis is as good as any
        low = tuple(0.0 if p else float(max(0, g - m)) for p, g, m, _, _ in place)
        high = tuple(float(s) if p else float(min(s, g - m + c)) for p, g, m, c, s in place)
        self._ends = low, high
        self._face_ends = [surroundings.carry_ends(axis, low, high) for axis in range(grid.dim)]

    def path(self, velocity: Faces, span: float) -> Path:
        """Return the path along a velocity for ``span`` seconds, see ``find_path``. Collective."""
        fastest = velocity if self.sheets is None else self.sheets.fastest(velocity)
        return find_path(self.grid, velocity, fastest, span, self.interpolation)

    # ---- faces ------------------------------------------------------------------------------------------------

    def carry_faces(
        self, q: Faces, path: Path, moved: list[np.ndarray], out: Faces, own: Faces | None = None
    ) -> list[np.ndarray]:
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
        list of ndarray of bool
            Which faces did.
        """
        grid = self.grid
        kept = [np.zeros(v.shape, dtype=bool) for v in out]
        for axis, v in enumerate(q):
            part = grid.owned(axis)
            out[axis][part] = v[part]
        out.parts = q.parts.copy()
        left = [np.zeros(grid.shape(None), dtype=bool) for _ in q]
        self._sweep_faces(q, path, path.whole, moved, own, out, left, kept)
        for where, last in self._rest(path, left, list(range(grid.dim)), 0.0):
            target = out if last else each(np.copy, q)
            # it has all flowed on, so nothing is kept
            self._sweep_faces(q, path, path.short, moved, None, target, left, kept, where)
            if not last:
                for axis, v in enumerate(target):
                    grid.exchange_faces(axis, v)
                    grid.fill_sides(v, axis)
                if self.surroundings.carries_along:
                    self.surroundings.fill_along(target)
                q = target
        return kept

    def _sweep_faces(
        self, q: Faces, path: Path, sweep: Sweep, moved: list[np.ndarray], own: Faces | None, out: Faces,
        left: list[np.ndarray], kept: list[np.ndarray], where: list[np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        """Carry faces for one sweep, ``where`` it is said by axis; mark those that are left. Collective."""
        for axis, v in enumerate(q):
            there = moved[axis] if where is None else moved[axis] & faces_below(where[axis], axis)
            self._sweep(v, path, sweep, there, axis, 0.0, out[axis], left[axis])
        if self.sheets is not None:
            self.sheets.carry_faces(
                q, path.velocity, moved, sweep, where, *self._ends, self.cubic, own, out, left, kept
            )  # fmt: skip

    # ---- smoke ------------------------------------------------------------------------------------------------

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
        grid = self.grid
        # it comes in from behind the sides, where the ghosts know what a jet carries
        beyond = 0.5
        out, out_extras = smoke.copy(), extras.copy()
        left = np.zeros(grid.shape(None), dtype=bool)
        some = self._reached(smoke, extras, path)
        self._sweep_smoke(smoke, extras, path, path.whole, moved, some, beyond, out, out_extras, left)
        for (where,), last in self._rest(path, [left], [None], beyond):
            target, further = (out, out_extras) if last else (smoke.copy(), extras.copy())
            self._sweep_smoke(smoke, extras, path, path.short, moved, some & where, beyond, target, further, left)
            if not last:
                grid.exchange_cells(target)
                self.surroundings.fill_smoke(target)
                smoke, extras = target, further
        return out, out_extras

    def _reached(self, smoke: np.ndarray, extras: np.ndarray, path: Path) -> np.ndarray:
        """Return the cells to which smoke may come along a path: elsewhere it stays zero. Collective."""
        some = smoke != 0.0
        if self.sheets is not None:
            some |= self.sheets.holds(extras)
        for n in range(path.sweeps):
            if n > 0:
                self._complete(some)
            for axis in range(self.grid.dim):
                some = spread(some, axis, path.whole.reach)
        return some

    def _sweep_smoke(
        self, smoke: np.ndarray, extras: np.ndarray, path: Path, sweep: Sweep, moved: np.ndarray, where: np.ndarray,
        beyond: float, out: np.ndarray, further: np.ndarray, left: np.ndarray,
    ) -> None:  # fmt: skip
        """Carry the smoke of cells for one sweep, ``where`` it is said; mark those that are left. Collective."""
        self._sweep(smoke, path, sweep, moved & where, None, beyond, out, left)
        if self.sheets is not None:
            self.sheets.carry_smoke(
                smoke, extras, path.velocity, sweep, where, *self._ends, beyond, self.cubic, out, further, left
            )  # fmt: skip

    # ---- sweeps -----------------------------------------------------------------------------------------------

    def _sweep(
        self, q: np.ndarray, path: Path, sweep: Sweep, moved: np.ndarray, axis: int | None, beyond: float,
        out: np.ndarray, left: np.ndarray,
    ) -> None:  # fmt: skip
        """Carry the faces of an axis (cells: None) for one sweep as if nothing divided them."""
        bounded = axis is None
        ends = self._ends if axis is None else self._face_ends[axis]
        advect.sweep(
            q, out, moved, *three(path.velocity), _offset(axis), self.grid.owned_ranges(axis), sweep.courant,
            sweep.long, *ends, beyond, self.cubic, bounded, sweep.limit, left,
        )  # fmt: skip

    def _rest(
        self, path: Path, left: list[np.ndarray], axes: list[int] | list[None], beyond: float
    ) -> Iterator[tuple[list[np.ndarray], bool]]:
        """Yield the cells that each of a path's short sweeps is to carry, and whether it is the last. Collective.

        For each axis those above the faces. The last one carries those that are ``left``, the others what the next
        one reads.
        """
        if path.sweeps == 1 or not self.grid.comm.allreduce(any(bool(m.any()) for m in left), op=MPI.LOR):
            return
        for mask in left:
            for b, part in enumerate(self.grid.inside(None)):
                view = np.moveaxis(mask, b, 0)
                if part.stop < len(view):  # a side's faces belong to the last cells
                    view[part.stop - 1] |= view[part.stop]
        turns = [[self._complete(mask.copy()) for mask in left]]
        for _ in range(path.sweeps - 1):
            turns.append([self._read(path, mask, a, beyond) for mask, a in zip(turns[-1], axes, strict=True)])
        for n, where in enumerate(reversed(turns), start=1):
            yield where, n == len(turns)

    def _read(self, path: Path, where: np.ndarray, axis: int | None, beyond: float) -> np.ndarray:
        """Return the cells of which a short sweep to some cells reads any, or of faces those above. Collective."""
        grid, sweep = self.grid, path.short
        # charts read all around, and what they are extended from; of another rank's cells this one knows no paths
        boxed = np.zeros(where.shape, dtype=bool) if self.sheets is None else where & self.sheets.around(sweep.reach)
        for b in range(grid.dim):
            boxed = spread(boxed, b, 1)
        others = self._complete(boxed) | where
        part, inside = grid.owned(None), grid.inside(None)
        others[part] = boxed[part]
        read = np.zeros(where.shape, dtype=bool)
        read[inside] = others[inside]
        for b in range(grid.dim):
            read = spread(read, b, sweep.reach)
        read |= where
        there = where if axis is None else faces_below(where, axis)
        ends = self._ends if axis is None else self._face_ends[axis]
        advect.mark_read(
            read, there, boxed, *three(path.velocity), _offset(axis), self.grid.owned_ranges(axis), sweep.courant,
            *ends, beyond, STENCIL[self.interpolation],
        )  # fmt: skip
        return self._complete(read)

    def _complete(self, cells: np.ndarray) -> np.ndarray:
        """Return a cell array with its ghosts filled. Collective."""
        self.grid.exchange_cells(cells)
        self.grid.fill_sides(cells, None)
        return cells

    def keep_own(self, own: np.ndarray, read: np.ndarray, path: Path, axis: int, out: np.ndarray) -> None:
        """Add to faces carried from ``read`` what they have beyond it, as far as it has not flowed on."""
        courant = (*(path.span / self.grid.dx), 0.0)[:3]
        advect.keep_own(out, own, read, *three(path.velocity), _offset(axis), self.grid.owned_ranges(axis), courant)


def _offset(axis: int | None) -> tuple[float, ...]:
    """Return where the first entry of an axis's faces (cells: None) lies, see ``advect.sweep``."""
    return tuple(0.0 if b == axis else 0.5 for b in range(3))
