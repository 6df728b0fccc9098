"""The ray transfer: exact forces and fluxes, identities, and the same answer on any number of ranks."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from scipy.sparse import csr_matrix

from petfsi.couplings.quadrature import area_normals
from petfsi.couplings.ray import RayCoupling
from petfsi.fields.mac.fluid import MacFluid
from petfsi.fields.mac.grid.kinds import FLUID, PRESSURE, SOLID, SOLID_FACE, VOID
from petfsi.fields.solid.solid import SimplexSolid
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import Layout
from petfsi.scene.schema import Scene


class Shell:
    """A stand-in for a solid: just a surface, its points in scrambled order spread over the ranks."""

    name = "solid"

    def __init__(self, comm, points, facets, void=None, fixed=None):
        n, dim = points.shape
        self.comm, self.points, self.velocity = comm, points.copy(), np.zeros_like(points)
        share = [dim * (n * r // comm.size) for r in range(comm.size + 1)]
        self.layout = Layout.of(comm, share[comm.rank + 1] - share[comm.rank])
        order = np.random.default_rng(1).permutation(n)
        self.unknowns = (order[:, None] * dim + np.arange(dim)).ravel()  # of point * dim + axis
        self.held = np.zeros(n * dim, dtype=bool) if fixed is None else fixed.ravel()
        self.prescribed = np.zeros(n * dim)
        maps = []
        for kept in (~self.held, self.held):
            rows = np.flatnonzero(kept)
            maps.append(csr_matrix((np.ones(len(rows)), (rows, self.unknowns[rows])), shape=(n * dim, n * dim)))
        void = np.zeros(len(facets), dtype=bool) if void is None else void
        self._surface = Surface(facets, void.copy(), void, *maps)

    def surface(self):
        return self._surface

    def surface_positions(self):
        return self.points

    def surface_velocity(self):
        return self.velocity

    def fixed_velocity(self):
        return self.prescribed

    def local(self, values):
        """This rank's unknowns, given one row per surface point."""
        u = np.empty(self.layout.n_global)
        u[self.unknowns] = np.asarray(values, dtype=float).ravel()
        return u[self.layout.start : self.layout.end]

    def by_point(self, local):
        u = np.concatenate(self.comm.allgather(np.asarray(local)))
        return u[self.unknowns].reshape(self.points.shape)


def make_scene(cells, size, solids=None, **extra):
    dim = len(cells)
    fluid = {"density": 1000.0, "origin": [0.0] * dim, "size": size, "cells": cells, "sides": extra.pop("sides", {})}
    return Scene.model_validate(
        {
            "dim": dim,
            "time": {"end": 1.0, "dt": 0.1, "integrator": "newmark"},
            "fluid": fluid,
            "solids": solids or {},
            **extra,
        }
    )


def couple(comm, cells, size, points, facets, quadrature=2, sides=None, **shell):
    scene = make_scene(cells, size, sides=sides or {}, coupling={"transfer": "ray", "quadrature": quadrature})
    fluid, solid = MacFluid(comm, scene), Shell(comm, points, facets, **shell)
    coupling = RayCoupling(fluid, solid, scene.coupling)
    step(coupling)
    return SimpleNamespace(fluid=fluid, solid=solid, coupling=coupling, grid=fluid.grid)


def step(coupling, dt=0.1):
    coupling.couple(0.0, dt)
    coupling.fluid.rhs[:] = 0.0
    coupling.assemble(0.0, dt)


def times(mat, local):
    x, y = mat.createVecs()
    x.array = local
    mat.mult(x, y)
    return y.array.copy()


def force(it, pressure):
    """J p by surface point, p a function of the coordinates."""
    grid = it.grid
    p = np.broadcast_to(pressure(*grid.coordinates(None)[: grid.dim]), grid.shape(None)).astype(float)
    return -it.solid.by_point(times(it.coupling.blocks["solid", "pressure"], grid.to_vec(p)))


def outflow(it, velocity):
    """D1 H u as a local cell array (zero in ghosts), u given by surface point."""
    cells = it.grid.zeros_cells()
    it.grid.from_vec(times(it.coupling.blocks["pressure", "solid"], it.solid.local(velocity)), cells)
    return cells


def nodal_areas(points, facets):
    areas = np.zeros_like(points)
    for i in range(facets.shape[1]):
        np.add.at(areas, facets[:, i], area_normals(points, facets) / facets.shape[1])
    return areas


def circle(n, centre, radius):
    angle = 2 * np.pi * np.arange(n) / n
    i = np.arange(n)
    return np.array(centre) + radius * np.column_stack((np.cos(angle), np.sin(angle))), np.column_stack(
        (i, (i + 1) % n)
    )


def sphere(n_cuts, centre, radius):
    """An octahedron cut n_cuts times and blown up."""
    points = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=float)
    facets = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    for _ in range(n_cuts):
        edges = np.concatenate((facets[:, [0, 1]], facets[:, [1, 2]], facets[:, [2, 0]]))
        edges, inverse = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        a, b, c = len(points) + inverse.reshape(3, -1)
        points = np.concatenate((points, points[edges].mean(axis=1)))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        p, q, r = facets.T
        facets = np.concatenate([np.column_stack(t) for t in ((p, a, c), (a, q, b), (c, b, r), (a, b, c))])
    return np.array(centre) + radius * points, facets


def ball(dim, centre=None, radius=0.31, n=2):
    centre = [0.52, 0.47, 0.49][:dim] if centre is None else centre
    return circle(24 * n, centre, radius) if dim == 2 else sphere(n, centre, radius)


def sheet(dim, low, high):
    """The surface of a box as one quadrilateral a side."""
    points = np.array(list(itertools.product(*zip(low, high, strict=True))))
    if dim == 2:
        return points, np.array([[0, 2], [2, 3], [3, 1], [1, 0]])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return points, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))


def volume(points, facets):
    return np.sum(points[facets].mean(axis=1) * area_normals(points, facets)) / points.shape[1]


def test_the_stand_ins_are_closed_and_outward():
    for dim in (2, 3):
        assert volume(*sheet(dim, [0.0] * dim, [0.5] * dim)) == pytest.approx(0.5**dim)
        for surface in (sheet(dim, [0.0] * dim, [0.5] * dim), ball(dim)):
            assert np.abs(nodal_areas(*surface).sum(axis=0)).max() < 1e-15
    assert volume(*ball(3, n=4)) == pytest.approx(4 / 3 * np.pi * 0.31**3, rel=0.01)


# ---- J ------------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("quadrature", [1, 2, 4])
def test_constant_pressure_gives_nodal_area_vectors(dim, quadrature):
    points, facets = ball(dim)
    it = couple(MPI.COMM_WORLD, [18] * dim, [1.0] * dim, points, facets, quadrature)
    found = force(it, lambda *x: 7.0)
    assert np.allclose(found, -7.0 * nodal_areas(points, facets), rtol=0, atol=1e-14)
    assert np.abs(found.sum(axis=0)).max() < 1e-13


@pytest.mark.parametrize("dim", [2, 3])
def test_buoyancy_is_first_order(dim):
    slope = np.array([1.0, -2.0, 0.5])[:dim]
    points, facets = ball(dim, n=3)
    error = []
    for n in (16, 32, 64):
        # mean over several positions, as the error at one of them is partly chance
        total = 0.0
        for shift in np.linspace(0, 1, 4, endpoint=False):
            moved = points + shift / n * np.array([1.0, 0.6, 0.3])[:dim]
            it = couple(MPI.COMM_SELF, [n] * dim, [1.0] * dim, moved, facets)
            lift = force(it, lambda *x: 3.0 + sum(s * c for s, c in zip(slope, x, strict=True))).sum(axis=0)
            total += np.linalg.norm(lift / volume(points, facets) + slope) / np.linalg.norm(slope)
        error.append(total / 4)
    seen = np.log2(np.divide(error[:-1], error[1:]))
    assert np.all(seen > 0.75), (error, seen)
    assert error[-1] < 0.06


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("at", [0.5, 0.503, 0.4625, 0.45])
def test_pressures_on_the_two_sides_of_a_thin_sheet_never_mix(dim, at):
    """A sheet a tenth of a cell thick from wall to wall, in any place relative to the centres (dx = 0.05)."""
    low, high = [-0.1] * dim, [1.1] * dim
    low[0], high[0] = at, at + 0.005
    points, facets = sheet(dim, low, high)
    it = couple(MPI.COMM_SELF, [20] * dim, [1.0] * dim, points, facets)
    kinds = it.fluid.cell_kind[it.grid.owned(None)]
    on_centres = round((at - 0.025) / 0.05, 9) % 1 == 0
    assert set(np.unique(kinds)) == ({FLUID, SOLID} if on_centres else {FLUID})
    x = it.grid.coordinates(None)[0]
    one_side = force(it, lambda *c: 1.0 * (x < at + 0.0025))
    other_side = force(it, lambda *c: 1.0 * (x >= at + 0.0025))
    left = np.flatnonzero(np.all(points[facets][:, :, 0] == at, axis=1))
    right = np.flatnonzero(np.all(points[facets][:, :, 0] == at + 0.005, axis=1))
    # the two big faces get exactly their own pressure wherever they are inside the domain
    assert np.all(one_side[np.unique(facets[right]), 0] == 0.0)
    assert np.all(other_side[np.unique(facets[left]), 0] == 0.0)
    wet = 1.05 ** (dim - 1)  # quadrature points up to half a cell beyond a wall still have cells around them
    assert one_side[:, 0].sum() == pytest.approx(wet, abs=0.06 * wet)
    assert other_side[:, 0].sum() == pytest.approx(-one_side[:, 0].sum(), rel=1e-12)
    # and every way through the sheet is closed
    normal = it.fluid.face_kind[0][it.grid.owned(0)]
    passing = np.any(normal == SOLID_FACE, axis=0)
    assert passing.all()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_force_on_a_sheet_within_the_walls_is_exact(dim):
    low, high = [0.0] * dim, [1.0] * dim
    low[0], high[0] = 0.512, 0.517
    points, facets = sheet(dim, low, high)
    it = couple(MPI.COMM_SELF, [20] * dim, [1.0] * dim, points, facets)
    left, right = points[:, 0] < 0.515, points[:, 0] > 0.515
    areas = nodal_areas(points, facets)
    one_side = force(it, lambda *c: 1.0 * (c[0] < 0.515))
    assert np.allclose(one_side[left, 0], -areas[left, 0], rtol=0, atol=1e-14)
    assert np.all(one_side[right, 0] == 0.0)
    assert one_side[:, 0].sum() == pytest.approx(1.0, abs=1e-13)
    assert np.all(np.abs(one_side[:, 1:]) < 1e-14)  # the rims lie in the walls


@pytest.mark.parametrize("dim", [2, 3])
def test_facets_far_larger_than_cells_are_sampled_finely(dim):
    """A smooth pressure on a box of a few big facets that lie on cell faces: p is read half a cell in front."""
    points, facets = sheet(dim, [0.25] * dim, [0.75] * dim)
    it = couple(MPI.COMM_SELF, [32] * dim, [1.0] * dim, points, facets)
    found = force(it, lambda *x: np.cos(3 * x[1]) + 0 * x[0])
    exact = (np.cos(3 * (0.25 - 1 / 64)) - np.cos(3 * (0.75 + 1 / 64))) * 0.5 ** (dim - 1)
    assert found[:, 1].sum() == pytest.approx(exact, rel=1e-12)
    left = points[:, 0] == 0.25
    exact = (np.sin(3 * 0.75) - np.sin(3 * 0.25)) / 3 * 0.5 ** (dim - 2)
    assert found[left, 0].sum() == pytest.approx(exact, rel=1e-3)


# ---- D1 H ---------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("sides", [{}, {"left": "periodic", "right": "periodic"}])
def test_a_solid_moving_with_the_fluid_leaves_no_divergence(dim, sides):
    """D2 v + D1 H u = 0 for v = u constant, in cells away from the walls; across a periodic seam, too."""
    points, facets = ball(dim, centre=[0.95 if sides else 0.5] + [0.47] * (dim - 1), radius=0.27)
    it = couple(MPI.COMM_WORLD, [20] * dim, [1.0] * dim, points, facets, sides=sides)
    grid, u = it.grid, np.array([0.3, -0.7, 0.2])[:dim]
    total = outflow(it, np.tile(u, (len(points), 1)))
    n_touched = it.grid.comm.allreduce(int(np.count_nonzero(total)))
    assert n_touched > 20
    away = np.ones(grid.shape(None), dtype=bool)
    for a in range(dim):
        area = grid.face_area(a)
        through = np.where(it.fluid.face_kind[a] == PRESSURE, u[a] * area, 0.0)
        for lower, sign in ((True, -1.0), (False, 1.0)):
            part = [slice(None)] * 3
            part[a] = slice(0, -1) if lower else slice(1, None)
            total += sign * through[tuple(part)]
            away &= np.isin(it.fluid.face_kind[a][tuple(part)], (PRESSURE, SOLID_FACE))
    cells = (it.fluid.cell_kind == FLUID) & away
    owned = np.zeros_like(cells)
    owned[grid.owned(None)] = True
    assert np.abs(total[cells & owned]).max() < 1e-15
    assert np.all(outflow(it, np.tile(u, (len(points), 1)))[it.fluid.cell_kind != FLUID] == 0.0)


def test_a_face_takes_the_velocity_where_the_ray_meets_the_facet():
    """u linear in space is reproduced exactly by H at the hit points of a facet oblique to the grid."""
    points = np.array([[0.2, 0.11], [0.83, 0.31], [0.53, 0.87]])
    facets = np.array([[0, 1], [1, 2], [2, 0]])
    it = couple(MPI.COMM_SELF, [16, 16], [1.0, 1.0], points, facets)
    it.solid.velocity = np.column_stack((1 + 2 * points[:, 0] - points[:, 1], 3 * points[:, 1] - points[:, 0]))
    it.coupling.accept({}, 0.0, 0.1)
    n = 0
    for a in range(2):
        faces = np.argwhere(it.fluid.face_kind[a] == SOLID_FACE)
        for index in faces:
            across = it.grid.cell_centres(1 - a)[index[1 - a]]
            low = it.grid.cell_centres(a)[index[a] - 1]
            hits = []
            for u, v in points[facets]:
                t = (across - u[1 - a]) / (v[1 - a] - u[1 - a])
                x = u + t * (v - u)
                if 0 <= t < 1 and low < x[a] < low + 1 / 16:
                    hits.append(x)
            x, y = min(hits, key=lambda x, a=a, low=low: abs(x[a] - low - 1 / 32))
            exact = 1 + 2 * x - y if a == 0 else 3 * y - x
            assert it.fluid.boundary_velocity[a][tuple(index)] == pytest.approx(exact, abs=1e-13)
            n += 1
    assert n > 30
    # and the flux block says the same: net outflow of all fluid cells is the sum over their solid faces
    u = it.solid.velocity
    total = outflow(it, u)
    expected = it.grid.zeros_cells()
    for a in range(2):
        for i, j, k in np.argwhere(it.fluid.face_kind[a] == SOLID_FACE):
            flux = it.fluid.boundary_velocity[a][i, j, k] / 16
            expected[i, j, k] -= flux
            expected[i - (a == 0), j - (a == 1), k] += flux
    fluid = it.fluid.cell_kind == FLUID
    assert np.allclose(total[fluid], expected[fluid], rtol=0, atol=1e-15)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_touched_cells_are_those_with_a_row(dim):
    points, facets = ball(dim)
    fixed = np.zeros(points.shape, dtype=bool)
    fixed[points[:, 0] > 0.5] = True
    it = couple(MPI.COMM_WORLD, [18] * dim, [1.0] * dim, points, facets, fixed=fixed)
    random = np.random.default_rng(0).normal(size=points.shape)
    rows = outflow(it, random) != 0
    it.grid.exchange_cells(rows)
    assert np.array_equal(it.coupling.touched_cells, rows)
    x = np.broadcast_to(it.grid.coordinates(None)[0], rows.shape)
    assert not rows[x > 0.62].any()


# ---- cavities, supports -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("void", [False, True])
def test_cavities(dim, void):
    outer, facets = ball(dim, radius=0.4)
    inner, _ = ball(dim, radius=0.2)
    points = np.concatenate((outer, inner))
    facets = np.concatenate((facets, facets[:, ::-1] + len(outer)))
    hollow = np.arange(len(facets)) >= len(facets) // 2
    it = couple(MPI.COMM_SELF, [20] * dim, [1.0] * dim, points, facets, void=hollow & void)
    grid = it.grid
    distance = np.sqrt(
        sum((x - c) ** 2 for x, c in zip(grid.coordinates(None), [0.52, 0.47, 0.49][:dim], strict=False))
    )
    kind = it.fluid.cell_kind[grid.owned(None)]
    distance = distance[grid.owned(None)]
    assert set(np.unique(kind[distance < 0.15])) == {VOID if void else FLUID}
    assert set(np.unique(kind[(distance > 0.21) & (distance < 0.35)])) == {SOLID}
    assert set(np.unique(kind[distance > 0.41])) == {FLUID}
    areas = nodal_areas(points, facets)
    if void:
        areas[len(outer) :] = 0.0
    assert np.allclose(force(it, lambda *x: 2.0), -2.0 * areas, rtol=0, atol=1e-14)
    flux = outflow(it, np.random.default_rng(0).normal(size=points.shape))[grid.owned(None)]
    assert np.any(flux[distance < 0.22]) != void
    assert np.all(flux[kind != FLUID] == 0.0)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_prescribed_points_act_through_the_right_hand_side(dim):
    points, facets = ball(dim)
    velocity = np.random.default_rng(4).normal(size=points.shape)
    free = couple(MPI.COMM_WORLD, [18] * dim, [1.0] * dim, points, facets)
    fixed = points > 0.45
    held = couple(MPI.COMM_WORLD, [18] * dim, [1.0] * dim, points, facets, fixed=fixed)
    held.solid.prescribed[held.solid.unknowns[fixed.ravel()]] = velocity[fixed]
    for _ in range(2):  # the second time nothing has moved, and the right-hand side is new all the same
        step(held.coupling)
        whole = outflow(free, velocity)
        known = held.grid.zeros_cells()
        held.grid.from_vec(-held.fluid.rhs, known)
        assert np.abs(known).max() > 0 or MPI.COMM_WORLD.size > 1
        assert np.allclose(outflow(held, velocity) + known, whole, rtol=0, atol=1e-15)
        assert np.array_equal(outflow(held, np.where(fixed, np.nan_to_num(velocity) * 9, velocity)),
                              outflow(held, velocity))  # fmt: skip
    everywhere, here = force(free, lambda *x: 1.0 + x[1]), force(held, lambda *x: 1.0 + x[1])
    assert np.all(here[fixed] == 0.0)
    assert np.allclose(here[~fixed], everywhere[~fixed], rtol=0, atol=1e-15)


# ---- ranks, repeats, skips ----------------------------------------------------------------------------------


def random_blob(dim, seed=0):
    points, facets = ball(dim, radius=0.3)
    random = np.random.default_rng(seed)
    return points + 0.01 * random.normal(size=points.shape), facets


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("sides", [{}, {"bottom": "periodic", "top": "periodic"}])
def test_any_number_of_ranks_gives_the_serial_answer(dim, sides):
    points, facets = random_blob(dim)
    points[:, 1] += 0.4 if sides else 0.0
    cells, size = [19, 22, 21][:dim], [1.0, 1.1, 1.0][:dim]
    velocity = np.random.default_rng(2).normal(size=points.shape)

    def pressure(*x):
        return np.sin(5 * x[0]) + np.cos(2 * np.pi * x[1] / 1.1)

    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        it = couple(comm, cells, size, points, facets, sides=sides)
        it.solid.velocity = velocity
        it.coupling.accept({}, 0.0, 0.1)
        found.append((it, force(it, pressure), outflow(it, velocity)))
    (it, forces, flux), (serial, serial_forces, serial_flux) = found
    assert np.allclose(forces, serial_forces, rtol=0, atol=1e-15)
    grid = it.grid

    def piece(axis):
        """Where this rank's faces or cells, its ghosts inside the domain included, lie in the serial arrays."""
        mine, theirs = [], []
        for b in range(3):
            inside = grid.inside(axis)[b]
            first = inside.start + grid.lo[b] - grid.ghost[b] + serial.grid.ghost[b]
            mine.append(inside)
            theirs.append(slice(first, first + inside.stop - inside.start))
        return tuple(mine), tuple(theirs)

    mine, theirs = grid.owned(None), tuple(
        slice(m + g, h + g) for m, h, g in zip(grid.lo, grid.hi, serial.grid.ghost, strict=True)
    )  # fmt: skip
    assert np.allclose(flux[mine], serial_flux[theirs], rtol=0, atol=1e-15)
    mine, theirs = piece(None)
    assert np.array_equal(it.fluid.cell_kind[mine], serial.fluid.cell_kind[theirs])
    touched, serial_touched = it.coupling.touched_cells, serial.coupling.touched_cells
    assert np.array_equal(touched[mine], serial_touched[theirs])
    for a in range(dim):
        mine, theirs = piece(a)
        assert np.array_equal(it.fluid.face_kind[a][mine], serial.fluid.face_kind[a][theirs])
        assert np.allclose(
            it.fluid.boundary_velocity[a][mine], serial.fluid.boundary_velocity[a][theirs], rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("dim", [2, 3])
def test_a_surface_across_a_periodic_seam_is_the_shifted_one(dim):
    sides = {"left": "periodic", "right": "periodic", "bottom": "periodic", "top": "periodic"}
    points, facets = random_blob(dim)
    cells = [16] * dim
    plain = couple(MPI.COMM_SELF, cells, [1.0] * dim, points, facets, sides=sides)
    for shift in ((8, 0, 0), (8, 8, 0), (-24, 40, 0)):
        moved = couple(MPI.COMM_SELF, cells, [1.0] * dim, points + np.array(shift[:dim]) / 16, facets, sides=sides)
        owned = plain.grid.owned(None)
        rolled = np.roll(plain.fluid.cell_kind[owned], shift, axis=(0, 1, 2))
        assert np.array_equal(moved.fluid.cell_kind[owned], rolled)
        velocity = np.random.default_rng(2).normal(size=points.shape)
        there = np.roll(outflow(plain, velocity)[owned], shift, axis=(0, 1, 2))
        assert np.allclose(outflow(moved, velocity)[owned], there, rtol=0, atol=1e-13)
        offset = np.array(shift[:2]) / 16

        def wave(x, y, *z, offset=offset):
            return np.sin(2 * np.pi * (x - offset[0])) + np.cos(2 * np.pi * (y - offset[1]))

        def still(x, y, *z):
            return np.sin(2 * np.pi * x) + np.cos(2 * np.pi * y)

        assert np.allclose(force(moved, wave), force(plain, still), rtol=0, atol=1e-12)


@pytest.mark.parallel([1, 3])
def test_a_still_solid_costs_nothing_and_a_moving_one_keeps_its_matrices():
    points, facets = random_blob(2)
    it = couple(MPI.COMM_WORLD, [24, 24], [1.0, 1.0], points, facets)
    coupling = it.coupling
    blocks = dict(coupling.blocks)
    handles = {name: block.handle for name, block in blocks.items()}
    version = it.fluid.geometry_version
    step(coupling)
    assert (coupling.n_coupled, coupling.n_assembled, coupling.pattern_version) == (1, 1, 1)
    assert it.fluid.geometry_version == version
    for n in range(2, 6):
        it.solid.points += [0.013, 0.021]
        step(coupling)
        assert (coupling.n_coupled, coupling.n_assembled, coupling.pattern_version) == (n, n, n)
        assert all(coupling.blocks[name] is block for name, block in blocks.items())
        assert {name: block.handle for name, block in coupling.blocks.items()} == handles
        fresh = couple(MPI.COMM_WORLD, [24, 24], [1.0, 1.0], it.solid.points, facets)
        for name in blocks:
            difference = fresh.coupling.blocks[name].copy()
            difference.axpy(-1.0, blocks[name])
            assert difference.norm() == 0.0
    # hardly moved: new values in the old pattern
    it.solid.points += 1e-9
    step(coupling)
    assert (coupling.n_assembled, coupling.pattern_version) == (6, 5)


def test_another_time_step_fills_the_blocks_again():
    """The solver scales blocks in place, by amounts that depend on dt."""
    it = couple(MPI.COMM_SELF, [24, 24], [1.0, 1.0], *random_blob(2))
    original = {name: block.copy() for name, block in it.coupling.blocks.items()}
    for block in it.coupling.blocks.values():
        block.scale(17.0)
    step(it.coupling)
    assert it.coupling.n_assembled == 1
    step(it.coupling, dt=0.05)
    assert (it.coupling.n_coupled, it.coupling.n_assembled) == (1, 2)
    for name, block in it.coupling.blocks.items():
        original[name].axpy(-1.0, block)
        assert original[name].norm() == 0.0


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_two_runs_agree_bit_for_bit(dim):
    points, facets = random_blob(dim)
    one, two = (couple(MPI.COMM_WORLD, [18] * dim, [1.0] * dim, points, facets) for _ in range(2))
    for name, block in one.coupling.blocks.items():
        for a, b in zip(block.getValuesCSR(), two.coupling.blocks[name].getValuesCSR(), strict=True):
            assert np.array_equal(a, b)


# ---- with a real solid --------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_block_of_elements_under_water(dim):
    box = {"origin": [0.31] * dim, "size": [0.4] * dim, "cells": [5] * dim}
    solid = {"shape": {"box": box}, "density": 1200.0, "young": 1e5, "poisson": 0.3}
    solid["supports"] = [{"where": "bottom", "fix": ["x", "y"]}]
    solid["initial"] = {"velocity": ["0.1*y", "0.2"] + ["0.0"] * (dim - 2)}
    scene = make_scene([20] * dim, [1.0] * dim, solids={"block": solid}, coupling={"transfer": "ray"})
    fluid, field = MacFluid(MPI.COMM_WORLD, scene), SimplexSolid(MPI.COMM_WORLD, scene)
    coupling = RayCoupling(fluid, field, scene.coupling)
    step(coupling)
    inside = MPI.COMM_WORLD.allreduce(int(np.sum(fluid.cell_kind[fluid.grid.owned(None)] == SOLID)))
    assert inside == 8**dim
    pressure = fluid.grid.zeros_cells()
    pressure[...] = 4.0
    nodal = -times(coupling.blocks["solid", "pressure"], fluid.grid.to_vec(pressure))
    total = MPI.COMM_WORLD.allreduce(nodal.reshape(-1, dim).sum(axis=0))
    # bottom nodes are held, so what acts on them is missing: the lift of the bottom, part of the rims' push
    surface, positions = field.surface(), field.surface_positions()
    expected = -4.0 * (surface.point_map.T @ nodal_areas(positions, surface.facets).ravel())
    mine = slice(field.layout.start, field.layout.end)
    assert np.allclose(nodal, expected[mine], rtol=0, atol=1e-13)
    free_rims = 0.4 ** (dim - 1)
    assert total[1] == pytest.approx(-4.0 * free_rims, rel=1e-12)
    coupling.accept({}, 0.0, 0.1)
    top = fluid.face_kind[1] == SOLID_FACE
    y = np.broadcast_to(fluid.grid.coordinates(1)[1], top.shape)
    assert np.allclose(fluid.boundary_velocity[1][top & (y > 0.6)], 0.2, rtol=0, atol=1e-14)
    assert np.allclose(fluid.boundary_velocity[1][top & (y < 0.4)], 0.0, rtol=0, atol=1e-14)
