"""The edges of elements: how short they are, and how much they have changed."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.fields.solid.partition import LocalMesh


class Edges:
    """Every pair of nodes of this rank's linear cells, once.

    Attributes
    ----------
    shortest : float
        Length of the shortest one at rest on any rank, m.
    """

    def __init__(self, comm: MPI.Comm, mesh: LocalMesh) -> None:
        self._comm, self._dim = comm, mesh.points.shape[1]
        a, b = np.triu_indices(mesh.cells.shape[1], 1)
        pairs = np.sort(mesh.cells[:, np.stack((a, b), axis=1)].reshape(-1, 2), axis=1)
        self._start, self._end = np.unique(pairs, axis=0).T
        self._length = np.linalg.norm(mesh.points[self._end] - mesh.points[self._start], axis=1)
        self.shortest: float = comm.allreduce(float(self._length.min(initial=np.inf)), MPI.MIN)

    def stretch(self, change: np.ndarray) -> float:
        """Return the largest difference of ``change`` along an edge over its length at rest. Collective.

        Parameters
        ----------
        change : ndarray, shape (n, width)
            Of the displacement at all local nodes, m; of components beyond the axes the difference counts itself.
        """
        difference = np.abs(change[self._end] - change[self._start])
        difference[:, : self._dim] /= self._length[:, None]
        return self._comm.allreduce(float(difference.max(initial=0.0)), MPI.MAX)
