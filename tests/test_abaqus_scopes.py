"""Abaqus's parts, instances and assemblies, each with numbers and names of its own, and what sets are made of."""

from pathlib import Path

import meshio
import numpy as np
import pytest

from petfsi.geometry.meshes import build_mesh
from petfsi.geometry.places import read_tags
from petfsi.geometry.readers.abaqus import read_abaqus
from petfsi.geometry.surfaces import signed_volumes
from petfsi.scene.solids import Solid

ZERO, X, Y, Z = (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)
#: A tetrahedron, and a larger one with the same numbers and names.
NODES = "*NODE\n1, 0,0,0\n2, 1,0,0\n3, 0,1,0\n4, 0,0,1\n"
TET = f"{NODES}*ELEMENT, TYPE=C3D4, ELSET=BODY\n1, 1,2,3,4\n"
LARGE = "*NODE\n1, 0,0,0\n2, 2,0,0\n3, 0,2,0\n14, 0,0,2\n*ELEMENT, TYPE=C3D4, ELSET=BODY\n1, 1,2,3,14\n"
PIN = "*PART, NAME=PIN\n*NODE\n1, 0,0,-9\n*ELEMENT, TYPE=MASS, ELSET=M\n5, 1\n*NSET, NSET=FOOT\n1\n*END PART\n"
RIG = "*PART, NAME=Rig\n*NODE\n1, 7,7,7\n2, 8,8,8\n*ELEMENT, TYPE=R3D3\n9, 1,2,1\n*END PART\n"


def part(content, name="P"):
    return f"*PART, NAME={name}\n{content}*END PART\n"


def assembly(content="", instance="NAME=P-1, PART=P", within=""):
    return f"*ASSEMBLY, NAME=A\n*INSTANCE, {instance}\n{within}*END INSTANCE\n{content}*END ASSEMBLY\n"


def read(tmp_path, text):
    notes: list[str] = []
    path = tmp_path / "m.inp"
    path.write_text(text)
    return read_abaqus(path, notes), notes


def places(mesh):
    """Return where the nodes of each group are, of nodes and of cells."""
    groups = {name: mesh.points[nodes] for name, nodes in mesh.point_sets.items()}
    for name, rows in mesh.cell_sets.items():
        groups[name] = np.concatenate([mesh.points[block.data[of]].reshape(-1, 3)
                                       for block, of in zip(mesh.cells, rows, strict=True)])  # fmt: skip
    return {name: {tuple(x) for x in at.tolist()} for name, at in groups.items()}


LEFT_OUT = "parts that are not instanced are left out: "
BODY = {"BODY": {ZERO, X, Y, Z}}
#: By a file: its points, groups and notes; all are of one tetrahedron of volume 1/6.
PARTS = {
    "flat": (TET, 4, BODY, []),
    "a reference point has a number of the part": (
        part(TET) + assembly("*NODE\n1, 5,-3,-3\n*NSET, NSET=RP\n1,\n*NSET, NSET=FOOT, INSTANCE=P-1\n1,2,3\n"),
        5, {**BODY, "RP": {(5, -3, -3)}, "FOOT": {ZERO, X, Y}}, []),
    "a reference point by its card": (
        part(TET) + assembly("*NODE, NSET=RP\n4, 5,-3,-3\n*NSET, NSET=ALL\nRP, P-1.4\n"),
        5, {**BODY, "RP": {(5, -3, -3)}, "ALL": {(5, -3, -3), Z}}, []),
    "parts around it": (RIG + part(TET) + PIN + assembly(), 4, BODY, [f"{LEFT_OUT}Rig, PIN"]),
    "a part of the same names before it": (
        part(LARGE + "*NSET, NSET=FOOT\n14\n", "Q") + part(TET + "*NSET, NSET=FOOT\n1,2\n") + assembly(),
        4, {**BODY, "FOOT": {ZERO, X}}, [f"{LEFT_OUT}Q"]),
    "a part of the same names after it": (
        part(TET) + part(LARGE, "Q") + assembly(instance="NAME=P-1, PART=p"), 4, BODY, [f"{LEFT_OUT}Q"]),
    "data within the instance": (
        assembly("*NODE\n1, 9,9,9\n*NSET, NSET=S, INSTANCE=I\n1\n", "NAME=I", f"{TET}*NSET, NSET=T\n2\n"),
        5, {**BODY, "S": {ZERO}, "T": {X}}, []),
    "a set within the instance of a part": (
        part(TET) + assembly(within="*NSET, NSET=T\n2\n"), 4, {**BODY, "T": {X}}, []),
    "a part, and no instance": (part(TET) + "*NSET, NSET=T\n2\n", 4, {**BODY, "T": {X}}, []),
    "an instance of a flat file": (
        TET + assembly("*NSET, NSET=T, INSTANCE=P-1\n2\n*NSET, NSET=U\nP-1.T, 3\n"),
        4, {**BODY, "T": {X}, "U": {X, Y}}, []),
    "both have sets of one name, alike and not": (
        part(TET + "*NSET, NSET=S\n1\n*NSET, NSET=T\n1\n")
        + assembly("*NSET, NSET=s, INSTANCE=P-1\n2, 3\n*NSET, NSET=U\nP-1.S\n*NSET, NSET=T, INSTANCE=P-1\n1\n"),
        4, {**BODY, "P-1.S": {ZERO}, "s": {X, Y}, "U": {ZERO}, "T": {ZERO}},
        ["part and assembly each have a set S: that of the part is P-1.S"]),
    "elements of the assembly": (
        part(TET) + assembly("*NODE\n1, 9,9,9\n*ELEMENT, TYPE=CONN3D2\n1, 1, P-1.1\n"),
        5, BODY, ["1 lines of elements of the assembly of type CONN3D2 are not read"]),
    "surfaces of the part": (
        part(TET + "*SURFACE, NAME=S\nBODY, S1\n*SURFACE, NAME=N, TYPE=NODE\n4\n") + PIN
        + assembly("*NODE\n4, 9,9,9\n"), 5, {**BODY, "S": {ZERO, X, Y}, "N": {Z}}, [f"{LEFT_OUT}PIN"]),
    "surfaces of the assembly": (
        part(TET) + assembly("*NODE\n1, 9,9,9\n*ELSET, ELSET=_S, INTERNAL, INSTANCE=P-1\n1\n*SURFACE, NAME=S\n_S, S1\n"
                             "*SURFACE, NAME=T\nP-1.BODY, S3\n*SURFACE, NAME=U\nP-1.1, S3\n"
                             "*SURFACE, TYPE=NODE, NAME=N\n1\n*SURFACE, TYPE=NODE, NAME=M\nP-1.1\n"),
        5, {**BODY, "_S": {ZERO, X, Y, Z}, "S": {ZERO, X, Y}, "T": {X, Y, Z}, "U": {X, Y, Z}, "N": {(9, 9, 9)},
            "M": {ZERO}}, []),
    "both have a surface of one name": (
        part(TET + "*SURFACE, NAME=S\nBODY, S1\n") + assembly("*SURFACE, NAME=S\nP-1.BODY, S3\n"),
        4, {**BODY, "P-1.S": {ZERO, X, Y}, "S": {X, Y, Z}},
        ["part and assembly each have a surface S: that of the part is P-1.S"]),
}  # fmt: skip


@pytest.mark.parametrize("case", PARTS)
def test_the_instanced_part_is_the_body_and_the_assembly_numbers_its_own_nodes(tmp_path, case):
    text, points, groups, told = PARTS[case]
    mesh, notes = read(tmp_path, text)
    [cell] = [block.data[0] for block in mesh.cells if block.type == "tetra"]
    assert len(mesh.points) == points and [tuple(x) for x in mesh.points[cell]] == [ZERO, X, Y, Z]
    assert places(mesh) == groups and notes == told


GONE = "that are not read or not there"
#: Sets of the tetrahedron by cards: where their nodes are, and notes.
SETS = {
    "another, by instance": ("*NSET, NSET=A\n1\n*NSET, NSET=C\nP-1.A, 2\n", {ZERO, X}, []),
    "a number, by instance": ("*NSET, NSET=C\nP-1.3, 2\n", {X, Y}, []),
    "another that comes later": ("*NSET, NSET=C\n1, A\n*NSET, NSET=A\n2\n", {ZERO, X}, []),
    "two that hold each other": ("*NSET, NSET=C\n1, A\n*NSET, NSET=A\n2, C\n", {ZERO, X}, []),
    "thirty that each hold the next": (
        "*NSET, NSET=C\nS1\n" + "".join(f"*NSET, NSET=S{n}\nS{n + 1}\n" for n in range(1, 30)) + "*NSET, NSET=S30\n4\n",
        {Z}, []),
    "nodes of elements": ("*NSET, NSET=C, ELSET=body\n", {ZERO, X, Y, Z}, []),
    "nodes of no elements": (
        "*NSET, NSET=C, ELSET=none\n", set(), [f"sets that sets of nodes name {GONE}: NONE in set C"]),
    "an unknown node, by instance": ("*NSET, NSET=C\nP-1.99, 1\n", {ZERO}, [f"nodes {GONE}: 1 in set C"]),
    "an unknown set": ("*NSET, NSET=C\n1, FUSS\n", {ZERO}, [f"sets that sets of nodes name {GONE}: FUSS in set C"]),
    "unknown nodes": ("*NSET, NSET=C\n1, 98, 99, 99\n", {ZERO}, [f"nodes {GONE}: 2 in set C"]),
    "unknown nodes of a row": ("*NSET, NSET=C, GENERATE\n3, 10\n", {Y, Z}, [f"nodes {GONE}: 6 in set C"]),
    "unknown elements": ("*ELSET, ELSET=C\n1, 98\n", {ZERO, X, Y, Z}, [f"elements {GONE}: 1 in set C"]),
    "an unknown set of elements": (
        "*ELSET, ELSET=C\nBODY, FUSS\n", {ZERO, X, Y, Z}, [f"sets that sets of elements name {GONE}: FUSS in set C"]),
}  # fmt: skip
#: The same in an assembly whose own node 1 is elsewhere.
ASSEMBLED = {
    "nodes of elements of the instance": ("*NSET, NSET=C, INSTANCE=P-1, ELSET=BODY\n", {ZERO, X, Y, Z}, []),
    "nodes of its elements by prefix": ("*NSET, NSET=C, ELSET=P-1.BODY\n", {ZERO, X, Y, Z}, []),
    "sets of the part": ("*NSET, NSET=C, INSTANCE=P-1\nFOOT, 4\n", {ZERO, X, Z}, []),
    "sets of the part by prefix": ("*NSET, NSET=C\nP-1.FOOT\n", {ZERO, X}, []),
    "its own and the part's": ("*NSET, NSET=C\n1\n*NSET, NSET=C, INSTANCE=P-1\n1\n", {(9, 9, 9), ZERO}, []),
    "a node that only the part has": ("*NSET, NSET=C\n1, 2\n", {(9, 9, 9)}, [f"nodes {GONE}: 1 in set C"]),
    "an unknown node of the part": ("*NSET, NSET=C\n1, P-1.99\n", {(9, 9, 9)}, [f"nodes {GONE}: 1 in set C"]),
    "of another instance": (
        "*NSET, NSET=C, INSTANCE=Q-1\n1\n", set(), [f"sets that sets of nodes name {GONE}: Q-1.C in set C"]),
    "a set of another instance": (
        "*NSET, NSET=C\n1, Q-1.FOOT\n", {(9, 9, 9)}, [f"sets that sets of nodes name {GONE}: Q-1.FOOT in set C"]),
}  # fmt: skip


@pytest.mark.parametrize("case", [*SETS, *ASSEMBLED])
def test_members_of_sets_are_found_or_told(tmp_path, case):
    cards, where, told = {**SETS, **ASSEMBLED}[case]
    foot = "*NSET, NSET=FOOT\n1, 2\n"
    text = TET + cards if case in SETS else part(TET + foot) + assembly(f"*NODE\n1, 9,9,9\n{cards}")
    mesh, notes = read(tmp_path, text)
    assert places(mesh)["C"] == where and notes == told


def test_a_number_that_is_not_there_is_none_of_the_assembly(tmp_path):
    """A part's set and surface name node 5, which only the assembly has, and its elements name it, too."""
    cards = "*NSET, NSET=C\n1, 5\n*SURFACE, NAME=S, TYPE=NODE\n5\n"
    mesh, notes = read(tmp_path, part(TET + cards) + assembly("*NODE\n5, 9,9,9\n1, 8,8,8\n"))
    assert places(mesh)["C"] == {ZERO} and "S" not in mesh.point_sets
    assert notes == [f"nodes {GONE}: 1 in set C", f"surface S is not read: it names 1 nodes {GONE}"]
    with pytest.raises(meshio.ReadError, match="nodes that the file does not hold"):
        read(tmp_path, part(TET.replace("1,2,3,4\n", "1,2,3,5\n")) + assembly("*NODE\n5, 9,9,9\n"))


@pytest.mark.parametrize(
    "text, why",
    [
        (part(TET) + part(LARGE, "Q"), "several parts, of which none is instanced"),
        (part(TET) + part(LARGE, "p"), "two parts are called p"),
        (part(TET) + assembly(instance="NAME=Q-1, PART=Q"), "an instance of part Q, which is not there"),
        (part(TET) + assembly(within="1., 0., 0.\n"), "moved or there more than once"),
        (part(TET) + assembly("*INSTANCE, NAME=P-2, PART=P\n*END INSTANCE\n"), "moved or there more than once"),
        (part(TET) + assembly("*NODE\n-3, 0,0,0\n"), "numbers of nodes must be positive"),
    ],
)
def test_parts_that_are_no_one_body_are_refused(tmp_path, text, why):
    with pytest.raises(meshio.ReadError, match=why):
        read(tmp_path, text)


def test_a_body_beside_a_reference_point_has_its_volume_and_its_places(tmp_path):
    text, _, _, _ = PARTS["a reference point has a number of the part"]
    (tmp_path / "m.inp").write_text(RIG + text)
    supports = [{"where": {"tag": "FOOT"}, "fix": ["x"]}]
    solid = Solid.model_validate({"shape": {"mesh": str(tmp_path / "m.inp")}, "density": 1.0, "young": 1.0,
                                  "poisson": 0.3, "supports": supports})  # fmt: skip
    notes: list[str] = []
    points, cells = build_mesh(solid, 3, "solids.b", Path(), notes)
    assert signed_volumes(points, cells) == pytest.approx(1 / 6) and len(points) == 4
    assert "1 points that belong to no cell are left out" in " ".join(notes) and f"{LEFT_OUT}Rig" in " ".join(notes)
    tags = read_tags(solid, 3, "solids.b", Path())
    assert {tuple(x) for x in points[tags["FOOT"].nodes].tolist()} == {ZERO, X, Y}
