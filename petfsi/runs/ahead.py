"""What is said before a scene is made ready, where that takes long enough to be wondered at."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from petfsi.geometry.shapes import bounds
from petfsi.runs.memory import as_bytes, solid_counts
from petfsi.scene.fluids import MacFluid, SphFluid
from petfsi.scene.schema import Scene

#: What takes less, in seconds of one rank, needs no words.
PATIENCE = 2.0
#: Seconds that making ready takes for a cell of a grid, a particle, an unknown of a solid by dimension, and a byte of a
#: mesh file, as measured; and what counting takes for a particle and for such a byte.
CELL, PARTICLE, UNKNOWN, BYTE = 5e-6, 2.5e-6, {2: 7e-6, 3: 1e-4}, 1e-6
COUNTED_PARTICLE, COUNTED_BYTE = 6e-7, 1e-7


def ahead(scene: Scene, ranks: int = 1, ready: bool = True) -> str:
    """Return a line about how much is made ready, or only counted; nothing where that takes a moment.

    Not collective; makes nothing, reads no mesh.

    Parameters
    ----------
    scene : Scene
    ranks : int
        That share the work.
    ready : bool
        Whether the scene is made ready, as for its first step, not only counted, as for a plan.
    """
    parts = [(text, making if ready else counting) for text, making, counting in _parts(scene)]
    if sum(seconds for _, seconds in parts) <= PATIENCE * ranks:
        return ""
    return f"{'making ready' if ready else 'counting'}: {', '.join(text for text, seconds in parts if seconds)} ..."


def _parts(scene: Scene) -> Iterator[tuple[str, float, float]]:
    """Yield what there is a lot of, and the seconds that one rank takes to make it ready and to count it."""
    fluid, dim = scene.fluid, scene.dim
    if isinstance(fluid, MacFluid):
        cells = math.prod(fluid.cells)
        yield f"{cells:,} cells", CELL * cells, 0.0
    elif isinstance(fluid, SphFluid):
        n = _most_particles(fluid)
        yield f"up to {n:,} particles", PARTICLE * n, COUNTED_PARTICLE * n
    bodies = [solid for solid in scene.solids.values() if solid.shape.beam is None]  # a beam has few
    unknowns = sum(dim * int(solid_counts("", solid, dim)[2]) for solid in bodies)
    if unknowns:
        yield f"{unknowns:,} unknowns of solids", UNKNOWN[dim] * unknowns, 0.0
    shapes = [solid.shape for solid in scene.solids.values()] + [one.shape for one in scene.obstacles.values()]
    size = sum((scene.directory / shape.mesh).stat().st_size for shape in shapes if shape.mesh is not None)
    if size:
        yield f"{as_bytes(size)} of mesh files", BYTE * size, COUNTED_BYTE * size


def _most_particles(fluid: SphFluid) -> int:
    """Return how many particles there may be: those of the boxes around what is filled."""
    number = 0.0
    for shape in fluid.fill:
        low, high = bounds(shape) or (np.zeros(len(fluid.size)), np.array(fluid.size))
        number += math.prod(np.minimum(high - low, fluid.size) / fluid.spacing)
    return round(number)
