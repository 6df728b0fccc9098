"""What pictures may colour: of a grid's fluid, of particles, and of solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from petfsi.fields.mac.grid.kinds import FLUID
from petfsi.geometry.rays import cast
from petfsi.output.frames import Frame
from petfsi.output.xdmf import GridInfo


@dataclass(frozen=True)
class Quantity:
    """How a quantity is shown.

    Attributes
    ----------
    label : str
        With its unit.
    colours : str
        Matplotlib's name of the scale.
    least : float
        By how much it must change somewhere to be worth a picture by itself.
    signed : bool
        Whether zero is the middle of the scale.
    """

    label: str
    colours: str
    least: float = 0.0
    signed: bool = False


#: All of them, in the order in which a run's pictures take what varies.
QUANTITIES = {
    "smoke": Quantity("smoke", "magma", 1e-6),
    "speed": Quantity("speed, m/s", "viridis", 1e-6),
    "pressure": Quantity("pressure, Pa", "plasma", 1e-9),
    "displacement": Quantity("displacement, m", "viridis"),
    "vorticity": Quantity("vorticity, 1/s", "RdBu_r", signed=True),
}
#: In space it is a length.
_LENGTH_OF_VORTICITY = Quantity("vorticity, 1/s", "magma")


def shown_as(name: str, dim: int) -> Quantity:
    """Return how a quantity is shown in a space of ``dim`` dimensions."""
    return _LENGTH_OF_VORTICITY if name == "vorticity" and dim == 3 else QUANTITIES[name]


def offered(frame: Frame) -> list[str]:
    """Return the names of what there is to be shown at an output time: of the fluid, then of solids."""
    fluid = frame.particles or frame.fluid
    names = {"smoke", "pressure"} & fluid.keys()
    if "velocity" in fluid:
        names |= {"speed"} if frame.particles else {"speed", "vorticity"}
    if "displacement" in frame.solid:
        names.add("displacement")
    if not fluid and "velocity" in frame.solid:
        names.add("speed")
    return [name for name in QUANTITIES if name in names]


def of_solids(name: str, frame: Frame) -> bool:
    """Return whether it is the solids that a quantity is shown of."""
    return name == "displacement" or not (frame.particles or frame.fluid)


def solid_values(frame: Frame, name: str) -> np.ndarray | None:
    """Return the length of the solids' displacement or velocity at every node; None where there is none."""
    vectors = frame.solid.get({"displacement": "displacement", "speed": "velocity"}.get(name, ""))
    return None if vectors is None else np.linalg.norm(vectors, axis=1)


def particle_values(frame: Frame, name: str) -> np.ndarray | None:
    """Return a quantity of every particle; None where there is no such thing."""
    if name == "speed" and "velocity" in frame.particles:
        return np.linalg.norm(frame.particles["velocity"], axis=1)
    return frame.particles.get(name)


def cell_values(
    frame: Frame, name: str, grid: GridInfo, periodic: Sequence[bool], walls: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray | None:
    """Return a quantity of every cell of a grid: NaN where it holds no fluid; None where there is no such thing.

    Parameters
    ----------
    frame : Frame
    name : str
        Of ``QUANTITIES``.
    grid : GridInfo
    periodic : sequence of bool
        The axes along which it repeats.
    walls : sequence of (ndarray, ndarray)
        Points and facets of what parts the fluid.
    """
    velocity = frame.fluid.get("velocity")
    found = velocity[..., 0] if name in ("speed", "vorticity") and velocity is not None else frame.fluid.get(name)
    if found is None:
        return None
    wet = frame.fluid.get("kind", np.full(found.shape, FLUID)) == FLUID
    if name == "speed" and velocity is not None:
        found = np.linalg.norm(velocity, axis=-1)
    elif name == "vorticity" and velocity is not None:
        found = vorticity(velocity, joined(wet, grid, periodic, walls), grid.spacing)
    return np.where(wet, found, np.nan)


def joined(
    wet: np.ndarray, grid: GridInfo, periodic: Sequence[bool], walls: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[np.ndarray]:
    """Return by axis which cells and the one before them, around the end where the grid repeats, hold one fluid.

    Walls between them may be thinner than a cell, as beams are.
    """
    lines = [o + h * (np.arange(n) + 0.5) for o, h, n in zip(grid.origin, grid.spacing, grid.cells, strict=True)]
    found = []
    for axis, repeats in enumerate(periodic):
        one = wet & np.roll(wet, 1, axis)
        if not repeats:
            np.moveaxis(one, axis, 0)[0] = False
        for points, facets in walls:
            one[tuple(cast(points, facets, lines, axis).beyond.T)] = False
        found.append(one)
    return found


def vorticity(velocity: np.ndarray, together: Sequence[np.ndarray], spacing: Sequence[float]) -> np.ndarray:
    """Return the vorticity of every cell: in the plane dv/dx - du/dy, in space the length of the velocity's curl.

    Differences are central between neighbours, and one-sided beside walls: exact where the velocity is linear.

    Parameters
    ----------
    velocity : ndarray, shape (nx, ny[, nz], dim)
        Of the cells' centres, m/s.
    together : sequence of ndarray of bool, shape (nx, ny[, nz])
        As ``joined`` has them.
    spacing : sequence of float
        The cells' edges, m.

    Returns
    -------
    ndarray, shape (nx, ny[, nz])
        1/s; NaN where a cell has no neighbour along an axis on which there are others.
    """

    def slope(of: int, along: int) -> np.ndarray:
        return _slope(velocity[..., of], together[along], along, spacing[along])

    if velocity.shape[-1] == 2:
        return slope(1, 0) - slope(0, 1)
    curl = [slope(2, 1) - slope(1, 2), slope(0, 2) - slope(2, 0), slope(1, 0) - slope(0, 1)]
    return np.linalg.norm(curl, axis=0)


def _slope(values: np.ndarray, behind: np.ndarray, axis: int, spacing: float) -> np.ndarray:
    """Return the difference quotient along an axis between a cell's neighbours, or from the only one to the cell."""
    if values.shape[axis] == 1:
        return np.zeros(values.shape)
    ahead = np.roll(behind, -1, axis)
    after = np.where(ahead, np.roll(values, -1, axis), values)
    before = np.where(behind, np.roll(values, 1, axis), values)
    steps = ahead.astype(float) + behind
    return np.divide(after - before, steps * spacing, where=steps > 0, out=np.full(values.shape, np.nan))
