"""The solver of a linear system: one KSP, with everything that is inside it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from petsc4py import PETSc

from petfsi import petsc, releases
from petfsi.errors import SolveError, is_memory
from petfsi.fields.fluids import PressureFluid
from petfsi.solving.convergence import SLACK, require_convergence
from petfsi.solving.method import read_method
from petfsi.solving.multigrid import Hierarchy
from petfsi.solving.option_stories import options_blamed, petsc_text
from petfsi.solving.pressure import PressureSolver
from petfsi.solving.system import System, blown_up

#: What round-off of a first guess of the pressure may leave, as a part of the right-hand side.
COARSEST_PRESSURE = 1e-8
#: What flows out of cells may be so many times the tolerance, as a part of what flows through their faces. The residual
#: of the whole tells little of it where solids are far heavier than what they move, or far stiffer.
CONTINUITY = 1e3
#: It is mended at most so many times, and a step that still leaves this part has failed.
MENDS, LEAK = 8, 1e-3


class _Iterations:
    """Counts the iterations of inner solvers. PETSc holds it, and through it nothing else: a solver can be let go."""

    number = 0

    def __call__(self, _ksp: PETSc.KSP, iteration: int, _norm: float) -> None:
        self.number += iteration > 0


class LinearSolver:
    """One KSP on the system's operator.

    Its type, tolerances and everything inside come from PETSc options under ``fsi_``; see ``options/``.

    Parameters
    ----------
    system : System

    Attributes
    ----------
    method : Method
        How it solves, as the options say.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.method = read_method([field.name for field in system.fields])
        self._ksp: PETSc.KSP | None = None
        self._monolith: PETSc.Mat | None = None
        self._pressure: PressureSolver | None = None
        self._hierarchy: Hierarchy | None = None
        self._correction: tuple[PETSc.Vec, PETSc.Vec] | None = None
        self._inner = _Iterations()

    @property
    def is_set_up(self) -> bool:
        """Whether there is a KSP."""
        return self._ksp is not None

    def set_up(self) -> None:
        """Create the KSP if there is none and let everything inside it read its options. Collective."""
        with options_blamed(self.method.prefix):
            if self._ksp is None:
                held = releases.of(self.system.comm)
                held.sweep(self.system.comm)
                self._ksp = self._create()
                # what PETSc runs in Python must be gone before Python is
                self._release = held.add(self, partial(_release, self._ksp, self._pressure))
            elif self.method.converts:
                self._ksp.setOperators(self._convert())
            elif self._pressure is not None:
                self._pressure.refresh(self._inner.number)
            self._ksp.setUp()
            if self._pressure is not None and _inner_solvers(self._ksp):
                fluid = self._pressure.fluid
                self._pressure.settle(_inner_solvers(self._ksp)[-1], self._grids(fluid))

    def _create(self) -> PETSc.KSP:
        system = self.system
        ksp = PETSc.KSP().create(system.comm)
        ksp.setOptionsPrefix(self.method.prefix)
        ksp.setOperators(self._convert() if self.method.converts else system.operator)
        ksp.setFromOptions()
        if system.index_sets and ksp.getPC().getType() == PETSc.PC.Type.FIELDSPLIT:
            ksp.getPC().setFieldSplitIS(*system.index_sets)  # heard only between setFromOptions and setUp
        fluid = next((field for field in system.fields if isinstance(field, PressureFluid)), None)
        if fluid is not None and not self.method.converts:
            self._pressure = PressureSolver(system, ksp, fluid)
            if not system.index_sets:
                self._pressure.connect(ksp, self._grids(fluid))
        ksp.setUp()
        for inner in _inner_solvers(ksp):
            if inner.getType() != PETSc.KSP.Type.PREONLY:
                inner.setMonitor(self._inner)
        return ksp

    def _grids(self, fluid: Any) -> Hierarchy | None:
        """Return the hierarchy of the fluid's grids, made once per run; None if it has no grid. Collective."""
        if getattr(fluid, "grid", None) is not None:
            if self._hierarchy is None:
                self._hierarchy = Hierarchy(fluid)
            self._hierarchy.follow(fluid)
        return self._hierarchy

    def _convert(self) -> PETSc.Mat:
        if self._monolith is not None:
            self._monolith.destroy()  # its pattern may have changed
        self._monolith = self.system.operator.convert("aij", PETSc.Mat())
        return self._monolith

    def solver_of(self, name: str) -> PETSc.KSP | None:
        """Return a field's own solver inside that of the whole, or None if nothing is split or set up."""
        names = [field.name for field in self.system.fields]
        inner = _inner_solvers(self._ksp) if self._ksp is not None else []
        return inner[names.index(name)] if inner and name in names else None

    def reset(self) -> None:
        """Forget everything but the options, so that the next solve is that of a fresh process. Collective."""
        if self._ksp is not None:
            self._release()
            self._ksp = self._pressure = None

    def adopt(self, system: System) -> None:
        """Solve another system of the same fields from now on. Collective."""
        self.reset()
        self.system, self._monolith, self._correction = system, None, None

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, slack: float = SLACK) -> tuple[int, dict[str, float]]:
        """Solve for x, from what it holds, with the operator as it was set up. Collective.

        Parameters
        ----------
        b, x : PETSc.Vec
        slack : float
            How far the true residual may lie above the tolerance that the solver itself tested.

        Returns
        -------
        int, dict of str to float
            Iterations, and the residual's norms (see ``System.update_residual``).

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        system, ksp = self.system, self._ksp
        assert ksp is not None
        fixed = self.method.fixed_iterations
        size = b.norm()
        rtol, warm = ksp.getTolerances()[0], ksp.getInitialGuessNonzero() and not fixed
        if warm:
            self._drop_coarse_guess(b, x, rtol * size, size)
        floor = self._floor(b, x, size)
        if not np.isfinite(size + floor):
            raise SolveError(blown_up([field.name for field in system.fields]))
        if ksp.getType() != PETSc.KSP.Type.PREONLY:
            if not PETSc.Options(self.method.prefix).hasName("ksp_atol"):
                ksp.setTolerances(atol=floor)
            if self._pressure is not None:
                self._pressure.aim(max(rtol * size, floor))
        iterations = self._run(b, x)
        lost = 0.0
        norms = system.update_residual(x, b)
        if norms[""] > max(rtol * size, floor) and not fixed:
            floor = self._floor(b, x, size)  # the first guess may have been nothing
            if warm and ksp.getConvergedReason() > 0 and norms[""] > max(rtol * size, floor):
                # what iterations update drifts from the true residual by round-off: they go on from there
                iterations += self._run(b, x)
                self._inner.number = iterations
                norms = system.update_residual(x, b)
            lost = system.round_off_at(x)
        require_convergence(self.method, [ksp, *_inner_solvers(ksp)], norms, slack, floor, lost)
        if self._pressure is not None and self._pressure.eliminates and not fixed:
            more, norms = self._close_cells(b, x, CONTINUITY * rtol, norms)
            iterations += more
        return iterations, norms

    def _close_cells(
        self, b: PETSc.Vec, x: PETSc.Vec, rtol: float, norms: dict[str, float]
    ) -> tuple[int, dict[str, float]]:
        """Refine x until what flows out of cells is small beside what flows through their faces. Collective.

        Parameters
        ----------
        b, x : PETSc.Vec
        rtol : float
            What is small.
        norms : dict of str to float
            Of the residual at x.

        Returns
        -------
        int, dict of str to float
            Iterations, and the norms there.

        Raises
        ------
        SolveError
            On every rank, if cells leak.
        """
        system, ksp = self.system, self._ksp
        assert ksp is not None and self._pressure is not None
        fluid = self._pressure.fluid
        name, piece = fluid.name, system.piece(fluid.name)
        if norms[name] <= rtol * system.norm(b, piece):
            return 0, norms
        y = x.copy()
        y.array[piece] = 0.0
        through = system.norm(b, piece) + system.update_residual(y, b)[name]
        wanted = max(rtol * through, fluid.round_off(system.values(x)[system.fields.index(fluid)]))
        norms, total = system.update_residual(x, b), 0
        self._pressure.aim(wanted)
        for _ in range(MENDS):
            if norms[name] <= wanted:
                break
            self._inner.number = 0
            ksp.getPC().apply(system.residual, y)
            x.axpy(1.0, y)
            total += self._inner.number
            norms = system.update_residual(x, b)
        y.destroy()
        if norms[name] > max(wanted, LEAK * through):
            raise SolveError(
                f"solver '{ksp.getOptionsPrefix()}' keeps fluid in its cells no better than to "
                f"{norms[name] / through:.1e} of what flows through them, wanted {rtol:.1e}: solids are far heavier or "
                f"stiffer than what they move. To tell the solver from the physics, run this step with -options_file "
                f"monolithic-direct.opts."
            )
        return total, norms

    def _drop_coarse_guess(self, b: PETSc.Vec, x: PETSc.Vec, wanted: float, size: float) -> None:
        """Begin from zero if the guess is too coarse to get from it to what is wanted, and no better. Collective."""
        if wanted < self.system.round_off_at(x) and not self.system.update_residual(x, b)[""] <= size:
            x.set(0.0)

    def _floor(self, b: PETSc.Vec, x: PETSc.Vec, size: float) -> float:
        """Return what the residual cannot fall below at the pressures in x; ``size`` is that of b. Collective.

        Pressures of a first guess may be anything: their round-off is no more than ``COARSEST_PRESSURE`` of b.
        """
        floor = self.system.rhs_round_off()
        if self._pressure is None:
            return floor
        return max(floor, min(self._pressure.round_off(b, x), COARSEST_PRESSURE * size))

    def _run(self, b: PETSc.Vec, x: PETSc.Vec) -> int:
        """Run the solver; return its iterations, of the inner one if that takes more. Collective."""
        assert self._ksp is not None
        self._inner.number = 0
        try:
            self._ksp.solve(b, x)
        except PETSc.Error as error:
            if is_memory(error):
                raise
            raise SolveError(f"solver '{self.method.prefix}' broke down: {petsc_text(error)}") from None
        return max(self._inner.number, self._ksp.getIterationNumber())

    def improve(self) -> tuple[int, dict[str, float]]:
        """Solve again for a right-hand side that has changed a little, from the solution there. Collective.

        What is left is no more than a thousandth of the change, nor than the solver's tolerance. Returns what ``solve``
        does.

        Raises
        ------
        SolveError
            On every rank, with the reason and the residual of each field.
        """
        system, ksp, kept = self.system, self._ksp, self._inner.number
        assert ksp is not None
        norms = system.update_residual()
        if self._correction is None:
            self._correction = system.solution.duplicate(), system.rhs.duplicate()
        y, r = self._correction
        system.residual.copy(r)
        rtol, warm = ksp.getTolerances()[0], ksp.getInitialGuessNonzero()
        ksp.setTolerances(rtol=min(rtol * norms["rhs"] / norms[""], 1e-3) if norms[""] > 0 else rtol)
        ksp.setInitialGuessNonzero(False)
        try:
            iterations, _ = self.solve(r, y)
        finally:
            ksp.setTolerances(rtol=rtol)
            ksp.setInitialGuessNonzero(warm)
        # what the preconditioner is judged by is a whole solve
        self._inner.number = kept
        system.solution.axpy(1.0, y)
        return iterations, system.update_residual()

    def relative(self, norms: dict[str, float]) -> float:
        """Return |b - Kx|/|b|; of no more than round-off, the part that it is of what it is the round-off of.

        Collective.
        """
        left, size = norms[""], norms["rhs"]
        assert self._ksp is not None
        if left > SLACK * self._ksp.getTolerances()[0] * size and not self.method.fixed_iterations:
            lost = self.system.round_off_at(self.system.solution) + self.system.rhs_round_off()
            size = max(size, lost / float(np.finfo(float).eps))
        return left / size if size > 0 else 0.0

    def rehearse(self, iterates: bool) -> None:
        """Apply the preconditioner once: some inner solvers read their options when they are first used. Collective.

        Parameters
        ----------
        iterates : bool
            Whether to iterate once, too, so that what PETSc refuses only when it solves shows now.
        """
        ksp, b, x = self._ksp, self.system.rhs, self.system.residual
        assert ksp is not None
        ksp.getPC().apply(b, x)
        if not iterates:
            return
        most = ksp.getTolerances()[3]
        ksp.setTolerances(max_it=min(most, 1))
        try:
            ksp.solve(b, x)
        except PETSc.Error as error:
            if error.ierr not in petsc.NUMERICAL:
                raise
        finally:
            ksp.setTolerances(max_it=most)


def _inner_solvers(ksp: PETSc.KSP) -> list[PETSc.KSP]:
    """Return the solvers of the fields inside a KSP that splits them."""
    pc = ksp.getPC()
    return list(pc.getFieldSplitSubKSP()) if pc.getType() == PETSc.PC.Type.FIELDSPLIT else []


def _release(ksp: PETSc.KSP, pressure: PressureSolver | None) -> None:
    if pressure is not None:
        pressure.release()
    ksp.destroy()
