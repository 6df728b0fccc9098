"""Lists of pairs that outlast steps: nothing near is missing, and ranks agree. About 15 s."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.distance import cdist

from petfsi.bench import particle_speed
from petfsi.bench.particles_runs import particles
from petfsi.fields.sph import moves

WORLD = MPI.COMM_WORLD


def stirred(comm, name, n):
    sim = particle_speed.scene(comm, name, n)
    particle_speed.stir(sim)
    return sim


def missing(pairs, near):
    """Return the number of near pairs (n, m) that are not listed, in either order if they are of one set."""
    listed = np.zeros(near.shape, dtype=bool)
    listed[np.repeat(np.arange(len(pairs.start) - 1), np.diff(pairs.start)), pairs.other] = True
    if near.shape[0] == near.shape[1]:
        listed |= listed.T
    return np.count_nonzero(near & ~listed)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("name, n", [("2D", 1500), ("3D", 2500)])
def test_no_pair_is_missing_while_lists_last(name, n):
    sim = stirred(WORLD, name, n)
    fluid = particles(sim)
    for _ in range(30):
        sim.advance()
        swarm, reach = fluid.swarm, fluid.room.reach
        either = swarm.owned[:, None] | swarm.owned
        near = (cdist(swarm["x"], swarm["x"]) < reach) & either & ~np.eye(len(swarm), dtype=bool)
        assert missing(fluid.pairs, near) == 0
        walls, owned = fluid.walls.met.rows.x, fluid.walls._swarm.owned
        near = (cdist(swarm["x"], walls) < reach) & (swarm.owned[:, None] | owned)
        assert missing(fluid.walls.met.pairs, near) == 0
    assert 2 < fluid.n_lists < 30
    assert np.linalg.norm(swarm["v"][swarm.owned], axis=1).max() > 0.02 * fluid.law.c or WORLD.size > 1


@pytest.mark.parallel([2, 3, 4])
def test_ranks_agree_in_the_last_bit_while_lists_last():
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        sim = stirred(comm, "2D", 1500)
        for _ in range(20):
            sim.advance()
        swarm = particles(sim).swarm
        rows = np.column_stack([swarm["id"], swarm["x"], swarm["v"], swarm["rho"]])[swarm.owned]
        rows = np.concatenate(comm.allgather(rows))
        found.append(rows[np.argsort(rows[:, 0])])
        assert particles(sim).n_lists < 40
    np.testing.assert_array_equal(*found)


def test_the_spread_of_ways_is_that_of_rows_at_most_two_cells_apart():
    """At least that of those rows, at most that of those four cells apart; nothing if all go the same way."""
    rng = np.random.default_rng(1)
    for counts in ([9, 7], [6, 7, 5]):
        dim, cells = len(counts), np.array(list(np.ndindex(*counts)))
        number = rng.integers(0, 3, len(cells))
        first = np.concatenate([[0], np.cumsum(number)])
        cell = np.repeat(cells, number, axis=0)
        anchor = rng.random((len(cell), dim))
        way = cell * 0.1 + 0.01 * rng.random((len(cell), dim)) + 5.0
        found = moves.spread(anchor + way, anchor, first, np.array(counts))
        apart = np.abs(cell[:, None] - cell).max(axis=2)
        differ = np.linalg.norm(way[:, None] - way, axis=2)
        # pairs around a cell that is not of the halo
        most = differ[apart <= 2].max()
        assert most <= found * (1 + 1e-9) <= 0.21 * np.sqrt(dim)
        assert moves.spread(anchor + 3.0, anchor, first, np.array(counts)) < 1e-12
    assert moves.spread(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(10, dtype=np.int64), np.array([3, 3])) == 0.0
