"""What every test shares: one thread per rank, and of the parallel tests those for the present number of ranks."""

import gc
import os
import signal
import subprocess
import sys
from contextlib import contextmanager

for name, value in {
    "OMP_NUM_THREADS": "1",
    "H5PY_ALWAYS_USE_MPI": "1",
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "MPLBACKEND": "Agg",
}.items():
    os.environ.setdefault(name, value)

import hypothesis  # noqa: E402 - as below
import pytest  # noqa: E402 - MPI and HDF5 read the environment when they are imported
from mpi4py import MPI  # noqa: E402

from petfsi.runs.stop import SIGNALS  # noqa: E402

# how long examples take to make is a matter of what else the machine does
hypothesis.settings.register_profile("busy", suppress_health_check=[hypothesis.HealthCheck.too_slow], deadline=None)
hypothesis.settings.load_profile("busy")


@pytest.hookimpl(tryfirst=True)
def pytest_itemcollected(item):
    """Mark what starts several ranks: beside tests that use the cores, each of their messages waits for a turn."""
    if hasattr(item, "callspec") and item.callspec.params.get("ranks", 1) > 1:
        item.add_marker("launches")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Keep the tests for this number of ranks: ``mpiexec -n 3 pytest`` runs those marked ``parallel(3)``.

    Of ``PETFSI_THIRD``, 0 to 2, every third module: a process that runs all of them holds as much more in the end.
    """
    match = [item for item in items if item.get_closest_marker("parallel[match]")]
    if third := os.environ.get("PETFSI_THIRD"):
        modules = sorted({item.path for item in items})[int(third) :: 3]
        match = [item for item in match if item.path in modules]
    if not os.environ.get("PETFSI_SLOW"):
        match = [item for item in match if not item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=[item for item in items if item not in match])
    items[:] = match


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report):
    """A test that fails on one rank of several ends them all: the others would wait for it until they are killed."""
    if report.failed and MPI.COMM_WORLD.size > 1:
        print(f"\n{report.nodeid}\n{report.longreprtext}", file=sys.__stdout__, flush=True)
        MPI.COMM_WORLD.Abort(1)


@contextmanager
def nothing_left():
    """Undo what a command leaves in this process: how it hears signals, and PETSc's options."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)
    if "petfsi.solving.option_database" in sys.modules:
        sys.modules["petfsi.solving.option_database"].put(sys.modules["petfsi.solving.options"].Options())
    if "petsc4py.PETSc" in sys.modules and sys.modules["petsc4py.PETSc"].Sys.isInitialized():
        options = sys.modules["petsc4py.PETSc"].Options()
        for name in options.getAll():
            options.delValue(name)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item):
    """Let nothing of a test, fixtures of its module included, reach the next one."""
    with nothing_left():
        yield


@pytest.fixture(scope="module", autouse=True)
def let_go():
    """Let go of what a module's tests have made: simulations are in circles, and PETSc's share of them is large."""
    yield
    gc.collect()


@pytest.fixture(autouse=True)
def freed():
    """Free what a test has let go of: PETSc notes it, and waits for all ranks of a communicator to ask for that."""
    yield
    petsc = sys.modules.get("petsc4py.PETSc")
    if MPI.COMM_WORLD.size == 1 and petsc is not None and petsc.Sys.isInitialized():
        for comm in (petsc.COMM_SELF, petsc.COMM_WORLD):
            petsc.garbage_cleanup(comm)


@pytest.fixture
def here(capfd):
    """Return a function that runs a command in this process."""
    from petfsi import cli

    def run(*words):
        capfd.readouterr()
        with nothing_left():
            code = cli.main([str(word) for word in words])
        out, err = capfd.readouterr()
        return subprocess.CompletedProcess(words, code, out, err)

    return run
