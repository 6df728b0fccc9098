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
    slots : ndarray of int32, shape (ne, n, n), n nodes an element
        The block of each pair of an element's nodes; -1 where the row belongs to another rank.
    indptr, indices : ndarray of IntType
        Rows of unknowns; columns are global, sorted.
    """

    node_ptr: np.ndarray
    slots: np.ndarray
    indptr: np.ndarray
    indices: np.ndarray

    @classmethod
    def of(cls, mesh: LocalMesh, width: int) -> Pattern:
        """Return the pattern of nodes that share an element, with ``width`` unknowns each."""
        corners = mesh.cells.shape[1]
        rows = np.repeat(mesh.cells, corners, axis=1).ravel()
        columns = np.tile(mesh.number[mesh.cells], (1, corners)).ravel()
        mine = rows < mesh.n_owned
        graph = coo_matrix(
            (np.ones(np.count_nonzero(mine), dtype=bool), (rows[mine], columns[mine])),
            shape=(mesh.n_owned, mesh.nodes.n_global),
        ).tocsr()
        graph.sort_indices()
        node_ptr, neighbours = graph.indptr.astype(np.int32), graph.indices.astype(IntType)
        slots = np.full((len(mesh.cells), corners, corners), -1, dtype=np.int32)
        _find_slots(mesh.cells, mesh.number, node_ptr, neighbours, slots)
        indptr = np.zeros(width * mesh.n_owned + 1, dtype=IntType)
        np.cumsum(np.repeat(width * np.diff(node_ptr), width), out=indptr[1:])
        indices = np.empty(indptr[-1], dtype=IntType)
        _expand(width, node_ptr, neighbours, indices)
        return cls(node_ptr, slots, indptr, indices)


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
