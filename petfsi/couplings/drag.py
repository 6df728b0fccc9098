"""Drag between particles and a surface without slip, where viscosity is solved for.

With c'_id of ``fields.sph.viscosity``, wall particles d whose velocity is T u, u the solid's unknowns, and g_d as far
as it is prescribed, Lambda their barycentric coordinates and D_s the sums of c' over particles,

    [ A + T^T D_s T    -T^T C^T ] [u]   [ b - T^T D_s g ]      solid
    [ -C T             ...  + D ] [w] = [ ... + C g     ]      particles

Each pair is c' (1 -1; -1 1): the matrix is symmetric, and what the solid gets the particles lose.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_matrix, diags, identity, kron

from petfsi.couplings.blocks import Rows, TransferBlocks
from petfsi.fields.solids import SolidField
from petfsi.fields.sph.fluid import SphFluid
from petfsi.fields.sph.viscosity import ImplicitViscosity
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import IntType, gather_sums, gather_triplets


class Drag:
    """The blocks off the diagonal, and what belongs on it.

    Parameters
    ----------
    fluid : SphFluid
    solid : SolidField
    viscous : ImplicitViscosity
        The fluid's.
    """

    def __init__(self, fluid: SphFluid, solid: SolidField, viscous: ImplicitViscosity):
        self.fluid, self.solid, self.viscous, self.comm = fluid, solid, viscous, fluid.comm
        self._make_blocks()

    def _make_blocks(self) -> None:
        self._layout = self.fluid.layout
        self._blocks = TransferBlocks(self.comm, self.fluid, self.solid)

    @property
    def blocks(self) -> dict[tuple[str, str], PETSc.Mat]:
        """The blocks by (name of the row's field, name of the column's field)."""
        return self._blocks.by_name

    def weigh(self, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the pairs of the present places; return rows, columns and values of this rank's part of T^T D_s T."""
        skin, swarm = self.fluid.skin, self.fluid.swarm
        assert skin is not None
        start, other = skin.met.pairs
        c = self.viscous.c_walls[-1]  # solids are the last of the sets
        particle = np.repeat(np.arange(len(swarm)), np.diff(start))
        here = np.flatnonzero(swarm.owned[particle] & (c != 0.0))
        local = np.zeros(len(swarm), dtype=np.int64)
        local[self.viscous.rows] = np.arange(len(self.viscous.rows))
        n_walls, n_points = len(skin.rows), len(skin.points)
        pairs = csr_matrix((c[here], (local[particle[here]], other[here])), (len(self.viscous.rows), n_walls))
        corners, weights = skin.facets[skin.facet[skin.rows]], skin.weights[skin.rows]
        each = np.arange(n_walls + 1) * corners.shape[1]
        feet = csr_matrix((weights.ravel(), corners.ravel(), each), (n_walls, n_points))
        axes = identity(self.fluid.dim, format="csr")
        sums = np.asarray(pairs.sum(axis=0)).ravel()
        self._on_particles = kron(pairs @ feet, axes, format="csr")  # C Lambda
        self._on_points = kron(feet.T @ diags(sums) @ feet, axes, format="csr")  # Lambda^T D_s Lambda
        self._surface = surface
        found = (surface.point_map.T @ self._on_points @ surface.point_map).tocoo()
        return found.row, found.col, found.data

    def assemble(self) -> bool:
        """Fill the blocks and add what is prescribed; return whether the pattern is new. Collective.

        The fields have assembled before.
        """
        new = self._layout is not self.fluid.layout
        if new:
            self._make_blocks()
        rows = -(self._on_particles @ self._surface.point_map).tocsr()
        rows.sort_indices()
        back = rows.tocoo()
        to_solid = gather_triplets(
            self.comm, self.solid.layout, back.col, back.row + self.fluid.layout.start, back.data
        )
        new |= self._blocks.fill(_whole(rows), to_solid)
        held = self._surface.fixed_map @ self.solid.fixed_velocity()
        self.fluid.rhs += self._on_particles @ held
        part = self._surface.point_map.T @ (self._on_points @ held)
        here = np.flatnonzero(part)
        self.solid.rhs -= gather_sums(self.comm, self.solid.layout, here, part[here])
        return new


def _whole(rows: csr_matrix) -> Rows:
    return rows.indptr.astype(IntType), rows.indices.astype(IntType), rows.data
