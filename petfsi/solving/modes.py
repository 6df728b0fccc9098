"""The large motions of light bodies, which a diagonal in the place of A^-1 does not know.

With R the polynomial motions of each light body, A^-1 is about X + R (R^T A R)^-1 R^T, so that to Sp (see ``schur``)
comes W C W^T with W = D1 H R and C = (R^T A R)^-1. For B, the preconditioner of Sp that the options ask for, the
Woodbury identity gives that of the sum,

    M^-1 = B - B W (C^-1 + W^T B W)^-1 W^T B .

Costs one application of B for each motion whenever the operator changes, and 8 bytes per motion and unknown.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from petfsi.errors import SolveError
from petfsi.fields.solids import SolidField
from petfsi.solving.system import System

#: Bodies lighter than this part of the fluid have modes.
LIGHT = 0.05
#: Where no body is that light, those lighter than this part of the fluid have linear ones: a stiff body moves so.
LINEAR = 0.3
#: Degree of the polynomials.
DEGREE = 3
#: Motions of all bodies together; more bodies have simpler ones, or none.
MOST = 60


class Modes:
    """Wraps the preconditioner of the pressure; a context of PETSc's python PC.

    Parameters
    ----------
    inner : PETSc.PC
        B; symmetric.
    system : System
        Of a solid and a fluid whose coupling is symmetric.
    degree : int
    light : float
        Density of bodies with modes, kg/m^3: up to this.
    """

    def __init__(self, inner: PETSc.PC, system: System, degree: int, light: float) -> None:
        self.inner = inner
        self._comm = system.comm
        solid = system.fields[0]
        assert isinstance(solid, SolidField)
        self._solid = solid
        self._degree, self._light = degree, light
        self._flux = system.operator.getNestSubMatrix(1, 0)
        self._rows = np.zeros(0, dtype=np.int64)

    def setUp(self, pc: PETSc.PC) -> None:  # noqa: N802 - PETSc's name
        """Set B up, and apply it to W. Collective."""
        self.inner.setOperators(*pc.getOperators())
        self.inner.setUp()
        motions = self._solid.light_motions(self._degree, self._light, MOST)
        motion, resisted = self._solid.block.createVecs()
        pushed, answer = self._flux.createVecLeft(), self._flux.createVecLeft()
        m = len(motions)
        stiff, w = np.zeros((m, m)), np.zeros((m, pushed.local_size))
        self._answers = np.zeros_like(w)
        for n, values in enumerate(motions):
            motion.array = values
            self._solid.block.mult(motion, resisted)
            stiff[:, n] = motions @ resisted.array
            self._flux.mult(motion, pushed)
            self.inner.apply(pushed, answer)
            w[n], self._answers[n] = pushed.array, answer.array
        self._rows = np.flatnonzero(w.any(axis=0))
        self._w = np.ascontiguousarray(w[:, self._rows])
        total = self._comm.allreduce(np.array([stiff, self._w @ self._answers[:, self._rows].T]))
        total = 0.5 * (total + total.swapaxes(1, 2))
        whole = total.sum(axis=0)
        size = np.sqrt(whole.diagonal())
        size[size == 0] = 1.0
        try:
            self._capacity = np.linalg.pinv(whole / np.outer(size, size), rcond=1e-13, hermitian=True)
        except np.linalg.LinAlgError:
            raise SolveError(
                "the motions of light bodies push on the fluid beyond what numbers can hold; "
                "-fsi_fieldsplit_pressure_modes_degree -1 leaves them out"
            ) from None
        self._capacity /= np.outer(size, size)
        for vec in (motion, resisted, pushed, answer):
            vec.destroy()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write M^-1 x into y. Collective."""
        self.inner.apply(x, y)
        seen = self._comm.allreduce(self._w @ y.array_r[self._rows])
        y.array -= (self._capacity @ seen) @ self._answers
