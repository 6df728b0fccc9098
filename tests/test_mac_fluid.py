"""The fluid's pressure system, its step, and its exact solutions."""

import numpy as np
import pytest
from mac_cases import (
    BOX,
    PERIODIC,
    crossings,
    kinetic_energy,
    make_fluid,
    max_divergence,
    reader,
    set_velocity,
    solid_box,
    solve,
    step,
    whole,
    whole_state,
)
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.errors import InputError
from petfsi.fields.mac.grid import kinds


def times(fluid, values):
    """Return L times a vector in PETSc's order."""
    x, y = fluid.block.createVecRight(), fluid.block.createVecLeft()
    x.array[:] = values
    fluid.block.mult(x, y)
    return y.array.copy()


def total(fluid, value):
    return fluid.comm.allreduce(float(value))


# ---- the pressure block -------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("cells", [(20, 24), (12, 13, 18)])
def test_the_block_is_symmetric_and_constants_feel_only_open_sides(cells):
    obstacle = {"ball": {"shape": {"ball": {"centre": [0.6, 0.4, 0.5][: len(cells)], "radius": 0.2}}}}
    sides = {"left": "periodic", "right": "periodic", "top": "open"}
    fluid = make_fluid(cells, sides=sides, obstacles=obstacle)
    fluid.immerse(solid_box(fluid, [0.1] * len(cells), [0.3] * len(cells)), None)
    dt = 0.01
    fluid.predict(0.0, dt)
    fluid.assemble(0.0, dt)
    rng = np.random.default_rng(fluid.comm.rank)
    x, y = rng.standard_normal((2, fluid.layout.n_local))
    forth, back = total(fluid, y @ times(fluid, x)), total(fluid, x @ times(fluid, y))
    assert forth == pytest.approx(back, rel=1e-12)
    grid = fluid.grid
    c = dt / fluid.density * grid.cell_volume / grid.dx**2
    rows = grid.zeros_cells()
    grid.from_vec(times(fluid, np.ones(fluid.layout.n_local)), rows)
    top = np.zeros(grid.shape(None), dtype=bool)
    top[:, (np.arange(top.shape[1]) + grid.lo[1] - grid.ghost[1]) == grid.cells[1] - 1] = True
    wanted = np.where(fluid.cell_kind == kinds.FLUID, np.where(top, 2 * c[1], 0.0), 0.05 * 2 * c.sum())
    own = grid.owned(None)
    assert np.abs(rows[own] - wanted[own]).max() < 1e-14 * c.max() * 100


@pytest.mark.parallel([1, 3])
def test_the_pattern_never_changes():
    fluid = make_fluid((20, 24), sides={"top": "open"})
    counts = []
    for mask in (None, solid_box(fluid, [0.1, 0.1], [0.9, 0.8]), None):
        fluid.immerse(mask, None)
        fluid.predict(0.0, 0.1)
        fluid.assemble(0.0, 0.1)
        counts.append((fluid.n_assembled, fluid.block.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]))
        fluid.assemble(0.1, 0.1)
    assert counts == [(n, 5 * 20 * 24 - 2 * (20 + 24)) for n in (1, 2, 3)]
    fluid.assemble(0.2, 0.05)
    assert fluid.n_assembled == 4


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim, sizes", [(2, (18, 36, 72)), (3, (9, 18))])
def test_poisson_between_walls_and_an_open_side_is_second_order(dim, sizes):
    errors = []
    for n in sizes:
        size = [1.0, 2.0, 1.5][:dim]
        fluid = make_fluid((n, n, 2 * n)[:dim], size=size, sides={"top": "open"})
        fluid.assemble(0.0, 0.1)
        x, y, z = fluid.grid.coordinates(None)
        exact = np.cos(np.pi * x) * np.cos(np.pi * y / 4) * np.cos(np.pi * z / 1.5)
        k2 = np.pi**2 * (1 + 1 / 16 + (1 / 1.5**2 if dim == 3 else 0))
        fluid.rhs[:] = 0.1 / fluid.density * k2 * fluid.grid.cell_volume * fluid.grid.to_vec(exact)
        error = np.abs(solve(fluid) - fluid.grid.to_vec(exact)).max()
        errors.append(fluid.comm.allreduce(error, op=MPI.MAX))
    order = np.diff(-np.log2(errors))
    assert order[-1] == pytest.approx(2.0, abs=0.1), errors


def test_scales_turn_the_block_into_numbers_near_one():
    for cells, rho, dt in (((16, 16), 1000.0, 1e-3), ((8, 8, 8), 1.2, 0.1)):
        fluid = make_fluid(cells, density=rho)
        fluid.assemble(0.0, dt)
        scaled = fluid.block.getDiagonal().array * fluid.row_scale * fluid.col_scale
        assert scaled.max() == pytest.approx(2 * len(cells))


# ---- the step -----------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("cells", [(24, 20), (12, 12, 18)])
def test_the_projection_leaves_no_divergence(cells):
    jet = {
        "speed": "1+0.5*sin(5*y)",
        "region": {"box": {"origin": [-0.1] * len(cells), "size": [0.2, 0.5, 0.6][: len(cells)]}},
    }
    fluid = make_fluid(
        cells,
        sides={"left": {"inflow": jet}, "top": "open"},
        obstacles={"ball": {"shape": {"ball": {"centre": [0.6, 0.4, 0.5][: len(cells)], "radius": 0.2}}}},
        initial={"velocity": ["cos(9*y)", "sin(7*x)", "x*y"][: len(cells)]},
    )
    assert max_divergence(fluid) > 0.1
    for number in range(2):
        step(fluid, 0.02 * number, 0.02)
        assert max_divergence(fluid) < 1e-12
    assert fluid.is_finite()


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_column_under_gravity_stays_at_rest(dim):
    cells, size = (12, 24, 12)[:dim], [1.0, 2.0, 1.0][:dim]
    obstacle = {"ball": {"shape": {"ball": {"centre": [0.5, 0.7, 0.5][:dim], "radius": 0.3}}}}
    fluid = make_fluid(cells, gravity=[0.0, "-9.81", 0.0][:dim], size=size, sides={"top": "open"}, obstacles=obstacle)
    for number in range(5):
        step(fluid, 0.1 * number, 0.1)
    assert crossings(fluid) * fluid.grid.dx.min() < 1e-12
    y = fluid.grid.coordinates(None)[1]
    wanted = np.where(fluid.cell_kind == kinds.FLUID, 9810.0 * (2.0 - y), 0.0)
    own = fluid.grid.owned(None)
    assert np.abs(fluid.pressure - wanted)[own].max() < 1e-8
    assert fluid.probe("pressure", [0.2, 1.03, 0.3][:dim]) == pytest.approx(9810.0 * 0.97, rel=1e-11)


@pytest.mark.parallel([1, 3])
def test_a_taylor_green_vortex_decays_and_keeps_its_shape():
    n = 32
    velocity = ["sin(2*pi*x)*cos(2*pi*y)", "-cos(2*pi*x)*sin(2*pi*y)"]
    fluid = make_fluid((n, n), sides=PERIODIC, initial={"velocity": velocity})
    assert max_divergence(fluid) < 1e-12
    energy = [kinetic_energy(fluid)]
    assert energy[0] == pytest.approx(1000.0 * 0.25, rel=1e-12)
    first = [v.copy() for v in fluid.velocity]
    for number in range(10):
        step(fluid, 0.02 * number, 0.02)
        energy.append(kinetic_energy(fluid))
    assert np.all(np.diff(energy) < 0) and energy[-1] > 0.5 * energy[0]
    # an exact steady flow of the Euler equations: what advection loses is amplitude
    ratio = np.sqrt(energy[-1] / energy[0])
    own = fluid.grid.owned(0)
    assert np.abs(fluid.velocity[0] - ratio * first[0])[own].max() < 0.05


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("side, axis, sign", [("left", 0, 1), ("right", 0, -1), ("bottom", 1, 1), ("top", 1, -1)])
def test_what_a_jet_brings_in_leaves_through_the_rest(side, axis, sign):
    jet = {"speed": "2.0", "ramp": 0.2, "rest": "open", "region": {"ball": {"centre": [0.5, 0.5], "radius": 0.52}}}
    fluid = make_fluid((20, 20), sides={side: {"inflow": jet}})
    grid = fluid.grid
    for number, part in enumerate(
        [np.sin(np.pi / 8) ** 2, np.sin(np.pi / 4) ** 2, np.sin(3 * np.pi / 8) ** 2, 1.0, 1.0]
    ):
        step(fluid, 0.05 * number, 0.05)
        v, kind = fluid.velocity[axis][grid.owned(axis)], fluid.face_kind[axis][grid.owned(axis)]
        inflow = total(fluid, v[kind == kinds.WALL].sum())
        # the ball meets the side where |y - 1/2| < sqrt(0.52^2 - 0.5^2), 5.71 of 20 faces
        assert inflow == pytest.approx(sign * 40 * np.sqrt(0.52**2 - 0.25) * 2.0 * part, abs=1e-12)
        assert total(fluid, v[kind == kinds.OPEN].sum()) == pytest.approx(-inflow, abs=1e-11)


@pytest.mark.parallel([1, 3])
def test_smoke_rises_against_gravity():
    fluid = make_fluid((12, 18), gravity=[1.0, "-10*t"], smoke={"initial": "y", "buoyancy": 0.3})
    fluid.predict(0.0, 0.1)
    y = fluid.grid.coordinates(1)[1]
    face = fluid.face_kind[1] == kinds.PRESSURE
    # gravity at the new time, and the smoke at the face
    wanted = np.broadcast_to(0.1 * -1.0 * (1 - 0.3 * y), face.shape)
    own = fluid.grid.owned(1)
    assert np.abs(fluid.velocity_star[1] - wanted)[own][face[own]].max() < 1e-14


# ---- what others see ----------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_probes_interpolate_linearly_among_fluid_cells():
    fluid = make_fluid((20, 24), obstacles={"box": BOX}, smoke={"initial": "3*x-y"})
    x, y, _ = fluid.grid.coordinates(None)
    fluid.pressure[...] = np.where(fluid.cell_kind == kinds.FLUID, 2 * x + y, 1e9)
    set_velocity(fluid, [lambda x, y, z: x + 2 * y, lambda x, y, z: 3 * x - y])
    assert fluid.probe("pressure", [0.123, 0.777]) == pytest.approx(2 * 0.123 + 0.777, rel=1e-13)
    assert fluid.probe("smoke", [0.123, 0.777]) == pytest.approx(3 * 0.123 - 0.777, rel=1e-12)
    assert fluid.probe("velocity", [0.123, 0.777]) == pytest.approx([0.123 + 2 * 0.777, 3 * 0.123 - 0.777])
    assert fluid.probe("pressure", [0.34, 0.5]) == pytest.approx(2 * 0.325 + 0.5, rel=1e-12)
    assert np.isnan(fluid.probe("pressure", [0.5, 0.5])) and np.isnan(fluid.probe("velocity", [0.5, 0.5])).all()
    assert fluid.probe("pressure", [1.0, 1.0]) == pytest.approx(2 * (1 - 0.025) + 1 - 1 / 48, rel=1e-13)
    with pytest.raises(InputError, match=r"\[1.1, 0.5\]: must lie in the fluid's grid"):
        fluid.probe("pressure", [1.1, 0.5])
    with pytest.raises(InputError, match="probe of 'displacement'"):
        fluid.probe("displacement", [0.5, 0.5])


@pytest.mark.parallel([1, 3])
def test_output_is_centred_in_the_cells():
    fluid = make_fluid((20, 24), obstacles={"box": BOX}, smoke={"initial": "1"})
    set_velocity(fluid, [lambda x, y, z: x + 2 * y, lambda x, y, z: 3 * x - y])
    output = {name: whole(fluid.comm, slab) for name, slab in fluid.output().items()}
    assert {name: a.shape for name, a in output.items()} == {
        "velocity": (20, 24, 2),
        "pressure": (20, 24),
        "smoke": (20, 24),
        "kind": (20, 24),
    }
    x, y = np.meshgrid((np.arange(20) + 0.5) / 20, (np.arange(24) + 0.5) / 24, indexing="ij")
    liquid = output["kind"] == kinds.FLUID
    assert np.abs(output["velocity"] - np.stack([x + 2 * y, 3 * x - y], axis=-1))[liquid].max() < 1e-14
    assert np.all(output["velocity"][~liquid] == 0.0) and np.array_equal(output["smoke"], liquid)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint", "symplectic-euler"])
@pytest.mark.parametrize("cells", [(24, 20), (12, 12, 18)])
def test_a_restored_fluid_goes_on_as_the_first_one(cells, integrator):
    dim = len(cells)
    scene = {
        "integrator": integrator,
        "sides": {"left": {"inflow": {"speed": "1+t", "smoke": 1.0}}, "right": "open"},
        "gravity": [0.0, -1.0, 0.0][:dim],
        "smoke": {"buoyancy": 0.1},
        "initial": {"velocity": ["1"] + ["0.1*sin(6*x)"] * (dim - 1)},
    }
    fluid = make_fluid(cells, **scene)
    fluid.immerse(solid_box(fluid, [0.3] * dim, [0.6] * dim), None)
    for number in range(3):
        step(fluid, 0.05 * number, 0.05)
        if number == 1:
            fluid.immerse(solid_box(fluid, [0.3] * dim, [0.7] * dim), None)
    stored = whole_state(fluid)
    same, alone = make_fluid(cells, **scene), make_fluid(cells, MPI.COMM_SELF, **scene)
    for other in (same, alone):
        other.restore(reader(stored))
    for array, again in zip(
        (*fluid.velocity, fluid.pressure, fluid.smoke), (*same.velocity, same.pressure, same.smoke), strict=True
    ):
        assert np.array_equal(array, again)
    for each in (fluid, same, alone):
        each.predict(0.15, 0.06)
        each.assemble(0.15, 0.06)
    assert np.array_equal(fluid.rhs, same.rhs)
    for each in (fluid, same, alone):
        each.accept(solve(each), 0.15, 0.06)
        step(each, 0.21, 0.05)
    # the direct solver does not repeat itself bit for bit
    for name, array in whole_state(fluid).items():
        for other in (same, alone):
            assert np.abs(array - whole_state(other)[name]).max() < 1e-11 * np.abs(array).max(initial=1.0), name


# ---- mistakes -----------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 3])
def test_mistakes_are_told_on_every_rank():
    with pytest.raises(InputError, match='fluid.sides.left = "periodic": the opposite side, right'):
        make_fluid((20, 20), sides={"left": "periodic"})
    with pytest.raises(InputError, match=r"fluid.cells = \[2, 20\]: a periodic axis needs at least 3"):
        make_fluid((2, 20), sides={"left": "periodic", "right": "periodic"})
    with pytest.raises(InputError, match="fluid.initial.velocity"):
        make_fluid((20, 20), initial={"velocity": ["1/(x-0.05)", "0"]})
    fluid = make_fluid((20, 20), sides={"left": {"inflow": {"speed": "1/(t-0.1)"}}})
    with pytest.raises(InputError, match="fluid.sides.left.inflow.speed"):
        fluid.predict(0.0, 0.1)


@pytest.mark.parallel([1, 3])
def test_a_broken_state_is_noticed():
    fluid = make_fluid((20, 20), sides={"top": "open"})
    assert fluid.is_finite()
    x = fluid.unknown()
    x[0] = np.nan
    fluid.assemble(0.0, 0.1)
    fluid.accept(x, 0.0, 0.1)
    assert not fluid.is_finite()
    fluid.predict(0.1, 0.1)
