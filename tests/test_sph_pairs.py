"""Kernels, cells, lists and passes of particles against sums over all pairs: 3 s, 30 s before anything is compiled."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from petfsi.fields.sph.cells import PairLists, cell_grid, fluid_pairs, sorted_rows, wall_pairs
from petfsi.fields.sph.kernels import ALPHA, Kernel
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.passes import NEAR, STOP, FluidRows, Met, Passes, WallRows

KERNELS = tuple(ALPHA)
GRAVITY = {2: (0.7, -9.81), 3: (0.7, 0.3, -9.81)}


# kernels


def radial_rule(kernel):
    """Gauss points over both pieces of the support, and weights that hold r^(dim - 1) and the solid angle."""
    t, weight = np.polynomial.legendre.leggauss(12)
    r = np.concatenate([kernel.s * (0.5 + t / 2), kernel.s * (1.5 + t / 2)])
    angle = 2 * np.pi if kernel.dim == 2 else 4 * np.pi
    return r, np.tile(kernel.s * weight / 2, 2) * angle * r ** (kernel.dim - 1)


def directions(dim):
    """Points on the unit circle or sphere, opposite ones paired, whose mean of n n^T is 1/dim."""
    if dim == 2:
        angle = 2 * np.pi * np.arange(8) / 8
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    return corners / np.sqrt(3)


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("dim", (2, 3))
def test_kernels_integrate_to_one_and_gradients_to_nothing(name, dim):
    kernel = Kernel(name, dim, 0.37)
    r, weight = radial_rule(kernel)
    W, F = kernel.values(r)
    assert np.sum(weight * W) == pytest.approx(1, abs=1e-12)
    n = directions(dim)
    gradient = np.einsum("k,k,k,da->a", weight, F, r, n) / len(n)
    np.testing.assert_allclose(gradient, 0, atol=1e-12)
    moment = -np.einsum("k,k,k,da,db->ab", weight, F, r**2, n, n) / len(n)
    np.testing.assert_allclose(moment, np.eye(dim), atol=1e-12)


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("dim", (2, 3))
def test_the_gradient_is_the_derivative(name, dim):
    kernel = Kernel(name, dim, 0.37)
    r, h = np.linspace(0.05, 0.9, 40) * kernel.support, 1e-5
    W, F = kernel.values(r)
    derivative = (kernel.values(r + h)[0] - kernel.values(r - h)[0]) / (2 * h)
    np.testing.assert_allclose(F * r, derivative, rtol=1e-8, atol=1e-8 * np.abs(F * r).max())
    assert np.all(W > 0) and np.all(F < 0)
    beyond = kernel.support * np.array([1, 1.001, 1.1, 3])
    assert np.all(np.array(kernel.values(beyond)) == 0)
    assert np.all(np.isfinite(kernel.values(np.zeros(1))))


SUMS = [
    ("wendland", 2, 1.3, 1.010, 0.974, 20),
    ("wendland", 2, 1.4, 1.007, 0.991, 20),
    ("wendland", 2, 1.5, 1.005, 0.997, 24),
    ("wendland", 2, 1.6, 1.004, 0.996, 36),
    ("wendland", 2, 2.0, 1.001, 0.999, 44),
    ("wendland", 3, 1.3, 1.010, 0.979, 80),
    ("wendland", 3, 1.5, 1.003, 1.0006, 92),
    ("wendland", 3, 2.0, 1.001, 0.999, 250),
    ("quadratic", 2, 1.3, 1.050, 1.021, None),
    ("quadratic", 2, 1.5, 1.034, 0.957, None),
    ("quadratic", 2, 2.0, 1.015, 0.985, None),
    ("cubic", 2, 1.2, 1.000, 0.991, None),
    ("cubic", 2, 1.5, 1.003, 1.007, None),
]


@pytest.mark.parametrize("name, dim, s, sum_W, moment, neighbours", SUMS)
def test_lattice_sums(name, dim, s, sum_W, moment, neighbours):
    kernel = Kernel(name, dim, s)
    x = np.array(list(itertools.product(range(-4, 5), repeat=dim)), dtype=float)
    r = np.linalg.norm(x, axis=1)
    W, F = kernel.values(r)
    assert np.sum(W) == pytest.approx(sum_W, abs=6e-4)
    assert -np.sum(F * x[:, 0] ** 2) == pytest.approx(moment, abs=6e-5 if moment == 1.0006 else 6e-4)
    if neighbours is not None:
        assert np.sum((r > 0) & (r < kernel.support)) == neighbours


# particles: a box of random fluid beside a plane of random walls, in cells


class Rows:
    """Random fluid and wall rows in a box of ``size`` smoothing lengths, sorted, and cut to the cells of one rank."""

    def __init__(self, dim, n=300, n_wall=80, size=12.0, seed=0, **law):
        rng = np.random.default_rng(seed)
        self.law = Law(dim, 1000.0, 20.0, 1.0, 0.7, gravity=GRAVITY[dim], **law)
        self.reach = 2.1
        size = size if dim == 2 else 0.6 * size
        self.grid = cell_grid(np.zeros(dim), np.full(dim, size), self.reach, np.zeros(dim, dtype=bool))
        self.x, self.v = rng.uniform(0, size, (n, dim)), rng.standard_normal((n, dim))
        self.rho, self.m = 1000 + 20 * rng.standard_normal(n), rng.uniform(300, 400, n)
        self.id = rng.permutation(n)
        self.p = 1000 * rng.standard_normal(n)
        normal = rng.standard_normal((n_wall, dim))
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        a, v = rng.standard_normal((2, n_wall, dim))
        x = rng.uniform(0, size, (n_wall, dim))
        volume, depth = rng.uniform(0.2, 0.4, n_wall), rng.uniform(0, 1, n_wall)
        self.walls = WallRows(x, v, a, volume, normal, depth, rng.uniform(size=n_wall) < 0.6)
        self.id_wall = n + rng.permutation(n_wall)
        self.p_wall, self.rho_wall = 1000 * rng.standard_normal(n_wall), 1000 + 20 * rng.standard_normal(n_wall)

    def part(self, low=None, high=None):
        """Rows and lists of a rank that owns the cells from low to high, with a halo of one cell."""
        low = np.zeros(self.law.dim, dtype=int) if low is None else np.array(low)
        high = self.grid.counts if high is None else np.array(high)
        counts = high - low + 2

        def local(x, ids):
            cells = self.grid.of(x) - low + 1
            here = np.flatnonzero(np.all((cells >= 0) & (cells < counts), axis=1))
            order, first = sorted_rows(cells[here], counts, ids[here])
            order = here[order]
            owned = np.all((cells[order] >= 1) & (cells[order] < counts - 1), axis=1)
            return order, first, owned

        f, first, owned = local(self.x, self.id)
        d, first_wall, owned_wall = local(self.walls.x, self.id_wall)
        fluid = FluidRows(self.x[f], self.v[f], self.rho[f], self.m[f])
        walls = WallRows(*(part[d] for part in self.walls))
        pairs = fluid_pairs(fluid.x, owned, first, counts, self.reach)
        with_walls = wall_pairs(fluid.x, owned, first, walls.x, owned_wall, first_wall, counts, self.reach)
        return SimpleNamespace(
            fluid=fluid, walls=walls, pairs=pairs, wall_pairs=with_walls, p=self.p[f], p_wall=self.p_wall[d],
            rho_wall=self.rho_wall[d], owned=owned, owned_wall=owned_wall, id=self.id[f], id_wall=self.id_wall[d],
        )  # fmt: skip

    def everything(self, low=None, high=None):
        """All results of a rank's passes, by name."""
        rows, passes = self.part(low, high), Passes(self.law)
        met = Met(rows.walls, rows.wall_pairs, rows.p_wall, rows.rho_wall)
        rates = passes.density_rates(rows.fluid, rows.pairs, met)
        pressure = passes.wall_pressure(rows.fluid, rows.p, met)
        density = self.law.density(np.maximum(pressure, -0.5 * self.law.B))
        forces = passes.forces(rows.fluid, rows.p, rows.pairs, met)
        fluid = {"total": rates.total, "diffusive": rates.diffusive, "f": forces.f, "S": forces.S}
        fluid["dissipated"] = forces.dissipated
        return rows, fluid, {"pressure": pressure, "density": density, "f_wall": forces.f_walls[0]}


def listed(pairs):
    return np.repeat(np.arange(pairs.start.size - 1), np.diff(pairs.start)), pairs.other


@pytest.mark.parametrize("dim", (2, 3))
def test_rows_are_sorted_by_cell_then_id(dim):
    rng = np.random.default_rng(3)
    counts = np.array([5, 4, 6])[:dim]
    for n in (0, 1, 7, 2000, 30000):
        cells, ids = rng.integers(0, counts, (n, dim)), rng.permutation(n)
        number = np.ravel_multi_index(tuple(cells.T), counts)
        order, first = sorted_rows(cells, counts, ids)
        np.testing.assert_array_equal(order, np.lexsort((ids, number)))
        np.testing.assert_array_equal(first, np.searchsorted(number[order], np.arange(np.prod(counts) + 1)))
    with pytest.raises(ValueError, match="particle 7 is in cell"):
        sorted_rows(np.array([np.zeros(dim), counts]), counts, np.array([3, 7]))


def test_cells_of_a_grid():
    grid = cell_grid([0, -1.0], [2.0, 1.0], 0.3, [True, False])
    assert tuple(grid.counts) == (6, 7) and grid.side == pytest.approx([1 / 3, 0.3])
    np.testing.assert_array_equal(grid.of(np.array([[-0.1, -1.1], [0.4, 5.0]])), [[-1, -1], [1, 20]])
    assert cell_grid([0], [3 * 0.1], 0.1, [True]).counts[0] == 3
    with pytest.raises(ValueError, match="period along axis 1"):
        cell_grid([0, 0], [1, 0.2], 0.3, [True, True])
    with pytest.raises(ValueError, match="positive reach"):
        cell_grid([0, 0], [1, 0.0], 0.3, [False, False])


@pytest.mark.parametrize("dim", (2, 3))
def test_lists_hold_every_near_pair_once_in_order(dim):
    rows = Rows(dim)
    ranges = [None, rows.grid.counts // 2]
    for high in ranges:
        part = rows.part(high=high)
        n, near = len(part.owned), lambda a, b: np.linalg.norm(a[:, None] - b, axis=2) < rows.reach
        either = part.owned[:, None] | part.owned
        i, j = np.nonzero(np.triu(near(part.fluid.x, part.fluid.x) & either, k=1))
        found = listed(part.pairs)
        np.testing.assert_array_equal(found, (i, j))
        assert part.pairs.start.size == n + 1 and part.pairs.other.dtype == np.int32 and len(i) > n
        either = part.owned[:, None] | part.owned_wall
        np.testing.assert_array_equal(listed(part.wall_pairs), np.nonzero(near(part.fluid.x, part.walls.x) & either))


def test_memory_of_lists_is_used_again():
    rows, lists = Rows(2), PairLists()
    part = rows.part()
    cells = rows.grid.of(part.fluid.x)
    _, first = sorted_rows(cells + 1, rows.grid.counts + 2, part.id)
    for _ in range(3):
        pairs = lists.fluid(part.fluid.x, part.owned, first, rows.grid.counts + 2, rows.reach)
        np.testing.assert_array_equal(pairs.other, part.pairs.other)
    again = lists.fluid(part.fluid.x, part.owned, first, rows.grid.counts + 2, rows.reach)
    assert np.shares_memory(again.other, pairs.other)


# passes


def geometry(law, x, y):
    """r (n, m, dim), W and F (n, m) of all points x with all y."""
    r = x[:, None] - y
    W, F = law.kernel.values(np.linalg.norm(r, axis=2).ravel())
    return r, W.reshape(r.shape[:2]), F.reshape(r.shape[:2])


def reference(law, fluid, p, walls, p_wall, rho_wall):
    """The sums of all pairs as the equations have them, (n, n) arrays at a time."""
    x, v, rho, m = fluid
    V, g, dot = m / rho, np.array(law.gravity), lambda a, b: np.einsum("...a,...a", a, b)
    r, W, F = geometry(law, x, x)
    u = v[:, None] - v
    drho = rho - rho[:, None] + law.rho0 / law.c**2 * r @ g
    diffusive = -2 * law.delta * law.s * law.c * np.sum(V * F * drho, axis=1)
    mean = (rho[:, None] + rho) / 2
    Pi = -law.alpha * law.c * law.s * np.minimum(0, dot(u, r)) / (mean * (dot(r, r) + 0.01 * law.s**2))
    mm, load = m[:, None] * m, p / rho**2
    c = -4 * law.nu * mm * F / (2 * mean)
    f = (-(mm * (load[:, None] + load + Pi) * F)[..., None] * r - c[..., None] * u).sum(axis=1)
    lost = np.triu(mm * Pi * F * dot(u, r) + c * dot(u, u)).sum(axis=1)
    unit = law.kernel.at(law.spacing)
    S = np.sum((V * F * (1 + 0.2 * (W / unit) ** 4))[..., None] * r, axis=1)
    total = rho * np.sum(V * F * dot(u, r), axis=1) + diffusive
    # walls
    r, W, F = geometry(law, x, walls.x)
    u = v[:, None] - walls.v
    total += rho * np.sum(walls.volume * F * dot(u, r), axis=1)
    value = p[:, None] + rho[:, None] * dot(g - walls.a, -r)
    weight = W.sum(axis=0)
    pressure = np.where(weight > 0, (W * value).sum(axis=0) / np.where(weight > 0, weight, 1), 0)
    mm = m[:, None] * (rho_wall * walls.volume)
    before = dot(r, walls.normal) - walls.depth
    with np.errstate(divide="ignore"):
        beta = np.where(before > 0, np.minimum(1.5, walls.depth / before), 1.5)
    c = -4 * law.nu * mm * F / (rho[:, None] + rho_wall) * (1 + beta) * walls.no_slip
    distance = np.linalg.norm(r, axis=2) / (NEAR * law.spacing)
    least = np.where(distance < 1, STOP * law.c**2 / law.rho0 * (1 - distance), -np.inf)
    push = np.maximum(load[:, None] + p_wall / rho_wall**2, least)
    pair = -(mm * push * F)[..., None] * r - c[..., None] * u
    f, lost = f + pair.sum(axis=1), lost + np.sum(c * dot(u, u), axis=1)
    S += np.sum((walls.volume * F * (1 + 0.2 * (W / unit) ** 4))[..., None] * r, axis=1)
    fluid = {"total": total, "diffusive": diffusive, "f": f, "S": S, "dissipated": lost}
    density = law.rho0 * (1 + pressure / law.B) ** (1 / 7)
    return fluid, {"pressure": pressure, "density": density, "f_wall": -pair.sum(axis=0)}


TERMS = [{}, {"delta": 0.1}, {"alpha": 0.3}, {"nu": 0.05}, {"delta": 0.1, "alpha": 0.3, "nu": 0.05}]


CASES = [(dim, "wendland", terms) for dim in (2, 3) for terms in TERMS]
CASES += [(2, "quadratic", TERMS[-1]), (3, "cubic", TERMS[-1])]


@pytest.mark.parametrize("dim, kernel, terms", CASES, ids=str)
def test_passes_are_the_sums_of_all_pairs(dim, kernel, terms):
    case = Rows(dim, kernel_name=kernel, **terms)
    rows, *found = case.everything()
    wanted = reference(case.law, rows.fluid, rows.p, rows.walls, rows.p_wall, rows.rho_wall)
    for got, want in zip(found, wanted, strict=True):
        for name, value in want.items():
            np.testing.assert_allclose(
                got[name], value, rtol=0, atol=1e-12 * max(np.abs(value).max(), 1e-300), err_msg=name
            )
    assert np.any(found[0]["diffusive"]) == ("delta" in terms)
    assert np.any(found[0]["dissipated"]) == ("alpha" in terms or "nu" in terms)
    assert np.all(found[0]["dissipated"] >= 0)


@pytest.mark.parametrize("dim", (2, 3))
def test_what_is_seen_in_part_counts_in_part(dim):
    """Halves of everything are everything with half the volume, but for the wall's own density."""
    case = Rows(dim, delta=0.1)
    rows, passes = case.part(), Passes(case.law)
    half = rows.walls._replace(volume=rows.walls.volume / 2)
    seen = np.full(len(rows.wall_pairs.other), 0.5)
    found = []
    for walls, part in ((rows.walls, seen), (half, None)):
        met = Met(walls, rows.wall_pairs, rows.p_wall, rows.rho_wall, part)
        forces = passes.forces(rows.fluid, rows.p, rows.pairs, met)
        found.append((passes.density_rates(rows.fluid, rows.pairs, met).total, forces.f, forces.S, forces.f_walls[0]))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(one).max())


def test_walls_without_suction_answer_no_pressure_below_zero():
    case = Rows(2, suction=False)
    rows = case.part()
    met = Met(rows.walls, rows.wall_pairs, rows.p_wall, rows.rho_wall)
    without = Passes(case.law).wall_pressure(rows.fluid, rows.p, met)
    with_suction = Passes(replace(case.law, suction=True))
    assert rows.p.min() < 0 and not np.array_equal(with_suction.wall_pressure(rows.fluid, rows.p, met), without)
    np.testing.assert_array_equal(with_suction.wall_pressure(rows.fluid, np.maximum(rows.p, 0), met), without)


@pytest.mark.parametrize("dim", (2, 3))
def test_forces_are_opposite(dim):
    case = Rows(dim, alpha=0.3, nu=0.05)
    _, fluid, walls = case.everything()
    defect = fluid["f"].sum(axis=0) + walls["f_wall"].sum(axis=0)
    scale = np.abs(fluid["f"]).sum() + np.abs(walls["f_wall"]).sum()
    assert np.abs(defect).max() < 1e-15 * scale


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("cuts", [(2, 1), (3, 1), (2, 2)], ids=str)
def test_rows_of_ghosts_in_between_change_no_bit(dim, cuts):
    case = Rows(dim, n=600, delta=0.1, alpha=0.3, nu=0.05, seed=4)
    rows, *whole = case.everything()
    place = [np.argsort(rows.id), np.argsort(rows.id_wall)]
    bounds = [np.linspace(0, case.grid.counts[a], cuts[a] + 1).astype(int) for a in range(2)]
    seen = 0
    for a, b in itertools.product(range(cuts[0]), range(cuts[1])):
        low, high = np.zeros(dim, dtype=int), case.grid.counts.copy()
        low[:2], high[:2] = (bounds[0][a], bounds[1][b]), (bounds[0][a + 1], bounds[1][b + 1])
        part, *cut = case.everything(low, high)
        ids = [part.id[part.owned], part.id_wall[part.owned_wall] - len(rows.id)]
        for got, want, k, own, where in zip(cut, whole, ids, (part.owned, part.owned_wall), place, strict=True):
            for name in want:
                np.testing.assert_array_equal(got[name][own], want[name][where[k]], err_msg=name)
        seen += len(ids[0])
        assert len(part.id) > len(ids[0])
    assert seen == len(rows.id)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("n, n_wall", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_no_rows_and_one_row(dim, n, n_wall):
    _, fluid, walls = Rows(dim, n=n, n_wall=n_wall, alpha=0.3, nu=0.05, delta=0.1).everything()
    assert fluid["f"].shape == fluid["S"].shape == (n, dim) and fluid["total"].shape == (n,)
    assert walls["f_wall"].shape == (n_wall, dim) and walls["pressure"].shape == (n_wall,)
    assert all(np.all(np.isfinite(value)) for value in (*fluid.values(), *walls.values()))


def test_two_particles_in_one_place_do_not_push():
    for kernel in KERNELS:
        law = Law(2, 1000.0, 20.0, 1.0, 0.7, kernel, (0.0, -9.81), alpha=0.3, delta=0.1)
        fluid = FluidRows(np.ones((2, 2)), np.array([[1.0, 0], [0, 1]]), np.full(2, 1001.0), np.ones(2))
        pairs = fluid_pairs(fluid.x, np.ones(2, dtype=bool), np.array([0, 2]), np.array([1, 1]), 2.0)
        assert len(pairs.other) == 1
        forces = Passes(law).forces(fluid, law.pressure(fluid.rho), pairs)
        assert not np.any(forces.f) and not np.any(forces.S)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_hydrostatic_pressure_reaches_walls_exactly(dim):
    case = Rows(dim)
    case.rho[:], case.walls.a[:] = 998.0, 0.3
    pull = np.array(case.law.gravity) - 0.3
    case.p = 2e5 + 998.0 * case.x @ pull
    rows, _, walls = case.everything()
    seen = walls["pressure"] != 0
    assert seen.sum() > 0.9 * len(seen)
    np.testing.assert_allclose(walls["pressure"][seen], 2e5 + 998.0 * rows.walls.x[seen] @ pull, rtol=1e-12)


def test_the_equation_of_state_and_its_inverse():
    law = Law(2, 1000.0, 20.0, 1.0, 0.7, gravity=(0.0, -9.81))
    rho = np.linspace(900, 1100, 21)
    p = law.pressure(rho)
    np.testing.assert_allclose(p, law.B * ((rho / 1000) ** 7 - 1), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(law.density(p), rho, rtol=1e-14)
    np.testing.assert_allclose(law.pressure(np.array([1000 * (1 + 1e-9)])), [1000 * 400 * 1e-9], rtol=1e-6)
    # the work of compression: de = p/rho^2 d rho
    step = 1e-3
    slope = (law.elastic_energy(rho + step) - law.elastic_energy(rho - step)) / (2 * step)
    np.testing.assert_allclose(slope, p / rho**2, rtol=1e-6, atol=1e-9)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no kernel 'gauss'; there are wendland"):
        Kernel("gauss", 2, 1.0)
    with pytest.raises(ValueError, match="2 or 3 dimensions, not 1"):
        Kernel("cubic", 1, 1.0)
    with pytest.raises(ValueError, match="smoothing length is 0 m"):
        Kernel("cubic", 2, 0.0)
    with pytest.raises(ValueError, match="gravity has 2 components in 3 dimensions"):
        Law(3, 1000.0, 20.0, 1.0, 0.7, gravity=(0.0, 0.0))
