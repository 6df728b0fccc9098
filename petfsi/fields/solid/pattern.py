"""The fixed sparsity of a solid's block, and where each element's entries stand in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix

from petfsi.fields.solid.partition import LocalMesh
from petfsi.petsc import IntType


@dataclass(frozen=True)
class Pattern:
    """Compressed rows of this rank's nodes, by nodes and by unknowns.

    Attributes
    ----------
    node_ptr : ndarray of int32, shape (n_owned + 1,)
        Rows of nodes: entry ``s`` is a width x width block.
    slots : list of ndarray of int32, shape (ne, n, n), n nodes an element
        Of each group of elements: the block of each pair of an element's nodes; -1 where the row belongs to another
        rank.
    indptr, indices : ndarray of IntType
        Rows of unknowns; columns are global, sorted.
    """

    node_ptr: np.ndarray
    slots: list[np.ndarray]
    indptr: np.ndarray
    indices: np.ndarray

    @classmethod
    def of(cls, mesh: LocalMesh, width: int) -> Pattern:
        """Return the pattern of nodes that share an element, with ``width`` unknowns each."""
        entries = np.concatenate([_block_entries(nodes, mesh) for nodes in mesh.connectivity], axis=1)
        graph = coo_matrix(
            (np.ones(entries.shape[1], dtype=bool), (entries[0], entries[1])),
            shape=(mesh.n_owned, mesh.nodes.n_global),
        ).tocsr()
        graph.sort_indices()
        node_ptr, neighbours = graph.indptr.astype(np.int32), graph.indices.astype(IntType)
        slots = []
        for nodes in mesh.connectivity:
            slots.append(np.full((*nodes.shape, nodes.shape[1]), -1, dtype=np.int32))
            _find_slots(nodes, mesh.number, node_ptr, neighbours, slots[-1])
        indptr = np.zeros(width * mesh.n_owned + 1, dtype=IntType)
        np.cumsum(np.repeat(width * np.diff(node_ptr), width), out=indptr[1:])
        indices = np.empty(indptr[-1], dtype=IntType)
        _expand(width, node_ptr, neighbours, indices)
        return cls(node_ptr, slots, indptr, indices)


def _block_entries(nodes: np.ndarray, mesh: LocalMesh) -> np.ndarray:
    """Return row and column of the blocks of every element in the rows of this rank's nodes, shape (2, n)."""
    n = nodes.shape[1]
    rows, columns = np.repeat(nodes, n, axis=1).ravel(), np.tile(mesh.number[nodes], (1, n)).ravel()
    mine = rows < mesh.n_owned
    return np.stack((rows[mine], columns[mine]))


@njit(cache=True)
def _find_slots(cells, number, node_ptr, neighbours, slots):
    for e in range(cells.shape[0]):
        for a in range(cells.shape[1]):
            row = cells[e, a]
            if row < node_ptr.shape[0] - 1:
                begin, end = node_ptr[row], node_ptr[row + 1]
                for b in range(cells.shape[1]):
                    slots[e, a, b] = begin + np.searchsorted(neighbours[begin:end], number[cells[e, b]])


@njit(cache=True)
def _expand(width, node_ptr, neighbours, indices):
    k = 0
    for row in range(node_ptr.shape[0] - 1):
        for _ in range(width):
            for s in range(node_ptr[row], node_ptr[row + 1]):
                for component in range(width):
                    indices[k] = width * neighbours[s] + component
                    k += 1
