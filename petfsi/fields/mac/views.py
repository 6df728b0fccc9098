"""What others see of a fluid: cell-centred fields and values at points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.base import Slab
from petfsi.fields.mac.advect import velocity_at
from petfsi.fields.mac.grid import MacGrid, three
from petfsi.fields.mac.kinds import FLUID


@dataclass(frozen=True)
class View:
    """A fluid's arrays, as they are at this moment."""

    grid: MacGrid
    cell_kind: np.ndarray
    velocity: list[np.ndarray]
    pressure: np.ndarray
    smoke: np.ndarray | None


def output(fluid: View) -> dict[str, Slab]:
    """Return cell-centred ``velocity`` (.., dim; zero outside the fluid), ``pressure``, ``kind`` and ``smoke``."""
    grid = fluid.grid
    part = grid.owned(None)
    slabs = {"pressure": grid.slab(fluid.pressure, None), "kind": grid.slab(fluid.cell_kind, None)}
    if fluid.smoke is not None:
        slabs["smoke"] = grid.slab(np.where(fluid.cell_kind == FLUID, fluid.smoke, 0.0), None)
    columns = []
    for axis, v in enumerate(fluid.velocity):
        above = tuple(slice(s.start + 1, s.stop + 1) if b == axis else s for b, s in enumerate(part))
        columns.append(np.where(fluid.cell_kind[part] == FLUID, 0.5 * (v[part] + v[above]), 0.0))
    cells = slabs["pressure"]
    data = np.stack(columns, axis=-1).reshape(*cells.data.shape, grid.dim)
    slabs["velocity"] = Slab(data, (*cells.start, 0), (*cells.shape, grid.dim))
    return slabs


def probe(fluid: View, quantity: str, at: list[float]) -> float | np.ndarray:
    """Return a quantity at a point, the same on all ranks; not a number where no fluid is near. Collective."""
    grid = fluid.grid
    if quantity not in ("velocity", "pressure") and (quantity != "smoke" or fluid.smoke is None):
        raise InputError(f"probe of {quantity!r}: the fluid has velocity, pressure and, if the scene says so, smoke")
    place = (np.asarray(at, dtype=float) - grid.origin) / grid.dx
    n_cells = np.array(grid.cells[: grid.dim])
    place = np.where(grid.periodic[: grid.dim], np.mod(place, n_cells), place)
    # round-off must not put a point on a side outside
    if np.any(place < -1e-9) or np.any(place > n_cells + 1e-9):
        raise InputError(f"probe at {list(map(float, at))}: must lie in the fluid's grid")
    cell = np.clip(place.astype(int), 0, n_cells - 1)
    here = all(grid.lo[b] <= cell[b] < grid.hi[b] for b in range(grid.dim))
    value = _value(fluid, quantity, place) if here else None
    owner = grid.comm.allgather(here).index(True)
    return grid.comm.bcast(value, root=owner)


def _value(fluid: View, quantity: str, place: np.ndarray) -> float | np.ndarray:
    """Return a quantity at a point (in cells from the grid's corner) in one of this rank's cells."""
    grid = fluid.grid
    s = np.full(3, 0.5)
    s[: grid.dim] = place + np.array(grid.ghost[: grid.dim]) - np.array(grid.lo[: grid.dim])
    corner = np.floor(s - 0.5).astype(int)
    fraction = s - 0.5 - corner
    stencil = tuple(slice(c, c + (2 if b < grid.dim else 1)) for b, c in enumerate(corner))
    weights = np.ones((1, 1, 1))
    for b in range(grid.dim):
        weights = weights * np.reshape([1.0 - fraction[b], fraction[b]], [2 if a == b else 1 for a in range(3)])
    weights = weights * (fluid.cell_kind[stencil] == FLUID)
    if quantity == "velocity":
        u, v, w = three(fluid.velocity)
        value = np.array(velocity_at(u, v, w, s[0], s[1], s[2], grid.dim == 2))[: grid.dim]
        return value if weights.sum() > 0 else np.full(grid.dim, np.nan)
    cells = fluid.smoke if quantity == "smoke" else fluid.pressure
    assert cells is not None
    return float((weights * cells[stencil]).sum() / weights.sum()) if weights.sum() > 0 else float("nan")
