"""Nastran's bulk data in all its forms (*MSC Nastran Quick Reference Guide*, "Format of Bulk Data Entries")."""

from pathlib import Path

import numpy as np
import pytest

from petfsi.errors import InputError
from petfsi.geometry.mesh_files import open_mesh
from petfsi.geometry.meshes import build_mesh
from petfsi.geometry.places import read_tags
from petfsi.output.mesh_files import _with_companions
from petfsi.scene.schema import Solid
from petfsi.scene.solids import Support

#: A unit cube with a pyramid of height 1 on it, of property 2.
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1), (0.5, 0.5, 2)]
NODES = "".join(f"GRID    {n:<8}        {x:<8.3f}{y:<8.3f}{z:<8.3f}\n" for n, (x, y, z) in enumerate(CORNERS, 1))
CUBE = "CHEXA   1       1       1       2       3       4       5       6\n               7       8\n"
TOP = "CPYRAM  2       2       5       6       7       8       9\n"
VOLUME = 1.0 + 1.0 / 3.0


def solid(path, cells=None):
    shape = {"mesh": str(path), "cells": cells}
    return Solid.model_validate({"shape": shape, "density": 1.0, "young": 1.0, "poisson": 0.3})


def read(tmp_path, text, dim=3, name="m.bdf", cells=None):
    """Return the size of what a solid takes, and what is told."""
    notes = []
    (tmp_path / name).write_text(text)
    points, simplices = build_mesh(solid(tmp_path / name, cells), dim, "solids.b", Path(), notes)[:2]
    edges = points[simplices[:, 1:]] - points[simplices[:, :1]]
    return np.abs(np.linalg.det(edges)).sum() / (2.0 if dim == 2 else 6.0), notes


def large(name, *fields):
    rows = [fields[at : at + 4] for at in range(0, len(fields), 4)]
    heads = [f"{name}*", *["*"] * len(rows)]
    return "".join(
        f"{head:8}" + "".join(f"{f:<16}" for f in row) + "\n" for head, row in zip(heads, rows, strict=False)
    )


FORMS = {
    "short lines": NODES + CUBE + TOP,
    "lines of 80": "\n".join(line.ljust(80) for line in (NODES + CUBE + TOP).split("\n")),
    "marks": NODES + CUBE.replace("6\n        ", "6       +1\n+1      ") + TOP,
    "free": NODES + "chexa,1,1,1,2,3,4,5,6,+\n+,7,8\ncpyram,2,2,5,6,7,8,9\n",
    "free without marks": NODES + "CHEXA, 1,1, 1,2,3, 4,5,6\n, 7,8\n" + TOP,
    "tabs": NODES + "CHEXA\t1\t1\t1\t2\t3\t4\t5\t6\n\t7\t8\n" + TOP,
    "large": "".join(large("GRID", n, "", *x) for n, x in enumerate(CORNERS, 1))
    + large("CHEXA", 1, 1, *range(1, 9)) + TOP,
    "large exponents": "".join(large("GRID", n, 0, *(f"{10.0 * v:.1f}-1" for v in x)) for n, x in enumerate(CORNERS, 1))
    + CUBE + TOP,
    "double": NODES.replace("1.000   ", "10.D-1  ") + CUBE + TOP,
    "executive": f"SOL 101\nCEND\nSPC = 1\nBEGIN BULK\n{NODES}{CUBE}{TOP}ENDDATA\nCHEXA,9,9\n",
    "comments": NODES.replace("\n", " $ here\n$ of nothing\n\n") + CUBE + TOP,
    "any order": TOP + CUBE + NODES,
    "windows": (NODES + CUBE + TOP).replace("\n", "\r\n"),
    "not elements": NODES + CUBE + TOP + "CORD2R,5,,0.,0.,0.,0.,0.,1.,+\n+,1.,0.,0.\nCAERO1,1,1\n",
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ("m.bdf", "m.NAS", "m.dat"))
def test_every_form_of_cards_is_read(tmp_path, form, name):
    found, notes = read(tmp_path, FORMS[form], name=name)
    assert found == pytest.approx(VOLUME, rel=1e-12)
    assert len(notes) == 3  # what is cut, and that there are groups
    assert read(tmp_path, FORMS[form], name=name, cells="2")[0] == pytest.approx(1.0 / 3.0, rel=1e-12)


def quadratic(name, corners, edges):
    x = np.array(corners, dtype=float)
    x = np.concatenate((x, x[np.array(edges)].mean(axis=1)))
    nodes = "".join(f"GRID,{n},,{','.join(map(str, row))}\n" for n, row in enumerate(x, 1))
    fields = [name, "1", "1", *map(str, range(1, len(x) + 1))]
    rows = [fields[:9]] + [["", *fields[at : at + 8]] for at in range(9, len(fields), 8)]
    return nodes + "".join(",".join(row) + "\n" for row in rows)


BOTTOM, TOPS = [(0, 1), (1, 2), (2, 3), (3, 0)], [(4, 5), (5, 6), (6, 7), (7, 4)]
QUADRATIC = {
    "CHEXA": (CORNERS[:8], [*BOTTOM, (0, 4), (1, 5), (2, 6), (3, 7), *TOPS], 1.0),
    "CPENTA": ([*CORNERS[:3], *CORNERS[4:7]],
               [(0, 1), (1, 2), (2, 0), (0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)], 0.5),
    "CTETRA": ([*CORNERS[:3], CORNERS[4]], [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)], 1.0 / 6.0),
    "CPYRAM": (CORNERS[4:], [*BOTTOM, (0, 4), (1, 4), (2, 4), (3, 4)], 1.0 / 3.0),
}  # fmt: skip


@pytest.mark.parametrize("name", QUADRATIC)
def test_nodes_within_edges_are_where_they_belong(tmp_path, name):
    """None is told to be beside the middle of its edge."""
    corners, edges, volume = QUADRATIC[name]
    text = quadratic(name, corners, edges)
    found, notes = read(tmp_path, text)
    assert found == pytest.approx(volume, rel=1e-12) and not any("beside the middles" in note for note in notes)
    block = open_mesh(solid(tmp_path / "m.bdf").shape, "k", Path()).mesh
    x, nodes = np.asarray(block.points), block.cells[0].data[0]
    # meshio's own order of wedges and hexahedra: bottom, top, then the edges between
    order = {
        "CHEXA": [*BOTTOM, *TOPS, (0, 4), (1, 5), (2, 6), (3, 7)],
        "CPENTA": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    }.get(name, edges)
    np.testing.assert_allclose(x[nodes[len(corners) :]], x[nodes[np.array(order)]].mean(axis=1), atol=1e-14)
    found, notes = read(tmp_path, text[: text.rindex(",")] + "\n")
    assert found == pytest.approx(volume, rel=1e-12)
    assert "1 elements" in str(notes) and "lack nodes within their edges" in str(notes)


def test_flat_elements_of_every_family(tmp_path):
    square = "".join(f"GRID,{n},,{x}.,{y}.,0.\n" for n, (x, y) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)], 1))
    middles = "GRID,5,,.5,0.,0.\nGRID,6,,1.,.5,0.\nGRID,7,,.5,.5,0.\n"
    for text, area in (
        ("CQUAD4,1,1,1,2,3,4,0.,0.\n", 1.0),
        ("CQUADR,1,1,1,2,3,4\n", 1.0),
        ("CPLSTN3,1,1,1,2,3\nCTRIA3,2,1,1,3,4,30.\n", 1.0),
        ("CPLSTS4,1,1,1,2,3,4\n", 1.0),
        (middles + "CTRIA6,1,1,1,2,3,5,6,7\n", 0.5),
        (middles + "CTRIAX6,1,1,1,5,2,6,3,7\n", 0.5),
    ):
        found, notes = read(tmp_path, square + text, dim=2)
        assert found == pytest.approx(area, rel=1e-12) and not any("beside" in note for note in notes)


def test_what_is_read_and_not_used_is_named(tmp_path):
    text = NODES + CUBE + TOP + "CBUSH,5,2,1,7\nCELAS1,6,1,1,1\nCELAS1,7,1,1,1\nCFOO,1\n"
    assert [note.split(": ")[1] for note in read(tmp_path, text)[1][:3]] == [
        "1 cards CBUSH are not read", "2 cards CELAS1 are not read", "1 cards CFOO are not read",
    ]  # fmt: skip


def test_files_that_are_included_are_read_and_kept(tmp_path):
    (tmp_path / "cube.txt").write_text(CUBE[:66] + "\ninclude 'rest.inc'\n")
    (tmp_path / "rest.inc").write_text(CUBE[65:].lstrip("\n"))
    assert read(tmp_path, f"{NODES}INCLUDE cube.txt\n{TOP}", name="m.dat")[0] == pytest.approx(VOLUME, rel=1e-12)
    kept = [path.name for path in _with_companions(tmp_path / "m.dat")]
    assert kept == ["m.dat", "cube.txt", "rest.inc"]


@pytest.mark.parametrize(
    "text, told",
    [
        (NODES.replace("GRID    1               ", "GRID    1       3       ") + CUBE, "coordinates of their own"),
        ("GRDSET,,5\n" + NODES + CUBE, "coordinates of their own"),
        (NODES + "INCLUDE '../m.bdf'\n", "beside the file that includes it"),
        (NODES + "INCLUDE 'm.bdf'\n", "includes itself"),
        (NODES + "INCLUDE gone.bdf\n", "it needs gone.bdf"),
        ("BEGIN BULK\n" + NODES + CUBE + "BEGIN SUPER=2\n" + NODES, "parts with nodes of their own"),
        (NODES + "=,*1,=\n" + CUBE, "repeat others"),
        (NODES + "CHEXA,1,1,1,2,3,4,5,6,+A\n+B,7,8\n", "elsewhere than right after"),
        (NODES + "CHEXA,1,1,1,2,3,4,5,6,7,8,9\n", "more than 10 fields"),
        (NODES + "CHEXA,1,1,1,2,3,4,5,6\n", "have not 8 nodes"),
        (NODES + "CTETRA,1,1,1,2,3,44\n", "name nodes that the file does not hold"),
        ("BEGIN BULK\n" + CUBE, "no nodes"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_by_name(tmp_path, text, told):
    with pytest.raises(InputError, match=told):
        read(tmp_path, text)


def test_the_number_of_an_elements_property_is_a_place(tmp_path):
    path = tmp_path / "m.bdf"
    path.write_text(NODES + CUBE + TOP + "CQUAD4,9,7,1,2,3,4\n")
    support = Support.model_validate({"where": {"tag": "7"}, "fix": ["x"]})
    held = solid(path).model_copy(update={"supports": [support]})
    assert read_tags(held, 3, "solids.b", Path())["7"].nodes.tolist() == [0, 1, 2, 3]
