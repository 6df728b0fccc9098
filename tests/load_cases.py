"""What the tests of loads share: loaded boxes, their forces, and the mesh file of a ring with tags."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from solid_cases import body, field

from petfsi.fields.solid.elements import State
from petfsi.geometry.meshes import box_mesh
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.tables import Box

COMM = MPI.COMM_WORLD
SIZE = np.array([1.5, 1.0, 0.8])
ORDERS = pytest.mark.parametrize("elements", ["linear", "quadratic"])


def loaded(dim, comm=COMM, **more):
    return field(dim, comm, b=body(dim, **more))


def forces(solid, time=0.0, move=None, shift=None, k=0.0, values=None):
    """Return this rank's rows of the loads' forces where nodes have moved by ``move``, a function of positions."""
    x = solid._mesh.points
    zero = np.zeros_like(x)
    d = zero if move is None else move(x)
    b = np.zeros_like(solid.reference)
    solid._loads.assemble(time, State(d, zero, zero if shift is None else shift(x)), k, values, b)
    return b


def resultant(solid, **how):
    """Return the sum of all nodal forces and of their moments about the origin, at rest."""
    f, x = forces(solid, **how), solid.reference
    moments = [x[:, a] @ f[:, b] - x[:, b] @ f[:, a] for a, b in ((0, 1), (1, 2), (2, 0))[: 1 if solid.dim == 2 else 3]]
    return COMM.allreduce(np.concatenate((f.sum(axis=0), moments)))


def annulus(path, n_along, n_around):
    """Write a quarter of a ring, radii 1 to 1.2, with its inner arc and both cuts tagged."""
    box = Box(origin=[0, 0], size=[1, 1], cells=[n_along, n_around])
    s, cells = box_mesh(box)
    radius, angle = 1 + 0.2 * s[:, 0], np.pi / 2 * s[:, 1]
    points = np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))
    facets = boundary_facets(s, cells)
    lines = {1: (0, 0.0), 2: (1, 0.0), 3: (1, 1.0)}
    chosen = {tag: facets[np.isclose(s[facets][:, :, axis], end).all(axis=1)] for tag, (axis, end) in lines.items()}
    # a point that belongs to no cell comes first: numbers shift when it is dropped
    points = np.vstack(([[9.0, 9.0]], points))
    blocks = [("triangle", cells + 1), *(("line", some + 1) for some in chosen.values())]
    physical = [np.full(len(cells), 7), *(np.full(len(some), tag) for tag, some in chosen.items())]
    mesh = meshio.Mesh(
        np.column_stack((points, np.zeros(len(points)))), blocks,
        cell_data={"gmsh:physical": physical, "gmsh:geometrical": physical},
        field_data={"inner": np.array([1, 1]), "floor": np.array([2, 1]), "body": np.array([7, 2])},
    )  # fmt: skip
    if COMM.rank == 0:
        mesh.write(path, file_format="gmsh22", binary=False)
    COMM.barrier()


def ring(path, lame=1.5, **more):
    young, poisson = (3 * lame + 2) / (lame + 1), lame / (2 * (lame + 1))
    supports = [{"where": {"tag": "floor"}, "fix": ["y"]}, {"where": {"tag": "3"}, "fix": ["x"]}]
    solid = {"shape": {"mesh": str(path)}, "density": 1.0, "young": young, "poisson": poisson, "supports": supports}
    return {"dim": 2, "time": {"end": 1.0, "dt": 0.1, "integrator": "newmark"}, "solids": {"ring": solid | more}}
