"""The net outflow of unknowns, and the gradient of their pressures that makes a velocity free of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.projection import pressure
from petfsi.fields.mac.projection.extras import Extras
from petfsi.fields.mac.projection.open_sides import OpenSides
from petfsi.fields.mac.walls.local_parts import LocalParts
from petfsi.petsc import Layout


@dataclass(frozen=True)
class Operators:
    """Divergence and gradient on a grid as it is covered at this moment.

    Attributes
    ----------
    layout : Layout
        Of the unknowns; those of cells come first.
    index, active : ndarray
        Cell arrays of the unknowns' global numbers, and of where the pressure is solved.
    face_kind, openness, given : list of ndarray
        Face arrays; the last is the velocity of faces where it is given.
    extras : Extras or None
    open_sides : OpenSides
    """

    grid: MacGrid
    layout: Layout
    index: np.ndarray
    active: np.ndarray
    face_kind: list[np.ndarray]
    openness: list[np.ndarray]
    given: list[np.ndarray]
    extras: Extras | None
    open_sides: OpenSides

    @property
    def _areas(self) -> np.ndarray:
        return np.array([self.grid.face_area(axis) for axis in range(self.grid.dim)])

    def outflow(self, velocity: Faces) -> np.ndarray:
        """Return the net outflow of each of this rank's unknowns through its faces, m^3/s (m^2/s in 2D)."""
        grid, areas = self.grid, self._areas
        inflow, cells, own = np.zeros(self.layout.n_local), np.zeros(grid.owned_shape), grid.owned(None)
        for axis, v in enumerate(velocity):
            through = np.empty_like(v)
            faces = v, self.given[axis], self.face_kind[axis], self.openness[axis], through
            pressure.known_flows(*(array.reshape(-1) for array in faces))
            above = tuple(slice(s.start + 1, s.stop + 1) if b == axis else s for b, s in enumerate(own))
            cells += areas[axis] * (through[own] - through[above])
        cells[~self.active[own]] = 0.0
        inflow[: grid.layout.n_local] = cells.ravel(order="F")
        if self.extras is not None:
            self.extras.add_inflow(velocity.parts, self.given, areas, self.layout, inflow)
        return -inflow

    def outflow_of(self, unknowns: np.ndarray, velocity: Faces) -> np.ndarray:
        """Return the same for some unknowns, by their local numbers."""
        inflow, areas = np.zeros(self.layout.n_local), self._areas
        cells = unknowns[unknowns < self.grid.layout.n_local]
        through = np.zeros(len(cells))
        for axis, v in enumerate(velocity):
            pressure.known_inflow_of(
                cells, v, self.given[axis], self.face_kind[axis], self.openness[axis], kinds.STEP[axis], areas[axis],
                self.grid.owned_ranges(None), through,
            )  # fmt: skip
        inflow[cells] = through
        if self.extras is not None:
            self.extras.add_inflow(velocity.parts, self.given, areas, self.layout, inflow)
        return -inflow[unknowns]

    def projected(self, star: Faces, p: np.ndarray, x: np.ndarray, c: np.ndarray, local: LocalParts | None) -> Faces:
        """Return v* less c times the differences of pressures on owned faces. Collective.

        Parameters
        ----------
        star : Faces
            v*.
        p : ndarray
            Pressure, Pa, a cell array with its ghosts.
        x : ndarray
            The same by unknown, with further pieces' at the end.
        c : ndarray, shape (dim,)
            By axis, m/(s Pa).
        local : LocalParts or None
            What divided faces and cells consist of here.
        """
        grid = self.grid
        solved = Faces(np.zeros_like(v) for v in star)
        for axis, v in enumerate(star):
            pressure.project(
                v, p, self.given[axis], self.face_kind[axis], kinds.STEP[axis], c[axis], grid.owned_ranges(axis),
                solved[axis],
            )  # fmt: skip
        if self.open_sides.total:
            self.open_sides.relax(solved, star, self.face_kind)
        if self.extras is not None:
            assert local is not None
            extras, n_cells = self.extras, grid.layout.n_local
            parts = extras.project(
                star.parts, x[n_cells:], self.layout.start + n_cells, p, self.index, c, grid.comm,
                self.open_sides.link_yields,
            )  # fmt: skip
            solved.parts = local.gathered(parts, extras.row[extras.owned])
            local.mean_into(solved, solved.parts)
        return solved
