"""What a user should know of the sides of a grid before a run begins."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.fluids import MacFluid
from petfsi.scene.schema import Scene
from petfsi.scene.shape_checks import OPPOSITE, periods
from petfsi.scene.sides import GridInflowSide

#: Gravity that changes is looked at this often.
INSTANTS = 11
#: A side whose normal is within 45 degrees of the direction against gravity is the top.
UPRIGHT = 0.5**0.5


def side_notes(scene: Scene) -> list[str]:
    """Return a line for each side that is open to p = 0 below the top, where fluid at rest runs out under gravity."""
    fluid = scene.fluid
    if not isinstance(fluid, MacFluid) or scene.gravity is None:
        return []
    down = _directions(scene) * (periods(fluid, scene.dim) == 0.0)  # nothing bears it along periodic axes
    size = np.linalg.norm(down, axis=1)
    down = down[size > 0.0] / size[size > 0.0, None]
    notes = []
    for axis, pair in enumerate(OPPOSITE[: scene.dim]):
        for sign, name in zip((-1.0, 1.0), pair, strict=True):
            side = getattr(fluid.sides, name)
            inner, form = (".inflow.rest", side.inflow.rest) if isinstance(side, GridInflowSide) else ("", side)
            if form == "open" and np.any(-sign * down[:, axis] < UPRIGHT):
                notes.append(
                    f'fluid.sides.{name}{inner} = "open": p = 0 at every depth, so that fluid at rest runs out; '
                    f'"hydrostatic" or {{ hydrostatic = height (m) }} holds it, {{ pressure = ... }} is any other'
                )
    return notes


def _directions(scene: Scene) -> np.ndarray:
    """Return gravity at some instants of the run, shape (n, dim); where it has no value the run itself will say so."""
    found = []
    for t in np.linspace(0.0, scene.time.end, INSTANTS):
        with suppress(ExpressionError):
            found.append([float(Expression(g, ("t",), "gravity")(t=t)) for g in scene.gravity or ()])
    return np.array(found).reshape(-1, scene.dim)
