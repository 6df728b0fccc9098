"""Inputs that nobody means: refused in a moment, by name, on a screen, with nothing made and nothing written."""

import copy
import os
import random
import time

import pytest

from petfsi.cli import main
from petfsi.errors import InputError
from petfsi.messages import COLUMNS, ROWS, screen, shown
from petfsi.runs import memory
from petfsi.scene.load import apply_set, load_scene, scene_from_dict

BOX = {"origin": [0.4, 0.4], "size": [0.2, 0.2], "cells": [2, 2]}
SCENE = {
    "dim": 2,
    "gravity": [0.0, -9.81],
    "time": {"end": 0.1, "dt": 0.01},
    "fluid": {"density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [8, 8], "sides": {"top": "open"}},
    "solids": {"b": {"shape": {"box": BOX}, "density": 1100.0, "young": 1e5, "poisson": 0.3}},
    "probes": {"p": {"of": "b", "at": [0.5, 0.5], "quantity": "velocity"}},
}


def with_sets(*sets):
    data = copy.deepcopy(SCENE)
    for text in sets:
        apply_set(data, text)
    return data


def refusal(*sets):
    with pytest.raises(InputError) as caught:
        scene_from_dict(with_sets(*sets))
    return str(caught.value)


@pytest.mark.parametrize(
    "setting, said",
    [
        ("fluid.density=1e308", "fluid.density = 1e+308: must be at most 1e+30"),
        ("fluid.density=5e-324", "fluid.density = 5e-324: must be at least 1e-30"),
        ("fluid.origin=[1e18, 0.0]", "fluid.origin.0 = 1e+18: lies more than 1e+08 of fluid's cells"),
        ("fluid.size=[1.0, 1e-9]", "fluid.size = [1.0, 1e-09]: makes cells of 0.125 x 1.25e-10 m"),
        ("time.dt=1e-300", "time.dt = 1e-300: "),
        ("solids.b.density=1e29", "solids.b.density = 1e+29: is 1e+26 times fluid.density"),
        ("solids.b.shape.box.size=[1e-14, 1e-14]", "solids.b.shape.box = [1e-14, 1e-14]: has elements of 5e-15 m"),
        ("gravity.1=-1e12", "gravity.1 = -1000000000000.0: leads 1e+08 m in a step, in a scene of 1 m"),
        ('gravity.1="-1e12"', "gravity.1 = -1000000000000.0: leads 1e+08 m in a step"),
        ("solids.b.initial.velocity=[1e9, 0.0]", "solids.b.initial.velocity.0 = 1000000000.0: leads 1e+07 m"),
        ("output.every=1e-12", "output.every = 1e-12: makes 1e+11 of them"),
        ('solids.b.loads=[{where="top", pressure=1e20}]', "loads.0.pressure = 1e+20: is more than 1e+09 times"),
        (
            "obstacles.o.shape.halfspace={point=[0.0, 0.0], normal=[5e-324, 0.0]}",
            "obstacles.o.shape.halfspace.normal = [5e-324, 0.0]: its largest part must be at least 1e-30",
        ),
    ],
)
def test_absurd_numbers_are_refused_beside_their_neighbours(setting, said):
    assert said in refusal(setting)


def test_what_is_merely_unusual_is_taken():
    for sets in (
        ["fluid.density=1e-4"],
        ["solids.b.young=1e12"],
        ["solids.b.young=1e-2"],
        ["time.end=1e5", "time.dt=1.0", "gravity.1=-1e-5"],
        ["fluid.origin=[-1e5, 0.0]", "solids.b.shape.box.origin=[-99999.5, 0.4]", "probes.p.at=[-99999.5, 0.5]"],
    ):
        scene_from_dict(with_sets(*sets))


@pytest.mark.parametrize(
    "text",
    ["a.b.c=" + "[" * 50 + "]" * 50, "x=" + "9" * 5000, "x=0x" + "f" * 9000, "a=" + "[" * 3000],
    ids=["lists", "digits", "hexadecimal", "open lists"],
)
def test_values_too_deep_or_too_long_are_refused(text):
    with pytest.raises(InputError, match="nested|64 bits|too many digits"):
        apply_set({}, text)


@pytest.mark.parametrize(
    "content, said",
    [
        (b"a = " + b"9" * 5000, "64 bits"),
        (b"a = " + b"{a=" * 5000, "nested deeper"),
        (b".".join([b"a"] * 20000) + b" = 1", "nested deeper"),
        (b".".join([b'"a"'] * 20000) + b" = 1", "nested deeper"),
        (b"a" * 5_000_000, "more than 4,000,000 bytes"),
        (b"\xef\xbb\xbfdim = 2", "byte order mark"),
        (b"dim = 2\n\0", "null character (line 2)"),
        (b'title = "' + b"x" * 9000 + b'"', "a text may have 5000 characters, not 9000"),
        (b"k" * 9000 + b" = 1", "a key may have 200 characters, not 9000"),
    ],
    ids=["digits", "tables", "dots", "dots in quotes", "size", "mark", "null", "text", "key"],
)
def test_no_text_takes_long(tmp_path, content, said):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert said in str(caught.value) and time.process_time() - begin < 2.0


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="a device or a pipe"):
            load_scene(path)
    (tmp_path / "dir").mkdir()
    for name in ("dir", "pipe"):
        shape = {"mesh": str(tmp_path / name)}
        with pytest.raises(InputError, match="is no file but"):
            scene_from_dict({**SCENE, "obstacles": {"o": {"shape": shape}}})
    for mesh in ("~nobody_of_this_name/x.msh", "a\0b", "x" * 4000):
        with pytest.raises(InputError, match="obstacles.o.shape.mesh"):
            scene_from_dict({**SCENE, "obstacles": {"o": {"shape": {"mesh": mesh}}}}, tmp_path)


def test_messages_are_cut_and_show_control_characters():
    assert shown("a\x1b[2J\n\u202eb") == "a\\x1b[2J\\n\\u202eb"
    assert len(shown("x" * 10**6)) == 60 and shown("start" + "x" * 100 + "end.msh").endswith("end.msh")
    assert shown(10**5000).endswith("digits")
    long = screen("\n".join("x" * 300 for _ in range(100)))
    rows = sum(-(-len(line) // COLUMNS) for line in long.split("\n"))
    assert rows <= ROWS and "more lines" in long


def test_keys_and_names_of_files_are_shown_harmless(tmp_path, capsys):
    bad = tmp_path / "a\x1b[31m\nb.toml"
    bad.write_text('"k\\u001b[2J' + "y" * 150 + '" = 1\n"' + "z" * 150 + '" = "\\u0007"\n')
    assert main(["check", str(bad)]) == 2
    said = capsys.readouterr().err
    assert "\x1b" not in said and "\x07" not in said and "\\x1b[31m\\nb.toml" in said and "\\x1b[2J" in said


def test_memory_is_compared_before_anything_is_made():
    scene = scene_from_dict(with_sets("fluid.cells=[40000, 40000]"))
    with pytest.raises(InputError, match=r"fluid.cells = \[40000, 40000\]: the scene takes about 1.* TB of memory"):
        memory.refuse_too_large(scene, available=64e9)
    small = scene_from_dict(SCENE)
    memory.refuse_too_large(small, available=1e9, ranks=(3, 3))
    with pytest.raises(InputError, match="on 8 ranks.*fewer ranks here"):
        memory.refuse_too_large(small, available=1e9, ranks=(8, 8))
    memory.refuse_too_large(small, available=1e9, ranks=(8, 2))
    particles = with_sets(
        "fluid.kind=sph", "fluid.spacing=0.05", "fluid.fill=[{box={origin=[0.0, 0.0], size=[1.0, 0.3]}}]"
    )
    del particles["fluid"]["cells"]
    apply_set(particles, "solids.b.shape.box={origin=[0.4, 0.4], size=[0.2, 9e4], cells=[2, 2]}")
    with pytest.raises(InputError, match="solids.b.shape: beside fluid.spacing = 0.05: the scene takes about"):
        memory.refuse_too_large(scene_from_dict(particles), available=1e9)


def test_control_groups_limit_memory(tmp_path):
    root, own = tmp_path / "cgroup", tmp_path / "own"
    for folder, files in {
        "memory/job": {"memory.limit_in_bytes": "5000", "memory.usage_in_bytes": "2000"},
        "memory": {"memory.limit_in_bytes": "9000", "memory.usage_in_bytes": "1000"},
        "job": {"memory.max": "max", "memory.current": "7"},
    }.items():
        (root / folder).mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (root / folder / name).write_text(text + "\n")
    own.write_text("4:memory:/job\n3:cpu:/job\n0::/job\n")
    assert sorted(memory._control_groups(root, own)) == [3000.0, 8000.0]
    assert 0 < memory.available_bytes() < float("inf")


def test_check_and_run_find_a_probe_outside_its_body(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    from petfsi.scene.dump import dump_scene

    scene.write_text(dump_scene(scene_from_dict(with_sets("probes.p.at=[0.9, 0.9]"))))
    for words in (["check", str(scene)], ["run", str(scene), "--out", str(tmp_path / "out")]):
        assert main(words) == 2
        assert "probes.p: a probe of solids.b at [0.9, 0.9] lies" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_thousand_bodies_are_checked_in_a_moment():
    disk = SCENE["solids"]["b"]
    solids = {
        f"b{n}": {**disk, "shape": {"ball": {"centre": [n % 45 + 0.5, n // 45 + 0.5], "radius": 0.3, "cells": 2}}}
        for n in range(2000)
    }
    data = {**SCENE, "solids": solids, "probes": {}}
    data["fluid"] = {**SCENE["fluid"], "size": [45.0, 45.0], "cells": [90, 90]}
    begin = time.process_time()
    scene_from_dict(data)
    assert time.process_time() - begin < 2.5
    solids["b97"]["shape"]["ball"]["radius"] = 0.8
    with pytest.raises(InputError) as caught:
        scene_from_dict(data)
    assert str(caught.value).count("overlaps") == 4


EXTREMES = [1e308, -1e308, 5e-324, 1e18, -1, 0, 2**63, 10**400, True, "", "\x1b[2J", "9**9**9**9", "1/0", "x" * 2000]
EXTREMES += ["(" * 300 + ")" * 300, [], [1.0], [[[]]], {}, {"a": 1}, {"box": {}}, None]


def _places(value, path=()):
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from _places(value[key], (*path, key))


def test_any_mutation_is_taken_or_refused_by_name():
    chance = random.Random(7)
    for _ in range(300):
        data = copy.deepcopy(SCENE)
        for _ in range(chance.choice([1, 1, 2, 3])):
            *path, last = chance.choice(list(_places(data)))
            holder = data
            for key in path:
                holder = holder[key]
            value = chance.choice(EXTREMES)
            if value is None:
                del holder[last]
            else:
                holder[last] = copy.deepcopy(value)
        try:
            scene_from_dict(data)
        except InputError as error:
            assert "\x1b" not in str(error) and len(str(error).splitlines()) <= ROWS
