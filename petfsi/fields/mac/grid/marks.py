"""What is marked on the grid, and what lies near it."""

from __future__ import annotations

import numpy as np
from numba import njit


def beside(cells: np.ndarray, axis: int) -> np.ndarray:
    """Return which faces of an axis have a marked cell next to them."""
    faces = np.zeros([n + (b == axis) for b, n in enumerate(cells.shape)], dtype=bool)
    view, marked = np.moveaxis(faces, axis, 0), np.moveaxis(cells, axis, 0)
    view[:-1] |= marked
    view[1:] |= marked
    return faces


def faces_below(cells: np.ndarray, axis: int) -> np.ndarray:
    """Return which faces of an axis have a marked cell above them; the last ones, which have none, below them."""
    return np.concatenate((cells, cells.take([-1], axis=axis)), axis=axis)


def spread(marked: np.ndarray, axis: int, reach: int) -> np.ndarray:
    """Return which entries have a marked one within so many along an axis."""
    lines = np.ascontiguousarray(marked).view(np.uint8)
    lines = lines.reshape(int(np.prod(marked.shape[:axis])), -1)
    out = lines.copy()
    if marked.any():
        stride = lines.shape[1] // marked.shape[axis]
        _spread(lines, out, stride, min(reach, marked.shape[axis] - 1))
    return out.view(bool).reshape(marked.shape)


@njit(cache=True)
def _spread(lines, out, stride, reach):
    """Mark what lies within so many strides of what is marked in each line."""
    for m in range(len(lines)):
        for n in range(1, reach + 1):
            # slices: indices that might count from the end are no vectors' work
            _join(out[m, : -n * stride], lines[m, n * stride :])
            _join(out[m, n * stride :], lines[m, : -n * stride])


@njit(cache=True, inline="always")
def _join(out, line):
    for i in range(len(line)):
        out[i] |= line[i]
