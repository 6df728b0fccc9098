"""What the tests of solids share: bodies, a direct step, and a slow statement of the finite elements."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.fields.solid import SimplexSolid
from petfsi.fields.solid.elements import Bodies, Elements, State
from petfsi.fields.solid.materials import lame_parameters, named
from petfsi.fields.solid.partition import distribute
from petfsi.fields.solid.patches import grid_patches, grouped_mesh
from petfsi.fields.solid.pattern import Pattern
from petfsi.geometry.meshes import SimplexMesh, box_mesh
from petfsi.geometry.quadratic import with_middles
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Box

DENSITY, YOUNG, POISSON = 1.3, 20.0, 0.3
LAME, MU = lame_parameters(YOUNG, POISSON)


def body(dim, cells=(3, 2, 2), origin=(0.0, 0.0, 0.0), size=(1.5, 1.0, 0.8), cavity=None, **more):
    shape = {"box": {"origin": list(origin[:dim]), "size": list(size[:dim]), "cells": list(cells[:dim])}}
    if cavity:
        shape["cavity"] = cavity
    return {"shape": shape, "density": DENSITY, "young": YOUNG, "poisson": POISSON, **more}


def field(dim, comm=MPI.COMM_SELF, gravity=None, integrator="newmark", **solids):
    time = {"end": 1.0, "dt": 0.1, "integrator": integrator}
    scene = {"dim": dim, "gravity": gravity, "time": time, "solids": solids}
    return SimplexSolid(comm, Scene.model_validate(scene))


def step(solid, time, dt):
    """Advance by a direct solve."""
    solid.predict(time, dt)
    solid.assemble(time, dt)
    ksp = PETSc.KSP().create(solid.comm)
    ksp.setOperators(solid.block)
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    ksp.getPC().setFactorSolverType("mumps")
    x, b = solid.block.createVecs()
    b.setArray(solid.rhs)
    ksp.solve(b, x)
    solid.accept(x.getArray().copy(), time, dt)
    for thing in (ksp, x, b):
        thing.destroy()


def gathered(solid, name):
    """Return a quantity in natural order, whole, on every rank."""
    slabs = solid.comm.allgather(solid.output()[name])
    assert [s.start[0] for s in slabs] == np.cumsum([0] + [len(s.data) for s in slabs[:-1]]).tolist()
    whole = np.concatenate([s.data for s in slabs])
    assert whole.shape == slabs[0].shape
    return whole


def dense(mat):
    copy = mat.convert("dense", PETSc.Mat())
    values = copy.getDenseArray().copy()
    copy.destroy()
    return values


def wave(n, dim, seed=3, size=0.05):
    return size * np.random.default_rng(seed).standard_normal((n, dim))


# ---- an independent, slow statement of the finite elements --------------------------------------------------


class Slow:
    """M, K(d) and, by complex steps, K'(d), in the mesh's own order; also takes complex d."""

    def __init__(self, points, cells, lumped=False):
        self.points, self.cells, self.dim = points, cells, points.shape[1]
        n, corners = points.shape[0], self.dim + 1
        self.M = np.zeros((n, n))
        self.elements = []
        for cell in cells:
            X = np.column_stack((np.ones(corners), points[cell]))
            V = np.linalg.det(X) / [2, 6][self.dim - 2]
            self.elements.append((V, np.linalg.inv(X)[1:].T))
            weights = np.eye(corners) / corners if lumped else (1 + np.eye(corners)) / (corners * (corners + 1))
            self.M[np.ix_(cell, cell)] += DENSITY * V * weights
        self.M = np.kron(self.M, np.eye(self.dim))

    def force(self, d):
        f = np.zeros_like(d)
        for (V, g), cell in zip(self.elements, self.cells, strict=True):
            F = np.eye(self.dim) + d[cell].T @ g
            E = (F.T @ F - np.eye(self.dim)) / 2
            S = LAME * np.trace(E) * np.eye(self.dim) + 2 * MU * E
            f[cell] += V * g @ (F @ S).T
        return f

    def tangent(self, d):
        columns = []
        for j in range(d.size):
            e = np.zeros(d.size, dtype=complex)
            e[j] = 1e-30j
            columns.append(self.force(d + e.reshape(d.shape)).imag.ravel() / 1e-30)
        return np.array(columns).T


def bent_mesh(dim, n=3):
    """Return a box mesh whose inner points are moved about."""
    points, cells = box_mesh(Box(origin=[0] * dim, size=[1] * dim, cells=[n] * dim))
    inner = np.all((points > 1e-9) & (points < 1 - 1e-9), axis=1)
    points = points + inner[:, None] * wave(len(points), dim, seed=5, size=0.2 / n**1.5)
    return points, cells.astype(np.int32), inner


def whole_mesh(mesh):
    """Return a mesh of one body as the piece of the only rank."""
    return distribute(MPI.COMM_SELF, mesh)[0]


def simplices(points, cells, order="linear", volumetric="full", patches=None):
    """Return the mesh of one body; patches are the cells of a box mesh unless a function says otherwise."""
    dim, patch = points.shape[1], None
    if order == "quadratic":
        points, cells = with_middles(points, cells)
    elif volumetric == "reduced":
        patch = (patches or grid_patches)(cells, dim)
    return whole_mesh(grouped_mesh([(points, cells, patch)]))


def elements_of(mesh, material="green", lame=LAME, mu=MU, lumped=False, volumetric="full"):
    one = np.ones(1)
    flag = one.astype(bool)
    return Elements(mesh, Bodies(DENSITY * one, lame * one, mu * one, [named(material)], flag & lumped,
                                 flag & (volumetric == "reduced"), 0 * one, 0 * one))  # fmt: skip


def pattern_of(mesh):
    return Pattern.of(mesh, mesh.points.shape[1])


def pattern_at(cells, n, width):
    """Return the pattern of a mesh of ``n`` nodes on one rank."""
    mesh = SimplexMesh(np.zeros((n, 2)), cells, np.zeros(len(cells), np.int32))
    return Pattern.of(whole_mesh(mesh), width)


def respond(elements, pattern, d, inertia=None, shift=None, a=0.0, k=1.0):
    """Return the dense matrix and b for given factors; by default K' and -K(d)."""
    n = d.size
    values, b = np.empty(len(pattern.indices)), np.empty_like(d)
    zero = np.zeros_like(d)
    state = State(d, zero if inertia is None else inertia, zero if shift is None else shift)
    elements.assemble(state, a, k, pattern, values, b)
    A = np.zeros((n, n))
    A[np.repeat(np.arange(n), np.diff(pattern.indptr)), pattern.indices] = values
    return A, b
