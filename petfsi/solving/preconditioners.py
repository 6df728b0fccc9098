"""What preconditioners of the pressure are unless options say otherwise, where PETSc's own defaults will not do.

Regions of fluid that are closed leave L singular, on all levels.

hypre               BoomerAMG eliminates on its coarsest grid; a pivot that vanishes there is noise. It relaxes instead.
gamg                Aggregates join rows however weakly they are linked, but in long cells what smoothers leave is not
                    smooth along weak links. Strong ones alone join: 15 iterations for more than 500 in cells of 80:1.
mg, its last level  by singular values, as it is small. The least is what round-off makes of 0, and PETSc takes for zero
                    what lies below an absolute number. Where the level is the first one again (see ``multigrid``), by
                    a cycle of BoomerAMG, for it follows what walls part.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

#: Of BoomerAMG.
SINGULAR = {
    "pc_hypre_boomeramg_relax_type_coarse": "symmetric-SOR/Jacobi",
    "pc_hypre_boomeramg_grid_sweeps_coarse": "10",
}
#: Of gamg: links below this part of the diagonal do not join aggregates; a cube's are 1/6 of it.
STRONG = {"pc_gamg_threshold": "0.05"}
#: By type, for those that stand in the first place.
DEFAULTS = {PETSc.PC.Type.HYPRE: SINGULAR, PETSc.PC.Type.GAMG: STRONG}
ALGEBRAIC = SINGULAR | {
    "pc_type": "hypre",
    "pc_hypre_type": "boomeramg",
    "pc_hypre_boomeramg_coarsen_type": "HMIS",
    "pc_hypre_boomeramg_interp_type": "ext+i",
    "pc_hypre_boomeramg_P_max": "4",
}
#: A singular value is zero up to this times what rounding makes of it.
SAFETY = 10.0
#: Options of those who want coarser grids, or another solver of the last one.
CHOICES = ("pc_mg_levels", "pc_mg_galerkin", "mg_coarse_pc_type")


def read_options(solver: PETSc.KSP | PETSc.PC, defaults: dict[str, str]) -> None:
    """Let a solver read its options, and these where there are no others. Collective."""
    options = PETSc.Options(solver.getOptionsPrefix())
    added = [name for name in defaults if not options.hasName(name)]
    for name in added:
        options.setValue(name, defaults[name])
    solver.setFromOptions()
    for name in added:
        options.delValue(name)


class LastLevel:
    """The solver of multigrid's last level.

    Parameters
    ----------
    pc : PETSc.PC
        Of type mg.
    """

    def __init__(self, pc: PETSc.PC) -> None:
        self._pc, self._given = pc, PETSc.Options(pc.getOptionsPrefix())
        self._algebraic = False

    def be_algebraic(self) -> bool:
        """Return whether it can and may be algebraic multigrid, and be it then."""
        chosen = any(self._given.hasName(name) for name in CHOICES)
        self._algebraic = not chosen and PETSc.Sys.hasExternalPackage("hypre")
        return self._algebraic

    def read(self, fine: PETSc.Mat, rows: int) -> None:
        """Read the options. Collective.

        Parameters
        ----------
        fine : PETSc.Mat
            L of the finest level.
        rows : int
            Of the last one.
        """
        defaults = {"ksp_type": "preonly"}
        if self._algebraic:
            defaults |= ALGEBRAIC
        elif self._given.getString("mg_coarse_pc_type", "svd") == "svd":
            rounding = np.finfo(float).eps * fine.norm(PETSc.NormType.NORM_INFINITY) * fine.getSize()[0] / rows
            defaults |= {"pc_type": "svd", "pc_svd_zero_sing": f"{SAFETY * rounding:g}"}
        read_options(self._pc.getMGCoarseSolve(), defaults)
