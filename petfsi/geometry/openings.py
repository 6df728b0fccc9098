"""How much of the faces on a side of a grid lies within a convex shape, and where: exact areas and centroids.

A plane cuts out of a box, ball, cylinder or half space the points (y, z) that lie below some lines and within at most
one ellipse. A face is clipped at the lines, mapped so that the ellipse is the unit circle, and what the circle takes of
the polygon is the sum over its edges of triangles, where they run inside, and sectors, where they run outside. In 2D
z is a dummy from -1/2 to 1/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from petfsi.errors import InputError
from petfsi.geometry.shapes import TOLERANCE, bounds
from petfsi.scene.fluids import MacFluid
from petfsi.scene.shape_checks import OPPOSITE, images, periods
from petfsi.scene.sides import GridInflowSide
from petfsi.scene.tables import Cylinder, Shape

#: Parts of faces nearer than this to 0 or 1 are 0 or 1, besides what rounding makes of the coordinates.
SNAP = 1e-12
#: A cylinder whose axis leans less than this against a plane is cut in a strip.
PARALLEL = 1e-8
#: In 2D the second coordinate in a side reaches from here to there.
DUMMY = (-0.5, 0.5)
#: Rounding errors of a coordinate.
ROUNDING = 8 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class Section:
    """What a plane cuts out of a shape.

    Attributes
    ----------
    lines : ndarray, shape (n, 3)
        a, b, c: points lie within where a y + b z <= c.
    circle : ndarray, shape (0 or 1, 2, 3)
        The map (y, z, 1) -> (r, s) that makes the unit circle of an ellipse.
    """

    lines: np.ndarray
    circle: np.ndarray

    @classmethod
    def of(cls, lines: list[tuple[float, float, float]], circle: np.ndarray | None = None) -> Section:
        """Return one of lines and an ellipse."""
        every = np.array(lines, dtype=float).reshape(-1, 3)
        return cls(every, np.zeros((0, 2, 3)) if circle is None else circle[None])


def parts_within(
    shape: Shape, axis: int, at: float, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which part of some rectangles in a plane lies within a shape, and the centroids of the parts.

    Parameters
    ----------
    shape : Shape
        A box, ball, cylinder or half space.
    axis : int
        The plane's normal.
    at : float
        Where it stands along that, m.
    low, high : ndarray, shape (n, dim)
        Corners of the rectangles; of ``axis`` not read.

    Returns
    -------
    part : ndarray, shape (n,)
        Fractions of the rectangles' areas (lengths in 2D).
    centroid : ndarray, shape (n, dim)
        In the plane, m; the middle of rectangles that lie within or outside altogether.
    """
    dim = low.shape[1]
    others = [b for b in range(dim) if b != axis]
    centroid = 0.5 * (low + high)
    centroid[:, axis] = at
    section = _section(shape, axis, at, others)
    if section is None:
        return np.zeros(len(low)), centroid
    flat = np.zeros((len(low), 2, 2))
    flat[:, 1] = DUMMY
    for n, b in enumerate(others):
        flat[:, n, 0], flat[:, n, 1] = low[:, b], high[:, b]
    areas, middles = _clip(flat[:, [0, 1], [[0, 0], [1, 0], [1, 1], [0, 1]]], section.lines, section.circle)
    size = flat[:, :, 1] - flat[:, :, 0]
    slack = SNAP + ROUNDING * np.max(np.abs(flat).max(axis=2) / size, axis=1)
    part = np.clip(areas / size.prod(axis=1), 0.0, 1.0)
    part = np.where(part > 1.0 - slack, 1.0, np.where(part < slack, 0.0, part))
    some = (part > 0.0) & (part < 1.0)
    for n, b in enumerate(others):
        centroid[some, b] = np.clip(middles[some, n], low[some, b], high[some, b])
    return part, centroid


def jet_parts(
    fluid: MacFluid, region: Shape | None, axis: int, at: float, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what ``parts_within`` does of a jet's region and its images around periodic axes; None is everything."""
    if region is None:
        middle = 0.5 * (low + high)
        middle[:, axis] = at
        return np.ones(len(low)), middle
    part, moment = np.zeros(len(low)), np.zeros(low.shape)
    for shift in _moves(fluid, region, low.shape[1]):
        share, centroid = parts_within(region, axis, at, low - shift, high - shift)
        part += share
        moment += share[:, None] * (centroid + shift)
    some = part > 0.0
    moment[some] /= part[some, None]
    return np.minimum(part, 1.0), moment


def areas_within(fluid: MacFluid, region: Shape, axis: int, at: float, corners: np.ndarray) -> np.ndarray:
    """Return the area of quadrilaterals in a side within a jet's region and its images around periodic axes.

    Parameters
    ----------
    fluid, region : MacFluid, Shape
    axis, at : int, float
        The side.
    corners : ndarray, shape (n, 4, 2)
        By the coordinates along the other axes (the second is ``DUMMY`` in 2D), anticlockwise, m.

    Returns
    -------
    ndarray, shape (n,)
        m^2 (m in 2D).
    """
    dim = len(fluid.origin)
    others = [b for b in range(dim) if b != axis]
    area = np.zeros(len(corners))
    for shift in _moves(fluid, region, dim):
        section = _section(region, axis, at, others)
        if section is not None:
            moved = corners - [*shift[others], 0.0][:2]
            area += _clip(moved, section.lines, section.circle)[0]
    return area


def _moves(fluid: MacFluid, region: Shape, dim: int) -> list[np.ndarray]:
    """Return by how much the images of a region are moved that may meet the grid, m."""
    origin, period, reach = np.array(fluid.origin, dtype=float), periods(fluid, dim), bounds(region)
    return [np.zeros(dim)] if reach is None else images(period, reach, (origin, origin + fluid.size))


def check_jets(fluid: MacFluid, dim: int) -> None:
    """Raise an ``InputError`` that names every jet whose region meets no part of its side."""
    low = np.array([fluid.origin], dtype=float)
    high = low + fluid.size
    wrong = []
    for axis, pair in enumerate(OPPOSITE[:dim]):
        for name, ends in zip(pair, (low, high), strict=True):
            side = getattr(fluid.sides, name)
            if not isinstance(side, GridInflowSide):
                continue
            at = float(ends[0, axis])
            if not jet_parts(fluid, side.inflow.region, axis, at, low, high)[0].any():
                key = f"fluid.sides.{name}.inflow.region"
                wrong.append(f"{key}: meets no part of the side, which lies at {'xyz'[axis]} = {at:g} m")
    if wrong:
        raise InputError("\n".join(wrong))


def _section(shape: Shape, axis: int, at: float, others: list[int]) -> Section | None:
    """Return what the plane cuts out, by the coordinates along the other axes; None for nothing."""
    if shape.box is not None:
        low = np.array(shape.box.origin)
        high = low + np.array(shape.box.size)
        slack = TOLERANCE * float(np.max(shape.box.size))
        if not low[axis] - slack <= at <= high[axis] + slack:
            return None
        return _between([(n, low[b], high[b]) for n, b in enumerate(others)])
    if shape.ball is not None:
        centre, square = np.array(shape.ball.centre), shape.ball.radius**2 - (at - shape.ball.centre[axis]) ** 2
        if square <= 0.0:
            return None
        radius, middle = float(np.sqrt(square)), centre[others]
        if len(others) == 1:
            return _between([(0, middle[0] - radius, middle[0] + radius)])
        return Section.of([], np.column_stack((np.eye(2), -middle)) / radius)
    if shape.cylinder is not None:
        return _of_cylinder(shape.cylinder, axis, at, others)
    if shape.halfspace is not None:
        normal, point = np.array(shape.halfspace.normal, dtype=float), np.array(shape.halfspace.point)
        normal /= np.linalg.norm(normal)
        return _below(normal, float(normal @ point), axis, at, others)
    raise ValueError("only a box, ball, cylinder or half space cuts out a part of a side")


def _between(bounds: list[tuple[int, float, float]]) -> Section:
    """Return the points between bounds of the first or second coordinate."""
    unit = ((1.0, 0.0), (0.0, 1.0))
    lines = [(*unit[n], high) for n, _, high in bounds]
    return Section.of(lines + [(-unit[n][0], -unit[n][1], -low) for n, low, _ in bounds])


def _below(normal: np.ndarray, reach: float, axis: int, at: float, others: list[int]) -> Section | None:
    """Return where normal . x <= reach in the plane; None for nowhere."""
    along = [*normal[others], 0.0][:2]
    left = reach - normal[axis] * at
    if np.linalg.norm(along) <= PARALLEL:
        return Section.of([]) if left >= -TOLERANCE * (abs(reach) + abs(at)) else None
    return Section.of([(along[0], along[1], left)])


def _of_cylinder(cylinder: Cylinder, axis: int, at: float, others: list[int]) -> Section | None:
    """Return what the plane cuts out of a round cylinder (3D)."""
    start, end, radius = np.array(cylinder.start), np.array(cylinder.end), cylinder.radius
    direction = (end - start) / np.linalg.norm(end - start)
    ends = [_below(direction, float(direction @ end), axis, at, others)]
    ends.append(_below(-direction, float(-direction @ start), axis, at, others))
    lines = [tuple(line) for part in ends if part is not None for line in part.lines]
    if None in ends:
        return None
    along = direction[others]
    leaning = float(np.linalg.norm(along))
    # the plane's directions across and along the axis, and how fast one goes away from it along the latter
    t = along / leaning if leaning > PARALLEL else np.array([0.0, 1.0])
    across = np.array([t[1], -t[0]])
    rise, away = direction[axis], start[others]
    first = np.array([*across, -across @ away]) / radius
    # v = (e - rise d) / |...| with e the plane's normal: v . (x - start)
    square = max(1.0 - rise**2, 0.0)
    if leaning <= PARALLEL:
        second = np.array([*t, -t @ away]) / radius
    else:
        v_axis, v_along = square / leaning, -rise * leaning / leaning
        second = np.array([*(v_along * t), v_axis * (at - start[axis]) - v_along * (t @ away)]) / radius
    if abs(rise) > PARALLEL:
        return Section.of(lines, np.stack((first, second)))
    half = 1.0 - second[2] ** 2
    if half <= 0.0:
        return None
    width = float(np.sqrt(half))
    lines += [(first[0], first[1], width - first[2]), (-first[0], -first[1], width + first[2])]
    return Section.of(lines)


@njit(cache=True)
def _clip(corners, lines, circle):
    """Return area and centroid of what lines and the circle leave of quadrilaterals, (n, 4, 2), anticlockwise.

    Of empty parts the centroid is the middle.
    """
    areas, middles = np.zeros(len(corners)), np.zeros((len(corners), 2))
    polygon, other = np.empty((4 + len(lines), 2)), np.empty((4 + len(lines), 2))
    for n in range(len(corners)):
        # about the middle, so that differences of coordinates keep their digits
        y = 0.25 * (corners[n, 0, 0] + corners[n, 1, 0] + corners[n, 2, 0] + corners[n, 3, 0])
        z = 0.25 * (corners[n, 0, 1] + corners[n, 1, 1] + corners[n, 2, 1] + corners[n, 3, 1])
        middles[n] = y, z
        for i in range(4):
            polygon[i] = corners[n, i, 0] - y, corners[n, i, 1] - z
        count = 4
        for a, b, c in lines:
            count = _cut(polygon, count, a, b, c - a * y - b * z, other)
            polygon, other = other, polygon
        if count < 3:
            continue
        if len(circle):
            area, r, s = _in_circle(polygon, count, circle[0], y, z)
        else:
            area, r, s = _moments(polygon, count)
        areas[n] = area
        if area > 0.0:
            middles[n] = y + r / area, z + s / area
    return areas, middles


@njit(cache=True)
def _cut(polygon, count, a, b, c, out):
    """Write the part of a polygon where a y + b z <= c; return its number of corners."""
    kept = 0
    for i in range(count):
        p, q = polygon[i], polygon[(i + 1) % count]
        here, there = c - a * p[0] - b * p[1], c - a * q[0] - b * q[1]
        if here >= 0.0:
            out[kept] = p
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            share = here / (here - there)
            out[kept] = p + share * (q - p)
            kept += 1
    return kept


@njit(cache=True)
def _moments(polygon, count):
    """Return the area of a polygon and the integrals of its coordinates."""
    area = first = second = 0.0
    for i in range(count):
        p, q = polygon[i], polygon[(i + 1) % count]
        double = p[0] * q[1] - p[1] * q[0]
        area += 0.5 * double
        first += double * (p[0] + q[0]) / 6.0
        second += double * (p[1] + q[1]) / 6.0
    return area, first, second


@njit(cache=True)
def _in_circle(polygon, count, to_circle, y, z):
    """Return area and first moments of what an ellipse takes of a polygon about (y, z)."""
    m00, m01, m10, m11 = to_circle[0, 0], to_circle[0, 1], to_circle[1, 0], to_circle[1, 1]
    r0, s0 = m00 * y + m01 * z + to_circle[0, 2], m10 * y + m11 * z + to_circle[1, 2]
    det = m00 * m11 - m01 * m10
    inside, area, first, second = True, 0.0, 0.0, 0.0
    for i in range(count):
        p, q = polygon[i], polygon[(i + 1) % count]
        pr, ps = r0 + m00 * p[0] + m01 * p[1], s0 + m10 * p[0] + m11 * p[1]
        qr, qs = r0 + m00 * q[0] + m01 * q[1], s0 + m10 * q[0] + m11 * q[1]
        inside = inside and pr * pr + ps * ps <= 1.0
        one, two, three = _edge(pr, ps, qr, qs)
        area, first, second = area + one, first + two, second + three
    if inside:
        return _moments(polygon, count)
    area = area / det
    if area <= 0.0:
        return 0.0, 0.0, 0.0
    # moments about the circle's centre, back to those about (y, z)
    first, second = first / det - r0 * area, second / det - s0 * area
    return area, (m11 * first - m01 * second) / det, (m00 * second - m10 * first) / det


@njit(cache=True)
def _edge(pr, ps, qr, qs):
    """Return what an edge adds to area and first moments within the unit circle: triangle inside, sectors outside."""
    dr, ds = qr - pr, qs - ps
    square, along = dr * dr + ds * ds, pr * dr + ps * ds
    distance = pr * qs - ps * qr
    root = square - distance * distance
    if square == 0.0 or root <= 0.0:
        return _sector(pr, ps, qr, qs)
    root = np.sqrt(root)
    enter, leave = max((-along - root) / square, 0.0), min((-along + root) / square, 1.0)
    if enter >= leave:
        return _sector(pr, ps, qr, qs)
    ar, az, br, bz = pr + enter * dr, ps + enter * ds, pr + leave * dr, ps + leave * ds
    double = (leave - enter) * distance
    area, first, second = 0.5 * double, double * (ar + br) / 6.0, double * (az + bz) / 6.0
    if enter > 0.0:
        one, two, three = _sector(pr, ps, ar, az)
        area, first, second = area + one, first + two, second + three
    if leave < 1.0:
        one, two, three = _sector(br, bz, qr, qs)
        area, first, second = area + one, first + two, second + three
    return area, first, second


@njit(cache=True)
def _sector(pr, ps, qr, qs):
    """Return area and first moments of the sector of the unit circle from one direction to another."""
    angle = np.arctan2(pr * qs - ps * qr, pr * qr + ps * qs)
    p, q = np.hypot(pr, ps), np.hypot(qr, qs)
    if p == 0.0 or q == 0.0:
        return 0.0, 0.0, 0.0
    return 0.5 * angle, (qs / q - ps / p) / 3.0, (pr / p - qr / q) / 3.0
