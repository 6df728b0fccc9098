"""What notes say of plates does not depend on where these lie, which way, and in which unit they are measured."""

import itertools
import math

import numpy as np
import pytest
from test_notes import beam, scene

from petfsi.notes.bending import widest_span
from petfsi.notes.forms import _mesh
from petfsi.notes.notes import find_notes

ANGLES, OFFSETS, UNITS = (0, 10, 30, 45, 77), (0.0, 3.7, 1e3), (1e-3, 1.0, 1e3)  # degrees, plates' lengths, m


def turned(angle, dim=2):
    """Return a rotation; in 3D about two axes, one after the other."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    if dim == 2:
        return np.array([[c, -s], [s, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def meshed(size, cells):
    """Return a box of simplices about the origin."""
    ends = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, cells, strict=True)]
    points = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, len(size))
    number = np.arange(len(points)).reshape([n + 1 for n in cells])
    parts = []
    for way in itertools.permutations(range(len(size))):
        corners = np.cumsum([np.zeros(len(size), dtype=int), *np.eye(len(size), dtype=int)[list(way)]], axis=0)
        picks = [tuple(slice(o, o + n) for o, n in zip(corner, cells, strict=True)) for corner in corners]
        parts.append(np.stack([number[pick].ravel() for pick in picks], axis=1))
    return points, np.concatenate(parts)


def plate_in_water(directory, kind, thickness, angle, offset, unit, cell):
    """Return the notes on how many cells a plate of length 1 is across, and how many that is where cells are square."""
    way, there = turned(angle), np.full(2, offset)
    fluid = {"density": 1000.0, "origin": ((there - 2.0) * unit).tolist(), "size": [4.0 * unit] * 2,
             "cells": [round(4.0 / h) for h in cell]}  # fmt: skip
    points, cells = meshed((1.0, thickness), (50, 2))
    meshes = {"b": ((points @ way.T + there) * unit, cells)} if kind == "mesh" else {}
    ends = ((np.array([[-0.5, 0.0], [0.5, 0.0]]) @ way.T + there) * unit).tolist()
    strip = {"beam": {"start": ends[0], "end": ends[1], "thickness": thickness * unit, "elements": 10}}
    made = scene(beam() | {"shape": strip if kind == "beam" else {"mesh": "b.msh"}}, fluid, directory=directory)
    said = [note.text for note in find_notes(made, meshes, 0.01) if "cells across" in note.text]
    along, across = way.T / cell  # as the grid draws a unit along the plate, and across it
    return said, thickness * abs(along[0] * across[1] - along[1] * across[0]) / math.hypot(*along)


@pytest.mark.parametrize("cell", [(0.1, 0.1), (0.1, 0.02)], ids=["square", "flat"])
@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("kind", ["beam", "mesh"])
def test_plates_are_as_many_cells_across_wherever_they_lie(tmp_path, kind, angle, cell):
    (tmp_path / "b.msh").touch()  # what is in it is given
    for offset, unit in itertools.product(OFFSETS, UNITS):
        said, across = plate_in_water(tmp_path, kind, 0.0233, angle, offset, unit, cell)
        assert len(said) == 1 and f"b is {across:.2g} of the fluid's cells across where it is thinnest" in said[0]
        thin = 3.99 / across * 0.0233
        said, across = plate_in_water(tmp_path, kind, thin, angle, offset, unit, cell)
        assert across == pytest.approx(3.99) and len(said) == 1 and "b is 3.99 of the fluid's cells" in said[0]
        assert plate_in_water(tmp_path, kind, thin * 4.0 / 3.99, angle, offset, unit, cell)[0] == []


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("size", "cells"), [((0.05, 1, 1), (1, 8, 8)), ((0.05, 1, 1.05), (1, 8, 8)),
                                             ((0.05, 1, 2), (1, 8, 8)), ((0.05, 0.05, 1), (2, 2, 20))])  # fmt: skip
def test_plates_from_files_bend_as_boxes_do_wherever_they_lie(size, cells, angle):
    """By tetrahedra, clamped at one side; the sides of a square are no principal axes more than its diagonals."""
    points, parts = meshed(size, cells)
    side = 1 if size[1] == 1 else 2
    fixed = np.repeat(points[:, [side]] == -0.5, 3, axis=1)
    for offset, unit in itertools.product(OFFSETS, UNITS):
        form = _mesh((points @ turned(angle, 3).T + offset) * unit, parts)
        assert form.lengths == pytest.approx(np.array(size) * unit, rel=1e-6)
        span = widest_span(form, fixed)
        assert span.ends == ("clamped", "free") and span.length == pytest.approx(unit, rel=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_a_film_from_a_file_is_as_thin_as_it_is(angle):
    for slender in (1e3, 1e5, 1e7):
        points, cells = meshed((1.0, 1 / slender), (50, 1))
        assert _mesh(points @ turned(angle).T, cells).thickness == pytest.approx(1 / slender, rel=1e-5)
