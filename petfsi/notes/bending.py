"""How slender solids bend: between which supports, how slowly, and how much too stiffly their elements do.

Beams of Euler and Bernoulli swing with  omega = c sqrt(E I / (rho A L^4)),  with shear (Dunkerley)
1/omega^2 = 1/omega_bending^2 + 1/omega_shear^2;  linear elements bend  1 + (a + b r^2)/n^2  times as stiffly as that,
n across the thickness and r times as long as thick, and tetrahedra by what a stiff bulk adds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from petfsi.notes.forms import SLENDER, Form
from petfsi.scene.solids import Solid

#: c of the slowest bending that is no rigid motion, by how the ends are held, in the order of the alphabet.
SLOWEST = {
    ("clamped", "free"): 3.516,
    ("clamped", "clamped"): 22.373,
    ("clamped", "pinned"): 15.418,
    ("free", "free"): 22.373,
    ("free", "pinned"): 15.418,
    ("pinned", "pinned"): math.pi**2,
}
#: Of a rectangular section, for shear.
SHEAR = 5 / 6
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
    """A stretch of a solid between supports or ends that can bend: its length, m, and how its ends are held."""

    length: float
    ends: tuple[str, str]

    @property
    def slowness(self) -> float:
        """What its period is in proportion to, m^2."""
        return self.length**2 / SLOWEST[self.ends]


def widest_span(form: Form, fixed: np.ndarray) -> Span | None:
    """Return the span of a solid that bends most slowly; None if there is none as slender as a beam.

    Parameters
    ----------
    form : Form
    fixed : ndarray of bool, shape (n, width)
        Which components of its points are held.
    """
    if not form.slender:
        return None
    dim = len(form.axes)
    s = form.points @ form.axes[-1]
    reach = s.min(), s.max()
    # as bodies of files are no boxes quite
    length = float(min(reach[1] - reach[0], form.lengths[-1] * 1.1))
    sideways = (fixed[:, :dim] & (np.abs(form.axes[0]) > _ALONG)).any(axis=1)
    at = np.sort(s[sideways])
    if not len(at):
        return Span(length, ("free", "free"))
    at = at[np.concatenate(([True], np.diff(at) > _SAME_PLACE * length))]
    ends = [*([(reach[0], "free")] if at[0] - reach[0] > _SAME_PLACE * length else [])]
    ends += [(float(place), _kind(form, fixed, s, at, n)) for n, place in enumerate(at)]
    ends += [(reach[1], "free")] if reach[1] - at[-1] > _SAME_PLACE * length else []
    spans = [
        Span(float(b - a), (min(one, other), max(one, other)))
        for (a, one), (b, other) in zip(ends[:-1], ends[1:], strict=True)
        if b - a >= SLENDER * form.thickness
    ]
    return max(spans, key=lambda span: span.slowness, default=None)


def _kind(form: Form, fixed: np.ndarray, s: np.ndarray, at: np.ndarray, n: int) -> str:
    """Return whether what is held at a place may turn there."""
    dim, thickness = len(form.axes), form.thickness
    here = np.abs(s - at[n]) <= _SAME_PLACE * form.lengths[-1]
    if fixed.shape[1] > dim:
        turns = not fixed[here, dim:].any()
    else:
        lengthwise = here & (fixed[:, :dim] & (np.abs(form.axes[-1]) > _ALONG)).any(axis=1)
        turns = bool(np.ptp(form.points[lengthwise] @ form.axes[0]) < 0.5 * thickness) if lengthwise.any() else True
    if turns and fixed.shape[1] == dim:
        near = np.abs(at - at[n]) < thickness
        turns = int(near.sum()) < 2  # what is held all along cannot turn
    return "pinned" if turns else "clamped"


def bending_period(solid: Solid, form: Form, span: Span) -> float:
    """Return the period of a span's slowest bending in vacuo, s."""
    flat = len(form.axes) == 2 and solid.shape.beam is None  # plane strain
    young = solid.young / (1 - solid.poisson**2 if flat else 1.0)
    inverse = math.sqrt(12 * solid.density / young) / form.thickness * span.slowness
    square = inverse**2
    if solid.shape.beam is None or solid.shape.beam.theory == "timoshenko":
        shear = solid.young / (2 * (1 + solid.poisson))
        quarter = math.pi / 2 if span.ends == ("clamped", "free") else math.pi
        square += (span.length / quarter) ** 2 * solid.density / (SHEAR * shear)
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


def excess(solid: Solid, form: Form, volumetric: str) -> float:
    """Return by which part linear elements bend too stiffly, to a factor of two; ``volumetric`` is as in a scene."""
    a, b = TOO_STIFF[volumetric]
    size = a + b * float(form.spacing[-1] / form.spacing[0]) ** 2
    if volumetric == "full":
        bulk = BULK_3D if len(form.axes) == 3 else BULK_2D if solid.shape.mesh is not None else 0.0
        size += bulk * 2 * solid.poisson / (1 - 2 * solid.poisson)
    return size / form.across**2
