"""Simplex meshes: structured boxes and balls, files, and the checks that they must pass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from petfsi.errors import InputError
from petfsi.geometry.balls import ball_mesh
from petfsi.geometry.beams import strip_mesh
from petfsi.geometry.mesh_cells import groups_advised, read_cells
from petfsi.geometry.mesh_files import once, open_mesh
from petfsi.geometry.shapes import inside
from petfsi.geometry.surfaces import boundary_facets, occurrences, ridges, signed_volumes
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Box, Shape

#: A cell is degenerate below this fraction of its longest edge to the power dim.
FLAT = 1e-12
#: Points coincide within this fraction of the mesh's extent.
COINCIDENT = 1e-10
#: Points of surfaces that are this near are one, as a fraction of the extent: files may hold single precision.
ROUNDED = 1e-7
#: More points than this that near are no rounding.
CROWD = 100


@dataclass(frozen=True)
class Group:
    """Elements of one body and one kind.

    Attributes
    ----------
    body : int
    nodes : ndarray of int, shape (ne, n)
        Of each element; its first dim + 1 are its corners, unless it is a patch.
    gradients : ndarray, shape (ne, n, dim), or None
        Of a patch, several elements with one gradient: the mean gradients of its nodes' shape functions, 1/m. Patches
        of fewer nodes repeat one, with gradient zero.
    volume : ndarray, shape (ne,), or None
        Of a patch, m^3.
    """

    body: int
    nodes: np.ndarray
    gradients: np.ndarray | None = None
    volume: np.ndarray | None = None

    def take(self, chosen: np.ndarray) -> Group:
        """Return some of the elements."""
        gradients = None if self.gradients is None else self.gradients[chosen]
        volume = None if self.volume is None else self.volume[chosen]
        return Group(self.body, self.nodes[chosen], gradients, volume)


@dataclass(frozen=True)
class SimplexMesh:
    """Triangles or tetrahedra of one or more bodies, positively oriented.

    Attributes
    ----------
    points : ndarray, shape (n, dim)
        m; each body has its own.
    cells : ndarray of int, shape (ne, dim + 1)
        Linear simplices: what surfaces, files and pictures see.
    body : ndarray of int, shape (ne,)
        The body each cell belongs to.
    groups : tuple of Group
        What forces come from; without any, the cells.
    """

    points: np.ndarray
    cells: np.ndarray
    body: np.ndarray
    groups: tuple[Group, ...] = ()

    def elements(self, body: int) -> np.ndarray:
        """Return the nodes of a body's elements, those of its cells where there are no groups."""
        return next((group.nodes for group in self.groups if group.body == body), self.cells[self.body == body])

    @classmethod
    def union(cls, meshes: list[tuple[np.ndarray, np.ndarray]]) -> SimplexMesh:
        """Return the disjoint union of (points, cells) pairs, body after body."""
        offsets = np.concatenate(([0], np.cumsum([len(points) for points, _ in meshes])))
        return cls(
            np.concatenate([points for points, _ in meshes]),
            np.concatenate([cells + offset for (_, cells), offset in zip(meshes, offsets[:-1], strict=True)]),
            np.repeat(np.arange(len(meshes)), [len(cells) for _, cells in meshes]),
        )


def build_mesh(
    solid: Solid, dim: int, key: str, directory: Path, notes: list[str] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and positively oriented cells of a solid. Not collective.

    Parameters
    ----------
    solid : Solid
        The table; its shape is a box or a ball with cells, a beam (then its strip is meshed), or a mesh file.
    dim : int
        2 for triangles, 3 for tetrahedra.
    key : str
        Where the table stands in the scene, for messages: ``"solids.layer"``.
    directory : Path
        What a mesh file's path is relative to.
    notes : list of str, optional
        Gets what a user should know of how a file was read.

    Raises
    ------
    InputError
        If there is no such mesh or it is not fit for a computation.
    """
    shape, notes = solid.shape, [] if notes is None else notes
    if shape.mesh is not None:
        what = ("solid", key, dim, directory, repr(shape))
        points, cells, told = once(what, lambda: _read_solid(shape, dim, f"{key}.shape.mesh", directory))
        notes += told
        return points.copy(), cells.copy()
    if shape.beam is not None:
        return strip_mesh(shape.beam)
    if shape.ball is not None and shape.ball.cells is not None:
        return ball_mesh(shape.ball, dim)
    if shape.box is None or shape.box.cells is None:
        raise InputError(f"{key}.shape: a solid wants a box or a ball with cells, or a mesh file")
    points, cells = box_mesh(shape.box)
    if shape.cavity is not None:
        centre = points[cells].reshape(-1, math.factorial(dim), dim + 1, dim).mean(axis=(1, 2))
        points, cells = _drop_unused(
            points, cells[np.repeat(~inside(Shape(box=shape.cavity), centre), math.factorial(dim))]
        )
        if len(cells) == 0:
            raise InputError(f"{key}.shape.cavity: nothing of the box is left outside the cavity")
        _check_manifold(points, cells, f"{key}.shape.cavity")
    return points, cells


def box_mesh(box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of a meshed box; the simplices of one grid cell follow each other.

    In 2D the diagonals alternate, so that the mesh has no preferred direction; in 3D every cell falls into the
    six tetrahedra around its main diagonal (Kuhn), which fit together across cells. Points run with x slowest.
    """
    n = np.array(box.cells)
    axes = [o + s * np.arange(m + 1) / m for o, s, m in zip(box.origin, box.size, n, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(n))
    stride = np.cumprod(np.concatenate(([1], n[:0:-1] + 1)))[::-1]
    grid = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, len(n))
    corner = (grid @ stride)[:, None]
    if len(n) == 2:
        a, b, c, d = 0, stride[0], stride[0] + stride[1], stride[1]
        even = np.array([[a, b, c], [a, c, d]]).ravel()
        odd = np.array([[a, b, d], [b, c, d]]).ravel()
        cells = corner + np.where(grid.sum(axis=1, keepdims=True) % 2 == 0, even, odd)
        return points, cells.reshape(-1, 3)
    tets = [np.concatenate(([0], np.cumsum(stride[list(path)]))) for path in permutations(range(3))]
    # every other path around the diagonal is left-handed
    tets = [
        t if np.linalg.det(np.eye(3)[list(path)]) > 0 else t[[0, 2, 1, 3]]
        for t, path in zip(tets, permutations(range(3)), strict=True)
    ]
    return points, (corner + np.concatenate(tets)).reshape(-1, 4)


def _read_solid(shape: Shape, dim: int, key: str, directory: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return points and positively oriented simplices of a mesh file, scaled and moved, and what is told of them.

    Cells that are no simplices are cut into some, those of second order are taken by their corners, points of no cell
    are left out: each is told.
    """
    notes: list[str] = []
    points, cells = _drop_unused(*read_cells(shape, dim, dim, key, directory, notes))
    cells = _turned(points, cells, key, notes)
    _check(points, cells, f"{key} = {shape.mesh!r}")
    return points, cells, notes


def _turned(points: np.ndarray, cells: np.ndarray, key: str, notes: list[str]) -> np.ndarray:
    """Return cells of which none is left-handed: the order in which a file has corners says nothing of the shape."""
    left = signed_volumes(points, cells) < 0
    if left.any() and not left.all():
        notes.append(f"{key}: {np.count_nonzero(left):,} of {len(cells):,} cells had their corners in the other order")
    return np.where(left[:, None], cells[:, [1, 0, *range(2, cells.shape[1])]], cells)


def read_surface(
    shape: Shape, dim: int, key: str, directory: Path, notes: list[str] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and facets of a closed surface in a file, normals outward. Not collective.

    Points in the same place to within round-off are merged, as formats such as STL repeat them.

    Parameters
    ----------
    shape : Shape
        With ``mesh``, ``scale`` and ``translate``.
    dim : int
        2 for segments, 3 for triangles.
    key : str
        Where the shape stands in the scene, for messages: ``"obstacles.hull.shape"``.
    directory : Path
        What the path is relative to.
    notes : list of str, optional
        Gets what a user should know of how the file was read.
    """
    what = ("surface", key, dim, directory, repr(shape))
    points, facets, told = once(what, lambda: _read_closed(shape, dim, f"{key}.mesh", directory))
    if notes is not None:
        notes += told
    return points.copy(), facets.copy()


def _read_closed(shape: Shape, dim: int, key: str, directory: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    notes: list[str] = []
    points, facets = read_cells(shape, dim, dim - 1, key, directory, notes)
    where = f"{key} = {shape.mesh!r}"
    points, facets = _merged(*_drop_unused(points, facets), where)
    shared = np.sort(facets, axis=1)
    _refuse(where, np.count_nonzero(np.any(np.diff(shared, axis=1) == 0, axis=1)), "facets without extent")
    _refuse(where, np.count_nonzero(occurrences(facets) > 1), "duplicate facets")
    rim = ridges(facets).reshape(-1, dim - 1)
    open_ridges = _distinct(rim, occurrences(rim) != 2)
    advice = ""
    if open_ridges and shape.cells is None:
        advice = groups_advised(open_mesh(shape, key, directory).mesh, dim - 1)
    closed = "the surface must be closed" + f" ({advice})" * bool(advice)
    _refuse(where, open_ridges, f"edges that do not lie between exactly two facets: {closed}")
    # between two facets that agree, an edge is run through once each way (in 2D: a point is end and start once)
    ends = rim if dim == 3 else facets[:, :1]
    _, count = np.unique(ends, axis=0, return_counts=True)
    _refuse(where, np.count_nonzero(count > 1), "edges at which the facets' orientations disagree")
    volume = np.linalg.det(points[facets] - points.mean(axis=0)).sum()
    return *_drop_unused(points, facets if volume > 0 else facets[:, ::-1]), notes


def _merged(points: np.ndarray, facets: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points of which those in one place are one, and the facets with them."""
    points, number = np.unique(points, axis=0, return_inverse=True)
    near = ROUNDED * float(np.ptp(points, axis=0).max())
    # of points that are all near each other, as beside one that is far away, there are too many pairs to list
    if near > 0:
        _, count = np.unique(np.floor((points - points.min(axis=0)) / near), axis=0, return_counts=True)
        _refuse(where, int(count[count > CROWD].sum()), f"points lie within {near:g} of others: one may be far away")
    close = cKDTree(points).query_pairs(near, output_type="ndarray")
    graph = coo_matrix((np.ones(len(close)), (close[:, 0], close[:, 1])), shape=(len(points),) * 2)
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    return points[first], label[number.ravel()][facets]


def _drop_unused(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, numbered = np.unique(cells, return_inverse=True)
    return points[used], numbered.reshape(cells.shape)


def _refuse(where: str, count: int, what: str) -> None:
    if count:
        raise InputError(f"{where}: {count} {what}")


def _distinct(tuples: np.ndarray, chosen: np.ndarray) -> int:
    return len(np.unique(np.sort(tuples[chosen], axis=1), axis=0))


def _check(points: np.ndarray, cells: np.ndarray, where: str) -> None:
    """Raise an InputError unless the mesh can carry a computation."""
    dim = points.shape[1]
    volume = signed_volumes(points, cells)
    longest = np.zeros(len(cells))
    for a in range(dim + 1):
        for b in range(a):
            np.maximum(longest, np.linalg.norm(points[cells[:, a]] - points[cells[:, b]], axis=1), out=longest)
    _refuse(where, np.count_nonzero(np.abs(volume) <= FLAT * longest**dim), "cells with zero volume")
    _refuse(where, np.count_nonzero(volume < 0), "inverted cells")
    _refuse(where, np.count_nonzero(occurrences(cells) > 1), "duplicate cells (the same points more than once)")
    _refuse(where, _folds(cells), "facets whose two cells lie on the same side: the mesh is folded over itself")
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    extent = np.ptp(points, axis=0).max()
    _refuse(where, np.count_nonzero(distance <= COINCIDENT * extent), "duplicate points (in the same place)")
    _check_manifold(points, cells, where)


def _folds(cells: np.ndarray) -> int:
    """Return between how many pairs of right-handed cells a facet has both on the same side."""
    n = cells.shape[1]
    faces = np.concatenate([np.delete(cells, a, axis=1) for a in range(n)])
    side = np.repeat([(-1) ** a for a in range(n)], len(cells))
    order = np.argsort(faces, axis=1)
    for a in range(n - 1):
        for b in range(a):
            side *= np.sign(order[:, a] - order[:, b])
    _, which, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    total = np.bincount(which.ravel(), weights=side)
    return int(np.count_nonzero((count == 2) & (total != 0)))


def _check_manifold(points: np.ndarray, cells: np.ndarray, where: str) -> None:
    dim = points.shape[1]
    faces = np.concatenate([np.delete(cells, a, axis=1) for a in range(dim + 1)])
    _refuse(where, _distinct(faces, occurrences(faces) > 2), "facets that belong to more than two cells")
    rim = ridges(boundary_facets(points, cells)).reshape(-1, dim - 1)
    count = _distinct(rim, occurrences(rim) != 2)
    kind = "points" if dim == 2 else "edges"
    _refuse(where, count, f"boundary {kind} at which the surface meets itself (non-manifold boundary)")
