"""An incompressible, inviscid fluid on a regular staggered grid."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.base import FluidField, Reader, Slab, scalar_slab
from petfsi.fields.mac import advect, kinds, pressure, views
from petfsi.fields.mac.extrapolate import FAR, Band
from petfsi.fields.mac.grid import MacGrid, three
from petfsi.fields.mac.regions import Regions, find_regions
from petfsi.fields.mac.sides import Surroundings, evaluate_at, periodic_axes, wrapped_points
from petfsi.fields.mac.transport import TRANSPORTS, Advection
from petfsi.petsc import new_block, set_csr
from petfsi.ranks import agreed
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Number, Scene


class MacFluid(FluidField):
    """A field whose unknown is the pressure of every cell of the grid.

    A step: ``predict`` carries velocity (and smoke) along the flow and adds forces, which gives ``velocity_star``; the
    solve finds p such that v_w = v* - (c/rho) G p has no divergence, with c of the integrator (see ``transport``);
    ``accept`` makes of v_w the velocity at the step's end and extrapolates it into faces where the flow is not
    determined.

    Attributes
    ----------
    grid : MacGrid
    density : float
    velocity, velocity_star, boundary_velocity : list of ndarray
        Face arrays per axis. Boundary velocities are those of WALL faces and, written by a coupling before
        ``accept``, of SOLID_FACE ones, ghosts included.
    pressure : ndarray
        Cell array, Pa; zero where it is not solved.
    smoke : ndarray or None
        Cell array.
    cell_kind : ndarray of uint8
        Cell array, see ``kinds``.
    face_kind : list of ndarray of uint8
        Face arrays, valid in all ghosts.
    geometry_version : int
        Grows when any kind changes on any rank.
    """

    name = "pressure"

    def __init__(self, comm: MPI.Comm, scene: Scene):
        assert scene.fluid is not None
        self.scene, self.comm = scene, comm
        fluid = scene.fluid
        periodic = periodic_axes(fluid.sides, scene.dim)
        if any(p and n < 3 for p, n in zip(periodic, fluid.cells, strict=True)):
            raise InputError(f"fluid.cells = {fluid.cells}: a periodic axis needs at least 3 cells")
        self.grid = grid = MacGrid(comm, fluid.origin, fluid.size, fluid.cells, periodic)
        self.dim, self.density, self.layout = grid.dim, fluid.density, grid.layout
        self.cell_volume = grid.cell_volume
        self.surroundings = Surroundings(grid, fluid.sides)
        advection = Advection(grid, self.surroundings, fluid.advection)
        self._transport = TRANSPORTS[scene.time.integrator](advection)
        for name, obstacle in scene.obstacles.items():
            self.surroundings.add_obstacle(obstacle, f"obstacles.{name}", scene.directory)

        self._axes = range(grid.dim)
        self.velocity = [grid.zeros_faces(axis) for axis in self._axes]
        self.velocity_star = [grid.zeros_faces(axis) for axis in self._axes]
        self.boundary_velocity = [grid.zeros_faces(axis) for axis in self._axes]
        self.pressure = grid.zeros_cells()
        self.smoke = None if fluid.smoke is None else grid.zeros_cells()
        self.cell_kind = np.full(grid.shape(None), FAR, dtype=np.uint8)
        self.face_kind = [grid.zeros_faces(axis, np.uint8) for axis in self._axes]
        self.geometry_version = 0
        self._bands = [Band(grid, axis) for axis in self._axes]
        self._smoke_band = None if self.smoke is None else Band(grid, None)
        gravity: list[Number] = scene.gravity or [0.0] * grid.dim
        self._gravity = [Expression(g, ("t",), key="gravity") for g in gravity]
        self._regions: tuple[int, Regions] | None = None

        self.block = new_block(comm, self.layout, self.layout)
        self.rhs = np.zeros(self.layout.n_local)
        self._pattern = pressure.Pattern(grid)
        self._assembled_for: tuple[int, float] | None = None
        self.immerse(None, None)
        self._start()

    def _start(self) -> None:
        """Set velocity and smoke as the scene says for time zero. Collective."""
        fluid = self.scene.fluid
        assert fluid is not None
        self.surroundings.evaluate(0.0)
        self.surroundings.prescribe(self.face_kind, self.boundary_velocity)
        if fluid.initial.velocity is not None:
            for axis, text in enumerate(fluid.initial.velocity):
                self._evaluate(text, "fluid.initial.velocity", self.velocity[axis], axis)
        for axis in self._axes:
            kind = self.face_kind[axis]
            self.velocity[axis][kind == kinds.DEAD] = 0.0
            wall = kind == kinds.WALL
            self.velocity[axis][wall] = self.boundary_velocity[axis][wall]
        if fluid.smoke is not None and self.smoke is not None:
            self._evaluate(fluid.smoke.initial, "fluid.smoke.initial", self.smoke, None)
            self.smoke[self.cell_kind != kinds.FLUID] = 0.0
        self._complete()

    def _evaluate(self, text: Number, key: str, array: np.ndarray, axis: int | None) -> None:
        """Fill the owned part of a local array with the values of an expression at time zero. Collective."""
        part = self.grid.owned(axis)
        index = tuple(i.ravel() for i in np.mgrid[part])
        expression, points = Expression(text, key=key), wrapped_points(self.grid, axis, index)
        values = agreed(self.comm, lambda: evaluate_at(expression, points, 0.0))
        array[part] = values.reshape(array[part].shape)

    # ---- geometry ---------------------------------------------------------------------------------------------

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
            self._geometry_changed()

    def _geometry_changed(self) -> None:
        """Refresh what follows from the kinds. Collective."""
        self.geometry_version += 1
        kind_x, kind_y, kind_z = three(self.face_kind)
        self._active = pressure.active_cells(self.cell_kind, kind_x, kind_y, kind_z, self.dim == 2)
        for axis in self._axes:
            self._bands[axis].rebuild(self.face_kind[axis] != kinds.DEAD)
        self._moved = [
            (band.layer != FAR) & (kind != kinds.WALL) & (kind != kinds.SOLID_FACE)
            for band, kind in zip(self._bands, self.face_kind, strict=True)
        ]
        if self._smoke_band is not None:
            self._smoke_band.rebuild(self.cell_kind == kinds.FLUID)
        self.surroundings.prescribe(self.face_kind, self.boundary_velocity)

    def closed_regions(self, touched: np.ndarray | None) -> list[tuple[np.ndarray, bool]]:
        """Return the connected regions of fluid without an OPEN face, but for single cells. Collective.

        Parameters
        ----------
        touched : ndarray of bool or None
            Cell array: cells that a coupling acts on.

        Returns
        -------
        list of (ndarray, bool)
            Per region 1 on its cells and 0 elsewhere (this rank's part, in PETSc's order), and whether any of its
            cells is touched.
        """
        if self._regions is None or self._regions[0] != self.geometry_version:
            linked = np.zeros_like(self._active)
            for axis in self._axes:
                acts = np.isin(self.face_kind[axis], (kinds.PRESSURE, kinds.OPEN))
                linked |= np.delete(acts, 0, axis) | np.delete(acts, -1, axis)
            found = find_regions(self.grid, self._active & linked, self.face_kind)
            self._regions = (self.geometry_version, found)
        regions = self._regions[1]
        return list(zip(regions.members, regions.touching(touched), strict=True))

    # ---- the step ---------------------------------------------------------------------------------------------

    def unknown(self) -> np.ndarray:
        """Return the pressure of this rank's cells, Pa, in PETSc's order."""
        return self.grid.to_vec(self.pressure)

    def predict(self, time: float, dt: float) -> None:
        """Carry velocity and smoke along, add gravity and buoyancy, open the jets: ``velocity_star``. Collective."""
        transport = self._transport
        transport.predict(self.velocity, self._moved, dt, self.velocity_star)
        moment, smoke = transport.moment(dt), self.smoke
        if self.smoke is not None and self._smoke_band is not None:
            old = self.smoke
            self.smoke = transport.carry_smoke(old, self.velocity, self._smoke_band.layer != FAR, dt)
            self._complete_cells(self.smoke)
            smoke = self.smoke if moment == dt else old + moment / dt * (self.smoke - old)
        self.surroundings.evaluate(time + moment)
        self.surroundings.prescribe_jets(self.face_kind, self.boundary_velocity)
        self._add_forces(time + moment, transport.factor(dt), smoke)

    def _add_forces(self, time: float, duration: float, smoke: np.ndarray | None) -> None:
        """Accelerate ``velocity_star`` as at ``time`` for ``duration`` and set it on WALL faces. Collective."""
        buoyancy = 0.0
        if smoke is not None and self.scene.fluid is not None and self.scene.fluid.smoke is not None:
            buoyancy = self.scene.fluid.smoke.buoyancy
        for axis in self._axes:
            star, kind = self.velocity_star[axis], self.face_kind[axis]
            dv = duration * float(self._gravity[axis](t=time))
            pressure.add_forces(
                star,
                self.boundary_velocity[axis],
                kind,
                kinds.STEP[axis],
                dv,
                self.pressure if smoke is None else smoke,
                -buoyancy * dv,
                self._part(axis),
            )
            self.grid.exchange_faces(axis, star, width=1)

    def assemble(self, time: float, dt: float) -> None:
        """Refresh L if the geometry or the step changed, the right-hand side and the scales. Collective."""
        grid = self.grid
        dx = grid.cell_volume ** (1.0 / self.dim)
        self.row_scale, self.col_scale = 1.0 / dx ** (self.dim - 1), self.density * dx / dt
        part = self._part(None)
        factor = self._transport.factor(dt)
        if self._assembled_for != (self.geometry_version, factor):
            c = factor / self.density * grid.cell_volume / grid.dx**2
            values = np.zeros(len(self._pattern.indices))
            kind_x, kind_y, kind_z = three(self.face_kind)
            pressure.laplacian(self._active, kind_x, kind_y, kind_z, part, self._pattern.slot, c, values)
            first = self._assembled_for is None
            set_csr(self.block, self._pattern.indptr, self._pattern.indices, values, new_pattern=first)
            self._assembled_for = (self.geometry_version, factor)
            self.n_assembled += 1
        self.rhs[:] = 0.0
        for axis in self._axes:
            pressure.known_inflow(
                self._active,
                self.velocity_star[axis],
                self.boundary_velocity[axis],
                self.face_kind[axis],
                kinds.STEP[axis],
                grid.face_area(axis),
                part,
                self.rhs,
            )

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the pressure and set the velocity that goes with it. Collective.

        Smoke has moved in ``predict`` already; here cells that are fluid only now get the mean of their neighbours.
        """
        grid, factor = self.grid, self._transport.factor(dt)
        grid.from_vec(x, self.pressure)
        grid.exchange_cells(self.pressure)
        solved = [np.zeros_like(v) for v in self.velocity]
        for axis in self._axes:
            pressure.project(
                self.velocity_star[axis],
                self.pressure,
                self.boundary_velocity[axis],
                self.face_kind[axis],
                kinds.STEP[axis],
                factor / (self.density * grid.dx[axis]),
                self._part(axis),
                solved[axis],
            )
        self._complete_faces(solved)
        self.velocity = self._transport.accept(self.velocity, solved, self.face_kind, dt, self._complete_faces)
        if self.smoke is not None:
            self._complete_cells(self.smoke)

    def _complete(self) -> None:
        """Fill ghosts, bands and what lies beyond the sides. Collective."""
        self._complete_faces(self.velocity)
        if self.smoke is not None:
            self._complete_cells(self.smoke)

    def _complete_faces(self, faces: list[np.ndarray]) -> None:
        for axis in self._axes:
            self.grid.exchange_faces(axis, faces[axis])
            self._bands[axis].fill(faces[axis])
            self.grid.fill_sides(faces[axis], axis)

    def _complete_cells(self, smoke: np.ndarray) -> None:
        assert self._smoke_band is not None
        self.grid.exchange_cells(smoke)
        self._smoke_band.fill(smoke)
        self.surroundings.fill_smoke(smoke)

    # ---- observation ------------------------------------------------------------------------------------------

    def cfl(self, dt: float) -> float:
        """Return the largest number of cells that the flow crosses in dt along an axis. Collective."""
        most = max(advect.largest(v) * dt / h for v, h in zip(self.velocity, self.grid.dx, strict=True))
        return self.comm.allreduce(most, op=MPI.MAX)

    def max_divergence(self) -> float:
        """Return the largest net outflow of a solved cell over the area of a (cubic) cell's face, m/s. Collective.

        Of the velocity that the last step solved for.
        """
        areas = np.array([self.grid.face_area(axis) for axis in self._axes])
        u, v, w = three(self._transport.solved(self.velocity))
        most = pressure.largest_outflow(self._active, u, v, w, areas, self._part(None))
        scale = self.grid.cell_volume ** ((self.dim - 1) / self.dim)
        return self.comm.allreduce(most, op=MPI.MAX) / scale

    def kinetic_energy(self) -> float:
        """Return the kinetic energy of the fluid cells, J (in 2D per metre of thickness). Collective."""
        part = self._part(None)
        total = sum(
            pressure.sum_of_squares(self.cell_kind, self.velocity[axis], kinds.STEP[axis], part) for axis in self._axes
        )
        return 0.5 * self.density * self.grid.cell_volume * self.comm.allreduce(total)

    def is_finite(self) -> bool:
        """Return whether this rank's velocity and pressure are finite. Not collective."""
        return all(advect.all_finite(a) for a in (*self.velocity, self.pressure))

    def output(self) -> dict[str, Slab]:
        """Return cell-centred velocity (.., dim), pressure, kind and smoke of this rank's cells."""
        return views.output(self._view())

    def probe(self, quantity: str, at: list[float]) -> float | np.ndarray:
        """Return ``velocity``, ``pressure`` or ``smoke`` at a point, interpolated among fluid cells. Collective."""
        return views.probe(self._view(), quantity, at)

    def _view(self) -> views.View:
        return views.View(self.grid, self.cell_kind, self.velocity, self.pressure, self.smoke)

    # ---- checkpoint -------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Slab]:
        """Return velocity, kinds, pressure, smoke and the transport's past: all that the next step reads."""
        arrays = {name: self.grid.slab(array, axis) for name, array, axis in [*self._stored(), *self._stored_past()]}
        return arrays | ({"past_dt": scalar_slab(self.comm, self._transport.past_dt)} if self._transport.past else {})

    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks. Collective."""
        for name, array, axis in [*self._stored(), *self._stored_past()]:
            self.grid.read_slab(read, name, array, axis)
            self.grid.halo.exchange(array, axis)
        for _, array, axis in self._stored_past():
            self.grid.fill_sides(array, axis)
        if self._transport.past:
            self._transport.past_dt = float(read("past_dt", (0,), (1,))[0])
        self._geometry_changed()
        self._complete()

    def _stored_past(self) -> list[tuple[str, np.ndarray, int | None]]:
        past = self._transport.past
        return [(f"{name}_{'xyz'[axis]}", past[name][axis], axis) for name in past for axis in self._axes]

    def _stored(self) -> list[tuple[str, np.ndarray, int | None]]:
        """Return the names, local arrays and axes of what a checkpoint holds."""
        stored: list[tuple[str, np.ndarray, int | None]] = [
            ("pressure", self.pressure, None),
            ("cell_kind", self.cell_kind, None),
        ]
        for axis, letter in zip(self._axes, "xyz", strict=False):
            stored.append((f"velocity_{letter}", self.velocity[axis], axis))
            stored.append((f"face_kind_{letter}", self.face_kind[axis], axis))
        if self.smoke is not None:
            stored.append(("smoke", self.smoke, None))
        return stored

    # ---- for the kernels --------------------------------------------------------------------------------------

    def _part(self, axis: int | None) -> tuple[tuple[int, int], ...]:
        """Return the owned ranges of faces of ``axis`` (cells: None)."""
        return tuple((s.start, s.stop) for s in self.grid.owned(axis))
