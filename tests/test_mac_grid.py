"""The distributed staggered grid: decomposition, ghosts, numbering, slabs."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.fields.mac.grid.grid import GHOST, MacGrid
from petfsi.fields.mac.grid.halo import ranks_per_axis, share_out

GRIDS = [
    ((24, 25), (False, False)),
    ((25, 24), (True, False)),
    ((26, 24), (True, True)),
    ((3, 40), (True, False)),
    ((13, 14, 18), (False, True, False)),
    ((18, 13, 12), (True, True, True)),
    ((2, 27, 12), (False, False, True)),
]


def make_grid(cells, periodic, comm=MPI.COMM_WORLD):
    dim = len(cells)
    return MacGrid(comm, [0.5, -1.0, 2.0][:dim], [1.0, 2.0, 3.0][:dim], cells, periodic)


def global_indices(grid, axis):
    """Return i, j, k of every local entry as global numbers, wrapped, and whether it lies in the domain."""
    lines, inside = [], []
    for b in range(3):
        i = np.arange(grid.shape(axis)[b]) + grid.lo[b] - grid.ghost[b]
        n = grid.cells[b]
        inside.append(np.ones(len(i), bool) if grid.periodic[b] else (i >= 0) & (i < n + (b == axis)))
        lines.append(i % n if grid.periodic[b] else i)
    i, j, k = np.meshgrid(*lines, indexing="ij")
    here = np.logical_and.reduce(np.meshgrid(*inside, indexing="ij"))
    return i, j, k, here


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("cells, periodic", GRIDS)
def test_exchange_fills_every_ghost_in_the_domain_and_no_other(cells, periodic):
    grid = make_grid(cells, periodic)
    for axis in (None, *range(grid.dim)):
        for dtype in (float, np.int64, np.uint8):
            i, j, k, here = global_indices(grid, axis)
            wanted = np.where(here, (i + 40 * (j + 40 * k)) % 251 + 1, 7).astype(dtype)
            array = np.full(grid.shape(axis), 7, dtype=dtype)
            array[grid.owned(axis)] = wanted[grid.owned(axis)]
            grid.halo.exchange(array, axis)
            assert np.array_equal(array, wanted), (axis, dtype)


@pytest.mark.parallel([1, 2, 3, 4])
def test_a_narrow_exchange_fills_the_nearest_layers_only():
    grid = make_grid((18, 13, 12), (True, True, True))
    for axis in (None, 0, 1, 2):
        i, j, k, _ = global_indices(grid, axis)
        wanted = (i + 20 * (j + 20 * k)).astype(float)
        array = np.full(grid.shape(axis), -1.0)
        array[grid.owned(axis)] = wanted[grid.owned(axis)]
        grid.halo.exchange(array, axis, width=2)
        near = tuple(slice(GHOST - 2, n - GHOST + 2) for n in array.shape)
        assert np.array_equal(array[near], wanted[near])
        assert np.all(array[: GHOST - 2] == -1.0) and np.all(array[:, :, -GHOST + 2 :] == -1.0)


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("cells, periodic", GRIDS)
def test_every_cell_and_face_has_one_owner(cells, periodic):
    grid = make_grid(cells, periodic)
    for axis in (None, *range(grid.dim)):
        i, j, k, here = global_indices(grid, axis)
        shape = [n + (b == axis and not grid.periodic[b]) for b, n in enumerate(grid.cells)]
        count = np.zeros(shape, dtype=int)
        own = grid.owned(axis)
        assert here[own].all()
        np.add.at(count, (i[own], j[own], k[own]), 1)
        assert np.all(grid.comm.allreduce(count) == 1)


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("cells, periodic", GRIDS)
def test_the_numbering_is_that_of_the_dmda(cells, periodic):
    grid = make_grid(cells, periodic)
    i, j, k, here = global_indices(grid, None)
    natural = (i + grid.cells[0] * (j + grid.cells[1] * k))[here].astype(PETSc.IntType)
    assert np.array_equal(grid.index[here], grid.dm.getAO().app2petsc(natural))
    assert np.all(grid.index[~here] == -1)
    vec = grid.to_vec(grid.index)
    assert np.array_equal(vec, np.arange(*grid.dm.createGlobalVec().getOwnershipRange()))
    back = grid.zeros_cells(int)
    grid.from_vec(vec, back)
    assert np.array_equal(back[grid.owned(None)], grid.index[grid.owned(None)])


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("cells, periodic", GRIDS)
def test_slabs_make_up_the_global_array_and_come_back(cells, periodic):
    grid = make_grid(cells, periodic)
    for axis in (None, *range(grid.dim)):
        i, j, k, here = global_indices(grid, axis)
        values = np.where(here, i + 100.0 * j + 1e4 * k, 0.0)
        slab = grid.slab(values, axis)
        whole = np.full(slab.shape, np.nan)
        for piece in grid.comm.allgather(slab):
            whole[tuple(slice(s, s + n) for s, n in zip(piece.start, piece.data.shape, strict=True))] = piece.data
        index = np.indices(slab.shape)
        assert np.array_equal(whole, sum(n * 100.0**b for b, n in enumerate(index)))

        def read(name, start, count, whole=whole):
            return whole[tuple(slice(s, s + n) for s, n in zip(start, count, strict=True))]

        again = np.zeros_like(values)
        grid.read_slab(read, "x", again, axis)
        grid.halo.exchange(again, axis)
        assert np.array_equal(again, values)


@pytest.mark.parallel([1, 3])
def test_coordinates_and_measures():
    grid = make_grid((20, 30), (False, False))
    assert grid.cell_volume == pytest.approx(0.05 * 2 / 30)
    assert [grid.face_area(a) for a in (0, 1)] == pytest.approx([2 / 30, 0.05])
    first = grid.lo[1] - GHOST
    assert grid.cell_centres(1)[0] == pytest.approx(-1.0 + (first + 0.5) * 2 / 30)
    assert grid.face_coords(1)[0] == pytest.approx(-1.0 + first * 2 / 30)
    assert len(grid.face_coords(1)) == len(grid.cell_centres(1)) + 1
    assert grid.shape(0) == (grid.hi[0] - grid.lo[0] + 11, grid.hi[1] - grid.lo[1] + 10, 1)
    assert np.array_equal(grid.cell_centres(2), [0.0])


@pytest.mark.parallel([1, 3])
def test_beyond_the_sides_stands_the_nearest_value():
    grid = make_grid((20, 30), (False, True))
    for axis in (None, 0, 1):
        i, j, _, here = global_indices(grid, axis)
        array = i + 100.0 * j
        wanted = np.clip(i, 0, grid.cells[0] - (axis != 0)) + 100.0 * j
        array[~here] = np.nan
        grid.fill_sides(array, axis)
        assert np.array_equal(array, wanted)


def test_ranks_are_shared_out_with_the_least_border():
    assert share_out((64, 64, 64), 4, 6) == (1, 2, 2)
    assert share_out((64, 64, 64), 3, 6) == (1, 1, 3)
    assert share_out((100, 10), 2, 6) == (2, 1)
    assert share_out((11, 11), 2, 6) is None
    assert share_out((12, 11), 2, 6) == (2, 1)


def test_too_many_ranks_are_refused_with_a_number_that_works():
    with pytest.raises(InputError, match=r"fluid\.cells = \[13, 20\]: 7 ranks .* at least 6 cells .* works is 6"):
        ranks_per_axis((13, 20), 7, 6)


@pytest.mark.parallel(2)
def test_too_many_ranks_are_refused_on_every_rank():
    with pytest.raises(InputError, match="works is 1"):
        make_grid((11, 10), (False, False))
