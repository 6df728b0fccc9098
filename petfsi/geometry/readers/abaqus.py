"""Nodes, elements, sets and surfaces of Abaqus's and CalculiX's input files.

meshio knows some types of elements, and takes no blank fields, no sets that are generated and no names in another case.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np

from petfsi.geometry.readers.abaqus_cards import read_cards
from petfsi.geometry.readers.abaqus_surfaces import Block, Surface, add_surfaces

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


class _Sets:
    """Sets of numbers by name; a set may hold others, and names have no case."""

    def __init__(self) -> None:
        self._found: dict[str, list[np.ndarray | str]] = {}
        self._names: dict[str, str] = {}

    def add(self, name: str, found: list[np.ndarray | str]) -> None:
        self._names.setdefault(name.upper(), name)
        self._found.setdefault(name.upper(), []).extend(found)

    def all(self) -> dict[str, np.ndarray]:
        """Return the numbers of each set."""
        return {name: self._numbers(key, ()) for key, name in self._names.items()}

    def _numbers(self, key: str, above: tuple[str, ...]) -> np.ndarray:
        if key in above or len(above) > 20:
            return np.zeros(0, dtype=np.int64)
        parts = [self._numbers(part, (*above, key)) if isinstance(part, str) else part
                 for part in self._found.get(key, [])]  # fmt: skip
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *parts]))


def read_abaqus(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return a mesh with its sets of nodes and elements and its surfaces; what is no cell is told."""
    points: list[tuple[np.ndarray, np.ndarray]] = []
    cells: list[Block] = []
    surfaces: list[Surface] = []
    node_sets, element_sets = _Sets(), _Sets()
    others: dict[str, int] = {}
    instances = 0
    for word, given, lines in read_cards(path):
        if word in ("NODE", "ELEMENT") and "INPUT" in given:
            raise meshio.ReadError(f"*{word} with INPUT: put *INCLUDE, INPUT={given['INPUT']} in the line after it")
        if word == "NODE":
            if given.get("SYSTEM", "R").upper() != "R":
                raise meshio.ReadError("nodes in coordinates that are not rectangular (*NODE, SYSTEM)")
            points.append(_nodes(lines))
            if "NSET" in given:
                node_sets.add(given["NSET"], [points[-1][0]])
        elif word == "ELEMENT":
            name = given.get("TYPE", "?").upper()
            kind, letter = _kind(name)
            if kind is None:
                others[name] = others.get(name, 0) + len(lines)
                continue
            rows = _elements(lines, name, _NODES[kind])
            cells.append(Block(kind, name, letter, rows[:, 0], rows[:, 1:]))
            if "ELSET" in given:
                element_sets.add(given["ELSET"], [rows[:, 0]])
        elif word in ("NSET", "ELSET") and word in given:
            (node_sets if word == "NSET" else element_sets).add(given[word], list(_members(lines, "GENERATE" in given)))
        elif word == "SURFACE":
            surfaces.append(Surface(given.get("NAME", ""), given, lines))
        elif word in _MAKERS:
            raise meshio.ReadError(f"*{word}: nodes and elements must be written out, in one frame")
        elif word == "INSTANCE":
            instances += 1
            if instances > 1 or any(line.strip(", ") for line in lines):
                raise meshio.ReadError("parts that are moved or there more than once (*INSTANCE): flatten the model")
    notes += [f"{count:,} lines of elements of type {name} are not read" for name, count in others.items()]
    if not any(len(numbers) for numbers, _ in points):
        raise meshio.ReadError("no nodes (*NODE)")
    sets = {"NSET": node_sets.all(), "ELSET": element_sets.all()}
    mesh, tags = _joined(points, cells, sets["NSET"], sets["ELSET"])
    add_surfaces(mesh, cells, tags, surfaces, sets, notes)
    return mesh


def _joined(
    points: list[tuple[np.ndarray, np.ndarray]],
    cells: list[Block],
    node_sets: dict[str, np.ndarray],
    element_sets: dict[str, np.ndarray],
) -> tuple[meshio.Mesh, np.ndarray]:
    """Return the mesh and the numbers of its nodes, by which they stand; of a node that is given twice the last."""
    tags, first = np.unique(np.concatenate([numbers for numbers, _ in points])[::-1], return_index=True)
    where = np.concatenate([x for _, x in points])[::-1][first]
    blocks = []
    for block in cells:
        place = np.minimum(np.searchsorted(tags, block.nodes), len(tags) - 1)
        if np.any(tags[place] != block.nodes):
            raise meshio.ReadError("elements name nodes that the file does not hold")
        blocks.append(meshio.CellBlock(block.kind, place))
    sets = {name: [np.flatnonzero(np.isin(block.numbers, chosen)) for block in cells]
            for name, chosen in element_sets.items()}  # fmt: skip
    of = {name: np.flatnonzero(np.isin(tags, chosen)) for name, chosen in node_sets.items()}
    return meshio.Mesh(where, blocks, cell_sets=sets, point_sets=of), tags


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


def _members(lines: list[str], generated: bool) -> Iterator[np.ndarray | str]:
    """Yield numbers and names of other sets."""
    if generated:
        for line in lines:
            first, last, step = ([int(field) for field in line.split(",") if field.strip()] + [1])[:3]
            yield np.arange(first, last + 1, max(step, 1))
        return
    fields = [field.strip() for field in ",".join(lines).split(",") if field.strip()]
    yield np.array([field for field in fields if field.isdigit()], dtype=np.int64)
    yield from (field.strip('"').upper() for field in fields if not field.isdigit())
