"""Walls that also have masses of fluid to push, as the finest grid sees them.

Where a coupling has added J T J^T to A (see ``projection.slivers``), no diagonal is near A: to push on a cell takes the
motions of many nodes together. With X near the inverse of the rest of A and H = T^(1/2) J^T, the identity of Woodbury
gives

    (X^-1 + H^T H)^-1 = X - X H^T C^-1 H X,     C = I + H X H^T ,

of unknowns by cell with T. For pressures, which the walls feel through a transfer K (J, or what extrapolates to the
walls besides), that is

    E = E0 - P^T C^-1 P,     E0 = K^T X K,     P = H X K .

C is sparse, its inverse is not; hence E is an operator, and L + E inverted on some pressures w with the help of C's
unknowns r, whose right side is 0:

    [ (L + E0)_ww   P_w^T ] [p]   [b]
    [  P_w          C     ] [r] = [0] ,       symmetric and positive.
"""

from __future__ import annotations

from petsc4py import PETSc

from petfsi.petsc import factorised


class Resisted:
    """L + E of walls with masses to push; a context of PETSc's python Mat.

    Parameters
    ----------
    fluxes : PETSc.Mat
        L.
    transfer : PETSc.Mat
        K or -K; rows of the solid.
    inverse : PETSc.Vec
        X's diagonal.
    push : PETSc.Mat
        H.
    prefix : str
        Of the options of C's factorisation.

    Attributes
    ----------
    free : PETSc.Mat
        E0.
    """

    def __init__(
        self,
        fluxes: PETSc.Mat,
        transfer: PETSc.Mat,
        inverse: PETSc.Vec,
        push: PETSc.Mat,
        prefix: str,
    ) -> None:
        yielding, pushed = transfer.copy(), push.transpose(PETSc.Mat())
        yielding.diagonalScale(L=inverse)
        self.free = transfer.transposeMatMult(yielding)
        self._fluxes, self._seen = fluxes, push.matMult(yielding)
        pushed.diagonalScale(L=inverse)
        self._mass = push.matMult(pushed)
        self._mass.shift(1.0)
        for mat in (pushed, yielding):
            mat.destroy()
        self._ksp = factorised(self._mass, prefix)
        self._r, self._s = self._mass.createVecs()

    def operator(self) -> PETSc.Mat:
        """Return L + E for PETSc; it holds this, not this it. Collective."""
        mat = PETSc.Mat().createPython(self._fluxes.getSizes(), self, self._fluxes.comm)
        mat.setUp()
        return mat

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write (L + E) x into y. Collective."""
        self._seen.mult(x, self._s)
        self._ksp.solve(self._s, self._r)
        self._r.scale(-1.0)
        self._fluxes.mult(x, y)
        self.free.multAdd(x, y, y)
        self._seen.multTransposeAdd(self._r, y, y)

    def block(self, chosen: PETSc.IS) -> PETSc.Mat:
        """Return the matrix whose inverse holds that of L + E on some unknowns, those of C last. Collective."""
        own, free = (mat.createSubMatrix(chosen, chosen) for mat in (self._fluxes, self.free))
        own.axpy(1.0, free, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        first, last = self._mass.getOwnershipRange()
        every = PETSc.IS().createStride(last - first, first, 1, comm=self._mass.comm)
        seen = self._seen.createSubMatrix(every, chosen)
        felt = seen.transpose(PETSc.Mat())
        nest = PETSc.Mat().createNest([[own, felt], [seen, self._mass]], comm=self._mass.comm)
        block = nest.convert("aij", PETSc.Mat())
        for mat in (nest, felt, seen, every, free, own):
            mat.destroy()
        return block

    def release(self) -> None:  # "destroy" is PETSc's to call
        """Free all but what solvers still hold. Collective."""
        for thing in (self._ksp, self._mass, self._seen, self.free, self._r, self._s):
            thing.destroy()
