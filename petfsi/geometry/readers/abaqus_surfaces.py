"""Surfaces of Abaqus's input files: sides of elements, or nodes, by name.

A solid element has the sides S1, S2, ..., a shell the edges E1, E2, ... and is itself a facet, SPOS or SNEG (*Abaqus
Analysis User's Guide*, "Element-based surface definition" and, for the numbers of sides, the elements' libraries).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import meshio
import numpy as np

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


class Block(NamedTuple):
    """Elements of one type.

    Attributes
    ----------
    kind : str
        The cell, by meshio's name.
    type : str
        As the file has it.
    letter : str
        What the names of its sides begin with, S or E; nothing if it has none.
    numbers : ndarray of int, shape (n,)
    nodes : ndarray of int, shape (n, k)
        By the file's numbers.
    """

    kind: str
    type: str
    letter: str
    numbers: np.ndarray
    nodes: np.ndarray


class Surface(NamedTuple):
    """A card *SURFACE: its name, what is given with it and its lines."""

    name: str
    given: Mapping[str, str]
    lines: list[str]

    @property
    def type(self) -> str:
        """TYPE, in capitals."""
        return self.given.get("TYPE", "ELEMENT").upper()


class _Unread(Exception):
    """Why a surface cannot be read."""


class _Facets:
    """Facets by the surfaces that they are of: whole elements by block and row, others by their corners."""

    def __init__(self) -> None:
        self.elements: list[tuple[str, int, np.ndarray]] = []
        self.sides: list[tuple[str, np.ndarray]] = []


def add_surfaces(
    mesh: meshio.Mesh,
    blocks: list[Block],
    tags: np.ndarray,
    surfaces: list[Surface],
    sets: Mapping[str, Mapping[str, np.ndarray]],
    notes: list[str],
) -> None:
    """Give a mesh the facets and nodes of surfaces as groups; those that cannot be read whole are told.

    Names have no case, and cards of one name and type are one surface. One that takes the name of a set of other nodes
    or elements is told, too: as a place, facets go before them.

    Parameters
    ----------
    mesh : meshio.Mesh
        Its cells are those of the blocks. Its ``info["unread"]`` says by name why a surface is not read.
    blocks : list of Block
    tags : ndarray of int, shape (n_points,)
        Numbers of the nodes, ascending.
    surfaces : list of Surface
    sets : mapping
        The sets of elements (``"ELSET"``) and nodes (``"NSET"``) by name.
    notes : list of str
    """
    unread: dict[str, list[str]] = {}
    facets = _Facets()
    upper = {kind: {name.upper(): numbers for name, numbers in of.items()} for kind, of in sets.items()}
    for surface in _joined(surfaces):
        name, given, lines = surface
        try:
            if not name:
                raise _Unread("it has no name")
            if "COMBINE" in given or surface.type not in ("ELEMENT", "NODE"):
                raise _Unread("COMBINE" if "COMBINE" in given else f"TYPE={surface.type}")
            if surface.type == "NODE":
                _add_nodes(mesh, name, tags, _members(lines, upper["NSET"], "nodes", tags)[""])
            else:
                hidden = _find(facets, name, mesh, blocks, _of_elements(lines, upper["ELSET"], blocks))
                notes += [f"{shown(name, 100)} is a surface and a set of other {what}: as a place it is the surface"
                          for what in hidden]  # fmt: skip
        except _Unread as reason:
            unread.setdefault(str(reason), []).append(name or "?")
    _add_elements(mesh, facets.elements)
    for corners in _FACETS:
        _add_sides(mesh, corners, [(name, part) for name, part in facets.sides if part.shape[1] == corners])
    mesh.info = {"unread": {name: why for why, names in unread.items() for name in names}}
    for why, names in unread.items():
        notes.append(f"surface {shown(', '.join(names), 100)} is not read: {why}")


def _joined(surfaces: list[Surface]) -> list[Surface]:
    """Return surfaces, those of one name and type as one, as their first card spells it; of nodes before others.

    So facets find the nodes whose name they take.
    """
    names: dict[str, str] = {}
    found: dict[tuple[str, str, bool], Surface] = {}
    for surface in surfaces:
        key = surface.name.upper()
        name = names.setdefault(key, surface.name)
        first = found.setdefault((key, surface.type, "COMBINE" in surface.given), Surface(name, surface.given, []))
        first.lines.extend(surface.lines)
    return sorted(found.values(), key=lambda surface: surface.type != "NODE")


# ---- what lines name ----------------------------------------------------------------------------------------


def _of_elements(lines: list[str], sets: Mapping[str, np.ndarray], blocks: list[Block]) -> dict[str, np.ndarray]:
    known = np.concatenate([np.zeros(0, dtype=np.int64), *(block.numbers for block in blocks)])
    return _members(lines, sets, "elements", known)


def _members(lines: list[str], sets: Mapping[str, np.ndarray], what: str, known: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers that lines name, by the name of the side that follows; of nodes that is an area."""
    found: dict[str, list[np.ndarray]] = {}
    for line in lines:
        first, side, *_ = (field.strip().strip('"').upper() for field in f"{line},,".split(","))
        if first:
            found.setdefault(side if what == "elements" else "", []).append(_numbers(first, sets, what))
    numbers = {side: np.unique(np.concatenate(parts)) for side, parts in found.items()}
    if not any(map(len, numbers.values())):
        raise _Unread(f"it names no {what}")
    missing = sum(np.count_nonzero(~np.isin(chosen, known)) for chosen in numbers.values())
    if missing:
        raise _Unread(f"it names {missing:,} {what} that are not read or not there")
    return numbers


def _numbers(word: str, sets: Mapping[str, np.ndarray], what: str) -> np.ndarray:
    """Return the numbers of a set, or a number; before them there may be the name of the one instance and a dot."""
    for name in (word, word.rpartition(".")[2]):
        if name in sets:
            return sets[name]
        if name.isdigit():
            return np.array([int(name)], dtype=np.int64)
    raise _Unread(f"no set of {what} {shown(word, 50)} is read")


# ---- their facets -------------------------------------------------------------------------------------------


def _find(
    facets: _Facets, name: str, mesh: meshio.Mesh, blocks: list[Block], members: Mapping[str, np.ndarray]
) -> list[str]:
    """Find the facets of a surface, all of them or none; return what they hide: nodes, elements."""
    elements: list[tuple[str, int, np.ndarray]] = []
    sides: list[tuple[str, np.ndarray]] = []
    for side, numbers in members.items():
        free: dict[int, np.ndarray] = {}
        for n, block in enumerate(blocks):
            rows = np.flatnonzero(np.isin(block.numbers, numbers))
            if not len(rows):
                continue
            kind, nodes = KINDS[block.kind], mesh.cells[n].data
            corners = _SIDES.get((kind.dim, kind.corners), ())
            solid = block.letter == "S"
            if side == "" and solid:
                free[n] = rows
            elif side in (*_WHOLE, "") and not solid:
                elements.append((name, n, rows))
            elif side[:1] == block.letter != "" and side[1:].isdigit() and 1 <= int(side[1:]) <= len(corners):
                sides.append((name, nodes[rows][:, corners[int(side[1:]) - 1]]))
            else:
                raise _Unread(f"{shown(side, 20)} is no side of {block.type}")
        sides += [(name, part) for part in (_free(mesh, free) if free else ())]
    hidden = _hidden(mesh, name, [part for _, part in sides] + [_corners(mesh, n, rows) for _, n, rows in elements])
    facets.elements += elements
    facets.sides += sides
    return hidden


def _hidden(mesh: meshio.Mesh, name: str, parts: list[np.ndarray]) -> list[str]:
    """Return of what there is a set that has a surface's name and lies elsewhere; the surface hides it as a place.

    Raises
    ------
    _Unread
        When that set is of facets: as groups of the mesh the two would be one.
    """
    hidden = []
    own = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(part.ravel() for part in parts)]))
    nodes = mesh.point_sets.get(name, own)
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


def _free(mesh: meshio.Mesh, chosen: Mapping[int, np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the sides of some elements, given by block and row, that are no other element's, too."""
    own: dict[tuple[int, int], list[np.ndarray]] = {}
    every: dict[tuple[int, int], list[np.ndarray]] = {}
    for n, block in enumerate(mesh.cells):
        dim, corners = KINDS[block.type][:2]
        for side in _SIDES.get((dim, corners), ()):
            every.setdefault((dim, len(side)), []).append(np.sort(block.data[:, side], axis=1))
            if n in chosen:
                own.setdefault((dim, len(side)), []).append(block.data[chosen[n]][:, side])
    for width, parts in own.items():
        sides = np.concatenate(parts)
        both = np.concatenate((np.sort(sides, axis=1), *every[width]))
        _, which, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
        # each is found twice, once as its own
        yield sides[count[which.ravel()[: len(sides)]] == 2]


# ---- groups of the mesh -------------------------------------------------------------------------------------


def _add_nodes(mesh: meshio.Mesh, name: str, tags: np.ndarray, numbers: np.ndarray) -> None:
    nodes = np.searchsorted(tags, numbers)
    if name in mesh.point_sets and not np.array_equal(mesh.point_sets[name], nodes):
        raise _Unread("a set of other nodes has its name")
    mesh.point_sets[name] = nodes


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
