"""Null spaces of a system's blocks: the uniform pressures of closed regions that no equation sees."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from petfsi import petsc
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.solids import SolidField
from petfsi.solving.system import System

#: Even pressures whose squared force is this part of what they push with by themselves are not felt.
UNFELT = 1e-14


def attach_null_space(mat: PETSc.Mat, members: list[np.ndarray]) -> None:
    """Tell PETSc of the null vectors of a symmetric matrix: this rank's parts, orthogonal. Collective."""
    space = petsc.null_space(mat.createVecRight(), members)
    mat.setNullSpace(space)
    mat.setTransposeNullSpace(space)


def unfelt_pressures(
    system: System, fluid: PressureFluid, solid: SolidField | None, members: list[np.ndarray], elastic: np.ndarray
) -> np.ndarray:
    """Return the pressures, even in each region, that no solid feels: an orthogonal set, shape (n, n_regions).

    Those of regions with rigid walls alone, and what rooms on two sides of a beam have in common. Collective.

    Parameters
    ----------
    system : System
    fluid : PressureFluid
    solid : SolidField or None
    members : list of ndarray
        Of each region, 1 on its unknowns and 0 elsewhere: this rank's part.
    elastic : ndarray of bool, shape (n_regions,)
        Which of them a solid bounds.
    """
    n = len(members)
    if not np.any(elastic):
        return np.eye(n)
    forces = []
    for coupling in system.couplings:
        block = coupling.blocks[solid.name, fluid.name]  # type: ignore[union-attr]
        even, force = block.createVecs()
        for member in members:
            even.array = member
            block.mult(even, force)
            forces.append(force.array_r.copy())
    pushed = np.array(forces).reshape(-1, n, len(forces[0]))
    sizes = np.array([[member @ other for other in members] for member in members])
    gram, sizes = system.comm.allreduce(np.array([np.einsum("ckx,clx->kl", pushed, pushed), sizes]))
    scale = np.sqrt(np.where(gram.diagonal() > 0.0, gram.diagonal(), 1.0))
    # in units in which each region alone pushes as hard as the others
    felt, ways = np.linalg.eigh(gram / np.outer(scale, scale))
    kernel = ways[:, felt <= UNFELT] / scale[:, None]
    if not kernel.shape[1]:
        return np.zeros((0, n))
    # orthogonal as pressures
    root = np.sqrt(sizes.diagonal())
    basis, _ = np.linalg.qr(root[:, None] * kernel)
    return basis.T / root
