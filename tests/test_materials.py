"""Materials: stress is the derivative of energy, the tangent that of stress, and neither sees a rotation."""

import numpy as np
import pytest

from petfsi.fields.solid.materials import MATERIALS, lame_parameters

STEP = 1e-5


def deformations(dim: int, n: int = 20) -> np.ndarray:
    return np.eye(dim) + 0.3 * np.random.default_rng(1).standard_normal((n, dim, dim))


def rotation(dim: int, seed: int = 2) -> np.ndarray:
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))[0]
    return q * np.sign(np.linalg.det(q)) if dim == 3 else q @ np.diag([1.0, np.linalg.det(q)])


def central_difference(f, F: np.ndarray) -> np.ndarray:
    """Return df/dF with the axes of F last."""
    dim = F.shape[1]
    columns = []
    for k in range(dim):
        for L in range(dim):
            change = np.zeros((dim, dim))
            change[k, L] = STEP
            columns.append((f(F + change) - f(F - change)) / (2 * STEP))
    return np.stack(columns, axis=-1).reshape(*columns[0].shape, dim, dim)


@pytest.fixture(params=[(name, dim) for name in MATERIALS for dim in (2, 3)], ids=lambda p: f"{p[0]}-{p[1]}d")
def material(request):
    name, dim = request.param
    lame, mu = lame_parameters(3.0, 0.3)

    def respond(F):
        return MATERIALS[name](F - np.eye(dim), np.full(len(F), lame), np.full(len(F), mu))

    return respond, dim


def test_stress_is_the_derivative_of_energy(material):
    respond, dim = material
    F = deformations(dim)
    expected = central_difference(lambda F: respond(F)[0], F)
    np.testing.assert_allclose(respond(F)[1], expected, atol=1e-8 * np.abs(expected).max())


def test_tangent_is_the_derivative_of_stress(material):
    respond, dim = material
    F = deformations(dim)
    expected = central_difference(lambda F: respond(F)[1], F)
    np.testing.assert_allclose(respond(F)[2], expected, atol=1e-8 * np.abs(expected).max())


def test_tangent_has_major_symmetry(material):
    respond, dim = material
    C = respond(deformations(dim))[2]
    np.testing.assert_allclose(C, C.transpose(0, 3, 4, 1, 2), atol=1e-13 * np.abs(C).max())


def test_energy_sees_no_rotation_and_stress_turns_with_it(material):
    respond, dim = material
    F, R = deformations(dim), rotation(dim)
    W, P, _ = respond(F)
    turned_W, turned_P, _ = respond(R @ F)
    np.testing.assert_allclose(turned_W, W, rtol=1e-12)
    np.testing.assert_allclose(turned_P, R @ P, atol=1e-12)
    rest_W, rest_P, _ = respond(R[None])
    assert abs(rest_W[0]) < 1e-28
    assert np.abs(rest_P).max() < 1e-14


def test_small_strain_is_hookes_law(material):
    respond, dim = material
    lame, mu = lame_parameters(3.0, 0.3)
    I = np.eye(dim)  # noqa: E741
    expected = (
        lame * np.einsum("ij,kl->ijkl", I, I)
        + mu * np.einsum("ik,jl->ijkl", I, I)
        + mu * np.einsum("il,jk->ijkl", I, I)
    )
    np.testing.assert_allclose(respond(I[None])[2][0], expected, atol=1e-14)


def test_green_under_uniaxial_stretch_has_its_closed_form():
    """E_11 = (s^2 - 1)/2 alone: P_11 = s (lambda + 2 mu) E_11, P_22 = lambda E_11."""
    s, lame, mu = 1.7, 2.0, 0.6
    W, P, _ = MATERIALS["green"](np.diag([s - 1.0, 0.0, 0.0])[None], np.array([lame]), np.array([mu]))
    strain = (s * s - 1) / 2
    np.testing.assert_allclose(P[0], np.diag([s * (lame + 2 * mu), lame, lame]) * strain, rtol=1e-14, atol=1e-15)
    assert W[0] == pytest.approx((lame / 2 + mu) * strain**2, rel=1e-14)


def test_lame_parameters_invert_to_young_and_poisson():
    lame, mu = lame_parameters(7.0, 0.35)
    assert mu * (3 * lame + 2 * mu) / (lame + mu) == pytest.approx(7.0)
    assert lame / (2 * (lame + mu)) == pytest.approx(0.35)
