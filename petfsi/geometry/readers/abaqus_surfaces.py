"""Surfaces of Abaqus's input files: sides of elements, or nodes, by name.

A solid element has the sides S1, S2, ..., a shell the edges E1, E2, ... and is itself a facet, SPOS or SNEG (*Abaqus
Analysis User's Guide*, "Element-based surface definition" and, for the numbers of sides, the elements' libraries).
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

import meshio
import numpy as np

from petfsi.geometry.readers.abaqus_sets import KINDS_OF_SETS, Sets
from petfsi.geometry.readers.numbered import Block
from petfsi.geometry.splitting import KINDS
from petfsi.messages import shown

#: Corners of the sides S1, S2, ..., by the dimension of an element and the number of its corners.
_SIDES = {
    (2, 3): ((0, 1), (1, 2), (2, 0)),
    (2, 4): ((0, 1), (1, 2), (2, 3), (3, 0)),
    (3, 4): ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    (3, 5): ((0, 1, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)),
    (3, 6): ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    (3, 8): ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
#: Cells that facets of so many corners are.
_FACETS = {2: "line", 3: "triangle", 4: "quad"}
#: An element that is a facet itself, by its two faces.
_WHOLE = ("SPOS", "SNEG")


class Surface(NamedTuple):
    """A card *SURFACE: its name, what is given with it, its lines and the sets that these name."""

    name: str
    given: Mapping[str, str]
    lines: list[str]
    sets: Sets

    @property
    def type(self) -> str:
        """TYPE, in capitals."""
        return self.given.get("TYPE", "ELEMENT").upper()


class _Unread(Exception):
    """Why a surface cannot be read."""


class _Found:
    """Places by the surfaces that they are of: whole elements by block and row, sides by their corners, nodes."""

    def __init__(self) -> None:
        self.elements: list[tuple[str, int, np.ndarray]] = []
        self.sides: list[tuple[str, np.ndarray]] = []
        self.nodes: list[tuple[str, np.ndarray]] = []

    def drop(self, names: Collection[str]) -> None:
        """Forget what is of surfaces of these names."""
        self.elements = [part for part in self.elements if part[0] not in names]
        self.sides = [part for part in self.sides if part[0] not in names]
        self.nodes = [part for part in self.nodes if part[0] not in names]


def add_surfaces(
    mesh: meshio.Mesh,
    blocks: list[Block],
    tags: np.ndarray,
    surfaces: list[Surface],
    notes: list[str],
) -> None:
    """Give a mesh the facets and nodes of surfaces as groups; those that cannot be read whole are told.

    Names have no case, and cards of one name and type are one surface. One that takes the name of a set of other nodes
    or elements is told, too: as a place, facets go before them.

    Parameters
    ----------
    mesh : meshio.Mesh
        Its cells are those of the blocks. Its ``info["unread"]`` says by name why a surface is not read, and
        ``info["added"]`` which blocks hold sides of elements, instead of elements.
    blocks : list of Block
    tags : ndarray of int, shape (n_points,)
        Numbers of the nodes, ascending.
    surfaces : list of Surface
    notes : list of str
    """
    unread: dict[str, list[str]] = {}
    found, bare = _Found(), _Bare(mesh)
    elements = np.concatenate([np.zeros(0, dtype=np.int64), *(block.numbers for block in blocks)])
    for surface in _joined(surfaces):
        name, given = surface.name, surface.given
        try:
            if not name:
                raise _Unread("it has no name")
            if "COMBINE" in given or surface.type not in ("ELEMENT", "NODE"):
                raise _Unread("COMBINE" if "COMBINE" in given else f"TYPE={surface.type}")
            if surface.type == "NODE":
                _find_nodes(found, name, mesh, tags, _members(surface, "NSET", tags)[""])
            else:
                members = _members(surface, "ELSET", elements)
                hidden = _find_facets(found, name, mesh, blocks, bare, members)
                notes += [f"{shown(name, 100)} is a surface and a set of other {what}: as a place it is the surface"
                          for what in hidden]  # fmt: skip
        except _Unread as reason:
            unread.setdefault(str(reason), []).append(name or "?")
    why = {name: what for what, names in unread.items() for name in names}
    found.drop(why)  # a name may have several cards, and some of them be read
    mesh.point_sets.update(found.nodes)
    _add_elements(mesh, found.elements)
    for corners in _FACETS:
        _add_sides(mesh, corners, [(name, part) for name, part in found.sides if part.shape[1] == corners])
    mesh.info = {"unread": why, "added": range(len(blocks), len(mesh.cells))}
    for what, names in unread.items():
        notes.append(f"surface {shown(', '.join(dict.fromkeys(names)), 100)} is not read: {what}")


def _joined(surfaces: list[Surface]) -> list[Surface]:
    """Return surfaces, those of one name and type as one, as their first card spells it; of nodes before others.

    So facets find the nodes whose name they take.
    """
    names: dict[str, str] = {}
    found: dict[tuple[str, str, bool], Surface] = {}
    for surface in surfaces:
        key = surface.name.upper()
        name = names.setdefault(key, surface.name)
        first = found.setdefault(
            (key, surface.type, "COMBINE" in surface.given), Surface(name, surface.given, [], surface.sets)
        )
        first.lines.extend(surface.lines)
    return sorted(found.values(), key=lambda surface: surface.type != "NODE")


# ---- what lines name ----------------------------------------------------------------------------------------


def _members(surface: Surface, kind: str, known: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers that lines name, by the name of the side that follows; of nodes that is an area."""
    what = KINDS_OF_SETS[kind]
    found: dict[str, list[np.ndarray]] = {}
    for line in surface.lines:
        first, side, *_ = (field.strip().replace('"', "").upper() for field in f"{line},,".split(","))
        if not first:
            raise _Unread(f"a line names no {what}")
        chosen = surface.sets.find(kind, first)
        if chosen is None:
            raise _Unread(f"no set of {what} {shown(first, 50)} is read")
        found.setdefault(side if kind == "ELSET" else "", []).append(chosen)
    numbers = {side: np.unique(np.concatenate(parts)) for side, parts in found.items()}
    if not any(map(len, numbers.values())):
        raise _Unread(f"it names no {what}")
    missing = sum(np.count_nonzero(~np.isin(chosen, known)) for chosen in numbers.values())
    if missing:
        raise _Unread(f"it names {missing:,} {what} that are not read or not there")
    return numbers


# ---- their facets and nodes ---------------------------------------------------------------------------------


def _find_facets(
    found: _Found, name: str, mesh: meshio.Mesh, blocks: list[Block], bare: _Bare, members: Mapping[str, np.ndarray]
) -> list[str]:
    """Find the facets of a surface, all of them or none; return what they hide: nodes, elements."""
    elements: list[tuple[str, int, np.ndarray]] = []
    sides: list[tuple[str, np.ndarray]] = []
    for side, numbers in members.items():
        for n, block in enumerate(blocks):
            rows = np.flatnonzero(np.isin(block.numbers, numbers))
            if not len(rows):
                continue
            kind, nodes = KINDS[block.kind], mesh.cells[n].data
            corners = _SIDES.get((kind.dim, kind.corners), ())
            solid = block.letter == "S"
            if side == "" and solid:
                sides += [(name, part) for part in bare.sides(n, rows)]
            elif side in (*_WHOLE, "") and not solid:
                elements.append((name, n, rows))
            elif side[:1] == block.letter != "" and side[1:].isdigit() and 1 <= int(side[1:]) <= len(corners):
                sides.append((name, nodes[rows][:, corners[int(side[1:]) - 1]]))
            else:
                raise _Unread(f"{shown(side, 20)} is no side of {block.type}")
    hidden = _hidden(
        found, mesh, name, [part for _, part in sides] + [_corners(mesh, n, rows) for _, n, rows in elements]
    )
    found.elements += elements
    found.sides += sides
    return hidden


def _hidden(found: _Found, mesh: meshio.Mesh, name: str, parts: list[np.ndarray]) -> list[str]:
    """Return of what there is a set that has a surface's name and lies elsewhere; the surface hides it as a place.

    Raises
    ------
    _Unread
        When that set is of facets: as groups of the mesh the two would be one.
    """
    hidden = []
    own = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(part.ravel() for part in parts)]))
    nodes = dict(found.nodes).get(name, mesh.point_sets.get(name, own))
    if not np.array_equal(nodes, own):
        corner = np.zeros(len(mesh.points), dtype=bool)
        for n in range(len(mesh.cells)):
            corner[_corners(mesh, n)] = True
        # sets may hold nodes in the middles of sides, too
        if not np.array_equal(nodes[corner[nodes]], own):
            hidden.append("nodes")
    chosen = [(n, rows) for n, rows in enumerate(mesh.cell_sets.get(name, [])) if len(rows)]
    others = [_corners(mesh, n, rows).ravel() for n, rows in chosen]
    if others and not np.array_equal(np.unique(np.concatenate(others)), own):
        width = max((part.shape[1] for part in parts), default=0)
        if any(KINDS[mesh.cells[n].type].dim == (1 if width == 2 else 2) for n, _ in chosen):
            raise _Unread("a set of other elements has its name")
        hidden.append("elements")
    return hidden


def _corners(mesh: meshio.Mesh, n: int, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the corners of elements of a block."""
    return mesh.cells[n].data[rows, : KINDS[mesh.cells[n].type].corners]


def _find_nodes(found: _Found, name: str, mesh: meshio.Mesh, tags: np.ndarray, numbers: np.ndarray) -> None:
    nodes = np.searchsorted(tags, numbers)
    known = [mesh.point_sets[name]] if name in mesh.point_sets else [other for of, other in found.nodes if of == name]
    if any(not np.array_equal(nodes, other) for other in known):
        raise _Unread("a set of other nodes has its name")
    found.nodes.append((name, nodes))


class _Bare:
    """The sides of a mesh's elements that are no other element's, too: found when first asked for, for all at once."""

    def __init__(self, mesh: meshio.Mesh) -> None:
        self._mesh = mesh

    def sides(self, n: int, rows: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the corners of those sides of some elements, given by block and row."""
        nodes = self._mesh.cells[n].data[rows]
        for (of, side), bare in self._found.items():
            if of == n:
                yield nodes[bare[rows]][:, side]

    @functools.cached_property
    def _found(self) -> dict[tuple[int, tuple[int, ...]], np.ndarray]:
        """By block and corners of a side, of which of the block's elements it is bare."""
        alike: dict[tuple[int, int], list[tuple[int, tuple[int, ...]]]] = {}
        for n, block in enumerate(self._mesh.cells):
            dim, corners = KINDS[block.type][:2]
            for side in _SIDES.get((dim, corners), ()):
                alike.setdefault((dim, len(side)), []).append((n, side))
        found: dict[tuple[int, tuple[int, ...]], np.ndarray] = {}
        for keys in alike.values():
            parts = [np.sort(self._mesh.cells[n].data[:, side], axis=1) for n, side in keys]
            _, which, count = np.unique(np.concatenate(parts), axis=0, return_inverse=True, return_counts=True)
            ends = np.cumsum([len(part) for part in parts])
            found |= dict(zip(keys, np.split(count[which.ravel()] == 1, ends[:-1]), strict=True))
        return found


# ---- groups of the mesh -------------------------------------------------------------------------------------


def _add_elements(mesh: meshio.Mesh, elements: list[tuple[str, int, np.ndarray]]) -> None:
    for name, n, rows in elements:
        of = mesh.cell_sets.setdefault(name, [np.zeros(0, dtype=np.int64)] * len(mesh.cells))
        of[n] = np.union1d(of[n], rows)


def _add_sides(mesh: meshio.Mesh, corners: int, sides: list[tuple[str, np.ndarray]]) -> None:
    """Give a mesh facets of so many corners, each once: surfaces may share some, and some may be elements, too."""
    if not sides:
        return
    like = KINDS[_FACETS[corners]]
    old = [n for n, block in enumerate(mesh.cells) if KINDS[block.type][:2] == like[:2]]
    parts = [mesh.cells[n].data[:, :corners] for n in old] + [part for _, part in sides]
    begin = np.concatenate(([0], np.cumsum([len(part) for part in parts])))
    every = np.concatenate(parts)
    _, first, which = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True)
    first = first[which.ravel()]
    new = np.unique(first[first >= begin[len(old)]])
    if len(new):
        mesh.cells.append(meshio.CellBlock(_FACETS[corners], every[new]))
        for of in mesh.cell_sets.values():
            of.append(np.zeros(0, dtype=np.int64))
    found: list[tuple[str, int, np.ndarray]] = []
    for k, (name, _) in enumerate(sides, len(old)):
        chosen = first[begin[k] : begin[k + 1]]
        for m, n in enumerate(old):
            found.append((name, n, chosen[(chosen >= begin[m]) & (chosen < begin[m + 1])] - begin[m]))
        if len(new):
            found.append((name, len(mesh.cells) - 1, np.searchsorted(new, chosen[chosen >= begin[len(old)]])))
    _add_elements(mesh, found)
