"""Newton's method on the system of a step, around the solver of its linear systems."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc
from petfsi.errors import InputError, SolveError, is_memory
from petfsi.solving.linear import LinearSolver
from petfsi.solving.system import System, blown_up

#: Linearise once, or iterate.
KINDS = ("ksponly", "newtonls")

#: What a linear solve leaves over, as of a tangent near singular, the next iteration sees: it may be so many times what
#: the solver was asked for.
SLACK = 1e4

#: Makes the system that of these values of the fields (SI); returns whether the operator has changed. Collective.
Restage = Callable[[list[np.ndarray]], bool]


def as_it_is(values: list[np.ndarray]) -> bool:
    """Restage a linear system: it is that of any values."""
    return False


def snes_type(prefix: str, static: bool) -> str:
    """Return which of ``KINDS`` the options ask for; by default Newton's method where there is no inertia.

    Raises
    ------
    InputError
        If it is another one.
    """
    kind = PETSc.Options(prefix).getString("snes_type", "newtonls" if static else "ksponly")
    if kind not in KINDS:
        raise InputError(f"option -{prefix}snes_type {kind}: must be {' or '.join(KINDS)}")
    return kind


class Newton:
    """A PETSc SNES whose function is  K(x) x - b(x),  in the solver's units, linearised about x itself.

    Its Jacobian is K(x). Function and Jacobian are assembled together, so that the last trial of a line search is
    the next Jacobian. Its linear systems are solved as those of a single linearisation, for the correction. One
    iteration from ``Field.linearised_at`` is what ``ksponly`` does.

    The residual cannot fall below round-off, see ``Field.round_off``: that is ``snes_atol`` unless options give one.

    Parameters
    ----------
    system : System
    solver : LinearSolver
    prefix : str
        Of the options: ``prefix + "snes_..."``.
    defaults : mapping of str to str
        What is in force unless options say otherwise: ``{"snes_linesearch_type": "bt"}``.
    """

    def __init__(self, system: System, solver: LinearSolver, prefix: str, defaults: Mapping[str, str]) -> None:
        self.system, self.solver = system, solver
        self._x = system.solution.duplicate()
        self._function = system.rhs.duplicate()
        self._at: np.ndarray | None = None  # the values that the system is that of
        self._restage: Restage = as_it_is
        self._changed = False
        self._iterations = 0
        self.snes = snes = PETSc.SNES().create(system.comm)
        snes.setOptionsPrefix(prefix)
        snes.setType(PETSc.SNES.Type.NEWTONLS)
        snes.setFunction(self._evaluate, self._function)
        snes.setJacobian(self._differentiate, system.operator)
        # the solver of the linear systems has read its options already; this one hands over to it
        inner = snes.getKSP()
        inner.setOptionsPrefix(f"{prefix}newton_")
        inner.setType(PETSc.KSP.Type.PREONLY)
        inner.getPC().setType(PETSc.PC.Type.PYTHON)
        inner.getPC().setPythonContext(_Correction(self))
        self._read_options(defaults)
        if snes.getType() != PETSc.SNES.Type.NEWTONLS:
            raise InputError(f"option -{prefix}snes_type: must be {' or '.join(KINDS)}")
        snes.setUp()
        snes.setUpdate(self._aim)
        self._reads_floor = not PETSc.Options(prefix).hasName("snes_atol")

    def _read_options(self, defaults: Mapping[str, str]) -> None:
        options = PETSc.Options(self.snes.getOptionsPrefix())
        missing = [name for name in defaults if not options.hasName(name)]
        for name in missing:
            options.setValue(name, defaults[name])
        self.snes.setFromOptions()
        for name in missing:
            options.delValue(name)

    def release(self) -> None:
        """Free what PETSc holds. Collective."""
        for thing in (self.snes, self._x, self._function):
            thing.destroy()

    def solve(self, changed: bool, restage: Restage) -> tuple[int, int, float]:
        """Solve for the system's solution, and leave the system that of it. Collective.

        Parameters
        ----------
        changed : bool
            Whether the operator differs from that of the last call.
        restage : callable

        Returns
        -------
        int, int, float
            Iterations, those of all linear solves, and |b - K(x) x| over |b|; where no more than round-off is left,
            over that of which it is the round-off.

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        system, snes = self.system, self.snes
        self._restage, self._changed, self._iterations = restage, changed, 0
        self._x.array = system.solution.array_r
        for field in system.fields:
            self._x.array[system.piece(field.name)] = field.linearised_at() / field.col_scale
        self._drop_coarse_guess()
        self._at = self._x.array_r.copy()
        if self._reads_floor:
            snes.setTolerances(atol=self._floor(self._x))
        try:
            snes.solve(None, self._x)
            self._become(self._x)
        except PETSc.Error as error:
            if is_memory(error):
                raise
            raise SolveError(f"solver '{snes.getOptionsPrefix()}snes_' broke down: code {error.ierr}") from None
        finally:
            # it knows the simulation: what is in a circle is let go of at another time on each rank
            self._restage = as_it_is
        system.solution.array = self._x.array_r
        norms, floor = system.update_residual(), self._floor(self._x)
        if snes.getConvergedReason() < 0 and not norms[""] <= floor:
            raise SolveError(self._story(norms))
        scale = norms["rhs"] if norms[""] > floor else floor / np.finfo(float).eps
        return snes.getIterationNumber(), self._iterations, float(norms[""] / scale) if scale > 0 else 0.0

    def _drop_coarse_guess(self) -> None:
        """Begin from zero where equations are linear if the guess is too coarse to get from it to zero. Collective.

        What is no better than none, and whose round-off is more than what is wanted of the right-hand side, would have
        that taken for the solution.
        """
        system = self.system
        norms = system.update_residual(self._x)
        wanted = self.snes.getTolerances()[0] * norms["rhs"]
        if wanted < self._floor(self._x) and not norms[""] <= norms["rhs"]:
            for field in system.fields:
                if field.is_linear:
                    self._x.array[system.piece(field.name)] = 0.0

    def _floor(self, x: PETSc.Vec) -> float:
        """Return the norm of the function that is round-off at x. Collective."""
        floor = self.system.round_off(x)
        if not np.isfinite(floor):
            raise SolveError(blown_up([field.name for field in self.system.fields]))
        return floor

    def _aim(self, snes: PETSc.SNES, _step: int) -> None:
        """Ask for no less than round-off, which grows with the way. Collective."""
        if self._reads_floor:
            snes.setTolerances(atol=self._floor(snes.getSolution()))

    def _become(self, x: PETSc.Vec) -> None:
        """Make the system that of x, unless it is. Collective."""
        same = self._at is not None and np.array_equal(self._at, x.array_r)
        if not self.system.comm.allreduce(same, MPI.LAND):
            self._changed |= self._restage(self.system.values(x))
            self._at = x.array_r.copy()

    def _evaluate(self, _snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self._become(x)
        self.system.operator.mult(x, f)
        f.axpy(-1.0, self.system.rhs)

    def _differentiate(self, _snes: PETSc.SNES, x: PETSc.Vec, _J: PETSc.Mat, _P: PETSc.Mat) -> None:
        self._become(x)

    def correct(self, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve K(x) y = f. Collective."""
        if self._changed:
            self.solver.set_up()
            self._changed = False
        y.set(0.0)
        self._iterations += self.solver.solve(f, y, SLACK)[0]

    def _story(self, norms: dict[str, float]) -> str:
        system, snes = self.system, self.snes
        rtol, atol = snes.getTolerances()[:2]
        by_field = ", ".join(f"{field.name} {norms[field.name]:.1e}" for field in system.fields)
        return (
            f"solver '{snes.getOptionsPrefix()}snes_' stopped with {petsc.reason_name(snes)} after "
            f"{snes.getIterationNumber()} iterations: |b - K(x) x| = {norms['']:.1e}, wanted {rtol:.1e} of the first "
            f"one or {atol:.1e}; by field: {by_field}. Smaller steps of load or time help; so may "
            f"-{snes.getOptionsPrefix()}snes_linesearch_type, and -{snes.getOptionsPrefix()}snes_monitor shows."
        )


class _Correction:
    """The preconditioner of the SNES's own KSP: the solver of the linear systems itself."""

    def __init__(self, newton: Newton) -> None:
        self._newton = newton

    def apply(self, _pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        self._newton.correct(f, y)
