"""What accelerates a fluid on a grid besides its pressure: gravity, and the buoyancy of smoke."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from petfsi.fields.mac import budget
from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.projection import pressure
from petfsi.fields.mac.projection.extras import Extras
from petfsi.fields.mac.projection.open_sides import OpenSides
from petfsi.fields.mac.projection.weight import Weight
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Number


class BodyForces:
    """Accelerates faces by gravity and buoyancy.

    Parameters
    ----------
    grid : MacGrid
    scene : Scene
    density : float
        kg/m^3.

    Attributes
    ----------
    weight : Weight or None
        The pressure of the fluid at rest, where that is split off.
    last : budget.Forces or None
        Of the last step.
    """

    def __init__(self, grid: MacGrid, scene: Scene, density: float) -> None:
        self.grid = grid
        given: list[Number] = scene.gravity or [0.0] * grid.dim
        self._gravity = [Expression(g, ("t",), f"gravity.{n}") for n, g in enumerate(given)]
        smoke = None if scene.fluid is None else scene.fluid.smoke
        self._buoyancy = 0.0 if smoke is None else smoke.buoyancy
        exact = scene.cuts_cells and scene.gravity is not None
        self.weight = Weight(grid, density, self._gravity) if exact else None
        self.last: budget.Forces | None = None

    def at(self, time: float) -> np.ndarray:
        """Return gravity, m/s^2."""
        return np.array([float(g(t=time)) for g in self._gravity])

    def push(
        self, star: Faces, time: float, duration: float, smoke: np.ndarray | None, further: np.ndarray,
        face_kind: list[np.ndarray], given: list[np.ndarray], open_sides: OpenSides, sheets: Sheets | None,
    ) -> None:  # fmt: skip
        """Accelerate a velocity and set it on WALL faces. Collective.

        Parameters
        ----------
        star : Faces
        time, duration : float
            The forces are those at ``time``, and act so long, s.
        smoke : ndarray or None
            Cell array.
        further : ndarray
            That of further pieces of divided cells.
        face_kind, given : list of ndarray
            Face arrays; the second is the velocity of WALL faces.
        open_sides : OpenSides
        sheets : Sheets or None
        """
        gravity, weight, buoyancy = self.at(time), self.weight, 0.0 if smoke is None else self._buoyancy
        local = sheets.local if sheets is not None and len(sheets.table) else None
        link_smoke = None if smoke is None or local is None else local.at_cells(smoke, further)
        heavy = [weight is None or p for p in self.grid.periodic]
        self.last = forces = budget.Forces.of(gravity, heavy, buoyancy, smoke, link_smoke)
        before = None if local is None else local.at_faces(star)
        open_sides.evaluate(time, gravity)
        open_sides.push(star, duration)
        if weight is not None:
            weight.at(time)
            weight.push_open_sides(star, duration)
        if local is not None and before is not None:
            pushed = local.gathered(local.at_faces(star) - before, local.link)
            if forces is not None:
                pushed = pushed + duration * forces.on_links(local.table.axis, np.arange(len(pushed)))
            star.parts = star.parts + pushed
        for axis, (v, kind) in enumerate(zip(star, face_kind, strict=True)):
            dv = duration * gravity[axis]
            part = self.grid.owned_ranges(axis)
            plain = dv if weight is None or self.grid.periodic[axis] else 0.0
            lifted = v if smoke is None else smoke  # without smoke nothing is lifted, and this not read
            pressure.add_forces(v, given[axis], kind, kinds.STEP[axis], plain, lifted, -buoyancy * dv, part)
            self.grid.exchange_faces(axis, v, width=1)

    def power(
        self, density: float, velocity: Faces, further: np.ndarray, face_kind: list[np.ndarray],
        openness: list[np.ndarray], extras: Extras | None, sheets: Sheets | None,
    ) -> float:  # fmt: skip
        """Return this rank's share of the power of the last step's forces at a velocity, W.

        Collective, without a reduction: smoke at divided faces is gathered from all ranks.
        """
        forces = self.last
        if forces is None:
            return 0.0
        if forces.smoke is not None:  # links may have changed since they were pushed
            local = sheets.local if sheets is not None and len(sheets.table) else None
            now = None if local is None else local.at_cells(forces.smoke, further)
            forces = replace(forces, link_smoke=now)
        return budget.power(self.grid, density, velocity, face_kind, openness, extras, forces)
