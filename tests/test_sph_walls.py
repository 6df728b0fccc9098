"""Wall particles and filled shapes against exact volumes, distances and lattice sums. Takes about ten seconds."""

import math
from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

from petfsi.errors import InputError
from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.dummies import wall_dummies
from petfsi.fields.sph.fill import hydrostatic, liquid
from petfsi.fields.sph.kernels import Kernel
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.layers import divided
from petfsi.fields.sph.solids import build_solids, nearest, pseudonormals
from petfsi.geometry.obstacles import obstacle_surface
from petfsi.scene.schema import Obstacle
from petfsi.scene.sides import InflowSide
from petfsi.scene.tables import Shape

DX = 0.1
HERE = Path(".")


def domain(*counts, sides=None, low=0.0):
    size = DX * np.array(counts, dtype=float)
    return Domain(np.full(len(counts), low), low + size, tuple(sides or [("slip", "slip")] * len(counts)))


def obstacle(outside=False, **shape):
    return Obstacle.model_validate({"shape": shape, "outside": outside})


def ball(centre, radius, outside=False):
    return obstacle(outside, ball={"centre": centre, "radius": radius})


def box(origin, size, outside=False):
    return obstacle(outside, box={"origin": origin, "size": size})


def plane(point, normal):
    return obstacle(halfspace={"point": point, "normal": normal})


def dummies(room, no_slip=(), **obstacles):
    found = wall_dummies(room, DX, 3 * DX, obstacles, HERE, no_slip)
    check(found, room)
    return found


def check(found, room):
    """What holds of all: unit normals, nothing twice, nothing in the fluid, nothing out of reach."""
    n, dim = found.x.shape
    assert {len(part) for part in (found.volume, found.normal, found.depth, found.no_slip, found.wall)} == {n}
    if n < 2:
        return
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)
    assert found.depth.min() > 0 and found.depth.max() < 3 * DX and found.volume.min() > 0
    assert cKDTree(found.x).query(found.x, k=2)[0][:, 1].min() > 0.4 * DX
    assert np.all(found.x[:, room.periodic] >= room.low[room.periodic])
    assert np.all(found.x[:, room.periodic] <= room.high[room.periodic])


def grid(room):
    """The lattice of spacing DX in a domain."""
    rows = [
        low + (np.arange(round((high - low) / DX)) + 0.5) * DX for low, high in zip(room.low, room.high, strict=True)
    ]
    return np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, len(rows))


def kernel_sums(at, x, volume):
    kernel = Kernel("wendland", x.shape[1], 1.5 * DX)
    near = cKDTree(x).query_ball_point(at, kernel.support)
    return np.array(
        [volume[i] @ kernel.values(np.linalg.norm(x[i] - p, axis=1))[0] for p, i in zip(at, near, strict=True)]
    )


def solid_share(at, depth, m):
    """The kernel's integral over what is solid, by a fine sum around each point."""
    dim = at.shape[1]
    kernel = Kernel("wendland", dim, 1.5 * DX)
    along = (np.arange(-m, m) + 0.5) / m * kernel.support
    offset = np.stack(np.meshgrid(*[along] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    weight = kernel.values(np.linalg.norm(offset, axis=1))[0]
    offset, weight = offset[weight > 0], weight[weight > 0] / weight.sum()
    return (depth((at[:, None] + offset).reshape(-1, dim)) > 0).reshape(len(at), -1) @ weight


# ---- sides ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [(7, 5), (6, 5, 4)])
def test_sides_continue_the_lattice_around_corners(counts):
    room = domain(*counts, low=-0.3)
    found = dummies(room)
    beyond = np.maximum(room.low - found.x, found.x - room.high)
    np.testing.assert_allclose(found.depth, np.linalg.norm(np.maximum(beyond, 0), axis=1), atol=1e-12)
    foot = found.x + found.depth[:, None] * found.normal
    np.testing.assert_allclose(foot, np.clip(found.x, room.low, room.high), atol=1e-12)
    places = (found.x - room.low) / DX - 0.5
    np.testing.assert_allclose(places, np.rint(places), atol=1e-9)
    np.testing.assert_allclose(found.volume, DX ** len(counts), rtol=1e-12)
    wanted = np.stack(np.meshgrid(*[np.arange(-3, n + 3) for n in counts], indexing="ij"), axis=-1)
    wanted = wanted.reshape(-1, len(counts))
    gap = np.maximum(np.maximum(-wanted - 0.5, wanted + 0.5 - np.array(counts)), 0)
    assert len(found.x) == np.count_nonzero((gap.max(axis=1) > 0) & (np.linalg.norm(gap, axis=1) < 3))
    at = grid(room)
    both = kernel_sums(at, np.concatenate((at, found.x)), np.full(len(at) + len(found.x), DX ** len(counts)))
    np.testing.assert_allclose(both, both[0], rtol=1e-12)
    assert both[0] == pytest.approx(1.0, abs=0.006)


def test_sides_say_what_they_are():
    room = domain(8, 6, sides=[("no-slip", "slip"), ("slip", "no-slip")])
    found = dummies(room)
    assert found.names == ("left", "right", "bottom", "top")
    for wall, (normal, rough) in enumerate([((1, 0), 1), ((-1, 0), 0), ((0, 1), 0), ((0, -1), 1)]):
        mine = found.wall == wall
        assert np.all(found.no_slip[mine] == rough)
        assert np.all(found.normal[mine] @ normal > 0.7)
        assert np.count_nonzero(mine & (np.abs(found.normal @ normal - 1) < 1e-12)) == 3 * (8, 6)[wall < 2]


def test_sides_around_a_size_of_no_whole_spacings_keep_layers_and_stand_for_all():
    room = Domain(np.zeros(2), np.array([0.84, 0.5]), (("slip", "slip"),) * 2)
    found = dummies(room)
    bottom = np.abs(found.normal @ (0, 1) - 1) < 1e-12
    np.testing.assert_allclose(np.unique(np.round(found.depth[bottom], 9)), [0.05, 0.15, 0.25])
    assert found.volume[bottom].sum() == pytest.approx(0.84 * 0.3)
    assert np.count_nonzero(bottom) == 24


@pytest.mark.parametrize("dim", (2, 3))
def test_nothing_is_behind_periodic_sides(dim):
    found = dummies(domain(*[6] * dim, sides=[("periodic",) * 2, ("slip", "no-slip"), ("periodic",) * 2][:dim]))
    assert len(found.x) == 6 ** (dim - 1) * 6
    assert set(found.wall) == {2, 3}


def test_walls_go_on_past_open_sides():
    room = domain(6, 5, sides=[("slip", "slip"), ("slip", "open")])
    found = dummies(room)
    above = found.x[:, 1] > 0.5
    assert np.count_nonzero(above) == 2 * 9
    assert np.all((found.x[above, 0] < 0) | (found.x[above, 0] > 0.6))
    np.testing.assert_allclose(np.abs(found.normal[above]), np.tile([1.0, 0.0], (18, 1)))
    assert found.x[:, 1].max() == pytest.approx(0.75)


def test_an_inflow_through_part_of_a_side_leaves_walls_beside_it():
    jet = {"speed": 1.0, "region": {"box": {"origin": [-0.1, 0.2], "size": [0.2, 0.2]}}}
    room = domain(6, 6, sides=[(InflowSide.model_validate({"inflow": jet}), "open"), ("open", "open")])
    found = wall_dummies(room, DX, 3 * DX, {}, HERE)
    assert np.all((found.x[:, 0] < 0) & ((found.x[:, 1] < 0.2) | (found.x[:, 1] > 0.4)))
    assert len(found.x) == 3 * (4 + 6)


# ---- obstacles ------------------------------------------------------------------------------------------------------

PLANES = {0: (0.0, 1.0), 17: (-math.sin(math.radians(17)), math.cos(math.radians(17))), 45: (-1.0, 1.0)}
WALLS = {
    **{f"plane {angle}": ((26, 26), plane([1.3, 1.0], normal)) for angle, normal in PLANES.items()},
    "ball of 5": ((20, 20), ball([1.0, 1.0], 0.5)),
    "ball of 10": ((30, 30), ball([1.5, 1.5], 1.0)),
    "room of 5": ((16, 16), ball([0.8, 0.8], 0.5, True)),
    "room of 10": ((26, 26), ball([1.3, 1.3], 1.0, True)),
    "box": ((20, 20), box([0.6, 0.6], [0.8, 0.7])),
    "box off the lattice": ((20, 20), box([0.63, 0.56], [0.84, 0.7])),
    "room of a box": ((20, 20), box([0.6, 0.6], [0.8, 0.7], True)),
    "blunt corner with the floor": ((20, 16), plane([0.5, 0.0], [1.0, 0.5])),
    "sharp corner with the floor": ((20, 16), plane([0.5, 0.0], [1.0, -0.5])),
    "plane in space": ((12, 12, 9), plane([0.6, 0.5, 0.4], [-0.5, 1.0, 0.3])),
    "ball in space": ((14, 14, 14), ball([0.7] * 3, 0.4)),
    "room in space": ((14, 14, 14), ball([0.7] * 3, 0.4, True)),
    "box in space": ((10, 10, 10), box([0.3] * 3, [0.4] * 3)),
    "cylinder in space": (
        (14, 12, 12),
        obstacle(cylinder={"start": [0.4, 0.6, 0.6], "end": [1, 0.6, 0.7], "radius": 0.3}),
    ),
}


@pytest.mark.parametrize("name", WALLS)
def test_kernel_sums_over_dummies_are_its_integral_over_the_solid(name):
    """To what the same sum over the lattice behind a plane has, -1.3% of the whole, and 1.5% more at most."""
    counts, wall = WALLS[name]
    room = domain(*counts)
    found = dummies(room, o=wall)
    (solid,) = build_solids(room, DX, {"o": wall}, HERE, 0.4)

    def depth(x):
        return np.maximum(solid.depth(x, 0.3)[0], np.maximum(room.low - x, x - room.high).max(axis=1))

    at = grid(room)
    at = at[(depth(at) <= -0.5 * DX * (1 - 1e-6)) & (solid.depth(at, 0.2)[0] > -1.6 * DX)]
    if "plane" in name:  # corners have the errors of both walls
        at = at[np.all((at > room.low + 2.5 * DX) & (at < room.high - 2.5 * DX), axis=1)]
    at = np.random.default_rng(1).choice(at, min(len(at), 60 if len(counts) == 2 else 25), replace=False)
    error = kernel_sums(at, found.x, found.volume) - solid_share(at, depth, 40 if len(counts) == 2 else 14)
    assert abs(error.mean() + 0.007) < 0.011
    assert np.abs(error).max() < 0.04


def test_layers_shrink_with_a_ball():
    found = dummies(domain(20, 20), o=ball([1.0, 1.0], 0.6))
    mine = found.names[4:] == ("o",) and found.wall == 4
    for k in range(3):
        layer = mine & (np.abs(found.depth - (k + 0.5) * DX) < 0.02 * DX)
        area = math.pi * ((0.6 - k * DX) ** 2 - (0.6 - (k + 1) * DX) ** 2)
        assert found.volume[layer].sum() == pytest.approx(area, rel=0.01)
        assert found.volume[layer].max() < 1.25 * DX**2
    np.testing.assert_allclose(
        np.linalg.norm(found.x[mine] + found.depth[mine, None] * found.normal[mine] - 1.0, axis=1), 0.6, atol=0.003
    )


def test_a_step_on_the_floor_has_no_wall_below_it():
    found = dummies(domain(20, 12), no_slip=["step"], step=box([1.2, 0.0], [0.8, 0.6]))
    mine = found.wall == 4
    assert np.all(found.no_slip == mine)
    # three layers along its front and its top, which share a corner
    assert np.count_nonzero(mine) == 3 * 6 + 3 * 5
    assert set(map(tuple, found.normal[mine])) == {(-1.0, 0.0), (0.0, 1.0)}
    # sides are left out where the step hides them
    assert not np.any((found.wall == 2) & (found.x[:, 0] > 1.5))


def test_faces_on_each_other_are_no_walls():
    found = dummies(domain(20, 12), low=box([0.8, 0.0], [1.2, 0.4]), high=box([1.4, 0.4], [0.6, 0.4]))
    assert set(map(tuple, found.normal[found.wall >= 4])) == {(-1.0, 0.0), (0.0, 1.0)}
    assert np.count_nonzero(found.wall == 5) == 3 * 4 + 3 * 3


@pytest.mark.parametrize("dim", (2, 3))
def test_obstacles_far_away_leave_the_sides_alone(dim):
    room = domain(*[6] * dim)
    alone = dummies(room)
    for far in (ball([3.0] * dim, 0.4), box([3.0] * dim, [0.4] * dim), box([-1.0] * dim, [3.0] * dim, True)):
        found = dummies(room, o=far)
        np.testing.assert_array_equal(found.x, alone.x)
        assert len(liquid(room, DX, [block([0.0] * dim, [0.6] * dim)], {"o": far}, HERE, fitted=True).x) == 6**dim
    full = liquid(room, DX, [block([0.0] * dim, [0.6] * dim)], {"o": box([-1.0] * dim, [3.0] * dim)}, HERE)
    assert (len(full.x), full.blocked) == (0, 6**dim)


def test_half_spaces_along_the_axes_stand_on_a_lattice():
    found = dummies(domain(8, 8), o=plane([0.0, 0.53], [0.0, 2.0]))
    mine = found.wall == 4
    np.testing.assert_allclose(np.unique(np.round(0.53 - found.x[mine, 1], 9)), [0.05, 0.15, 0.25])
    assert found.volume[mine].sum() == pytest.approx(0.8 * 0.3)


def test_an_obstacle_in_another_has_no_dummies_and_hides_none():
    room = domain(14, 14)
    alone = dummies(room, o=plane([0.7, 0.7], [1.0, -0.7]))
    both = dummies(room, o=plane([0.7, 0.7], [1.0, -0.7]), b=ball([0.4, 0.9], 0.15))
    np.testing.assert_array_equal(alone.x, both.x)


def test_a_place_in_two_obstacles_belongs_to_one():
    room = domain(20, 20)
    found = dummies(room, a=ball([0.8, 1.0], 0.4), b=ball([1.2, 1.0], 0.4))
    both = np.all(np.linalg.norm(found.x[:, None] - np.array([[0.8, 1.0], [1.2, 1.0]]), axis=2) < 0.39, axis=1)
    assert np.all(found.wall[both] == 4)
    distance = np.linalg.norm(found.x + found.depth[:, None] * found.normal - (1.2, 1.0), axis=1)
    assert np.all(distance[found.wall == 4] > 0.3)


def test_a_ball_on_a_seam_is_that_within():
    sides = [("periodic",) * 2, ("slip",) * 2]
    moved = dummies(domain(20, 20, sides=sides), o=ball([0.0, 1.0], 0.4))
    within = dummies(domain(20, 20, sides=sides), o=ball([1.0, 1.0], 0.4))
    for k in range(3):
        sums = [d.volume[(d.wall == 4) & (np.abs(d.depth - (k + 0.5) * DX) < DX / 2)].sum() for d in (moved, within)]
        assert sums[0] == pytest.approx(sums[1], rel=0.03)
    assert np.any(moved.x[moved.wall == 4, 0] < 0.3) and np.any(moved.x[moved.wall == 4, 0] > 1.7)


def test_what_reaches_through_a_period_has_no_ends():
    room = domain(10, 9, 9, sides=[("periodic",) * 2, ("open",) * 2, ("open",) * 2])
    rod = obstacle(cylinder={"start": [0.0, 0.45, 0.45], "end": [1.0, 0.45, 0.45], "radius": 0.3})
    found = dummies(room, o=rod)
    np.testing.assert_allclose(found.normal[:, 0], 0.0, atol=1e-9)
    assert found.volume.sum() == pytest.approx(math.pi * 0.09, rel=0.03)
    bar = dummies(room, o=box([0.0, 0.2, 0.2], [1.0, 0.5, 0.5]))
    np.testing.assert_array_equal(bar.normal[:, 0], 0.0)
    assert bar.volume.sum() == pytest.approx(0.25)


@pytest.mark.parametrize("outside", (False, True))
def test_a_box_from_a_file_is_as_good_as_one(outside, tmp_path):
    shape = box([0.41, 0.52], [0.6, 0.5])
    points, facets = obstacle_surface(shape, 2, DX, np.zeros(2), np.ones(2), "o", HERE)
    meshio.write(tmp_path / "box.vtk", meshio.Mesh(np.column_stack((points, [0.0] * 4)), [("line", facets)]))
    mesh = obstacle(outside, mesh=str(tmp_path / "box.vtk"))
    found = dummies(domain(14, 14), o=mesh)
    mine = found.wall == 4
    inner = np.minimum(found.x - (0.41, 0.52), (1.01, 1.02) - found.x).min(axis=1)[mine]
    if not outside:
        np.testing.assert_allclose(found.depth[mine], inner, atol=1e-9)
        assert found.volume[mine].sum() == pytest.approx(0.3, rel=0.01)
    else:
        assert np.all(inner < 0)
    flooded = liquid(domain(14, 14), DX, [Shape(mesh=str(tmp_path / "box.vtk"))], {}, HERE)
    assert len(flooded.x) == 30 and flooded.notes == []
    kept = liquid(domain(14, 14), DX, [Shape(box={"origin": [0.0, 0.0], "size": [1.4, 1.4]})], {"o": mesh}, HERE)
    gap = np.linalg.norm(np.maximum(np.maximum((0.41, 0.52) - kept.x, kept.x - (1.01, 1.02)), 0), axis=1)
    room = np.minimum(kept.x - (0.41, 0.52), (1.01, 1.02) - kept.x).min(axis=1)
    assert (room if outside else gap).min() >= DX / 2


@pytest.mark.parametrize("dim", (2, 3))
def test_depths_are_right_on_both_sides_of_faces_edges_and_corners(dim):
    shape = box([0.2] * dim, [0.6] * dim)
    surface = obstacle_surface(shape, dim, DX, np.zeros(dim), np.ones(dim), "o", HERE)
    x = np.random.default_rng(2).uniform(-0.2, 1.2, (500, dim))
    depth, normal = nearest(x, surface[0][surface[1]], pseudonormals(*surface), 0.35, DX)
    gap = np.abs(x - 0.5) - 0.3
    exact = np.where(gap.max(axis=1) < 0, -gap.max(axis=1), -np.linalg.norm(np.maximum(gap, 0), axis=1))
    near = np.abs(exact) < 0.35
    np.testing.assert_allclose(depth[near], exact[near], atol=1e-12)
    assert np.all(np.isinf(depth[~near])) and np.all(normal[~near] == 0)
    foot = x[near] + depth[near, None] * normal[near]
    np.testing.assert_allclose(np.abs(foot - 0.5).max(axis=1), 0.3, atol=1e-12)


def test_points_are_divided_into_equal_parts():
    x = np.stack(np.meshgrid(*[np.arange(24) + 0.5] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    middle, weight = divided(x, np.full(len(x), 2.0), 72.0)
    assert len(middle) == 16 and weight.sum() == pytest.approx(2 * 24**2)
    assert weight.min() > 50 and weight.max() < 95
    none, nothing = divided(x[:0], np.zeros(0), 72.0)
    assert none.shape == (0, 2) and nothing.shape == (0,)


@pytest.mark.parallel([1, 2, 3])
def test_every_rank_has_the_same():
    from mpi4py import MPI

    found = dummies(domain(12, 12), o=ball([0.6, 0.6], 0.3))
    flooded = liquid(domain(12, 12), DX, [Shape(ball={"centre": [0.6, 0.6], "radius": 0.5})], {}, HERE)
    said = [part.tobytes() for part in (found.x, found.volume, found.normal, flooded.x)]
    assert MPI.COMM_WORLD.bcast(said, 0) == said


# ---- liquid ---------------------------------------------------------------------------------------------------------


def block(origin, size):
    return Shape(box={"origin": origin, "size": size})


@pytest.mark.parametrize("counts", [(8, 6), (5, 4, 6)])
def test_a_box_on_the_lattice_is_the_lattice(counts):
    room = domain(*counts, low=-0.2)
    found = liquid(room, DX, [block([-0.2] * len(counts), [DX * n for n in counts])], {}, HERE)
    np.testing.assert_allclose(found.x, grid(room), atol=1e-12)
    np.testing.assert_allclose(found.volume, DX ** len(counts))
    assert (found.outside, found.blocked, found.double) == (0, 0, 0)


def test_a_box_off_the_lattice_has_its_own_and_all_of_its_volume():
    found = liquid(domain(12, 12), DX, [block([0.13, 0.1], [0.64, 0.5])], {}, HERE)
    assert len(found.x) == 6 * 5
    assert found.volume.sum() == pytest.approx(0.32)
    np.testing.assert_allclose(np.unique(np.round(found.x[:, 0], 9)), 0.13 + (np.arange(6) + 0.5) * 0.64 / 6)
    np.testing.assert_allclose(np.unique(np.round(found.x[:, 1], 9)), 0.15 + np.arange(5) * DX)


def test_a_box_that_is_larger_than_the_fluids_is_told():
    """Also where it lacks no place: of less than half a spacing, and of what a period repeats."""
    room = domain(10, 10, sides=(("slip", "slip"), ("periodic", "periodic")))
    found = liquid(room, DX, [block([0.0, 0.0], [0.2, 1.0]), block([0.5, 0.0], [0.53, 1.25])], {}, HERE)
    assert found.notes == [
        "fluid.fill: 4 places lie outside the box",
        "fluid.fill.1 has x from 0.5 to 1.03 m, the fluid's box from 0 to 1 m: what lies in that is filled; "
        "is 1.25 m long along y, which repeats after 1 m: that is filled once",
    ]
    assert found.volume.sum() == pytest.approx(0.7)
    found = liquid(room, DX, [block([-0.001, 0.1 * n], [0.2, 0.1]) for n in range(10)], {}, HERE)
    assert len(found.notes) == 7 and found.notes[-1] == "fluid.fill: of 4 more shapes only a part is filled"
    assert liquid(room, DX, [block([0.0, 0.7], [1.0, 1.0])], {}, HERE).notes == []


def test_boxes_beyond_the_fluids_are_counted_not_their_axes():
    corner = [block([-0.5 - 0.1 * n] * 2, [0.6 + 0.1 * n] * 2) for n in range(7)]
    told = [note for note in liquid(domain(10, 10), DX, corner, {}, HERE).notes if "places" not in note]
    assert [note.split()[0] for note in told] == [*(f"fluid.fill.{n}" for n in range(6)), "fluid.fill:"]
    assert told[0].count("what lies in that is filled") == 2
    assert told[-1] == "fluid.fill: of 1 more shape only a part is filled"


def test_what_is_outside_is_dropped_and_counted():
    room = domain(10, 10)
    found = liquid(room, DX, [block([-0.2, 0.0], [0.5, 0.4])], {}, HERE)
    assert (len(found.x), found.outside) == (12, 8) and found.x.min() > 0
    found = liquid(room, DX, [Shape(ball={"centre": [0.0, 0.5], "radius": 0.31})], {}, HERE)
    assert len(found.x) == found.outside == 16
    assert found.notes == ["fluid.fill: 16 places lie outside the box"]
    found = liquid(room, DX, [Shape(halfspace={"point": [0.0, 0.3], "normal": [0.0, 1.0]})], {}, HERE)
    assert (len(found.x), found.outside) == (30, 0)


def test_what_is_far_larger_than_the_fluids_box_fills_it(tmp_path):
    """In time and memory of the fluid's places, as files in other units than the scene's would take those of theirs."""
    square = tmp_path / "square.vtk"
    corners = [[-1e5, -1e5, 0.0], [2e5, -1e5, 0.0], [2e5, 0.7, 0.0], [-1e5, 0.7, 0.0]]
    meshio.Mesh(corners, [("line", [[0, 1], [1, 2], [2, 3], [3, 0]])]).write(square)
    for shape in (Shape(mesh=str(square)), Shape(ball={"centre": [0.5, 0.7 - 1e7], "radius": 1e7})):
        found = liquid(domain(10, 10), DX, [shape], {}, HERE)
        assert (len(found.x), found.outside) == (70, 0)
        assert len(found.notes) == 1 and "what lies in that is filled" in found.notes[0]
        room = domain(10, 10, sides=(("periodic", "periodic"), ("slip", "slip")))
        with pytest.raises(
            InputError, match=r"fluid.fill.0: is .* m long along x, which repeats after 1 m; at most 100"
        ):
            liquid(room, DX, [shape], {}, HERE)


def test_a_cylinder_is_filled():
    shape = Shape(cylinder={"start": [0.6, 0.6, 0.2], "end": [0.6, 0.6, 1.0], "radius": 0.5})
    found = liquid(domain(12, 12, 12), DX, [shape], {}, HERE)
    assert len(found.x) == 8 * np.count_nonzero(np.linalg.norm(grid(domain(12, 12)) - 0.6, axis=1) < 0.5)


def test_overlaps_count_once():
    room = domain(10, 10)
    parts = [block([0.0, 0.0], [0.6, 0.4]), block([0.4, 0.0], [0.6, 0.6])]
    found = liquid(room, DX, parts, {}, HERE)
    assert (len(found.x), found.double) == (24 + 28, 8)
    assert np.count_nonzero(found.shape == 0) == 24
    assert len(np.unique(np.round(found.x / DX, 6), axis=0)) == len(found.x)
    found = liquid(
        room, DX, [block([0.0, 0.0], [0.63, 0.4]), Shape(ball={"centre": [0.6, 0.3], "radius": 0.3})], {}, HERE
    )
    assert cKDTree(found.x).query(found.x, k=2)[0][:, 1].min() > 0.49 * DX
    assert not np.any((found.shape == 1) & (found.x[:, 0] < 0.63) & (found.x[:, 1] < 0.4))


def test_what_crosses_a_seam_comes_in_on_the_other_side():
    room = domain(10, 6, sides=[("periodic",) * 2, ("slip",) * 2])
    for shape, count in ((block([0.8, 0.0], [0.4, 0.3]), 12), (Shape(ball={"centre": [1.0, 0.3], "radius": 0.21}), 12)):
        found = liquid(room, DX, [shape], {}, HERE)
        assert (len(found.x), found.outside) == (count, 0)
        assert np.count_nonzero(found.x[:, 0] < 0.5) == count // 2
        np.testing.assert_allclose(np.sort(found.x[:, 0] % 1.0), np.sort((1.0 - found.x[:, 0]) % 1.0), atol=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("outside", (False, True))
def test_particles_keep_off_obstacles(dim, outside):
    room = domain(*[12] * dim)
    wall = ball([0.6] * dim, 0.4, outside)
    found = liquid(room, DX, [block([0.0] * dim, [1.2] * dim)], {"o": wall}, HERE)
    distance = (np.linalg.norm(found.x - 0.6, axis=1) - 0.4) * (-1 if outside else 1)
    # facets lie a little inside and outside of the ball
    assert distance.min() > 0.47 * DX
    assert len(found.x) + found.blocked == 12**dim
    away = (np.linalg.norm(grid(room) - 0.6, axis=1) - 0.4) * (-1 if outside else 1)
    assert abs(len(found.x) - np.count_nonzero(away >= DX / 2)) <= 2**dim
    touching = liquid(room, DX, [block([0.0] * dim, [1.2] * dim)], {"o": box([0.4] * dim, [0.4] * dim)}, HERE)
    assert touching.blocked == 4**dim


@pytest.mark.parametrize("name", ["plane 17", "plane 45", "room of 5", "plane in space"])
def test_a_fitted_fill_leaves_no_gap(name):
    counts, wall = WALLS[name]
    dim, room = len(counts), domain(*counts)
    found = liquid(room, DX, [block([0.0] * dim, [DX * n for n in counts])], {"o": wall}, HERE, fitted=True)
    walls = dummies(room, o=wall)
    (solid,) = build_solids(room, DX, {"o": wall}, HERE, 0.4)
    depth = solid.depth(found.x, 0.2, far=False)[0]
    near = np.flatnonzero(depth > -1.6 * DX)[:60]
    assert depth.max() < -0.15 * DX
    sums = kernel_sums(found.x[near], np.concatenate((found.x, walls.x)), np.concatenate((found.volume, walls.volume)))
    assert abs(sums.mean() - 1.0) < 0.015 and np.abs(sums - 1.0).max() < 0.04
    if name == "room of 5":
        assert found.volume.sum() == pytest.approx(math.pi * 0.25, rel=0.003)
    aligned = liquid(
        room,
        DX,
        [block([0.0] * dim, [DX * n for n in counts])],
        {"o": box([0.2] * dim, [0.3] * dim)},
        HERE,
        fitted=True,
    )
    places = aligned.x / DX - 0.5
    np.testing.assert_allclose(places, np.rint(places), atol=1e-9)


# ---- at rest --------------------------------------------------------------------------------------------------------


def law(dim):
    return Law(dim, 1000.0, 30.0, 1.5 * DX, DX, gravity=(0.0,) * dim)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("sign", (-1, 1))
def test_pressure_of_a_tank_is_by_depth(dim, sign):
    x = grid(domain(*[6] * dim))
    g = np.zeros(dim)
    g[-1] = sign * 9.81
    depth = 0.6 - x[:, -1] if sign < 0 else x[:, -1]
    np.testing.assert_allclose(hydrostatic(x, g, law(dim)), 9810 * depth, rtol=1e-12)
    tilted = np.array([3.0, -4.0, 0.0][:dim])
    p = hydrostatic(x, tilted, law(dim))
    assert p.min() == pytest.approx(1000 * 5 * 0.05) and np.ptp(p) == pytest.approx(1000 * np.ptp(x @ tilted))
    np.testing.assert_array_equal(hydrostatic(x, np.zeros(dim), law(dim)), 0.0)
    np.testing.assert_array_equal(hydrostatic(x, g, law(dim), [True] * dim), 0.0)
    assert hydrostatic(x[:0], g, law(dim)).shape == (0,)


def test_columns_bodies_and_drops_have_levels_of_their_own():
    room = domain(20, 10)
    parts = [block([0.0, 0.0], [0.5, 0.8]), block([0.5, 0.0], [0.5, 0.3]), block([1.5, 0.0], [0.5, 0.4])]
    found = liquid(room, DX, [*parts, block([1.5, 0.7], [0.2, 0.2])], {}, HERE)
    level = hydrostatic(found.x, [0.0, -10.0], law(2)) / 1e4 + found.x[:, 1]
    np.testing.assert_allclose(level, np.array([0.8, 0.3, 0.4, 0.9])[found.shape])
    apart = found.shape != 1
    level = hydrostatic(found.x[apart], [0.0, -10.0], law(2)) / 1e4 + found.x[apart, 1]
    np.testing.assert_allclose(level, np.array([0.8, 0.3, 0.4, 0.9])[found.shape[apart]])


@pytest.mark.parametrize("fitted", (False, True))
def test_what_is_below_something_has_the_level_around_it(fitted):
    room = domain(16, 12)
    obstacles = {"o": ball([0.8, 0.5], 0.22), "lid": box([0.0, 0.3], [0.3, 0.9])}
    found = liquid(room, DX, [block([0.0, 0.0], [1.6, 1.0])], obstacles, HERE, fitted=fitted)
    p = hydrostatic(found.x, [0.0, -9.81], law(2), room.periodic, found.is_solid)
    np.testing.assert_allclose(p, 9810 * (1.0 - found.x[:, 1]), atol=9810 * 0.3 * DX)
    if not fitted:
        np.testing.assert_allclose(p, 9810 * (1.0 - found.x[:, 1]), rtol=1e-9)
