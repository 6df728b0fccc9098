"""The start of a run: velocities of fluid, solids and supports that fit each other."""

from __future__ import annotations

import numpy as np

from petfsi.errors import SolveError
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.solids import SolidField
from petfsi.solving.balance import Balance
from petfsi.solving.linear import LinearSolver
from petfsi.solving.option_database import only_options
from petfsi.solving.regions import ClosedRegions
from petfsi.solving.solver import Solver
from petfsi.solving.system import System

#: Net outflows, and forces, this many times their round-off are none.
ROUND_OFF = 10.0
#: This part of what leaves cells may be left where the solver stops for the round-off of forces.
LEFT = 1e-8
#: Whose velocities do not fit those given to solids.
SUPPORTS, FLUID = "supports", "fluid"


def fit_velocities(
    system: System, solver: Solver, regions: ClosedRegions | None, fluid: PressureFluid | None,
    solid: SolidField | None, dt: float,
) -> list[str]:  # fmt: skip
    """Let the velocities of supports, solids and fluid fit each other at the start; return what was changed for.

    A scene may say that a body flies and that the water around it rests, or that a body rests and its support moves.
    What leaves the cells then, D v + D1 H u, must vanish, and bodies must keep together where their supports jump by g
    to their velocity at t = 0; the step's own system, with its A and L, says which impulse brings both about at once:

        [  A    -J ] [u' - u]   [      -A_F g       ]
        [ D1 H   L ] [  p   ] = [ -(D v + D1 H u)   ] ,        v' = v - (c/rho) G p .

    So u' and v' are the velocities nearest to those given that follow supports and let fluid come from nowhere nowhere:
    nearest in the kinetic energy of the change, and, A being M/c + C + c K', in the elastic energy of what it does
    within c. A body that is as good as rigid within a step moves on as such; of one that is not the surface, or what is
    next to the support, alone moves at once. Else its fastest waves would carry away what the rest has lost, and a
    scheme without damping keep them for ever. Supports, sides and inflows keep their velocities.

    The solver is that of the steps. A splitting scheme, which may solve no system to its end, has the one of
    ``monolithic.opts`` here. Where supports agree with what is given and nothing leaves a cell nothing is solved.

    Parameters
    ----------
    system : System
        As assembled for the first step, with K' where the bodies are.
    solver : Solver
        Set up for it.
    regions : ClosedRegions or None
    fluid : PressureFluid or None
    solid : SolidField or None
    dt : float
        Length of the first step, s.

    Returns
    -------
    list of str
        Of ``SUPPORTS`` and ``FLUID``, those whose velocities did not fit.

    Raises
    ------
    SolveError
        On all ranks, if the system cannot be solved.
    """
    pull, outflow = None if solid is None else solid.jolt(), _outflow(system, fluid)
    reasons = ([] if pull is None else [SUPPORTS]) + ([] if outflow is None else [FLUID])
    if solid is not None and pull is not None:
        _change(system, solver, regions, fluid, solid, dt, pull, outflow)
        # beside the forces of a stiff body much that leaves cells is little
        outflow = _outflow(system, fluid, LEFT)
    if outflow is not None:
        _change(system, solver, regions, fluid, solid, dt, None, outflow)
    _show(system, fluid)
    return reasons


def _show(system: System, fluid: PressureFluid | None) -> None:
    """Leave what flows out of cells in the residual, as steps do. Collective."""
    system.residual.set(0.0)
    if fluid is not None:
        system.residual.array[system.piece(fluid.name)] = fluid.row_scale * np.sum(_outflows(system, fluid), axis=0)


def _outflows(system: System, fluid: PressureFluid) -> list[np.ndarray]:
    """Return what the fluid's faces and each coupling's let out of cells, by unknown, m^3/s (m^2/s in 2D)."""
    return [fluid.net_outflow(), *(coupling.outflow() for coupling in system.couplings)]


def _outflow(system: System, fluid: PressureFluid | None, little: float = 0.0) -> np.ndarray | None:
    """Return what leaves cells, by unknown, m^3/s (m^2/s in 2D). Collective.

    None where that is round-off, or so small a part of what goes through walls and sides.
    """
    if fluid is None:
        return None
    parts = _outflows(system, fluid)
    outflow = np.sum(parts, axis=0)
    squares = system.comm.allreduce(np.array([outflow @ outflow, *(part @ part for part in parts)]))
    left, terms = np.sqrt(squares[0]), np.sqrt(squares[1:].sum())
    floor = fluid.rhs_round_off() / fluid.row_scale + np.finfo(float).eps * terms
    return outflow if left > max(ROUND_OFF * floor, little * terms) else None


def _change(
    system: System, solver: Solver, regions: ClosedRegions | None, fluid: PressureFluid | None,
    solid: SolidField | None, dt: float, pull: np.ndarray | None, outflow: np.ndarray | None,
) -> None:  # fmt: skip
    """Change velocities so that solids bear the pull, and cells take what leaves them. Collective."""
    for field in system.fields:
        field.rhs[:] = 0.0
    if fluid is not None and outflow is not None:
        if system.couplings:
            system.couplings[0].inject(-outflow)
        else:
            fluid.rhs[:] = -outflow
    if solid is not None and pull is not None:
        solid.rhs += pull
    system.refresh()
    system.solution.set(0.0)
    if regions is not None and Balance(regions).make_up():
        system.refresh(guess=False)
    _solve(system, solver, regions, fluid)
    changes = dict(zip((field.name for field in system.fields), system.values(), strict=True))
    if solid is not None:
        solid.push(changes[solid.name])
    if fluid is not None:
        for coupling in system.couplings:
            coupling.accept(changes, 0.0, dt)
        fluid.push(changes[fluid.name], dt)


def _solve(system: System, solver: Solver, regions: ClosedRegions | None, fluid: PressureFluid | None) -> None:
    try:
        if solver.decoupled and regions is not None:
            solver.reset()
            with only_options([]), regions.coupled():
                other = LinearSolver(system)
                other.set_up()
                other.solve(system.rhs, system.solution)
                other.reset()
        else:
            solver.linear.solve(system.rhs, system.solution)
    except SolveError as error:
        # what is left of a stiff body's large forces may be no more than their round-off
        norms = system.update_residual()
        forces = norms[""] <= ROUND_OFF * system.round_off()
        if not (forces and (fluid is None or norms[fluid.name] <= LEFT * norms["rhs"])):
            raise SolveError(f"the velocities at t = 0 cannot be made to fit each other: {error}") from None
