"""The one place that knows PETSc's versions and ranks."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from mpi4py import MPI
from numba import njit
from petsc4py import PETSc
from scipy.sparse import coo_matrix

IntType = PETSc.IntType
#: Codes of errors that numbers make, and no option: a zero pivot, no number, no convergence.
NUMERICAL = (71, 72, 91)


@dataclass(frozen=True)
class Layout:
    """How a vector lies on the ranks: this rank holds entries ``start`` to ``start + n_local`` of ``n_global``."""

    n_local: int
    start: int
    n_global: int

    @classmethod
    def of(cls, comm: MPI.Comm, n_local: int) -> Layout:
        """Return the layout in which this rank holds ``n_local`` entries. Collective."""
        counts = comm.allgather(n_local)
        return cls(n_local, sum(counts[: comm.rank]), sum(counts))

    @property
    def end(self) -> int:
        """One past this rank's last entry."""
        return self.start + self.n_local

    @property
    def sizes(self) -> tuple[int, int]:
        """The pair that PETSc's constructors take."""
        return self.n_local, self.n_global


def new_block(comm: MPI.Comm, rows: Layout, cols: Layout, block_size: int = 1) -> PETSc.Mat:
    """Return an AIJ matrix without a pattern yet; ``set_csr`` gives it one. Collective."""
    mat = PETSc.Mat().create(comm)
    mat.setSizes((rows.sizes, cols.sizes))
    mat.setType(PETSc.Mat.Type.AIJ)
    if block_size > 1:
        mat.setBlockSize(block_size)
    mat.setUp()
    if block_size == 1:
        forget_inodes(mat)
    return mat


def set_near_null_space(mat: PETSc.Mat, modes: list[np.ndarray]) -> None:
    """Tell multigrid motions of this rank's unknowns that cost nearly nothing. Collective."""
    vectors = []
    for mode in modes:
        vectors.append(mat.createVecRight())
        vectors[-1].setArray(mode)
    mat.setNearNullSpace(PETSc.NullSpace().create(vectors=vectors, comm=mat.comm))


def forget_inodes(mat: PETSc.Mat) -> None:
    """Multiply row by row from now on: whether PETSc groups equal rows, and so rounds, depends on former patterns."""
    mat.setOption(PETSc.Mat.Option.USE_INODES, False)


def set_csr(mat: PETSc.Mat, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray, new_pattern: bool) -> None:
    """Fill a matrix with this rank's rows. Collective.

    The matrix stays the same object, so a nest that holds it stays valid when its pattern changes.

    Parameters
    ----------
    mat : PETSc.Mat
        The matrix, from ``new_block``.
    indptr, indices, values : ndarray
        Local rows in compressed form, global column numbers of ``IntType``, sorted within each row.
    new_pattern : bool
        Whether any rank's pattern differs from that of the last call; the same on all ranks.
    """
    if new_pattern and mat.getType() == PETSc.Mat.Type.SEQAIJ:
        # four times as fast as PETSc's function for it, which looks for each entry's place
        # of two numbers alone petsc4py would take the second one for that of other ranks
        mat.setPreallocationNNZ((np.diff(indptr).astype(IntType), None))
        mat.setOption(PETSc.Mat.Option.SORTED_FULL, True)
        mat.setValuesCSR(indptr, indices, values)
        mat.assemble()
        mat.setOption(PETSc.Mat.Option.SORTED_FULL, False)
    elif new_pattern:
        mat.setPreallocationCSR((indptr, indices, values))
    else:
        _replace_values(mat, indices, values)


def _replace_values(mat: PETSc.Mat, indices: np.ndarray, values: np.ndarray) -> None:
    """Write all entries of this rank's rows into an AIJ matrix; row by row, PETSc's way, takes ten times as long.

    On several ranks PETSc keeps the columns that this rank owns apart from the others, each in the order of the rows.
    """
    values = np.ascontiguousarray(values, dtype=float)
    if mat.getType() == PETSc.Mat.Type.MPIAIJ:
        call = library().MatMPIAIJGetSeqAIJ
        own, others, columns = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
        call.argtypes = [ctypes.c_void_p, *(ctypes.POINTER(ctypes.c_void_p),) * 3]
        if call(mat.handle, ctypes.byref(own), ctypes.byref(others), ctypes.byref(columns)):
            raise PETSc.Error
        begin, end = mat.getOwnershipRangeColumn()
        mine = (indices >= begin) & (indices < end)
        _overwrite(own, values[mine])
        _overwrite(others, values[~mine])
    else:
        _overwrite(ctypes.c_void_p(mat.handle), values)
    mat.assemble()


def _overwrite(mat: ctypes.c_void_p, values: np.ndarray) -> None:
    """Replace the entries of a matrix of one rank, in PETSc's own array."""
    place = ctypes.c_void_p()
    for function, work in (("MatSeqAIJGetArray", True), ("MatSeqAIJRestoreArray", False)):
        call = getattr(library(), function)
        call.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_void_p)]
        if call(mat, ctypes.byref(place)):
            raise PETSc.Error
        if work:
            ctypes.memmove(place, values.ctypes.data, values.nbytes)


def collect_garbage() -> None:
    """Free what Python has let go of: PETSc only notes it, and frees it when all ranks come here. Collective."""
    PETSc.garbage_cleanup()


def set_mg_residual(pc: PETSc.PC, level: int, operator: PETSc.Mat) -> None:
    """Give a level of PCMG the matrix of its residuals: it keeps that of its first set-up else. Collective."""
    function = library().PCMGSetResidual
    function.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
    if function(pc.handle, level, None, operator.handle):
        raise PETSc.Error


def factorised(mat: PETSc.Mat, prefix: str) -> PETSc.KSP:
    """Return a solver for a symmetric matrix: redundant Cholesky, unless options tell otherwise. Collective."""
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.getPC().setType(PETSc.PC.Type.REDUNDANT)
    inner = PETSc.Options(f"{prefix}redundant_")
    for name, value in (("pc_type", "cholesky"), ("pc_factor_mat_solver_type", "mumps")):
        if not inner.hasName(name):
            inner.setValue(name, value)
    ksp.setFromOptions()
    ksp.setUp()
    return ksp


def gather_triplets(
    comm: MPI.Comm, rows: Layout, i: np.ndarray, j: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Send matrix entries to the ranks that own their rows and return this rank's as CSR. Collective.

    Duplicates are added in an order that depends on nothing but the ranks' numbers, so that a run repeats bit
    for bit, which PETSc's own stash does not promise.

    Returns
    -------
    indptr, indices, values : ndarray
        Local rows; columns global, sorted, unique.
    """
    i, j, values = _to_owners(comm, rows, i, (i, np.int64), (j, np.int64), (values, np.float64))
    local, j = np.asarray(i, dtype=np.int64) - rows.start, np.asarray(j, dtype=np.int64)
    entries = np.asarray(values, dtype=float), (local, j)
    found = coo_matrix(entries, shape=(rows.n_local, int(j.max(initial=-1)) + 1)).tocsr()  # adds up by place
    found.sort_indices()
    return found.indptr.astype(IntType), found.indices.astype(IntType), found.data


def gather_sums(comm: MPI.Comm, rows: Layout, i: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Send entries of a vector to the ranks that own them and return this rank's, added up. Collective.

    Parameters
    ----------
    i : ndarray of int, shape (n,)
    values : ndarray, shape (n,)
    """
    i, values = _to_owners(comm, rows, i, (i, np.int64), (values, np.float64))
    # of nothing the sum would be of whole numbers
    return np.bincount(i - rows.start, values, rows.n_local).astype(float)


def _to_owners(comm: MPI.Comm, rows: Layout, i: np.ndarray, *columns: tuple[np.ndarray, type]) -> list[np.ndarray]:
    """Send what belongs to rows ``i`` to the ranks that own them; return what this one receives. Collective."""
    if comm.size == 1:
        return [column for column, _ in columns]
    starts = np.array(comm.allgather(rows.start))
    # of ranks that begin at the same row only the last one owns it
    owner = np.searchsorted(starts, i, side="right") - 1
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=comm.size)
    received = np.empty_like(counts)
    comm.Alltoall(counts, received)
    parts = []
    for part, kind in columns:
        send: np.ndarray = np.ascontiguousarray(part[order], dtype=kind)
        recv: np.ndarray = np.empty(received.sum(), dtype=kind)
        comm.Alltoallv([send, counts], [recv, received])
        parts.append(recv)
    return parts


def sum_csr(
    ptr_a: np.ndarray, col_a: np.ndarray, val_a: np.ndarray, ptr_b: np.ndarray, col_b: np.ndarray, val_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sum of two matrices in compressed rows with sorted columns, by row."""
    most = len(col_a) + len(col_b)
    indptr, indices = np.zeros(len(ptr_a), dtype=IntType), np.empty(most, dtype=IntType)
    values = np.empty(most)
    n = _merge(ptr_a, col_a, val_a, ptr_b, col_b, val_b, indptr, indices, values)
    return indptr, indices[:n], values[:n]


@njit(cache=True)
def _merge(ptr_a, col_a, val_a, ptr_b, col_b, val_b, indptr, indices, values):
    n = 0
    for row in range(len(ptr_a) - 1):
        a, b = ptr_a[row], ptr_b[row]
        while a < ptr_a[row + 1] or b < ptr_b[row + 1]:
            from_a = a < ptr_a[row + 1] and (b == ptr_b[row + 1] or col_a[a] <= col_b[b])
            from_b = b < ptr_b[row + 1] and (a == ptr_a[row + 1] or col_b[b] <= col_a[a])
            indices[n] = col_a[a] if from_a else col_b[b]
            values[n] = 0.0
            if from_a:
                values[n] += val_a[a]
                a += 1
            if from_b:
                values[n] += val_b[b]
                b += 1
            n += 1
        indptr[row + 1] = n
    return n


# ---- the library and its objects ----------------------------------------------------------------------------


@cache
def library() -> ctypes.CDLL:
    """Return the libpetsc that this process runs; loading a second one by name would crash."""
    maps = Path("/proc/self/maps").read_text().split()
    return ctypes.CDLL(next(word for word in maps if "/libpetsc" in word))


def reason_name(ksp: PETSc.KSP) -> str:
    """Return PETSc's name of the reason why a solver stopped."""
    reason = ksp.getConvergedReason()
    names = [n for n, value in vars(type(ksp).ConvergedReason).items() if value == reason and n.isupper()]
    failures = [n for n in names if n.startswith(("DIVERGED", "CONVERGED"))]
    return (failures or names or [str(reason)])[0]


def null_space(like: PETSc.Vec, vectors: list[np.ndarray]) -> PETSc.NullSpace:
    """Return the null space spanned by vectors without common support, given by their local parts. Collective."""
    basis = []
    for values in vectors:
        vec = like.duplicate()
        vec.array = values
        vec.normalize()
        basis.append(vec)
    return PETSc.NullSpace().create(constant=False, vectors=basis, comm=like.comm)
