"""How tests start processes as a user does."""

import os


def environment(**variables):
    """Return the environment of a user: pytest's own process may have started MPI."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX", "ORTE", "PETSC"))}
    env |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    # a rank that waits leaves the core to one that works
    return env | {"OMPI_MCA_mpi_yield_when_idle": "1"} | variables


def launcher(ranks):
    """Return the words that start so many ranks; one rank needs none."""
    return ["mpirun", "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
