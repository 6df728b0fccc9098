"""What beams must keep; each check yields the mistakes it finds."""

from __future__ import annotations

import math

from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import Problems, length
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Beam

#: Settings of a solid that say nothing about a beam; they must keep their defaults.
WITHOUT_MEANING = ("material", "tangent", "elements", "volumetric", "interior")


def is_sound(beam: Beam, dim: int) -> bool:
    """Whether a beam has a length and a direction."""
    return len(beam.start) == len(beam.end) == dim == 2 and beam.start != beam.end


def corners(beam: Beam) -> tuple[list[float], list[float]]:
    """Return the lower and upper corner of a sound beam at rest, faces included."""
    dx, dy = (b - a for a, b in zip(beam.start, beam.end, strict=True))
    reach = [beam.thickness / 2 * abs(c) / math.hypot(dx, dy) for c in (dy, dx)]
    low = [min(a, b) - r for a, b, r in zip(beam.start, beam.end, reach, strict=True)]
    high = [max(a, b) + r for a, b, r in zip(beam.start, beam.end, reach, strict=True)]
    return low, high


def beam_shape(key: str, beam: Beam, dim: int) -> Problems:
    """Judge the shape of a beam."""
    if dim != 2:
        yield Problem(key, ABSENT, "a beam needs dim = 2; in 3D use a box or a mesh", ("dim",))
        return
    yield from length(f"{key}.start", beam.start, dim)
    yield from length(f"{key}.end", beam.end, dim)
    if beam.start == beam.end:
        yield Problem(f"{key}.end", beam.end, "must differ from start")
    elif is_sound(beam, dim) and beam.thickness >= math.dist(beam.start, beam.end):
        allowed = f"must be less than the length, {math.dist(beam.start, beam.end):g} m; a beam is slender"
        yield Problem(f"{key}.thickness", beam.thickness, allowed, (f"{key}.start", f"{key}.end"))


def beams(scene: Scene) -> Problems:
    """Judge what beams need of other settings."""
    for name, solid in scene.solids.items():
        if solid.shape.beam is not None:
            yield from _settings(f"solids.{name}", solid)


def _settings(key: str, solid: Solid) -> Problems:
    for name in WITHOUT_MEANING:
        field = Solid.model_fields.get(name)
        if field is not None and getattr(solid, name) != field.default:
            allowed = "means nothing to a beam, which has a theory; leave it out"
            yield Problem(f"{key}.{name}", getattr(solid, name), allowed, (f"{key}.shape.beam",))
