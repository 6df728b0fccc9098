"""Options from where they are given to what is in force: files, ``PETSC_OPTIONS``, the command line. Knows no PETSc."""

from __future__ import annotations

import re
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from petfsi.errors import InputError
from petfsi.solving.option_rules import AT_START, PREFIX, fault, shown

DEFAULT = "monolithic.opts"
COMMAND_LINE, ENVIRONMENT = "command line", "PETSC_OPTIONS"
FILE = "options_file"
#: In a run's directory: what ``Options.dump`` says.
STORED = "options.opts"
#: Bytes of an options file, options in all, and files that name each other.
LARGEST_FILE, MOST, DEEPEST = 1_000_000, 1000, 10
#: Mistakes and names told at once.
TOLD = 8

_WORD = re.compile(r"\"([^\"]*)\"|'([^']*)'|(\S+)")
_NAME = re.compile(r"--?[A-Za-z]")
_NO_NAME = re.compile(r"-(inf|infinity|nan)", re.IGNORECASE)


@dataclass(frozen=True)
class Option:
    """An option and where it is from.

    Attributes
    ----------
    name : str
        Without the dash, in lower case: PETSc makes no difference.
    value : str
        Empty if there is none.
    origin : str
        The file as it was named, ``ENVIRONMENT`` or ``COMMAND_LINE``.
    shipped : bool
        Whether it is petfsi's own word, and not the user's.
    line : int
        Of the file.
    """

    name: str
    value: str
    origin: str
    shipped: bool = False
    line: int = 0

    def __str__(self) -> str:
        """Say name and value, as on a command line."""
        return f"-{shown(self.name)} {shown(self.value)}".rstrip()

    @property
    def place(self) -> str:
        """What a message about it begins with."""
        where = f"{shown(self.origin, 200)}, line {self.line}: " if self.line else f"{self.origin}: "
        return "" if self.origin == COMMAND_LINE else where


@dataclass
class Options:
    """The options in force, by name, and what is to be told of how they came about.

    Attributes
    ----------
    chosen : dict of str to Option
        Under petfsi's prefix.
    at_start : dict of str to Option
        Those that PETSc gets when it starts.
    left_out : list of Option
        What nothing would read.
    notes : list of str
        Lines for the log.
    """

    chosen: dict[str, Option] = field(default_factory=dict)
    at_start: dict[str, Option] = field(default_factory=dict)
    left_out: list[Option] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def given(self) -> bool:
        """Whether any is the user's."""
        return not all(option.shipped for option in self.chosen.values())

    def starting(self) -> list[str]:
        """Return the words that PETSc is started with."""
        return [word for name, option in self.at_start.items() for word in (f"-{name}", option.value) if word]

    def dump(self) -> str:
        """Return petfsi's options as an options file that says where each is from."""
        lines = [
            f"-{name} {option.value}".rstrip() + f"  # {shown(option.origin, 200)}"
            for name, option in sorted(self.chosen.items())
        ]
        return "\n".join(lines) + "\n"


# ---- files and words ----------------------------------------------------------------------------------------


def options_directory() -> Path:
    """Return where the shipped options files are: beside the package in a checkout, else in the installation."""
    checkout = Path(__file__).parents[2] / "options"
    return checkout if checkout.is_dir() else Path(sysconfig.get_path("data")) / "share" / "petfsi" / "options"


def shipped_options() -> list[Path]:
    """Return the shipped options files, by name."""
    return sorted(options_directory().glob("*.opts"))


def is_option(word: str) -> bool:
    """Return whether a word is the name of an option, and not a value such as -1 or -inf."""
    return bool(_NAME.match(word)) and not _NO_NAME.fullmatch(word)


def from_words(words: Iterable[str], origin: str = COMMAND_LINE) -> list[Option]:
    """Return the options that words give, those of the files that they name in their place.

    Raises
    ------
    InputError
        If a word is no option, or a file cannot be read.
    """
    return list(_options(words, origin, ()))


def _options(words: Iterable[str], origin: str, inside: tuple[Path, ...], line: int = 0) -> Iterator[Option]:
    queue = list(words)[::-1]
    shipped = bool(inside) and inside[-1].parent == options_directory().resolve()
    while queue:
        word = queue.pop()
        value = queue.pop() if queue and not is_option(queue[-1]) else ""
        option = Option(word[1:].lower(), value, origin, shipped, line)
        if not is_option(word):
            raise InputError(f"{option.place}{shown(word)!r} is no option; wanted '-name [value]' or '# ...'")
        if option.name == FILE:
            yield from from_file(value, inside, option.place)
        else:
            yield option


def from_file(name: str, inside: tuple[Path, ...] = (), place: str = "") -> list[Option]:
    """Return the options of a file; a shipped one needs no folder.

    Parameters
    ----------
    name : str
        As it was given.
    inside : tuple of Path
        The files that name it, one in another.
    place : str
        What an error begins with.

    Raises
    ------
    InputError
        If it cannot be read, names itself, or has what is no option.
    """
    if not name:
        raise InputError(f"{place}-options_file: wants the name of a file; petfsi's own are listed by 'petfsi info'")
    path, told = Path(name), f"{place}-options_file {shown(name, 200)}"
    own = options_directory() / name
    try:
        if path.name == name and not path.exists() and own.is_file():
            path = own
        text, resolved = _read(path, told), path.resolve()
    except (OSError, ValueError) as error:  # as of names with zeros, or longer than the system's
        raise InputError(f"{told}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if resolved in inside or len(inside) >= DEEPEST:
        raise InputError(f"{told}: the file names itself, or files that do")
    options: list[Option] = []
    origin = path.name if resolved.parent == options_directory().resolve() else name
    for number, line in enumerate(text.splitlines(), 1):
        words = _words(line)
        if words and not is_option(words[0]):
            raise InputError(
                f"{place}{shown(name, 200)}, line {number}: {shown(line.strip())!r} is no option; "
                "wanted '-name [value]' or '# ...'"
            )
        options += _options(words, origin, (*inside, resolved), number)
    return options


def _read(path: Path, told: str) -> str:
    if path.is_dir():
        raise InputError(f"{told}: is a folder; petfsi's own files are listed by 'petfsi info'")
    if not path.exists():
        raise InputError(f"{told}: no such file; petfsi's own are listed by 'petfsi info'")
    if not path.is_file():
        raise InputError(f"{told}: is no file, but a device or pipe")
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{told}: is larger than {LARGEST_FILE:,} bytes, which no options file is")
    return path.read_text(encoding="utf-8", errors="replace")


def _words(line: str, comments: bool = True) -> list[str]:
    """Return a line's words; quotes keep blanks together, and a word that begins with # ends the line."""
    words = []
    for match in _WORD.finditer(line):
        if comments and match[0].startswith("#"):
            break
        words.append(next(group for group in match.groups() if group is not None))
    return words


# ---- what is in force ---------------------------------------------------------------------------------------

#: Whether a type of KSP can follow an option of the one that it replaces: (type, end of the option's name, value).
Fits = Callable[[str, str, str], bool]


def resolve(
    words: Sequence[str], environment: Mapping[str, str], base: str = DEFAULT, fits: Fits = lambda *_: True
) -> Options:
    """Return the options in force: shipped files, PETSC_OPTIONS, files of the user's, the command line, in this order.

    A type takes the place of all that hangs on the one before it: a preconditioner's options go with it.

    Parameters
    ----------
    words : sequence of str
        Of the command line.
    environment : mapping
        The process's.
    base : str
        The shipped file in force if the command line names no file.
    fits : callable

    Raises
    ------
    InputError
        With every option that is refused.
    """
    given = from_words(words)
    if not _names_file(words):
        given = [*from_file(str(options_directory() / base)), *given]
    shipped = [option for option in given if option.shipped]
    files = [option for option in given if not option.shipped and option.origin != COMMAND_LINE]
    last = [option for option in given if option.origin == COMMAND_LINE]
    return _layered([shipped, from_environment(environment), files, last], fits)


def resolve_stored(words: Sequence[str], environment: Mapping[str, str], path: Path, fits: Fits) -> Options:
    """Return the options in force of a run that goes on: those stored in its directory, and the command line.

    PETSC_OPTIONS had its say when the run began.

    Raises
    ------
    InputError
        As ``resolve`` does.
    """
    if _names_file(words):
        return resolve(words, environment, fits=fits)
    result = _layered([_stored(path), from_words(words)], fits)
    for option in from_environment(environment):
        now = result.chosen.get(option.name)
        if option.name.startswith(PREFIX) and (now is None or now.value != option.value):
            result.notes.append(f"{ENVIRONMENT}: {option} is not read: the run goes on as it began")
    return result


def from_environment(environment: Mapping[str, str]) -> list[Option]:
    """Return the options of ``PETSC_OPTIONS``; raises as ``from_words`` does."""
    return from_words(_words(environment.get(ENVIRONMENT, ""), comments=False), ENVIRONMENT)


def _names_file(words: Sequence[str]) -> bool:
    return any(word.lower() == f"-{FILE}" for word in words)


def _stored(path: Path) -> list[Option]:
    """Return what ``Options.dump`` wrote, each with the origin that stands behind it."""
    options = from_file(str(path))
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    ours = {shipped.name: {option.name for option in from_file(str(shipped))} for shipped in shipped_options()}
    result = []
    for option in options:
        _, mark, origin = lines[option.line - 1].partition("  # ") if option.origin == str(path) else ("", "", "")
        known = option.name in ours.get(origin, ())
        result.append(replace(option, origin=shown(origin) or path.name, shipped=known, line=0) if mark else option)
    return result


def _layered(layers: Sequence[Sequence[Option]], fits: Fits) -> Options:
    """Return what is in force of layers, each over those before it."""
    faults = [f"{o.place}option {o}: {said}" for layer in layers for o in layer if (said := fault(o.name, o.value))]
    if faults:
        raise InputError(_cut(list(dict.fromkeys(faults)), "\n"))
    if sum(map(len, layers)) > MOST:
        raise InputError(f"{sum(map(len, layers)):,} options are given; at most {MOST:,} are taken")
    result = Options()
    for layer in layers:
        lower = dict(result.chosen)
        for option in {option.name: option for option in layer}.values():  # of the same name the last one counts
            if option.name.startswith(PREFIX):
                _put(option, lower, result, fits)
            elif option.name in AT_START:
                result.at_start[option.name] = option
            else:
                result.left_out.append(option)
    return result


def _put(option: Option, lower: Mapping[str, Option], result: Options, fits: Fits) -> None:
    """Put an option over those of lower layers, and drop what hangs on the type that it takes the place of."""
    note, before = f"option {option} ({option.origin})", lower.get(option.name)
    if before is not None and before.value != option.value:
        note += f", not {before.value or 'without a value'} ({before.origin})"
        hung = hanging(before, option.value, lower, fits)
        gone = [name for name in hung if result.chosen.get(name) is lower[name]]  # what is given beside it stays
        for name in gone:
            del result.chosen[name]
        if gone:
            note += f"; gone with it: {_cut([f'-{name}' for name in gone], ', ')}"
    result.chosen[option.name] = option
    if not option.shipped:
        result.notes.append(note)


def hanging(before: Option, new: str, stored: Mapping[str, Option], fits: Fits) -> list[str]:
    """Return the names of the options that mean nothing once a type has another value.

    Parameters
    ----------
    before : Option
        The one that is replaced, of type or not.
    new : str
        Its new value.
    stored : mapping of str to Option
        Among which they are looked for.
    fits : callable
    """
    if not before.name.endswith("_type"):
        return []
    stem, old = before.name.removesuffix("type"), before.value.lower()
    own = [name for name in stored if name.startswith(f"{stem}{old}_")]
    if stem.endswith("_pc_"):
        top = stem.removesuffix("pc_")
        others = tuple(f"{top}{kind}" for kind in ("ksp_", "snes_", "mat_type", "pc_type"))
        return [name for name in stored if name.startswith(top) and not name.startswith(others)]
    if stem.endswith("_ksp_"):
        rest = [name for name in stored if name.startswith(stem) and name != before.name]
        if new == "preonly":
            return rest
        test = stored.get(f"{stem}convergence_test")
        if test is not None and test.value == "skip":  # a fixed number of iterations is a scheme of that type alone
            own += [f"{stem}{name}" for name in ("convergence_test", "norm_type", "max_it")]
        return [name for name in rest if name in own or not fits(new, name[len(stem) :], stored[name].value)]
    if stem.endswith("_pc_factor_mat_solver_"):
        top = stem.removesuffix("pc_factor_mat_solver_")
        return [name for name in stored if name.startswith(f"{top}mat_{old}_")]
    return own


def _cut(parts: Sequence[str], between: str) -> str:
    more = [f"... and {len(parts) - TOLD} more"] if len(parts) > TOLD else []
    return between.join([*parts[:TOLD], *more])
