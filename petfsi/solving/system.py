"""Blocks by field name, laid out as one nest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.couplings.base import Coupling
from petfsi.errors import SolveError
from petfsi.fields.base import Field


class System:
    """The linear system of a step, in the units of the solver.

    With the fields' blocks on the diagonal and the couplings' off it,

        sum_j  r_i K_ij c_j  (x_j / c_j)  =  r_i b_i ,

    where r and c are the fields' row and column scales: all residuals and unknowns are then comparable numbers
    (m/s where there is a fluid). A single field needs no nest; its block is the operator. Fields without a block are
    left out, and where none has one there is no operator, and no vector.

    Parameters
    ----------
    comm : MPI.Comm
    fields : sequence of Field
    couplings : sequence of Coupling
    before : System, optional
        That of the same fields and couplings in whose place this one steps.

    Attributes
    ----------
    fields : list of Field
        Those with a block.
    operator : PETSc.Mat
        The nest, or the single block; the same object for the whole run.
    rhs, solution : PETSc.Vec
        Scaled; ``solution`` holds the first guess before the solve.
    index_sets : list of (str, PETSc.IS)
        The unknowns of each field; empty for a single field.
    """

    def __init__(
        self, comm: MPI.Comm, fields: Sequence[Field], couplings: Sequence[Coupling], before: System | None = None
    ) -> None:
        self.comm = comm
        self.fields = [field for field in fields if field.has_block]
        self.couplings = list(couplings)
        self.index_sets: list[tuple[str, PETSc.IS]] = []
        if len(self.fields) == 1:
            self.operator = self.fields[0].block
        elif self.fields:
            names = [field.name for field in self.fields]
            rows: list[list[PETSc.Mat | None]] = [[None] * len(names) for _ in names]
            for n, field in enumerate(self.fields):
                rows[n][n] = field.block
            for coupling in self.couplings:
                for (row, col), block in coupling.blocks.items():
                    rows[names.index(row)][names.index(col)] = block
            self.operator = PETSc.Mat().createNest(rows, comm=comm)
            self.operator.setUp()
            self.index_sets = list(zip(names, self.operator.getNestISs()[0], strict=True))
        if self.fields:
            self.solution, self.rhs = self.operator.createVecs()
            self.residual = self.rhs.duplicate()
        offsets = np.cumsum([0] + [field.layout.n_local for field in self.fields])
        self._pieces = [slice(a, b) for a, b in zip(offsets[:-1], offsets[1:], strict=True)]
        # a block that stays was scaled already, unless it has been assembled since
        self._seen: dict[object, int] = {} if before is None else dict(before._seen)
        self._held = self._blocks()
        self._sizes: dict[str, tuple[int, float]] = {}

    def close(self) -> None:
        """Free the nest, its blocks and the vectors. Collective."""
        things = [self.operator, self.solution, self.rhs, self.residual] if self.fields else []
        things += [matrix for field in self.fields for matrix in field.matrices]
        things += [block for coupling in self.couplings for block in coupling.blocks.values()]
        for thing in things:
            thing.destroy()

    @property
    def unknowns(self) -> dict[str, int]:
        """Unknowns of each field."""
        return {field.name: field.layout.n_global for field in self.fields}

    def is_outdated(self) -> bool:
        """Return whether a field or coupling has put another matrix in the place of one that the operator holds."""
        return self._blocks() != self._held

    def _blocks(self) -> list[int]:
        """Return the handles of all blocks."""
        blocks = [field.block for field in self.fields]
        blocks += [block for coupling in self.couplings for block in coupling.blocks.values()]
        return [block.handle for block in blocks]

    def refresh(self, guess: bool = True) -> bool:
        """Scale what was assembled anew, fill the right-hand side; say whether the operator changed. Collective.

        Parameters
        ----------
        guess : bool
            Whether to fill the solution, too: with the fields' present values.
        """
        changed = False
        scales = {field.name: (field.row_scale, field.col_scale) for field in self.fields}
        for field in self.fields:
            if self._is_new(field, field.n_assembled):
                for matrix in field.matrices:
                    matrix.scale(field.row_scale * field.col_scale)
                changed = True
        for coupling in self.couplings:
            if self._is_new(coupling, coupling.n_assembled):
                for (row, col), block in coupling.blocks.items():
                    block.scale(scales[row][0] * scales[col][1])
                changed = True
        if changed and self.index_sets:
            self.operator.assemble()  # else Schur complements formed by PETSc keep the old values
        for field, piece in zip(self.fields, self._pieces, strict=True):
            self.rhs.array[piece] = field.row_scale * field.rhs
            if guess:
                self.solution.array[piece] = field.unknown() / field.col_scale
        return changed

    def _is_new(self, part: Field | Coupling, count: int) -> bool:
        new = self._seen.get(part) != count
        self._seen[part] = count
        return new

    def check_operator(self) -> None:
        """Raise unless the matrix and the first guess are finite. Collective."""
        self.operator.mult(self.solution, self.residual)
        parts = np.array([not np.isfinite(self.residual.array_r[piece]).all() for piece in self._pieces])
        wrong = self.comm.allreduce(parts.astype(int))
        if wrong.any():
            raise SolveError(blown_up([field.name for field, n in zip(self.fields, wrong, strict=True) if n]))

    def check(self) -> None:
        """Raise unless the matrix, the right-hand side and the first guess are finite. Collective.

        Raises
        ------
        SolveError
            On every rank, with the fields in whose equations there is something else.
        """
        # a product hands on what is no number, from every entry that is stored
        with np.errstate(all="ignore"):
            norms = self.update_residual()
        if not np.isfinite(norms[""] + norms["rhs"]):
            fields = [field.name for field in self.fields if not np.isfinite(norms[field.name])]
            raise SolveError(blown_up(fields or [field.name for field in self.fields]))

    def update_residual(self, x: PETSc.Vec | None = None, b: PETSc.Vec | None = None) -> dict[str, float]:
        """Compute b - operator * x and return its norm by field, and of all under ``""``. Collective.

        x and b are solution and rhs if not given.
        """
        x, b = x or self.solution, b or self.rhs
        self.operator.mult(x, self.residual)
        self.residual.aypx(-1.0, b)
        r, b = self.residual.array_r, b.array_r
        squares = [r[piece] @ r[piece] for piece in self._pieces] + [b @ b]
        total = np.sqrt(self.comm.allreduce(np.array(squares)))
        norms = {field.name: float(n) for field, n in zip(self.fields, total, strict=False)}
        norms[""] = float(np.sqrt(np.sum(total[:-1] ** 2)))
        norms["rhs"] = float(total[-1])
        return norms

    def norm(self, x: PETSc.Vec, piece: slice) -> float:
        """Return the norm of a field's part of a vector. Collective."""
        part = x.array_r[piece]
        return float(np.sqrt(self.comm.allreduce(float(part @ part))))

    def round_off(self, x: PETSc.Vec | None = None) -> float:
        """Return what the norm of the residual at x (the solution if not given) cannot fall below. Collective."""
        return sum(field.round_off(part) for field, part in zip(self.fields, self.values(x), strict=True))

    def round_off_at(self, x: PETSc.Vec) -> float:
        """Return what no solver gets |b - K x| below near x, sum_f eps ||A_f|| ||x_f||, for any b. Collective."""
        values = x.array_r
        squares = self.comm.allreduce(np.array([values[piece] @ values[piece] for piece in self._pieces]))
        lengths = zip(self.fields, np.sqrt(squares), strict=True)
        return float(np.finfo(float).eps) * sum(self._size(field) * float(length) for field, length in lengths)

    def _size(self, field: Field) -> float:
        """Return the norm of a field's block. Collective, where it was assembled anew."""
        known = self._sizes.get(field.name)
        if known is None or known[0] != field.n_assembled:
            known = self._sizes[field.name] = field.n_assembled, field.block.norm(PETSc.NormType.NORM_INFINITY)
        return known[1]

    def rhs_round_off(self) -> float:
        """Return the norm of what rounding makes of a right-hand side that vanishes. Collective."""
        return sum(field.rhs_round_off() for field in self.fields)

    def values(self, of: PETSc.Vec | None = None) -> list[np.ndarray]:
        """Return the solution (or another vector) of each field that has a block on this rank, SI."""
        if not self.fields:
            return []
        x = (self.solution if of is None else of).array_r
        return [x[piece] * field.col_scale for field, piece in zip(self.fields, self._pieces, strict=True)]

    def piece(self, name: str) -> slice:
        """Return where a field's unknowns lie in the local vectors."""
        return self._pieces[[field.name for field in self.fields].index(name)]


def blown_up(fields: Sequence[str]) -> str:
    """Return what to say of fields whose equations hold something that is not finite."""
    return (
        f"the state has blown up: the step's equations of {' and '.join(fields)} hold numbers that are not finite, of "
        f"an element inside out, or beyond 1e154. Smaller steps may help; look at loads, supports, speeds, "
        f"densities, damping, and the sizes of cells and steps"
    )
