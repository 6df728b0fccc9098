"""Cards of Nastran's bulk data: a name and fields, over one or more lines, in any of its three forms.

Fields are between commas, or 8 or 16 characters wide; a card goes on in lines whose first field is blank or begins with
``+`` or ``*``. A file that is included stands where INCLUDE does (*MSC Nastran Quick Reference Guide*, "Format of Bulk
Data Entries").
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import meshio

from petfsi.geometry.readers.included import read_text, spliced

_BULK = re.compile(r"^[^\S\n]*BEGIN\b[^\n]*$", re.IGNORECASE | re.MULTILINE)
#: With the lines that a long name goes on in.
_INCLUDE = re.compile(r"^[^\S\n]*INCLUDE[^\S\n]+(?:'([^']*)'|\"([^\"]*)\"|([^\s'\"]+))", re.IGNORECASE | re.MULTILINE)

Card = tuple[str, list[str]]


def read_cards(path: Path) -> Iterator[Card]:
    """Yield the cards of a file's bulk data, and of those that it includes: name, in capitals, and what is in fields.

    Raises
    ------
    meshio.ReadError
        When a file includes itself, or files that are not beside it, or too deep; when a card cannot be
        told from the next.
    OSError
        When a file cannot be read.
    """
    name, mark = "", ""
    fields: list[str] = []
    for line in _lines(path):
        first, data, next_mark = _fields(line)
        if first[:1] in ("", "+", "*"):
            if mark.lstrip("+*") and first[1:].strip() and mark.lstrip("+*") != first[1:].strip():
                raise meshio.ReadError(f"lines that go on with a card ({name}) elsewhere than right after it")
            fields += data
        else:
            if name:
                yield name, fields
            name, fields = first.upper().rstrip("*").rstrip(), data
            if name.startswith("="):
                raise meshio.ReadError("cards that repeat others (=): write them out")
        mark = next_mark
    if name:
        yield name, fields


def included_names(text: str) -> list[str]:
    """Return the names of the files that a text includes, as they are beside it: without ``./``."""
    return [name for _, _, name in _includes(text)]


def _includes(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield where INCLUDE begins and ends, and the names of files."""
    for found in _INCLUDE.finditer(text):
        name = "".join((found[1] or found[2] or found[3] or "").split("\n")).strip()
        yield found.start(), found.end(), str(Path(name))


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of bulk data that are neither blank nor comments, up to ENDDATA."""
    text = read_text(path)
    begins = list(_BULK.finditer(text))
    if len(begins) > 1:
        raise meshio.ReadError("parts with nodes of their own (BEGIN SUPER): write out the assembled model")
    bulk = text[begins[0].end() :] if begins else text
    for piece in spliced(path, bulk, _includes, "INCLUDE"):
        for line in piece.split("\n"):
            line = line.partition("$")[0].rstrip()
            if line[:8].strip().upper() == "ENDDATA":
                return
            if line:
                yield line


def _fields(line: str) -> tuple[str, list[str], str]:
    """Return the first field of a line, those of data, and the last, which the first of the next may repeat."""
    if "," in line:
        fields = [field.strip() for field in line.split(",")]
        count = 4 if "*" in fields[0] else 8
        if any(fields[count + 2 :]):
            raise meshio.ReadError(f"a line of more than {count + 2} fields: {line}")
        fields += [""] * (count + 2 - len(fields))
        return fields[0], fields[1 : count + 1], fields[count + 1]
    line = line.expandtabs(8).ljust(80)
    width = 16 if "*" in line[:8] else 8
    data = [line[at : at + width].strip() for at in range(8, 72, width)]
    return line[:8].strip(), data, line[72:80].strip()
