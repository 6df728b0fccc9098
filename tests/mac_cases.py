"""What the tests of the fluid share: scenes, a solver, whole arrays."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.fields.mac.fluid import MacFluid
from petfsi.scene.schema import Scene

PERIODIC = {"left": "periodic", "right": "periodic", "bottom": "periodic", "top": "periodic"}
BOX = {"shape": {"box": {"origin": [0.35, 0.3], "size": [0.3, 0.3]}}}


def make_scene(cells, gravity=None, obstacles=None, integrator="newmark", **fluid):
    dim = len(cells)
    fluid = {"origin": [0.0] * dim, "size": [1.0] * dim, "density": 1000.0, "cells": list(cells)} | fluid
    time = {"end": 1.0, "dt": 0.1, "integrator": integrator}
    scene = {"dim": dim, "time": time, "fluid": fluid, "obstacles": obstacles or {}}
    scene["coupling"] = {"transfer": "ray"}  # obstacles of whole cells
    if gravity is not None:
        scene["gravity"] = gravity
    return Scene.model_validate(scene)


def make_fluid(cells, comm=MPI.COMM_WORLD, **scene):
    return MacFluid(comm, make_scene(cells, **scene))


def solve(fluid):
    """Return the pressure that solves the fluid's own system, closed regions without mean."""
    block, layout = fluid.block, fluid.layout
    b, x = block.createVecRight(), block.createVecRight()
    rhs = fluid.rhs * fluid.row_scale
    regions = [vec for vec, _ in fluid.closed_regions(None)]
    basis = []
    for vec in regions:
        unit = PETSc.Vec().createWithArray(vec.copy(), size=layout.sizes, comm=fluid.comm)
        unit.normalize()
        basis.append(unit)
    scaled = block.copy()
    scaled.scale(fluid.row_scale * fluid.col_scale)
    ksp = PETSc.KSP().create(fluid.comm)
    ksp.setOperators(scaled)
    b.array[:] = rhs
    if basis:
        space = PETSc.NullSpace().create(vectors=basis, comm=fluid.comm)
        scaled.setNullSpace(space)
        space.remove(b)
        ksp.setType("cg")
        ksp.getPC().setType("hypre")
        ksp.setTolerances(rtol=1e-14, atol=1e-14, max_it=100)
    else:
        # on every rank the whole matrix: ranks that share two cores factor it together at a crawl
        ksp.setType("preonly")
        options = PETSc.Options("cases_")
        options["pc_type"], options["redundant_pc_type"] = "redundant", "cholesky"
        options["redundant_pc_factor_mat_solver_type"] = "mumps"
        ksp.setOptionsPrefix("cases_")
        ksp.setFromOptions()
    ksp.solve(b, x)
    return x.array * fluid.col_scale


def step(fluid, time, dt):
    fluid.predict(time, dt)
    fluid.assemble(time, dt)
    fluid.accept(solve(fluid), time, dt)


def crossings(fluid):
    """Return how many cells the flow crosses in a second, the most along any axis."""
    fastest = fluid.velocity if fluid.sheets is None else fluid.sheets.fastest(fluid.velocity)
    most = max(np.abs(v).max() / h for v, h in zip(fastest, fluid.grid.dx, strict=True))
    return fluid.comm.allreduce(float(most), op=MPI.MAX)


def kinetic_energy(fluid):
    return fluid.comm.allreduce(fluid.stock().kinetic)


def whole(comm, slab):
    """Return a global array from its pieces, on every rank."""
    pieces = comm.allgather(slab)
    array = np.zeros(slab.shape, dtype=slab.data.dtype)
    for piece in pieces:
        array[tuple(slice(s, s + n) for s, n in zip(piece.start, piece.data.shape, strict=True))] = piece.data
    return array


def whole_state(fluid):
    return {name: whole(fluid.comm, slab) for name, slab in fluid.state().items()}


def reader(arrays):
    def read(name, start, count):
        return arrays[name][tuple(slice(s, s + n) for s, n in zip(start, count, strict=True))]

    return read


def set_velocity(fluid, functions):
    """Set the velocity everywhere, ghosts included, from functions of x, y, z."""
    for axis, function in enumerate(functions):
        fluid.velocity[axis][...] = function(*fluid.grid.coordinates(axis))


def solid_box(fluid, low, high):
    """Return a cell mask that marks a box as SOLID, ghosts included."""
    x = fluid.grid.coordinates(None)[: fluid.dim]
    covered = np.ones(fluid.grid.shape(None), dtype=bool)
    for line, a, b in zip(x, low, high, strict=True):
        covered &= (line > a) & (line < b)
    return covered.astype(np.uint8)


def max_divergence(fluid):
    """Return the largest net outflow of a solved cell over the area of a (cubic) cell's face, m/s. Collective."""
    grid = fluid.grid
    part = grid.owned(None)
    total = np.zeros(grid.owned_shape)
    for axis in range(fluid.dim):
        above = tuple(slice(s.start + (b == axis), s.stop + (b == axis)) for b, s in enumerate(part))
        total += grid.face_area(axis) * (fluid.velocity[axis][above] - fluid.velocity[axis][part])
    most = np.abs(total[fluid.cell_kind[part] == 0]).max(initial=0.0)
    return grid.comm.allreduce(most, MPI.MAX) / grid.cell_volume ** ((fluid.dim - 1) / fluid.dim)
