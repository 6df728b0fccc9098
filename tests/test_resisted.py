"""Walls with masses to push: the operator, and the matrix whose inverse holds that of a part of it."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from petfsi.petsc import IntType, Layout, factorised
from petfsi.solving.resisted import Resisted

#: Pressures, the solid's unknowns and pushed cells.
N, M, K = 17, 11, 5


def scattered(whole: np.ndarray, bounds: list[np.ndarray]) -> PETSc.Mat:
    """Return a dense matrix as a sparse one, rows and columns on the ranks by the bounds. Collective."""
    comm = MPI.COMM_WORLD
    rows, columns = (Layout.of(comm, int(b[comm.rank + 1] - b[comm.rank])) for b in bounds)
    mine = csr_matrix(whole[rows.start : rows.end])
    csr = mine.indptr.astype(IntType), mine.indices.astype(IntType), mine.data
    return PETSc.Mat().createAIJ((rows.sizes, columns.sizes), csr=csr, comm=comm)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("crowded", [False, True])
def test_masses_that_walls_push_are_met_exactly(crowded):
    comm, rng = MPI.COMM_WORLD, np.random.default_rng(3)
    pressures, unknowns, cells = (np.linspace(0, n, comm.size + 1).astype(int) for n in (N, M, K))
    if crowded:  # one rank alone has cells to push
        cells = np.where(np.arange(comm.size + 1) < comm.size, 0, K)
    fluxes = 2.5 * np.eye(N) - np.eye(N, k=1) - np.eye(N, k=-1)
    touched = np.arange(4, 15)
    transfer, push = np.zeros((M, N)), rng.normal(size=(K, M)) * (rng.random((K, M)) < 0.6)
    transfer[:, touched] = rng.normal(size=(M, len(touched))) * (rng.random((M, len(touched))) < 0.4)
    inverse = rng.uniform(0.5, 2.0, M)
    x = scattered(np.diag(inverse), [unknowns, unknowns])
    resisted = Resisted(
        scattered(fluxes, [pressures, pressures]),
        scattered(transfer, [unknowns, pressures]),
        x.getDiagonal(),
        scattered(push, [cells, unknowns]),
        "resisted_test_",
    )
    whole = fluxes + transfer.T @ np.linalg.solve(np.diag(1 / inverse) + push.T @ push, transfer)

    operator = resisted.operator()
    p, answer = operator.createVecs()
    value = rng.normal(size=N)
    mine = slice(*operator.getOwnershipRange())
    p.array = value[mine]
    operator.mult(p, answer)
    np.testing.assert_allclose(answer.array, (whole @ value)[mine], rtol=1e-12, atol=1e-12)

    own = touched[(touched >= mine.start) & (touched < mine.stop)]
    block = resisted.block(PETSc.IS().createGeneral(own.astype(IntType), comm=comm))
    solver = factorised(block, "resisted_test_")
    found, b = block.createVecs()
    b.array[: len(own)] = value[own]
    solver.solve(b, found)
    expected = np.linalg.solve(whole[np.ix_(touched, touched)], value[touched])
    np.testing.assert_allclose(found.array[: len(own)], expected[np.isin(touched, own)], rtol=1e-11, atol=1e-11)
    for name in list(PETSc.Options().getAll()):
        if name.startswith("resisted_test_"):
            PETSc.Options().delValue(name)
