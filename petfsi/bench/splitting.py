"""How time splitting grows or decays on an elastic layer under water, against linear theory.

With M, C, K the solid's matrices and M_a the added mass that the fluid puts on its wet nodes, a split step (the solid
under the old pressure, then the fluid with the solid's new velocity) is, for small motions, the recurrence

    (M + h C + h^2 K/2) u1 = (M - h^2 K/2) u0 - h K d0 - M_a (u0 - u_1),     d1 = d0 + h/2 (u0 + u1).

Three studies:

- ``mode``: a layer one element thick, which has one mode: m_s = rho_s L_s / 3, k = M / L_s, m_a = rho_f L_f. Its mesh
  is the mirror image of itself, so that both nodes of its top move alike (a box's diagonals are not, and its two
  nodes have different masses).
- ``layer``: 16 elements through the layer, against the matrices of 16 linear elements in one dimension with M_a on
  the top alone. Steps in which an elastic wave crosses several elements: below that the top's own mass counts,
  which is not the same for triangles.
- ``iterated``: the same splitting iterated within the step, which contracts by m_a / (m + h c + h^2 k/2).

Each growth is also compared with the recurrence made of the program's own matrices, M_a = h J L^-1 D1 H. Theory's
m_a is larger than the program's by half a cell of water, which the ray transfer leaves out of the pressure.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import meshio
import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from petfsi import build
from petfsi.bench import theory
from petfsi.bench.case import ITERATED, MONOLITHIC, SPLIT, Case, dense, history, job, simulation
from petfsi.bench.report import Report, Row
from petfsi.couplings.base import Coupling
from petfsi.errors import SolveError
from petfsi.fields.base import Field
from petfsi.fields.mac.fluid import MacFluid
from petfsi.fields.solid import SimplexSolid
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

SOLID_HEIGHT, FLUID_HEIGHT, FLUID_DENSITY, POISSON = 0.5, 1.5, 1000.0, 0.3
CELLS = 64
DT = 0.01
SPEED = 1e-9  # m/s: of the fastest part, at every step
BOUND = 0.03
OWN_BOUND = 1e-3  # against the program's own matrices
SAME = 1e-7  # iterated against monolithic

MASS_RATIOS = (0.5, 0.9, 1.5, 3.0)  # m_a / m_s
STIFFNESSES = (0.01, 4.0)  # h^2 k / m_s: soft, stiff
#: a0 h and a1 / h.
DAMPINGS = {"none": (0.0, 0.0), "mass": (0.5, 0.0), "stiffness": (0.0, 0.5)}
#: Reach of the top's motion within a step, sqrt(M / rho_s / 2) h, in elements; and m_a over the layer's mass in reach.
REACHES, LAYER_RATIOS = (4.0, 8.0), (0.7, 1.5, 3.0)
ELEMENTS = 16
CONTRACTIONS = (0.5, 0.8, 1.25, 3.0)


@dataclass(frozen=True)
class Layer:
    """A layer, its damping, and the step; ``elements`` through its height, one for the mirrored mesh."""

    density: float
    modulus: float
    mass_damping: float = 0.0
    stiffness_damping: float = 0.0
    elements: int = 1
    cells: int = CELLS

    @classmethod
    def one_mode(cls, mass_ratio: float, stiffness: float, damping: tuple[float, float], cells: int = CELLS) -> Layer:
        """Return the layer of given m_a / m_s, h^2 k / m_s and (a0 h, a1 / h)."""
        mass = FLUID_DENSITY * FLUID_HEIGHT / mass_ratio
        density, modulus = 3 * mass / SOLID_HEIGHT, stiffness * mass / DT**2 * SOLID_HEIGHT
        return cls(density, modulus, damping[0] / DT, damping[1] * DT, cells=cells)

    @property
    def added_mass(self) -> float:
        """m_a = rho_f L_f, kg/m^2."""
        return FLUID_DENSITY * FLUID_HEIGHT

    @property
    def mass(self) -> float:
        """m_s = rho_s L_s / 3, kg/m^2."""
        return self.density * SOLID_HEIGHT / 3

    @property
    def stiffness(self) -> float:
        """The mode's stiffness k = M / L_s, Pa/m."""
        return self.modulus / SOLID_HEIGHT

    @property
    def damping(self) -> tuple[float, float]:
        """a0 and a1, 1/s and s."""
        return self.mass_damping, self.stiffness_damping

    def growth(self) -> float:
        """Return the growth per step that one-dimensional theory predicts."""
        if self.elements == 1:
            return theory.split_growth(self.mass, self.stiffness, self.added_mass, DT, *self.damping)
        M, K = theory.chain(self.elements, self.density, self.modulus, SOLID_HEIGHT)
        added = np.zeros_like(M)
        added[-1, -1] = self.added_mass
        return theory.split_growth(M, K, added, DT, *self.damping)

    def scene(self, comm: MPI.Comm, folder: Path) -> Scene:
        """Return the layer under a column one cell wide. Collective; the mirrored mesh is a file in ``folder``."""
        height = SOLID_HEIGHT + FLUID_HEIGHT
        width = height / self.cells
        young = self.modulus * (1 + POISSON) * (1 - 2 * POISSON) / (1 - POISSON)
        shape: dict[str, Any] = {
            "box": {"origin": [0.0, 0.0], "size": [width, SOLID_HEIGHT], "cells": [1, self.elements]}
        }
        if self.elements == 1:
            shape = {"mesh": str(_mirrored_mesh(comm, folder, width))}
        sets = {
            "gravity": [0.0, 0.0],
            "time.dt": DT,
            "time.end": 1e4 * DT,
            "fluid.density": FLUID_DENSITY,
            "fluid.size": [width, height],
            "fluid.cells": [1, self.cells],
            "coupling.transfer": "ray",
            "time.integrator": "newmark",
            "time.energy_limit": -1,  # it is to grow
            "fluid.initial.velocity": [0.0, SPEED],
            "solids.layer.shape": shape,
            "solids.layer.density": self.density,
            "solids.layer.young": young,
            "solids.layer.poisson": POISSON,
            "solids.layer.damping": {"mass": self.mass_damping, "stiffness": self.stiffness_damping},
            "solids.layer.initial.velocity": ["0.0", f"{SPEED / SOLID_HEIGHT!r}*y"],
            "probes.top": {"of": "layer", "at": [0.5 * width, SOLID_HEIGHT], "quantity": "velocity"},
        }
        return job(comm, "column", sets)


def _mirrored_mesh(comm: MPI.Comm, folder: Path, width: float) -> Path:
    """Write three triangles between two nodes at the top and three at the foot. Collective."""
    path = folder / "layer.msh"
    if comm.rank == 0:
        points = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * [width, SOLID_HEIGHT]
        cells = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4]])
        flat = np.column_stack((points, np.zeros(len(points))))
        meshio.write_points_cells(path, flat, [("triangle", cells)], file_format="gmsh")
    comm.Barrier()
    return path


# ---- measuring ----------------------------------------------------------------------------------------------


def measure_growth(comm: MPI.Comm, scene: Scene, steps: int, order: int) -> float:
    """Return the growth per step of a scene's small motions under time splitting. Collective.

    The state is scaled back after every step, so that it stays linear however long it grows; the recurrence of
    ``order`` terms is fitted to the last steps.
    """
    values, logs = [], []
    scale = 0.0
    with simulation(comm, scene, SPLIT) as sim:
        wanted = sim.probe_columns().index("top.y")
        for _ in range(steps):
            sim.advance()
            values.append(sim.probe()[wanted])
            logs.append(scale)
            scale -= np.log(_slow_down(sim))
    window = slice(max(0, steps - 4 * order), None)
    return theory.prony_growth(np.array(values)[window], np.array(logs)[window], order)


def _slow_down(sim: Simulation) -> float:
    """Scale the state so that the solid moves at ``SPEED``; return the factor. Collective."""
    solid, fluid = sim.solid, sim.fluid
    assert isinstance(solid, SimplexSolid) and isinstance(fluid, MacFluid)
    factor = SPEED / sim.comm.allreduce(float(np.abs(solid.velocity).max(initial=0.0)), MPI.MAX)
    for array in (solid.displacement, solid.velocity, fluid.pressure, *fluid.velocity):
        array *= factor
    return factor


def growth_of_own_matrices(scene: Scene) -> float:
    """Return the growth per step that the program's own M, K, J, L and D1 H predict. Not collective."""
    fields = build.build_fields(MPI.COMM_SELF, scene)
    solid, fluid = fields
    (coupling,) = build.build_couplings(scene, fields)
    body = next(iter(scene.solids.values()))
    coupling.couple(0.0, DT)
    blocks = []
    parts: list[Field | Coupling] = [*fields, coupling]
    for h in (2 * DT, DT):
        for part in parts:
            part.assemble(0.0, h)
        blocks.append(dense(solid.block))
    free = np.count_nonzero(blocks[0], axis=1) > 1  # rows of held unknowns have a diagonal alone
    A2, A1 = (A[np.ix_(free, free)] for A in blocks)
    # A(h) = (1/h + a0) M + (a1 + h/2) K at two steps
    coefficients = np.array([[1 / h + body.damping.mass, body.damping.stiffness + h / 2] for h in (2 * DT, DT)])
    inverse = np.linalg.inv(coefficients)
    M, K = (row[0] * A2 + row[1] * A1 for row in inverse)
    pressure = np.linalg.solve(dense(fluid.block), dense(coupling.blocks["pressure", "solid"]))
    added = -DT * dense(coupling.blocks["solid", "pressure"]) @ pressure
    return theory.split_growth(M, K, added[np.ix_(free, free)], DT, body.damping.mass, body.damping.stiffness)


# ---- the studies --------------------------------------------------------------------------------------------


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report(f"Growth per step of time splitting, h = {DT:g} s; bounds: {BOUND:.0%} and {OWN_BOUND:g}")
    with TemporaryDirectory() as own:
        folder = Path(case.comm.bcast(own))
        _one_mode(case, report, folder)
        _through_the_layer(case, report, folder)
        _iterated(case, report, folder)
    report.figure = _picture(report)
    return report


def _compare(comm: MPI.Comm, report: Report, layer: Layer, scene: Scene, row: Row, steps: int, order: int) -> None:
    measured, predicted = measure_growth(comm, scene, steps, order), layer.growth()
    own = growth_of_own_matrices(scene)
    row |= {
        "growth": measured,
        "theory": predicted,
        "error": measured / predicted - 1,
        "own matrices": own,
        "own error": measured / own - 1,
    }
    report.rows.append(row)
    report.demand(abs(row["error"]) < BOUND, row, f"within {BOUND:.0%} of theory")
    report.demand(abs(row["own error"]) < OWN_BOUND, row, f"within {OWN_BOUND:g} of the program's own matrices")


def _one_mode(case: Case, report: Report, folder: Path) -> None:
    for damping, factors in DAMPINGS.items():
        for stiffness in STIFFNESSES:
            for ratio in MASS_RATIOS:
                layer = Layer.one_mode(ratio, stiffness, factors)
                row: Row = {"study": "mode", "damping": damping, "m_a/m": ratio, "h2k/m": stiffness, "reach": ""}
                _compare(case.comm, report, layer, layer.scene(case.comm, folder), row, steps=12, order=3)


def _through_the_layer(case: Case, report: Report, folder: Path) -> None:
    element = SOLID_HEIGHT / ELEMENTS
    for damping, factors in DAMPINGS.items():
        if case.quick and damping != "none":
            continue
        for reach in REACHES:
            for ratio in LAYER_RATIOS:
                density = FLUID_DENSITY * FLUID_HEIGHT / (ratio * reach * element)
                modulus = 2 * density * (reach * element / DT) ** 2
                layer = Layer(density, modulus, factors[0] / DT, factors[1] * DT, ELEMENTS)
                row: Row = {"study": "layer", "damping": damping, "m_a/m": ratio, "reach": reach}
                _compare(case.comm, report, layer, layer.scene(case.comm, folder), row, steps=200, order=6)


def _iterated(case: Case, report: Report, folder: Path) -> None:
    """Compare iterated splitting with the monolithic solve where it contracts, and see it fail where it does not."""
    steps = 10 if case.quick else 40
    for wanted in CONTRACTIONS:
        stiffness = 0.5
        layer = Layer.one_mode(wanted * (1 + stiffness / 2), stiffness, (0.0, 0.0))
        factor = theory.contraction(layer.mass, layer.stiffness, layer.added_mass, DT, *layer.damping)
        scene = layer.scene(case.comm, folder)
        ratio = layer.added_mass / layer.mass
        row: Row = {"study": "iterated", "damping": "none", "m_a/m": ratio, "h2k/m": stiffness, "contraction": factor}
        reference = history(case.comm, scene, MONOLITHIC, steps)
        try:
            y = history(case.comm, scene, ITERATED, steps)
            row |= {"outcome": "converged", "difference": float(np.abs(y - reference).max() / np.abs(reference).max())}
            report.demand(factor < 1 and row["difference"] < SAME, row, f"the monolithic history within {SAME:g}")
        except SolveError as error:
            reason = next((word for word in str(error).split() if word.startswith("DIVERGED")), "blown up")
            row |= {"outcome": reason}
            report.demand(
                factor > 1 and reason != "blown up", row, "iterations that contract converge, others are told"
            )
        report.rows.append(row)


# ---- the picture --------------------------------------------------------------------------------------------


def _picture(report: Report) -> Figure:
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for study, marker in (("mode", "o"), ("layer", "s")):
        rows = [row for row in report.rows if row["study"] == study]
        left.plot([r["theory"] for r in rows], [r["growth"] for r in rows], marker, mfc="none", label=study)
    ends = np.array([0.4, 5.0])
    left.plot(ends, ends, "k-", lw=0.8)
    left.set(xlabel="growth per step, theory", ylabel="growth per step, measured", title="time splitting")
    left.legend()

    ratios, stiffnesses = np.geomspace(0.3, 30, 60), np.geomspace(1e-3, 100, 60)
    for (name, (a0, a1)), colour in zip(DAMPINGS.items(), ("C0", "C1", "C2"), strict=True):
        growth = np.array(
            [[theory.split_growth(1.0, k / DT**2, r, DT, a0 / DT, a1 * DT) for r in ratios] for k in stiffnesses]
        )
        right.contour(ratios, stiffnesses, growth, levels=[1.0 + 1e-9], colors=colour)
        right.plot([], [], colour, label=f"border, damping: {name}")
        for row in report.rows:
            if row["study"] == "mode" and row["damping"] == name:
                style = {"mfc": colour if row["growth"] > 1 else "none", "mec": colour}
                shift = 1.05 ** (["none", "mass", "stiffness"].index(name) - 1)  # so that all three can be seen
                right.plot(row["m_a/m"] * shift, row["h2k/m"], "o", **style)
    right.set(xscale="log", yscale="log", xlabel="$m_a / m_s$", ylabel="$h^2 k / m_s$")
    right.set(title="border of stability; full: measured to grow")
    right.legend(loc="upper left")
    return figure
