"""What a checkpoint holds of a fluid on a grid, as pieces of global arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from petfsi.fields.mac.carrying.transport import Transport
from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.faces import Faces
from petfsi.fields.mac.grid.grid import MacGrid
from petfsi.fields.mac.walls.parts import Parts
from petfsi.fields.replicated import read_whole, whole_slab
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.stored import outside, step_fault


@dataclass(frozen=True)
class Saved:
    """The grid's arrays that the next step reads, as they are at this moment; they are filled from a file in place.

    Attributes
    ----------
    other_pressure : ndarray or None
        That of the second piece of split cells, where the scene has what splits cells anew.
    narrow, facing : list of ndarray
        As of ``CoveredGrid``; None and empty where nothing cuts cells.
    """

    grid: MacGrid
    pressure: np.ndarray
    other_pressure: np.ndarray | None
    cell_kind: np.ndarray
    velocity: Faces
    face_kind: list[np.ndarray]
    smoke: np.ndarray | None
    narrow: list[np.ndarray] | None
    facing: list[np.ndarray]
    transport: Transport

    def slabs(self) -> dict[str, Slab]:
        """Return velocity, kinds, pressure, smoke and the transport's past."""
        slabs = {name: self.grid.slab(array, axis) for name, array, axis in self._arrays()}
        past = {"past_dt": scalar_slab(self.grid.comm, self.transport.past_dt)} if self.transport.past else {}
        return slabs | past

    def read(self, read: Reader) -> None:
        """Fill them with what ``slabs`` gave, and their ghosts but those beyond sides. Collective."""
        for name, array, axis in self._arrays():
            self.grid.read_slab(read, name, array, axis)
            self.grid.halo.exchange(array, axis)
        if self.transport.past:
            self.transport.past_dt = float(read("past_dt", (0,), (1,))[0])

    def faults(self) -> Iterator[str]:
        """Yield what cannot be of kinds that a file holds: obstacles and sides are the scene's."""
        yield step_fault(self.transport.past_dt if self.transport.past else 0.0)
        yield outside("cell_kind", self.cell_kind[self.grid.owned(None)], kinds.FLUID, kinds.OUTSIDE)
        for axis, kind in enumerate(self.face_kind):
            yield outside(f"face_kind_{'xyz'[axis]}", kind[self.grid.owned(axis)], kinds.DEAD, kinds.SPLIT)

    def _arrays(self) -> list[tuple[str, np.ndarray, int | None]]:
        """Return the names, local arrays and axes of all."""
        return [*self._present(), *self._reach(), *self._past()]

    def _present(self) -> Iterator[tuple[str, np.ndarray, int | None]]:
        yield "pressure", self.pressure, None
        yield "cell_kind", self.cell_kind, None
        for axis, v in enumerate(self.velocity):
            yield f"velocity_{'xyz'[axis]}", v, axis
            yield f"face_kind_{'xyz'[axis]}", self.face_kind[axis], axis
        if self.smoke is not None:
            yield "smoke", self.smoke, None
        if self.other_pressure is not None:
            yield "pressure_other", self.other_pressure, None

    def _reach(self) -> Iterator[tuple[str, np.ndarray, int | None]]:
        """Yield what the transport reads in place of the velocity, and the faces where the two differ."""
        for axis, narrow in enumerate(self.narrow or []):
            yield f"velocity_carried_{'xyz'[axis]}", self.transport.carried[axis], axis
            yield f"face_narrow_{'xyz'[axis]}", narrow, axis
            yield f"wall_facing_{'xyz'[axis]}", self.facing[axis], None

    def _past(self) -> Iterator[tuple[str, np.ndarray, int | None]]:
        for name, faces in self.transport.past.items():
            for axis, v in enumerate(faces):
                yield f"{name}_{'xyz'[axis]}", v, axis


def parts_slabs(
    rank: int, table: Parts, velocity: Faces, smoke_parts: np.ndarray, transport: Transport
) -> dict[str, Slab]:
    """Return divided cells and faces, and what is on them, as arrays that rank 0 owns."""
    values = {"velocity_links": velocity.parts, "smoke_pieces": smoke_parts}
    values |= {name: faces.parts for name, faces in transport.past.items()}
    return table.state(rank) | {f"parts_{name}": whole_slab(rank, array) for name, array in values.items()}


def read_parts(read: Reader, table: Parts, velocity: Faces, n_pieces: int, transport: Transport) -> np.ndarray:
    """Fill the parts of velocities with what ``parts_slabs`` gave; return the smoke of ``n_pieces``. Collective."""
    velocity.parts = read_whole(read, "parts_velocity_links", len(table))
    smoke_parts = read_whole(read, "parts_smoke_pieces", n_pieces)
    transport.carried.parts = velocity.parts
    for name, faces in transport.past.items():
        faces.parts = read_whole(read, f"parts_{name}", len(table))
    return smoke_parts
