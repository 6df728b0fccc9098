"""What shapes and sizes must keep; each check yields the mistakes it finds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from petfsi.scene.fluid_kinds import Fluid
from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.sides import HydrostaticSide, PressureSide
from petfsi.scene.tables import Box, Shape

#: PETSc numbers unknowns with 32 bits.
MAX_CELLS = 2**31 - 1
#: Bodies may touch the grid's sides and each other; this fraction of a length is round-off.
SLACK = 1e-9

#: Pairs are looked for among so many things and all others at a time.
ROWS = 256

OPPOSITE = (("left", "right"), ("bottom", "top"), ("back", "front"))
NO_Z = "bounds z, which dim = 2 does not have"

Problems = Iterator[Problem]
#: The lower and upper corner of a bounding box.
Reach = tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]


def length(key: str, value: Sequence | None, dim: int) -> Problems:
    """Judge whether a list has an item per axis."""
    if value is not None and len(value) != dim:
        yield Problem(key, value, f"must have {dim} items, as dim = {dim}", ("dim",))


def sizes(key: str, box: Box | Fluid, dim: int) -> Problems:
    """Judge a box, or what the fluid has of one."""
    yield from length(f"{key}.origin", box.origin, dim)
    yield from length(f"{key}.size", box.size, dim)
    yield from length(f"{key}.cells", box.cells, dim)
    if min(box.size, default=1.0) <= 0:
        yield Problem(f"{key}.size", box.size, "must be greater than 0 along every axis (m)")
    if box.cells is not None and math.prod(box.cells) > MAX_CELLS:
        yield Problem(f"{key}.cells", box.cells, f"make more than {MAX_CELLS} cells, the most that can be numbered")


def is_measured(box: Box | Fluid, dim: int) -> bool:
    """Whether a box is sound enough to compare places with it."""
    return len(box.origin) == len(box.size) == dim and min(box.size) > 0


def _shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge what any shape must keep, wherever it stands."""
    kinds = shape.kinds
    if len(kinds) != 1:
        found = ", ".join(kinds) or ABSENT
        yield Problem(key, found, "must have exactly one of box, ball, cylinder, halfspace, beam, mesh")
    if shape.box is not None:
        yield from sizes(f"{key}.box", shape.box, dim)
    if shape.ball is not None:
        yield from length(f"{key}.ball.centre", shape.ball.centre, dim)
    if shape.cylinder is not None:
        yield from _cylinder(f"{key}.cylinder", shape, dim)
    if shape.halfspace is not None:
        yield from length(f"{key}.halfspace.point", shape.halfspace.point, dim)
        yield from length(f"{key}.halfspace.normal", shape.halfspace.normal, dim)
        if not any(shape.halfspace.normal):
            yield Problem(f"{key}.halfspace.normal", shape.halfspace.normal, "must not be zero")
    yield from length(f"{key}.translate", shape.translate, dim)
    for name in ("cells", "scale", "translate"):
        if shape.mesh is None and name in shape.model_fields_set and getattr(shape, name) not in (1.0, None):
            yield Problem(f"{key}.{name}", getattr(shape, name), "belongs to a mesh file only", (f"{key}.mesh",))


def _cylinder(key: str, shape: Shape, dim: int) -> Problems:
    cylinder = shape.cylinder
    assert cylinder is not None
    if dim == 2:
        yield Problem(key, ABSENT, "a cylinder needs dim = 3; in 2D use ball, a disk", ("dim",))
        return
    yield from length(f"{key}.start", cylinder.start, dim)
    yield from length(f"{key}.end", cylinder.end, dim)
    if cylinder.start == cylinder.end:
        yield Problem(f"{key}.end", cylinder.end, "must differ from start")


def plain_shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge a shape that is never meshed."""
    yield from _shape(key, shape, dim)
    if shape.beam is not None:
        yield Problem(f"{key}.beam", ABSENT, "only a solid can be a beam; give a box, ball, cylinder or halfspace here")
    for kind in ("box", "ball"):
        cells = getattr(getattr(shape, kind), "cells", None)
        if cells is not None:
            yield Problem(f"{key}.{kind}.cells", cells, f"only a solid's {kind} is meshed; leave cells out")
    if shape.cavity is not None:
        yield Problem(f"{key}.cavity", ABSENT, "only a solid's box can have a cavity")


def analytic_shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge a shape that picks out points."""
    yield from plain_shape(key, shape, dim)
    if shape.mesh is not None:
        yield Problem(f"{key}.mesh", shape.mesh, "must be a box, ball, cylinder or halfspace here")


def solid_shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge a shape that must be meshed."""
    yield from _shape(key, shape, dim)
    for kind in ("cylinder", "halfspace"):
        if getattr(shape, kind) is not None:
            allowed = "a solid must be meshed: give a box or a ball with cells, or a mesh file"
            yield Problem(f"{key}.{kind}", ABSENT, allowed)
    if shape.box is not None and shape.box.cells is None:
        yield Problem(f"{key}.box.cells", ABSENT, "is missing; a solid's box needs its number of cells per axis")
    if shape.ball is not None and shape.ball.cells is None:
        yield Problem(f"{key}.ball.cells", ABSENT, "is missing; a solid's ball needs its number of cells across")
    if shape.ball is not None and (shape.ball.cells or 0) ** dim > MAX_CELLS:
        allowed = f"make more than {MAX_CELLS} cells, the most that can be numbered"
        yield Problem(f"{key}.ball.cells", shape.ball.cells, allowed)
    if shape.cavity is not None:
        yield from _cavity(key, shape, dim)


def _cavity(key: str, shape: Shape, dim: int) -> Problems:
    box, cavity = shape.box, shape.cavity
    assert cavity is not None
    if box is None:
        yield Problem(f"{key}.cavity", ABSENT, "belongs to a meshed box only", (f"{key}.box",))
        return
    yield from sizes(f"{key}.cavity", cavity, dim)
    if cavity.cells is not None:
        yield Problem(f"{key}.cavity.cells", cavity.cells, "a cavity has the cells of its box; leave cells out")
    if not (is_measured(box, dim) and is_measured(cavity, dim) and len(box.cells or ()) == dim):
        return
    taken = [_cells_within(box, cavity, axis) for axis in range(dim)]
    if not all(taken):
        yield Problem(f"{key}.cavity", ABSENT, "holds no cell's centre, so nothing is left out", (f"{key}.box",))
    elif taken == box.cells:
        yield Problem(f"{key}.cavity", ABSENT, "holds every cell's centre, so nothing is left", (f"{key}.box",))


def _cells_within(box: Box, cavity: Box, axis: int) -> int:
    """Return how many of the box's cells have their centre in the cavity, along one axis."""
    assert box.cells is not None
    n, low, size = box.cells[axis], cavity.origin[axis], cavity.size[axis]
    centres = box.origin[axis] + box.size[axis] * (np.arange(n) + 0.5) / n
    return int(np.count_nonzero((centres >= low) & (centres <= low + size)))


def extent(shape: Shape, dim: int) -> tuple[list[float], list[float]] | None:
    """Return the lower and upper corner of a box or ball that is sound; None of all other shapes."""
    box, ball = shape.box, shape.ball
    if box is not None and is_measured(box, dim):
        return box.origin, [o + s for o, s in zip(box.origin, box.size, strict=True)]
    if ball is not None and len(ball.centre) == dim:
        return [c - ball.radius for c in ball.centre], [c + ball.radius for c in ball.centre]
    return None


def periods(fluid: Fluid | None, dim: int) -> np.ndarray:
    """Return after what length the scene repeats along each axis, m; 0 where it does not, shape (dim,)."""
    if fluid is None:
        return np.zeros(dim)
    periodic = [getattr(fluid.sides, low) == getattr(fluid.sides, high) == "periodic" for low, high in OPPOSITE[:dim]]
    return np.where(periodic, fluid.size, 0.0)


def images(period: np.ndarray, one: Reach, other: Reach) -> list[np.ndarray]:
    """Return by how much those images of one thing are moved that may meet another, m; each is its corners."""
    (low, high), (low_b, high_b) = ([np.asarray(corner, dtype=float) for corner in reach] for reach in (one, other))
    length = np.where(period > 0.0, period, 1.0)
    first = np.where(period > 0.0, np.ceil((low_b - high) / length - SLACK), 0.0)
    last = np.where(period > 0.0, np.floor((high_b - low) / length + SLACK), 0.0)
    ranges = [np.arange(a, b + 1.0) for a, b in zip(first, last, strict=True)]
    return [np.array(shift) * period for shift in itertools.product(*ranges)]


def may_meet(lows: np.ndarray, highs: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Return which pairs of boxes meet, or whose images do: a superset by round-off, shape (n_pairs, 2).

    Parameters
    ----------
    lows, highs : ndarray, shape (n, dim)
        m.
    period : ndarray, shape (dim,)
        As ``periods`` returns it.
    """
    found = [np.zeros((0, 2), dtype=np.int64)]
    length = np.where(period > 0.0, period, 1.0)
    slack = SLACK * (highs - lows).max(axis=1, initial=0.0)
    for begin in range(0, len(lows), ROWS):
        rows = slice(begin, begin + ROWS)
        both = np.arange(len(lows))[rows, None] < np.arange(len(lows))
        for axis in range(lows.shape[1]):
            reach = slack[rows, None] + slack
            before = lows[:, axis] - highs[rows, None, axis] - reach
            beyond = highs[:, axis] - lows[rows, None, axis] + reach
            if period[axis] > 0.0:
                both &= np.ceil(before / length[axis]) <= np.floor(beyond / length[axis])
            else:
                both &= (before <= 0.0) & (beyond >= 0.0)
        first, second = np.nonzero(both)
        found.append(np.column_stack((first + begin, second)))
    return np.concatenate(found)


def overlap(a: Shape, b: Shape, dim: int, shift: np.ndarray) -> bool:
    """Whether two shapes, boxes or balls, share more than round-off, the first of them moved.

    A ball is a point, a box itself; what is left between the two must be longer than the radii together.
    """
    (low_a, high_a), (low_b, high_b) = (_core(shape, dim) for shape in (a, b))
    low_a, high_a = low_a + shift, high_a + shift
    reach = sum(shape.ball.radius for shape in (a, b) if shape.ball is not None)
    gaps = np.maximum(low_b - high_a, low_a - high_b)
    if reach == 0:
        return bool(np.all(gaps < -SLACK * np.maximum(high_a - low_a, high_b - low_b)))
    return bool(np.linalg.norm(np.maximum(gaps, 0.0)) < (1 - SLACK) * reach)


def _core(shape: Shape, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box, or the centre of a ball twice."""
    corners = extent(shape, dim)
    assert corners is not None
    low, high = (np.array(corner) for corner in corners)
    return (low, high) if shape.ball is None else (0.5 * (low + high), 0.5 * (low + high))


def passes(side: object) -> bool:
    """Whether all of a side lets fluid and floats through, both ways."""
    return side in ("open", "hydrostatic") or isinstance(side, PressureSide | HydrostaticSide)


def outside_grid(fluid: Fluid, key: str, low: Sequence[float], high: Sequence[float]) -> Problems:
    """Yield a problem if a bounding box does not lie in the grid, but for what reaches through an open side.

    Along a periodic axis every place is in the grid, and what is longer than the grid is not.
    """
    if not is_measured(fluid, len(low)):
        return
    repeats = periods(fluid, len(low)) > 0.0
    for n, (axis, a, b, start, size, sides) in enumerate(
        zip("xyz", low, high, fluid.origin, fluid.size, OPPOSITE, strict=False)
    ):
        end, slack = start + size, SLACK * size
        if repeats[n]:
            if b - a > size + slack:
                allowed = f"{axis} must be no longer than the grid, {size:g} m, after which the scene repeats"
                yield Problem(key, f"{axis} from {a:g} to {b:g} m", allowed, ("fluid.size", "fluid.sides"))
            continue
        # floats: a part of it at least must be in the grid
        through = [passes(getattr(fluid.sides, side)) and a < end and b > start for side in sides]
        if (a < start - slack and not through[0]) or (b > end + slack and not through[1]):
            allowed = f"{axis} must lie inside the fluid's grid, {start:g} to {end:g} m"
            yield Problem(key, f"{axis} from {a:g} to {b:g} m", allowed, ("fluid.origin", "fluid.size"))
