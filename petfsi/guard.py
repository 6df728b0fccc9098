"""What stops a run whose energy grows out of nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from mpi4py import MPI

from petfsi.errors import SolveError
from petfsi.fields.base import Reader, Slab, scalar_slab
from petfsi.scene.schema import Scene

#: Energies below this part of the weight of all water times the height of its box are round-off.
ROUND_OFF = 1e-9
#: In so many steps running: of what begins at rest the first ones have little to compare with.
PATIENCE = 3


class EnergyGuard:
    """Compares the energy that nothing accounts for with what a run has held or was given.

    With E = kinetic + elastic energy and what damping took so far, and R = ``energy_residual``, see ``accounts``, E - R
    is what a run began with and what gravity, loads, supports and sides have done to it since. Once R exceeds
    ``time.energy_limit`` times the largest E - R so far, ``PATIENCE`` times running, the motion is the scheme's own. A
    scheme's damping makes R negative, and that is never judged.

    Without the accounts there is nothing to judge, nor in statics, where no step goes on from the energy of the last.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene

    Attributes
    ----------
    watches : bool
    largest : float
        The largest E - R so far, J.
    beyond : int
        How many of the last steps had too much.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene) -> None:
        self.comm, self.limit = comm, scene.time.energy_limit
        self.watches = watches(scene)
        self.largest, self.beyond = 0.0, 0
        self._floor = ROUND_OFF * _weight(scene)

    def judge(self, values: Mapping[str, float], advice: str) -> None:
        """Raise if the step that these accounts close with has energy out of nothing. Not collective; all agree.

        Parameters
        ----------
        values : mapping of str to float
            ``Accounts.values``.
        advice : str
            What may help.

        Raises
        ------
        SolveError
        """
        if not values:
            return
        residual = values["energy_residual"]
        parts = {name: values.get(name, 0.0) for name in ("kinetic", "elastic", "dissipated")}
        held = sum(parts.values()) - residual
        self.largest = max(self.largest, held)
        self.beyond = 0 if residual <= self.limit * max(self.largest, self._floor) else self.beyond + 1
        if not self.watches or self.beyond < PATIENCE:
            return
        grown = max(parts, key=lambda name: parts[name])
        raise SolveError(
            f"energy has come out of nothing, most of it {grown}: {residual:.3g} J of now "
            f"{', '.join(f'{name} {value:.3g} J' for name, value in parts.items())}; what the run began with and was "
            f"given since was never more than {self.largest:.3g} J. {advice} time.energy_limit = {self.limit:g} is the "
            f"part of that which may be so; -1 lets all pass."
        )

    def state(self) -> dict[str, Slab]:
        """Return what the next step is judged by."""
        numbers = {"largest": self.largest, "beyond": self.beyond}
        return {name: scalar_slab(self.comm, value) for name, value in numbers.items()}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        self.largest, beyond = (float(read(name, (0,), (1,))[0]) for name in ("largest", "beyond"))
        self.beyond = int(beyond)


def watches(scene: Scene) -> bool:
    """Return whether the energy of a scene is judged."""
    return scene.time.energy_limit >= 0 and scene.output.accounts and scene.time.integrator != "static"


def _weight(scene: Scene) -> float:
    """Return the weight of all that the fluid's box may hold, times the longest way it may fall, J (per m in 2D)."""
    if scene.fluid is None or scene.gravity is None:
        return 0.0
    gravity = [abs(g) for g in scene.gravity if not isinstance(g, str)]
    size = np.asarray(scene.fluid.size)
    return scene.fluid.density * float(np.linalg.norm(gravity) * size.max() * size.prod())
