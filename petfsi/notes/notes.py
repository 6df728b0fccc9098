"""All notes: to have another one, write a function of a ``View`` and give it a line in ``NOTES``."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from petfsi.notes import flow, solids
from petfsi.notes.forms import Mesh, form_of
from petfsi.notes.note import Note, Notes, View
from petfsi.scene.schema import Scene

#: Solids beyond this number are not looked at one by one, and of each kind so many lines are told.
MOST, TOLD = 100, 6

NOTES: tuple[Callable[[View], Notes], ...] = (
    solids.loose,
    solids.locking,
    solids.swings,
    flow.resolution,
    flow.nowhere_to_go,
    flow.courant,
    flow.masses,
)


def find_notes(scene: Scene, meshes: Mapping[str, Mesh], dt: float | None = None, splits: bool = False) -> list[Note]:
    """Return what a user should know of a valid scene, warnings first. Not collective; takes milliseconds.

    Parameters
    ----------
    scene : Scene
    meshes : mapping of str to (points, cells)
        Of the solids from mesh files.
    dt : float, optional
        The first step, s, where it is known.
    splits : bool
        Whether the options in force are a splitting scheme.
    """
    chosen = dict(list(scene.solids.items())[:MOST])
    forms = {name: form_of(solid, scene.dim, meshes.get(name)) for name, solid in chosen.items()}
    view = View(scene, {name: form for name, form in forms.items() if form is not None}, dt, splits)
    found = [list(notes(view)) for notes in NOTES]
    return [note for warns in (True, False) for notes in found for note in _few([n for n in notes if n.warns == warns])]


def _few(notes: list[Note]) -> list[Note]:
    """Return the first notes of a kind, and how many there are beyond them."""
    more = len(notes) - TOLD
    return notes if more <= 0 else [*notes[:TOLD], Note(f"and {more} more like the last one", notes[0].warns)]
