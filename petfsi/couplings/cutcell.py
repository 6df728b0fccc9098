"""The exact transfer between a regular grid and a surface: facets clipped against cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix

from petfsi.couplings.blocks import Rows
from petfsi.couplings.enclosure import Enclosure
from petfsi.couplings.walls import WallCoupling
from petfsi.fields.base import Work
from petfsi.fields.mac.projection.slivers import outer_products
from petfsi.fields.solids import Forces, SolidField
from petfsi.fields.stored import outside, refuse
from petfsi.geometry.seams import Seams
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import gather_sums, gather_triplets, sum_csr
from petfsi.scene import schema

if TYPE_CHECKING:
    from petfsi.fields.mac.fluid import MacFluid
    from petfsi.fields.mac.walls.cut import Wet


#: Cells that sheets may go from one cut to the next, see ``fields.mac.carrying.lineage``.
STRIDE = 0.45
#: A surface goes less than the grid's size in a step; where a file has it so much farther away, it is another's.
_AWAY = 10.0


class CutCellCoupling(WallCoupling):
    """Couples a MAC fluid and a solid's surface without loss: D1 H = J^T.

    What the walls of a cell let through when they move is J^T u, and J p is the pressure's force on them; see
    ``fields.mac.walls.cut`` for the entries. The coupling does no work of its own, a closed cavity keeps its volume to
    the solver's tolerance, and the system is symmetric quasi-definite.
    """

    symmetric = True

    def __init__(self, fluid: MacFluid, solid: SolidField, spec: schema.Coupling) -> None:
        super().__init__(fluid, solid)
        self._seams: Seams | None = None
        self._factor = 0.0
        self._held = np.zeros(self.surface.point_map.shape[0])

    def _take(self, surface: Surface) -> None:
        super()._take(surface)
        # a cavity that holds nothing is no room for the fluid: without its walls it counts as solid
        wet = ~surface.void
        self.facets = surface.facets[wet]
        self.nodes, self.curved = self.facets, None
        if surface.curved is not None:
            self.curved = surface.curved.take(wet)
            self.nodes = self.curved.nodes

    def _new_blocks(self) -> None:
        super()._new_blocks()
        self._made_for = self.fluid.block

    def couple(self, time: float, dt: float) -> None:
        """Cut the grid and make J, if any point moved, and give the solid the mass of the slivers it pushes."""
        positions, surface = self.solid.surface_positions(), self.solid.surface()
        moved = self._positions is None or surface is not self.surface or not np.array_equal(positions, self._positions)
        if moved:
            if surface is not self.surface:
                self._take(surface)
            self._positions = positions.copy()
            self._cut(positions)
        factor = self.fluid.factor(dt)
        if moved or factor != self._factor:
            self._factor = factor
            self.solid.take_mass(self._sliver_mass(factor))

    def _cut(self, positions: np.ndarray) -> None:
        """Cut the grid and make what walls let through. Collective."""
        if self._seams is None:
            # as all is at rest: what meets there is one
            self._seams = self.fluid.find_seams(positions, self.facets)
        part = None if self.curved is None else self.curved.part
        for place in self._stations(positions):
            walls, wet = self.fluid.cut(place, self.facets, part, self._seams)
        self._walls, self._let_through = self.nodes[self._seams.walls], walls
        layout = self.fluid.layout
        points = self._walls[walls.facet] * self.dim + walls.axis[:, None]
        rows = np.repeat(walls.slot - layout.start, self.nodes.shape[1])
        shape = (layout.n_local, self._free_map.shape[0])
        self._point_flux = csr_matrix((walls.flux.ravel(), (rows, points.ravel())), shape=shape)
        self._flux = self._flux_rows()
        self.touched = np.diff(self._flux[0]) > 0
        if self.fluid.weight is not None:
            self._weight = self._rest_force(wet)
        self._stale = True
        self.n_coupled += 1

    def restored(self) -> None:
        """Look whether the grid was cut near where the surface is: it is followed from there. Collective."""
        begin, here = self.fluid.cut_at, self.solid.surface_present()
        if begin.shape == here.shape:
            way = np.abs(begin - here).max(axis=1, initial=0.0)
            refuse(
                self.fluid.comm,
                [outside("the way of the surface since cut_at", way, 0.0, _AWAY * float(max(self.fluid.grid.size)))],
            )

    def _stations(self, positions: np.ndarray) -> list[np.ndarray]:
        """Return where to cut the grid on the way to some positions, them last: sheets must not pass by cells unseen.

        The way begins where the grid was last cut, which is not where the surface is now: a scheme may take its
        equations at the beginning of a step or in its middle.
        """
        sheets = self.fluid.sheets
        if sheets is None or not sheets.anywhere:
            return [positions]
        begin = self.fluid.cut_at
        if begin.shape != positions.shape:  # it has not been cut yet
            return [positions]
        way = positions - begin
        n = max(1, int(np.ceil(np.abs(way / self.fluid.grid.dx).max(initial=0.0) / STRIDE)))
        return [*(begin + k / n * way for k in range(1, n)), positions]

    def _sliver_mass(self, factor: float) -> Rows | None:
        """Return J T J^T over the slivers with S > 0, this rank's rows of the solid. Collective."""
        slivers = self.fluid.slivers
        self.pushed = self.push = None
        if slivers is None or not self.comm.allreduce(bool(np.any(slivers.size > 0.0)), op=MPI.LOR):
            return None
        self.pushed = np.zeros(self.fluid.layout.n_local)
        self.pushed[slivers.slot] = self.fluid.density / factor * np.maximum(slivers.size, 0.0)
        thick = np.flatnonzero(self.pushed)
        indptr, indices, values = self._flux
        rows = csr_matrix((values, indices, indptr), shape=(len(self.pushed), self.solid.layout.n_global))[thick]
        rows.data *= np.repeat(np.sqrt(self.pushed[thick]), np.diff(rows.indptr))
        self.push = rows.indptr, rows.indices, rows.data
        entries = outer_products(*self._flux, *self._flux, thick, self.pushed[thick])
        return gather_triplets(self.comm, self.solid.layout, *entries)

    def _rest_force(self, wet: Wet) -> csr_matrix:
        """Return the force of a linear pressure, zero in the grid's upper corner, by its gradient. Collective.

        Shape (unknowns of the solid on this rank, dim), m^3 (m^2 in 2D):  -∫ N_i n (x_b - x_0,b) dA.
        """
        dim, layout = self.dim, self.solid.layout
        points = (self._walls[wet.facet] * dim)[:, :, None] + np.arange(dim)
        rows = np.repeat(points.ravel(), dim)
        columns = np.tile(np.arange(dim), points.size)
        self._point_weight = csr_matrix((-wet.first.ravel(), (rows, columns)), shape=(self._free_map.shape[0], dim))
        force = (self._free_map.T @ self._point_weight).tocoo()
        columns = force.col.astype(np.int64)
        indptr, indices, values = gather_triplets(self.comm, layout, self._free[force.row], columns, force.data)
        return csr_matrix((values, indices, indptr), shape=(layout.n_local, dim))

    def assemble(self, time: float, dt: float) -> None:
        """Do what every wall does, for the fluid's present unknowns, and let slivers act on the solid. Collective."""
        if self._made_for is not self.fluid.block:  # its unknowns have changed, on all ranks
            self._new_blocks()
        super().assemble(time, dt)
        self.fluid.rhs[:] = self._pressed(self.fluid.rhs)
        if self.fluid.weight is not None:
            self.solid.rhs += self._weight @ self.fluid.weight.gradient

    def _transfer_rows(self) -> tuple[Rows, Rows]:
        """Return this rank's rows of D1 H and -J, with the pressure extrapolated to the walls. Collective."""
        flux, slivers, layout = self._flux, self.fluid.slivers, self.fluid.layout
        if slivers is not None:
            thin = np.flatnonzero(slivers.size < 0.0)
            weight = self.fluid.density / self._factor * slivers.size[thin]
            entries = outer_products(*self.fluid.flux_rows, *self._flux, slivers.slot[thin], weight)
            flux = sum_csr(*flux, *gather_triplets(self.comm, layout, *entries))
        indptr, columns, values = flux
        cells = layout.start + np.repeat(np.arange(layout.n_local), np.diff(indptr))
        return flux, gather_triplets(self.comm, self.solid.layout, columns, cells, -values)

    def _pressed(self, known: np.ndarray) -> np.ndarray:
        """Let what comes into cells act through the slivers on the solid; return what it is to the pressure's rows.

        Collective.
        """
        fluid, slivers = self.fluid, self.fluid.slivers
        if slivers is None:
            return known
        thick = np.flatnonzero(slivers.size > 0.0)
        force = fluid.density / self._factor * slivers.size[thick] * known[slivers.slot[thick]]
        n = fluid.layout.n_local
        column = np.arange(n + 1), np.zeros(n, dtype=np.int64), np.ones(n)
        i, _, values = outer_products(*self._flux, *column, slivers.slot[thick], force)
        self.solid.rhs += gather_sums(self.comm, self.solid.layout, i, values)
        return known + fluid.spread(known)

    def enclose(self, members: list[np.ndarray]) -> Enclosure | None:
        """Return what bounds regions of the fluid, each 1 on its unknowns and 0 elsewhere."""
        assert self._seams is not None
        walls, start = self._seams.walls, self.fluid.layout.start
        curved = None if self.curved is None else self.curved.take(walls)
        surface = self.fluid.cut_at, self.facets[walls], walls, len(self.facets)
        return Enclosure(*surface, self._let_through, start, self._point_flux, members, curved)

    @property
    def n_enclosing(self) -> int:
        """How many facets may bound regions, at any time."""
        return len(self.facets)

    def inject(self, volume: np.ndarray) -> None:
        """Add what comes into cells from nowhere to the right sides. Collective."""
        self.fluid.rhs += self._pressed(volume)

    def forces(self) -> Forces:
        """Return the fluid's weight on the points that are free."""
        return {} if self.fluid.weight is None else {"gravity": self._weight @ self.fluid.weight.gradient}

    def power(self, pressure: np.ndarray) -> Work:
        """Return the power of the fluid's weight on prescribed points, and what is done against it and the pressure.

        By supports, and by what comes into cells from nowhere.
        """
        held = 0.0
        if self.fluid.weight is not None:
            held = float(self._held @ (self._point_weight @ self.fluid.weight.gradient))
        pressed, outflow = 0.0, np.zeros_like(pressure)
        if self.surface.fixed_map.nnz:
            outflow += self._held_outflow
        if self.fluid.source is not None:
            outflow -= self.fluid.source
        if self.surface.fixed_map.nnz or self.fluid.source is not None:
            if self.fluid.slivers is not None:
                outflow += self.fluid.spread(outflow, only_thin=False)
            pressed = float(pressure @ outflow)
        return Work(gravity=held, boundary=-pressed - held)

    def accept(self, values: Mapping[str, np.ndarray], time: float, dt: float) -> None:
        """Do nothing: no face takes its velocity from the solid."""
