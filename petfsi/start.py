"""The start of a run: velocities of fluid and solids that fit each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc

from petfsi import solve
from petfsi.errors import SolveError
from petfsi.fields.base import PressureFluid, SolidField
from petfsi.regions import ClosedRegions
from petfsi.solve import Solver
from petfsi.system import System

#: Net outflows, and forces, this many times their round-off are none.
ROUND_OFF = 10.0
#: This part of what leaves cells may be left where the solver stops for the round-off of forces.
LEFT = 1e-8


def fit_velocities(
    system: System, solver: Solver, regions: ClosedRegions, fluid: PressureFluid, solid: SolidField | None, dt: float
) -> bool:  # fmt: skip
    """Let the velocities of fluid and solids fit each other at the start; return whether any was changed. Collective.

    A scene may say that a body flies and that the water around it rests. What leaves the cells then, D v + D1 H u,
    must vanish; the step's own system, with its A and L, says which impulse of the pressure brings that about at once:

        [  A    -J ] [u' - u]   [        0        ]
        [ D1 H   L ] [  p   ] = [ -(D v + D1 H u) ] ,        v' = v - (c/rho) G p .

    So u' and v' are the velocities nearest to those given that let fluid come from nowhere nowhere: nearest in the
    kinetic energy of the change, and, A being M/c + C + c K', in the elastic energy of what it does within c. A body
    that is as good as rigid within a step moves on as such; of one that is not the surface alone is braked at once.
    Else its fastest waves would carry away what the rest has lost, and a scheme without damping keep them for ever.
    Supports, sides and inflows keep their velocities.

    The solver is that of the steps. A splitting scheme, which may solve no system to its end, has the one of
    ``monolithic.opts`` here. Where nothing leaves a cell nothing is solved.

    Parameters
    ----------
    system : System
        As assembled for the first step.
    solver : Solver
        Set up for it.
    regions : ClosedRegions
    fluid : PressureFluid
    solid : SolidField or None
    dt : float
        Length of the first step, s.

    Raises
    ------
    SolveError
        On all ranks, if the system cannot be solved.
    """
    parts = [fluid.net_outflow(), *(coupling.outflow() for coupling in system.couplings)]
    outflow = np.sum(parts, axis=0)
    squares = system.comm.allreduce(np.array([outflow @ outflow, *(part @ part for part in parts)]))
    left, terms = np.sqrt(squares[0]), np.sqrt(squares[1:].sum())
    floor = fluid.rhs_round_off() / fluid.row_scale + np.finfo(float).eps * terms
    if not left > ROUND_OFF * floor:
        return False
    for field in system.fields:
        field.rhs[:] = 0.0
    if system.couplings:
        system.couplings[0].inject(-outflow)
    else:
        fluid.rhs[:] = -outflow
    system.refresh()
    system.solution.set(0.0)
    _solve(system, solver, regions, fluid)
    changes = dict(zip((field.name for field in system.fields), system.values(), strict=True))
    if solid is not None:
        solid.push(changes[solid.name])
    for coupling in system.couplings:
        coupling.accept(changes, 0.0, dt)
    fluid.push(changes[fluid.name], dt)
    return True


def _solve(system: System, solver: Solver, regions: ClosedRegions, fluid: PressureFluid) -> None:
    try:
        if solver.decoupled:
            solver.reset()
            with _only_defaults(), regions.coupled():
                other = Solver(system)
                other.set_up()
                other.solve_linear(system.rhs, system.solution)
                other.reset()
        else:
            solver.solve_linear(system.rhs, system.solution)
    except SolveError as error:
        # what is left of a stiff body's large forces may be no more than their round-off
        norms = system.update_residual()
        forces = norms[""] <= ROUND_OFF * system.round_off()
        if not (forces and norms[fluid.name] <= LEFT * norms["rhs"]):
            raise SolveError(f"the velocities at t = 0 cannot be made to fit each other: {error}") from None


@contextmanager
def _only_defaults() -> Iterator[None]:
    """Have the solver's options of ``solve.DEFAULT`` in force inside, and no others of petfsi's. Collective."""
    options = PETSc.Options()
    mine = {name: value for name, value in options.getAll().items() if name.startswith(solve.PREFIX)}
    for name in mine:
        options.delValue(name)
    try:
        solve.load_options([])
        yield
    finally:
        for name in options.getAll():
            if name.startswith(solve.PREFIX):
                options.delValue(name)
        for name, value in mine.items():
            options.setValue(name, value)
