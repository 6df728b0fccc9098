"""What cells and faces are, given the static sides and obstacles and the solids of the moment."""

from __future__ import annotations

import numpy as np
from numba import njit

# cells
FLUID = 0
SOLID = 1  # inside a deformable solid
OBSTACLE = 2
VOID = 3  # in an empty cavity: p = 0, not solved
OUTSIDE = 4  # beyond a side

# faces
DEAD = 0  # the velocity is not determined
PRESSURE = 1  # between two fluid cells
OPEN = 2  # between fluid and an open side: p is given at the face
WALL = 3  # velocity prescribed by a side, an inflow or an obstacle
SOLID_FACE = 4  # velocity given by a coupling
SPLIT = 5  # of a cell with several pieces of fluid: its parts join unknowns as the openings' extras say

#: Unit steps along the axes, for kernels that serve every axis.
STEP = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


#: Faces less open than this are not what a flow is read from, see ``narrow_faces``.
NARROW = 0.25


@njit(cache=True)
def narrow_faces(openness, face_kind, across, narrow):
    """Mark faces of an axis whose velocity is better extrapolated from their neighbours than read.

    A sliver of fluid between a wall and a face's edge has next to no mass: what the pressure makes of its velocity is
    right for the flux through it, but says little about the flow. Such a face has a wider one beside it. Faces of a
    film between two walls have none, and say all that is known.

    Parameters
    ----------
    openness, face_kind : ndarray
        Face arrays; of a split face all of its parts count.
    across : tuple of (int, int, int)
        The unit steps along the other axes.
    narrow : ndarray of bool
        The result; the outermost planes of the array are left alone.
    """
    n0, n1, n2 = openness.shape
    flat = n2 == 1
    for i in range(1, n0 - 1):
        for j in range(1, n1 - 1):
            for k in range(0 if flat else 1, 1 if flat else n2 - 1):
                narrow[i, j, k] = False
                kind = face_kind[i, j, k]
                if (kind != PRESSURE and kind != SPLIT) or openness[i, j, k] >= NARROW:
                    continue
                for di, dj, dk in across:
                    widest = max(openness[i - di, j - dj, k - dk], openness[i + di, j + dj, k + dk])
                    narrow[i, j, k] = narrow[i, j, k] or widest >= NARROW


@njit(cache=True)
def classify_faces(cell_kind, side_kind, crossed, step, face_kind):
    """Write the kind of every local face whose two cells are local, too.

    Parameters
    ----------
    cell_kind : ndarray of uint8
        Cell array.
    side_kind : ndarray of uint8
        Face array: OPEN or WALL on the sides of the domain; not read elsewhere.
    crossed : ndarray of bool
        Face array: a solid's surface passes between the two cells' centres. Wins over everything else.
    step : tuple of int
        The unit step along the faces' axis.
    face_kind : ndarray of uint8
        Face array, the result; its first and last plane along the axis are left alone.
    """
    di, dj, dk = step
    n0, n1, n2 = cell_kind.shape
    for i in range(di, n0):
        for j in range(dj, n1):
            for k in range(dk, n2):
                below = cell_kind[i - di, j - dj, k - dk]
                above = cell_kind[i, j, k]
                if below != FLUID and above != FLUID:
                    kind = DEAD
                elif crossed[i, j, k]:
                    kind = SOLID_FACE
                elif below == above:
                    kind = PRESSURE
                else:
                    other = above if below == FLUID else below
                    if other == OBSTACLE:
                        kind = WALL
                    elif other == OUTSIDE:
                        kind = side_kind[i, j, k]
                    else:
                        kind = SOLID_FACE
                face_kind[i, j, k] = kind


def merge_cells(static: np.ndarray, inside: np.ndarray | None) -> np.ndarray:
    """Return the kind of each cell: what is static (obstacles, outside) wins over what a solid covers."""
    return static.copy() if inside is None else np.where(static == FLUID, inside, static)
