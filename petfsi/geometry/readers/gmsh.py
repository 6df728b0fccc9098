"""Gmsh's files of all versions, as text or binary: points, elements and groups.

meshio loses count of entities in no group, and has no partitions, no parameters of points and no version 1; of an
element in two groups it keeps the first (C. Geuzaine, J.-F. Remacle, *Gmsh reference manual*, "MSH file format").
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np
from meshio._common import num_nodes_per_cell
from meshio.gmsh.common import _gmsh_to_meshio_order, _gmsh_to_meshio_type

_SECTION = re.compile(rb"^\$(?!End)(\w+)[^\n]*\n", re.MULTILINE)
_NAME = re.compile(rb'^\s*(\d)\s+(-?\d+)\s+"([^"\n]*)"', re.MULTILINE)


class _Numbers:
    """The numbers of a section, one after the other, as text or as they are in memory."""

    def __init__(self, data: bytes, order: str, width: int):
        """Take a section; ``order`` is ``"<"`` or ``">"``, or nothing for text, ``width`` that of sizes, bytes."""
        self._order, self._width, self._at = order, width, 0
        self._bytes = data if order else b""
        self._values = np.zeros(0) if order else np.fromstring(data, sep=" ")

    def take(self, count: int, kind: str) -> np.ndarray:
        """Return the next numbers: int (i), size (n) or double (d); never more than there are."""
        begin, count = self._at, int(count)
        code = {"i": "i4", "n": f"u{self._width}", "d": "f8"}[kind]
        self._at += count * (int(code[1:]) if self._order else 1)
        if count < 0 or self._at > len(self._bytes if self._order else self._values):
            raise meshio.ReadError("a section ends before what it announces")
        if self._order:
            found = np.frombuffer(self._bytes[begin : self._at], self._order + code)
        else:
            found = self._values[begin : self._at]
        return found.astype(float if kind == "d" else np.int64)

    def one(self, kind: str) -> int:
        """Return the next number."""
        return int(self.take(1, kind)[0])

    def count(self) -> int:
        """Return the number that opens a section of version 2: text, also before binary numbers."""
        if not self._order:
            return self.one("n")
        line, _, self._bytes = self._bytes.partition(b"\n")
        return int(line)

    def records(self, count: int, kinds: list[tuple[str, int]]) -> list[np.ndarray]:
        """Return the columns of a table: of text, or of binary records that mix ints and doubles."""
        if not self._order:
            table = self.take(count * sum(width for _, width in kinds), "d").reshape(count, -1)
            return np.split(table, np.cumsum([width for _, width in kinds])[:-1], axis=1)
        code = np.dtype([(f"{n}", self._order + {"i": "i4", "d": "f8"}[kind], (width,))
                         for n, (kind, width) in enumerate(kinds)])  # fmt: skip
        begin, self._at = self._at, self._at + count * code.itemsize
        if count < 0 or self._at > len(self._bytes):
            raise meshio.ReadError("a section ends before what it announces")
        rows = np.frombuffer(self._bytes[begin : self._at], code)
        return [rows[name] for name in code.names or ()]

    def rest(self) -> np.ndarray:
        """Return all numbers of a text that are left."""
        return self._values[self._at :].astype(np.int64)


class _Block(NamedTuple):
    """Elements of one kind: Gmsh's number of it, their nodes by Gmsh's numbers, and which of them is in which group."""

    kind: int
    nodes: np.ndarray
    groups: dict[int, np.ndarray]


def read_gmsh(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return a mesh with its groups as sets of cells and, of dimension 0, of points."""
    sections = _sections(path.read_bytes())
    if b"NOD" in sections:
        nodes, elements = _Numbers(sections[b"NOD"], "", 0), _Numbers(sections.get(b"ELM", b"0"), "", 0)
        return _mesh(*_nodes_2(nodes), _elements_2(elements, "", first=True), {})
    if b"MeshFormat" not in sections or b"Nodes" not in sections or b"Elements" not in sections:
        raise meshio.ReadError("no $MeshFormat, no $Nodes or no $Elements")
    header, _, one = sections[b"MeshFormat"].partition(b"\n")
    version, binary, width = (float(word) for word in header.split()[:3])
    order = ("<" if one[:1] == b"\x01" else ">") if binary else ""
    names = {(int(dim), int(group)): name.decode(errors="replace")
             for dim, group, name in _NAME.findall(sections.get(b"PhysicalNames", b""))}  # fmt: skip
    found = {name: _Numbers(sections[name], order, int(width))
             for name in (b"Entities", b"PartitionedEntities", b"Nodes", b"Elements") if name in sections}  # fmt: skip
    if version < 4:
        return _mesh(*_nodes_2(found[b"Nodes"]), _elements_2(found[b"Elements"], order), names)
    # some call 4 what is 4.1, whose sections begin with four numbers
    old = version < 4.1 and (version != 4 or len(sections[b"Nodes"].split(b"\n", 1)[0].split()) == 2)
    if old and order:
        raise meshio.ReadError("binary files of version 4.0 are not read")
    groups: dict[tuple[int, int], list[int]] = {}
    if b"Entities" in found:
        _entities(found[b"Entities"], groups, old)
    if b"PartitionedEntities" in found:
        found[b"PartitionedEntities"].take(1, "n")
        found[b"PartitionedEntities"].take(2 * found[b"PartitionedEntities"].one("n"), "i")
        _entities(found[b"PartitionedEntities"], groups, old, partitioned=True)
    return _mesh(*_nodes_4(found[b"Nodes"], old), _elements_4(found[b"Elements"], groups, old), names)


def _sections(data: bytes) -> dict[bytes, bytes]:
    """Return what stands between the lines ``$Name`` and ``$EndName``; of version 1 ``$NOD`` and ``$ENDNOD``."""
    found: dict[bytes, bytes] = {}
    at = 0
    while (line := _SECTION.search(data, at)) is not None:
        name = line[1]
        end = data.find(b"$END" + name if name in (b"NOD", b"ELM") else b"$End" + name, line.end())
        if end < 0:
            raise meshio.ReadError(f"${name.decode(errors='replace')} has no end")
        found.setdefault(name, data[line.end() : end])
        at = end + 4 + len(name)
    return found


def _mesh(tags: np.ndarray, points: np.ndarray, blocks: list[_Block], names: dict[tuple[int, int], str]) -> meshio.Mesh:
    """Return the mesh, nodes by where they stand in the file."""
    order = np.argsort(tags, kind="stable")
    sets: dict[str, list[np.ndarray]] = {}
    points_of: dict[str, np.ndarray] = {}
    cells = []
    for n, block in enumerate(blocks):
        kind = _gmsh_to_meshio_type[block.kind]
        place = np.minimum(np.searchsorted(tags, block.nodes, sorter=order), max(len(tags) - 1, 0))
        if block.nodes.size and (not len(tags) or np.any(tags[order[place]] != block.nodes)):
            raise meshio.ReadError("elements name nodes that the file does not hold")
        nodes = order[place] if block.nodes.size else block.nodes
        cells.append(meshio.CellBlock(kind, np.asarray(_gmsh_to_meshio_order(kind, nodes))))
        for group, chosen in block.groups.items():
            name = names.get((cells[n].dim, group), str(group))
            if cells[n].dim == 0:
                points_of[name] = np.union1d(points_of.get(name, np.zeros(0, np.int64)), nodes[chosen])
            else:
                sets.setdefault(name, [np.zeros(0, np.int64)] * len(blocks))[n] = chosen
    return meshio.Mesh(points, cells, cell_sets=sets, point_sets=points_of)


def _width(kind: int) -> int:
    """Return how many nodes an element has."""
    if kind not in _gmsh_to_meshio_type:
        raise meshio.ReadError(f"elements of Gmsh's type {kind} are not known")
    return num_nodes_per_cell[_gmsh_to_meshio_type[kind]]


# ---- versions 1 and 2 ---------------------------------------------------------------------------------------


def _nodes_2(numbers: _Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the nodes and where they are."""
    tags, points = numbers.records(numbers.count(), [("i", 1), ("d", 3)])
    return tags[:, 0].astype(np.int64), points.astype(float)


def _elements_2(numbers: _Numbers, order: str, first: bool = False) -> list[_Block]:
    """Return the elements by kind, each kind together; of version 1 each says how many nodes it has."""
    count = numbers.count()
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    if order:
        while count > 0:
            kind, several, tags = numbers.take(3, "i").tolist()
            width = 1 + tags + _width(kind)
            rows = numbers.take(several * width, "i").reshape(several, width)
            found.setdefault(kind, []).append((rows[:, 1] if tags else np.zeros(several, int), rows[:, 1 + tags :]))
            count -= max(several, 1)
    else:
        data = numbers.rest()
        while count > 0:
            if len(data) < 5:
                raise meshio.ReadError("a section ends before what it announces")
            kind, tags = int(data[1]), 2 if first else int(data[2])
            begin = 3 + tags if not first else 5
            width = begin + _width(kind)
            rows = _alike(data, width, (1, 4) if first else (1, 2), count)
            group = rows[:, 2] if first else rows[:, 3] if tags else np.zeros(len(rows), int)
            found.setdefault(kind, []).append((group, rows[:, begin:]))
            data, count = data[rows.size :], count - len(rows)
    return [_block_2(kind, parts) for kind, parts in found.items()]


def _alike(data: np.ndarray, width: int, columns: tuple[int, ...], most: int) -> np.ndarray:
    """Return the first rows that are like the first one in some columns, so that they are as wide; not all at once."""
    several, found = 1, 0
    while True:
        rows = data[: min(several, most, len(data) // width) * width].reshape(-1, width)
        if not len(rows):
            raise meshio.ReadError("a section ends before what it announces")
        same = (rows[found:, columns] == rows[0, columns]).all(axis=1)
        if not same.all():
            return rows[: found + int(same.argmin())]
        if len(rows) < several or several >= most:
            return rows
        found, several = len(rows), 8 * several


def _block_2(kind: int, parts: list[tuple[np.ndarray, np.ndarray]]) -> _Block:
    group = np.concatenate([numbers for numbers, _ in parts])
    groups = {int(tag): np.flatnonzero(group == tag) for tag in np.unique(group[group != 0])}
    return _Block(kind, np.concatenate([nodes for _, nodes in parts]), groups)


# ---- version 4 ----------------------------------------------------------------------------------------------


def _entities(
    numbers: _Numbers, groups: dict[tuple[int, int], list[int]], old: bool, partitioned: bool = False
) -> None:
    """Find the groups that each entity is in, by its dimension and number; those of no group stay out."""
    for dim, count in enumerate(numbers.take(4, "n").tolist()):
        for _ in range(count):
            tag = numbers.one("i")
            if partitioned:
                numbers.take(2, "i")
                numbers.take(numbers.one("n"), "i")
            numbers.take(6 if dim or old else 3, "d")
            found = numbers.take(numbers.one("n"), "i")
            if dim:
                numbers.take(numbers.one("n"), "i")
            if len(found):
                groups[dim, tag] = np.unique(np.abs(found)).tolist()


def _nodes_4(numbers: _Numbers, old: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the nodes and where they are; points on curves and surfaces may have parameters, too."""
    tags, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for _ in range(numbers.take(2 if old else 4, "n")[0]):
        entity = numbers.take(3, "i").tolist()
        count, width = numbers.one("n"), 3 + entity[1 if old else 0] * (entity[2] != 0)
        if old:
            rows = numbers.take(count * (1 + width), "d").reshape(count, 1 + width)
            tags.append(rows[:, 0].astype(np.int64))
            points.append(rows[:, 1:4])
        else:
            tags.append(numbers.take(count, "n"))
            points.append(numbers.take(count * width, "d").reshape(count, width)[:, :3])
    return np.concatenate(tags), np.concatenate(points)


def _elements_4(numbers: _Numbers, groups: dict[tuple[int, int], list[int]], old: bool) -> list[_Block]:
    """Return the elements by entity."""
    blocks = []
    for _ in range(numbers.take(2 if old else 4, "n")[0]):
        one, other, kind = numbers.take(3, "i").tolist()
        count, width = numbers.one("n"), 1 + _width(kind)
        nodes = numbers.take(count * width, "n").reshape(count, width)[:, 1:]
        of = groups.get((other, one) if old else (one, other), [])
        blocks.append(_Block(kind, nodes, {group: np.arange(count) for group in of}))
    return blocks
