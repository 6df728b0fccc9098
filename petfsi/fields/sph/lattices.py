"""Dummies on lattices: behind what is bounded by planes along the axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.solids import SAME, Array, Solid


def spaced(low: float, high: float, dx: float, before: int, after: int) -> tuple[Array, Array]:
    """Return places and widths: so many of width dx from either end, between them some of nearly that."""
    n = int(np.rint((high - low) / dx))
    if before + after >= n:  # there are too few for all
        most = max(n - 1, 0) // (2 if before and after else 1)
        before, after = min(before, most), min(after, most)
    rest = (high - low) - (before + after) * dx
    n = max(1, int(np.rint(rest / dx)))
    width = np.concatenate((np.full(before, dx), np.full(n, rest / n), np.full(after, dx)))
    k = np.arange(n) + 0.5
    place = np.concatenate((
        low + (np.arange(before) + 0.5) * dx,
        low + before * dx + k * (rest / n),
        high - (np.arange(after)[::-1] + 0.5) * dx,
    ))  # fmt: skip
    return place, width


def product(rows: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the points of a lattice, the last axis' fastest, and their volumes."""
    x = np.stack(np.meshgrid(*(place for place, _ in rows), indexing="ij"), axis=-1).reshape(-1, len(rows))
    width = np.stack(np.meshgrid(*(w for _, w in rows), indexing="ij"), axis=-1).reshape(-1, len(rows))
    return x, width.prod(axis=1)


def outside_box(domain: Domain, dx: float, layers: int) -> tuple[Array, ...]:
    """Return what is behind a box's sides, its edges and corners: x, volume, normal, depth and side."""
    dim, k = len(domain.low), (np.arange(layers) + 0.5) * dx
    core, outer, whole = [], [], []
    for a in range(dim):
        core.append(spaced(domain.low[a], domain.high[a], float(domain.spacing(dx)[a]), 0, 0))
        ends = np.zeros(0) if domain.periodic[a] else np.concatenate((domain.low[a] - k[::-1], domain.high[a] + k))
        outer.append((ends, np.full(len(ends), dx)))
        whole.append(tuple(np.concatenate(both) for both in zip(core[a], outer[a], strict=True)))
    # what is beyond axis a, but not beyond those before
    blocks = [product([*core[:a], outer[a], *whole[a + 1 :]]) for a in range(dim)]
    x, volume = (np.concatenate(both) for both in zip(*blocks, strict=True))
    behind = domain.beyond(x)
    depth = np.linalg.norm(behind, axis=1)
    kept = np.flatnonzero((depth > 0.0) & (depth < layers * dx))
    # by rows, so that places next to each other stand near each other
    kept = kept[np.lexsort(np.rint(2.0 * (x[kept] - domain.low) / dx).T[::-1])]
    x, volume, behind, depth = x[kept], volume[kept], behind[kept], depth[kept]
    axis = np.argmax(np.abs(behind) > (np.abs(behind).max(axis=1, initial=0.0) - SAME * dx)[:, None], axis=1)
    wall = 2 * axis + (behind[np.arange(len(x)), axis] < 0.0)
    return x, volume, behind / depth[:, None], depth, wall


def on_lattice(solid: Solid, domain: Domain, dx: float, layers: int) -> tuple[Array, ...]:
    """Return what is behind the faces of a box or half space along the axes: x, volume, normal, depth."""
    assert solid.box is not None
    dim, faces = len(domain.low), solid.faces()
    low, high = solid.box
    if solid.outside and solid.shape.box is not None:
        kinds = []
        for a, wet in enumerate(faces):
            lower, upper = ("slip" if face else "open" for face in wet)
            kinds.append(("periodic", "periodic") if domain.periodic[a] and not wet.any() else (lower, upper))
        x, volume, normal, depth, _ = outside_box(Domain(low, high, tuple(kinds)), dx, layers)
    else:
        rows = []
        for a in range(dim):
            place, width = spaced(low[a], high[a], dx, *(layers * faces[a]))
            for end in range(2):
                if not faces[a, end] and domain.lets_out(a, end):
                    more = (np.arange(layers) + 0.5) * dx
                    place = np.append(place, high[a] + more if end else low[a] - more)
                    width = np.append(width, np.full(layers, dx))
            rows.append((place, width))
        x, volume = product(rows)
        distance = np.stack((x - low, high - x), axis=2)
        distance[:, ~faces] = np.inf
        nearest = distance.reshape(len(x), -1).argmin(axis=1)
        depth = distance.reshape(len(x), -1)[np.arange(len(x)), nearest]
        normal = (np.eye(dim)[:, None] * np.array([-1.0, 1.0])[:, None]).reshape(-1, dim)[nearest]
    kept = (depth < layers * dx) & ~np.any(domain.beyond(x) != 0.0, axis=1)
    around = np.where(domain.periodic, domain.period, 1.0)
    x = np.where(domain.periodic, domain.low + np.mod(x - domain.low, around), x)
    kept &= np.all((x > domain.low - layers * dx) & (x < domain.high + layers * dx), axis=1)
    return x[kept], volume[kept], normal[kept], depth[kept]
