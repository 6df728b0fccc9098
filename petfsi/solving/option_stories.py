"""What PETSc's errors about options mean, and why an option is read by nothing, for those who wrote the options."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches

from petsc4py import PETSc

from petfsi.errors import InputError, is_memory
from petfsi.solving import option_database
from petfsi.solving.option_rules import PREFIX, field_prefix, shown
from petfsi.solving.options import COMMAND_LINE, ENVIRONMENT, TOLD, Option

#: Names worth suggesting for a misspelt option, besides those in force.
COMMON = (
    "ksp_type ksp_rtol ksp_atol ksp_max_it ksp_monitor ksp_view ksp_pc_side ksp_norm_type "
    "ksp_initial_guess_nonzero ksp_convergence_test ksp_converged_reason pc_type pc_fieldsplit_type mat_type "
    "snes_type snes_rtol snes_atol snes_stol snes_max_it snes_monitor snes_linesearch_type snes_converged_reason "
    "pc_fieldsplit_schur_fact_type pc_fieldsplit_schur_precondition pc_factor_mat_solver_type"
).split()
#: What an option whose name goes on like this, behind a solver's prefix, needs of that solver: a type, and its values.
NEEDS = (
    ("snes_", "snes_type", ("newtonls",)),
    ("pc_fieldsplit_schur_", "pc_fieldsplit_type", ("schur",)),
    ("pc_fieldsplit_", "pc_type", ("fieldsplit",)),
    ("fieldsplit_", "pc_type", ("fieldsplit",)),
    ("pc_mg_", "pc_type", ("mg", "gamg")),
    ("mg_", "pc_type", ("mg", "gamg")),
    ("pc_gamg_", "pc_type", ("gamg",)),
    ("pc_hypre_", "pc_type", ("hypre",)),
    ("redundant_", "pc_type", ("redundant",)),
    ("sub_", "pc_type", ("bjacobi", "asm")),
    ("pc_factor_", "pc_type", ("lu", "cholesky", "ilu", "icc")),
    ("mat_mumps_", "pc_factor_mat_solver_type", ("mumps",)),
    ("ksp_chebyshev_", "ksp_type", ("chebyshev",)),
    ("ksp_richardson_", "ksp_type", ("richardson",)),
    ("ksp_gmres_", "ksp_type", ("gmres", "fgmres", "lgmres")),
    ("ksp_gcr_", "ksp_type", ("gcr",)),
)
#: Fields that the shipped files have options for, whether they are in a scene or not.
SHIPPED = ("solid", "pressure", "particles")
#: Of these a solver that does not iterate reads none.
ITERATIVE = tuple(f"ksp_{name}" for name in "rtol atol divtol max_it norm_type pc_side initial_guess".split())


def refuse_unread(prefix: str, fields: Sequence[str]) -> list[str]:
    """Return what was given for this run and nothing reads, to warn of; refuse what solvers should have read.

    Parameters
    ----------
    prefix : str
        Of the solver of the whole.
    fields : sequence of str
        Of the scene, those with a block.

    Raises
    ------
    InputError
        Naming each option, with the nearest one that was read.
    """
    unread, now = option_database.unread(), option_database.in_force()
    absent = tuple(map(field_prefix, {*SHIPPED} - {*fields}))
    wrong = [name for name in unread if not name.startswith(absent)]
    if len(fields) == 1:  # options of the others wait for a scene that couples
        mine, others = (prefix, f"{PREFIX}snes_"), f"{PREFIX}fieldsplit_" if prefix == PREFIX else "-"
        wrong = [name for name in wrong if name.startswith(mine) and not name.startswith(others)]
    if wrong:
        raise InputError(unread_story(wrong, prefix, fields))
    # of a file for many runs nobody need be told
    given = [name for name in unread if now.chosen[name].origin in (COMMAND_LINE, ENVIRONMENT)]
    return given + [option.name for option in now.left_out]


def unread_story(names: Sequence[str], prefix: str, fields: Sequence[str]) -> str:
    """Return why options that nothing reads are refused, a line each.

    Parameters
    ----------
    names : sequence of str
    prefix : str
        Of the solver of the whole.
    fields : sequence of str
        Of the scene.
    """
    now = option_database.in_force().chosen
    known = sorted(set(COMMON) | {name.removeprefix(prefix) for name in now if name not in names})
    lines = []
    for name in names[:TOLD]:
        why = _lacks(name, now) or _unknown_field(name, fields) or _near(name, prefix, known)
        lines.append(f"{now[name].place}option -{shown(name)}: no solver of this scene reads it{why}")
    return "\n".join([*lines, *([f"... and {len(names) - TOLD} more"] if len(names) > TOLD else [])])


def _lacks(name: str, now: Mapping[str, Option]) -> str:
    """Return what would have to be of another type for an option to be read: of nested solvers the outermost."""
    starts = [at for at in range(len(PREFIX), len(name)) if name[at - 1] == "_"]
    for at in starts:
        for part, kind, wanted in NEEDS:
            if name.startswith(part, at) and (part != "snes_" or at == len(PREFIX)) and name != f"{name[:at]}{kind}":
                needed = f"{name[:at]}{kind}"
                is_now = now[needed].value if needed in now else ""
                if is_now not in wanted:
                    found = f"which is {is_now} ({now[needed].origin})" if is_now else "which is not given"
                    return f"; it needs -{needed} {' or '.join(wanted)}, {found}"
        solver = f"{name[:at]}ksp_type"
        if name.startswith(ITERATIVE, at) and solver in now and now[solver].value == "preonly":
            return f"; -{solver} preonly ({now[solver].origin}) does not iterate"
    return ""


def _unknown_field(name: str, fields: Sequence[str]) -> str:
    start = f"{PREFIX}fieldsplit_"
    if name.startswith(start) and not name.startswith(tuple(f"{start}{field}_" for field in fields)):
        return f"; the fields of this scene are {', '.join(fields)}"
    return ""


def _near(name: str, prefix: str, known: Sequence[str]) -> str:
    own = PREFIX if name.startswith(f"{PREFIX}snes_") else prefix
    near = [f"{own}{found}" for found in get_close_matches(name.removeprefix(own), known, 2)]
    return next((f"; did you mean -{found}?" for found in near if found != name), "")


def petsc_text(error: PETSc.Error) -> str:
    """Return the last words of a PETSc error: what it said, without where in PETSc."""
    lines = [line.split("]", 1)[-1].strip() for line in str(error).splitlines()]
    where = max((number for number, line in enumerate(lines) if "() at " in line), default=0)
    said = [
        line for line in lines[where + 1 :] if line and not line.startswith(("*", "See http", "Unknown type. Check"))
    ]
    return shown(" ".join(said).rstrip(".,: "), 300) or f"error code {error.ierr}"


@contextmanager
def options_blamed(prefix: str) -> Iterator[None]:
    """Have what PETSc refuses inside told as a mistake in the options of this solver."""
    try:
        yield
    except PETSc.Error as error:
        if is_memory(error):
            raise
        raise InputError(option_story(prefix, error)) from None


def option_story(prefix: str, error: PETSc.Error) -> str:
    """Return which option of a solver PETSc could not follow, and why."""
    text = petsc_text(error)
    meant = _options_meant(text, prefix)
    hint = ""
    if "Python context" in text:
        given = _given("")
        told = [option for option in given if option.value == "python" or option.name.endswith("mat_type")]
        meant = told or given
        text = "petfsi's preconditioners are for the pressure of a nest, under -fsi_fieldsplit_pressure_mg_levels_"
    elif "type nest" in text:
        hint = "; all of the matrix can be factorised with -fsi_mat_type aij"
    places = {option.place for option in meant}
    place = places.pop() if len(places) == 1 else ""
    options = _either([str(option) for option in meant]) or f"-{prefix}..."
    return f"{place}option {options}: PETSc cannot set this solver up: {text}{hint} (code {error.ierr})"


def _options_meant(text: str, prefix: str) -> list[Option]:
    """Return the options that a PETSc message speaks of, or else may mean; most name the value only."""
    words = {word.strip(".,:'\"()") for word in text.split()}
    options = sorted(option_database.in_force().chosen.values(), key=lambda option: (option.shipped, option.name))
    kind = next((f"_{kind.lower()}_type" for kind in ("KSP", "PC") if f"{kind} type" in text), "")
    named = [option for option in options if f"-{option.name}" in {word.lower() for word in words}]
    told = [option for option in options if option.value in words and option.name.endswith(kind)]
    return named or [option for option in told if not option.shipped] or told or _given(prefix)


def _given(prefix: str) -> list[Option]:
    """Return what the user has given under a prefix."""
    now = option_database.in_force().chosen
    return [option for name, option in sorted(now.items()) if name.startswith(prefix) and not option.shipped]


def _either(options: Sequence[str]) -> str:
    few = list(options[:TOLD])
    return " or ".join(few) + (f" or one of {len(options) - TOLD} more" if len(options) > TOLD else "")
