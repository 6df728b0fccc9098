"""A run directory vouches for itself: whatever is edited, lost, linked or crafted is told, and costs nothing else.

All in one process: a run is made once, stopped after six of eight steps, and copied for every edit. About 30 s.
"""

import json
import os
import re
import shutil
import warnings
from pathlib import Path
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import pytest

from petfsi.output import files
from petfsi.output.growing import GrowingXml
from petfsi.output.manifest import Mark, read_manifest
from petfsi.output.outputs import Written
from petfsi.output.stored_state import fault

#: Two triangles, pulled to the right; checkpoints after steps 2, 4, 6 and 8.
MESH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
4
1 0 0 0
2 1 0 0
3 1 1 0
4 0 1 0
$EndNodes
$Elements
2
1 2 2 1 1 1 2 3
2 2 2 1 1 1 3 4
$EndElements
"""
SCENE = """
dim = 2
[time]
end = 0.8
dt = 0.1
integrator = "bdf2"
[solids.b]
shape = { mesh = "square.msh" }
density = 1.0
young = 1000.0
poisson = 0.0
supports = [{ where = "left", fix = ["x", "y"] }]
loads = [{ where = "right", traction = [1.0, 0.0] }]
[probes.tip]
of = "b"
at = [1.0, 0.5]
quantity = "displacement"
[output]
every = 0.1
[checkpoint]
every = 0.2
keep = 2
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a folder with the scene, its mesh, a run to the end, and one that was stopped; copy it before use."""
    from petfsi import cli

    folder = tmp_path_factory.mktemp("made")
    (folder / "square.msh").write_text(MESH)
    (folder / "square.toml").write_text(SCENE)
    scene = str(folder / "square.toml")
    assert cli.main(["run", scene, "--out", str(folder / "straight")]) == 0
    assert cli.main(["run", scene, "--out", str(folder / "run"), "--steps", "6"]) == 0
    return folder


@pytest.fixture
def run(made, tmp_path, monkeypatch):
    """Return a copy of the stopped run; beside it ``outside`` is what no run may touch."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made / "run", "run")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "000001.h5").write_bytes(b"precious")
    (tmp_path / "outside" / "history.csv").write_bytes((made / "run" / "history.csv").read_bytes())
    return Path("run")


def everything(directory):
    """Return what is in a directory, by path: bytes, or where a link points."""
    found = {}
    for path in sorted(Path(directory).rglob("*")):
        if path.is_symlink():
            found[str(path)] = os.readlink(path)
        elif path.is_file():
            found[str(path)] = path.read_bytes()
    return found


def replaced(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def flipped(path, at=-9):
    data = bytearray(path.read_bytes())
    data[at] ^= 4
    path.write_bytes(data)


def linked(path, to):
    path.unlink(missing_ok=True)
    path.symlink_to(Path(to).absolute())


def linked_directory(path, to="outside"):
    path.rename(f"{path.name}-away")
    path.symlink_to(Path(to).absolute())


def without_line(path, number):
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:number] + lines[number + 1 :]))


def piped(path):
    path.unlink()
    os.mkfifo(path)


def appended(path, text):
    path.write_bytes(path.read_bytes() + text.encode())


def of_old_format(run):
    (run / ".petfsi-run").write_text('{"petfsi": "0.0.9"}\n')


#: By name what is done to a stopped run, and what it is refused with.
REFUSED = {
    "a setting": (lambda r: replaced(r / "scene.toml", "young = 1000.0", "young = 2000.0"), "scene.toml has been"),
    "a comment in the scene": (lambda r: appended(r / "scene.toml", "# mine\n"), "scene.toml has been"),
    "no TOML": (lambda r: (r / "scene.toml").write_text("dim = = 2"), "scene.toml has been"),
    "no scene": (lambda r: (r / "scene.toml").unlink(), "scene.toml is missing"),
    "a link for a scene": (lambda r: linked(r / "scene.toml", "../made.toml"), "scene.toml: it is a link"),
    "an option": (lambda r: appended(r / "options.opts", "-fsi_ksp_rtol 1e-3\n"), "options.opts has been changed"),
    "no options": (lambda r: (r / "options.opts").unlink(), "options.opts is missing"),
    "another mesh": (lambda r: replaced(r / "meshes/1/square.msh", "2 1 0 0", "2 1.2 0 0"), "is another mesh"),
    "no mesh": (lambda r: (r / "meshes/1/square.msh").unlink(), "square.msh, the run's mesh: No such file"),
    "meshes elsewhere": (lambda r: linked_directory(r / "meshes"), "run/meshes is a link, and petfsi follows none"),
    "a number of a row": (lambda r: replaced(r / "history.csv", "\n3,0.3", "\n3,0.4"), "its content has been changed"),
    "no number in a row": (lambda r: replaced(r / "history.csv", "\n3,0.3", "\n3,x.3"), "line 5: not a row of"),
    "a row less": (lambda r: without_line(r / "history.csv", 3), "it has 6 rows and should have 7 or more"),
    "the last row less": (lambda r: without_line(r / "history.csv", 7), "it has 6 rows and should have 7 or more"),
    "a column's name": (lambda r: replaced(r / "history.csv", "tip.x", "tap.x"), "its content has been changed"),
    "an empty history": (lambda r: (r / "history.csv").write_text(""), "it has 0 rows and should have 7"),
    "no history": (lambda r: (r / "history.csv").unlink(), "it is missing; put it back"),
    "a link for a history": (lambda r: linked(r / "history.csv", "outside/history.csv"), "it is a link"),
    "a pipe for a history": (lambda r: piped(r / "history.csv"), "history.csv is not the one"),
    "output elsewhere": (lambda r: linked_directory(r / "fields"), "run/fields is a link, and petfsi follows none"),
    "checkpoints elsewhere": (lambda r: linked_directory(r / "checkpoint"), "run/checkpoint is a link"),
    "an older format": (of_old_format, "is of format 3, by petfsi 0.0.9; this petfsi goes on with format 6 alone"),
}  # fmt: skip

#: By name what is done to a stopped run that goes on, and what is told (nothing: "").
TOLD = {
    "no edit": (lambda r: None, ""),
    "a torn row": (lambda r: appended(r / "history.csv", "7,0.7,0"), ""),
    "a row too many": (lambda r: appended(r / "history.csv", "7,0.7,1,2,3,4,5,6,7\n"), ""),
    "output of a kill": (lambda r: shutil.copy(r / "fields/000006.h5", r / "fields/000007.h5.part"), ""),
    "output cut short": (lambda r: os.truncate(r / "fields/000003.h5", 99), "fields/000003.h5 has another size"),
    "a bit of output": (lambda r: flipped(r / "fields/000003.h5"), "fields/000003.h5 has been changed"),
    "output lost": (lambda r: (r / "fields/000003.h5").unlink(), "fields/000003.h5 is missing"),
    "all output lost": (lambda r: shutil.rmtree(r / "fields"), "outputs.csv: it is missing"),
    "a link for output": (lambda r: linked(r / "fields/000003.h5", "outside/000001.h5"), "fields/000003.h5 is a link"),
    "no mesh of the output": (lambda r: (r / "fields/mesh.h5").unlink(), "mesh.h5 is missing or has been changed"),
    "a bit of the mesh": (lambda r: flipped(r / "fields/mesh.h5"), "mesh.h5 is missing or has been changed"),
    "a list with another row": (lambda r: replaced(r / "fields/outputs.csv", "03.h5", "09.h5"), "csv: its content"),
    "no list": (lambda r: (r / "fields/outputs.csv").unlink(), "outputs.csv: it is missing"),
    "a list that goes on": (lambda r: appended(r / "fields/outputs.csv", "../../outside/000001.h5,9,0.9,1,00,1\n"), ""),
    "a byte of an index": (lambda r: flipped(r / "solid.xdmf", 300), "solid.xdmf: its content has been changed"),
    "an index cut short": (lambda r: os.truncate(r / "solid.xdmf", 99), "solid.xdmf: it has 99 bytes and should have"),
    "no index": (lambda r: (r / "fields.xdmf").unlink(), "fields.xdmf: it is missing; it is written anew"),
    "a link for an index": (lambda r: linked(r / "fields.xdmf", "outside/history.csv"), "fields.xdmf: it is a link"),
    "a bit of a checkpoint": (lambda r: flipped(r / "checkpoint/000006.h5"), "000006.h5 is damaged: its checksum"),
    "a bit of a manifest": (lambda r: flipped(r / "checkpoint/000006.json"), "does not have its own checksum"),
    "a manifest lost": (lambda r: (r / "checkpoint/000006.json").unlink(), "000006.json is missing"),
    "a link for a checkpoint": (lambda r: linked(r / "checkpoint/000006.h5", "outside/000001.h5"), "is damaged"),
    "a link for a manifest": (lambda r: linked(r / "checkpoint/000006.json", "outside/000001.h5"), "it is a link"),
    "a link for a part": (lambda r: linked(r / "checkpoint/000008.h5.part", "outside/000001.h5"), ""),
    "a link for a part of output": (lambda r: linked(r / "fields/000007.h5.part", "outside/000001.h5"), ""),
    "a link for the summary": (lambda r: linked(r / "summary.json.part", "outside/000001.h5"), ""),
    "a link for the reserve": (lambda r: linked(r / ".reserve", "outside/000001.h5"), ""),
    "a link for the log": (lambda r: linked(r / "log.txt", "outside/000001.h5"), ""),
    "no summary": (lambda r: (r / "summary.json").unlink(), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_by_name_and_nothing_changes(run, here, name):
    edit, said = REFUSED[name]
    edit(run)
    before = everything(".")
    done = here("resume", run)
    assert done.returncode == 2 and said in done.stderr, done.stderr
    assert len(done.stderr.splitlines()) < 12 and "defect" not in done.stderr
    assert everything(".") == before


@pytest.mark.parametrize("name", TOLD)
def test_what_is_lost_is_told_and_loses_nothing_else(run, made, here, name):
    edit, said = TOLD[name]
    edit(run)
    outside, kept = everything("outside"), everything(run / "fields")
    done = here("resume", run)
    assert done.returncode == 0, done.stderr
    warnings = [line for line in done.stdout.splitlines() if line.startswith("warning: ")]
    assert any(said in line for line in warnings) if said else not warnings, done.stdout
    assert everything("outside") == outside
    assert (run / "history.csv").read_bytes() == (made / "straight" / "history.csv").read_bytes()
    new = [f"{step:06d}.h5" for step in (7, 8)] + ["mesh.h5"]
    for file in new:
        assert (run / "fields" / file).read_bytes() == (made / "straight" / "fields" / file).read_bytes()
    after = everything(run / "fields")
    assert all(after[path] == kept[path] for path in kept if re.search(r"00000[1-6]\.h5$", path))
    for index in ("fields.xdmf", "solid.xdmf"):
        named = {item.text.split(":")[0] for item in ElementTree.parse(run / index).iter("DataItem")}
        whole = named - {"fields/mesh.h5"}
        assert all(h5py.is_hdf5(run / file) for file in whole) and {"fields/000007.h5", "fields/000008.h5"} <= whole
    # and it fits itself: a part of a run more changes none of it
    assert here("resume", run, "--set", "time.end=0.9").returncode == 0


def test_files_that_the_run_does_not_know_are_left_alone(run, made, here):
    (run / "fields" / "notes.part").write_text("mine")
    (run / "checkpoint" / "notes.part").write_text("mine")
    for step in (3, 7, 999):
        (run / "fields" / f"{step:06d}.h5.old").write_text("mine")
    (run / "fields" / "000007.h5").write_text("my seven")
    (run / "fields" / "000999.h5").write_text("my 999")
    done = here("resume", run)
    assert done.returncode == 0
    assert "fields/000007.h5 and 1 more: not in the list of this run's output; left alone" in done.stdout
    found = everything(run)
    assert sum(data == b"mine" for data in found.values()) == 5 and found["run/fields/000999.h5"] == b"my 999"
    assert found["run/fields/000007.h5.aside"] == b"my seven"
    assert found["run/fields/000007.h5"] == (made / "straight" / "fields" / "000007.h5").read_bytes()


def test_a_run_that_has_moved_needs_no_other_file(run, made, here, monkeypatch):
    mesh = made / "square.msh"
    try:
        mesh.write_text(MESH.replace("2 1 0 0\n3 1 1 0", "2 1.2 0 0\n3 1.2 1 0"))
        before = everything(run)
        done = here("resume", run)
        assert done.returncode == 2 and f"{mesh} is another mesh than the run began with" in done.stderr
        assert everything(run) == before
        mesh.unlink()
        run.rename("elsewhere")
        assert here("resume", "elsewhere").returncode == 0
    finally:
        mesh.write_text(MESH)
    assert Path("elsewhere/history.csv").read_bytes() == (made / "straight" / "history.csv").read_bytes()
    assert here("run", "elsewhere/scene.toml", "--out", "elsewhere", "--overwrite", "--steps", 1).returncode == 0
    assert meshio.read("elsewhere/meshes/1/square.msh").points.shape == (4, 3)


# ---- the manifest's own bits ------------------------------------------------------------------------------------


def test_every_bit_of_a_manifest_that_flips_is_found(made):
    data = (made / "run" / "checkpoint" / "000006.json").read_bytes()
    assert not isinstance(read_manifest(data), str) and json.loads(data)["step"] == 6
    for at in range(len(data)):
        for bit in range(8):
            changed = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
            assert isinstance(read_manifest(changed), str), (at, bit)
    for at in range(len(data)):
        assert isinstance(read_manifest(data[:at]), str)
    assert isinstance(read_manifest(data + b"\n"), str)


def crafted(path, **changes):
    """Write a manifest that is wrong, and has its own checksum."""
    about = json.loads(path.read_bytes())
    del about["blake2b"]
    for key, value in changes.items():
        about["run" if key in about["run"] else key] = value if key not in about["run"] else about["run"] | {key: value}
    body = json.dumps(about, indent=1)[1:] + "\n"
    path.write_text(f'{{\n "blake2b": "{files.digest_of(body.encode())}",{body}')


@pytest.mark.parametrize(
    "changes",
    [
        {"step": -6}, {"step": 6.0}, {"step": "6"}, {"step": True}, {"step": 7}, {"time": float("nan")}, {"time": -1.0},
        {"time": 1e999}, {"time": 0.7}, {"dt": "x"}, {"file": "../x.h5"}, {"more": 1}, {"run": []}, {"data": None},
        {"history": {"rows": -1, "bytes": 5, "blake2b": "0" * 64}}, {"indexes": {"../x": {"bytes": 1}}},
        {"meshes": [{"file": "meshes/1/../../x", "source": "", "bytes": 1, "blake2b": "0" * 64}]},
        {"meshes": [{"file": "meshes/1/..", "source": "", "bytes": 1, "blake2b": "0" * 64}]},
        {"scene": ["x"]}, {"legs": [1]}, {"ranks": 10**400},
    ],
    ids=str,
)  # fmt: skip
def test_a_crafted_manifest_is_refused_and_the_one_before_it_used(run, here, changes):
    crafted(run / "checkpoint" / "000006.json", **changes)
    done = here("resume", run)
    assert done.returncode == 0 and re.search("000006.h5 is damaged: ", done.stdout) and "step 4, t" in done.stdout


def test_a_manifest_of_nothing_is_refused(run, here):
    for number in (4, 6):
        crafted(run / "checkpoint" / f"{number:06d}.json", history=None, outputs=None, mesh=None, indexes={})
    before = everything(run)
    done = here("resume", run)
    assert done.returncode == 2 and "the checkpoint counts no rows of it" in done.stderr
    assert everything(run) == before


# ---- crafted data -----------------------------------------------------------------------------------------------


def without(name):
    return lambda file: file.__delitem__(name)


def instead(name, **how):
    def craft(file):
        del file[name]
        file.create_dataset(name, **how)

    return craft


def external(file):
    del file["solid/velocity"]
    file["solid/velocity"] = h5py.ExternalLink("other.h5", "x")


def soft(file):
    del file["solid/velocity"]
    file["solid/velocity"] = h5py.SoftLink("/solid/displacement")


def attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


X = np.zeros((4, 2))
CRAFTED = {
    "another shape": (instead("solid/velocity", data=np.zeros((5, 2))), "the scene wants"),
    "another number of axes": (instead("solid/velocity", data=np.zeros(8)), "the scene wants 2 axes"),
    "NaN": (instead("solid/velocity", data=X * np.nan), "'solid/velocity' holds what is not finite"),
    "infinite": (instead("solid/velocity", data=X + np.inf), "'solid/velocity' holds what is not finite"),
    "text": (instead("solid/velocity", data=[[b"a"] * 2] * 4), "which is no number of a state"),
    "complex": (instead("solid/velocity", data=X * 1j), "'solid/velocity' holds complex128"),
    "records": (instead("solid/velocity", data=np.zeros((4, 2), "i4,f8")), "which is no number of a state"),
    "references": (instead("solid/velocity", shape=(4, 2), dtype=h5py.ref_dtype), "which is no number of a state"),
    "big end first": (instead("solid/velocity", data=X.astype(">f8")), "which is no number of a state"),
    "a scalar": (instead("solid/velocity", data=1.0), "the scene wants 2 axes"),
    "huge": (instead("solid/velocity", shape=(1 << 40, 2), dtype="f8"), "for which the file has no room"),
    "packed": (instead("solid/velocity", data=X, compression="gzip"), "is not stored plainly in the file"),
    "stored elsewhere": (
        instead("solid/velocity", shape=(4, 2), dtype="f8", external=[("other.bin", 0, 64)]),
        "is not stored plainly in the file",
    ),
    "a link to a file": (external, "'solid/velocity' is no array of it"),
    "a link within": (soft, "'solid/velocity' is no array of it"),
    "a group for an array": (lambda f: (without("solid/velocity")(f), f.create_group("solid/velocity")), "is no array"),
    "an array for a group": (instead("guard", data=X), "'guard' is no group of it"),
    "an array less": (without("solid/velocity"), "no array 'solid/velocity'"),
    "a group less": (without("accounts"), "no state of 'accounts'"),
    "another step": (attribute("step", 7), "its step is not that of its manifest"),
    "a step that is none": (attribute("step", "six"), "its step is not that of its manifest"),
    "a time that is none": (attribute("time", np.nan), "its time is not that of its manifest"),
    "dt that is many": (attribute("dt", [0.1, 0.1]), "it holds what is no state"),
    "attributes that are none": (attribute("attributes", "[1"), "it holds what is no state"),
}  # fmt: skip


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_data_with_a_right_checksum_is_refused_by_name(run, here, name):
    craft, said = CRAFTED[name]
    (run / "checkpoint" / "000004.json").unlink()
    path = run / "checkpoint" / "000006.h5"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # h5py's, of NumPy
        with h5py.File(path, "r+") as file:
            craft(file)
    size, digest = files.digest(path)
    crafted(path.with_suffix(".json"), data={"bytes": size, "blake2b": digest})
    before = everything(run)
    done = here("resume", run)
    assert done.returncode == 2 and said in done.stderr and "000006.h5" in done.stderr, done.stderr
    assert "defect" not in done.stderr and everything(run) == before


def test_the_data_of_a_real_run_have_no_fault(made):
    path = made / "run" / "checkpoint" / "000006.h5"
    assert fault(path, read_manifest(path.with_suffix(".json").read_bytes())) == ""


# ---- files that grow --------------------------------------------------------------------------------------------

BEGIN, END = '<?xml version="1.0"?>\n<all>\n', "</all>\n"


def test_an_index_is_whole_whenever_a_kill_comes(tmp_path, monkeypatch):
    """Every write is torn after every page, and between any two of them a reader sees all elements up to some time."""
    written, whole = [], files.write_whole

    def slowly(handle, data, at):
        for begin in range(0, len(data), 512):
            if begin == 0 or (at + begin) // 4096 != (at + begin - 1) // 4096 or len(data) > 64:
                written.append([e.get("n") for e in ElementTree.parse(path).getroot()])
            whole(handle, data[begin : begin + 512], at + begin)

    monkeypatch.setattr(files, "write_whole", slowly)
    path = tmp_path / "index.xdmf"
    index = GrowingXml(path, BEGIN, END)
    sizes = np.random.default_rng(1).integers(1, 9000, 60)
    for n, size in enumerate(sizes):
        index.append(f'<e n="{n}">{"x" * size}</e>\n')
        assert [e.get("n") for e in ElementTree.parse(path).getroot()] == [str(m) for m in range(n + 1)]
    assert len(written) > 100 and all(seen == [str(m) for m in range(len(seen))] for seen in written)
    mark = index.on_disk()
    again = GrowingXml(path, BEGIN, END)
    before = path.read_bytes()
    again.go_on(mark)
    assert path.read_bytes() == before and again.on_disk() == mark


def test_two_thousand_entries_take_the_time_of_two_thousand(tmp_path, monkeypatch):
    """Counted in bytes handed to the system: were all written every time, it would be a thousand times as many."""
    handed, publish, whole = [0], files.replace_text, files.write_whole
    monkeypatch.setattr(files, "replace_text", lambda p, t: (handed.append(len(t)), publish(p, t)))
    monkeypatch.setattr(files, "write_whole", lambda h, d, a: (handed.append(len(d)), whole(h, d, a)))
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    index, text = GrowingXml(tmp_path / "index.xdmf", BEGIN, END), f"<e>{'x' * 1000}</e>\n"
    for _ in range(2000):
        index.append(text)
    assert sum(handed) < 8 * 2000 * len(text)
    assert len(ElementTree.parse(index.path).getroot()) == 2000
    assert isinstance(index.on_disk(), Mark)


@pytest.mark.parametrize(
    "line", ["", "a,b", "../1.h5,1,0.0,1,00,1", "000001.h5,2,0.0,1,00,1", "000001.h5,1,nan,1,00,1"]
)
def test_a_row_that_is_none_names_no_file(line):
    assert Written.read(line) is None
    assert Written.read("000001.h5,1,0.5,1,00,1") == Written("000001.h5", 1, 0.5, 1, "00", 1)
