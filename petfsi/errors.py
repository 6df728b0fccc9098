"""The errors a user meets, each with the exit code it ends in."""

#: PETSc's code of a machine without memory.
_PETSC_MEMORY = 55


class PetfsiError(Exception):
    """Something a user can act on; its text stands alone, without a traceback."""

    exit_code = 1


class InputError(PetfsiError):
    """The scene, a mesh, an option or a run directory is wrong: exit code 2, nothing written."""

    exit_code = 2


class NotStoredError(InputError):
    """A checkpoint has no such array, or group."""


class SolveError(PetfsiError):
    """A solve failed or the state blew up: exit code 3."""

    exit_code = 3


class FinalError(SolveError):
    """What no shorter step helps: it is not tried again."""


class EnergyError(SolveError):
    """There is more energy than a run can have got."""


class TouchError(FinalError):
    """Things meet that do not push each other off."""


class NoSolutionError(FinalError):
    """The equations of a step have no solution, whatever its length."""


def is_memory(error: BaseException) -> bool:
    """Return whether what Python or PETSc raises says that the machine has no memory left."""
    return isinstance(error, MemoryError) or getattr(error, "ierr", 0) == _PETSC_MEMORY
