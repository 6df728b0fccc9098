"""Solvers that Python's collector finds on each rank at a time of its own."""

import gc
from weakref import ref

import pytest
from mpi4py import MPI
from step_cases import block

from petfsi import releases
from petfsi.bench.case import job, only_options
from petfsi.simulation import Simulation

COMM = MPI.COMM_WORLD


class Owner:
    pass


def test_what_was_collected_is_released_where_ranks_meet_in_the_order_of_making():
    held, seen, owners = releases.Releases(), [], [Owner() for _ in range(3)]
    nows = [held.add(owner, lambda n=n: seen.append(n)) for n, owner in enumerate(owners)]
    nows[1]()
    assert seen == [1]
    owners.clear()
    gc.collect()
    assert seen == [1]
    held.sweep(MPI.COMM_SELF)
    assert seen == [1, 0, 2]
    last = Owner()
    held.add(last, lambda: seen.append(3))
    held.end()
    assert seen == [1, 0, 2, 3]


@pytest.mark.parallel([2, 3])
def test_a_rank_that_collects_a_solver_before_the_others_waits_for_nobody():
    held = releases.of(COMM)
    held.sweep(COMM)
    gc.disable()
    try:
        with only_options(["-options_file", "monolithic.opts"]):
            sim = Simulation(COMM, block((4, 4)))
            sim.prepare()
            sim.advance()
            sim.me = sim  # nothing but the collector lets go of it
            before = len(held._held)
            del sim
            if COMM.rank == 0:
                gc.collect()
            COMM.Barrier()  # a solver destroyed above would wait for the others, who wait here
            held.sweep(COMM)
            assert len(held._held) == before  # others hold it still
            gc.collect()
            held.sweep(COMM)
            assert len(held._held) < before
    finally:
        gc.enable()


@pytest.mark.parametrize("newton", [[], ["-fsi_snes_type", "newtonls"]], ids=["once", "newton"])
def test_a_coupled_simulation_is_let_go_with_all_that_petsc_holds_of_it(newton):
    held = releases.of(MPI.COMM_SELF)
    gc.collect()
    held.sweep(MPI.COMM_SELF)
    before = len(held._held)
    with only_options(["-options_file", "monolithic.opts", *newton]):
        sim = Simulation(MPI.COMM_SELF, job(MPI.COMM_SELF, "column", {"fluid.cells": [8, 16]}))
        sim.prepare()
        sim.advance()
        seen = [ref(sim), ref(sim.solver)]
        assert len(held._held) > before
        del sim
        gc.collect()
        held.sweep(MPI.COMM_SELF)
    assert [thing() for thing in seen] == [None, None] and len(held._held) == before


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("scene", ["column", "neohookean"])
def test_a_simulation_that_is_closed_leaves_petsc_nothing(scene):
    held = releases.of(COMM)
    gc.collect()
    held.sweep(COMM)
    before = len(held._held)
    with only_options(["-options_file", "monolithic.opts"]):
        sim = Simulation(COMM, job(COMM, scene, {"time.integrator": "newmark"}))
        sim.prepare()
        sim.advance()
        block = sim.solid.block
        assert block.handle and sim.system.operator.handle
        sim.close()
    assert not block.handle and not sim.system.operator.handle and len(held._held) == before
