"""What a fluid of particles must keep; each check yields the mistakes it finds."""

from __future__ import annotations

from collections.abc import Iterator

from petfsi.scene.fluids import SphFluid
from petfsi.scene.mistakes import Problem
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import MAX_CELLS, OPPOSITE, is_measured, length, periods, plain_shape
from petfsi.scene.sides import InflowSide, MovingSide

#: Particles see so many smoothing lengths far, and lists of pairs a little farther.
REACH = 2.1
#: The box must be at least so many particles wide.
FEWEST = 2


def particles(scene: Scene) -> Iterator[Problem]:
    """Judge the table of a fluid of particles."""
    fluid = scene.fluid
    if not isinstance(fluid, SphFluid):
        return
    for n, shape in enumerate(fluid.fill):
        yield from plain_shape(f"fluid.fill.{n}", shape, scene.dim)
    if is_measured(fluid, scene.dim):
        yield from _spacing(fluid, scene.dim)
    yield from _plates(fluid, scene.dim)
    yield from _viscosity(scene, fluid)


def why_explicit(scene: Scene) -> tuple[str, str] | None:
    """Return why the viscosity of particles cannot be solved for, and the key that says so; None if it can."""
    assert isinstance(scene.fluid, SphFluid)
    if scene.fluid.viscosity == 0:
        return "there is none to solve for", "fluid.viscosity"
    if scene.solids and scene.time.scheme.explicit:
        return "symplectic-euler solves for nothing", "time.integrator"
    if scene.solids and scene.transfer == "repulsion":
        return "repulsion has no drag to solve for", "coupling.transfer"
    sides = (getattr(scene.fluid.sides, side) for pair in OPPOSITE[: scene.dim] for side in pair)
    if any(isinstance(side, InflowSide) for side in sides):
        return "what comes in has its velocity prescribed", "fluid.sides"
    return None


def _viscosity(scene: Scene, fluid: SphFluid) -> Iterator[Problem]:
    """Judge whether viscosity can be solved for, if it shall be."""
    reason = why_explicit(scene)
    if fluid.viscosity_solve == "implicit" and reason:
        yield Problem("fluid.viscosity_solve", "implicit", f"cannot be: {reason[0]}", (reason[1],))


def _plates(fluid: SphFluid, dim: int) -> Iterator[Problem]:
    """Judge the velocities of sides: along them, and of what can hold the fluid."""
    for axis, pair in enumerate(OPPOSITE[:dim]):
        for side in pair:
            form = getattr(fluid.sides, side)
            if not isinstance(form, MovingSide):
                continue
            key, velocity = f"fluid.sides.{side}.no-slip.velocity", form.no_slip.velocity
            yield from length(key, velocity, dim)
            if axis < len(velocity) == dim and velocity[axis] != 0:
                allowed = f"must be 0: a side moves in its own plane only, not along {'xyz'[axis]}"
                yield Problem(f"{key}.{axis}", velocity[axis], allowed)
            if fluid.viscosity == 0:
                yield Problem(key, velocity, "moves no fluid, whose viscosity is 0", ("fluid.viscosity",))


def _spacing(fluid: SphFluid, dim: int) -> Iterator[Problem]:
    """Judge the spacing beside the size of the box."""
    uses, shortest, most = ("fluid.size",), min(fluid.size), 1.0
    for size in fluid.size:
        most *= size / fluid.spacing
    if shortest < FEWEST * fluid.spacing:
        allowed = f"must be at most {shortest / FEWEST:g} m, so that {FEWEST} particles lie across the box"
        yield Problem("fluid.spacing", fluid.spacing, allowed, uses)
    elif most > MAX_CELLS:
        yield Problem("fluid.spacing", fluid.spacing, f"makes room for more than {MAX_CELLS} particles", uses)
    reach = REACH * fluid.smoothing * fluid.spacing
    for axis, period in zip("xyz", periods(fluid, dim), strict=False):
        if 0 < period < reach:
            allowed = f"{axis} repeats after {period:g} m, but particles see {reach:g} m far: less spacing or smoothing"
            yield Problem("fluid.spacing", fluid.spacing, allowed, (*uses, "fluid.smoothing", "fluid.sides"))
