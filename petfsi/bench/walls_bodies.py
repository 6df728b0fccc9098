"""Stiff bodies for ``petfsi bench walls``: the drag of one that stays, and how fast others fall in a channel."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

from petfsi.bench.case import MONOLITHIC, Case, simulation
from petfsi.bench.potential import added_mass_in_channel
from petfsi.bench.report import Report, Row
from petfsi.bench.walls_flows import made

#: Cells to the radius of the disk that stays; the box is so many radii long and wide.
DRAG_RADII, QUICK_DRAG_RADII, BOX_RADII = (8, 16, 32), (8, 16), 8
#: Its density over the fluid's, the cells that the stream crosses in a step, and the steps that the start is left.
HEAVY, DRAG_COURANT, SETTLED = 1e6, 0.5, 4
DRAG, DRAG_AT = 0.02, 16

#: Cells to the diameter of bodies that fall, and what part of the exact acceleration is wanted.
FALL_CELLS, QUICK_FALL_CELLS = {2: (8, 16, 32), 3: (8, 16)}, {2: (8, 16), 3: (8,)}
FALLEN = {8: 0.95, 16: 0.99, 32: 0.995}
#: The channel is 1 m wide and 4 m high, the body half as wide, twice as dense as the fluid, and falls for a while.
RADIUS, RATIO, GRAVITY = 0.25, 2.0, 1.0
HEIGHT, START = {2: 4.0, 3: 3.0}, {2: 3.0, 3: 2.0}
END, DT = {2: 2.4, 3: 2.0}, {2: 0.01, 3: 0.02}
#: Elements across the body.
ELEMENTS_PER_CELL, FEWEST = {2: 1.25, 3: 0.75}, {2: 8, 3: 12}
YOUNG = 1e8


def _ball(dim: int, centre: list[float], radius: float, elements: float, density: float) -> dict:
    across = 2 * max(2, round(elements / 2))
    shape = {"ball": {"centre": centre, "radius": radius, "cells": across}}
    return {"shape": shape, "density": density, "young": YOUNG, "poisson": 0.3}


# ---- drag ---------------------------------------------------------------------------------------------------


def drag(comm: MPI.Comm, cells: int, integrator: str = "bdf2") -> float:
    """Return the mean drag coefficient of a disk of ``cells`` to its radius while the stream crosses it. Collective.

    The stream enters and leaves a box evenly. A disk a million times as dense as the fluid hardly moves; the force on
    it is what its momentum gains in a second, from when the first steps have made the stream one that passes it. The
    flow is the same seen from behind, and without separation nothing ever changes: the exact drag is zero.
    """
    n, R = BOX_RADII * cells, 1.0 / BOX_RADII
    dt = DRAG_COURANT / n
    steps = round(2 * R / dt)
    side = {"left": {"inflow": {"speed": 1.0}}, "right": {"inflow": {"speed": -1.0}}}
    data = {
        "dim": 2,
        "time": {"end": 2 * steps * dt, "dt": dt, "integrator": integrator},
        "fluid": {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [n, n], "sides": side,
                  "initial": {"velocity": [1.0, 0.0]}},
        "solids": {"disk": _ball(2, [0.5, 0.5], R, 2.5 * cells, HEAVY)},
        "output": {"accounts": False},
    }  # fmt: skip
    with simulation(comm, made(comm, data), MONOLITHIC) as sim:
        assert sim.solid is not None
        for _ in range(SETTLED):
            sim.advance()
        first = sim.solid.stock().momentum[0]
        for _ in range(steps - SETTLED):
            sim.advance()
        gained = comm.allreduce(sim.solid.stock().momentum[0] - first)
    force = gained / ((steps - SETTLED) * dt)
    return float(force / (0.5 * 2 * R))


def resist(case: Case, report: Report) -> None:
    """Measure the drag over grids. Collective."""
    for cells in QUICK_DRAG_RADII if case.quick else DRAG_RADII:
        row: Row = {"part": "drag of a disk", "scheme": "bdf2", "at": f"R/dx {cells}", "value": drag(case.comm, cells)}
        report.rows.append(row)
        if cells >= DRAG_AT:
            report.demand(abs(row["value"]) <= DRAG, row, f"drag coefficient at most {DRAG:g}")


# ---- falling ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fall:
    """A disk or a ball let go in a channel closed at both ends, with ``cells`` to its diameter."""

    dim: int
    cells: int
    integrator: str = "bdf2"

    @property
    def exact(self) -> float:
        """The acceleration (m_s - m_f) g / (m_s + m_a) of potential flow, m/s^2."""
        return (RATIO - 1) * GRAVITY / (RATIO + added_mass_in_channel(self.dim, RADIUS))

    def scene(self) -> dict:
        """Return the scene, as a dictionary."""
        dim, across = self.dim, 2 * self.cells
        elements = max(FEWEST[dim], ELEMENTS_PER_CELL[dim] * self.cells)
        size, centre = [1.0] * dim, [0.5] * dim
        size[1], centre[1] = HEIGHT[dim], START[dim]
        return {
            "dim": dim,
            "gravity": [0.0, -GRAVITY, 0.0][:dim],
            "time": {"end": END[dim], "dt": DT[dim] * 16 / self.cells, "integrator": self.integrator},
            "fluid": {"density": 1.0, "origin": [0.0] * dim, "size": size, "cells": [round(across * s) for s in size]},
            "solids": {"body": _ball(dim, centre, RADIUS, elements, RATIO)},
            "probes": {"body": {"of": "body", "at": centre, "quantity": "velocity"}},
        }

    def measure(self, comm: MPI.Comm) -> tuple[float, float]:
        """Return the mean acceleration over the exact one, and the energy residual over the kinetic energy.

        Collective.
        """
        with simulation(comm, made(comm, self.scene()), MONOLITHIC) as sim:
            while not sim.finished:
                sim.advance()
            seen = -sim.probe()[1] / sim.time
            energy = sim.accounts.values["energy_residual"] / sim.accounts.values["kinetic"]
        return seen / self.exact, energy


def fall(case: Case, report: Report, dim: int) -> None:
    """Measure bodies that fall over grids. Collective."""
    name = {2: "falling disk", 3: "falling ball"}[dim]
    for cells in (QUICK_FALL_CELLS if case.quick else FALL_CELLS)[dim]:
        seen, energy = Fall(dim, cells).measure(case.comm)
        row: Row = {"part": name, "scheme": "bdf2", "at": f"D/dx {cells}", "value": seen, "energy": energy}
        report.rows.append(row)
        report.demand(abs(seen - 1) <= 1 - FALLEN[cells], row, f"at least {FALLEN[cells]:g} of what is exact")
