"""What stops a run whose energy grows out of nothing."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from petfsi.accounts import Accounts
from petfsi.errors import EnergyError
from petfsi.fields.slabs import Reader, Slab, scalar_slab
from petfsi.fields.stored import EXACT
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Scene

#: Energies below this part of the weight of all water times the height of its box, or of all exchanged, are round-off.
ROUND_OFF = 1e-9
#: In so many steps running: of what begins at rest the first ones have little to compare with.
PATIENCE = 3


class EnergyGuard:
    """Compares the energy that a run holds with what it can have got.

    It holds kinetic + elastic energy. (What damping took is no part of it: where that is too fast for the steps the sum
    of its powers exceeds what there was.) It can have got ``Accounts.exchanged``: what it
    began with and what gravity, loads, supports and sides did since, each step's without its sign. Once it holds more
    than (1 + ``time.energy_limit``) times that, ``PATIENCE`` times running, the motion is the scheme's own.

    ``energy_residual`` would not do: it is first order in the mesh where fluid streams through, adds up, and also pays
    for what has left.

    Without the accounts there is nothing to judge, nor in statics, where no step goes on from the energy of the last.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene

    Attributes
    ----------
    beyond : int
        How many of the last steps had too much.
    doubt : str
        What is wrong, if the last one had: a run may end before ``PATIENCE`` does.
    weight : float
        The largest weight so far of all that the fluid's box may hold, times the longest way it may fall, J (per m in
        2D): fluid at rest in a closed box exchanges nothing, and round-off moves it.
    notes : list of str
        That nothing is judged where the scene itself sets a limit, but keeps no accounts.
    """

    def __init__(self, comm: MPI.Comm, scene: Scene) -> None:
        self.comm, self.limit = comm, scene.time.energy_limit
        self._watches = self.limit >= 0 and not scene.unjudged
        asked = self.limit >= 0 and "energy_limit" in scene.time.model_fields_set
        self.notes = [] if scene.output.accounts or not asked else [f"time.energy_limit: {scene.unjudged}"]
        self._gravity, self._mass_way = _may_fall(scene)
        self._strained = _strained(scene)
        self.beyond, self.weight, self.doubt = 0, 0.0, ""

    def judge(self, accounts: Accounts, time: float, advice: str) -> None:
        """Raise if there is energy out of nothing. Not collective; all agree.

        Parameters
        ----------
        accounts : Accounts
            Of the step that ends now.
        time : float
            At its end, s.
        advice : str
            What may help.

        Raises
        ------
        EnergyError
        """
        if not accounts.values:
            return
        self.weight = max(self.weight, self._mass_way * float(np.linalg.norm([g(t=time) for g in self._gravity])))
        parts = {name: accounts.values.get(name, 0.0) for name in ("kinetic", "elastic")}
        # pairs of particles and a body store energy as negative losses
        stored = min(0.0, accounts.values.get("dissipated", 0.0))
        held, got = sum(parts.values()) + stored, accounts.exchanged
        most = (1.0 + self.limit) * got + ROUND_OFF * (got + self.weight) + self._strained
        self.beyond, self.doubt = 0 if held <= most else self.beyond + 1, ""
        if not self._watches or not self.beyond:
            return
        grown = max(parts, key=lambda name: parts[name])
        self.doubt = (
            f"energy has come out of nothing, most of it {grown}: there are now "
            f"{', '.join(f'{name} {value:.3g} J' for name, value in parts.items())}; what it began with and what "
            f"gravity, loads and boundaries gave or took since, step by step, come to {got:.3g} J. {advice} "
            f"time.energy_limit = {self.limit:g} is how much more there may be, as a part of that; -1 lets all pass."
        )
        if self.beyond >= PATIENCE:
            raise EnergyError(self.doubt)

    def last_doubt(self, step: int) -> str:
        """Return what is wrong at the end of a run of so many steps that ends before that is sure, or nothing."""
        return self.doubt if step > PATIENCE else ""

    def state(self) -> dict[str, Slab]:
        """Return what the next step is judged by, besides the accounts."""
        numbers = {"weight": self.weight, "beyond": self.beyond}
        return {name: scalar_slab(self.comm, value) for name, value in numbers.items()}

    def restore(self, read: Reader) -> None:
        """Take the state back. Collective."""
        self.weight, beyond = (float(read(name, (0,), (1,))[0]) for name in ("weight", "beyond"))
        if not (self.weight >= 0 and 0 <= beyond <= EXACT):  # every rank has read the same
            raise ValueError(f"'weight' or 'beyond' of the guard are {self.weight:g} and {beyond:g}")
        self.beyond = int(beyond)


def _may_fall(scene: Scene) -> tuple[list[Expression], float]:
    """Return gravity, and the mass of all that the fluid's box may hold times its longest side, kg m (per m in 2D)."""
    if scene.fluid is None:
        return [], 0.0
    size = np.asarray(scene.fluid.size)
    mass = scene.fluid.density * float(size.prod())
    return [Expression(g, ("t",), "gravity") for g in scene.gravity or []], mass * float(size.max())


def _strained(scene: Scene) -> float:
    """Return the energy of strains that are round-off in the whole of the fluid's box, J (per m in 2D).

    Where nothing pulls, and nothing moves, there is no other energy to compare with.
    """
    if scene.fluid is None:
        return 0.0
    stiffness = sum(solid.young for solid in scene.solids.values())
    return float(np.finfo(float).eps) ** 2 * stiffness * float(np.prod(scene.fluid.size))
