"""Numbers that are finite but absurd beside their neighbours; each check yields the mistakes it finds.

What is refused here would be lost in round-off, or overflow in a product: not what is merely unusual.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from pydantic import BaseModel

from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.fluid_kinds import Fluid
from petfsi.scene.fluids import SphFluid
from petfsi.scene.mistakes import Problem
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import Problems, extent, is_measured
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Halfspace, Shape

#: No number may be larger, nor a positive one smaller: products of a few of them must not overflow.
LARGEST, SMALLEST = 1e30, 1e-30
#: The same of lengths (m) and times (s), whose cubes and squares are taken.
LONGEST, SHORTEST = 1e15, 1e-15
#: Places may be so many cells away from 0: round-off leaves half of all digits of a cell.
FAR = 1e8
#: The longest side of a cell, or the largest body, over the shortest or smallest.
STRETCHED, UNLIKE = 1e6, 1e9
#: The ratio of two densities, and of a load and what it acts on.
HEAVIER, STRONGER = 1e12, 1e9
#: What crosses so many scenes in a step has no path.
SCENES = 1e3
#: Outputs and checkpoints over a run.
MOST_OUTPUTS = 1e8

_TIMES = ("end", "dt", "every", "ramp")
_LENGTHS = ("size", "radius", "thickness", "spacing")
_POSITIVE = (*_TIMES[:3], *_LENGTHS, "density", "young", "sound_speed", "scale")
_PLACES = ("origin", "centre", "start", "point", "at", "hydrostatic", "translate")

Leaf = tuple[str, str, float]


def scales(scene: Scene) -> Problems:
    """Judge every number by itself, and if each is sound all of them beside each other."""
    alone = [*_magnitudes(scene), *_normals(scene)]
    yield from alone
    if not alone:
        for check in (_lengths, _intervals, _speeds, _materials):
            yield from check(scene)


def _magnitudes(scene: Scene) -> Problems:
    """Judge every number by itself."""
    for key, name, value in _leaves(scene, ""):
        large, small = (LONGEST, SHORTEST) if name in (*_TIMES, *_LENGTHS) else (LARGEST, SMALLEST)
        if abs(value) > large:
            yield Problem(key, value, f"must be at most {large:g} in size")
        elif name in _POSITIVE and 0 < value < small:
            yield Problem(key, value, f"must be at least {small:g}")


def _leaves(table: BaseModel, key: str) -> Iterator[Leaf]:
    """Yield the key, the setting and the value of every number, and of every expression that is one."""
    for name, field in type(table).model_fields.items():
        yield from _inside(getattr(table, name), f"{key}{field.alias or name}", name)


def _inside(value: Any, key: str, name: str) -> Iterator[Leaf]:
    match value:
        case bool() | None:
            return
        case int() | float():
            yield key, name, float(value)
        case str():
            if key == "time.dt" or (constant := _constant(value)) is None:
                return
            yield key, name, constant
        case list():
            for n, item in enumerate(value):
                yield from _inside(item, f"{key}.{n}", name)
        case dict():
            for part, item in value.items():
                yield from _inside(item, f"{key}.{part}", name)
        case BaseModel():
            yield from _leaves(value, f"{key}.")


def _constant(value: float | str) -> float | None:
    """Return the value of a number, or of an expression that is the same everywhere; None of all other texts."""
    if not isinstance(value, str):
        return float(value)
    if not any(character.isdigit() for character in value):
        return None
    try:
        expression = Expression(value)
        return float(expression()) if expression.is_constant else None
    except ExpressionError:
        return None


# ---- lengths ------------------------------------------------------------------------------------------------


def _lengths(scene: Scene) -> Problems:
    """Judge places and sizes beside the cells that must resolve them."""
    fluid = scene.fluid
    grid = None
    if fluid is not None and _is_sound(fluid, scene.dim):
        grid = fluid.resolution
        yield from _stretched("fluid", fluid.size, fluid.cells)
        for key, name, value in itertools.chain(_leaves(fluid, "fluid."), *_others(scene)):
            yield from _far(key, name, value, grid, "fluid")
        reach = [abs(o) + s for o, s in zip(fluid.origin, fluid.size, strict=True)]
        if max(reach) > FAR * grid:
            allowed = f"reaches {max(reach):g} m away from 0 with cells of {grid:g} m; at most {FAR:g} cells may be"
            yield Problem("fluid.size", fluid.size, allowed, ("fluid.origin", "fluid.cells"))
    for name, solid in scene.solids.items():
        own = _resolution(solid, scene.dim)
        if own is None:
            continue
        for key, setting, value in _leaves(solid.shape, f"solids.{name}.shape."):
            yield from _far(key, setting, value, own, f"solids.{name}.shape")
        if solid.shape.box is not None:
            yield from _stretched(f"solids.{name}.shape.box", solid.shape.box.size, solid.shape.box.cells)
        if grid is not None and not 1 / UNLIKE <= own / grid <= UNLIKE:
            allowed = f"has elements of {own:g} m beside the fluid's {grid:g} m; their ratio may be {UNLIKE:g}"
            yield Problem(f"solids.{name}.shape.{solid.shape.kinds[0]}", _size(solid.shape), allowed, ("fluid",))


def _others(scene: Scene) -> Iterator[Iterator[Leaf]]:
    for name, obstacle in scene.obstacles.items():
        yield _leaves(obstacle, f"obstacles.{name}.")
    for name, probe in scene.probes.items():
        yield _leaves(probe, f"probes.{name}.")


def _far(key: str, name: str, value: float, cell: float, of: str) -> Problems:
    if name in _PLACES and abs(value) > FAR * cell:
        allowed = (
            f"lies more than {FAR:g} of {of}'s cells or elements ({cell:g} m) from 0: they would be lost in round-off"
        )
        yield Problem(key, value, allowed, (of,) if not key.startswith(of) else ())


def _stretched(key: str, size: list[float], cells: list[int] | None) -> Problems:
    if cells is None or len(cells) != len(size):
        return
    sides = [s / n for s, n in zip(size, cells, strict=True)]
    if min(sides) > 0 and max(sides) > STRETCHED * min(sides):
        allowed = f"makes cells of {' x '.join(f'{s:g}' for s in sides)} m; their sides may differ {STRETCHED:g} times"
        yield Problem(f"{key}.size", size, allowed, (f"{key}.cells",))


def _is_sound(fluid: Fluid, dim: int) -> bool:
    return is_measured(fluid, dim) and (isinstance(fluid, SphFluid) or len(fluid.cells) == dim)


def _resolution(solid: Solid, dim: int) -> float | None:
    """Return the shortest side of a body's elements, m; None where its shape is unsound or in a file."""
    box, ball, beam = solid.shape.box, solid.shape.ball, solid.shape.beam
    if box is not None and is_measured(box, dim) and box.cells is not None and len(box.cells) == dim:
        return min(s / n for s, n in zip(box.size, box.cells, strict=True))
    if ball is not None and ball.cells is not None:
        return 2 * ball.radius / ball.cells
    if beam is not None and len(beam.start) == len(beam.end) == dim:
        long = float(np.linalg.norm(np.subtract(beam.end, beam.start))) / beam.elements
        return min(long, beam.thickness) or None
    return None


def _size(shape: Shape) -> Any:
    if shape.box is not None:
        return shape.box.size
    return shape.ball.radius if shape.ball is not None else ""


def _normals(scene: Scene) -> Problems:
    """Judge the normals of half spaces: a direction must be left of them once they are squared."""
    for key, halfspace in _halfspaces(scene, ""):
        largest = max(map(abs, halfspace.normal), default=1.0)
        if 0 < largest < SMALLEST:
            yield Problem(f"{key}.normal", halfspace.normal, f"its largest part must be at least {SMALLEST:g} in size")


def _halfspaces(value: Any, key: str) -> Iterator[tuple[str, Halfspace]]:
    if isinstance(value, Halfspace):
        yield key[:-1], value
    elif isinstance(value, BaseModel):
        for name, field in type(value).model_fields.items():
            yield from _halfspaces(getattr(value, name), f"{key}{field.alias or name}.")
    elif isinstance(value, dict | list):
        for part, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _halfspaces(item, f"{key}{part}.")


# ---- times and speeds ---------------------------------------------------------------------------------------


def _intervals(scene: Scene) -> Problems:
    """Judge how often things are written."""
    for table in ("output", "checkpoint"):
        every = getattr(scene, table).every
        if every is not None and scene.time.end / every > MOST_OUTPUTS:
            allowed = f"makes {scene.time.end / every:.3g} of them to time.end = {scene.time.end:g} s; at most"
            yield Problem(f"{table}.every", every, f"{allowed} {MOST_OUTPUTS:g} may be", ("time.end",))


def _speeds(scene: Scene) -> Problems:
    """Judge speeds, displacements and gravity by how far they lead in a step."""
    whole, dt = _extent(scene), _constant(scene.time.dt)
    if whole is None:
        return
    static = not scene.time.scheme.inertia
    for key, name, value in _leaves(scene, ""):
        step, unit = _step(key, name, None if static else dt)
        if step is not None and abs(value) * step > SCENES * whole:
            far, most = f"{abs(value) * step:.3g} m", f"{SCENES * whole / step:.3g} {unit}"
            allowed = f"leads {far} {'away' if unit == 'm' else 'in a step'}, in a scene of {whole:g} m; at most {most}"
            yield Problem(key, value, f"{allowed} may be", ("time.dt", "fluid.size"))


def _step(key: str, name: str, dt: float | None) -> tuple[float | None, str]:
    """Return what a setting is multiplied with to give a length, where it can be, and its unit."""
    table, *parts = key.split(".")
    parts = parts[1:] if table in ("solids", "obstacles", "probes") else parts  # without names
    if "angle" in parts:
        return None, ""
    if "displacement" in parts:
        return 1.0, "m"
    if dt is not None and any(part in ("velocity", "along", "speed") for part in parts):
        return dt, "m/s"
    return (dt**2, "m/s^2") if dt is not None and name == "gravity" else (None, "")


def _extent(scene: Scene) -> float | None:
    """Return the largest length of a scene, m; None where only mesh files know it."""
    if scene.fluid is not None:
        return max(scene.fluid.size, default=None)
    found = []
    for solid in scene.solids.values():
        reach, beam = extent(solid.shape, scene.dim), solid.shape.beam
        if reach is not None:
            found.append(float(np.max(np.subtract(reach[1], reach[0]))))
        elif beam is not None and len(beam.start) == len(beam.end):
            found.append(float(np.linalg.norm(np.subtract(beam.end, beam.start))))
        else:
            return None
    return max(found, default=None)


# ---- materials ----------------------------------------------------------------------------------------------


def _materials(scene: Scene) -> Problems:
    """Judge densities beside each other, and loads beside moduli."""
    names = list(scene.solids)
    first = "fluid" if scene.fluid is not None else f"solids.{names[0]}" if names else ""
    density = scene.fluid.density if scene.fluid is not None else scene.solids[names[0]].density if names else 1.0
    for name, solid in scene.solids.items():
        if not 1 / HEAVIER <= solid.density / density <= HEAVIER:
            allowed = (
                f"is {solid.density / density:.3g} times {first}.density; from {1 / HEAVIER:g} to {HEAVIER:g} may be"
            )
            yield Problem(f"solids.{name}.density", solid.density, allowed, (f"{first}.density",))
        for n, load in enumerate(solid.loads):
            for key, kind, value in _leaves(load, f"solids.{name}.loads.{n}."):
                if kind in ("traction", "pressure") and abs(value) > STRONGER * solid.young:
                    allowed = f"is more than {STRONGER:g} times the body's young = {solid.young:g} Pa"
                    yield Problem(key, value, allowed, (f"solids.{name}.young",))
