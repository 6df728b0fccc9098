"""Supports that share nodes and do not agree there on what these do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from petfsi.messages import shown
from petfsi.scene.expressions import Expression, ExpressionError
from petfsi.scene.solids import Support, Tagged
from petfsi.scene.tables import Shape

#: Motions are compared at so many instants of the run.
INSTANTS = 17
#: They agree within this part of the larger one.
SAME = 1e-9


class Rule(NamedTuple):
    """What one support prescribes along one axis.

    Attributes
    ----------
    key : str
        Of the support: ``solids.b.supports.0``.
    axis, quantity : str
        ``x``, ..., ``angle``; ``velocity`` or ``displacement``.
    expression : Expression
    support : Support
    """

    key: str
    axis: str
    quantity: str
    expression: Expression
    support: Support


class Overlap(NamedTuple):
    """Two rules for the same nodes, of which the later one holds; ``points`` are theirs, shape (n, dim)."""

    earlier: Rule
    later: Rule
    points: np.ndarray


def conflicts(overlaps: list[Overlap], end: float) -> list[str]:
    """Return a line for each two supports that prescribe different motions of nodes that they share.

    Not collective.

    Parameters
    ----------
    overlaps : list of Overlap
    end : float
        Of the run, s.
    """
    return [story for overlap in overlaps for story in _story(overlap, end)]


def _story(overlap: Overlap, end: float) -> Iterator[str]:
    one, other, points = overlap
    differs = _differ(one, other, points, end)
    if not differs.any():
        return
    at = ", ".join(f"{c:.6g}" for c in points[np.argmax(differs)])
    body, first = one.key.rsplit(".supports.", 1)
    last = other.key.rsplit(".", 1)[1]
    nodes = "the node" if differs.sum() == 1 else f"{differs.sum()} nodes, one of them"
    along = "by different angles" if one.axis == "angle" else f"differently along {one.axis}"
    yield (
        f"{body}: supports.{first} ({_place(one.support)}) and supports.{last} ({_place(other.support)}) move {nodes} "
        f"at ({at}) m {along}: {_motion(one)}, {_motion(other)}. The later one, supports.{last}, counts there"
    )


def _differ(one: Rule, other: Rule, points: np.ndarray, end: float) -> np.ndarray:
    """Return at which points two rules differ at some instant, shape (n,)."""
    a, b = one.expression, other.expression
    if one.quantity == other.quantity and a.source == b.source:
        return np.zeros(len(points), dtype=bool)
    t = np.linspace(0.0, end, INSTANTS)[:, None]
    coordinates = {"z": 0.0, **dict(zip("xyz", points.T, strict=False))}
    try:
        first, second = (expression(t=t, **coordinates) for expression in (a, b))
    except ExpressionError:  # the run itself will say so
        return np.zeros(len(points), dtype=bool)
    size = np.maximum(np.abs(first), np.abs(second))
    apart = np.abs(first - second) if one.quantity == other.quantity else size  # else they are alike at rest only
    return np.any(apart > SAME * size, axis=0)


def _motion(rule: Rule) -> str:
    if rule.expression.is_constant and float(rule.expression()) == 0.0:
        return "at rest"
    return f"{rule.quantity} {shown(rule.expression.source, 40)}"


def _place(support: Support) -> str:
    where = support.where
    if isinstance(where, Tagged):
        return f"tag {shown(where.tag, 30)}"
    return f"a {where.kinds[0]}" if isinstance(where, Shape) else where
