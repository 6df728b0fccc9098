"""What notes are made of, and made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from petfsi.notes.bending import Span, widest_span
from petfsi.notes.forms import Form, held
from petfsi.scene.schema import Scene


@dataclass(frozen=True)
class Note:
    """A line for users; ``warns`` if something is likely wrong, and then ``run`` says it, too."""

    text: str
    warns: bool = False

    def __str__(self) -> str:
        """Say which of the two it is."""
        return f"warning: {self.text}" if self.warns else self.text


@dataclass(frozen=True)
class View:
    """A scene as notes see it.

    Attributes
    ----------
    scene : Scene
    forms : mapping of str to Form
        Of the solids that have one.
    dt : float or None
        The first step, s, where it is known.
    splits : bool
        Whether the options in force are a splitting scheme.
    """

    scene: Scene
    forms: Mapping[str, Form]
    dt: float | None = None
    splits: bool = False

    @cached_property
    def spans(self) -> dict[str, Span | None]:
        """What of each solid bends; None of those that do not, or of which that cannot be told."""
        return {name: self._span(name, form) for name, form in self.forms.items()}

    def _span(self, name: str, form: Form) -> Span | None:
        fixed = held(self.scene.solids[name], form, self.scene.directory) if form.slender else None
        return None if fixed is None else widest_span(form, fixed)


Notes = Iterator[Note]
