"""Notes on a fluid: whether it resolves solids, where it may go, how far in a step, and what it weighs beside them."""

from __future__ import annotations

import math
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
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import Inflow, InflowSide, open_side
from petfsi.scene.tables import Number

#: Cells that a body should have across it.
ENOUGH = 4.0
#: Cells a step beyond which what is carried is blurred.
FAST = 5.0
#: Places along each axis, on a line, over a side and in a box, and instants of the run at which speeds are looked at.
PLACES, INSTANTS = (1, 257, 33, 9), 97
#: Of what flows in and out at once this part may be left: places and instants say no more of it.
BALANCED = 0.01
#: Solids may give way by this part of their volume without a word, and by that one without a warning.
SLIGHT, MUCH = 1e-6, 0.1
#: Speeds of a jet that are looked at in all: at each step, if that is not too many.
SAMPLES = 1 << 18
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
        said, second = f"solids.{name} is {_below(across.min())} of the fluid's {unit} across", np.sort(across)[1]
        if second < ENOUGH - _ROUND_OFF:
            finer = math.ceil(10 * ENOUGH / second - _ROUND_OFF) / 10
            yield Note(
                f"solids.{name} is {_below(second)} of the fluid's {unit} across, where {ENOUGH:g} are few: forces on "
                f"it are coarse; {finer:.3g} times finer {key} help",
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


def _below(number: float) -> str:
    """Return a number that is too small in as many digits as show that it is; two, as a rule."""
    return next((said for n in range(2, 12) if float(said := f"{number:.{n}g}") < ENOUGH), f"{ENOUGH:g}")


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


# ---- what closed boxes take ---------------------------------------------------------------------------------


def nowhere_to_go(view: View) -> Notes:
    """Tell what jets let into a box that no side opens: where no solid could give way either, that is an error.

    Solids give way to the volume V(t) that has come in, net, from all sides since the start; it is judged beside theirs
    where it is largest, by size.
    """
    scene = view.scene
    if not isinstance(scene.fluid, MacFluid) or not scene.solids:
        return
    sides = {side: getattr(scene.fluid.sides, side) for pair in OPPOSITE[: scene.dim] for side in pair}
    jets = {side: form.inflow for side, form in sides.items() if isinstance(form, InflowSide)}
    if not jets or any(open_side(form) for form in sides.values()):
        return
    # a beam bends, but its cross section stays as it is
    room = sum(math.prod(form.lengths) for name, form in view.forms.items() if not scene.solids[name].shape.beam)
    if not room:
        return
    try:
        t, came = _net_volume(view, jets)
    except ExpressionError:  # is told of by those who need the speed
        return
    part = came / room
    most = float(np.abs(part).max())
    if not most > SLIGHT:
        return
    first = int(np.argmax(np.abs(part) >= min(most, 1.0)))
    yield _closed_box(f"fluid.sides.{', '.join(jets)}", most, part[first] > 0, f"by t = {t[first]:.2g} s")


def _closed_box(keys: str, part: float, enters: bool, when: str) -> Note:
    """Return the note of sides that change the volume of solids by a part of it, the fluid having no other way."""
    if part < MUCH:
        change = "shrink" if enters else "swell"
        return Note(f"{keys}: no side is open: solids {change} by {100 * part:.3g}% of their volume {when}")
    if enters:
        end = "to nothing" if part >= 1.0 else f"by {100 * part:.3g}% of their volume"
        said = (
            f"what comes in can leave nowhere, as no side is open; solids alone give way to it, squeezed {end} {when}"
        )
    else:
        said = (
            "what is drawn out comes in nowhere, as no side is open; solids alone make up for it, stretched by "
            f"{100 * min(part, 1.0):.3g}% of their volume {when}"
        )
    return Note(f'{keys}: {said}; let another side be "open"', warns=True)


def _net_volume(view: View, jets: Mapping[str, Inflow]) -> tuple[np.ndarray, np.ndarray]:
    """Return instants of the run, s, and the volume that has come in through all jets until then, m^3 (m^2 in 2D)."""
    scene, dim = view.scene, view.scene.dim
    fluid = scene.fluid
    assert fluid is not None
    low, high = np.array(fluid.origin, dtype=float), np.array(fluid.origin, dtype=float) + fluid.size
    steps = scene.time.end / view.dt if view.dt else math.inf
    number = max(INSTANTS, math.ceil(min(steps, SAMPLES / PLACES[dim - 1] ** (dim - 1))))
    # in the middle of steps: the sum of a flow that swings then swings no more than it
    t = scene.time.end * (np.arange(number) + 0.5) / number
    net, gross = np.zeros(number), np.zeros(number)
    for side, jet in jets.items():
        axis, upper = next((a, pair.index(side)) for a, pair in enumerate(OPPOSITE) if side in pair)
        at, area = _patches(jet, low, high, axis, (low, high)[upper][axis])
        at = at[~_covered(scene, at)]
        coordinates = {"z": 0.0, **dict(zip("xyz", at.T, strict=False))}
        speed = np.broadcast_to(Expression(jet.speed)(t=t[:, None], **coordinates), (number, len(at)))
        opened = np.sin(np.pi / 2 * np.minimum(t / jet.ramp, 1.0)) ** 2 if jet.ramp else np.ones(number)
        net += area * opened * speed.sum(axis=1)
        gross += area * opened * np.abs(speed).sum(axis=1)
    net[np.abs(net) <= BALANCED * gross] = 0.0
    return t + t[0], np.cumsum(net) * 2 * t[0]


def _patches(inflow: Inflow, low: np.ndarray, high: np.ndarray, axis: int, end: float) -> tuple[np.ndarray, float]:
    """Return the middles of equal patches of what part of a side lets something in, and the area of each."""
    low, high = _reach(inflow, low, high, axis, end)
    number = np.where(np.arange(len(low)) == axis, 1, PLACES[len(low) - 1])
    middle = (high - low) / number / 2
    at = _places(low + middle, high - middle)
    area = float(np.prod(np.delete(2 * middle, axis)))
    return (at if inflow.region is None else at[inside(inflow.region, at)]), area


def _covered(scene: Scene, at: np.ndarray) -> np.ndarray:
    """Return which points lie in an obstacle that is no mesh."""
    covered = np.zeros(len(at), dtype=bool)
    for obstacle in scene.obstacles.values():
        if obstacle.shape.mesh is None:
            covered |= inside(obstacle.shape, at) != obstacle.outside
    return covered


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
    at = _places(*_reach(inflow, low, high, axis, end))
    return at if inflow.region is None else at[inside(inflow.region, at)]


def _reach(inflow: Inflow, low: np.ndarray, high: np.ndarray, axis: int, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the box about the part of a side that lets something in."""
    low, high = low.copy(), high.copy()
    reach = None if inflow.region is None else bounds(inflow.region)
    if reach is not None:
        low, high = np.maximum(low, reach[0]), np.minimum(high, reach[1])
    low[axis] = high[axis] = end
    return low, np.maximum(low, high)


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
        "more fluid moves with a solid, or with a part of its surface, than that weighs"
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
