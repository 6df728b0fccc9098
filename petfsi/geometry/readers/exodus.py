"""Exodus II without netCDF's library: the old format through SciPy, the new one, which is HDF5, through h5py.

Blocks, sets of nodes and sides of elements are groups (G. D. Sjaardema et al., *EXODUS: a finite element data model*,
2024).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import meshio
import numpy as np
from scipy.io import netcdf_file

#: Cells by the beginning of their type's name and the number of their nodes, and the corners of their sides.
_KINDS: dict[str, tuple[dict[int, str], tuple[tuple[int, ...], ...]]] = {
    "TRI": ({3: "triangle", 6: "triangle6"}, ((0, 1), (1, 2), (2, 0))),
    "QUA": ({4: "quad", 8: "quad8", 9: "quad9"}, ((0, 1), (1, 2), (2, 3), (3, 0))),
    # two faces, then edges
    "SHE": ({4: "quad", 8: "quad8", 9: "quad9"},
            ((0, 1, 2, 3), (0, 3, 2, 1), (0, 1), (1, 2), (2, 3), (3, 0))),
    "TRISHE": ({3: "triangle", 6: "triangle6"}, ((0, 1, 2), (0, 2, 1), (0, 1), (1, 2), (2, 0))),
    "TET": ({4: "tetra", 10: "tetra10"}, ((0, 1, 3), (1, 2, 3), (0, 3, 2), (0, 2, 1))),
    "PYR": ({5: "pyramid", 13: "pyramid13", 14: "pyramid14"},
            ((0, 1, 4), (1, 2, 4), (2, 3, 4), (0, 4, 3), (0, 3, 2, 1))),
    "WED": ({6: "wedge", 15: "wedge15", 18: "wedge18"},
            ((0, 1, 4, 3), (1, 2, 5, 4), (0, 3, 5, 2), (0, 2, 1), (3, 4, 5))),
    "HEX": ({8: "hexahedron", 20: "hexahedron20", 27: "hexahedron27"},
            ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (0, 4, 7, 3), (0, 3, 2, 1), (4, 5, 6, 7))),
    "BAR": ({2: "line", 3: "line3"}, ()),
}  # fmt: skip
_SAME = {"PRI": "WED", "BEA": "BAR", "TRU": "BAR", "EDG": "BAR", "ROD": "BAR"}
_FACETS = {2: "line", 3: "triangle", 4: "quad"}


class _Dataset(NamedTuple):
    """What a file holds: arrays by name, and the types of blocks of elements."""

    arrays: dict[str, np.ndarray]
    types: dict[str, str]

    def names(self, kind: str, count: int) -> list[str]:
        """Return the names of blocks (eb) or sets (ns, ss), or their numbers where they have none."""
        numbers = self.arrays.get(f"{kind}_prop1", np.arange(1, count + 1))
        given = self.arrays.get(f"{kind}_names", np.zeros((0, 1), dtype="S1"))
        texts = [b"".join(row.tolist()).split(b"\0")[0].decode(errors="replace").strip() for row in given]
        return [text or str(number) for text, number in zip(texts or [""] * count, numbers.tolist(), strict=True)]


def read_exodus(path: Path, notes: list[str]) -> meshio.Mesh:
    """Return a mesh with its blocks, side sets and node sets."""
    data = _opened(path)
    points = _points(data.arrays)
    cells: list[meshio.CellBlock] = []
    chosen: list[tuple[str, int]] = []
    sides: list[tuple[int, tuple[tuple[int, ...], ...], np.ndarray]] = []
    number, blocks = 0, sorted((name for name in data.types), key=lambda name: int(name[7:]))
    for name, group in zip(blocks, data.names("eb", len(blocks)), strict=True):
        nodes = data.arrays[name].astype(np.int64) - 1
        key = data.types[name].upper()[:3]
        kinds, faces = _KINDS.get(_SAME.get(key, key), ({}, ()))
        width = max((n for n in kinds if n <= nodes.shape[1]), default=0)
        if width:
            cells.append(meshio.CellBlock(kinds[width], nodes[:, :width]))
            chosen.append((group, len(cells) - 1))
        elif key not in ("SPH", "NOD"):
            notes.append(f"{len(nodes):,} cells of type {data.types[name]} are not read")
        sides.append((number, faces, nodes))
        number += len(nodes)
    for group, facets in _side_sets(data, sides):
        for part in facets:
            cells.append(meshio.CellBlock(_FACETS[part.shape[1]], part))
            chosen.append((group, len(cells) - 1))
    sets: dict[str, list[np.ndarray]] = {}
    for group, n in chosen:
        sets.setdefault(group, [np.zeros(0, np.int64)] * len(cells))[n] = np.arange(len(cells[n].data))
    return meshio.Mesh(points, cells, cell_sets=sets, point_sets=dict(_node_sets(data)))


def _opened(path: Path) -> _Dataset:
    with path.open("rb") as file:
        new = file.read(4) == b"\x89HDF"
    if new:
        with h5py.File(path, "r") as found:
            held = {name: item for name, item in found.items() if isinstance(item, h5py.Dataset) and item.shape}
            arrays = {name: item[...] for name, item in held.items() if _wanted(name)}
            types = {name: item.attrs["elem_type"] for name, item in held.items() if "elem_type" in item.attrs}
    else:
        with netcdf_file(path, mmap=False) as found:
            arrays = {name: np.array(item[...]) for name, item in found.variables.items() if _wanted(name)}
            types = {name: item.elem_type for name, item in found.variables.items() if hasattr(item, "elem_type")}
    return _Dataset(arrays, {name: text.decode() if isinstance(text, bytes) else str(text)
                             for name, text in types.items() if name.startswith("connect")})  # fmt: skip


def _wanted(name: str) -> bool:
    begin = ("coord", "connect", "eb_", "ns_", "ss_", "node_ns", "elem_ss", "side_ss")
    return name.startswith(begin) and name != "coor_names"


def _points(arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "coord" in arrays:
        return np.asarray(arrays["coord"], dtype=float).T
    axes = [arrays[f"coord{axis}"] for axis in "xyz" if f"coord{axis}" in arrays]
    if not axes:
        raise meshio.ReadError("no coordinates")
    return np.stack(axes, axis=1).astype(float)


def _side_sets(
    data: _Dataset, blocks: list[tuple[int, tuple[tuple[int, ...], ...], np.ndarray]]
) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield the name of each set of sides and the corners of its facets, by the number of these."""
    count = sum(name.startswith("elem_ss") for name in data.arrays)
    for n, name in enumerate(data.names("ss", count), 1):
        elements, side = data.arrays[f"elem_ss{n}"] - 1, data.arrays[f"side_ss{n}"] - 1
        found = []
        for begin, faces, nodes in blocks:
            own = (elements >= begin) & (elements < begin + len(nodes))
            for k, face in enumerate(faces):
                found.append(nodes[elements[own & (side == k)] - begin][:, face])
        yield name, [part for part in found if len(part)]


def _node_sets(data: _Dataset) -> Iterator[tuple[str, np.ndarray]]:
    count = sum(name.startswith("node_ns") for name in data.arrays)
    for n, name in enumerate(data.names("ns", count), 1):
        yield name, data.arrays[f"node_ns{n}"].astype(np.int64) - 1
