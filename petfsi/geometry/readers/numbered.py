"""Nodes and elements that files know by numbers, not by their places."""

from __future__ import annotations

from typing import NamedTuple

import meshio
import numpy as np


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


def joined(
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
