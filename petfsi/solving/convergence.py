"""What solves report, and whether they can be trusted: PETSc's word is not enough when an inner solver gave up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from petfsi import petsc
from petfsi.errors import SolveError
from petfsi.solving.method import Method

#: How far the true residual may lie above the tolerance that the solver itself tested.
SLACK = 10.0
#: Round-off of the solution may leave this part of the right-hand side; where it is more, K is singular to double
#: precision, and what is solved for may be anything.
COARSEST = 1e-4


@dataclass(frozen=True)
class Outcome:
    """What the solves of a step report.

    Attributes
    ----------
    iterations : int
        Of all linear solves; of the pressure's solver where the outer one only applies it.
    residual : float
        Largest |b - Kx|/|b|.
    newton : int
        Newton's iterations.
    """

    iterations: int
    residual: float
    newton: int = 0

    def __add__(self, other: Outcome) -> Outcome:
        """Return the outcome of both."""
        residual = max(self.residual, other.residual)
        return Outcome(self.iterations + other.iterations, residual, self.newton + other.newton)


def require_convergence(
    method: Method, solvers: Sequence[PETSc.KSP], norms: Mapping[str, float], slack: float, floor: float, lost: float
) -> None:
    """Raise unless a linear solve can be trusted.

    Parameters
    ----------
    method : Method
    solvers : sequence of PETSc.KSP
        That of the whole, then those inside.
    norms : mapping of str to float
        Of the residual, see ``System.update_residual``.
    slack : float
        How far the true residual may lie above the tolerance that the solver itself tested.
    floor : float
        What no residual need fall below: round-off.
    lost : float
        What round-off of the solution may leave, if that was looked for.

    Raises
    ------
    SolveError
        With the reason and the residual of each field.
    """
    ksp = solvers[0]
    outer = ksp.getType() != PETSc.KSP.Type.PREONLY
    iterative = [s.getTolerances()[0] for s in solvers if s.getType() != PETSc.KSP.Type.PREONLY]
    rtol: float = iterative[0] if outer else max(iterative, default=1e-8)
    round_off: float = SLACK * min(lost, COARSEST * norms["rhs"])
    wanted = max(slack * max(rtol * norms["rhs"], floor), round_off)
    failed = [s for s in solvers if s.getConvergedReason() < 0]
    finite = np.isfinite(norms[""])
    if method.fixed_iterations:
        good = finite and not failed
    else:
        # iterations may not tell that round-off lets them get no farther
        ended = ksp.getConvergedReason() >= 0 or norms[""] <= round_off
        good = finite and ended and norms[""] <= wanted
    if not good:
        raise SolveError(_story(method, failed[-1] if failed else ksp, norms, wanted, lost))


def _story(method: Method, culprit: PETSc.KSP, norms: Mapping[str, float], wanted: float, lost: float) -> str:
    by_field = ", ".join(f"{name} {norm:.1e}" for name, norm in norms.items() if name not in ("", "rhs"))
    doubt = ""
    if lost > COARSEST * norms["rhs"]:
        doubt = (
            f" Round-off alone may be {lost:.1e}: what resists least is lost beside what resists most, as where "
            f"nothing holds a body, or where stiffness, density or step are extreme."
        )
    return (
        f"solver '{culprit.getOptionsPrefix()}' stopped with {petsc.reason_name(culprit)} after "
        f"{culprit.getIterationNumber()} iterations: |b - Kx| = {norms['']:.1e}, wanted {wanted:.1e} "
        f"(|b| = {norms['rhs']:.1e}); by field: {by_field}.{doubt} {_advice(method, culprit)}"
    )


def _advice(method: Method, culprit: PETSc.KSP) -> str:
    """Return what helps where a solver inside, or the whole one, has not converged."""
    whole = culprit.getOptionsPrefix() == method.prefix
    if whole and method.decoupled and culprit.getType() == PETSc.KSP.Type.RICHARDSON:
        return (
            "Iterated splitting diverges where more fluid moves with the solid, or with a part of its surface, than "
            "that weighs (added mass), its stiffness and damping in a step included: go on with -options_file "
            "monolithic.opts."
        )
    if whole and culprit.getPC().getType() in (PETSc.PC.Type.LU, PETSc.PC.Type.CHOLESKY):
        return "Smaller steps may help; look at densities, stiffness and supports."
    return "To tell the solver from the physics, run this step with -options_file monolithic-direct.opts."
