"""Which facets of a surface are those of bodies thinner than particles see."""

from __future__ import annotations

import numpy as np
from numba import njit

from petfsi.fields.sph.sight_cells import BEFORE, extent, fitting, normal_of, sorted_into
from petfsi.fields.sph.sight_guard import cell_range, dot, in_space, minus, plus
from petfsi.geometry.slabs import area_vectors
from petfsi.geometry.surfaces import occurrences, ridges, shells

#: Facets are sampled at this part of the reach.
SAMPLED = 0.25


def thin_facets(points: np.ndarray, facets: np.ndarray, reach: float) -> np.ndarray:
    """Return which facets hide something nearer than ``reach``, shape (m,) bool.

    Those that have another facet, which faces away from them, less than ``reach`` (m) behind them, what closes the gap
    between such at a rim, and all of open shells. Sampled, so what is just as thick as ``reach`` may be either.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        At rest, m.
    facets : ndarray of int, shape (m, dim)
    reach : float
    """
    behind = backed(points, facets, reach)
    part = np.zeros(len(points), dtype=bool)
    part[facets[behind]] = True
    return np.all(part[facets], axis=1) | _in_open_shells(points, facets)


def thin_shells(points: np.ndarray, facets: np.ndarray, thickness: float) -> tuple[np.ndarray, float]:
    """Return which facets are of bodies that are thin for the most part, and how large a part of the others is thin.

    Parameters
    ----------
    points : ndarray, shape (n_points, dim)
        At rest, m.
    facets : ndarray of int, shape (m, dim)
    thickness : float
        Less is thin, m.

    Returns
    -------
    thin : ndarray of bool, shape (m,)
    part : float
        Of the others' area.
    """
    if not len(facets):
        return np.zeros(0, dtype=bool), 0.0
    behind = thin_facets(points, facets, thickness)
    area = np.linalg.norm(area_vectors(points, facets), axis=1)
    label, _ = shells(points, facets)
    thin = (np.bincount(label, behind * area) > 0.5 * np.bincount(label, area))[label]
    rest = area[~thin].sum()
    return thin, float(area[~thin & behind].sum() / rest) if rest > 0.0 else 0.0


def wet_on_both_sides(points: np.ndarray, facets: np.ndarray, reach: float) -> np.ndarray:
    """Return which facets are single sheets: in open shells, with none behind them that faces away, shape (m,) bool."""
    return _in_open_shells(points, facets) & ~backed(points, facets, reach)


def _in_open_shells(points, facets) -> np.ndarray:
    if not len(facets):
        return np.zeros(0, dtype=bool)
    dim = facets.shape[1]
    rim = np.any(occurrences(ridges(facets).reshape(-1, dim - 1)).reshape(-1, dim) == 1, axis=1)
    label, volume = shells(points, facets)
    return np.bincount(label, rim, len(volume))[label] > 0


def backed(points, facets, reach: float) -> np.ndarray:
    """Return which facets have another within reach that faces away, each behind the other."""
    if not len(facets):
        return np.zeros(0, dtype=bool)
    corners = points[facets]
    sample, facet = sampled(corners, SAMPLED * reach)
    low, high = extent(sample)
    wide, counts = fitting(high - low, reach, 1)
    # the distance between samples is longer than that of two planes, by this at most
    reach *= np.hypot(1.0, 0.5 * SAMPLED)
    return _find_backs(corners, sample, facet, sorted_into(low, wide, counts, sample, sample), reach)


@njit(cache=True)
def sampled(corners, spacing):
    """Return points inside of facets (m, dim, dim), about so far apart, and their facets."""
    m, dim = corners.shape[:2]
    parts, n = np.empty(m, np.int64), 0
    for f in range(m):
        longest = 0.0
        for k in range(dim):
            longest = max(longest, np.sqrt(np.sum((corners[f, k] - corners[f, k - 1]) ** 2)))
        parts[f] = max(1, np.ceil(longest / spacing))
        n += parts[f] if dim == 2 else parts[f] * (parts[f] + 1) // 2
    sample, facet, n = np.empty((n, dim)), np.empty(n, np.int64), 0
    for f in range(m):
        for i in range(parts[f]):
            for j in range(1 if dim == 2 else parts[f] - i):
                s, t = (i + 1.0 / dim) / parts[f], (j + 1.0 / dim) / parts[f]
                for a in range(dim):
                    sample[n, a] = corners[f, 0, a] + s * (corners[f, 1, a] - corners[f, 0, a])
                    if dim == 3:
                        sample[n, a] += t * (corners[f, dim - 1, a] - corners[f, 0, a])
                facet[n] = f
                n += 1
    return sample, facet


@njit(cache=True)
def _find_backs(corners, sample, facet, cells, reach):
    m, dim = corners.shape[:2]
    normal, backed = np.zeros((m, 3)), np.zeros(m, np.bool_)
    for f in range(m):
        n = normal_of(corners[f])
        size = max(np.sqrt(dot(n, n)), 1e-300)
        normal[f] = n[0] / size, n[1] / size, n[2] / size
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(len(sample)):
        f, x = facet[i], in_space(sample[i])
        if backed[f]:
            continue
        far = (reach, reach, reach)
        cell_range(plus(x, 1.0, far), minus(x, far), cells, dim, first, last)
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                line = (a * cells.counts[1] + b) * cells.counts[2]
                for k in range(cells.start[line + first[2]], cells.start[line + last[2] + 1]):
                    j = cells.item[k]
                    g, d = facet[j], minus(in_space(sample[j]), x)
                    if dot(normal[f], normal[g]) < -1e-6 and dot(d, d) < reach * reach:
                        if dot(d, normal[f]) <= BEFORE * reach and dot(d, normal[g]) >= -BEFORE * reach:
                            backed[f] = backed[g] = True
    return backed
