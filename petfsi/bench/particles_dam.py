"""Dams that break for ``petfsi bench particles``: the front on a dry bed, and the blow on a wall."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.optimize import minimize_scalar

from petfsi.bench import particles_data as data
from petfsi.bench.case import Case
from petfsi.bench.particles_runs import DENSITY, G, box, particles, prepared, rms, watched
from petfsi.bench.report import Report, Row

# ---- the front ---------------------------------------------------------------------------------------------------

#: Width of the column, m; it is twice as high, and the bed so many widths long.
WIDTH, BED = 0.05715, 22.0
FRONT_CELLS, QUICK_FRONT_CELLS, SPACE_CELLS, QUICK_SPACE_CELLS = (20, 40, 80), (20,), (12, 16, 20), (10,)
#: In space the channel is so wide, over the column's width.
ACROSS = 0.5
#: tau at the end: of the experiment's last height, and of its last front.
TAU_END, SHORT_TAU_END = 7.4, 2.5
#: T over tau.
FASTER = float(np.sqrt(2.0))
#: Largest shift of the experiment's clock in T: by how much it may have begun before the water moved freely.
LARGEST_SHIFT = 0.6
#: Of the front to the experiment with its clock shifted, of the height without; of the energy not accounted for.
#: At least so many particles to the width, in the plane and in space, must account for it: a film of one is no fluid.
FRONT_RMS, HEIGHT_RMS, RESIDUAL, RESIDUAL_FROM = 0.05, 0.03, 0.01, {2: 40, 3: 10}
#: Where fronts at several resolutions are compared.
FRONT_AT = (2.0, 3.0)


def column(comm: MPI.Comm, n: int, tau: float, dim: int = 2, **fluid: Any) -> tuple[np.ndarray, float]:
    """Return T, front Z and height H of a column let go, and the largest energy not accounted for. Collective.

    The energy is over the column's potential energy at the start.
    """
    unit = float(np.sqrt(WIDTH / G))
    across = [ACROSS * WIDTH] * (dim - 2)
    bed = min(BED, 2.0 + 2.0 * FASTER * tau)
    gravity = [0.0, -G, 0.0][:dim]
    table = {"spacing": WIDTH / n, "sides": {"top": "open"}, "fill": box([WIDTH, 2 * WIDTH, *across])}
    sim = prepared(comm, tau * unit, [bed * WIDTH, 2.2 * WIDTH, *across], gravity, **table | fluid)
    water, wall = particles(sim), [0.0] * dim
    wall[2:] = [0.5 * a for a in across]
    stored = DENSITY * G * 2 * WIDTH**3 * float(np.prod(across))

    def look() -> list[float]:
        front, level = water.probe("front", []), water.probe("level", wall)
        return [float(front) / WIDTH, float(level) / (2 * WIDTH), sim.accounts.values["energy_residual"] / stored]

    seen = watched(sim, 0.02 * unit, look)
    seen[:, 0] *= FASTER / unit
    return seen[:, :3], float(np.abs(seen[:, 3]).max())


def against_front(seen: np.ndarray, shift: float) -> float:
    """Return the rms of the front's distance from Martin and Moyce's, relative, their clock set back by ``shift``."""
    T, Z = np.array(data.FRONT_T), np.array(data.FRONT_Z)
    at = T - shift
    used = at >= 0
    return rms(np.interp(at[used], seen[:, 0], seen[:, 1]) / Z[used] - 1)


def best_shift(seen: np.ndarray) -> float:
    """Return the shift of the clock, in T, with which the front is nearest to Martin and Moyce's."""
    found = minimize_scalar(lambda s: against_front(seen, s), bounds=(0.0, LARGEST_SHIFT), method="bounded")
    return float(found.x)


def against_height(seen: np.ndarray) -> float:
    """Return the rms of the height's distance from Martin and Moyce's as far as the run went, over the first height."""
    tau, H = np.array(data.HEIGHT_TAU), np.array(data.HEIGHT_H)
    used = tau <= seen[-1, 0] / FASTER + 0.05
    return rms(np.interp(tau[used], seen[:, 0] / FASTER, seen[:, 2]) - H[used])


def front_row(seen: np.ndarray, residual: float) -> Row:
    """Return the numbers of a column that was let go."""
    shift = best_shift(seen)
    late = (seen[:, 0] >= FRONT_AT[0]) & (seen[:, 0] <= FRONT_AT[1])
    return {
        "front rms": against_front(seen, 0.0),
        "shift": shift,
        "shifted": against_front(seen, shift),
        "height rms": against_height(seen),
        **{f"Z({T:g})": float(np.interp(T, seen[:, 0], seen[:, 1])) for T in FRONT_AT},
        "Z'": float(np.polyfit(seen[late, 0], seen[late, 1], 1)[0]),
        "residual": residual,
    }


Curves = dict[str, np.ndarray]


def fronts(case: Case, report: Report) -> Curves:
    """Measure the front and the height in the plane and in space; return the histories by name. Collective."""
    curves: Curves = {}
    plane, space = (QUICK_FRONT_CELLS, QUICK_SPACE_CELLS) if case.quick else (FRONT_CELLS, SPACE_CELLS)
    for dim, numbers in ((2, plane), (3, space)):
        rows: list[Row] = []
        for n in numbers:
            tau = TAU_END if dim == 2 and not case.quick else SHORT_TAU_END
            seen, residual = column(case.comm, n, tau, dim)
            curves[f"{dim}D, {n}"] = seen
            row: Row = {"part": f"front {dim}D", "at": n} | front_row(seen, residual)
            rows.append(row)
            report.demand(row["shifted"] <= FRONT_RMS, row, f"front within {FRONT_RMS:g} rms, clock shifted")
            report.demand(row["height rms"] <= HEIGHT_RMS, row, f"height within {HEIGHT_RMS:g} rms")
            if n >= RESIDUAL_FROM[dim]:
                report.demand(row["residual"] <= RESIDUAL, row, f"energy accounted for to {RESIDUAL:g}")
            beyond = float((seen[:, 1] - 1 - 2 * seen[:, 0]).max())
            report.demand(beyond <= 0.5 / n, row, f"front behind Ritter's Z = 1 + 2 T ({beyond:.3f} beyond)")
        report.rows += rows
        for T in FRONT_AT:
            differences = np.diff([row[f"Z({T:g})"] for row in rows])
            if len(differences):
                report.notes.append(f"front {dim}D: Z({T:g}) changes by {', '.join(f'{d:+.3f}' for d in differences)}")
    return curves


# ---- the blow on a wall ------------------------------------------------------------------------------------------

#: m: height of the water, twice as long; of the tank, and of its walls.
HEIGHT, TANK, WALLS = 0.6, 3.22, 6.0
BLOW_CELLS, QUICK_BLOW_CELLS, T_END, QUICK_T_END = (40, 80), (40,), 7.0, 5.0
#: Signals are looked at every so many T, and means taken over intervals of so many.
EVERY, FILTER = 0.005, 0.1
#: Buchner's gauge, a disc: centre and diameter, m; PySPH places it at 0.2 H.
DISC, DISC_WIDTH, LOWER_DISC = 0.16, 0.09, 0.12
#: Arrival is where a signal first is above this; the plateau its mean between these.
ARRIVED, PLATEAU = 0.2, (3.2, 5.0)
#: Arrival, peak and plateau of the series in ``particles_data``, read before they were thinned, in the same way.
READ = {
    "lower disc": (2.529, 0.675, 0.542),
    "P1": (2.349, 2.454, 1.008),
    "P2": (2.392, 1.776, 0.938),
    "P3": (2.469, 1.241, 0.829),
    "P4": (3.244, 0.196, 0.347),
}
#: How near to De Courcy's the arrival, the peak and the plateau must be at gauges 1 to 3, the plateau to Buchner's; the
#: last ones relative. And the energy that may not be accounted for.
ARRIVAL_ERROR, PEAK_ERROR, PLATEAU_ERROR, BUCHNER_ERROR, BLOW_RESIDUAL = 0.05, 0.25, 0.06, 0.1, 0.02


def disc(centre: float, points: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return heights (m) and weights that take the mean over Buchner's gauge, by Gauss and Chebyshev's rule."""
    angle = np.pi * np.arange(1, points + 1) / (points + 1)
    return centre + 0.5 * DISC_WIDTH * np.cos(angle), 2 / (points + 1) * np.sin(angle) ** 2


def blow(comm: MPI.Comm, n: int, end: float, **fluid: Any) -> tuple[np.ndarray, list[str], float]:
    """Return T and the gauges' pressures over rho g H, their names, and the largest energy not accounted for.

    Collective. ``n`` particles to H. The gauges are Buchner's, at either height, and De Courcy's.
    """
    unit, scale = float(np.sqrt(HEIGHT / G)), DENSITY * G * HEIGHT
    table = {"spacing": HEIGHT / n, "sides": {"top": "open"}, "fill": box([2 * HEIGHT, HEIGHT])}
    sim = prepared(comm, end * unit, [TANK, WALLS], [0.0, -G], **table | fluid)
    water = particles(sim)
    gauges = {"disc": disc(DISC), "lower disc": disc(LOWER_DISC)}
    gauges |= {f"P{k}": (np.array([z * HEIGHT]), np.ones(1)) for k, z in enumerate(data.COURCY, start=1)}
    stored = DENSITY * G * HEIGHT**3

    def look() -> list[float]:
        signals = [
            float(w @ [water.probe("pressure", [TANK, z]) for z in heights]) / scale for heights, w in gauges.values()
        ]
        return [*signals, sim.accounts.values["energy_residual"] / stored]

    seen = watched(sim, EVERY * unit, look)
    seen[:, 0] /= unit
    return seen[:, :-1], list(gauges), float(np.abs(seen[:, -1]).max())


def filtered(T: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return the running mean of a signal over ``FILTER``."""
    sums = np.concatenate([[0.0], np.cumsum(np.diff(T) * 0.5 * (P[1:] + P[:-1]))])
    low, high = np.maximum(T - 0.5 * FILTER, T[0]), np.minimum(T + 0.5 * FILTER, T[-1])
    return (np.interp(high, T, sums) - np.interp(low, T, sums)) / (high - low)


def blow_row(T: np.ndarray, P: np.ndarray) -> Row:
    """Return arrival, the first peak after the filter and when it was, and the plateau of a signal."""
    smooth = filtered(T, P)
    arrived = smooth > ARRIVED
    first = T[np.argmax(arrived)] if arrived.any() else float("nan")
    early = (T >= 2.2) & (T <= PLATEAU[0])
    late = (T >= PLATEAU[0]) & (T <= PLATEAU[1])
    peak = int(np.argmax(np.where(early, smooth, -np.inf)))
    row: Row = {"arrival": float(first), "peak": float(smooth[peak]), "peak at": float(T[peak])}
    return row | {"plateau": float(P[late].mean()), "noise": rms((P - smooth)[late])}


def blows(case: Case, report: Report) -> Curves:
    """Measure the pressure on the wall; return the filtered signals by name. Collective."""
    curves: Curves = {}
    for n in QUICK_BLOW_CELLS if case.quick else BLOW_CELLS:
        seen, names, residual = blow(case.comm, n, QUICK_T_END if case.quick else T_END)
        T = seen[:, 0]
        for k, name in enumerate(names, start=1):
            row: Row = {"part": f"blow, {name}", "at": n} | blow_row(T, seen[:, k]) | {"residual": residual}
            report.rows.append(row)
            curves[f"{name}, {n}"] = np.column_stack([T, filtered(T, seen[:, k])])
            _judge(report, name, row)
    return curves


def _judge(report: Report, name: str, row: Row) -> None:
    """Hold a signal against the series of others."""
    report.demand(row["residual"] <= BLOW_RESIDUAL, row, f"energy accounted for to {BLOW_RESIDUAL:g}")
    if name not in READ:
        return
    arrival, peak, plateau = READ[name]
    row |= {"arrival read": arrival, "peak read": peak, "plateau read": plateau}
    if name in ("P1", "P2", "P3"):
        report.demand(abs(row["arrival"] - arrival) <= ARRIVAL_ERROR, row, f"arrival within {ARRIVAL_ERROR:g} T")
        report.demand(abs(row["peak"] / peak - 1) <= PEAK_ERROR, row, f"peak within {PEAK_ERROR:g}")
        report.demand(abs(row["plateau"] / plateau - 1) <= PLATEAU_ERROR, row, f"plateau within {PLATEAU_ERROR:g}")
    elif name == "lower disc":
        report.demand(abs(row["plateau"] / plateau - 1) <= BUCHNER_ERROR, row, f"plateau within {BUCHNER_ERROR:g}")
