"""What each kind of fluid would take: its part of the plan of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

from petfsi.registry import FLUIDS, find
from petfsi.scene.fluids import MacFluid, SphFluid
from petfsi.scene.schema import Scene
from petfsi.scene.side_notes import side_notes

#: Vectors of the length of all unknowns: those of 30 flexible GMRES iterations, and a few more.
KRYLOV_VECTORS = 65
#: A preconditioner holds about as much as this many copies of its matrix.
PRECONDITIONER = 3.0
#: Bytes of a matrix entry: a value and a column number.
ENTRY_BYTES = 12
#: Bytes that a particle takes with its list of pairs, by dimension.
PARTICLE_BYTES = {2: 400, 3: 700}
#: Particles that one sees at the default smoothing, with the skin, by dimension.
PARTICLE_NEIGHBOURS = {2: 28, 3: 106}


@dataclass(frozen=True)
class FluidPlan:
    """What a scene's fluid would take.

    Attributes
    ----------
    rows : list of (str, str)
        What there is of it, by name.
    unknowns : int
        That are solved for.
    bytes, output_bytes : float
        Of memory on all ranks together, and of one output.
    skipped : list of str
        What is neither allocated nor assembled for it, and why.
    step : float or None
        What limits steps to begin with, s, where something does.
    """

    rows: list[tuple[str, str]]
    unknowns: int
    bytes: float
    output_bytes: float
    skipped: list[str]
    step: float | None = None


def fluid_plan(scene: Scene) -> FluidPlan:
    """Return the plan of a scene's fluid; an empty one without any. Not collective; may read mesh files."""
    if scene.fluid is None:
        return FluidPlan([], 0, 0.0, 0.0, [])
    plan: FluidPlan = find(FLUIDS[scene.fluid.kind].plan)(scene)
    return plan


def fluid_skipped(scene: Scene) -> list[str]:
    """Return what is neither allocated nor assembled for a scene's fluid, and why."""
    skipped: list[str] = [] if scene.fluid is None else find(FLUIDS[scene.fluid.kind].skipped)(scene)
    return skipped


def grid_plan(scene: Scene) -> FluidPlan:
    """Return what a fluid on a grid would take."""
    fluid, dim = scene.fluid, scene.dim
    assert isinstance(fluid, MacFluid)
    n = math.prod(fluid.cells)
    rows = [("pressure", f"{n:,} unknowns, one per cell of {' x '.join(map(str, fluid.cells))}")]
    rows += [("note", note) for note in side_notes(scene)]
    per_output = 8 * (dim + 2 + (fluid.smoke is not None))
    return FluidPlan(rows, n, grid_bytes(fluid, dim), float(n * per_output), grid_skipped(scene))


def grid_bytes(fluid: MacFluid, dim: int) -> float:
    """Return what a grid takes on all ranks together, bytes."""
    arrays = 8 * (4 * dim + 4) + dim + 5 + (16 if fluid.smoke is not None else 0)
    matrix = ENTRY_BYTES * (2 * dim + 1) * (1 + PRECONDITIONER)
    return float(math.prod(fluid.cells) * (arrays + matrix + 8 * KRYLOV_VECTORS))


def grid_skipped(scene: Scene) -> list[str]:
    """Return what such a fluid has no need of."""
    fluid = scene.fluid
    assert isinstance(fluid, MacFluid)
    out = ["viscous terms: viscosity is 0"]
    if fluid.smoke is None:
        out.append("smoke: there is no [fluid.smoke]")
    if not scene.obstacles:
        out.append("obstacles: there are none")
    if not scene.solids:
        out.append("geometry after the first step: sides and obstacles do not move, the matrix stays")
    return out


def particle_plan(scene: Scene) -> FluidPlan:
    """Return what a fluid of particles would take."""
    from petfsi.fields.sph.start import Start

    assert isinstance(scene.fluid, SphFluid)
    start, dim = Start(scene), scene.dim
    n, n_walls, law = len(start.x), len(start.dummies().x), start.law
    unknowns = dim * n if start.implicit else 0
    solved = f"{unknowns:,} unknowns, their velocities" if start.implicit else "no unknowns: they are explicit"
    rows = [("particles", f"{n:,} of {law.spacing:g} m, and {n_walls:,} in walls; {solved}")]
    limits = ", ".join(f"{name} {limit:.3g} s" for name, limit in start.limits().items())
    rows.append(("sound", f"{law.c:.4g} m/s; limits on the step at the start: {limits}"))
    hold = "hold back what is drawn away from them" if law.suction else "let go what is drawn away from them"
    why = "" if scene.fluid.suction is not None else ": no" if law.suction else ": a"
    rows.append(("walls", hold + (why and f"{why} free surface at the start")))
    rows += [("sides", told) for told in [*map(str, start.inlets), *map(str, start.plates)]]
    if law.nu > 0:
        rows.append(("viscosity", start.viscosity_story()))
    rows += [("note", note) for note in start.notes]
    # a row of the matrix, the same in Python and in PETSc, and where pairs go in it
    neighbours = PARTICLE_NEIGHBOURS[dim] * (law.s / law.spacing / 1.5) ** dim
    size = n * (PARTICLE_BYTES[dim] + (unknowns > 0) * neighbours * (2 * dim * ENTRY_BYTES + 16))
    size += n_walls * PARTICLE_BYTES[dim]
    step = min(start.limits().values())
    return FluidPlan(rows, unknowns, float(size), 8.0 * n * (2 * dim + 3), particle_skipped(scene), step)


def particle_skipped(scene: Scene) -> list[str]:
    """Return what such a fluid has no need of."""
    from petfsi.fields.sph.start import Start

    fluid = scene.fluid
    assert isinstance(fluid, SphFluid)
    out = ["viscous terms: viscosity is 0"] if fluid.viscosity == 0 else []
    if fluid.alpha == 0:
        out.append("artificial viscosity: its coefficient is 0")
    if fluid.density_diffusion == 0:
        out.append("diffusion of density: its coefficient is 0")
    if not fluid.shifting:
        out.append("shifting: it is turned off")
    if not scene.obstacles:
        out.append("obstacles: there are none")
    if not scene.solids and not (fluid.viscosity > 0 and Start(scene).implicit):
        out.append("solver: particles are explicit, and nothing else is there; no option under -fsi_ is read")
    return out
