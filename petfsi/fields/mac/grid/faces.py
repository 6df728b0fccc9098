"""A quantity on the faces of a grid, with a value of its own for each part of a divided face."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np


class Faces(list[np.ndarray]):
    """A face array per axis.

    Attributes
    ----------
    parts : ndarray, shape (n_links,)
        Values of the parts of all divided faces of the grid, on every rank, in the order of ``parts.Parts``. The
        arrays hold the mean over a divided face's parts, which is there to be looked at.
    """

    def __init__(self, arrays: Iterable[np.ndarray], parts: np.ndarray | None = None) -> None:
        super().__init__(arrays)
        self.parts = np.zeros(0) if parts is None else parts


def each(function: Callable[..., np.ndarray], *faces: Faces) -> Faces:
    """Return what a function makes of the values of one or several quantities, entry by entry."""
    return Faces(
        [function(*arrays) for arrays in zip(*faces, strict=True)], function(*(quantity.parts for quantity in faces))
    )
