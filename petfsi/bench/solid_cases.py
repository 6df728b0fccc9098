"""The scenes of ``bench solids``: Cook's membrane, the elastic bar of Turek and Hron, and slender beams."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from mpi4py import MPI

from petfsi.geometry.meshes import box_mesh
from petfsi.ranks import on_root
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Box

#: Finite strain, plane strain, a dead shear of 6.25 on the right edge; the middle of that edge, (48, 52), moves by so
#: much in x and y, by the ratio of Poisson. Derived by tensor-product elements of order 3 to 5; +-0.0005 and +-0.005.
#: Material: W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2, E = 240.565.
COOK = {0.3: (-4.2875, 7.8927), 0.4999: (-3.595, 6.960)}
COOK_YOUNG, COOK_SHEAR = 240.565, 6.25

#: S. Turek, J. Hron, Proposal for numerical benchmarking of fluid-structure interaction (2006), CSM1 and CSM2: the
#: bar's end under gravity moves by so much in x and y, m; by Young's modulus, Pa.
CSM_STATIC = {"csm1": (1.4e6, (-7.187e-3, -66.10e-3)), "csm2": (5.6e6, (-0.4690e-3, -16.97e-3))}
#: CSM3, of the same bar as CSM1 from rest: half of the way of uy, m, and Hz. The published frequency, 1.0995, is not
#: that of the published motion (1.0929); other codes find 1.0936 to 1.0941.
CSM3_AMPLITUDE, CSM3_FREQUENCY = 65.160e-3, 1.0935
CSM3_YOUNG = 1.4e6
DENSITY, POISSON, GRAVITY = 1000.0, 0.4, -2.0
CENTRE, RADIUS, TIP, HALF = np.array([0.2, 0.2]), 0.05, 0.6, 0.01

#: Of an inextensible cantilever with a dead tip load, alpha = P L^2 / EI: deflection w/L and shortening u/L. Elliptic
#: integrals (K. E. Bisshopp, D. C. Drucker, Large deflection of cantilever beams, 1945).
ELASTICA = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}
#: Thickness over length: stretching and shear, which the elastica has not, weigh (h/L)^2.
SLENDER = 1e-3


#: The lowest angular frequencies of cantilevers over sqrt(EI / (rho A L^4)), by theory of the beam and thickness over
#: length: Timoshenko's with nu = 0.3 and kappa = 5/6, roots of the transfer matrix; Euler's and Bernoulli's,
#: (beta L)^2 with cos(beta L) cosh(beta L) = -1.
FREQUENCIES = {
    ("timoshenko", 0.1): (3.488355, 20.906915, 54.988380),
    ("euler-bernoulli", SLENDER): (3.516015268, 22.034491564, 61.697214409),
}


@dataclass(frozen=True)
class Statics:
    """A scene of one load, put on in steps, and where its probe ``tip`` ends up."""

    name: str
    scene: Scene
    exact: tuple[float, float]
    about: dict[str, Any] = field(default_factory=dict)


def cook(comm: MPI.Comm, folder: Path, n: int, poisson: float, elements: str, volumetric: str) -> Statics:
    """Return Cook's membrane of n x n quadrilaterals, two triangles each. Collective."""

    def bent(x: np.ndarray) -> np.ndarray:
        low, high = 44 * x[:, 0], 44 + 16 * x[:, 0]
        return np.column_stack((48 * x[:, 0], low + (high - low) * x[:, 1]))

    solid = {
        "shape": {"mesh": _mapped(comm, folder / f"cook{n}.msh", (n, n), bent)},
        "elements": elements,
        "volumetric": volumetric,
        "density": 1.0,
        "young": COOK_YOUNG,
        "poisson": poisson,
        "material": "neohookean",
        "supports": [{"where": "left", "fix": ["x", "y"]}],
        "loads": [{"where": "right", "traction": [0.0, f"{COOK_SHEAR}*t"]}],
    }
    scene = _scene(solid, (48.0, 52.0), "static", end=1.0, dt=0.25)
    about = {"elements": f"{elements} {volumetric}", "cells": n, "poisson": poisson}
    return Statics("cook", scene, COOK[poisson], about)


def csm(comm: MPI.Comm, folder: Path, case: str, thick: int, elements: str) -> Statics:
    """Return the bar under gravity, ``thick`` quadrilaterals high. Collective."""
    young, exact = CSM_STATIC[case]
    scene = _scene(_bar(comm, folder, thick, elements, young), (TIP, CENTRE[1]), "static", 1.0, 0.5, f"{GRAVITY}*t")
    return Statics(case, scene, exact, {"elements": elements, "cells": thick})


def csm3(comm: MPI.Comm, folder: Path, thick: int, elements: str, integrator: str, dt: float, end: float) -> Scene:
    """Return the bar let go from rest under gravity, explicit schemes in sub-steps. Collective."""
    solid = _bar(comm, folder, thick, elements, CSM3_YOUNG)
    explicit: dict[str, Any] = {"above_limit": "subcycle"} if integrator == "symplectic-euler" else {}
    return _scene(solid, (TIP, CENTRE[1]), integrator, end, dt, GRAVITY, **explicit)


def elastica(alpha: float, n: int) -> Statics:
    """Return a cantilever of unit length and n elements under a dead load at its tip."""
    deflection, shortening = ELASTICA[int(alpha)]
    # EI = 1
    solid = _beam(n) | {"loads": [{"at": [1.0, 0.0], "force": [0.0, f"{alpha}*t"]}]}
    scene = _scene(solid, (1.0, 0.0), "static", end=1.0, dt=0.25)
    return Statics("elastica", scene, (-shortening, deflection), {"elements": "timoshenko", "cells": n, "load": alpha})


def roll_up(n: int) -> Statics:
    """Return a cantilever of unit length and n elements that a moment at its tip bends into a full circle."""
    solid = _beam(n) | {"loads": [{"at": [1.0, 0.0], "moment": f"{2 * math.pi!r}*t"}]}
    scene = _scene(solid, (1.0, 0.0), "static", end=1.0, dt=0.1)
    return Statics("roll-up", scene, (-1.0, 0.0), {"elements": "timoshenko", "cells": n})


def cantilever(theory: str, thickness: float, n: int, dt: float) -> Scene:
    """Return a cantilever of unit length, mass and EI, at rest."""
    solid = _beam(n, theory, thickness) | {"poisson": 0.3}
    return _scene(solid, (1.0, 0.0), "newmark", end=1.0, dt=dt)


def _beam(n: int, theory: str = "timoshenko", thickness: float = SLENDER) -> dict[str, Any]:
    """Return a clamped beam of unit length, mass and EI."""
    beam = {"start": [0.0, 0.0], "end": [1.0, 0.0], "thickness": thickness, "elements": n, "theory": theory}
    return {
        "shape": {"beam": beam},
        "density": 1 / thickness,
        "young": 12 / thickness**3,
        "poisson": 0.0,
        "supports": [{"where": "start", "fix": ["x", "y", "angle"]}],
    }


def _bar(comm: MPI.Comm, folder: Path, thick: int, elements: str, young: float) -> dict[str, Any]:
    def on_the_circle(x: np.ndarray) -> np.ndarray:
        y = HALF * (2 * x[:, 1] - 1)
        root = CENTRE[0] + np.sqrt(RADIUS**2 - y**2)
        return np.column_stack((root + (TIP - root) * x[:, 0], CENTRE[1] + y))

    root = CENTRE[0] + RADIUS
    held = {"origin": [root - 0.01, CENTRE[1] - 2 * HALF], "size": [0.01 + 1e-9, 4 * HALF]}
    return {
        "shape": {"mesh": _mapped(comm, folder / f"bar{thick}.msh", (17 * thick, thick), on_the_circle)},
        "elements": elements,
        "density": DENSITY,
        "young": young,
        "poisson": POISSON,
        "material": "green",
        "supports": [{"where": {"box": held}, "fix": ["x", "y"]}],
    }


def _scene(
    solid: dict[str, Any], at: tuple[float, float], integrator: str, end: float, dt: float,
    gravity: str | float = 0.0, **time: Any,
) -> Scene:  # fmt: skip
    data = {
        "dim": 2,
        "gravity": [0.0, gravity],
        "time": {"end": end, "dt": dt, "integrator": integrator, **time},
        "solids": {"body": solid},
        "probes": {"tip": {"of": "body", "at": list(at), "quantity": "displacement"}},
        "output": {"accounts": False},
    }
    return scene_from_dict(data)


def _mapped(comm: MPI.Comm, path: Path, cells: tuple[int, int], onto: Any) -> str:
    """Write the triangles of the unit square, mapped; return the file's name. Collective."""

    def write() -> None:
        points, triangles = box_mesh(Box(origin=[0.0, 0.0], size=[1.0, 1.0], cells=list(cells)))
        flat = np.column_stack((onto(points), np.zeros(len(points))))
        meshio.write_points_cells(path, flat, [("triangle", triangles)], file_format="gmsh")

    on_root(comm, write)
    return str(path)
