"""What a scene must keep across its tables; every check yields the mistakes it finds.

The schema has judged each value by itself by now, so types and signs are right here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from petfsi.errors import InputError
from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.schema import Box, Fluid, InflowSide, Probe, Scene, Shape, Solid
from petfsi.scene.stepping import Stepping

MAX_STEPS = 10**8
#: PETSc numbers unknowns with 32 bits.
MAX_CELLS = 2**31 - 1
#: Bodies may touch the grid's sides and each other; this fraction of a length is round-off.
SLACK = 1e-9

OPPOSITE = (("left", "right"), ("bottom", "top"), ("back", "front"))
SOLID_QUANTITIES = ("displacement", "velocity")
NO_Z = "bounds z, which dim = 2 does not have"
#: Columns of history.csv, which a scalar probe must not repeat.
RESERVED_PROBES = ("step", "time", "dt", "iterations", "residual", "volume_error", "divergence")

Problems = Iterator[Problem]


def problems(scene: Scene) -> list[Problem]:
    """Return every mistake that shows only when several settings are seen together."""
    return [problem for check in CHECKS for problem in check(scene)]


def check_inside_grid(scene: Scene, key: str, points: np.ndarray) -> None:
    """Raise unless a solid's points at rest, from a mesh file, lie inside the fluid's grid.

    Not collective; call it where the mesh is read. Without a fluid every place is fine.
    """
    if scene.fluid is None:
        return
    for problem in _outside_grid(scene.fluid, key, points.min(axis=0).tolist(), points.max(axis=0).tolist()):
        raise InputError(str(problem))


# ---- the whole ----------------------------------------------------------------------------------------------


def _contents(scene: Scene) -> Problems:
    if scene.fluid is None and not scene.solids:
        yield Problem("fluid", ABSENT, "the scene needs a [fluid], or at least one [solids.<name>]", ("solids",))
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
    for name in scene.probes.keys() & set(RESERVED_PROBES):
        yield Problem(f"probes.{name}", ABSENT, f"'{name}' is a column of history.csv; call the probe something else")


def _time(scene: Scene) -> Problems:
    time = scene.time
    try:
        stepping = Stepping(time)
        dt = stepping.length(0.0)
    except ExpressionError as error:
        yield Problem("time.dt", time.dt, error.reason, ("time.end",))
        return
    if dt > time.end:
        yield Problem("time.dt", time.dt, f"must not exceed time.end = {time.end:g} s", ("time.end",))
    elif stepping.constant and not time.end / dt <= MAX_STEPS:
        allowed = f"makes {time.end / dt:.3g} steps to time.end = {time.end:g} s; at most {MAX_STEPS:.0e} may be"
        yield Problem("time.dt", time.dt, allowed, ("time.end",))


# ---- lengths ------------------------------------------------------------------------------------------------


def _length(key: str, value: Sequence | None, dim: int) -> Problems:
    if value is not None and len(value) != dim:
        yield Problem(key, value, f"must have {dim} items, as dim = {dim}", ("dim",))


def _box(key: str, box: Box | Fluid, dim: int) -> Problems:
    yield from _length(f"{key}.origin", box.origin, dim)
    yield from _length(f"{key}.size", box.size, dim)
    yield from _length(f"{key}.cells", box.cells, dim)
    if min(box.size, default=1.0) <= 0:
        yield Problem(f"{key}.size", box.size, "must be greater than 0 along every axis (m)")
    if box.cells is not None and math.prod(box.cells) > MAX_CELLS:
        yield Problem(f"{key}.cells", box.cells, f"make more than {MAX_CELLS} cells, the most that can be numbered")


def _is_measured(box: Box | Fluid, dim: int) -> bool:
    """Whether a box is sound enough to compare places with it."""
    return len(box.origin) == len(box.size) == dim and min(box.size) > 0


# ---- fluid --------------------------------------------------------------------------------------------------


def _fluid(scene: Scene) -> Problems:
    fluid = scene.fluid
    if fluid is None:
        return
    yield from _box("fluid", fluid, scene.dim)
    yield from _length("fluid.initial.velocity", fluid.initial.velocity, scene.dim)
    if fluid.smoke is not None and fluid.smoke.buoyancy != 0 and scene.gravity is None:
        allowed = "buoyancy is a multiple of gravity; set gravity too, or buoyancy to 0"
        yield Problem("fluid.smoke.buoyancy", fluid.smoke.buoyancy, allowed, ("gravity",))


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
            yield Problem(f"fluid.sides.{side}", getattr(sides, side), NO_Z, ("dim",))
    inflows = [(side, table.inflow) for side, table in sides if isinstance(table, InflowSide)]
    for side, inflow in inflows:
        key = f"fluid.sides.{side}.inflow"
        if inflow.region is not None:
            yield from _analytic_shape(f"{key}.region", inflow.region, scene.dim)
        if inflow.smoke > 0 and scene.fluid.smoke is None:
            allowed = "smoke needs a table [fluid.smoke] (it may be empty)"
            yield Problem(f"{key}.smoke", inflow.smoke, allowed, ("fluid.smoke",))
    leaves = any(form == "open" for _, form in sides) or any(inflow.rest == "open" for _, inflow in inflows)
    if len(inflows) == 1 and not leaves and not scene.solids:
        allowed = 'what flows in must be able to leave: make a side open, or set rest = "open" here'
        yield Problem(f"fluid.sides.{inflows[0][0]}.inflow", ABSENT, allowed, ("fluid.sides", "solids"))


# ---- shapes -------------------------------------------------------------------------------------------------


def _shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge what any shape must keep, wherever it stands."""
    kinds = shape.kinds
    if len(kinds) != 1:
        found = ", ".join(kinds) or ABSENT
        yield Problem(key, found, "must have exactly one of box, ball, cylinder, halfspace, mesh")
    if shape.box is not None:
        yield from _box(f"{key}.box", shape.box, dim)
    if shape.ball is not None:
        yield from _length(f"{key}.ball.centre", shape.ball.centre, dim)
    if shape.cylinder is not None:
        yield from _cylinder(f"{key}.cylinder", shape, dim)
    if shape.halfspace is not None:
        yield from _length(f"{key}.halfspace.point", shape.halfspace.point, dim)
        yield from _length(f"{key}.halfspace.normal", shape.halfspace.normal, dim)
        if not any(shape.halfspace.normal):
            yield Problem(f"{key}.halfspace.normal", shape.halfspace.normal, "must not be zero")
    yield from _length(f"{key}.translate", shape.translate, dim)
    for name in ("scale", "translate"):
        if shape.mesh is None and name in shape.model_fields_set and getattr(shape, name) not in (1.0, None):
            yield Problem(f"{key}.{name}", getattr(shape, name), "belongs to a mesh file only", (f"{key}.mesh",))


def _cylinder(key: str, shape: Shape, dim: int) -> Problems:
    cylinder = shape.cylinder
    assert cylinder is not None
    if dim == 2:
        yield Problem(key, ABSENT, "a cylinder needs dim = 3; in 2D use ball, a disk", ("dim",))
        return
    yield from _length(f"{key}.start", cylinder.start, dim)
    yield from _length(f"{key}.end", cylinder.end, dim)
    if cylinder.start == cylinder.end:
        yield Problem(f"{key}.end", cylinder.end, "must differ from start")


def _plain_shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge a shape that is never meshed."""
    yield from _shape(key, shape, dim)
    if shape.box is not None and shape.box.cells is not None:
        yield Problem(f"{key}.box.cells", shape.box.cells, "only a solid's box is meshed; leave cells out")
    if shape.cavity is not None:
        yield Problem(f"{key}.cavity", ABSENT, "only a solid's box can have a cavity")


def _analytic_shape(key: str, shape: Shape, dim: int) -> Problems:
    """Judge a shape that picks out points."""
    yield from _plain_shape(key, shape, dim)
    if shape.mesh is not None:
        yield Problem(f"{key}.mesh", shape.mesh, "must be a box, ball, cylinder or halfspace here")


def _solid_shape(key: str, shape: Shape, dim: int) -> Problems:
    yield from _shape(key, shape, dim)
    for kind in ("ball", "cylinder", "halfspace"):
        if getattr(shape, kind) is not None:
            yield Problem(f"{key}.{kind}", ABSENT, "a solid must be meshed: give a box with cells, or a mesh file")
    if shape.box is not None and shape.box.cells is None:
        yield Problem(f"{key}.box.cells", ABSENT, "is missing; a solid's box needs its number of cells per axis")
    if shape.cavity is not None:
        yield from _cavity(key, shape, dim)


def _cavity(key: str, shape: Shape, dim: int) -> Problems:
    box, cavity = shape.box, shape.cavity
    assert cavity is not None
    if box is None:
        yield Problem(f"{key}.cavity", ABSENT, "belongs to a meshed box only", (f"{key}.box",))
        return
    yield from _box(f"{key}.cavity", cavity, dim)
    if cavity.cells is not None:
        yield Problem(f"{key}.cavity.cells", cavity.cells, "a cavity has the cells of its box; leave cells out")
    if not (_is_measured(box, dim) and _is_measured(cavity, dim) and len(box.cells or ()) == dim):
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


def _mesh_files(scene: Scene) -> Problems:
    for table in ("solids", "obstacles"):
        for name, item in getattr(scene, table).items():
            mesh = item.shape.mesh
            if item.shape.kinds == ["mesh"] and not (scene.directory / mesh).is_file():
                # in full, where a value would be shortened: a file's name stands at the end
                yield Problem(f"{table}.{name}.shape.mesh", ABSENT, f"no such file: {mesh}")


def _obstacles(scene: Scene) -> Problems:
    for name, obstacle in scene.obstacles.items():
        yield from _plain_shape(f"obstacles.{name}.shape", obstacle.shape, scene.dim)


# ---- solids -------------------------------------------------------------------------------------------------


def _solids(scene: Scene) -> Problems:
    for name, solid in scene.solids.items():
        key = f"solids.{name}"
        yield from _solid_shape(f"{key}.shape", solid.shape, scene.dim)
        yield from _length(f"{key}.initial.velocity", solid.initial.velocity, scene.dim)
        yield from _length(f"{key}.initial.displacement", solid.initial.displacement, scene.dim)
        yield from _supports(key, solid, scene.dim)
        box = solid.shape.box
        if scene.fluid is not None and box is not None and _is_measured(box, scene.dim):
            high = [o + s for o, s in zip(box.origin, box.size, strict=True)]
            yield from _outside_grid(scene.fluid, f"{key}.shape.box", box.origin, high)
    yield from _overlaps(scene)


def _supports(key: str, solid: Solid, dim: int) -> Problems:
    for n, support in enumerate(solid.supports):
        here = f"{key}.supports.{n}"
        if isinstance(support.where, Shape):
            yield from _analytic_shape(f"{here}.where", support.where, dim)
        elif support.where in OPPOSITE[2] and dim == 2:
            yield Problem(f"{here}.where", support.where, NO_Z, ("dim",))
        if "z" in support.fix and dim == 2:
            yield Problem(f"{here}.fix", support.fix, "must be out of x, y, as dim = 2", ("dim",))
        if len(set(support.fix)) < len(support.fix):
            yield Problem(f"{here}.fix", support.fix, "names an axis twice")
        for axis in support.velocity:
            if axis not in support.fix:
                allowed = f"a velocity belongs to fixed axes only; fix = {support.fix}"
                yield Problem(f"{here}.velocity.{axis}", support.velocity[axis], allowed, (f"{here}.fix",))


def _outside_grid(fluid: Fluid, key: str, low: Sequence[float], high: Sequence[float]) -> Problems:
    """Yield a problem if a solid's bounding box does not lie in the grid."""
    if not _is_measured(fluid, len(low)):
        return
    for axis, a, b, start, size in zip("xyz", low, high, fluid.origin, fluid.size, strict=False):
        if a < start - SLACK * size or b > start + size + SLACK * size:
            allowed = f"{axis} must lie inside the fluid's grid, {start:g} to {start + size:g} m"
            yield Problem(key, f"{axis} from {a:g} to {b:g} m", allowed, ("fluid.origin", "fluid.size"))


def _overlaps(scene: Scene) -> Problems:
    """Refuse boxes that share material: no body may start inside another."""
    boxes = [
        (name, solid.shape.box)
        for name, solid in scene.solids.items()
        if solid.shape.box is not None and solid.shape.cavity is None and _is_measured(solid.shape.box, scene.dim)
    ]
    for (first, a), (second, b) in combinations(boxes, 2):
        shared = [
            min(p + m, q + n) - max(p, q) - SLACK * max(m, n)
            for p, m, q, n in zip(a.origin, a.size, b.origin, b.size, strict=True)
        ]
        if min(shared) > 0:
            allowed = f"overlaps solids.{first}; bodies must lie apart"
            yield Problem(f"solids.{second}.shape.box", ABSENT, allowed, (f"solids.{first}.shape",))


# ---- probes -------------------------------------------------------------------------------------------------


def _probes(scene: Scene) -> Problems:
    for name, probe in scene.probes.items():
        key = f"probes.{name}"
        yield from _length(f"{key}.at", probe.at, scene.dim)
        if probe.of == "fluid":
            yield from _fluid_probe(scene, key, probe)
        elif probe.of not in scene.solids:
            known = ", ".join([*(["fluid"] if scene.fluid else []), *scene.solids]) or "fluid, or a solid's name"
            yield Problem(f"{key}.of", probe.of, f"must be one of {known}", (f"solids.{probe.of}",))
        elif probe.quantity not in SOLID_QUANTITIES:
            allowed = f"a solid has {' and '.join(SOLID_QUANTITIES)}"
            yield Problem(f"{key}.quantity", probe.quantity, allowed, (f"{key}.of",))


def _fluid_probe(scene: Scene, key: str, probe: Probe) -> Problems:
    fluid = scene.fluid
    if fluid is None:
        yield Problem(f"{key}.of", "fluid", f"the scene has no [fluid], only {', '.join(scene.solids)}", ("fluid",))
        return
    if probe.quantity == "displacement":
        yield Problem(f"{key}.quantity", probe.quantity, "a fluid has velocity, pressure and smoke", (f"{key}.of",))
    if probe.quantity == "smoke" and fluid.smoke is None:
        yield Problem(f"{key}.quantity", "smoke", "the fluid has no [fluid.smoke]", (f"{key}.of", "fluid.smoke"))
    if len(probe.at) == scene.dim:
        for problem in _outside_grid(fluid, f"{key}.at", probe.at, probe.at):
            yield Problem(problem.key, probe.at, problem.allowed, (*problem.uses, f"{key}.of"))
            break


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
                yield f"fluid.sides.{side}.inflow.speed", form.inflow.speed, (*space, "t")
    for name, solid in scene.solids.items():
        yield from each(f"solids.{name}.initial.velocity", solid.initial.velocity, space)
        yield from each(f"solids.{name}.initial.displacement", solid.initial.displacement, space)
        for n, support in enumerate(solid.supports):
            for axis, value in support.velocity.items():
                yield f"solids.{name}.supports.{n}.velocity.{axis}", value, (*space, "t")


def _expressions(scene: Scene) -> Problems:
    yield from _length("gravity", scene.gravity, scene.dim)
    for key, source, variables in expressions(scene):
        try:
            Expression(source, variables, key)
        except ExpressionError as error:
            yield Problem(key, source, error.reason, ("dim",))


CHECKS: tuple[Callable[[Scene], Problems], ...] = (
    _contents,
    _names,
    _time,
    _fluid,
    _sides,
    _solids,
    _obstacles,
    _mesh_files,
    _probes,
    _expressions,
)
