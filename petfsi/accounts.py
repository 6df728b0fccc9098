"""What a scene holds and what it gains and loses: volumes, momentum and energy, a row of them per step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.fields.base import Field, Work
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.solids import SolidField
from petfsi.force_work import ForceWork
from petfsi.scene.schema import Scene
from petfsi.solving.regions import ClosedRegions

#: The columns that are summed over steps.
SUMMED = ("potential", "dissipated", "load_work", "boundary_work")
#: Those of them by which something beyond the scene's matter gives and takes.
EXCHANGED = [0, 2, 3]


class Accounts:
    """Keeps the conservation columns of history.csv, at the price of one reduction a step.

    In SI units, in 2D per metre of thickness. Sums over time begin at zero.

    ``region_volume.1``, ...
        Fluid in each region that was closed at the start, at the end of the step (cut cells: exact for the surface;
        ray: whole cells, for the geometry at which the step was taken). nan once it was opened, divided or joined
        with another.
    ``momentum.x``, ...
        Of the fluid, sum_f m_f v_f with m_f = rho alpha_f A_f dx over the faces that the pressure acts on (half of it
        at open sides), or of its particles, and of the solids. Of ``midpoint``, v is what the step's kick left.
    ``kinetic``
        sum_f m_f v_f^2 / 2 of the fluid, and the solids' u . M u / 2.
    ``elastic``
        Energy stored in the solids, and in the compression of particles.
    ``potential``
        Minus the work of gravity so far: on the solids' mass along the way it went, and on the fluid. Cut cells:
        through the walls that solids move, -int N_i n rho g . (x - x_0) dA along the same way. Ray: m_f g . v_f.
    ``dissipated``
        What Rayleigh damping took so far, w . C w; and of particles their viscosity, the diffusion of density, and
        shifting as far as it lowered their weight.
    ``load_work``
        Of the solids' body forces and loads so far, along the way that nodes moved.
    ``boundary_work``
        What came in so far: the supports' reactions, the residual of their equations, along the way of their nodes;
        through inflows and open sides (pressure + kinetic energy + with cut cells potential energy) per volume, times
        the flow; and with what closes the volume of regions, pressure times that. Of particles the work of sides that
        move, and the energy of all that came and left, with what is done on them beyond sides.
    ``energy_residual``
        kinetic + elastic + potential + dissipated - load_work - boundary_work, less its initial value: what the
        scheme's own damping took (negative) or gave, with advection, cuts that change and what linearising a step
        leaves out. With ``midpoint`` and cut cells it vanishes to the solver's tolerance for small motions. In statics
        it is what loads set free that the state at the start does not bear.

    Forces times a way go through ``ForceWork``, powers through the trapezoidal rule, of ``midpoint`` through its own:
    both are of second order. The power before the first step is that of the first step.

    Columns that a scene has no use for are left out, all of them if ``output.accounts`` is false.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    fields : sequence of Field
    couplings : sequence of Coupling
    regions : ClosedRegions or None
        None without a fluid.

    Attributes
    ----------
    columns : list of str
        Empty before ``start``.
    values : dict of str to float
        The present row.
    exchanged : float
        What there was at the start, and what gravity, loads and boundaries did since, each step's of each without its
        sign, J.
    """

    def __init__(
        self, comm: MPI.Comm, scene: Scene, fields: Sequence[Field], couplings: Sequence[Coupling],
        regions: ClosedRegions | None,
    ) -> None:  # fmt: skip
        self.comm, self.fields, self.couplings, self.regions = comm, fields, couplings, regions
        self.dim, self._wanted, self._heavy = scene.dim, scene.output.accounts, scene.gravity is not None
        self._elastic = any(field.elastic for field in fields)
        self._loaded = any(solid.loads or solid.body_force for solid in scene.solids.values())
        self._initial, self.exchanged = 0.0, 0.0
        self._sums = np.zeros(4)
        scheme = scene.time.scheme
        self._solid = ForceWork(next((f for f in fields if isinstance(f, SolidField)), None), couplings, scheme)
        self._centred = 0.0 < scheme.moment(1.0) < 1.0
        self._power: np.ndarray | None = None  # of the step before
        self.values: dict[str, float] = {}

    @property
    def columns(self) -> list[str]:
        """The names of the columns, in order."""
        return list(self.values)

    @property
    def sums(self) -> dict[str, float]:
        """What was summed over the steps, J, that of columns left out as well."""
        return dict(zip(SUMMED, self._sums.tolist(), strict=True))

    def start(self) -> None:
        """Open the books for the present state. Collective."""
        if self._wanted:
            self._sums[:] = 0.0
            self._initial = 0.0
            self._enter(np.zeros(8), 0.0)
            self._power = None
            self._solid.start()
            self._initial = self.exchanged = self.values["energy_residual"]
            self.values["energy_residual"] = 0.0

    def update(self, pressure: np.ndarray | None, dt: float) -> None:
        """Enter the step that was accepted; nothing before ``start``. Collective: one reduction.

        Parameters
        ----------
        pressure : ndarray or None
            The step's solution of a fluid that solves for it, Pa.
        dt : float
        """
        if not self.values:
            return
        solution = np.zeros(0) if pressure is None else pressure
        works = [Work(**self._solid.step())]
        works += [field.work(dt) for field in self.fields]
        works += [coupling.work() for coupling in self.couplings]
        powers = [field.power() for field in self.fields]
        powers += [coupling.power(solution) for coupling in self.couplings]
        self._enter(np.concatenate((_summed(works), _summed(powers))), dt)

    def _enter(self, done: np.ndarray, dt: float) -> None:
        """Add up this rank's shares: what was done in a step, the powers, and what the fields hold. Collective."""
        stocks = [field.stock() for field in self.fields]
        share = np.concatenate([done, *([s.kinetic, s.elastic] for s in stocks), *(s.momentum for s in stocks)])
        total = np.empty_like(share)
        self.comm.Allreduce(share, total)
        power = total[4:8]
        before = power if self._power is None or self._centred else self._power
        step = total[:4] + dt / 2 * (before + power)
        self._sums += step
        self.exchanged += float(np.abs(step[EXCHANGED]).sum())
        self._power = power
        n = len(stocks)
        kinetic, elastic = total[8 : 8 + 2 * n].reshape(n, 2).sum(axis=0).tolist()
        momentum = total[8 + 2 * n :].reshape(n, self.dim).sum(axis=0)
        self._write(kinetic, elastic, momentum)

    def _write(self, kinetic: float, elastic: float, momentum: np.ndarray) -> None:
        potential, dissipated, load_work, boundary_work = self._sums.tolist()
        volumes = [] if self.regions is None else self.regions.volumes.tolist()
        self.values = {f"region_volume.{number}": volume for number, volume in enumerate(volumes, start=1)}
        self.values |= {f"momentum.{axis}": p for axis, p in zip("xyz", momentum.tolist(), strict=False)}
        self.values["kinetic"] = kinetic
        if self._elastic:
            self.values["elastic"] = elastic
        if self._heavy:
            self.values["potential"] = potential
        if self._elastic:
            self.values["dissipated"] = dissipated
        if self._loaded:
            self.values["load_work"] = load_work
        self.values["boundary_work"] = boundary_work
        held = kinetic + elastic + potential + dissipated - load_work - boundary_work
        self.values["energy_residual"] = held - self._initial

    def state(self) -> dict[str, Slab]:
        """Return the present row, where it began, and what the next one reads. Collective."""
        power = self._power
        numbers = self.sums | self.values | {"initial_energy": self._initial, "began": float(power is not None)}
        numbers["exchanged"] = self.exchanged
        if power is not None:
            numbers |= {f"power_{name}": value for name, value in zip(SUMMED, power.tolist(), strict=True)}
        return {name: scalar_slab(self.comm, value) for name, value in numbers.items()} | self._solid.state()

    def restore(self, read: Reader) -> None:
        """Take up a state, after ``start``. Collective."""
        self.values = {name: _number(read, name) for name in self.values}
        self._initial, self.exchanged = _number(read, "initial_energy"), _number(read, "exchanged")
        self._sums[:] = [_number(read, name) for name in SUMMED]
        self.follow(read)

    def follow(self, read: Reader) -> None:
        """Take what the next step reads of the one before, after ``start``; the books stay empty. Collective."""
        began = _number(read, "began") > 0
        self._power = np.array([_number(read, f"power_{name}") for name in SUMMED]) if began else None
        self._solid.restore(read, began)


def _number(read: Reader, name: str) -> float:
    return float(read(name, (0,), (1,))[0])


def _summed(works: Sequence[Work]) -> np.ndarray:
    """Return the sums by ``SUMMED``."""
    return np.array([(-work.gravity, work.damping, work.loads, work.boundary) for work in works]).sum(axis=0)
