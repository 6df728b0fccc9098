"""What a scene must keep across its tables; every check yields the mistakes it finds.

The schema has judged each value by itself by now, so types and signs are right here.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.scene.beam_checks import beam_shape, beams, corners, is_sound
from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.fluid_kinds import Fluid
from petfsi.scene.fluids import MacFluid
from petfsi.scene.load_checks import place, solid_loads
from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.particle_checks import particles
from petfsi.scene.probe_checks import probes
from petfsi.scene.scale_checks import scales
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import (
    NO_Z,
    OPPOSITE,
    Problems,
    analytic_shape,
    extent,
    images,
    is_measured,
    length,
    may_meet,
    outside_grid,
    overlap,
    periods,
    plain_shape,
    sizes,
    solid_shape,
)
from petfsi.scene.side_checks import grid_sides
from petfsi.scene.sides import GridInflow, Inflow, InflowSide, MovingSide, PressureSide, open_side
from petfsi.scene.solids import Solid
from petfsi.scene.stepping import Stepping
from petfsi.scene.tables import Halfspace

MAX_STEPS = 10**8
#: Characters of a file's name that are shown.
LONGEST = 300

#: Columns of history.csv, which a probe must not repeat.
RESERVED_PROBES = (
    "step", "time", "dt", "iterations", "residual", "newton", "substeps", "volume_error", "divergence",
    "region_volume", "momentum", "kinetic", "elastic", "potential", "dissipated", "load_work", "boundary_work",
    "energy_residual", "particles", "put_back", "particles_behind", "mass", "mass_in", "mass_out",
)  # fmt: skip


def problems(scene: Scene) -> list[Problem]:
    """Return every mistake that shows only when several settings are seen together."""
    with np.errstate(all="ignore"):  # what overflows is told by the last of them
        found = [problem for check in CHECKS for problem in check(scene)]
        told = {problem.key for problem in found}
        return found + [problem for problem in scales(scene) if problem.key not in told]


def check_inside_grid(scene: Scene, key: str, points: np.ndarray) -> None:
    """Raise unless a solid's points at rest, from a mesh file, lie inside the fluid's grid.

    Not collective; call it where the mesh is read. Without a fluid every place is fine.
    """
    if scene.fluid is None:
        return
    for problem in outside_grid(scene.fluid, key, points.min(axis=0).tolist(), points.max(axis=0).tolist()):
        raise InputError(str(problem))


# ---- the whole ----------------------------------------------------------------------------------------------


def _contents(scene: Scene) -> Problems:
    if scene.fluid is None and not scene.solids:
        yield Problem("fluid", ABSENT, "the scene needs a [fluid], or at least one [solids.NAME]", ("solids",))
    if scene.fluid is None and scene.obstacles:
        names = ", ".join(scene.obstacles)
        yield Problem("obstacles", names, "only a fluid feels obstacles, and the scene has no [fluid]", ("fluid",))


def _names(scene: Scene) -> Problems:
    for table in ("solids", "obstacles", "probes"):
        for name in getattr(scene, table):
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
                yield Problem(f"{table}.{name}", ABSENT, "a name must be made of letters, digits and _, no digit first")
    if "fluid" in scene.solids:
        yield Problem("solids.fluid", ABSENT, "the name 'fluid' means the fluid; call the solid something else")
    for name in scene.obstacles.keys() & {side for pair in OPPOSITE for side in pair}:
        yield Problem(f"obstacles.{name}", ABSENT, f"'{name}' is a side of the fluid; call the obstacle something else")
    for name in scene.probes.keys() & set(RESERVED_PROBES):
        yield Problem(f"probes.{name}", ABSENT, f"'{name}' is a column of history.csv; call the probe something else")


def _time(scene: Scene) -> Problems:
    time = scene.time
    try:
        stepping = Stepping(time)
        dt = stepping.wanted(0.0)
    except ExpressionError as error:
        yield Problem("time.dt", time.dt, error.reason, ("time.end",))
        return
    explicit = time.scheme.explicit or (scene.fluid is not None and scene.fluid.kind == "sph")
    if stepping.auto and not explicit:
        allowed = "is the stable step of what is explicit, particles or symplectic-euler; give a length (s)"
        yield Problem("time.dt", time.dt, allowed, ("time.integrator", "fluid.kind"))
    if dt > time.end:
        yield Problem("time.dt", time.dt, f"must not exceed time.end = {time.end:g} s", ("time.end",))
    elif stepping.constant and not time.end / dt <= MAX_STEPS:
        allowed = f"makes {time.end / dt:.3g} steps to time.end = {time.end:g} s; at most {MAX_STEPS:.0e} may be"
        yield Problem("time.dt", time.dt, allowed, ("time.end",))


def _static(scene: Scene) -> Problems:
    """Refuse what has no meaning where nothing moves by itself."""
    if scene.time.scheme.inertia:
        return
    uses = ("time.integrator",)
    if scene.fluid is not None:
        yield Problem("time.integrator", "static", "finds the equilibrium of solids; take out the [fluid]", ("fluid",))
    for name, solid in scene.solids.items():
        key = f"solids.{name}"
        if solid.initial.velocity is not None:
            allowed = "nothing has a velocity in statics: leave it out"
            yield Problem(f"{key}.initial.velocity", solid.initial.velocity, allowed, uses)
        for kind in ("mass", "stiffness"):
            if getattr(solid.damping, kind) != 0:
                allowed = "nothing is damped in statics: leave it out, or 0"
                yield Problem(f"{key}.damping.{kind}", getattr(solid.damping, kind), allowed, uses)


# ---- fluid --------------------------------------------------------------------------------------------------


def _fluid(scene: Scene) -> Problems:
    fluid = scene.fluid
    if fluid is None:
        return
    yield from sizes("fluid", fluid, scene.dim)
    yield from length("fluid.initial.velocity", fluid.initial.velocity, scene.dim)
    if fluid.smoke is not None and fluid.smoke.buoyancy != 0 and scene.gravity is None:
        allowed = "buoyancy is a multiple of gravity; set gravity too, or buoyancy to 0"
        yield Problem("fluid.smoke.buoyancy", fluid.smoke.buoyancy, allowed, ("gravity",))


def _transfer(scene: Scene) -> Problems:
    if scene.fluid is None or (scene.coupling.transfer is None and not scene.solids):
        return
    if scene.transfer not in scene.fluid.transfers:
        known = f"must be one of {', '.join(scene.fluid.transfers)}" if scene.fluid.transfers else "there is none"
        allowed = f"{known} for fluid.kind = {scene.fluid.kind}"
        yield Problem("coupling.transfer", scene.transfer, allowed, ("fluid.kind",))


def _sides(scene: Scene) -> Problems:
    if scene.fluid is None:
        return
    sides = scene.fluid.sides
    for pair in OPPOSITE[: scene.dim]:
        for side, other in (pair, pair[::-1]):
            if getattr(sides, side) == "periodic" and getattr(sides, other) != "periodic":
                yield Problem(
                    f"fluid.sides.{side}",
                    "periodic",
                    f"the opposite side '{other}' must be periodic too",
                    (f"fluid.sides.{other}",),
                )
    for side in OPPOSITE[2] if scene.dim == 2 else ():
        if side in sides.model_fields_set:
            form = getattr(sides, side)
            yield Problem(f"fluid.sides.{side}", form if isinstance(form, str) else ABSENT, NO_Z, ("dim",))
    inflows = [(side, table.inflow) for side, table in sides if isinstance(table, InflowSide)]
    for side, inflow in inflows:
        key = f"fluid.sides.{side}.inflow"
        if inflow.region is not None:
            yield from analytic_shape(f"{key}.region", inflow.region, scene.dim)
    yield from _jets(scene, inflows)


def _jets(scene: Scene, inflows: list[tuple[str, Inflow]]) -> Problems:
    """Judge what flows into a grid: particles carry no smoke, and may fill what was empty."""
    fluid = scene.fluid
    if not isinstance(fluid, MacFluid):
        return
    for side, inflow in inflows:
        assert isinstance(inflow, GridInflow)
        if inflow.smoke > 0 and fluid.smoke is None:
            allowed = "smoke needs a table [fluid.smoke] (it may be empty)"
            yield Problem(f"fluid.sides.{side}.inflow.smoke", inflow.smoke, allowed, ("fluid.smoke",))
    leaves = any(open_side(form) is not None for _, form in fluid.sides)
    if len(inflows) == 1 and not leaves and not scene.solids and not _varies_along(inflows[0][1]):
        allowed = 'what flows in must be able to leave: make a side open, or set rest = "open" here'
        yield Problem(f"fluid.sides.{inflows[0][0]}.inflow", ABSENT, allowed, ("fluid.sides", "solids"))


def _varies_along(inflow: Inflow) -> bool:
    """Return whether a jet's speed depends on the place: one part of its side may draw out what another lets in."""
    return not Expression(inflow.speed).names.isdisjoint("xyz")


# ---- obstacles ----------------------------------------------------------------------------------------------


def _mesh_files(scene: Scene) -> Problems:
    tables = (("solids", scene.solids), ("obstacles", scene.obstacles))
    shapes = {f"{table}.{name}.shape": item.shape for table, items in tables for name, item in items.items()}
    shapes |= {f"fluid.fill.{n}": shape for n, shape in enumerate(getattr(scene.fluid, "fill", []))}
    for key, shape in shapes.items():
        if shape.kinds == ["mesh"] and (why := unreadable(scene.directory / str(shape.mesh))):
            # nearly in full, where a value would be shortened
            yield Problem(f"{key}.mesh", ABSENT, f"{why}: {shown(str(shape.mesh), LONGEST)}")


def unreadable(path: Path) -> str:
    """Return why a file cannot be read, or nothing."""
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            return "is no file but a folder" if stat.S_ISDIR(mode) else "is no file but a device or a pipe"
        with path.open("rb"):
            return ""
    except FileNotFoundError:
        return "no such file"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _obstacles(scene: Scene) -> Problems:
    for name, obstacle in scene.obstacles.items():
        key, shape = f"obstacles.{name}.shape", obstacle.shape
        yield from plain_shape(key, shape, scene.dim)
        if scene.fluid is not None and shape.halfspace is not None:
            yield from _repeats(key, shape.halfspace, scene.fluid)


def _repeats(key: str, halfspace: Halfspace, fluid: Fluid) -> Problems:
    """Refuse a half space that its own images across periodic sides would fill up."""
    for axis, component, (side, other) in zip("xyz", halfspace.normal, OPPOSITE, strict=False):
        if component != 0 and getattr(fluid.sides, side) == getattr(fluid.sides, other) == "periodic":
            allowed = f"must not lean along {axis}, whose sides are periodic"
            uses = (f"fluid.sides.{side}", f"fluid.sides.{other}")
            yield Problem(f"{key}.halfspace.normal", halfspace.normal, allowed, uses)


# ---- solids -------------------------------------------------------------------------------------------------


def _solids(scene: Scene) -> Problems:
    for name, solid in scene.solids.items():
        key = f"solids.{name}"
        yield from solid_shape(f"{key}.shape", solid.shape, scene.dim)
        yield from _initial(key, solid, scene.dim)
        yield from _supports(key, solid, scene.dim)
        yield from solid_loads(key, solid, scene.dim)
        beam = solid.shape.beam
        if beam is not None:
            yield from beam_shape(f"{key}.shape.beam", beam, scene.dim)
        reach = corners(beam) if beam and is_sound(beam, scene.dim) else extent(solid.shape, scene.dim)
        if scene.fluid is not None and reach is not None:
            yield from outside_grid(scene.fluid, f"{key}.shape.{solid.shape.kinds[0]}", *reach)
    yield from _overlaps(scene)
    yield from beams(scene)


def _initial(key: str, solid: Solid, dim: int) -> Problems:
    for name in ("velocity", "displacement"):
        given = getattr(solid.initial, name)
        if solid.shape.beam is None or given is None or len(given) != dim + 1:
            yield from length(f"{key}.initial.{name}", given, dim)


def _supports(key: str, solid: Solid, dim: int) -> Problems:
    for n, support in enumerate(solid.supports):
        here = f"{key}.supports.{n}"
        yield from place(f"{here}.where", support.where, f"{key}.shape", solid.shape, dim)
        if "z" in support.fix and dim == 2:
            yield Problem(f"{here}.fix", support.fix, "must be out of x, y, as dim = 2", ("dim",))
        if "angle" in support.fix and solid.shape.beam is None:
            yield Problem(f"{here}.fix", support.fix, "only a beam has an angle", (f"{key}.shape",))
        if len(set(support.fix)) < len(support.fix):
            yield Problem(f"{here}.fix", support.fix, "names an axis twice")
        for quantity in ("velocity", "displacement"):
            for axis, value in getattr(support, quantity).items():
                if axis not in support.fix:
                    allowed = f"a {quantity} belongs to fixed axes only; fix = {support.fix}"
                    yield Problem(f"{here}.{quantity}.{axis}", value, allowed, (f"{here}.fix",))
        for axis in support.displacement.keys() & support.velocity.keys():
            allowed = "the axis has a velocity too; give one of the two"
            yield Problem(f"{here}.displacement.{axis}", support.displacement[axis], allowed, (f"{here}.velocity",))


def _overlaps(scene: Scene) -> Problems:
    """Refuse boxes and balls that share material: no body may start inside another."""
    whole = [
        (name, solid.shape, reach)
        for name, solid in scene.solids.items()
        if solid.shape.cavity is None and (reach := extent(solid.shape, scene.dim)) is not None
    ]
    measured = scene.fluid is None or is_measured(scene.fluid, scene.dim)
    period = periods(scene.fluid, scene.dim) if measured else np.zeros(scene.dim)
    corners = np.array([reach for *_, reach in whole], dtype=float).reshape(-1, 2, scene.dim)
    for i, j in may_meet(corners[:, 0], corners[:, 1], period):
        (first, a, reach), (second, b, other) = whole[i], whole[j]
        if any(overlap(a, b, scene.dim, shift) for shift in images(period, reach, other)):
            allowed = f"overlaps solids.{first}; bodies must lie apart"
            yield Problem(f"solids.{second}.shape.{b.kinds[0]}", ABSENT, allowed, (f"solids.{first}.shape",))


# ---- expressions --------------------------------------------------------------------------------------------


def expressions(scene: Scene) -> Iterator[tuple[str, float | str, tuple[str, ...]]]:
    """Yield the key, the source and the variables of every expression in a scene."""
    space = ("x", "y", "z")[: scene.dim]

    def each(key: str, values: Sequence[float | str] | None, variables: tuple[str, ...]) -> Iterator:
        for n, value in enumerate(values or ()):
            yield f"{key}.{n}", value, variables

    yield from each("gravity", scene.gravity, ("t",))
    if scene.fluid is not None:
        yield from each("fluid.initial.velocity", scene.fluid.initial.velocity, space)
        if scene.fluid.smoke is not None:
            yield "fluid.smoke.initial", scene.fluid.smoke.initial, space
        for side, form in scene.fluid.sides:
            if isinstance(form, InflowSide):
                key = f"fluid.sides.{side}.inflow"
                yield f"{key}.speed", form.inflow.speed, (*space, "t")
                if isinstance(form.inflow, GridInflow):
                    yield from each(f"{key}.along", form.inflow.along, (*space, "t"))
                    if isinstance(form.inflow.rest, PressureSide):
                        yield f"{key}.rest.pressure", form.inflow.rest.pressure, (*space, "t")
            elif isinstance(form, PressureSide):
                yield f"fluid.sides.{side}.pressure", form.pressure, (*space, "t")
            elif isinstance(form, MovingSide):
                yield from each(f"fluid.sides.{side}.no-slip.velocity", form.no_slip.velocity, (*space, "t"))
    for name, solid in scene.solids.items():
        yield from each(f"solids.{name}.initial.velocity", solid.initial.velocity, space)
        yield from each(f"solids.{name}.initial.displacement", solid.initial.displacement, space)
        yield from each(f"solids.{name}.body_force", solid.body_force, (*space, "t"))
        for n, support in enumerate(solid.supports):
            for quantity in ("velocity", "displacement"):
                for axis, value in getattr(support, quantity).items():
                    yield f"solids.{name}.supports.{n}.{quantity}.{axis}", value, (*space, "t")
        for n, load in enumerate(solid.loads):
            key = f"solids.{name}.loads.{n}"
            yield from each(f"{key}.traction", load.traction, (*space, "t"))
            yield from each(f"{key}.force", load.force, (*space, "t"))
            for quantity in ("pressure", "moment"):
                if getattr(load, quantity) is not None:
                    yield f"{key}.{quantity}", getattr(load, quantity), (*space, "t")


def _expressions(scene: Scene) -> Problems:
    yield from length("gravity", scene.gravity, scene.dim)
    for key, source, variables in expressions(scene):
        try:
            Expression(source, variables, key)
        except ExpressionError as error:
            yield Problem(key, source, error.reason, ("dim",))


CHECKS: tuple[Callable[[Scene], Problems], ...] = (
    _contents,
    _names,
    _time,
    _static,
    _fluid,
    _transfer,
    _sides,
    grid_sides,
    particles,
    _solids,
    _obstacles,
    _mesh_files,
    probes,
    _expressions,
)
