"""Which rank owns which node, and how ranks tell each other about nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from petfsi.geometry.meshes import Group, SimplexMesh
from petfsi.petsc import IntType, Layout


def bisect(points: np.ndarray, parts: int) -> np.ndarray:
    """Return the part of each point by recursive coordinate bisection.

    Each cut is across the longest extent; parts differ by a few points at most.
    """
    part = np.zeros(len(points), dtype=np.int32)
    todo = [(np.arange(len(points)), 0, parts)]
    while todo:
        nodes, first, count = todo.pop()
        part[nodes] = first
        if count == 1 or len(nodes) == 0:
            continue
        axis = int(np.argmax(np.ptp(points[nodes], axis=0)))
        nodes = nodes[np.lexsort((nodes, points[nodes, axis]))]
        left = count // 2
        cut = len(nodes) * left // count
        todo += [(nodes[:cut], first, left), (nodes[cut:], first + left, count - left)]
    return part


class Fetch:
    """Brings rows that other ranks own to this rank, the same rows each time.

    Parameters
    ----------
    comm : MPI.Comm
    owned : Layout
        How the rows lie on the ranks.
    wanted : ndarray of int
        Global numbers of the rows this rank wants, in any order.
    """

    def __init__(self, comm: MPI.Comm, owned: Layout, wanted: np.ndarray):
        self.comm = comm
        starts = np.array(comm.allgather(owned.start))
        # of ranks that begin at the same row only the last one owns it
        owner = np.searchsorted(starts, wanted, side="right") - 1
        self._place = np.argsort(owner, kind="stable")
        self._receive = np.bincount(owner, minlength=comm.size)
        self._send = np.empty_like(self._receive)
        comm.Alltoall(self._receive, self._send)
        asked = np.empty(self._send.sum(), dtype=np.int64)
        request = np.ascontiguousarray(wanted[self._place], dtype=np.int64)
        comm.Alltoallv([request, self._receive], [asked, self._send])
        self._rows = asked - owned.start

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the wanted rows; ``values`` holds the owned ones, shape (n_owned, ...). Collective."""
        width = int(np.prod(values.shape[1:], dtype=np.int64))
        got = np.empty((len(self._place), *values.shape[1:]), dtype=values.dtype)
        outgoing = np.ascontiguousarray(values[self._rows])
        self.comm.Alltoallv([outgoing, self._send * width], [got, self._receive * width])
        result = np.empty_like(got)
        result[self._place] = got
        return result


@dataclass(frozen=True)
class LocalMesh:
    """A rank's piece of a mesh: its own nodes first, then those its cells share with other ranks.

    A rank keeps every cell that touches one of its nodes, so that it assembles its rows without a message.

    Attributes
    ----------
    points : ndarray, shape (n_nodes, dim)
    cells : ndarray of int32, shape (ne, dim + 1)
        Local node numbers.
    body : ndarray of int32, shape (ne,)
    cell_ids : ndarray of int, shape (ne,)
        Number of each cell in the whole mesh.
    counted_cells : ndarray of bool, shape (ne,)
        Each cell of the whole mesh is counted on exactly one rank.
    groups : tuple of Group
        Elements, in local node numbers; none where the cells are the elements.
    counted : ndarray of bool, shape (n_elements,)
        Each element of the whole mesh, group after group, is counted on exactly one rank.
    number : ndarray of IntType, shape (n_nodes,)
        Global node number: rank after rank, on each in the order of the whole mesh.
    natural : ndarray of int, shape (n_nodes,)
        Number of each node in the whole mesh.
    nodes : Layout
        How the nodes lie on the ranks.
    """

    points: np.ndarray
    cells: np.ndarray
    body: np.ndarray
    cell_ids: np.ndarray
    counted_cells: np.ndarray
    groups: tuple[Group, ...]
    counted: np.ndarray
    number: np.ndarray
    natural: np.ndarray
    nodes: Layout

    def elements(self, body: int) -> np.ndarray:
        """Return the nodes of a body's elements, those of its cells where there are no groups."""
        return next((group.nodes for group in self.groups if group.body == body), self.cells[self.body == body])

    @property
    def connectivity(self) -> list[np.ndarray]:
        """The nodes of the elements of each group, or of the cells."""
        return [group.nodes for group in self.groups] or [self.cells]

    @property
    def n_owned(self) -> int:
        """The number of nodes this rank owns."""
        return self.nodes.n_local


def distribute(comm: MPI.Comm, mesh: SimplexMesh) -> tuple[LocalMesh, np.ndarray]:
    """Return this rank's piece of a mesh that all ranks hold, and every node's global number."""
    owner = bisect(mesh.points, comm.size)
    order = np.argsort(owner, kind="stable")
    number = np.empty(len(order), dtype=IntType)
    number[order] = np.arange(len(order), dtype=IntType)
    owned = np.flatnonzero(owner == comm.rank)
    cell_ids = np.flatnonzero(np.any(owner[mesh.cells] == comm.rank, axis=1))
    cells = mesh.cells[cell_ids]
    groups = [group.take(np.any(owner[group.nodes] == comm.rank, axis=1)) for group in mesh.groups]
    elements = [group.nodes for group in groups] or [cells]
    around = np.unique(np.concatenate([nodes.ravel() for nodes in [cells, *elements]]))
    ghosts = around[owner[around] != comm.rank]
    natural = np.concatenate((owned, ghosts[np.argsort(number[ghosts])]))
    local = np.full(len(order), -1, dtype=np.int32)
    local[natural] = np.arange(len(natural), dtype=np.int32)
    piece = LocalMesh(
        points=mesh.points[natural],
        cells=np.ascontiguousarray(local[cells]),
        body=mesh.body[cell_ids].astype(np.int32),
        cell_ids=cell_ids,
        counted_cells=owner[cells[:, 0]] == comm.rank,
        groups=tuple(replace(group, nodes=np.ascontiguousarray(local[group.nodes])) for group in groups),
        counted=owner[np.concatenate([nodes[:, 0] for nodes in elements])] == comm.rank,
        number=number[natural],
        natural=natural,
        nodes=Layout.of(comm, len(owned)),
    )
    return piece, number


def slab(n: int, rank: int, size: int) -> tuple[int, int]:
    """Return begin and end of a rank's share of ``n`` things in natural order."""
    return n * rank // size, n * (rank + 1) // size
