"""Rigid motions that no support holds: where there is no inertia, nothing else may resist them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from petfsi.geometry.meshes import SimplexMesh

#: Held nodes that move less than this part of what others do in a motion hold nothing of it.
RANK = 1e-9
#: Components of a motion below this part of it are none.
NONE = 1e-7
#: What is left of forces that cancel, as a part of them.
UNPUSHED = 1e-9


@dataclass(frozen=True)
class RigidMotion:
    """A rigid motion of a connected body that leaves all held unknowns where they are.

    Attributes
    ----------
    body : int
    story : str
        ``along y``, or around what.
    nodes : ndarray of int, shape (n,)
        Of the body, in the whole mesh.
    values : ndarray, shape (n, width)
        How they move: 1 m along a direction, or 1 rad.
    centripetal : ndarray, shape (n, dim)
        How that curves, m: zero if it is no rotation.
    """

    body: int
    story: str
    nodes: np.ndarray
    values: np.ndarray
    centripetal: np.ndarray


def loose_motions(mesh: SimplexMesh, x: np.ndarray, held: np.ndarray) -> list[RigidMotion]:
    """Return the rigid motions that are not held, of every connected body. Not collective.

    Parameters
    ----------
    mesh : SimplexMesh
    x : ndarray, shape (n, dim)
        Where its nodes are, m.
    held : ndarray of bool, shape (n, width)
        Which of their unknowns are prescribed; beyond ``dim`` they are angles.
    """
    found = []
    for body in range(int(mesh.body.max()) + 1):
        elements = mesh.elements(body)
        for nodes in _parts(elements, len(x)):
            found += [RigidMotion(body, *motion) for motion in _loose(nodes, x[nodes], held[nodes])]
    return found


def without_equilibrium(
    motions: Sequence[RigidMotion], force: np.ndarray, follows: bool, stiffens: Callable[[int], bool]
) -> dict[int, list[tuple[RigidMotion, float]]]:
    """Return the bodies that forces push along some of these motions, or that have no place where they come to rest.

    Not collective.

    Parameters
    ----------
    motions : sequence of RigidMotion
    force : ndarray, shape (n, width)
        On the nodes of the whole mesh, zero where they are held, N.
    follows : bool
        Whether forces turn with bodies.
    stiffens : callable
        Whether forces that do not may hold a body in its place as it turns.

    Returns
    -------
    dict of int to list of (RigidMotion, float)
        Of each such body all of its motions, and the work that forces do along each.
    """
    found: dict[int, list[tuple[RigidMotion, float]]] = {}
    wrong = []
    for motion in motions:
        push, steadies = _pushed(motion, force[motion.nodes], follows, stiffens)
        found.setdefault(motion.body, []).append((motion, push))
        if push or not steadies:
            wrong.append(motion.body)
    return {body: found[body] for body in wrong}


def _pushed(
    motion: RigidMotion, force: np.ndarray, follows: bool, stiffens: Callable[[int], bool]
) -> tuple[float, bool]:
    """Return the work of nodal forces (n, width) along a motion, and whether they hold the body as it turns."""
    works, curved = force * motion.values, force[:, : motion.centripetal.shape[1]] * motion.centripetal
    push = float(works.sum())
    steadies = bool(np.any(curved)) and (follows or stiffens(motion.body))
    steadies = steadies and (follows or abs(float(curved.sum())) > UNPUSHED * float(np.abs(curved).sum()))
    return (push if abs(push) > UNPUSHED * float(np.abs(works).sum()) else 0.0), steadies


def _parts(elements: np.ndarray, n: int) -> list[np.ndarray]:
    """Return the nodes of each connected part of some elements."""
    rows = np.repeat(elements[:, 0], elements.shape[1])
    graph = coo_matrix((np.ones(rows.size), (rows, elements.ravel())), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    nodes = np.unique(elements)
    order = nodes[np.argsort(label[nodes], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _loose(nodes: np.ndarray, x: np.ndarray, held: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Return story, nodes, values and centripetal part of what is not held of one body."""
    dim, width = x.shape[1], held.shape[1]
    middle, size = x.mean(axis=0), float(np.ptp(x, axis=0).max())
    modes = _rigid((x - middle) / size, width)
    fixed = modes.reshape(len(modes), -1)[:, held.ravel()]
    if fixed.shape[1]:
        _, strength, ways = np.linalg.svd(np.linalg.qr(fixed.T, mode="r"))
        strength = np.concatenate((strength, np.zeros(len(ways) - len(strength))))
        free = ways[strength <= RANK * strength[0]]
    else:
        free = np.eye(len(modes))
    shifts, turns = _sorted_out(free, dim)
    found = []
    for way in shifts:
        values = np.zeros((len(x), width))
        values[:, :dim] = way
        found.append((f"along {_direction(way)}", nodes, values, np.zeros_like(x)))
    for way in turns:
        spin = _spin(way[dim:])
        centre = middle - size * np.linalg.pinv(spin) @ way[:dim]
        # modes are by (x - middle) / size: one radian shifts by size times as much
        values = np.tensordot(way, _rigid((x - middle) / size, width), axes=1)
        values[:, :dim] *= size
        story = f"around {_point(centre, size)}" if dim == 2 else f"around {_axis(way[dim:], centre, size)}"
        found.append((story, nodes, values, (x - centre) @ (spin @ spin).T))
    return found


def _rigid(x: np.ndarray, width: int) -> np.ndarray:
    """Return the rigid motions of points, shifts and then turns about the origin, shape (3 or 6, n, width).

    What is beyond ``dim`` is the angle of a section in the plane.
    """
    dim = x.shape[1]
    turns = np.eye(1) if dim == 2 else np.eye(3)
    modes = np.zeros((dim + len(turns), len(x), width))
    for a in range(dim):
        modes[a, :, a] = 1.0
    for n, turn in enumerate(turns):
        modes[dim + n, :, :dim] = x @ _spin(turn).T
        modes[dim + n, :, dim:] = 1.0
    return modes


def _spin(turn: np.ndarray) -> np.ndarray:
    """Return the matrix S of a turn, S x = omega cross x."""
    if len(turn) == 1:
        return turn[0] * np.array([[0.0, -1.0], [1.0, 0.0]])
    a, b, c = turn
    return np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])


def _sorted_out(free: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a space of motions as shifts, along axes where that is possible, and turns, of one radian each."""
    left, turned, _ = np.linalg.svd(free[:, dim:])
    rank = int(np.sum(turned > NONE))
    shifts = _along_axes((left[:, rank:].T @ free)[:, :dim])
    turns = _echelon(left[:, :rank].T @ free, dim)
    # of a shift that is free, a turn needs none
    turns[:, :dim] -= turns[:, :dim] @ np.linalg.pinv(shifts) @ shifts if len(shifts) else 0.0
    return shifts, turns


def _along_axes(rows: np.ndarray) -> np.ndarray:
    """Return a basis of the space of some directions: the axes in it first, then what is across them."""
    if not len(rows):
        return rows
    inside = rows.T @ np.linalg.pinv(rows.T)
    axes = np.array([row for row in np.eye(rows.shape[1]) if np.linalg.norm(inside @ row - row) < NONE])
    axes = axes.reshape(-1, rows.shape[1])
    others, strength, _ = np.linalg.svd((rows - rows @ axes.T @ axes).T, full_matrices=False)
    return np.concatenate((axes, others[:, strength > NONE].T))


def _echelon(rows: np.ndarray, dim: int) -> np.ndarray:
    """Return combinations of motions that turn about axes where that is possible, by one radian."""
    turns = _along_axes(rows[:, dim:])
    return turns @ np.linalg.pinv(rows[:, dim:]) @ rows if len(rows) else rows


def _direction(way: np.ndarray) -> str:
    most = int(np.argmax(np.abs(way)))
    if np.abs(way[most]) > (1 - NONE) * np.linalg.norm(way):
        return "xyz"[most]
    return _point(way * np.sign(way[most]), 1.0)


def _axis(turn: np.ndarray, through: np.ndarray, size: float) -> str:
    return f"the axis along {_direction(turn)} through {_point(through, size)}"


def _point(x: np.ndarray, size: float) -> str:
    return f"({', '.join(f'{c:.4g}' for c in np.where(np.abs(x) < NONE * size, 0.0, x))})"


def refusal(name: str, motions: Sequence[tuple[RigidMotion, float]], dim: int) -> str:
    """Return what to say of a body with motions that nothing holds.

    Parameters
    ----------
    name : str
    motions : sequence of (RigidMotion, float)
        And the work that loads do along each, N or N m (N/m or N in 2D).
    dim : int
    """
    parts = []
    for motion, push in motions:
        units = ("N/m", "N m/m") if dim == 2 else ("N", "N m")
        unit = units[bool(np.any(motion.centripetal))]
        parts.append(motion.story + (f", where {push:.4g} {unit} act" if push else ""))
    pushed = any(push for _, push in motions)
    why = "there is no equilibrium as it lies" if pushed else "where it comes to rest is not determined"
    return f"solids.{name}.supports: in statics nothing holds the solid {'; '.join(parts)}: {why}; hold it there, too"
