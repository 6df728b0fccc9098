"""The work of what acts on solids from outside, of second order in the step whatever the scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from petfsi.couplings.base import Coupling
from petfsi.errors import NotStoredError
from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.solids import Forces, SolidField
from petfsi.integrators.base import Integrator


class ForceWork:
    """Adds up forces on a solid's unknowns times the way that these go.

    Over a step in which the unknowns move by w^n, from forces f^n where the integrator takes them:

        at the end      (f^{n-1} + f^n)/2 . w^n
        in the middle   f^n . w^n
        at the begin    f^n . w^n, and once f^{n+1} is known  (f^{n+1} - f^n)/2 . w^n

    which is the trapezoidal rule, late by half a step's change in the last case: nothing is assembled for it. As the
    stresses of a linear body do  (K d^n + K d^{n+1})/2 . (d^{n+1} - d^n),  what it stores, exactly, no error of the
    first order is left in the balance of forces. What is not known at the start, as reactions are but in statics, is
    that of the first step.

    Parameters
    ----------
    solid : SolidField or None
    couplings : sequence of Coupling
    integrator : Integrator
    """

    def __init__(self, solid: SolidField | None, couplings: Sequence[Coupling], integrator: Integrator) -> None:
        self._solid, self._couplings = solid, couplings
        # what the change of forces since the last step is multiplied by, and whether with the way before or the last
        moment = integrator.moment(1.0)
        self._late, self._lead = moment == 0.0, 0.5 - moment
        self._forces: Forces = {}
        self._way = np.zeros(0)

    def start(self) -> None:
        """Begin with the present state, at time zero. Collective."""
        solid = self._solid
        if solid is not None and solid.acting:
            self._way = np.zeros(solid.layout.n_local)
            self._forces = solid.starting_forces() if self._lead else {}
            for coupling in self._couplings:  # a fluid does not know yet what it weighs
                self._forces = {name: f for name, f in self._forces.items() if name not in coupling.forces()}

    def step(self) -> dict[str, float]:
        """Return this rank's share of what forces did in the step last accepted, by their name, J. Collective."""
        solid = self._solid
        if solid is None or not solid.acting:
            return {}
        forces, way = solid.forces(), solid.moved
        for coupling in self._couplings:
            for name, force in coupling.forces().items():
                forces[name] = forces[name] + force
        done = {name: float(force @ way) for name, force in forces.items()}
        if self._lead:
            other = self._way if self._late else way
            for name, before in self._forces.items():
                done[name] += self._lead * float((forces[name] - before) @ other)
            self._forces = forces
        if self._late:
            self._way = way
        return done

    def state(self) -> dict[str, Slab]:
        """Return what the next step reads. Collective."""
        arrays = {f"before_{name}": force for name, force in self._forces.items()}
        if self._late and self._forces:
            arrays["before_way"] = self._way
        return self._slabs(arrays)

    def _slabs(self, arrays: Mapping[str, np.ndarray]) -> dict[str, Slab]:
        found: dict[str, Slab] = {}
        for name, values in arrays.items():
            assert self._solid is not None  # it has forces
            found |= self._solid.stored(name, values)
        return found

    def restore(self, read: Reader, began: bool) -> None:
        """Take up a state, after ``start``; ``began``: of a run that had taken a step. Collective."""
        solid = self._solid
        if solid is None or not self._lead:
            return
        names = solid.acting if began else self._forces
        self._forces = {name: self._read(read, solid, f"before_{name}") for name in names}
        if self._late and self._forces:
            self._way = self._read(read, solid, "before_way")

    def _read(self, read: Reader, solid: SolidField, name: str) -> np.ndarray:
        """Return what was stored; zeros of a force that has come since, by another gravity or loads. Collective."""
        try:
            return solid.read_stored(read, name)
        except NotStoredError:
            return np.zeros(solid.layout.n_local)
