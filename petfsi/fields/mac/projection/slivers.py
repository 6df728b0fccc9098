"""The fluid between the centre of a cell and the moving wall through it: a mass of rank one in each such cell.

That sliver of fluid moves with the wall along its normal, and the row of D knows how fast: with N = ∫ n dA over the
moving walls of a piece of fluid, the net outflow is d_c v = N . v for any uniform v. Hence the kinetic energy v M v / 2
with

    M = M0 + rho sum_c S_c d_c d_c^T,     S_c = a_c / |N_c|^2,     a_c = -∫ n . (x - x_c) dA ,

M0 the masses rho alpha_f A_f dx of faces, and a_c an area times the distance from the wall to the centre, negative if
the centre lies in the solid. To minimise it subject to D v + J^T u = 0 is, with L = c D M0^-1 D^T, c of the integrator,
and T = rho S / c, to take from the solved q the pressure (I + T L) q on the walls: extrapolated to them linearly along
n, at any slope, which is of second order. In terms of q,

    [  A              -J (I + T L) ] [u]   [  b                 ]
    [ (I + L T) J^T    L + L T L   ] [q] = [ -(I + L T) D v*   ],      v = v* - c M0^-1 D^T q .

Where S > 0 it may be large; there the same is written as a mass of the solid, A + J T J^T and b - J T D v*. Where S < 0
it is limited so that M stays at least ``LEAST`` of M0: with the mass of each face shared between its two cells, half to
each if both have S < 0 and else all to the one that has,

    -S_c <= (1 - LEAST) / r_c,     r_c = sum_f alpha_f A_f / (dx_f share_f),

by the inequality of Cauchy and Schwarz in each cell. Walls that never move have no slivers: there is nothing to mend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from petfsi.fields.mac.projection.pressure import LEAST_OPEN
from petfsi.fields.mac.walls.cut import Links
from petfsi.geometry.clipping import CutCells

#: What is left at least of the masses of faces.
LEAST = 0.1
#: Walls with a smaller |∫ n dA| than this part of their area have no common normal, and no sliver: films and corners.
COMMON = 0.7
#: Nor have those that only graze a cell.
GRAZING = 0.01


@dataclass(frozen=True)
class Slivers:
    """The slivers of some pieces of fluid.

    Attributes
    ----------
    slot : ndarray of int, shape (n,)
        Each piece's, see ``cut.Walls``; of a fluid this rank's own unknowns, local numbers.
    size : ndarray, shape (n,)
        S, 1/m in 3D (1 in 2D).
    normal : ndarray, shape (n, dim)
        N of the moving walls, m^2 (m in 2D).
    """

    slot: np.ndarray
    size: np.ndarray
    normal: np.ndarray


def slivers_of(cut: CutCells, slot: np.ndarray, n_moving: int, links: Links, dx: np.ndarray, n_slots: int) -> Slivers:
    """Return the slivers of all pieces that moving walls bound. Not collective.

    Parameters
    ----------
    cut : CutCells
    slot : ndarray of int
        Of each patch.
    n_moving : int
        Facets below this number can move.
    links : Links
        Of all faces next to a surface that the pressure acts on.
    dx : ndarray, shape (dim,)
    n_slots : int
    """
    mine = np.flatnonzero(cut.facet < n_moving)
    slots, of = np.unique(slot[mine], return_inverse=True)
    normals = cut.normals[cut.facet[mine]]
    area = cut.integrals[mine].sum(axis=1)
    reach = -np.einsum("pa,pia->p", normals, cut.moments[mine])
    normal = np.column_stack([np.bincount(of, area * n, len(slots)) for n in normals.T])
    total, reach = np.bincount(of, area, len(slots)), np.bincount(of, reach, len(slots))
    squared = np.sum(normal**2, axis=1)
    least = np.maximum(COMMON * total, GRAZING * np.prod(dx) ** (1 - 1 / len(dx)))
    use = np.flatnonzero((squared > least**2) & (reach != 0.0))
    slots, size, normal = slots[use], reach[use] / squared[use], normal[use]
    negative = np.zeros(n_slots, dtype=bool)
    negative[slots[size < 0.0]] = True
    resistance = _resistance(links, negative, dx)[slots]
    keep = resistance > 0.0  # else nothing but walls bounds the piece
    size = np.maximum(size[keep], -(1.0 - LEAST) / resistance[keep])
    return Slivers(slots[keep], size, normal[keep])


def _resistance(links: Links, negative: np.ndarray, dx: np.ndarray) -> np.ndarray:
    """Return r of each slot."""
    conductance = np.maximum(links.openness, LEAST_OPEN) * (np.prod(dx) / dx**2)[links.axis]
    ends = links.below, links.above
    here = [slot >= 0 for slot in ends]
    both = here[0] & here[1] & negative[ends[0]] & negative[ends[1]]
    # at an open side, where p = 0 lies half a cell away, half the mass resists
    conductance = conductance * np.where(both | ~(here[0] & here[1]), 2.0, 1.0)
    total = np.zeros(len(negative))
    for slot, inside in zip(ends, here, strict=True):
        total += np.bincount(slot[inside], conductance[inside], len(negative))
    return total


# ---- the algebra -------------------------------------------------------------------------------------------------


@njit(cache=True)
def outer_products(left_ptr, left_col, left, right_ptr, right_col, right, rows, weight):
    """Return the entries of  sum_r weight_r (row r of one matrix)^T (row r of another).

    Parameters
    ----------
    left_ptr, left_col, left : ndarray
        The first matrix in compressed rows, and so on.
    rows : ndarray of int, shape (n,)
    weight : ndarray, shape (n,)

    Returns
    -------
    i, j, values : ndarray
    """
    total = 0
    for r in rows:
        total += (left_ptr[r + 1] - left_ptr[r]) * (right_ptr[r + 1] - right_ptr[r])
    i, j, values = np.empty(total, np.int64), np.empty(total, np.int64), np.empty(total)
    n = 0
    for k in range(len(rows)):
        r = rows[k]
        for a in range(left_ptr[r], left_ptr[r + 1]):
            for b in range(right_ptr[r], right_ptr[r + 1]):
                i[n], j[n], values[n] = left_col[a], right_col[b], weight[k] * left[a] * right[b]
                n += 1
    return i, j, values
