"""The pressure block L = -(dt/rho) D2 G, its right-hand side, and the projection with its solution.

D is the net outflow of a cell in m^3/s, G the difference of the two cells at a face by their distance; at an OPEN
face p = 0 lies half a cell away, and whatever else is given there has pushed v* already (see ``open_sides``).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.kinds import DEAD, FLUID, OPEN, PRESSURE, SOLID_FACE, STEP, WALL
from petfsi.petsc import IntType

#: Diagonal of rows that are not solved, as a part of the usual one: small, for the sake of multigrid.
INACTIVE_DIAGONAL = 0.05

#: The same for a fluid cell between solid faces alone. Nothing may push back on its pressure, if no point of the
#: surface sees the cell; this much compressibility then keeps the system regular.
POCKET_DIAGONAL = 1e-6

#: The pressure sees a face that is open at all as open as this at least: between openings below it, round-off would
#: become a flow. Only what the pressure drives goes through it, so that a flow which needs no pressure needs none.
LEAST_OPEN = 1e-4
#: Of faces less open than this the velocity is read from the band: it may be one that the least conductance has made.
SLIT = 10 * LEAST_OPEN


class Pattern:
    """The 5- or 7-point pattern, the same for the whole run.

    Attributes
    ----------
    indptr, indices : ndarray of IntType
        Local rows in the DMDA's order; global columns, sorted.
    slot : ndarray of int64, shape (n_rows, 1 + 2 dim)
        Where the entries of a row stand: itself, then the neighbour below and above per axis; -1 for none.
    """

    def __init__(self, grid: MacGrid):
        steps = [(0, 0, 0)]
        for unit in STEP[: grid.dim]:
            steps += [(-unit[0], -unit[1], -unit[2]), unit]
        part = grid.owned(None)
        columns = np.empty((grid.layout.n_local, len(steps)), dtype=IntType)
        for c, shifts in enumerate(steps):
            shifted = tuple(slice(p.start + s, p.stop + s) for p, s in zip(part, shifts, strict=True))
            columns[:, c] = grid.index[shifted].ravel(order="F")
        order = np.argsort(columns, axis=1, kind="stable")
        columns = np.take_along_axis(columns, order, axis=1)
        present = columns >= 0
        self.indptr = np.zeros(len(columns) + 1, dtype=IntType)
        np.cumsum(present.sum(axis=1), out=self.indptr[1:])
        self.indices = columns[present]
        place = np.full(columns.shape, -1, dtype=np.int64)
        place[present] = np.arange(len(self.indices))
        self.slot = np.empty_like(place)
        np.put_along_axis(self.slot, order, place, axis=1)


@njit(cache=True)
def active_cells(cell_kind, kind0, kind1, kind2, flat):
    """Return the cell array of fluid cells that are solved: those with any face that the pressure can act on."""
    n0, n1, n2 = cell_kind.shape
    active = np.zeros(cell_kind.shape, np.bool_)
    for i in range(n0):
        for j in range(n1):
            for k in range(n2):
                if cell_kind[i, j, k] != FLUID:
                    continue
                free = _acts(kind0[i, j, k]) or _acts(kind0[i + 1, j, k])
                free = free or _acts(kind1[i, j, k]) or _acts(kind1[i, j + 1, k])
                if not flat:
                    free = free or _acts(kind2[i, j, k]) or _acts(kind2[i, j, k + 1])
                active[i, j, k] = free
    return active


@njit(cache=True)
def _acts(kind):
    return kind != WALL and kind != DEAD


@njit(cache=True)
def _seen(openness):
    """Return how open the pressure sees a face."""
    return max(openness, LEAST_OPEN) if openness > 0.0 else 0.0


@njit(cache=True)
def _conductance(kind, c):
    """Return what a face adds to the diagonal; c is dt/rho * area / dx."""
    if kind == PRESSURE:
        return c
    if kind == OPEN:
        return 2.0 * c
    return 0.0


@njit(cache=True)
def laplacian(active, kind0, kind1, kind2, open0, open1, open2, part, slot, c, values):
    """Write all values of L.

    Parameters
    ----------
    active : ndarray of bool
        Cell array.
    kind0, kind1, kind2 : ndarray of uint8
        Face kinds; in 2D the last is not read.
    open0, open1, open2 : ndarray
        Face arrays: how much of a whole face lets fluid through.
    part : tuple of (int, int)
        The owned cells.
    slot : ndarray
        See ``Pattern``.
    c : ndarray, shape (dim,)
        dt/rho * area / dx per axis.
    values : ndarray
        The result, along the pattern's indices.
    """
    (b0, e0), (b1, e1), (b2, e2) = part
    flat = len(c) == 2
    usual = 2.0 * c.sum()
    below = np.zeros(3)
    above = np.zeros(3)
    kinds_below = np.zeros(3, np.uint8)
    kinds_above = np.zeros(3, np.uint8)
    for k in range(b2, e2):
        for j in range(b1, e1):
            for i in range(b0, e0):
                row = (i - b0) + (e0 - b0) * ((j - b1) + (e1 - b1) * (k - b2))
                kinds_below[0], kinds_above[0] = kind0[i, j, k], kind0[i + 1, j, k]
                kinds_below[1], kinds_above[1] = kind1[i, j, k], kind1[i, j + 1, k]
                if not flat:
                    kinds_below[2], kinds_above[2] = kind2[i, j, k], kind2[i, j, k + 1]
                below[0] = c[0] * _seen(open0[i, j, k])
                above[0] = c[0] * _seen(open0[i + 1, j, k])
                below[1], above[1] = c[1] * _seen(open1[i, j, k]), c[1] * _seen(open1[i, j + 1, k])
                if not flat:
                    below[2], above[2] = c[2] * _seen(open2[i, j, k]), c[2] * _seen(open2[i, j, k + 1])
                diagonal = 0.0
                for a in range(len(c)):
                    diagonal += _conductance(kinds_below[a], below[a]) + _conductance(kinds_above[a], above[a])
                    if not active[i, j, k] or kinds_below[a] != PRESSURE:
                        below[a] = 0.0
                    if not active[i, j, k] or kinds_above[a] != PRESSURE:
                        above[a] = 0.0
                    if slot[row, 1 + 2 * a] >= 0:
                        values[slot[row, 1 + 2 * a]] = -below[a]
                    if slot[row, 2 + 2 * a] >= 0:
                        values[slot[row, 2 + 2 * a]] = -above[a]
                if not active[i, j, k]:
                    diagonal = INACTIVE_DIAGONAL * usual
                elif diagonal == 0.0:
                    diagonal = POCKET_DIAGONAL * usual
                values[slot[row, 0]] = diagonal


@njit(cache=True)
def _flux(star, bound, kind, i, j, k):
    """Return the known velocity through a face that counts on the right-hand side."""
    if kind[i, j, k] == PRESSURE or kind[i, j, k] == OPEN:
        return star[i, j, k]
    if kind[i, j, k] == WALL:
        return bound[i, j, k]
    return 0.0


@njit(cache=True)
def known_flows(star, bound, kind, openness, out):
    """Write the known flow through each face that counts on the right-hand side, by its whole area; flat arrays."""
    for n in range(len(out)):
        here = kind[n]
        value = star[n] if here == PRESSURE or here == OPEN else bound[n] if here == WALL else 0.0
        out[n] = openness[n] * value


@njit(cache=True)
def known_inflow_of(rows, star, bound, kind, openness, step, area, part, out):
    """Add minus the net outflow through one axis' faces to ``out``, of active cells by their numbers in the DMDA."""
    (b0, e0), (b1, e1), (b2, e2) = part
    di, dj, dk = step
    for n in range(len(rows)):
        i, rest = b0 + rows[n] % (e0 - b0), rows[n] // (e0 - b0)
        j, k = b1 + rest % (e1 - b1), b2 + rest // (e1 - b1)
        above = openness[i + di, j + dj, k + dk] * _flux(star, bound, kind, i + di, j + dj, k + dk)
        out[n] -= area * (above - openness[i, j, k] * _flux(star, bound, kind, i, j, k))


@njit(cache=True)
def project(star, p, bound, kind, step, c, part, out):
    """Write the new velocity on the owned faces of one axis; zero on DEAD ones.

    v = v* - (dt/rho) G p on PRESSURE and OPEN faces, with c = dt / (rho dx) and p = 0 outside; elsewhere as given.
    """
    (b0, e0), (b1, e1), (b2, e2) = part
    di, dj, dk = step
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                here = kind[i, j, k]
                if here == PRESSURE:
                    out[i, j, k] = star[i, j, k] - c * (p[i, j, k] - p[i - di, j - dj, k - dk])
                elif here == OPEN:
                    out[i, j, k] = star[i, j, k] - 2.0 * c * (p[i, j, k] - p[i - di, j - dj, k - dk])
                elif here == WALL or here == SOLID_FACE:
                    out[i, j, k] = bound[i, j, k]
                else:
                    out[i, j, k] = 0.0


@njit(cache=True)
def add_forces(star, bound, kind, step, dv, smoke, dv_smoke, part):
    """Accelerate the owned faces of one axis by dv + dv_smoke * (smoke at the face); WALL faces take ``bound``."""
    (b0, e0), (b1, e1), (b2, e2) = part
    di, dj, dk = step
    for i in range(b0, e0):
        for j in range(b1, e1):
            for k in range(b2, e2):
                if kind[i, j, k] == WALL:
                    star[i, j, k] = bound[i, j, k]
                else:
                    star[i, j, k] += dv
                    if dv_smoke != 0.0:
                        mean = 0.5 * (smoke[i, j, k] + smoke[i - di, j - dj, k - dk])
                        star[i, j, k] += dv_smoke * mean
