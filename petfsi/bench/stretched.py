"""The solve of one step in cells that are longer along some axes: iterations and seconds over their ratio.

Moving fluid in a box with an open side, as many cells along each axis; alone, and around a plate that is turned against
the grid, as long and thin as cells are: nearly held by its mass, and as dense as the fluid. Each case is solved from
nothing to a relative residual of 1e-8 by the default and with other preconditioners of the pressure under it; the plate
as dense as the fluid is harder the longer it is, in any cells, as it has more water to push.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from petfsi.bench.case import DIRECT, MONOLITHIC, Case
from petfsi.bench.report import Report, Row
from petfsi.bench.solver import solves
from petfsi.scene.schema import Scene

FLUID_DENSITY, SHORTEST, STEP = 1000.0, 1 / 32, 0.01
#: Density of the plate over that of the fluid, and the most iterations of the default; None is no plate.
PLATES: dict[float | None, int] = {None: 14, 1e3: 14, 1.0: 50}
RATIOS, QUICK_RATIOS = (1, 5, 20, 80, 400), (1, 20)
CELLS, QUICK_CELLS = {2: 96, 3: 32}, {2: 32, 3: 12}
PRESSURE = "-fsi_fieldsplit_pressure_"
SOLVERS = {
    "default": MONOLITHIC,
    "hypre": f"{MONOLITHIC} {PRESSURE}pc_type hypre",
    "gamg": f"{MONOLITHIC} {PRESSURE}pc_type gamg",
    "direct": DIRECT,
}
#: Solvers compared in 3D, where the direct one takes minutes.
IN_SPACE = ("default", "hypre", "gamg")
#: Iterations of any other solver than the default.
MOST_OTHERS = 150
TOLERANCE, REPEATS = 1e-8, 3


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"One solve to {TOLERANCE:g} in cells longer along some axes, {case.comm.size} ranks")
    for dim, n in (QUICK_CELLS if case.quick else CELLS).items():
        for ratios in _ratios(dim, case.quick):
            for density, most in PLATES.items():
                made = scene((n,) * dim, ratios, {"right": "open"}, density)
                names = list(SOLVERS) if dim == 2 else IN_SPACE
                found = solves(case, [(made, SOLVERS[name]) for name in names], REPEATS)
                row: Row = {"cells": f"{n}^{dim}", "ratios": " ".join(map(str, ratios)), "plate": density or "none"}
                for name, one in zip(names, found, strict=True):
                    row |= {f"{name} iterations": one["iterations"], f"{name} seconds": one["seconds"]}
                row["residual"] = found[0]["residual"]
                report.rows.append(row)
                report.demand(0 <= found[0]["iterations"] <= most, row, f"at most {most} iterations")
                report.demand(row["residual"] <= TOLERANCE, row, f"a residual of {TOLERANCE:g}")
                for name in names[1:]:
                    count = row[f"{name} iterations"]
                    report.demand(0 <= count <= MOST_OTHERS, row, f"{name}: at most {MOST_OTHERS} iterations")
    return report


def _ratios(dim: int, quick: bool) -> list[tuple[int, ...]]:
    """Return the lengths of cells over the shortest, each axis the long one or, in 3D, the short one."""
    found = []
    for ratio in QUICK_RATIOS if quick else RATIOS:
        for axis in range(dim if ratio > 1 else 1):
            found.append(tuple(ratio if a == axis else 1 for a in range(dim)))
            if dim == 3 and ratio > 1:
                found.append(tuple(1 if a == axis else ratio for a in range(dim)))
    return found


def scene(
    cells: Sequence[int],
    ratios: Sequence[float],
    sides: dict[str, str],
    density: float | None = None,
    stiffness: float = 1e4,
) -> Scene:
    """Return a box of moving fluid, perhaps around a plate.

    Parameters
    ----------
    cells : sequence of int
        Per axis.
    ratios : sequence of float
        Length of cells per axis over ``SHORTEST``.
    sides : dict
        Those that are no slip walls.
    density : float, optional
        Of the plate over that of the fluid.
    stiffness : float
        dt^2 E / (rho_s h^2) of the plate, h the shortest edge of a cell.
    """
    dim = len(cells)
    edges = np.array(ratios) * SHORTEST
    size, speed = edges * np.array(cells), 0.1 * edges / STEP
    waves = [[f"{float(v)!r}*sin({3 + a + b}*{x}/{float(size[b])!r} + {a})" for b, x in enumerate("xyz"[:dim])]
             for a, v in enumerate(speed)]  # fmt: skip
    walls = dict.fromkeys(("left", "right", "bottom", "top", "back", "front")[: 2 * dim], "slip")
    fluid = {"origin": [0.0] * dim, "size": size.tolist(), "cells": list(cells), "density": FLUID_DENSITY}
    fluid |= {"sides": walls | sides, "initial": {"velocity": [" + ".join(terms) for terms in waves]}}
    data = {"dim": dim, "time": {"end": 10 * STEP, "dt": STEP, "integrator": "bdf2"}, "fluid": fluid}
    data["coupling"] = {"transfer": "cutcell"}
    if density is not None:
        data["solids"] = {"plate": _plate(0.47 * size, 0.3 * size, density * FLUID_DENSITY, stiffness)}
    return Scene.model_validate(data)


def _plate(middle: np.ndarray, extent: np.ndarray, density: float, stiffness: float) -> dict:
    """Return a plate that leans by what cells and plate see as about 0.3."""
    dim, lean = len(middle), 0.3 * float(min(extent[0] / extent[1], extent[1] / extent[0]))
    c, s = float(np.cos(lean) - 1), float(np.sin(lean))
    x, y = (f"({axis}-{float(m)!r})" for axis, m in zip("xy", middle, strict=False))
    box = {"origin": (middle - extent / 2).tolist(), "size": extent.tolist(), "cells": [8] + [4] * (dim - 1)}
    return {
        "shape": {"box": box},
        "density": density,
        "young": stiffness * density * SHORTEST**2 / STEP**2,
        "poisson": 0.3,
        "initial": {"displacement": [f"{c!r}*{x} - {s!r}*{y}", f"{s!r}*{x} + {c!r}*{y}", "0.0"][:dim]},
    }
