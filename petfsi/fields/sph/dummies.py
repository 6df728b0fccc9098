"""Wall particles at rest: those of the domain's sides and of obstacles.

Layers of dummies at depths (k + 1/2) dx behind a wall stand for what is solid there, as far as the kernel reaches, so
that sums over particles see no gap (S. Adami, X. Y. Hu, N. A. Adams, J. Comput. Phys. 231 (2012), 7057). What is
bounded by planes along the axes has them on a lattice. Everything else is cut into a fine lattice of points with their
distance to the nearest facet; each layer of it is divided into parts of about dx^dim, as equal and compact as can be
(a centroidal Voronoi division), and every part is one dummy with the part's volume.

Every place behind several walls belongs to one: to a side, else to the first obstacle on a lattice, else to the first.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.lattices import on_lattice, outside_box
from petfsi.fields.sph.layers import from_facets
from petfsi.fields.sph.solids import SAME, Array, Solid, build_solids
from petfsi.scene.schema import Obstacle
from petfsi.scene.sides import InflowSide

SIDES = ("left", "right", "bottom", "top", "back", "front")
#: Dummies of two walls nearer than this part of dx are one.
NEAR = 0.5


@dataclass(frozen=True)
class Dummies:
    """Wall particles, the same and in the same order on every rank.

    Attributes
    ----------
    x : ndarray, shape (n, dim)
        m.
    volume : ndarray, shape (n,)
        What each stands for, m^3 (in 2D m^2).
    normal : ndarray, shape (n, dim)
        Unit, out of the wall into the fluid; ``x + depth normal`` is the place of the wall that it hangs on (beyond
        open sides, where obstacles go on as they end there, a place that far from the wall's end).
    depth : ndarray, shape (n,)
        Distance behind the wall, m.
    no_slip : ndarray of bool, shape (n,)
    wall : ndarray of int, shape (n,)
        Which of ``names`` it belongs to.
    names : tuple of str
        The sides, two an axis (left, right, bottom, ...), then the obstacles.
    """

    x: Array
    volume: Array
    normal: Array
    depth: Array
    no_slip: Array
    wall: Array
    names: tuple[str, ...]


def wall_dummies(
    domain: Domain,
    dx: float,
    reach: float,
    obstacles: Mapping[str, Obstacle],
    directory: Path,
    no_slip: Collection[str] = (),
) -> Dummies:
    """Return the dummies of all walls at rest. Not collective; every rank gets the same.

    Walls go on past an open side or an inflow as far as the kernel reaches; obstacles do as if they were prisms there.

    Parameters
    ----------
    domain : Domain
    dx : float
        The particles' spacing, m.
    reach : float
        The kernel's support, m: there are ceil(reach / dx) layers.
    obstacles : mapping of str to Obstacle
    directory : Path
        What mesh files are relative to.
    no_slip : collection of str
        The obstacles that are not slippery.
    """
    layers = int(np.ceil(reach / dx - SAME))
    solids = build_solids(domain, dx, obstacles, directory, layers * dx)
    dim, deep = len(domain.low), layers * dx
    names = (*SIDES[: 2 * dim], *obstacles)
    walls = [kind.inflow.rest if isinstance(kind, InflowSide) else kind for pair in domain.sides for kind in pair]
    rough = np.array([kind == "no-slip" for kind in walls] + [o in no_slip for o in obstacles])
    x, volume, normal, depth, wall = outside_box(domain, dx, layers)
    foot = x + depth[:, None] * normal
    hidden = np.zeros(len(x), dtype=bool)
    for solid in solids:
        inner = np.maximum(solid.depth(foot, deep, solid.shape.mesh is None, whole=True)[0], 0.0)
        hidden |= inner**2 + depth**2 >= deep**2
    parts = [tuple(part[~hidden] for part in (x, volume, normal, depth, wall))]
    done: list[Solid] = []
    for solid in sorted(solids, key=lambda s: s.box is None):
        if solid.box is not None:
            found = on_lattice(solid, domain, dx, layers)
            held = [other.depth(domain.clamped(found[0]), deep, whole=True)[0] for other in done]
            seen = np.all([d < SAME * dx for d in held], axis=0) if held else np.ones(len(found[0]), dtype=bool)
        else:
            found = from_facets(solid, done, domain, dx, layers)
            seen = np.ones(len(found[0]), dtype=bool)
        for other in solids:
            if other is not solid:
                inner = domain.clamped(found[0])
                seen &= other.depth(inner, deep, other.shape.mesh is None, whole=True)[0] < deep
        number = np.full(len(found[0]), names.index(solid.name))
        parts.append(tuple(part[seen] for part in (*found, number)))
        done.append(solid)
    x, volume, normal, depth, wall = _apart(parts, dx)
    return Dummies(x, volume, normal, depth, rough[wall], wall, names)


def _apart(parts: list[tuple[Array, ...]], dx: float) -> list[Array]:
    """Return all walls' dummies less those too near to one of an earlier wall, which takes their volume."""
    kept = list(parts[0])
    for part in parts[1:]:
        if len(kept[0]) and len(part[0]):
            distance, nearest = cKDTree(kept[0]).query(part[0], distance_upper_bound=NEAR * dx * (1.0 - SAME))
            near = np.isfinite(distance)
            np.add.at(kept[1], nearest[near], part[1][near])
            part = tuple(p[~near] for p in part)
        kept = [np.concatenate(both) for both in zip(kept, part, strict=True)]
    return kept
