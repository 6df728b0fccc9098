"""Sets of nodes and elements of Abaqus's input files, of a part or of the assembly around it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from petfsi.geometry.readers.numbered import Block
from petfsi.messages import shown

#: What sets are of.
KINDS_OF_SETS = {"ELSET": "elements", "NSET": "nodes"}


class NodesOf(NamedTuple):
    """A member of a set: the nodes of the elements of another."""

    elements: str


Member = np.ndarray | str | NodesOf


class Sets:
    """Sets by name, which has no case; a set holds numbers and other sets.

    Parameters
    ----------
    part : Sets, optional
        Those of the one part, for an assembly: it calls them Instance.Name.
    instance : str
        In capitals.
    """

    def __init__(self, part: Sets | None = None, instance: str = "") -> None:
        self.blocks: list[Block] = [] if part is None else part.blocks
        self._part, self._instance = part, instance
        self._members: dict[str, dict[str, list[Member]]] = {kind: {} for kind in KINDS_OF_SETS}
        self._names: dict[str, dict[str, str]] = {kind: {} for kind in KINDS_OF_SETS}
        self._done: dict[tuple[str, str], np.ndarray] = {}

    def own(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers as they are told apart from others: an assembly's are negative, which none of a part is."""
        return numbers if self._part is None else -1 - numbers

    def add(self, kind: str, name: str, members: list[Member], instance: str = "") -> None:
        """Give a set members; those of an instance are by its part's names and numbers."""
        if self._part is not None and instance.upper() not in ("", self._instance):
            members = [f"{instance}.{name}".upper()]
        elif self._part is not None and instance:
            members = [_of_instance(member, f"{self._instance}.") for member in members]
        else:
            members = [self.own(member) if isinstance(member, np.ndarray) else member for member in members]
        self._names[kind].setdefault(name.upper(), name)
        self._members[kind].setdefault(name.upper(), []).extend(members)

    def all(self, kind: str) -> dict[str, np.ndarray]:
        """Return the numbers of each set, ascending, as its first card spells its name."""
        return {name: self._numbers(kind, key) for key, name in self._names[kind].items()}

    def find(self, kind: str, word: str) -> np.ndarray | None:
        """Return the numbers of a set, or a number, given in capitals; None where none is called so.

        Before it there may be the name of the instance and a dot. In a file without an assembly that may be any name.
        """
        if self._part is not None and word.startswith(f"{self._instance}."):
            return self._part.find(kind, word[len(self._instance) + 1 :])
        for name in self._read_as(word):
            if name in self._members[kind]:
                return self._numbers(kind, name)
            if name.isdigit():
                return self.own(np.array([int(name)], dtype=np.int64))
        return self._part.find(kind, word) if self._part is not None and "." not in word else None

    def missing(self, kind: str, known: np.ndarray) -> Iterator[str]:
        """Yield notes of the members that are none of the nodes or elements whose numbers are known, or no sets."""
        numbers: list[str] = []
        names: list[str] = []
        for key, name in self._names[kind].items():
            count = 0
            for member in self._members[kind][key]:
                found = member if isinstance(member, np.ndarray) else self._of(kind, member)
                if found is None:
                    word = member.elements if isinstance(member, NodesOf) else member
                    names.append(f"{shown(word, 50)} in set {shown(name, 50)}")
                # what other sets miss is told of them
                elif isinstance(member, np.ndarray) or (isinstance(member, str) and _bare(member).isdigit()):
                    count += len(_others(known, found))
            if count:
                numbers.append(f"{count:,} in set {shown(name, 50)}")
        for what, told in ((KINDS_OF_SETS[kind], numbers), (f"sets that sets of {KINDS_OF_SETS[kind]} name", names)):
            if told:
                yield f"{what} that are not read or not there: {shown(', '.join(told), 150)}"

    def _read_as(self, word: str) -> tuple[str, ...]:
        return (word,) if self._part is not None else (word, _bare(word))

    def _numbers(self, kind: str, key: str) -> np.ndarray:
        """Return the numbers of a set, and of those that it names, which may name it in turn."""
        if (kind, key) not in self._done:
            found, seen, left = [np.zeros(0, dtype=np.int64)], {key}, [key]
            while left:
                for member in self._members[kind][left.pop()]:
                    words = self._read_as(member) if isinstance(member, str) else ()
                    other = next((word for word in words if word in self._members[kind]), None)
                    if other is None or (kind, other) in self._done:
                        numbers = member if isinstance(member, np.ndarray) else self._of(kind, member)
                        found += [] if numbers is None else [numbers]
                    elif other not in seen:
                        seen.add(other)
                        left.append(other)
            self._done[kind, key] = np.unique(np.concatenate(found))
        return self._done[kind, key]

    def _of(self, kind: str, member: str | NodesOf) -> np.ndarray | None:
        """Return the numbers that another set gives; None where there is no such set."""
        if isinstance(member, str):
            return self.find(kind, member)
        chosen = self.find("ELSET", member.elements)
        if chosen is None:
            return None
        nodes = [block.nodes[np.isin(block.numbers, chosen)].ravel() for block in self.blocks]
        return np.concatenate([np.zeros(0, dtype=np.int64), *nodes])


def _bare(word: str) -> str:
    """Return a word without the name of an instance before it."""
    return word.rpartition(".")[2]


def _others(known: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the numbers that are not among ascending ones that are known, each once."""
    if not len(known):
        return np.unique(numbers)
    return np.unique(numbers[known[np.minimum(np.searchsorted(known, numbers), len(known) - 1)] != numbers])


def _of_instance(member: Member, prefix: str) -> Member:
    """Return a member as the assembly names it."""
    if isinstance(member, NodesOf):
        return NodesOf(prefix + member.elements)
    return prefix + member if isinstance(member, str) else member
