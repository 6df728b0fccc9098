"""What others see of a fluid: cell-centred fields and values at points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.mac.carrying.advect import velocity_at
from petfsi.fields.mac.carrying.sheets import Sheets
from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.kinds import DEAD, FLUID
from petfsi.fields.slabs import Slab
from petfsi.geometry.sight import seen_from


@dataclass(frozen=True)
class View:
    """A fluid's arrays, as they are at this moment.

    Attributes
    ----------
    links : ndarray
        Velocities of the parts of divided faces.
    surface : (ndarray, ndarray)
        Points and facets of all walls that cut the grid.
    """

    grid: MacGrid
    cell_kind: np.ndarray
    velocity: list[np.ndarray]
    pressure: np.ndarray
    smoke: np.ndarray | None
    face_kind: list[np.ndarray]
    sheets: Sheets | None
    links: np.ndarray
    surface: tuple[np.ndarray, np.ndarray]


def output(fluid: View) -> dict[str, Slab]:
    """Return cell-centred ``velocity`` (.., dim; zero outside the fluid), ``pressure``, ``kind`` and ``smoke``.

    Of divided cells those of the largest piece; beside thin walls the velocity of open faces alone.
    """
    grid = fluid.grid
    slabs = {"pressure": grid.slab(fluid.pressure, None), "kind": grid.slab(fluid.cell_kind, None)}
    if fluid.smoke is not None:
        slabs["smoke"] = grid.slab(np.where(fluid.cell_kind == FLUID, fluid.smoke, 0.0), None)
    columns = cell_velocity(fluid)
    cells = slabs["pressure"]
    data = np.stack(columns, axis=-1).reshape(*cells.data.shape, grid.dim)
    slabs["velocity"] = Slab(data, (*cells.start, 0), (*cells.shape, grid.dim))
    return slabs


def cell_velocity(fluid: View) -> list[np.ndarray]:
    """Return the velocity of this rank's own cells by axis, as ``output`` has it."""
    grid, part, columns = fluid.grid, fluid.grid.owned(None), []
    sheets, divided = fluid.sheets, None
    if sheets is not None:
        divided = sheets.local.in_first_pieces(fluid.velocity, fluid.links)
    for axis, v in enumerate(fluid.velocity):
        above = tuple(slice(s.start + 1, s.stop + 1) if b == axis else s for b, s in enumerate(part))
        mean = 0.5 * (v[part] + v[above])
        if sheets is not None and divided is not None:
            shut = [sheets.near[part] & (fluid.face_kind[axis][faces] == DEAD) for faces in (part, above)]
            np.copyto(mean, v[above], where=shut[0] & ~shut[1])
            np.copyto(mean, v[part], where=shut[1] & ~shut[0])
            place = np.unravel_index(divided[0], grid.shape(None))
            mean[tuple(i - s.start for i, s in zip(place, part, strict=True))] = divided[1][axis]
        columns.append(np.where(fluid.cell_kind[part] == FLUID, mean, 0.0))
    return columns


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
    sides = _sides(fluid)
    value = _value(fluid, quantity, place, sides) if here else None
    owner = grid.comm.allgather(here).index(True)
    return grid.comm.bcast(value, root=owner)


def _sides(fluid: View) -> list[np.ndarray] | None:
    """Return the velocity of cells, ghosts valid, by axis; None where there are no sheets. Collective."""
    sheets = fluid.sheets
    if sheets is None or not sheets.anywhere:
        return None
    arrays = []
    for column in cell_velocity(fluid):
        array = fluid.grid.zeros_cells()
        array[fluid.grid.owned(None)] = column
        fluid.grid.exchange_cells(array)
        arrays.append(array)
    return arrays


def _value(fluid: View, quantity: str, place: np.ndarray, sides: list[np.ndarray] | None) -> float | np.ndarray:
    """Return a quantity at a point (in cells from the grid's corner) in one of this rank's cells.

    Near sheets it is the mean over the cells around whose centres are seen from there; ``sides`` is their velocity.
    """
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
    around = tuple(slice(c.start - 1, c.stop + 1) if b < grid.dim else c for b, c in enumerate(stencil))
    near = sides is not None and fluid.sheets is not None and bool(fluid.sheets.near[around].any())
    if near:
        weights = weights * _seen(fluid, place)
    if not weights.sum() > 0:
        return np.full(grid.dim, np.nan) if quantity == "velocity" else float("nan")
    if quantity == "velocity" and not (near and sides):
        u, v, w = three(fluid.velocity)
        return np.array(velocity_at(u, v, w, s[0], s[1], s[2], grid.dim == 2))[: grid.dim]
    cells = sides if quantity == "velocity" else [fluid.smoke if quantity == "smoke" else fluid.pressure]
    assert cells is not None
    means = [float((weights * array[stencil]).sum() / weights.sum()) for array in cells if array is not None]
    return np.array(means) if quantity == "velocity" else means[0]


def _seen(fluid: View, place: np.ndarray) -> np.ndarray:
    """Return which of the cells around a point have their centres in sight, as ``_value`` has them."""
    grid, dim = fluid.grid, fluid.grid.dim
    shape = [2] * dim + [1] * (3 - dim)
    corners = np.array(list(np.ndindex(*shape[:dim])))
    centres = np.floor(place - 0.5) + corners + 0.5
    points, facets = fluid.surface
    seen = np.ones(len(corners), dtype=bool)
    for turn in np.ndindex(*(3 if p else 1 for p in grid.periodic[:dim])):
        shift = np.where(grid.periodic[:dim], (np.array(turn) - 1) * np.array(grid.cells[:dim]), 0)
        here, there = (grid.origin + (x + shift) * grid.dx for x in (place, centres))
        seen &= seen_from(here, there, points, facets)
    return seen.reshape(shape)
