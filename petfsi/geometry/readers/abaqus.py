"""Nodes, elements, sets and surfaces of Abaqus's and CalculiX's input files.

meshio knows some types of elements, and takes no blank fields, no sets that are generated and no names in another case.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np

from petfsi.geometry.readers.abaqus_cards import Card, read_cards
from petfsi.geometry.readers.abaqus_scopes import sorted_cards
from petfsi.geometry.readers.abaqus_sets import KINDS_OF_SETS, Member, NodesOf, Sets
from petfsi.geometry.readers.abaqus_surfaces import Surface, add_surfaces
from petfsi.geometry.readers.numbered import Block, joined
from petfsi.messages import shown

_FLAT = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
#: Families of elements, what they are for is none of a mesh's business: their cells by the number of nodes, and what
#: the names of their sides begin with.
_FAMILIES = (
    (
        re.compile(r"(?:C3D|DC3D|DCC3D|F3D|AC3D|EC3D|Q3D|SC|CSS)(\d+)"),
        {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13", 15: "wedge15",
         20: "hexahedron20", 27: "hexahedron27"},
        "S",
    ),
    (re.compile(r"(?:CPS|CPE|CPEG|DC2D|DCC2D|AC2D|F2D|CAX|CGAX|DCAX)(\d)"), _FLAT, "S"),
    (re.compile(r"(?:M3D|SFM3D|R3D|US|DS|S|STRI)(\d)"), _FLAT, "E"),
    (re.compile(r"[TR][23]D(\d)"), {2: "line", 3: "line3"}, ""),
    (re.compile(r"(?:B|PIPE)[23](\d)"), {1: "line", 2: "line3", 3: "line"}, ""),
)  # fmt: skip
_NODES = {
    "line": 2, "line3": 3, "triangle": 3, "triangle6": 6, "quad": 4, "quad8": 8, "quad9": 9, "tetra": 4, "tetra10": 10,
    "pyramid": 5, "pyramid13": 13, "wedge": 6, "wedge15": 15, "hexahedron": 8, "hexahedron20": 20, "hexahedron27": 27,
}  # fmt: skip
#: Cards that make or move nodes and elements.
_MAKERS = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "SYMMETRIC MODEL GENERATION")


class _Content(NamedTuple):
    """What is read of a part or of the assembly: nodes, elements, surfaces, and how many lines are of other types."""

    sets: Sets
    points: list[tuple[np.ndarray, np.ndarray]]
    cells: list[Block]
    surfaces: list[Surface]
    others: dict[str, int]


def read_abaqus(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return a mesh with its sets of nodes and elements and its surfaces; what is no cell is told.

    Of files with parts it is the one that is instanced, and the assembly's own nodes: points by themselves. Where both
    have a set of one name, the part's is called Instance.Name.
    """
    scopes = sorted_cards(read_cards(path), notes)
    body = _read(scopes.body, Sets())
    assembly = _read(scopes.assembly, Sets(body.sets, scopes.instance), own=False)
    for content, what in ((body, ""), (assembly, " of the assembly")):
        notes += [f"{n:,} lines of elements{what} of type {name} are not read" for name, n in content.others.items()]
    points = body.points + assembly.points
    if not any(len(numbers) for numbers, _ in points):
        raise meshio.ReadError("no nodes (*NODE)")
    numbers = {"NSET": [part for part, _ in points], "ELSET": [block.numbers for block in body.cells]}
    sets: dict[str, dict[str, np.ndarray]] = {}
    for kind in KINDS_OF_SETS:
        sets[kind] = _together(body.sets.all(kind), assembly.sets.all(kind), scopes.instance, notes)
        known = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *numbers[kind]]))
        for content in (body, assembly):
            notes += content.sets.missing(kind, known)
    mesh, tags = joined(points, body.cells, sets["NSET"], sets["ELSET"])
    add_surfaces(mesh, body.cells, tags, _all_surfaces(body, assembly, scopes.instance, notes), notes)
    return mesh


def _read(cards: list[Card], sets: Sets, own: bool = True) -> _Content:
    """Return what cards hold; elements only where the nodes are their own, as they are in a part."""
    content = _Content(sets, [], sets.blocks if own else [], [], {})
    for word, given, lines in cards:
        if word in ("NODE", "ELEMENT") and "INPUT" in given:
            raise meshio.ReadError(f"*{word} with INPUT: put *INCLUDE, INPUT={given['INPUT']} in the line after it")
        if word == "NODE":
            if given.get("SYSTEM", "R").upper() != "R":
                raise meshio.ReadError("nodes in coordinates that are not rectangular (*NODE, SYSTEM)")
            numbers, where = _nodes(lines)
            if not own and np.any(numbers < 0):
                raise meshio.ReadError("numbers of nodes must be positive")
            content.points.append((sets.own(numbers), where))
            if "NSET" in given:
                sets.add("NSET", given["NSET"], [numbers])
        elif word == "ELEMENT":
            name = given.get("TYPE", "?").upper()
            kind, letter = _kind(name)
            if kind is None or not own:
                content.others[name] = content.others.get(name, 0) + len(lines)
                continue
            rows = _elements(lines, name, _NODES[kind])
            content.cells.append(Block(kind, name, letter, rows[:, 0], rows[:, 1:]))
            if "ELSET" in given:
                sets.add("ELSET", given["ELSET"], [rows[:, 0]])
        elif word in KINDS_OF_SETS and word in given:
            sets.add(word, given[word], list(_members(word, given, lines)), given.get("INSTANCE", ""))
        elif word == "SURFACE":
            content.surfaces.append(Surface(given.get("NAME", ""), given, lines, sets))
        elif word in _MAKERS:
            raise meshio.ReadError(f"*{word}: nodes and elements must be written out, in one frame")
    return content


def _together(
    body: dict[str, np.ndarray], assembly: dict[str, np.ndarray], instance: str, notes: list[str]
) -> dict[str, np.ndarray]:
    """Return the sets of both; names that both have are the assembly's, as in what follows it in such a file."""
    theirs = {name.upper(): numbers for name, numbers in assembly.items()}
    other = [name for name, numbers in body.items() if not np.array_equal(theirs.get(name.upper(), numbers), numbers)]
    found = {f"{instance}.{name}" if name in other else name: numbers for name, numbers in body.items()
             if name in other or name.upper() not in theirs}  # fmt: skip
    _tell(other, "set", instance, notes)
    return found | assembly


def _all_surfaces(body: _Content, assembly: _Content, instance: str, notes: list[str]) -> list[Surface]:
    """Return the surfaces of both; a name that both have is the assembly's."""
    theirs = {surface.name.upper() for surface in assembly.surfaces if surface.name}
    other = [surface.name for surface in body.surfaces if surface.name.upper() in theirs]
    _tell(list(dict.fromkeys(other)), "surface", instance, notes)
    mine = [surface._replace(name=f"{instance}.{surface.name}") if surface.name in other else surface
            for surface in body.surfaces]  # fmt: skip
    return mine + assembly.surfaces


def _tell(names: list[str], what: str, instance: str, notes: list[str]) -> None:
    if names:
        told = shown(", ".join(names), 100)
        notes.append(f"part and assembly each have a {what} {told}: that of the part is {instance}.{names[0]}"
                     + (" and so on" if len(names) > 1 else ""))  # fmt: skip


def _kind(name: str) -> tuple[str | None, str]:
    """Return the cell of a type of elements, None of those that are none, and what its sides' names begin with."""
    for pattern, kinds, letter in _FAMILIES:
        found = pattern.match(name)
        if found:
            return kinds.get(int(found[1])), letter
    return None, ""


def _nodes(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of nodes and where they are: fields that are blank or not there are 0."""
    rows = [
        [field.strip() or "0" for field in (line + ",,,").upper().replace("D", "E").split(",")[:4]] for line in lines
    ]
    table = np.array(rows, dtype=float).reshape(-1, 4)
    return table[:, 0].astype(np.int64), table[:, 1:]


def _elements(lines: list[str], name: str, nodes: int) -> np.ndarray:
    """Return number and nodes of each element, which may go over several lines."""
    numbers = np.array([field for field in ",".join(lines).split(",") if field.strip()], dtype=np.int64)
    if len(numbers) % (nodes + 1):
        raise meshio.ReadError(f"elements of type {name} do not have {nodes} nodes each")
    return numbers.reshape(-1, nodes + 1)


def _members(word: str, given: Mapping[str, str], lines: list[str]) -> Iterator[Member]:
    """Yield numbers and names of other sets of a card *NSET or *ELSET."""
    if word == "NSET" and "ELSET" in given:
        yield NodesOf(given["ELSET"].upper())
        return
    if "GENERATE" in given:
        for line in lines:
            first, last, step = ([int(field) for field in line.split(",") if field.strip()] + [1])[:3]
            yield np.arange(first, last + 1, max(step, 1))
        return
    fields = [field.strip() for field in ",".join(lines).split(",") if field.strip()]
    yield np.array([field for field in fields if field.isdigit()], dtype=np.int64)
    yield from (field.replace('"', "").upper() for field in fields if not field.isdigit())
