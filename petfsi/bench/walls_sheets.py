"""Sheets thinner than a cell for ``petfsi bench walls``: one that shields water at rest, and a beam that swings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import MONOLITHIC, Case, history, simulation
from petfsi.bench.potential import beam_between_layers
from petfsi.bench.report import Report, Row
from petfsi.bench.walls_flows import made
from petfsi.fields.mac.fluid import MacFluid

#: The sheet's middle, m (of a cell at 32 cells, upon a plane of the grid at 64), its thickness, and a thick wall's.
SHEET, THIN, THICK = 0.515625, 0.002, 0.1
SHEET_CELLS, QUICK_SHEET_CELLS, SHEET_END = (32, 64), (32,), 3.0
#: What may be found below after that, of a largest velocity of about 2 m/s and of smoke of 1; and how much more of
#: the kinetic energy may be lost than above a thick wall.
LEAKED, LOST_MORE = 1e-9, 0.01

BEAM_CELLS, QUICK_BEAM_CELLS = (16, 32, 64), (16, 32)
#: Where the beam lies above a plane of the grid, in cells: inside one, and upon the plane for comparison.
PLACES = (0.4, 0.0)
THICKNESS, YOUNG, BEAM_DENSITY, FLUID_DENSITY, ELEMENTS = 0.002, 2e9, 2000.0, 1000.0, 128
SPEED, PER_PERIOD, PERIODS, SETTLED = 1e-7, 50, 2, 6
BEAM_ORDER, BEAM_DAMPING = 1.7, 1e-4
#: The beam's surface is made of its elements' chords: that makes its frequency 5e-5 too high.
#: A frequency's error below this says nothing of orders.
READABLE = 3e-4


# ---- a sheet that shields -----------------------------------------------------------------------------------


def shear(comm: MPI.Comm, cells: int, thickness: float) -> dict[str, float]:
    """Return what leaked below a sheet under which water rests while it turns above, after ``SHEET_END``. Collective.

    The largest velocity and smoke in cells wholly below the sheet, and the part of the kinetic energy that was lost.
    """
    thin = thickness == THIN
    height = 1 - SHEET
    up = f"pi*(y-{SHEET})/{height}"
    # a thick wall's first row of faces has its centres in the wall, and moves
    above = f"y>{SHEET if thin else SHEET - 0.6 / cells}"
    top = SHEET + THIN / 2
    data = {
        "dim": 2,
        "time": {"end": SHEET_END, "dt": 0.5 / cells, "integrator": "bdf2"},
        "fluid": {
            "density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [cells, cells],
            "smoke": {"initial": f"where({above},1,0)"},
            "initial": {"velocity": [f"where({above},pi/{height}*sin(pi*x)*cos({up}),0)/3",
                                     f"-pi*cos(pi*x)*where({above},sin({up}),0)/3"]},
        },
        "obstacles": {"sheet": {"shape": {"box": {"origin": [-1.0, top - thickness], "size": [3.0, thickness]}}}},
    }  # fmt: skip
    with simulation(comm, made(comm, data), MONOLITHIC) as sim:
        before = sim.accounts.values["kinetic"]
        while not sim.finished:
            sim.advance()
        fluid = sim.fluid
        assert isinstance(fluid, MacFluid) and fluid.smoke is not None
        below = int((top - thickness) * cells) / cells
        velocity = max(_largest(fluid, v, axis, below) for axis, v in enumerate(fluid.velocity))
        smoke = _largest(fluid, fluid.smoke, None, below)
        lost = 1 - sim.accounts.values["kinetic"] / before
    return {"velocity": velocity, "smoke": smoke, "energy": -lost}


def _largest(fluid: MacFluid, array: np.ndarray, axis: int | None, height: float) -> float:
    """Return the largest modulus below a height. Collective."""
    part = fluid.grid.owned(axis)
    y = fluid.grid.lines(axis)[1][part[1]]
    most = float(np.abs(array[part][:, y < height]).max(initial=0.0))
    return fluid.comm.allreduce(most, MPI.MAX)


def shield(case: Case, report: Report) -> None:
    """Measure the sheet beside the thick wall. Collective."""
    for cells in QUICK_SHEET_CELLS if case.quick else SHEET_CELLS:
        pair: list[Row] = [
            {"part": "below a sheet", "scheme": name, "at": f"{cells} cells"} | shear(case.comm, cells, thickness)
            for name, thickness in (("thick", THICK), ("thin", THIN))
        ]
        thick, thin = pair
        report.rows += pair
        report.demand(thin["velocity"] <= LEAKED, thin, f"velocity below at most {LEAKED:g} m/s")
        report.demand(thin["smoke"] <= LEAKED, thin, f"smoke below at most {LEAKED:g}")
        more = thick["energy"] - thin["energy"]
        report.demand(more <= LOST_MORE, thin, f"no more than {LOST_MORE:.0%} of kinetic energy lost beyond {more:.3f}")


# ---- a beam in a cell ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Strip:
    """A beam across a box of water of 1 m by 1 m, open above, on a grid of ``cells``; its ends slide up and down.

    (In a closed box the water on both sides would keep the beam's volume, which keeps itself: one condition too many.)
    It swings as cos(pi x), the water below and above with it: an exact mode, see ``potential.beam_between_layers``.
    """

    cells: int
    place: float
    integrator: str = "bdf2"

    @property
    def height(self) -> float:
        """Of the beam's axis, m."""
        return 0.5 + self.place / self.cells

    @property
    def depths(self) -> tuple[float, float]:
        """Of the water below and above, m."""
        return self.height - THICKNESS / 2, 1 - self.height - THICKNESS / 2

    @property
    def omega(self) -> float:
        """The exact angular frequency, rad/s."""
        inertia = THICKNESS**3 / 12
        mass, turning = BEAM_DENSITY * THICKNESS, BEAM_DENSITY * inertia
        return beam_between_layers(np.pi, YOUNG * inertia, mass, turning, FLUID_DENSITY, *self.depths)

    def scene(self, dt: float) -> dict:
        """Return the scene that starts in the mode, as a dictionary."""
        low, high = self.depths
        up, down = "pi*y", "pi*(1-y)"
        below, above = (f"{SPEED / float(scale)!r}" for scale in (np.sinh(np.pi * low), np.cosh(np.pi * high)))
        split = f"y<{self.height!r}"
        held = [{"where": end, "fix": ["x", "angle"]} for end in ("start", "end")]
        return {
            "dim": 2,
            "time": {"end": 1e4 * dt, "dt": dt, "integrator": self.integrator},
            "fluid": {
                "density": FLUID_DENSITY, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [self.cells] * 2,
                "sides": {"top": "open"},
                "initial": {"velocity": [
                    f"sin(pi*x)*where({split},-{below}*cosh({up}),{above}*sinh({down}))",
                    f"cos(pi*x)*where({split},{below}*sinh({up}),{above}*cosh({down}))",
                ]},
            },
            "solids": {"beam": {
                "shape": {"beam": {"start": [0.0, self.height], "end": [1.0, self.height], "thickness": THICKNESS,
                                   "elements": ELEMENTS, "theory": "euler-bernoulli"}},
                "density": BEAM_DENSITY, "young": YOUNG, "poisson": 0.3, "supports": held,
                "initial": {"velocity": ["0", f"{SPEED}*cos(pi*x)", f"-{SPEED}*pi*sin(pi*x)"]},
            }},
            "probes": {"end": {"of": "beam", "at": [0.0, self.height], "quantity": "displacement"}},
            "output": {"accounts": False},
        }  # fmt: skip

    def measure(self, comm: MPI.Comm) -> tuple[float, float]:
        """Return the error of the frequency and the damping over it, both without what the step makes of a mode.

        Collective.
        """
        dt = 2 * np.pi / self.omega / PER_PERIOD
        y = history(comm, made(comm, self.scene(dt)), MONOLITHIC, PERIODS * PER_PERIOD, "end.y")
        t = dt * np.arange(len(y))
        seen, damping = theory.fit_damped_sinusoid(t[SETTLED:], y[SETTLED:], self.omega, 0.0)
        mode = theory.undo(self.integrator, seen, dt)
        return mode / self.omega - 1, (damping - theory.observed(self.integrator, mode, dt)[1]) / self.omega


def swing(case: Case, report: Report) -> None:
    """Measure the beam over grids, inside a cell and upon a plane of the grid. Collective."""
    meshes = QUICK_BEAM_CELLS if case.quick else BEAM_CELLS
    for place in PLACES:
        rows: list[Row] = []
        for cells in meshes:
            error, damping = Strip(cells, place).measure(case.comm)
            row: Row = {"part": "beam", "scheme": f"at {place:g} of a cell", "at": f"{cells} cells"}
            rows.append(row | {"value": error, "damping": damping})
        report.rows += rows
        seen = theory.orders([row["value"] for row in rows], [1 / n for n in meshes])
        report.notes.append(f"beam at {place:g} of a cell: orders of the frequency {np.round(seen, 2)}")
        last = rows[-1]
        if abs(last["value"]) > READABLE:
            report.demand(seen[-1] >= BEAM_ORDER, last, f"order of the frequency at least {BEAM_ORDER:g}")
        for row in rows:
            report.demand(abs(row["damping"]) <= BEAM_DAMPING, row, f"damping over omega at most {BEAM_DAMPING:g}")
