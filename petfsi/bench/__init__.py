"""Measurements that stand for themselves: each bench is one module and one line here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from petfsi.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI


@dataclass(frozen=True)
class Bench:
    """What a bench measures, and how long that takes, whole and with ``--quick``, on one core of a laptop."""

    about: str
    whole: str
    quick: str


#: Each name, with _ for -, is a module of this package whose ``run(case)`` returns a ``Report``.
BENCHES = {
    "column": Bench("a layer under water: frequency, damping and energy against theory", "4 min", "1 min"),
    "added-mass": Bench("added mass of a disk and a ball between the cells of a grid, against theory", "4 min", "45 s"),
    "walls": Bench("flows along and past walls, bodies that fall, thin sheets, against exact ones", "10 min", "1 min"),
    "extremes": Bench("thirty runs at extremes: right by a stated check, or stopped by name", "1 min", "20 s"),
    "interface": Bench("error against seconds: published and split schemes beside cut cells", "10 min", "1 min"),
    "splitting": Bench("growth per step of the split scheme, against linear theory", "30 s", "10 s"),
    "stability": Bench("which schemes, steps and dampings keep the bar in a jet bounded", "90 min", "4 min"),
    "phases": Bench("seconds per phase and step, monolithic against split, on the bar", "40 s", "10 s"),
    "solids": Bench("solids and beams alone: error against seconds by element and integrator", "1 min", "25 s"),
    "solid-speed": Bench(
        "a solid's assembly against products with its matrix; its solve, eight times finer", "4 min", "5 s"
    ),
    "particles": Bench(
        "vortices, channels, still water and dams that break, against exact and measured ones", "10 min", "1 min"
    ),
    "particle-bodies": Bench(
        "particles that bend an elastic gate and an obstacle, against an experiment and codes", "10 min", "1 min"
    ),
    "particle-speed": Bench(
        "steps a second of particles in tanks in 2D and 3D, and beside a beam: phases, memory", "5 min", "1 min"
    ),
    "particle-coupling": Bench(
        "largest stable step of particles beside an elastic body: solves and schemes over density and stiffness",
        "4 min",
        "1 min",
    ),
    "solver": Bench("one solve over density ratio, stiffness, step and grid, against others", "20 min", "20 s"),
    "stretched": Bench("one solve over the ratio of cells' edges, with and without a plate", "15 min", "20 s"),
}


def describe() -> str:
    """Return the list of benches."""
    lines = [f"  {name:<19}{b.about} ({b.whole}; --quick {b.quick})" for name, b in BENCHES.items()]
    return "\n".join(["petfsi bench NAME measures one of", *lines])


def run_bench(comm: MPI.Comm, name: str, out: Path, quick: bool) -> int:
    """Run a bench, write ``out/name.csv`` and ``.png``, print its table; return 0 if its bounds hold, else 1.

    Collective.

    Raises
    ------
    InputError
        If there is no bench of that name.
    """
    if name not in BENCHES:
        raise InputError(f"bench {name}: no such bench; there are {', '.join(BENCHES)}")
    from petfsi.bench.case import Case
    from petfsi.bench.report import publish

    report = import_module(f"petfsi.bench.{name.replace('-', '_')}").run(Case(comm, quick))
    if comm.rank == 0:
        publish(report, out, name)
    return 1 if report.failures else 0
