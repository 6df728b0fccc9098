"""Particles (SPH) against exact flows and experiments: vortices, channels, still water, dams that break.

- ``vortices``: Taylor and Green's, at a Reynolds number of 100 in a periodic box, after a second: relative error of the
  velocity in L2 and of the kinetic energy, and the rate of its decay over the exact one.
- ``poiseuille``, ``couette``, ``stopped``: flow between plates that a force sets off, that a plate draws along, or that
  two plates stop, with the numbers of Morris et al. 1997: largest error of the velocity over the largest speed, at
  several times. ``strewn``: from a disordered start.
- ``still water``: 10 s of a tank; pressure at the bottom, error of all pressures, kinetic energy and level.
- ``front``: a column on a dry bed against Martin and Moyce 1952. Their clock began before the water moved freely (the
  gate had to go), so errors are given as they are and with the clock's shift that makes them least. No front of an
  ideal fluid is faster than Ritter's.
- ``blow``: pressure on the wall at the end of a tank against Buchner 2002 and the particles of De Courcy et al. 2024;
  arrival, first peak (of means over 0.1 of T) and plateau.
- ``choice``: the default kernel, smoothing, diffusion, shifting and artificial viscosity beside others.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from petfsi.bench import particles_dam as dam
from petfsi.bench import particles_data as data
from petfsi.bench import particles_flows as flows
from petfsi.bench.case import Case
from petfsi.bench.particles_choices import choose
from petfsi.bench.particles_tank import still
from petfsi.bench.report import Report


def run(case: Case) -> Report:
    """Measure; see the module. Collective."""
    report = Report("Particles against exact flows and experiments")
    flows.decay(case, report)
    profiles = flows.channels(case, report)
    still(case, report)
    fronts = dam.fronts(case, report)
    blows = dam.blows(case, report)
    choose(case, report)
    if case.comm.rank == 0:
        report.figure = _picture(report, profiles, fronts, blows)
    return report


def _picture(report: Report, profiles: flows.Profiles, fronts: dam.Curves, blows: dam.Curves) -> Figure:
    figure = Figure(figsize=(16, 8.6), layout="constrained")
    (errors, channel, front), (height, gauge, low) = figure.subplots(2, 3)
    _draw_errors(errors, report)
    _draw_channel(channel, profiles)
    _draw_fronts(front, height, fronts)
    _draw_blows(gauge, low, blows)
    for axes in (channel, front, height, gauge, low):
        axes.legend(fontsize=7)
    return figure


def _draw_errors(axes: Axes, report: Report) -> None:
    for name in ("vortices", *flows.CHANNELS):
        rows = [row for row in report.rows if row["part"] == name]
        axes.loglog([row["at"] for row in rows], [row["error"] for row in rows], "o-", mfc="none", label=name)
    ticks = sorted({row["at"] for row in report.rows if row["part"] in ("vortices", *flows.CHANNELS)})
    ends = np.array([ticks[0], ticks[-1]])
    axes.loglog(ends, 0.02 * ends[0] / ends, "k:", lw=0.8, label="order 1")
    axes.set_xticks(ticks, [f"{n}" for n in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set(xlabel="particles across", title="vortices (L2) and channels (largest): relative error")
    axes.legend(fontsize=7)


def _draw_channel(axes: Axes, profiles: flows.Profiles) -> None:
    y = np.linspace(0.0, flows.WIDTH, 101)
    for colour, (name, exact) in enumerate(flows.CHANNELS.items()):
        axes.plot([], [], f"C{colour}o", mfc="none", label=name)
        for t in flows.TIMES:
            axes.plot(exact(y, t) / flows.SPEED, y / flows.WIDTH, f"C{colour}-", lw=0.6)
        for at, u in profiles[name]:
            axes.plot(u / flows.SPEED, at / flows.WIDTH, f"C{colour}o", mfc="none", ms=3, lw=0)
    axes.set(xlabel="u / V", ylabel="y / L", title="channels at several times (lines: exact)")


def _draw_fronts(front: Axes, height: Axes, curves: dam.Curves) -> None:
    for name, seen in curves.items():
        style = "-" if name.startswith("2D") else "--"
        front.plot(seen[:, 0], seen[:, 1], style, lw=1, label=name)
        height.plot(seen[:, 0] / dam.FASTER, seen[:, 2], style, lw=1, label=name)
    T = np.array(data.FRONT_T)
    shift = dam.best_shift(list(curves.values())[-1])
    front.plot(T, data.FRONT_Z, "ko", mfc="none", label="Martin and Moyce")
    front.plot(T - shift, data.FRONT_Z, "k.", ms=3, label=f"the same {shift:.2f} earlier")
    front.plot([0, 1.75], [1, 4.5], "k:", lw=0.8, label="Ritter")
    height.plot(data.HEIGHT_TAU, data.HEIGHT_H, "ko", mfc="none", label="Martin and Moyce")
    front.set(xlabel="T", ylabel="Z", xlim=(0, 3.5), ylim=(1, 5), title="front on a dry bed")
    height.set(xlabel="tau", ylabel="H", xlim=(0, 7.6), title="height of the column")


def _draw_blows(gauge: Axes, low: Axes, curves: dam.Curves) -> None:
    gauge.plot(data.BUCHNER_T, data.BUCHNER_P, "k.", ms=3, label="Buchner")
    for name, seen in curves.items():
        if "disc" in name:
            gauge.plot(seen[:, 0], seen[:, 1], lw=1, label=name)
        elif name.startswith(("P1", "P3")):
            low.plot(seen[:, 0], seen[:, 1], lw=1, label=name)
    for k in (1, 3):
        low.plot(data.COURCY_T, list(data.COURCY.values())[k - 1], "k." if k == 1 else "kx", ms=4,
                 label=f"P{k}, De Courcy")  # fmt: skip
    gauge.set(xlabel="T", ylabel="p / (rho g H)", xlim=(2, 7), title=f"Buchner's gauge, means over {dam.FILTER:g} T")
    low.set(xlabel="T", ylabel="p / (rho g H)", xlim=(2, 7), title="De Courcy's gauges 1 and 3")
