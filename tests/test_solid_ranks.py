"""The solid field as others see it: its surface, its solver, ranks, state and probes."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from solid_cases import YOUNG, body, field, gathered, step, wave

from petfsi.errors import InputError
from petfsi.fields.solid.elements import State
from petfsi.fields.solid.partition import Fetch, bisect
from petfsi.petsc import Layout
from petfsi.registry import INTEGRATORS

#: Those in which a body may be free.
DYNAMIC = [name for name in INTEGRATORS if name != "static"]


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


# ---- the solver's side --------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_the_near_null_space_is_that_of_the_stiffness(dim):
    solid = field(dim, MPI.COMM_WORLD, b=body(dim))
    rest, b = np.zeros_like(solid._mesh.points), np.empty_like(solid.reference)
    modes = solid.near_null_space()
    assert len(modes) == {2: 3, 3: 6}[dim]
    for mode in modes:
        u = solid._exchange.with_shared(mode.reshape(-1, dim))
        values = np.empty(len(solid._pattern.indices))
        solid._elements.assemble(State(rest, 0 * u, u), 0.0, 1.0, solid._pattern, values, b)
        assert np.abs(b).max(initial=0) < 1e-12 * YOUNG
    solid.assemble(0.0, 0.1)
    assert len(solid.block.getNearNullSpace().getVecs()) == len(modes)
    assert solid.block.getBlockSize() == dim


@pytest.mark.parallel([1, 3])
def test_multigrid_counts_hardly_grow_with_the_mesh():
    counts = []
    for n in (4, 8, 16):
        bar = body(3, (2 * n, n, n), size=(2, 1, 1), supports=[{"where": "left", "fix": ["x", "y", "z"]}])
        solid = field(3, MPI.COMM_WORLD, gravity=[0, 0, -9.81], b=bar)
        solid.assemble(0.0, 10.0)  # a long step: stiffness rules
        ksp = PETSc.KSP().create(solid.comm)
        ksp.setOperators(solid.block)
        ksp.setType("cg")
        ksp.getPC().setType("gamg")
        ksp.setTolerances(rtol=1e-8)
        x, b = solid.block.createVecs()
        b.setArray(solid.rhs)
        ksp.solve(b, x)
        assert ksp.getConvergedReason() > 0
        counts.append(ksp.getIterationNumber())
        for thing in (ksp, x, b):
            thing.destroy()
    assert counts[-1] <= 1.6 * counts[0], counts
    assert counts[-1] <= 30, counts


# ---- the surface --------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_the_surface_moves_with_the_nodes(dim):
    support = [{"where": "left", "fix": ["x", "y"], "velocity": {"x": 2.0}}]
    solid = field(dim, MPI.COMM_WORLD, gravity=[1.0] * dim, b=body(dim, supports=support))
    surface = solid.surface()
    for k in range(2):
        step(solid, 0.1 * k, 0.1)
    everything = np.concatenate(solid.comm.allgather(solid.unknown()))
    moved = surface.point_map @ everything + surface.fixed_map @ solid.fixed_velocity()
    np.testing.assert_allclose(moved.reshape(-1, dim), solid.surface_velocity(), atol=1e-14)
    assert surface.fixed_map.nnz == 2 * np.prod([3, 3][: dim - 1])
    assert surface.fixed_map.nnz + surface.point_map.nnz == surface.n_points * dim
    points, shift = gathered(solid, "points"), gathered(solid, "displacement")
    on_rim = np.any((np.abs(points) < 1e-12) | (np.abs(points - [1.5, 1.0, 0.8][:dim]) < 1e-12), axis=1)
    np.testing.assert_allclose(solid.surface_positions(), (points + shift)[on_rim], atol=1e-14)
    assert all(np.array_equal(f, surface.facets) for f in solid.comm.allgather(surface.facets))
    corner = solid.surface_positions()[surface.facets]
    enclosed = np.linalg.det(corner).sum() / [2, 6][dim - 2]
    assert enclosed == pytest.approx(solid.volumes()["b"], rel=1e-12)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("interior", ["fluid", "void"])
def test_cavities_are_marked_and_empty_ones_too(dim, interior):
    hole = {"origin": [1.0] * dim, "size": [1.0] * dim}
    shell = body(dim, (3, 3, 3), size=(3, 3, 3), cavity=hole, interior=interior)
    solid = field(dim, MPI.COMM_WORLD, plain=body(dim, origin=(9, 9, 9), interior="void"), shell=shell)
    surface, x = solid.surface(), solid.surface_positions()
    middle = x[surface.facets].mean(axis=1)
    inner = np.all((middle > 0.99) & (middle < 2.01), axis=1)
    assert inner.sum() == {2: 4, 3: 12}[dim]
    np.testing.assert_array_equal(surface.cavity, inner)
    np.testing.assert_array_equal(surface.void, inner & (interior == "void"))


# ---- ranks and state ----------------------------------------------------------------------------------------


def busy(comm, dim, integrator="newmark"):
    support = [{"where": "left", "fix": ["x", "y"], "velocity": {"x": "0.2*cos(9*t)"}}]
    first = body(dim, (5, 3, 2), supports=support, damping={"stiffness": 0.01},
                 initial={"velocity": ["y", "0.5*x", 0.1][:dim]})  # fmt: skip
    second = body(dim, (2, 4, 3), origin=(0.3, 2.0, 0.1), mass="lumped", initial={"displacement": ["0.1*x"] * dim})
    return field(dim, comm, gravity=["sin(t)", -1.0, 0.2][:dim], integrator=integrator, first=first, second=second)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", DYNAMIC)
def test_ranks_agree_with_one_rank(dim, integrator):
    many, one = busy(MPI.COMM_WORLD, dim, integrator), busy(MPI.COMM_SELF, dim, integrator)
    for k in range(5):
        step(many, 0.05 * k, 0.05)
        step(one, 0.05 * k, 0.05)
    for name in ("points", "cells", "body", "displacement", "velocity"):
        np.testing.assert_allclose(gathered(many, name), gathered(one, name), rtol=0, atol=1e-12, err_msg=name)
    assert many.energies() == pytest.approx(one.energies(), rel=1e-12)
    assert many.volumes() == pytest.approx(one.volumes(), rel=1e-12)
    assert many.quality() == pytest.approx(one.quality(), rel=1e-12)
    np.testing.assert_allclose(many.surface_positions(), one.surface_positions(), atol=1e-12)
    for at in ([0.31, 0.44, 0.2], [1.5, 1.0, 0.8], [0.5, 0.5, 0.4]):
        expected = one.probe("first", at[:dim], "displacement")
        np.testing.assert_allclose(many.probe("first", at[:dim], "displacement"), expected, atol=1e-12)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", DYNAMIC)
def test_state_comes_back_bit_for_bit_on_other_ranks(dim, integrator):
    many, one = busy(MPI.COMM_WORLD, dim, integrator), busy(MPI.COMM_SELF, dim, integrator)
    for solid in (many, one):
        n = len(gathered(solid, "points"))
        own = solid._mesh.natural[: len(solid.reference)]
        solid.displacement, solid.velocity = wave(n, dim)[own], wave(n, dim, seed=6)[own]
        if solid._past:
            solid._past = tuple(wave(n, dim, seed=seed)[own] for seed in (7, 8))
            solid._past_dt = 0.04

    def store(solid):
        return {
            name: np.concatenate([s.data for s in solid.comm.allgather(slab)]) for name, slab in solid.state().items()
        }

    def reader(stored):
        def read(name, start, count):
            return stored[name][tuple(slice(s, s + c) for s, c in zip(start, count, strict=True))]

        return read

    def state_of(solid):
        return solid.displacement, solid.velocity, *solid._past, np.array(solid._past_dt if solid._past else 0)

    for source, target in ((many, one), (one, many), (many, many)):
        fresh = busy(target.comm, dim, integrator)
        fresh.restore(reader(store(source)))
        for got, expected in zip(state_of(fresh), state_of(target), strict=True):
            np.testing.assert_array_equal(got, expected)
        fresh.assemble(0.3, 0.05)
        target.assemble(0.3, 0.05)
        np.testing.assert_array_equal(fresh.rhs, target.rhs)
        np.testing.assert_array_equal(fresh.unknown(), target.unknown())
        np.testing.assert_array_equal(fresh.block.getValuesCSR()[2], target.block.getValuesCSR()[2])


@pytest.mark.parallel([1, 3])
def test_a_probe_interpolates_and_does_not_reach_far(dim):
    linear = ["1 + x - 2*y", "3*x*1 + y", "z - x"][:dim]
    comm = MPI.COMM_WORLD
    solid = field(dim, comm, b=body(dim, initial={"velocity": linear}), c=body(dim, origin=(3.2, 0.2, 0.2)))
    at = np.array([0.77, 0.31, 0.52][:dim])
    x, y, z = np.append(at, 0.0)[:3]
    np.testing.assert_allclose(solid.probe("b", at.tolist(), "velocity"), [1 + x - 2 * y, 3 * x + y, z - x][:dim])
    np.testing.assert_array_equal(solid.probe("c", [at[0] + 3.0, *at[1:]], "velocity"), 0)
    # outside: the nearest node, here the corner (1.5, 1, 0.8)
    corner = [1.6, 1.1, 0.8][:dim]
    np.testing.assert_allclose(solid.probe("b", corner, "velocity"), [0.5, 5.5, -0.7][:dim], atol=1e-13)
    with pytest.raises(InputError, match=r"probe of solids\.b at \[4, 1.* lies 2\.5 m outside it"):
        solid.probe("b", [4.0, 1.0, 0.8][:dim], "velocity")
    with pytest.raises(InputError, match="known solids are b, c"):
        solid.probe("a", at.tolist(), "velocity")
    with pytest.raises(InputError, match="'pressure' is not known"):
        solid.probe("b", at.tolist(), "pressure")


@pytest.mark.parallel([1, 3])
def test_fetch_brings_any_rows_in_the_order_asked():
    comm = MPI.COMM_WORLD
    owned = Layout.of(comm, [4, 0, 3][comm.rank % 3])
    rows = np.arange(owned.start, owned.end)
    wanted = np.random.default_rng(comm.rank).integers(0, owned.n_global, 17)
    fetch = Fetch(comm, owned, wanted)
    np.testing.assert_array_equal(fetch(np.column_stack((rows, rows**2))), np.column_stack((wanted, wanted**2)))
    assert fetch(rows.astype(np.int32)).dtype == np.int32


def test_bisection_shares_evenly_and_compactly():
    points = np.random.default_rng(0).uniform(size=(1000, 2)) * [3, 1]
    part = bisect(points, 3)
    assert np.bincount(part).tolist() == [333, 333, 334]
    assert all(np.ptp(points[part == p], axis=0).max() < 1.3 for p in range(3))
    assert np.array_equal(bisect(np.zeros((2, 2)), 4) >= 0, [True, True])


@pytest.mark.parallel([1, 3])
def test_fewer_nodes_than_ranks_still_work(tmp_path_factory):
    comm = MPI.COMM_WORLD
    path = comm.bcast(tmp_path_factory.mktemp("mesh") / "one.vtk" if comm.rank == 0 else None)
    if comm.rank == 0:
        meshio.Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), [("triangle", [[0, 1, 2]])]).write(path)
    solid = field(2, comm, gravity=[0, -1], b={**body(2), "shape": {"mesh": str(path)}})
    step(solid, 0.0, 0.1)
    np.testing.assert_allclose(solid.velocity[:, 1], -0.1, atol=1e-14)
    assert solid.volumes() == pytest.approx({"b": 0.5})
