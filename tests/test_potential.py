"""The exact flows that walls are measured against."""

import numpy as np
import pytest

from petfsi.bench import potential
from petfsi.bench.potential import Round
from petfsi.scene.expressions import Expression

FLOWS = {2: Round((0.503, 0.491), 0.2, (0.8, 0.6)), 3: Round((0.5, 0.48, 0.49), 0.2, (0.48, 0.6, 0.64))}


@pytest.mark.parametrize("dim", [2, 3])
def test_a_stream_past_a_body_slips_along_it_and_is_a_stream_far_away(dim):
    flow = FLOWS[dim]
    normals = np.random.default_rng(1).normal(size=(50, dim))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    at = flow.velocity(np.array(flow.centre) + flow.radius * normals)
    assert np.abs(np.sum(at * normals, axis=1)).max() < 1e-14
    far = flow.velocity(np.array(flow.centre) + 1e4 * normals)
    assert np.abs(far - flow.stream).max() < 1e-7
    # fastest at the widest place, by d/(d - 1)
    assert np.linalg.norm(at, axis=1).max() == pytest.approx(dim / (dim - 1), rel=0.02)


@pytest.mark.parametrize("dim", [2, 3])
def test_what_comes_in_through_a_boxs_sides_is_the_mean_over_faces_and_goes_out_again(dim):
    flow, n = FLOWS[dim], 8
    line = (np.arange(n) + 0.5) / n
    gauss, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for number, side in enumerate(potential.sides(flow, [0.0] * dim, [1.0] * dim, [n] * dim).values()):
        axis, upper = divmod(number, 2)
        across = np.array(np.meshgrid(*[line] * (dim - 1), indexing="ij")).reshape(dim - 1, -1)
        points = np.insert(across, axis, float(upper), axis=0)
        speed = Expression(side["inflow"]["speed"], key="speed")(t=0.0, **dict(zip("xyz", points, strict=False)))
        total += speed.sum()
        off = np.array(np.meshgrid(*[gauss / (2 * n)] * (dim - 1), indexing="ij")).reshape(dim - 1, -1)
        part = np.prod(np.meshgrid(*[weights / 2] * (dim - 1), indexing="ij"), axis=0).ravel()
        moved = points.T[:, None, :] + np.insert(off, axis, 0.0, axis=0).T
        mean = flow.velocity(moved.reshape(-1, dim))[:, axis].reshape(len(speed), -1) @ part
        assert np.abs((1 - 2 * upper) * speed - mean).max() < 1e-11
    assert abs(total) < 1e-10


def test_added_mass_in_a_channel_is_known_from_afar_and_at_the_issues_radius():
    """Far walls act as a field A S y of dipoles A y / r^3; S is the lattice's sum of 1/r^3, in 2D pi^2/3 of 1/r^2."""
    R = 0.05
    for dim, total, accuracy in ((2, np.pi**2 / 3, 1e-5), (3, 9.03362, 2e-7)):
        field = total * R**dim / (dim - 1)
        guess = (1 + (dim - 1) * field) / (1 - field) / (dim - 1)
        assert potential.added_mass_in_channel(dim, R) == pytest.approx(guess, rel=accuracy)
    assert potential.added_mass_in_channel(2, 0.25) == pytest.approx(1.5184, abs=5e-5)


def test_a_beam_between_deep_layers_carries_two_half_planes_of_fluid():
    k, EI, mass, rho = 3.0, 2.0, 4.0, 1000.0
    seen = potential.beam_between_layers(k, EI, mass, 0.0, rho, 50.0, 50.0)
    assert seen == pytest.approx(np.sqrt(EI * k**4 / (mass + 2 * rho / k)), rel=1e-12)
