"""What the sides of a grid of fluid must keep; each check yields the mistakes it finds."""

from __future__ import annotations

import itertools

import numpy as np

from petfsi.scene.fluids import MacFluid
from petfsi.scene.mistakes import Problem
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import OPPOSITE, SLACK, Problems, extent, images, is_measured, length, periods
from petfsi.scene.sides import GridInflow, HydrostaticSide, InflowSide
from petfsi.scene.tables import Shape


def grid_sides(scene: Scene) -> Problems:
    """Judge what jets carry in and where, and fluid at rest beyond sides."""
    fluid = scene.fluid
    if not isinstance(fluid, MacFluid):
        return
    for side, form in fluid.sides:
        if isinstance(form, InflowSide):
            assert isinstance(form.inflow, GridInflow)
            yield from _jet(f"fluid.sides.{side}.inflow", form.inflow, side, fluid, scene.dim)
        given, inner = (form.inflow.rest, ".inflow.rest") if isinstance(form, InflowSide) else (form, "")
        if scene.gravity is None and (given == "hydrostatic" or isinstance(given, HydrostaticSide)):
            allowed = "is the pressure of fluid that gravity pulls on; give the scene one"
            yield Problem(f"fluid.sides.{side}{inner}", "hydrostatic", allowed, ("gravity",))


def _jet(key: str, jet: GridInflow, side: str, fluid: MacFluid, dim: int) -> Problems:
    axis = next(a for a, pair in enumerate(OPPOSITE) if side in pair)
    yield from length(f"{key}.along", jet.along, dim)
    if jet.along is not None and axis < len(jet.along) == dim and jet.along[axis] != 0:
        allowed = f"must be 0: what comes in across the side, along {'xyz'[axis]}, is its speed"
        yield Problem(f"{key}.along.{axis}", jet.along[axis], allowed)
    if jet.region is None or len(jet.region.kinds) != 1 or axis >= dim or not is_measured(fluid, dim):
        return
    low, high = np.array(fluid.origin, dtype=float), np.array(fluid.origin) + fluid.size
    at = high[axis] if side == OPPOSITE[axis][1] else low[axis]
    low[axis] = high[axis] = at
    if not _may_meet(jet.region, low, high, periods(fluid, dim)):
        shape = jet.region.kinds[0]
        allowed = f"meets no part of the side, which lies at {'xyz'[axis]} = {at:g} m"
        value = getattr(jet.region, shape).model_dump(exclude_none=True)
        yield Problem(f"{key}.region.{shape}", value, allowed, ("fluid.origin", "fluid.size"))


def _may_meet(shape: Shape, low: np.ndarray, high: np.ndarray, period: np.ndarray) -> bool:
    """Whether a region may have an area in common with a side from low to high; of cylinders that shows in the end."""
    dim = len(low)
    half = shape.halfspace
    if half is not None and len(half.point) == len(half.normal) == dim:
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        return bool(((corners - half.point) @ np.array(half.normal)).min() <= SLACK * np.abs(corners).max())
    reach = extent(shape, dim)
    if reach is None:
        return True
    one, other = (np.array(corner, dtype=float) for corner in reach)
    slack = SLACK * (other - one)
    for shift in images(period, reach, (low, high)):
        if shape.ball is not None:
            centre = np.array(shape.ball.centre) + shift
            if np.linalg.norm(centre - np.clip(centre, low, high)) < shape.ball.radius:
                return True
        elif np.all((one + shift <= high + slack) & (other + shift >= low - slack)):
            return True
    return False
