"""The unknowns of cells that hold several pieces of fluid, and the links of their faces: matrix, fluxes, velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_matrix, csr_matrix

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.projection.pressure import LEAST_OPEN, POCKET_DIAGONAL, Pattern
from petfsi.petsc import IntType, Layout


@dataclass(frozen=True)
class Inlets:
    """Parts of faces on sides with a given velocity that let fluid into further pieces of this rank's cells.

    The grid's own rows give a whole face's flow to the first piece of its cell.

    Attributes
    ----------
    piece, cell : ndarray of int, shape (n,)
        Local numbers of the unknowns of the piece and of its cell.
    axis, face : ndarray of int, shape (n,)
        The face: flat index in the local face array.
    inward : ndarray, shape (n,)
        The part's fraction of the face; negative at upper sides, where what flows along the axis goes out.
    """

    piece: np.ndarray
    cell: np.ndarray
    axis: np.ndarray
    face: np.ndarray
    inward: np.ndarray

    def flow(self, given: list[np.ndarray], areas: np.ndarray) -> np.ndarray:
        """Return what comes in through each part at the given velocities of faces, m^3/s (m^2/s in 2D)."""
        speed = np.zeros(len(self.axis))
        for a, velocity in enumerate(given):
            at = self.axis == a
            speed[at] = velocity.reshape(-1)[self.face[at]]
        return areas[self.axis] * self.inward * speed


@dataclass(frozen=True)
class Extras:
    """The second and further unknowns of split cells, which follow a rank's cells in the layout, and their links.

    Attributes
    ----------
    inlets : Inlets
    cell : ndarray of int, shape (n_owned,)
        Flat index in the local array of the cell that each of this rank's extra unknowns lies in.
    piece : ndarray of int, shape (n_owned,)
        Which piece of fluid of its cell it is: 1, 2, ...
    volume : ndarray, shape (n_owned,)
        Part of the cell's volume.
    axis, face : ndarray of int, shape (n_links,)
        Faces of split cells that touch this rank's unknowns: flat index in the local face array.
    below, above : ndarray of int, shape (n_links,)
        Global numbers of the unknowns that a part of the face joins; -1 beyond a side.
    mine_below, mine_above : ndarray of bool, shape (n_links,)
        Whether that unknown is this rank's, and not just its image in a ghost.
    openness : ndarray, shape (n_links,)
        That of the part: a fraction of the face.
    row : ndarray of int, shape (n_links,)
        Where ``parts.Parts`` has the link.
    owned : ndarray of bool, shape (n_links,)
        Whether the face is this rank's own.
    """

    inlets: Inlets
    cell: np.ndarray
    piece: np.ndarray
    volume: np.ndarray
    axis: np.ndarray
    face: np.ndarray
    below: np.ndarray
    above: np.ndarray
    mine_below: np.ndarray
    mine_above: np.ndarray
    openness: np.ndarray
    row: np.ndarray
    owned: np.ndarray

    def same(self, other: Extras | None) -> bool:
        """Return whether unknowns and links are those of another one, whatever their openness."""
        if other is None:
            return False
        names = ("cell", "piece", "axis", "face", "below", "above")
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    # ---- the system -----------------------------------------------------------------------------------------

    def block(
        self, pattern: Pattern, values: np.ndarray, layout: Layout, index: np.ndarray, grid: MacGrid, c: np.ndarray,
        yields: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Return this rank's rows of L: those of the grid, given by their values, and what links add.

        Parameters
        ----------
        pattern, values : Pattern, ndarray
            Rows of the cells, in the grid's own numbers; values may be changed.
        layout, index : Layout, ndarray
            The unknowns, and their numbers by local cell.
        grid : MacGrid
        c : ndarray, shape (dim,)
            dt/rho * area / dx per axis.
        yields : ndarray
            By what part of that all links yield to a push, see ``open_sides``; empty if all do by all of it.

        Returns
        -------
        indptr, indices, values : ndarray
            Global columns, sorted.
        """
        # pattern's columns are numbers in the grid's layout; find the cells they mean
        cells = np.flatnonzero(grid.index.reshape(-1) >= 0)
        old = grid.index.reshape(-1)[cells]
        order = np.argsort(old, kind="stable")
        columns = index.reshape(-1)[cells[order]][np.searchsorted(old[order], pattern.indices)]
        n_cells, n_rows = grid.layout.n_local, layout.n_local
        pocket = POCKET_DIAGONAL * 2.0 * c.sum()
        linked = np.unique(np.concatenate((self.below[self.mine_below], self.above[self.mine_above]))) - layout.start
        # a cell that the grid's own faces leave alone is no pocket if it has links
        own = pattern.slot[linked[linked < n_cells], 0]
        values[own] = np.where(values[own] == pocket, 0.0, values[own])
        indptr = np.concatenate((pattern.indptr, np.full(n_rows - n_cells, pattern.indptr[-1])))
        shape = (n_rows, layout.n_global)
        rows = csr_matrix((values, columns, indptr), shape=shape)
        weight = c[self.axis] * np.maximum(self.openness, LEAST_OPEN) * self._of(yields)
        gain = np.where((self.below < 0) | (self.above < 0), 2.0, 1.0)
        i, j, v = [], [], []
        ends = ((self.below, self.above, self.mine_below), (self.above, self.below, self.mine_above))
        for one, other, mine in ends:
            i.append(one[mine] - layout.start)
            j.append(one[mine])
            v.append((gain * weight)[mine])
            mine = mine & (other >= 0)
            i.append(one[mine] - layout.start)
            j.append(other[mine])
            v.append(-weight[mine])
        alone = np.setdiff1d(np.arange(n_cells, n_rows), linked)
        i.append(alone)
        j.append(alone + layout.start)
        v.append(np.full(len(alone), pocket))
        added = coo_matrix((np.concatenate(v), (np.concatenate(i), np.concatenate(j))), shape=shape)
        total = (rows + added.tocsr()).tocsr()
        total.sort_indices()
        return total.indptr.astype(IntType), total.indices.astype(IntType), total.data

    def add_inflow(
        self, star: np.ndarray, given: list[np.ndarray], areas: np.ndarray, layout: Layout, out: np.ndarray
    ) -> None:
        """Add what comes in through the links, by their velocities, to this rank's right-hand side.

        Parameters
        ----------
        star : ndarray
            Velocities of links.
        given : list of ndarray
            Face arrays: those of the sides.
        areas : ndarray, shape (dim,)
        layout : Layout
        out : ndarray, shape (layout.n_local,)
        """
        let_in = self.inlets.flow(given, areas)
        np.add.at(out, self.inlets.piece, let_in)
        np.subtract.at(out, self.inlets.cell, let_in)
        flux = areas[self.axis] * self.openness * star[self.row]
        for number, mine, sign in ((self.below, self.mine_below, -1.0), (self.above, self.mine_above, 1.0)):
            np.add.at(out, number[mine] - layout.start, sign * flux[mine])

    def project(
        self, star: np.ndarray, p: np.ndarray, start: int, pressure: np.ndarray, index: np.ndarray,
        factor: np.ndarray, comm: MPI.Comm, yields: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return the velocity of all links, right where the face is this rank's own. Collective.

        Parameters
        ----------
        star : ndarray
            That of all links before.
        p : ndarray
            This rank's extra pressures, whose first has the global number ``start``.
        pressure, index : ndarray
            Cell arrays, ghosts valid: pressure, and the unknowns' numbers.
        factor : ndarray, shape (dim,)
            dt / (rho dx) per axis.
        yields : ndarray
            As for ``block``.
        """
        parts = comm.allgather((start, p))
        numbers = np.concatenate([s + np.arange(len(q)) for s, q in parts])
        every = np.concatenate([q for _, q in parts])
        ends = []
        for number, step in ((self.below, -1), (self.above, 0)):
            value = np.zeros(len(number))
            for a in range(len(factor)):
                at = np.flatnonzero((self.axis == a) & (number >= 0))
                shape = tuple(n + (b == a) for b, n in enumerate(pressure.shape))
                where = list(np.unravel_index(self.face[at], shape))
                where[a] = where[a] + step
                own = index[tuple(where)] == number[at]
                value[at] = pressure[tuple(where)]
                far = at[~own]
                value[far] = every[np.searchsorted(numbers, number[far])]
            ends.append(value)
        gain = np.where((self.below < 0) | (self.above < 0), 2.0, 1.0)
        out = star.copy()
        out[self.row] -= self._of(yields) * gain * factor[self.axis] * (ends[1] - ends[0])
        return out

    def _of(self, yields: np.ndarray) -> np.ndarray | float:
        """Return by what part of a push each link yields."""
        return yields[self.row] if len(yields) else 1.0
