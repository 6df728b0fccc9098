"""How slender solids bend: between which supports, how slowly, and how much too stiffly their elements do.

Beams of Euler and Bernoulli swing with  omega = c sqrt(E I / (rho A L^4)),  with shear (Dunkerley)
1/omega^2 = 1/omega_bending^2 + 1/omega_shear^2;  linear elements bend  1 + (a + b r^2)/n^2  times as stiffly as that,
n across the thickness and r times as long as thick, and tetrahedra by what a stiff bulk adds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from petfsi.notes.forms import SLENDER, Bend, Form
from petfsi.scene.solids import Solid

#: c of the slowest bending that is no rigid motion, by how the ends are held, in the order of the alphabet. A guided
#: end slides and does not turn, as in a plane of symmetry. R. D. Blevins, Formulas for Natural Frequency (1979), ch. 8.
SLOWEST = {
    ("clamped", "free"): 3.516,
    ("clamped", "clamped"): 22.373,
    ("clamped", "guided"): 5.593,
    ("clamped", "pinned"): 15.418,
    ("free", "free"): 22.373,
    ("free", "guided"): 5.593,
    ("free", "pinned"): 15.418,
    ("guided", "guided"): math.pi**2,
    ("guided", "pinned"): math.pi**2 / 4,
    ("pinned", "pinned"): math.pi**2,
}
#: k of the same motion by shear alone, as sections that do not bend turn all alike:  omega = k/L sqrt(SHEAR G / rho).
SHEARED = {
    ("clamped", "free"): math.pi / 2,
    ("clamped", "guided"): math.pi / 2,
    ("free", "free"): 2 * math.pi,
    ("free", "pinned"): 4.493,  # tan k = k
    ("guided", "pinned"): math.pi / 2,
}
#: Of others, and of a rectangular section.
SHEARED_ELSE, SHEAR = math.pi, 5 / 6
#: What linear elements of a box add to its stiffness, (a + b r^2)/n^2 with full and reduced integration, fitted to
#: cantilevers ten times as long as thick, n 1 to 8, r 1/2 to 4, poisson 0 to .4999: nearly all that bend 1.1 to 30
#: times as stiffly are met within a factor of two (poisson to .495, else within 2.3).
TOO_STIFF = {"full": (1.6, 1.3), "reduced": (1.0, 1.2)}
#: What lambda/mu adds to (a + b r^2): with tetrahedra, and with triangles of a file, at least. A box's triangles do not
#: lock so, as their diagonals change direction.
BULK_3D, BULK_2D = 0.65, 0.1

#: A node holds a direction if it holds an axis that is not across it by more than this.
_ALONG = 0.3
_SAME_PLACE = 1e-6


class Span(NamedTuple):
    """A stretch of a solid between supports or ends that can bend.

    Attributes
    ----------
    length : float
        m.
    ends : tuple of str
        How they are held, in the order of the alphabet.
    axis : int
        Along which axis of the solid's form it lies.
    """

    length: float
    ends: tuple[str, str]
    axis: int

    @property
    def slowness(self) -> float:
        """What its period is in proportion to, m^2."""
        return self.length**2 / SLOWEST[self.ends]


def widest_span(form: Form, fixed: np.ndarray) -> Span | None:
    """Return the span of a solid that bends most slowly; None if there is none as slender as a beam.

    A plate may bend along either of its long axes: one as wide as long is held by what holds one of them.

    Parameters
    ----------
    form : Form
    fixed : ndarray of bool, shape (n, width)
        Which components of its points are held.
    """
    if not form.slender:
        return None
    long = [n for n in range(1, len(form.axes)) if form.lengths[n] >= SLENDER * form.thickness]
    spans = [span for n in reversed(long) for span in _Line(form, fixed, n).spans()]
    return max(spans, key=lambda span: span.slowness, default=None)


class _Line:
    """A long axis of a solid: where its points are along it, and which of them are held sideways and lengthwise."""

    def __init__(self, form: Form, fixed: np.ndarray, axis: int) -> None:
        dim = len(form.axes)
        self.form, self.axis = form, axis
        self.s = form.points @ form.axes[axis]
        self.sideways, self.lengthwise = (
            (fixed[:, :dim] & (np.abs(form.axes[n]) > _ALONG)).any(axis=1) for n in (0, axis)
        )
        self.angled = fixed.shape[1] > dim  # nodes of beams turn
        self.turning = fixed[:, dim:].any(axis=1)
        # as bodies of files are no boxes quite
        self.length = float(min(np.ptp(self.s), form.lengths[axis] * 1.1))
        self.near = _SAME_PLACE * self.length
        # of a large box only some of its nodes are here, farther apart than its elements are long
        apart = np.ptp(self.s) / max(int((np.diff(np.sort(self.s)) > self.near).sum()), 1)
        self.spacing = max(float(apart), float(form.spacing[axis]))

    def spans(self) -> list[Span]:
        """Return what bends along it."""
        first, last = float(self.s.min()), float(self.s.max())
        at = np.sort(self.s[self.sideways])
        if not len(at):
            one, other = sorted((self._loose_kind(first), self._loose_kind(last)))
            return [Span(self.length, (one, other), self.axis)]
        at = at[np.concatenate(([True], np.diff(at) > self.near))]
        ends = [(first, self._loose_kind(first))] if at[0] - first > self.near else []
        ends += [(float(place), self._kind(place, at)) for place in at]
        ends += [(last, self._loose_kind(last))] if last - at[-1] > self.near else []
        return [
            Span(float(b - a), (min(one, other), max(one, other)), self.axis)
            for (a, one), (b, other) in zip(ends[:-1], ends[1:], strict=True)
            if b - a >= SLENDER * self.form.thickness and self._moves(a, one, b, other)
        ]

    def _moves(self, a: float, one: str, b: float, other: str) -> bool:
        """Return whether a node of a stretch can move sideways: an end that is not held, or one within."""
        within = (self.s > a + self.near) & (self.s < b - self.near)
        return bool({"free", "guided"} & {one, other}) or bool(within.any())

    def _here(self, place: float) -> np.ndarray:
        return np.abs(self.s - place) <= self.near

    def _keeps_angle(self, place: float) -> bool:
        """Return whether what is held at a place does not turn: by its angle, or lengthwise at more than one height."""
        here = self._here(place)
        held = here & self.lengthwise
        high = np.ptp(self.form.points[held] @ self.form.axes[0]) if held.any() else 0.0
        return bool((here & self.turning).any() or high >= 0.5 * self.form.thickness)

    def _kind(self, place: float, at: np.ndarray) -> str:
        """Return how an end is held at one of the places where something is held sideways."""
        # what is held all along cannot turn
        alike = max(self.form.thickness, 1.5 * self.spacing)
        all_along = not self.angled and (np.abs(at - place) < alike).sum() > 1
        return "clamped" if self._keeps_angle(place) or all_along else "pinned"

    def _loose_kind(self, place: float) -> str:
        """Return how an end is held at which nothing is held sideways."""
        return "guided" if self._keeps_angle(place) else "free"


def bending_period(solid: Solid, form: Form, span: Span) -> float:
    """Return the period of a span's slowest bending in vacuo, s."""
    flat = len(form.axes) == 2 and solid.shape.beam is None  # plane strain
    young = solid.young / (1 - solid.poisson**2 if flat else 1.0)
    inverse = math.sqrt(12 * solid.density / young) / form.thickness * span.slowness
    square = inverse**2
    if solid.shape.beam is None or solid.shape.beam.theory == "timoshenko":
        shear = solid.young / (2 * (1 + solid.poisson))
        k = SHEARED.get(span.ends, SHEARED_ELSE)
        square += (span.length / k) ** 2 * solid.density / (SHEAR * shear)
    return 2 * math.pi * math.sqrt(square)


def wave_time(solid: Solid, form: Form) -> float:
    """Return how long a pressure wave takes through the smallest element, s."""
    nu = solid.poisson
    bulk = 1.0 if solid.shape.beam is not None else (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    return form.altitude * math.sqrt(solid.density / (solid.young * bulk))


def carried(form: Form, density: float, fluid: float) -> float:
    """Return about how much fluid moves with a solid across its thinnest side, as a part of its own mass.

    Of a strip of width b and thickness h in an unbounded fluid that is pi rho_f b^2/4 over rho b h; walls add to it.
    """
    return math.pi / 4 * fluid * float(form.lengths[1]) / (density * form.thickness)


def excess(solid: Solid, bend: Bend, dim: int, volumetric: str) -> float:
    """Return by which part linear elements bend too stiffly, to a factor of two; ``volumetric`` is as in a scene."""
    a, b = TOO_STIFF[volumetric]
    size = a + b * bend.ratio**2
    if volumetric == "full":
        bulk = BULK_3D if dim == 3 else BULK_2D if solid.shape.mesh is not None else 0.0
        size += bulk * 2 * solid.poisson / (1 - 2 * solid.poisson)
    return size / bend.across**2
