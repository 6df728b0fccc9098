"""The step, in six calls."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from mpi4py import MPI

from petfsi import build, petsc
from petfsi.errors import SolveError
from petfsi.fields.base import Reader, Slab
from petfsi.scene.schema import Scene
from petfsi.solve import Outcome, Solver
from petfsi.system import System

PHASES = ("predict", "couple", "assemble", "solve", "accept", "observe")


class Simulation:
    """Fields, couplings and solver of a scene, at one instant.

    Attributes
    ----------
    step, time, dt : int, float, float
        The present step number, its time (s) and the step (s).
    n_steps : int
        The number of the last step.
    outcome : Outcome
        What the last solve reported.
    volume_error : float
        Largest relative change of a closed region's fluid volume in the last step, |sum of net outflows| h / V.
        A split solve spreads a compatible correction over the region: then this is its size.
    phases : dict
        Seconds spent in each of the six phases.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene) -> None:
        self.comm = comm
        self.scene = scene
        self.dt = scene.time.dt
        self.step = 0
        self.n_steps = int(np.ceil(scene.time.end / self.dt - 1e-9))
        self.fields = build.build_fields(comm, scene)
        self.couplings = build.build_couplings(scene, self.fields)
        by_name = {field.name: field for field in self.fields}
        self.solid, self.fluid = by_name.get("solid"), by_name.get("pressure")
        if self.solid and self.fluid:
            self.solid.set_scale(self.fluid.density * self.fluid.grid.cell_volume)
        self.system = System(comm, self.fields, self.couplings)
        self.solver = Solver(self.system)
        self.outcome = Outcome(0, 0.0)
        self.volume_error = 0.0
        self.phases = dict.fromkeys(PHASES, 0.0)
        self._regions: list[tuple[np.ndarray, float]] = []
        self._null_space_of: tuple[int, ...] | None = None

    @property
    def time(self) -> float:
        """The present time, s."""
        return self.step * self.dt

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the seconds spent inside to one of the phases."""
        start = clock.perf_counter()
        yield
        self.phases[name] += clock.perf_counter() - start

    def advance(self) -> None:
        """Take one step. Collective.

        Raises
        ------
        SolveError
            On all ranks; the state is then that of the failed step and must not be used.
        """
        t, dt = self.time, self.dt
        with self.phase("predict"):
            for field in self.fields:
                field.predict(t, dt)
        with self.phase("couple"):
            for coupling in self.couplings:
                coupling.couple(t, dt)
        with self.phase("assemble"):
            changed = self._assemble(t, dt)
        with self.phase("solve"):
            self.outcome = self.solver.solve(changed)
        with self.phase("accept"):
            self._accept(t, dt)
        self.step += 1

    def prepare(self) -> list[str]:
        """Assemble and set the solver up once without moving, so that every mistake in the options shows now.

        Collective. Returns the options of others that nothing reads.
        """
        for coupling in self.couplings:
            coupling.couple(self.time, self.dt)
        self._assemble(self.time, self.dt)
        return self.solver.check_options()

    def _assemble(self, t: float, dt: float) -> bool:
        for part in (*self.fields, *self.couplings):
            part.assemble(t, dt)
        changed = self.system.refresh()
        if self.fluid:
            self._find_closed_regions()
        return changed

    def _accept(self, t: float, dt: float) -> None:
        self._account_volume(dt)
        values = dict(zip((field.name for field in self.fields), self.system.values(), strict=True))
        if self.solid:
            self._check_speed(values["solid"])
            self.solid.accept(values["solid"], t, dt)
        for coupling in self.couplings:
            coupling.accept(t, dt)
        if self.fluid:
            self.fluid.accept(values["pressure"], t, dt)

    def _check_speed(self, velocity: np.ndarray) -> None:
        """Raise if a node would cross the whole scene in one step: the state has blown up."""
        fastest = self.comm.allreduce(float(np.abs(velocity).max(initial=0.0)), MPI.MAX)
        extent = max(self.scene.fluid.size) if self.scene.fluid else 10.0 * self.solid.extent
        if not fastest * self.dt < extent:
            raise SolveError(
                f"the solid has blown up: a node at {fastest:.2e} m/s would cross the whole scene ({extent:g} m) "
                f"in one step of {self.dt:g} s. Take a smaller dt, more damping, or a monolithic options file."
            )

    def _find_closed_regions(self) -> None:
        """Tell PETSc which uniform pressures no equation sees.

        A region closed by rigid walls leaves its mean pressure free. One that an elastic wall closes does not,
        except to a pressure block that is inverted by itself.
        """
        fluid = self.fluid
        version = (fluid.geometry_version, *(coupling.n_assembled for coupling in self.couplings))
        if version == self._null_space_of:
            return
        self._null_space_of = version
        touched = self.couplings[0].touched if self.couplings else None
        regions = fluid.closed_regions(touched)
        counts = self.comm.allreduce(np.array([indicator.sum() for indicator, _ in regions] or [0.0]))
        self._regions = [
            (indicator, float(n) * fluid.grid.cell_volume) for (indicator, _), n in zip(regions, counts, strict=False)
        ]
        free = [r for r, touches_solid in regions if self.solver.decoupled or not touches_solid]
        self._attach_null_space(fluid.block, free)
        if self.system.index_sets:
            piece = self.system.piece("pressure")
            rigid = [np.zeros(self.system.solution.local_size) for _, touches_solid in regions if not touches_solid]
            for whole, indicator in zip(rigid, (r for r, touches in regions if not touches), strict=True):
                whole[piece] = indicator
            self._attach_null_space(self.system.operator, rigid)

    def _attach_null_space(self, mat: petsc.PETSc.Mat, vectors: list[np.ndarray]) -> None:
        space = petsc.null_space(self.comm, mat.createVecRight(), vectors)
        mat.setNullSpace(space)
        mat.setTransposeNullSpace(space)

    def _account_volume(self, dt: float) -> None:
        if not self._regions:
            self.volume_error = 0.0
            return
        outflow = self.system.residual.array[self.system.piece("pressure")] / self.fluid.row_scale
        sums = self.comm.allreduce(np.array([outflow @ indicator for indicator, _ in self._regions]))
        volumes = np.array([volume for _, volume in self._regions])
        self.volume_error = float(np.max(np.abs(sums) * dt / volumes))

    def probe_columns(self) -> list[str]:
        """Return the names of the probes' columns in history.csv."""
        return [name for name, _ in self._probe_values(lambda *_: np.zeros(self.scene.dim))]

    def probe(self) -> list[float]:
        """Return the probes' present values, one per column. Collective."""
        return [value for _, value in self._probe_values(self._measure)]

    def _measure(self, of: str, at: list[float], quantity: str) -> np.ndarray | float:
        if of == "fluid":
            return self.fluid.probe(quantity, at)
        return self.solid.probe(of, at, quantity)

    def _probe_values(self, measure: Callable) -> Iterator[tuple[str, float]]:
        for name, spec in self.scene.probes.items():
            value = measure(spec.of, spec.at, spec.quantity)
            if spec.quantity in ("pressure", "smoke"):
                yield name, float(np.ravel(value)[0])
            else:
                yield from ((f"{name}.{axis}", float(v)) for axis, v in zip("xyz", value, strict=False))

    def divergence(self) -> float:
        """Return the largest net outflow of a fluid cell per face area, m/s. Collective."""
        return self.fluid.max_divergence() if self.fluid else 0.0

    def assemblies(self) -> dict[str, int]:
        """Return how often each block was assembled."""
        return {
            **{field.name: field.n_assembled for field in self.fields},
            **{"-".join(next(iter(coupling.blocks))): coupling.n_assembled for coupling in self.couplings},
        }

    def skipped(self) -> list[str]:
        """Return what this scene does without, and why."""
        scene, out = self.scene, []
        if not scene.solids:
            out.append("solid, nest and coupling: the scene has no solids")
        if scene.fluid is None:
            out.append("fluid, nest and coupling: the scene has no fluid")
        elif scene.fluid.smoke is None:
            out.append("smoke: the fluid has no [fluid.smoke]")
        if scene.fluid and scene.fluid.viscosity == 0:
            out.append("viscous terms: viscosity is 0")
        if scene.fluid and not scene.obstacles:
            out.append("obstacles: the scene has none")
        return out

    def state(self) -> dict[str, dict[str, Slab]]:
        """Return all that the next step reads, by field."""
        return {field.name: field.state() for field in self.fields}

    def restore(self, step: int, readers: dict[str, Reader]) -> None:
        """Take up the state of a checkpoint. Collective."""
        self.step = step
        for field in self.fields:
            field.restore(readers[field.name])
