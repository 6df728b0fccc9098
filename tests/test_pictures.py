"""What pictures of a run show, by what is drawn: shapes, quantities, times and labels. About 15 s."""

import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from output_cases import centres
from picture_cases import block, figures, fluid, made_run, particles, spinning

from petfsi import cli
from petfsi.errors import InputError
from petfsi.geometry.shapes import inside
from petfsi.output import film
from petfsi.output.frames import Wanted, read_frame, wanted_files
from petfsi.output.pictures import plot_run
from petfsi.output.plane import WATER
from petfsi.output.quantities import QUANTITIES, joined, vorticity
from petfsi.output.slices import clip_triangles
from petfsi.output.space import _in_box
from petfsi.output.surroundings import GREY
from petfsi.output.xdmf import GridInfo
from petfsi.scene.schema import Shape

# ---- vorticity ----------------------------------------------------------------------------------------------

INFO = GridInfo((-0.3, 0.2, 0.1), (0.1, 0.25, 0.2), (7, 5, 6))


def flat(dim):
    return GridInfo(*(part[:dim] for part in (INFO.origin, INFO.spacing, INFO.cells)))


@pytest.mark.parametrize("solid", [False, True], ids=["alone", "around a solid"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_rigid_rotation_has_twice_its_rate_everywhere(dim, solid):
    info, rate = flat(dim), np.array([0.3, -0.5, 0.7])
    x = np.concatenate((centres(info), np.zeros((*info.cells, 3 - dim))), axis=-1)
    flow = np.cross(rate if dim == 3 else [0.0, 0.0, 0.7], x)[..., :dim]
    wet = np.ones(info.cells, dtype=bool)
    if solid:
        wet[2:4, 2:3] = False
        flow[~wet] = 1e3
    found = vorticity(flow, joined(wet, info, [False] * dim, []), info.spacing)
    assert found[wet] == pytest.approx(2.0 * (0.7 if dim == 2 else np.linalg.norm(rate)), rel=1e-12)
    assert dim == 3 or np.all(vorticity(-flow, joined(wet, info, [False] * 2, []), info.spacing)[wet] < 0.0), "signed"


def test_a_grid_one_cell_thick_has_the_vorticity_of_its_plane():
    info = GridInfo(INFO.origin, INFO.spacing, (7, 5, 1))
    flow = np.cross([0.0, 0.0, 0.7], centres(info))
    found = vorticity(flow, joined(np.ones(info.cells, dtype=bool), info, [False] * 3, []), info.spacing)
    assert found == pytest.approx(1.4, rel=1e-12)


@pytest.mark.parametrize("around", [True, False])
def test_the_ends_of_a_periodic_axis_are_neighbours(around):
    info = GridInfo((0.0, 0.0), (1 / 16, 1.0), (16, 3))
    x = centres(info)
    flow = np.stack((0.0 * x[..., 0], np.sin(2 * np.pi * x[..., 0])), axis=-1)
    wet = np.ones(info.cells, dtype=bool)
    found = vorticity(flow, joined(wet, info, [around, False], []), info.spacing)
    central = np.cos(2 * np.pi * x[..., 0]) * np.sin(2 * np.pi / 16) * 16
    assert found[1:-1] == pytest.approx(central[1:-1], rel=1e-12)
    assert (found[[0, -1]] == pytest.approx(central[[0, -1]], rel=1e-12)) == around


def test_there_is_no_vorticity_between_the_two_sides_of_a_sheet():
    info = GridInfo((0.0, 0.0), (0.1, 0.1), (8, 6))
    x = centres(info)
    flow = np.stack((np.where(x[..., 1] > 0.3, 1.0, -1.0), 0.0 * x[..., 1]), axis=-1)
    corners = np.array([[-1.0, 0.29], [2.0, 0.29], [2.0, 0.31], [-1.0, 0.31]])
    sheet = (corners, np.array([[0, 1], [1, 2], [2, 3], [3, 0]]))
    wet = np.ones(info.cells, dtype=bool)
    free, parted = (vorticity(flow, joined(wet, info, [False] * 2, w), info.spacing) for w in ([], [sheet]))
    assert np.abs(free).max() == pytest.approx(10.0) and not parted.any()


# ---- shapes -------------------------------------------------------------------------------------------------


def rigid(ax):
    return [p for p in ax.patches if isinstance(p, PathPatch) and to_hex(p.get_facecolor()) == GREY]


def turns(patch, place):
    """Return how often a patch's outline goes around points: not at all outside what is filled."""
    count = np.zeros(len(place))
    for x in patch.get_path().to_polygons():
        area = np.sum(x[:-1, 0] * x[1:, 1] - x[1:, 0] * x[:-1, 1])
        count += np.sign(area) * Path(x).contains_points(place)
    return count


SHAPES = {
    "disk": (2, {"ball": {"centre": [0.9, 0.4], "radius": 0.23}}),
    "rectangle": (2, {"box": {"origin": [0.31, 0.0], "size": [0.47, 0.33]}}),
    "half plane": (2, {"halfspace": {"point": [1.0, 0.3], "normal": [-0.3, 1.0]}}),
    "ball": (3, {"ball": {"centre": [0.9, 0.45, 0.55], "radius": 0.3}}),
    "cylinder": (3, {"cylinder": {"start": [0.4, -0.2, 0.4], "end": [0.8, 0.9, 0.7], "radius": 0.17}}),
    "box": (3, {"box": {"origin": [0.3, 0.2, 0.3], "size": [0.5, 0.6, 0.9]}}),
    "half space": (3, {"halfspace": {"point": [1.0, 0.3, 0.5], "normal": [-0.3, 1.0, 0.2]}}),
    "mesh": (3, {"mesh": "box.stl"}),
}


@pytest.mark.parametrize("outside", [False, True], ids=["obstacle", "container"])
@pytest.mark.parametrize("kind", ["grid", "particles"])
@pytest.mark.parametrize("name", SHAPES)
def test_obstacles_are_drawn_in_their_true_shape(tmp_path, name, kind, outside):
    dim, shape = SHAPES[name]
    exact = {"box": {"origin": [0.3, 0.15, 0.3], "size": [0.5, 0.65, 0.9]}} if name == "mesh" else shape
    if name == "mesh":
        trimesh.creation.box(bounds=[[0.3, 0.15, 0.3], [0.8, 0.8, 1.2]]).export(tmp_path / "box.stl")
    what = fluid(dim) if kind == "grid" else particles(dim)
    made_run(tmp_path, dim=dim, fluid=what, obstacles={"it": {"shape": shape, "outside": outside}})
    stage, (figure,) = figures(tmp_path, "speed")
    place = np.random.default_rng(3).uniform((0.0, 0.0), (2.0, 1.0), (4000, 2))
    for ax, (a, b) in zip(figure.axes, ([0, 1], [0, 2]) if dim == 3 else ([0, 1],), strict=False):
        x = np.tile(stage.middle, (len(place), 1))
        x[:, [a, b]] = place
        drawn = sum((turns(patch, place) for patch in rigid(ax)), np.zeros(len(place))) != 0
        assert np.mean(drawn != (inside(Shape.model_validate(exact), x) != outside)) < 0.004
        assert len(ax.images) == (kind == "grid"), "no cells over them"


def white(ax):
    return [p for p in ax.patches if isinstance(p, PathPatch) and to_hex(p.get_facecolor()) == "#ffffff"]


@pytest.mark.parametrize("dim", [2, 3])
def test_nothing_is_drawn_in_a_cavity_that_is_empty(tmp_path, dim):
    solids = {
        "full": block(dim, cavity=True),
        "empty": block(dim, origin=(1.2, 0.3, 0.3), cavity=True, interior="void"),
        "whole": block(dim, origin=(0.1, 0.3, 0.3), size=(0.3, 0.3, 0.3), interior="void"),
    }
    made_run(tmp_path, dim=dim, fluid=fluid(dim), solids=solids)
    _, (figure,) = figures(tmp_path)
    (hole,) = white(figure.axes[0])
    assert hole.get_path().get_extents().bounds == pytest.approx((1.3, 0.4, 0.2, 0.2))
    (image,) = figure.axes[0].images
    assert image.get_zorder() < hole.get_zorder() < min(c.get_zorder() for c in figure.axes[0].collections[1:])


@pytest.mark.parametrize("dim", [2, 3])
def test_what_reaches_around_a_periodic_side_is_seen_at_both(tmp_path, dim):
    round_about = {"left": "periodic", "right": "periodic"}
    post = {"shape": {"ball": {"centre": [0.05, 0.3, 0.5][:dim], "radius": 0.2}}}
    body = block(dim, origin=(1.85, 0.55, 0.3), size=(0.3, 0.3, 0.4))
    made_run(tmp_path, dim=dim, fluid=fluid(dim, sides=round_about), solids={"body": body}, obstacles={"post": post})
    _, (figure,) = figures(tmp_path)
    ends = []
    for polygons in [c for c in figure.axes[0].collections if type(c) is PolyCollection]:
        x = np.concatenate([path.vertices[:, 0] for path in polygons.get_paths()])
        ends.append((x.min(), x.max()))
    assert sorted(ends) == [pytest.approx((-0.15, 0.15)), pytest.approx((1.85, 2.15))]
    (patch,) = rigid(figure.axes[0])
    assert np.abs(turns(patch, [[0.1, 0.3], [1.9, 0.3], [1.0, 0.3]])).tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_triangles_are_cut_at_a_plane(sign):
    triangles = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3, 3))

    def normals(t):
        return np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])

    (above, of), (below, _) = (clip_triangles(triangles, 1, 0.2, s) for s in (sign, -sign))
    assert np.all(sign * (above[:, :, 1] - 0.2) > -1e-12) and np.all(sign * (below[:, :, 1] - 0.2) < 1e-12)
    whole = np.linalg.norm(normals(triangles), axis=1).sum()
    assert np.linalg.norm(normals(np.concatenate((above, below))), axis=1).sum() == pytest.approx(whole, rel=1e-12)
    turned = np.einsum("ij,ij->i", normals(above), normals(triangles)[of])
    assert np.all(turned > 0.0), "turned as they were"


def test_the_view_of_space_stays_in_the_box_of_the_fluid(tmp_path):
    slope = {"shape": {"halfspace": {"point": [1.0, 0.3, 0.5], "normal": [-0.3, 1.0, 0.2]}}}
    room = {"shape": {"ball": {"centre": [1.0, 0.5, 0.5], "radius": 1.0}}, "outside": True}
    obstacles = {"slope": slope, "room": room}
    made_run(tmp_path, dim=3, fluid=fluid(3), solids={"body": block(3)}, obstacles=obstacles)
    stage, (figure,) = figures(tmp_path)
    (view,) = [ax for ax in figure.axes if ax.name == "3d"]
    assert len([c for c in view.collections if isinstance(c, Poly3DCollection)]) == 2, "what is solid, and the room"
    assert len(view.patches) == 2, "the slope is closed where it leaves the box, at x = 2 and z = 1"
    for obstacle in stage.around.obstacles:
        pieces, of = _in_box(obstacle.points[obstacle.facets], stage)
        assert pieces.min() > -1e-9 and np.all(pieces.max(axis=(0, 1)) < np.array([2.0, 1.0, 1.0]) + 1e-9)
        assert len(of) == len(pieces) > 10


# ---- what is coloured ---------------------------------------------------------------------------------------

#: Kinds of runs: what they are made of, what can be shown of them, and what is by default.
KINDS = {
    "grid": ({"fluid": fluid(2)}, "speed pressure vorticity", "speed"),
    "smoke": ({"fluid": fluid(2, smoke={}), "smoke": True}, "smoke speed pressure vorticity", "smoke"),
    "grid 3D": ({"dim": 3, "fluid": fluid(3)}, "speed pressure vorticity", "speed"),
    "particles": ({"fluid": particles(2)}, "speed pressure", "speed"),
    "particles 3D": ({"dim": 3, "fluid": particles(3)}, "speed pressure", "speed"),
    "solid": ({"solids": {"body": block(2)}}, "speed displacement", "displacement"),
    "solid 3D": ({"dim": 3, "solids": {"body": block(3)}}, "speed displacement", "displacement"),
    "both": (
        {"fluid": fluid(2), "solids": {"body": block(2)}},
        "speed pressure displacement vorticity",
        "speed",
    ),
    "particles with a solid": (
        {"fluid": particles(2), "solids": {"body": block(2)}},
        "speed pressure displacement",
        "speed",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_shows_what_it_has_and_refuses_the_rest_by_name(tmp_path, capsys, kind):
    tables, names, default = KINDS[kind]
    made_run(tmp_path, (0.0, 1.0), **tables)
    assert figures(tmp_path)[0].shown == default
    for name in (*QUANTITIES, "taste"):
        if name in names.split():
            stage, drawn = figures(tmp_path, name)
            assert stage.shown == name
            labels = {ax.get_ylabel() or ax.get_xlabel() for ax in drawn[-1].axes}
            assert QUANTITIES[name].label in labels
        else:
            assert cli.main(["plot", str(tmp_path), "--quantity", name]) == 2
            said = " ".join(capsys.readouterr().err.split())
            assert f"--quantity {name}: the fields in" in said
            assert said.endswith(f"have {' and '.join(names.split())} to show")
    assert not (tmp_path / "pictures").exists()


def test_colours_are_the_values_of_what_is_asked(tmp_path):
    made_run(tmp_path, (0.0, 1.0), fluid=fluid(2), solids={"body": block(2)})
    stage, drawn = figures(tmp_path, "vorticity")
    (image,) = drawn[1].axes[0].images
    assert np.asarray(image.get_array()) == pytest.approx(4.0), "a rate of 2 rad/s"
    assert (stage.norm.vmin, stage.norm.vmax, stage.look.colours) == (-4.0, 4.0, "RdBu_r")
    stage, drawn = figures(tmp_path, "displacement")
    ax = drawn[1].axes[0]
    assert not ax.images and to_hex(ax.get_facecolor()) == WATER
    (mesh,) = [c for c in ax.collections if c.get_array() is not None]
    assert np.asarray(mesh.get_array()) == pytest.approx(np.hypot(0.1, 0.05))
    assert stage.norm.vmin == 0.0


def test_arrows_are_as_long_as_the_flow_is_fast_on_a_stretched_axis_too(tmp_path):
    made_run(tmp_path, fluid=fluid(2, size=(20.0, 0.1), cells=(200, 4)), flow=lambda x: np.ones_like(x))
    stage, (figure,) = figures(tmp_path, "speed")
    assert stage.stretch.tolist() == pytest.approx([1.0, 20.0])
    (arrows,) = [c for c in figure.axes[0].collections if hasattr(c, "scale")]
    assert np.sqrt(2.0) / arrows.scale == pytest.approx(1.3 * 20.0 / 30, rel=1e-12)
    assert len(np.unique(arrows.XY[:, 1])) > 1


# ---- times and files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wanted, steps",
    [
        (Wanted(), range(11)),
        (Wanted(every=4), [0, 4, 8]),
        (Wanted(begin=0.3), range(3, 11)),
        (Wanted(end=0.3), range(4)),
        (Wanted(begin=0.3, end=0.7), range(3, 8)),
        (Wanted(begin=0.3, end=0.7, every=2), [3, 5, 7]),
        (Wanted(begin=0.3, end=0.3), [3]),
        (Wanted(begin=-1.0, end=np.inf, every=20), [0]),
    ],
)
def test_the_times_wanted_are_drawn(tmp_path, wanted, steps):
    times = np.cumsum([0.0] + [0.1] * 10)  # 0.30000000000000004 is 0.3
    made_run(tmp_path, times, fluid=fluid(2, cells=(4, 2)))
    assert [read_frame(path).step for path in wanted_files(tmp_path, wanted)] == list(steps)


def test_a_film_shows_the_times_and_the_quantity_wanted(tmp_path, monkeypatch):
    monkeypatch.setattr(film, "_DPI", 20)
    shown = []
    draw = film.scene_figure
    monkeypatch.setattr(film, "scene_figure", lambda stage, f: shown.append((stage.shown, f.step)) or draw(stage, f))
    made_run(tmp_path, np.arange(6) / 10, fluid=fluid(2, cells=(4, 2)))
    words = ["--quantity", "vorticity", "--from", "0.1", "--to", "0.4", "--every", "2"]
    assert cli.main(["plot", str(tmp_path), "--film", str(tmp_path / "a.gif"), *words]) == 0
    assert shown == [("vorticity", 1), ("vorticity", 3)]


@pytest.mark.parametrize(
    "words, said",
    [
        (["--from", "2"], "--from 2: no output time of {run} lies there; there are 3 from t = 0 s to 0.2 s"),
        (["--from", "0.12", "--to", "0.18"], "--from 0.12 --to 0.18: no output time"),
        (["--from", "0.2", "--to", "0.1"], "--from 0.2 --to 0.1: no output time"),
        (["--to", "-1", "--film"], "--to -1: no output time"),
    ],
)
def test_times_that_there_are_not_are_refused(tmp_path, capsys, words, said):
    made_run(tmp_path, (0.0, 0.1, 0.2), fluid=fluid(2, cells=(4, 2)))
    assert cli.main(["plot", str(tmp_path), *words]) == 2
    assert said.format(run=tmp_path) in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "pictures").exists()


HISTORY = "step,time,dt,tip.x,tip.y,iterations,residual\n1,0.1,0.1,1.0,0.0,3,1e-9\n2,0.2,0.1,2.0,0.0,4,1e-9\n"


@pytest.mark.parametrize("kind, start", [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_pictures_are_stored_as_asked(tmp_path, kind, start):
    made_run(tmp_path, (0.0, 1.0), fluid=fluid(2, cells=(4, 2)))
    (tmp_path / "history.csv").write_text(HISTORY)
    drawn = plot_run(tmp_path, Wanted(every=2), kind)
    assert [path.name for path in drawn] == [f"history.{kind}", f"000000.{kind}"]
    assert all(path.read_bytes().startswith(start) for path in drawn)


def test_a_history_is_drawn_of_the_times_wanted(tmp_path):
    (tmp_path / "history.csv").write_text(HISTORY)
    assert [path.name for path in plot_run(tmp_path, Wanted(begin=0.15))] == ["history.png"]
    with pytest.raises(InputError, match="--from 3: no step of the run lies there; there are 2 from t = 0.1 s to 0.2"):
        plot_run(tmp_path, Wanted(begin=3.0))
    with pytest.raises(InputError, match="--quantity speed: .* has no fields, so nothing can be coloured"):
        plot_run(tmp_path, Wanted(quantity="speed"))
    made_run(tmp_path, (0.0, 0.1), fluid=fluid(2, cells=(4, 2)))
    assert [path.name for path in plot_run(tmp_path, Wanted(end=0.0))] == ["000000.png"], "it has no row of t = 0"


# ---- labels -------------------------------------------------------------------------------------------------


def within(figure):
    """Return whether all that a figure shows lies in it, to a pixel."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = figure.get_tightbbox(canvas.get_renderer())
    width, height = figure.get_size_inches()
    return min(box.x0, box.y0, width - box.x1, height - box.y1) > -1.0 / figure.dpi


@pytest.mark.parametrize("size", [(20.0, 0.1), (0.1, 20.0), (1.0, 1.0), (1e-6, 2e-6), (3e4, 1e4)], ids=str)
@pytest.mark.parametrize("kind", ["grid", "particles", "solid"])
def test_no_label_of_a_plane_is_cut(tmp_path, kind, size):
    origin = [1e-3, 0.0] if max(size) > 1e-3 else [0.0, 0.0]
    smallest = min(size)
    if kind == "solid":
        made_run(tmp_path, (0.0, smallest), solids={"body": block(2, origin=origin, size=size)})
    elif kind == "grid":
        made_run(tmp_path, fluid=fluid(2, size=size, cells=(4, 4), origin=origin), flow=lambda x: 1e-5 * spinning(x))
    else:
        fill = [{"box": {"origin": origin, "size": list(size)}}]
        made_run(tmp_path, fluid=particles(2, origin=origin, size=list(size), spacing=smallest / 4, fill=fill))
    assert within(figures(tmp_path)[1][0])


@pytest.mark.parametrize(
    "size", [(2.0, 1.0, 1.0), (1.0, 1.0, 1.0), (10.0, 0.1, 0.1), (0.1, 8.0, 0.1), (0.2, 0.2, 10.0)], ids=str
)
def test_no_label_of_space_is_cut(tmp_path, size):
    post = {"shape": {"box": {"origin": [0.0] * 3, "size": [0.05] * 3}}}
    made_run(tmp_path, dim=3, fluid=fluid(3, size=size, cells=(6, 6, 6)), obstacles={"post": post})
    (figure,) = figures(tmp_path)[1]
    assert within(figure)
    *slices, view = sorted(figure.axes, key=lambda ax: ax.name == "3d")
    labels = [axis.label.get_window_extent() for axis in (view.xaxis, view.yaxis, view.zaxis)]
    assert not any(label.overlaps(ax.get_window_extent()) for label in labels for ax in slices)
