"""Wall particles behind the facets of solids: what is seen of them is the solid, once. A few seconds."""

import itertools

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.fields.sph.cells import Pairs, cell_grid
from petfsi.fields.sph.kernels import Kernel
from petfsi.fields.sph.passes import Met
from petfsi.fields.sph.skin import Skin

DX = 0.1


def box_surface(dim, size):
    """Points and facets, normals outwards, of a box with its lower corner at the origin."""
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=dim))) * size
    if dim == 2:
        return corners, np.array([[0, 2], [2, 3], [3, 1], [1, 0]])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def look(points, facets, x, is_thin, turn=None):
    """Return the wall rows of a surface, and how much of each every place of x sees: (n, n_wall)."""
    dim = points.shape[1]
    grid = cell_grid(np.full(dim, -2.0), np.full(dim, 4.0), 3 * DX, np.zeros(dim, dtype=bool))
    thin = np.full(len(facets), is_thin)
    skin = Skin(MPI.COMM_SELF, grid, DX, 3 * DX, points, facets, thin, False, np.zeros((0, dim)))
    if turn is not None:
        skin.place(points @ turn.T, np.zeros_like(points))
    n = len(skin.x)
    skin.rows, skin._shift = np.arange(n), np.zeros((n, dim))
    pairs = Pairs(np.arange(0, n * len(x) + 1, n), np.tile(np.arange(n, dtype=np.int32), len(x)))
    skin._met = Met(skin._wall_rows(), pairs, seen=np.empty(n * len(x)))
    skin.look(x)
    return skin.met.rows, skin.met.seen.reshape(len(x), n)


def solid_sum(kernel, size, x):
    """The kernel's integral over the box from each place of x."""
    dim, fine = x.shape[1], DX / 8
    rows = [(np.arange(round(s / fine)) + 0.5) * fine for s in size]
    places = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, dim)
    return np.array([kernel.values(np.linalg.norm(places - p, axis=1))[0].sum() for p in x]) * fine**dim


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("angle", (0.0, 0.7))
@pytest.mark.parametrize("is_thin", (False, True))
def test_an_edge_is_seen_once_from_all_around(dim, angle, is_thin):
    """From before both faces, wall particles of each fill the edge; they counted twice (1.6 of the integral)."""
    size = np.full(dim, 0.8)
    points, facets = box_surface(dim, size)
    t = np.linspace(0.0, 0.5 * np.pi, 13)
    around = np.stack([-np.cos(t), -np.sin(t), np.zeros_like(t)], axis=1)[:, :dim]
    x = np.concatenate([r * DX * around for r in (0.6, 1.0, 1.6)])
    x = np.concatenate([x, np.stack([np.linspace(-0.4, 0.4, 9), np.full(9, -0.6 * DX), np.zeros(9)], axis=1)[:, :dim]])
    if dim == 3:
        x[:, 2] = 0.4
    turn = np.eye(dim)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    rows, seen = look(points, facets, x @ turn.T, is_thin, turn)
    kernel = Kernel("wendland", dim, 1.5 * DX)
    W = kernel.values(np.linalg.norm((x @ turn.T)[:, None] - rows.x, axis=2).ravel())[0].reshape(seen.shape)
    found, wanted = (seen * W) @ rows.volume, solid_sum(kernel, size, x)
    assert np.abs(found - wanted).max() < 0.03
    assert np.all(found < 1.15 * wanted + 0.01)


def test_the_end_of_a_thin_plate_is_seen_from_before_it():
    """What hides the water on the other side, and stands for it, ends where that comes into sight."""
    points, facets = box_surface(2, np.array([0.02, 2.0]))
    x = np.array([[-0.05, 1.0], [-0.05, 0.05], [-0.05, -0.05], [0.01, -0.05]])
    rows, seen = look(points, facets, x, True)
    kernel = Kernel("wendland", 2, 1.5 * DX)
    W = kernel.values(np.linalg.norm(x[:, None] - rows.x, axis=2).ravel())[0].reshape(seen.shape)
    found = (seen * W) @ rows.volume
    # all places whose straight way to x meets the plate
    places = np.stack(np.meshgrid(*[(np.arange(-80, 80) + 0.5) * DX / 20] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    for k, p in enumerate(x):
        y = places + p
        hit = np.zeros(len(y), dtype=bool)
        for a, b in (points[f] for f in facets):
            side = [(v - a)[..., 0] * (b - a)[1] - (v - a)[..., 1] * (b - a)[0] for v in (p, y)]
            ends = [(e - p)[0] * (y - p)[:, 1] - (e - p)[1] * (y - p)[:, 0] for e in (a, b)]
            hit |= (side[0] * side[1] < 0) & (ends[0] * ends[1] < 0)
        wanted = kernel.values(np.linalg.norm(places[hit], axis=1))[0].sum() * (DX / 20) ** 2
        assert found[k] == pytest.approx(wanted, abs=0.04), k
