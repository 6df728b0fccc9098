"""How the linear system of a step is solved: what PETSc's options say of it, and what no matrix can follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.solving.option_rules import PREFIX, field_prefix

#: Preconditioners of a matrix in blocks.
NEST = ("fieldsplit", "jacobi", "none")


@dataclass(frozen=True)
class Method:
    """How a linear system is solved.

    Attributes
    ----------
    prefix : str
        Of its solver's options.
    converts : bool
        Whether the blocks become one matrix.
    decoupled : bool
        Whether each block is inverted by itself (a fieldsplit other than Schur's), so that a region closed by
        an elastic wall is singular to the pressure block though not to the system.
    fixed_iterations : bool
        Whether it iterates so often and no more, from the last step's solution: nothing converges.
    """

    prefix: str
    converts: bool
    decoupled: bool
    fixed_iterations: bool

    @property
    def splits(self) -> bool:
        """Whether it is a splitting scheme in time, which leaves a residual."""
        return self.decoupled and self.fixed_iterations


def read_method(fields: Sequence[str]) -> Method:
    """Return how the options have a system of these fields solved.

    A field that is alone is solved as the options say for the whole, or, where they split the whole into fields, as
    they say for that field.

    Raises
    ------
    InputError
        If its matrix cannot be solved like that.
    """
    single = len(fields) == 1
    splits = PETSc.Options(PREFIX).getString("pc_type", "") == PETSc.PC.Type.FIELDSPLIT
    prefix = field_prefix(fields[0]) if single and splits else PREFIX
    options = PETSc.Options(prefix)
    mat_type = options.getString("mat_type", "nest")
    if not single and mat_type not in ("nest", "aij"):
        raise InputError(f"option -{prefix}mat_type {mat_type}: must be nest or aij")
    converts = mat_type == "aij" and not single
    kind = options.getString("pc_type", PETSc.PC.Type.FIELDSPLIT)
    if not single and not converts and kind not in NEST:  # some crash on a nest, before they are refused
        raise InputError(
            f"option -{prefix}pc_type {kind}: the matrix type nest is for {', '.join(NEST)}; "
            f"all of the matrix can be factorised with -{prefix}mat_type aij"
        )
    split = options.getString("pc_fieldsplit_type", "multiplicative")
    return Method(
        prefix=prefix,
        converts=converts,
        decoupled=not single and splits and split != "schur",
        fixed_iterations=options.getString("ksp_convergence_test", "default") == "skip",
    )
