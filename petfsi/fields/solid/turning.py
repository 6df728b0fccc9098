"""Predictions that turn with a body: where nodes are on the way of a rotation, which is no straight one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components

from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.rotations import IN_PLACE, ONWARD, SETTING_OUT, Gradients, missing
from petfsi.geometry.meshes import SimplexMesh
from petfsi.petsc import IntType, new_block, set_csr

#: More nodes than this are solved for with multigrid.
MANY = 20_000
PREFIX = "turning_"
_SMALL = {"ksp_type": "cg", "ksp_rtol": "1e-14", "ksp_max_it": "5000", "pc_type": "jacobi"}
_LARGE = {"ksp_type": "cg", "ksp_rtol": "1e-10", "ksp_max_it": "200", "pc_type": "gamg"}


class Turning:
    """Adds to straight predictions of a body's nodes what makes them turn, element by element.

    Of a gradient F of positions, at rest, now and a step ago, and with the rotation R from F^{n-1} to F^n, a body that
    turns without a strain goes on to R (2 F^n - R F^{n-1}). A straight prediction 2 F^n - F^{n-1} swells by the square
    of the angle. What is added, T, has the gradient that is missing, G, as nearly as can be,

        sum_e V_e |grad T - G_e|^2 -> min ,      T = 0 at supports that stay, sum m T = 0 for bodies that have none,

    so that it is exact for a rotation of the whole about any axis, for parts of a body that turn each in their own
    way as long as they do so without strains, and zero where nothing turns. Angles among a node's unknowns go along.

    Parameters
    ----------
    comm : MPI.Comm
    mesh : LocalMesh
    parts : ndarray of int, shape (ne, n)
        Local nodes of the simplices, or segments, that turn: all with nodes of this rank.
    labels : ndarray of int, shape (n_owned,)
        Which connected body each of this rank's nodes belongs to: 0, 1, ...
    still : ndarray of bool, shape (n_owned, dim)
        What supports hold at rest.
    mass : ndarray, shape (n_owned, dim)
        kg.
    share : callable
        Adds to values of owned nodes those of the other local ones. Collective.
    """

    def __init__(
        self, comm: MPI.Comm, mesh: LocalMesh, parts: np.ndarray, labels: np.ndarray, still: np.ndarray,
        mass: np.ndarray, share: Callable[[np.ndarray], np.ndarray],
    ) -> None:  # fmt: skip
        self._comm, self._mesh, self._share, self._mass = comm, mesh, share, mass
        self._n_owned, self._dim = mesh.n_owned, mesh.points.shape[1]
        self._gradients = gradients = Gradients(mesh.points, parts)
        weighted = diags(np.repeat(gradients.size, gradients.m)) @ gradients.matrix
        self._divergence = weighted.T.tocsr()[: self._n_owned]
        self._labels, self._still, self._free = labels, still, np.zeros_like(still)
        self._count = comm.allreduce(int(labels.max(initial=-1)), MPI.MAX) + 1
        stiffness = (self._divergence @ gradients.matrix).tocsr()
        self._solvers: list[tuple[np.ndarray, _Laplace]] = []
        for axis in range(self._dim):
            self._prepare(axis, stiffness)

    def _prepare(self, axis: int, stiffness: csr_matrix) -> None:
        """Find what is held along an axis, and factor. Collective."""
        held = self._still[:, axis].copy()
        holds = np.bincount(self._labels, held, minlength=self._count) > 0
        self._comm.Allreduce(MPI.IN_PLACE, holds, MPI.LOR)
        # a body that nothing holds is pinned where the numbers begin, and put right afterwards
        first = np.full(self._count, np.iinfo(np.int64).max)
        natural = self._mesh.natural[: self._n_owned]
        np.minimum.at(first, self._labels, natural)
        self._comm.Allreduce(MPI.IN_PLACE, first, MPI.MIN)
        self._free[:, axis] = ~holds[self._labels]
        held |= self._free[:, axis] & (natural == first[self._labels])
        held |= stiffness.diagonal() == 0.0  # of bodies without parts
        for known, solver in self._solvers:
            if self._comm.allreduce(np.array_equal(known, held), MPI.LAND):
                self._solvers.append((held, solver))
                return
        everywhere = self._share(held[:, None].astype(float))[:, 0] > 0
        self._solvers.append((held, _Laplace(self._comm, self._mesh, stiffness, everywhere)))

    # ---- what integrators ask for -----------------------------------------------------------------------------

    def onward(self, d: np.ndarray, before: np.ndarray, ratio: float) -> np.ndarray:
        """Return what d + ratio (d - before) lacks, m. Collective.

        Parameters
        ----------
        d, before : ndarray, shape (n_owned, width)
            Displacements now and a step ago.
        ratio : float
            Length of the coming step by that of the last one.

        Returns
        -------
        ndarray, shape (n_owned, dim)
            The angles lack nothing. What follows has them, too: shape (n_owned, width).
        """
        return self._added(d, before, ratio, ONWARD)

    def setting_out(self, d: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        """Return what d + h u lacks. Collective."""
        angles = u[:, self._dim :]
        return np.hstack((self._added(d, u, h, SETTING_OUT), 2 * np.arctan(h / 2 * angles) - h * angles))

    def in_place(self, d: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        """Return by how much d turns in h with the velocities u, without what else they do. Collective.

        As if both went on as they are: u^{n+1} = R u^n, d^{n+1} = d^n + h/2 (u^n + u^{n+1}) (Cayley's map).
        """
        return np.hstack((self._added(d, u, h, IN_PLACE), 2 * np.arctan(h / 2 * u[:, self._dim :])))

    def _added(self, d: np.ndarray, other: np.ndarray, h: float, kind: int) -> np.ndarray:
        dim, of = self._dim, self._gradients
        local = self._share(np.concatenate((d[:, :dim], other[:, :dim]), axis=1))
        now = of.rest + of(local[:, :dim])
        past = of(local[:, dim:])
        if kind == ONWARD:
            past += of.rest
        wanted = np.empty_like(now)
        missing(now, past, h, kind, wanted)
        b = self._divergence @ wanted.reshape(-1, dim)
        added = np.column_stack([solver(b[:, a], held) for a, (held, solver) in enumerate(self._solvers)])
        return added - self._mean(added)

    def _mean(self, added: np.ndarray) -> np.ndarray:
        """Return the mean over the mass of each free body, at its nodes; zero at the others. Collective."""
        if not self._comm.allreduce(bool(self._free.any()), MPI.LOR):
            return np.zeros_like(added)
        total = np.zeros((2, self._count, self._dim))
        for a in range(self._dim):
            total[0, :, a] = np.bincount(self._labels, self._mass[:, a] * added[:, a], minlength=self._count)
            total[1, :, a] = np.bincount(self._labels, self._mass[:, a], minlength=self._count)
        total = self._comm.allreduce(total)
        return np.where(self._free, (total[0] / total[1])[self._labels], 0.0)


class _Laplace:
    """Solves for values at this rank's nodes, zero at those that are held."""

    def __init__(self, comm: MPI.Comm, mesh: LocalMesh, stiffness: csr_matrix, held: np.ndarray) -> None:
        n, entries = mesh.n_owned, stiffness.tocoo()
        keep = ~held[entries.row] & ~held[entries.col]
        mean = np.abs(stiffness.diagonal()).mean() if n else 1.0
        here = np.flatnonzero(held[:n])
        rows = np.concatenate((entries.row[keep], here))
        columns = mesh.number[np.concatenate((entries.col[keep], here))]
        values = np.concatenate((entries.data[keep], np.full(len(here), mean)))
        matrix = coo_matrix((values, (rows, columns)), shape=(n, mesh.nodes.n_global)).tocsr()
        matrix.sort_indices()
        self._matrix = new_block(comm, mesh.nodes, mesh.nodes)
        indptr, indices = matrix.indptr.astype(IntType), matrix.indices.astype(IntType)
        set_csr(self._matrix, indptr, indices, matrix.data, new_pattern=True)
        self._matrix.setOption(PETSc.Mat.Option.SPD, True)
        self._x, self._b = self._matrix.createVecs()
        self._ksp = PETSc.KSP().create(comm)
        self._ksp.setOptionsPrefix(PREFIX)
        self._ksp.setOperators(self._matrix)
        options = PETSc.Options(PREFIX)
        chosen = _SMALL if mesh.nodes.n_global <= MANY else _LARGE
        for name, value in chosen.items():
            options.setValue(name, value)
        self._ksp.setFromOptions()
        self._ksp.setUp()
        for name in chosen:
            options.delValue(name)

    def __call__(self, b: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Return the values for a right-hand side, both of this rank's nodes. Collective."""
        self._b.setArray(np.where(held, 0.0, b))
        self._ksp.solve(self._b, self._x)
        return self._x.getArray().copy()


def bodies_of(mesh: SimplexMesh) -> np.ndarray:
    """Return which connected body each node of a mesh belongs to."""
    n, parts = len(mesh.points), mesh.cells
    first = np.repeat(parts[:, :1], parts.shape[1] - 1, axis=1).ravel()
    others = parts[:, 1:].ravel()
    graph = coo_matrix((np.ones(len(first), dtype=bool), (first, others)), shape=(n, n))
    return connected_components(graph, directed=False)[1]
