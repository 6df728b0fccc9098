"""What a run leaves on the disk besides checkpoints: directory, history, fields, summary, pictures. About 10 s."""

import errno
import itertools
import json
import os
import re
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import pytest
from matplotlib.image import imread
from mpi4py import MPI
from output_cases import SCENE, centres, grid, grid_fields, output, run_on, shared_directory, solid_fields

from petfsi.errors import InputError, SolveError
from petfsi.output.fields import FieldWriter
from petfsi.output.film import film_run
from petfsi.output.frames import Wanted
from petfsi.output.history import History, column_names, read_history
from petfsi.output.manifest import Record
from petfsi.output.pictures import FORMATS, plot_run
from petfsi.output.rundir import RunDirectory
from petfsi.output.slices import cut_tetrahedra
from petfsi.output.summary import Summary, read_summary, write_summary

comm = MPI.COMM_WORLD


# ---- fields -------------------------------------------------------------------------------------------------


def write_fields(directory, dim, steps, on=comm):
    writer = FieldWriter(directory, on, grid(dim))
    for step in steps:
        writer.write(step, 0.1 * step, output(dim, 0.1 * step, on))
    return writer


def contents(directory):
    comm.barrier()
    found = {p.relative_to(directory).as_posix(): p.read_bytes() for p in directory.rglob("*") if p.is_file()}
    comm.barrier()
    return found


def series(path):
    """Return points, cells and [(time, point data, cell data)] as meshio reads them."""
    with meshio.xdmf.TimeSeriesReader(path) as reader:
        points, (block,) = reader.read_points_cells()
        return points, block, [reader.read_data(k) for k in range(reader.num_steps)]


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_meshio_finds_every_value_in_its_cell(tmp_path, dim):
    directory = shared_directory(tmp_path, comm)
    write_fields(directory, dim, [0, 5])
    points, block, times = series(directory / "fluid.xdmf")
    info = grid(dim)
    assert block.type == {2: "quad", 3: "hexahedron"}[dim]
    x = points[block.data].mean(axis=1)
    low = points[block.data].min(axis=1)
    assert np.allclose(points[block.data].max(axis=1) - low, info.spacing, rtol=1e-14)
    assert sorted(map(tuple, x.round(12))) == sorted(map(tuple, centres(info).reshape(-1, dim).round(12)))
    edges = points[block.data[:, 1 : dim + 2 : 1]] - points[block.data[:, :1]]
    assert np.all(edges[:, 0, 1] == 0) and np.all(edges[:, 2, 0] == 0), "corners 1 and 3 lie along x and y"
    for step, (time, point_data, cell_data) in zip((0, 5), times, strict=True):
        assert time == 0.1 * step
        assert point_data == {}
        assert cell_data["velocity"][0] == pytest.approx(x + time, abs=1e-14)
        assert cell_data["pressure"][0] == pytest.approx(x[:, 0] + 10 * x[:, 1] + 100 * x[:, -1] + time)
        assert np.array_equal(cell_data["kind"][0] == 2, x[:, 0] < info.origin[0] + info.spacing[0])
        meshio.Mesh(points, [block], cell_data=cell_data)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_meshio_moves_the_solid(tmp_path, dim):
    directory = shared_directory(tmp_path, comm)
    write_fields(directory, dim, [0, 5])
    points, block, times = series(directory / "solid.xdmf")
    for step, (time, point_data, cell_data) in zip((0, 5), times, strict=True):
        whole = solid_fields(dim, 0.1 * step)
        assert time == 0.1 * step
        assert block.type == {2: "triangle", 3: "tetra"}[dim]
        assert np.array_equal(points, whole["points"])
        assert np.array_equal(block.data, whole["cells"])
        assert np.array_equal(point_data["displacement"], whole["displacement"])
        assert np.array_equal(point_data["velocity"], whole["velocity"])
        assert np.array_equal(cell_data["body"][0], whole["body"])
    with h5py.File(directory / "fields" / "000005.h5") as file:
        assert np.array_equal(file["solid/points"][()], whole["points"] + whole["displacement"])


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_index_for_paraview_names_what_is_there(tmp_path, dim):
    directory = shared_directory(tmp_path, comm)
    write_fields(directory, dim, [0, 5])
    root = ElementTree.parse(directory / "fields.xdmf").getroot()
    scenes = root.findall("Domain/Grid[@CollectionType='Temporal']/Grid[@CollectionType='Spatial']")
    assert [float(scene.find("Time").get("Value")) for scene in scenes] == [0.0, 0.5]
    for scene in scenes:
        assert [part.get("Name") for part in scene.findall("Grid")] == ["fluid", "solid"]
    for item in root.iter("DataItem"):
        if item.get("Format") == "HDF":
            name, path = item.text.split(":")
            with h5py.File(directory / name) as file:
                assert tuple(map(int, item.get("Dimensions").split())) == file[path].shape
                assert int(item.get("Precision")) == file[path].dtype.itemsize
    if dim == 3:
        fluid = scenes[0].find("Grid[@Name='fluid']")
        assert fluid.find("Topology").attrib == {"TopologyType": "3DCoRectMesh", "Dimensions": "5 6 7"}
        assert [item.text for item in fluid.findall("Geometry/DataItem")] == ["2.0 -1.0 0.5", "0.125 0.5 0.25"]
        with h5py.File(directory / "fields" / "000000.h5") as file:
            assert np.array_equal(file["fluid/pressure"][()].T, grid_fields(grid(3), 0.0)["pressure"])


@pytest.mark.parallel([1, 3])
def test_a_scene_without_fluid_or_without_solid_has_only_the_other(tmp_path):
    directory = shared_directory(tmp_path, comm)
    groups = output(2, 0.0, comm)
    for name, info in (("solid", None), ("pressure", grid(2))):
        if comm.rank == 0:
            (directory / name).mkdir()
        comm.barrier()
        FieldWriter(directory / name, comm, info).write(0, 0.0, {name: groups[name]})
    assert {"fields.xdmf", "solid.xdmf"} == {n for n in contents(directory / "solid") if "/" not in n}
    assert {"fields.xdmf", "fluid.xdmf"} == {n for n in contents(directory / "pressure") if "/" not in n}


@pytest.mark.parallel([1, 3])
def test_output_does_not_depend_on_ranks_or_interruptions(tmp_path):
    directory = shared_directory(tmp_path, comm)
    if comm.rank == 0:
        for name in ("through", "resumed", "alone"):
            (directory / name).mkdir()
        write_fields(directory / "alone", 3, [0, 5, 10], on=MPI.COMM_SELF)
    comm.barrier()
    write_fields(directory / "through", 3, [0, 5, 10])
    writer = write_fields(directory / "resumed", 3, [0, 5])
    known = Record(**writer.on_disk())
    for step in (7, 8):
        writer.write(step, 0.1 * step, output(3, 0.1 * step, comm))
    if comm.rank == 0:
        (directory / "resumed" / "fields" / "000009.h5.part").write_bytes(b"left by a kill")
    comm.barrier()
    writer = FieldWriter(directory / "resumed", comm, grid(3))
    writer.go_on(known, 6, lambda: output(3, 0.6, comm), pytest.fail)
    assert len(series(directory / "resumed" / "fluid.xdmf")[2]) == 2
    writer.write(10, 1.0, output(3, 1.0, comm))
    through, alone, resumed = (contents(directory / name) for name in ("through", "alone", "resumed"))
    listed = [files.pop("fields/outputs.csv").decode().splitlines() for files in (through, alone, resumed)]
    assert through == alone == resumed
    # the last column is when a file was written
    assert len({tuple(line.rpartition(",")[0] for line in lines) for lines in listed}) == 1 and len(listed[0]) == 4


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_full_disk_leaves_earlier_output_whole(tmp_path, ranks):
    code = """
from petfsi.output.fields import FieldWriter
writer = FieldWriter(directory, comm, grid(2))
writer.write(0, 0.0, output(2, 0.0, comm))
resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, resource.RLIM_INFINITY))
try:
    writer.write(5, 0.5, output(2, 0.5, comm))
except PetfsiError as error:
    say(f"rank {comm.rank} exit {error.exit_code}: {error}")
"""
    done = run_on(ranks, code, tmp_path)
    assert done.returncode == 0, done.stderr
    lines = sorted(done.stdout.splitlines())
    assert len(lines) == ranks
    for rank, line in enumerate(lines):
        assert re.search(rf"^rank {rank} exit 3: step 5, t = 0.5 s: fields .*/000005.h5 could not be written:", line)
        assert line.endswith("File too large. There is no checkpoint.")
    assert sorted(p.name for p in (tmp_path / "fields").iterdir()) == ["000000.h5", "mesh.h5", "outputs.csv"]
    assert len(series(tmp_path / "fluid.xdmf")[2]) == 1


# ---- history ------------------------------------------------------------------------------------------------

COLUMNS = column_names(["top.x", "top.y"], ["cfl"])


def row(step):
    values = [step, 0.1 * step, 0.1, np.sin(step), 1 / 3 * step, 7, 1e-300 * step, np.float64(step) / 7]
    return dict(zip(COLUMNS, values, strict=True))


@pytest.mark.parallel([1, 3])
def test_history_gives_every_number_back_exactly(tmp_path):
    path = shared_directory(tmp_path, comm) / "history.csv"
    history = History(path, COLUMNS, comm)
    for step in range(1, 6):
        history.append(row(step))
    comm.barrier()
    table = read_history(path)
    assert list(table) == ["step", "time", "dt", "top.x", "top.y", "iterations", "residual", "cfl"]
    assert table["step"].dtype == table["iterations"].dtype == np.int64
    for name, column in table.items():
        assert column.tolist() == [row(step)[name] for step in range(1, 6)]


@pytest.mark.parallel([1, 3])
def test_history_goes_on_after_a_kill_as_if_nothing_had_happened(tmp_path):
    path = shared_directory(tmp_path, comm) / "history.csv"
    history = History(path, COLUMNS, comm)
    for step in (1, 2):
        history.append(row(step))
    known = history.on_disk()
    for step in (3, 4):
        history.append(row(step))
    if comm.rank == 0:
        whole = path.read_bytes()
        path.write_bytes(whole + b"5,0.5,0.1,0.9")
        assert read_history(path)["step"].tolist() == [1, 2, 3, 4]
    comm.barrier()
    history = History(path, COLUMNS, comm, known)
    assert read_history(path)["step"].tolist() == [1, 2] and history.on_disk() == known
    comm.barrier()  # rank 0 writes on without waiting for others to have read
    for step in (3, 4):
        history.append(row(step))
    comm.barrier()
    assert comm.bcast(path.read_bytes()) == comm.bcast(whole if comm.rank == 0 else None)


@pytest.mark.parallel([1, 3])
def test_history_refuses_what_is_not_its_own(tmp_path):
    path = shared_directory(tmp_path, comm) / "history.csv"
    history = History(path, COLUMNS, comm)
    with pytest.raises(ValueError, match="a row of"):
        history.append({"step": 1})
    for step in (1, 2):
        history.append(row(step))
    known = history.on_disk()
    with pytest.raises(
        InputError, match=r"history\.csv has the columns step, time, dt, top\.x, .*, not step, time, dt,"
    ):
        History(path, column_names(["other"]), comm, known)
    whole = contents(path.parent)["history.csv"]
    lines = whole.splitlines(keepends=True)
    edits = {
        r"line 3: not a row of 8 numbers": [*lines[:2], b"2,0.2,oops\n"],
        r"its content has been changed": [*lines[:2], lines[2].replace(b"0.2", b"0.3")],
        r"it has 1 rows and should have 2 or more": lines[:2],
        r"it has 0 rows and should have 2 or more": [],
    }
    for said, edited in edits.items():
        if comm.rank == 0:
            path.write_bytes(b"".join(edited))
        with pytest.raises(InputError, match=rf"history\.csv.*{said}"):
            History(path, COLUMNS, comm, known)
        assert contents(path.parent)["history.csv"] == b"".join(edited)
    with pytest.raises(InputError, match=r"nothing\.csv cannot be read: No such file"):
        read_history(path.with_name("nothing.csv"))


@pytest.mark.parallel([1, 3])
def test_history_on_a_full_disk_is_a_solve_error_on_all_ranks(tmp_path, monkeypatch):
    path = shared_directory(tmp_path, comm) / "history.csv"
    history = History(path, COLUMNS, comm)
    before = contents(path.parent)

    def full(handle, data, at, write=os.pwrite):
        if len(data) > 10:
            return write(handle, data[:-10], at)
        raise OSError(errno.ENOSPC, "no room")

    if comm.rank == 0:
        monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(SolveError, match=r"history\.csv could not be written: No space left on device .* be resumed"):
        history.append(row(1))
    assert contents(path.parent) == before


# ---- summary ------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_summary_is_json_whatever_the_numbers_are(tmp_path):
    path = shared_directory(tmp_path, comm) / "summary.json"
    summary = Summary("done", steps=np.int64(10), time=0.1, iterations={"mean": np.float64(2.5), "max": np.int32(4)})
    summary.probes = {"top": np.array([0.5, -0.25]), "gauge": float("nan")}
    write_summary(path, Summary("stopped", 1, 0.0), comm)
    write_summary(path, summary, comm)
    comm.barrier()
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found == read_summary(path)
    needed = "status steps time unknowns wall_s phases iterations conservation probes skipped versions".split()
    assert [key for key in found if key in needed] == needed
    assert (found["status"], found["steps"], found["time"]) == ("done", 10, 0.1)
    assert found["iterations"] == {"mean": 2.5, "max": 4}
    assert found["probes"] == {"top": [0.5, -0.25], "gauge": None}


# ---- run directory ------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_a_run_is_made_once_and_found_again(tmp_path):
    path = shared_directory(tmp_path, comm) / "deep" / "run"
    made = RunDirectory.create(path, "title = 'é'\n", "-fsi_ksp_type fgmres\n", overwrite=False, comm=comm)
    assert RunDirectory.open(path, comm) == made
    assert made.scene.read_text(encoding="utf-8") == "title = 'é'\n"
    assert made.options.read_text() == "-fsi_ksp_type fgmres\n"
    with pytest.raises(InputError, match=r"holds a run already; continue it with 'petfsi resume .*/deep/run'"):
        RunDirectory.create(path, "", "", overwrite=False, comm=comm)


@pytest.mark.parallel([1, 3])
def test_overwrite_removes_what_petfsi_wrote_and_nothing_else(tmp_path):
    path = shared_directory(tmp_path, comm) / "run"
    run = RunDirectory.create(path, SCENE, "", overwrite=False, comm=comm)
    write_fields(path, 2, [0, 5])
    History(run.history, COLUMNS, comm).append(row(1))
    write_summary(run.summary, Summary("done", 1, 0.1), comm)
    if comm.rank == 0:
        run.log.write_text("a line")
        for kind in FORMATS:
            plot_run(path, kind=kind)
        (path / "notes.txt").write_text("mine")
        (path / "pictures" / "film.mp4").write_text("mine")
    comm.barrier()
    RunDirectory.create(path, "second", "", overwrite=True, comm=comm)
    assert sorted(contents(path)) == [".petfsi-run", "notes.txt", "options.opts", "pictures/film.mp4", "scene.toml"]
    assert run.scene.read_text() == "second"


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_directory_that_is_no_run_is_left_alone(tmp_path, overwrite):
    path = shared_directory(tmp_path, comm)
    if comm.rank == 0:
        (path / "scene.toml").write_text("somebody's own")
    comm.barrier()
    with pytest.raises(InputError, match="is not empty and holds no run"):
        RunDirectory.create(path, "x", "", overwrite, comm)
    with pytest.raises(InputError, match="there is a file of that name"):
        RunDirectory.create(path / "scene.toml", "x", "", overwrite, comm)
    with pytest.raises(InputError, match="scene.toml/run.* cannot be written: Not a directory"):
        RunDirectory.create(path / "scene.toml" / "run", "x", "", overwrite, comm)
    with pytest.raises(InputError, match="is not the directory of a run"):
        RunDirectory.open(path, comm)
    assert contents(path) == {"scene.toml": b"somebody's own"}


# ---- pictures -----------------------------------------------------------------------------------------------


def test_a_box_is_cut_into_its_cross_section():
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3))) * [2.0, 3.0, 5.0]
    cells = []
    for order in itertools.permutations(range(3)):  # Kuhn's six tetrahedra
        path = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[list(order)]], axis=0)
        cells.append(path @ [4, 2, 1])
    points = corners + 0.0
    for axis, area in ((0, 15.0), (1, 10.0), (2, 6.0)):
        for at in (0.1, 0.77, 1.9):
            polygons, owners = cut_tetrahedra(points, np.array(cells), axis, at)
            assert {len(p) for p in polygons} == {3, 4} or {len(p) for p in polygons} == {3}
            x, y = zip(*(p.T for p in polygons), strict=True)
            areas = [0.5 * abs(np.sum(a * np.roll(b, -1) - b * np.roll(a, -1))) for a, b in zip(x, y, strict=True)]
            assert sum(areas) == pytest.approx(area, rel=1e-13)
            assert len(owners) == len(polygons) and set(owners) <= set(range(6))
    assert cut_tetrahedra(points, np.array(cells), 0, 2.5)[0] == []


def coloured(path, colour):
    """Return the part of a picture's pixels that have about this colour (0 to 255)."""
    return np.mean(np.abs(imread(path)[..., :3] * 255 - colour).max(axis=-1) < 4)


@pytest.mark.parametrize("dim", [2, 3])
def test_pictures_show_fluid_solid_and_obstacle(tmp_path, dim):
    writer = FieldWriter(tmp_path, MPI.COMM_SELF, grid(dim))
    history = History(tmp_path / "history.csv", COLUMNS, MPI.COMM_SELF)
    for step in (1, 2):
        writer.write(step, 0.1 * step, output(dim, 0.1 * step, MPI.COMM_SELF))
        history.append(row(step))
    drawn = plot_run(tmp_path)
    assert [p.name for p in drawn] == ["history.png", "000001.png", "000002.png"]
    assert plot_run(tmp_path, Wanted(every=2))[1:] == drawn[1:2]
    for path in drawn[1:]:
        assert coloured(path, (0x8C, 0x8C, 0x8C)) > 0.03, "the obstacle"
        assert coloured(path, (0xF3, 0xDC, 0xBD)) > 0.002, "the first body"
        assert coloured(path, (255, 255, 255)) < 0.85


def test_a_solid_alone_is_drawn(tmp_path):
    writer = FieldWriter(tmp_path, MPI.COMM_SELF, None)
    writer.write(3, 0.3, {"solid": output(2, 0.3, MPI.COMM_SELF)["solid"]})
    (picture,) = plot_run(tmp_path)
    assert coloured(picture, (255, 255, 255)) < 0.6


def test_fluid_at_rest_is_drawn(tmp_path):
    groups = output(2, 0.0, MPI.COMM_SELF)["pressure"]
    for slab in groups.values():
        slab.data[...] = 0
    FieldWriter(tmp_path, MPI.COMM_SELF, grid(2)).write(0, 0.0, {"pressure": groups})
    assert [p.name for p in plot_run(tmp_path)] == ["000000.png"]


def test_nothing_to_draw_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="neither history.csv nor fields"):
        plot_run(tmp_path)
    (tmp_path / "fields").mkdir()
    (tmp_path / "fields" / "000001.h5").write_bytes(b"damaged")
    with pytest.raises(InputError, match="fields cannot be drawn"):
        plot_run(tmp_path)


@pytest.mark.parametrize("draw", [plot_run, film_run])
def test_a_directory_that_is_not_there_is_called_so(tmp_path, draw):
    with pytest.raises(InputError, match=f"^there is no directory {tmp_path / 'NOSUCH'}$"):
        draw(tmp_path / "NOSUCH")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is no directory$"):
        draw(tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
