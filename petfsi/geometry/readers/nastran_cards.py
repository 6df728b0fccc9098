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

#: How deep files include others.
DEPTH = 5

_BULK = re.compile(r"^[^\S\n]*BEGIN\b[^\n]*$", re.IGNORECASE | re.MULTILINE)
#: With the lines that a long name goes on in.
_INCLUDE = re.compile(r"^[^\S\n]*INCLUDE[^\S\n]+(?:'([^']*)'|\"([^\"]*)\"|([^\s'\"]+))", re.IGNORECASE | re.MULTILINE)

Card = tuple[str, list[str]]


def read_cards(path: Path) -> Iterator[Card]:
    """Yield the cards of a file's bulk data, and of those that it includes: name, in capitals, and what is in fields.

    Raises
    ------
    meshio.ReadError
        When a file includes itself, or files that are not beside it, or more than ``DEPTH`` deep; when a card cannot be
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


def read_text(path: Path) -> str:
    """Return a file's text, whatever its bytes are; lines end in one character, and no mark comes before them.

    Raises
    ------
    OSError
        When it cannot be read.
    """
    return path.read_text(encoding="utf-8-sig", errors="replace")


def included_names(text: str) -> list[str]:
    """Return the names of the files that a text includes, as they are beside it: without ``./``."""
    return [_name(found) for found in _INCLUDE.finditer(text)]


def _name(found: re.Match[str]) -> str:
    return str(Path("".join((found[1] or found[2] or found[3] or "").split("\n")).strip()))


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of bulk data that are neither blank nor comments, up to ENDDATA."""
    text = read_text(path)
    begins = list(_BULK.finditer(text))
    if len(begins) > 1:
        raise meshio.ReadError("parts with nodes of their own (BEGIN SUPER): write out the assembled model")
    for piece in _pieces(path, text[begins[0].end() :] if begins else text, ()):
        for line in piece.split("\n"):
            line = line.partition("$")[0].rstrip()
            if line[:8].strip().upper() == "ENDDATA":
                return
            if line:
                yield line


def _pieces(path: Path, text: str, above: tuple[str, ...]) -> Iterator[str]:
    """Yield a text, cut where it includes files, with theirs in their places."""
    begin, above = 0, (*above, path.name)
    for found in _INCLUDE.finditer(text):
        yield text[begin : found.start()]
        begin, name = found.end(), _name(found)
        beside = path.with_name(name) if Path(name).name == name != ".." else None
        if beside is None or (beside.exists() and not beside.is_file()):
            raise meshio.ReadError(f"INCLUDE of {name}: it must be a file, beside the file that includes it")
        if name in above:
            raise meshio.ReadError(f"INCLUDE of {name}: it includes itself")
        if len(above) > DEPTH:
            raise meshio.ReadError(f"INCLUDE of {name}: files may include others at most {DEPTH} files deep")
        yield from _pieces(beside, read_text(beside), above)
    yield text[begin:]


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
