"""Particles on the disk, as meshio finds them, and in pictures. About 4 s."""

from types import SimpleNamespace
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import pytest
from matplotlib.image import imread
from mpi4py import MPI
from output_cases import output, shared_directory, slabs

from petfsi.errors import InputError
from petfsi.fields.slabs import Slab
from petfsi.output import pictures, stage
from petfsi.output.fields import FieldWriter, field_files
from petfsi.output.frames import Wanted, read_frame
from petfsi.output.manifest import Record
from petfsi.output.pictures import plot_run
from petfsi.output.slices import section
from petfsi.output.surroundings import surroundings_of
from petfsi.scene.schema import Obstacle

comm = MPI.COMM_WORLD
#: Particles in a row along x at each output step: they come and go.
ROWS = {0: 4, 5: 0, 10: 7}
SPACING = 0.1


def cloud(dim, step):
    """Return a block of particles, one column of ten along y, as the field of particles gives it but whole."""
    sides = [ROWS[step], 10, 10][:dim]
    points = SPACING * (np.stack(np.meshgrid(*map(np.arange, sides), indexing="ij"), axis=-1).reshape(-1, dim) + 0.5)
    velocity = np.zeros_like(points)
    velocity[:, 0] = points[:, 1]
    ids = 3 + 2 * np.arange(len(points), dtype=np.int64)
    pressure = 100.0 * (1.0 - points[:, 1])
    return {"points": points, "velocity": velocity, "pressure": pressure, "density": 1e3 + pressure, "id": ids}


def groups(dim, step, on, solid):
    found = {"particles": slabs({"particles": cloud(dim, step)}, on)["particles"]}
    return found | ({"solid": output(dim, 0.1 * step, on)["solid"]} if solid else {})


def write(directory, dim, steps, on=comm, solid=False):
    writer = FieldWriter(directory, on, None)
    for step in steps:
        writer.write(step, 0.1 * step, groups(dim, step, on, solid))
    return writer


def clouds(path):
    """Return (time, points, cells, point data) of every time, as meshio reads them."""
    found = []
    with meshio.xdmf.TimeSeriesReader(path) as reader:
        for k in range(reader.num_steps):
            reader.mesh_grid = reader.collection[k]
            points, (block,) = reader.read_points_cells()
            time, point_data, cell_data = reader.read_data(k)
            assert cell_data == {}
            found.append((time, points, block, point_data))
    return found


def files_of(directory):
    comm.barrier()
    found = {p.relative_to(directory).as_posix(): p.read_bytes() for p in directory.rglob("*") if p.is_file()}
    comm.barrier()
    return found


# ---- files --------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("solid", [False, True], ids=["alone", "with a solid"])
@pytest.mark.parametrize("dim", [2, 3])
def test_meshio_finds_every_particle(tmp_path, dim, solid):
    directory = shared_directory(tmp_path, comm)
    write(directory, dim, ROWS, solid=solid)
    found = clouds(directory / "particles.xdmf")
    assert [time for time, *_ in found] == [0.0, 0.5, 1.0]
    for step, (_, points, block, point_data) in zip(ROWS, found, strict=True):
        whole = cloud(dim, step)
        assert np.array_equal(points, whole.pop("points"))
        assert block.type == "vertex" and np.array_equal(block.data, np.arange(len(points))[:, None])
        assert point_data.keys() == whole.keys()
        for name, values in whole.items():
            assert np.array_equal(point_data[name], values) and point_data[name].dtype == values.dtype
        meshio.Mesh(points, [block], point_data=point_data)
    names = {name for name in files_of(directory) if "/" not in name}
    assert names == {"fields.xdmf", "particles.xdmf"} | ({"solid.xdmf"} if solid else set())
    if solid:
        with meshio.xdmf.TimeSeriesReader(directory / "solid.xdmf") as reader:
            assert reader.num_steps == 3 and len(reader.read_points_cells()[0]) == 2**dim


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_indexes_name_what_is_there(tmp_path, dim):
    directory = shared_directory(tmp_path, comm)
    write(directory, dim, ROWS, solid=True)
    both = ["solid", "particles"]
    for name, want in (("particles.xdmf", [[], [], []]), ("fields.xdmf", [both, ["solid"], both])):
        root = ElementTree.parse(directory / name).getroot()
        times = root.findall("Domain/Grid[@CollectionType='Temporal']/Grid")
        assert [[part.get("Name") for part in grid.findall("Grid")] for grid in times] == want
        for topology in root.findall(".//Topology[@TopologyType='Polyvertex']"):
            n = topology.find("DataItem").get("Dimensions")
            assert n == f"{topology.get('NumberOfElements')} {topology.get('NodesPerElement')}"
        assert {g.get("GeometryType") for g in root.iter("Geometry")} == {{2: "XY", 3: "XYZ"}[dim]}
        for item in root.iter("DataItem"):
            file, path = item.text.split(":")
            with h5py.File(directory / file) as stored:
                assert tuple(map(int, item.get("Dimensions").split())) == stored[path].shape
                assert int(item.get("Precision")) == stored[path].dtype.itemsize


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("solid", [False, True], ids=["alone", "with a solid"])
def test_clouds_do_not_depend_on_ranks_or_interruptions(tmp_path, solid):
    directory = shared_directory(tmp_path, comm)
    if comm.rank == 0:
        for name in ("through", "resumed", "alone"):
            (directory / name).mkdir()
        write(directory / "alone", 2, ROWS, on=MPI.COMM_SELF, solid=solid)
    comm.barrier()
    write(directory / "through", 2, ROWS, solid=solid)
    writer = write(directory / "resumed", 2, [0, 5], solid=solid)
    known = Record(**writer.on_disk())
    writer.write(7, 0.7, groups(2, 10, comm, solid))
    writer = FieldWriter(directory / "resumed", comm, None)
    writer.go_on(known, 6, pytest.fail, pytest.fail)
    assert len(clouds(directory / "resumed" / "particles.xdmf")) == 2
    writer.write(10, 1.0, groups(2, 10, comm, solid))
    through, alone, resumed = (files_of(directory / name) for name in ("through", "alone", "resumed"))
    for found in (through, alone, resumed):
        assert len(found.pop("fields/outputs.csv").splitlines()) == 4  # it says when files were written
    assert through == alone == resumed
    FieldWriter(directory / "resumed", comm, None).go_on(Record(), -1, pytest.fail, pytest.fail)
    assert sorted(files_of(directory / "resumed")) == ["fields/mesh.h5"]


@pytest.mark.parallel([2])
def test_a_rank_may_have_no_particles(tmp_path):
    directory = shared_directory(tmp_path, comm)
    whole = cloud(2, 0)
    mine = slice(None) if comm.rank == 1 else slice(0)
    parts = {name: Slab(values[mine], (0,) * values.ndim, values.shape) for name, values in whole.items()}
    FieldWriter(directory, comm, None).write(0, 0.0, {"particles": parts})
    comm.barrier()
    ((_, points, block, _),) = clouds(directory / "particles.xdmf")
    assert np.array_equal(points, whole["points"]) and np.array_equal(block.data[:, 0], np.arange(len(points)))


# ---- pictures -----------------------------------------------------------------------------------------------


def around(dim, **sides):
    """Return the surroundings of a scene of particles with an obstacle and a container."""
    zeros, ones = [0.0] * dim, [1.0] * dim
    shapes = {
        "post": {"shape": {"box": {"origin": [0.8, *zeros[1:]], "size": [0.1, 0.5, 1.0][:dim]}}},
        "room": {"shape": {"ball": {"centre": [0.5] * dim, "radius": 0.6}}, "outside": True},
    }
    obstacles = {name: Obstacle.model_validate(table) for name, table in shapes.items()}
    fluid = SimpleNamespace(origin=zeros, size=ones, resolution=SPACING, sides=SimpleNamespace(**sides))
    return surroundings_of(SimpleNamespace(dim=dim, fluid=fluid, solids={}, obstacles=obstacles, directory="."))


def test_the_surroundings_are_those_of_the_scene():
    found = around(2, left="open", right="no-slip", bottom="periodic", top={"inflow": {}})
    assert found.styles == (("dashed", "solid"), ("dotted", "dashdot"))
    assert (found.low.tolist(), found.high.tolist(), found.spacing) == ([0.0, 0.0], [1.0, 1.0], SPACING)
    assert [o.outside for o in found.obstacles] == [False, True]


def enclosed(loops):
    x, y = zip(*(loop.T for loop in loops), strict=True)
    return sum(0.5 * np.sum(a * np.roll(b, -1) - b * np.roll(a, -1)) for a, b in zip(x, y, strict=True))


@pytest.mark.parametrize("dim", [2, 3])
def test_obstacles_are_cut_into_closed_lines(dim):
    post, room = around(dim).obstacles
    axis, at = (None, 0.0) if dim == 2 else (2, 0.33)
    (box,) = section(post.points, post.facets, axis, at)
    (ring,) = section(room.points, room.facets, axis, at)
    assert abs(enclosed([box])) == pytest.approx(0.05, rel=1e-12)
    assert np.sign(enclosed([box])) == -np.sign(enclosed([ring])), "a container's surface faces its room"
    area = np.pi * (0.36 - (0.0 if dim == 2 else 0.17**2))
    assert abs(enclosed([ring])) == pytest.approx(area, rel=0.02)
    if dim == 3:
        assert abs(enclosed(section(post.points, post.facets, 1, 0.2))) == pytest.approx(0.1, rel=1e-12)
        assert section(post.points, post.facets, 2, 3.0) == []


def coloured(path, colour):
    """Return the part of a picture's pixels that have about this colour (0 to 255)."""
    return np.mean(np.abs(imread(path)[..., :3] * 255 - colour).max(axis=-1) < 4)


@pytest.mark.parametrize("dim", [2, 3])
def test_pictures_show_particles_bodies_and_obstacles(tmp_path, monkeypatch, dim):
    monkeypatch.setattr(stage, "read_surroundings", lambda _: around(dim, top="open"))
    monkeypatch.setattr(pictures, "_DPI", 50)
    write(tmp_path, dim, [5, 10], on=MPI.COMM_SELF, solid=True)
    drawn = plot_run(tmp_path)
    assert [path.name for path in drawn] == ["000005.png", "000010.png"]
    for path in drawn:
        assert coloured(path, (0x8C, 0x8C, 0x8C)) > 0.02, "the obstacles"
    none, some = (coloured(path, (255, 255, 255)) for path in drawn)
    assert none > some + 0.05, "the particles"


def test_a_particle_is_as_wide_as_its_spacing_and_coloured_by_what_is_asked(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "read_surroundings", lambda _: around(2))
    write(tmp_path, 2, ROWS, on=MPI.COMM_SELF)
    for colour, top in (("pressure", 100.0), ("speed", 1.0)):
        seen = stage.look_through(tmp_path, field_files(tmp_path), colour)
        assert (seen.shown, seen.spacing) == (colour, SPACING)
        assert seen.norm.vmax == pytest.approx(0.95 * top, rel=0.01)
        frame = read_frame(tmp_path / "fields" / "000010.h5")
        ax = pictures.scene_figure(seen, frame).axes[0]
        (disks,) = [c for c in ax.collections if len(c.get_offsets()) == 70]
        assert disks.get_widths() == disks.get_heights() == pytest.approx([SPACING])
        assert np.array_equal(disks.get_array(), seen.fluid_values(frame))
    with pytest.raises(InputError, match="--quantity smoke: the fields in .* have speed and pressure to show"):
        plot_run(tmp_path, Wanted(quantity="smoke"))


def test_a_slice_of_space_is_two_spacings_thick(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "read_surroundings", lambda _: around(3))
    write(tmp_path, 3, [0], on=MPI.COMM_SELF)
    path = tmp_path / "fields" / "000000.h5"
    frame = read_frame(path)
    figure = pictures.scene_figure(stage.look_through(tmp_path, [path]), frame)
    for ax in figure.axes[:2]:
        (disks,) = [c for c in ax.collections if c.get_array() is not None]
        assert len(disks.get_offsets()) == 2 * 4 * 10, "the layers on both sides of the middle"


def test_a_run_without_its_scene_is_drawn_as_wide_as_its_particles(tmp_path):
    write(tmp_path, 2, ROWS, on=MPI.COMM_SELF)
    paths = sorted((tmp_path / "fields").glob("0*.h5"))
    seen = stage.look_through(tmp_path, paths)
    assert seen.around is None and seen.spacing == pytest.approx(SPACING)
    assert np.allclose([seen.low, seen.high], [[-0.004, -0.004], [0.704, 1.004]])
    with pytest.raises(InputError, match="neither a grid nor a solid nor particles"):
        stage.look_through(tmp_path, paths[1:2])
