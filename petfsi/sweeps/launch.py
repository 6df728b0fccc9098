"""How the process of a run is started: petfsi itself, under ``mpirun`` where it has several ranks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from petfsi.output import files
from petfsi.output.files import RUN_MARKER
from petfsi.sweeps.folder import OUTPUT, SweepFolder
from petfsi.sweeps.plan import Planned

#: What a launcher tells its own ranks, and a run that is none of them must not hear.
_OF_LAUNCHERS = ("PMIX", "PMI_", "ORTE", "OMPI_", "PRTE")
#: What is meant for all runs, of that.
_KEPT = ("OMPI_MCA_", "OMPI_ALLOW_RUN_AS_ROOT")
_OF_ONE = ("OMPI_MCA_orte", "OMPI_MCA_ess", "OMPI_MCA_pmix", "OMPI_MCA_initial_wdir", "OMPI_MCA_shmem")


def petfsi_words() -> list[str]:
    """Return the words that start petfsi, the one whose sweep this is."""
    script = Path(sys.executable).with_name("petfsi")
    return [str(script)] if script.is_file() else [sys.executable, "-m", "petfsi.cli"]


def run_words(folder: SweepFolder, run: Planned, step: int) -> list[str]:
    """Return the words that start a run, or go on with it from the checkpoint of a step (-1: there is none)."""
    directory = os.path.abspath(folder.run(run.name))
    if step >= 0 and (run.steps is None or step < run.steps):
        rest = [] if run.steps is None else ["--steps", str(run.steps - step)]
        return ["resume", directory, *rest]
    # what has begun there and left no checkpoint is nothing to keep; else there is nothing to overwrite
    again = ["--overwrite"] if (folder.run(run.name) / RUN_MARKER).exists() else []
    steps = [] if run.steps is None else ["--steps", str(run.steps)]
    return ["run", os.path.abspath(folder.path / run.scene), "--out", directory, *again, *steps, *run.options]


def launcher(ranks: int) -> list[str]:
    """Return the words before those of petfsi.

    Ranks are bound to no core: two mpiruns would each begin with the first one. How many there may be is the sweep's
    to say: mpirun would refuse more than its slots, which are physical cores.
    """
    if ranks == 1:
        return []
    return ["mpirun", "--bind-to", "none", "--oversubscribe", "-n", str(ranks)]


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a run: that of the sweep, but what would differ from one call to the next."""
    env = {
        name: value
        for name, value in given.items()
        if not name.startswith(_OF_LAUNCHERS) or (name.startswith(_KEPT) and not name.startswith(_OF_ONE))
    }
    for name in ("PETSC_OPTIONS", "PETSC_OPTIONS_YAML"):
        env.pop(name, None)
    # several runs share the cores; mpirun waits twice this long after a run that failed, and is told to end by SIGUSR1
    return {"OMP_NUM_THREADS": "1", **env, "OMPI_MCA_odls_base_sigkill_timeout": "1"}


def start(folder: SweepFolder, run: Planned, words: Sequence[str], claim: int) -> subprocess.Popen[bytes]:
    """Start the process of a run with ``run_words``, in a session of its own: Ctrl-C reaches the sweep alone."""
    line = [*launcher(run.ranks), *petfsi_words(), *words]
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT
    with open(files.open_plain(folder.run(run.name) / OUTPUT, flags), "ab") as output:
        return subprocess.Popen(
            line,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=folder.inputs,
            env=environment(os.environ),
            start_new_session=True,
            pass_fds=(claim,),
        )
