"""The places of a solid that a scene speaks of: sides, shapes and the tagged facets of mesh files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.groups import cell_groups, point_groups
from petfsi.geometry.mesh_cells import body_blocks
from petfsi.geometry.mesh_files import open_mesh
from petfsi.geometry.quadratic import EDGES, facets_with_middles
from petfsi.geometry.shapes import inside
from petfsi.geometry.splitting import KINDS, simplices
from petfsi.messages import shown
from petfsi.scene.solids import Solid, Tagged
from petfsi.scene.tables import Shape

if TYPE_CHECKING:
    import meshio

    from petfsi.geometry.meshes import SimplexMesh

#: Nodes this far from a side of the bounding box, as a fraction of its size, lie on it (files may hold single
#: precision).
TOLERANCE = 1e-6

_SIDES = {"left": (0, 0), "right": (0, 1), "bottom": (1, 0), "top": (1, 1), "back": (2, 0), "front": (2, 1)}


class Tag(NamedTuple):
    """A group of facets or nodes of a mesh file, in the numbering of the body's own mesh.

    Attributes
    ----------
    facets : ndarray of int, shape (n, dim), or with middles too; None of a group of nodes
        Corners first.
    nodes : ndarray of int, shape (m,)
    unread : str
        Why it could not be read, and so has neither.
    """

    facets: np.ndarray | None
    nodes: np.ndarray
    unread: str = ""


Tags = dict[str, Tag]


def read_tags(solid: Solid, dim: int, key: str, directory: Path) -> Tags:
    """Return the groups that a solid's mesh file knows; none, unread, where the scene names no tag. Not collective.

    Of facets, see ``groups``; else of nodes, or of the body's cells, whose corners they are then.

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
    key = f"{key}.shape.mesh"
    mesh = open_mesh(solid.shape, key, directory).mesh
    corners = {n: nodes[:, : kind.corners] for n, kind, nodes in body_blocks(mesh, solid.shape, dim, key)}
    used = np.unique(np.concatenate([nodes.ravel() for nodes in corners.values()]))
    number = np.full(len(mesh.points), -1)
    number[used] = np.arange(len(used))
    found: Tags = {}
    for name, chosen in cell_groups(mesh, dim - 1).items():
        facets = np.concatenate([_simplices(mesh, n, number, own) for n, own in enumerate(chosen) if len(own)])
        facets = facets[(facets >= 0).all(axis=1)]
        found[name] = Tag(facets, np.unique(facets))
    for name, points in point_groups(mesh).items():
        nodes = number[points]
        found.setdefault(name, Tag(None, np.unique(nodes[nodes >= 0])))
    for name, chosen in cell_groups(mesh, dim).items():
        kept = [number[mesh.cells[n].data[own][:, : KINDS[mesh.cells[n].type].corners]] for n, own in enumerate(chosen)
                if len(own)]  # fmt: skip
        nodes = np.unique(np.concatenate([part.ravel() for part in kept]))
        found.setdefault(name, Tag(None, nodes[nodes >= 0]))
    for name, why in (mesh.info or {}).get("unread", {}).items():
        found.setdefault(name, Tag(None, np.zeros(0, dtype=np.int64), why))
    return found


def _simplices(mesh: meshio.Mesh, n: int, number: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the simplices of some cells of a block, renumbered."""
    kind = KINDS[mesh.cells[n].type]
    return simplices(number[np.asarray(mesh.cells[n].data)[chosen, : kind.corners]], kind.dim)[0]


def tags_of_bodies(solids: Mapping[str, Solid], mesh: SimplexMesh, directory: Path) -> dict[str, Tags]:
    """Return the groups that the scene names, by body; numbers are those of the body's own nodes. Not collective."""
    found = {}
    for body, (name, solid) in enumerate(solids.items()):
        tags = read_tags(solid, mesh.points.shape[1], f"solids.{name}", directory)
        elements = mesh.elements(body)
        found[name] = with_middles(tags, elements - elements.min()) if tags else tags
    return found


def with_middles(tags: Tags, elements: np.ndarray) -> Tags:
    """Return the same groups with the middles of edges, where the elements have some."""
    dim = {3: 2, 6: 2, 4: 3, 10: 3}[elements.shape[1]]
    edges, middles = elements[:, EDGES[dim]], elements[:, dim + 1 :]
    found = {}
    for name, (facets, nodes, unread) in tags.items():
        if facets is not None:
            facets = facets_with_middles(facets, elements)
            found[name] = Tag(facets, np.unique(facets))
        elif middles.size and not unread:
            found[name] = Tag(None, np.union1d(nodes, middles[np.isin(edges, nodes).all(axis=2)]))
        else:
            found[name] = Tag(None, nodes, unread)
    return found


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
        held[_tagged(where, key, tags).nodes] = True
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
        tag = _tagged(where, key, tags)
        if tag.facets is None:
            chosen = np.isin(facets, tag.nodes).all(axis=1)
        else:
            both = np.sort(np.concatenate((facets, tag.facets[:, : facets.shape[1]])), axis=1)
            _, group = np.unique(both, axis=0, return_inverse=True)
            chosen = np.isin(group.ravel()[: len(facets)], group.ravel()[len(facets) :])
    else:
        chosen = located(where, points, key, tags)[facets].all(axis=1)
    if not chosen.any():
        raise InputError(
            f"{key}.where: none of the {len(facets)} boundary facets (of a beam: elements) lies there whole"
        )
    return chosen


def _tagged(where: Tagged, key: str, tags: Tags) -> Tag:
    tag = tags.get(where.tag)
    if tag is not None and not tag.unread:
        return tag
    known = shown(", ".join(sorted(name for name, other in tags.items() if not other.unread)), 300) or "none at all"
    why = f"could not be read from the mesh file: {tag.unread}" if tag else "the mesh file has no such group"
    raise InputError(f"{key}.where.tag = {where.tag!r}: {why}; it has {known}")
