"""What the pressure's solver cannot read from options: its grids, its stand-in for S, and what S cannot see."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.solids import SolidField
from petfsi.solving.modes import DEGREE, LIGHT, LINEAR, MOST, Modes
from petfsi.solving.multigrid import Hierarchy, Multigrid
from petfsi.solving.preconditioners import DEFAULTS, read_options
from petfsi.solving.resisted import Resisted
from petfsi.solving.schur import FAINT, SchurStandIn
from petfsi.solving.smoothers import DOMINANT
from petfsi.solving.system import System

#: A preconditioner is kept while no diagonal entry has changed by more than this part, and the iterations have not
#: grown by this factor.
CHANGE, GROWTH = 0.05, 1.2
#: The inner solver stops at this part of the residual that the whole system may have.
SHARE = 0.5


class PressureSolver:
    """Serves the KSP of the pressure, be it a split's, a Schur complement's or the only one.

    In order: create it after the outer ``setFromOptions``; ``connect`` the pressure's KSP once it exists; ``refresh``
    whenever the operator has changed.

    Parameters
    ----------
    system : System
    outer : PETSc.KSP
        The solver of the whole.
    fluid : PressureFluid
        The field whose unknown the pressure is.
    """

    def __init__(self, system: System, outer: PETSc.KSP, fluid: PressureFluid) -> None:
        self.system, self.fluid = system, fluid
        self.stand_in: SchurStandIn | None = None
        self._multigrid: Multigrid | None = None
        self._resisted: Resisted | None = None
        self._ksp: PETSc.KSP | None = None
        self._has_modes = False
        self._built: np.ndarray | None = None
        self._versions: list[int] = []
        self._first_iterations = 0
        options = PETSc.Options(outer.getOptionsPrefix())
        self.eliminates = bool(system.index_sets) and options.getString("pc_fieldsplit_type", "") == "schur"
        if self.eliminates and options.getString("pc_fieldsplit_schur_precondition", "a11") == "user":
            own = PETSc.Options(f"{outer.getOptionsPrefix()}fieldsplit_{fluid.name}_")
            faint = own.getReal("schur_faint", FAINT) * _weakest(fluid)
            self.stand_in = SchurStandIn(system, faint)
            outer.getPC().setFieldSplitSchurPreType(PETSc.PC.SchurPreType.USER, self.stand_in.operator)

    def connect(self, ksp: PETSc.KSP, hierarchy: Hierarchy | None) -> None:
        """Take charge of the pressure's KSP, before it is set up itself. Collective.

        Parameters
        ----------
        ksp : PETSc.KSP
        hierarchy : Hierarchy or None
            The fluid's grids, if it has any.
        """
        self._ksp = ksp
        self._prefix = ksp.getOptionsPrefix()
        self._read(PETSc.Options(self._prefix))
        pc = ksp.getPC()
        if pc.getType() == PETSc.PC.Type.MG:
            if hierarchy is None:
                raise InputError(f"option -{pc.getOptionsPrefix()}pc_type mg: needs a grid; hypre and gamg do not")
            fine = self.stand_in.operator if self.stand_in is not None else self.fluid.block
            self._multigrid = Multigrid(pc, hierarchy, fine)
        elif pc.getType() in DEFAULTS:
            read_options(pc, DEFAULTS[pc.getType()])
        self._pass_on()
        if self.stand_in is not None and self._symmetric():
            self._add_modes(ksp)

    def _read(self, own: PETSc.Options) -> None:
        """Read petfsi's own options, whether this scene needs them or not, so that none goes unread."""
        self._change, self._growth = own.getReal("lag_change", CHANGE), own.getReal("lag_growth", GROWTH)
        self._degree, self._light = own.getInt("modes_degree", DEGREE), own.getReal("modes_below", LIGHT)
        self._rigid = own.getReal("modes_linear_below", LINEAR)
        self._aims = not own.hasName("ksp_atol")
        self._dominant = own.getReal("mg_levels_walls_from", DOMINANT)
        own.getReal("schur_faint", FAINT)

    def _add_modes(self, ksp: PETSc.KSP) -> None:
        """Wrap the preconditioner if there are light bodies. Collective."""
        solid = self.system.fields[0]
        assert isinstance(solid, SolidField)
        for degree, part in ((self._degree, self._light), (min(self._degree, 1), self._rigid)):
            density = part * self.fluid.density
            if degree >= 0 and len(solid.light_motions(degree, density, MOST)):
                break
        else:
            return
        wrapped = PETSc.PC().create(self.system.comm)
        wrapped.setType(PETSc.PC.Type.PYTHON)
        wrapped.setPythonContext(Modes(ksp.getPC(), self.system, degree, density))
        wrapped.setOperators(*ksp.getOperators())
        ksp.setPC(wrapped)
        self._has_modes = True

    def settle(self, ksp: PETSc.KSP, hierarchy: Hierarchy | None) -> None:
        """Look after the pressure's KSP once the outer one is set up, which may have made it anew. Collective."""
        if self._ksp is None or self._ksp.handle != ksp.handle:
            self._multigrid, self._has_modes, self._built = None, False, None
            self.connect(ksp, hierarchy)
        if self.eliminates and ksp.getType() == PETSc.KSP.Type.CG and not self._symmetric():
            ksp.setType(PETSc.KSP.Type.GMRES)
            ksp.setPCSide(PETSc.PC.Side.RIGHT)

    def _symmetric(self) -> bool:
        return all(coupling.symmetric for coupling in self.system.couplings)

    def refresh(self, iterations: int) -> None:
        """Follow the operator's new values, unless the preconditioner there is good enough. Collective.

        Parameters
        ----------
        iterations : int
            Of the last solve.
        """
        stale = self._is_stale(iterations)
        if stale and self.stand_in is not None:
            self.stand_in.refresh()
        self._pass_on(stale)

    def _is_stale(self, iterations: int) -> bool:
        """Return whether the last preconditioner no longer pays. Collective.

        It is kept while no pattern has changed, no diagonal entry by more than ``lag_change`` of itself, and the
        iterations have not grown by ``lag_growth`` over those of the first solve with it.
        """
        if self.stand_in is None or self._ksp is None or self._has_modes:
            return True
        if self._change <= 0:
            return True
        versions = [field.pattern_version for field in self.system.fields]
        versions += [coupling.pattern_version for coupling in self.system.couplings]
        self._first_iterations = self._first_iterations or iterations
        now = np.concatenate([field.matrices[-1].getDiagonal().array_r for field in self.system.fields])
        stale = versions != self._versions or iterations > self._growth * self._first_iterations
        if self._built is not None:
            stale = stale or bool(np.any(np.abs(now - self._built) > self._change * np.abs(self._built)))
        if self.system.comm.allreduce(stale, MPI.LOR):
            self._built, self._versions, self._first_iterations = now, versions, 0
            return True
        return False

    def _pass_on(self, stale: bool = True) -> None:
        if stale and self._multigrid is not None:
            self._remake(self._multigrid)
        if self.eliminates and self._ksp is not None:
            schur = self._ksp.getOperators()[0]
            schur.setNullSpace(self.fluid.block.getNullSpace())
            schur.setTransposeNullSpace(self.fluid.block.getNullSpace())

    def _remake(self, multigrid: Multigrid) -> None:
        """Give multigrid the present operators. Collective."""
        fluid, walls = self.fluid, None
        last, self._resisted = self._resisted, None
        if self.stand_in is not None and self.stand_in.matter:
            walls = self.stand_in.walls
            if multigrid.can_resist():
                self._resisted = self.stand_in.resisted(self._dominant, f"{self._prefix}mg_levels_walls_")
        multigrid.refresh(fluid.block, fluid.fluxes, walls, self._resisted, fluid.pattern_version)
        if last is not None:
            last.release()

    def release(self) -> None:
        """Hold on to no solver any longer."""
        self._ksp = self._multigrid = self._resisted = None

    def round_off(self, b: PETSc.Vec, x: PETSc.Vec) -> float:
        """Return what the residual of the pressure's rows cannot fall below at x. Collective.

        Where that is still nothing, at what the preconditioner makes of b.
        """
        pressure = self.system.values(x)[self.system.fields.index(self.fluid)]
        if self._ksp is not None and not self.system.comm.allreduce(bool(pressure.any()), MPI.LOR):
            guess, known = self.fluid.block.createVecs()
            known.array = b.array_r[self.system.piece(self.fluid.name)]
            self._ksp.setUp()
            self._ksp.getPC().apply(known, guess)
            space = self.fluid.block.getNullSpace()
            if space.handle:
                space.remove(guess)
            pressure = guess.array_r * self.fluid.col_scale
        return self.fluid.round_off(pressure)

    def aim(self, residual: float) -> None:
        """Let the inner solver stop where the whole has the wanted residual, unless options say where."""
        if self.eliminates and self._aims and self._ksp is not None:
            self._ksp.setTolerances(atol=SHARE * residual)


def _weakest(fluid: PressureFluid) -> float:
    """Return the coupling of cells along their longest side as a part of that along their shortest one."""
    grid = getattr(fluid, "grid", None)
    return 1.0 if grid is None else float((grid.dx.min() / grid.dx.max()) ** 2)
