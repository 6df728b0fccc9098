"""Where a reference position lies in a distributed mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.solid.partition import LocalMesh
from petfsi.fields.solid.patches import barycentric_gradients
from petfsi.fields.solid.rules import shape_functions

#: Barycentric coordinates down to this count as inside.
SLACK = -1e-9


@dataclass(frozen=True)
class Place:
    """A point as a weighted mean of nodes, the same on every rank."""

    nodes: np.ndarray  # global numbers
    weights: np.ndarray

    def value(self, comm: MPI.Comm, mesh: LocalMesh, owned: np.ndarray) -> np.ndarray:
        """Return the mean of rows of ``owned``, shape (n_owned, dim), on every rank. Collective."""
        local = self.nodes - mesh.nodes.start
        mine = (local >= 0) & (local < mesh.n_owned)
        result = np.empty(owned.shape[1])
        comm.Allreduce(self.weights[mine] @ owned[local[mine]], result)
        return result


def locate(comm: MPI.Comm, mesh: LocalMesh, body: int, at: np.ndarray, key: str) -> Place:
    """Return the place of a reference position in a body. Collective.

    It lies in the first element that contains it, where its shape functions are the weights, else at the nearest node.

    Parameters
    ----------
    comm : MPI.Comm
    mesh : LocalMesh
    body : int
    at : ndarray, shape (dim,)
    key : str
        What is there, for messages: ``"a probe of solids.layer"``.

    Raises
    ------
    InputError
        If it is farther from the nearest node than that node's longest edge.
    """
    dim = mesh.points.shape[1]
    elements = mesh.elements(body)
    corners = mesh.points[elements[:, : dim + 1]]
    slack = 1e-6 * np.ptp(corners, axis=1).max(axis=1, keepdims=True)
    near = np.all((corners.min(axis=1) - slack <= at) & (at <= corners.max(axis=1) + slack), axis=1)
    nodes, corners = elements[near], corners[near]
    offset = np.einsum("eaj,ej->ea", barycentric_gradients(mesh.points, nodes), at - corners.mean(axis=1))
    barycentric = 1 / (dim + 1) + offset
    hits = np.flatnonzero(barycentric.min(axis=1, initial=np.inf) >= SLACK)
    found = None
    if len(hits):
        # on a face between elements every rank must choose the same one: the first by its nodes in the whole mesh
        chosen = min(hits, key=lambda hit: mesh.natural[nodes[hit]].tolist())
        weights = shape_functions(barycentric[chosen], nodes.shape[1])
        found = (mesh.natural[nodes[chosen]].tolist(), mesh.number[nodes[chosen]], weights)
    answers = [answer for answer in comm.allgather(found) if answer is not None]
    if answers:
        _, nodes, weight = min(answers, key=lambda answer: answer[0])
        return Place(np.asarray(nodes), weight)
    return _nearest(comm, mesh, body, at, key)


def _nearest(comm: MPI.Comm, mesh: LocalMesh, body: int, at: np.ndarray, key: str) -> Place:
    cells = mesh.cells[mesh.body == body]
    nodes = np.unique(cells[cells < mesh.n_owned])
    found = None
    if len(nodes):
        distance = np.linalg.norm(mesh.points[nodes] - at, axis=1)
        node = nodes[np.argmin(distance)]
        around = mesh.points[cells[np.any(cells == node, axis=1)]]
        edges = np.linalg.norm(around[:, :, None] - around[:, None, :], axis=-1)
        found = (distance.min(), mesh.natural[node], mesh.number[node], edges.max())
    answers = [answer for answer in comm.allgather(found) if answer is not None]
    distance, _, number, size = min(answers, key=lambda answer: answer[:2])
    if distance > size:
        where = ", ".join(f"{x:g}" for x in at)
        raise InputError(f"{key} at [{where}] lies {distance:g} m outside it, more than an element ({size:g} m)")
    return Place(np.array([number]), np.ones(1))
