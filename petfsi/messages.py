"""What users read: one screen at most, on which nothing that was given can do anything but be read."""

from __future__ import annotations

import math
import unicodedata

#: A screen.
ROWS, COLUMNS = 24, 120
#: Characters of a value or a name that are shown.
MOST = 60
#: Kinds of characters that are shown by their number: controls, marks of direction, lone surrogates, no characters.
_HIDDEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")


def escaped(text: str) -> str:
    """Return a text with each character that a terminal would act on, or not show, written as Python writes it."""
    return "".join(_visible(character) for character in text)


def _visible(character: str) -> str:
    if character.isascii() and character.isprintable():
        return character
    if unicodedata.category(character) in _HIDDEN:
        return character.encode("unicode_escape", "surrogatepass").decode("ascii")
    return character


def shown(value: object, most: int = MOST) -> str:
    """Return a value or a name on one line, its middle cut out where it is longer than ``most`` characters."""
    if isinstance(value, int) and abs(value) >= 10**most:
        return f"{'-' * (value < 0)}{int(math.log10(2) * value.bit_length())} digits"
    try:
        text = str(value)
    except (RecursionError, ValueError):
        return f"a {type(value).__name__} that is too large to show"
    if len(text) > 20 * most:  # what is cut need not be looked at
        text = text[: 10 * most] + text[-10 * most :]
    return cut(escaped(text), most)


def cut(text: str, most: int) -> str:
    """Return a text, its middle cut out where it is longer: a file's name stands at the end."""
    if len(text) <= most:
        return text
    end = (most - 3) // 3
    return f"{text[: most - 3 - end]}...{text[-end:]}"


def screen(text: str, first: int = 0) -> str:
    """Return a text of lines that fits on a screen: long ones are cut, and the last ones give way to their number.

    Parameters
    ----------
    text : str
    first : int
        How many characters will stand before it.
    """
    lines = [escaped(line.replace("\t", " ")) for line in text.split("\n")]
    longest = (ROWS - 4) * COLUMNS if len(lines) == 1 else 5 * COLUMNS
    lines = [cut(line, longest) for line in lines]
    kept, free = 0, ROWS - 1
    for n, line in enumerate(lines):
        free -= max(1, math.ceil((len(line) + first * (n == 0)) / COLUMNS))
        if free < 0:
            break
        kept += 1
    if kept == len(lines):
        return "\n".join(lines)
    return "\n".join([*lines[:kept], f"  and {len(lines) - kept} more line{'s' * (len(lines) - kept > 1)}"])
