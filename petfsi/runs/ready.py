"""All that a run does before its first step: ``check`` does the same, and so finds what ``run`` would."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from mpi4py import MPI

from petfsi.ranks import on_root
from petfsi.runs.memory import refuse_too_large
from petfsi.runs.plan import default_options
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation
from petfsi.solving.option_database import load_options
from petfsi.solving.options import Options

if TYPE_CHECKING:
    from petfsi.runs.origin import Origin


def made_ready(
    comm: MPI.Comm,
    scene: Scene,
    petsc_args: list[str],
    origin: Origin | None = None,
    begins: Callable[[MPI.Comm, Scene], object] = lambda comm, scene: None,
) -> tuple[Simulation, list[str], Options]:
    """Return the simulation of a scene, ready for its first step, options that nothing reads, and all. Collective.

    Writes nothing: everything that can be wrong with the scene and the options is found here, its probes included.
    ``begins`` is called once that seems to be possible at all.

    Raises
    ------
    InputError
        On all ranks, with what is wrong.
    SolveError
        On all ranks, if velocities that fit each other cannot be found.
    """
    here = comm.Split_type(MPI.COMM_TYPE_SHARED)
    ranks = comm.size, comm.allreduce(here.size, MPI.MAX)
    here.Free()
    on_root(comm, lambda: refuse_too_large(scene, ranks=ranks))
    begins(comm, scene)
    options = load_options(petsc_args, base=on_root(comm, lambda: default_options(scene)))
    simulation = Simulation(comm, scene)
    unread = simulation.prepare() if origin is None else origin.begin(simulation)
    simulation.probe()
    return simulation, unread, options
