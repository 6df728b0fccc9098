"""Notes on a fluid: whether it resolves solids, how far it goes in a step, and what it weighs beside solids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from petfsi.geometry.shapes import bounds, inside
from petfsi.notes.bending import carried
from petfsi.notes.forms import Form
from petfsi.notes.note import Note, Notes, View
from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.fluid_kinds import Fluid
from petfsi.scene.fluids import MacFluid
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import Inflow, InflowSide, open_side
from petfsi.scene.tables import Number

#: Cells that a body should have across it.
ENOUGH = 4.0
#: Cells a step beyond which what is carried is blurred.
FAST = 5.0
#: Places along each axis, on a line, over a side and in a box, and instants of the run at which speeds are looked at.
PLACES, INSTANTS = (1, 257, 33, 9), 97
#: What is below that many cells a step is round-off.
NOTHING = 1e-9
_ROUND_OFF = 1e-9


def resolution(view: View) -> Notes:
    """Tell of solids that are only a few cells, or particles, across."""
    scene = view.scene
    fluid = scene.fluid
    if fluid is None:
        return
    cell = _cell(fluid)
    unit = "cells" if isinstance(fluid, MacFluid) else "particles"
    key = f"fluid.{'cells' if isinstance(fluid, MacFluid) else 'spacing'}"
    for name, form in view.forms.items():
        across = _across(form, cell)
        if across.min() >= ENOUGH - _ROUND_OFF:
            continue
        said, second = f"solids.{name} is {across.min():.2g} of the fluid's {unit} across", np.sort(across)[1]
        if second < ENOUGH - _ROUND_OFF:
            finer = ENOUGH / second
            yield Note(
                f"solids.{name} is {second:.2g} of the fluid's {unit} across, where {ENOUGH:g} are few: forces on it "
                f"are coarse; {finer:.2g} times finer {key} help",
                warns=True,
            )
        elif scene.transfer == "ray":
            yield Note(
                f'{said}: with transfer = "ray" it is where the nearest faces are; "cutcell" has it in its place',
                warns=True,
            )
        elif scene.transfer == "repulsion":
            yield Note(f'{said}: repulsion keeps water 1.3 spacings off; "pressure" is for thin bodies', warns=True)
        else:
            yield Note(
                f"{said} where it is thinnest: the fluid on its sides is kept apart, but the flow around its edges is "
                f"as coarse as the {unit}"
            )


def _cell(fluid: Fluid) -> np.ndarray:
    """Return the sides of a cell, or of the place of a particle, m."""
    if isinstance(fluid, MacFluid):
        return np.array(fluid.size, dtype=float) / fluid.cells
    return np.full(len(fluid.size), fluid.resolution)


def _across(form: Form, cell: np.ndarray) -> np.ndarray:
    """Return how many cells a solid, of a hollow one its wall, is across between its faces along each of its axes.

    Between two faces with the normal n, L apart, that are  L / |(n_x h_x, n_y h_y, ...)|  cells of sides h: where cells
    are no squares, the distance of the faces where cells are drawn as such.
    """
    lengths = np.concatenate(([form.thickness], form.lengths[1:]))
    return lengths / np.linalg.norm(form.axes * cell, axis=1)


def nowhere_to_go(view: View) -> Notes:
    """Warn of a jet into a box that no side opens: where no solid could give way either, that is an error."""
    scene = view.scene
    if not isinstance(scene.fluid, MacFluid) or not scene.solids:
        return
    sides = {side: getattr(scene.fluid.sides, side) for pair in OPPOSITE[: scene.dim] for side in pair}
    jets = [side for side, form in sides.items() if isinstance(form, InflowSide)]
    if len(jets) == 1 and not any(open_side(form) for form in sides.values()):
        yield Note(
            f"fluid.sides.{jets[0]}: what comes in can leave nowhere, as no side is open; solids alone give way to it, "
            f'until they are squeezed to nothing; let another side be "open"',
            warns=True,
        )


# ---- speeds -------------------------------------------------------------------------------------------------


def courant(view: View) -> Notes:
    """Tell how many cells the fluid crosses in a step at the speeds that the scene gives."""
    scene, dt = view.scene, view.dt
    if not isinstance(scene.fluid, MacFluid) or dt is None:
        return
    cell = _cell(scene.fluid)
    found = {key: float((speed / cell).max() * dt) for key, speed in _speeds(view, dt)}
    key = max(found, key=lambda key: found[key], default="")
    if not found or found[key] < NOTHING:
        yield Note("CFL: no speed is given at which the fluid would cross cells in a step")
        return
    said = f"CFL: {found[key]:.2g} cells a step, by {key}"
    if found[key] <= FAST:
        yield Note(said)
        return
    shorter = FAST / found[key] * dt
    yield Note(
        f"{said}: it is stable, but carries what is smaller inaccurately; time.dt = {shorter:.1g} is {FAST:g}", True
    )


def _speeds(view: View, dt: float) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the key and the largest speed along each axis, m/s, of all that sets the fluid in motion."""
    scene = view.scene
    fluid, dim = scene.fluid, scene.dim
    assert fluid is not None
    low, high = np.array(fluid.origin), np.array(fluid.origin) + fluid.size
    # not equally far apart: what is periodic may vanish at all of them
    t = scene.time.end * np.modf(np.arange(INSTANTS) * 0.5 * (5**0.5 - 1))[0]
    if fluid.initial.velocity is not None:
        yield "fluid.initial.velocity", _largest(fluid.initial.velocity, _places(low, high), t[:1])
    for axis, pair in enumerate(OPPOSITE[:dim]):
        for end, side in zip((low, high), pair, strict=True):
            form = getattr(fluid.sides, side)
            if isinstance(form, InflowSide):
                at = _opening(form.inflow, low, high, axis, end[axis])
                speed: list[Number] = list(getattr(form.inflow, "along", None) or [0.0] * dim)
                speed[axis] = form.inflow.speed
                yield f"fluid.sides.{side}.inflow", _largest(speed, at, t)
    for name, form in view.forms.items():
        solid, at = scene.solids[name], _places(form.points.min(axis=0), form.points.max(axis=0))
        if solid.initial.velocity is not None:
            yield f"solids.{name}.initial.velocity", _largest(solid.initial.velocity[:dim], at, t[:1])
        for n, support in enumerate(solid.supports):
            key = f"solids.{name}.supports.{n}"
            if support.velocity:
                yield f"{key}.velocity", _largest(_vector(support.velocity, dim), at, t)
            if support.displacement:
                yield f"{key}.displacement", _largest(_vector(support.displacement, dim), at, t, dt)


def _vector(parts: Mapping[Any, Number], dim: int) -> list[Number]:
    """Return what is said of each axis; zero where nothing is."""
    return [parts.get(axis, 0.0) for axis in "xyz"[:dim]]


def _places(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return points all over a box, a side or a line, shape (n, dim)."""
    wide = high > low
    number = np.where(wide, PLACES[int(wide.sum())], 1)
    ends = [np.linspace(a, b, n) for a, b, n in zip(low, high, number, strict=True)]
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, len(low))


def _opening(inflow: Inflow, low: np.ndarray, high: np.ndarray, axis: int, end: float) -> np.ndarray:
    """Return points all over the part of a side that lets something in; none if that is too small to be seen."""
    low, high = low.copy(), high.copy()
    reach = None if inflow.region is None else bounds(inflow.region)
    if reach is not None:
        low, high = np.maximum(low, reach[0]), np.minimum(high, reach[1])
    low[axis] = high[axis] = end
    at = _places(low, np.maximum(low, high))
    return at if inflow.region is None else at[inside(inflow.region, at)]


def _largest(values: Sequence[Number], at: np.ndarray, t: np.ndarray, dt: float | None = None) -> np.ndarray:
    """Return the largest size of each expression at some points and instants; with dt that of its change over one.

    Where one has no value that is left to those who need it.
    """
    found = np.zeros(len(values))
    coordinates = {"z": 0.0, **dict(zip("xyz", at.T, strict=False))}
    for n, value in enumerate(values):
        with suppress(ExpressionError):
            expression = Expression(value)
            size = expression(t=t[:, None], **coordinates)
            if dt is not None:
                size = (expression(t=t[:, None] + dt, **coordinates) - size) / dt
            found[n] = np.abs(size).max(initial=0.0)
    return found


# ---- masses -------------------------------------------------------------------------------------------------


def masses(view: View) -> Notes:
    """Tell how dense solids are beside the fluid, and what that means to splitting."""
    scene = view.scene
    if scene.fluid is None or not scene.solids:
        return
    density = scene.fluid.density
    ratios = [f"{name} {solid.density / density:.3g}" for name, solid in scene.solids.items()]
    many = f" and {len(ratios) - 5} more" if len(ratios) > 5 else ""
    yield Note(
        f"mass ratio, solid to fluid: {', '.join(ratios[:5])}{many}; only split.opts minds it: it is unstable where "
        "the fluid that moves with a solid outweighs it"
    )
    if not view.splits:
        return
    for name, form in view.forms.items():
        part = carried(form, scene.solids[name].density, density)
        if part > 1:
            yield Note(
                f"solids.{name}: the fluid that moves with it weighs about {part:.2g} times as much as it does: time "
                "splitting will be unstable; monolithic.opts is not",
                warns=True,
            )
