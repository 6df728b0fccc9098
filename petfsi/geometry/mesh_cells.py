"""The cells of mesh files: those that a shape means, as simplices, and what is told of the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.groups import cell_groups
from petfsi.geometry.mesh_files import open_mesh
from petfsi.geometry.quadratic import EDGES
from petfsi.geometry.splitting import KINDS, SIMPLEX, Kind, simplices
from petfsi.messages import shown
from petfsi.scene.tables import Shape

if TYPE_CHECKING:
    import meshio

#: Sides count as straight up to this part of their length.
STRAIGHT = 1e-6
#: No point is as far away, m: the products of such lengths are no numbers.
FAR = 1e60


def read_cells(
    shape: Shape, dim: int, of: int, key: str, directory: Path, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a file, scaled and moved, and the simplices of all cells of dimension ``of`` that are meant.

    Parameters
    ----------
    shape : Shape
        With ``mesh``.
    dim : int
        Of the points.
    of : int
        ``dim`` for a solid, ``dim - 1`` for a surface.
    key : str
        Where the file's name stands in the scene.
    directory : Path
        What that is relative to.
    notes : list of str
        Gets what a user should know of how the file was read.

    Returns
    -------
    points : ndarray, shape (n, dim)
        m; some may be of no cell.
    simplices : ndarray of int, shape (m, of + 1)

    Raises
    ------
    InputError
        If there are none.
    """
    mesh, said = open_mesh(shape, key, directory)
    notes += [f"{key}: {shown(note, 300)}" for note in said]
    where = f"{key} = {shape.mesh!r}"
    points = np.asarray(mesh.points, dtype=float)
    found, unused = [], np.ones(len(points), dtype=bool)
    for n, kind, nodes in body_blocks(mesh, shape, of, key):
        unused[nodes] = False
        found.append(simplices(nodes[:, : kind.corners], of)[0])
        notes += _taken(points, mesh.cells[n].type, kind, nodes, key, len(found[-1]))
    for name, count in _others(mesh, of).items():
        notes.append(f"{key}: {count:,} cells of type {name} are not read")
    if not found:
        held = shown(", ".join(sorted({block.type for block in mesh.cells if len(block.data)})), 200)
        held = "; ".join([held or "no cells at all", *(shown(note, 300) for note in said)])
        raise InputError(f"{where}: holds no {SIMPLEX[of]} cells, which dim = {dim} wants; found {held}")
    if shape.cells is None:
        advice = groups_advised(mesh, of)
        notes += [f"{key}: {advice}"] * bool(advice)
    if unused.any() and shape.cells is None:
        notes.append(f"{key}: {np.count_nonzero(unused):,} points that belong to no cell are left out")
    points = _as_dim(points, dim, where) * shape.scale + np.array(shape.translate or [0.0] * dim)
    far = np.abs(points).max()
    if far > FAR:
        raise InputError(f"{where}: a coordinate of {far:g} m is no place to compute with")
    return points, np.concatenate(found)


def body_blocks(mesh: meshio.Mesh, shape: Shape, of: int, key: str) -> Iterator[tuple[int, Kind, np.ndarray]]:
    """Return number, kind and nodes of the blocks of cells that a shape means: those of dimension ``of``, in its group.

    Without a group these are the file's elements; sides that it names beside them only if there are none.

    Raises
    ------
    InputError
        If there is no such group.
    """
    parts: dict[int, slice | np.ndarray] = {n: slice(None) for n in _without_added(mesh, of)[0]}
    if shape.cells is not None:
        groups = cell_groups(mesh, of)
        if shape.cells not in groups:
            known = shown(", ".join(sorted(groups)), 300) or "none at all"
            where = f"{key.removesuffix('mesh')}cells = {shape.cells!r}"
            raise InputError(f"{where}: the mesh file has no such group of cells; it has {known}")
        parts = {n: chosen for n, chosen in enumerate(groups[shape.cells]) if len(chosen)}
    for n, part in parts.items():
        yield n, KINDS[mesh.cells[n].type], np.asarray(mesh.cells[n].data, dtype=np.int64)[part]


def groups_advised(mesh: meshio.Mesh, of: int) -> str:
    """Return what to say of groups where all cells are taken and these are not all in each; else nothing."""
    taken, added = _without_added(mesh, of)
    count = sum(len(mesh.cells[n].data) for n in taken)
    groups = cell_groups(mesh, of)
    if all(sum(len(chosen[n]) for n in taken) == count for chosen in groups.values()):
        return ""
    names = shown(", ".join(sorted(groups)), 300)
    but = ", but no surfaces made of other cells' sides" if added else ""
    return f"all cells are taken, of whatever group{but}; cells = ... would take one of the groups {names}"


def _without_added(mesh: meshio.Mesh, of: int) -> tuple[list[int], bool]:
    """Return the blocks of elements of a dimension, and whether there are others, of sides that surfaces name.

    A surface for a contact or a load is no part of what encloses a body: one with a skin of its own is that skin.
    Where there are no elements, all that surfaces name is taken.
    """
    every = [n for n, block in enumerate(mesh.cells)
             if len(block.data) and block.type in KINDS and KINDS[block.type].dim == of]  # fmt: skip
    own = [n for n in every if n not in (mesh.info or {}).get("added", ())]
    return own or every, 0 < len(own) < len(every)


def _others(mesh: meshio.Mesh, of: int) -> dict[str, int]:
    """Return how many cells of which types are neither of dimension ``of`` nor parts of such cells' boundary."""
    found: dict[str, int] = {}
    for block in mesh.cells:
        kind = KINDS.get(block.type)
        if len(block.data) and (block.type != "vertex" if kind is None else kind.dim > of):
            found[block.type] = found.get(block.type, 0) + len(block.data)
    return found


def _taken(points: np.ndarray, name: str, kind: Kind, nodes: np.ndarray, key: str, count: int) -> Iterator[str]:
    """Say what was done with cells of which simplices were made."""
    if kind.corners != kind.dim + 1:
        yield f"{key}: {len(nodes):,} cells of type {name} are cut into {count:,} of type {SIMPLEX[kind.dim]}"
    if kind.order > 1:
        bent = ""
        if kind.order == 2 and kind.dim > 1 and kind.corners == kind.dim + 1:
            ends = points[nodes[:, EDGES[kind.dim]]]
            middles = points[nodes[:, kind.corners : kind.corners + ends.shape[1]]]
            off = np.linalg.norm(middles - ends.mean(axis=2), axis=-1)
            if np.any(off > STRAIGHT * np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)):
                bent = f", up to {off.max():.3g} (in the file's unit) beside the middles of curved ones"
        yield f"{key}: {len(nodes):,} cells of type {name} are read by their corners: sides are straight{bent}"


def _as_dim(points: np.ndarray, dim: int, where: str) -> np.ndarray:
    count = np.count_nonzero(~np.isfinite(points).all(axis=1))
    if count:
        raise InputError(f"{where}: {count} points with a coordinate that is no number")
    if points.shape[1] < dim:
        raise InputError(f"{where}: points have {points.shape[1]} coordinates, dim = {dim} wants {dim}")
    if points.shape[1] > dim and np.ptp(points[:, dim:], axis=0).max() > 1e-9 * np.ptp(points, axis=0).max():
        raise InputError(f"{where}: the points do not lie in one plane z = constant, as dim = 2 wants")
    return np.ascontiguousarray(points[:, :dim])
