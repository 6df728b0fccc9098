"""The options in PETSc's database: how they get there, and which of them nothing has read."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

from petfsi import petsc
from petfsi.ranks import on_root
from petfsi.solving.option_rules import PREFIX
from petfsi.solving.options import DEFAULT, Options, resolve, resolve_stored

_in_force = Options()


def load_options(args: list[str], base: str = DEFAULT, stored: Path | None = None) -> Options:
    """Fill PETSc's database with what files, PETSC_OPTIONS and the command line say; return it. Collective.

    Parameters
    ----------
    args : list of str
        PETSc options as given; ``-options_file`` may name a shipped file without its folder.
    base : str
        The shipped file used when the command line names none.
    stored : Path, optional
        The options of a run that goes on: used in place of the shipped file and of PETSC_OPTIONS.

    Raises
    ------
    InputError
        On all ranks, with every option that is refused.
    """

    def read() -> Options:
        if stored is not None:
            return resolve_stored(args, os.environ, stored, fits)
        return resolve(args, os.environ, base, fits)

    found = on_root(MPI.COMM_WORLD, read)
    put(found)
    return found


def put(options: Options) -> None:
    """Have these options of petfsi's, and no others, in PETSc's database, as values, not as text. Collective."""
    global _in_force
    database = PETSc.Options()
    for name in database.getAll():
        if name.lower().startswith(PREFIX):
            database.delValue(name)
    for name, option in options.chosen.items():
        database.setValue(name, option.value or None)
    _in_force = options


def in_force() -> Options:
    """Return what was put last."""
    return _in_force


@contextmanager
def only(options: Options) -> Iterator[None]:
    """Have these options of petfsi's, and no others, in force inside. Collective."""
    before = _in_force
    put(options)
    try:
        yield
    finally:
        put(before)


@contextmanager
def only_options(args: list[str]) -> Iterator[None]:
    """Have these PETSc options of petfsi's, and no others, in force inside. Collective.

    Solvers read theirs when they are set up, some when they are first applied, so both must happen inside.
    """
    with only(on_root(MPI.COMM_WORLD, lambda: resolve(args, {}, fits=fits))):
        yield


def unread() -> list[str]:
    """Return the names that the user has given under petfsi's prefix and that no solver has asked for."""
    call, used = petsc.library().PetscOptionsUsed, ctypes.c_int()
    names, there = [], {name.lower() for name in PETSc.Options().getAll()}
    for name, option in _in_force.chosen.items():
        if not option.shipped and name in there:
            call(None, name.encode(), ctypes.byref(used))
            if not used.value:
                names.append(name)
    return sorted(names)


def fits(kind: str, name: str, value: str) -> bool:
    """Return whether a type of KSP can follow an option, as of the side that it is preconditioned from. One rank."""
    if name not in ("norm_type", "pc_side"):
        return True
    ksp = PETSc.KSP().create(MPI.COMM_SELF)
    one = PETSc.Mat().createAIJ((1, 1), nnz=1, comm=MPI.COMM_SELF)
    one.setValue(0, 0, 1.0)
    one.assemble()
    prefix = "fits_"
    ksp.setOptionsPrefix(prefix)
    options = PETSc.Options(prefix)
    options.setValue(f"ksp_{name}", value)
    try:
        ksp.setType(kind)
        ksp.getPC().setType(PETSc.PC.Type.NONE)
        ksp.setOperators(one)
        ksp.setFromOptions()
        ksp.setUp()
    except PETSc.Error:
        return False
    finally:
        options.delValue(f"ksp_{name}")
        ksp.destroy()
        one.destroy()
    return True
