"""Particles on ranks: nothing is lost, ghosts and order are as they should be on any ranks, into files and back."""

from itertools import product

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.sph import transport
from petfsi.fields.sph.balance import bisect, is_better, is_uneven
from petfsi.fields.sph.cells import CellGrid
from petfsi.fields.sph.particles import StrayError, Swarm

COMM = MPI.COMM_WORLD
RANKS = [1, 2, 3, 4]
#: Counts of cells and which axes are periodic: none, one, all; axes with one cell and with two.
GRIDS = [
    ((7, 5), (False, False)),
    ((6, 9), (False, True)),
    ((5, 4), (True, True)),
    ((1, 8), (True, False)),
    ((2, 1), (True, True)),
    ((4, 3, 5), (False, False, False)),
    ((3, 1, 2), (True, True, True)),
    ((6, 2, 3), (False, True, False)),
]


def grid_of(counts, periodic=None):
    dim = len(counts)
    side = np.array([0.3, 0.37, 0.41])[:dim]
    periodic = np.array(periodic if periodic is not None else (False,) * dim)
    return CellGrid(np.array([-1.0, 0.2, 0.1])[:dim], side, np.array(counts), periodic)


def ends(grid):
    return grid.low, grid.low + grid.counts * grid.side


def payload(ids, width):
    return np.sin(np.outer(ids + 1, np.arange(1, width + 1)))


def swarm_of(comm, grid, n, seed=0, stride=1):
    """Return a set of n particles anywhere, dealt out to the ranks like cards; ids go up in strides."""
    low, high = ends(grid)
    dim = len(low)
    swarm = Swarm(comm, grid, {"v": (dim, float), "rho": ((), float), "tag": ((), np.int64)})
    x = low + (high - low) * np.random.default_rng(seed).random((n, dim)) * (1 - 1e-12)
    mine = np.arange(n)[comm.rank :: comm.size]
    ids = stride * mine
    swarm.insert({"id": ids, "x": x[mine], "v": payload(ids, dim), "rho": payload(ids, 1), "tag": 7 * ids})
    return swarm


def everyone(swarm):
    """Return the owned of all ranks, by id: a dict of columns."""
    parts = swarm.comm.allgather({name: swarm[name][swarm.owned] for name in swarm})
    columns = {name: np.concatenate([part[name] for part in parts]) for name in swarm}
    order = np.argsort(columns["id"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def check(swarm, n, stride=1):
    """Assert that a rebuilt set is what the definition says, ghosts and order and all, and that nothing was lost."""
    grid, rank = swarm.grid, swarm.comm.rank
    every = everyone(swarm)
    dim = len(grid.counts)
    assert np.array_equal(every["id"], stride * np.arange(n))
    assert np.array_equal(every["v"], payload(every["id"], dim))
    assert np.array_equal(every["rho"], payload(every["id"], 1).ravel())
    assert np.array_equal(every["tag"], 7 * every["id"])

    low, high = swarm.boxes.low[rank], swarm.boxes.high[rank]
    own_cells = grid.of(every["x"])
    assert np.all((own_cells >= 0) & (own_cells < grid.counts))
    filled = np.all(high > low)
    found = []
    for shift in product(*((-1, 0, 1) if p else (0,) for p in grid.periodic)):
        cells = own_cells + np.array(shift) * grid.counts
        x = every["x"] + np.array(shift) * (grid.counts * grid.side)
        owned = np.all((cells >= low) & (cells < high), axis=1)
        near = np.all((cells >= low - 1) & (cells <= high), axis=1) & filled
        found += [(tuple(cells[k]), every["id"][k], tuple(x[k]), owned[k]) for k in np.flatnonzero(near)]
    found.sort(key=lambda one: one[:2])
    assert swarm["id"].tolist() == [one[1] for one in found]
    assert swarm["x"].tolist() == [list(one[2]) for one in found]
    assert swarm.owned.tolist() == [one[3] for one in found]
    assert np.array_equal(swarm["v"], payload(swarm["id"], dim))
    assert np.array_equal(swarm["tag"], 7 * swarm["id"])
    assert (len(swarm), swarm.n_owned) == (len(found), int(swarm.owned.sum()))

    assert np.array_equal(swarm.counts, high - low + 2)
    assert np.array_equal(swarm.corner, low - 1)
    local = np.array([one[0] for one in found]).reshape(-1, dim) - swarm.corner
    numbers = np.ravel_multi_index(tuple(local.T), tuple(swarm.counts)) if len(found) else np.zeros(0, int)
    assert np.array_equal(swarm.first, np.searchsorted(numbers, np.arange(np.prod(swarm.counts) + 1)))
    for name in swarm:
        assert swarm[name].flags.c_contiguous


def walk(swarm, rng, step=0.5):
    """Move the owned at random; reflect them at sides that are not periodic."""
    low, high = ends(swarm.grid)
    x = swarm["x"]
    x += swarm.grid.side * step * rng.normal(size=x.shape)
    for a in np.flatnonzero(~swarm.grid.periodic):
        x[:, a] = np.clip(x[:, a], low[a], high[a] - 1e-9)


# ---- order, migration, ghosts -------------------------------------------------------------------------------------


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("counts, periodic", GRIDS)
def test_random_walks_lose_nothing(counts, periodic):
    grid, n, rng = grid_of(counts, periodic), 150, np.random.default_rng(COMM.rank)
    swarm = swarm_of(COMM, grid, n)
    swarm.rebuild()
    check(swarm, n)
    for k in range(6):
        walk(swarm, rng, step=3.0 if k == 3 else 0.5)
        swarm.rebuild(swarm.balanced())
        check(swarm, n)


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("counts, periodic", GRIDS)
def test_cells_hold_the_same_rows_on_any_ranks(counts, periodic):
    grid = grid_of(counts, periodic)
    alone = swarm_of(MPI.COMM_SELF, grid, 200)
    alone.rebuild()
    swarm = swarm_of(COMM, grid, 200)
    swarm.rebuild(bisect(COMM, grid, grid.of(swarm["x"])))
    for c, local in enumerate(product(*(range(n) for n in swarm.counts))):
        rows = slice(*swarm.first[c : c + 2])
        whole = np.ravel_multi_index(np.array(local) + swarm.corner - alone.corner, alone.counts)
        same = slice(*alone.first[whole : whole + 2])
        if np.all(swarm.counts > 2):  # an empty box has no ghosts
            assert all(np.array_equal(swarm[name][rows], alone[name][same]) for name in swarm)


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("counts, periodic", GRIDS)
def test_exchange_brings_the_owners_values(counts, periodic):
    grid, n = grid_of(counts, periodic), 120
    swarm = swarm_of(COMM, grid, n)
    swarm.rebuild()
    for _ in range(2):
        before, images = everyone(swarm), swarm["x"].copy()
        new = 1e-3 * np.random.default_rng(5).normal(size=(n, len(counts)))
        ids, mine = swarm["id"], swarm.owned
        swarm["x"][mine] += new[ids[mine]]
        swarm["v"][mine] *= -3.0
        swarm["tag"][mine] -= 2**60
        old_rho = swarm["rho"].copy()
        swarm["rho"][mine] = 5.0
        swarm.exchange("v", "tag", "x")
        periods = np.round((images - before["x"][ids]) / (grid.counts * grid.side))
        assert np.array_equal(swarm["x"], (before["x"] + new)[ids] + periods * (grid.counts * grid.side))
        assert np.array_equal(swarm["v"], -3.0 * before["v"][ids])
        assert np.array_equal(swarm["tag"], before["tag"][ids] - 2**60)
        assert np.array_equal(swarm["rho"], np.where(mine, 5.0, old_rho))
        swarm.exchange("rho")
        assert np.all(swarm["rho"] == 5.0)


@pytest.mark.parallel([1])
def test_exchange_without_neighbours_does_nothing(monkeypatch):
    swarm = swarm_of(COMM, grid_of((3, 3)), 20)
    swarm.rebuild()
    monkeypatch.setattr(transport, "swap", None)
    swarm.exchange("v", "x")


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("counts, periodic", [GRIDS[0], GRIDS[6], ((1, 1), (False, False)), ((1, 1), (True, True))])
def test_ranks_without_particles(counts, periodic):
    for n in (0, 1, 3):
        swarm = swarm_of(COMM, grid_of(counts, periodic), n)
        for _ in range(2):
            swarm.rebuild(swarm.balanced())
            check(swarm, n)
            swarm.exchange("x", "v")
            check(swarm, n)
            walk(swarm, np.random.default_rng(1))
        assert swarm.slabs()["x"].shape == (n, len(counts))


@pytest.mark.parallel(RANKS)
def test_walls_share_the_boxes_of_the_fluid():
    grid = grid_of((8, 5))
    fluid, walls = swarm_of(COMM, grid, 300), None
    fluid.rebuild(fluid.balanced())
    walls = Swarm(COMM, grid, {"n": (2, float)}, fluid.boxes)
    ids = np.arange(50)[COMM.rank :: COMM.size]
    walls.insert(
        {"id": ids, "x": grid.low + grid.side * np.column_stack([8 * (ids + 0.5) / 50, np.full(len(ids), 4.5)])}
    )
    walls.rebuild()
    assert walls.boxes is fluid.boxes
    assert np.array_equal(walls.counts, fluid.counts) and len(walls.first) == len(fluid.first)
    assert np.array_equal(everyone(walls)["id"], np.arange(50))


@pytest.mark.parallel(RANKS)
def test_particles_come_and_go():
    grid = grid_of((5, 6), (True, False))
    swarm = swarm_of(COMM, grid, 100)
    swarm.rebuild()
    swarm.remove(swarm["id"] >= 60)
    assert not swarm.is_sorted and swarm.owned.all()
    swarm.rebuild()
    check(swarm, 60)
    ids = np.arange(60, 80)[COMM.rank :: COMM.size]
    x = grid.low + grid.side * np.column_stack([(ids - 60) / 4.0, np.full(len(ids), 2.5)])
    swarm.insert({"id": ids, "x": x, "v": payload(ids, 2), "rho": payload(ids, 1)})
    assert np.all(swarm["tag"][-len(ids) :] == 0) or not len(ids)
    swarm["tag"] = 7 * swarm["id"]
    swarm.rebuild()
    check(swarm, 80)


@pytest.mark.parallel(RANKS)
def test_a_place_on_the_end_of_a_period_is_its_beginning():
    grid = CellGrid(np.array([0.1, 0.0]), np.array([0.1, 1.0]), np.array([3, 2]), np.array([True, False]))
    low, period = 0.1, 3 * 0.1
    places = [low, low - 1e-20, np.nextafter(low, 0), low + period, np.nextafter(low + period, 0), low - period]
    places += [np.nextafter(low + period, 1), low + 5 * period, low - 7.3 * period, low + 0.1, low + 0.2]
    ids = np.arange(len(places))[COMM.rank :: COMM.size]
    swarm = Swarm(COMM, grid, {})
    swarm.insert({"id": ids, "x": np.column_stack([np.array(places)[ids], np.full(len(ids), 0.5)])})
    swarm.rebuild()
    every = everyone(swarm)
    assert np.array_equal(every["id"], np.arange(len(places)))
    moved = (every["x"][:, 0] - places) / period
    assert np.allclose(moved, np.round(moved), atol=1e-14)
    assert np.all((grid.of(every["x"]) >= 0) & (grid.of(every["x"]) < grid.counts))


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("where", [(-1.5, 0.5), (0.0, 99.0), (np.nan, 0.5), (0.0, np.inf), (1e300, 0.5)])
def test_a_particle_outside_the_grid_is_named_on_all_ranks(where):
    grid = grid_of((6, 4), (False, True) if where[1] == 0.5 else (False, False))
    swarm = swarm_of(COMM, grid, 60)
    swarm.rebuild()
    good = {name: column.copy() for name, column in everyone(swarm).items()}
    for strays in ([17], [41, 23]):
        swarm["x"][np.isin(swarm["id"], strays) & swarm.owned] = where
        with pytest.raises(StrayError, match=rf"particle {min(strays)} at .*outside") as caught:
            swarm.rebuild(swarm.balanced())
        error = caught.value
        assert isinstance(error, SolveError)
        assert (error.id, error.n_strays) == (min(strays), len(strays))
        assert np.array_equal(error.place, where, equal_nan=True)
        assert ("1 more" in str(error)) == (len(strays) > 1)
        mine = swarm.owned
        swarm["x"][mine] = good["x"][swarm["id"][mine]]
        swarm.rebuild()
        check(swarm, 60)


@pytest.mark.parallel([1])
def test_columns_are_checked():
    with pytest.raises(ValueError, match="id"):
        Swarm(COMM, grid_of((2, 2)), {"x": (3, float)})
    with pytest.raises(ValueError, match="8 bytes"):
        Swarm(COMM, grid_of((2, 2)), {"flag": ((), bool)})


# ---- balance ------------------------------------------------------------------------------------------------------


@pytest.mark.parallel([2, 3, 4])
def test_a_cluster_that_moves_is_shared_out_again():
    grid, n = grid_of((60, 50)), 3000
    swarm = swarm_of(COMM, grid, n)
    low, high = ends(grid)
    swarm["x"] = low + 0.2 * (swarm["x"] - low)
    made = 0
    for _ in range(30):
        boxes = swarm.balanced()
        made += boxes is not swarm.boxes
        swarm.rebuild(boxes)
        counts = np.array(COMM.allgather(swarm.n_owned))
        assert counts.max() <= 1.35 * counts.mean()
        swarm["x"] += 0.01 * (high - low)
    swarm.rebuild()
    check(swarm, n)
    assert 1 < made < 25


@pytest.mark.parallel([2, 3, 4])
def test_boxes_that_cannot_be_better_stay():
    grid = grid_of((9, 9))
    swarm = swarm_of(COMM, grid, 100)
    swarm["x"] = grid.low + grid.side * 4.5
    swarm.rebuild(bisect(COMM, grid, grid.of(swarm["x"])))
    assert swarm.balanced() is swarm.boxes
    check(swarm, 100)


class Ranks:
    """Stands for a communicator of so many ranks, of which this one has all particles."""

    def __init__(self, size):
        self.size, self.rank = size, 0

    def Allreduce(self, mine, total):  # noqa: N802
        total[...] = mine


@pytest.mark.parallel([1])
@pytest.mark.parametrize("size", [1, 2, 3, 5, 7, 8, 13, 64])
@pytest.mark.parametrize("counts", [(40, 30), (3, 2), (12, 9, 10), (1, 1)])
@pytest.mark.parametrize("n", [0, 5000])
def test_boxes_fill_the_grid(size, counts, n):
    grid = grid_of(counts, (True,) + (False,) * (len(counts) - 1))
    low, high = ends(grid)
    x = low + (high - low) * np.random.default_rng(2).random((n, len(counts))) ** 1.5 * (1 - 1e-12)
    boxes = bisect(Ranks(size), grid, grid.of(x))
    every = np.array(list(product(*(range(c) for c in counts))))
    owner = boxes.owner(every)
    volumes = np.prod(boxes.high - boxes.low, axis=1)
    assert np.all(boxes.high >= boxes.low)
    assert np.array_equal(np.bincount(owner, minlength=size), volumes) and volumes.sum() == len(every)
    assert np.all((every >= boxes.low[owner]) & (every < boxes.high[owner]))
    for outside in (-1, counts[-1]):
        cells = every.copy()
        cells[:, -1] = outside
        assert np.all(boxes.owner(cells) == -1)
    loads = np.bincount(boxes.owner(grid.of(x)), minlength=size)
    assert np.array_equal(loads, boxes.loads)
    if len(every) > 50 * size and n:
        assert loads.max() < 1.3 * loads.mean()
    if not n and len(every) > 50 * size:
        assert volumes.max() < 1.6 * volumes.mean()


@pytest.mark.parallel([1])
@pytest.mark.parametrize("size", [1, 3, 8, 13])
@pytest.mark.parametrize("counts, periodic", GRIDS)
def test_links_match(size, counts, periodic):
    grid = grid_of(counts, periodic)
    boxes = bisect(Ranks(size), grid, np.zeros((0, len(counts)), dtype=np.int64))
    links = [boxes.links(rank, grid.counts, grid.periodic) for rank in range(size)]
    for p, q in product(range(size), repeat=2):
        sent = [(tuple(k.shift), tuple(k.low), tuple(k.high)) for k in links[p][0] if k.rank == q]
        taken = [(tuple(k.shift), tuple(k.low), tuple(k.high)) for k in links[q][1] if k.rank == p]
        assert sent == taken


@pytest.mark.parallel([1])
def test_when_boxes_are_made_anew():
    assert not is_uneven(np.array([110, 90])) and is_uneven(np.array([112, 88]))
    assert not is_uneven(np.array([0, 0, 0])) and is_uneven(np.array([1, 0]))
    grid = grid_of((2, 1))
    boxes = bisect(Ranks(2), grid, np.array([[0, 0]] * 70 + [[1, 0]] * 30))
    assert boxes.loads.tolist() == [70, 30]
    assert not is_better(boxes, np.array([70, 30])) and is_better(boxes, np.array([100, 0]))


# ---- into a file and back -----------------------------------------------------------------------------------------


def stored(swarm, names=None):
    """Return what ``slabs`` of all ranks make up: a dict of whole arrays."""
    whole = {}
    for name, slab in swarm.slabs(names).items():
        pieces = swarm.comm.allgather((slab.start, slab.data))
        whole[name] = np.full(slab.shape, -99, slab.data.dtype)
        for start, data in pieces:
            assert data.ndim == len(slab.shape)
            rows = slice(start[0], start[0] + len(data))
            assert np.all(whole[name][rows] == -99)
            whole[name][rows] = data
        assert sum(len(data) for _, data in pieces) == slab.shape[0]
    return whole


def reader(whole):
    def read(name, start, count):
        piece = whole[name][tuple(slice(s, s + c) for s, c in zip(start, count, strict=True))]
        assert piece.shape == tuple(count)
        return piece.copy()

    return read


@pytest.mark.parallel(RANKS)
@pytest.mark.parametrize("n, stride", [(130, 1), (130, 5), (2, 1), (0, 1)])
@pytest.mark.parametrize("counts, periodic", [GRIDS[0], GRIDS[6]])
def test_files_do_not_depend_on_ranks(n, stride, counts, periodic):
    grid = grid_of(counts, periodic)
    alone, swarm = swarm_of(MPI.COMM_SELF, grid, n, stride=stride), swarm_of(COMM, grid, n, stride=stride)
    alone.rebuild()
    swarm.rebuild()
    whole, other = stored(alone), stored(swarm)
    assert whole["count"] == [n]
    assert list(whole) == list(other) == ["count", "id", "x", "v", "rho", "tag"]
    assert all(np.array_equal(whole[name], other[name]) for name in whole)
    assert all(whole[name].dtype == other[name].dtype for name in whole)

    swarm = Swarm(COMM, grid, {"v": (len(counts), float), "rho": ((), float), "tag": ((), np.int64)})
    swarm.restore(reader(whole))
    check(swarm, n, stride)
    alone.restore(reader(other))
    check(alone, n, stride)


@pytest.mark.parallel([1, 3])
def test_some_columns_are_stored_and_the_others_come_back_as_zeros():
    swarm = swarm_of(COMM, grid_of((5, 5)), 40)
    whole = stored(swarm, ["v", "tag"])
    assert list(whole) == ["count", "id", "x", "v", "tag"]
    before = everyone(swarm)
    swarm.restore(reader(whole), ["v", "tag"])
    after = everyone(swarm)
    assert all(np.array_equal(after[name], before[name]) for name in ("id", "x", "v", "tag"))
    assert len(after["rho"]) == 40 and not after["rho"].any()
