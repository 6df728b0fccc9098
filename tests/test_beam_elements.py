"""Beam elements against exact solutions, published numbers and their own energy."""

import numpy as np
import pytest
from beam_cases import added, equilibrium, frequencies, respond, row, section
from solid_cases import pattern_at

from petfsi.fields.beam.hermite import Hermite, cubics
from petfsi.fields.beam.timoshenko import shapes
from petfsi.fields.solid.elements import State

THEORIES = ("timoshenko", "euler-bernoulli")
RNG = np.random.default_rng(11)


@pytest.fixture(params=THEORIES)
def theory(request):
    return request.param


def bent(theory, size=0.4, lumped=False, damping=(0.0, 0.0)):
    """Return a few elements of several lengths, and a large displacement."""
    elements, points = row(theory, 3, section(0.2, 7.0, 0.3, 1.7, lumped, damping), 2.0, angle=0.6, seed=2)
    return elements, size * np.random.default_rng(5).standard_normal((len(points), 3))


# ---- energy, forces, tangent --------------------------------------------------------------------------------


def slow_energy(elements, d):
    """Return the energy as the docstrings state it, element by element; takes complex d."""
    total = 0.0
    for e, cell in enumerate(elements.cells):
        (EA, GA, EI), length, axis = elements.theory.stiffness[e], elements.length[e], elements.axis[e]
        turn = np.array([axis, [-axis[1], axis[0]]])
        u, w = turn @ d[cell, :2].T
        theta = d[cell, 2]
        if isinstance(elements.theory, Hermite):
            q = np.array([w[0], theta[0], w[1], theta[1]])
            xi, weights = np.polynomial.legendre.leggauss(6)
            slope = np.array([cubics(x, length)[1] @ q for x in xi])
            tiny = 1e-4
            curvature = np.array([(cubics(x + tiny, 1)[1] - cubics(x - tiny, 1)[1]) for x in xi])
            curvature = curvature / (2 * tiny) * 2 / length * [1, length, 1, length] / length @ q
            mean = (u[1] - u[0]) / length + weights @ slope**2 / 4
            total += EA * length * mean**2 / 2 + EI * length / 2 * (weights @ curvature**2) / 2
            continue
        for xi in (-(3**-0.5), 3**-0.5):
            N, dN = shapes(xi)
            du, dw, kappa, angle = 2 / length * dN @ u, 2 / length * dN @ w, 2 / length * dN @ theta, N @ theta
            eps = (1 + du) * np.cos(angle) + dw * np.sin(angle) - 1
            gamma = dw * np.cos(angle) - (1 + du) * np.sin(angle)
            total += length / 2 * (EA * eps**2 + GA * gamma**2 + EI * kappa**2) / 2
    return total


def test_forces_are_the_gradient_of_the_stated_energy(theory):
    elements, d = bent(theory)
    W, f, _ = respond(elements, d)
    assert pytest.approx(slow_energy(elements, d), rel=1e-9) == W
    steps = 1e-30j * np.eye(d.size).reshape(-1, *d.shape)
    gradient = np.array([slow_energy(elements, d + step).imag / 1e-30 for step in steps])
    np.testing.assert_allclose(f, gradient, rtol=1e-7, atol=1e-7 * np.abs(gradient).max())


def test_the_tangent_is_symmetric_and_that_of_the_forces(theory):
    elements, d = bent(theory)
    _, _, K = respond(elements, d)
    np.testing.assert_allclose(K, K.T, atol=1e-13 * np.abs(K).max())
    h = 1e-6
    for j, step in enumerate(h * np.eye(d.size).reshape(-1, *d.shape)):
        column = (respond(elements, d + step)[1] - respond(elements, d - step)[1]) / (2 * h)
        np.testing.assert_allclose(K[:, j], column, atol=1e-8 * np.abs(K).max())


def test_a_large_rigid_motion_costs_nothing():
    elements, points = row("timoshenko", 4, section(0.2, 7.0), 2.0, angle=0.6, seed=2)
    for angle in (0.3, 2.0, -7.5):
        c, s = np.cos(angle), np.sin(angle)
        d = np.column_stack((points @ np.array([[c, s], [-s, c]]) + [3.0, -1.0] - points, np.full(len(points), angle)))
        W, f, K = respond(elements, d)
        assert W < 1e-28
        assert np.abs(f).max() < 1e-13
        turn = np.column_stack((-(points + d[:, :2])[:, 1], (points + d[:, :2])[:, 0], np.ones(len(points))))
        assert np.abs(K @ turn.ravel()).max() < 1e-12 * np.abs(K).max()


def test_hermite_elements_turn_freely_up_to_the_fourth_power():
    elements, points = row("euler-bernoulli", 2, section(0.2, 7.0), 2.0)
    seen = []
    for angle in (0.2, 0.1):
        c, s = np.cos(angle), np.sin(angle)
        d = np.column_stack((points @ np.array([[c, s], [-s, c]]) - points, np.full(len(points), s)))
        seen.append(respond(elements, d)[0])
    assert seen[0] == pytest.approx(7.0 * 0.2 * 2.0 / 2 * (0.2**4 / 8) ** 2, rel=0.05)
    assert np.log2(seen[0] / seen[1]) == pytest.approx(8, abs=0.1)


# ---- what the field asks for --------------------------------------------------------------------------------


@pytest.mark.parametrize("lumped", [False, True])
def test_assembly_and_damping_are_those_of_the_sums(theory, lumped):
    elements, d = bent(theory, lumped=lumped, damping=(0.3, 0.02))
    V, s, w = RNG.standard_normal((3, *d.shape))
    M, (_, f, K) = added(elements, elements.mass, len(d)), respond(elements, d)
    C = 0.3 * M + 0.02 * K
    pattern = pattern_at(elements.cells, len(d), 3)
    values, b, alone = np.empty(len(pattern.indices)), np.empty_like(d), np.empty_like(d)
    at = State(d, V, s)
    elements.assemble(at, 5.0, 0.1, pattern, values, b)
    elements.forces(at, alone)
    A = np.zeros((d.size, d.size))
    A[np.repeat(np.arange(d.size), np.diff(pattern.indptr)), pattern.indices] = values
    np.testing.assert_allclose(A, 5.0 * M + 0.1 * K + C, atol=1e-13 * np.abs(A).max())
    np.testing.assert_allclose(b.ravel(), M @ V.ravel() - K @ s.ravel() - f, atol=1e-12)
    np.testing.assert_array_equal(b, alone)
    counted = np.ones(len(elements.cells), dtype=bool)
    w_ = w.ravel()
    elements.forces(State(d, V, 0 * s), alone)
    np.testing.assert_allclose(alone.ravel(), M @ V.ravel() - f, atol=1e-12)
    assert elements.damping(d, w, counted) == pytest.approx(w_ @ C @ w_, rel=1e-12)
    elements.forces(State(d, V - (5.0 + 0.3) * w, s + (0.1 + 0.02) * w), alone)
    np.testing.assert_allclose(alone.ravel(), b.ravel() - A @ w_, atol=1e-12 * np.abs(A).max())
    kinetic, elastic = elements.energies(d, w, counted)
    assert (kinetic, elastic) == pytest.approx((w_ @ M @ w_ / 2, respond(elements, d)[0]), rel=1e-12)


@pytest.mark.parametrize("lumped", [False, True])
def test_a_rigid_motion_has_its_exact_momentum_and_energy(theory, lumped):
    elements, points = row(theory, 3, section(0.2, 7.0, 0.3, 1.7, lumped), 2.0, angle=0.6, seed=2)
    mass = 1.7 * 0.2 * 2.0
    M = added(elements, elements.mass, len(points))
    loads = elements.uniform_load(len(points))
    for axis in range(2):
        unit = np.tile(np.eye(3)[axis], len(points))
        np.testing.assert_allclose(loads[axis].ravel(), M @ unit, atol=1e-14)
        assert unit @ M @ unit == pytest.approx(mass)
    lump = elements.lumped_mass(len(points))
    assert np.all(lump > 0)
    np.testing.assert_allclose(lump[:, :2].sum(axis=0), mass)
    if not lumped:
        turn = np.column_stack((-points[:, 1], points[:, 0], np.ones(len(points)))).ravel()
        assert turn @ M @ turn == pytest.approx(mass * 2.0**2 / 3 + mass * 0.2**2 / 12)


def test_interpolation_finds_what_nodes_say(theory):
    elements, points = row(theory, 2, section(0.05), 1.0, angle=0.6)
    slope = np.array([-np.sin(0.6), np.cos(0.6)])
    s = np.linalg.norm(points, axis=1)
    d = np.column_stack((np.outer(s**2, slope), 2 * s))  # a parabola across the axis
    for e, xi in ((0, -0.4), (1, 0.7), (1, 1.0)):
        x = 0.5 * e + 0.25 * (1 + xi)
        (at,) = elements.theory.interpolation(np.array([e]), np.array([xi]))
        value = at @ d[elements.cells[e]].ravel()
        np.testing.assert_allclose(value, [*(x**2 * slope), 2 * x], atol=1e-14)


# ---- statics ------------------------------------------------------------------------------------------------

#: A thickness and a modulus with EI = 1 and EA = 1.3e6 for a length of 1.
SLENDER = (0.003, 12 / 0.003**3)
CLAMPED = [0, 1, 2]

#: alpha = P L^2/EI: rotation, deflection and shortening of the tip over L, by elliptic integrals.
#: K. E. Bisshopp, D. C. Drucker, Large deflection of cantilever beams, Q. Appl. Math. 3 (1945).
ELASTICA = {
    1: (0.4613519497, 0.3017207738, 0.0564332363),
    2: (0.7817498316, 0.4934574804, 0.1606417208),
    5: (1.2153681176, 0.7137915236, 0.3876283607),
    10: (1.4302855388, 0.8106090249, 0.5549955978),
}


def tip_loaded(elements, n, alphas):
    d, load = np.zeros((n, 3)), np.zeros((n, 3))
    for alpha in alphas:
        load[-1, 1] = alpha
        d, _ = equilibrium(elements, d, load, CLAMPED)
        yield d


def test_a_tip_load_bends_a_cantilever_into_the_elastica():
    elements, points = row("timoshenko", 8, section(*SLENDER))
    for d, exact in zip(tip_loaded(elements, len(points), ELASTICA), ELASTICA.values(), strict=True):
        u, w, theta = d[-1]
        np.testing.assert_allclose((theta, w, -u), exact, rtol=2e-4)


def test_the_elastica_is_met_with_fourth_order():
    errors = []
    for n in (2, 4, 8):
        elements, points = row("timoshenko", n, section(0.01, 12 / 0.01**3))
        fine, many = row("timoshenko", 64, section(0.01, 12 / 0.01**3))
        *_, d = tip_loaded(elements, len(points), (1, 2))
        *_, exact = tip_loaded(fine, len(many), (1, 2))
        errors.append(np.linalg.norm(d[-1] - exact[-1]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(4, abs=0.3), orders


def test_an_end_moment_rolls_a_beam_up_and_newton_converges_quadratically(capsys):
    elements, points = row("timoshenko", 10, section(*SLENDER))
    d, load = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    for turns in np.linspace(0.1, 1.0, 10):
        load[-1, 2] = 2 * np.pi * turns
        d, norms = equilibrium(elements, d, load, CLAMPED, 1e-7)
        phi = 2 * np.pi * turns
        exact = np.sin(phi) / phi, (1 - np.cos(phi)) / phi
        np.testing.assert_allclose((points + d[:, :2])[-1], exact, atol=1e-4)
    assert np.linalg.norm((points + d[:, :2])[-1] - points[0]) < 1e-3
    with capsys.disabled():
        print("\nresiduals of the last load:", " ".join(f"{norm:.1e}" for norm in norms))


def test_newton_converges_quadratically():
    elements, points = row("timoshenko", 8, section(0.1, 12 / 0.1**3))
    load = np.zeros((len(points), 3))
    load[-1] = 0.3, 1.0, -0.5
    exact, _ = equilibrium(elements, np.zeros((len(points), 3)), load, CLAMPED, 1e-11)
    errors, free = [], np.arange(3, load.size)
    d = np.zeros_like(load)
    for _ in range(9):
        _, f, K = respond(elements, d)
        d.reshape(-1)[free] += np.linalg.solve(K[np.ix_(free, free)], (load.ravel() - f)[free])
        errors.append(np.linalg.norm(d - exact))
    small = [(a, b) for a, b in zip(errors, errors[1:], strict=False) if 1e-6 < a < 0.05]
    assert len(small) >= 2, errors
    assert all(b < 200 * a**2 for a, b in small), errors


@pytest.mark.parametrize("slender", [10, 1000, 10000])
def test_thin_beams_do_not_lock(theory, slender):
    elements, points = row(theory, 4, section(1 / slender, 12.0 * slender**3))
    load = np.zeros((len(points), 3))
    load[-1, 1] = 1e-3
    shear = 1 / elements.sections.stiffness[0, 1] if theory == "timoshenko" else 0.0
    _, _, K = respond(elements, 0 * load)
    d = np.linalg.solve(K[3:, 3:], load.ravel()[3:])
    assert d[-2] == pytest.approx(1e-3 * (1 / 3 + shear), rel=1e-6)
    assert d[-1] == pytest.approx(1e-3 / 2, rel=1e-6)


def test_hermite_nodes_are_exact_under_an_even_load():
    elements, points = row("euler-bernoulli", 3, section(0.01, 12e6), seed=4)
    load = elements.uniform_load(len(points))[1] / 0.01  # density 1: one newton per metre
    _, _, K = respond(elements, 0 * load)
    d = np.concatenate((np.zeros(3), np.linalg.solve(K[3:, 3:], load.ravel()[3:]))).reshape(-1, 3)
    s = points[:, 0]
    np.testing.assert_allclose(d[:, 1], s**2 * (s**2 - 4 * s + 6) / 24, atol=1e-9)
    np.testing.assert_allclose(d[:, 2], s * (s**2 - 3 * s + 3) / 6, atol=1e-9)


# ---- frequencies --------------------------------------------------------------------------------------------

#: (beta_n L)^2: W. Weaver, S. P. Timoshenko, D. H. Young, Vibration Problems in Engineering (1990), section 5.11.
BENDING = {
    "cantilever": np.array([1.8751040687, 4.6940911330, 7.8547574382, 10.9955407349]) ** 2,
    "clamped": np.array([4.7300407449, 7.8532046241, 10.9956078380, 14.1371654913]) ** 2,
    "pinned": (np.pi * np.arange(1, 5)) ** 2,
}
#: omega_n sqrt(rho A L^4/EI) of a Timoshenko cantilever with shear coefficient 5/6, from the roots of its 4 x 4
#: transfer matrix: (L/h, nu) to n = 1 ... 4.
SHEARED = {
    (5, 0.3): (3.409783, 18.363703, 43.709082, 72.567009),
    (5, 0.0): (3.427651, 18.876836, 45.722078, 76.982446),
    (10, 0.3): (3.488355, 20.906915, 54.988380, 99.747158),
    (10, 0.0): (3.493141, 21.091624, 55.998401, 102.633091),
    (20, 0.3): (3.509027, 21.734580, 59.760253, 114.194476),
    (20, 0.0): (3.510245, 21.786112, 60.084966, 115.282455),
    (50, 0.3): (3.514894, 21.985617, 61.372705, 119.735588),
    (50, 0.0): (3.515090, 21.994135, 61.429026, 119.936830),
}


def supported(ends, n):
    last = 3 * (n - 1)
    return {"cantilever": [0, 1, 2], "clamped": [0, 1, 2, last, last + 1, last + 2], "pinned": [0, 1, last, last + 1]}[
        ends
    ]


@pytest.mark.parametrize("ends", BENDING)
def test_slender_beams_have_the_frequencies_of_bending(theory, ends):
    elements, points = row(theory, 16, section(1e-3, 12e9, 0.3, 1e3))
    seen = frequencies(elements, np.zeros((len(points), 3)), supported(ends, len(points)), 4)
    np.testing.assert_allclose(seen, BENDING[ends], rtol=5e-3)
    np.testing.assert_allclose(seen[:2], BENDING[ends][:2], rtol=2e-4)


@pytest.mark.parametrize("slender, nu", SHEARED)
def test_thick_cantilevers_have_timoshenkos_frequencies(slender, nu):
    elements, points = row("timoshenko", 16, section(1 / slender, 12.0 * slender**2, nu))
    # the modulus makes EI/(rho A L^4) = 1; axial modes are not in the table
    held = np.union1d(CLAMPED, np.arange(0, 3 * len(points), 3))
    seen = frequencies(elements, np.zeros((len(points), 3)), held, 4)
    np.testing.assert_allclose(seen, SHEARED[slender, nu], rtol=5e-4)


def test_pinned_thick_beams_have_timoshenkos_frequencies():
    elements, points = row("timoshenko", 16, section(0.1, 12e2, 0.3))
    _, GA, EI = elements.sections.stiffness[0]
    rho_A, rho_I = elements.sections.rho_A[0], elements.sections.rho_I[0]
    held = np.union1d(supported("pinned", len(points)), np.arange(0, 3 * len(points), 3))
    seen = frequencies(elements, np.zeros((len(points), 3)), held, 3)
    for n, omega in enumerate(seen, 1):
        k = n * np.pi
        middle = rho_A * GA + k**2 * (rho_I * GA + rho_A * EI)
        exact = np.sqrt((middle - np.sqrt(middle**2 - 4 * rho_I * rho_A * GA * EI * k**4)) / (2 * rho_I * rho_A))
        assert omega == pytest.approx(exact, rel=5e-4)


@pytest.mark.parametrize("pull", [20.0, 200.0, -5.0])
def test_tension_stiffens_a_pinned_beam(theory, pull):
    """omega_n = (n pi/L)^2 sqrt(EI/rho A) sqrt(1 + N L^2/(EI n^2 pi^2)); here EI = rho A = L = 1."""
    elements, points = row(theory, 12, section(1e-3, 12e9, 0.3, 1e3))
    n = len(points)
    load = np.zeros((n, 3))
    load[-1, 0] = pull
    d, _ = equilibrium(elements, 0 * load, load, [0, 1, 3 * n - 2], 1e-6)
    held = np.union1d(supported("pinned", n), np.arange(0, 3 * n, 3))
    seen = frequencies(elements, d, held, 3)
    k = np.pi * np.arange(1, 4)
    np.testing.assert_allclose(seen, k**2 * np.sqrt(1 + pull / k**2), rtol=5e-3)


def test_a_bar_has_its_axial_frequencies(theory):
    elements, points = row(theory, 16, section(0.1, 4.0, 0.3, 1.0))
    held = np.setdiff1d(np.arange(3 * len(points)), np.arange(3, 3 * len(points), 3))
    seen = frequencies(elements, np.zeros((len(points), 3)), held, 2)
    np.testing.assert_allclose(seen, np.array([1, 3]) * np.pi / 2 * 2.0, rtol=5e-3)
