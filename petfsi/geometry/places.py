"""The places of a solid that a scene speaks of: sides, shapes and the tagged facets of mesh files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.meshes import cell_blocks, open_mesh
from petfsi.geometry.quadratic import facets_with_middles
from petfsi.geometry.shapes import inside
from petfsi.geometry.splitting import KINDS, simplices
from petfsi.messages import shown
from petfsi.scene.schema import Solid, Tagged
from petfsi.scene.tables import Shape

#: Nodes this far from a side of the bounding box, as a fraction of its size, lie on it (files may hold single
#: precision).
TOLERANCE = 1e-6

_SIDES = {"left": (0, 0), "right": (0, 1), "bottom": (1, 0), "top": (1, 1), "back": (2, 0), "front": (2, 1)}

#: The facets of each tag in the numbering of the body's own mesh, corners first: shape (n, dim), or with middles too.
Tags = dict[str, np.ndarray]


def read_tags(solid: Solid, dim: int, key: str, directory: Path) -> Tags:
    """Return the groups of facets that a solid's mesh file knows; none, unread, where the scene names no tag.

    They are gmsh's physical groups, by name or else by number, and other formats' named sets of cells. Not collective.

    Parameters
    ----------
    solid : Solid
    dim : int
    key : str
        Where the table stands in the scene: ``"solids.layer"``.
    directory : Path
        What the mesh file's path is relative to.
    """
    places = [*(support.where for support in solid.supports), *(load.where for load in solid.loads)]
    if solid.shape.mesh is None or not any(isinstance(where, Tagged) for where in places):
        return {}
    mesh = open_mesh(solid.shape, f"{key}.shape.mesh", directory)
    corners = [nodes[:, : kind.corners].ravel() for _, kind, nodes in cell_blocks(mesh) if kind and kind.dim == dim]
    used = np.unique(np.concatenate(corners))
    number = np.full(len(mesh.points), -1)
    number[used] = np.arange(len(used))
    names = {(int(tag), int(of)): name for name, (tag, of) in mesh.field_data.items()}
    groups: dict[str, list[np.ndarray]] = {}
    for n, block in enumerate(mesh.cells):
        kind = KINDS.get(block.type)
        if kind is None or kind.dim != dim - 1 or not len(block.data):
            continue
        facets, owner = simplices(number[block.data[:, : kind.corners]], kind.dim)
        sets = {name: chosen[n] for name, chosen in mesh.cell_sets.items() if not name.startswith("gmsh:")}
        physical = mesh.cell_data.get("gmsh:physical")
        if physical is not None:
            for tag in np.unique(physical[n][physical[n] > 0]).tolist():
                sets.setdefault(names.get((tag, dim - 1), str(tag)), physical[n] == tag)
        for name, chosen in sets.items():
            among = np.zeros(len(block.data), dtype=bool)
            if chosen is not None:
                among[chosen] = True
            if among.any():
                groups.setdefault(name, []).append(facets[among[owner]])
    return {name: np.concatenate(facets) for name, facets in groups.items()}


def with_middles(tags: Tags, elements: np.ndarray) -> Tags:
    """Return the same facets with the middles of their edges, where the elements have some."""
    return {name: facets_with_middles(facets, elements) for name, facets in tags.items()}


def located(where: str | Shape | Tagged, points: np.ndarray, key: str, tags: Tags) -> np.ndarray:
    """Return which reference points of one body lie in a place; those of a beam are given from start to end.

    Parameters
    ----------
    where : str or Shape or Tagged
    points : ndarray, shape (n, dim)
        m.
    key : str
        Where the table with ``where`` stands in the scene, for messages.
    tags : Tags
        Of the body.

    Returns
    -------
    ndarray of bool, shape (n,)

    Raises
    ------
    InputError
        If there is none.
    """
    lower, upper = points.min(axis=0), points.max(axis=0)
    if isinstance(where, Tagged):
        held = np.zeros(len(points), dtype=bool)
        held[_tagged(where, key, tags)] = True
    elif isinstance(where, Shape):
        held = inside(where, points)
    elif where in ("start", "end"):
        held = np.arange(len(points)) == (0 if where == "start" else len(points) - 1)
    elif where == "all":
        held = np.ones(len(points), dtype=bool)
    else:
        axis, end = _SIDES[where]
        held = np.abs(points[:, axis] - (lower, upper)[end][axis]) <= TOLERANCE * (upper - lower).max()
    if not held.any():
        reach = f"its nodes reach from {lower.tolist()} to {upper.tolist()} m"
        raise InputError(f"{key}.where: no node of the solid lies there; {reach}")
    return held


def located_facets(
    where: str | Shape | Tagged, points: np.ndarray, facets: np.ndarray, key: str, tags: Tags
) -> np.ndarray:
    """Return which boundary facets of one body lie in a place, with all their nodes; of a tag those that it names.

    Parameters
    ----------
    where : str or Shape or Tagged
    points : ndarray, shape (n, dim)
        m.
    facets : ndarray of int, shape (n_facets, dim)
        All boundary facets of the body; of a beam its elements.
    key : str
        Where the table with ``where`` stands in the scene, for messages.
    tags : Tags
        Of the body.

    Returns
    -------
    ndarray of bool, shape (n_facets,)

    Raises
    ------
    InputError
        If there is none.
    """
    if isinstance(where, Tagged):
        tagged = _tagged(where, key, tags)[:, : facets.shape[1]]
        both = np.sort(np.concatenate((facets, tagged)), axis=1)
        _, group = np.unique(both, axis=0, return_inverse=True)
        chosen = np.isin(group.ravel()[: len(facets)], group.ravel()[len(facets) :])
    else:
        chosen = located(where, points, key, tags)[facets].all(axis=1)
    if not chosen.any():
        raise InputError(
            f"{key}.where: none of the {len(facets)} boundary facets (of a beam: elements) lies there whole"
        )
    return chosen


def _tagged(where: Tagged, key: str, tags: Tags) -> np.ndarray:
    if where.tag not in tags:
        known = shown(", ".join(sorted(tags)), 300) or "none at all"
        raise InputError(f"{key}.where.tag = {where.tag!r}: the mesh file has no such group of facets; it has {known}")
    facets = tags[where.tag]
    return facets[(facets >= 0).all(axis=1)]
