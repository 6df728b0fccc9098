"""A grid of fluid that obstacles and solids cover in part: its cells, faces and unknowns, and the matrix over them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.fluids import PressureFluid
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.sides import Surroundings, periodic_axes
from petfsi.fields.mac.projection import pressure
from petfsi.fields.mac.projection.extras import Extras
from petfsi.fields.mac.projection.open_sides import OpenSides
from petfsi.fields.mac.projection.regions import Regions, find_regions
from petfsi.fields.mac.projection.slivers import outer_products
from petfsi.fields.mac.walls.parts import Parts
from petfsi.petsc import gather_sums, gather_triplets, new_block, set_csr, sum_csr
from petfsi.ranks import on_root
from petfsi.scene import fluids
from petfsi.scene.schema import Scene

if TYPE_CHECKING:
    from petfsi.fields.mac.projection.cutgrid import CutGrid, Openings
    from petfsi.fields.mac.projection.slivers import Slivers
    from petfsi.fields.mac.walls.cut import Walls, Wet
    from petfsi.geometry.seams import Seams


#: Walls in a cell that face somewhere with less than this part of a face's area face nowhere.
FAINT = 1e-3
#: What a step replaces before it is solved; none of it is changed in place.
REPLACED = (
    "cell_kind", "face_kind", "openness", "narrow", "volume", "slivers", "extras", "index", "layout",
    "block", "fluxes", "rhs", "cut_at", "surface", "facing",
)  # fmt: skip


class CoveredGrid(PressureFluid):
    """A field with the pressure of every cell of a grid as unknown; which cells and faces are fluid changes with time.

    Attributes
    ----------
    grid : MacGrid
    density : float
    cell_kind : ndarray of uint8
        Cell array, see ``kinds``.
    face_kind : list of ndarray of uint8
        Face arrays, valid in all ghosts.
    openness : list of ndarray
        Face arrays: how much of a face lets fluid through, see ``cut``; 1 where nothing cuts cells.
    fluxes : PETSc.Mat
        L; the block itself unless slivers add to it.
    narrow : list of ndarray of bool or None
        Face arrays, see ``kinds.narrow_faces``; None where nothing cuts cells.
    index : ndarray of IntType
        Cell array of the unknowns' global numbers.
    extras : Extras or None
        Further unknowns, of cells that hold several pieces of fluid.
    slivers : Slivers or None
        None where nothing that cuts cells can move.
    cut_at : ndarray, shape (n, dim)
        Where the points of the surface were when it was last cut, m.
    facing : list of ndarray
        Cell arrays by axis: area times normal of the walls in each cell; empty where nothing cuts cells.
    surface : (ndarray, ndarray)
        Points and facets of all walls that the grid was last cut by.
    flux_rows : (ndarray, ndarray, ndarray)
        This rank's rows of L as last assembled, SI: indptr, global columns, values.
    volume : ndarray or None
        Cell array: open part of each cell; None where nothing cuts cells.
    geometry_version, kinds_version : int
        Grow when openings change, and when kinds or unknowns do; the same on all ranks.
    """

    name = "pressure"

    def __init__(self, comm: MPI.Comm, scene: Scene):
        fluid = scene.fluid
        assert isinstance(fluid, fluids.MacFluid)
        self.scene, self.comm = scene, comm
        periodic = periodic_axes(fluid.sides, scene.dim)
        if any(p and n < 3 for p, n in zip(periodic, fluid.cells, strict=True)):
            raise InputError(f"fluid.cells = {fluid.cells}: a periodic axis needs at least 3 cells")
        self.grid = grid = MacGrid(comm, fluid.origin, fluid.size, fluid.cells, periodic)
        self.dim, self.density, self.layout = grid.dim, fluid.density, grid.layout
        self.cell_volume, self.extent, self.n_cells = grid.cell_volume, max(fluid.size), grid.layout.n_local
        self.surroundings = Surroundings(grid, fluid)
        self.open_sides = OpenSides(grid, fluid.density, fluid.sides)
        self._cutter = self._make_cutter() if scene.cuts_cells else None
        if self._cutter is None:
            for name, obstacle in scene.obstacles.items():
                self.surroundings.add_obstacle(obstacle, f"obstacles.{name}", scene.directory)
        self._axes = range(grid.dim)
        self.cell_kind = np.full(grid.shape(None), kinds.OUTSIDE, dtype=np.uint8)
        self.face_kind = [grid.zeros_faces(axis, np.uint8) for axis in self._axes]
        self.openness = [np.ones(grid.shape(axis)) for axis in self._axes]
        self.narrow = None if self._cutter is None else [grid.zeros_faces(axis, bool) for axis in self._axes]
        self.index = grid.index
        self.extras: Extras | None = None
        self.volume: np.ndarray | None = None
        self.geometry_version = self.kinds_version = 0
        self._regions: tuple[int, Regions] | None = None
        self.slivers: Slivers | None = None
        self.cut_at = np.zeros((0, self.dim))
        self.facing = [grid.zeros_cells() for _ in self._axes] if self._cutter is not None else []
        self.surface = np.zeros((0, self.dim)), np.zeros((0, self.dim), dtype=np.int64)
        self._moves = self._cutter is not None and bool(scene.solids)
        self._new_blocks()
        self._pattern = pressure.Pattern(grid)
        self._assembled_for: tuple[int, float] | None = None
        self.flux_rows = self._pattern.indptr, self._pattern.indices, np.zeros(len(self._pattern.indices))
        self._block_pattern: tuple[np.ndarray, np.ndarray] | None = None
        self._new_pattern = True
        self._before: dict[str, Any] = {}

    def _new_blocks(self) -> None:
        """Make matrices and right-hand side for the present layout. Collective."""
        self.block = self.fluxes = new_block(self.comm, self.layout, self.layout)
        if self._moves:  # then slivers set the two apart
            self.block = new_block(self.comm, self.layout, self.layout)
        self.rhs = np.zeros(self.layout.n_local)

    def _uncover(self) -> None:
        """Start with what obstacles leave. Collective."""
        if self._cutter is None:
            self.immerse(None, None)
        else:
            self.cut(np.zeros((0, self.dim)), np.zeros((0, self.dim), dtype=np.int64))

    def _make_cutter(self) -> CutGrid | None:
        """Return what cuts the grid, if the scene has anything to cut it with. Collective."""
        scene = self.scene
        if not scene.solids and not scene.obstacles:
            return None
        from petfsi.fields.mac.projection.cutgrid import CutGrid
        from petfsi.geometry.obstacles import obstacle_surfaces

        surfaces = on_root(self.comm, lambda: obstacle_surfaces(scene))
        return CutGrid(self.grid, self.surroundings, surfaces)

    def immerse(self, inside: np.ndarray | None, crossed: list[np.ndarray] | None) -> None:
        """Take over which cells solids cover and which faces their surfaces cut. Collective.

        Parameters
        ----------
        inside : ndarray of uint8 or None
            Cell array of FLUID, SOLID and VOID, valid in all ghosts.
        crossed : list of ndarray of bool or None
            Face arrays, valid in all ghosts.
        """
        grid = self.grid
        cell_kind = kinds.merge_cells(self.surroundings.cell_kind, inside)
        changed = not np.array_equal(cell_kind, self.cell_kind)
        face_kind = []
        for axis in self._axes:
            cut = np.zeros(grid.shape(axis), dtype=bool) if crossed is None else np.asarray(crossed[axis], dtype=bool)
            kind = np.zeros(grid.shape(axis), dtype=np.uint8)
            kinds.classify_faces(cell_kind, self.surroundings.side_kind[axis], cut, kinds.STEP[axis], kind)
            # of the outermost faces one cell lies beyond the ghosts
            grid.exchange_faces(axis, kind)
            changed = changed or not np.array_equal(kind, self.face_kind[axis])
            face_kind.append(kind)
        if self.comm.allreduce(changed, op=MPI.LOR):
            self.cell_kind, self.face_kind = cell_kind, face_kind
            self.geometry_version += 1
            self._kinds_changed()

    def find_seams(self, points: np.ndarray, facets: np.ndarray) -> Seams:
        """Return where a closed surface meets itself around periodic axes. Not collective."""
        from petfsi.geometry.seams import find_seams

        grid = self.grid
        return find_seams(points, facets, grid.size, np.array(grid.periodic[: grid.dim]))

    def cut(
        self, points: np.ndarray, facets: np.ndarray, part: np.ndarray | None = None, seams: Seams | None = None
    ) -> tuple[Walls, Wet]:
        """Take over what a surface covers of cells and faces; return what it lets through, and bears. Collective.

        Parameters
        ----------
        points : ndarray, shape (n, dim)
            The same on all ranks.
        facets : ndarray of int, shape (m, dim)
            Segments or triangles with normals into the fluid.
        part : ndarray of int8, shape (m,), or None
            As in ``quadratic.Curved``.
        seams : Seams, optional
            Where the surface reaches around periodic axes. In the answer facets are numbered among its walls.
        """
        assert self._cutter is not None
        old_kind, old_cells, old_facing = self.face_kind, self.cell_kind, self.facing
        found = self._cutter.cut(points, facets, part, seams)
        changed = any(
            not np.array_equal(new, old)
            for new, old in zip([found.cell_kind, *found.face_kind], [self.cell_kind, *self.face_kind], strict=True)
        )
        if found.extras is not None or self.extras is not None:
            changed = changed or found.extras is None or not found.extras.same(self.extras)
        wider = self.narrow is None or any(map(np.any, map(np.not_equal, found.narrow, self.narrow)))
        changed, wider = self.comm.allreduce(np.array([changed, wider], dtype=int)) > 0
        self.narrow = found.narrow
        if changed:
            self._renumber(found)
            self.cell_kind, self.face_kind = found.cell_kind, found.face_kind
            self._kinds_changed()
        elif wider:
            self._reach_changed()
        self.openness, self.volume, self.extras = found.openness, found.volume, found.extras
        self.slivers = found.slivers if self._moves else None
        self.cut_at, still = found.points, self._cutter.obstacles
        self.surface = np.concatenate((points, still.points)), np.concatenate((facets, still.facets + len(points)))
        self.facing = found.facing
        self._divide(found.parts, old_kind, (old_cells != kinds.FLUID) | self._turned(old_facing))
        self.geometry_version += 1
        return found.walls, found.wet

    def _turned(self, before: list[np.ndarray]) -> np.ndarray:
        """Return the cells whose walls face the other way now: they belong to the water on the other side."""
        pairs = list(zip(before, self.facing, strict=True))
        along = sum(one * other for one, other in pairs)
        sizes = sum(one**2 for one, _ in pairs) * sum(other**2 for _, other in pairs)
        # to within 60 degrees; what is left where two sides cancel is round-off
        return (along < 0.0) & (along**2 > 0.25 * sizes) & (sizes > (FAINT * self.grid.face_area(0)) ** 4)

    def _remember(self, *more: str) -> None:
        """Keep what ``rewind`` puts back: attributes that are replaced, never changed in place."""
        self._before = {name: getattr(self, name) for name in (*REPLACED, *more)}

    def rewind(self) -> None:
        """Put the grid back to how it was covered before the step. Collective."""
        for name, value in self._before.items():
            setattr(self, name, value)
        self._before = {}
        self.geometry_version += 1
        self._kinds_changed()
        self._assembled_for, self._new_pattern, self._block_pattern = None, True, None

    def _renumber(self, found: Openings) -> None:
        """Take over the unknowns of split cells; the others keep their place. Collective."""
        self._new_pattern |= found.extras is not None or self.extras is not None
        self.extras, self.index = found.extras, found.index
        # an unknown that goes from one rank to another changes nothing on a third, which must take part
        if self.comm.allreduce(found.layout != self.layout, op=MPI.LOR):
            self.layout, self._block_pattern = found.layout, None
            self._new_blocks()

    def _kinds_changed(self) -> None:
        """Refresh what follows from the kinds. Collective."""
        self.kinds_version += 1
        kind_x, kind_y, kind_z = three(self.face_kind)
        self._active = pressure.active_cells(self.cell_kind, kind_x, kind_y, kind_z, self.dim == 2)
        self._reach_changed()

    def closed_regions(self, touched: np.ndarray | None) -> list[tuple[np.ndarray, bool]]:
        """Return the connected regions of fluid without an OPEN face, but for single cells. Collective.

        Parameters
        ----------
        touched : ndarray of bool or None
            This rank's unknowns that a coupling acts on.

        Returns
        -------
        list of (ndarray, bool)
            Per region 1 on its unknowns and 0 elsewhere (this rank's part), and whether any of them is touched.
        """
        if self._regions is None or self._regions[0] != self.kinds_version:
            linked = np.zeros_like(self._active)
            for axis in self._axes:
                acts = np.isin(self.face_kind[axis], (kinds.PRESSURE, kinds.OPEN, kinds.SPLIT))
                linked |= np.delete(acts, 0, axis) | np.delete(acts, -1, axis)
            found = find_regions(self.grid, self._active & linked, self.face_kind, self.layout, self.index, self.extras)
            self._regions = (self.kinds_version, found)
        regions = self._regions[1]
        return list(zip(regions.members, regions.touching(touched), strict=True))

    def volumes(self) -> np.ndarray:
        """Return the volume of fluid that belongs to each of this rank's unknowns, m^3 (m^2 in 2D)."""
        if self.volume is None:
            volume = self.grid.to_vec(self._active).astype(float)
        else:
            volume = self.grid.to_vec(self.volume)
        if self.extras is not None and self.volume is not None:
            whole = self.volume.copy()
            np.subtract.at(whole.reshape(-1), self.extras.cell, self.extras.volume)
            volume = np.concatenate((self.grid.to_vec(whole), self.extras.volume))
        return self.cell_volume * volume

    def _reach_changed(self) -> None:
        """Refresh what follows from where the flow can be read. Collective."""

    def _divide(self, parts: Parts, old_kind: list[np.ndarray], other: np.ndarray) -> None:
        """Take over what divided cells and faces consist of. Collective.

        Parameters
        ----------
        parts : Parts
        old_kind : list of ndarray of uint8
            Kinds of the faces before.
        other : ndarray of bool
            Cell array: which were no fluid before, or that on the other side of a wall.
        """

    def _assemble_block(self, factor: float) -> None:
        """Fill L, and L + L T L, for the step's factor (see ``transport``). Collective."""
        grid, pattern = self.grid, self._pattern
        c = factor / self.density * grid.cell_volume / grid.dx**2
        values = np.zeros(len(pattern.indices))
        arrays = (*three(self.face_kind), *three(self.open_sides.conducting(self.openness)))
        pressure.laplacian(self._active, *arrays, self.grid.owned_ranges(None), pattern.slot, c, values)
        rows = pattern.indptr, pattern.indices, values
        if self.extras is not None:
            rows = self.extras.block(pattern, values, self.layout, self.index, grid, c, self.open_sides.link_yields)
        set_csr(self.fluxes, *rows, new_pattern=self._new_pattern)
        self.pattern_version += self._new_pattern
        self._new_pattern = False
        self.flux_rows = rows
        if self.slivers is not None:
            self._fill_block(self.slivers, factor)
        self._assembled_for = (self.geometry_version, factor)
        self.n_assembled += 1

    def _fill_block(self, slivers: Slivers, factor: float) -> None:
        """Fill the block with L + L T L over the slivers with S < 0. Collective."""
        thin = np.flatnonzero(slivers.size < 0.0)
        weight = self.density / factor * slivers.size[thin]
        entries = outer_products(*self.flux_rows, *self.flux_rows, slivers.slot[thin], weight)
        rows = sum_csr(*self.flux_rows, *gather_triplets(self.comm, self.layout, *entries))
        known = self._block_pattern
        new = known is None or not all(map(np.array_equal, known, rows[:2]))
        set_csr(self.block, *rows, new_pattern=self.comm.allreduce(new, op=MPI.LOR))
        self._block_pattern = rows[:2]

    def spread(self, outflow: np.ndarray, only_thin: bool = True) -> np.ndarray:
        """Return L T times a net outflow of each of this rank's unknowns, m^3/s (m^2/s in 2D). Collective.

        Parameters
        ----------
        outflow : ndarray, shape (layout.n_local,)
        only_thin : bool
            Whether slivers with S > 0 are left out, as the system's rows leave them to the solid.
        """
        slivers = self.slivers
        assert slivers is not None and self._assembled_for is not None
        use = np.flatnonzero((slivers.size < 0.0) | (not only_thin))
        weight = self.density / self._assembled_for[1] * slivers.size[use] * outflow[slivers.slot[use]]
        n = len(outflow)
        column = np.arange(n + 1), np.zeros(n, dtype=np.int64), np.ones(n)
        i, _, values = outer_products(*self.flux_rows, *column, slivers.slot[use], weight)
        return gather_sums(self.comm, self.layout, i, values)
