"""Semi-Lagrangian advection: exact where it must be, its order elsewhere, the same on any number of ranks."""

from dataclasses import replace

import numpy as np
import pytest
from mac_cases import PERIODIC, crossings, make_fluid, set_velocity, whole, whole_state
from mpi4py import MPI

from petfsi.fields.mac.carrying import advect, advection
from petfsi.fields.mac.grid.marks import faces_below


def smoke_fluid(cells, smoke, comm=MPI.COMM_WORLD, **scene):
    return make_fluid(cells, comm, smoke={"initial": smoke}, **scene)


def smoke(fluid):
    return whole(fluid.comm, fluid.state()["smoke"])


def centres(fluid):
    index = np.indices(fluid.grid.cells[: fluid.dim])
    return [o + (i + 0.5) * h for o, i, h in zip(fluid.grid.origin, index, fluid.grid.dx, strict=True)]


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_linear_scalar_in_a_rotation_moves_as_the_midpoint_rule_says(dim):
    cells = (40, 40, 20)[:dim]
    fluid = smoke_fluid(cells, "x - 0.5" + (" + z" if dim == 3 else ""))
    set_velocity(
        fluid,
        [lambda x, y, z: 0.5 - y + 0 * x * z, lambda x, y, z: x - 0.5 + 0 * y * z, lambda x, y, z: 0.1 + 0 * x * y * z][
            :dim
        ],
    )
    dt = 0.11
    fluid.predict(0.0, dt)
    x, y, *z = centres(fluid)
    # departure points z (1 - i dt - dt^2 / 2): the exact rotation up to dt^3 / 6
    wanted = (x - 0.5) * (1 - dt**2 / 2) + (y - 0.5) * dt
    inner = np.hypot(x - 0.5, y - 0.5) < 0.35
    if dim == 3:
        wanted = wanted + z[0] - 0.1 * dt
        inner &= (z[0] > 0.1) & (z[0] < 0.9)
    assert np.abs(smoke(fluid) - wanted)[inner].max() < 1e-12
    exact = (x - 0.5) * np.cos(dt) + (y - 0.5) * np.sin(dt)
    if dim == 2:
        assert np.abs(smoke(fluid) - exact)[inner].max() < dt**3 / 6


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("courant", [0.3, 1.7, 3.9])
def test_uniform_flow_damps_a_wave_by_the_factor_of_linear_interpolation(courant):
    n = 24
    fluid = smoke_fluid((n, n), "sin(2*pi*x)*cos(4*pi*y)", sides=PERIODIC, advection="linear")
    set_velocity(fluid, [lambda x, y, z: 1.0, lambda x, y, z: -0.5])
    dt, steps = courant / n, 5
    for number in range(steps):
        fluid.predict(number * dt, dt)

    def factor(velocity, k):
        cells = velocity * dt * n
        whole_cells = np.floor(cells)
        f = cells - whole_cells
        shift = np.exp(-1j * k * whole_cells / n)
        return ((1 - f) + f * np.exp(-1j * k / n)) * shift

    x, y = centres(fluid)
    a = np.exp(2j * np.pi * x) * factor(1.0, 2 * np.pi) ** steps
    b = np.exp(4j * np.pi * y) * factor(-0.5, 4 * np.pi) ** steps
    assert np.abs(smoke(fluid) - a.imag * b.real).max() < 1e-13


@pytest.mark.parametrize("interpolation, order, last", [("linear", 1.0, 0.03), ("cubic", 1.2, 1.5e-3)])
def test_a_blob_in_a_rotation_converges(interpolation, order, last):
    """Cubics are cut at the blob's peak, to stay within the values around, and that costs order there.

    How much depends on where the peak lies between points, so the order is that of two refinements together.
    """
    errors = []
    for n in (32, 64, 128):
        fluid = smoke_fluid((n, n), "exp(-((x-0.5)**2+(y-0.65)**2)/0.03)", advection=interpolation)
        set_velocity(fluid, [lambda x, y, z: 0.5 - y + 0 * x, lambda x, y, z: x - 0.5 + 0 * y])
        steps = n // 8
        for number in range(steps):
            fluid.predict(number / steps, 1.0 / steps)
        x, y = centres(fluid)
        c, s = np.cos(1.0), np.sin(1.0)
        exact = np.exp(-((x - 0.5 + 0.15 * s) ** 2 + (y - 0.5 - 0.15 * c) ** 2) / 0.03)
        errors.append(np.abs(smoke(fluid) - exact)[np.hypot(x - 0.5, y - 0.5) < 0.45].max())
    assert np.log2(errors[0] / errors[-1]) / 2 > order - 0.1, errors
    assert errors[-1] < last


@pytest.mark.parametrize("shape", [(20, 17, 1), (16, 14, 15)])
def test_cubic_interpolation_is_exact_for_cubics(shape):
    """Uniform flow carries a product of cubics by any distance up to three cells, and up to the array's ends."""
    flat = shape[2] == 1
    polynomials = [np.polynomial.Polynomial([1.0, 0.13, -0.8, 0.3], domain=[0, n]) for n in shape]
    if flat:
        polynomials[2] = np.polynomial.Polynomial([1.0])

    def product(shift):
        i = np.indices(shape, dtype=float)
        return np.prod([f(x - s) for f, x, s in zip(polynomials, i, shift, strict=True)], axis=0)

    shift = (2.7, -1.3, 0.0 if flat else 0.45)
    q = product((0.0, 0.0, 0.0))
    out = np.full(shape, np.nan)
    flow = [np.full(tuple(n + (a == b) for b, n in enumerate(shape)), s) for a, s in enumerate(shift)]
    part = ((3, shape[0]), (0, shape[1] - 2), (0, 1) if flat else (1, shape[2]))
    moved, left = np.ones(shape, dtype=bool), np.zeros(shape, dtype=bool)
    low, high = (0.0, 0.0, 0.0), tuple(map(float, shape))
    advect.sweep(
        q, out, moved, *flow, (0.5, 0.5, 0.5), part, (1.0, 1.0, 1.0), False, low, high, 0.5, True, False, np.inf, left
    )
    own = tuple(slice(*p) for p in part)
    np.testing.assert_allclose(out[own], product(shift)[own], atol=1e-13)
    steep = (np.indices(shape).sum(axis=0) > 15).astype(float)
    for bounded in (False, True):
        advect.sweep(
            steep, out, moved, *flow, (0.5, 0.5, 0.5), part, (1.0, 1.0, 1.0), False, low, high, 0.5, True, bounded,
            np.inf, left,
        )  # fmt: skip
        assert (out[own].max() > 1.01) != bounded and (out[own].min() < -0.01) != bounded


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("dim, courant", [(2, 4.0), (2, 9.0), (3, 9.0)])
def test_large_steps_across_ranks_equal_those_on_one(dim, courant):
    cells = (26, 24, 18)[:dim]
    sides = {"left": "periodic", "right": "periodic", "top": "open"}
    velocity = ["sin(2*pi*x)*cos(3*y)+0.5", "0.4*cos(2*pi*x)*sin(2*y)", "0.3*cos(4*x)*y"][:dim]
    states = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        fluid = smoke_fluid(
            cells,
            "exp(-10*((x-0.4)**2+(y-0.5)**2))",
            comm,
            sides=sides,
            initial={"velocity": velocity},
            obstacles={"post": {"shape": {"ball": {"centre": [0.7, 0.5, 0.4][:dim], "radius": 0.2}}}},
        )
        dt = courant / crossings(fluid)
        fluid.predict(0.0, dt)
        fluid.accept(fluid.unknown(), 0.0, dt)  # no pressure: the advected velocity itself
        fluid.predict(dt, 0.5 * dt)
        fluid.accept(fluid.unknown(), dt, 0.5 * dt)
        states.append(whole_state(fluid))
    for name, array in states[0].items():
        assert np.abs(array - states[1][name]).max() < 1e-13, name


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slab_of_one_flow_in_space_is_the_flow_in_the_plane(axis):
    """One plane flow, in 2D and in 3D along each axis: one set of kernels, so the same numbers."""
    plane = [a for a in range(3) if a != axis]
    text = ["sin(2*pi*{x})*cos(2*pi*{y})+0.3", "0.5*cos(2*pi*{x})*sin(2*pi*{y})"]
    names = dict(zip("xy", ("xyz"[a] for a in plane), strict=True))
    flat = make_fluid((16, 14), sides=PERIODIC, initial={"velocity": [t.format(x="x", y="y") for t in text]})
    cells, velocity = [8, 8, 8], ["0"] * 3
    for a, n, t in zip(plane, (16, 14), text, strict=True):
        cells[a], velocity[a] = n, t.format(**names)
    deep = make_fluid(cells, sides=PERIODIC | {"back": "periodic", "front": "periodic"}, initial={"velocity": velocity})
    for fluid in (flat, deep):
        fluid.predict(0.0, 0.2)
        fluid.accept(fluid.unknown(), 0.0, 0.2)
    for a, b in zip(plane, "xy", strict=True):
        solution = np.moveaxis(deep.state()[f"velocity_{'xyz'[a]}"].data, axis, 0)
        assert np.abs(solution - flat.state()[f"velocity_{b}"].data).max() < 1e-14


@pytest.mark.parallel([1, 3])
def test_smoke_keeps_its_bounds_past_obstacles_jets_and_open_sides():
    jet = {"speed": 2.0, "smoke": 0.9, "region": {"box": {"origin": [-0.1, 0.3], "size": [0.2, 0.4]}}}
    fluid = smoke_fluid(
        (30, 24),
        "0.2 + 0.5*(x>0.5)",
        sides={"left": {"inflow": jet}, "right": "open"},
        obstacles={"post": {"shape": {"ball": {"centre": [0.5, 0.5], "radius": 0.15}}}},
        initial={"velocity": ["2.0", "sin(7*x)"]},
    )
    for number in range(20):
        fluid.predict(number * 0.05, 0.05)
        values = whole(fluid.comm, fluid.output()["smoke"])
        liquid = whole(fluid.comm, fluid.output()["kind"]) == 0
        assert values[liquid].min() >= 0.2 and values[liquid].max() <= 0.9
    # after the jet has filled its channel it carries what comes in
    assert np.all(values[:8, 10:14] > 0.85)


@pytest.mark.parametrize("cubic, bounded", [(False, False), (True, False), (True, True)])
def test_departure_points_never_index_wildly(cubic, bounded):
    q = np.ones((12, 12, 1))
    nan = np.full((13, 13, 1), np.nan)
    out = np.zeros_like(q)
    moved, left = np.ones(q.shape, dtype=bool), np.zeros(q.shape, dtype=bool)
    part, low, high = ((0, 12), (0, 12), (0, 1)), (0.0, 0.0, 0.0), (12.0, 12.0, 1.0)
    for bad in (nan, np.full_like(nan, np.inf), np.full_like(nan, -1e300)):
        advect.sweep(
            q, out, moved, bad, bad, bad, (0.5, 0.5, 0.5), part, (1.0, 1.0, 0.0), False, low, high, 0.5, cubic, bounded,
            np.inf, left,
        )  # fmt: skip
        np.testing.assert_allclose(out, 1.0, rtol=1e-14)
    assert not advect.all_finite(nan) and advect.all_finite(q)
    assert not advect.all_finite(np.array([[[1.0, -np.inf]]]))


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("sheet", [False, True], ids=["open", "sheet"])
def test_what_is_too_fast_for_one_sweep_goes_as_if_all_went_in_several(dim, sheet, monkeypatch):
    """Carrying all in short sweeps is the judge: a jet's entries must not read what was left out on their way."""
    cells = (30, 24, 18)[:dim]
    jet = "exp(-((y-0.6)/0.12)**2)"
    wall = {"box": {"origin": [-1.0, 0.55, -1.0][:dim], "size": [1.5, 0.004, 3.0][:dim]}}

    def run():
        fluid = smoke_fluid(
            cells,
            "sin(7*x+3*y)",
            sides={"left": "periodic", "right": "periodic", "top": "open"},
            initial={"velocity": [f"0.2+{jet}", f"0.4*sin(2*pi*x)*{jet}", "0.3*cos(4*x)*y"][:dim]},
            obstacles={"wall": {"shape": wall}} if sheet else {},
        )
        dt = 8.0 / crossings(fluid)
        fluid.predict(0.0, dt)
        seen.append([m.copy() for m in left])
        left.clear()
        return [v[fluid.grid.owned(a)].copy() for a, v in enumerate(fluid.velocity_star)], fluid

    seen, left = [], []
    rest = advection.Advection._rest

    def watched(self, path, masks, axes, beyond):
        if axes != [None]:
            left.extend(m.copy() for m in masks)
        return rest(self, path, masks, axes, beyond)

    monkeypatch.setattr(advection.Advection, "_rest", watched)
    got, fluid = run()
    find = advection.find_path

    def no_whole(*args):
        path = find(*args)
        return replace(path, whole=replace(path.whole, limit=-1.0))

    monkeypatch.setattr(advection, "find_path", no_whole)
    wanted, _ = run()
    for a, (one, other) in enumerate(zip(got, wanted, strict=True)):
        fast = faces_below(seen[0][a], a)[fluid.grid.owned(a)]
        share = fluid.comm.allreduce(float(fast.sum())) / fluid.comm.allreduce(float(fast.size))
        assert 0.01 < share < 0.5
        assert np.abs(one - other)[fast].max(initial=0.0) < 1e-14


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("crossed", [3.0, 4.0, 6.0, 12.0, 24.0])
def test_a_blob_of_smoke_goes_whole_cells_however_many_in_a_step(crossed, interpolation):
    """Also where it leaves all that a sweep reads, and where the last digits of the speed say a bit more."""
    n = 36
    blob = "where((abs(x-0.2)<0.08)*(abs(y-0.5)<0.1),1,0)"
    for speed in (1.0, 1.0 + 5e-16, 1.0 - 5e-16):
        fluid = smoke_fluid((n, n), blob, sides=PERIODIC, advection=interpolation)
        set_velocity(fluid, [lambda x, y, z, s=speed: s, lambda x, y, z: 0.0])
        before = smoke(fluid)
        fluid.predict(0.0, crossed / n)
        sweeps = np.ceil(crossed / (4.0 if interpolation == "linear" else 3.0) - 1e-9)
        if crossed % sweeps == 0:
            assert np.abs(smoke(fluid) - np.roll(before, int(crossed), axis=0)).max() < 1e-12
        assert smoke(fluid).sum() == pytest.approx(before.sum(), rel=1e-12)
