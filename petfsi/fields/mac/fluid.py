"""An incompressible, inviscid fluid on a regular staggered grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from petfsi.fields.base import Stock, Work
from petfsi.fields.mac import budget, views
from petfsi.fields.mac.body_forces import BodyForces
from petfsi.fields.mac.carrying import advect
from petfsi.fields.mac.carrying.extension import Extension
from petfsi.fields.mac.carrying.lineage import Lineage
from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.carrying.transport import Advection, transport
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces, each
from petfsi.fields.mac.grid.initial import set_initial
from petfsi.fields.mac.projection import pressure
from petfsi.fields.mac.projection.covered import CoveredGrid
from petfsi.fields.mac.projection.operators import Operators
from petfsi.fields.mac.projection.regions import box_around
from petfsi.fields.mac.saved import Saved, parts_slabs, read_parts
from petfsi.fields.mac.walls.parts import Parts
from petfsi.fields.replicated import read_whole, whole_slab
from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.stored import refuse
from petfsi.scene import fluids
from petfsi.scene.schema import Scene
from petfsi.scene.side_notes import side_notes

if TYPE_CHECKING:
    from petfsi.fields.mac.projection.cutgrid import Openings


class MacFluid(CoveredGrid):
    """A field whose unknown is the pressure of every cell of the grid.

    A step: ``predict`` carries velocity (and smoke) along the flow and adds forces, which gives ``velocity_star``; the
    solve finds p such that v_w = v* - (c/rho) G p has no divergence, with c of the integrator (see ``transport``);
    ``accept`` makes of v_w the velocity at the step's end and extrapolates it into faces where the flow is not
    determined.

    Attributes
    ----------
    grid : MacGrid
    density : float
    velocity, velocity_star : Faces
    boundary_velocity : list of ndarray
        Face arrays per axis. Boundary velocities are those of WALL faces and, written by a coupling before
        ``accept``, of SOLID_FACE ones, ghosts included.
    pressure : ndarray
        Cell array, Pa; zero where it is not solved.
    smoke : ndarray or None
        Cell array.
    smoke_parts : ndarray
        That of the further pieces of divided cells, on every rank.
    sheets : Sheets or None
        Divided cells and faces; None where nothing cuts cells.
    """

    name = "pressure"

    def __init__(self, comm: MPI.Comm, scene: Scene):
        super().__init__(comm, scene)
        grid, fluid = self.grid, scene.fluid
        assert isinstance(fluid, fluids.MacFluid)
        advection = Advection(grid, self.surroundings, fluid.advection)
        self._transport = transport(scene.time.scheme, advection)
        self.velocity = Faces(grid.zeros_faces(axis) for axis in self._axes)
        self.velocity_star = Faces(grid.zeros_faces(axis) for axis in self._axes)
        self.boundary_velocity = [grid.zeros_faces(axis) for axis in self._axes]
        self.pressure = grid.zeros_cells()
        self.smoke = None if fluid.smoke is None else grid.zeros_cells()
        self.smoke_parts = np.zeros(0)
        self.sheets: Sheets | None = None
        self._extra_pressure = np.zeros(0)
        self._other_pressure: np.ndarray | None = None
        self._weighed = True  # no step has pushed anything yet
        self._extension = Extension(grid, self.surroundings, self.smoke is not None)
        self._body_forces = BodyForces(grid, scene, self.density)
        self.weight = self._body_forces.weight
        self._uncover()
        self._start()
        self._notes = side_notes(scene) + self._look_at_jets()

    def _look_at_jets(self) -> list[str]:
        """Refuse jets that obstacles cover altogether; return notes of those that they cover in part. Collective."""
        around = self.surroundings
        if not around.has_jets or not self.scene.obstacles:
            return []
        for jet in around.jets:
            jet.open_fully()
        opened = {key: float(flow.sum()) for key, flow in self.inflows().items()}
        around.evaluate(0.0)
        return around.notes_on_covered(opened)

    def _start(self) -> None:
        """Set velocity and smoke as the scene says for time zero. Collective."""
        fluid = self.scene.fluid
        assert fluid is not None
        self.surroundings.evaluate(0.0)
        self.surroundings.prescribe(self.face_kind, self.boundary_velocity)
        if fluid.initial.velocity is not None:
            for axis, text in enumerate(fluid.initial.velocity):
                set_initial(self.grid, text, "fluid.initial.velocity", self.velocity[axis], axis)
        for axis in self._axes:
            kind = self.face_kind[axis]
            self.velocity[axis][kind == kinds.DEAD] = 0.0
            wall = kind == kinds.WALL
            self.velocity[axis][wall] = self.boundary_velocity[axis][wall]
        if fluid.smoke is not None and self.smoke is not None:
            set_initial(self.grid, fluid.smoke.initial, "fluid.smoke.initial", self.smoke, None)
            self.smoke[self.cell_kind != kinds.FLUID] = 0.0
            self._extension.cells(self.smoke)
        self._transport.carried = self._extend(self.velocity, divided=False)
        self.velocity_star = each(np.copy, self.velocity)
        if self.sheets is not None:
            whole = self._sheets_of(Parts.none())
            self._go_on(Lineage(self.grid, whole, self.sheets, self.face_kind))
            self._transport.carried = self._extend(self.velocity)

    # ---- the step ---------------------------------------------------------------------------------------------

    def _renumber(self, found: Openings) -> None:
        """Take over the unknowns of split cells with the pressures that their cells had. Collective."""
        super()._renumber(found)
        self.forget()

    def forget(self) -> None:
        """Forget what a resumed run could not know: which pressures further pieces have, but by their cells."""
        known = self.pressure if self._other_pressure is None else self._other_pressure
        self._extra_pressure = np.zeros(0) if self.extras is None else known.reshape(-1)[self.extras.cell]

    def _kinds_changed(self) -> None:
        """Refresh the smoke's band and prescribed velocities, too. Collective."""
        super()._kinds_changed()
        self._extension.rebuild_cells(self.cell_kind)
        self.surroundings.prescribe(self.face_kind, self.boundary_velocity)

    def _reach_changed(self) -> None:
        """Refresh the velocity's bands. Collective."""
        self._extension.rebuild_faces(self.face_kind, self.narrow)

    def _divide(self, parts: Parts, old_kind: list[np.ndarray], other: np.ndarray) -> None:
        """Let divided faces and cells go on with what those had that they come from. Collective."""
        old, grid = self.sheets, self.grid
        if self.surroundings.has_jets:  # what is open of a face may be so to a jet or not
            self.surroundings.prescribe_jets(self.face_kind, self.boundary_velocity)
        self.sheets = self._sheets_of(parts)
        self._transport.advection.sheets = self.sheets
        if old is None:
            return
        self.sheets.mark_uncovered(old, old_kind, other)
        if len(parts) or len(old.table):
            self._go_on(Lineage(grid, old, self.sheets, old_kind))
        if old.anywhere or self.sheets.anywhere:
            self._renew(self.sheets)

    def _renew(self, sheets: Sheets) -> None:
        """Give what thin walls have just uncovered the values of its own side. Collective."""
        found = np.array([any(map(np.any, sheets.fresh)), sheets.flipped.any()], dtype=int)
        faces_are, cells_are = self.comm.allreduce(found) > 0

        def renewed(faces: Faces) -> Faces:
            return sheets.renew_faces(faces, sheets.fresh)

        if faces_are:
            self.velocity, self.velocity_star = renewed(self.velocity), renewed(self.velocity_star)
            self._transport.change(renewed)
        if cells_are and self.smoke is not None:
            self.smoke = sheets.renew_smoke(self.smoke, self.smoke_parts, sheets.flipped)
            self._extension.cells(self.smoke)

    def _sheets_of(self, parts: Parts) -> Sheets:
        assert self.narrow is not None
        around = self.surroundings
        narrow = around.not_read(self.narrow)
        return Sheets(self.grid, parts, self.face_kind, narrow, self.cell_kind, around.behind_jets)

    def _go_on(self, lineage: Lineage) -> None:
        """Take over velocities and smoke of the former parts. Collective."""
        self.velocity, self.velocity_star = lineage.faces(self.velocity), lineage.faces(self.velocity_star)
        self._transport.change(lineage.faces)
        if self.smoke is not None:
            assert self.volume is not None
            self.smoke, self.smoke_parts = lineage.smoke(self.smoke, self.smoke_parts, self.volume)

    def rewind(self) -> None:
        """Put everything back to before the step. Collective."""
        super().rewind()
        self._transport.rewind()
        self._transport.advection.sheets = self.sheets

    def unknown(self) -> np.ndarray:
        """Return the pressure of this rank's cells and of its extra unknowns, Pa, in PETSc's order.

        Where there is a ``weight``, less that of the fluid at rest.
        """
        cells, extra = self.grid.to_vec(self.pressure), self._extra_pressure
        if self.weight is not None:
            rest = self.weight.pressure()
            cells = cells - self.grid.to_vec(np.where(self._active, rest, 0.0))
            extra = extra if self.extras is None else extra - rest.reshape(-1)[self.extras.cell]
        return np.concatenate((cells, extra))

    def factor(self, dt: float) -> float:
        """Return c, how long an acceleration acts on the solution of a step of dt, s."""
        return self._transport.factor(dt)

    def predict(self, time: float, dt: float) -> None:
        """Carry velocity and smoke along, add gravity and buoyancy, open the jets: ``velocity_star``. Collective."""
        self._remember("smoke", "_extra_pressure", "velocity", "smoke_parts", "sheets")
        transport = self._transport
        transport.remember()
        moment, smoke, further = transport.moment(dt), self.smoke, self.smoke_parts
        self.surroundings.evaluate(*transport.instants(time, dt))
        if self.surroundings.carries_along:
            for faces in transport.read():
                self.surroundings.fill_along(faces)
        transport.predict(self._extension.moved, dt, self.velocity_star, self._extend)
        if self.smoke is not None:
            old, parts = self.smoke, self.smoke_parts
            self.smoke, self.smoke_parts = transport.carry_smoke(old, parts, self._extension.moved_smoke, dt)
            self._extension.cells(self.smoke)
            smoke = self.smoke if moment == dt else old + moment / dt * (self.smoke - old)
            further = self.smoke_parts if moment == dt else parts + moment / dt * (self.smoke_parts - parts)
        self.surroundings.prescribe_jets(self.face_kind, self.boundary_velocity)
        self._body_forces.push(
            self.velocity_star, time + moment, transport.factor(dt), smoke, further, self.face_kind,
            self.boundary_velocity, self.open_sides, self.sheets,
        )  # fmt: skip
        self._weighed = not self.open_sides.total

    def assemble(self, time: float, dt: float) -> None:
        """Refresh L if the geometry or the step changed, the right-hand side and the scales. Collective."""
        grid = self.grid
        dx = grid.cell_volume ** (1.0 / self.dim)
        self.row_scale, self.col_scale = 1.0 / dx ** (self.dim - 1), self.density * dx / dt
        factor = self.factor(dt)
        if not self._weighed:  # the cells are cut as this step sees them by now
            table = None if self.sheets is None else self.sheets.table
            carried = self._transport.carried
            self.open_sides.weigh(carried, self.velocity_star, self.face_kind, factor, table)
            self._weighed, self._assembled_for = True, None
        if self._assembled_for != (self.geometry_version, factor):
            self._assemble_block(factor)
        self.rhs[:] = -self._operators().outflow(self.velocity_star)
        if self.source is not None:
            self.rhs += self.source

    def net_outflow(self) -> np.ndarray:
        """Return by unknown what leaves it at the present velocity but through solids' walls."""
        return self._operators().outflow(self.velocity)

    def push(self, x: np.ndarray, dt: float) -> None:
        """Change the present velocity as the pressure x would in a first step of dt. Collective."""
        p = self.grid.zeros_cells()
        self.grid.from_vec(x[: self.grid.layout.n_local], p)
        self.grid.exchange_cells(p)
        self.velocity_star = each(np.copy, self.velocity)
        self.velocity = self._projected(p, x, self._transport.factor(dt))
        self._transport.carried = self._extend(self.velocity)

    def inflow(self) -> np.ndarray | None:
        """Return by unknown what jets let in, m^3/s (m^2/s in 2D); None if there are none. Not collective."""
        if not self.surroundings.has_jets:
            return None
        return -self._operators().outflow(each(np.zeros_like, self.velocity_star))

    def inflows(self) -> dict[str, np.ndarray]:
        """Return by unknown what each side with jets lets in. Not collective."""
        found: dict[str, np.ndarray] = {}
        given, still = self.boundary_velocity, each(np.zeros_like, self.velocity_star)
        for key in self.surroundings.jet_keys:
            self.boundary_velocity = [np.zeros_like(v) for v in given]
            self.surroundings.prescribe_jets(self.face_kind, self.boundary_velocity, key)
            found[key] = -self._operators().outflow(still)
        self.boundary_velocity = given
        return found

    def rehearse(self, time: float, dt: float) -> None:
        """Give jets the velocities that they have in a step from ``time``; see that what else drives has values.

        Collective.
        """
        moment = time + self._transport.moment(dt)
        self.surroundings.evaluate(*self._transport.instants(time, dt))
        self.surroundings.prescribe_jets(self.face_kind, self.boundary_velocity)
        if dt > 0.0:
            self.open_sides.check(moment)
            self._body_forces.at(moment)

    def place(self, member: np.ndarray) -> str:
        """Return the box around the cells of some unknowns. Collective."""
        return box_around(self.grid, self.extras, member)

    def rhs_round_off(self) -> float:
        """Return eps ||A v*||: net outflows are differences of what goes in and out. Collective."""
        stars = [star[self.grid.owned(axis)] for axis, star in enumerate(self.velocity_star)]
        squares = sum(self.grid.face_area(axis) ** 2 * float(np.vdot(v, v)) for axis, v in enumerate(stars))
        return float(np.finfo(float).eps) * self.row_scale * float(np.sqrt(self.comm.allreduce(squares)))

    def round_off(self, x: np.ndarray) -> float:
        """Return eps (||L|| ||p|| + ||A v*||). Collective."""
        return super().round_off(x) + self.rhs_round_off()

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Take the pressure and set the velocity that goes with it. Collective.

        Smoke has moved in ``predict`` already; here cells that are fluid only now get the mean of their neighbours.
        """
        grid = self.grid
        grid.from_vec(x[: grid.layout.n_local], self.pressure)
        grid.exchange_cells(self.pressure)
        solved = self._projected(self.pressure, x, self._transport.factor(dt))
        if self.extras is not None:
            self._extra_pressure = x[grid.layout.n_local :].copy()
        if self.weight is not None:
            rest = self.weight.pressure()
            self.pressure += np.where(self._active, rest, 0.0)
            if self.extras is not None:
                self._extra_pressure += rest.reshape(-1)[self.extras.cell]
        if self.extras is not None or self._other_pressure is not None:
            self._remember_extras()
        self.velocity = self._transport.accept(solved, self.face_kind, dt, self._extend)
        if self.smoke is not None:
            self._extension.cells(self.smoke)

    def _projected(self, p: np.ndarray, x: np.ndarray, factor: float) -> Faces:
        """Return v_w = v* - (factor/rho) G p on owned faces, see ``transport`` and ``Operators``. Collective."""
        local, c = None if self.sheets is None else self.sheets.local, factor / (self.density * self.grid.dx)
        return self._operators().projected(self.velocity_star, p, x, c, local)

    def _operators(self) -> Operators:
        return Operators(
            self.grid, self.layout, self.index, self._active, self.face_kind, self.openness, self.boundary_velocity,
            self.extras, self.open_sides,
        )  # fmt: skip

    def _remember_extras(self) -> None:
        """Keep the pressure of the second piece of split cells where the next step's cells can find it."""
        self._other_pressure = self.pressure.copy()
        if self.extras is not None:
            second = self.extras.piece == 1
            self._other_pressure.reshape(-1)[self.extras.cell[second]] = self._extra_pressure[second]

    def _extend(self, faces: Faces, divided: bool = True) -> Faces:
        """Fill ghosts, bands and what lies beyond the sides; return copies that narrow faces are not read from.

        Without any such faces the arrays themselves are returned. What is not ``divided`` has no parts of its own
        near sheets yet. Collective.
        """
        slits: list[np.ndarray] = []
        if self.narrow is not None:
            pairs = zip(self.openness, self.face_kind, strict=True)
            slits = [(openness < pressure.SLIT) & (kind == kinds.PRESSURE) for openness, kind in pairs]
        return self._extension.faces(faces, self.narrow, slits, self.sheets if divided else None)

    # ---- observation ------------------------------------------------------------------------------------------

    @property
    def notes(self) -> list[str]:
        """What a user should know of the sides."""
        return self._notes

    def stock(self) -> Stock:
        """Return this rank's share of momentum and kinetic energy of the faces that the pressure acts on.

        A face has the mass rho alpha_f A_f dx, one at an open side half of it. The velocity is that after the step's
        kick, see ``transport``.
        """
        velocity = self._transport.kicked(self.velocity)
        stock = budget.stock(self.grid, self.density, velocity, self.face_kind, self.openness, self.extras)
        if self.slivers is None:
            return stock
        flow = self._operators().outflow_of(self.slivers.slot, velocity)
        pushed = self.density * self.slivers.size * flow
        kinetic = 0.5 * float(pushed @ flow)
        return Stock(stock.momentum + pushed @ self.slivers.normal, stock.kinetic + kinetic)

    def power(self) -> Work:
        """Return this rank's share of the power of gravity and of what comes through sides, see ``budget``.

        Collective, without a reduction.
        """
        velocity, faces = self._transport.solved(self.velocity), (self.face_kind, self.openness)
        gravity = self._body_forces.power(self.density, velocity, self.smoke_parts, *faces, self.extras, self.sheets)
        into = budget.inflow(
            self.grid, self.density, velocity, *faces, self.pressure, self._active, self.weight, self.surroundings,
            self.open_sides, self.extras, self._extra_pressure,
        )  # fmt: skip
        return Work(gravity=gravity, boundary=into)

    def cells_slab(self, values: np.ndarray) -> Slab:
        """Return a value per cell, in the DMDA's order, as a piece of a global array."""
        array = self.grid.zeros_cells()
        self.grid.from_vec(values, array)
        return self.grid.slab(array, None)

    def read_cells(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``cells_slab`` stored. Collective."""
        array = self.grid.zeros_cells()
        self.grid.read_slab(read, name, array, None)
        return self.grid.to_vec(array)

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
        arrays = self.cell_kind, self.velocity, self.pressure, self.smoke, self.face_kind
        return views.View(self.grid, *arrays, self.sheets, self.velocity.parts, self.surface)

    # ---- checkpoint -------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Slab]:
        """Return velocity, kinds, pressure, smoke and the transport's past: all that the next step reads."""
        arrays = self._saved().slabs()
        if self.sheets is None:
            return arrays
        rank = self.comm.rank
        on_parts = parts_slabs(rank, self.sheets.table, self.velocity, self.smoke_parts, self._transport)
        return arrays | on_parts | {"cut_at": whole_slab(rank, self.cut_at.ravel())}

    def _saved(self) -> Saved:
        """Return what a checkpoint holds of the grid's arrays."""
        if self._moves and self._other_pressure is None:
            self._other_pressure = self.pressure.copy()
        return Saved(
            self.grid, self.pressure, self._other_pressure if self._moves else None, self.cell_kind, self.velocity,
            self.face_kind, self.smoke, self.narrow, self.facing, self._transport,
        )  # fmt: skip

    def _restore_parts(self, read: Reader) -> None:
        """Take back divided cells and faces, and what is on them; kinds are back already. Collective."""
        table = Parts.restored(self.grid, read)
        self.sheets = self._sheets_of(table)
        self._transport.advection.sheets = self.sheets
        n_pieces = 0 if self.smoke is None else len(table.cell)
        self.smoke_parts = read_parts(read, table, self.velocity, n_pieces, self._transport)
        self.cut_at = read_whole(read, "cut_at", self.cut_at.size).reshape(-1, self.dim)

    def restore(self, read: Reader) -> None:
        """Take the state back from a checkpoint, on any number of ranks. Collective."""
        transport = self._transport
        transport.carried = self.velocity if self.narrow is None else each(np.copy, self.velocity)
        saved = self._saved()
        saved.read(read)
        refuse(self.comm, saved.faults())
        for arrays in (self.velocity, transport.carried, *transport.past.values()):
            for axis in self._axes:
                self.grid.fill_sides(arrays[axis], axis)
        self.geometry_version += 1
        self._new_pattern = True  # the solver may hold that of the scene's start
        self._kinds_changed()
        if self.sheets is not None:
            self._restore_parts(read)
            self.forget()
        if self.smoke is not None:
            self._extension.cells(self.smoke)
