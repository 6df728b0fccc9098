"""Nodes and elements of Nastran's bulk data; the numbers of their properties are groups.

meshio takes small fields alone of elements, lines that are as long as they may be and names in capitals, and leaves out
in silence what it does not know.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np

from petfsi.geometry.readers.nastran_cards import read_cards
from petfsi.geometry.readers.numbered import Block, joined


class _Element(NamedTuple):
    """Which field holds the first node, cells by how many nodes there are, and VTK's order where it is another."""

    first: int
    kinds: dict[int, str]
    order: dict[int, tuple[int, ...]] = {}


_LINE = {2: "line"}
_TRIANGLE, _TRIANGLE_6 = {3: "triangle"}, {3: "triangle", 6: "triangle6"}
_QUAD, _QUAD_8, _QUAD_9 = {4: "quad"}, {4: "quad", 8: "quad8"}, {4: "quad", 8: "quad8", 9: "quad9"}
_ELEMENTS = (
    {name: _Element(2, _LINE) for name in ("CROD", "CTUBE", "CBAR", "CBEAM", "CBEND")}
    | {"CONROD": _Element(1, _LINE)}
    | {name: _Element(2, _TRIANGLE) for name in ("CTRIA3", "CTRIAR", "CPLSTN3", "CPLSTS3", "CTRAX3")}
    | {name: _Element(2, _TRIANGLE_6) for name in ("CTRIA6", "CPLSTN6", "CPLSTS6", "CTRIAX", "CTRAX6")}
    # its nodes go around: corner, middle, corner
    | {"CTRIAX6": _Element(2, {6: "triangle6"}, {6: (0, 2, 4, 1, 3, 5)})}
    | {name: _Element(2, _QUAD) for name in ("CQUAD4", "CQUADR", "CSHEAR", "CPLSTN4", "CPLSTS4", "CQUADX4")}
    | {name: _Element(2, _QUAD_8) for name in ("CQUAD8", "CPLSTN8", "CPLSTS8", "CQUADX8")}
    | {name: _Element(2, _QUAD_9) for name in ("CQUAD", "CQUADX")}
    | {"CTETRA": _Element(2, {4: "tetra", 10: "tetra10"})}
    | {name: _Element(2, {5: "pyramid", 13: "pyramid13"}) for name in ("CPYRAM", "CPYRA")}
    | {"CPENTA": _Element(2, {6: "wedge", 15: "wedge15"}, {15: (*range(9), 12, 13, 14, 9, 10, 11)})}
    | {"CHEXA": _Element(2, {8: "hexahedron", 20: "hexahedron20"}, {20: (*range(12), *range(16, 20), *range(12, 16))})}
)
#: Cards that begin as those of elements do, and are of something else.
_NO_ELEMENTS = re.compile(
    r"CORD|C[A-Z]?SET|CSSCHD|CAERO|CYAX|CYJOIN|CYSUP|CYSYM|CREEP|CONV|CSUP|CLOAD|CBARAO|CONTRL|CMETHOD|CEND|CASE"
)


def read_nastran(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return a mesh; what is no cell is told."""
    nodes: list[list[str]] = []
    elements: dict[str, list[list[str]]] = {}
    others: dict[str, int] = {}
    frame = ""
    for name, fields in read_cards(path):
        if name == "GRID":
            nodes.append(fields[:5])
        elif name == "GRDSET":
            frame = fields[1]
        elif name in _ELEMENTS:
            elements.setdefault(name, []).append(fields)
        elif name[:1] == "C" and not _NO_ELEMENTS.match(name):
            others[name] = others.get(name, 0) + 1
    notes += [f"{count:,} cards {name} are not read" for name, count in others.items()]
    if not nodes:
        raise meshio.ReadError("no nodes (GRID)")
    if any((row[1] or frame or "0").strip("0") for row in nodes):
        raise meshio.ReadError("points in coordinates of their own (CP of GRID or GRDSET)")
    points = _integers([row[0] for row in nodes]), _numbers([x for row in nodes for x in row[2:5]]).reshape(-1, 3)
    blocks, properties = [], []
    for name, rows in elements.items():
        for kind, chosen in _by_kind(name, rows, notes):
            blocks.append(Block(kind.name, name, "", chosen[:, 0], chosen[:, 2:]))
            properties.append(chosen[:, 1])
    mesh, _ = joined([points], blocks, {}, {})
    if blocks:
        mesh.cell_data["nastran:ref"] = properties
    return mesh


class _Kind(NamedTuple):
    name: str
    nodes: int


def _by_kind(name: str, rows: list[list[str]], notes: list[str]) -> Iterator[tuple[_Kind, np.ndarray]]:
    """Yield the kinds of cells that elements of one name are, and number, property and nodes of each.

    One that lacks nodes within its edges is read by its corners.
    """
    element = _ELEMENTS[name]
    least, most = min(element.kinds), max(element.kinds)
    found: dict[int, list[list[str]]] = {}
    lacking = 0
    for fields in rows:
        nodes = fields[element.first : element.first + most]
        while nodes and not nodes[-1]:
            nodes.pop()
        whole = len(nodes) in element.kinds and all(nodes)
        count = len(nodes) if whole else least
        lacking += not whole
        # one that names no property has that of its own number; 0 is none
        group = fields[1] or fields[0] if element.first == 2 else "0"
        found.setdefault(count, []).append([fields[0], group, *nodes[:count]])
    for count, texts in found.items():
        if any(len(row) < count + 2 or not all(row) for row in texts):
            raise meshio.ReadError(f"elements {name} that have not {least} nodes each")
        table = _integers([text for row in texts for text in row]).reshape(len(texts), -1)
        order = element.order.get(count, tuple(range(count)))
        yield _Kind(element.kinds[count], count), table[:, [0, 1, *(2 + place for place in order)]]
    if lacking:
        notes.append(f"{lacking:,} elements {name} lack nodes within their edges, and are read by their corners")


def _integers(texts: list[str]) -> np.ndarray:
    return np.array(texts).astype(np.int64)


def _numbers(texts: list[str]) -> np.ndarray:
    """Return numbers as Nastran writes them: blank ones are 0, and the E of an exponent may be D, or not there."""
    try:
        return np.array([text or "0" for text in texts]).astype(float)
    except ValueError:
        plain = [re.sub(r"(?<=[\d.])[ED]?(?=[+-])", "e", text.upper()).replace("D", "e") or "0" for text in texts]
        return np.array(plain).astype(float)
