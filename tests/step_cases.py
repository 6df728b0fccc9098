"""What the tests of whole steps share: small scenes in this process, each with its own PETSc options."""

from contextlib import contextmanager

import numpy as np
from mpi4py import MPI

from petfsi.bench.case import only_options
from petfsi.scene.load import load_scene
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

#: How a block is thrown.
SWING = {"velocity": ["0.5*x", "1.5*x"]}
LEFT = [{"where": "left", "fix": ["x", "y"]}]


def block(cells=(1, 1), size=(1.0, 1.0), time=None, gravity=None, output=None, **solid):
    """Return a scene of one block, clamped at its left side."""
    body = {
        "shape": {"box": {"origin": [0.0, 0.0], "size": list(size), "cells": list(cells)}},
        "density": 1.3, "young": 20.0, "poisson": 0.3, "material": "neohookean", "supports": LEFT,
    }  # fmt: skip
    return Scene.model_validate(
        {
            "dim": 2,
            "time": {"end": 1.0, "dt": 0.1, "integrator": "newmark"} | (time or {}),
            "gravity": gravity,
            "output": output or {},
            "solids": {"block": body | solid},
        }
    )


@contextmanager
def prepared(scene, *options, comm=MPI.COMM_WORLD):
    with only_options(list(options)):
        sim = Simulation(comm, scene)
        sim.prepare()
        yield sim
        # an error that is looked at keeps the simulation, and ranks would let go of it at different times
        sim.solver.reset()


def stepped(scene, n, *options, comm=MPI.COMM_WORLD):
    """Return a simulation after n steps."""
    with prepared(scene, *options, comm=comm) as sim:
        for _ in range(n):
            sim.advance()
    return sim


def loaded(path, *sets):
    return load_scene(path, list(sets))


def motion(sim):
    """Return displacements and velocities of all nodes in natural order, the same on every rank."""
    parts = sim.comm.allgather([sim.solid.state()[name].data for name in ("displacement", "velocity")])
    return np.concatenate([np.concatenate([part[n] for part in parts]) for n in range(2)])


def stored(sim):
    """Return the whole state by group and name, the same on every rank."""
    return {
        group: {name: _joined(sim.comm.allgather((slab.start, slab.data)), slab.shape) for name, slab in slabs.items()}
        for group, slabs in sim.state().items()
    }


def _joined(pieces, shape):
    whole = np.full(shape, np.nan)
    for start, data in pieces:
        whole[tuple(slice(a, a + n) for a, n in zip(start, data.shape, strict=True))] = data
    return whole
