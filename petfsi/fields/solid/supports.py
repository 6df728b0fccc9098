"""Nodes whose motion is prescribed, and their elimination from A and b."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.fields.solid.conflicts import Overlap, Rule
from petfsi.fields.solid.pattern import Pattern
from petfsi.geometry.places import Tags, located
from petfsi.integrators.base import Integrator, Motion, Stage
from petfsi.petsc import Layout
from petfsi.scene.expressions import Expression
from petfsi.scene.solids import Solid

#: Fraction of the first step over which the initial velocity of a prescribed displacement is measured.
INSTANT = 1e-3
#: Velocities agree within this part of them, or of what leads a prescribed displacement through the first step.
AGREE = 1e-5


class Supports:
    """The prescribed unknowns of all bodies, the same on every rank.

    Where supports overlap, the later one in the scene holds; see ``conflicts``.

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
    tags : mapping of str to Tags
        Of the bodies whose mesh files have some that the scene names.

    Attributes
    ----------
    unknowns : ndarray of int
        Global numbers, ascending.
    placed : ndarray of int
        Which of ``unknowns`` have a prescribed displacement; the others have a velocity.
    overlaps : list of Overlap
        Where two supports prescribe the same unknowns.
    """

    def __init__(
        self, solids: Mapping[str, Solid], points: np.ndarray, node_body: np.ndarray, number: np.ndarray,
        components: tuple[str, ...], tags: Mapping[str, Tags],
    ) -> None:  # fmt: skip
        width = len(components)
        rule = np.full((len(points), width), -1, dtype=np.int32)
        rules: list[Rule] = []
        self.overlaps: list[Overlap] = []
        for body, (name, solid) in enumerate(solids.items()):
            nodes = np.flatnonzero(node_body == body)
            for n, support in enumerate(solid.supports):
                key = f"solids.{name}.supports.{n}"
                held = nodes[located(support.where, points[nodes], key, tags.get(name, {}))]
                for letter in dict.fromkeys(support.fix):
                    quantity = "displacement" if letter in support.displacement else "velocity"
                    source = getattr(support, quantity).get(letter, 0.0)
                    own = Rule(key, letter, quantity, Expression(source, key=f"{key}.{quantity}.{letter}"), support)
                    before = rule[held, components.index(letter)]
                    self.overlaps += [
                        Overlap(rules[index], own, points[held[before == index]])
                        for index in np.unique(before[before >= 0])
                    ]
                    rule[held, components.index(letter)] = len(rules)
                    rules.append(own)
        node, direction = np.nonzero(rule >= 0)
        unknowns = width * number[node].astype(np.int64) + direction
        order = np.argsort(unknowns)
        self.unknowns = unknowns[order]
        self._assign(rules, rule[node, direction][order], points[node[order]])

    def _assign(self, rules: list[Rule], chosen: np.ndarray, where: np.ndarray) -> None:
        """Note which expression gives which of the unknowns, and at what position."""
        self._values = np.zeros(len(chosen))
        self._reach = float(np.abs(where).max(initial=0.0))
        self._moving, self._placing = [], []
        for index, (_, _, quantity, expression, _) in enumerate(rules):
            entries = np.flatnonzero(chosen == index)
            part = expression, entries, {"z": 0.0, **dict(zip("xyz", where[entries].T, strict=False))}
            if len(entries) and quantity == "displacement":
                self._placing.append(part)
            elif len(entries) and not (expression.is_constant and float(expression()) == 0.0):
                self._moving.append(part)
        self.placed = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *(part[1] for part in self._placing)]))

    @property
    def still(self) -> np.ndarray:
        """Those of ``unknowns`` that are held at rest, where they were at the start."""
        moving = [entries for _, entries, _ in self._moving]
        moving += [entries for expression, entries, _ in self._placing if expression.depends_on_time]
        return np.delete(self.unknowns, np.concatenate([np.zeros(0, dtype=np.int64), *moving]))

    @property
    def move(self) -> bool:
        """Whether any of them moves."""
        return bool(self._moving) or any(expression.depends_on_time for expression, _, _ in self._placing)

    def velocities(self, time: float) -> np.ndarray:
        """Return the prescribed velocity of each of ``unknowns``, m/s; anything at those that are ``placed``."""
        for speed, entries, coordinates in self._moving:
            self._values[entries] = speed(t=time, **coordinates)
        return self._values

    def displacements(self, time: float) -> np.ndarray:
        """Return the prescribed displacement of each of ``unknowns[placed]``, m."""
        values = np.zeros(len(self.unknowns))
        for way, entries, coordinates in self._placing:
            values[entries] = way(t=time, **coordinates)
        return values[self.placed]

    def initial_velocities(self, dt: float) -> np.ndarray:
        """Return the velocity of each of ``unknowns`` at time zero, m/s.

        Of prescribed displacements by one-sided differences of second order over a small part of the first step.
        """
        values = self.velocities(0.0).copy()
        if len(self.placed):
            tick = INSTANT * dt
            d = [self.displacements(n * tick) for n in range(3)]
            values[self.placed] = (4 * d[1] - 3 * d[0] - d[2]) / (2 * tick)
        return values

    def jumps(self, given: np.ndarray, dt: float) -> np.ndarray:
        """Return by how much the velocity of each of ``unknowns`` at time zero differs from those given, m/s.

        Zero where they agree, as far as can be told of prescribed displacements.
        """
        speed = self.initial_velocities(dt)
        size, lost = np.maximum(np.abs(speed), np.abs(given)), np.zeros(len(speed))
        if len(self.placed):
            begin, end = self.displacements(0.0), self.displacements(dt)
            size[self.placed] = np.maximum(size[self.placed], np.abs(end - begin) / dt)
            lost[self.placed] = 10 * np.finfo(float).eps * (np.abs(begin) + self._reach) / (INSTANT * dt)
        jump = speed - given
        return np.where(np.abs(jump) > np.maximum(AGREE * size, lost), jump, 0.0)

    def reaching(
        self,
        comm: MPI.Comm,
        layout: Layout,
        integrator: Integrator,
        motion: Motion,
        stage: Stage,
        time: float,
        h: float,
    ) -> np.ndarray:
        """Return the w of ``unknowns[placed]`` that takes them to where they should be at the step's end. Collective.

        Whatever the scheme, d^{n+1} is linear in w.

        Parameters
        ----------
        comm : MPI.Comm
        layout : Layout
            Of the unknowns.
        integrator : Integrator
        motion : Motion
            Of this rank's nodes.
        stage : Stage
            Of the step.
        time, h : float
            When it begins, and its length, s.
        """
        width = motion.displacement.shape[1]
        unknowns = self.unknowns[self.placed]
        mine = np.flatnonzero((unknowns >= layout.start) & (unknowns < layout.end))
        rows, components = np.divmod(unknowns[mine] - layout.start, width)
        past = tuple(values[rows] for values in motion.past)
        there = Motion(motion.displacement[rows], motion.velocity[rows], past, motion.past_dt)
        arrays = {f.name: getattr(stage, f.name) for f in fields(stage)}
        parts: dict[str, Any] = {name: a[rows] for name, a in arrays.items() if isinstance(a, np.ndarray)}
        staged = replace(stage, **parts)
        ends = [integrator.finish(there, staged, np.full((len(rows), width), w), h).displacement for w in (0.0, 1.0)]
        ends = [end[np.arange(len(rows)), components] for end in ends]
        share = np.zeros(len(unknowns))
        share[mine] = (self.displacements(time + h)[mine] - ends[0]) / (ends[1] - ends[0])
        result = np.empty_like(share)
        comm.Allreduce(share, result)
        return result


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

    def empty(self, values: np.ndarray, diagonal: float) -> None:
        """Change A's values in place, and keep A[:, F] for ``prescribe``. Not collective."""
        self._taken, self._on_diagonal = values[self._lifted], diagonal
        values[self._empty] = 0.0
        values[self._diagonal] = diagonal

    def prescribe(self, b: np.ndarray, g: np.ndarray) -> None:
        """Change b (flat) in place, for the A that was emptied last. Not collective."""
        lift = self._taken * g[self._lifted_column]
        b -= np.bincount(self._lifted_row, weights=lift, minlength=len(b))
        b[self._rows] = self._on_diagonal * g[self._own]
