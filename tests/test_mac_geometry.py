"""What cells and faces are, the band around the fluid, closed regions, obstacles from files."""

import numpy as np
import pytest
from mac_cases import BOX, make_fluid, max_divergence, set_velocity, solid_box, solve, whole, whole_state
from mpi4py import MPI

from petfsi.fields.mac.grid import kinds


@pytest.mark.parallel([1, 3])
def test_faces_are_what_their_cells_and_crossings_make_them():
    fluid = make_fluid((20, 18), sides={"top": "open"}, obstacles={"box": BOX})
    grid = fluid.grid
    version = fluid.geometry_version
    x, y, _ = grid.coordinates(None)
    inside = np.where((x > 0.1) & (x < 0.4) & (y > 0.3) & (y < 0.5), kinds.SOLID, kinds.FLUID).astype(np.uint8)
    inside[(x > 0.2) & (x < 0.25) & (y > 0.38) & (y < 0.45)] = kinds.VOID
    crossed = [grid.zeros_faces(axis, bool) for axis in (0, 1)]
    xf, yf, _ = grid.coordinates(0)
    crossed[0][(np.abs(xf - 0.8) < 1e-9) & (yf < 0.7)] = True
    fluid.immerse(inside, crossed)
    assert fluid.geometry_version == version + 1
    fluid.immerse(inside, crossed)
    assert fluid.geometry_version == version + 1
    cell = whole_state(fluid)["cell_kind"]
    xc, yc = np.meshgrid((np.arange(20) + 0.5) / 20, (np.arange(18) + 0.5) / 18, indexing="ij")
    block = (xc > 0.35) & (xc < 0.65) & (yc > 0.3) & (yc < 0.6)
    assert np.array_equal(cell == kinds.OBSTACLE, block)
    covered = (xc > 0.1) & (xc < 0.4) & (yc > 0.3) & (yc < 0.5) & ~block
    void = (xc > 0.2) & (xc < 0.25) & (yc > 0.38) & (yc < 0.45)
    assert void.sum() == 1
    assert np.array_equal(cell, np.select([block, void, covered], [2, 3, 1], 0))
    for axis, name in enumerate("xy"):
        kind = np.moveaxis(whole_state(fluid)[f"face_kind_{name}"], axis, 0)
        c = np.moveaxis(cell, axis, 0)
        below, above = c[:-1], c[1:]
        one = (below == 0) != (above == 0)
        other = np.maximum(below, above)
        wanted = np.select([(below == 0) & (above == 0), one & (other == 2), one], [1, 3, 4], 0)
        if axis == 0:
            # a sheet between the cell rows 15 and 16 cuts fluid from fluid
            wanted[15, yc[0] < 0.7] = kinds.SOLID_FACE
        assert np.array_equal(kind[1:-1], wanted)
        assert np.all(kind[0] == kinds.WALL)
        assert np.all(kind[-1] == (kinds.OPEN if axis == 1 else kinds.WALL))
    # kinds are right in every ghost, too
    for axis in (0, 1):
        again = fluid.face_kind[axis].copy()
        grid.exchange_faces(axis, again)
        assert np.array_equal(again, fluid.face_kind[axis])


@pytest.mark.parallel([1, 3])
def test_a_side_covered_by_a_solid_is_dead_and_a_moving_solid_pushes():
    fluid = make_fluid((18, 18), sides={"right": "open"})
    grid = fluid.grid
    fluid.immerse(solid_box(fluid, [-1.0, -1.0], [0.3, 2.0]), None)
    kind = whole_state(fluid)["face_kind_x"]
    assert np.all(kind[:5] == kinds.DEAD) and np.all(kind[5] == kinds.SOLID_FACE) and np.all(kind[6:18] == 1)
    dt = 0.01
    fluid.predict(0.0, dt)
    fluid.assemble(0.0, dt)
    solid = fluid.face_kind[0] == kinds.SOLID_FACE
    fluid.boundary_velocity[0][solid] = 3.0
    # the coupling's D1 H u: an inflow of 3 m/s through the lower face of each cell next to the piston
    pushed = grid.zeros_cells()
    pushed[solid[:-1]] = 3.0 * grid.face_area(0)
    fluid.rhs += grid.to_vec(pushed)
    fluid.accept(solve(fluid), 0.0, dt)
    assert np.abs(whole_state(fluid)["velocity_x"] - 3.0).max() < 1e-11  # dead faces too: the band is 6 wide
    assert max_divergence(fluid) < 1e-11
    x = grid.coordinates(None)[0]
    wanted = np.broadcast_to(np.where(x > 0.3, 1000.0 * 3.0 / dt * (1.0 - x), 0.0), grid.shape(None))
    assert np.abs(fluid.pressure - wanted)[grid.owned(None)].max() < 1e-6


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("cells", [(26, 25), (13, 14, 24)])
def test_the_band_does_not_depend_on_the_ranks(cells):
    dim = len(cells)
    states = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        sides = {"left": "periodic", "right": "periodic"}
        fluid = make_fluid(cells, comm, sides=sides, smoke={})
        mask = solid_box(fluid, [0.2] * dim, [0.85] * dim)
        mask |= solid_box(fluid, [1.2] + [0.2] * (dim - 1), [1.85] + [0.85] * (dim - 1))
        mask |= solid_box(fluid, [-0.8] + [0.2] * (dim - 1), [-0.15] + [0.85] * (dim - 1))
        fluid.immerse(mask, None)
        set_velocity(
            fluid,
            [lambda x, y, z: np.cos(2 * np.pi * x) + y * z, lambda x, y, z: x + 2 * y, lambda x, y, z: x * z][:dim],
        )
        fluid.smoke[...] = 0.0
        fluid.smoke[fluid.cell_kind == kinds.FLUID] = 2.0
        for axis in range(dim):
            fluid.velocity_star[axis][...] = fluid.velocity[axis]
        fluid.accept(fluid.unknown(), 0.0, 0.1)
        states.append(whole_state(fluid) | {"smoke": whole(fluid.comm, fluid.grid.slab(fluid.smoke, None))})
        for axis in range(dim):
            v, ghosts = fluid.velocity[axis], fluid.velocity[axis].copy()
            fluid.grid.exchange_faces(axis, ghosts)
            assert np.array_equal(v, ghosts)
    for name, array in states[0].items():
        assert np.array_equal(array, states[1][name]), name
    solid = states[0]["cell_kind"] == kinds.SOLID
    assert set(np.unique(states[0]["smoke"][solid])) <= {0.0, 2.0}
    depth = np.minimum.reduce(
        [np.minimum(i - 0.2 * n, 0.85 * n - i) for i, n in zip(np.indices(cells), cells, strict=True)]
    )
    assert np.all(states[0]["smoke"][solid & (depth < 5)] == 2.0)


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("door", [False, True])
def test_closed_regions_are_found_across_ranks(door):
    wall = {"shape": {"box": {"origin": [0.47, 0.0], "size": [0.06, 0.7 if door else 1.0]}}}
    fluid = make_fluid((30, 24), sides={"bottom": "periodic", "top": "periodic"}, obstacles={"wall": wall})
    # a sheet with fluid within: a third room
    x, y, _ = fluid.grid.coordinates(0)
    room = lambda t: (t > 0.2) & (t < 0.4)  # noqa: E731
    crossed = [(np.isclose(x, 0.2) | np.isclose(x, 0.4)) & room(y)]
    x, y, _ = fluid.grid.coordinates(1)
    crossed.append(room(x) & (np.isclose(y, 0.25) | np.isclose(y, 0.375)))
    crossed[0] &= (fluid.grid.coordinates(0)[1] > 0.25) & (fluid.grid.coordinates(0)[1] < 0.375)
    fluid.immerse(None, crossed)
    touched = fluid.grid.zeros_cells(bool)
    touched[:, :] = (fluid.grid.coordinates(None)[0] < 0.1)[:, :, :]
    regions = fluid.closed_regions(fluid.grid.to_vec(touched))
    names = np.zeros((30, 24))
    for number, (vec, _) in enumerate(regions):
        array = fluid.grid.zeros_cells()
        fluid.grid.from_vec(vec, array)
        names += (number + 1) * whole(fluid.comm, fluid.grid.slab(array, None))
    xc, yc = np.meshgrid((np.arange(30) + 0.5) / 30, (np.arange(24) + 0.5) / 24, indexing="ij")
    wanted = np.where(xc < 0.47, 1.0, 2.0 if not door else 1.0)
    if not door:
        wanted = np.where(xc < 0.5, 1.0, 3.0)
    third = room(xc) & (yc > 0.25) & (yc < 0.375)
    wanted[third] = 2.0
    wanted[(np.abs(xc - 0.5) < 0.03) & ((yc < 0.7) | (not door))] = 0.0
    assert np.array_equal(names, wanted)
    assert [touch for _, touch in regions] == ([True, False] if door else [True, False, False])
    assert [touch for _, touch in fluid.closed_regions(None)] == [False] * len(regions)


@pytest.mark.parallel([1, 3])
def test_a_region_with_an_open_face_is_not_closed_and_sealed_cells_are_not_solved():
    wall = {"shape": {"box": {"origin": [-1.0, 0.47], "size": [3.0, 0.06]}}}
    pocket = {"shape": {"box": {"origin": [0.4, 0.1], "size": [0.2, 0.2]}}}
    fluid = make_fluid((20, 24), sides={"top": "open"}, obstacles={"wall": wall, "pocket": pocket})
    ((vec, touched),) = fluid.closed_regions(None)
    assert not touched
    y = np.broadcast_to(fluid.grid.coordinates(None)[1], fluid.grid.shape(None))
    assert np.array_equal(vec > 0, fluid.grid.to_vec((y < 0.47) & (fluid.cell_kind == kinds.FLUID)))
    covered = make_fluid((20, 24))
    covered.immerse(solid_box(covered, [-1, -1], [2, 2]), None)
    assert covered.closed_regions(None) == []


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("outside", [False, True])
def test_a_mesh_obstacle_is_the_box_that_it_bounds(outside, tmp_path_factory):
    meshio = pytest.importorskip("meshio")
    comm = MPI.COMM_WORLD
    path = comm.bcast(str(tmp_path_factory.mktemp("mesh") / "box.stl") if comm.rank == 0 else None)
    low, high = np.array([0.2, 0.31, 0.1]), np.array([0.72, 0.61, 0.8])
    if comm.rank == 0:
        points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * (high - low) + low
        quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
        facets = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
        meshio.write(path, meshio.Mesh(points.astype(np.float32), [("triangle", facets)]))
    box = {"origin": low.tolist(), "size": (high - low).tolist()}
    fluids = [
        make_fluid((14, 15, 18), obstacles={"thing": {"shape": shape, "outside": outside}})
        for shape in ({"mesh": path}, {"box": box})
    ]
    assert np.array_equal(fluids[0].cell_kind, fluids[1].cell_kind)
    assert (fluids[0].cell_kind == kinds.OBSTACLE).any() or fluids[0].comm.size > 1
