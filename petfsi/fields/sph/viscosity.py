"""Viscosity of particles solved for: what pairs drag each other, as a symmetric matrix.

Explicit steps end at 0.2 s^2/nu. Here the drag acts once over the whole step h, between the two kicks that have moved
particles to v' and, with the forces f_p of pressure, on to v'' = v' + h/2 (f_p/m + g): for their velocities w

    (M/(theta h) + L + D) w = M/(theta h) (theta v'' + (1 - theta) v_0) + C v_d,      w = theta v_1 + (1 - theta) v_0,

v_0 and v_1 at the ends of the step; theta = 1 damps what is too fast for the step, 1/2 is of second order. With c_ij of
``passes`` (between particles i, j) and c'_id = (1 + beta) c_id (to wall particles d without slip),

    L = sum over pairs of c_ij (e_i - e_j)(e_i - e_j)^T,      C = c',      D = the sums of its rows,

the same for each component. Nothing but c (1 -1; -1 1) is in it, so it is symmetric to the last bit. The velocities
change by the pairs' forces c_ij (w_j - w_i), not by the solution: momentum is kept to round-off by any solver.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.compiled import compiled_for
from petfsi.fields.sph.cells import Pairs
from petfsi.fields.sph.kernels import shape
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.particles import Swarm
from petfsi.fields.sph.passes import Met
from petfsi.petsc import IntType, Layout, new_block, set_csr

#: The part of the end of a step in w, by integrator; of others all.
THETA = {"midpoint": 0.5}


class Drag(NamedTuple):
    """What viscosity does at velocities w.

    Attributes
    ----------
    f : ndarray, shape (n, dim)
        Force on each fluid row, N; incomplete in ghost rows.
    f_walls : list of ndarray, shape (n_d, dim)
        On each wall row of each set, N.
    given : ndarray, shape (n,)
        Power that walls get from each fluid row, W.
    """

    f: np.ndarray
    f_walls: list[np.ndarray]
    given: np.ndarray


class ImplicitViscosity:
    """The block M/(theta h) + L + D of a swarm's particles, and what follows from its solution.

    Unknowns are the components of w of this rank's particles, in the order of rows, particle by particle. They are
    others whenever pairs are listed anew.

    Parameters
    ----------
    comm : MPI.Comm
    swarm : Swarm
        With columns w (vectors) and number (int64).
    theta : float

    Attributes
    ----------
    layout : Layout
        Another object where it has changed on any rank, and ``block`` then, too.
    block : PETSc.Mat
    rhs : ndarray, shape (layout.n_local,)
    guess : ndarray, shape (layout.n_local,)
        v_0, m/s.
    rows : ndarray of int, shape (n_owned,)
        This rank's particles among the swarm's rows.
    c : ndarray, shape (n_pairs,)
        c_ij of each pair, kg/s.
    c_walls : list of ndarray
        c'_id of each pair with walls, by set, kg/s.
    """

    def __init__(self, comm: MPI.Comm, swarm: Swarm, theta: float):
        self.comm, self.theta, self.dim = comm, theta, len(swarm.grid.counts)
        self.rows = np.flatnonzero(swarm.owned)
        self._lie(Layout.of(comm, self.dim * len(self.rows)))
        self.c, self.c_walls = np.zeros(0), list[np.ndarray]()
        self._pairs: Pairs | None = None
        self._before = np.zeros((len(swarm), self.dim))

    def _lie(self, layout: Layout) -> None:
        self.layout = layout
        self.block = new_block(self.comm, layout, layout)
        self.rhs = self.guess = np.zeros(layout.n_local)

    def weigh(self, swarm: Swarm, law: Law, pairs: Pairs, walls: Sequence[Met], half: float) -> None:
        """Find c and c' at the present places, densities and wall pressures, and v_0. Collective.

        To be called while the swarm has the acceleration that has kicked it for ``half`` (s) since v_0.
        """
        if pairs is not self._pairs:
            self._arrange(swarm, pairs)
        fluid = swarm["x"], swarm["rho"], swarm["m"]
        which = law.dim, law.kernel.number
        scale = -4 * law.nu * law.kernel.f_scale
        self.c, self.c_walls = np.empty(len(pairs.other)), []
        _drag_loop(*which)(*pairs, *fluid, 1 / law.s, scale, self.c)
        for met in walls:
            wall, c = met.rows, np.empty(len(met.pairs.other))
            place = wall.x, wall.normal, wall.depth, met.parts()
            what = wall.no_slip, wall.volume, met.density
            _wall_drag_loop(*which, met.seen is not None)(*met.pairs, *fluid, *place, *what, 1 / law.s, scale, c)
            self.c_walls.append(c)
        self._before = swarm["v"] - half * swarm["a"]

    def _arrange(self, swarm: Swarm, pairs: Pairs) -> None:
        """Give particles their numbers, and pairs that were listed anew their places in the block. Collective."""
        self.rows = np.flatnonzero(swarm.owned)
        n, dim = len(self.rows), self.dim
        layout = Layout.of(self.comm, dim * n)
        if self.comm.allreduce(layout != self.layout, MPI.LOR):
            self._lie(layout)
        local = np.full(len(swarm), -1, dtype=np.int64)
        local[self.rows] = np.arange(n)
        swarm["number"] = local + layout.start // dim
        swarm.exchange("number")
        self._indptr, columns, self._slots, self._diagonal = _pattern(*pairs, local, swarm["number"], n)
        self._local, self._pairs, self._fresh = local, pairs, True
        self._expanded = _expand_pattern(self._indptr, columns, dim, IntType)

    def assemble(self, swarm: Swarm, h: float, half: float, walls: Sequence[tuple[Met, np.ndarray]]) -> None:
        """Fill block and right-hand side for a step of h (s), of which the last ``half`` is to be kicked. Collective.

        ``walls`` are the sets and what is known of the velocities of their rows, shape (n_d, dim), m/s.
        """
        assert self._pairs is not None
        theta, mass = self.theta, swarm["m"] / (self.theta * h)
        after = swarm["v"] + half * swarm["a"]
        push, diagonal = mass[:, None] * (theta * after + (1 - theta) * self._before), mass.copy()
        for (met, known), c in zip(walls, self.c_walls, strict=True):
            _add_walls(*met.pairs, c, known, diagonal, push)
        values = np.zeros(self._indptr[-1])
        values[self._diagonal] = diagonal[self.rows]
        _fill(*self._pairs, self.c, self._local, self._slots, self._diagonal, values)
        wide, columns = self._expanded
        set_csr(self.block, wide, columns, _expand_values(self._indptr, values, self.dim), self._fresh)
        self._fresh = False
        self.rhs, self.guess = push[self.rows].ravel(), self._before[self.rows].ravel()

    def drag(self, swarm: Swarm, x: np.ndarray, walls: Sequence[tuple[Met, np.ndarray]]) -> Drag:
        """Return the forces of pairs at the solution x (layout.n_local,), and at that of the walls, m/s. Collective."""
        assert self._pairs is not None
        swarm["w"][self.rows] = x.reshape(-1, self.dim)
        swarm.exchange("w")
        w = swarm["w"]
        found = Drag(np.zeros_like(w), [np.zeros_like(v) for _, v in walls], np.zeros(len(w)))
        _drag(*self._pairs, self.c, w, found.f)
        for (met, v), c, f_wall in zip(walls, self.c_walls, found.f_walls, strict=True):
            _wall_drag(*met.pairs, c, w, v, found.f, f_wall, found.given)
        return found

    def kick(
        self, swarm: Swarm, x: np.ndarray, walls: Sequence[tuple[Met, np.ndarray]], h: float
    ) -> tuple[list[np.ndarray], float]:
        """Take v'' to v_1 by the solution x, and the walls'. Collective.

        Returns
        -------
        f_walls : list of ndarray, shape (n_d, dim)
            On each wall row of each set, N.
        lost : float
            Of this rank's particles' kinetic energy, less what walls got, J.
        """
        drag = self.drag(swarm, x, walls)
        change = drag.f * (h / swarm["m"])[:, None]
        # a force does its work at the mean of the velocities before and after
        power = np.sum(drag.f * (swarm["v"] + change / 2), axis=1) + drag.given
        swarm["v"] += change
        return drag.f_walls, -h * float(power[self.rows].sum())


# ---- what drags ---------------------------------------------------------------------------------------------------


@functools.cache
def _drag_loop(dim: int, kernel: int):
    """Return the pass that fills c (n_pairs,); ``scale`` is -4 nu times the factor of the kernel's f."""

    @compiled_for(dim, kernel, error_model="numpy")
    def drag(start, other, x, rho, m, inv_s, scale, c):
        for i in range(rho.size):
            for k in range(start[i], start[i + 1]):
                j, r2 = other[k], 0.0
                for a in range(dim):
                    r2 += (x[i, a] - x[j, a]) ** 2
                _, f = shape(kernel, np.sqrt(r2) * inv_s)
                c[k] = scale * m[i] * m[j] * f / (rho[i] + rho[j])

    return drag


@functools.cache
def _wall_drag_loop(dim: int, kernel: int, sided: bool):
    """Return the pass that fills c' (n_pairs,) of a set of walls, as ``loops.wall_force_loop`` has it."""

    @compiled_for(dim, kernel, sided, error_model="numpy")
    def wall_drag(
        start, other, x, rho, m, x_wall, normal, depth, seen, no_slip, volume, rho_wall, inv_s, scale, c
    ):  # fmt: skip
        for i in range(rho.size):
            for k in range(start[i], start[i + 1]):
                d = other[k]
                c[k] = 0.0
                if not no_slip[d]:
                    continue
                r2 = height = 0.0
                for a in range(dim):
                    r = x[i, a] - x_wall[d, a]
                    r2, height = r2 + r * r, height + r * normal[d, a]
                _, f = shape(kernel, np.sqrt(r2) * inv_s)
                if sided:
                    f *= seen[k]
                before = height - depth[d]
                beta = depth[d] / before if depth[d] < 1.5 * before else 1.5
                c[k] = (1.0 + beta) * scale * m[i] * (volume[d] * rho_wall[d]) * f / (rho[i] + rho_wall[d])

    return wall_drag


@njit(cache=True)
def _drag(start, other, c, w, f):
    """Add the forces of pairs at w to f."""
    for i in range(w.shape[0]):
        for k in range(start[i], start[i + 1]):
            j = other[k]
            for a in range(w.shape[1]):
                t = c[k] * (w[j, a] - w[i, a])
                f[i, a] += t
                f[j, a] -= t


@njit(cache=True)
def _wall_drag(start, other, c, w, v_wall, f, f_wall, given):
    """Add the forces of pairs with walls to f and f_wall, and their power on walls to ``given``."""
    for i in range(w.shape[0]):
        for k in range(start[i], start[i + 1]):
            d = other[k]
            for a in range(w.shape[1]):
                t = c[k] * (v_wall[d, a] - w[i, a])
                f[i, a] += t
                f_wall[d, a] -= t
                given[i] -= t * v_wall[d, a]


# ---- the matrix ---------------------------------------------------------------------------------------------------


@njit(cache=True)
def _pattern(start, other, local, number, n):
    """Return the rows of one component, and where pairs and the diagonal go in them.

    On one rank rows come out sorted but for images across periodic sides; one may meet a particle and its image, which
    have one column.

    Parameters
    ----------
    start, other : ndarray
        The pairs.
    local, number : ndarray of int64
        Of each row of the swarm: which of the n owned ones it is, or -1; its column.
    n : int

    Returns
    -------
    indptr : ndarray of int64, shape (n + 1,)
    columns : ndarray of int64
    slots : ndarray of int32, shape (n_pairs, 2)
        The entries (i, j) and (j, i) of each pair; -1 where the row is another rank's.
    diagonal : ndarray of int64, shape (n,)
    """
    room = np.zeros(n + 1, dtype=np.int64)
    room[1:] = 1
    for i in range(local.size):
        for k in range(start[i], start[i + 1]):
            if local[i] >= 0:
                room[local[i] + 1] += 1
            if local[other[k]] >= 0:
                room[local[other[k]] + 1] += 1
    begin = np.cumsum(room)
    end = begin[:-1].copy()
    columns, origin = np.empty(begin[n], dtype=np.int64), np.empty(begin[n], dtype=np.int64)
    for i in range(local.size):
        if local[i] >= 0:
            _put(columns, origin, begin[local[i]], end, local[i], number[i], -1)
        for k in range(start[i], start[i + 1]):
            j = other[k]
            if local[i] >= 0:
                _put(columns, origin, begin[local[i]], end, local[i], number[j], 2 * k)
            if local[j] >= 0:
                _put(columns, origin, begin[local[j]], end, local[j], number[i], 2 * k + 1)
    return _merged(begin, columns, origin, start[local.size])


@njit(cache=True, inline="always")
def _put(columns, origin, begin, end, row, column, where):
    """Put a column into its place among those of a row that are there."""
    at = end[row]
    while at > begin and columns[at - 1] > column:
        columns[at], origin[at] = columns[at - 1], origin[at - 1]
        at -= 1
    columns[at], origin[at] = column, where
    end[row] += 1


@njit(cache=True)
def _merged(begin, columns, origin, n_pairs):
    """Make one entry of those with the same column, see ``_pattern``."""
    n = begin.size - 1
    indptr, diagonal = np.zeros(n + 1, dtype=np.int64), np.zeros(n, dtype=np.int64)
    slots = np.full((n_pairs, 2), -1, dtype=np.int32)
    at = -1
    for row in range(n):
        for k in range(begin[row], begin[row + 1]):
            if k == begin[row] or columns[k] != columns[at]:
                at += 1
                columns[at] = columns[k]
            if origin[k] < 0:
                diagonal[row] = at
            else:
                slots[origin[k] // 2, origin[k] % 2] = at
        indptr[row + 1] = at + 1
    return indptr, columns[: at + 1], slots, diagonal


def _expand_pattern(indptr, columns, dim, kind):
    """Return the pattern of all components, one row each, particle by particle."""
    lengths = np.repeat(np.diff(indptr), dim)
    wide = np.concatenate(([0], np.cumsum(lengths)))
    return wide.astype(kind), _expand_columns(indptr, columns, dim).astype(kind)


@njit(cache=True)
def _expand_columns(indptr, columns, dim):
    out, at = np.empty(dim * columns.size, dtype=np.int64), 0
    for row in range(indptr.size - 1):
        for a in range(dim):
            for k in range(indptr[row], indptr[row + 1]):
                out[at] = dim * columns[k] + a
                at += 1
    return out


@njit(cache=True)
def _expand_values(indptr, values, dim):
    """Return the values of all components."""
    out, at = np.empty(dim * values.size), 0
    for row in range(indptr.size - 1):
        for _ in range(dim):
            for k in range(indptr[row], indptr[row + 1]):
                out[at] = values[k]
                at += 1
    return out


@njit(cache=True)
def _add_walls(start, other, c, known, diagonal, push):
    """Add the sums of c' to the diagonal, and what walls of known velocity drag along to the right-hand side."""
    for i in range(diagonal.size):
        for k in range(start[i], start[i + 1]):
            diagonal[i] += c[k]
            for a in range(push.shape[1]):
                push[i, a] += c[k] * known[other[k], a]


@njit(cache=True)
def _fill(start, other, c, local, slots, diagonal, values):
    """Add L to the entries."""
    for i in range(local.size):
        for k in range(start[i], start[i + 1]):
            j = other[k]
            if local[i] >= 0:
                values[slots[k, 0]] -= c[k]
                values[diagonal[local[i]]] += c[k]
            if local[j] >= 0:
                values[slots[k, 1]] -= c[k]
                values[diagonal[local[j]]] += c[k]
