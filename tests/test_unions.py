"""Solids that touch and overlap: the cells that both cut close, and what is apart stays apart."""

from __future__ import annotations

import numpy as np
import pytest
from cut_cases import check, grid, star, together
from mpi4py import MPI
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from petfsi.bench.case import only_options
from petfsi.geometry.clipping import cut
from petfsi.geometry.meshes import box_mesh
from petfsi.geometry.rays import inside_mask
from petfsi.geometry.seams import find_seams
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.load import scene_from_dict
from petfsi.scene.tables import Box
from petfsi.simulation import Simulation

COMM = MPI.COMM_WORLD
DIMS = pytest.mark.parametrize("dim", [2, 3])


def block(low, high, dim):
    low, size = low[:dim], [b - a for a, b in zip(low[:dim], high, strict=False)]
    mesh = box_mesh(Box(origin=low, size=size, cells=[2] * dim))
    return mesh[0], boundary_facets(*mesh)


def overlapped(bodies, cells=4, turn=None):
    """Bodies cut by a grid, which is checked to close; and by how much the room they leave differs from a raster."""
    surface, dim = together(*bodies), bodies[0][0].shape[1]
    lattice = grid([cells] * dim)
    seams = find_seams(*surface, np.full(dim, float(cells)), np.zeros(dim, dtype=bool))
    cuts = cut(*surface, lattice, 0, None, seams)
    check(*surface, cuts, lattice)
    n = 40 if dim == 2 else 12
    shown = inside_mask(*surface, [(np.arange(cells * n) + 0.5) / n] * dim) != 0
    blocks = shown.reshape(*(k for _ in range(dim) for k in (cells, n))).mean(axis=tuple(range(1, 2 * dim, 2)))
    return cuts, np.abs(1.0 - blocks - cuts.volume)


def regions(cuts):
    """The volumes of the connected regions of fluid, large to small."""
    shape, n = cuts.volume.shape, cuts.volume.size
    number = np.full((n, 2 + max(cuts.extra_piece, default=0)), -1)
    number[:, 0] = np.arange(n)
    number[cuts.extra_cell, cuts.extra_piece] = n + np.arange(len(cuts.extra_cell))
    split = np.isin(np.arange(n), cuts.extra_cell)
    volume = np.concatenate((cuts.volume.ravel(), cuts.extra_volume))
    np.subtract.at(volume, cuts.extra_cell, cuts.extra_volume)
    pairs = []
    for a, opening in enumerate(cuts.open):
        above = np.array([i.ravel() for i in np.indices(opening.shape)])
        inner = np.flatnonzero((above[a] > 0) & (above[a] < shape[a]) & (opening.ravel() > 0.0))
        upper = np.ravel_multi_index(tuple(above[:, inner]), shape)
        lower = upper - np.prod(shape[a + 1 :], dtype=int)
        whole = ~split[upper] & ~split[lower]
        pairs.append(np.stack((lower[whole], upper[whole])))
        mine = (cuts.link_axis == a) & (cuts.link_below >= 0) & (cuts.link_above >= 0)
        upper = np.ravel_multi_index(np.unravel_index(cuts.link_face[mine], opening.shape), shape)
        lower = upper - np.prod(shape[a + 1 :], dtype=int)
        pairs.append(np.stack((number[lower, cuts.link_below[mine]], number[upper, cuts.link_above[mine]])))
    one, other = np.concatenate(pairs, axis=1)
    _, label = connected_components(coo_matrix((np.ones(len(one)), (one, other)), shape=(len(volume),) * 2))
    total = np.bincount(label, volume)
    return np.sort(total[total > 1e-6])[::-1]


@DIMS
@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_overlap_anyhow_close(dim, seed):
    rng = np.random.default_rng(seed)
    cells = 6 if dim == 2 else 4
    bodies = [star(rng, 9 if dim == 2 else 12, rng.uniform(1, cells - 1, dim), 0.3, 1.6) for _ in range(3)]
    _, error = overlapped(bodies, cells)
    assert error.max() < 0.02
    assert error.mean() < 2e-3


#: Bodies that share a plane, or more; how much they fill of the grid along x, y and z.
PAIRS = {
    "side by side": [([0.3, 0.7, 0.6], [1.45, 2.2, 2.3]), ([1.45, 0.7, 0.6], [2.9, 2.2, 2.3])],
    "side by side in a plane": [([0.3, 1.0, 1.0], [2.0, 2.0, 2.0]), ([2.0, 1.0, 1.0], [2.9, 2.0, 2.0])],
    "planks": [([0.3, 1.2, 1.3], [2.9, 1.5, 1.6]), ([1.4, 1.5, 0.3], [1.8, 1.9, 2.8])],
    "crossed": [([0.3, 1.2, 1.3], [2.9, 1.5, 1.6]), ([1.4, 0.5, 1.1], [1.5, 2.9, 1.9])],
    "one and the same": [([0.3, 0.7, 0.6], [1.45, 2.2, 2.3]), ([0.3, 0.7, 0.6], [1.45, 2.2, 2.3])],
    "with common sides": [([0.3, 0.7, 0.6], [1.45, 2.2, 2.3]), ([0.3, 0.7, 0.6], [2.45, 1.2, 2.3])],
}


@DIMS
@pytest.mark.parametrize("name", PAIRS)
def test_bodies_with_common_faces_close(dim, name):
    (low, high), (low_b, high_b) = ((np.array(a[:dim]), np.array(b[:dim])) for a, b in PAIRS[name])
    cuts, _ = overlapped([block(a[:dim], b[:dim], dim) for a, b in PAIRS[name]])
    common = np.prod(np.maximum(np.minimum(high, high_b) - np.maximum(low, low_b), 0.0))
    filled = np.prod(high - low) + np.prod(high_b - low_b) - common
    assert cuts.volume.size - cuts.volume.sum() == pytest.approx(filled, abs=1e-6)
    assert len(regions(cuts)) == 1


@DIMS
@pytest.mark.parametrize("foot", [2.0, 2.2, 1.9, 2.0 - 1e-7])
@pytest.mark.parametrize("floor", [2.0, 2.2])
def test_a_sheet_that_stands_on_a_floor_parts_what_is_beside_it(dim, foot, floor):
    if foot > floor:
        pytest.skip("it does not stand on it")
    sheet, ground = block([1.3, foot, -0.5], [1.4, 5.0, 4.5], dim), block([-1.0, -1.0, -1.0], [5.0, floor, 5.0], dim)
    for bodies in ([sheet, ground], [ground, sheet]):
        cuts, _ = overlapped(bodies)
        depth = (4.0 - floor) * 4.0 ** (dim - 2)
        assert regions(cuts) == pytest.approx([2.6 * depth, 1.3 * depth], rel=1e-6)


def test_a_sheet_across_a_corner_of_two_walls_parts_it():
    """A sheet aslant from one wall to another, its ends in them."""
    turn = np.array([[np.cos(0.6), np.sin(0.6)], [-np.sin(0.6), np.cos(0.6)]])
    points, facets = block([-3.0, 0.0], [3.0, 0.05], 2)
    walls = [block([-1.0, -1.0], [5.0, 0.55], 2), block([-1.0, -1.0], [0.45, 5.0], 2)]
    cuts, error = overlapped([(points @ turn.T + [1.6, 1.7], facets), *walls])
    assert len(regions(cuts)) == 2
    assert error.max() < 0.02


# ---- runs ---------------------------------------------------------------------------------------------------


def run(data, steps):
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(COMM, scene_from_dict(data))
        sim.prepare()
        for _ in range(steps):
            sim.advance()
    return sim


def sheet_on_corner(dim, foot):
    """A sheet that hangs from the top and stands on, or in, an obstacle."""
    cells = [24, 16] if dim == 2 else [12, 12, 6]
    fluid = {"density": 1000.0, "origin": [0.0] * dim, "size": [1.0, 1.0, 0.5][:dim], "cells": cells}
    sheet = {"origin": [0.0437, foot, 0.0][:dim], "size": [0.006, 1.0 - foot, 0.5][:dim], "cells": [1, 8, 2][:dim]}
    held = [{"where": side, "fix": ["x", "y", "z"][:dim]} for side in ("bottom", "top")]
    if dim == 3:
        held += [{"where": side, "fix": ["z"]} for side in ("back", "front")]
    solid = {"shape": {"box": sheet}, "density": 1100.0, "young": 1e7, "poisson": 0.3, "supports": held}
    corner = {"shape": {"box": {"origin": [-0.1] * dim, "size": [0.6, 0.6, 0.7][:dim]}}}
    data = {
        "dim": dim,
        "gravity": [0.0, -9.81, 0.0][:dim],
        "time": {"end": 0.05, "dt": 0.01, "integrator": "newmark"},
        "fluid": fluid,
    }
    return data | {"solids": {"sheet": solid}, "obstacles": {"corner": corner}}


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("dim, foot", [(2, 0.5), (2, 0.48), (3, 0.5), (3, 0.48)])
def test_a_sheet_on_an_obstacle_makes_two_regions(dim, foot):
    if dim == 3 and COMM.size > 2:
        pytest.skip("too small a grid")
    sim = run(sheet_on_corner(dim, foot), 3)
    deep = 0.5 ** (dim - 2)
    left, right = 0.0437 * 0.5 * deep, (0.75 - 0.0497 * 0.5) * deep
    assert sim.regions.volumes == pytest.approx([left, right], rel=1e-6)


@pytest.mark.parallel([1, 2])
def test_water_between_a_beam_drawn_into_the_walls_stays_where_it_is():
    """A beam clamped in two walls, with its ends within: what is above presses on it, and nothing goes through."""
    walls = {
        name: {"shape": {"box": {"origin": [x, -0.1], "size": [0.3, 1.2]}}} for name, x in (("l", -0.13), ("r", 0.83))
    }
    beam = {"start": [0.14, 0.45], "end": [0.86, 0.45], "thickness": 0.01, "elements": 12}
    held = [{"where": end, "fix": ["x", "y", "angle"]} for end in ("start", "end")]
    solid = {"shape": {"beam": beam}, "density": 1100.0, "young": 1e9, "poisson": 0.3, "supports": held}
    fluid = {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [16, 16]}
    data = {
        "dim": 2,
        "gravity": [0.0, -9.81],
        "time": {"end": 1.0, "dt": 0.01, "integrator": "newmark"},
        "fluid": fluid,
    }
    sim = run(data | {"solids": {"beam": solid}, "obstacles": walls}, 5)
    wide = 0.83 - 0.17
    assert sim.regions.volumes == pytest.approx([wide * 0.445, wide * 0.545], rel=1e-4)
