"""What solids look like from afar: the box that each is, or is about, its elements, and where it is held."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from petfsi.errors import InputError
from petfsi.geometry.beams import axis_mesh
from petfsi.geometry.places import located, read_tags
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Ball, Beam, Box

#: A body whose volume is that of its box up to this is taken for one: a ring, a frame or a cross is not.
BOX_LIKE = (0.75, 1.3)
#: Of a plate whose two long sides differ by less than this factor, the second moments say too little of which they are.
ALIKE = 0.9
#: Shorter than so many thicknesses nothing bends as a beam.
SLENDER = 3.0
#: Nodes of a box along each axis, of which no more stand for all of them, by dimension.
STAND_INS = {2: 200, 3: 40}

Mesh = tuple[np.ndarray, np.ndarray]


class Bend(NamedTuple):
    """How linear elements lie in what bends: how many across it, and how many times as long along it as thick."""

    across: float
    ratio: float


@dataclass(frozen=True)
class Form:
    """The box that a solid is, or about is; axes are in the order of their lengths.

    Attributes
    ----------
    axes : ndarray, shape (dim, dim)
        Unit vectors, one a row, the thinnest first.
    lengths, spacing : ndarray, shape (dim,)
        Of the body and of its elements along these, m.
    altitude : float
        The shortest way through an element, m.
    thickness : float
        Of its material where it is thinnest, m: of walls, if it is hollow.
    filled : bool
        Whether it is a box and no more.
    wall : Bend or None
        Of the thinnest wall of a hollow one that is long enough to bend.
    points : ndarray, shape (n, dim)
        Nodes, of a large box some of them, m.
    """

    axes: np.ndarray
    lengths: np.ndarray
    spacing: np.ndarray
    altitude: float
    thickness: float
    filled: bool
    points: np.ndarray
    wall: Bend | None = None

    @property
    def slender(self) -> bool:
        """Whether it may bend as a beam does."""
        return self.filled and bool(self.lengths[-1] >= SLENDER * self.thickness)

    def bend(self, axis: int) -> Bend:
        """Return how elements lie in it as it bends along an axis."""
        return Bend(float(self.thickness / self.spacing[0]), float(self.spacing[axis] / self.spacing[0]))


def form_of(solid: Solid, dim: int, mesh: Mesh | None) -> Form | None:
    """Return the form of a solid; None of one whose mesh file is not given. Not collective."""
    shape = solid.shape
    if shape.beam is not None:
        return _beam(shape.beam)
    if shape.box is not None:
        return _box(shape.box, shape.cavity)
    if shape.ball is not None:
        return _ball(shape.ball)
    return None if mesh is None else _mesh(*mesh)


def _box(box: Box, cavity: Box | None) -> Form:
    size, cells = np.array(box.size, dtype=float), np.array(box.cells)
    most = STAND_INS[len(size)]
    ends = [np.linspace(o, o + s, min(n, most) + 1) for o, s, n in zip(box.origin, box.size, cells, strict=True)]
    points = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, len(size))
    order = np.argsort(size, kind="stable")
    spacing = size / cells
    left_out = [] if cavity is None else _left_out(box, cavity)
    walls = _walls(spacing, cells, left_out) if left_out else []
    return Form(
        axes=np.eye(len(size))[order],
        lengths=size[order],
        spacing=spacing[order],
        altitude=float(np.sum((cells / size) ** 2) ** -0.5),
        thickness=min([wall.thickness for wall in walls], default=float(size.min())),
        filled=not left_out,
        points=points,
        wall=next((wall.bend for wall in sorted(walls) if wall.length >= SLENDER * wall.thickness), None),
    )


class _Wall(NamedTuple):
    """A wall of a hollow box: its thickness, the side of what it bounds over which it bends, m, and its elements."""

    thickness: float
    length: float
    bend: Bend


def _left_out(box: Box, cavity: Box) -> list[np.ndarray]:
    """Return which cells along each axis have their centres in a cavity, as the box's mesh has; nothing if none has."""
    found = []
    for o, size, n, low, wide in zip(box.origin, box.size, box.cells or (), cavity.origin, cavity.size, strict=True):
        centre = o + size / n * (np.arange(n) + 0.5)
        found.append(np.flatnonzero((centre >= low) & (centre <= low + wide)))
    return found if all(len(cells) for cells in found) else []


def _walls(spacing: np.ndarray, cells: np.ndarray, left_out: list[np.ndarray]) -> list[_Wall]:
    """Return the walls around what is left out; where that reaches a side there is none."""
    sides = np.array([len(out) for out in left_out]) * spacing
    walls = []
    for axis, out in enumerate(left_out):
        others = [n for n in range(len(spacing)) if n != axis]
        # a panel bends over its shorter side between walls that hold it: round a tube, not along it
        between = [n for n in others if left_out[n][0] > 0 or left_out[n][-1] < cells[n] - 1]
        along = min(between or others, key=lambda n: sides[n])
        for n in (int(out[0]), int(cells[axis] - 1 - out[-1])):
            if n:
                bend = Bend(float(n), float(spacing[along] / spacing[axis]))
                walls.append(_Wall(float(n * spacing[axis]), float(sides[along]), bend))
    return walls


def _ball(ball: Ball) -> Form:
    dim = len(ball.centre)
    across = 2 * ball.radius
    step = across / (ball.cells or 1)
    around = np.array(ball.centre) + ball.radius * np.concatenate((np.eye(dim), -np.eye(dim)))
    sides = np.full(dim, across)
    return Form(np.eye(dim), sides, np.full(dim, step), step / dim**0.5, across, False, around)


def _beam(beam: Beam) -> Form:
    points = axis_mesh(beam)[0]
    along = points[-1] - points[0]
    length = float(np.linalg.norm(along))
    x, y = along / length
    step = length / beam.elements
    sides = np.array([beam.thickness, length])
    return Form(np.array([[-y, x], [x, y]]), sides, np.array([sides[0], step]), step, beam.thickness, True, points)


def _mesh(points: np.ndarray, cells: np.ndarray) -> Form:
    """Return the box of the same second moments, and about as many elements as would fill it."""
    dim = points.shape[1]
    corners = points[cells[:, : dim + 1]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / math.factorial(dim)
    volume = volumes.sum()
    corners = corners - volumes @ corners.mean(axis=1) / volume
    total = corners.sum(axis=1)
    moments = np.einsum("e,eia,eib->ab", volumes, corners, corners) + np.einsum("e,ea,eb->ab", volumes, total, total)
    sizes, ways = np.linalg.eigh(moments)  # the squares of lengths, but for a factor
    if dim == 3 and sizes[1] > ALIKE**2 * sizes[2]:
        ways[:, 1:] = ways[:, 1:] @ _sides(points[np.unique(cells)] @ ways[:, 1:])
    # of thin ones the least eigenvalue is round-off of the largest; along the axis itself it is not
    squares = volumes @ ((corners @ ways) ** 2).sum(axis=1) + volumes @ (total @ ways) ** 2
    order = np.argsort(squares, kind="stable")
    ways, lengths = ways[:, order], np.sqrt(12.0 * squares[order] / ((dim + 1) * (dim + 2) * volume))
    step = (math.factorial(dim) * volume / len(cells)) ** (1 / dim)
    filled = BOX_LIKE[0] < volume / lengths.prod() < BOX_LIKE[1]
    return Form(ways.T, lengths, np.full(dim, step), _altitude(corners, volumes), float(lengths[0]), filled, points)


def _sides(points: np.ndarray) -> np.ndarray:
    """Return the sides of the smallest rectangle around points of a plane, shape (n, 2), as unit columns, (2, 2).

    It has a side along an edge of their hull. Second moments do not tell the sides of a square.

    References
    ----------
    H. Freeman, R. Shapira, Determining the minimum-area encasing rectangle for an arbitrary closed curve (1975).
    """
    from scipy.spatial import ConvexHull  # a plan alone needs none of it

    around = points[ConvexHull(points).vertices]
    edges = np.roll(around, -1, axis=0) - around
    x, y = (edges / np.linalg.norm(edges, axis=1, keepdims=True)).T
    areas = np.ptp(around @ (x, y), axis=0) * np.ptp(around @ (-y, x), axis=0)
    best = int(np.argmin(areas))
    return np.array([[x[best], -y[best]], [y[best], x[best]]])


def _altitude(corners: np.ndarray, volumes: np.ndarray) -> float:
    """Return the smallest altitude of some simplices: dim times the volume over the largest facet."""
    dim = corners.shape[2]
    if dim == 2:
        facets = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    else:
        one, other = (np.roll(corners, n, axis=1) - corners for n in (1, 2))
        facets = 0.5 * np.linalg.norm(np.cross(one, other), axis=2)
    return float(np.min(dim * volumes / facets.max(axis=1)))


def held(solid: Solid, form: Form, directory: Path) -> np.ndarray | None:
    """Return which components of its points supports hold, shape (n, dim or 3 of a beam). Not collective.

    None where the points do not show it.
    """
    names = ("x", "y", "angle") if solid.shape.beam is not None else ("x", "y", "z")[: form.points.shape[1]]
    found = np.zeros((len(form.points), len(names)), dtype=bool)
    try:
        tags = read_tags(solid, form.points.shape[1], "solids", directory)
        for support in solid.supports:
            where = located(support.where, form.points, "supports", tags)
            for letter in support.fix:
                found[where, names.index(letter)] = True
    except InputError:
        return None
    return found
