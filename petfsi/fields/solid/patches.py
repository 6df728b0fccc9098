"""The groups of elements that forces come from: simplices of every body, and patches of linear ones.

Over a patch what resists a change of volume is taken at the mean gradient, so that a nearly incompressible body has
fewer constraints than unknowns.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from petfsi.geometry.meshes import Group, SimplexMesh
from petfsi.geometry.quadratic import linear_parts
from petfsi.geometry.surfaces import signed_volumes

#: Elements of a patch: about as many patches as nodes, one constraint to dim unknowns.
PATCH = {2: 2, 3: 6}


def grouped_mesh(bodies: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]) -> SimplexMesh:
    """Return the mesh of (points, elements, patches) of every body.

    Elements have dim + 1 nodes, or the middles of their edges too; the patch of each linear element, where there are
    any, makes a group of its own.
    """
    meshes, groups, offset = [], [], 0
    for body, (points, elements, patch) in enumerate(bodies):
        dim = points.shape[1]
        linear = elements.shape[1] == dim + 1
        meshes.append((points, elements if linear else linear_parts(elements, dim)))
        groups.append(Group(body, elements + offset))
        if patch is not None:
            group = patch_group(points, elements, patch, body)
            groups.append(replace(group, nodes=group.nodes + offset))
        offset += len(points)
    return replace(SimplexMesh.union(meshes), groups=tuple(groups))


def grid_patches(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return the patch of each simplex of a box mesh: the dim! simplices of a grid cell follow each other."""
    return np.arange(len(cells)) // math.factorial(dim)


def grown_patches(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return the patch of each simplex of any mesh, shape (ne,).

    Each grows from the first free simplex, by neighbours with the fewest free neighbours of their own, to ``PATCH``
    simplices; what stays smaller than half of that joins a neighbour.
    """
    neighbours = _neighbours(cells, dim)
    patch = _grow(neighbours, PATCH[dim])
    return np.unique(patch, return_inverse=True)[1].ravel()


def patch_group(points: np.ndarray, cells: np.ndarray, patch: np.ndarray, body: int) -> Group:
    """Return the patches of a body as a group of elements.

    With V_e and g_ea the volumes and gradients of the shape functions of a patch's simplices, a node has the gradient
    sum_e V_e g_ea / sum_e V_e.

    Parameters
    ----------
    points : ndarray, shape (n, dim)
        m.
    cells : ndarray of int, shape (ne, dim + 1)
    patch : ndarray of int, shape (ne,)
        Numbers without a gap.
    body : int
    """
    dim = points.shape[1]
    volumes = signed_volumes(points, cells)
    volume = np.bincount(patch, weights=volumes)
    pairs, which = np.unique(np.repeat(patch, dim + 1) * len(points) + cells.ravel(), return_inverse=True)
    of, node = pairs // len(points), pairs % len(points)
    count = np.bincount(of)
    place = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    nodes = np.repeat(node[np.cumsum(count) - count, None], count.max(), axis=1)
    nodes[of, place] = node
    weighted = (volumes[:, None, None] * barycentric_gradients(points, cells)).reshape(-1, dim)
    gradients = np.zeros((*nodes.shape, dim))
    for axis in range(dim):
        total = np.bincount(which.ravel(), weights=weighted[:, axis])
        gradients[of, place, axis] = total / volume[of]
    return Group(body, nodes, gradients, volume)


def barycentric_gradients(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the gradients of each simplex's barycentric coordinates, shape (ne, dim + 1, dim), 1/m."""
    corners = points[cells[:, : points.shape[1] + 1]]
    rest = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return np.concatenate((-rest.sum(axis=1, keepdims=True), rest), axis=1)


def _neighbours(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return the simplex on the other side of each facet, -1 at the boundary, shape (ne, dim + 1)."""
    facets = np.sort(np.stack([np.delete(cells, a, axis=1) for a in range(dim + 1)], axis=1).reshape(-1, dim), axis=1)
    order = np.lexsort(facets.T[::-1])
    same = np.flatnonzero(np.all(facets[order[1:]] == facets[order[:-1]], axis=1))
    one, other = order[same], order[same + 1]
    neighbours = np.full(len(facets), -1)
    neighbours[one], neighbours[other] = other // (dim + 1), one // (dim + 1)
    return neighbours.reshape(len(cells), dim + 1)


@njit(cache=True)
def _grow(neighbours, size):
    n = neighbours.shape[0]
    patch = np.full(n, -1)
    members = np.empty(size, dtype=np.int64)
    for seed in range(n):
        if patch[seed] >= 0:
            continue
        patch[seed], members[0], count = seed, seed, 1
        while count < size:
            best, fewest = -1, neighbours.shape[1] + 1
            for m in members[:count]:
                for other in neighbours[m]:
                    if other >= 0 and patch[other] < 0:
                        free = 0
                        for third in neighbours[other]:
                            free += third >= 0 and patch[third] < 0
                        if free < fewest:
                            best, fewest = other, free
            if best < 0:
                break
            patch[best], members[count] = seed, best
            count += 1
        if 2 * count <= size:
            _join(neighbours, patch, members[:count], seed)
    return patch


@njit(cache=True)
def _join(neighbours, patch, members, seed):
    """Give the members of a small patch to a patch beside it, if there is one."""
    for m in members:
        for other in neighbours[m]:
            if other >= 0 and patch[other] >= 0 and patch[other] != seed:
                for member in members:
                    patch[member] = patch[other]
                return
