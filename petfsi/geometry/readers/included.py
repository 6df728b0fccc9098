"""Texts that include others: these stand where they are named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import meshio

#: How deep files include others.
DEPTH = 5

#: Yields where what includes a file begins and ends in a text, and the file's name.
Includes = Callable[[str], Iterable[tuple[int, int, str]]]


def read_text(path: Path) -> str:
    """Return a file's text, whatever its bytes are; lines end in one character, and no mark comes before them.

    Raises
    ------
    OSError
        When it cannot be read.
    """
    return path.read_text(encoding="utf-8-sig", errors="replace")


def spliced(path: Path, text: str, includes: Includes, word: str, above: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield a text, cut where it includes files, with theirs in their places.

    Parameters
    ----------
    path : Path
        Where the text is from.
    text : str
    includes : callable
    word : str
        What includes, for messages.
    above : tuple of str
        The files that include this one.

    Raises
    ------
    meshio.ReadError
        When a file includes itself, or files that are not beside it, or more than ``DEPTH`` deep.
    OSError
        When a file cannot be read.
    """
    begin, above = 0, (*above, path.name)
    for start, end, name in includes(text):
        yield text[begin:start]
        begin = end
        beside = path.with_name(name) if Path(name).name == name != ".." else None
        if beside is None or (beside.exists() and not beside.is_file()):
            raise meshio.ReadError(f"{word} of {name}: it must be a file, beside the file that includes it")
        if name in above:
            raise meshio.ReadError(f"{word} of {name}: it includes itself")
        if len(above) > DEPTH:
            raise meshio.ReadError(f"{word} of {name}: files may include others at most {DEPTH} files deep")
        yield from spliced(beside, read_text(beside), includes, word, above)
    yield text[begin:]
