"""Quadrilaterals, hexahedra, wedges and pyramids cut into simplices that fit together, whatever lies beside them.

A face of four corners is cut through the one of the smallest number, so that both cells beside it cut it alike; a cell
is what its corner of the smallest number sees: a cone over each triangle of the faces that do not have it (J.
Dompierre, P. Labbé, M.-G. Vallet, R. Camarero, *How to subdivide pyramids, prisms and hexahedra into tetrahedra*,
1999).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Kind(NamedTuple):
    """A kind of cell in files.

    Attributes
    ----------
    dim : int
    corners : int
        They come first.
    order : int
        2 if it has a node on each of its edges, too, and may have some in its middle; 3 if it has more.
    """

    dim: int
    corners: int
    order: int


#: By meshio's names; in VTK's order of corners.
KINDS = {
    "triangle": Kind(2, 3, 1), "triangle6": Kind(2, 3, 2), "triangle7": Kind(2, 3, 2),
    "quad": Kind(2, 4, 1), "quad8": Kind(2, 4, 2), "quad9": Kind(2, 4, 2),
    "tetra": Kind(3, 4, 1), "tetra10": Kind(3, 4, 2),
    "pyramid": Kind(3, 5, 1), "pyramid13": Kind(3, 5, 2), "pyramid14": Kind(3, 5, 2),
    "wedge": Kind(3, 6, 1), "wedge15": Kind(3, 6, 2), "wedge18": Kind(3, 6, 2),
    "hexahedron": Kind(3, 8, 1), "hexahedron20": Kind(3, 8, 2), "hexahedron27": Kind(3, 8, 2),
    "line": Kind(1, 2, 1), "line3": Kind(1, 2, 2),
} | {
    name + str(nodes): Kind(dim, corners, 3)
    for name, dim, corners, counts in (
        ("line", 1, 2, (4, 5, 6, 7)), ("triangle", 2, 3, (10, 15, 21)), ("quad", 2, 4, (16, 25, 36)),
        ("tetra", 3, 4, (20, 35, 56)), ("wedge", 3, 6, (40, 75)), ("hexahedron", 3, 8, (64, 125, 216)),
    )
    for nodes in counts
} | {
    f"VTK_LAGRANGE_{name}": Kind(dim, corners, 3)
    for name, dim, corners in (
        ("CURVE", 1, 2), ("TRIANGLE", 2, 3), ("QUADRILATERAL", 2, 4), ("TETRAHEDRON", 3, 4), ("HEXAHEDRON", 3, 8),
        ("WEDGE", 3, 6), ("PYRAMID", 3, 5),
    )
}  # fmt: skip

#: The simplex of each dimension.
SIMPLEX = {1: "line", 2: "triangle", 3: "tetra"}
#: The faces of cells with so many corners.
_FACES = {
    5: ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    6: ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    8: ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}


def simplices(corners: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the simplices of cells of one kind, and of which cell each is. Their orientations are not looked at.

    Parameters
    ----------
    corners : ndarray of int, shape (n, k)
        3 or 4 of each in 2D (4 are a quadrilateral), 4, 5, 6 or 8 in 3D; 2 are a segment.
    dim : int
        Of the cells.

    Returns
    -------
    simplices : ndarray of int, shape (m, dim + 1)
        In the order of the cells.
    owner : ndarray of int, shape (m,)
    """
    n, k = corners.shape
    if k == dim + 1:
        return corners, np.arange(n)
    if dim == 2:
        return _halves(corners).reshape(-1, 3), np.repeat(np.arange(n), 2)
    parts, owners = [], []
    first = corners.argmin(axis=1)
    for tip in range(k):
        own = np.flatnonzero(first == tip)
        for face in _FACES[k]:
            if tip not in face:
                base = corners[own][:, face]
                triangles = base[:, None] if len(face) == 3 else _halves(base)
                apex = np.broadcast_to(corners[own, tip][:, None, None], (*triangles.shape[:2], 1))
                parts.append(np.concatenate((apex, triangles), axis=2).reshape(-1, 4))
                owners.append(np.repeat(own, triangles.shape[1]))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(parts)[order], owner[order]


def _halves(quads: np.ndarray) -> np.ndarray:
    """Return the two triangles of each quadrilateral, cut through its corner of the smallest number: (n, 2, 3)."""
    even = (quads.argmin(axis=1) % 2 == 0)[:, None]
    one = np.where(even, quads[:, [0, 1, 2]], quads[:, [1, 2, 3]])
    other = np.where(even, quads[:, [0, 2, 3]], quads[:, [1, 3, 0]])
    return np.stack((one, other), axis=1)
