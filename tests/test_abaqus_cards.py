"""Abaqus's files in pieces: what an included file holds stands where it is included."""

import meshio
import pytest

from petfsi.geometry.readers.abaqus import read_abaqus
from petfsi.geometry.readers.abaqus_cards import read_cards
from petfsi.geometry.readers.included import DEPTH
from petfsi.output.mesh_files import _with_companions

NODES = ["1, 0., 0.", "2, 1., 0.", "3, 2., 0.", "4, 0., 1.", "5, 1., 1.", "6, 2., 1."]
ELEMENTS = ["1, 1, 2, 5, 4", "2, 2, 3, 6, 5"]
WHOLE = ["*NODE", *NODES, "*ELEMENT, TYPE=CPE4, ELSET=all", *ELEMENTS, "*NSET, NSET=foot", "1, 2,", "3",
         "*SURFACE, NAME=low", "1, S1", "2, S1"]  # fmt: skip


def read(path):
    """Return all that is read of a file, to be compared."""
    mesh = read_abaqus(path, [])
    groups = {name: [part.tolist() for part in parts] for name, parts in mesh.cell_sets.items()}
    sets = {name: part.tolist() for name, part in mesh.point_sets.items()}
    return mesh.points.tolist(), [(block.type, block.data.tolist()) for block in mesh.cells], groups, sets


@pytest.mark.parametrize("include", ["*INCLUDE, INPUT={}", '  *include ,\n** which\n\n Input = "./{}"'])
def test_lines_stand_where_they_are_included_wherever_a_file_is_cut(tmp_path, include):
    """Nodes, elements, members of sets and of surfaces, without the card that they go on with, and what follows."""
    whole = tmp_path / "whole.inp"
    whole.write_text("\n".join(WHOLE))
    path, part = tmp_path / "m.inp", tmp_path / "a part.inc"
    for begin in range(1, len(WHOLE)):
        for end in (begin + 1, begin + 3, len(WHOLE)):
            part.write_text("\n".join(WHOLE[begin:end]), encoding="utf-8-sig")
            path.write_text("\n".join([*WHOLE[:begin], include.format(part.name), *WHOLE[end:]]))
            assert read(path) == read(whole), (begin, end)
    assert [file.name for file in _with_companions(path)] == ["m.inp", part.name]


def chain(folder, depth):
    """Write files of which each includes the next, and the last holds a node and goes on with the first's set."""
    for n in range(depth):
        (folder / f"{n}.inp").write_text(f"*NSET, NSET=S{n},\n*INCLUDE, INPUT={n + 1}.inp\n{n}\n")
    (folder / f"{depth}.inp").write_text("9\n*NSET, NSET=last\n")
    return folder / "0.inp"


def test_files_include_others_down_to_a_depth(tmp_path):
    found = list(read_cards(chain(tmp_path, DEPTH)))
    assert [given["NSET"] for _, given, _ in found] == [*(f"S{n}" for n in range(DEPTH)), "last"]
    assert [lines for *_, lines in found[-2:]] == [["9"], [str(n) for n in reversed(range(DEPTH))]]
    with pytest.raises(meshio.ReadError, match=f"6.inp: files may include others at most {DEPTH} files deep"):
        list(read_cards(chain(tmp_path, DEPTH + 1)))


def test_files_that_include_each_other_are_refused(tmp_path):
    (tmp_path / "a.inp").write_text("*NODE\n*INCLUDE, INPUT=b.inp\n")
    (tmp_path / "b.inp").write_text("1, 0., 0.\n*INCLUDE, INPUT=a.inp\n")
    with pytest.raises(meshio.ReadError, match="INCLUDE of a.inp: it includes itself"):
        list(read_cards(tmp_path / "a.inp"))


def test_a_card_without_nodes_is_refused_as_such(tmp_path):
    path = tmp_path / "m.inp"
    path.write_text("*NODE\n*ELEMENT, TYPE=CPE4\n1, 1, 2, 3, 4\n")
    with pytest.raises(meshio.ReadError, match="no nodes"):
        read_abaqus(path, [])
