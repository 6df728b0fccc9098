"""What the pressure's solver cannot read from options: its grids, its stand-in for S, and what S cannot see."""

from __future__ import annotations

from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.fields.base import FluidField
from petfsi.multigrid import Hierarchy, Multigrid
from petfsi.schur import SchurStandIn
from petfsi.system import System

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
    fluid : FluidField
        The field whose unknown the pressure is.
    """

    def __init__(self, system: System, outer: PETSc.KSP, fluid: FluidField) -> None:
        self.system, self.fluid = system, fluid
        self.stand_in: SchurStandIn | None = None
        self._multigrid: Multigrid | None = None
        self._ksp: PETSc.KSP | None = None
        options = PETSc.Options(outer.getOptionsPrefix())
        self.eliminates = bool(system.index_sets) and options.getString("pc_fieldsplit_type", "") == "schur"
        if self.eliminates and options.getString("pc_fieldsplit_schur_precondition", "a11") == "user":
            own = PETSc.Options(f"{outer.getOptionsPrefix()}fieldsplit_{fluid.name}_")
            grids = own.getString("pc_type", "") == PETSc.PC.Type.MG
            self.stand_in = SchurStandIn(system, assembled=own.getBool("schur_assembled", not grids))
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
        if self.eliminates and ksp.getType() == PETSc.KSP.Type.CG and not self._symmetric():
            ksp.setType(PETSc.KSP.Type.GMRES)
            ksp.setPCSide(PETSc.PC.Side.RIGHT)
        pc = ksp.getPC()
        if pc.getType() == PETSc.PC.Type.MG:
            if hierarchy is None:
                raise InputError(f"option -{pc.getOptionsPrefix()}pc_type mg: needs a grid; hypre and gamg do not")
            fine = self.stand_in.operator if self.stand_in is not None else self.fluid.block
            self._multigrid = Multigrid(pc, hierarchy, fine)
        self._pass_on()

    def _symmetric(self) -> bool:
        return all(coupling.symmetric for coupling in self.system.couplings)

    def refresh(self) -> None:
        """Follow the operator's new values. Collective."""
        if self.stand_in is not None:
            self.stand_in.refresh()
        self._pass_on()

    def _pass_on(self) -> None:
        if self._multigrid is not None:
            self._multigrid.refresh(self.fluid.block, self.stand_in.walls if self.stand_in is not None else None)
        if self.eliminates and self._ksp is not None:
            schur = self._ksp.getOperators()[0]
            schur.setNullSpace(self.fluid.block.getNullSpace())
            schur.setTransposeNullSpace(self.fluid.block.getNullSpace())

    def release(self) -> None:
        """Hold on to no solver any longer."""
        self._ksp = self._multigrid = None

    def aim(self, residual: float) -> None:
        """Let the inner solver stop where the whole has the wanted residual, unless options say where."""
        if self.eliminates and self._ksp is not None:
            if not PETSc.Options(self._ksp.getOptionsPrefix()).hasName("ksp_atol"):
                self._ksp.setTolerances(atol=SHARE * residual)
