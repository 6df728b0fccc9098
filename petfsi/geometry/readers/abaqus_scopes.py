"""Parts, their instance and the assembly of Abaqus's input files: each numbers its nodes and elements by itself.

What is named stands between *PART and *END PART, *INSTANCE and *END INSTANCE, or, in the assembly, outside them
(*Abaqus Analysis User's Guide*, "Assembly definition"). Files may do without; then there is one numbering.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import meshio

from petfsi.geometry.readers.abaqus_cards import Card
from petfsi.messages import shown


class Scopes(NamedTuple):
    """Cards by what they are of.

    Attributes
    ----------
    body : list of tuple
        The part that is instanced, and what its instance adds; all cards of files without parts.
    assembly : list of tuple
        What numbers its own nodes beside the part.
    instance : str
        The name of the instance, in capitals.
    """

    body: list[Card]
    assembly: list[Card]
    instance: str


def sorted_cards(cards: Iterable[Card], notes: list[str]) -> Scopes:
    """Return the cards of the body and of the assembly; parts that are not instanced are told.

    Raises
    ------
    meshio.ReadError
        When an instance is moved, or there is more than one, or none says which of several parts is the body.
    """
    parts: dict[str, list[Card]] = {}
    outside: list[Card] = []
    within: list[Card] = []
    instance: dict[str, str] | None = None
    current = outside
    for card in cards:
        word, given, lines = card
        if word == "PART":
            name = given.get("NAME", "")
            if name.upper() in map(str.upper, parts):
                raise meshio.ReadError(f"two parts are called {shown(name, 50)}")
            current = parts[name] = []
        elif word == "INSTANCE":
            if instance is not None or any(line.strip(", ") for line in lines):
                raise meshio.ReadError("parts that are moved or there more than once (*INSTANCE): flatten the model")
            current, instance = within, given
        elif word in ("END PART", "END INSTANCE", "ASSEMBLY", "END ASSEMBLY"):
            current = outside
        else:
            current.append(card)
    if instance is None or not (parts or _has_nodes(within)):
        if len(parts) > 1:
            raise meshio.ReadError("several parts, of which none is instanced (*INSTANCE)")
        return Scopes([card for part in (*parts.values(), within, outside) for card in part], [], "")
    wanted = _instanced(parts, instance, within)
    left = [name for name in parts if name != wanted]
    if left:
        notes.append(f"parts that are not instanced are left out: {shown(', '.join(left), 100)}")
    return Scopes(parts.get(wanted, []) + within, outside, instance.get("NAME", "").upper())


def _instanced(parts: dict[str, list[Card]], instance: dict[str, str], within: list[Card]) -> str:
    """Return the name of the part that an instance is of; nothing if all data stand within it."""
    name = instance.get("PART", "")
    found = [part for part in parts if part.upper() == name.upper()]
    if not found and not _has_nodes(within):
        raise meshio.ReadError(f"an instance of part {shown(name, 50) or '?'}, which is not there (*INSTANCE)")
    return found[0] if found else ""


def _has_nodes(cards: list[Card]) -> bool:
    return any(word == "NODE" for word, _, _ in cards)
