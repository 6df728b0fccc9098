"""What the loads of a solid must keep, and the places where loads and supports are; each check yields mistakes."""

from __future__ import annotations

from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.shape_checks import NO_Z, OPPOSITE, Problems, analytic_shape, length
from petfsi.scene.solids import Load, Solid, Tagged
from petfsi.scene.tables import Shape


def place(key: str, where: str | Shape | Tagged | None, shape_key: str, shape: Shape, dim: int) -> Problems:
    """Judge what picks out nodes or facets of a solid with the given shape."""
    if isinstance(where, Shape):
        yield from analytic_shape(key, where, dim)
    elif isinstance(where, Tagged):
        if shape.mesh is None:
            allowed = "a tag is a mesh file's, and the solid's shape is none"
            yield Problem(f"{key}.tag", where.tag, allowed, (shape_key,))
    elif where in OPPOSITE[2] and dim == 2:
        yield Problem(key, where, NO_Z, ("dim",))
    elif where in ("start", "end") and shape.beam is None:
        yield Problem(key, where, "only a beam has a start and an end", (shape_key,))


def solid_loads(key: str, solid: Solid, dim: int) -> Problems:
    """Judge the body force and the loads of a solid."""
    yield from length(f"{key}.body_force", solid.body_force, dim)
    for n, load in enumerate(solid.loads):
        here = f"{key}.loads.{n}"
        yield from _kind(here, load, solid)
        yield from place(f"{here}.where", load.where, f"{key}.shape", solid.shape, dim)
        for name in ("traction", "force", "at"):
            yield from length(f"{here}.{name}", getattr(load, name), dim)


def _kind(key: str, load: Load, solid: Solid) -> Problems:
    """Yield what keeps a load from being exactly one of a traction, a pressure and a force."""
    kinds = load.kinds
    if len(kinds) != 1:
        allowed = "must have exactly one of traction, pressure (both with where) and force (with at)"
        uses = tuple(f"{key}.{name}" for name in ("traction", "pressure", "force"))
        yield Problem(key, ", ".join(kinds) or ABSENT, allowed, uses)
        return
    wanted, other = ("at", "where") if kinds == ["force"] else ("where", "at")
    if getattr(load, other) is not None:
        yield Problem(f"{key}.{other}", ABSENT, f"a {kinds[0]} has {wanted} instead", (f"{key}.{kinds[0]}",))
    elif getattr(load, wanted) is None:
        yield Problem(f"{key}.{wanted}", ABSENT, f"is missing; a {kinds[0]} needs it", (f"{key}.{kinds[0]}",))
    if load.moment is not None and solid.shape.beam is None:
        yield Problem(f"{key}.moment", load.moment, "only a beam feels a moment", (f"{key}.at",))
    if kinds == ["force"] and load.follower and solid.shape.beam is None:
        allowed = "a force at a point of this solid keeps its direction: there is nothing that it could turn with"
        yield Problem(f"{key}.follower", True, allowed, (f"{key}.force",))
