"""What an option may say: nothing that runs code or writes outside the run directory, and no number out of range.

PETSc has some two thousand options, and each version brings new ones, so they are judged by kind: by the words that
their names are made of, and by what their values look like. Knows no PETSc.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

#: The solve of a step.
PREFIX = "fsi_"
#: Longest name and value: PETSc copies both into buffers of its own.
LONGEST_NAME, LONGEST_VALUE = 200, 200

#: Words of names that run code, whatever they are told.
_RUNS = frozenset("python dll library libraries debugger exec command script matlab engine saws opencl setup".split())
#: Words of names that write, or read, files or screens, whatever they are told.
_WRITES = frozenset(
    "file filename dir tmpdir path template save load dump draw display plot lg movie image hdf5 binary socket machine "
    "history tee mpe popen vieweps mpidump noise log_trace".split()
)
#: Words of names that may be told to write into a file, and may speak to the screen.
_SPEAKS = frozenset("view viewer monitor reason rate subdomains trace log estimate print".split())
#: What changes where options come from, or how they are read.
_MACHINERY = frozenset(
    "prefix_push prefix_pop options_file_yaml options_string_yaml options_monitor options_monitor_cancel skip_petscrc "
    "petscrc alias".split()
)
#: Options outside petfsi's prefix that PETSc gets at its start: those that only speak, and harm nothing.
AT_START = frozenset(
    "log_view log_view_memory log_view_gpu_time log_sync log_exclude info memory_view malloc_debug malloc_test "
    "malloc_view options_left options_view use_gpu_aware_mpi nox nox_warning citations help".split()
)
_NO_FILE = "a file is refused, as it may lie outside the run directory"
_FLAG = re.compile(r"|0|1|true|false|yes|no|on|off", re.IGNORECASE)
_SCREEN = re.compile(r"(ascii)?(::ascii_[a-z_]+)?", re.IGNORECASE)
_CLASSES = re.compile(r"(:~?[a-z,]*(:~?self)?)?")
_PLAIN = re.compile(r"[A-Za-z0-9_.,+-]*((SOR/)?Jacobi)?")
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_NO_NUMBER = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
#: Beyond it a whole number is none of PETSc's.
_LARGEST_INTEGER = 2**31 - 1


def field_prefix(name: str) -> str:
    """Return the options prefix of a field's own solver."""
    return f"{PREFIX}fieldsplit_{name}_"


@dataclass(frozen=True)
class Range:
    """The numbers that an option takes, both ends included."""

    least: float
    most: float
    whole: bool = False

    def fault(self, value: str) -> str:
        """Return what is wrong with a value, or nothing."""
        wanted = f"wanted {self}"
        if not _NUMBER.fullmatch(value):
            return f"has no {'integer' if self.whole else 'numeric'} value; {wanted}"
        if self.whole and not re.fullmatch(r"[+-]?\d+", value):
            return f"has no integer value; {wanted}"
        return "" if self.least <= float(value) <= self.most else f"is out of range; {wanted}"

    def __str__(self) -> str:
        """Say the range."""
        kind = "a whole number" if self.whole else "a number"
        if self.least == self.most:
            return f"{self.least:g}"
        if self.most >= 1e300:
            return f"{kind} of at least {self.least:g}"
        return f"{kind} from {self.least:g} to {self.most:g}"


#: How names end that want a number, and which.
RANGES = {
    "_rtol": Range(0, 0.999),
    "_atol": Range(0, 1e300),
    "_stol": Range(0, 1e300),
    "_divtol": Range(1, 1e300),
    "_divergence_tolerance": Range(-1, 1e300),
    "_max_it": Range(0, 1_000_000, whole=True),
    "_max_its": Range(0, 1_000_000, whole=True),
    "_restart": Range(1, 1000, whole=True),
    # so many vectors are kept
    "_ell": Range(1, 100, whole=True),
    "_augment": Range(0, 1000, whole=True),
    "_mmax": Range(1, 1000, whole=True),
    "_nprealloc": Range(0, 1000, whole=True),
    "_max_eigen": Range(0, 1000, whole=True),
    "_fischer_guess": Range(1, 1000, whole=True),
    "_mg_levels": Range(1, 100, whole=True),  # PETSc looks for the last one of none
    "_levels": Range(0, 100, whole=True),
    "_overlap": Range(0, 100, whole=True),
    # what is made, or done again, so many times: no signal is heard within
    **dict.fromkeys(("_asm_blocks", "_jacobi_blocks", "_local_blocks"), Range(1, 10_000, whole=True)),
    "_total_subdomains": Range(1, 10_000, whole=True),
    **dict.fromkeys(("_sweeps", "_sweeps_all", "_sweeps_down", "_sweeps_up"), Range(0, 1000, whole=True)),
    **dict.fromkeys(("_sweeps_coarse", "_its", "_lits", "_max_iter", "_maxiter"), Range(0, 1000, whole=True)),
    **dict.fromkeys(("_cycles", "_esteig_steps", "_pod_size", "_hist_size"), Range(0, 1000, whole=True)),
    **dict.fromkeys(("_nlevels", "_num_levels", "_euclid_level", "_eu_level"), Range(0, 100, whole=True)),
    **dict.fromkeys(("_nsmooths", "_interp_refine", "_space_size"), Range(0, 100, whole=True)),
    "_factorrowsize": Range(1, 10_000, whole=True),
    "_mumps_icntl_14": Range(0, 10_000, whole=True),  # more memory, by so many hundredths
    "_factor_fill": Range(1, 1000),
    "_lag_change": Range(0, 1e300),
    "_lag_growth": Range(0, 1e300),
    "_modes_degree": Range(-1, 3, whole=True),
    "_modes_below": Range(0, 1e300),
    "_modes_linear_below": Range(0, 1e300),
    "_schur_faint": Range(0, 1e300),
    "_walls_from": Range(0, 1e300),
    "_walls_damping": Range(1e-6, 2),
    # Fortran's units other than the screen's are files; what does not fit into memory goes into files, too
    "_mumps_icntl_1": Range(0, 0, whole=True),
    "_mumps_icntl_2": Range(0, 0, whole=True),
    "_mumps_icntl_3": Range(0, 0, whole=True),
    "_mumps_icntl_4": Range(0, 4, whole=True),
    "_mumps_icntl_22": Range(0, 0, whole=True),
}
#: How names end of packages that factor, and those of them that can end the process where they do.
_FACTORS, _ABORTS = ("_mat_solver_type", "_mat_solver_package"), ("superlu",)
#: How names end that mean nothing without a value, besides those.
_VALUED = ("_type",)


def fault(name: str, value: str) -> str:
    """Return what is wrong with an option, or nothing.

    Parameters
    ----------
    name : str
        Without the dash, in lower case.
    value : str
        Empty if there is none.
    """
    if len(name) > LONGEST_NAME or not _NAME.fullmatch(name):
        return "no option of PETSc's: names are of letters, digits and _"
    return _forbidden(name) or _unsuitable(name, value) or (_misfit(name, value) if name.startswith(PREFIX) else "")


def _forbidden(name: str) -> str:
    """Return why an option is refused whatever its value, or nothing."""
    words = set(name.split("_"))
    if name in _MACHINERY:
        return "changes how options are read; write each one in full"
    if name.startswith("mpi_") or words & _RUNS or name.startswith(("on_error_", "start_in_", "stop_for_")):
        return "refused: it runs code that is none of petfsi's"
    if words & _WRITES or name in ("log", "log_all", "log_trace", "malloc_dump", "objects_dump"):
        return "refused: it reads or writes what is outside the run directory"
    return ""


def _unsuitable(name: str, value: str) -> str:
    """Return why a value is none, or not for a name of this kind, or nothing."""
    if name == "info":
        good, wanted = bool(_CLASSES.fullmatch(value)), "no value or :classes"
    elif name in AT_START - {"log_view", "log_exclude"} or name == "log_trace":
        good, wanted = (
            bool(_FLAG.fullmatch(value)),
            "no value: a file is refused, as it may lie outside the run directory",
        )
    elif "monitor" in name.split("_"):
        # PETSc calls what is not there for other formats
        good, wanted = bool(_FLAG.fullmatch(value) or value.lower() == "ascii"), f"no value, or ascii: {_NO_FILE}"
    elif set(name.split("_")) & _SPEAKS:
        numeric = bool(_NUMBER.fullmatch(value))
        good = bool(_FLAG.fullmatch(value) or _SCREEN.fullmatch(value)) or (numeric and not name.endswith("view"))
        wanted = f"no value or a format of the screen's, such as ::ascii_info_detail: {_NO_FILE}"
    else:
        good = bool(_PLAIN.fullmatch(value))
        wanted = "a word, a number or a list 1,2: blanks, quotes, paths and other characters are in no value of PETSc's"
    if len(value) > LONGEST_VALUE:
        return f"its value has {len(value):,} characters; at most {LONGEST_VALUE} are taken"
    return "" if good else f"wants {wanted}"


def _misfit(name: str, value: str) -> str:
    """Return why a value is out of its option's range, or nothing."""
    wanted = next((limits for end, limits in RANGES.items() if name.endswith(end)), None)
    if (wanted is not None or name.endswith(_VALUED)) and not value:
        return "wants a value behind it"
    if name.endswith(_FACTORS) and value.lower() in _ABORTS:
        return "can end the process: as distributed it lacks MC64; wanted petsc, mumps, superlu_dist or another"
    if wanted is not None:
        parts = value.split(",") if name.endswith("_fischer_guess") else [value]
        return next(filter(None, map(wanted.fault, parts)), "")
    for part in value.split(","):
        if _NO_NUMBER.fullmatch(part):
            return "wants a number that is one, and finite"
        if _NUMBER.fullmatch(part) and not abs(float(part)) <= (
            1e300 if re.search(r"[.eE]", part) else _LARGEST_INTEGER
        ):
            return f"is too large; whole numbers end at {_LARGEST_INTEGER:,}, others at 1e300"
    return ""


def shown(text: str, longest: int = 60) -> str:
    """Return text as it can be shown on a line: cut, and without control characters."""
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: longest + 1])
    return text if len(text) <= longest else text[: longest - 3] + "..."
