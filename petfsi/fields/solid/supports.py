"""Nodes whose motion is prescribed, and their elimination from A and b."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from petfsi.fields.solid.pattern import Pattern
from petfsi.geometry.bodies import supported
from petfsi.petsc import Layout
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Solid


class Supports:
    """The prescribed unknowns of all bodies, the same on every rank.

    Where supports overlap, the later one in the scene holds.

    Parameters
    ----------
    solids : mapping of str to Solid
        Of the scene.
    points : ndarray, shape (n, dim)
        Reference points of the whole mesh.
    node_body : ndarray of int, shape (n,)
        The body of each node.
    number : ndarray of int, shape (n,)
        Global number of each node.
    components : tuple of str
        What a node's unknowns are called in the scene: x, y, ...

    Attributes
    ----------
    unknowns : ndarray of int
        Global numbers, ascending.
    """

    def __init__(
        self, solids: Mapping[str, Solid], points: np.ndarray, node_body: np.ndarray, number: np.ndarray,
        components: tuple[str, ...],
    ):  # fmt: skip
        width = len(components)
        rule = np.full((len(points), width), -1, dtype=np.int32)
        speeds: list[Expression] = []
        for body, (name, solid) in enumerate(solids.items()):
            nodes = np.flatnonzero(node_body == body)
            for n, support in enumerate(solid.supports):
                key = f"solids.{name}.supports.{n}"
                held = nodes[supported(support, points[nodes], key)]
                for letter in dict.fromkeys(support.fix):
                    rule[held, components.index(letter)] = len(speeds)
                    speeds.append(Expression(support.velocity.get(letter, 0.0), key=f"{key}.velocity.{letter}"))
        node, direction = np.nonzero(rule >= 0)
        unknowns = width * number[node].astype(np.int64) + direction
        order = np.argsort(unknowns)
        self.unknowns = unknowns[order]
        chosen, where = rule[node, direction][order], points[node[order]]
        self._values = np.zeros(len(chosen))
        self._moving = []
        for index, speed in enumerate(speeds):
            entries = np.flatnonzero(chosen == index)
            if len(entries) and not (speed.is_constant and float(speed()) == 0.0):
                coordinates = dict(zip("xyz", where[entries].T, strict=False))
                self._moving.append((speed, entries, {"z": 0.0, **coordinates}))

    @property
    def move(self) -> bool:
        """Whether any of them has a velocity other than zero."""
        return bool(self._moving)

    def velocities(self, time: float) -> np.ndarray:
        """Return the prescribed velocity of each of ``unknowns``, m/s."""
        for speed, entries, coordinates in self._moving:
            self._values[entries] = speed(t=time, **coordinates)
        return self._values


class Elimination:
    """Takes prescribed unknowns out of this rank's rows of A and b, rows and columns alike.

    With g the prescribed values and F the fixed unknowns,  b -= A[:, F] g  in the free rows; then rows and columns
    of F are emptied and  diagonal * u = diagonal * g  stands in the rows.

    Parameters
    ----------
    pattern : Pattern
    unknowns : Layout
        Of the block.
    fixed : ndarray of int
        Global numbers of all prescribed unknowns, ascending.
    """

    def __init__(self, pattern: Pattern, unknowns: Layout, fixed: np.ndarray):
        index = np.full(unknowns.n_global, -1, dtype=np.int32)
        index[fixed] = np.arange(len(fixed), dtype=np.int32)
        mine = index[unknowns.start : unknowns.end]
        self._rows = np.flatnonzero(mine >= 0)
        self._own = mine[self._rows]
        row = np.repeat(np.arange(unknowns.n_local, dtype=np.int32), np.diff(pattern.indptr))
        column = index[pattern.indices]
        self._empty = np.flatnonzero((column >= 0) | (mine[row] >= 0)).astype(np.int32)
        self._lifted = np.flatnonzero((column >= 0) & (mine[row] < 0)).astype(np.int32)
        self._lifted_row, self._lifted_column = row[self._lifted], column[self._lifted]
        diagonal = self._empty[pattern.indices[self._empty] == row[self._empty] + unknowns.start]
        self._diagonal = diagonal

    def apply(self, values: np.ndarray, b: np.ndarray, g: np.ndarray, diagonal: float) -> None:
        """Change A's values and b (flat) in place. Not collective."""
        lift = values[self._lifted] * g[self._lifted_column]
        b -= np.bincount(self._lifted_row, weights=lift, minlength=len(b))
        values[self._empty] = 0.0
        values[self._diagonal] = diagonal
        b[self._rows] = diagonal * g[self._own]
