"""What a fluid of particles must keep; each check yields the mistakes it finds."""

from __future__ import annotations

from collections.abc import Iterator

from petfsi.scene.fluids import SphFluid
from petfsi.scene.mistakes import Problem
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import MAX_CELLS, is_measured, periods, plain_shape

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
    yield from _viscosity(scene, fluid)


def why_explicit(scene: Scene) -> tuple[str, str] | None:
    """Return why the viscosity of particles cannot be solved for, and the key that says so; None if it can."""
    assert isinstance(scene.fluid, SphFluid)
    if scene.fluid.viscosity == 0:
        return "there is none to solve for", "fluid.viscosity"
    if scene.solids and scene.time.integrator == "symplectic-euler":
        return "symplectic-euler solves for nothing", "time.integrator"
    if scene.solids and scene.transfer == "repulsion":
        return "repulsion has no drag to solve for", "coupling.transfer"
    return None


def _viscosity(scene: Scene, fluid: SphFluid) -> Iterator[Problem]:
    """Judge whether viscosity can be solved for, if it shall be."""
    reason = why_explicit(scene)
    if fluid.viscosity_solve == "implicit" and reason:
        yield Problem("fluid.viscosity_solve", "implicit", f"cannot be: {reason[0]}", (reason[1],))


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
