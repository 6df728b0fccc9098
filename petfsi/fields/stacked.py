"""Numbers, arrays and surfaces of several solids, one after the other, as those of a single one."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix, vstack

from petfsi.fields.slabs import Slab
from petfsi.fields.solid.partition import Fetch, slab
from petfsi.geometry.quadratic import Curved
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import IntType, Layout


class Stack:
    """Puts rows of several global arrays one array after the other, and cuts them anew: a share for each rank.

    Parameters
    ----------
    comm : MPI.Comm
    slabs : list of Slab
        Pieces of the arrays, cut as those that are given later.
    """

    def __init__(self, comm: MPI.Comm, slabs: list[Slab]):
        counts = [len(piece.data) for piece in slabs]
        self._n = sum(piece.shape[0] for piece in slabs)
        self._begin, end = slab(self._n, comm.rank, comm.size)
        held = np.concatenate(stacked_numbers(comm, counts))
        self._fetch = Fetch(comm, Layout.of(comm, sum(counts)), held[self._begin : end])

    def __call__(self, slabs: list[Slab]) -> Slab:
        """Return this rank's piece of the whole. Collective."""
        like = slabs[0]
        data = self._fetch(np.concatenate([piece.data for piece in slabs]))
        return Slab(data, (self._begin, *like.start[1:]), (self._n, *like.shape[1:]))


def stacked_numbers(comm: MPI.Comm, counts: list[int]) -> list[np.ndarray]:
    """Return the joint numbers of each part's things, numbered rank after rank and on each part after part. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    counts : list of int
        How many of each part this rank holds; a part's own numbers run rank after rank.

    Returns
    -------
    list of ndarray of IntType
        Ascending, by the part's own number.
    """
    every = np.array(comm.allgather(counts))
    first = (np.cumsum(every) - every.ravel()).reshape(every.shape)
    shift = first - (np.cumsum(every, axis=0) - every)
    return [(np.arange(n.sum()) + np.repeat(by, n)).astype(IntType) for n, by in zip(every.T, shift.T, strict=True)]


def joined_surface(surfaces: list[Surface], numbers: list[np.ndarray], n: int) -> Surface:
    """Return several surfaces as one, the points of one after those of the other. Not collective.

    Parameters
    ----------
    surfaces : list of Surface
    numbers : list of ndarray of IntType
        The joint numbers of the unknowns of each part, see ``stacked_numbers``.
    n : int
        How many unknowns there are.
    """
    first = np.cumsum([0] + [surface.n_points for surface in surfaces])
    facets = [s.facets + n for s, n in zip(surfaces, first, strict=False)]
    curved = [s.curved and s.curved._replace(nodes=s.nodes + n) for s, n in zip(surfaces, first, strict=False)]
    return Surface(
        facets=np.concatenate(facets),
        cavity=np.concatenate([s.cavity for s in surfaces]),
        void=np.concatenate([s.void for s in surfaces]),
        point_map=_joined_map([s.point_map for s in surfaces], numbers, n),
        fixed_map=_joined_map([s.fixed_map for s in surfaces], numbers, n),
        curved=Curved.joined(list(zip(facets, curved, strict=True))),
    )


def _joined_map(maps: list[csr_matrix], numbers: list[np.ndarray], n: int) -> csr_matrix:
    renumbered = [
        csr_matrix((m.data, number[m.indices], m.indptr), shape=(m.shape[0], n))
        for m, number in zip(maps, numbers, strict=True)
    ]
    return vstack(renumbered, format="csr")
