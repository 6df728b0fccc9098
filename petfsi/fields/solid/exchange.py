"""Values of nodes on their way between the ranks that own them, those that share them, and the mesh's own order."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.solid.partition import Fetch, LocalMesh, slab
from petfsi.petsc import Layout


class NodalExchange:
    """Sends what ranks know of their own nodes to those who need it.

    Parameters
    ----------
    comm : MPI.Comm
    mesh : LocalMesh
    number : ndarray of int, shape (n,)
        Global number of each node, in the mesh's own order.

    Attributes
    ----------
    slab : (int, int, int)
        Begin and end of this rank's piece of arrays in the mesh's own order, and how long they are.
    """

    def __init__(self, comm: MPI.Comm, mesh: LocalMesh, number: np.ndarray) -> None:
        nodes = mesh.nodes
        begin, end = slab(len(number), comm.rank, comm.size)
        self.comm, self.mesh = comm, mesh
        self.slab = begin, end, len(number)
        self._share = Fetch(comm, nodes, mesh.number[nodes.n_local :])
        self._to_natural = Fetch(comm, nodes, number[begin:end])
        self._from_natural = Fetch(comm, Layout.of(comm, end - begin), mesh.natural[: nodes.n_local])

    def with_shared(self, owned: np.ndarray) -> np.ndarray:
        """Return values at all nodes of this rank's elements. Collective."""
        return np.concatenate((owned, self._share(owned)))

    def to_natural(self, owned: np.ndarray) -> np.ndarray:
        """Return this rank's piece of the same values in the mesh's own order. Collective."""
        return self._to_natural(owned)

    def stored(self, owned: np.ndarray) -> Slab:
        """Return that as a piece of a global array. Collective."""
        begin, _, n = self.slab
        return Slab(self._to_natural(owned), (begin, 0), (n, owned.shape[1]))

    def read(self, read: Reader, name: str, width: int) -> np.ndarray:
        """Return what ``stored`` gave, at this rank's nodes. Collective."""
        begin, end, _ = self.slab
        return self._from_natural(np.asarray(read(name, (begin, 0), (end - begin, width)), dtype=float))
