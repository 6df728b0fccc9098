"""Velocity and smoke beyond where the flow is determined: in ghosts, in bands around it, and outside the sides."""

from __future__ import annotations

import numpy as np

from petfsi.fields.mac.carrying.extrapolate import FAR, Band
from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.grid.sides import Surroundings


class Extension:
    """Extends what a fluid carries along to where it is read from.

    Parameters
    ----------
    grid : MacGrid
    surroundings : Surroundings
    has_smoke : bool

    Attributes
    ----------
    moved : list of ndarray of bool
        Face arrays: where velocities are carried along.
    """

    def __init__(self, grid: MacGrid, surroundings: Surroundings, has_smoke: bool) -> None:
        self.grid, self.surroundings = grid, surroundings
        self._bands = [Band(grid, axis) for axis in range(grid.dim)]
        self._smoke_band = Band(grid, None) if has_smoke else None
        self.moved: list[np.ndarray] = []

    def rebuild_cells(self, cell_kind: np.ndarray) -> None:
        """Find the smoke's band anew. Collective."""
        if self._smoke_band is not None:
            self._smoke_band.rebuild(cell_kind == kinds.FLUID)

    def rebuild_faces(self, face_kind: list[np.ndarray], narrow: list[np.ndarray] | None) -> None:
        """Find the velocity's bands anew. Collective."""
        for axis, band in enumerate(self._bands):
            known = face_kind[axis] != kinds.DEAD
            band.rebuild(known if narrow is None else known & ~narrow[axis])
        self.moved = [
            (band.layer != FAR) & (kind != kinds.WALL) & (kind != kinds.SOLID_FACE)
            for band, kind in zip(self._bands, face_kind, strict=True)
        ]

    @property
    def moved_smoke(self) -> np.ndarray:
        """Cell array: where smoke is carried along."""
        assert self._smoke_band is not None
        return self._smoke_band.layer != FAR

    def cells(self, smoke: np.ndarray) -> None:
        """Fill ghosts, band and what lies beyond the sides, in place. Collective."""
        assert self._smoke_band is not None
        self.grid.exchange_cells(smoke)
        self._smoke_band.fill(smoke)
        self.surroundings.fill_smoke(smoke)

    def faces(
        self, faces: Faces, narrow: list[np.ndarray] | None, slits: list[np.ndarray], sheets: Sheets | None
    ) -> Faces:
        """Fill ghosts, bands and what lies beyond the sides; return copies that narrow faces are not read from.

        Where there is nothing narrow the arrays themselves are returned. Collective.

        Parameters
        ----------
        faces : Faces
        narrow : list of ndarray of bool or None
            Face arrays.
        slits : list of ndarray of bool
            Those of the narrow faces whose own velocity is not to be looked at either; empty where none are narrow.
        sheets : Sheets or None
        """
        extended = []
        for axis, v in enumerate(faces):
            self.grid.exchange_faces(axis, v)
            known = v if narrow is None else v.copy()
            self._bands[axis].fill(known)
            if narrow is not None:
                np.copyto(v, known, where=~narrow[axis] | slits[axis])
                self.grid.fill_sides(v, axis)
            self.grid.fill_sides(known, axis)
            extended.append(known)
        new = Faces(extended, faces.parts)
        if sheets is not None and sheets.anywhere:
            # a band takes both sides; and what is narrow now may be read as it is in the next step
            new = sheets.renew_faces(new, sheets.slim)
            for v, known, slit, slim in zip(faces, new, slits, sheets.slim, strict=True):
                np.copyto(v, known, where=slit & slim)
        if self.surroundings.carries_along:
            self.surroundings.fill_along(new)
        return new
