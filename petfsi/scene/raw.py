"""A scene as TOML gives it, before anything is judged: what is too large, too deep or no text is refused here."""

from __future__ import annotations

import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown

#: Bytes of the largest scene file; ten thousand bodies take about two million.
MAX_BYTES = 4_000_000
#: Tables and lists may stand in each other so deep; what a scene has a use for is at most seven.
MAX_DEPTH = 30
#: Characters that a key may have, and a text.
MAX_KEY, MAX_TEXT = 200, 5000
#: Characters of a file's name that are shown.
NAME = 200
#: Whole numbers of TOML have 64 bits.
WHOLE = 2**63
_NESTED = "tables and lists are nested deeper than"
_DOTTED = re.compile(
    r"""(?:(?:(?<![A-Za-z0-9_-])[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+)"""
    f"{{{MAX_DEPTH + 1}}}"
)


def read_raw(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file. Not collective.

    Raises
    ------
    InputError
        If there is no such file, it is none or too large, is no TOML, or holds what no scene does.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(
                f"{shown(path, NAME)}: is a folder; a scene is a TOML file (a run folder is for 'petfsi resume')"
            )
        if not stat.S_ISREG(mode):
            raise InputError(f"{shown(path, NAME)}: is no file but a device or a pipe; a scene is a TOML file")
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{shown(path, NAME)}: no such file; a scene is a TOML file") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise InputError(f"{shown(path, NAME)}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(text) > MAX_BYTES:
        raise InputError(f"{shown(path, NAME)}: has more than {MAX_BYTES:,} bytes; a scene is a short text")
    return parse_raw(text, shown(path, NAME))


def parse_raw(text: bytes, source: str) -> dict[str, Any]:
    """Return the tables of a TOML text; ``source`` begins the message of an InputError."""
    if text.startswith(b"\xef\xbb\xbf"):
        raise InputError(f"{source}: begins with a byte order mark; save it as UTF-8 without one")
    if b"\0" in text:
        line = text.count(b"\n", 0, text.index(b"\0")) + 1
        raise InputError(f"{source}: holds a null character (line {line}); a scene is a TOML file")
    try:
        decoded = text.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is not UTF-8 text (byte {error.start}); a scene is a TOML file") from None
    deep = _DOTTED.search(decoded)  # the parser's time grows with the square of a key's parts
    if deep:
        raise InputError(f"{source}: {_NESTED} {MAX_DEPTH} levels (line {decoded.count(chr(10), 0, deep.start()) + 1})")
    return parsed(decoded, source)


def parsed(text: str, source: str) -> dict[str, Any]:
    """Return the tables of a TOML text, judged."""
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{source}: {_NESTED} {MAX_DEPTH} levels") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {shown(str(error), 200)}") from None
    except ValueError:  # Python's own limit on digits
        raise InputError(f"{source}: a whole number has thousands of digits; at most 64 bits may be") from None
    except OverflowError as error:
        raise InputError(f"{source}: not valid TOML: {shown(str(error), 200)}") from None
    judge_raw(data, source)
    return data


def judge_raw(data: dict[str, Any], source: str) -> None:
    """Raise an InputError if anything is nested too deep, too long, or a whole number beyond 64 bits.

    Without recursion: what is nested deeper than Python's stack is judged, too.
    """
    waiting: list[tuple[str, Any, int]] = [("", data, 0)]
    while waiting:
        key, value, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise InputError(f"{source}: one mistake\n  {shown(key)}: {_NESTED} {MAX_DEPTH} levels")
        if isinstance(value, dict):
            for name, inner in value.items():
                if len(str(name)) > MAX_KEY:
                    raise InputError(
                        f"{source}: one mistake\n  {shown(name)}: a key may have {MAX_KEY} characters, not {len(name)}"
                    )
                waiting.append((f"{key}.{name}" if key else str(name), inner, depth + 1))
        elif isinstance(value, list):
            waiting += [(f"{key}.{n}", inner, depth + 1) for n, inner in enumerate(value)]
        elif isinstance(value, str) and len(value) > MAX_TEXT:
            had = f"a text may have {MAX_TEXT} characters, not {len(value)}"
            raise InputError(f"{source}: one mistake\n  {shown(key)} = {shown(value)}: {had}")
        elif isinstance(value, int) and not -WHOLE <= value < WHOLE:
            raise InputError(f"{source}: one mistake\n  {shown(key)} = {shown(value)}: a whole number may have 64 bits")
