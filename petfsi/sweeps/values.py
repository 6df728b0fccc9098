"""The values of an axis: a list, or where they begin and how they go on."""

from __future__ import annotations

import math
from datetime import date, time
from typing import Any

from petfsi.messages import shown

#: Values of one axis.
MOST = 10_000
_WORDS = ("from", "factor", "step", "count")


def read_values(key: str, given: Any, mistakes: list[str]) -> list[Any]:
    """Return the values of an axis; of one that is wrong none, with what is wrong added to ``mistakes``."""
    if isinstance(given, dict):
        return _series(key, given, mistakes)
    if not isinstance(given, list) or not 0 < len(given) <= MOST:
        mistakes.append(f"{key}: must be a list of 1 to {MOST:,} values, or {{ from, factor or step, count }}")
        return []
    if is_dated(given):
        mistakes.append(f"{key}: no value is a date or a time; a text stands in quotes")
        return []
    return given


def is_dated(value: Any) -> bool:
    """Return whether a value of TOML is a date or a time, or holds one."""
    if isinstance(value, dict | list):
        return any(is_dated(one) for one in (value.values() if isinstance(value, dict) else value))
    return isinstance(value, date | time)


def _series(key: str, given: dict[str, Any], mistakes: list[str]) -> list[Any]:
    """Return a geometric or an arithmetic series.

    Its numbers are rounded to 12 digits: what is added up would else have names such as 0.30000000000000004.
    """
    before = len(mistakes)
    for word in (word for word in given if word not in _WORDS):
        mistakes.append(f"{key}.{shown(word)}: no such word of values; they have from, factor or step, and count")
    if ("factor" in given) == ("step" in given):
        mistakes.append(f"{key}: must have factor or step")
    for word in ("from", *(word for word in ("factor", "step") if word in given)):
        if not _is_number(given.get(word)):
            mistakes.append(f"{key}.{word}: must be a number")
    count = given.get("count")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MOST:
        mistakes.append(f"{key}.count: must be a whole number from 1 to {MOST:,}")
    if len(mistakes) > before:
        return []
    assert isinstance(count, int)
    first = given["from"]
    try:
        if "factor" in given:
            values = [first * given["factor"] ** n for n in range(count)]
        else:
            values = [first + n * given["step"] for n in range(count)]
    except (OverflowError, ZeroDivisionError):
        values = [math.inf]
    if not all(_is_number(value) and abs(value) < 2**63 or isinstance(value, float) for value in values):
        values = [math.inf]
    if not all(math.isfinite(value) for value in values):
        mistakes.append(f"{key}: its last values are too large")
        return []
    return [value if isinstance(value, int) else float(f"{value:.12g}") for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
