"""What every test shares: one thread per rank, and of the parallel tests those for the present number of ranks."""

import os

for name, value in {
    "OMP_NUM_THREADS": "1",
    "H5PY_ALWAYS_USE_MPI": "1",
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "MPLBACKEND": "Agg",
}.items():
    os.environ.setdefault(name, value)

import pytest  # noqa: E402 - MPI and HDF5 read the environment when they are imported


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Keep the tests for this number of ranks: ``mpiexec -n 3 pytest`` runs those marked ``parallel(3)``."""
    match = [item for item in items if item.get_closest_marker("parallel[match]")]
    if not os.environ.get("PETFSI_SLOW"):
        match = [item for item in match if not item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=[item for item in items if item not in match])
    items[:] = match
