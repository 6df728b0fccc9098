"""Materials: stress is the derivative of energy, the tangent that of stress, and neither sees a rotation."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from petfsi.fields.solid.materials import lame_parameters, named, project, projected
from petfsi.registry import MATERIALS

NONLINEAR = sorted(set(MATERIALS) - {"linear"})
#: Materials that are finite and smooth for every F.
INVERTIBLE = ["green", "linear", "stable-neohookean"]
LAME, MU = lame_parameters(3.0, 0.3)
#: Stress under uniaxial stretch (E = 1, nu = 0.3): exact solutions, derived, in ten digits.
UNIAXIAL = np.genfromtxt(
    Path(__file__).parent / "data" / "uniaxial_hyperelastic_E1_nu0.3.csv", delimiter=",", names=True, skip_header=1
)


def respond(name, F, lame=LAME, mu=MU):
    """Return W, P and C of one gradient or of many."""
    F = np.asarray(F)
    n = F.shape[:-2]
    H = (F - np.eye(F.shape[-1])).reshape(-1, *F.shape[-2:])
    answer = named(name)(H, np.full(len(H), lame), np.full(len(H), mu))
    return tuple(a.reshape(n + a.shape[1:]) for a in answer)


def deformations(dim: int, n: int = 20) -> np.ndarray:
    return np.eye(dim) + 0.3 * np.random.default_rng(1).standard_normal((n, dim, dim))


def rotation(dim: int, seed: int = 2) -> np.ndarray:
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))[0]
    return q * np.sign(np.linalg.det(q)) if dim == 3 else q @ np.diag([1.0, np.linalg.det(q)])


def central_difference(f, F: np.ndarray) -> np.ndarray:
    """Return df/dF of one F, the axes of F last: central differences of the fourth order."""
    dim, step = len(F), 1e-3
    columns = []
    for change in step * np.eye(dim * dim).reshape(-1, dim, dim):
        near, far = f(F + change) - f(F - change), f(F + 2 * change) - f(F - 2 * change)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1).reshape(*np.shape(columns[0]), dim, dim)


def hooke(dim: int, lame: float = LAME, mu: float = MU) -> np.ndarray:
    I = np.eye(dim)  # noqa: E741
    return (
        lame * np.einsum("ij,kl->ijkl", I, I)
        + mu * np.einsum("ik,jl->ijkl", I, I)
        + mu * np.einsum("il,jk->ijkl", I, I)
    )


both_dimensions = pytest.mark.parametrize("dim", [2, 3])
every_material = pytest.mark.parametrize("name", sorted(MATERIALS))


@st.composite
def gradients(draw, inverted: bool = False) -> np.ndarray:
    """Draw F of either dimension: any at all, or one whose volume is positive and not next to nothing."""
    dim = draw(st.sampled_from([2, 3]))
    entries = st.floats(-2.0, 2.0) if inverted else st.floats(-0.7, 0.7)
    rows = draw(st.lists(entries, min_size=dim * dim, max_size=dim * dim))
    F = np.reshape(rows, (dim, dim)) + (0.0 if inverted else np.eye(dim))
    assume(inverted or np.linalg.det(F) > 0.3)
    return F


def check_derivatives(name: str, F: np.ndarray) -> None:
    _, P, C = respond(name, F)
    size = max(np.abs(C).max(), MU)  # a stable element shrunk to a point has no stiffness at all
    np.testing.assert_allclose(P, central_difference(lambda F: respond(name, F)[0], F), atol=1e-6 * size)
    np.testing.assert_allclose(C, central_difference(lambda F: respond(name, F)[1], F), atol=1e-6 * size)
    np.testing.assert_allclose(C, C.transpose(2, 3, 0, 1), atol=1e-13 * np.abs(C).max())


@every_material
@settings(max_examples=60, deadline=None)
@given(F=gradients())
def test_stress_and_symmetric_tangent_are_the_derivatives_of_energy(name, F):
    check_derivatives(name, F)


@pytest.mark.parametrize("name", INVERTIBLE)
@settings(max_examples=60, deadline=None)
@given(F=gradients(inverted=True))
@example(F=np.zeros((3, 3)))
@example(F=np.zeros((2, 2)))
@example(F=np.diag([1.0, -1.0]))
@example(F=-np.eye(3))
@example(F=np.diag([2.0, 0.0, 1.0]))
def test_so_they_are_of_inverted_and_flat_elements(name, F):
    check_derivatives(name, F)


@both_dimensions
@every_material
def test_without_a_tangent_energy_and_stress_are_the_same(name, dim):
    H = deformations(dim, 5) - np.eye(dim)
    lame, mu = np.full(5, LAME), np.full(5, MU)
    with_tangent, without = named(name)(H, lame, mu), named(name)(H, lame, mu, tangent=False)
    np.testing.assert_array_equal(without[0], with_tangent[0])
    np.testing.assert_array_equal(without[1], with_tangent[1])
    assert without[2].shape == (0, dim, dim, dim, dim)


@both_dimensions
@every_material
def test_a_material_is_linear_in_its_parameters(name, dim):
    F = deformations(dim)
    for whole, volume, shape in zip(
        respond(name, F), respond(name, F, mu=0.0), respond(name, F, lame=0.0), strict=True
    ):
        np.testing.assert_allclose(volume + shape, whole, atol=1e-13 * np.nanmax(np.abs(whole)))


@both_dimensions
@pytest.mark.parametrize("name", NONLINEAR)
def test_energy_sees_no_rotation_and_stress_turns_with_it(name, dim):
    F, R = deformations(dim), rotation(dim)
    W, P, _ = respond(name, F)
    turned_W, turned_P, _ = respond(name, R @ F)
    np.testing.assert_allclose(turned_W, W, rtol=1e-11)
    np.testing.assert_allclose(turned_P, R @ P, atol=1e-12 * np.abs(P).max())


@both_dimensions
@pytest.mark.parametrize("name", NONLINEAR)
def test_a_rotation_costs_nothing(name, dim):
    R = np.stack([rotation(dim, seed) for seed in range(50)])
    W, P, _ = respond(name, R)
    assert np.abs(W).max() < 1e-28
    assert np.abs(P).max() < 1e-14


@both_dimensions
@every_material
def test_at_rest_every_material_is_hookes(name, dim):
    W, P, C = respond(name, np.eye(dim))
    assert W == 0 and not P.any()
    np.testing.assert_allclose(C, hooke(dim), atol=1e-14)


@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-9, 1e-12])
@both_dimensions
@every_material
def test_tiny_strains_keep_their_digits(name, dim, size):
    """What is left of Hooke's energy and stress is the next order, whatever the strain: nothing drowns in F = I."""
    H = size * np.random.default_rng(4).standard_normal((20, dim, dim))
    W, P, _ = named(name)(H, np.full(20, LAME), np.full(20, MU))
    stress = np.einsum("ijkl,nkl->nij", hooke(dim), H)
    np.testing.assert_allclose(W, np.einsum("nij,nij->n", stress, H) / 2, rtol=40 * size + 1e-14)
    np.testing.assert_allclose(P, stress, atol=np.abs(stress).max() * (40 * size + 1e-14))


@pytest.mark.parametrize("material, state", [("green", "SVK"), ("neohookean", "NH")])
@pytest.mark.parametrize("dim, place", [(3, "uniaxial3D"), (2, "planestrain")])
@pytest.mark.parametrize("row", UNIAXIAL, ids=lambda row: f"{row['stretch']:g}")
def test_uniaxial_stress_is_the_exact_one(material, state, dim, place, row):
    """The width at which the sides bear no stress is found from the material's own stress."""
    lame, mu = lame_parameters(1.0, 0.3)
    stretch, wanted = row["stretch"], row[f"P_{state}_{place}"]

    def stress(width):
        return respond(material, np.diag([stretch, *[width] * (dim - 1)]), lame, mu)[1]

    if np.isnan(row[f"lambda_t_{state}"]) or (dim == 2 and state == "SVK" and stretch > 1.8):
        assert stress(1e-3)[1, 1] > 0  # so far stretched, no width frees St Venant-Kirchhoff's sides
        return
    width = brentq(lambda width: stress(width)[1, 1], 1e-3, 2.0, xtol=1e-15, rtol=1e-15)
    assert stress(width)[0, 0] == pytest.approx(wanted, abs=1e-8)


def test_a_neohookean_element_without_volume_is_no_number_and_no_warning():
    for F in (np.diag([1.0, -0.5]), np.zeros((2, 2)), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)):
        W, P, C = respond("neohookean", F)
        assert np.isinf(W) and np.isnan(P).all() and np.isnan(C).all()


def test_a_nearly_flat_neohookean_element_keeps_its_digits():
    thin = 2.0**-40
    W, P, _ = respond("neohookean", np.diag([1.0, thin]))
    log_J = np.log(thin)
    assert W == pytest.approx(MU / 2 * (thin**2 - 1) - MU * log_J + LAME / 2 * log_J**2, rel=1e-14)
    assert P[1, 1] == pytest.approx(MU * thin + (LAME * log_J - MU) / thin, rel=1e-14)


@both_dimensions
def test_the_stable_material_has_no_rest_but_rotations(dim):
    """A flat or collapsed element pushes, or has a way down: else it would never come back."""
    flat = np.eye(dim)
    flat[0, 0] = 0.0
    assert np.abs(respond("stable-neohookean", flat)[1]).max() > 0.1 * MU
    rng = np.random.default_rng(6)
    at_the_point = respond("stable-neohookean", np.zeros((dim, dim)))[0]
    nearby = respond("stable-neohookean", 1e-2 * np.stack([rotation(dim, s) for s in rng.integers(0, 99, 9)]))[0]
    assert np.all(nearby < at_the_point)


@both_dimensions
@pytest.mark.parametrize("name", INVERTIBLE)
def test_projection_removes_negative_eigenvalues_and_nothing_else(name, dim):
    F = np.concatenate((deformations(dim, 50), np.random.default_rng(8).uniform(-2, 2, (50, dim, dim)), [np.eye(dim)]))
    C = respond(name, F)[2]
    P = C.copy()
    project(P, F - np.eye(dim))
    flat, exact = P.reshape(-1, dim**2, dim**2), C.reshape(-1, dim**2, dim**2)
    values, vectors = np.linalg.eigh(exact)
    expected = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0), vectors)
    size = np.abs(values).max(axis=1)[:, None, None]
    np.testing.assert_allclose(flat / size, expected / size, atol=1e-13)
    np.testing.assert_allclose(flat / size, flat.transpose(0, 2, 1) / size, atol=1e-14)
    assert np.all(np.linalg.eigvalsh(flat) > -1e-13 * size[:, 0])
    untouched = values[:, 0] > -1e-15 * size[:, 0, 0]
    np.testing.assert_array_equal(flat[untouched], exact[untouched])
    if name != "linear":
        assert np.any(values[:, 0] < -1e-3 * size[:, 0, 0])


@both_dimensions
def test_projection_takes_any_symmetric_tangent_and_any_gradient(dim):
    rng = np.random.default_rng(3)
    A = rng.standard_normal((40, dim**2, dim**2))
    A += A.transpose(0, 2, 1)
    F = rng.standard_normal((40, dim, dim))
    F[0], F[1], F[2] = 0.0, np.eye(dim), -np.eye(dim)
    F[3:9, 0] = 0.0
    F[5:9, 1] = 0.0
    F[7, 0], F[8, 1] = 1.0, 1e-9 * F[9, 0]
    values, vectors = np.linalg.eigh(A)
    expected = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0), vectors)
    project(A.reshape(40, dim, dim, dim, dim), F - np.eye(dim))
    np.testing.assert_allclose(A, expected, atol=1e-13 * np.abs(values).max())


def test_projection_leaves_what_is_no_number():
    C = np.full((1, 2, 2, 2, 2), np.nan)
    project(C, np.zeros((1, 2, 2)))
    assert np.isnan(C).all()


def test_a_projected_material_differs_in_its_tangent_only():
    H = np.random.default_rng(9).uniform(-2, 2, (20, 2, 2))
    lame, mu = np.full(20, LAME), np.full(20, MU)
    exact, clamped = named("green")(H, lame, mu), projected(named("green"))(H, lame, mu)
    np.testing.assert_array_equal(clamped[0], exact[0])
    np.testing.assert_array_equal(clamped[1], exact[1])
    project(exact[2], H)
    np.testing.assert_array_equal(clamped[2], exact[2])
    assert projected(named("green"))(H, lame, mu, tangent=False)[2].shape == (0, 2, 2, 2, 2)
    assert projected(named("linear")) is named("linear")


def test_lame_parameters_invert_to_young_and_poisson():
    lame, mu = lame_parameters(7.0, 0.35)
    assert mu * (3 * lame + 2 * mu) / (lame + mu) == pytest.approx(7.0)
    assert lame / (2 * (lame + mu)) == pytest.approx(0.35)
