"""Cards of Abaqus's and CalculiX's input files: a line that begins with ``*``, and the lines of data after it.

A file that is included stands where *INCLUDE does, whatever it holds: cards, or only more data of the card before it
(*Abaqus Keywords Reference Guide*, "*INCLUDE").
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

from petfsi.geometry.readers.included import read_text, spliced

#: With the lines that go on with it, where it ends in a comma. It begins with its star, not with its line, to be found
#: fast in large files.
_INCLUDE = re.compile(
    r"\*[^\S\n]*INCLUDE[^\S\n]*(?![^,\n])"
    r"(?:[^\n]*,[^\S\n]*\n(?:[^\S\n]*(?:\*\*[^\n]*)?\n)*(?![^\S\n]*\*))*[^\n]*",
    re.IGNORECASE,
)

Card = tuple[str, dict[str, str], list[str]]


def read_cards(path: Path) -> Iterator[Card]:
    """Yield the cards of a file and of those that it includes: word, what is given with it, lines of data.

    Raises
    ------
    meshio.ReadError
        When a file includes itself, or files that are not beside it, or too deep.
    OSError
        When a file cannot be read.
    """
    card: Card | None = None
    for text in spliced(path, read_text(path), _includes, "*INCLUDE"):
        lines = _lines(text)
        starts = [n for n, line in enumerate(lines) if line.lstrip()[:1] == "*"]
        if card is not None:  # what stands before the first card goes on with the card before the piece
            card[2].extend(lines[: starts[0] if starts else len(lines)])
        for begin, end in itertools.pairwise([*starts, len(lines)]):
            if card is not None:
                yield card
            head = [lines[begin]]
            while head[-1].rstrip().endswith(",") and begin + 1 < end:
                begin += 1
                head.append(lines[begin])
            card = (*_head(head), lines[begin + 1 : end])
    if card is not None:
        yield card


def included_names(text: str) -> list[str]:
    """Return the names of the files that a text includes, as they are beside it: without ``./``."""
    return [name for _, _, name in _includes(text)]


def _includes(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield where cards *INCLUDE begin and end, and the names of their files."""
    for found in _INCLUDE.finditer(text):
        before = text[text.rfind("\n", 0, found.start()) + 1 : found.start()]
        if not before.strip():
            _, given = _head(_lines(found[0]))
            yield found.start(), found.end(), str(Path(given.get("INPUT", "")))


def _lines(text: str) -> list[str]:
    """Return the lines that are neither blank nor comments."""
    return [line for line in text.split("\n") if line.strip() and line[:2] != "**"]


def _head(lines: list[str]) -> tuple[str, dict[str, str]]:
    """Return the word of a card, in capitals, and what is given with it."""
    word, *words = (part.strip() for part in "".join(map(str.strip, lines))[1:].split(","))
    given = {key.strip().upper(): value.strip().strip('"') for key, _, value in (w.partition("=") for w in words)}
    return " ".join(word.upper().split()), given
