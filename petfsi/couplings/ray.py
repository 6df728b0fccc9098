"""The paper's transfer between a regular grid and a surface: rays between cell centres, pressure by quadrature."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix

from petfsi.couplings.blocks import Rows
from petfsi.couplings.quadrature import Box, area_normals, pressure_integrals
from petfsi.couplings.walls import WallCoupling
from petfsi.fields.base import Work
from petfsi.fields.mac.grid.kinds import FLUID, SOLID, SOLID_FACE, VOID
from petfsi.fields.solids import SolidField
from petfsi.geometry import rays
from petfsi.petsc import gather_triplets
from petfsi.scene import schema

if TYPE_CHECKING:
    from petfsi.fields.mac.fluid import MacFluid


class RayCoupling(WallCoupling):
    """Couples a MAC fluid and a solid's surface as in the paper.

    A face whose two cell centres are cut apart by a facet lets through what the solid does where their segment meets
    the facet (H, from the facet's shape functions); with D1 the net outflow of cells through such faces, the rows of
    the fluid cells get D1 H u. The pressure on a facet is interpolated among the fluid cells in front of it, and

        (J p)_i = - ∫ N_i n p dA ,   n outward,

    is its force on the solid's nodes. The two are not transposes of each other.

    Attributes
    ----------
    touched_cells : ndarray of bool
        Cell array: fluid cells whose row of D1 H is not zero (valid in ghosts).

    References
    ----------
    N. Chentanez et al., Simultaneous coupling of fluids and deformable bodies, SCA 2006, section 3.4.
    """

    def __init__(self, fluid: MacFluid, solid: SolidField, spec: schema.Coupling) -> None:
        super().__init__(fluid, solid)
        self.quadrature, self.grid, self.box = spec.quadrature, fluid.grid, Box.of(fluid.grid)
        self.wet = np.flatnonzero(~self.surface.void)
        self.touched_cells: np.ndarray = self.grid.zeros_cells(dtype=bool)
        self._faces: list[rays.Hits] = []
        self._held = np.zeros(0)

    # ---- couple ---------------------------------------------------------------------------------------------

    def couple(self, time: float, dt: float) -> None:
        """Find the cells and faces that the solid takes, and make D1 H and J; nothing if no point moved."""
        positions, surface = self.solid.surface_positions(), self.solid.surface()
        if self._positions is not None and surface is self.surface and np.array_equal(positions, self._positions):
            return
        if surface is not self.surface:
            self._take(surface)
        self._positions = positions.copy()
        shifts = self._images(positions)
        hits = self._immerse(positions, shifts)
        self._faces = [self._solid_faces(a, hits[a], positions, shifts) for a in range(self.dim)]
        self._point_flux = self._point_fluxes()
        self.touched = self.grid.to_vec(self.touched_cells)
        self._rows = self._flux_rows(), self._force_rows(positions)
        self._stale = True
        self.n_coupled += 1

    def _images(self, positions: np.ndarray) -> np.ndarray:
        """Return the shifts by whole periods that bring the surface near this rank's cells, (n, dim)."""
        low, high = positions.min(axis=0, initial=np.inf), positions.max(axis=0, initial=-np.inf)
        multiples = []
        for a in range(self.dim):
            if not self.box.periodic[a] or len(positions) == 0:
                multiples.append(range(1))
                continue
            centres, dx, period = self.grid.cell_centres(a), self.box.dx[a], self.box.dx[a] * self.box.cells[a]
            first = int(np.ceil((centres[0] - dx - high[a]) / period))
            last = int(np.floor((centres[-1] + dx - low[a]) / period))
            multiples.append(range(first, last + 1))
        shifts = np.array(list(itertools.product(*multiples)), dtype=float).reshape(-1, self.dim)
        return shifts * self.box.dx * self.box.cells

    def _immerse(self, positions: np.ndarray, shifts: np.ndarray) -> list[rays.Hits]:
        """Tell the fluid which cells and faces the solid takes; return the hits along each axis by local face."""
        grid, void = self.grid, self.surface.void
        inside = grid.zeros_cells(dtype=np.uint8)
        crossed = [grid.zeros_faces(a, dtype=np.uint8) for a in range(self.dim)]
        hits = []
        for a in range(self.dim):
            coords = [grid.cell_centres(b) for b in range(self.dim)]
            # one point more on both ends, as the outermost faces lie beyond the outermost centres
            c, dx = coords[a], self.box.dx[a]
            coords[a] = np.concatenate(([c[0] - dx], c, [c[-1] + dx]))
            found = self._cast(positions, shifts, coords, a)
            if a == 0:
                shape = (inside.shape[0] + 2, *inside.shape[1:])
                inside[rays.windings(found, shape, 0)[1:-1] != 0] = SOLID
                if void.any():
                    hole = rays.windings(rays.select(found, void[found.facet]), shape, 0)[1:-1] != 0
                    inside[hole & (inside == FLUID)] = VOID
            hits.append(rays.nearest_hits(rays.select(found, ~void[found.facet]), coords, a))
            crossed[a].reshape(-1)[hits[a].segment] = True
        if self.box.periodic.any():
            # an image may round differently from the original, and both sides of a seam must agree
            grid.exchange_cells(inside)
            for a in range(self.dim):
                grid.exchange_faces(a, crossed[a])
        self.fluid.immerse(inside, [c.view(bool) for c in crossed])
        return hits

    def _cast(self, positions: np.ndarray, shifts: np.ndarray, coords: list[np.ndarray], axis: int) -> rays.Crossings:
        """Return the crossings of lattice lines with the surface and its periodic images."""
        parts = [rays.cast(positions + shift, self.surface.facets, coords, axis) for shift in shifts]
        if len(parts) == 1:
            return parts[0]
        nothing = rays.cast(positions, self.surface.facets[:0], coords, axis)
        return rays.Crossings(*(np.concatenate(columns) for columns in zip(nothing, *parts, strict=True)))

    def _solid_faces(self, axis: int, hits: rays.Hits, positions: np.ndarray, shifts: np.ndarray) -> rays.Hits:
        """Return every SOLID_FACE along an axis with the place on the surface that moves it."""
        kind = self.fluid.face_kind[axis]
        faces = np.flatnonzero(kind.reshape(-1) == SOLID_FACE)
        facet = np.zeros(len(faces), dtype=np.int32)
        weights = np.zeros((len(faces), self.dim))
        at = np.searchsorted(hits.segment, faces)
        at[at == len(hits.segment)] = 0
        hit = hits.segment[at] == faces if len(hits.segment) else np.zeros(len(faces), dtype=bool)
        facet[hit], weights[hit] = hits.facet[at[hit]], hits.weights[at[hit]]
        lost = np.flatnonzero(~hit)
        if len(lost):
            index = np.unravel_index(faces[lost], kind.shape)
            lines = [self.grid.face_coords(a) if a == axis else self.grid.cell_centres(a) for a in range(self.dim)]
            middle = np.column_stack([line[i] for line, i in zip(lines, index, strict=False)])
            wet = self.surface.facets[self.wet]
            images = np.concatenate([positions + shift for shift in shifts])
            facets = np.concatenate([wet + n * len(positions) for n in range(len(shifts))])
            nearest, weights[lost] = rays.nearest_on_facets(images, facets, middle)
            facet[lost] = self.wet[nearest % len(wet)]
        return rays.Hits(faces, facet, weights)

    # ---- the operators --------------------------------------------------------------------------------------

    def _point_fluxes(self) -> csr_matrix:
        """Return the net outflow of this rank's fluid cells by surface point velocity; mark the touched cells.

        Shape (local pressures, n_points * dim), m^2 (m in 2D).
        """
        grid, layout, kind = self.grid, self.fluid.layout, self.fluid.cell_kind
        owned = np.zeros(kind.shape, dtype=bool)
        owned[grid.owned(None)] = True
        free = np.diff(self._free_map.indptr) > 0
        self.touched_cells[...] = False
        rows, cols, values = [], [], []
        for a, faces in enumerate(self._faces):
            points = self.surface.nodes[faces.facet] * self.dim + a
            shapes = self.surface.shape_functions(faces.facet, faces.weights)
            width = shapes.shape[1]
            moves = np.any(free[points] & (shapes != 0.0), axis=1)
            above = np.array(np.unravel_index(faces.segment, self.fluid.face_kind[a].shape))
            below = above.copy()
            below[a] -= 1
            for cell, sign in ((above, -1.0), (below, 1.0)):
                local = np.flatnonzero((cell[a] >= 0) & (cell[a] < kind.shape[a]))
                local = local[kind[tuple(cell[:, local])] == FLUID]
                self.touched_cells[tuple(cell[:, local[moves[local]]])] = True
                mine = local[owned[tuple(cell[:, local])]]
                rows.append(np.repeat(grid.index[tuple(cell[:, mine])] - layout.start, width))
                cols.append(points[mine].reshape(-1))
                values.append(sign * grid.face_area(a) * shapes[mine].reshape(-1))
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return csr_matrix(entries, shape=(layout.n_local, self._free_map.shape[0]))

    def _force_rows(self, positions: np.ndarray) -> Rows:
        """Return this rank's rows of -J. Collective."""
        facets, nodes, curved = self.surface.facets[self.wet], self.surface.nodes[self.wet], self.surface.curved
        if curved is not None:
            curved = curved.take(self.wet)
        usable = (self.fluid.cell_kind == FLUID) & (self.grid.index >= 0)
        shape_weights, stencils = pressure_integrals(positions, facets, self.box, usable, self.quadrature, curved)
        # point * dim + axis by facet * width + node: each node's force is along the facet's normal
        (n, width), dim = nodes.shape, self.dim
        node = np.broadcast_to(np.arange(n * width).reshape(n, width, 1), (n, width, dim))
        point = nodes[:, :, None] * dim + np.arange(dim)
        normal = np.broadcast_to(area_normals(positions, facets)[:, None, :], (n, width, dim))
        spread = csr_matrix((normal.ravel(), (point.ravel(), node.ravel())), shape=(self._free_map.shape[0], n * width))
        force = ((self._free_map.T @ spread) @ (shape_weights @ stencils)).tocoo()
        cells = self.grid.index.reshape(-1)[force.col]
        return gather_triplets(self.comm, self.solid.layout, self._free[force.row], cells, force.data)

    # ---- assemble and accept --------------------------------------------------------------------------------

    def _transfer_rows(self) -> tuple[Rows, Rows]:
        return self._rows

    def inject(self, volume: np.ndarray) -> None:
        """Add what comes into cells from nowhere to the fluid's right side."""
        self.fluid.rhs += volume

    def power(self, pressure: np.ndarray) -> Work:
        """Return what supports do against the pressure, as the fluid feels it."""
        held = self._held_outflow
        return Work(boundary=-float(pressure @ held) if len(held) else 0.0)

    def accept(self, values: Mapping[str, np.ndarray], time: float, dt: float) -> None:
        """Give the faces that the solid took its new velocity, in ghosts, too."""
        velocity = self.solid.surface_velocity()
        for a, faces in enumerate(self._faces):
            shapes = self.surface.shape_functions(faces.facet, faces.weights)
            moved = np.sum(shapes * velocity[self.surface.nodes[faces.facet], a], axis=1)
            self.fluid.boundary_velocity[a].reshape(-1)[faces.segment] = moved
