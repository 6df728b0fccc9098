"""The first mode of an elastic layer under a column of water: frequency, damping and energy, against theory.

The layer's foot is held and the water's top is open, so that the water moves as one mass on the layer. With
rho_s, L_s, M the layer's density, height and P-wave modulus and rho_f, L_f the water's, the angular frequency omega is

    x tan x = rho_s L_s / (rho_f L_f),    omega = (x / L_s) sqrt(M / rho_s).

Four studies, for each scheme:

- ``mesh``: grid and layer refined together, 8 cells to an element. What the step alone does to a free mode is known
  exactly (``theory.root``) and taken out: column ``mode``, whose distance from omega is ``mode error``. The grids of
  ``off`` have planes a quarter of a cell away from the layer's top, those of ``mesh`` one in it.
- ``step``: the step refined on the finest mesh, against what theory makes of that mesh's own mode: newmark is of second
  order in the frequency and of first in the damping, bdf2 of second and third, midpoint of second and undamped.
- ``energy``: the largest change of the kinetic and elastic energy over a thousand steps of the undamped midpoint rule,
  with no plane of the grid in the layer's top: where the top sweeps over one, faces come and go, and energy with them.
- ``shipped width``: the default at 200 steps a period on a grid as wide as that of ``jobs/column.toml``.

Every other material has ``mesh`` and ``step`` with every integrator at a density ratio of 1: so small a motion is
Hooke's for all of them.

The ray transfer takes the pressure on the top from the centre of the first cell above, and so leaves half a cell of
water out of the mass that the layer carries: first order in the mesh. The table gives what is left of its error
against that shorter column, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import MONOLITHIC, Case, history, job, simulation
from petfsi.bench.report import Report, Row
from petfsi.fields.solid import SimplexSolid
from petfsi.registry import MATERIALS
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

YOUNG, POISSON, FLUID_DENSITY = 1.0e5, 0.3, 1000.0
SOLID_HEIGHT, FLUID_HEIGHT = 0.5, 1.5
MODULUS = theory.p_wave_modulus(YOUNG, POISSON)

#: Transfer and integrator: the published pair, and the exact transfer with every integrator.
SCHEMES = (("ray", "newmark"), ("cutcell", "newmark"), ("cutcell", "bdf2"), ("cutcell", "midpoint"))
DEFAULT = ("cutcell", "bdf2")

RATIOS = (0.1, 1.0, 10.0)
CELLS, OFF_PLANES = (16, 32, 64), (17, 33, 65)
#: Steps per period: where the mesh's error is measured, where the step's is, and for the shipped width.
FINE, COARSE, FINEST = 50, (10, 20, 40, 80), 200
PERIODS = 2
#: Rows of a history before the fit: what a multistep scheme's first step leaves behind is gone by then.
SETTLED = 6
#: Largest velocity at the start, m/s: the top moves by less than a millionth of a cell.
SPEED = 1e-7
ENERGY_STEPS, ENERGY_PER_PERIOD = 1000, 20

ORDER_IN_MESH = {"ray": 1.0, "cutcell": 2.0}
#: Of frequency and damping in the step.
ORDERS_IN_STEP = {"newmark": (2.0, 1.0), "bdf2": (2.0, 3.0), "midpoint": (2.0, None)}

ORDER_ERROR = 0.15
#: A mode's error below this says nothing of orders: it is what the first step leaves in the fit.
READABLE = 1e-5
LARGEST_ERROR = {"ray": 0.02, "cutcell": 1e-3}  # of the mode on the finest mesh
THEORY_ERROR = 1e-4  # of the frequency at COARSE steps against theory's, which starts from the mode at FINE ones
DAMPING_ERROR = 5e-3  # of the damping rate against theory's
UNDAMPED = 1e-4  # damping rate times period of a scheme that has none
#: What is lost is the work of linearising each step, in proportion to the amplitude: 1.5e-8 at ten times the speed.
ENERGY_ERROR = 1e-8


@dataclass(frozen=True)
class Column:
    """A column of ``cells`` cells of water and layer along y, ``wide`` cells across."""

    ratio: float
    cells: int
    wide: int = 4
    transfer: str = "cutcell"
    integrator: str = "bdf2"
    material: str = "green"

    @property
    def height(self) -> float:
        """Of layer and water together, m."""
        return SOLID_HEIGHT + FLUID_HEIGHT

    @property
    def wave_number(self) -> float:
        """The x of the mode shape sin(x y / L_s)."""
        return theory.first_wave_number(self.ratio * SOLID_HEIGHT / FLUID_HEIGHT)

    @property
    def omega(self) -> float:
        """The exact angular frequency, rad/s."""
        return self._frequency(FLUID_HEIGHT)

    @property
    def period(self) -> float:
        """The exact period, s."""
        return 2 * np.pi / self.omega

    @property
    def omega_without_half_cell(self) -> float:
        """The angular frequency under a column that lacks half a cell, rad/s."""
        return self._frequency(FLUID_HEIGHT - 0.5 * self.height / self.cells)

    def _frequency(self, fluid_height: float) -> float:
        x = theory.first_wave_number(self.ratio * SOLID_HEIGHT / fluid_height)
        return x / SOLID_HEIGHT * float(np.sqrt(MODULUS / (self.ratio * FLUID_DENSITY)))

    def exact(self, t: np.ndarray) -> np.ndarray:
        """Return the top's displacement at times t, m."""
        return SPEED * np.sin(self.wave_number) / self.omega * np.sin(self.omega * t)

    def scene(self, comm: MPI.Comm, dt: float) -> Scene:
        """Return the scene that starts in the first mode, water included. Collective."""
        width = self.wide * self.height / self.cells
        x = self.wave_number
        sets = {
            "gravity": [0.0, 0.0],
            "time.dt": dt,
            "time.end": 1e4 * dt,
            "time.integrator": self.integrator,
            "fluid.density": FLUID_DENSITY,
            "fluid.size": [width, self.height],
            "fluid.cells": [self.wide, self.cells],
            "coupling.transfer": self.transfer,
            "fluid.initial.velocity": [0.0, SPEED * float(np.sin(x))],
            "solids.layer.shape.box.size": [width, SOLID_HEIGHT],
            "solids.layer.shape.box.cells": [max(1, self.wide // 2), self.cells // 8],
            "solids.layer.density": self.ratio * FLUID_DENSITY,
            "solids.layer.young": YOUNG,
            "solids.layer.poisson": POISSON,
            "solids.layer.material": self.material,
            "solids.layer.initial.velocity": ["0.0", f"{SPEED}*sin({x / SOLID_HEIGHT!r}*y)"],
            "probes.top.at": [0.5 * width, SOLID_HEIGHT],
        }
        return job(comm, "column", sets)

    def measure(self, comm: MPI.Comm, per_period: int) -> tuple[float, float, float]:
        """Return step, angular frequency and damping rate of the top's motion. Collective."""
        dt = self.period / per_period
        y = history(comm, self.scene(comm, dt), MONOLITHIC, PERIODS * per_period)[SETTLED:]
        guess = theory.observed(self.integrator, self.omega, dt)
        return (dt, *theory.fit_damped_sinusoid(dt * np.arange(len(y)), y, *guess))

    def energies(self, comm: MPI.Comm, per_period: int, steps: int) -> np.ndarray:
        """Return the kinetic and elastic energy of layer and water at the start and after steps, J/m. Collective."""
        with simulation(comm, self.scene(comm, self.period / per_period), MONOLITHIC) as sim:
            values = [_energy(sim)]
            for _ in range(steps):
                sim.advance()
                values.append(_energy(sim))
        return np.array(values)


def _energy(sim: Simulation) -> float:
    """Return kinetic and elastic energy, J/m, the water's as the last step's kick left it. Collective."""
    assert sim.fluid is not None and isinstance(sim.solid, SimplexSolid)
    return sim.comm.allreduce(sim.fluid.stock().kinetic) + sum(sim.solid.energies().values())


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("First angular frequency of an elastic layer under water (rad/s, damping in 1/s)")
    for ratio in RATIOS[1:2] if case.quick else RATIOS:
        for transfer, integrator in SCHEMES:
            if case.quick and (transfer, integrator) == ("cutcell", "newmark"):
                continue
            _refine(case, report, Column(ratio, CELLS[-1], transfer=transfer, integrator=integrator))
        _keep_energy(case, report, Column(ratio, OFF_PLANES[-1], integrator="midpoint"))
    for material in sorted(MATERIALS.keys() - {Column.material}):
        for integrator in ORDERS_IN_STEP if not case.quick else ("bdf2",):
            _refine(case, report, Column(1.0, CELLS[-1], integrator=integrator, material=material))
    if not case.quick:
        column = Column(1.0, CELLS[-1], wide=32)
        row = _row(column, "shipped width", *column.measure(case.comm, FINEST))
        report.rows.append(row)
        report.demand(abs(row["error"]) < LARGEST_ERROR["cutcell"], row, f"error below {LARGEST_ERROR['cutcell']:.1%}")
    report.figure = _picture(report)
    return report


def _refine(case: Case, report: Report, column: Column) -> None:
    """Refine the mesh, then the step. Collective."""
    _refine_step(case, report, column, _refine_mesh(case, report, column))


def _row(column: Column, study: str, dt: float, omega: float, damping: float) -> Row:
    """Return what was measured beside what is exact, and beside what the scheme makes of the exact mode."""
    mode = theory.undo(column.integrator, omega, dt)
    row = {
        "study": study,
        "scheme": f"{column.transfer} {column.integrator}",
        "material": column.material,
        "ratio": column.ratio,
        "cells": column.cells,
        "steps/period": round(column.period / dt),
        "dt": float(dt),
        "omega": omega,
        "exact": column.omega,
        "error": omega / column.omega - 1,
        "mode error": mode / column.omega - 1,
        "damping": damping,
        "theory's damping": theory.observed(column.integrator, column.omega, dt)[1],
    }
    if column.transfer == "ray":
        row["mode less half a cell"] = mode / column.omega_without_half_cell - 1
    return row


def _refine_mesh(case: Case, report: Report, like: Column) -> float:
    """Measure on finer and finer meshes; return the frequency on the last one at vanishing steps. Collective."""
    wanted, bound = ORDER_IN_MESH[like.transfer], LARGEST_ERROR[like.transfer]
    scheme = like.transfer, like.integrator
    off = scheme == DEFAULT and like.material == Column.material
    studies = {"mesh": CELLS} | ({"off": OFF_PLANES} if off else {})
    modes = {}
    for study, meshes in studies.items():
        rows = []
        for cells in meshes:
            column = replace(like, cells=cells)
            rows.append(_row(column, study, *column.measure(case.comm, FINE)))
        report.rows += rows
        last = rows[-1]
        modes[study] = like.omega * (1 + last["mode error"])
        seen = theory.orders([row["mode error"] for row in rows], [1 / (row["cells"] // 8) for row in rows])
        name = f"ratio {like.ratio:g}, {' '.join(scheme)}, {like.material}"
        report.notes.append(f"{name}: observed orders in the mesh ({study}) {_list(seen)}")
        report.demand(abs(last["mode error"]) < bound, last, f"mode within {bound:.1%}")
        # a heavy layer's own error, of second order, is beside the ray transfer's
        own = ORDER_ERROR if like.transfer == "cutcell" or like.ratio <= 1 else 0.3
        if abs(last["mode error"]) > READABLE:
            report.demand(abs(seen[-1] - wanted) < own, last, f"order {wanted:g} in the mesh")
    return modes["mesh"]


def _list(values: np.ndarray) -> str:
    return np.array2string(values, precision=2)


def _refine_step(case: Case, report: Report, column: Column, limit: float) -> None:
    """Measure at smaller and smaller steps on the finest mesh, whose own frequency is ``limit``. Collective."""
    rows = []
    for per_period in COARSE:
        row = _row(column, "step", *column.measure(case.comm, per_period))
        predicted, damping = theory.observed(column.integrator, limit, row["dt"])
        row |= {
            "theory's damping": damping,
            "step error": row["omega"] / limit - 1,
            "theory's step error": predicted / limit - 1,
        }
        rows.append(row)
        report.demand(abs(row["omega"] / predicted - 1) < THEORY_ERROR, row, "frequency of theory")
        if ORDERS_IN_STEP[column.integrator][1] is None:
            report.demand(abs(row["damping"]) * column.period < UNDAMPED, row, "no damping")
        else:
            report.demand(abs(row["damping"] / damping - 1) < DAMPING_ERROR, row, "damping of theory")
    report.rows += rows
    steps = [row["dt"] for row in rows]
    name = f"ratio {column.ratio:g}, {column.transfer} {column.integrator}, {column.material}"
    for what, key, order in zip(
        ("frequency", "damping"), ("step error", "damping"), ORDERS_IN_STEP[column.integrator], strict=True
    ):
        if order is not None:
            seen = theory.orders([row[key] for row in rows], steps)
            report.notes.append(f"{name}: observed orders of the {what} in the step {_list(seen)}")
            report.demand(abs(seen[-1] - order) < ORDER_ERROR, rows[-1], f"order {order:g} of the {what}")


def _keep_energy(case: Case, report: Report, column: Column) -> None:
    """See whether the undamped midpoint rule keeps the energy. Collective."""
    energy = column.energies(case.comm, ENERGY_PER_PERIOD, ENERGY_STEPS)
    row: Row = {
        "study": "energy",
        "scheme": f"{column.transfer} {column.integrator}",
        "material": column.material,
        "ratio": column.ratio,
        "cells": column.cells,
        "steps/period": ENERGY_PER_PERIOD,
        "dt": column.period / ENERGY_PER_PERIOD,
        "energy change": float(np.abs(energy / energy[0] - 1).max()),
    }
    report.rows.append(row)
    bound = f"energy kept to {ENERGY_ERROR:g} over {ENERGY_STEPS} steps"
    report.demand(row["energy change"] < ENERGY_ERROR, row, bound)


# ---- the picture --------------------------------------------------------------------------------------------


def _picture(report: Report) -> Figure:
    """Draw every scheme in its colour and every ratio with its marker; lines are theory, but for the mesh's."""
    shipped = [row for row in report.rows if row["material"] == Column.material]
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    mesh, step, damping = figure.subplots(1, 3)
    colours = {f"{transfer} {integrator}": f"C{n}" for n, (transfer, integrator) in enumerate(SCHEMES)}
    for scheme, colour in colours.items():
        mesh.plot([], [], colour, label=scheme)
        for ratio, marker in zip(RATIOS, "osv", strict=True):
            rows = [row for row in shipped if row["scheme"] == scheme and row["ratio"] == ratio]
            style = {"color": colour, "mfc": "none"}
            for study, line in (("mesh", "-"), ("off", ":")):
                one = [row for row in rows if row["study"] == study]
                mesh.loglog([r["cells"] for r in one], [abs(r["mode error"]) for r in one], marker + line, **style)
            two = [row for row in rows if row["study"] == "step"]
            x = [1 / r["steps/period"] for r in two]
            step.loglog(x, [abs(r["step error"]) for r in two], marker, **style)
            step.loglog(x, [abs(r["theory's step error"]) for r in two], "-", color=colour, lw=0.8)
            if scheme.endswith("midpoint"):
                continue
            period = np.array([r["dt"] * r["steps/period"] for r in two])
            damping.loglog(x, period * [r["damping"] for r in two], marker, **style)
            damping.loglog(x, period * [r["theory's damping"] for r in two], "-", color=colour, lw=0.8)
    for ratio, marker in zip(RATIOS, "osv", strict=True):
        if any(row["ratio"] == ratio for row in report.rows):
            step.plot([], [], "k" + marker, mfc="none", label=rf"$\rho_s/\rho_f$ = {ratio:g}")
    for axes, ticks in ((mesh, CELLS), (step, [1 / n for n in COARSE]), (damping, [1 / n for n in COARSE])):
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
    mesh.set(xlabel="cells along y", ylabel="relative error of the mode", title="mesh (dotted: planes off the top)")
    step.set(xlabel="dt / period", ylabel="relative error of the frequency", title="step (lines: theory)")
    damping.set(xlabel="dt / period", ylabel="damping rate x period", title="numerical damping (lines: theory)")
    step.legend()
    figure.legend(*mesh.get_legend_handles_labels(), loc="outside lower center", ncols=len(SCHEMES))
    return figure
